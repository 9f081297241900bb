"""What happened to the jobs of an auctioneer: the records of its journal."""

from typing import Literal

import msgspec

from fleet.bus.trade import JobWord


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


Record = Began | Ticked | Accepted | Awarded | Leave | Silent | Heard | Closed | Ended
"""Each has `time_s`, the fleet's time when it was written."""
