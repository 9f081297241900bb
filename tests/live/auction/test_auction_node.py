"""An auctioneer over a real router: awards, requests of people, restarts, rivals and lost journals."""

import re

import pytest

from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Announcement,
    Clock,
    ClockRequest,
    JobSpec,
    JobStatus,
    Result,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.keys import HISTORY
from fleet.bus.protocol.messages import State, encode
from fleet.bus.protocol.operator import ControlRequest, Operation, Pause
from fleet.bus.router import open_client, other_versions
from fleet.errors import BusError, JournalFull, Refused
from fleet.live import journal
from fleet.live.auction import node as auction_node
from fleet.live.auction.auctioneer import Auctioneer
from fleet.live.auction.node import AuctionNode
from fleet.live.book import JobBook
from fleet.live.job_rules import status_reply
from fleet.live.journal import EpochBegun, JobsAccepted, Journal
from tests.waiting import PATIENCE_S, serving, wait_until

TWICE = ("Started", "Started")
"""Of the owner, which compaction keeps, and of the start."""


def test_jobs_are_accepted_awarded_and_finished(bus):
    node = bus.auctioneer(places=frozenset({"rack", "bin"}), speed=1000.0)
    bus.arm("arm_0")
    bus.arm("arm_1")
    submission = Submission((*bus.jobs("a"), *bus.jobs("b", place="bin"), *bus.jobs("c", place="moon")), "test")
    (reply,) = bus.ask(keys.of_jobs("f", "submit"), submission, SubmissionReply).messages.values()
    assert [admission.accepted for admission in reply.jobs] == [True, True, False]
    bus.until(lambda: bus.states(node) == ["finished", "finished"])
    assert sorted(job for arm in bus.arms for job in arm.done) == ["a", "b"]
    (status,) = bus.ask(keys.of_jobs("f", "status"), StatusRequest(("b", "unknown")), Status).messages.values()
    assert [each.state for each in status.jobs] == ["finished"]
    (one,), (two,) = (bus.ask(keys.of_clock("f"), ClockRequest(), Clock).messages.values() for _ in range(2))
    assert (one.speed, 0.0 <= one.time_s < two.time_s) == (1000.0, True)


def test_a_late_subscriber_gets_the_last_results(bus):
    node = bus.auctioneer()
    bus.arm("arm_0")
    submit(bus, "a")
    bus.until(lambda: bus.states(node) == ["finished"])
    results, rounds = [], []
    late = bus.link()
    late.subscribe(keys.of_every_auction("f", "result"), Result, lambda _, result: results.append(result), history=True)
    late.subscribe(keys.of_every_auction("f", "announce"), Announcement, lambda _, it: rounds.append(it), history=True)
    bus.until(lambda: len(results) == 4 and rounds)
    assert [result.status.state for result in results] == ["waiting", "awarded", "finishing", "finished"]
    assert [result.number for result in results] == [0, 1, 2, 3]
    assert [[offer.arm for offer in result.offers] for result in results] == [[], ["arm_0"], [], []]
    assert rounds[0].jobs == ("a",)


def test_an_arm_with_a_token_but_without_a_state_is_not_present(bus):
    node = bus.auctioneer()
    silent = bus.link()
    silent.declare_token(keys.of_arm("f", "silent", "alive"))
    bus.arm("arm_0")
    bus.until(lambda: node.present == {"arm_0"} and "silent" in node._tokens)


def test_the_journal_is_compacted_at_the_start_and_when_it_has_grown(bus, monkeypatch):
    first = bus.auctioneer()
    bus.arm("arm_0")
    submit(bus, "a")
    bus.until(lambda: bus.states(first) == ["finished"])
    bus.kill(first)
    again = bus.auctioneer()
    assert [type(record).__name__ for record in again.journal.records()] == ["BookSnapshot", *TWICE]
    assert bus.states(again) == ["finished"]
    monkeypatch.setattr(journal, "TICK_S", 0.01)
    monkeypatch.setattr(journal, "COMPACT_BYTES", 1)
    monkeypatch.setattr(journal, "COMPACT_FACTOR", 1.1)
    bus.kill(again)
    third = bus.auctioneer()
    rows = []
    bus.until(lambda: rows.append(len(list(third.journal.records()))) or (len(rows) > 1 and rows[-1] < rows[-2]))
    assert max(rows) < 50
    assert bus.states(third) == ["finished"]


