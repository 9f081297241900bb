"""Messages between arms that allocate jobs without an auctioneer.

Every arm publishes a `Bid`: which jobs it would take, and at what cost. From the same bids every arm computes the same
allocation. The arm that gets a job by it sends all peers a `Claim`, and begins when a majority of the fleet, as the
scenario names it, has granted the job in a `ClaimReply`.

Why no job is done twice: two majorities have an arm in common, and an arm grants a job to one peer at a time. A grant
is a lease: the claimer counts it from the moment it sent the claim, the granter from the moment it replied. Permission
to commit never expires. The granter makes each grant durable before it replies.

Why no two arms are away from home on plans that exclude each other: an arm grants the space of a plan to one peer at a
time, and frees it only by a later claim of that peer, never because a lease has ended.
(Leases: Gray & Cheriton 1989, SOSP. Majorities: Thomas 1979, ACM TODS 4.)

An auctioneer or an arm that has lost its journal recovers from the `History` of the arms.
"""

from collections.abc import Sequence
from itertools import accumulate
from typing import Annotated, Literal

import msgspec
from msgspec.structs import replace

from fleet.bus.protocol.auction import MOST_JOBS, Award, JobEstimate, JobSpec, LeaseTime
from fleet.bus.protocol.messages import LISTED_BYTES, Count, FiniteStruct, Name, Number, encode
from fleet.bus.protocol.operator import Operation


class Bid(FiniteStruct, frozen=True):
    """Published under `arm/{arm}/bid`: jobs that an arm would take, and at what cost."""

    arm: Name
    number: Count
    """Counts the bids of this arm; unique, with a gap after a restart."""
    time_s: Number
    """Fleet time of this arm; the latest time of any arm is that of the fleet."""
    capacity: Count
    """How many more jobs it would accept now."""
    estimates: Annotated[tuple[JobEstimate, ...], msgspec.Meta(max_length=MOST_JOBS)]
    """Estimates of jobs that wait for an arm, as far as this arm has been informed."""
    open_count: Count
    """Number of jobs without an outcome at this arm. A peer with more of them sends some."""
    open_jobs: Annotated[tuple[Name, ...], msgspec.Meta(max_length=MOST_JOBS)] = ()
    """The first jobs without an outcome, by release and name. A peer that has an outcome, or a missing job, sends
    it."""
    choice: str = ""
    """The job among the estimates that this arm's policy chose; "" for none yet."""
    choice_plan: Count = 0
    """Number of the plan that it chose."""
    epoch: str = ""
    """Name of the shift, as in `Clock`; an arm that has none takes that of the first bid."""
    digest: Count = 0
    """Checksum of the job outcomes and operator requests at this arm. A peer with another checksum sends its own."""


class ClaimEntry(msgspec.Struct, frozen=True):
    """A job that an arm has or requests."""

    award: Name
    """Unique per job and attempt; this arm never uses it again."""
    job: Name
    places: Annotated[tuple[Name, ...], msgspec.Meta(max_length=2)]
    """Stations that it occupies."""
    cycles: Count
    """Done so far, by any arm."""
    phase: Literal["requested", "queued", "working", "finishing"]
    """requested: not granted yet; finishing: requests permission to commit (to begin the last cycle), or has it."""
    space: Name | None = None
    """Name of the space of its plan, from home to home; null for unknown: its whole workspace counts as taken."""


Faults = Annotated[dict[Name, Name], msgspec.Meta(max_length=16)]
"""Faults in a job at the sender: the arm, by award."""


class JobOutcome(FiniteStruct, frozen=True):
    """Outcome of a job, or of one attempt at it."""

    job: Name
    award: Name
    arm: Name
    """The arm that had the job."""
    outcome: Literal["finished", "unfinished", "given_up", "cancelled", "returned"]
    """unfinished: the arm crashed after it got permission to commit, and no arm does the job again; given_up: abandoned
    after repeated faults; cancelled: by an operator; returned: the job is open again."""
    cycles: Count
    time_s: Number
    reason: str = ""
    faults: Faults = {}  # noqa: RUF012 - msgspec copies it


