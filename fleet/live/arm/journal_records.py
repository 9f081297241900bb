"""Arm journal records, and the awards of an arm after a restart.

An accepted award ends with a report, which is repeated until the auctioneer acknowledges it. Awards that are open when
the process dies are returned at the next start: the arm is at home again, and only the cycles on disk count. If the arm
was permitted to commit, the last cycle may have been done or not, and the report says so.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import msgspec
from msgspec.structs import replace

from fleet.bus.protocol.auction import MOST_JOBS, Award, JobSpec, Name, Report
from fleet.bus.protocol.history import MOST_FINISHED, History
from fleet.bus.protocol.messages import encode
from fleet.live.journal import JournalState
from fleet.live.journal_records import Closed, CommitPermitted, Progress, Released, Started

MAX_BYTES = 60_000
"""Size of a history: a router may drop larger messages."""
MAX_PAST_AWARDS = 256
"""Closed awards whose answer is kept; their quotes expired long ago."""


class AwardAccepted(msgspec.Struct, frozen=True, tag="award_accepted"):
    """The arm accepted a job."""

    award: Award


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
    """Jobs that the arm finished, and the last epoch that it knows."""

    jobs: tuple[JobSpec, ...]
    epoch: str = ""


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
    name: str = ""
    """Of the arm; "" in a journal of an earlier version."""

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
            case Closed(name):
                if name in self.active:
                    report = report_of(record)
                    award = self.active.pop(name).award
                    self.reports[name] = award, report
                    if record.outcome == "finished":
                        self._finish(award.job)
            case Released(name):
                self.active.pop(name, None)
            case ReportReceived(name):
                self.reports.pop(name, None)
            case PastAward(name, job):
                self.accepted[name] = job
            case JobsFinished(jobs, epoch):
                self.epoch = epoch or self.epoch
                for job in jobs:
                    self._finish(job)
            case FaultCleared():
                pass

    def _finish(self, job: JobSpec) -> None:
        self.finished.pop(job.name, None)
        self.finished[job.name] = job
        if len(self.finished) > MOST_FINISHED:
            del self.finished[next(iter(self.finished))]

    def compact(self) -> tuple[ArmRecord, ...]:
        """Return the fewest records that give the same history, without closed awards of long ago."""
        self.accepted = bounded(self.accepted, [*self.reports, *self.active])
        records: list[ArmRecord] = [Started(self.name, boot=self.boot)]
        records += [JobsFinished(tuple(self.finished.values()), self.epoch)] if self.epoch or self.finished else []
        records += [PastAward(name, job) for name, job in self.accepted.items()]
        for award, report in self.reports.values():
            records += [AwardAccepted(award), closed(report)]
        for name, active in self.active.items():
            records += [AwardAccepted(active.award), Progress(active.job, active.cycles)]
            records += [CommitPermitted(name)] if active.may_commit else []
        return tuple(records)

    def after_restart(self, arm: str, time_s: float) -> "ArmHistory":
        """History at the next start, with a report for every award that was open: it is returned."""
        reports = dict(self.reports)
        for name, active in self.active.items():
            reason = "the arm was restarted" + (" after it was permitted to commit" if active.may_commit else "")
            report = Report(arm, name, active.job, "returned", active.cycles, time_s, reason, unsure=active.may_commit)
            reports[name] = active.award, report
        accepted = bounded(self.accepted, reports)
        return ArmHistory(self.boot + 1, {}, reports, accepted, self.epoch, dict(self.finished), arm)

    def message(self, arm: str) -> History:
        """Return what the arm has done and has, as much as fits into one message."""
        active = list(self.active.values())[:MOST_JOBS]
        awards = tuple(replace(each.award, cycles=each.cycles) for each in active)
        may_commit = tuple(each.award.award for each in active if each.may_commit)
        history = History(arm, self.epoch, (), awards, may_commit)
        size, finished = len(encode(history)), list[JobSpec]()
        for job in reversed(self.finished.values()):
            if (size := size + len(encode(job)) + 1) > MAX_BYTES:
                break
            finished.append(job)
        return replace(history, finished=tuple(reversed(finished)))


def bounded(accepted: dict[str, str], needed: Iterable[str]) -> dict[str, str]:
    """Keep the awards that are needed, and the last `MAX_PAST_AWARDS` of the others."""
    keep = set(needed)
    keep.update([name for name in accepted if name not in keep][-MAX_PAST_AWARDS:])
    return {name: job for name, job in accepted.items() if name in keep}


def closed(report: Report) -> Closed:
    """Journal record of a report."""
    return msgspec.convert(report, Closed, from_attributes=True)


def report_of(record: Closed) -> Report:
    """Report that a journal record was made of."""
    return msgspec.convert(record, Report, from_attributes=True)
