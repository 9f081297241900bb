"""The auctioneer: asks for quotes, awards jobs, renews leases and takes reports, so that no job is done twice.

A state machine without a clock and without I/O. Real seconds (`real_s`, monotonic) and the fleet's time (`time_s`) come
as arguments; records go to `keep`, which returns once they are on disk; what is to be said or asked lies in `out`.
The rule is in the head of `fleet.bus.trade`; this side of it:

- an award is on disk before it is sent, and from then on counts as leased for `Timing.hold_s`, whether there is an
  answer or not; every renewal counts anew from the moment it is answered;
- a job is offered again only when its lease is over here, or the arm has refused it or given it back;
- leave to finish is on disk before it is given, and bars the job for everybody else for good;
- after a crash every open award counts as leased from the restart.
"""

import logging
import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from fleet.bus.trade import (
    Ack,
    Announce,
    Award,
    Hold,
    JobStatus,
    Lease,
    LeaseRequest,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
    Result,
    Submission,
    Submitted,
)
from fleet.errors import FleetError, JournalFull
from fleet.live.bidding import MOST_TOLD, Allocate, Bidding, Round, nobody_can, sound
from fleet.live.ledger import Ledger
from fleet.live.records import Accepted, Awarded, Change, Closed, Ended, Heard, Leave, Record, Silent
from fleet.live.timing import Timing

_LOG = logging.getLogger(__name__)

SCAN_S = 0.05
"""Real seconds between two looks for jobs that have become ready."""


class Objection(FleetError):
    """What was said cannot be; the one who said it is told this sentence."""


@dataclass(frozen=True)
class Give:
    """Send this award to its arm."""

    arm: str
    award: Award


Out = QuoteRequest | Give | Announce | Result


@dataclass(eq=False)
class _Sent:
    """An award without an answer."""

    give: Give
    at_s: float
    attempts: int = 1


