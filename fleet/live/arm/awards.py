"""Awards of an arm: it accepts them, limits the work on them by leases, and reports their end; also after a restart.

An accepted award ends with a report, which is repeated until the auctioneer acknowledges it. Awards that are open when
the process dies are returned at the next start: the arm is at home again, and only the cycles on disk count. If the arm
was permitted to commit, the last cycle may have been done or not, and the report says so.

`AwardExecutor` is a state machine without a clock and without I/O: real time is an argument; records go to `keep`,
which returns once they are on disk. The rules by which no job is done twice are in `fleet.bus.protocol.auction`; those
of the arm:

- an award counts only on a quote of this start of the arm that is still valid, once per job of that quote, and the
  answer is on disk before it is sent;
- the arm begins cycles up to `allowed_cycles`: only under a valid lease, the last one only with permission to commit,
  which is on disk before; it ends what it has begun, and begins nothing of a revoked award;
- an arm that is stopped returns no award whose last cycle may have begun;
- the last jobs that it has finished, or may have done, stay in its history after the reports are acknowledged;
- the end of a job is on disk before it is reported, and the report is repeated until it is acknowledged.
"""

import logging
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import msgspec
from msgspec.structs import replace

from fleet.bus.protocol.auction import (
    MOST_JOBS,
    Ack,
    Award,
    JobSpec,
    Lease,
    LeaseEntry,
    LeaseRequest,
    Name,
    Receipt,
    Report,
)
from fleet.bus.protocol.consensus import MOST_FINISHED, History, with_finished
from fleet.errors import JournalFull
from fleet.live.clock import CLOCK_DRIFT
from fleet.live.journal import CommitPermitted, JournalState, Progress, Released, Started
from fleet.live.records import outcome_of

Value = TypeVar("Value")
MAX_PAST_AWARDS = 256
"""Closed awards whose answer is kept; their quotes expired long ago."""
MAX_UNSURE = 32
"""Jobs kept whose last cycle the arm may have done."""
REVOKED = "The award was revoked."
"""Why an award is returned that an auctioneer, or a person, has revoked."""


class AwardAccepted(msgspec.Struct, frozen=True, tag="award_accepted"):
    """The arm accepted a job."""

    award: Award


class Closed(msgspec.Struct, frozen=True, tag="closed"):
    """An award has ended, and is reported."""

    report: Report


class ReportReceived(msgspec.Struct, frozen=True, tag="report_received"):
    """The auctioneer has the report on its disk."""

    award: Name


class FaultCleared(msgspec.Struct, frozen=True, tag="fault_cleared"):
    """A person has cleared a fault of the arm."""

    by: str
    time_s: float


class PastAward(msgspec.Struct, frozen=True, tag="past_award"):
    """An award that was accepted and closed: only its answer is kept."""

    award: Name
    job: Name


class JobsFinished(msgspec.Struct, frozen=True, tag="jobs_finished"):
    """Jobs that the arm finished, or may have finished, and the last epoch that it knows."""

    jobs: tuple[JobSpec, ...]
    epoch: str = ""
    unsure: tuple[Report, ...] = ()


ArmRecord = (
    JobsFinished
    | Started
    | AwardAccepted
    | Progress
    | CommitPermitted
    | Closed
    | Released
    | ReportReceived
    | PastAward
    | FaultCleared
)


@dataclass(eq=False)
class ActiveAward:
    """An award that the arm has accepted and not closed."""

    award: Award
    cycles: int
    """Done so far, by any arm."""
    lease_end_s: float = 0.0
    """Real second at which its lease expires."""
    may_commit: bool = False
    """Whether the last cycle may begin, under a lease."""
    revoked: bool = False
    """No cycle may begin any more."""
    why: str = REVOKED
    """Why, if it is."""
    cycles_on_disk: int = 0
    lease_s: float = 0.0
    """Length of its leases, real seconds."""
    last_cycle_in_s: float = math.inf
    """Real seconds until its last cycle could begin."""
    commit_asked_s: float = -math.inf
    """Real second at which permission to commit was last requested."""

    @property
    def job(self) -> str:
        """Name of the job."""
        return self.award.job.name


