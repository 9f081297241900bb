"""What arms say to each other where no auctioneer shares out the jobs.

Every arm says a `Bid`: which jobs it would take, and at what cost. From the same bids every arm works out the same
result; who comes to have a job by it asks all peers with a `Claim`, and begins when a majority of the fleet, as its
roster names it, has answered with a `Grant`.

Why a job is never done twice: two majorities share an arm, and an arm grants a job to one peer at a time. A grant is
a lease: the one who claims counts it from the moment it *asked*, the one who grants from the moment it *answered*.
Leave to begin the last cycle is granted once and for good. All of it is on the disk of who grants before the answer.
(Leases: Gray & Cheriton 1989, SOSP. Majorities: Thomas 1979, ACM TODS 4.)
"""

from typing import Annotated, Literal

import msgspec

from fleet.bus.messages import Name, finite
from fleet.bus.trade import MOST_JOBS, Count, JobWord, Offer, Positive


class Bid(msgspec.Struct, frozen=True):
    """Under `arm/{arm}/bid`: what an arm would take, where arms share jobs out among themselves."""

    arm: Name
    number: Count
    """Counts the bids of this arm; never the same again, and with a leap after a restart."""
    time_s: float
    """The fleet's time as this arm keeps it; the latest that anybody keeps is that of all."""
    capacity: Count
    """How many more jobs it would take now."""
    offers: Annotated[tuple[Offer, ...], msgspec.Meta(max_length=MOST_JOBS)]
    """For jobs that could begin now, as far as it knows; none without capacity."""
    left: Count
    """Jobs that are not settled yet, as far as it knows."""
    settled: Count = 0
    """Jobs that are, as far as it knows. Who knows of more, for a while, tells this arm."""
    open: Annotated[tuple[Name, ...], msgspec.Meta(max_length=MOST_JOBS)] = ()
    """The first of these, by release and name. Who knows better, of a job that is settled or one that is missing, tells
    this arm."""

    def __post_init__(self) -> None:
        finite("Bid", "time_s", (self.time_s,))


class Stake(msgspec.Struct, frozen=True):
    """A job that an arm holds, or wants to hold."""

    award: Name
    """Unique per job and attempt, and never used again by this arm."""
    job: Name
    places: Annotated[tuple[Name, ...], msgspec.Meta(min_length=1, max_length=2)]
    """Stations that it occupies."""
    cycles: Count
    """Done so far, those of others included."""
    phase: Literal["wanted", "queued", "working", "finishing"]
    """wanted: not held yet; finishing: asks for leave to begin the last cycle, or has it."""


class Settled(msgspec.Struct, frozen=True):
    """How it ended with a job, or with one attempt at it."""

    job: Name
    award: Name
    arm: Name
    """Who had it."""
    outcome: Literal["finished", "unfinished", "returned"]
    """unfinished: the arm crashed after it was given leave to finish, and nobody does the job again; returned: it is
    anybody's again."""
    cycles: Count
    time_s: float
    reason: str = ""

    def __post_init__(self) -> None:
        finite("Settled", "time_s", (self.time_s,))


class Claim(msgspec.Struct, frozen=True):
    """To `arm/*/grant/{arm}`: all that an arm holds and wants, and what was settled. Whatever was granted to it before
    and is not in here it has let go of."""

    arm: Name
    number: Count
    """Counts the claims of this arm; an earlier one than the last is refused."""
    stakes: Annotated[tuple[Stake, ...], msgspec.Meta(max_length=MOST_JOBS)]
    settled: Annotated[tuple[Settled, ...], msgspec.Meta(max_length=MOST_JOBS)] = ()
    jobs: Annotated[tuple[JobWord, ...], msgspec.Meta(max_length=MOST_JOBS)] = ()
    """Jobs that others have handed in, and that an arm does not seem to know."""


class Granted(msgspec.Struct, frozen=True):
    """A job that is granted."""

    award: Name
    cycles: Count
    """Of the job, as many as are known to be done."""
    leave: bool = False
    """It may begin the last cycle, for all that this arm knows; nobody else gets the job from it any more."""


class Denied(msgspec.Struct, frozen=True):
    """A job that is not granted now."""

    award: Name
    reason: str
    settled: Settled | None = None
    """How it ended, if it has."""


class Grant(msgspec.Struct, frozen=True):
    """Answer to a `Claim`, on disk before it is given."""

    arm: Name
    number: Count
    """Of the claim."""
    lease_s: Positive
    """Real seconds, counted by the one who claims from the moment it asked."""
    granted: tuple[Granted, ...] = ()
    denied: tuple[Denied, ...] = ()
