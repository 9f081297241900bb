"""The arm's side of the auction: which awards it takes, what it may do with them, and what it says of them.

A state machine without a clock and without I/O: real time comes as an argument; records go to `keep`, which returns
once they are on disk. The rules that make it do no job twice are in the head of `fleet.bus.trade`; here they are kept:

- an award counts only on a quote of this life of the arm that is still valid, once per job of that quote, and the
  answer is on disk before it is given;
- the arm works on a job while `may` lets it: up to the last cycle while the lease lasts, and through the last one only
  with leave to finish, which is on disk before the cycle begins;
- the end of a job is on disk before it is reported, and reported until there is a receipt.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from fleet.bus.trade import Ack, Award, Hold, JobWord, Lease, LeaseRequest, Receipt, Report
from fleet.errors import JournalError
from fleet.live.promises import (
    Accepted,
    Closed,
    Dropped,
    Held,
    Leave,
    Memory,
    Promise,
    Receipted,
    Worked,
    accepted,
    bounded,
)

_LOG = logging.getLogger(__name__)

Phase = Literal["queued", "working", "finishing"]

DRIFT = 0.01
"""Clocks may differ in rate by so much: by this share an arm counts its leases shorter than they are."""
RENEWALS = 3
"""Times that an arm asks for a lease in the length of one."""
ASK_AGAIN_S = 0.3
"""Real seconds after which it asks again for leave to finish."""
REPORT_AGAIN_S = (0.5, 8.0)
"""Real seconds between two reports of the same, first and at most."""
MOST_REPORTS = 256
"""Without a receipt; an arm that has more takes no more work."""


@dataclass(frozen=True, kw_only=True)
class Terms:
    """On what terms an arm works."""

    capacity: int = 1
    """Jobs in hand at a time."""
    valid_s: float = 5.0
    """Real seconds during which it takes an award on a quote."""
    quotes: int = 64
    """Remembered; an award on an older one is refused."""
    patience_s: float = 60.0
    """Real seconds after the end of a lease at which it gives a job back of its own accord."""
    ahead_s: float = 1.0
    """Real seconds before the last cycle at which it asks for leave to begin it."""

    def __post_init__(self) -> None:
        for name in ("capacity", "valid_s", "quotes", "patience_s", "ahead_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Terms.{name} must be > 0 (got {getattr(self, name)}).")


@dataclass(eq=False)
class _Quote:
    """A quote that may still be awarded."""

    made_s: float
    jobs: dict[str, tuple[JobWord, bool]]
    """What was asked for, and whether the arm can do it."""
    answers: dict[str, Ack] = field(default_factory=dict)
    """By job: one award each, whatever the answer."""


@dataclass(eq=False)
class _Pending:
    """A report without a receipt."""

    auctioneer: str
    report: Report
    next_s: float
    wait_s: float


class Contractor:
    """What one arm has promised.

    Attributes:
        arm: Its name.
        terms: On which it works.
        unwritten: Records for which there was no room yet; while there are any, it takes no award.
    """

    def __init__(
        self,
        arm: str,
        keep: Callable[..., None],
        memory: Memory,
        *,
        nonce: str,
        terms: Terms | None = None,
    ) -> None:
        """Begin a life of the arm.

        Args:
            keep: Takes records and returns when they are on disk; raises a JournalError, then none is.
            memory: As `restarted` gives it, and on disk.
            nonce: Never the same for two lives, so that a quote's name stays its own even if the disk was wiped.
        """
        self.arm = arm
        self.terms = terms or Terms()
        self.unwritten: list[Promise] = []
        self._keep = keep
        self._life = f"{memory.boot}-{nonce}"
        self._count = 0
        self._quotes: dict[str, _Quote] = {}
        self._held: dict[str, Held] = {}
        self._known = dict(memory.known)
        first_s, _ = REPORT_AGAIN_S
        self._reports = {
            name: _Pending(award.auctioneer, report, -math.inf, first_s)
            for name, (award, report) in memory.reports.items()
        }
        self._asked_s: dict[str, float] = {}

    # Taking work

    @property
    def spare(self) -> int:
        """How many more jobs it would take now."""
        closed = self.unwritten or len(self._reports) >= MOST_REPORTS
        return 0 if closed else max(0, self.terms.capacity - len(self._held))

    def quoted(self, jobs: dict[str, tuple[JobWord, bool]], now_s: float) -> str:
        """Name of a new quote for jobs, each with whether the arm can do it."""
        self._count += 1
        name = f"{self._life}-{self._count}"
        self._quotes[name] = _Quote(now_s, jobs)
        for old, quote in list(self._quotes.items()):
            if len(self._quotes) > self.terms.quotes or now_s > quote.made_s + self.terms.valid_s:
                del self._quotes[old]
        return name

    def awarded(self, award: Award, now_s: float, unfit: str = "") -> Ack:
        """Answer to an award.

        Args:
            unfit: Why the arm can take no work at all just now; "" if it can.
        """
        known = self._known.get(award.award)
        if known is not None:
            if known == award.job.name:
                return accepted(self.arm, award.award)
            return self._refusal(award, f"this award was for the job '{known}'")
        quote = self._quotes.get(award.quote)
        if quote is None:
            return self._refusal(award, f"no quote '{award.quote}' of mine is still good")
        name = award.job.name
        if name not in quote.jobs:
            return self._refusal(award, f"the quote says nothing of a job '{name}'")
        before = quote.answers.get(name)
        if before is None:
            before = quote.answers[name] = self._answer(award, quote, now_s, unfit)
        elif before.award != award.award:
            return self._refusal(award, f"that job was awarded on this quote by '{before.award}'")
        return before

    def _answer(self, award: Award, quote: _Quote, now_s: float, unfit: str) -> Ack:
        """The one answer to the first award of a job on a quote."""
        until_s = quote.made_s + (1 - DRIFT) * award.lease_s
        earlier = next((h for h in self._held.values() if h.award.job.name == award.job.name), None)
        reason = self._objection(award, quote, now_s) or unfit
        if not reason and now_s >= until_s:
            reason = "its lease is over already"
        elif not reason and earlier is not None and earlier.leave:
            reason = "I am finishing that job already"
        elif not reason and earlier is None and not self.spare:
            reason = self._no_room()
        if reason:
            return self._refusal(award, reason)
        records: list[Promise] = [Accepted(award)]
        if earlier is not None:  # A new award for the job says that the earlier one is over.
            records.insert(0, Dropped(earlier.award.award))
        try:
            self._keep(*records)
        except JournalError as error:
            return self._refusal(award, f"I cannot write it down: {error}")
        if earlier is not None:
            del self._held[earlier.award.award]
        self._held[award.award] = Held(award, award.cycles, until_s, kept=award.cycles, lease_s=award.lease_s)
        self._known[award.award] = award.job.name
        self._known = bounded(self._known, [*self._held, *self._reports])
        self._asked_s.setdefault(award.auctioneer, quote.made_s)
        return accepted(self.arm, award.award)

    def _objection(self, award: Award, quote: _Quote, now_s: float) -> str:
        word, feasible = quote.jobs[award.job.name]
        if self.unwritten:
            return "my journal has no room"
        if word != award.job:
            return "the job is not the one that the quote was for"
        if not feasible:
            return "the quote says that I cannot do it"
        if now_s > quote.made_s + self.terms.valid_s:
            return f"the quote was good for {self.terms.valid_s:g} s"
        if award.cycles >= award.job.repetitions:
            return f"of {award.job.repetitions} cycles {award.cycles} are done: nothing is left"
        if any(p.report.job == award.job.name and p.report.outcome == "finished" for p in self._reports.values()):
            return "I have finished that job"
        return ""

    def _no_room(self) -> str:
        if len(self._reports) >= MOST_REPORTS:
            return f"{len(self._reports)} of my reports have no receipt"
        return f"I have {len(self._held)} job(s) in hand and take no more at a time"

    def _refusal(self, award: Award, reason: str) -> Ack:
        return Ack(arm=self.arm, award=award.award, accepted=False, reason=reason)

    # Working

    @property
    def held(self) -> tuple[Held, ...]:
        """All awards in hand, the one to work on first."""
        return tuple(self._held.values())

    def may(self, now_s: float) -> int:
        """How many cycles of the first job in hand may be begun, those done included."""
        first = next(iter(self._held.values()))
        if first.leave:
            return first.award.job.repetitions
        return first.award.job.repetitions - 1 if now_s < first.until_s else first.cycles

    def worked(self, cycles: int, last_in_s: float) -> None:
        """How far the first job is.

        Args:
            cycles: Done, those of others included.
            last_in_s: Real seconds until its last cycle could begin.
        """
        first = next(iter(self._held.values()))
        first.cycles, first.last_in_s = cycles, last_in_s

    def finished(self, time_s: float, now_s: float) -> None:
        """The first job is done: its last cycle ended at `time_s`."""
        first = next(iter(self._held.values()))
        assert first.leave, "nobody finishes without leave"
        first.cycles = first.award.job.repetitions
        self._close(first, "finished", time_s, now_s, "")

    def returned(self, time_s: float, now_s: float, reason: str) -> None:
        """The arm cannot go on: it gives back all it has in hand."""
        for held in self.held:
            self._close(held, "returned", time_s, now_s, reason)

    def give_up(self, time_s: float, now_s: float) -> None:
        """Give back what has been without a lease for longer than the arm's patience."""
        for held in self.held:
            if not held.leave and now_s > held.until_s + self.terms.patience_s:
                self._close(held, "returned", time_s, now_s, f"no lease for {now_s - held.until_s:.0f} s")

    def _close(
        self, held: Held, outcome: Literal["finished", "returned"], time_s: float, now_s: float, reason: str
    ) -> None:
        name = held.award.award
        report = Report(
            arm=self.arm,
            award=name,
            job=held.award.job.name,
            outcome=outcome,
            cycles=held.cycles,
            time_s=time_s,
            reason=reason,
        )
        del self._held[name]
        self._reports[name] = _Pending(held.award.auctioneer, report, now_s, REPORT_AGAIN_S[0])
        self._write(Closed(report))

    # Leases

    def lease_requests(self, now_s: float) -> list[tuple[str, LeaseRequest]]:
        """What is to be asked of which auctioneer now; counted as asked."""
        due: list[tuple[str, LeaseRequest]] = []
        auctioneers = dict.fromkeys(held.award.auctioneer for held in self.held)
        self._asked_s = {name: asked_s for name, asked_s in self._asked_s.items() if name in auctioneers}
        for auctioneer in auctioneers:
            mine = [held for held in self.held if held.award.auctioneer == auctioneer]
            renew_s = self._asked_s.get(auctioneer, -math.inf) + min(held.lease_s for held in mine) / RENEWALS
            waiting = [held for held in mine if self._phase(held) == "finishing" and not held.leave]
            if now_s < renew_s and all(now_s < held.asked_s + ASK_AGAIN_S for held in waiting):
                continue
            self._asked_s[auctioneer] = now_s
            for held in waiting:
                held.asked_s = now_s
            due.append((auctioneer, LeaseRequest(arm=self.arm, holds=self.holds(auctioneer))))
        return due

    def holds(self, auctioneer: str) -> tuple[Hold, ...]:
        """What it has in hand from an auctioneer, as it tells it."""
        return tuple(self._hold(held) for held in self.held if held.award.auctioneer == auctioneer)

    def leased(self, lease: Lease, asked_s: float) -> None:
        """Take the answer to a request made at the real second `asked_s`."""
        until_s = asked_s + (1 - DRIFT) * lease.lease_s
        for held in self.held:
            name = held.award.award
            if held.award.auctioneer != lease.auctioneer:
                continue
            if name in lease.leave and not held.leave:
                try:
                    self._keep(Leave(name))
                except JournalError as error:
                    _LOG.warning("Leave to finish '%s' cannot be written down: %s", held.award.job.name, error)
                else:
                    held.leave = True
            if name in lease.lost and not held.leave:  # Leave once given cannot be taken back.
                del self._held[name]
                self._write(Dropped(name))
            elif name in lease.granted:
                held.until_s, held.lease_s = max(held.until_s, until_s), lease.lease_s

    def _phase(self, held: Held) -> Phase:
        if held is not next(iter(self._held.values())):
            return "queued"
        # A job of one cycle begins only with leave, however far the way to its place is.
        only_last = held.cycles >= held.award.job.repetitions - 1
        near = held.last_in_s <= self.terms.ahead_s
        return "finishing" if held.leave or only_last or near else "working"

    def _hold(self, held: Held) -> Hold:
        """What is told of a job in hand: no more cycles than are on disk."""
        if held.kept != held.cycles:
            try:
                self._keep(Worked(held.award.award, held.cycles))
            except JournalError as error:
                _LOG.warning("The cycles of '%s' cannot be written down: %s", held.award.job.name, error)
            else:
                held.kept = held.cycles
        return Hold(held.award.award, held.award.job.name, held.kept, self._phase(held))

    # Reports

    def reports(self, now_s: float) -> list[tuple[str, Report]]:
        """What is to be reported to whom now; counted as said. Nothing that is not on disk."""
        waiting = {record.report.award for record in self.unwritten if isinstance(record, Closed)}
        due: list[tuple[str, Report]] = []
        for name, pending in self._reports.items():
            if pending.next_s <= now_s and name not in waiting:
                pending.next_s = now_s + pending.wait_s
                pending.wait_s = min(2 * pending.wait_s, REPORT_AGAIN_S[1])
                due.append((pending.auctioneer, pending.report))
        return due

    def unreceipted(self) -> tuple[tuple[Report, bool], ...]:
        """Every report without a receipt, and whether it is on disk."""
        waiting = {record.report.award for record in self.unwritten if isinstance(record, Closed)}
        return tuple((pending.report, name not in waiting) for name, pending in self._reports.items())

    @property
    def owes(self) -> bool:
        """Whether a report has no receipt yet."""
        return bool(self._reports)

    def receipted(self, receipt: Receipt) -> None:
        """The auctioneer has a report."""
        pending = self._reports.get(receipt.award)
        if pending is not None and pending.auctioneer == receipt.auctioneer:
            del self._reports[receipt.award]
            self._write(Receipted(receipt.award))

    # The disk

    def _write(self, record: Promise) -> None:
        """Write what has happened already; where there is no room, later."""
        self.unwritten.append(record)
        self.catch_up()

    def catch_up(self) -> None:
        """Write what there was no room for."""
        if not self.unwritten:
            return
        try:
            self._keep(*self.unwritten)
        except JournalError as error:
            _LOG.warning("%d record(s) wait for room: %s", len(self.unwritten), error)
        else:
            self.unwritten.clear()