def test_a_journal_that_cannot_be_compacted_is_continued(bus, monkeypatch, caplog):
    first = bus.auctioneer()
    submit(bus, "a")
    bus.kill(first)
    with monkeypatch.context() as full:
        full.setattr(Journal, "rewrite", refuse)
        again = bus.auctioneer()
    assert "is not compacted: no room" in caplog.text
    assert [type(record).__name__ for record in again.journal.records()] == [
        "BookSnapshot",
        *TWICE,
        "EpochBegun",
        "JobsAccepted",
        "Started",
    ]
    assert bus.states(again) == ["waiting"]


def refuse(*_records):
    raise JournalFull("no room")


def test_the_status_of_1500_jobs_fits_into_one_message_with_open_jobs_first(bus):
    node = bus.auctioneer()
    long = "x" * 100
    node.submit(Submission(bus.jobs(*(f"{long}{i}" for i in range(1500)))))
    (status,) = bus.ask(keys.of_jobs("f", "status"), StatusRequest(), Status).messages.values()
    assert 100 < len(status.jobs) <= 256
    assert len(encode(status)) < 65_536
    first = JobStatus("done", "finished")
    taken = {f"arm_{number}": frozenset("*") for number in range(1000)}
    reply = status_reply("x", 0.0, (first, *status.jobs * 2), taken)
    assert (len(reply.jobs) > 0, reply.jobs[0].state, len(reply.space)) == (True, "waiting", 1000)
    assert len(encode(reply)) < 65_536


def test_an_arm_of_an_older_version_is_named_with_its_version(bus):
    bus.arm("arm 2")
    with open_client(bus.endpoint, timeout_s=PATIENCE_S) as session:
        token = session.liveliness().declare_token("thermofleet/v2/f/arm/arm%201/alive")
        (sentence,) = other_versions(bus.endpoint, "f")
        token.undeclare()
    assert sentence.startswith("'arm 1' uses version v2 of the bus, and this program v4")


def test_a_state_without_a_token_takes_no_space_unless_the_arm_is_of_the_cell(bus):
    """Any process could stop the fleet: an arm outside the cell may be anywhere, and would be in everybody's way."""
    node = bus.auctioneer(arms=("arm_0",), excludes=lambda *_: True)
    outsider = bus.link()
    said = State("nobody", 1, 0.0, "working", (30.0,), 30.0, space="s")
    for _ in range(3):
        outsider.publish(keys.of_arm("f", "nobody", "state"), said)
        bus.serve_for(0.1)
    assert "nobody" not in node.auctioneer.book.taken_space()
    outsider.declare_token(keys.of_arm("f", "nobody", "alive"))
    bus.until(lambda: "nobody" in node._tokens)
    outsider.publish(keys.of_arm("f", "nobody", "state"), said)
    bus.until(lambda: "nobody" in node.auctioneer.book.taken_space())


def auctioneer_of(book: JobBook) -> Auctioneer:
    return Auctioneer("boss", book, allocate=lambda _: {}, keep=lambda *_: None, boot="1", real_s=0.0)


def test_a_restart_publishes_as_much_again_as_was_cached():
    """Or what a recorder had not yet received when the auctioneer ended is lost."""
    before = auctioneer_of(JobBook().replay([EpochBegun("e")]))
    for start in range(0, 2 * HISTORY, 128):
        jobs = tuple(JobSpec(name=str(start + i), kind="hold", places=("rack",)) for i in range(128))
        before.book.record(JobsAccepted(jobs, "bob", 1.0))
    before.set_present(frozenset(["arm_0"]))
    for number in range(3):
        before.control(ControlRequest(str(number), Pause("arm_0"), "ann"), 2.0)
    after = auctioneer_of(JobBook().replay(before.book.compact()))
    for kind in (Result, Operation):
        sent, again = ([message for message in each.out if isinstance(message, kind)] for each in (before, after))
        assert [message.number for message in sent] == list(range(len(sent)))
        assert {message.epoch for message in sent} == {"e"}
        assert again == sent[-HISTORY:]


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
    bus.until(lambda: again.present and len(again.book.jobs) == 2)
    after = submit(bus, "a", "b", "c")
    assert [job.accepted for job in after.jobs] == [True] * 3
    assert before.epoch != after.epoch == again.epoch
    bus.until(lambda: bus.states(again) == ["finished"] * 3)
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
    path, log = first.journal.path, first.journal.path.with_name("auctioneer-wal")
    copy = path.read_bytes(), log.read_bytes()
    arm.commits = True
    bus.until(lambda: bus.states(first) == ["finished"] * 2)
    bus.kill(first)
    path.write_bytes(copy[0])
    log.write_bytes(copy[1])
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


