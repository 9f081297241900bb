"""Job book of a fleet: its jobs, grants, space and operator requests, as the journal of one participant records them.

An auctioneer keeps one, and so does each arm that allocates jobs with its peers. A job goes to an arm by a grant of a
quorum: the auctioneer is a quorum of one (`fleet.live.auction.auctioneer`), arms without one need a majority of the
roster (`fleet.live.consensus.grants`). The rules that make it safe (`fleet.bus.protocol.auction` and
`fleet.bus.protocol.consensus` say why):

- A record is durable before it is applied, and applied before anything is sent that relies on it.
- A job is granted to one arm at a time. From then on it counts as leased for `Timing.counted_lease_s`, with or without
  an answer; a renewal counts from the moment of the reply. Another arm gets the job only after the lease has ended here
  (`expire`), or its arm has refused, released or returned it.
- While a job is granted, no other job at one of its stations is.
- Permission to commit, that is to begin the last cycle, is durable before it is given. It stays unless the arm releases
  or returns the job; no other arm gets the job then.
- A settled job is granted to no arm, a cancelled one only to the arm that has permission to commit.
- After a crash every open grant counts as leased from the restart.
- An arm takes the space of a grant until a later quote or claim of the arm states that it does not. Of two plans that
  exclude each other one is granted. An arm without such a message may be anywhere.
- Whoever frees the space of an arm also revokes its grants; if the arm is online again, it takes its space again.

A replay gives the same book, with the same numbers on its results. The ends of leases are not recorded.

A journal can be undamaged and yet wrong: written by a version with an error or other bounds, or edited by hand. What
contradicts is quarantined with its jobs, which no arm does until a person has settled them; the rest goes on. Each line
begins with what the line before has changed (`Checked`), so a missing record is noticed, too.
"""

import logging
import math
from bisect import insort
from collections import deque
from collections.abc import Callable, Container, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from typing import NamedTuple, Self, cast
from zlib import crc32

import msgspec
from msgspec.structs import asdict, replace

from fleet.bus.protocol.auction import (
    ABANDONED,
    SETTLED,
    Admission,
    Award,
    JobSpec,
    JobState,
    JobStatus,
    Name,
    Offers,
    Report,
    Result,
)
from fleet.bus.protocol.consensus import Faults, History, JobOutcome
from fleet.bus.protocol.keys import HISTORY
from fleet.bus.protocol.messages import MOST_COUNT, Count, encode
from fleet.bus.protocol.operator import (
    ALL_ARMS,
    Cancel,
    Change,
    Controlled,
    ControlRequest,
    Operation,
    Pause,
    Resume,
    Settle,
)
from fleet.errors import JournalError, JournalFull, Refused
from fleet.job import reason_to_give_up
from fleet.live.job_rules import (
    EXPIRED,
    MAX_OPEN_JOBS,
    SHIFT_ENDED,
    PastJobs,
    admit,
    changed_spec,
    content_hash,
    hash_of,
    is_late,
    is_same_work,
    job_order,
    lost_jobs,
    ready_jobs,
    reason_for_silence,
    reason_to_follow,
    with_terms,
)
from fleet.live.journal import (
    ClockTick,
    CommitPermitted,
    EpochBegun,
    JobsAccepted,
    Progress,
    Quarantine,
    Released,
    Salvage,
    SpaceCleared,
    SpaceTaken,
    Started,
    TimedState,
)
from fleet.live.space import ANYWHERE

_LOG = logging.getLogger(__name__)

MAX_REASON = 300
"""Characters of the reason for which a job is quarantined."""
MAX_RECENT = HISTORY
"""Latest changes and requests, published again after a restart for those who missed them: as many as were cached."""
MAX_SETTLED = 2_000
"""Finished and given-up jobs whose status is kept; older ones leave the book, and only `PastJobs` knows them."""
MAX_UNKNOWN = 4 * MAX_OPEN_JOBS
"""Jobs of which only the name is known, from peers; the first ones leave if there are more."""
MAX_REQUESTS = 1_024
"""Requests of people whose names are kept."""
MAX_SLOTS = 4 * MAX_OPEN_JOBS
"""Things that requests of people have set; the first ones are dropped if there are more."""
MAX_AWARDS = 16
"""Ended awards of one job on which a report is still expected, and those that were redone, in one request."""
NUMBERS_SKIPPED = 1_000
"""Numbers of results and requests left out after a journal that was wrong, so that none is used twice."""
ALREADY_DONE = "This request was carried out before."
NO_CHANGE = "Nothing changed: it is so already."
NO_AWARD = "?"
"""Award of an outcome that follows from none."""
RANKS = ("returned", "given_up", "cancelled", "unfinished", "finished")
"""Outcomes of a job: the later ones count more."""


# Records


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


class Checked(msgspec.Struct, frozen=True, tag="checked"):
    """What the records since the last one of these have changed, so that a wrong or missing one is noticed."""

    number: int
    """Counts them, from 1."""
    changes: int
    """Number of the next change."""
    operated: int
    """Number of the next request of a person."""
    jobs: dict[str, int]
    """Checksum of the state of each job that has changed."""
    time_s: float
    paused: dict[str, str] = {}


class JobsQuarantined(msgspec.Struct, frozen=True, tag="jobs_quarantined"):
    """Jobs whose records cannot be read, with the reason."""

    jobs: dict[str, str]
    time_s: float = 0.0


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
    aside: str = ""
    """Why it is quarantined; "" if it is not. It stays unfinished until an arm reports it finished, or a person settles
    it."""

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
    aside: dict[str, str]
    checks: int
    names: dict[str, int]
    """Of requests of people, as in `Operations`."""
    operations: tuple[Operation, ...]
    operated: int
    requested: tuple[Operation, ...]


