"""Journal records of a job book, the entries that a snapshot of it holds, and operator requests by what they set."""

import math
from dataclasses import dataclass, field

import msgspec
from msgspec.structs import replace

from fleet.bus.protocol.auction import ABANDONED, Award, JobSpec, JobState, Name, Offers, Report, Result
from fleet.bus.protocol.consensus import Faults, JobOutcome
from fleet.bus.protocol.messages import Count
from fleet.bus.protocol.operator import (
    ALL_ARMS,
    Cancel,
    Change,
    Clear,
    ControlRequest,
    Operation,
    Pause,
    Resume,
    Settle,
    by_whom,
)
from fleet.live.job_rules import MAX_OPEN_JOBS, Position, changed_spec, content_hash, hash_of, urgency
from fleet.live.journal import (
    ClockTick,
    CommitPermitted,
    EpochBegun,
    JobsAccepted,
    Progress,
    Released,
    SpaceCleared,
    SpaceTaken,
    Started,
)
from fleet.live.space import ANYWHERE

MAX_REASON = 300
"""Characters of the reason why a job was returned or refused."""
MAX_REQUESTS = 1_024
"""Requests of people whose names are kept."""
MAX_SLOTS = 4 * MAX_OPEN_JOBS
"""Things that requests of people have set; the first ones are dropped if there are more."""
RANKS = ("returned", "given_up", "cancelled", "unfinished", "finished")
"""Outcomes of a job: the later ones count more."""
NO_AWARD = "?"
"""Award of an outcome that follows from none."""
FINISHED_BY = "'{}' had finished it; the journal did not know it."
"""Why a job is finished without a report."""


class HistoryAdopted(msgspec.Struct, frozen=True, tag="history_adopted"):
    """An arm has finished jobs that the journal did not know to be finished."""

    arm: str
    finished: tuple[JobSpec, ...]
    time_s: float


class Granted(msgspec.Struct, frozen=True, tag="granted"):
    """A job is granted to an arm, which may have a lease on it from now on."""

    award: Name
    job: Name
    arm: Name
    time_s: float = 0.0
    cycles: Count = 0
    """Done by other arms before."""
    places: tuple[Name, ...] = ()
    """Stations that it occupies."""
    space: Name = ANYWHERE
    """Name of the space of its plan."""
    may_commit: bool = False
    auction: str = ""
    """Round of an auctioneer, as are the next ones."""
    quote: str = ""
    plan: Count = 0
    """Number of the plan in the quote."""
    difficulty: float | None = None
    p_saturation: float | None = None
    peak_c: float | None = None
    offers: Offers = ()
    """Behind the award. The book keeps them with its last changes only."""


class ContactLost(msgspec.Struct, frozen=True, tag="contact_lost"):
    """The lease of an arm with permission to commit has ended: it is unknown whether the job is done."""

    award: Name
    time_s: float
    cycles: Count = 0
    """Last reported progress."""


class ContactRegained(msgspec.Struct, frozen=True, tag="contact_regained"):
    """The arm renews its lease again, and still has the job."""

    award: Name
    time_s: float


class JobSettled(msgspec.Struct, frozen=True, tag="job_settled"):
    """A job, or an attempt at one, has ended."""

    settled: JobOutcome
    recorded_s: float = 0.0
    """Fleet time of the record; 0 for that of the outcome."""

    @property
    def time_s(self) -> float:
        """Fleet time of the record."""
        return self.recorded_s or self.settled.time_s


class Faulted(msgspec.Struct, frozen=True, tag="faulted"):
    """Arms have faulted in a job."""

    job: Name
    faults: Faults


class ClaimNumbered(msgspec.Struct, frozen=True, tag="claim_numbered"):
    """The last claim of an arm had this number."""

    arm: Name
    number: Count


class ShiftEnded(msgspec.Struct, frozen=True, tag="shift_ended"):
    """The fleet's shift is over; open jobs stay unfinished."""

    time_s: float


class Requested(msgspec.Struct, frozen=True, tag="requested"):
    """A request of a person is carried out, here or by a peer; what changes follows from the state."""

    operation: Operation

    @property
    def time_s(self) -> float:
        """Fleet time of the request."""
        return self.operation.time_s


class Grant(msgspec.Struct):
    """A grant of a job, open or ended."""

    record: Granted
    may_commit: bool = False
    silent: bool = False
    """The arm has permission to commit, and has not renewed its lease."""
    revoked: bool = False
    """A person has freed the space of the arm, which may begin no cycle any more."""
    outcome: str = ""
    """How it ended; "" while it is open."""


