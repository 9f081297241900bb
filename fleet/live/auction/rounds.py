"""Rounds of an auction: which jobs are offered when, to whom, and what is awarded."""

import logging
import math
from collections.abc import Iterable

from fleet.bus.protocol.auction import Announcement, Award, QuoteRequest
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import ALL_ARMS
from fleet.errors import JournalFull
from fleet.live.auction.leases import CountedLease, SendAward, new_awards, unanswered
from fleet.live.auction.round import (
    Allocate,
    Assignment,
    Bidding,
    Round,
    Timing,
    drop_invalid,
    infeasible_jobs,
    planned_jobs,
)
from fleet.live.auction.space_rules import stated_spaces, waits_for_space
from fleet.live.auction.writer import LedgerWriter
from fleet.live.space import Excludes

_LOG = logging.getLogger(__name__)

SCAN_S = 0.05
"""Real seconds between two checks for jobs that have become ready."""


class Rounds:
    """Rounds of one auctioneer, one after another.

    Attributes:
        open: The round that is open for bids; None between two rounds.
        allocate: The allocation rule.
        states: The last state of each arm.
        present: Arms that are present.
    """

    def __init__(
        self, name: str, writer: LedgerWriter, allocate: Allocate, timing: Timing, excludes: Excludes, boot: str
    ) -> None:
        """Start; arguments as of `fleet.live.auction.auctioneer.Auctioneer`."""
        self.open: Round | None = None
        self.states: dict[str, State] = {}
        self.present: frozenset[str] = frozenset()
        self._name, self._writer, self.allocate = name, writer, allocate
        self._timing, self._excludes, self._boot = timing, excludes, boot
        self._count = 0
        self._later_s: dict[str, float] = {}
        """Real second from which a job may be offered again."""
        self._notes: dict[str, str] = {}
        """Why no arm can do a job."""
        self._planned: set[str] = set()
        """Waiting jobs for which arms have plans, or have said that there is none."""
        self._scan_s = -math.inf
        self._pause_s = timing.pause_s[0]

    def step(self, real_s: float, time_s: float) -> None:
        """Open or close a round if that is due."""
        if self.open is None:
            if real_s >= self._scan_s:
                self._scan_s = real_s + SCAN_S
                self._begin(real_s, time_s)
        elif real_s >= self.open.until_s or self.open.complete(self.present):
            self._close(self.open, real_s, time_s)

    def scan_now(self) -> None:
        """Open the next round with the next step."""
        self._scan_s = -math.inf

    def note(self, job: str) -> str:
        """Return why no arm begins a job; "" if an arm may."""
        if (pauser := self._writer.ledger.paused.get(ALL_ARMS)) is not None:
            return f"All arms are paused by '{pauser}'."
        return self._notes.get(job, "")

    def is_planned(self, job: str) -> bool:
        """Return whether an arm has a plan for a waiting job, or all have said that there is none."""
        return job in self._planned

    def retry_now(self) -> None:
        """Offer delayed jobs again at once: something has changed."""
        self._later_s.clear()
        self._scan_s = -math.inf
        self._pause_s = self._timing.pause_s[0]

    def delay(self, real_s: float, jobs: Iterable[str]) -> None:
        """Offer these jobs again after a pause, which is longer each time in a row."""
        self._later_s |= dict.fromkeys(jobs, real_s + self._pause_s)
        self._pause_s = min(2 * self._pause_s, self._timing.pause_s[1])

    # Inside

    def _begin(self, real_s: float, time_s: float) -> None:
        waiting = unanswered(self._writer.leases)
        ledger = self._writer.ledger
        able = {arm for arm in self.present if not ledger.is_paused(arm)}
        bidders = frozenset(able - {message.arm for _, message in waiting})
        if not bidders or any(real_s < lease.sent_s + self._timing.window_s for lease, _ in waiting):
            return
        self._later_s = {job: at_s for job, at_s in self._later_s.items() if at_s > real_s}
        self._notes = {job: note for job, note in self._notes.items() if job in ledger.waiting}
        self._planned &= ledger.waiting.keys()
        jobs = tuple(ledger.ready(time_s, self._timing.max_jobs, excluded=self._later_s))
        busy = ledger.busy_stations()
        if not any(busy.isdisjoint(job.places) for job in jobs):
            return
        self._count += 1
        auction = f"{self._name}-{self._boot}-{self._count}"
        self.open = Round(auction, jobs, bidders, real_s + self._timing.window_s, self._writer.ledger.closed_space())
        self._writer.out.append(Announcement(self._name, auction, time_s, tuple(job.name for job in jobs)))
        cycles = {job.name: done for job in jobs if (done := self._writer.ledger.jobs[job.name].cycles)}
        self._writer.out.append(QuoteRequest(auction, jobs, cycles=cycles))

    def _close(self, closing: Round, real_s: float, time_s: float) -> None:
        self.open = None
        if not self._writer.try_to_record("Nothing is awarded", *stated_spaces(self._writer.ledger, closing, time_s)):
            self.delay(real_s, (job.name for job in closing.jobs))
            return
        entries = [self._writer.ledger.jobs[job.name] for job in closing.jobs]
        entries = [e for e, job in zip(entries, closing.jobs, strict=True) if e.state == "waiting" and e.spec == job]
        jobs = tuple(entry.spec for entry in entries)
        quotes = {arm: quote for arm, quote in closing.quotes.items() if self._may_work(arm, closing)}
        bidding = Bidding(
            closing.auction,
            time_s,
            jobs,
            {arm: quote for arm, quote in quotes.items() if quote.capacity},
            {arm: quote for arm, quote in quotes.items() if not quote.capacity},
            states=self.states,
            returned={entry.spec.name: (len(entry.faults), entry.returned_s) for entry in entries if entry.returns},
            busy=self._writer.ledger.busy_stations(),
            taken=self._writer.ledger.taken_space(),
            excludes=self._excludes,
        )
        for job in closing.jobs if quotes else ():
            self._notes.pop(job.name, None)
        self._planned |= planned_jobs(quotes)
        self._notes |= infeasible_jobs(quotes) | waits_for_space(bidding)
        allocation = drop_invalid(bidding, self.allocate(bidding)) if bidding.quotes and jobs else {}
        try:
            self._award(bidding, allocation, real_s, time_s)
        except JournalFull as error:
            _LOG.error("Nothing is awarded: %s", error)
            allocation = {}
        if allocation:
            self._scan_s, self._pause_s = -math.inf, self._timing.pause_s[0]
        else:
            if not bidding.quotes:  # no arm has capacity for any job
                self._scan_s = real_s + self._pause_s
            self.delay(real_s, (job.name for job in closing.jobs))

    def _may_work(self, arm: str, closing: Round) -> bool:
        return arm in closing.asked & self.present and not self._writer.ledger.is_paused(arm)

    def _award(self, bidding: Bidding, allocation: dict[str, Assignment], real_s: float, time_s: float) -> None:
        self._writer.record(*(records := new_awards(self._writer.ledger, bidding, allocation, time_s)))
        for record in records:
            self._notes.pop(record.job, None)
            spec = self._writer.ledger.jobs[record.job].spec
            terms = (record.quote, spec, record.cycles, self._timing.lease_s, record.plan)
            award = Award(record.award, bidding.auction, self._name, *terms, epoch=self._writer.ledger.epoch)
            message = SendAward(record.arm, award)
            until_s = real_s + self._timing.counted_lease_s
            self._writer.leases[record.award] = CountedLease(until_s, unanswered=message, sent_s=real_s)
            self._writer.out.append(message)
