"""After the loss of the auctioneer's journal no job is done twice: the arms know what they have done and have."""

import pytest

from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Clock, ClockRequest, Status, StatusRequest, Submission, SubmissionReply
from fleet.errors import BusError


def submit(bus, *names):
    (reply,) = bus.ask(keys.of_jobs("f", "submit"), Submission(bus.jobs(*names)), SubmissionReply).messages.values()
    return reply


def lose(bus, node):
    """Stop an auctioneer and delete its journal."""
    bus.kill(node)
    node.journal.path.unlink()


def test_an_empty_journal_is_refused_beside_arms_that_know_an_epoch(bus):
    first = bus.auctioneer()
    arm = bus.arm("arm_0")
    before = submit(bus, "a", "b")
    bus.until(lambda: bus.states(first) == ["finished", "finished"])
    lose(bus, first)
    with pytest.raises(BusError, match=r"'arm_0' knows the epoch '\w+', 2 finished job\(s\), the last ones a, b"):
        served(bus, bus.auctioneer)
    again = served(bus, lambda: bus.auctioneer(new_epoch=True))
    bus.until(lambda: again.present and len(again.auctioneer.ledger.past) == 2)
    after = submit(bus, "a", "b", "c")
    assert [job.accepted for job in after.jobs] == [True] * 3
    assert before.epoch != after.epoch == again.epoch
    bus.until(lambda: bus.states(again) == ["finished"])
    assert arm.done == ["a", "b", "c"]
    replies = (
        *bus.ask(keys.of_clock("f"), ClockRequest(), Clock).messages.values(),
        *bus.ask(keys.of_jobs("f", "status"), StatusRequest(), Status).messages.values(),
    )
    assert {reply.epoch for reply in replies} == {after.epoch}
    bus.kill(again)
    assert served(bus, bus.auctioneer).epoch == after.epoch


def test_jobs_are_refused_when_arms_of_an_older_epoch_come_later(bus):
    first = bus.auctioneer()
    arm = bus.arm("arm_0")
    submit(bus, "a")
    bus.until(lambda: bus.states(first) == ["finished"])
    lose(bus, first)
    bus.arms.clear()
    arm.link.close()
    second = bus.auctioneer()
    back = bus.arm("arm_0")
    back.awards, back.done = arm.awards, arm.done
    key = keys.of_jobs("f", "submit")
    bus.until(lambda: second._epochs.objection)
    (reason,) = bus.ask(key, Submission(bus.jobs("a")), SubmissionReply).refused.values()
    assert "the journal has the epoch" in reason
    assert "--new-epoch" in reason
    assert second._epochs.admitted(["arm_0"]) == frozenset()


def test_an_award_that_an_arm_still_has_is_adopted(bus):
    first = bus.auctioneer()
    arm = bus.arm("arm_0")
    arm.commits = False
    submit(bus, "a")
    bus.until(lambda: bus.states(first) == ["awarded"] and arm._current)
    lose(bus, first)
    again = served(bus, lambda: bus.auctioneer(new_epoch=True))
    bus.until(lambda: bus.states(again) == ["awarded"])
    arm.commits = True
    bus.until(lambda: bus.states(again) == ["finished"])
    assert submit(bus, "a").jobs[0].accepted
    bus.serve_for(1.0)
    assert (arm.done, len(arm.awards)) == (["a"], 1)


def test_an_older_copy_of_the_journal_learns_what_is_finished(bus):
    first = bus.auctioneer()
    arm = bus.arm("arm_0")
    arm.commits = False
    submit(bus, "a")
    bus.until(lambda: bus.states(first) == ["awarded"] and arm._current)
    submit(bus, "b")
    copy = first.journal.path.read_bytes()
    arm.commits = True
    bus.until(lambda: bus.states(first) == ["finished"] * 2)
    bus.kill(first)
    first.journal.path.write_bytes(copy)
    again = served(bus, bus.auctioneer)
    bus.until(lambda: bus.states(again).count("finished") == 1)
    bus.serve_for(1.0)
    assert arm.done == ["a", "b"]


def served(bus, start):
    """Start an auctioneer while the arms are served by another thread."""
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        started = pool.submit(start)
        bus.until(started.done)
        return started.result()
