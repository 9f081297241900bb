"""An arm without an auctioneer, on the bus: it exchanges bids and claims with its peers and keeps the fleet's time.

The fleet's time is the latest that any arm keeps: an arm that receives a later one sets its clock to it. It begins when
all arms of the roster are present, or a majority has waited long enough for the others.
"""

import logging
import math
import time
from collections import deque
from dataclasses import dataclass
from random import Random

import msgspec

from fleet.bus.client.client import AnotherReplies, Refused
from fleet.bus.client.replies import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Admission,
    Clock,
    ClockRequest,
    JobEstimate,
    JobSpec,
    JobStatus,
    LeaseRequest,
    Report,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.consensus import Bid, Claim, ClaimReply
from fleet.bus.protocol.messages import State
from fleet.errors import BusError, JournalFull
from fleet.live.arm.auctioneer_client import LiveArm, RateLimitedWarnings
from fleet.live.auction.admission import admit
from fleet.live.auction.auctioneer import Objection
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.auction.lease_timing import Timing
from fleet.live.auction.status_message import statuses_that_fit
from fleet.live.clock import FleetClock
from fleet.live.consensus.granter import Granter, GrantRecord, Register
from fleet.live.consensus.participant import MOST_NAMED, QUIET_S, ArmInterface, Choose, Participant
from fleet.live.journal import Journal

_LOG = logging.getLogger(__name__)

TICK_S = 2.0
"""Real seconds between two records of the fleet's time."""
LISTEN_S = 0.5
"""Real seconds that an arm listens before it starts the fleet's time."""
PATIENCE_S = 20.0
"""Real seconds that a majority waits for the other arms before it starts the fleet's time."""
LAST_S = 10.0
"""Real seconds after the end of the shift that an arm waits at most for last cycles, its own and its peers'."""
NOT_YET_S = 1e9
"""Real seconds until the fleet's time would begin if no arm started it: never."""


@dataclass(frozen=True, kw_only=True)
class Membership:
    """How an arm takes part in the consensus of its fleet."""

    fleet: LiveFleet
    """Its arms are the roster: a majority is counted in these, whoever is present."""
    choose: Choose
    """The policy of this arm."""
    slots: int = MOST_NAMED
    """Jobs that the policy chooses from."""
    places: frozenset[str] | None = None
    """Places of the cell; None: jobs of others may name any."""
    stream: tuple[tuple[float, JobSpec], ...] = ()
    """Jobs that all arms know, each from a time of the fleet on."""
    horizon_s: float = math.inf
    """The fleet's time at which the shift is over."""
    timing: Timing | None = None


