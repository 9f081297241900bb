"""What happened to the jobs of an auctioneer: the records of its journal, and where all of them leave the jobs."""

from dataclasses import dataclass
from typing import Literal

import msgspec

from fleet.bus.trade import JobState, JobStatus, JobWord


class Began(msgspec.Struct, frozen=True, tag=True):
    """The auctioneer starts, for the first time or again."""

    auctioneer: str
    time_s: float


class Ticked(msgspec.Struct, frozen=True, tag=True):
    """The fleet's time has come so far."""

    time_s: float


class Accepted(msgspec.Struct, frozen=True, tag=True):
    """Somebody wants these jobs done."""

    jobs: tuple[JobWord, ...]
    by: str
    time_s: float


class Awarded(msgspec.Struct, frozen=True, tag=True):
    """A job is promised to an arm; from here on the arm may hold a lease on it."""

    award: str
    auction: str
    job: str
    arm: str
    quote: str
    cycles: int
    """Done by others before."""
    time_s: float
    d: float | None = None
    p_saturation: float | None = None


class Leave(msgspec.Struct, frozen=True, tag=True):
    """The arm may begin the last cycle; nobody else gets the job any more."""

    award: str
    time_s: float


class Silent(msgspec.Struct, frozen=True, tag=True):
    """The arm had leave to finish, and its lease is over: nobody knows whether the job is done."""

    award: str
    time_s: float


class Heard(msgspec.Struct, frozen=True, tag=True):
    """An arm that was silent speaks again, and still has the job in hand."""

    award: str
    time_s: float


class Closed(msgspec.Struct, frozen=True, tag=True):
    """An award has come to its end."""

    award: str
    outcome: Literal["finished", "returned", "refused", "dropped"]
    """refused: the arm did not take it; dropped: its lease has surely ended."""
    cycles: int
    """Done so far, those of others included."""
    time_s: float
    reason: str = ""
    unsure: bool = False
    """See `fleet.bus.trade.Report`."""


class Ended(msgspec.Struct, frozen=True, tag=True):
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
    d: float | None = None
    p_saturation: float | None = None


@dataclass
class Entry:
    """One job and where it stands."""

    word: JobWord
    by: str
    state: JobState = "waiting"
    award: str = ""
    """The open one, or the last one."""
    cycles: int = 0
    finished_s: float | None = None
    reason: str = ""


@dataclass
class Promise:
    """One award and what became of it."""

    made: Awarded
    leave: bool = False
    silent: bool = False
    outcome: str = ""


class Standing(msgspec.Struct, frozen=True, tag=True):
    """Where all the records so far have led: a journal may begin with it instead of them."""

    time_s: float
    number: int
    """Of the next change."""
    ended: bool
    jobs: tuple[Entry, ...]
    awards: tuple[Promise, ...]
    """Of which something may yet be heard that counts."""
    open: tuple[str, ...]
    """Awards that an arm may still hold, by name."""
    recent: tuple[Change, ...]


Record = Began | Ticked | Accepted | Awarded | Leave | Silent | Heard | Closed | Ended | Standing
"""Each has `time_s`, the fleet's time when it was written."""