class JobEntry(msgspec.Struct):
    """State of one job."""

    name: Name
    spec: JobSpec | None = None
    """As people have changed it; None while only its name is known, from a peer."""
    submitted: JobSpec | None = None
    """As it was submitted, if a person has changed it since."""
    by: str = ""
    state: JobState = "waiting"
    reason: str = ""
    award: str = ""
    """The open one, or the last one."""
    grants: dict[str, Grant] = {}
    """By award: the open one, and ended ones on which a report may still come."""
    outcome: JobOutcome | None = None
    """The one that counts most; None while the job is open, or given up because it waits for another job."""
    arm: str = ""
    """The arm that has it, or had it last."""
    cycles: Count = 0
    returns: int = 0
    """How many times an arm returned it."""
    returned_s: float = 0.0
    """Fleet time of the last return."""
    faults: dict[str, str] = {}
    """The arm of each fault in this job, by award."""
    settled_s: float | None = None
    """Fleet time at which it was finished or given up."""
    accepted_s: float | None = None
    """Fleet time at which it was accepted; None while only its name is known."""
    shift_ended: bool = False
    """It is unfinished only because the shift has ended."""

    @property
    def original(self) -> JobSpec | None:
        """The job as it was submitted."""
        return self.submitted or self.spec

    @property
    def grant(self) -> Grant | None:
        """The grant that has not ended; also one that is revoked."""
        grant = self.grants.get(self.award)
        return None if grant is None or grant.outcome else grant

    @property
    def finished_s(self) -> float | None:
        """Fleet time at which it was finished."""
        return self.settled_s if self.state == "finished" else None

    @property
    def position(self) -> Position:
        """Where its status is in the pages of a status reply."""
        if self.state == "waiting":
            order_s = 0.0 if self.spec is None else self.spec.release_s
        else:
            order_s = 0.0 if self.settled_s is None else -self.settled_s
        return Position(urgency(self.state, shift_ended=self.shift_ended), order_s, self.name)

    @property
    def is_settled(self) -> bool:
        """Whether no arm gets it: it has an outcome, or waits for a job that is given up."""
        return self.outcome is not None or self.state in ("finished", *ABANDONED)

    def count(self, cycles: int) -> None:
        """Count cycles that an arm has reported; the last one counts when the job is finished."""
        most = math.inf if self.spec is None else self.spec.repetitions - 1
        self.cycles = max(self.cycles, int(min(cycles, most)))

    def copied(self) -> "JobEntry":
        """Return a copy that shares nothing that changes."""
        grants = {award: replace(grant) for award, grant in self.grants.items()}
        return replace(self, grants=grants, faults=dict(self.faults))


class BookSnapshot(msgspec.Struct, frozen=True, tag="book_snapshot"):
    """The whole book, in place of the records before; fields as in `JobBook`."""

    time_s: float
    number: int
    ended: bool
    jobs: tuple[JobEntry, ...]
    recent: tuple[Result, ...]
    space: dict[str, tuple[str, ...]]
    past: bytes
    left: dict[JobState, int]
    epoch: str
    succeeds: bool
    numbers: dict[str, int]
    names: dict[str, int]
    """Of requests of people, as in `Operations`."""
    operations: tuple[Operation, ...]
    operated: int
    requested: tuple[Operation, ...]
    roster: tuple[str, ...] = ()


BookRecord = (
    Started
    | EpochBegun
    | ClockTick
    | BookSnapshot
    | JobsAccepted
    | HistoryAdopted
    | Granted
    | CommitPermitted
    | ContactLost
    | ContactRegained
    | Progress
    | Released
    | JobSettled
    | Faulted
    | ClaimNumbered
    | SpaceTaken
    | SpaceCleared
    | Requested
    | ShiftEnded
)


def job_of(award: str) -> str:
    """Return the job in the name of an award, ROUND:JOB or ARM-QUOTE:JOB; "" if there is none."""
    return award.partition(":")[2]


def weight_of(outcome: JobOutcome) -> tuple[int, bool, float]:
    """Return how much an outcome of a job counts: by its kind, then one of an award, then the later one."""
    return RANKS.index(outcome.outcome), outcome.award != NO_AWARD, outcome.time_s


def outcome_of(report: Report, faults: Faults) -> JobOutcome:
    """Return a report as the outcome of an attempt at a job; one that leaves the job open names the faults in it."""
    outcome = "finished" if report.outcome == "finished" else "unfinished" if report.unsure else "returned"
    named = faults if outcome == "returned" else {}
    return JobOutcome(report.job, report.award, report.arm, outcome, report.cycles, report.time_s, report.reason, named)


# Requests of people


Slot = tuple[str, str]
"""What a request sets, and of which job or arm."""


def requested_job(request: ControlRequest) -> str:
    """Return the name of the job of a request; "" if it is for arms."""
    return "" if isinstance(request.action, Pause | Resume | Clear) else request.action.job


def cancelled_by(operation: Operation) -> str:
    """Return why a job is cancelled."""
    return f"Cancelled{by_whom(operation.request.by)}."


