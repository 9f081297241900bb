"""What happened to the jobs of an auctioneer: the records of its journal, and where all of them leave the jobs."""

from dataclasses import dataclass

import msgspec

from fleet.bus.protocol.auction import JobSpec, JobState, JobStatus
from fleet.live.journal_records import ClockTick, Closed, CommitPermitted, JobsAccepted, Started


class Awarded(msgspec.Struct, frozen=True, tag="awarded"):
    """A job is promised to an arm; from here on the arm may hold a lease on it."""

    award: str
    auction: str
    job: str
    arm: str
    quote: str
    cycles: int
    """Done by others before."""
    time_s: float
    difficulty: float | None = None
    p_saturation: float | None = None


class ContactLost(msgspec.Struct, frozen=True, tag="contact_lost"):
    """The arm had leave to finish, and its lease is over: nobody knows whether the job is done."""

    award: str
    time_s: float


class ContactRegained(msgspec.Struct, frozen=True, tag="contact_regained"):
    """An arm that was silent speaks again, and still has the job in hand."""

    award: str
    time_s: float


class ShiftEnded(msgspec.Struct, frozen=True, tag="shift_ended"):
    """The fleet's shift is over; what is not done stays undone."""

    time_s: float


@dataclass(frozen=True)
class Change:
    """A job's state has changed."""

    number: int
    """Counts all changes, from 0, also over restarts."""
    time_s: float
    status: JobStatus
    auction: str = ""
    difficulty: float | None = None
    p_saturation: float | None = None


@dataclass
class Entry:
    """One job and where it stands."""

    word: JobSpec
    by: str
    state: JobState = "waiting"
    award: str = ""
    """The open one, or the last one."""
    cycles: int = 0
    finished_s: float | None = None
    reason: str = ""
    returns: int = 0
    """How often an arm gave it back."""
    returned_s: float = 0.0
    """When it last came back."""


@dataclass
class AwardState:
    """One award and what became of it."""

    made: Awarded
    may_commit: bool = False
    silent: bool = False
    outcome: str = ""


class LedgerSnapshot(msgspec.Struct, frozen=True, tag="ledger_snapshot"):
    """Where all the records so far have led: a journal may begin with it instead of them."""

    time_s: float
    number: int
    """Of the next change."""
    ended: bool
    jobs: tuple[Entry, ...]
    awards: tuple[AwardState, ...]
    """Of which something may yet be heard that counts."""
    open: tuple[str, ...]
    """Awards that an arm may still hold, by name."""
    recent: tuple[Change, ...]


AuctionRecord = (
    Started
    | ClockTick
    | JobsAccepted
    | Awarded
    | CommitPermitted
    | ContactLost
    | ContactRegained
    | Closed
    | ShiftEnded
    | LedgerSnapshot
)
"""Each has `time_s`, the fleet's time when it was written."""
