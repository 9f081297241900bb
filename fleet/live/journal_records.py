"""Records that the journals of arms and auctioneers have in common; each journal adds a few of its own.

One name means one thing in every journal. Times are fleet seconds, 0 where the writer does not know the time.
"""

from typing import Literal

import msgspec

from fleet.bus.protocol.auction import Count, JobSpec, Name


class Started(msgspec.Struct, frozen=True, tag="started"):
    """The process starts, for the first time or again."""

    name: str = ""
    """Of the arm or auctioneer."""
    time_s: float = 0.0
    boot: Count = 0
    """Counts the starts of an arm from 1."""


class EpochBegun(msgspec.Struct, frozen=True, tag="epoch_begun"):
    """The journal is new, and has this name; or an arm without an auctioneer has learned it from another."""

    epoch: str
    time_s: float = 0.0
    succeeds: bool = False
    """A person has requested that it takes the place of another one: arms may know older epochs."""


class ClockTick(msgspec.Struct, frozen=True, tag="clock_tick"):
    """Fleet time has reached this value."""

    time_s: float


class JobsAccepted(msgspec.Struct, frozen=True, tag="jobs_accepted"):
    """These jobs were submitted and accepted."""

    jobs: tuple[JobSpec, ...]
    by: str = ""
    time_s: float = 0.0


class Progress(msgspec.Struct, frozen=True, tag="progress"):
    """Number of cycles of a job that are done, by any arm."""

    job: Name
    cycles: Count


class CommitPermitted(msgspec.Struct, frozen=True, tag="commit_permitted"):
    """The arm may begin the last cycle; from now on the job goes to no other arm."""

    award: Name
    time_s: float = 0.0
    cycles: Count = 0
    """Done then, where an auctioneer writes it."""


class Released(msgspec.Struct, frozen=True, tag="released"):
    """The arm no longer has the award, and has nothing to report on it."""

    award: Name
    job: str = ""
    arm: str = ""
    number: Count = 0
    """Number of the claim that released it, where arms allocate by consensus."""


class Closed(msgspec.Struct, frozen=True, tag="closed"):
    """An award has ended."""

    award: Name
    outcome: Literal["finished", "returned", "refused", "dropped"]
    """refused: the arm did not accept it; dropped: its lease has expired."""
    cycles: Count
    """Done so far, by any arm."""
    time_s: float
    reason: str = ""
    unsure: bool = False
    """As in `fleet.bus.protocol.auction.Report`."""
    job: str = ""
    arm: str = ""
    faulted: bool = False
    """As in `fleet.bus.protocol.auction.Report`."""


class SpaceTaken(msgspec.Struct, frozen=True, tag="space_taken"):
    """An arm says which spaces it takes; empty at home."""

    arm: Name
    space: tuple[Name, ...] = ()
    """Names, without those of its open awards."""
    time_s: float = 0.0
    number: Count = 0
    """Of the claim that says it, where arms allocate by consensus."""


class SpaceCleared(msgspec.Struct, frozen=True, tag="space_cleared"):
    """A person has freed all space of an absent arm."""

    arm: Name
    by: str = ""
    time_s: float = 0.0