class ConsensusNode:
    """Work source of an arm that shares out the jobs with its peers.

    Attributes:
        participant: Its state machine.
        objection: Why no auctioneer may award the arm a job.
    """

    objection = "I share out jobs with my peers, and take none from an auctioneer"

    def __init__(self, worker: LiveArm, membership: Membership, journal: Journal[GrantRecord], *, life: int) -> None:
        """Join: the arm's session and the journal are open.

        Args:
            life: Counts up with every start of the arm.
        """
        self._worker, self._link, self.journal = worker, worker.link, journal
        self._name, self._speed = worker.executor.arm, worker.clock.speed
        self._horizon_s, self._places = membership.horizon_s, membership.places
        register = Register().replay(journal.records())
        real_s = time.monotonic()
        granter = Granter(
            self._name, membership.fleet.arms, register, journal.append, real_s=real_s, timing=membership.timing
        )
        interface = ArmInterface(offers=self._offers, unfit=worker.unfit, take=worker.answer_award)
        self.participant = Participant(
            worker.executor,
            granter,
            interface,
            fleet=membership.fleet,
            choose=membership.choose,
            life=life,
            rng=Random(f"{self._name} {life}"),
            slots=membership.slots,
            timing=membership.timing,
        )
        self.participant.add_jobs(register.jobs.values())
        self._timing = membership.timing or Timing()
        self._stream = deque(membership.stream)
        self._warn = RateLimitedWarnings(self._name)
        self._tokens: set[str] = set()
        self._begun = self._busy = False
        self._ended_s = math.inf
        self._since_s = self._ticked_s = real_s
        self.wake_s = math.inf
        worker.set_clock(FleetClock(self._speed, real_s + NOT_YET_S))
        journal.compact(*register.compact())
        self._declare()

    # For the arm

    def request_leases(self, auctioneer: str, request: LeaseRequest, asked_s: float) -> None:
        """Renew leases with the next claim."""
        if auctioneer == self._name:
            self.participant.claimant.claim_soon()

    def send_report(self, auctioneer: str, report: Report) -> None:
        """Send the report with the next claim."""
        if auctioneer == self._name:
            self.participant.claimant.claim_soon()
        else:
            self._warn("report", f"owes '{auctioneer}' a report on '{report.job}', which it cannot give here.")

    def step(self, real_s: float) -> None:
        """Do what is due."""
        if self._busy:  # the arm also steps while it plans for a bid
            return
        self._busy = True
        try:
            self._step(real_s)
        finally:
            self._busy = False

    @property
    def over(self) -> bool:
        """Whether nothing is left to do: all is settled and every present arm knows, or the shift has ended."""
        real_s = time.monotonic()
        if math.isinf(self._horizon_s):
            return False
        if self.participant.ended:
            mine = self.participant.executor.active or self.participant.executor.has_pending_reports
            others = any(said.state == "finishing" for said in self.statuses())
            return not (mine or others) or real_s >= self._ended_s + LAST_S
        return self._begun and not self._stream and self.participant.all_settled(real_s)

    def statuses(self) -> list[JobStatus]:
        """Status of all jobs as far as this arm knows, those of the stream that are not released yet included."""
        return self.participant.status([word for _, word in self._stream], time.monotonic())

    # Inside

    def _step(self, real_s: float) -> None:
        time_s = self._worker.clock.now_s(real_s)
        if not self._begun:
            self._begin(real_s)
        while self._stream and self._begun and self._stream[0][0] <= time_s:
            self.participant.add_jobs([self._stream.popleft()[1]])
        if self._begun and time_s >= self._horizon_s and not self.participant.ended:
            self.participant.ended, self._ended_s = True, real_s
            held = self.participant.executor.active
            if held and not held[0].may_commit:
                self.participant.executor.return_all(time_s, real_s, "the shift is over")
        if self._begun:
            self.participant.set_present(frozenset(self._tokens))
            self.participant.tick(real_s, time_s)
            self._send()
            self._record_time(real_s, time_s)
        quiet_s = self.participant.changed_s + QUIET_S
        self.wake_s = quiet_s if quiet_s > real_s else math.inf

    def _offers(self, words: tuple[JobSpec, ...]) -> tuple[JobEstimate, ...]:
        """Estimates for a bid, without the difficulty of each joint; that is published under its own key."""
        offers = self._worker.estimate(words)
        self._worker.publish_difficulty(offers, time.monotonic())
        return tuple(msgspec.structs.replace(offer, joint_difficulty=None) for offer in offers)

    def _begin(self, real_s: float) -> None:
        """Start the fleet's time, unless a peer has started it."""
        roster = self.participant.granter.roster
        there = len(self._tokens & roster | {self._name})
        waited_s = real_s - self._since_s
        if there < self.participant.claimant.majority:
            self._since_s = real_s
        elif waited_s >= (LISTEN_S if there == len(roster) else PATIENCE_S):
            noted_s = self.participant.granter.register.time_s
            # It may have run until just before its next record.
            self._set_time(noted_s + TICK_S * self._speed if noted_s else 0.0, real_s)

    def _set_time(self, time_s: float, real_s: float) -> None:
        self._begun = True
        self._worker.set_clock(FleetClock(self._speed, real_s, time_s), jump=True)

    def _declare(self) -> None:
        link, fleet, name = self._link, self._link.fleet, self._name
        self._say = link.publisher(keys.of_arm(fleet, name, "bid"), Bid)
        link.reply_to(keys.asked_by_every_arm(fleet, name, "claim"), Claim, self._grant)
        link.reply_to(keys.of_jobs(fleet, "submit"), Submission, self._submit)
        link.reply_to(keys.of_jobs(fleet, "status"), StatusRequest, self._status)
        link.reply_to(keys.of_clock(fleet), ClockRequest, self._clock)
        link.subscribe(keys.of_every_arm(fleet, "bid"), Bid, self._apply_bid, history=True)
        link.subscribe(keys.of_every_arm(fleet, "state"), State, self._state)
        link.watch_tokens(keys.of_every_arm(fleet, "alive"), self._token)

    def _apply_bid(self, arm: str, bid: Bid) -> None:
        real_s = time.monotonic()
        if arm == self._name or arm not in self.participant.granter.roster:
            return
        if not self._begun or bid.time_s > self._worker.clock.now_s(real_s):
            self._set_time(bid.time_s, real_s)
        self.participant.apply_bid(bid, real_s)

    def _state(self, arm: str, state: State) -> None:
        self.participant.states[arm] = state

    def _token(self, arm: str, there: bool) -> None:
        (self._tokens.add if there else self._tokens.discard)(arm)

    def _grant(self, claim: Claim) -> ClaimReply:
        if claim.arm == self._name:
            raise AnotherReplies
        try:
            return self.participant.answer_claim(claim, time.monotonic())
        except Objection as objection:
            raise Refused(str(objection)) from objection

    # Requests of others: all arms receive them, and the first present one answers

    def _check_first(self) -> None:
        """Check that this arm answers for the fleet.

        Raises:
            AnotherReplies: another arm does.
        """
        if not self._begun or self._name != min(self._tokens & self.participant.granter.roster, default=self._name):
            raise AnotherReplies

    def _submit(self, word: Submission) -> SubmissionReply:
        there = {job.name: job for _, job in self._stream} | self.participant.jobs
        admissions = admit(word.jobs, there, places=self._places)
        if self.participant.ended:
            admissions = tuple(Admission(job.name, False, "The shift is over.") for job in word.jobs)
        taken = tuple(job for job, said in zip(word.jobs, admissions, strict=True) if said.accepted)
        try:
            self.participant.granter.add_jobs(tuple(job for job in taken if job.name not in there), word.by)
        except JournalFull as error:
            raise Refused(str(error)) from error
        self.participant.add_jobs(taken)
        self._check_first()
        return SubmissionReply(self._name, admissions)

    def _status(self, word: StatusRequest) -> Status:
        self._check_first()
        wanted = frozenset(word.jobs)
        statuses = tuple(said for said in self.statuses() if not wanted or said.job in wanted)
        return Status(self._name, self._worker.clock.now_s(time.monotonic()), statuses_that_fit(statuses))

    def _clock(self, _: ClockRequest) -> Clock:
        self._check_first()
        return Clock(self._worker.clock.now_s(time.monotonic()), self._speed)

    def _send(self) -> None:
        out = self.participant.out
        while out:
            match out.popleft():
                case Bid() as bid:
                    self._say(bid)
                case Claim() as claim:
                    self._ask(claim)

    def _ask(self, claim: Claim) -> None:
        read: set[str] = set()

        def arrived(answers: Replies[ClaimReply]) -> None:
            for key in answers.messages.keys() - read:
                read.add(key)
                self.participant.apply_reply(answers.messages[key], time.monotonic())
            for reason in filter(None, answers.refused.values()):
                self._warn("claim", f"is not answered: {reason}")

        key = keys.asked_of_all(self._link.fleet, "claim", self._name)
        try:
            self._link.query(key, claim, ClaimReply, arrived, timeout_s=self._timing.ack_s, each=arrived)
        except BusError as error:
            self._warn("bus", str(error))

    # Journal

    def _record_time(self, real_s: float, time_s: float) -> None:
        if real_s < self._ticked_s + TICK_S:
            return
        self._ticked_s = real_s
        try:
            self.participant.granter.record_time(time_s)
        except JournalFull as error:
            _LOG.error("Could not record the fleet's time: %s", error)
        if self.journal.needs_compaction:
            self.journal.compact(*self.participant.granter.register.compact())
