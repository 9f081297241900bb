"""An arm's seat among its peers on the bus: it says bids, claims and grants, and keeps the fleet's time with them.

The fleet's time is the latest that any arm keeps: whoever hears of a later one goes by that. It begins when all arms of
the roster are there, or a majority has waited long enough for the others.
"""

import logging
import math
import time
from collections import deque
from dataclasses import dataclass
from random import Random

import msgspec

from fleet.bus import keys
from fleet.bus.answers import Answers
from fleet.bus.council import Bid, Claim, Grant
from fleet.bus.link import LeftToOthers, Refused
from fleet.bus.trade import (
    Admission,
    Clock,
    ClockRequest,
    JobStatus,
    JobWord,
    LeaseRequest,
    Offer,
    Report,
    Status,
    StatusRequest,
    Submission,
    Submitted,
)
from fleet.errors import BusError, JournalFull
from fleet.live.admission import admit
from fleet.live.auctioneer import Objection
from fleet.live.bidding import Allocate
from fleet.live.clock import FleetClock
from fleet.live.council import QUIET_S, Council, Faculties
from fleet.live.granting import Deed, Grantor, recalled, retold
from fleet.live.journal import Journal
from fleet.live.orders import Complaints, Worker
from fleet.live.standing import first
from fleet.live.timing import Timing

_LOG = logging.getLogger(__name__)

TICK_S = 2.0
"""Real seconds between two records of the fleet's time."""
LISTEN_S = 0.5
"""Real seconds that an arm listens before it lets the fleet's time begin."""
PATIENCE_S = 20.0
"""Real seconds that a majority waits for the other arms before the fleet's time begins."""
LAST_S = 10.0
"""Real seconds after the end of the shift that an arm waits at most for last cycles, its own and those of others."""
NOT_YET_S = 1e9
"""Real seconds: so long the fleet's time would stand still, if nobody let it begin."""


@dataclass(frozen=True, kw_only=True)
class Membership:
    """What an arm shares with its peers from the beginning."""

    roster: tuple[str, ...]
    """All arms of the fleet: a majority is one of these, whoever is there."""
    agree: Allocate
    """What all make of all bids."""
    places: frozenset[str] | None = None
    """Places of the cell; None: jobs of others may name any."""
    stream: tuple[tuple[float, JobWord], ...] = ()
    """Jobs that all know of, each from a time of the fleet on."""
    horizon_s: float = math.inf
    """The fleet's time at which the shift is over."""
    timing: Timing | None = None


