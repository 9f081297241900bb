"""What an arm has granted to its peers, and what it knows of jobs, as its journal records it."""

from dataclasses import dataclass, field
from typing import TypeVar

from fleet.bus.protocol.auction import JobSpec
from fleet.bus.protocol.consensus import Faults, JobOutcome
from fleet.bus.protocol.messages import MOST_COUNT
from fleet.bus.protocol.operator import Operation
from fleet.live.auction.control import job_of
from fleet.live.auction.job_rules import MAX_OPEN_JOBS
from fleet.live.auction.past_jobs import PastJobs
from fleet.live.consensus.operations import Operations
from fleet.live.consensus.records import (
    ClaimNumbered,
    Faulted,
    GrantRecord,
    JobGranted,
    JobReturned,
    JobSettled,
    PastKnown,
    Requested,
    RequestsKnown,
)
from fleet.live.consensus.settled_jobs import SettledJobs, is_abandoned
from fleet.live.journal import TimedState
from fleet.live.journal_records import (
    ClockTick,
    EpochBegun,
    JobsAccepted,
    Progress,
    Released,
    SpaceCleared,
    SpaceTaken,
    Started,
)
from fleet.live.space import ANYWHERE

MAX_NOTES = 4 * MAX_OPEN_JOBS
"""Jobs whose cycles, faults or returns are known; the first ones are forgotten if there are more."""
Note = TypeVar("Note")


@dataclass(eq=False)
class Grant:
    """A job that is granted to an arm."""

    arm: str
    award: str
    places: tuple[str, ...]
    may_commit: bool = False
    revoked: bool = False
    """A person has freed the space of the arm, which may begin no cycle any more."""
    until_s: float = 0.0
    """Real second at which its lease ends."""


