"""Journal records of an auctioneer, and the entries of its ledger, which a snapshot of the ledger holds as records.

Jobs that have left a ledger: two hashes and the outcome of each, 16 bytes, for the last of them.

A job that is settled leaves memory and journal; the recording has it. Its name must not be used again: a submission
that is repeated late would be done twice. The last `MAX_PAST` names are known, at one job in 10 s those of 11 days.
"""

from collections import deque
from collections.abc import Container, Iterator
from hashlib import blake2b
from struct import iter_unpack, pack
from typing import cast

import msgspec
from msgspec import Struct

from fleet.bus.protocol.auction import JobSpec, JobState, JobStatus, Offers
from fleet.bus.protocol.messages import Count, encode
from fleet.bus.protocol.operator import ControlRequest
from fleet.errors import JournalError
from fleet.live.journal import (
    ClockTick,
    Closed,
    CommitPermitted,
    EpochBegun,
    JobsAccepted,
    Quarantine,
    Salvage,
    SpaceCleared,
    SpaceTaken,
    Started,
)
from fleet.live.space import ANYWHERE

MAX_REASON = 300
"""Characters of the reason for which a job is quarantined."""


class HistoryAdopted(msgspec.Struct, frozen=True, tag="history_adopted"):
    """An arm has finished jobs that the journal did not know to be finished."""

    arm: str
    finished: tuple[JobSpec, ...]
    time_s: float


class Awarded(msgspec.Struct, frozen=True, tag="awarded"):
    """A job is awarded to an arm, which may have a lease on it from now on."""

    award: str
    auction: str
    job: str
    arm: str
    quote: str
    cycles: int
    """Done by other arms before."""
    time_s: float
    difficulty: float | None = None
    p_saturation: float | None = None
    peak_c: float | None = None
    space: str = ANYWHERE
    """Name of the space of its plan."""
    plan: int = 0
    """Number of the plan in the quote."""
    offers: Offers = ()
    """Behind the award. The ledger keeps them with its last changes only."""


class ContactLost(msgspec.Struct, frozen=True, tag="contact_lost"):
    """The lease of an arm with permission to commit has ended: it is unknown whether the job is done."""

    award: str
    time_s: float
    cycles: Count = 0
    """Last reported progress."""


class ContactRegained(msgspec.Struct, frozen=True, tag="contact_regained"):
    """The arm renews its lease again, and still has the job."""

    award: str
    time_s: float


class Expired(msgspec.Struct, frozen=True, tag="expired"):
    """A waiting job is given up: its hard due date has passed."""

    job: str
    time_s: float


class ShiftEnded(msgspec.Struct, frozen=True, tag="shift_ended"):
    """The fleet's shift is over; open jobs stay unfinished."""

    time_s: float
    cycles: dict[str, Count] = {}
    """Last reported progress, by open award."""


class Operated(msgspec.Struct, frozen=True, tag="operated"):
    """A request of a person is carried out; what changes follows from the state."""

    request: ControlRequest
    time_s: float
    cycles: Count = 0
    """Last reported progress of its job."""


class JobChange(msgspec.Struct, frozen=True):
    """A job's state has changed; fields as in `fleet.bus.protocol.auction.Result`."""

    number: int
    time_s: float
    status: JobStatus
    auction: str = ""
    difficulty: float | None = None
    p_saturation: float | None = None
    peak_c: float | None = None
    by: str = ""
    offers: Offers = ()


class JobEntry(msgspec.Struct):
    """State of one job."""

    spec: JobSpec
    by: str
    state: JobState = "waiting"
    award: str = ""
    """The open one, or the last one."""
    cycles: int = 0
    finished_s: float | None = None
    reason: str = ""
    returns: int = 0
    """How many times an arm returned it."""
    returned_s: float = 0.0
    """Fleet time of the last return."""
    faults: tuple[str, ...] = ()
    """The arm of each fault in this job."""
    expired: bool = False
    """It waited when its hard due date passed."""
    cancelled: bool = False
    """A person has cancelled it: it never waits again, unless a person has it redone."""
    changed_by: str = ""
    """The person whose request changed it last."""
    submitted: JobSpec | None = None
    """As it was submitted, if a person has changed it since."""
    arm: str = ""
    """The arm that had it last, if `award` does not say."""
    aside: str = ""
    """Why it is quarantined; "" if it is not. It stays unfinished until an arm reports it finished, or a person settles
    it."""

    @property
    def original(self) -> JobSpec:
        """The job as it was submitted."""
        return self.submitted or self.spec


class Checked(msgspec.Struct, frozen=True, tag="checked"):
    """What the records since the last one of these have changed, so that a wrong or missing one is noticed."""

    number: int
    """Counts them, from 1."""
    changes: int
    """Number of the next change."""
    jobs: dict[str, int]
    """Checksum of the state of each job that has changed."""
    time_s: float
    paused: dict[str, str] = {}


class JobsQuarantined(msgspec.Struct, frozen=True, tag="jobs_put_aside"):
    """Jobs whose records cannot be read, with the reason."""

    jobs: dict[str, str]
    time_s: float = 0.0


class AwardState(msgspec.Struct):
    """State of one award."""

    record: Awarded
    may_commit: bool = False
    silent: bool = False
    """The arm has permission to commit, and has not renewed its lease."""
    outcome: str = ""


