"""The auctioneer over a real router: jobs are taken, awarded and finished, and go on after it was gone."""

import errno
import os
import re
import threading
import time
from contextlib import ExitStack
from functools import partial
from itertools import count

import pytest

from fleet.bus.client.client import BusClient
from fleet.bus.client.router import Router
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    Announcement,
    Award,
    Clock,
    ClockRequest,
    JobEstimate,
    JobSpec,
    JobStatus,
    Lease,
    LeaseEntry,
    LeaseRequest,
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
from fleet.bus.protocol.messages import State, encode
from fleet.errors import BusError, JournalFull, Refused
from fleet.live import journal
from fleet.live.auction import node as auction_node
from fleet.live.auction.job_rules import statuses_that_fit
from fleet.live.auction.ledger import AuctionRecord
from fleet.live.auction.node import AuctionNode
from fleet.live.journal import Journal
from fleet.live.monitor.listener import FleetListener

PATIENCE_S = 15.0


def cheapest(bidding):
    """One job per arm, the first ones first."""
    free = sorted(bidding.quotes)
    return dict(zip((word.name for word in bidding.jobs), free, strict=False))


class Arm:
    """The least that an arm must say: it takes one job at a time and finishes it as soon as it has leave."""

    def __init__(self, link, name):
        self.link, self.name = link, name
        self.done, self.awards = [], []
        self._numbers = count()
        self._hold, self._answers, self._said_s, self._asked = None, {}, 0.0, False
        fleet = link.fleet
        link.reply_to(keys.of_arm(fleet, name, "quote"), QuoteRequest, self.quote)
        link.reply_to(keys.of_arm(fleet, name, "award"), Award, self.take)
        link.declare_token(keys.of_arm(fleet, name, "alive"))

    def quote(self, request):
        offers = tuple(JobEstimate(word.name, True, finish_in_s=1.0) for word in request.jobs)
        quote = f"{self.name}-{next(self._numbers)}"
        room = int(self._hold is None)
        return Quote(self.name, request.auction, quote, 5.0, "none", 0.0, "idle", 20.0, room, offers)

    def take(self, award):
        self.awards.append(award)
        if award.award not in self._answers:
            self._answers[award.award] = Ack(self.name, award.award, self._hold is None)
            self._hold = self._hold or award
        return self._answers[award.award]

    def turn(self):
        self.link.serve(time.monotonic() + 0.005)
        if time.monotonic() > self._said_s + 0.1:
            self._said_s = time.monotonic()
            self.link.publish(keys.of_arm(self.link.fleet, self.name, "state"), self.state())
            if self._hold is not None and not self._asked:
                self._asked = True
                hold = LeaseEntry(self._hold.award, self._hold.job.name, 0, "finishing")
                key = keys.asked_by(self.link.fleet, self._hold.auctioneer, "lease", self.name)
                self.link.query(key, LeaseRequest(self.name, (hold,)), Lease, self.leased, timeout_s=1.0)

    def state(self):
        return State(self.name, next(self._numbers), 0.0, "idle", (30.0,), 30.0)

    def leased(self, answers):
        self._asked = False
        for lease in answers.messages.values():
            if self._hold is not None and self._hold.award in lease.may_commit:
                award, self._asked = self._hold, True
                self.done.append(award.job.name)
                report = Report(self.name, award.award, award.job.name, "finished", 1, 0.0)
                key = keys.asked_by(self.link.fleet, award.auctioneer, "report", self.name)
                self.link.query(key, report, Receipt, self.receipted, timeout_s=1.0)

    def receipted(self, answers):
        assert answers.messages
        self._hold, self._asked = None, False