def _slots(request: ControlRequest) -> tuple[Slot, ...]:
    match request.action:
        case Cancel(job):
            return (("cancel", job),)
        case Settle(job, outcome):
            return (("redo", job),) if outcome == "redo" else ()
        case Change(job) as change:
            return tuple((name, job) for name in ("due_s", "value") if getattr(change, name) is not msgspec.UNSET)
        case Pause(arm):
            return (("pause", arm),)
        case Resume(arm):
            return (("pause", arm), ("resume", arm)) if arm == ALL_ARMS else (("pause", arm),)
        case Clear():
            return ()


def _stamp(operation: Operation | None) -> tuple[float, str]:
    return (-math.inf, "") if operation is None else (operation.time_s, operation.request.request)


@dataclass
class Operations:
    """Requests of people that were carried out.

    For each thing that a request can set, the latest request counts: by fleet time, then by name. So arms that know the
    same requests agree, in whatever order they have received them.
    """

    latest: dict[Slot, Operation] = field(default_factory=dict[Slot, Operation])
    """The request that counts, by slot."""
    names: dict[str, int] = field(default_factory=dict[str, int])
    """Hash of the content of the last requests, by name, oldest first."""
    paused: dict[str, str] = field(default_factory=dict[str, str])
    """Who paused an arm, by arm; "*" for all arms."""
    digest: int = 0
    """Equal for arms that know the same requests."""
    last_s: float = field(default=-math.inf, compare=False)
    """Latest fleet time of all requests."""

    def is_new(self, operation: Operation) -> bool:
        """Return whether a request is unknown, or changes what counts."""
        changes = any(_stamp(operation) > _stamp(self.latest.get(slot)) for slot in _slots(operation.request))
        return changes or operation.request.request not in self.names

    def add(self, operation: Operation, *, counts: bool = True) -> None:
        """Add a request; one that does not count is only known by its name."""
        self.names[operation.request.request] = content_hash(operation.request)
        while len(self.names) > MAX_REQUESTS:
            del self.names[next(iter(self.names))]
        self.last_s = max(self.last_s, operation.time_s)
        for slot in _slots(operation.request) if counts else ():
            if _stamp(operation) > _stamp(self.latest.get(slot)):
                self._drop(slot)
                self.latest[slot] = operation
                self.digest ^= _operations_hash(slot, operation)
        while len(self.latest) > MAX_SLOTS:
            self._drop(next(iter(self.latest)))
        if isinstance(operation.request.action, Pause | Resume):
            resumed = _stamp(self.latest.get(("resume", ALL_ARMS)))
            self.paused = {
                name: each.request.by
                for (slot, name), each in self.latest.items()
                if slot == "pause" and isinstance(each.request.action, Pause) and _stamp(each) > resumed
            }

    def forget(self, job: str) -> None:
        """Drop the requests for a job that has left."""
        for slot in ("cancel", "redo", "due_s", "value"):
            self._drop((slot, job))

    @property
    def all(self) -> tuple[Operation, ...]:
        """All requests that count."""
        return tuple({operation.request.request: operation for operation in self.latest.values()}.values())

    def cancelled(self, job: str) -> Operation | None:
        """Return the latest cancellation of a job; None if there is none, or a later redo."""
        cancel = self.latest.get(("cancel", job))
        return cancel if _stamp(cancel) > _stamp(self.latest.get(("redo", job))) else None

    def redone(self, job: str) -> tuple[str, ...]:
        """Return the awards of a job whose last cycle a person has called not done."""
        operation = self.latest.get(("redo", job))
        return () if operation is None else operation.awards

    def changed(self, job: JobSpec) -> JobSpec:
        """Return a job with the due date and value that people have requested."""
        for name in ("due_s", "value"):
            operation = self.latest.get((name, job.name))
            if operation is not None and isinstance(change := operation.request.action, Change):
                try:
                    job = changed_spec(job, Change(job.name, **{name: getattr(change, name)}))
                except ValueError:
                    continue  # two changes that are possible one by one only
        return job

    def _drop(self, slot: Slot) -> None:
        if (operation := self.latest.pop(slot, None)) is not None:
            self.digest ^= _operations_hash(slot, operation)


def _operations_hash(slot: Slot, operation: Operation) -> int:
    return hash_of(repr((slot, _stamp(operation))).encode())


# Leases


@dataclass(frozen=True)
class SendAward:
    """Send this award to its arm."""

    arm: str
    award: Award


@dataclass(eq=False)
class CountedLease:
    """Lease of an open grant, as the granting side counts it."""

    until_s: float
    """Real second at which it ends."""
    cycles: int = 0
    """Last reported progress."""
    unanswered: SendAward | None = None
    """The award, until its arm answers."""
    sent_s: float = -math.inf
    attempts: int = 1
    takes_s: float = math.inf
    """Predicted fleet seconds for the job; inf for unknown."""
    progress_s: tuple[float, float] = (math.inf, math.inf)
    """Real second and fleet time since which its arm could have done a cycle, and has not reported one."""
