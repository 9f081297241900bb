"""An auctioneer on a real router, with model arms that are served in turn."""

import time
from contextlib import ExitStack
from itertools import count

import pytest

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    Award,
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
)
from fleet.bus.protocol.consensus import History, HistoryRequest
from fleet.bus.protocol.messages import State
from fleet.bus.router import Router
from fleet.live.auction.node import AuctionNode
from fleet.live.auction.rounds import Assignment
from fleet.live.journal import Journal
from fleet.live.records import BookRecord
from tests.waiting import PATIENCE_S


def first_come(bidding):
    """Return one job per arm, in the order of jobs and arms."""
    return dict(zip((job.name for job in bidding.jobs), map(Assignment, sorted(bidding.quotes)), strict=False))


class Arm:
    """The simplest arm: it accepts one job at a time and finishes it as soon as it is permitted to commit."""

    def __init__(self, link, name):
        self.link, self.name = link, name
        self.done, self.awards, self.commits = [], [], True
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
        return History(self.name, self.awards[-1].epoch if self.awards else "", finished, current)

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