@dataclass(eq=False)
class Register(TimedState[GrantRecord]):
    """The state that follows from the records; only `apply` changes it."""

    grants: dict[str, Grant] = field(default_factory=dict[str, Grant])
    """By job."""
    settled: SettledJobs = field(default_factory=SettledJobs)
    """By job; finished, unfinished, given up or cancelled."""
    faults: dict[str, Faults] = field(default_factory=dict[str, Faults])
    """Faults of arms, by job."""
    returned_s: dict[str, float] = field(default_factory=dict[str, float])
    """Fleet time at which an arm last returned a job, by job."""
    cycles: dict[str, int] = field(default_factory=dict[str, int])
    """Cycles known to be done, by job."""
    last_arm: dict[str, str] = field(default_factory=dict[str, str])
    """The arm that has a job, or had it last, by job."""
    numbers: dict[str, int] = field(default_factory=dict[str, int])
    """Number of the last claim, by arm."""
    jobs: dict[str, JobSpec] = field(default_factory=dict[str, JobSpec])
    """Submitted ones, by name."""
    time_s: float = 0.0
    epoch: str = ""
    """Name that all arms give to this shift; "" before they have begun."""
    space: dict[str, frozenset[str]] = field(default_factory=dict[str, frozenset[str]])
    """Names of the spaces that an arm may take, by arm."""
    operations: Operations = field(default_factory=Operations)
    """Requests of people."""
    name: str = ""
    """Of the arm; "" in a journal of an earlier version."""
    _forgotten: int = 0
    """How many of the jobs that have left are forgotten."""

    def apply(self, record: GrantRecord) -> None:
        """Apply a record that is on disk."""
        match record:
            case Started(name):
                self.name = name or self.name
            case JobGranted():
                self._count(record.job, record.cycles)
                self._number(record.arm, record.number)
                self._note_arm(record.job, record.arm)
                self.grants[record.job] = Grant(
                    record.arm, record.award, record.places, record.may_commit, record.revoked
                )
            case Released():
                self._number(record.arm, record.number)
                grant = self.grants.get(record.job)
                if grant is not None and grant.award == record.award:
                    del self.grants[record.job]
            case JobSettled(outcome):
                self._count(outcome.job, outcome.cycles)
                self.time_s = max(self.time_s, outcome.time_s)
                self._add_faults(outcome.job, outcome.faults)
                if outcome.outcome == "returned":
                    self._return(outcome.job, outcome.time_s)
                    self._note_arm(outcome.job, outcome.arm)
                elif self.is_news(outcome):
                    self.settled.put(outcome, self.jobs)
                    self.returned_s.pop(outcome.job, None)
                    if not is_abandoned(outcome):  # an arm may still be in a cycle of an abandoned job
                        self.grants.pop(outcome.job, None)
                self._forget()
            case Faulted(job, faults):
                self._add_faults(job, faults)
            case JobReturned(job, time_s, arm):
                self._return(job, time_s)
                self._note_arm(job, arm)
            case JobsAccepted(jobs):
                self.jobs |= {job.name: job for job in jobs if job.name not in self.past}
            case PastKnown(packed, left):
                self.settled.restore(packed, left)
            case ClockTick(time_s):
                self.time_s = max(self.time_s, time_s)
            case ClaimNumbered(arm, number):
                self._number(arm, number)
            case Progress(job, cycles):
                self._count(job, cycles)
            case EpochBegun(epoch):
                self.epoch = epoch
            case SpaceTaken():
                self._number(record.arm, record.number)
                self.space[record.arm] = frozenset(record.space)
            case SpaceCleared(arm):
                self.space[arm] = frozenset()
                for grant in self.grants.values():
                    grant.revoked |= grant.arm == arm
                self._drop_redone()
            case Requested(operation):
                self._operate(operation)
            case RequestsKnown(names):
                self.operations.add_names(names)

    def compact(self) -> tuple[GrantRecord, ...]:
        """Return the fewest records that give the same register."""
        records: list[GrantRecord] = [ClockTick(self.time_s), *([Started(self.name)] if self.name else [])]
        records += [PastKnown(self.past.packed(), self.settled.left)] if len(self.past) else []
        records += [EpochBegun(self.epoch)] if self.epoch else []
        records += [ClaimNumbered(arm, number) for arm, number in self.numbers.items()]
        records += [Progress(job, cycles) for job, cycles in self.cycles.items()]
        records += [JobsAccepted((job,)) for job in self.jobs.values()]
        for job, grant in self.grants.items():
            number, cycles = self.numbers.get(grant.arm, 0), self.cycles.get(job, 0)
            records.append(
                JobGranted(grant.arm, number, grant.award, job, grant.places, cycles, grant.may_commit, grant.revoked)
            )
        records += [Faulted(job, faults) for job, faults in self.faults.items() if job not in self.settled]
        records += [JobReturned(job, time_s, self.last_arm.get(job)) for job, time_s in self.returned_s.items()]
        records += [JobSettled(outcome) for outcome in self.settled.values()]
        records += [RequestsKnown(tuple(self.operations.names))] if self.operations.names else []
        records += map(Requested, self.operations.all)
        known = {arm: names for arm, names in self.space.items() if ANYWHERE not in names}
        records += [SpaceTaken(arm, tuple(sorted(names))) for arm, names in known.items()]
        return tuple(records)

    @property
    def given_up(self) -> frozenset[str]:
        """Jobs in which arms have faulted too often, and cancelled ones."""
        return frozenset(job for job, outcome in self.settled.items() if is_abandoned(outcome))

    @property
    def past(self) -> PastJobs:
        """Settled jobs that have left."""
        return self.settled.past

    @property
    def digest(self) -> int:
        """Equal for arms that know the same outcomes and requests of people."""
        return (self.operations.digest ^ self.settled.digest) % MOST_COUNT

    def is_settled(self, job: str) -> bool:
        """Return whether a job is settled."""
        return job in self.settled or job in self.past

    def is_finished(self, job: str) -> bool:
        """Return whether a job is finished."""
        return self.settled[job].outcome == "finished" if job in self.settled else self.past.is_finished(job)

    def is_news(self, outcome: JobOutcome) -> bool:
        """Return whether the outcome of a job counts more than what is known of the job."""
        redone = outcome.outcome == "unfinished" and outcome.award in self.operations.redone(outcome.job)
        return not redone and self.settled.is_news(outcome)

    def knows(self, job: str, faults: Faults) -> bool:
        """Return whether these faults in a job are known."""
        return faults.keys() <= self.faults.get(job, {}).keys()

    def _forget(self) -> None:
        """Forget what is known of jobs that have left."""
        for job in self.settled.gone[self._forgotten :]:
            for notes in (self.jobs, self.cycles, self.faults, self.returned_s, self.last_arm):
                notes.pop(job, None)
            self.operations.forget(job)
        self._forgotten = len(self.settled.gone)

    def take_gone(self) -> list[str]:
        """Return the names of jobs that have left since the last call."""
        gone, self.settled.gone, self._forgotten = self.settled.gone, [], 0
        return gone

    def _operate(self, operation: Operation) -> None:
        self.operations.add(operation)
        self.time_s = max(self.time_s, operation.time_s)
        job = job_of(operation.request)
        known, redone = self.settled.get(job), self.operations.redone(job)
        if known is not None and known.outcome == "unfinished" and known.award in redone:
            self.settled.drop(job)
        self._drop_redone()

    def _drop_redone(self) -> None:
        """Drop the grants of cleared arms for jobs whose last cycle a person has called not done."""
        for job, grant in list(self.grants.items()):
            if grant.revoked and grant.award in self.operations.redone(job):
                del self.grants[job]

    def _add_faults(self, job: str, faults: Faults) -> None:
        if faults and job not in self.past:
            self.faults[job] = self.faults.get(job, {}) | faults
            _bound(self.faults)

    def _return(self, job: str, time_s: float) -> None:
        if not self.is_settled(job):
            self.returned_s[job] = max(time_s, self.returned_s.get(job, 0.0))
            _bound(self.returned_s)

    def _count(self, job: str, cycles: int) -> None:
        if job not in self.past:
            self.cycles[job] = max(cycles, self.cycles.get(job, 0))
            _bound(self.cycles)

    def _note_arm(self, job: str, arm: str | None) -> None:
        if arm is not None and job not in self.past:
            self.last_arm[job] = arm
            _bound(self.last_arm)

    def _number(self, arm: str, number: int) -> None:
        self.numbers[arm] = max(number, self.numbers.get(arm, -1))


def _bound(notes: dict[str, Note]) -> None:
    while len(notes) > MAX_NOTES:
        del notes[next(iter(notes))]
