"""An auctioneer over a real router: jobs are accepted, awarded and finished, also across its restart."""

import errno
import os

import pytest

from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Announcement,
    Clock,
    ClockRequest,
    JobStatus,
    Result,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.messages import State, encode
from fleet.bus.router import open_client, other_versions
from fleet.errors import JournalFull
from fleet.live import journal
from fleet.live.auction.job_rules import status_reply
from fleet.live.journal import Journal
from tests.waiting import PATIENCE_S

TWICE = ("Started", "Started")
"""Of the owner, which compaction keeps, and of the start."""


def test_jobs_are_accepted_awarded_and_finished(bus):
    node = bus.auctioneer(places=frozenset({"rack", "bin"}))
    bus.arm("arm_0")
    bus.arm("arm_1")
    submission = Submission((*bus.jobs("a"), *bus.jobs("b", place="bin"), *bus.jobs("c", place="moon")), "test")
    replies = bus.ask(keys.of_jobs("f", "submit"), submission, SubmissionReply)
    (reply,) = replies.messages.values()
    assert [admission.accepted for admission in reply.jobs] == [True, True, False]
    bus.until(lambda: bus.states(node) == ["finished", "finished"])
    assert sorted(job for arm in bus.arms for job in arm.done) == ["a", "b"]
    (status,) = bus.ask(keys.of_jobs("f", "status"), StatusRequest(("b", "unknown")), Status).messages.values()
    assert [each.state for each in status.jobs] == ["finished"]


def test_a_late_subscriber_gets_the_last_results(bus):
    node = bus.auctioneer()
    bus.arm("arm_0")
    node.submit(Submission(bus.jobs("a")))
    bus.until(lambda: bus.states(node) == ["finished"])
    results, rounds = [], []
    late = bus.link()
    late.subscribe(keys.of_every_auction("f", "result"), Result, lambda _, result: results.append(result), history=True)
    late.subscribe(
        keys.of_every_auction("f", "announce"),
        Announcement,
        lambda _, announcement: rounds.append(announcement),
        history=True,
    )
    bus.until(lambda: len(results) == 4 and rounds)
    assert [result.status.state for result in results] == ["waiting", "awarded", "finishing", "finished"]
    assert [result.number for result in results] == [0, 1, 2, 3]
    assert [[offer.arm for offer in result.offers] for result in results] == [[], ["arm_0"], [], []]
    assert rounds[0].jobs == ("a",)


def test_no_job_is_lost_while_the_auctioneer_is_stopped(bus):
    first = bus.auctioneer()
    first.submit(Submission(bus.jobs("a", "b")))
    arm = bus.arm("arm_0")
    bus.until(lambda: "awarded" in bus.states(first))
    time_s = first.time_s
    bus.kill(first)
    second = bus.auctioneer()
    assert second.time_s >= time_s
    bus.until(lambda: bus.states(second) == ["finished", "finished"])
    assert sorted(arm.done) == ["a", "b"]
    assert len({award.award for award in arm.awards}) == 2


def test_fleet_time_runs_at_its_speed(bus):
    bus.auctioneer(speed=1000.0)
    (one,) = bus.ask(keys.of_clock("f"), ClockRequest(), Clock).messages.values()
    (two,) = bus.ask(keys.of_clock("f"), ClockRequest(), Clock).messages.values()
    assert one.speed == 1000.0
    assert 0.0 <= one.time_s < two.time_s


def test_an_arm_with_a_token_but_without_a_state_is_not_present(bus):
    node = bus.auctioneer()
    silent = bus.link()
    silent.declare_token(keys.of_arm("f", "silent", "alive"))
    bus.arm("arm_0")
    bus.until(lambda: node.present == {"arm_0"} and "silent" in node._tokens)


def test_with_a_full_disk_jobs_are_refused_and_the_auctioneer_continues(bus):
    full = []

    def sync(file):
        if full:
            raise OSError(full.pop(), "No space left on device")
        os.fsync(file)

    node = bus.auctioneer(sync=sync)
    full.append(errno.ENOSPC)
    replies = bus.ask(keys.of_jobs("f", "submit"), Submission(bus.jobs("a")), SubmissionReply)
    assert "no space left" in next(iter(replies.refused.values()))
    full.append(errno.ENOSPC)
    with pytest.raises(JournalFull):
        node.submit(Submission(bus.jobs("a")))
    assert bus.ask(keys.of_jobs("f", "submit"), Submission(bus.jobs("a")), SubmissionReply).messages
    assert bus.states(node) == ["waiting"]


def test_the_journal_is_compacted_at_the_start_and_when_it_has_grown(bus, monkeypatch):
    first = bus.auctioneer()
    bus.arm("arm_0")
    bus.ask(keys.of_jobs("f", "submit"), Submission(bus.jobs("a"), "test"), SubmissionReply)
    bus.until(lambda: bus.states(first) == ["finished"])
    bus.kill(first)
    again = bus.auctioneer()
    assert [type(record).__name__ for record in again.journal.records()] == ["LedgerSnapshot", *TWICE]
    assert bus.states(again) == ["finished"]
    monkeypatch.setattr(journal, "TICK_S", 0.01)
    monkeypatch.setattr(journal, "COMPACT_BYTES", 1)
    before = again.journal.path.stat().st_size
    bus.kill(again)
    third = bus.auctioneer()
    sizes = []
    bus.until(lambda: sizes.append(third.journal.path.stat().st_size) or (len(sizes) > 1 and sizes[-1] < sizes[-2]))
    assert max(sizes) < 5 * before
    assert bus.states(third) == ["finished"]


def test_a_journal_that_cannot_be_compacted_is_continued(bus, monkeypatch, caplog):
    first = bus.auctioneer()
    bus.ask(keys.of_jobs("f", "submit"), Submission(bus.jobs("a"), "test"), SubmissionReply)
    bus.kill(first)
    with monkeypatch.context() as full:
        full.setattr(Journal, "rewrite", refuse)
        again = bus.auctioneer()
    assert "is not compacted: no room" in caplog.text
    assert [type(record).__name__ for record in again.journal.records()] == [
        "LedgerSnapshot",
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
    assert "nobody" not in node.auctioneer.ledger.taken_space()
    outsider.declare_token(keys.of_arm("f", "nobody", "alive"))
    bus.until(lambda: "nobody" in node._tokens)
    outsider.publish(keys.of_arm("f", "nobody", "state"), said)
    bus.until(lambda: "nobody" in node.auctioneer.ledger.taken_space())
