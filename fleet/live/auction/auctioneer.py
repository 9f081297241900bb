"""The auctioneer: asks for quotes, awards jobs, renews leases and takes reports, so that no job is done twice.

A state machine without a clock and without I/O. Real seconds (`real_s`, monotonic) and the fleet's time (`time_s`) come
as arguments. Records go to `keep`, which returns once they are on disk. Messages to send are in `out`. The rules that
make it safe (`fleet.bus.protocol.auction` says why):

- An award is on disk before it is sent. From then on it counts as leased for `Timing.counted_lease_s`, answered or not;
  a renewal counts from the moment it is answered.
- A job is offered again only after its lease has ended here, or its arm has refused or returned it.
- Permission to commit, that is to begin the last cycle, is on disk before it is given; no other arm gets the job then.
- After a crash every open award counts as leased from the restart.
"""

import logging
import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from fleet.bus.protocol.auction import (
    Ack,
    Announcement,
    Award,
    JobStatus,
    Lease,
    LeaseEntry,
    LeaseRequest,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
    Result,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.messages import State
from fleet.errors import FleetError, JournalFull
from fleet.live.auction.journal_records import (
    AuctionRecord,
    Awarded,
    Change,
    Closed,
    CommitPermitted,
    ContactLost,
    ContactRegained,
    JobsAccepted,
    ShiftEnded,
)
from fleet.live.auction.lease_timing import Timing
from fleet.live.auction.ledger import Ledger
from fleet.live.auction.round import REASON_CHARACTERS, Allocate, Bidding, Round, drop_invalid, infeasible_jobs

_LOG = logging.getLogger(__name__)

SCAN_S = 0.05
"""Real seconds between two checks for jobs that have become ready."""


class Objection(FleetError):
    """A request that is refused; its sender receives this sentence."""


@dataclass(frozen=True)
class SendAward:
    """Send this award to its arm."""

    arm: str
    award: Award


Out = QuoteRequest | SendAward | Announcement | Result


@dataclass(eq=False)
class _Sent:
    """An award without an answer."""

    give: SendAward
    at_s: float
    attempts: int = 1


class Auctioneer:
    """One auctioneer, from one start of its process to the next.

    Attributes:
        ledger: Its jobs and awards.
        out: Messages to send, oldest first; the driver takes them out.
        cycles: Last reported progress of the open awards.
        states: The last state of each arm; the driver puts them in.
    """

    def __init__(
        self,
        name: str,
        ledger: Ledger,
        *,
        allocate: Allocate,
        keep: Callable[..., None],
        life: str,
        real_s: float,
        timing: Timing | None = None,
    ) -> None:
        """Start with the jobs and awards of a ledger.

        Args:
            keep: Writes records; returns when they are on disk, or raises `JournalError` and has written none.
            life: Part of the names of auctions and awards; unique for each start of an auctioneer of this name.
        """
        self.name, self.ledger = name, ledger
        self.out: deque[Out] = deque(self._result(change) for change in ledger.recent)
        self.cycles: dict[str, int] = {}
        self.states: dict[str, State] = {}
        self._allocate, self._keep, self._life = allocate, keep, life
        self._timing = timing or Timing()
        self._until_s = dict.fromkeys(ledger.open, real_s + self._timing.counted_lease_s)
        self._unanswered: dict[str, _Sent] = {}
        self._round: Round | None = None
        self._rounds = 0
        self._present: frozenset[str] = frozenset()
        self._later_s: dict[str, float] = {}
        self._notes: dict[str, str] = {}
        self._scan_s = -math.inf
        self._pause_s = self._timing.pause_s[0]

    # Messages

    def submit(self, word: Submission, real_s: float, time_s: float) -> SubmissionReply:
        """Accept jobs; every accepted one is on disk when this returns."""
        admissions = self.ledger.admit(word.jobs)
        taken = {job.name: job for job, said in zip(word.jobs, admissions, strict=True) if said.accepted}
        fresh = tuple(job for name, job in taken.items() if name not in self.ledger.jobs)
        if fresh:
            self._record(JobsAccepted(fresh, word.by, time_s))
            self._retry_now()
        return SubmissionReply(self.name, admissions)

    def renew_leases(self, word: LeaseRequest, real_s: float, time_s: float) -> Lease:
        """Renew leases, and permit to commit where an arm asks for it.

        An arm that asks after the end of its lease, but before its job was taken back, keeps it: no other arm has it.
        """
        mine = {hold.award: hold for hold in word.entries if self._is_held(hold, word.arm)}
        for award, hold in mine.items():
            self._unanswered.pop(award, None)
            self.cycles[award] = max(hold.cycles, self.cycles.get(award, 0))
            self._until_s[award] = real_s + self._timing.counted_lease_s
        self._permit_commits(mine, time_s)
        return Lease(
            auctioneer=self.name,
            lease_s=self._timing.lease_s,
            granted=tuple(mine),
            revoked=tuple(hold.award for hold in word.entries if hold.award not in mine),
            may_commit=tuple(award for award in mine if self.ledger.open[award].may_commit),
        )

    def apply_report(self, word: Report, real_s: float, time_s: float) -> Receipt:
        """Record how an award ended; the same report again changes nothing.

        Raises:
            Objection: the award is another arm's, or for another job.
        """
        promise = self.ledger.awards.get(word.award)
        if promise is None:
            # Of a lost journal: it is receipted, so that the arm does not repeat it for ever.
            _LOG.warning("'%s' reports on an award that is not known here: %s.", word.arm, word.award)
            return Receipt(self.name, word.award)
        if (promise.made.arm, promise.made.job) != (word.arm, word.job):
            raise Objection(
                f"Award '{word.award}' is of '{promise.made.job}' to '{promise.made.arm}', not of '{word.job}' to "
                f"'{word.arm}'."
            )
        if promise.outcome not in ("finished", "returned"):
            if word.outcome == "finished" and not promise.may_commit:
                _LOG.error("'%s' finished '%s' without permission to commit.", word.arm, word.job)
            done_s = min(word.time_s, time_s)
            why = word.reason[:REASON_CHARACTERS]
            self._record(Closed(word.award, word.outcome, word.cycles, done_s, why, word.unsure))
            self._forget(word.award)
            if word.outcome == "finished":
                self._retry_now()
            else:
                self._delay(real_s, (word.job,))
        return Receipt(self.name, word.award)

    def add_quote(self, quote: Quote, real_s: float, time_s: float) -> None:
        """Take a quote; the round closes with the last one that it waits for."""
        open_round = self._round
        if open_round is not None and quote.auction == open_round.auction:
            open_round.quotes[quote.arm] = quote
            if open_round.complete(self._present):
                self._close_round(open_round, real_s, time_s)

    def end_quotes(self, auction: str, real_s: float, time_s: float) -> None:
        """No more quotes will come: close the round."""
        if self._round is not None and self._round.auction == auction:
            self._close_round(self._round, real_s, time_s)

    def apply_ack(self, ack: Ack, real_s: float, time_s: float) -> None:
        """Take an arm's answer to an award."""
        sent = self._unanswered.get(ack.award)
        if sent is None or sent.give.arm != ack.arm:
            return
        if not ack.accepted:
            why = f"'{ack.arm}' refused it: {ack.reason}"[:REASON_CHARACTERS]
            self._record(Closed(ack.award, "refused", 0, time_s, why))
            self._forget(ack.award)
            self._delay(real_s, (sent.give.award.job.name,))
        self._unanswered.pop(ack.award, None)
        if not self._unanswered:
            self._scan_s = -math.inf  # the next round waits for nobody

    def set_present(self, present: frozenset[str]) -> None:
        """Set which arms are present."""
        if present - self._present:
            self._retry_now()
        self._present = present

    def tick(self, real_s: float, time_s: float) -> None:
        """Do what is due."""
        self._expire(real_s, time_s)
        self._resend(real_s)
        if self._round is None:
            if real_s >= self._scan_s:
                self._scan_s = real_s + SCAN_S
                self._open_round(real_s, time_s)
        elif real_s >= self._round.until_s or self._round.complete(self._present):
            self._close_round(self._round, real_s, time_s)

    def end(self, time_s: float) -> None:
        """End the shift: nothing more is offered, and jobs that are not done are reported unfinished."""
        if not self.ledger.ended:
            self._round = None
            self._record(ShiftEnded(time_s))

    def finishing(self) -> bool:
        """Whether a present arm may be in the last cycle of a job."""
        return any(promise.may_commit and promise.made.arm in self._present for promise in self.ledger.open.values())

    def status(self, names: Iterable[str] = ()) -> tuple[JobStatus, ...]:
        """Status of jobs, with the last reported progress."""
        return tuple(
            JobStatus(
                job=said.job,
                state=said.state,
                arm=said.arm,
                award=said.award,
                cycles=max(said.cycles, self.cycles.get(said.award, 0)),
                finished_s=said.finished_s,
                reason=said.reason or (self._notes.get(said.job, "") if said.state == "waiting" else ""),
            )
            for said in self.ledger.status(names)
        )

    # Leases

    def _is_held(self, hold: LeaseEntry, arm: str) -> bool:
        promise = self.ledger.open.get(hold.award)
        if promise is None or (promise.made.arm, promise.made.job) != (arm, hold.job):
            return False
        return promise.may_commit or not self.ledger.ended

    def _permit_commits(self, mine: dict[str, LeaseEntry], time_s: float) -> None:
        records: list[AuctionRecord] = []
        for award, hold in mine.items():
            promise = self.ledger.open[award]
            if hold.phase == "finishing" and not promise.may_commit:
                records.append(CommitPermitted(award, time_s))
            elif promise.silent and not self.ledger.ended:
                records.append(ContactRegained(award, time_s))
        try:
            self._record(*records)
        except JournalFull as error:
            _LOG.error("No permission to commit is given: %s", error)

    def _expire(self, real_s: float, time_s: float) -> None:
        """Take back jobs whose lease has ended; one that may be committed stays with its arm."""
        for award in [award for award, until_s in self._until_s.items() if real_s >= until_s]:
            promise = self.ledger.open[award]
            did = "answer the award" if award in self._unanswered else "renew its lease"
            why = f"'{promise.made.arm}' did not {did}."
            try:
                if not promise.may_commit:
                    self._record(Closed(award, "dropped", self.cycles.get(award, 0), time_s, why))
                    self._forget(award)
                    self._retry_now()
                elif not promise.silent and not self.ledger.ended:
                    self._record(ContactLost(award, time_s))
                    self._until_s[award] = math.inf
            except JournalFull as error:
                _LOG.error("'%s' stays with '%s': %s", promise.made.job, promise.made.arm, error)
                return

    def _forget(self, award: str) -> None:
        """Drop the timers of closed awards: this one, and one that it has superseded."""
        for table in (self._until_s, self._unanswered, self.cycles):
            for closed in [name for name in table if name == award or name not in self.ledger.open]:
                del table[closed]

    # Rounds

    def _retry_now(self) -> None:
        """Offer rejected jobs again at once: something has changed."""
        self._later_s.clear()
        self._scan_s = -math.inf
        self._pause_s = self._timing.pause_s[0]

    def _delay(self, real_s: float, jobs: Iterable[str]) -> None:
        """Offer these jobs again only after a while, longer each time in a row."""
        self._later_s |= dict.fromkeys(jobs, real_s + self._pause_s)
        self._pause_s = min(2 * self._pause_s, self._timing.pause_s[1])

    def _open_round(self, real_s: float, time_s: float) -> None:
        busy = {sent.give.arm for sent in self._unanswered.values()}
        bidders = self._present - busy
        recent = any(real_s < sent.at_s + self._timing.window_s for sent in self._unanswered.values())
        if not bidders or recent:
            return
        later = {job for job, at_s in self._later_s.items() if at_s > real_s}
        jobs = tuple(self.ledger.ready(time_s, self._timing.max_jobs, but=later))
        if not jobs:
            return
        self._rounds += 1
        auction = f"{self.name}-{self._life}-{self._rounds}"
        self._round = Round(auction, jobs, bidders, real_s + self._timing.window_s)
        self.out.append(Announcement(self.name, auction, time_s, tuple(word.name for word in jobs)))
        self.out.append(QuoteRequest(auction, jobs))

    def _close_round(self, closing: Round, real_s: float, time_s: float) -> None:
        self._round = None
        taken = self.ledger.taken()
        jobs = tuple(
            word
            for word in closing.jobs
            if self.ledger.jobs[word.name].state == "waiting" and not taken & frozenset(word.places)
        )
        heard = {arm: quote for arm, quote in closing.quotes.items() if arm in closing.asked & self._present}
        room = {arm: quote for arm, quote in heard.items() if quote.capacity}
        full = {arm: quote for arm, quote in heard.items() if not quote.capacity}
        bidding = Bidding(
            closing.auction, time_s, jobs, room, full, states=self.states, returned=self.ledger.returned(jobs)
        )
        self._notes |= infeasible_jobs(bidding)
        allocation = drop_invalid(bidding, self._allocate(bidding)) if room and jobs else {}
        try:
            self._award(bidding, allocation, real_s, time_s)
        except JournalFull as error:
            _LOG.error("Nothing is awarded: %s", error)
            allocation = {}
        if allocation:
            self._scan_s, self._pause_s = -math.inf, self._timing.pause_s[0]
        else:
            if not room:  # whatever else might be offered: nobody takes more
                self._scan_s = real_s + self._pause_s
            self._delay(real_s, (word.name for word in closing.jobs))

    def _award(self, bidding: Bidding, allocation: dict[str, str], real_s: float, time_s: float) -> None:
        records: list[Awarded] = []
        for job, arm in allocation.items():
            offer = bidding.offer(arm, job)
            assert offer is not None  # `drop_invalid` keeps jobs with a bid
            records.append(
                Awarded(
                    award=f"{bidding.auction}:{job}",
                    auction=bidding.auction,
                    job=job,
                    arm=arm,
                    quote=bidding.quotes[arm].quote,
                    cycles=self.ledger.jobs[job].cycles,
                    time_s=time_s,
                    difficulty=offer.difficulty,
                    p_saturation=offer.p_saturation,
                )
            )
        self._record(*records)
        for made in records:
            self._notes.pop(made.job, None)
            word = self.ledger.jobs[made.job].word
            award = Award(made.award, made.auction, self.name, made.quote, word, made.cycles, self._timing.lease_s)
            give = SendAward(made.arm, award)
            self._unanswered[made.award] = _Sent(give, real_s)
            self._until_s[made.award] = real_s + self._timing.counted_lease_s
            self.out.append(give)

    def _resend(self, real_s: float) -> None:
        for sent in self._unanswered.values():
            if real_s >= sent.at_s + self._timing.ack_s and sent.attempts < self._timing.attempts:
                sent.at_s, sent.attempts = real_s, sent.attempts + 1
                self.out.append(sent.give)

    # Records

    def _record(self, *records: AuctionRecord) -> None:
        """Write records, then apply them.

        Raises:
            JournalError: nothing was written, and nothing has happened.
        """
        if records:
            self._keep(*records)
            for record in records:
                self.out.extend(self._result(change) for change in self.ledger.apply(record))

    def _result(self, change: Change) -> Result:
        return Result(
            auctioneer=self.name,
            number=change.number,
            time_s=change.time_s,
            status=change.status,
            auction=change.auction,
            difficulty=change.difficulty,
            p_saturation=change.p_saturation,
        )
