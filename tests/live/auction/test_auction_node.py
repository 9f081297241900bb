"""An auctioneer over a real router: awards, requests of people, restarts, rivals and lost journals."""

import re
import time
from contextlib import ExitStack
from itertools import count
from typing import Any, ClassVar

import pytest
from msgspec.structs import replace

from fleet.bus.client import BusClient, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    Announcement,
    Award,
    Clock,
    ClockRequest,
    JobEstimate,
    JobSpec,
    Lease,
    LeaseEntry,
    LeaseRequest,
    PlanQuote,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
    Result,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.consensus import History, HistoryRequest
from fleet.bus.protocol.keys import HISTORY
from fleet.bus.protocol.messages import State, encode
from fleet.bus.protocol.operator import ControlRequest, Operation, Pause
from fleet.bus.router import Router, open_client, other_versions
from fleet.errors import BusError, JournalFull, Refused
from fleet.live import journal
from fleet.live.auction import node as auction_node
from fleet.live.auction.auctioneer import Auctioneer
from fleet.live.auction.node import AuctionNode
from fleet.live.auction.rounds import Assignment
from fleet.live.book import JobBook
from fleet.live.epochs import kept_time_s
from fleet.live.journal import EpochBegun, JobsAccepted, Journal
from fleet.live.records import BookRecord
from tests.waiting import PATIENCE_S, serving, wait_until


def first_come(bidding):
    """Return one job per arm, in the order of jobs and arms."""
    return dict(zip((job.name for job in bidding.jobs), map(Assignment, sorted(bidding.quotes)), strict=False))


class Arm:
    """The simplest arm: it accepts one job at a time and finishes it as soon as it is permitted to commit."""

    def __init__(self, link, name):
        self.link, self.name = link, name
        self.done, self.awards, self.commits = [], [], True
        self.kept_s, self.kept_epoch = 0.0, None
        self._numbers = count()
        self._current, self._answers, self._published_s, self._asked = None, {}, 0.0, False
        fleet = link.fleet
        link.reply_to(keys.of_arm(fleet, name, "quote"), QuoteRequest, self.quote)
        link.reply_to(keys.of_arm(fleet, name, "award"), Award, self.answer_award)
        link.reply_to(keys.of_arm(fleet, name, "history"), HistoryRequest, self.history)
        link.declare_token(keys.of_arm(fleet, name, "alive"))

    def history(self, request):
        finished = tuple(award.job for award in self.awards if award.job.name in self.done)
        current = () if self._current is None or self._current.job.name in self.done else (self._current,)
        epoch = self.awards[-1].epoch if self.awards else ""
        epoch = epoch if self.kept_epoch is None else self.kept_epoch
        return History(self.name, epoch, finished, current, time_s=self.kept_s)

    def quote(self, request):
        estimates = tuple(JobEstimate(job.name, (PlanQuote(finish_in_s=1.0),)) for job in request.jobs)
        quote, capacity = f"{self.name}-{next(self._numbers)}", int(self._current is None)
        return Quote(self.name, request.auction, quote, 5.0, "none", 0.0, "idle", 20.0, capacity, estimates)

    def answer_award(self, award):
        self.awards.append(award)
        if award.award not in self._answers:
            self._answers[award.award] = Ack(self.name, award.award, self._current is None)
            self._current = self._current or award
        return self._answers[award.award]

    def step(self):
        self.link.serve(time.monotonic() + 0.005)
        if time.monotonic() > self._published_s + 0.1:
            self._published_s = time.monotonic()
            state = State(self.name, next(self._numbers), 0.0, "idle", (30.0,), 30.0)
            self.link.publish(keys.of_arm(self.link.fleet, self.name, "state"), state)
            if self._current is not None and not self._asked and self.commits:
                entry = LeaseEntry(self._current.award, self._current.job.name, 0, "finishing")
                self._query("lease", LeaseRequest(self.name, (entry,)), Lease, self.apply_lease)

    def _query(self, topic, request, kind, done):
        self._asked = True
        key = keys.asked_by(self.link.fleet, self._current.auctioneer, topic, self.name)
        # A request for a lease is repeated, also to the next auctioneer; a report is sent once.
        self.link.query(key, request, kind, done, timeout_s=1.0 if topic == "lease" else PATIENCE_S)

    def apply_lease(self, replies):
        self._asked = False
        for lease in replies.messages.values():
            if self._current is not None and self._current.award in lease.may_commit:
                award, job = self._current.award, self._current.job.name
                self.done.append(job)
                self._query("report", Report(self.name, award, job, "finished", 1, 0.0), Receipt, self.apply_receipt)

    def apply_receipt(self, replies):
        assert replies.messages
        self._current, self._asked = None, False