class Bus:
    """A router, and participants that are served in turn."""

    def __init__(self, stack, folder):
        self.stack, self.folder = stack, folder
        self.endpoint = stack.enter_context(Router()).endpoint
        self.arms, self.nodes, self.links = [], [], []

    def link(self):
        link = BusClient(self.endpoint, "f")
        self.stack.enter_context(link)
        self.links.append(link)
        return link

    def arm(self, name):
        self.arms.append(Arm(self.stack.enter_context(BusClient(self.endpoint, "f")), name))
        return self.arms[-1]

    def auctioneer(self, name="auctioneer", sync=None, folder="", **options):
        """A node with a life of its own, that `kill` may end."""
        extra = {} if sync is None else {"sync": sync}
        with ExitStack() as life:
            link = life.enter_context(BusClient(self.endpoint, "f"))
            book = life.enter_context(Journal[AuctionRecord](self.folder / folder / name, AuctionRecord, **extra))
            node = AuctionNode(link, name, book, **{"allocate": cheapest, "speed": 60.0, **options})
            node.life = self.stack.enter_context(life.pop_all())
        self.nodes.append(node)
        return node

    def kill(self, node):
        self.nodes.remove(node)
        node.life.close()

    def until(self, condition):
        deadline_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline_s, "waited in vain"
            for node in self.nodes:
                node.serve(time.monotonic() + 0.005)
            for arm in self.arms:
                arm.turn()
            for link in self.links:
                link.serve(time.monotonic() + 0.001)

    def ask(self, key, word, kind):
        """What is answered to a question of an outsider."""
        got = []
        self.link().query(key, word, kind, got.append, timeout_s=5.0)
        self.until(lambda: got)
        return got[0]


@pytest.fixture
def bus(tmp_path):
    with ExitStack() as stack:
        yield Bus(stack, tmp_path)


def jobs(*names, place="rack", **changes):
    return tuple(JobSpec(name=name, kind="hold", places=(place,), **changes) for name in names)


def states(node):
    return [said.state for said in node.auctioneer.status()]


def test_jobs_are_taken_awarded_and_finished(bus):
    node = bus.auctioneer(places=frozenset({"rack", "bin"}))
    bus.arm("arm_0")
    bus.arm("arm_1")
    word = Submission((*jobs("a"), *jobs("b", place="bin"), *jobs("c", place="moon")), "test")
    answers = bus.ask(keys.of_jobs("f", "submit"), word, SubmissionReply)
    (answer,) = answers.messages.values()
    assert [said.accepted for said in answer.jobs] == [True, True, False]
    bus.until(lambda: states(node) == ["finished", "finished"])
    assert sorted(job for arm in bus.arms for job in arm.done) == ["a", "b"]
    (status,) = bus.ask(keys.of_jobs("f", "status"), StatusRequest(("b", "nobody")), Status).messages.values()
    assert [said.state for said in status.jobs] == ["finished"]


def test_who_comes_late_hears_the_last_results(bus):
    node = bus.auctioneer()
    bus.arm("arm_0")
    node.submit(Submission(jobs("a")))
    bus.until(lambda: states(node) == ["finished"])
    results, rounds = [], []
    late = bus.link()
    late.subscribe(keys.of_every_auction("f", "result"), Result, lambda _, word: results.append(word), history=True)
    late.subscribe(
        keys.of_every_auction("f", "announce"), Announcement, lambda _, word: rounds.append(word), history=True
    )
    bus.until(lambda: len(results) == 4 and rounds)
    assert [result.status.state for result in results] == ["waiting", "awarded", "finishing", "finished"]
    assert [result.number for result in results] == [0, 1, 2, 3]
    assert rounds[0].jobs == ("a",)


def test_nothing_is_lost_while_the_auctioneer_is_gone(bus):
    first = bus.auctioneer()
    first.submit(Submission(jobs("a", "b")))
    arm = bus.arm("arm_0")
    bus.until(lambda: "awarded" in states(first))
    time_s = first.time_s
    bus.kill(first)
    second = bus.auctioneer()
    assert second.time_s >= time_s
    bus.until(lambda: states(second) == ["finished", "finished"])
    assert sorted(arm.done) == ["a", "b"]
    assert len({award.award for award in arm.awards}) == 2


def test_a_fleet_has_one_auctioneer(bus, token_reaches):
    node = bus.auctioneer("one")
    token_reaches(bus.link(), keys.of_auction("f", "one", "alive"))
    # While the second one asks, the first is not served, as if it stood still: its token tells.
    with pytest.raises(BusError, match=r"has an auctioneer already: 'one'. A fleet has one"):
        bus.auctioneer("two")
    with pytest.raises(BusError, match=r"has an auctioneer 'one' already: its token is present. Stop that one first"):
        bus.auctioneer("one", folder="elsewhere")
    bus.kill(node)
    assert states(bus.auctioneer("one")) == []