@dataclass(eq=False)
class ArmHistory(JournalState[ArmRecord]):
    """Awards of an arm, as its journal records them; only `apply` changes it."""

    boot: int = 0
    """Number of the last start; 0 before the first."""
    active: dict[str, ActiveAward] = field(default_factory=dict[str, ActiveAward])
    """By award."""
    reports: dict[str, tuple[Award, Report]] = field(default_factory=dict[str, tuple[Award, Report]])
    """Not acknowledged yet, by award."""
    accepted: dict[str, str] = field(default_factory=dict[str, str])
    """Job of every accepted award, oldest first: the last `MAX_PAST_AWARDS` closed ones and all others."""
    epoch: str = ""
    """Of the last accepted award that has one."""
    finished: dict[str, JobSpec] = field(default_factory=dict[str, JobSpec])
    """The last jobs that the arm finished, oldest first."""
    unsure: dict[str, Report] = field(default_factory=dict[str, Report])
    """The last jobs whose last cycle it may have done, oldest first."""
    name: str = ""
    """Of the arm."""

    def apply(self, record: ArmRecord) -> None:
        """Change the history as the record says."""
        match record:
            case Started(name):
                self.name, self.boot = name or self.name, record.boot
            case AwardAccepted(award):
                self.active[award.award] = ActiveAward(award, award.cycles, cycles_on_disk=award.cycles)
                self.accepted[award.award] = award.job.name
                self.epoch = award.epoch or self.epoch
            case Progress(job, cycles):
                for active in self.active.values():
                    if active.job == job:
                        active.cycles = active.cycles_on_disk = cycles
            case CommitPermitted(name):
                if name in self.active:
                    self.active[name].may_commit = True
            case Closed(report):
                if report.award in self.active:
                    award = self.active.pop(report.award).award
                    self.reports[report.award] = award, report
                    if report.outcome == "finished":
                        self._finish(award.job)
                    elif report.unsure:
                        self._doubt(report)
            case Released(name):
                self.active.pop(name, None)
            case ReportReceived(name):
                self.reports.pop(name, None)
            case PastAward(name, job):
                self.accepted[name] = job
            case JobsFinished(jobs, epoch, unsure):
                self.epoch = epoch or self.epoch
                for job in jobs:
                    self._finish(job)
                for report in unsure:
                    self._doubt(report)
            case FaultCleared():
                pass

    def _doubt(self, report: Report) -> None:
        _keep_last(self.unsure, report.job, report, MAX_UNSURE)

    def _finish(self, job: JobSpec) -> None:
        self.unsure.pop(job.name, None)
        _keep_last(self.finished, job.name, job, MOST_FINISHED)

    def compact(self) -> tuple[ArmRecord, ...]:
        """Return the fewest records that give the same history, without closed awards of long ago."""
        self.accepted = bounded(self.accepted, [*self.reports, *self.active])
        records: list[ArmRecord] = [Started(self.name, boot=self.boot)]
        if self.epoch or self.finished or self.unsure:
            records.append(JobsFinished(tuple(self.finished.values()), self.epoch, tuple(self.unsure.values())))
        records += [PastAward(name, job) for name, job in self.accepted.items()]
        for award, report in self.reports.values():
            records += [AwardAccepted(award), Closed(report)]
        for name, active in self.active.items():
            records += [AwardAccepted(active.award), Progress(active.job, active.cycles)]
            records += [CommitPermitted(name)] if active.may_commit else []
        return tuple(records)

    def after_restart(self, arm: str, time_s: float) -> "ArmHistory":
        """History at the next start, with a report for every award that was open: it is returned."""
        reports = dict(self.reports)
        for name, active in self.active.items():
            reason = "the arm was restarted" + (" after it was permitted to commit" if active.may_commit else "")
            report = Report(arm, name, active.job, "returned", active.cycles, time_s, reason, restarted=True)
            reports[name] = active.award, replace(report, unsure=active.may_commit)
        accepted = bounded(self.accepted, reports)
        after = ArmHistory(
            self.boot + 1, {}, reports, accepted, self.epoch, dict(self.finished), dict(self.unsure), arm
        )
        for _, report in reports.values():
            if report.unsure:
                after._doubt(report)
        return after

    def message(self, arm: str, time_s: float = 0.0) -> History:
        """Return what the arm has done and has, as much as fits into one message.

        Args:
            time_s: Fleet time by its clock; 0 for unknown.
        """
        active = list(self.active.values())[:MOST_JOBS]
        awards = tuple(replace(each.award, cycles=each.cycles) for each in active)
        may_commit = tuple(each.award.award for each in active if each.may_commit)
        unsure = tuple(outcome_of(report, {}) for report in self.unsure.values())
        history = History(arm, self.epoch, (), awards, may_commit, committed=unsure, time_s=time_s)
        return with_finished(history, list(self.finished.values()))


