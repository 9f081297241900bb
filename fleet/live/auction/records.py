"""Journal records of an auctioneer, and the entries of its ledger, which a snapshot of the ledger holds as records."""

import msgspec

from fleet.bus.protocol.auction import JobSpec, JobState, JobStatus
from fleet.bus.protocol.operator import ControlRequest
from fleet.live.journal_records import (
    ClockTick,
    Closed,
    CommitPermitted,
    EpochBegun,
    JobsAccepted,
    SpaceCleared,
    SpaceTaken,
    Started,
)
from fleet.live.space import ANYWHERE


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


class ContactLost(msgspec.Struct, frozen=True, tag="contact_lost"):
    """The lease of an arm with permission to commit has ended: it is unknown whether the job is done."""

    award: str
    time_s: float


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


class Operated(msgspec.Struct, frozen=True, tag="operated"):
    """A request of a person is carried out; what changes follows from the state."""

    request: ControlRequest
    time_s: float


class Change(msgspec.Struct, frozen=True):
    """A job's state has changed; fields as in `fleet.bus.protocol.auction.Result`."""

    number: int
    time_s: float
    status: JobStatus
    auction: str = ""
    difficulty: float | None = None
    p_saturation: float | None = None
    peak_c: float | None = None
    by: str = ""


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

    @property
    def original(self) -> JobSpec:
        """The job as it was submitted."""
        return self.submitted or self.spec


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
    recent: tuple[Change, ...]
    space: dict[str, tuple[str, ...]] = {}
    """As in `Ledger`, as are the next ones."""
    settled: tuple[str, ...] = ()
    past: bytes = b""
    left: dict[JobState, int] = {}
    epoch: str = ""
    succeeds: bool = False
    paused: dict[str, str] = {}
    requests: tuple[str, ...] = ()
    operated: int = 0
    operations: tuple[Operated, ...] = ()


AwardRecord = Awarded | CommitPermitted | ContactLost | ContactRegained | Closed
JobRecord = JobsAccepted | Expired | HistoryAdopted | Operated
SpaceRecord = SpaceTaken | SpaceCleared
AuctionRecord = Started | EpochBegun | ClockTick | JobRecord | AwardRecord | SpaceRecord | ShiftEnded | LedgerSnapshot