def test_one_that_answers_and_shows_no_token_yet_is_an_auctioneer_too(bus, token_reaches):
    early = bus.link()
    early.reply_to(keys.of_jobs("f", "status"), StatusRequest, lambda _: Status("one", 0.0, ()))
    early.watch_tokens(keys.of_every_arm("f", "alive"), lambda *_: None)
    with pytest.raises(BusError, match="has an auctioneer already, which does not reply"):
        bus.auctioneer("two")
    stop = threading.Event()

    def serve():
        while not stop.is_set():
            early.serve(time.monotonic() + 0.05)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        with pytest.raises(BusError, match="has an auctioneer already: 'one'"):
            bus.auctioneer("two")
        with bus.link() as arm:
            arm.declare_token(keys.of_arm("f", "one", "alive"))
            token_reaches(early, keys.of_arm("f", "one", "alive"))
            with pytest.raises(BusError, match=r"allocate the jobs themselves; 'one' replies .* Stop them first"):
                bus.auctioneer("two")
    finally:
        stop.set()
        thread.join(PATIENCE_S)


def test_two_auctioneers_are_both_seen_and_do_nothing_together(bus, monkeypatch):
    """Two may come together after a cut: neither saw the other when it began."""
    monkeypatch.setattr(AuctionNode, "_check_no_auctioneer", lambda self: None)
    one, two = bus.auctioneer("one"), bus.auctioneer("two")
    arm = bus.arm("arm_0")
    bus.until(lambda: one.rivals == {"two"} and two.rivals == {"one"} and one.present == {"arm_0"})
    answers = bus.ask(keys.of_jobs("f", "submit"), Submission(jobs("a")), SubmissionReply)
    assert not answers.messages
    assert (
        sorted(answers.refused.values())
        == ["Fleet 'f' has more than one auctioneer (one, two): no jobs are accepted until one is stopped."] * 2
    )
    with pytest.raises(Refused, match="more than one auctioneer"):
        one.submit(Submission(jobs("a")))
    status = bus.ask(keys.of_jobs("f", "status"), StatusRequest(), Status)
    assert sorted(word.auctioneer for word in status.messages.values()) == ["one", "two"]
    assert len(bus.ask(keys.of_clock("f"), ClockRequest(), Clock).messages) == 2
    bus.kill(two)
    bus.until(lambda: not one.rivals)
    one.submit(Submission(jobs("a")))
    bus.until(lambda: states(one) == ["finished"])
    assert arm.done == ["a"]


def test_two_auctioneers_of_one_name_see_each_other_and_do_nothing_together(bus, monkeypatch):
    """Begun in the same moment, neither saw the other when it looked, and their tokens are one."""
    monkeypatch.setattr(AuctionNode, "_check_no_auctioneer", lambda self: None)
    one, two = bus.auctioneer("one"), bus.auctioneer("one", folder="elsewhere")
    for node in (one, two):  # before any of them was served
        node.submit(Submission(jobs("a")))
    arm = bus.arm("arm_0")
    bus.until(lambda: one.rivals == two.rivals == {"one"} and one.present == two.present == {"arm_0"})
    told = "Fleet 'f' has more than one auctioneer (one, one): no jobs are accepted until one is stopped."
    with pytest.raises(Refused, match=re.escape(told)):
        one.submit(Submission(jobs("b")))
    bus.until(partial(later, time.monotonic() + 0.5))
    assert states(one) == states(two) == ["waiting"]
    assert not arm.awards
    bus.kill(two)
    bus.until(lambda: states(one) == ["finished"])
    assert arm.done == ["a"]


def test_one_that_does_not_hear_itself_is_not_sure_to_be_alone(bus, monkeypatch):
    """It awards nothing before its first look at who answers, nor long after its last."""
    alone = bus.auctioneer("one")
    arm = bus.arm("arm_0")
    monkeypatch.setattr(AuctionNode, "_check_rivals", lambda self, real_s: None)
    alone.submit(Submission(jobs("a")))
    bus.until(lambda: alone.present == {"arm_0"})
    bus.until(partial(later, time.monotonic() + 0.3))
    assert not arm.awards
    monkeypatch.undo()
    bus.until(lambda: states(alone) == ["finished"])
    monkeypatch.setattr(auction_node, "ALONE_S", 0.0)  # it stood still for longer than that
    alone.submit(Submission(jobs("b")))
    bus.until(partial(later, time.monotonic() + 0.3))
    assert arm.done == ["a"]


