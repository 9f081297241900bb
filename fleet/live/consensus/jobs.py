"""Records that an arm without an auctioneer keeps of what it has granted, in the order in which they happened.

Outcomes of settled jobs, as an arm without an auctioneer knows them.

The latest `MAX_SETTLED` by fleet time stay, and unfinished ones; of older ones only name and outcome are known
(`PastJobs`). Arms that know the same outcomes keep the same ones, in whatever order they have received them; where two
times of one outcome are known, only until these have left.

Requests of people, as an arm without an auctioneer knows them.

For each thing that a request can set, the latest request counts: by fleet time, then by name. So arms that know the
same requests agree, in whatever order they have received them.

What an arm has granted to its peers, and what it knows of jobs, as its journal records it.
"""

from bisect import insort
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import msgspec

from fleet.bus.protocol.auction import ABANDONED, Count, JobSpec, JobState, Name
from fleet.bus.protocol.consensus import Faults, JobOutcome
from fleet.bus.protocol.messages import MOST_COUNT
from fleet.bus.protocol.operator import ALL_ARMS, Cancel, Change, ControlRequest, Operation, Pause, Resume, Settle
from fleet.live.auction.auctioneer import job_of
from fleet.live.auction.job_rules import MAX_OPEN_JOBS, changed_spec
from fleet.live.auction.ledger import MAX_REQUESTS, MAX_SETTLED
from fleet.live.auction.records import PastJobs, hash_of
from fleet.live.journal import (
    ClockTick,
    EpochBegun,
    JobsAccepted,
    Progress,
    Released,
    SpaceCleared,
    SpaceTaken,
    Started,
    TimedState,
)
from fleet.live.space import ANYWHERE


class JobGranted(msgspec.Struct, frozen=True, tag="job_granted"):
    """A job is granted to an arm, or its grant is updated with more cycles done."""

    arm: Name
    number: Count
    """Of the claim."""
    award: Name
    job: Name
    places: tuple[Name, ...]
    cycles: Count
    may_commit: bool = False
    revoked: bool = False
    """As in `Grant`."""


class JobSettled(msgspec.Struct, frozen=True, tag="job_settled"):
    """A job, or an attempt at one, has ended."""

    settled: JobOutcome


class Faulted(msgspec.Struct, frozen=True, tag="faulted"):
    """Arms have faulted in a job."""

    job: Name
    faults: Faults


class JobReturned(msgspec.Struct, frozen=True, tag="job_returned"):
    """An arm returned a job at this fleet time."""

    job: Name
    time_s: float
    arm: Name | None = None
    """None in the journals of earlier versions."""


class ClaimNumbered(msgspec.Struct, frozen=True, tag="claim_numbered"):
    """The last claim of an arm had this number."""

    arm: Name
    number: Count


class Requested(msgspec.Struct, frozen=True, tag="requested"):
    """A request of a person is carried out, here or by a peer."""

    operation: Operation


class RequestsKnown(msgspec.Struct, frozen=True, tag="requests_known"):
    """Requests of people that were carried out, by name."""

    names: tuple[str, ...]


class PastKnown(msgspec.Struct, frozen=True, tag="past_known"):
    """Settled jobs that have left, as `PastJobs.packed`, and how many have left, by state."""

    packed: bytes
    left: dict[JobState, int]


GrantRecord = (
    Started
    | PastKnown
    | JobGranted
    | Released
    | JobSettled
    | Faulted
    | JobReturned
    | JobsAccepted
    | ClockTick
    | ClaimNumbered
    | Progress
    | Requested
    | RequestsKnown
    | SpaceTaken
    | SpaceCleared
    | EpochBegun
)


RANKS = ("returned", "given_up", "cancelled", "unfinished", "finished")
"""Outcomes of a job: the later ones count more."""


