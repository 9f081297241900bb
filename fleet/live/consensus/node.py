"""An arm without an auctioneer, on the bus: it exchanges bids and claims with its peers and keeps the fleet's time.

The fleet's time is the latest that any arm keeps: an arm that receives a later one sets its clock to it. It begins when
all arms of the roster are present, or a majority has waited long enough for the others.
"""

import logging
import math
import secrets
import time
from collections import deque
from collections.abc import Sequence
from random import Random

from msgspec.structs import replace

from fleet.bus.client import AnotherReplies, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Clock, ClockRequest, JobStatus, LeaseRequest, Report, Submission, SubmissionReply
from fleet.bus.protocol.consensus import Bid, Claim, ClaimReply, History, HistoryRequest
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import Cleared, ClearRequest, Controlled, ControlRequest, Operation
from fleet.errors import BusError, JournalFull, Refused, RefusedForNow, listed
from fleet.live.arm.node import ArmNode
from fleet.live.book import JobBook
from fleet.live.clock import FleetClock
from fleet.live.consensus.grants import NUMBERS_PER_BOOT, Granter
from fleet.live.consensus.participant import Membership, Participant
from fleet.live.desk import JobDesk
from fleet.live.epochs import REPLY_S, adopted, ask_arms, check_journals, history_of
from fleet.live.job_rules import SHIFT_ENDED
from fleet.live.journal import EpochBegun, Journal, SpaceTaken, Started, TimeRecorder, own_records
from fleet.live.rate_limit import RateLimitedWarnings
from fleet.live.records import BookRecord, JobEntry
from fleet.live.space import ANYWHERE

_LOG = logging.getLogger(__name__)

LISTEN_S = 0.5
"""Real seconds that an arm listens before it starts the fleet's time."""
PATIENCE_S = 20.0
"""Real seconds that a majority waits for the other arms before it starts the fleet's time."""
LAST_S = 10.0
"""Real seconds after the end of the shift that an arm waits at most for last cycles, its own and its peers'."""
NOT_JOINED = "'{}' has not joined: a majority has to reply what it knows; with --new-epoch, a lease has to end first."
"""Why an arm accepts no jobs."""
NOT_YET_S = 1e9
"""Real seconds until the fleet's time would begin if no arm started it: never."""