BookRecord = (
    Started
    | EpochBegun
    | ClockTick
    | Checked
    | BookSnapshot
    | JobsAccepted
    | JobsQuarantined
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


# Requests of people


Slot = tuple[str, str]
"""What a request sets, and of which job or arm."""


def requested_job(request: ControlRequest) -> str:
    """Return the name of the job of a request; "" if it is for arms."""
    return "" if isinstance(request.action, Pause | Resume) else request.action.job


def cancelled_by(operation: Operation) -> str:
    """Return why a job is cancelled."""
    return f"Cancelled by '{operation.request.by}'."


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

    def add(self, operation: Operation) -> None:
        """Add a request."""
        self.names[operation.request.request] = content_hash(operation.request)
        while len(self.names) > MAX_REQUESTS:
            del self.names[next(iter(self.names))]
        self.last_s = max(self.last_s, operation.time_s)
        for slot in _slots(operation.request):
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


# The book


def reason_of_aside(reason: str) -> str:
    """Return why a job is unfinished that is quarantined."""
    return f"Quarantined, because the journal is wrong about it: {reason}. Settle it as done or redo."


def outcome_of(report: Report, faults: Faults) -> JobOutcome:
    """Return a report as the outcome of an attempt at a job; one that leaves the job open names the faults in it."""
    outcome = "finished" if report.outcome == "finished" else "unfinished" if report.unsure else "returned"
    named = faults if outcome == "returned" else {}
    return JobOutcome(report.job, report.award, report.arm, outcome, report.cycles, report.time_s, report.reason, named)


def weight_of(outcome: JobOutcome) -> tuple[int, float]:
    """Return how much an outcome of a job counts: by its kind, then the later one."""
    return RANKS.index(outcome.outcome), outcome.time_s


def _outcome_hash(outcome: JobOutcome | None) -> int:
    return 0 if outcome is None else hash_of(repr((outcome.job, outcome.outcome, outcome.time_s)).encode())


@dataclass
class JobBook(TimedState[BookRecord]):
    """Jobs and grants; only `apply` changes them, and `record` writes a record before."""

    places: frozenset[str] | None = None
    """Places of the cell; None allows any name."""
    arms: tuple[str, ...] = ()
    """Arms of the cell: each may be anywhere until it says where it is."""
    name: str = field(default="", compare=False)
    """Of the participant that keeps it."""
    is_central: bool = True
    """An auctioneer keeps it: no job is granted or settled that was not accepted here. False at an arm, whose peers may
    know more."""
    jobs: dict[str, JobEntry] = field(default_factory=dict[str, JobEntry])
    """By name, in the order of submission."""
    waiting: dict[str, JobEntry] = field(default_factory=dict[str, JobEntry])
    """Those that wait, and whose description is known."""
    settled: list[tuple[float, str]] = field(default_factory=list[tuple[float, str]])
    """Time and name of those that are finished or given up, oldest first."""
    open: dict[str, Grant] = field(default_factory=dict[str, Grant])
    """Grants that have not ended, without revoked ones, by award."""
    leases: dict[str, CountedLease] = field(default_factory=dict[str, CountedLease], repr=False, compare=False)
    """Of the open grants, once the book is attached to its journal."""
    past: PastJobs = field(default_factory=PastJobs)
    """Jobs that have left."""
    left: dict[JobState, int] = field(default_factory=dict[JobState, int])
    """How many have left, by state."""
    epoch: str = ""
    """Of the journal; another one begins when the journal is lost. "" before the first start."""
    succeeds: bool = False
    """A person has requested that the epoch takes the place of another one."""
    time_s: float = 0.0
    """Latest time of all records."""
    number: int = 0
    """Of the next change."""
    ended: bool = False
    recent: deque[Result] = field(default_factory=lambda: deque(maxlen=MAX_RECENT))
    operations: Operations = field(default_factory=Operations)
    operated: int = 0
    """Number of the next request of a person."""
    requested: deque[Operation] = field(default_factory=lambda: deque(maxlen=MAX_RECENT))
    """The latest ones that were carried out."""
    space: dict[str, frozenset[str]] = field(default_factory=dict[str, frozenset[str]])
    """Names of the spaces that an arm may take besides those of its open grants, by arm: ended grants leave theirs here
    until the arm states which space it takes."""
    numbers: dict[str, int] = field(default_factory=dict[str, int])
    """Number of the last claim, by arm."""
    aside: dict[str, str] = field(default_factory=dict[str, str])
    """Why jobs are quarantined of which only the name is known, by name."""
    checks: int = 0
    """Number of the last `Checked` record."""
    unchecked: set[str] = field(default_factory=set[str], repr=False, compare=False)
    """Names of the jobs that have changed since."""
    _unnoted: bool = field(default=False, repr=False, compare=False)
    """Something has changed since the last `Checked`."""
    _awaited: dict[str, dict[str, None]] = field(default_factory=dict[str, dict[str, None]], repr=False, compare=False)
    """Names of the jobs that wait for each job, settled ones included, in the order of their submission."""
    _unknown: dict[str, None] = field(default_factory=dict[str, None], repr=False, compare=False)
    """Names of the jobs without a description."""
    _in_order: list[str] | None = field(default=None, repr=False, compare=False)
    _outcomes: int = field(default=0, repr=False, compare=False)
    """Checksum of the outcomes."""
    _keep: Callable[..., object] = field(default=lambda *_: None, repr=False, compare=False)
    _announce: Callable[[Result | Operation], object] = field(default=lambda _: None, repr=False, compare=False)

    def __post_init__(self) -> None:
        self.space |= {arm: frozenset([ANYWHERE]) for arm in self.arms}

    # Journal

    def attach(
        self,
        keep: Callable[..., object],
        counted_until_s: float,
        announce: Callable[[Result | Operation], object] = lambda _: None,
    ) -> None:
        """Write further records to a journal.

        Args:
            keep: Writes records; returns when they are durable, or raises `JournalError` and has written none.
            counted_until_s: Real second until which the open grants count as leased.
            announce: Gets each change of a job, and each operator request.
        """
        self._keep, self._announce = keep, announce
        self.leases = {award: CountedLease(counted_until_s) for award in self.open}

    def record(self, *records: BookRecord) -> None:
        """Write records, then apply them.

        Raises:
            JournalError: nothing was written, and nothing has changed.
        """
        if not records:
            return
        records = (*self.checks_due(), *records)
        self._keep(*records)
        for record in records:
            for change in self.apply(record):
                self._announce(change)
            if isinstance(record, Requested):
                self._announce(self.requested[-1])
        for award in self.leases.keys() - self.open.keys():
            del self.leases[award]

    def try_to_record(self, failure: str, *records: BookRecord) -> bool:
        """Record; return whether that is durable, and log the failure if not."""
        try:
            self.record(*records)
        except JournalFull as error:
            _LOG.error("%s: %s", failure, error)
            return False
        return True

    def replay(self, records: Iterable[BookRecord], quarantine: Quarantine | None = None) -> Self:
        """Apply records, oldest first, and return the book.

        Records that contradict those before are not applied, and their jobs are quarantined.

        Args:
            quarantine: Gets each of these records, with the reason; None: it is logged.
        """
        before, doubts = set(self._aside_jobs()), 0
        for record in records:
            if (found := doubt(self, record)) is None:
                self.apply(record)
                continue
            doubts += 1
            _LOG.error("A record of the journal is wrong, %s: %s", found.reason, record)
            if quarantine is not None:
                quarantine(encode(record), found.reason)
            self._quarantine(dict.fromkeys(found.jobs, found.reason))
            if isinstance(record, Checked):
                self._apply_check(record)
        aside = [name for name in self._aside_jobs() if name not in before]
        if doubts or aside:  # the numbers of the last changes are uncertain
            self.recent.clear()
            self.requested.clear()
            self.number, self.operated = self.number + NUMBERS_SKIPPED, self.operated + NUMBERS_SKIPPED
        for name in aside:
            self._change(self.status((name,))[0], self.time_s, self.jobs.get(name))
        return self

    def compact(self) -> tuple[BookSnapshot, Started]:
        """Return the records that give the same book."""
        snapshot = BookSnapshot(
            time_s=self.time_s,
            number=self.number,
            ended=self.ended,
            jobs=tuple(entry.copied() for entry in self.jobs.values()),
            recent=tuple(self.recent),
            space={arm: tuple(sorted(spaces)) for arm, spaces in self.space.items()},
            past=self.past.packed(),
            left=dict(self.left),
            epoch=self.epoch,
            succeeds=self.succeeds,
            numbers=dict(self.numbers),
            aside=dict(self.aside),
            checks=self.checks,
            names=dict(self.operations.names),
            operations=self.operations.all,
            operated=self.operated,
            requested=tuple(self.requested),
        )
        return snapshot, Started(self.name, self.time_s)

    def checks_due(self) -> tuple[Checked, ...]:
        """Return what to write before the next records, so that a replay notices if those before are wrong."""
        if not self._unnoted:
            return ()
        jobs = {name: digest(self, name) for name in sorted(self.unchecked) if name in self.jobs}
        paused = dict(self.operations.paused)
        return (Checked(self.checks + 1, self.number, self.operated, jobs, self.time_s, paused),)

    # Questions

    @property
    def digest(self) -> int:
        """Equal for arms that know the same outcomes and operator requests."""
        return (self.operations.digest ^ self._outcomes) % MOST_COUNT

    @property
    def in_order(self) -> list[str]:
        """Names of the jobs with a description, by release and name."""
        if self._in_order is None:
            specs = (entry.spec for entry in self.jobs.values() if entry.spec is not None)
            self._in_order = [job.name for job in sorted(specs, key=job_order)]
        return self._in_order

    def admit(self, jobs: Sequence[JobSpec], later: Mapping[str, JobSpec] | None = None) -> tuple[Admission, ...]:
        """Return which submitted jobs can be accepted; changes nothing.

        Args:
            later: Jobs that will be accepted, by name.
        """
        named = [name for job in jobs for name in (job.name, *job.after)]
        entries = {name: self.jobs[name] for name in named if name in self.jobs}
        known = {name: job for name, entry in entries.items() if (job := entry.original) is not None}
        given_up = {name for name, entry in entries.items() if entry.state in ABANDONED}
        given_up |= {name for job in jobs for name in job.after if self.past.is_given_up(name)}
        return admit(
            jobs,
            {**(later or {}), **known},
            places=self.places,
            count=len(self.jobs) - len(self.settled),
            ended=self.ended,
            given_up=given_up,
            past=self.past,
            aside=self.aside,
        )

    def ready(self, time_s: float, limit: int, *, excluded: Container[str] = ()) -> list[JobSpec]:
        """Return the jobs that wait for an arm, as `ready_jobs` does."""
        if self.ended:
            return []
        waiting = [entry for name, entry in self.waiting.items() if name not in excluded]
        returned_s = {entry.name: entry.returned_s for entry in waiting if entry.returns}
        specs = (entry.spec for entry in waiting if entry.spec is not None)
        return ready_jobs(specs, time_s, limit, self.busy_stations(), self.is_finished, returned_s)

    def is_finished(self, name: str) -> bool:
        """Return whether a job is finished.

        One that has left is, unless it was given up; at an auctioneer also if its name is not known any more: followers
        of a job that is given up do not wait.
        """
        entry = self.jobs.get(name)
        if entry is not None:
            return entry.state == "finished"
        if not self.is_central:
            return self.past.is_finished(name)
        return name not in self.aside and not self.past.is_given_up(name)

    def is_settled(self, name: str) -> bool:
        """Return whether no arm gets a job any more."""
        return name in self.past or (name in self.jobs and self.jobs[name].is_settled)

    def expired(self, time_s: float) -> list[JobSettled]:
        """Return the outcomes of the waiting jobs whose hard due date has passed."""
        records: list[JobSettled] = []
        for entry in () if self.ended else self.waiting.values():
            if (job := entry.spec) is not None and job.due_s is not None and is_late(job, time_s):
                outcome = JobOutcome(
                    job.name, NO_AWARD, self.name or NO_AWARD, "given_up", entry.cycles, job.due_s, EXPIRED
                )
                records.append(JobSettled(outcome, time_s))
        return records

    def is_paused(self, arm: str) -> bool:
        """Return whether an arm gets no jobs."""
        return arm in self.operations.paused or ALL_ARMS in self.operations.paused

    def at_work(self) -> Mapping[str, tuple[str, bool]]:
        """Return the arm with an open grant of a job, and whether it has permission to commit, by job."""
        return {grant.record.job: (grant.record.arm, grant.may_commit) for grant in self.open.values()}

    def may_begin(self, award: str) -> bool:
        """Return whether cycles of an open grant may be begun under a lease."""
        grant = self.open[award]
        stopped = self.ended or self.operations.cancelled(grant.record.job) or self.is_paused(grant.record.arm)
        return grant.may_commit or not stopped

    def busy_stations(self) -> frozenset[str]:
        """Return the stations at which an arm may be at work; a silent arm does not block its station."""
        return frozenset(place for grant in self.open.values() if not grant.silent for place in grant.record.places)

    def taken_space(self) -> Mapping[str, frozenset[str]]:
        """Return the names of the spaces that each arm may take."""
        taken = dict(self.space)
        for grant in self.open.values():
            arm = grant.record.arm
            taken[arm] = taken.get(arm, frozenset()) | {grant.record.space}
        return taken

    def space_of(self, awards: Iterable[str], arm: str) -> set[str]:
        """Return the names of the spaces of an arm's awards; unknown awards have none."""
        grants = (self.grant_of(award) for award in awards)
        return {grant.record.space for grant in grants if grant is not None and grant.record.arm == arm}

    def closed_space(self) -> Mapping[str, frozenset[str]]:
        """Return the names of the spaces that each arm may take for ended grants alone."""
        still_open: dict[str, set[str]] = {}
        for grant in self.open.values():
            still_open.setdefault(grant.record.arm, set()).add(grant.record.space)
        return {arm: names - still_open.get(arm, set()) for arm, names in self.space.items()}

    def retaken_space(self, arm: str, space: Set[str]) -> list[SpaceTaken]:
        """Return what changes when an arm takes this space; it counts as free after a person has freed it.

        Args:
            space: Names of spaces that the arm takes, or for which it has an award.
        """
        taken = self.taken_space().get(arm, frozenset())
        if ANYWHERE in taken or space <= taken:
            return []
        return [SpaceTaken(arm, tuple(sorted(self.space.get(arm, frozenset()) | space)), self.time_s)]

    def grant_of(self, award: str, job: str = "") -> Grant | None:
        """Return a grant by its award, also one that has ended; None if it is not kept.

        Args:
            job: Its job, if that is known.
        """
        entries = (self.jobs[name] for name in (job, job_of(award)) if name in self.jobs)
        return self.open.get(award) or next((e.grants[award] for e in entries if award in e.grants), None)

    def grants_of(self, arm: str) -> list[Grant]:
        """Return the grants of an arm that have not ended, also revoked ones."""
        grants = (entry.grant for entry in self.jobs.values())
        return [grant for grant in grants if grant is not None and grant.record.arm == arm]

    def unsettled(self) -> list[str]:
        """Return the names of jobs that still need an arm or a report."""
        return [name for name, entry in self.jobs.items() if entry.state not in SETTLED]

    def status(self, names: Iterable[str] = ()) -> list[JobStatus]:
        """Return the status of these jobs, without unknown ones; of all jobs if none is named."""
        wanted = dict.fromkeys(names) or [*self.in_order, *self._unknown, *self.aside]
        return [
            self.status_of(self.jobs[name])
            if name in self.jobs
            else JobStatus(name, "unfinished", reason=reason_of_aside(self.aside[name]))
            for name in wanted
            if name in self.aside or (name in self.jobs and (name not in self._unknown or self.jobs[name].is_settled))
        ]

    def status_of(self, entry: JobEntry) -> JobStatus:
        """Return the status of a job."""
        has = entry.grant is not None and not entry.grant.revoked and entry.state != "waiting"
        award = entry.award if (has or entry.state == "finished") and entry.award != NO_AWARD else ""
        done = (entry.cycles, entry.finished_s, entry.reason)
        return with_terms(JobStatus(entry.name, entry.state, entry.arm, award, *done), entry.spec)

    # Leases

    def expire(self, real_s: float, time_s: float) -> bool:
        """Record the ends of leases; return whether a job goes back. One in its last cycle stays with its arm."""
        back = False
        for award, lease in [(award, lease) for award, lease in self.leases.items() if real_s >= lease.until_s]:
            grant = self.open[award]
            job, arm = grant.record.job, grant.record.arm
            vain = f"'{job}' is not taken back from '{arm}'"
            if not grant.may_commit:
                missing = "renew its lease" if lease.unanswered is None else "answer the award"
                reason = f"'{arm}' did not {missing}."
                if not self.try_to_record(vain, Released(award, job, arm, "dropped", lease.cycles, time_s, reason)):
                    return back
                back = True
            elif not (grant.silent or self.ended) and not self.try_to_record(
                vain, ContactLost(award, time_s, lease.cycles)
            ):
                return back
        return back

    def progress(self, jobs: Container[str]) -> list[Progress]:
        """Return the reported cycles of jobs that are about to change, as far as they are not recorded."""
        leases = ((self.open[award].record.job, lease.cycles) for award, lease in self.leases.items())
        return [Progress(job, cycles) for job, cycles in leases if job in jobs and cycles > self.jobs[job].cycles]

    def clear(self, arm: str, by: str, present: Set[str], lease_s: float, time_s: float) -> bool:
        """Free the space of an absent arm and revoke its grants: a person has seen that it is at home, or removed.

        It is unknown whether its last cycle was done; if the arm is online again, it reports that. Return whether
        anything changes.

        Raises:
            Refused: the arm is unknown, or present, or may have a lease.
            JournalError: it is not durable, and nothing has changed.
        """
        taken, grants = self.taken_space(), [grant for grant in self.open.values() if grant.record.arm == arm]
        if arm in present:
            raise Refused(f"'{arm}' is present and says itself which space it takes. Stop it first, or move it home.")
        if arm not in self.space and not grants:
            arms = ", ".join(sorted(name for name, spaces in taken.items() if spaces))
            raise Refused(f"'{arm}' takes no space. Arms that do: {arms or 'none'}.")
        if not all(grant.silent for grant in grants):
            raise Refused(f"The lease of '{arm}' has not ended; try again in {lease_s:g} s.")
        if taken.get(arm):
            self.record(*self.progress([grant.record.job for grant in grants]), SpaceCleared(arm, by, time_s))
        return bool(taken.get(arm))

    # Requests of people

    def carry_out(self, request: ControlRequest, arms: Set[str], time_s: float) -> tuple[Operation | None, str]:
        """Carry out a request of a person, once; it is durable when this returns.

        Args:
            arms: Those that are present, and those of the cell.

        Returns:
            The operation, None if it was carried out before; and why nothing changes, "" if something does.

        Raises:
            Refused: it is not possible now.
        """
        if (known := self.operations.names.get(request.request)) is not None:
            if known != content_hash(request):
                raise Refused(
                    f"Another request of the name '{request.request}' was carried out before, so this one is not "
                    f"({request.action}). Give each request a name of its own, for example a UUID."
                )
            return None, ALREADY_DONE
        note = self.objection(request, arms)
        operation = self.operation(request, time_s)
        self.record(*self.progress([requested_job(request)]), Requested(operation))
        _LOG.warning("'%s' requested: %s", request.by, request.action)
        return operation, note

    def operation(self, request: ControlRequest, time_s: float) -> Operation:
        """Return a request as this participant carries it out, later than all others."""
        time_s = max(time_s, math.nextafter(self.operations.last_s, math.inf))
        awards: tuple[str, ...] = ()
        match request.action:
            case Settle(job, "redo") if (entry := self.jobs.get(job)) is not None:
                last = (entry.award,) if entry.state == "unfinished" and entry.award not in ("", NO_AWARD) else ()
                awards = (*self.operations.redone(job), *last)[-MAX_AWARDS:]
            case _:
                pass
        epoch = self.epoch if self.is_central else ""
        return Operation(self.name, time_s, request, epoch=epoch, awards=awards)

    def objection(self, request: ControlRequest, arms: Set[str]) -> str:
        """Return why a request changes nothing; "" if it changes something.

        Raises:
            Refused: it is not possible now.
        """
        paused = self.operations.paused
        match request.action:
            case Pause(arm):
                self._check_arm(arm, arms)
                return NO_CHANGE if arm in paused else ""
            case Resume(arm):
                self._check_arm(arm, arms)
                if arm != ALL_ARMS and ALL_ARMS in paused:
                    raise Refused("All arms are paused. Resume all; then pause those that must stay paused.")
                return "" if (paused if arm == ALL_ARMS else arm in paused) else NO_CHANGE
            case Cancel() | Settle() | Change() as action:
                return self._objection_to_job(action)

    def _check_arm(self, arm: str, arms: Set[str]) -> None:
        if arm != ALL_ARMS and not any(arm in names for names in (arms, self.space, self.operations.paused)):
            raise Refused(f"There is no arm '{arm}'. Arms: {', '.join(sorted(arms)) or 'none'}; '*' for all.")

    def _objection_to_job(self, action: Cancel | Settle | Change) -> str:
        entry = self.jobs.get(action.job)
        if entry is None or (entry.spec is None and not entry.is_settled):
            if action.job in self.past:
                return "It was settled long ago."
            if action.job in self.aside:
                if isinstance(action, Settle):
                    return ""
                raise Refused(f"'{action.job}' is quarantined, and its description is lost: settle it as done or redo.")
            raise Refused(f"There is no job '{action.job}'.")
        state = entry.state
        match action:
            case Cancel():
                if state == "unfinished":
                    raise Refused(f"'{action.job}' is unfinished: settle it as done, or redo it and then cancel it.")
                return f"It is {state}." if state == "finished" or self.operations.cancelled(action.job) else ""
            case Settle(_, outcome):
                if state != "unfinished":
                    if state in ("finished", "waiting") and (state == "finished") == (outcome == "done"):
                        return NO_CHANGE
                    raise Refused(f"'{action.job}' is {state}; only an unfinished job can be settled.")
                if outcome == "redo" and self.ended:
                    raise Refused("The shift is over: nothing is redone.")
                if outcome == "redo" and action.job in (at_work := self.at_work()):
                    arm = at_work[action.job][0]
                    raise Refused(
                        f"'{arm}' may still do the last cycle of '{action.job}'. Stop it and free its space "
                        f"(jobs/clear, or thermofleet arm clear {arm}) first."
                    )
                return ""
            case Change():
                if state in SETTLED or entry.spec is None:
                    raise Refused(f"'{action.job}' is {state}; only a job that is not settled can be changed.")
                try:
                    changed = changed_spec(entry.spec, action)
                except ValueError as error:
                    raise Refused(str(error)) from error
                return NO_CHANGE if changed == entry.spec else ""

    def controlled(self, request: ControlRequest, note: str, job: JobStatus | None) -> Controlled:
        """Return the reply to a request that was carried out.

        Args:
            note: Why it changed nothing; "" if it did.
            job: Status of its job.
        """
        step, paused = note or self.next_step(request), dict(self.operations.paused)
        return Controlled(self.name, request.request, not note, step, job, paused)

    def next_step(self, request: ControlRequest) -> str:
        """Return what happens next; "" if nothing does."""
        match request.action:
            case Pause(arm):
                jobs = [job for job, (has, _) in self.at_work().items() if arm in (ALL_ARMS, has)]
                return f"{len(jobs)} job(s) end or go back after the cycle in progress." if jobs else ""
            case Cancel(job) if job in (at_work := self.at_work()):
                if at_work[job][1]:
                    return "It is in its last cycle: it is cancelled only if the arm returns it."
                return "The arm ends the cycle in progress and returns it."
            case _:
                return ""

    # Histories of arms

    def adopted(self, history: History) -> list[BookRecord]:
        """Return what this participant takes over from an arm: jobs that it finished, and jobs that it or others have.

        An arm leases its awards at the auctioneer that gave them; arms without one name those to whom they have given
        permission to commit.
        """
        records: list[BookRecord] = []
        if history.epoch and not self.epoch:
            records.append(EpochBegun(history.epoch))

        def is_open(job: JobSpec) -> bool:
            if (entry := self.jobs.get(job.name)) is None:
                return job.name not in self.past and job.name not in self.aside
            return entry.state == "waiting" and (entry.spec is None or is_same_work(entry.spec, job))

        unknown = tuple(job for job in history.finished if is_open(job))
        if unknown:
            records.append(HistoryAdopted(history.arm, unknown, self.time_s))
        done = {job.name for job in unknown}
        for award in history.awards:
            if award.auctioneer != self.name or award.job.name in done or not is_open(award.job):
                continue
            if self.grant_of(award.award) is None:
                records.append(JobsAccepted((award.job,), f"adopted from {history.arm}", self.time_s))
                records.append(_adopted_award(award, history, self.time_s))
        for outcome in history.committed:
            entry = self.jobs.get(outcome.job)
            if self.is_settled(outcome.job) or (entry is not None and entry.grant is not None):
                continue
            if outcome.arm == self.name:  # it may have done the last cycle, and does not know
                records.append(JobSettled(outcome))
            else:
                terms = (outcome.award, outcome.job, outcome.arm, self.time_s, outcome.cycles, (outcome.job,))
                records.append(Granted(*terms, may_commit=True))
                records.append(ClaimNumbered(outcome.arm, history.claims.get(outcome.arm, 0)))
        return records

    # Changes

    def apply(self, record: BookRecord) -> list[Result]:
        """Apply a record that is durable, and return the changes of job states."""
        time_s = getattr(record, "time_s", self.time_s)
        self.time_s = max(self.time_s, time_s)
        by, changed = self._apply(record)
        self.unchecked.update(entry.name for entry in changed)
        self._unnoted |= bool(changed) or isinstance(record, Requested | ShiftEnded)
        offers = record.offers if isinstance(record, Granted) else ()
        changes = [self._change(self.status_of(entry), time_s, entry, by, offers) for entry in changed]
        while len(self.settled) > MAX_SETTLED:
            self._leave(self.settled[0][1])
        return changes

    def _apply(self, record: BookRecord) -> tuple[str, list[JobEntry]]:
        """Apply a record; return the person who requested it, "" for none, and the jobs whose state has changed."""
        by, changed = "", list[JobEntry]()
        match record:
            case JobsAccepted():
                by, changed = record.by, self._accept(record)
            case Granted():
                changed = self._grant(record)
            case CommitPermitted() | ContactLost() | ContactRegained():
                if (grant := self.open.get(record.award)) is not None:
                    entry = self.jobs[grant.record.job]
                    if not isinstance(record, ContactRegained):
                        entry.count(record.cycles)
                    grant.may_commit, grant.silent = True, isinstance(record, ContactLost)
                    silence = reason_for_silence(grant.record.arm) if grant.silent else ""
                    self._move(entry, "unfinished" if grant.silent else "finishing", silence)
                    changed = [entry]
            case Progress(job, cycles):
                if (entry := self._entry(job)) is not None:
                    entry.count(cycles)
            case Released():
                by = "" if record.outcome == "refused" else self._pauser(record.job, record.award)
                changed = self._release(record, by)
            case JobSettled(outcome):
                if outcome.outcome == "returned" and not outcome.faults:
                    by = self._pauser(outcome.job, outcome.award)
                changed = self._settle(outcome, by)
            case Faulted(job, faults):
                if (entry := self._entry(job)) is not None:
                    entry.faults |= faults
                    changed = self._give_up(entry)
            case HistoryAdopted():
                changed = self._adopt(record)
            case Requested(operation):
                number = self.operated if self.is_central else 0
                self.requested.append(replace(operation, number=number))
                self.operated += 1
                by, changed = operation.request.by, self._operate(operation)
            case ShiftEnded():
                self.ended = True
                changed = [self.jobs[name] for name in self.unsettled()]
                for entry in changed:
                    self._move(entry, "unfinished", entry.reason or SHIFT_ENDED)
            case SpaceTaken():
                self.space[record.arm] = frozenset(record.space)
            case SpaceCleared(arm):
                changed = self._clear(arm)
            case EpochBegun():
                self.epoch, self.succeeds = record.epoch, record.succeeds
            case ClaimNumbered(arm, number):
                self.numbers[arm] = max(number, self.numbers.get(arm, -1))
            case JobsQuarantined():
                self._quarantine(record.jobs)
            case Checked():
                self._apply_check(record)
            case BookSnapshot():
                self._restore(record)
            case Started(name):
                self.name = name or self.name
            case ClockTick():
                pass
        return by, changed

    def _entry(self, name: str) -> JobEntry | None:
        """Return the entry of a job, a new one for an unknown name; None if it has left, or its description is lost."""
        if (entry := self.jobs.get(name)) is None and name not in self.past and name not in self.aside:
            entry = self.jobs[name] = JobEntry(name)
            self._unknown[name] = None
            if len(self._unknown) > MAX_UNKNOWN:
                self._leave(next((each for each in self._unknown if self.jobs[each].grant is None), name))
        return entry

    def _accept(self, record: JobsAccepted) -> list[JobEntry]:
        new: list[JobEntry] = []
        for job in record.jobs:
            known = job.name in self.jobs and self.jobs[job.name].spec is not None
            if known or (entry := self._entry(job.name)) is None:
                continue
            del self._unknown[job.name]
            entry.spec, entry.by, self._in_order = self.operations.changed(job), record.by, None
            entry.submitted = job if entry.spec != job else None
            if entry.state == "waiting":
                self._move(entry, "waiting", entry.reason)
            new.append(entry)
        self._note_followers(new)
        if any(entry.spec.after for entry in new if entry.spec is not None):
            self._apply_given_up()
        for entry in new:
            self._give_up(entry)
        return new

    def _grant(self, record: Granted) -> list[JobEntry]:
        if (entry := self._entry(record.job)) is None:
            return []
        if (before := entry.grant) is not None:
            self._end(before, "dropped")
        counts = {award: grant for award, grant in entry.grants.items() if grant.outcome != "refused"}
        old = [award for award, grant in counts.items() if grant.outcome and not grant.may_commit][:-MAX_AWARDS]
        grant = Grant(replace(record, offers=()), record.may_commit)
        entry.grants = {award: each for award, each in counts.items() if award not in old} | {record.award: grant}
        self.open[record.award], entry.award, entry.arm = grant, record.award, record.arm
        entry.count(record.cycles)
        self._move(entry, "finishing" if record.may_commit else "awarded")
        return [entry]

    def _end(self, grant: Grant, outcome: str, *, moved: bool = True) -> None:
        """End a grant; an arm that may have moved for it takes its space until it states which space it takes."""
        grant.outcome, arm = outcome, grant.record.arm
        self.open.pop(grant.record.award, None)
        if moved:
            self.space[arm] = self.space.get(arm, frozenset()) | {grant.record.space}

    def _pauser(self, job: str, award: str) -> str:
        """Return who paused the arm that gives a job back; "" if it has another reason to."""
        entry = self.jobs.get(job)
        grant = None if entry is None or entry.award != award else entry.grant
        if entry is None or grant is None or grant.may_commit or entry.state == "unfinished":
            return ""
        paused = self.operations.paused
        return paused.get(grant.record.arm, paused.get(ALL_ARMS, ""))

    def _release(self, record: Released, pauser: str) -> list[JobEntry]:
        entry = self.jobs.get(record.job)
        grant = None if entry is None else entry.grants.get(record.award)
        if entry is None or grant is None or grant.outcome:
            return []
        self._end(grant, record.outcome, moved=record.outcome != "refused")
        entry.count(record.cycles)
        if entry.award != record.award or entry.outcome is not None:
            return self._give_up(entry)
        return self._wait(entry, f"Its arm was paused by '{pauser}'." if pauser else record.reason)

    def is_news(self, outcome: JobOutcome) -> bool:
        """Return whether an outcome tells more than what is known of the job.

        A job counts as abandoned only when no arm has it. An attempt that is over counts once.
        """
        entry = self.jobs.get(outcome.job)
        if entry is None and outcome.job in self.past:
            return outcome.outcome == "finished" and self.past.is_given_up(outcome.job)
        if entry is None and outcome.job in self.aside:
            return outcome.outcome == "finished"
        if outcome.outcome == "returned":
            if entry is None:
                return bool(outcome.cycles or outcome.faults)
            has = entry.grants.get(outcome.award)
            more = outcome.cycles > entry.cycles or not outcome.faults.keys() <= entry.faults.keys()
            return more or (has is not None and not has.outcome)
        if outcome.outcome == "unfinished" and outcome.award in self.operations.redone(outcome.job):
            return False
        if entry is None:
            return True
        if outcome.outcome in ABANDONED and entry.grant is not None:
            return False
        return entry.outcome is None or weight_of(outcome) > weight_of(entry.outcome)

    def _settle(self, outcome: JobOutcome, pauser: str = "") -> list[JobEntry]:
        """Apply the outcome of a job, or of an attempt at it."""
        news, finished = self.is_news(outcome), outcome.outcome == "finished"
        if (entry := self._entry(outcome.job)) is None:
            if finished and news:
                self.aside.pop(outcome.job, None)
                self.past.add(outcome.job, finished=True)
            return []
        grant = entry.grants.get(outcome.award)
        was_open = grant is not None and not grant.outcome
        if grant is not None and outcome.outcome not in ABANDONED:
            if was_open:
                self._end(grant, outcome.outcome, moved=self.is_central or not grant.revoked)
            grant.outcome = outcome.outcome
        entry.faults |= outcome.faults
        if outcome.outcome == "returned":
            entry.count(outcome.cycles)
            if entry.award != outcome.award or entry.is_settled:
                return self._give_up(entry)
            if was_open:
                entry.returns, entry.returned_s = entry.returns + 1, outcome.time_s
            return self._wait(entry, f"Its arm was paused by '{pauser}'." if pauser else outcome.reason)
        return self._set(entry, outcome) if news else self._give_up(entry)

    def _set(self, entry: JobEntry, outcome: JobOutcome) -> list[JobEntry]:
        """Set the outcome of a job; return what has changed."""
        before = entry.state
        self._outcomes ^= _outcome_hash(entry.outcome) ^ _outcome_hash(outcome)
        entry.outcome = outcome
        if outcome.outcome == "finished" or outcome.outcome == "unfinished":
            if (has := entry.grant) is not None:  # a later award of the same job has no purpose any more
                self._end(has, "dropped", moved=not has.revoked)
            entry.award = outcome.award
            if outcome.award != NO_AWARD or not entry.arm:
                entry.arm = outcome.arm
        if outcome.outcome == "finished":
            most = outcome.cycles if entry.spec is None else entry.spec.repetitions
            entry.cycles = max(entry.cycles, min(outcome.cycles, most))
            entry.grants = {award: grant for award, grant in entry.grants.items() if award == outcome.award}
        else:
            entry.count(outcome.cycles)
        assert outcome.outcome != "returned"
        unsure = "" if outcome.outcome != "unfinished" else "It is unknown whether its last cycle was done."
        self._move(entry, outcome.outcome, outcome.reason or unsure)
        follows = before in ABANDONED or entry.state in ABANDONED
        return [entry, *(self._follow_given_up(entry) if follows else ())]

    def _wait(self, entry: JobEntry, reason: str) -> list[JobEntry]:
        """Have a job wait again, unless it is abandoned; return what has changed."""
        entry.count(entry.cycles)
        if entry.spec is not None:  # the last cycle is never assumed done
            entry.cycles = min(entry.cycles, entry.spec.repetitions - 1)
        if not entry.aside and (lost := self._reason_to_abandon(entry)) is not None:
            return self._set(entry, lost)
        self._move(entry, "waiting", reason)
        return [entry]

    def _give_up(self, entry: JobEntry) -> list[JobEntry]:
        """Abandon a job that waits if there is a reason; return what has changed."""
        lost = self._reason_to_abandon(entry) if entry.state == "waiting" else None
        return [] if lost is None else self._set(entry, lost)

    def _reason_to_abandon(self, entry: JobEntry) -> JobOutcome | None:
        """Return the outcome of a job that a person has cancelled, or in which arms have faulted too often."""
        if (cancel := self.operations.cancelled(entry.name)) is not None:
            end = (NO_AWARD, cancel.auctioneer, "cancelled", entry.cycles, cancel.time_s, cancelled_by(cancel))
            return JobOutcome(entry.name, *end)
        if reason := reason_to_give_up(entry.faults.values()):
            award = max(entry.faults)
            return JobOutcome(entry.name, award, entry.faults[award], "given_up", entry.cycles, self.time_s, reason)
        return None

    def _operate(self, operation: Operation) -> list[JobEntry]:
        """Carry out a request of a person; return what has changed."""
        self.operations.add(operation)
        action, by = operation.request.action, operation.request.by
        if isinstance(action, Pause | Resume):
            return []
        if action.job in self.aside:
            if isinstance(action, Settle):
                del self.aside[action.job]
                if action.outcome == "done":
                    self.past.add(action.job, finished=True)
            return []
        if (entry := self._entry(action.job)) is None:
            self.operations.forget(action.job)
            return []
        if isinstance(action, Change) and entry.spec is not None and entry.state not in SETTLED:
            original = entry.original or entry.spec
            if (changed := self.operations.changed(original)) != entry.spec:
                entry.submitted, entry.spec = original, changed
                return [entry]
        elif isinstance(action, Cancel) and self.operations.cancelled(entry.name) is operation:
            if entry.state in ("waiting", "given_up"):
                lost = self._reason_to_abandon(entry)
                return [] if lost is None else self._set(entry, lost)
            if entry.state in ("awarded", "finishing"):
                reason = f"{cancelled_by(operation)[:-1]}; its arm ends the cycle in progress."
                self._move(entry, entry.state, reason)
                return [entry]
        elif isinstance(action, Settle) and entry.state == "unfinished":
            entry.aside = ""
            if action.outcome == "redo":
                return self._redo(entry)
            cycles = entry.cycles if entry.spec is None else entry.spec.repetitions
            award, arm = entry.award or NO_AWARD, entry.arm
            end = (arm or self.name or NO_AWARD, "finished", cycles, operation.time_s, f"Settled as done by '{by}'.")
            changes = self._set(entry, JobOutcome(entry.name, award, *end))
            entry.arm = arm
            return changes
        return []

    def _redo(self, entry: JobEntry) -> list[JobEntry]:
        """Have a job wait again if a person has called its last cycle not done, and no arm may still do it."""
        redo, grant = self.operations.latest.get(("redo", entry.name)), entry.grant
        if redo is None:
            return []
        if grant is not None and grant.revoked and grant.record.award in redo.awards:
            grant.outcome = "dropped"
        if entry.outcome is not None and entry.outcome.outcome == "unfinished" and entry.outcome.award in redo.awards:
            self._outcomes ^= _outcome_hash(entry.outcome)
            entry.outcome = None
        if entry.state != "unfinished" or entry.outcome is not None or entry.grant is not None:
            return []
        entry.award = ""  # a late report on it that is unsure is settled, too
        return self._wait(entry, f"To be redone, by '{redo.request.by}'.")

    def _clear(self, arm: str) -> list[JobEntry]:
        """Free the space of an arm, and revoke its grants."""
        self.space[arm], changed = frozenset(), list[JobEntry]()
        for entry in list(self.jobs.values()):
            its = [grant for grant in entry.grants.values() if grant.record.arm == arm]
            for grant in its:
                grant.revoked = True
            if (grant := entry.grant) is not None and grant in its:
                self.open.pop(grant.record.award, None)
                reason = f"The space of '{arm}' was cleared; it was about to finish it."
                if grant.may_commit:
                    grant.silent = True
                    self._move(entry, "unfinished", reason)
                    changed.append(entry)
                else:
                    grant.outcome = "dropped"
                    changed += self._wait(entry, f"The space of '{arm}' was cleared.")
            changed += self._redo(entry) if its else []
        return changed

    def _adopt(self, record: HistoryAdopted) -> list[JobEntry]:
        """Apply what an arm has finished; return the waiting jobs that need no arm any more."""
        changed: list[JobEntry] = []
        for job in record.finished:
            known = job.name in self.jobs
            self._accept(JobsAccepted((job,), f"adopted from {record.arm}", record.time_s))
            entry = self.jobs.get(job.name)
            if entry is None or entry.state != "waiting":
                continue
            reason = f"'{record.arm}' had finished it; the journal did not know it."
            end = (NO_AWARD, record.arm, "finished", job.repetitions, record.time_s, reason)
            entry.arm = record.arm
            changes = self._set(entry, JobOutcome(job.name, *end))
            changed += changes if known else []
        return changed

    def _leave(self, name: str) -> None:
        """Drop a job, except for its name and outcome."""
        entry = self.jobs.pop(name)
        self._unsettle(entry)
        self.waiting.pop(name, None)
        self._unknown.pop(name, None)
        for before in () if entry.spec is None else entry.spec.after:
            if (followers := self._awaited.get(before)) is not None:
                followers.pop(name, None)
                if not followers:
                    del self._awaited[before]
        if entry.is_settled:
            self.past.add(entry.original or name, finished=entry.state == "finished")
            self.left[entry.state] = self.left.get(entry.state, 0) + 1
        self._outcomes ^= _outcome_hash(entry.outcome)
        self.operations.forget(name)
        self._in_order = None

    def _unsettle(self, entry: JobEntry) -> None:
        if entry.settled_s is not None:
            self.settled.remove((entry.settled_s, entry.name))
            entry.settled_s = None

    def _move(self, entry: JobEntry, state: JobState, reason: str = "") -> None:
        """Change the state of a job."""
        if state == "finished":
            entry.aside = ""
        elif entry.aside:
            state, reason = "unfinished", reason_of_aside(entry.aside)
        elif state == "waiting" and self.ended:
            state, reason = "unfinished", reason or SHIFT_ENDED
        self.waiting.pop(entry.name, None)
        self._unsettle(entry)
        entry.state, entry.reason = state, reason
        if state == "waiting" and entry.spec is not None:
            self.waiting[entry.name] = entry
        elif state in ("finished", *ABANDONED):
            entry.settled_s = self.time_s if entry.outcome is None else entry.outcome.time_s
            insort(self.settled, (entry.settled_s, entry.name))

    def _note_followers(self, entries: Iterable[JobEntry]) -> None:
        """Note which jobs these wait for."""
        for entry in entries:
            for before in () if entry.spec is None else entry.spec.after:
                self._awaited.setdefault(before, {})[entry.name] = None

    def _follow_given_up(self, entry: JobEntry) -> list[JobEntry]:
        """Apply a change of this job to jobs that wait for it; return what has changed."""
        if entry.name not in self._awaited:
            return []
        if entry.state not in ABANDONED:
            return self._apply_given_up()
        changed, lost = list[JobEntry](), [entry.name]
        for before in lost:  # grows meanwhile
            for name in self._awaited.get(before, ()):
                if (follower := self.waiting.get(name)) is not None:
                    self._move(follower, "given_up", reason_to_follow(before))
                    changed.append(follower)
                    lost.append(name)
        return changed

    def _apply_given_up(self) -> list[JobEntry]:
        """Give up jobs that wait for one that is given up; return what has changed.

        They wait again if that one was finished after all.
        """
        abandoned = [entry for _, name in self.settled if (entry := self.jobs[name]).state in ABANDONED]
        causes = {entry.name for entry in abandoned if entry.outcome is not None}
        followers = [entry for entry in abandoned if entry.outcome is None]
        open_jobs = {entry.name: entry for entry in (*self.waiting.values(), *followers)}
        specs = [entry.spec for entry in open_jobs.values() if entry.spec is not None]
        causes |= {name for job in specs for name in job.after if self.past.is_given_up(name)}
        lost = lost_jobs(specs, causes) if causes else {}
        changed = list[JobEntry]()
        for name, entry in open_jobs.items():
            state = "given_up" if name in lost else "waiting"
            if entry.state != state:
                self._move(entry, state, lost.get(name, ""))
                changed.append(entry)
        return changed

    def _change(
        self, status: JobStatus, time_s: float, entry: JobEntry | None, by: str = "", offers: Offers = ()
    ) -> Result:
        cancel = None if entry is None else self.operations.cancelled(entry.name)
        change = Result(
            self.name or NO_AWARD,
            time_s=time_s,
            status=status,
            number=self.number,
            by=cancel.request.by if cancel is not None and status.state == "cancelled" else by,
            epoch=self.epoch,
            offers=offers,
        )
        if entry is not None and (grant := entry.grants.get(entry.award)) is not None:
            award = asdict(grant.record)
            names = ("auction", "difficulty", "p_saturation", "peak_c")
            change = replace(change, **{name: award[name] for name in names})
        self.number += 1
        self.recent.append(change)
        return change

    # Journals that are wrong

    def _aside_jobs(self) -> list[str]:
        return [*self.aside, *(name for name, entry in self.jobs.items() if entry.aside)]

    def _quarantine(self, reasons: Mapping[str, str]) -> None:
        """Have no arm do these jobs until a person has settled them, except for one that may have it already.

        As it is unknown where that arm is, every arm may be anywhere until it says where it is.
        """
        for name, reason in reasons.items():
            if (entry := self.jobs.get(name)) is None:
                if name not in self.past:
                    self.aside.setdefault(name, reason)
            else:
                entry.aside = entry.aside or reason
                self._outcomes ^= _outcome_hash(entry.outcome)
                entry.outcome = None
                if (grant := entry.grant) is not None:
                    grant.may_commit = grant.silent = True
                self._move(entry, "unfinished")
        if reasons:
            self.space = dict.fromkeys([*self.arms, *self.space], frozenset([ANYWHERE]))

    def _apply_check(self, check: Checked) -> None:
        self.unchecked.clear()
        self._unnoted = False
        if check.number > self.checks:
            self.checks = check.number
            self.number, self.operated = max(self.number, check.changes), max(self.operated, check.operated)

    def _restore(self, snapshot: BookSnapshot) -> None:
        self.number, self.ended, self.checks = snapshot.number, snapshot.ended, snapshot.checks
        self.epoch, self.succeeds, self.numbers = snapshot.epoch, snapshot.succeeds, dict(snapshot.numbers)
        self.jobs = {entry.name: entry.copied() for entry in snapshot.jobs}
        entries = self.jobs.values()
        self.waiting = {name: entry for name, entry in self.jobs.items() if entry.state == "waiting" and entry.spec}
        self.settled = sorted((entry.settled_s, entry.name) for entry in entries if entry.settled_s is not None)
        self._unknown = dict.fromkeys(entry.name for entry in entries if entry.spec is None)
        grants = (entry.grant for entry in entries)
        self.open = {grant.record.award: grant for grant in grants if grant is not None and not grant.revoked}
        self._in_order, self._awaited, self._outcomes = None, {}, 0
        self._note_followers(entries)
        for entry in entries:
            self._outcomes ^= _outcome_hash(entry.outcome)
        self.past, self.left = PastJobs(snapshot.past, self.past.limit), dict(snapshot.left)
        self.recent = deque(snapshot.recent, maxlen=MAX_RECENT)
        self.space |= {arm: frozenset(spaces) for arm, spaces in snapshot.space.items()}
        self.operations = Operations()
        for operation in snapshot.operations:
            self.operations.add(operation)
        self.operations.names = dict(snapshot.names)
        self.operated, self.requested = snapshot.operated, deque(snapshot.requested, maxlen=MAX_RECENT)
        self.aside, self._unnoted = dict(snapshot.aside), False
        self.unchecked.clear()
        at_work = [entry for entry in entries if entry.state in ("awarded", "finishing") and entry.grant is None]
        self._quarantine({entry.name: f"it is {entry.state} without an award" for entry in at_work})


def _adopted_award(award: Award, history: History, time_s: float) -> Granted:
    terms = (award.award, award.job.name, history.arm, time_s, award.cycles, award.job.stations)
    may_commit = award.award in history.may_commit
    return Granted(*terms, may_commit=may_commit, auction=award.auction, quote=award.quote, plan=award.plan)


class Doubt(NamedTuple):
    """Why a record is not applied."""

    reason: str
    jobs: tuple[str, ...] = ()
    """Jobs whose state is uncertain now; none if the record only repeats another one."""


def digest(book: JobBook, name: str) -> int:
    """Return a checksum of the state of a job, and of the award that it has."""
    entry = book.jobs[name]
    grant = entry.grants.get(entry.award)
    terms = None if grant is None else (entry.award, grant.record.arm, grant.record.plan, grant.record.space)
    cancelled = book.operations.cancelled(name) is not None
    state = (entry.state, entry.cycles, cancelled, sorted(entry.faults.items()), terms)
    return crc32(msgspec.json.encode(state), crc32(encode(entry.spec) if entry.spec else b""))


def doubt(book: JobBook, record: BookRecord) -> Doubt | None:
    """Return why a record cannot follow those before; None if it can."""
    match record:
        case Granted():
            return _doubt_grant(book, record)
        case CommitPermitted() | ContactLost() | ContactRegained():
            if (grant := book.open.get(record.award)) is None:
                known = book.grant_of(record.award) is not None
                return Doubt("the award is closed already") if known else _unknown_award(book, record.award)
            expected = {CommitPermitted: (False, False), ContactLost: (True, False), ContactRegained: (True, True)}
            if (grant.may_commit, grant.silent) == expected[type(record)] or book.jobs[grant.record.job].aside:
                return None
            return Doubt("the award is in this state already", () if grant.may_commit else (grant.record.job,))
        case Released(award, job):
            grant = book.grant_of(award, job)
            if grant is None:
                return None if record.outcome == "refused" else _unknown_award(book, award)
            return Doubt("the award is closed already") if grant.outcome else None
        case JobSettled(outcome) if book.is_central:
            return _doubt_outcome(book, outcome)
        case Requested(operation) if book.is_central:
            if operation.request.request in book.operations.names:
                return Doubt("the request was carried out before")
            job = requested_job(operation.request)
            return None if not job or _is_known(book, job) else _unknown_job(job)
        case Checked():
            return _doubt_check(book, record)
        case _:
            return None


def _is_known(book: JobBook, job: str) -> bool:
    return job in book.jobs or job in book.past or job in book.aside


def _unknown_job(job: str) -> Doubt:
    return Doubt(f"the journal does not say what '{job}' is", (job,))


def _doubt_grant(book: JobBook, record: Granted) -> Doubt | None:
    entry = book.jobs.get(record.job)
    if entry is None:
        return _unknown_job(record.job) if book.is_central else None
    before = entry.grants.get(record.award)
    if before is not None and (book.is_central or not before.outcome):
        return Doubt("the award was given before")
    if entry.state == "waiting":
        return None
    return Doubt(f"'{record.job}' was {entry.state} when it was awarded", (record.job,))


def _unknown_award(book: JobBook, award: str) -> Doubt:
    """Doubt for a record on an award that is not in the book."""
    job = job_of(award)
    entry = book.jobs.get(job)
    if job in book.past or (entry is not None and entry.state == "finished"):
        return Doubt(f"the job of '{award}' is done already")
    return Doubt(f"the journal has no award '{award}'", (job,) if job else ())


def _doubt_outcome(book: JobBook, outcome: JobOutcome) -> Doubt | None:
    entry = book.jobs.get(outcome.job)
    if entry is None:
        return None if _is_known(book, outcome.job) else _unknown_job(outcome.job)
    if outcome.award == NO_AWARD:
        return None if outcome.job in book.waiting else Doubt("the job does not wait")
    if (grant := entry.grants.get(outcome.award)) is None:
        return _unknown_award(book, outcome.award)
    return Doubt("the award is closed already") if grant.outcome in ("finished", "returned", "unfinished") else None


def _doubt_check(book: JobBook, record: Checked) -> Doubt | None:
    """Compare the jobs that changed since the last check with what they were when it was written."""
    if record.number <= book.checks:
        return Doubt("it repeats a line")
    wrong = {name for name in book.unchecked - record.jobs.keys() if name in book.jobs}
    for name, expected in record.jobs.items():
        if name not in book.past and (name not in book.jobs or digest(book, name) != expected):
            wrong.add(name)
    wrong -= {name for name in wrong if name in book.aside or (name in book.jobs and book.jobs[name].aside)}
    counts = (record.changes, record.operated, record.paused)
    if not wrong and counts == (book.number, book.operated, book.operations.paused):
        return None
    return Doubt("the records before do not give the state that was noted", tuple(sorted(wrong)))


def salvage(quarantine: Quarantine) -> Salvage[BookRecord]:
    """Return what to do with a record that cannot be read: put it aside, and go on with its other jobs."""

    def put(record: bytes, reason: str) -> list[BookRecord]:
        quarantine(record, reason)
        return rest_of(record, reason)

    return put


def rest_of(raw: bytes, reason: str) -> list[BookRecord]:
    """Return what can be kept of a record that is none of this version: its other jobs, and whom it concerns.

    Raises:
        JournalError: it is the record of all jobs, and cannot be read at all.
    """
    try:
        content = msgspec.json.decode(raw)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return []
    if not isinstance(content, dict):
        return []
    fields, bad = cast(dict[str, object], content), set[str]()
    snapshot = fields.get("type") == "book_snapshot"
    parts: dict[str, type[msgspec.Struct]] = {"jobs": JobEntry if snapshot else JobSpec, "finished": JobSpec}
    for key, kind in (parts | {"recent": Result}).items():
        if isinstance(items := fields.get(key), list):
            kept: list[object] = []
            for item in cast(list[object], items):
                if _is_readable(item, kind):
                    kept.append(item)
                elif kind is not Result:  # of the last messages none is needed
                    bad.add(_job_in(item))
            fields[key] = kept
    rest: list[BookRecord] = []
    try:
        rest.append(msgspec.convert(fields, BookRecord, str_keys=True))
    except msgspec.ValidationError as error:
        if snapshot:
            raise JournalError(f"The journal's record of all jobs cannot be read: {error}.") from error
        bad.add(_job_in(fields))
    bad.discard("")
    return [*rest, JobsQuarantined(dict.fromkeys(sorted(bad), reason[:MAX_REASON]))] if bad else rest


def _is_readable(item: object, kind: type[msgspec.Struct]) -> bool:
    try:
        msgspec.convert(item, kind)
    except msgspec.ValidationError:
        return False
    return True


def _job_in(item: object) -> str:
    """Return the name of the job that a part of a record is about; "" if there is none."""
    if not isinstance(item, dict):
        return ""
    fields = cast(dict[str, object], item)
    for key in ("name", "job"):
        if isinstance(name := fields.get(key), str):
            return name
    if isinstance(award := fields.get("award"), str) and job_of(award):
        return job_of(award)
    inner = ("spec", "record", "settled", "operation", "request", "action")
    return next(filter(None, (_job_in(fields.get(key)) for key in inner)), "")