def test_a_fleet_has_one_auctioneer(bus, token_reaches):
    node = bus.auctioneer("one")
    token_reaches(bus.link(), keys.of_auction("f", "one", "alive"))
    # While the second one starts, the first is not served, as if it were stopped: only its token is present.
    with pytest.raises(BusError, match=r"has an auctioneer already: 'one'. A fleet has one"):
        bus.auctioneer("two")
    with pytest.raises(BusError, match=r"has an auctioneer 'one' already: its token is present. Stop that one first"):
        bus.auctioneer("one", folder="elsewhere")
    bus.kill(node)
    assert bus.states(bus.auctioneer("one")) == []


@pytest.mark.ci_slow
def test_a_participant_that_replies_without_a_token_counts_as_an_auctioneer(bus, token_reaches, monkeypatch):
    early = bus.link()
    early.reply_to(keys.of_jobs("f", "status"), StatusRequest, lambda _: Status("one", 0.0, ()))
    early.watch_tokens(keys.of_every_arm("f", "alive"), lambda *_: None)
    probe, request = bus.link(), StatusRequest(("?",))
    wait_until(lambda: probe.query_and_wait(keys.of_jobs("f", "status"), request, Status, timeout_s=2.0).refused)
    with pytest.raises(BusError, match="has an auctioneer already, which does not reply"):
        bus.auctioneer("two")
    monkeypatch.setattr(auction_node, "OTHERS_S", PATIENCE_S)
    with serving(early):
        with pytest.raises(BusError, match="has an auctioneer already: 'one'"):
            bus.auctioneer("two")
        with bus.link() as arm:
            arm.declare_token(keys.of_arm("f", "one", "alive"))
            token_reaches(early, keys.of_arm("f", "one", "alive"))
            with pytest.raises(BusError, match=r"allocate the jobs themselves; 'one' replies .* Stop them first"):
                bus.auctioneer("two")


@pytest.mark.parametrize("other", ["two", "one"])
def test_two_auctioneers_detect_each_other_and_neither_accept_nor_award_jobs(bus, monkeypatch, other):
    """Both start while the network is cut, and meet after it; those of one name share one token."""
    monkeypatch.setattr(AuctionNode, "_check_no_auctioneer", lambda self: None)
    one, two = bus.auctioneer("one"), bus.auctioneer(other, folder="elsewhere")
    for node in (one, two):  # before either is served
        node.submit(Submission(bus.jobs("a")))
    arm = bus.arm("arm_0")
    bus.until(lambda: (one.rivals, two.rivals, one.present, two.present) == ({other}, {"one"}, *2 * [{"arm_0"}]))
    replies = bus.ask(keys.of_jobs("f", "submit"), Submission(bus.jobs("b")), SubmissionReply)
    error = f"Fleet 'f' has more than one auctioneer (one, {other}): no jobs are accepted until one is stopped."
    assert (replies.messages, {*replies.refused.values()}) == ({}, {error})
    with pytest.raises(Refused, match=re.escape(error)):
        one.submit(Submission(bus.jobs("b")))
    status = bus.ask(keys.of_jobs("f", "status"), StatusRequest(), Status)
    assert {reply.auctioneer for reply in status.messages.values()} == {"one", other}
    bus.serve_for(0.5)
    assert bus.states(one) == bus.states(two) == ["waiting"]
    assert not arm.awards
    bus.kill(two)
    bus.until(lambda: bus.states(one) == ["finished"])
    assert arm.done == ["a"]


def test_an_auctioneer_without_a_recent_check_for_others_awards_nothing(bus, monkeypatch):
    """It awards nothing before its first check, nor long after its last."""
    alone = bus.auctioneer("one")
    arm = bus.arm("arm_0")
    monkeypatch.setattr(AuctionNode, "_check_rivals", lambda self, real_s: None)
    alone.submit(Submission(bus.jobs("a")))
    bus.until(lambda: alone.present == {"arm_0"})
    bus.serve_for(0.3)
    assert not arm.awards
    monkeypatch.undo()
    bus.until(lambda: bus.states(alone) == ["finished"])
    monkeypatch.setattr(auction_node, "ALONE_S", 0.0)  # as if it had been stopped for longer than that
    alone.submit(Submission(bus.jobs("b")))
    bus.serve_for(0.3)
    assert arm.done == ["a"]