class Auctioneer:
    """One auctioneer in one life.

    Attributes:
        ledger: What it knows of its jobs.
        out: What it wants said and asked, oldest first; whoever drives it takes it out.
        cycles: Last heard progress of the awards that are open.
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
        """Begin, or go on where the ledger stands.

        Args:
            keep: Writes records; returns when they are on disk, or raises `JournalError` and has written none.
            life: Part of the names of auctions and awards; never the same again for this name.
        """
        self.name, self.ledger = name, ledger
        self.out: deque[Out] = deque(self._result(change) for change in ledger.recent)
        self.cycles: dict[str, int] = {}
        self._allocate, self._keep, self._life = allocate, keep, life
        self._timing = timing or Timing()
        self._until_s = dict.fromkeys(ledger.open, real_s + self._timing.hold_s)
        self._unanswered: dict[str, _Sent] = {}
        self._round: Round | None = None
        self._rounds = 0
        self._present: frozenset[str] = frozenset()
        self._later_s: dict[str, float] = {}
        self._notes: dict[str, str] = {}
        self._scan_s = -math.inf
        self._pause_s = self._timing.pause_s[0]

    # What comes from outside

    def submitted(self, word: Submission, real_s: float, time_s: float) -> Submitted:
        """Take jobs; every accepted one is on disk when this returns."""
        admissions = self.ledger.admit(word.jobs)
        taken = {job.name: job for job, said in zip(word.jobs, admissions, strict=True) if said.accepted}
        fresh = tuple(job for name, job in taken.items() if name not in self.ledger.jobs)
        if fresh:
            self._happen(Accepted(fresh, word.by, time_s))
            self._hurry()
        return Submitted(self.name, admissions)

    def leased(self, word: LeaseRequest, real_s: float, time_s: float) -> Lease:
        """Renew leases, and give leave to finish to those who ask for it.

        An arm that asks after its lease, but before its job was taken back, keeps it: nobody else can have it.
        """
        mine = {hold.award: hold for hold in word.holds if self._is_held(hold, word.arm)}
        for award, hold in mine.items():
            self._unanswered.pop(award, None)
            self.cycles[award] = max(hold.cycles, self.cycles.get(award, 0))
            self._until_s[award] = real_s + self._timing.hold_s
        self._note_leave(mine, time_s)
        return Lease(
            auctioneer=self.name,
            lease_s=self._timing.lease_s,
            granted=tuple(mine),
            lost=tuple(hold.award for hold in word.holds if hold.award not in mine),
            leave=tuple(award for award in mine if self.ledger.open[award].leave),
        )

    def reported(self, word: Report, real_s: float, time_s: float) -> Receipt:
        """Note how an award ended; the same report again changes nothing.

        Raises:
            Objection: the award is another arm's, or for another job.
        """
        promise = self.ledger.awards.get(word.award)
        if promise is None:
            # Of a life whose journal is gone: nothing is known of it, and the arm shall not repeat it for ever.
            _LOG.warning("'%s' reports on an award that is not known here: %s.", word.arm, word.award)
            return Receipt(self.name, word.award)
        if (promise.made.arm, promise.made.job) != (word.arm, word.job):
            raise Objection(
                f"Award '{word.award}' is of '{promise.made.job}' to '{promise.made.arm}', not of '{word.job}' to "
                f"'{word.arm}'."
            )
        if promise.outcome not in ("finished", "returned"):
            if word.outcome == "finished" and not promise.leave:
                _LOG.error("'%s' finished '%s' without leave.", word.arm, word.job)
            done_s = min(word.time_s, time_s)
            why = word.reason[:MOST_TOLD]
            self._happen(Closed(word.award, word.outcome, word.cycles, done_s, why, word.unsure))
            self._forget(word.award)
            if word.outcome == "finished":
                self._hurry()
            else:
                self._pause(real_s, (word.job,))
        return Receipt(self.name, word.award)

    def quoted(self, quote: Quote, real_s: float, time_s: float) -> None:
        """A bid has come; the round closes with the last one that is waited for."""
        open_round = self._round
        if open_round is not None and quote.auction == open_round.auction:
            open_round.quotes[quote.arm] = quote
            if open_round.complete(self._present):
                self._close_round(open_round, real_s, time_s)

    def all_quoted(self, auction: str, real_s: float, time_s: float) -> None:
        """No more bids will come."""
        if self._round is not None and self._round.auction == auction:
            self._close_round(self._round, real_s, time_s)

    def acknowledged(self, ack: Ack, real_s: float, time_s: float) -> None:
        """An arm has answered an award."""
        sent = self._unanswered.get(ack.award)
        if sent is None or sent.give.arm != ack.arm:
            return
        if not ack.accepted:
            why = f"'{ack.arm}' refused it: {ack.reason}"[:MOST_TOLD]
            self._happen(Closed(ack.award, "refused", 0, time_s, why))
            self._forget(ack.award)
            self._pause(real_s, (sent.give.award.job.name,))
        self._unanswered.pop(ack.award, None)
        if not self._unanswered:
            self._scan_s = -math.inf  # the next round waits for nobody

    def seen(self, present: frozenset[str]) -> None:
        """These arms are there."""
        if present - self._present:
            self._hurry()
        self._present = present

    def tick(self, real_s: float, time_s: float) -> None:
        """Do what is due."""
        self._expire(real_s, time_s)
        self._send_again(real_s)
        if self._round is None:
            if real_s >= self._scan_s:
                self._scan_s = real_s + SCAN_S
                self._open_round(real_s, time_s)
        elif real_s >= self._round.until_s or self._round.complete(self._present):
            self._close_round(self._round, real_s, time_s)

    def end(self, time_s: float) -> None:
        """The shift is over: nothing more is offered, and what is not done is reported unfinished."""
        if not self.ledger.ended:
            self._round = None
            self._happen(Ended(time_s))

    def finishing(self) -> bool:
        """Whether an arm that is there may be in the last cycle of a job."""
        return any(promise.leave and promise.made.arm in self._present for promise in self.ledger.open.values())

    def status(self, names: Iterable[str] = ()) -> tuple[JobStatus, ...]:
        """Where jobs stand, with what was last heard."""
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

    def _is_held(self, hold: Hold, arm: str) -> bool:
        promise = self.ledger.open.get(hold.award)
        if promise is None or (promise.made.arm, promise.made.job) != (arm, hold.job):
            return False
        return promise.leave or not self.ledger.ended

    def _note_leave(self, mine: dict[str, Hold], time_s: float) -> None:
        records: list[Record] = []
        for award, hold in mine.items():
            promise = self.ledger.open[award]
            if hold.phase == "finishing" and not promise.leave:
                records.append(Leave(award, time_s))
            elif promise.silent and not self.ledger.ended:
                records.append(Heard(award, time_s))
        try:
            self._happen(*records)
        except JournalFull as error:
            _LOG.error("No leave to finish is given: %s", error)

    def _expire(self, real_s: float, time_s: float) -> None:
        """Take back what is leased no longer; what had leave to finish stays with its arm."""
        for award in [award for award, until_s in self._until_s.items() if real_s >= until_s]:
            promise = self.ledger.open[award]
            did = "answer the award" if award in self._unanswered else "renew its lease"
            why = f"'{promise.made.arm}' did not {did}."
            try:
                if not promise.leave:
                    self._happen(Closed(award, "dropped", self.cycles.get(award, 0), time_s, why))
                    self._forget(award)
                    self._hurry()
                elif not promise.silent and not self.ledger.ended:
                    self._happen(Silent(award, time_s))
                    self._until_s[award] = math.inf
            except JournalFull as error:
                _LOG.error("'%s' stays with '%s': %s", promise.made.job, promise.made.arm, error)
                return

    def _forget(self, award: str) -> None:
        """Keep nothing of awards that are closed: this one, and one that it has overtaken."""
        for table in (self._until_s, self._unanswered, self.cycles):
            for closed in [name for name in table if name == award or name not in self.ledger.open]:
                del table[closed]

    # Rounds

    def _hurry(self) -> None:
        """Something has changed: whatever was offered in vain may find its arm now."""
        self._later_s.clear()
        self._scan_s = -math.inf
        self._pause_s = self._timing.pause_s[0]

    def _pause(self, real_s: float, jobs: Iterable[str]) -> None:
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
        jobs = tuple(self.ledger.ready(time_s, self._timing.most_offered, but=later))
        if not jobs:
            return
        self._rounds += 1
        auction = f"{self.name}-{self._life}-{self._rounds}"
        self._round = Round(auction, jobs, bidders, real_s + self._timing.window_s)
        self.out.append(Announce(self.name, auction, time_s, tuple(word.name for word in jobs)))
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
        self._notes |= nobody_can(Bidding(closing.auction, time_s, jobs, heard))
        room = {arm: quote for arm, quote in heard.items() if quote.capacity}
        bidding = Bidding(closing.auction, time_s, jobs, room)
        allocation = sound(bidding, self._allocate(bidding)) if room and jobs else {}
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
            self._pause(real_s, (word.name for word in closing.jobs))

    def _award(self, bidding: Bidding, allocation: dict[str, str], real_s: float, time_s: float) -> None:
        records: list[Awarded] = []
        for job, arm in allocation.items():
            offer = bidding.offer(arm, job)
            assert offer is not None  # `sound` has seen to it
            records.append(
                Awarded(
                    award=f"{bidding.auction}:{job}",
                    auction=bidding.auction,
                    job=job,
                    arm=arm,
                    quote=bidding.quotes[arm].quote,
                    cycles=self.ledger.jobs[job].cycles,
                    time_s=time_s,
                    d=offer.d,
                    p_saturation=offer.p_saturation,
                )
            )
        self._happen(*records)
        for made in records:
            self._notes.pop(made.job, None)
            word = self.ledger.jobs[made.job].word
            award = Award(made.award, made.auction, self.name, made.quote, word, made.cycles, self._timing.lease_s)
            give = Give(made.arm, award)
            self._unanswered[made.award] = _Sent(give, real_s)
            self._until_s[made.award] = real_s + self._timing.hold_s
            self.out.append(give)

    def _send_again(self, real_s: float) -> None:
        for sent in self._unanswered.values():
            if real_s >= sent.at_s + self._timing.ack_s and sent.attempts < self._timing.attempts:
                sent.at_s, sent.attempts = real_s, sent.attempts + 1
                self.out.append(sent.give)

    # Records

    def _happen(self, *records: Record) -> None:
        """Records first, then their effect.

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
            d=change.d,
            p_saturation=change.p_saturation,
        )