class LedgerSnapshot(msgspec.Struct, frozen=True, tag="ledger_snapshot"):
    """The whole ledger, in place of the records before."""

    time_s: float
    number: int
    """Of the next change."""
    ended: bool
    jobs: tuple[JobEntry, ...]
    awards: tuple[AwardState, ...]
    """Awards on which a report could still change something."""
    open: tuple[str, ...]
    """Names of open awards."""
    recent: tuple[JobChange, ...]
    space: dict[str, tuple[str, ...]] = {}
    """As in `Ledger`, as are the next ones."""
    settled: tuple[str, ...] = ()
    past: bytes = b""
    left: dict[JobState, int] = {}
    epoch: str = ""
    succeeds: bool = False
    paused: dict[str, str] = {}
    requests: dict[str, int] | tuple[str, ...] = ()
    """As in `Ledger`; earlier versions kept the names alone."""
    aside: dict[str, str] = {}
    checks: int = 0
    operated: int = 0
    operations: tuple[Operated, ...] = ()


AwardRecord = Awarded | CommitPermitted | ContactLost | ContactRegained | Closed
JobRecord = JobsAccepted | JobsQuarantined | Expired | HistoryAdopted | Operated
SpaceRecord = SpaceTaken | SpaceCleared
AuctionRecord = (
    Started | EpochBegun | ClockTick | Checked | JobRecord | AwardRecord | SpaceRecord | ShiftEnded | LedgerSnapshot
)


def job_of(award: str) -> str:
    """Return the job in the name of an award, as `leases.new_awards` makes it: ROUND:JOB; "" if there is none."""
    return award.partition(":")[2]


# Records that cannot be read


def salvage(quarantine: Quarantine) -> Salvage[AuctionRecord]:
    """Return what to do with a record that cannot be read: put it aside, and go on with its other jobs."""

    def put(record: bytes, reason: str) -> list[AuctionRecord]:
        quarantine(record, reason)
        return rest_of(record, reason)

    return put


def rest_of(raw: bytes, reason: str) -> list[AuctionRecord]:
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
    snapshot = fields.get("type") == "ledger_snapshot"
    parts = {"jobs": JobEntry if snapshot else JobSpec, "finished": JobSpec, "awards": AwardState, "recent": JobChange}
    for key, kind in parts.items():
        if isinstance(items := fields.get(key), list):
            kept: list[object] = []
            for item in cast(list[object], items):
                if _is_readable(item, kind):
                    kept.append(item)
                elif kind is not JobChange:  # of the last messages none is needed
                    bad.add(_job_in(item))
            fields[key] = kept
    rest: list[AuctionRecord] = []
    try:
        rest.append(msgspec.convert(fields, AuctionRecord, str_keys=True))
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
    return next(filter(None, (_job_in(fields.get(key)) for key in ("spec", "record", "request", "action"))), "")


MAX_PAST = 100_000
"""Jobs whose names are known after they have left the ledger."""


def hash_of(content: bytes) -> int:
    """Return 64 bits, the same in every process."""
    return int.from_bytes(blake2b(content, digest_size=8).digest(), "little")


def content_hash(message: Struct) -> int:
    """Return a hash of the content of a message."""
    return hash_of(encode(message))


def _spec_hash(job: JobSpec) -> int:
    """Hash of a job without the lowest bit, which says whether it was finished."""
    return content_hash(job) & ~1


class PastJobs(Container[str]):
    """Names of the last jobs that have left a ledger.

    Attributes:
        limit: How many are known at most.
    """

    def __init__(self, packed: bytes = b"", limit: int = MAX_PAST) -> None:
        """Start with jobs as `packed` returns them."""
        self.limit = limit
        self._jobs: dict[int, int] = {}
        self._order: deque[int] = deque()
        for name, value in iter_unpack("<QQ", packed):
            self._put(name, value)

    def add(self, job: JobSpec | str, *, finished: bool) -> None:
        """Add a job that is finished, or given up; the oldest one is dropped if there are too many.

        Args:
            job: A job, or the name of one of unknown content, which is the same as any other of that name.
        """
        name, content = (job, 0) if isinstance(job, str) else (job.name, _spec_hash(job))
        self._put(hash_of(name.encode()), content | finished)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and hash_of(name.encode()) in self._jobs

    def __len__(self) -> int:
        return len(self._jobs)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PastJobs) and self._jobs == other._jobs

    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def is_same(self, job: JobSpec) -> bool:
        """Return whether a job of this name is known, and is this one."""
        return self._jobs.get(hash_of(job.name.encode()), -1) & ~1 in (0, _spec_hash(job))

    def is_finished(self, name: str) -> bool:
        """Return whether a job of this name is known, and was finished."""
        return bool(self._jobs.get(hash_of(name.encode()), 0) & 1)

    def is_given_up(self, name: str) -> bool:
        """Return whether a job of this name is known, and was given up."""
        return not self._jobs.get(hash_of(name.encode()), 1) & 1

    def packed(self) -> bytes:
        """Return all jobs, oldest first."""
        return b"".join(pack("<QQ", name, value) for name, value in self._items())

    def _items(self) -> Iterator[tuple[int, int]]:
        return ((name, self._jobs[name]) for name in self._order)

    def _put(self, name: int, value: int) -> None:
        if name not in self._jobs:
            self._order.append(name)
            if len(self._order) > self.limit:
                del self._jobs[self._order.popleft()]
        self._jobs[name] = value