class SettledJobs(Mapping[str, JobOutcome]):
    """Outcome of each settled job, by name.

    Attributes:
        past: Jobs that have left.
        left: How many have left, by state.
        gone: Names of jobs that have left since they were last taken from here.
        digest: Equal for arms that keep the same outcomes.
    """

    def __init__(self) -> None:
        self.past, self.left = PastJobs(), dict[JobState, int]()
        self.gone: list[str] = []
        self.digest = 0
        self._outcomes: dict[str, JobOutcome] = {}
        self._order: list[tuple[float, str]] = []
        """Time and name of those that may leave."""

    def __getitem__(self, job: str) -> JobOutcome:
        return self._outcomes[job]

    def __iter__(self) -> Iterator[str]:
        return iter(self._outcomes)

    def __len__(self) -> int:
        return len(self._outcomes)

    def __contains__(self, job: object) -> bool:
        return job in self._outcomes

    def is_news(self, outcome: JobOutcome) -> bool:
        """Return whether an outcome counts more than the known one: by its kind, then the later one."""
        known = self._outcomes.get(outcome.job)
        if known is None and outcome.job in self.past:
            return outcome.outcome == "finished" and self.past.is_given_up(outcome.job)
        return known is None or _weight(outcome) > _weight(known)

    def known(self, job: str, arm: str) -> JobOutcome | None:
        """Return the outcome of a job, also of one that has left, as the arm `arm` knows it; None for none."""
        if job in self._outcomes or job not in self.past:
            return self._outcomes.get(job)
        outcome = "finished" if self.past.is_finished(job) else "given_up"
        return JobOutcome(job, "?", arm, outcome, 0, 0.0, f"It was {outcome.replace('_', ' ')} long ago.")

    def put(self, outcome: JobOutcome, specs: Mapping[str, JobSpec]) -> None:
        """Add an outcome that is news; the oldest one leaves if there are too many.

        Args:
            specs: Jobs by name; one of unknown content is the same as any other of its name.
        """
        job = outcome.job
        self.drop(job)
        if job in self.past:
            self.past.add(specs.get(job, job), finished=outcome.outcome == "finished")
            return
        self._outcomes[job] = outcome
        self.digest ^= _hash(outcome)
        if outcome.outcome != "unfinished":
            insort(self._order, (outcome.time_s, job))
        while len(self._order) > MAX_SETTLED:
            self._leave(self._order[0][1], specs)
        if len(self._outcomes) > MAX_SETTLED + MAX_OPEN_JOBS:
            self._leave(next(name for name, each in self._outcomes.items() if each.outcome == "unfinished"), specs)

    def drop(self, job: str) -> None:
        """Forget the outcome of a job."""
        if (known := self._outcomes.pop(job, None)) is not None:
            self.digest ^= _hash(known)
            if known.outcome != "unfinished":
                self._order.remove((known.time_s, job))

    def restore(self, packed: bytes, left: Mapping[JobState, int]) -> None:
        """Start with jobs that have left."""
        self.past, self.left = PastJobs(packed, self.past.limit), dict(left)

    def _leave(self, job: str, specs: Mapping[str, JobSpec]) -> None:
        outcome = self._outcomes[job].outcome
        assert outcome != "returned"
        self.drop(job)
        self.past.add(specs.get(job, job), finished=outcome == "finished")
        self.left[outcome] = self.left.get(outcome, 0) + 1
        self.gone.append(job)


def is_abandoned(outcome: JobOutcome) -> bool:
    """Return whether a job is given up or cancelled: it may be finished after all."""
    return outcome.outcome in ABANDONED


def _weight(outcome: JobOutcome) -> tuple[int, float]:
    return RANKS.index(outcome.outcome), outcome.time_s


def _hash(outcome: JobOutcome) -> int:
    return hash_of(repr((outcome.job, outcome.outcome, outcome.time_s)).encode())


Slot = tuple[str, str]
"""What a request sets, and of which job or arm."""
MAX_SLOTS = 4 * MAX_OPEN_JOBS
"""Of all requests that count; the first ones are dropped if there are more."""
MAX_AWARDS = 16
"""Awards of one job that were redone, in one request."""