class ConsensusNode(JobDesk):
    """Work source of an arm that allocates jobs together with its peers.

    Attributes:
        participant: Its state machine.
        objection: Why no auctioneer may award the arm a job.
    """

    objection = "I allocate jobs together with my peers, and accept none from an auctioneer"

    def __init__(
        self,
        arm: ArmNode,
        membership: Membership,
        journal: Journal[BookRecord],
        *,
        boot: int,
        new_epoch: bool = False,
    ) -> None:
        """Join; the arm's client and the journal are open.

        Args:
            boot: Number of this start of the arm.
            new_epoch: Begin even if peers know claims of this arm that its journals do not.

        Raises:
            BusError: peers know another epoch, or claims of this arm after those in its journals; or the journals are
                of a fleet of other arms.
            JournalError: the journal is of another arm.
        """
        super().__init__(arm.executor.arm, arm.clock.speed, membership.cell)
        self._arm, self._link, self._membership = arm, arm.link, membership
        book = self.book = JobBook(membership.places, name=self._name, is_central=False)
        book.replay(own_records(journal, self._name))
        book.apply(Started(self._name))
        real_s = time.monotonic()
        self._recorder = TimeRecorder(journal, book, real_s)
        roster = membership.fleet.arms
        if book.roster not in ((), tuple(sorted(roster))):
            raise BusError(
                f"The journals of '{self._name}' are of a fleet of the arms {listed(book.roster)}, not of "
                f"{listed(sorted(roster))}: jobs could be done twice. Restore the scenario, or begin in another folder."
            )
        timing, excludes = membership.timing, membership.excludes
        granter = Granter(self._name, roster, book, journal.append, real_s=real_s, timing=timing, excludes=excludes)
        # By its claims: a start that was refused counts as a boot.
        self._first_number = (book.numbers.get(self._name, -1) // NUMBERS_PER_BOOT + 1) * NUMBERS_PER_BOOT
        """Least number of the claims of this start, by those in its journals."""
        self._new_epoch = new_epoch
        boot = max(boot, self._first_number // NUMBERS_PER_BOOT)
        self.participant = Participant(arm, granter, membership, boot=boot, rng=Random(f"{self._name} {boot}"))
        self._stream = deque(membership.stream)
        self._warn = RateLimitedWarnings(self._name)
        self._tokens: set[str] = set()
        self._begun = self._busy = False
        self._ended_s = math.inf
        self._started_s = self._since_s = real_s
        """Real second since which a majority has been present."""
        self.wake_s = math.inf
        arm.set_clock(FleetClock(self._speed, real_s + NOT_YET_S))
        link, fleet, name = self._link, self._link.fleet, self._name
        link.reply_to(keys.of_arm(fleet, name, "history"), HistoryRequest, self._history)
        self._joined = False
        """A majority, with this arm, was asked whether its journals are those that it knows."""
        self._asked_s = -math.inf
        self._failure: BusError | None = None
        self._join(ask_arms(link))  # before it grants anything
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

    def prepare_quote(self, real_s: float) -> None:
        """Do nothing: an arm that allocates jobs with its peers accepts no award."""

    @property
    def over(self) -> bool:
        """Whether nothing is left to do: all is settled and every present arm knows, or the shift has ended."""
        real_s = time.monotonic()
        if math.isinf(self._membership.horizon_s):
            return False
        if self.book.ended:
            own = self.participant.executor.active or self.participant.executor.has_pending_reports
            others = any(grant.may_commit and not grant.silent for grant in self.book.open.values())
            return not (own or others) or real_s >= self._ended_s + LAST_S
        return self._begun and not self._stream and self.participant.all_settled(real_s)

    def statuses(self) -> list[JobStatus]:
        """Return the status of all jobs that this arm knows, those of the stream that are not offered yet included."""
        return self._status_of(self._entries())

    # Inside

    def _join(self, histories: tuple[History, ...]) -> None:
        """Check what the peers know; with a majority, adopt what this arm has lost, and take the epoch.

        Raises:
            BusError: jobs might be done twice.
        """
        granter, number = self.participant.granter, self._first_number
        check_journals(self._name, number, self._epoch, histories, new_epoch=self._new_epoch)
        # A minority may not know the claims of this arm. With an epoch, lost journals would not be noticed later.
        if len({each.arm for each in histories} | {self._name}) < self._majority:
            return
        known = max((history.claims.get(self._name, -1) for history in histories), default=-1)
        if known >= number:
            # It may have granted leases of which it does not know.
            if time.monotonic() < self._started_s + granter.timing.counted_lease_s:
                return
            _LOG.warning("Arm '%s' adopts what %d arm(s) have done and have.", self._name, len(histories))
            for history in (each for each in histories if each.arm != self._name):
                granter.adopt(adopted(self.book, history), time.monotonic())
            peers = sorted(granter.roster - {self._name})  # each repeats its claim for this arm
            self.book.record(*(SpaceTaken(arm, (ANYWHERE,)) for arm in peers))
            self.participant.count_after(known)
        self._take_epoch(next((history.epoch for history in histories if history.epoch), ""))
        self._joined = True

    def _ask_peers(self, real_s: float) -> None:
        """Ask all peers what they know, before this arm takes or names an epoch, claims or grants."""
        if real_s < self._asked_s + REPLY_S:
            return
        self._asked_s = real_s

        def done(replies: Replies[History]) -> None:
            histories = tuple(replies.messages.values())
            if self._joined:  # since then it may have claimed, and its peers know that
                return
            try:
                self._join(histories)
            except Refused as error:
                self._warn("journal", f"cannot record what its peers know: {error}")
            except BusError as error:
                self._failure = error

        self._link.query(
            keys.of_every_arm(self._link.fleet, "history"), HistoryRequest(), History, done, timeout_s=REPLY_S
        )

    def _step(self, real_s: float) -> None:
        if self._failure is not None:
            raise self._failure
        time_s = self._arm.clock.now_s(real_s)
        if not self._begun:
            self._begin(real_s)
        if self._begun:
            self._offer_jobs(time_s)
            if time_s >= self._membership.horizon_s and math.isinf(self._ended_s):
                self._end(real_s, time_s)
            self.participant.set_present(frozenset(self._tokens))
            if self._joined:  # else its journals may be an older copy: it claims and grants nothing
                self.participant.tick(real_s, time_s)
            else:
                self._ask_peers(real_s)
            self._send()
            self._recorder.step(real_s, time_s)
        self.wake_s = self.participant.wake_s(real_s)

    def _offer_jobs(self, time_s: float) -> None:
        """Add the jobs of the stream that are due, as many as the disk has space for."""
        due = [job for at_s, job in self._stream if at_s <= time_s]
        try:
            self.participant.granter.add_jobs(due)
        except JournalFull as error:
            self._warn("jobs", f"cannot record jobs that are due: {error}")
        while self._stream and self.book.is_known(self._stream[0][1].name):
            self._stream.popleft()

    def _begin(self, real_s: float) -> None:
        """Start the fleet's time, unless a peer has started it."""
        roster = self.participant.granter.roster
        present = len(self._tokens & roster | {self._name})
        if present < self._majority:
            self._since_s, self._joined = real_s, False  # meanwhile the others may begin an epoch
        elif real_s - self._since_s >= (LISTEN_S if present == len(roster) else PATIENCE_S):
            first = self._name == min(self._tokens & roster | {self._name})
            if not (self._epoch or self._joined):
                self._ask_peers(real_s)
                return
            if not (self._epoch or first):  # the first by name names the epoch; its bid begins the fleet's time here
                return
            if self._take_epoch(self._epoch or secrets.token_hex(4)):
                self._set_time(self._recorder.start_s(self._speed), real_s)

    def _end(self, real_s: float, time_s: float) -> None:
        """End the shift; only a last cycle continues."""
        if not self.participant.end():
            return
        self._ended_s, executor = real_s, self.participant.executor
        if executor.active and not executor.active[0].may_commit:
            executor.return_all(time_s, real_s, SHIFT_ENDED)

    def _set_time(self, time_s: float, real_s: float) -> None:
        self._begun = True
        self._arm.set_clock(FleetClock(self._speed, real_s, time_s, epoch=self._epoch), jump=True)

    def _declare(self) -> None:
        link, fleet, name = self._link, self._link.fleet, self._name
        self._publish_bid = link.publisher(keys.of_arm(fleet, name, "bid"), Bid)
        self._publish_operation = link.publisher(keys.of_arm(fleet, name, "operation"), Operation)
        link.reply_to(keys.asked_by_every_arm(fleet, name, "claim"), Claim, self._answer_claim)
        self._declare_desk(link)
        link.subscribe(keys.of_every_arm(fleet, "bid"), Bid, self._apply_bid, history=True)
        link.subscribe(keys.of_every_arm(fleet, "state"), State, self.participant.apply_state)
        self._at_start = link.tokens(keys.of_every_arm(fleet, "alive"))
        self._listened_s = time.monotonic() + LISTEN_S
        link.watch_tokens(keys.of_every_arm(fleet, "alive"), self._apply_token)

    def _apply_bid(self, arm: str, bid: Bid) -> None:
        real_s = time.monotonic()
        if arm == self._name or arm not in self.participant.granter.roster:
            return
        if bid.epoch and not (self._epoch or self._joined):
            self._ask_peers(real_s)
            return
        if not self._take_epoch(bid.epoch) and not self._begun:
            return
        if not self._begun or bid.time_s > self._arm.clock.now_s(real_s):
            self._set_time(bid.time_s, real_s)
        self.participant.apply_bid(bid, real_s)

    @property
    def _epoch(self) -> str:
        return self.book.epoch

    @property
    def _majority(self) -> int:
        return self.participant.claimant.majority

    def _take_epoch(self, epoch: str) -> bool:
        """Take the epoch of the fleet, unless there is one on disk already; return whether it is this one."""
        if epoch and not (self._epoch and self.book.roster):
            try:
                roster = tuple(sorted(self.participant.granter.roster))
                self.book.record(EpochBegun(self._epoch or epoch, roster=roster))
            except Refused as error:
                self._warn("epoch", f"cannot record the epoch: {error}")
        elif epoch not in ("", self._epoch):
            self._warn("epoch", f"has journals of the epoch '{self._epoch}', and a peer those of '{epoch}'.")
        return epoch in ("", self._epoch)

    def _history(self, _: HistoryRequest) -> History:
        return history_of(self._name, self.book)

    def _apply_token(self, arm: str, present: bool) -> None:
        (self._tokens.add if present else self._tokens.discard)(arm)

    def _answer_claim(self, claim: Claim) -> ClaimReply:
        if claim.arm == self._name or not (self._begun and self._joined):
            raise AnotherReplies
        real_s = time.monotonic()
        self.book.pass_time(self._arm.clock.now_s(real_s))
        return self.participant.granter.answer_claim(claim, real_s)

    # Requests of others: all arms receive them, and the first present one replies

    def _check_first(self) -> None:
        """Check that this arm replies for the fleet, which has begun or lacks a majority.

        Raises:
            AnotherReplies: another arm does, or all of them once they have begun.
        """
        if not (self._begun or self._too_few) or self._name != min(self._present, default=self._name):
            raise AnotherReplies

    @property
    def _too_few(self) -> str:
        return self.participant.too_few(self._present)

    @property
    def _present(self) -> frozenset[str]:
        """Present arms of the roster."""
        # The bid of a peer may begin the fleet's time here before the tokens arrive.
        at_start = self._at_start if time.monotonic() < self._listened_s else frozenset[str]()
        return self.participant.granter.roster & (self._tokens | at_start)

    @property
    def time_s(self) -> float:
        """Fleet time; before it goes on, that of the journal."""
        return self._arm.clock.now_s(time.monotonic()) if self._begun else self.book.time_s

    def _reply_clock(self, request: ClockRequest, /) -> Clock:
        if not self._begun:
            raise AnotherReplies
        return super()._reply_clock(request)

    def _trouble(self) -> str:
        if failure := self._recorder.failure:
            return f"{self._name} accepts and takes no jobs: {failure}"
        return self._too_few or ("" if self._joined else NOT_JOINED.format(self._name))

    def _entries(self) -> list[JobEntry]:
        return self.participant.entries(job for _, job in self._stream)

    def _status_of(self, entries: Sequence[JobEntry]) -> list[JobStatus]:
        return self.participant.status_of(entries, time.monotonic())

    def _submit(self, submission: Submission) -> SubmissionReply:
        self._check_first()  # it alone decides: the others get what it accepts with its next claim
        # Without a majority the others may accept another job of the same name; an older copy lacks names.
        if self._too_few or not self._joined:
            raise RefusedForNow(f"{self._trouble()} Submit it again then.")
        later = {job.name: job for _, job in self._stream}
        admissions = self.book.admit(submission.jobs, self.time_s, later)
        accepted = [job for job, reply in zip(submission.jobs, admissions, strict=True) if reply.accepted]
        self.participant.granter.add_jobs(accepted, submission.by)
        for job in accepted:
            self.participant.claimant.send_job(job)
        return SubmissionReply(self._name, admissions, self._epoch)

    def _clear(self, request: ClearRequest) -> Cleared:
        present, freed = frozenset(self._tokens | {self._name}), False
        try:
            freed = self.participant.granter.clear(request.arm, request.by, present, time.monotonic(), self.time_s)
        finally:
            self._check_first()
        if freed:
            self.participant.out.append(self.book.requested[-1])
        return Cleared(self._name, request.arm)

    def _control(self, request: ControlRequest) -> Controlled:
        self._check_first()
        if not (self._begun and self._joined):
            raise RefusedForNow(f"{self._trouble()} Ask again then.")
        return self.participant.control(request, self.time_s, (job for _, job in self._stream))

    # Messages to send

    def _send(self) -> None:
        out = self.participant.out
        while out:
            match out.popleft():
                case Bid() as bid:
                    if bid.estimates:  # the difficulty of each joint is published under its own key
                        self._arm.publish_difficulty(bid.estimates, time.monotonic())
                    estimates = tuple(
                        replace(each, plans=tuple(replace(plan, joint_difficulty=None) for plan in each.plans))
                        for each in bid.estimates
                    )
                    self._publish_bid(replace(bid, estimates=estimates))
                case Operation() as operation:
                    self._publish_operation(operation)
                case Claim() as claim:
                    self._query_claim(claim)

    def _query_claim(self, claim: Claim) -> None:
        def done(replies: Replies[ClaimReply]) -> None:
            for reason in filter(None, replies.refused.values()):
                self._warn("claim", f"gets no reply: {reason}")

        def apply(reply: ClaimReply) -> None:
            self.participant.claimant.apply_reply(reply, time.monotonic())

        key = keys.asked_of_all(self._link.fleet, "claim", self._name)
        try:
            self._link.query(key, claim, ClaimReply, done, timeout_s=self._membership.timing.ack_s, each=apply)
        except BusError as error:
            self._warn("bus", str(error))