class Bus:
    """A router, and participants that are served in turn."""

    def __init__(self, stack, folder):
        self.stack, self.folder = stack, folder
        self.endpoint = stack.enter_context(Router()).endpoint
        self.arms, self.nodes, self.links = [], [], []

    def link(self):
        self.links.append(self.stack.enter_context(BusClient(self.endpoint, "f")))
        return self.links[-1]

    def arm(self, name):
        self.arms.append(Arm(self.stack.enter_context(BusClient(self.endpoint, "f")), name))
        return self.arms[-1]

    def auctioneer(self, name="auctioneer", folder="", **options):
        """Start an auctioneer with resources of its own, which `kill` closes."""
        with ExitStack() as resources:
            link = resources.enter_context(BusClient(self.endpoint, "f"))
            path = self.folder / folder / name
            journal = resources.enter_context(Journal[BookRecord](path, BookRecord, durable=False))
            node = AuctionNode(link, name, journal, **{"allocate": first_come, "speed": 60.0, **options})
            node.resources = self.stack.enter_context(resources.pop_all())
        self.nodes.append(node)
        return node

    def kill(self, node):
        self.nodes.remove(node)
        node.resources.close()

    def until(self, condition):
        """Serve all until a condition holds."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline_s, "the condition was never met"
            for node in self.nodes:
                node.serve(time.monotonic() + 0.005)
            for arm in self.arms:
                arm.step()
            for link in self.links:
                link.serve(time.monotonic() + 0.001)

    def serve_for(self, seconds):
        end_s = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end_s)

    def ask(self, key, request, kind):
        """Return the replies to a query of an outsider."""
        replies = []
        self.link().query(key, request, kind, replies.append, timeout_s=PATIENCE_S)
        self.until(lambda: replies)
        return replies[0]

    @staticmethod
    def jobs(*names, place="rack"):
        return tuple(JobSpec(name=name, kind="hold", places=(place,)) for name in names)

    @staticmethod
    def states(node):
        """Return the state of every job of an auctioneer."""
        return [status.state for status in node.auctioneer.status()]


@pytest.fixture
def bus(tmp_path):
    with ExitStack() as stack:
        yield Bus(stack, tmp_path)


class WrongArm(Arm):
    """An arm whose quotes have other fields."""

    change: ClassVar[dict[str, Any]] = {}

    def quote(self, request):
        return replace(super().quote(request), **self.change)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"auction": "x"}, "quoted for another round"),
        (
            {"estimates": (JobEstimate("a", (PlanQuote(duration_s=0.0),)),)},
            "gave no valid quote: Not a thermofleet.Quote",
        ),
        ({"estimates": (JobEstimate("a", (PlanQuote(finish_in_s=-1.0),)),)}, "Expected `float` >= 0"),
        ({"estimates": ()}, "did not quote"),
    ],
)
def test_what_is_wrong_with_a_quote_is_logged_once_and_is_the_reason_of_the_job(bus, caplog, change, says):
    node = bus.auctioneer()
    arm = WrongArm(bus.stack.enter_context(BusClient(bus.endpoint, "f")), "arm_0")
    arm.change = change
    bus.arms.append(arm)
    submit(bus, "a")
    bus.until(lambda: says in node.auctioneer.status(("a",))[0].reason)
    bus.serve_for(1.0)
    logged = [each.getMessage() for each in caplog.records if each.getMessage().startswith("Arm 'arm_0' ")]
    assert len(logged) == 1
    assert says in logged[0]


def test_cycles_beyond_those_of_a_job_do_not_count_and_are_logged_once(bus, caplog):
    node = bus.auctioneer()
    bus.arm("arm_0").commits = False
    job = JobSpec(name="a", kind="hold", places=("rack",), repetitions=3)
    bus.ask(keys.of_jobs("f", "submit"), Submission((job,)), SubmissionReply)
    bus.until(lambda: node.book.open)
    (award,) = node.book.open
    for cycles in (50, 19):
        request = LeaseRequest("arm_0", (LeaseEntry(award, "a", cycles, "working"),))
        (lease,) = bus.ask(keys.asked_by("f", "auctioneer", "lease", "arm_0"), request, Lease).messages.values()
        assert lease.granted == (award,)
    assert node.auctioneer.status(("a",))[0].cycles == 2
    assert warnings_of(caplog) == ["Arm 'arm_0' reports 50 cycles of 'a', which has 3: only 2 count."]


def warnings_of(caplog):
    return [each.getMessage() for each in caplog.records if each.getMessage().startswith("Arm 'arm_0' ")]


def test_a_refused_award_is_logged_with_its_reason(bus, caplog, monkeypatch):
    monkeypatch.setattr(Arm, "answer_award", lambda self, award: Ack(self.name, award.award, False, "Too windy."))
    node = bus.auctioneer()
    bus.arm("arm_0")
    submit(bus, "a")
    bus.until(lambda: "has refused it" in node.auctioneer.status(("a",))[0].reason)
    (award,) = node.book.jobs["a"].grants
    assert warnings_of(caplog) == [f"Arm 'arm_0' refuses award '{award}': Too windy."]


def test_an_arm_that_does_not_quote_in_time_is_logged_and_named_in_the_status(bus, caplog, monkeypatch):
    node = bus.auctioneer()
    link = bus.stack.enter_context(BusClient(bus.endpoint, "f"))
    reply_to = link.reply_to
    monkeypatch.setattr(link, "reply_to", lambda key, *more: key.endswith("/quote") or reply_to(key, *more))
    bus.arms.append(Arm(link, "arm_0"))
    submit(bus, "a")
    bus.until(lambda: "has not quoted within 0.5 s in the last 3 rounds" in node._left_out().get("arm_0", ""))
    assert warnings_of(caplog) == ["Arm 'arm_0' has not quoted within 0.5 s: it is awarded no job."]


def test_a_report_that_is_refused_again_and_again_is_logged_once(bus, caplog):
    node = bus.auctioneer()
    bus.arm("arm_0").commits = False
    submit(bus, "a")
    bus.until(lambda: node.book.open)
    (award,) = node.book.open
    for _ in range(3):
        report = Report("arm_0", award, "b", "finished", 1, 0.0)
        key = keys.asked_by("f", "auctioneer", "report", "arm_0")
        assert bus.ask(key, report, Receipt).refusals
    (logged,) = (each.getMessage() for each in caplog.records if f"Award '{award}'" in each.getMessage())
    assert logged.startswith("Arm 'arm_0' reports in vain: Award")


def test_quotes_under_no_valid_key_are_logged_at_a_limited_rate(bus, caplog):
    node = bus.auctioneer()
    for _ in range(3):
        node._end_quotes(
            "r",
            frozenset(),
            Replies(refused={"thermofleet/v4/f/arm/.dot/quote": "'…/.dot/quote' is no key of this bus."}),
        )
    logged = [each.getMessage() for each in caplog.records if each.getMessage().startswith("No quote")]
    assert logged == ["No quote: '…/.dot/quote' is no key of this bus."]


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


def refuse(*_records, **_options):
    raise JournalFull("no room")


def test_the_status_of_1500_jobs_comes_in_pages_with_why_each_waits(bus):
    node = bus.auctioneer()
    long = "x" * 100
    node.submit(Submission(bus.jobs(*(f"{long}{i}" for i in range(1500)))))
    jobs, after = [], ""
    for _ in range(1 + 1500 // 128):
        request = StatusRequest((), after)
        (status,) = bus.ask(keys.of_jobs("f", "status"), request, Status).messages.values()
        assert len(encode(status)) < 65_536
        jobs += status.jobs
        after = status.next
    assert (len({job.job for job in jobs}), after, status.counts) == (1500, "", {"waiting": 1500})
    assert all(job.reason for job in jobs)


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


def test_another_job_may_not_have_the_name_of_a_job_of_the_scenario_that_is_released_later(bus):
    (own,) = bus.jobs("load-004")
    node = bus.auctioneer(reserved={own.name: own})
    other, follower, free = (
        JobSpec("load-004", "hold", ("bin",)),
        JobSpec("b", "hold", ("bin",), after=("load-004",)),
        JobSpec("load-4", "hold", ("bin",)),
    )
    (reply,) = bus.ask(
        keys.of_jobs("f", "submit"), Submission((other, follower, free)), SubmissionReply
    ).messages.values()
    assert [job.reason for job in reply.jobs] == [
        "The scenario has another job 'load-004', released later; give this one another name.",
        "It waits for 'load-004', which is unknown or was not accepted.",
        "",
    ]
    assert node.submit(Submission((own,))).jobs[0].accepted
    assert submit(bus, "load-004").jobs[0].accepted  # the same job
    assert node.book.jobs["load-004"].spec == own


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
    assert reason.endswith("Or stop 'arm_0', if it alone is wrong.")
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
    trouble = error.replace("accepted until", "accepted or awarded until")
    assert {reply.trouble for reply in status.messages.values()} == {trouble}
    assert {reply.jobs[0].reason for reply in status.messages.values()} == {trouble}
    bus.serve_for(0.5)
    assert bus.states(one) == bus.states(two) == ["waiting"]
    assert not arm.awards
    bus.kill(two)
    bus.until(lambda: bus.states(one) == ["finished"])
    assert arm.done == ["a"]


def test_a_full_disk_is_told_as_the_trouble_and_as_the_reason_of_waiting_jobs(bus, monkeypatch):
    monkeypatch.setattr(journal, "TICK_S", 0.01)
    node = bus.auctioneer()
    node.submit(Submission(bus.jobs("a")))

    def status():
        (reply,) = bus.ask(keys.of_jobs("f", "status"), StatusRequest(), Status).messages.values()
        return reply.trouble, reply.jobs[0].reason

    with monkeypatch.context() as full:
        full.setattr(Journal, "_write", refuse)
        bus.until(lambda: status()[0])
        arm = bus.arm("arm_0")
        bus.until(lambda: node.auctioneer.rounds.present)
        assert status() == ("No jobs are accepted or awarded: no room",) * 2
    bus.until(lambda: bus.states(node) == ["finished"])
    assert (status()[0], arm.done) == ("", ["a"])


def test_fleet_time_continues_as_the_arms_have_kept_it_while_there_was_no_auctioneer(bus):
    """The median of the arms that know its epoch; others may keep another time."""
    first = bus.auctioneer()
    arms = [bus.arm(f"arm_{number}") for number in range(3)]
    submit(bus, "a", "b", "c")
    bus.until(lambda: bus.states(first) == ["finished"] * 3)
    assert first.time_s < 100.0
    bus.kill(first)
    for arm, time_s in zip(arms, (1e9, 500.0, 480.0), strict=True):
        arm.kept_s, arm.kept_epoch = time_s, first.epoch
    again = served(bus, bus.auctioneer)
    assert 500.0 <= again.time_s < 600.0
    assert again.book.time_s >= 500.0
    bus.kill(again)
    for arm, epoch in zip(arms, ("other", "", "other"), strict=True):
        arm.kept_s, arm.kept_epoch = 2000.0, epoch
    assert kept_time_s([arm.history(None) for arm in arms], again.epoch) == 0.0
    assert kept_time_s([], again.epoch) == 0.0


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
