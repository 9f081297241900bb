"""Arm journal records, and the awards of an arm after a restart.

An accepted award ends with a report, which is repeated until the auctioneer acknowledges it. Awards that are open when
the process dies are returned at the next start: the arm is at home again, and only the cycles on disk count. If the arm
was permitted to commit, the last cycle may have been done or not, and the report says so.
"""

import logging
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from fleet.bus.protocol.auction import Award, Name, Report
from fleet.errors import printable
from fleet.live.journal import JournalState
from fleet.live.journal_records import Closed, CommitPermitted, Progress, Released, Started

_LOG = logging.getLogger(__name__)
MAX_PAST_AWARDS = 256
"""Closed awards whose answer is kept; their quotes expired long ago."""


class AwardAccepted(msgspec.Struct, frozen=True, tag="award_accepted"):
    """The arm accepted a job."""

    award: Award


class ReportReceived(msgspec.Struct, frozen=True, tag="report_received"):
    """The auctioneer has the report on its disk."""

    award: Name


class PastAward(msgspec.Struct, frozen=True, tag="past_award"):
    """An award that was accepted and closed: only its answer is kept."""

    award: Name
    job: Name


ArmRecord = Started | AwardAccepted | Progress | CommitPermitted | Closed | Released | ReportReceived | PastAward


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

    def apply(self, record: ArmRecord) -> None:
        """Change the history as the record says."""
        match record:
            case Started():
                self.boot = record.boot
            case AwardAccepted(award):
                self.active[award.award] = ActiveAward(award, award.cycles, cycles_on_disk=award.cycles)
                self.accepted[award.award] = award.job.name
            case Progress(job, cycles):
                for active in self.active.values():
                    if active.job == job:
                        active.cycles = active.cycles_on_disk = cycles
            case CommitPermitted(name):
                if name in self.active:
                    self.active[name].may_commit = True
            case Closed(name):
                if name in self.active:
                    self.reports[name] = self.active.pop(name).award, report_of(record)
            case Released(name):
                self.active.pop(name, None)
            case ReportReceived(name):
                self.reports.pop(name, None)
            case PastAward(name, job):
                self.accepted[name] = job

    def compact(self) -> tuple[ArmRecord, ...]:
        """Return the fewest records that give the same history."""
        records: list[ArmRecord] = [Started(boot=self.boot)]
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
        return ArmHistory(self.boot + 1, {}, reports, bounded(self.accepted, reports))


def put_aside(path: Path, arm: str) -> Callable[[bytes, str], None]:
    """Return what to do with a record of an arm's journal that cannot be read: append it to a file, and report it.

    An award that is put aside is not executed again. Its lease expires at the auctioneer, which awards the job anew or,
    if it had permitted the last cycle, calls it unfinished.
    """

    def put(record: bytes, reason: str) -> None:
        _LOG.error(
            "Arm '%s': put a journal record aside in '%s': %s. The record begins %s.",
            *(arm, path, reason, printable(record[:200].decode(errors="replace"))),
        )
        try:
            with path.open("ab") as file:
                file.write(record + b"\n")
        except OSError as error:
            _LOG.error("The record could not be written to '%s': %s.", path, error.strerror)

    return put


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