def bounded(accepted: dict[str, str], needed: Iterable[str]) -> dict[str, str]:
    """Keep the awards that are needed, and the last `MAX_PAST_AWARDS` of the others."""
    keep = set(needed)
    keep.update([name for name in accepted if name not in keep][-MAX_PAST_AWARDS:])
    return {name: job for name, job in accepted.items() if name in keep}


def _keep_last(kept: dict[str, Value], name: str, value: Value, most: int) -> None:
    """Add a value as the newest one; drop the oldest one of more than `most`."""
    kept.pop(name, None)
    kept[name] = value
    if len(kept) > most:
        del kept[next(iter(kept))]


_LOG = logging.getLogger(__name__)

Phase = Literal["queued", "working", "finishing"]

RENEWALS = 3
"""Lease requests per length of a lease."""
COMMIT_RETRY_S = 0.3
"""Real seconds between two requests for permission to commit."""
REPORT_RETRY_S = (0.5, 8.0)
"""Real seconds between two sends of the same report, first and at most."""
MAX_REPORTS = 256
"""Reports not acknowledged; with more, the arm accepts no work."""


@dataclass(frozen=True, kw_only=True)
class ExecutorConfig:
    """Limits and times of an arm's work."""

    capacity: int = 1
    """Maximum concurrent jobs."""
    valid_s: float = 5.0
    """Real seconds during which it accepts an award on a quote."""
    quotes: int = 64
    """Quotes kept; an award on an older one is refused."""
    return_after_s: float = 60.0
    """Real seconds after the end of a lease at which the arm returns the job."""
    commit_lead_s: float = 1.0
    """Real seconds before the last cycle at which the arm requests permission to commit."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"ExecutorConfig.{name} must be > 0 (got {value}).")


@dataclass(eq=False)
class _Quote:
    """A quote on which an award may come."""

    made_s: float
    jobs: dict[str, tuple[JobSpec, int]]
    """Jobs that were asked for, and the number of plans that were offered for each."""
    answers: dict[str, Ack] = field(default_factory=dict[str, Ack])
    """Answer to the first award of each job."""


@dataclass(eq=False)
class _PendingReport:
    """A report that is not acknowledged."""

    auctioneer: str
    report: Report
    next_s: float
    wait_s: float = REPORT_RETRY_S[0]


class AwardExecutor:
    """The awards of one arm.

    Attributes:
        arm: Name of the arm.
        config: Limits and times of its work.
        unwritten: Records for which the disk had no space yet; while there are any, it accepts no award.
    """

    def __init__(
        self,
        arm: str,
        keep: Callable[..., None],
        history: ArmHistory,
        *,
        nonce: str,
        config: ExecutorConfig | None = None,
    ) -> None:
        """Start.

        Args:
            keep: Writes records and returns when they are on disk; if it raises JournalFull, none is. After another
                JournalError the process must end: only a restart can read what is on disk.
            history: As `ArmHistory.after_restart` returns it, and on disk.
            nonce: Different at every start, so that names of quotes stay unique even if the disk was wiped.
        """
        self.arm = arm
        self.config = config or ExecutorConfig()
        self.unwritten: list[ArmRecord] = []
        self._keep = keep
        self._quote_prefix = f"{history.boot}-{nonce}"
        self._count = 0
        self._quotes: dict[str, _Quote] = {}
        self._active: dict[str, ActiveAward] = {}
        self._accepted = dict(history.accepted)
        self._reports = {
            name: _PendingReport(award.auctioneer, report, -math.inf)
            for name, (award, report) in history.reports.items()
        }
        self._asked_s: dict[str, float] = {}

    # Quotes and awards

    @property
    def spare_capacity(self) -> int:
        """Number of further jobs it would accept now."""
        blocked = self.unwritten or len(self._reports) >= MAX_REPORTS
        return 0 if blocked else max(0, self.config.capacity - len(self._active))

    def add_quote(self, jobs: dict[str, tuple[JobSpec, int]], now_s: float) -> str:
        """Register a quote and return its name.

        Args:
            jobs: By name, each with the number of plans that are offered for it; 0 if the arm cannot do it.
        """
        self._count += 1
        name = f"{self._quote_prefix}-{self._count}"
        self._quotes[name] = _Quote(now_s, jobs)
        for old, quote in list(self._quotes.items()):
            if len(self._quotes) > self.config.quotes or now_s > quote.made_s + self.config.valid_s:
                del self._quotes[old]
        return name

    def answer_award(self, award: Award, now_s: float, unfit: str = "") -> Ack:
        """Accept or refuse an award; the same award gets the same answer again.

        Args:
            unfit: Why the arm can accept no work at all now; "" if it can.
        """
        name = award.job.name
        job = self._accepted.get(award.award)
        if job is not None:
            return self._ack(award, "" if job == name else f"this award was for the job '{job}'")
        quote = self._quotes.get(award.quote)
        if quote is None:
            return self._ack(award, f"no quote '{award.quote}' of mine is still valid")
        if name not in quote.jobs:
            return self._ack(award, f"the quote is not for a job '{name}'")
        earlier = quote.answers.get(name)
        if earlier is None:
            earlier = quote.answers[name] = self._first_answer(award, quote, now_s, unfit)
        elif earlier.award != award.award:
            return self._ack(award, f"that job was awarded on this quote by '{earlier.award}'")
        return earlier

    def _first_answer(self, award: Award, quote: _Quote, now_s: float, unfit: str) -> Ack:
        """Answer to the first award of a job on a quote."""
        lease_end_s = quote.made_s + (1 - CLOCK_DRIFT) * award.lease_s
        earlier = next((active for active in self._active.values() if active.job == award.job.name), None)
        reason = self._objection(award, quote, now_s) or unfit
        if not reason and now_s >= lease_end_s:
            reason = "its lease has expired"
        elif not reason and earlier is not None and earlier.may_commit:
            reason = "I am finishing that job already"
        elif not reason and earlier is None and len(self._reports) >= MAX_REPORTS:
            reason = f"{len(self._reports)} of my reports are not acknowledged"
        elif not reason and earlier is None and not self.spare_capacity:
            reason = f"I have {len(self._active)} job(s) and accept no more at a time"
        if reason:
            return self._ack(award, reason)
        # A new award for the job means that the earlier one has ended.
        records: list[ArmRecord] = [AwardAccepted(award)]
        if earlier is not None:
            records.insert(0, Released(earlier.award.award, earlier.job, self.arm))
        try:
            self._keep(*records)
        except JournalFull as error:
            return self._ack(award, f"my journal cannot be written: {error}")
        if earlier is not None:
            del self._active[earlier.award.award]
        self._active[award.award] = ActiveAward(
            award, award.cycles, lease_end_s, cycles_on_disk=award.cycles, lease_s=award.lease_s
        )
        self._accepted[award.award] = award.job.name
        self._accepted = bounded(self._accepted, [*self._active, *self._reports])
        self._asked_s.setdefault(award.auctioneer, quote.made_s)
        return self._ack(award)

    def _objection(self, award: Award, quote: _Quote, now_s: float) -> str:
        """Why the award itself cannot be accepted; "" if it can."""
        job, plans = quote.jobs[award.job.name]
        reports = [pending.report for pending in self._reports.values()]
        checks = (
            (self.unwritten, "my journal has no space left"),
            (job != award.job, "the job is not the one that the quote was for"),
            (not plans, "the quote says that I cannot do it"),
            (award.plan >= plans, f"the quote has {plans} plan(s) for it, and none of number {award.plan}"),
            (now_s > quote.made_s + self.config.valid_s, f"the quote was valid for {self.config.valid_s:g} s"),
            (award.cycles >= job.repetitions, f"{award.cycles} of {job.repetitions} cycles are done: none is left"),
            (any(r.job == job.name and r.outcome == "finished" for r in reports), "I have finished that job"),
        )
        return next((reason for wrong, reason in checks if wrong), "")

    def _ack(self, award: Award, reason: str = "") -> Ack:
        """Accept an award, or refuse it for a reason."""
        return Ack(arm=self.arm, award=award.award, accepted=not reason, reason=reason)

    # Work

    @property
    def active(self) -> tuple[ActiveAward, ...]:
        """All awards accepted and not closed, the current one first."""
        return tuple(self._active.values())

    @property
    def _current(self) -> ActiveAward:
        return next(iter(self._active.values()))

    def allowed_cycles(self, now_s: float) -> int:
        """Number of cycles of the current job that may be begun, including those done."""
        current = self._current
        if current.revoked or now_s >= current.lease_end_s:
            return current.cycles
        return current.award.job.repetitions - (not current.may_commit)

    def record_progress(self, cycles: int, last_cycle_in_s: float) -> None:
        """Update the current job.

        Args:
            cycles: Done, by any arm.
            last_cycle_in_s: Real seconds until its last cycle could begin.
        """
        self._current.cycles, self._current.last_cycle_in_s = cycles, last_cycle_in_s

    def finish(self, time_s: float, now_s: float) -> None:
        """Close the current job: its last cycle ended at `time_s`."""
        current = self._current
        assert current.may_commit, "the last cycle needs permission to commit"
        current.cycles = current.award.job.repetitions
        self._close(current, "finished", time_s, now_s, "")

    def return_all(self, time_s: float, now_s: float, reason: str, *, faulted: bool = False) -> None:
        """Return every active award: the arm cannot continue.

        Args:
            faulted: Whether the arm faulted in the current job.
        """
        for number, active in enumerate(self.active):
            self._close(active, "returned", time_s, now_s, reason, faulted=faulted and number == 0)

    def stop(self, time_s: float, now_s: float, reason: str) -> None:
        """Return every award without permission to commit, as the arm stops; revoke the others.

        The caller returns those whose last cycle has not begun. The next start returns the others as unsure.
        """
        for active in self.active:
            if active.may_commit:
                active.revoked, active.why = True, reason
            else:
                self._close(active, "returned", time_s, now_s, reason)

    def revoke(self, reason: str, is_stopped: Callable[[str], bool] = lambda job: True) -> None:
        """Begin no more cycles of these jobs unless their last cycle is permitted, and return them.

        Args:
            reason: For which they are returned.
            is_stopped: Whether a job is one of them; all are by default.
        """
        for active in self.active:
            if is_stopped(active.job) and not (active.may_commit or active.revoked):
                active.revoked, active.why = True, reason

    def return_ended(self, time_s: float, now_s: float, *, at_home: bool) -> None:
        """Return awards that are revoked, or without a lease for `return_after_s`; the current one from home only."""
        for active in self.active:
            unleased_s = now_s - active.lease_end_s
            expired = not active.may_commit and unleased_s > self.config.return_after_s
            if (active.revoked or expired) and (at_home or active is not self._current):
                reason = active.why if active.revoked else f"It had no lease for {unleased_s:.0f} s."
                self._close(active, "returned", time_s, now_s, reason)

    def _close(
        self,
        active: ActiveAward,
        outcome: Literal["finished", "returned"],
        time_s: float,
        now_s: float,
        reason: str,
        *,
        faulted: bool = False,
    ) -> None:
        name = active.award.award
        report = Report(self.arm, name, active.job, outcome, active.cycles, time_s, reason, faulted=faulted)
        del self._active[name]
        self._reports[name] = _PendingReport(active.award.auctioneer, report, now_s)
        self.write(Closed(report))

    # Leases

    def lease_requests(self, now_s: float) -> list[tuple[str, LeaseRequest]]:
        """Lease requests that are due now, by auctioneer; they count as sent."""
        due: list[tuple[str, LeaseRequest]] = []
        auctioneers = dict.fromkeys(active.award.auctioneer for active in self.active)
        self._asked_s = {name: asked_s for name, asked_s in self._asked_s.items() if name in auctioneers}
        for auctioneer in auctioneers:
            mine = [active for active in self.active if active.award.auctioneer == auctioneer]
            renew_s = self._asked_s.get(auctioneer, -math.inf) + min(active.lease_s for active in mine) / RENEWALS
            waiting = [active for active in mine if self._phase(active) == "finishing"]
            waiting = [active for active in waiting if not (active.may_commit or active.revoked)]
            if now_s < renew_s and all(now_s < active.commit_asked_s + COMMIT_RETRY_S for active in waiting):
                continue
            self._asked_s[auctioneer] = now_s
            for active in waiting:
                active.commit_asked_s = now_s
            due.append((auctioneer, LeaseRequest(arm=self.arm, entries=self.lease_entries(auctioneer))))
        return due

    def lease_entries(self, auctioneer: str) -> tuple[LeaseEntry, ...]:
        """Active awards of an auctioneer, as its lease request names them."""
        return tuple(self._lease_entry(active) for active in self.active if active.award.auctioneer == auctioneer)

    def apply_lease(self, lease: Lease, asked_s: float) -> None:
        """Apply the answer to a request that was made at the real second `asked_s`."""
        lease_end_s = asked_s + (1 - CLOCK_DRIFT) * lease.lease_s
        for active in self.active:
            name = active.award.award
            if active.award.auctioneer != lease.auctioneer:
                continue
            if name in lease.may_commit and not (active.may_commit or active.revoked):
                active.may_commit = self._try_to_keep(CommitPermitted(name))
            if name in lease.revoked:
                active.revoked = True
            elif name in lease.granted:
                active.lease_end_s, active.lease_s = max(active.lease_end_s, lease_end_s), lease.lease_s

    def _phase(self, active: ActiveAward) -> Phase:
        if active is not self._current:
            return "queued"
        # A job of one cycle begins only with permission to commit, however far the way to its place is.
        only_last = active.cycles >= active.award.job.repetitions - 1
        near = active.last_cycle_in_s <= self.config.commit_lead_s
        return "finishing" if active.may_commit or only_last or near else "working"

    def _lease_entry(self, active: ActiveAward) -> LeaseEntry:
        """Entry of a lease request: it names no more cycles than are on disk."""
        if active.cycles_on_disk != active.cycles and self._try_to_keep(Progress(active.job, active.cycles)):
            active.cycles_on_disk = active.cycles
        return LeaseEntry(active.award.award, active.job, active.cycles_on_disk, self._phase(active))

    # Reports

    def due_reports(self, now_s: float) -> list[tuple[str, Report]]:
        """Reports to send now, by auctioneer, each of which is on disk; they count as sent."""
        unwritten = self._unwritten_reports()
        due: list[tuple[str, Report]] = []
        for name, pending in self._reports.items():
            if pending.next_s <= now_s and name not in unwritten:
                pending.next_s = now_s + pending.wait_s
                pending.wait_s = min(2 * pending.wait_s, REPORT_RETRY_S[1])
                due.append((pending.auctioneer, pending.report))
        return due

    def pending_reports(self) -> tuple[tuple[Report, bool], ...]:
        """Every report that is not acknowledged, and whether it is on disk."""
        unwritten = self._unwritten_reports()
        return tuple((pending.report, name not in unwritten) for name, pending in self._reports.items())

    @property
    def has_pending_reports(self) -> bool:
        """Whether a report is not acknowledged."""
        return bool(self._reports)

    def apply_receipt(self, receipt: Receipt) -> None:
        """Drop the report that the auctioneer acknowledges."""
        pending = self._reports.get(receipt.award)
        if pending is not None and pending.auctioneer == receipt.auctioneer:
            del self._reports[receipt.award]
            self.write(ReportReceived(receipt.award))

    # The disk

    def _unwritten_reports(self) -> set[str]:
        return {record.report.award for record in self.unwritten if isinstance(record, Closed)}

    def write(self, record: ArmRecord) -> None:
        """Write what has already happened; without space on the disk, later."""
        self.unwritten.append(record)
        self.retry_writes()

    def retry_writes(self) -> None:
        """Write the records for which there was no space."""
        if self.unwritten and self._try_to_keep(*self.unwritten):
            self.unwritten.clear()

    def _try_to_keep(self, *records: ArmRecord) -> bool:
        """Write records; return whether they are on disk."""
        try:
            self._keep(*records)
        except JournalFull as error:
            _LOG.warning("%d record(s) of '%s' could not be written: %s", len(records), self.arm, error)
            return False
        return True