def _slots(request: ControlRequest) -> tuple[Slot, ...]:
    match request.action:
        case Cancel(job):
            return (("cancel", job),)
        case Settle(job, outcome):
            return (("redo", job),) if outcome == "redo" else ()
        case Change(job) as change:
            return tuple((field, job) for field in ("due_s", "value") if field in _given(change))
        case Pause(arm):
            return (("pause", arm),)
        case Resume(arm):
            return (("pause", arm), ("resume", arm)) if arm == ALL_ARMS else (("pause", arm),)


def _given(change: Change) -> dict[str, float | None]:
    fields = {"due_s": change.due_s, "value": change.value}
    return {name: value for name, value in fields.items() if value is None or isinstance(value, float | int)}


def _stamp(operation: Operation | None) -> tuple[float, str]:
    return (float("-inf"), "") if operation is None else (operation.time_s, operation.request.request)


class Operations:
    """Requests of people that were carried out.

    Attributes:
        latest: The request that counts, by slot.
        names: Names of the last requests that this arm knows, oldest first.
        digest: Equal for arms that know the same requests.
    """

    def __init__(self) -> None:
        self.latest: dict[Slot, Operation] = {}
        self.names: dict[str, None] = {}
        self.digest = 0

    def is_new(self, operation: Operation) -> bool:
        """Return whether a request changes what counts."""
        return any(_stamp(operation) > _stamp(self.latest.get(slot)) for slot in _slots(operation.request))

    def add(self, operation: Operation) -> None:
        """Add a request."""
        self.add_names((operation.request.request,))
        for slot in _slots(operation.request):
            if _stamp(operation) > _stamp(self.latest.get(slot)):
                self._drop(slot)
                self.latest[slot] = operation
                self.digest ^= _operations_hash(slot, operation)
        while len(self.latest) > MAX_SLOTS:
            self._drop(next(iter(self.latest)))

    def add_names(self, names: tuple[str, ...]) -> None:
        """Add names of requests that were carried out."""
        self.names |= dict.fromkeys(names)
        while len(self.names) > MAX_REQUESTS:
            del self.names[next(iter(self.names))]

    def forget(self, job: str) -> None:
        """Drop the requests for a job that is settled."""
        for slot in ("cancel", "redo", "due_s", "value"):
            self._drop((slot, job))

    @property
    def all(self) -> tuple[Operation, ...]:
        """All requests that count."""
        return tuple({operation.request.request: operation for operation in self.latest.values()}.values())

    @property
    def paused(self) -> dict[str, str]:
        """Who paused an arm, by arm; "*" for all arms."""
        resumed = _stamp(self.latest.get(("resume", ALL_ARMS)))
        return {
            name: operation.request.by
            for (slot, name), operation in self.latest.items()
            if slot == "pause" and isinstance(operation.request.action, Pause) and _stamp(operation) > resumed
        }

    def is_paused(self, arm: str) -> bool:
        """Return whether an arm takes no jobs."""
        return bool(self.latest) and not self.paused.keys().isdisjoint((arm, ALL_ARMS))

    def cancelled(self, job: str) -> Operation | None:
        """Return the request that has cancelled a job; None if none has, or a person has it redone since."""
        cancel = self.latest.get(("cancel", job))
        return cancel if _stamp(cancel) > _stamp(self.latest.get(("redo", job))) else None

    @property
    def all_cancelled(self) -> Mapping[str, Operation]:
        """The request that has cancelled a job, by job."""
        jobs = [job for slot, job in self.latest if slot == "cancel"]
        return {job: operation for job in jobs if (operation := self.cancelled(job)) is not None}

    def redone(self, job: str) -> Container[str]:
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


def is_for(operation: Operation, roster: Container[str]) -> bool:
    """Return whether a request is for a job, or for arms of this fleet."""
    action = operation.request.action
    return bool(job_of(operation.request)) or (
        isinstance(action, Pause | Resume) and (action.arm == ALL_ARMS or action.arm in roster)
    )


def _operations_hash(slot: Slot, operation: Operation) -> int:
    return hash_of(repr((slot, _stamp(operation))).encode())


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