def test_what_was_taken_before_a_second_auctioneer_came_is_awarded_by_nobody_meanwhile(bus, monkeypatch):
    monkeypatch.setattr(AuctionNode, "_check_no_auctioneer", lambda self: None)
    one = bus.auctioneer("one")
    one.submit(Submission(jobs("a")))
    two = bus.auctioneer("two")
    bus.until(lambda: one.rivals == {"two"})
    arm = bus.arm("arm_0")
    bus.until(lambda: one.present == {"arm_0"})
    seen = bus.link()
    onlooker = FleetListener(seen)
    bus.until(
        lambda: {said.auctioneer for said in onlooker.view.snapshot(0.0).auctioneers if said.token} == {"one", "two"}
    )
    bus.until(partial(later, time.monotonic() + 0.5))
    assert states(one) == ["waiting"]
    assert not arm.awards
    bus.kill(two)
    bus.until(lambda: states(one) == ["finished"])


def later(at_s):
    return time.monotonic() > at_s


def test_the_fleets_time_runs_at_its_speed(bus):
    bus.auctioneer(speed=1000.0)
    (one,) = bus.ask(keys.of_clock("f"), ClockRequest(), Clock).messages.values()
    (two,) = bus.ask(keys.of_clock("f"), ClockRequest(), Clock).messages.values()
    assert one.speed == 1000.0
    assert 0.0 <= one.time_s < two.time_s


def test_an_arm_with_a_token_that_says_nothing_is_not_there(bus):
    node = bus.auctioneer()
    mute = bus.link()
    mute.declare_token(keys.of_arm("f", "mute", "alive"))
    bus.arm("arm_0")
    bus.until(lambda: node.present == {"arm_0"} and "mute" in node._tokens)


def test_a_full_disk_is_a_refusal_and_no_end(bus):
    full = []

    def sync(file):
        if full:
            raise OSError(full.pop(), "No space left on device")
        os.fsync(file)

    node = bus.auctioneer(sync=sync)
    full.append(errno.ENOSPC)
    answers = bus.ask(keys.of_jobs("f", "submit"), Submission(jobs("a")), SubmissionReply)
    assert "no space left" in next(iter(answers.refused.values()))
    full.append(errno.ENOSPC)
    with pytest.raises(JournalFull):
        node.submit(Submission(jobs("a")))
    assert bus.ask(keys.of_jobs("f", "submit"), Submission(jobs("a")), SubmissionReply).messages
    assert states(node) == ["waiting"]


def test_a_journal_is_shortened_at_the_start_and_when_it_has_grown(bus, monkeypatch):
    first = bus.auctioneer()
    bus.arm("arm_0")
    bus.ask(keys.of_jobs("f", "submit"), Submission(jobs("a"), "test"), SubmissionReply)
    bus.until(lambda: states(first) == ["finished"])
    bus.kill(first)
    again = bus.auctioneer()
    assert [type(record).__name__ for record in again.journal.records()] == ["LedgerSnapshot", "Started"]
    assert states(again) == ["finished"]
    monkeypatch.setattr(journal, "TICK_S", 0.01)
    monkeypatch.setattr(journal, "COMPACT_BYTES", 1)
    before = again.journal.size
    bus.kill(again)
    third = bus.auctioneer()
    sizes = []
    bus.until(lambda: sizes.append(third.journal.size) or (len(sizes) > 1 and sizes[-1] < sizes[-2]))
    assert max(sizes) < 5 * before
    assert states(third) == ["finished"]


def test_a_journal_that_cannot_be_shortened_is_gone_on_with(bus, monkeypatch, caplog):
    first = bus.auctioneer()
    bus.ask(keys.of_jobs("f", "submit"), Submission(jobs("a"), "test"), SubmissionReply)
    bus.kill(first)
    with monkeypatch.context() as full:
        full.setattr(Journal, "rewrite", refuse)
        again = bus.auctioneer()
    assert "is not compacted: no room" in caplog.text
    assert [type(record).__name__ for record in again.journal.records()] == [
        "LedgerSnapshot",
        "Started",
        "JobsAccepted",
        "Started",
    ]
    assert states(again) == ["waiting"]


def refuse(*_records):
    raise JournalFull("no room")


def test_a_status_of_very_many_jobs_fits_into_a_word_and_tells_the_open_ones_first(bus):
    node = bus.auctioneer()
    long = "x" * 100
    node.submit(Submission(jobs(*(f"{long}{i}" for i in range(1500)))))
    (status,) = bus.ask(keys.of_jobs("f", "status"), StatusRequest(), Status).messages.values()
    assert 100 < len(status.jobs) <= 256
    assert len(encode(status)) < 65_536
    first = JobStatus("done", "finished")
    assert statuses_that_fit((first, *status.jobs * 2))[0].state == "waiting"