class CouncilNode:
    """Orders of an arm that comes to them with its peers.

    Attributes:
        council: Its state machine.
        objection: Why no auctioneer may give the arm work.
    """

    objection = "I share out jobs with my peers, and take none from an auctioneer"

    def __init__(self, worker: Worker, membership: Membership, journal: Journal[Deed], *, life: int) -> None:
        """Take a seat: the arm's line and the journal are open.

        Args:
            life: Counts up with every start of the arm.
        """
        self._worker, self._link, self.journal = worker, worker.link, journal
        self._name, self._speed = worker.contractor.arm, worker.clock.speed
        self._horizon_s, self._places = membership.horizon_s, membership.places
        register = recalled(journal.replay())
        real_s = time.monotonic()
        grantor = Grantor(
            self._name, membership.roster, register, journal.append, real_s=real_s, timing=membership.timing
        )
        faculties = Faculties(offers=self._offers, unfit=worker.unfit, take=worker.take)
        self.council = Council(
            worker.contractor,
            grantor,
            faculties,
            agree=membership.agree,
            life=life,
            rng=Random(f"{self._name} {life}"),
            timing=membership.timing,
        )
        self.council.know(register.jobs.values())
        self._timing = membership.timing or Timing()
        self._stream = deque(membership.stream)
        self._complain = Complaints(self._name)
        self._tokens: set[str] = set()
        self._begun = self._busy = False
        self._ended_s = math.inf
        self._since_s = self._ticked_s = real_s
        self.wake_s = math.inf
        worker.set_clock(FleetClock(self._speed, real_s + NOT_YET_S))
        journal.shorten(*retold(register))
        self._declare()

    # What an arm wants of its orders

    def lease(self, auctioneer: str, request: LeaseRequest, asked_s: float) -> None:
        """The claim that is due says what the request does."""
        if auctioneer == self._name:
            self.council.claimant.hurry()

    def report(self, auctioneer: str, report: Report) -> None:
        """The next claim has it too."""
        if auctioneer == self._name:
            self.council.claimant.hurry()
        else:
            self._complain("report", f"owes '{auctioneer}' a report on '{report.job}', which it cannot give here.")

    def turn(self, real_s: float) -> None:
        """Do what is due."""
        if self._busy:  # the arm takes its turn also while it plans for a bid
            return
        self._busy = True
        try:
            self._turn(real_s)
        finally:
            self._busy = False

    @property
    def over(self) -> bool:
        """Whether nothing is left to do: all is done and everybody there knows, or the shift, if it ends, is over."""
        real_s = time.monotonic()
        if math.isinf(self._horizon_s):
            return False
        if self.council.ended:
            mine = self.council.contractor.held or self.council.contractor.owes
            others = any(said.state == "finishing" for said in self.statuses())
            return not (mine or others) or real_s >= self._ended_s + LAST_S
        return self._begun and not self._stream and self.council.over(real_s)

    def statuses(self) -> list[JobStatus]:
        """Where all jobs stand, those of the stream that are still to come among them, as far as this arm knows."""
        return self.council.status([word for _, word in self._stream], time.monotonic())

    # Inside

    def _turn(self, real_s: float) -> None:
        time_s = self._worker.clock.now_s(real_s)
        if not self._begun:
            self._begin(real_s)
        while self._stream and self._begun and self._stream[0][0] <= time_s:
            self.council.know([self._stream.popleft()[1]])
        if self._begun and time_s >= self._horizon_s and not self.council.ended:
            self.council.ended, self._ended_s = True, real_s
            held = self.council.contractor.held
            if held and not held[0].leave:
                self.council.contractor.returned(time_s, real_s, "the shift is over")
        if self._begun:
            self.council.seen(frozenset(self._tokens))
            self.council.tick(real_s, time_s)
            self._send()
            self._note(real_s, time_s)
        quiet_s = self.council.changed_s + QUIET_S
        self.wake_s = quiet_s if quiet_s > real_s else math.inf

    def _offers(self, words: tuple[JobWord, ...]) -> tuple[Offer, ...]:
        """What jobs would cost the arm, as a bid tells it; how hard each joint finds them is said elsewhere."""
        offers = self._worker.offers(words)
        self._worker.tell_difficulty(offers, time.monotonic())
        return tuple(msgspec.structs.replace(offer, difficulty=None) for offer in offers)

    def _begin(self, real_s: float) -> None:
        """Let the fleet's time begin, unless it has begun elsewhere: then that is the time."""
        roster = self.council.grantor.roster
        there = len(self._tokens & roster | {self._name})
        waited_s = real_s - self._since_s
        if there < self.council.claimant.majority:
            self._since_s = real_s
        elif waited_s >= (LISTEN_S if there == len(roster) else PATIENCE_S):
            noted_s = self.council.grantor.register.time_s
            # It may have gone on until just before its next record of it.
            self._go_by(noted_s + TICK_S * self._speed if noted_s else 0.0, real_s)

    def _go_by(self, time_s: float, real_s: float) -> None:
        self._begun = True
        self._worker.set_clock(FleetClock(self._speed, real_s, time_s), jump=True)

    def _declare(self) -> None:
        link, fleet, name = self._link, self._link.fleet, self._name
        self._say = link.publisher(keys.of_arm(fleet, name, "bid"), Bid, remember=1)
        link.answer(keys.asked_by_every_arm(fleet, name, "grant"), Claim, self._grant)
        link.answer(keys.of_jobs(fleet, "submit"), Submission, self._submit)
        link.answer(keys.of_jobs(fleet, "status"), StatusRequest, self._status)
        link.answer(keys.of_clock(fleet), ClockRequest, self._clock)
        link.listen(keys.of_every_arm(fleet, "bid"), Bid, self._hear, remembered=1)
        link.watch(keys.of_every_arm(fleet, "alive"), self._token)

    def _hear(self, arm: str, bid: Bid) -> None:
        real_s = time.monotonic()
        if arm == self._name or arm not in self.council.grantor.roster:
            return
        if not self._begun or bid.time_s > self._worker.clock.now_s(real_s):
            self._go_by(bid.time_s, real_s)
        self.council.heard(bid, real_s)

    def _token(self, arm: str, there: bool) -> None:
        (self._tokens.add if there else self._tokens.discard)(arm)

    def _grant(self, claim: Claim) -> Grant:
        if claim.arm == self._name:
            raise LeftToOthers
        try:
            return self.council.asked(claim, time.monotonic())
        except Objection as objection:
            raise Refused(str(objection)) from objection

    # What outsiders ask: all arms hear it, and the first of those that are there answers

    def _speaks(self) -> None:
        """Leave it to another to answer, unless this arm speaks for the fleet.

        Raises:
            LeftToOthers: another one does.
        """
        if not self._begun or self._name != min(self._tokens & self.council.grantor.roster, default=self._name):
            raise LeftToOthers

    def _submit(self, word: Submission) -> Submitted:
        there = {job.name: job for _, job in self._stream} | self.council.jobs
        admissions = admit(word.jobs, there, places=self._places)
        if self.council.ended:
            admissions = tuple(Admission(job.name, False, "The shift is over.") for job in word.jobs)
        taken = tuple(job for job, said in zip(word.jobs, admissions, strict=True) if said.accepted)
        try:
            self.council.grantor.admit(tuple(job for job in taken if job.name not in there), word.by)
        except JournalFull as error:
            raise Refused(str(error)) from error
        self.council.know(taken)
        self._speaks()
        return Submitted(self._name, admissions)

    def _status(self, word: StatusRequest) -> Status:
        self._speaks()
        wanted = frozenset(word.jobs)
        statuses = tuple(said for said in self.statuses() if not wanted or said.job in wanted)
        return Status(self._name, self._worker.clock.now_s(time.monotonic()), first(statuses))

    def _clock(self, _: ClockRequest) -> Clock:
        self._speaks()
        return Clock(self._worker.clock.now_s(time.monotonic()), self._speed)

    def _send(self) -> None:
        out = self.council.out
        while out:
            match out.popleft():
                case Bid() as bid:
                    self._say(bid)
                case Claim() as claim:
                    self._ask(claim)

    def _ask(self, claim: Claim) -> None:
        read: set[str] = set()

        def came(answers: Answers[Grant]) -> None:
            for key in answers.words.keys() - read:
                read.add(key)
                self.council.answered(answers.words[key], time.monotonic())
            for reason in filter(None, answers.refused.values()):
                self._complain("claim", f"is not answered: {reason}")

        key = keys.asked_of_all(self._link.fleet, "grant", self._name)
        try:
            self._link.ask(key, claim, Grant, came, timeout_s=self._timing.ack_s, each=came)
        except BusError as error:
            self._complain("bus", str(error))

    # The disk

    def _note(self, real_s: float, time_s: float) -> None:
        if real_s < self._ticked_s + TICK_S:
            return
        self._ticked_s = real_s
        try:
            self.council.grantor.tick(time_s)
        except JournalFull as error:
            _LOG.error("The fleet's time is not noted: %s", error)
        if self.journal.long:
            self.journal.shorten(*retold(self.council.grantor.register))
