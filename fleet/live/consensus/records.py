"""Records that an arm without an auctioneer keeps of what it has granted, in the order in which they happened."""

import msgspec

from fleet.bus.protocol.auction import Count, JobState, Name
from fleet.bus.protocol.consensus import Faults, JobOutcome
from fleet.bus.protocol.operator import Operation
from fleet.live.journal_records import (
    ClockTick,
    EpochBegun,
    JobsAccepted,
    Progress,
    Released,
    SpaceCleared,
    SpaceTaken,
    Started,
)


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