class Claim(msgspec.Struct, frozen=True):
    """Request to `arm/*/claim/{arm}`: all jobs that an arm has or requests, and outcomes. A job that was granted to it
    before and is not in here is released."""

    arm: Name
    number: Count
    """Counts the claims of this arm; a claim that is older than the last one is refused."""
    entries: Annotated[tuple[ClaimEntry, ...], msgspec.Meta(max_length=MOST_JOBS)]
    outcomes: Annotated[tuple[JobOutcome, ...], msgspec.Meta(max_length=MOST_JOBS)] = ()
    jobs: Annotated[tuple[JobSpec, ...], msgspec.Meta(max_length=MOST_JOBS)] = ()
    """Jobs that the arm has accepted, and those that a peer lacks, as its last messages show."""
    operations: Annotated[tuple[Operation, ...], msgspec.Meta(max_length=MOST_JOBS)] = ()
    """Operator requests that a peer lacks, as its last messages show. Of several requests that set the same value, the
    latest applies: by `time_s`, then by name."""
    space: Annotated[tuple[Name, ...], msgspec.Meta(max_length=MOST_JOBS)] | None = None
    """Names of the spaces that the arm takes now; empty at home. All other space that was granted to it before and is
    not of its entries is free. null if not reported: its whole workspace counts as taken."""


class GrantedEntry(msgspec.Struct, frozen=True):
    """A granted job."""

    award: Name
    cycles: Count
    """Cycles of the job that are done, at the granter."""
    may_commit: bool = False
    """Permission to commit, by this granter: the last cycle may begin, and it grants the job to no other arm."""
    faults: Faults = {}


class DeniedEntry(msgspec.Struct, frozen=True):
    """A job that is denied now."""

    award: Name
    reason: str
    outcome: JobOutcome | None = None
    """Its outcome, if it has one."""
    committed: JobOutcome | None = None
    """As in `History`; the claimer records it."""


class ClaimReply(msgspec.Struct, frozen=True):
    """Reply to a `Claim`, durable at the granter before it is sent."""

    arm: Name
    number: Count
    """Number of the claim that this answers."""
    lease_s: LeaseTime
    """Real seconds, counted by the claimer from the moment it sent the claim."""
    granted: tuple[GrantedEntry, ...] = ()
    denied: tuple[DeniedEntry, ...] = ()


MOST_FINISHED = 256
"""Maximum number of finished jobs in a `History`, the last ones."""


class HistoryRequest(msgspec.Struct, frozen=True):
    """Request to `arm/*/history`: finished jobs and current awards. An auctioneer sends it before its first award."""


class History(msgspec.Struct, frozen=True):
    """Reply to a `HistoryRequest`, from the journal of the arm."""

    arm: Name
    epoch: str = ""
    """Of the last award that it accepted, or of its grants; "" for none."""
    finished: Annotated[tuple[JobSpec, ...], msgspec.Meta(max_length=MOST_FINISHED)] = ()
    """Jobs that it finished, in any epoch, oldest first; as many of the last ones as fit into one message."""
    awards: Annotated[tuple[Award, ...], msgspec.Meta(max_length=MOST_JOBS)] = ()
    """Accepted awards that have not ended, with the cycles done so far."""
    may_commit: Annotated[tuple[Name, ...], msgspec.Meta(max_length=MOST_JOBS)] = ()
    """Awards among these with permission to commit."""
    claims: Annotated[dict[Name, Count], msgspec.Meta(max_length=MOST_JOBS)] = {}
    """Number of the last claim of each arm, where arms allocate jobs without an auctioneer."""
    committed: Annotated[tuple[JobOutcome, ...], msgspec.Meta(max_length=MOST_JOBS)] = ()
    """Unfinished: jobs reported as unsure. Without an auctioneer, jobs of arms with permission to commit."""
    time_s: Number = 0.0
    """Fleet time of `epoch` by the arm's clock; 0 for unknown. An auctioneer that restarts continues from it."""


def with_finished(history: History, jobs: Sequence[JobSpec]) -> History:
    """Return a history with finished jobs, oldest first: as many of the last ones as fit into one message."""
    sizes = accumulate((len(encode(job)) + 1 for job in reversed(jobs[-MOST_FINISHED:])), initial=len(encode(history)))
    count = sum(size <= LISTED_BYTES for size in sizes) - 1
    return replace(history, finished=tuple(jobs[len(jobs) - max(0, count) :]))
