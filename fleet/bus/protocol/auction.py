"""Messages of the auction between arms, auctioneers and outsiders.

The life of a job: a `Submission` is acknowledged; the auctioneer queries all arms for a `Quote` and sends the `Award`
to one, which replies with an `Ack`. While the arm has the job it renews its lease with a `LeaseRequest`; before the
last cycle it requests permission to commit. Then it repeats a `Report` until there is a `Receipt`.

Why no job is done twice: an arm accepts an award only within `Quote.valid_s` of its own quote, works only under a lease
that it counts from the moment it sent the request, and begins the last cycle only with permission to commit too. The
auctioneer counts the same lease from the moment it replied, so at the auctioneer it always ends later. Only after that
does another arm get the job, and never once permission to commit was given. Durations are real seconds on each one's
own monotonic clock; wall clocks do not matter. (Leases: Gray & Cheriton 1989, SOSP.)

Units: fields that end in `_s` are seconds of fleet time, unless they say *real*.
"""

from math import inf
from typing import Annotated, Literal

import msgspec

from fleet.bus.protocol.messages import (
    MOST,
    Celsius,
    Count,
    Difficulty,
    Duration,
    FiniteStruct,
    Name,
    Number,
    Person,
    PersonRequest,
    Share,
)
from fleet.errors import check_names, distinguish
from fleet.fields import MAX_SPEED, MIN_SPEED
from fleet.job import (
    BOUNDS,
    DWELL_S,
    MOST_ALTERNATIVES,
    Kind,
    check_alternatives,
    check_bounds,
    check_duration,
    check_dwell,
    shared_stations,
)
from fleet.telemetry import Mode

LeaseTime = Annotated[float, msgspec.Meta(gt=0, le=3600)]
PlanTime = Annotated[float, msgspec.Meta(gt=0, le=MOST)]
LEASE_S = 6.0
"""Real seconds that an arm may work on a job without renewing its lease."""
NOT_PLANNED = "not planned yet; ask again"
"""Reason of an estimate that the arm will have soon."""
MOST_PLANS, MOST_OFFERS = 8, 8
"""Plans of one arm for one job; offers in a `Result`."""
MOST_QUOTED, MOST_JOBS = 64, 128
"""Jobs in one quote and in one message, so that none exceeds the router's size limit; more take several messages."""


def _bounds(name: str) -> msgspec.Meta:
    """Bounds of a number in the JSON schema; `JobSpec` itself checks them, as its error also names the value."""
    return msgspec.Meta(extra_json_schema={"minimum": BOUNDS[name].low, "maximum": BOUNDS[name].high})


class JobSpec(msgspec.Struct, frozen=True, omit_defaults=True):
    """A job on the bus; fields as in `fleet.job.Work` and `fleet.job.Job`."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=128)]
    """Unique in the fleet; a second job with this name is the same job."""
    kind: Kind
    """What an arm does in a cycle, as in [CellKind](#cellkind)."""
    places: Annotated[tuple[Name, ...], msgspec.Meta(min_length=1, max_length=2)]
    """Places of the cell: from and to for pick_place and sort; one for hold and press."""
    repetitions: Annotated[int, _bounds("repetitions")] = 1
    """Cycles of the job."""
    payload_kg: Annotated[float, _bounds("payload_kg")] = 0.0
    dwell_s: Annotated[float, _bounds("dwell_s")] = DWELL_S
    force_n: Annotated[float, _bounds("force_n")] = 0.0
    release_s: Annotated[float, _bounds("release_s")] = 0.0
    """Earliest start, fleet time."""
    due_s: Annotated[float, _bounds("due_s")] | None = None
    """Due date, fleet time, not before `release_s`; null for none."""
    value: Annotated[float, _bounds("value")] = 1.0
    """What finishing it is worth, in any unit that all jobs share."""
    after: tuple[Name, ...] = ()
    """Jobs that must be finished before."""
    expires: bool = False
    """The due date is hard: a job that still waits then becomes `given_up`."""
    alternatives: Annotated[tuple[tuple[Name, ...], ...], msgspec.Meta(max_length=MOST_ALTERNATIVES - 1)] = ()
    """Other places that serve as well as `places`: parallel stations."""

    @property
    def every_places(self) -> tuple[tuple[str, ...], ...]:
        """`places` and the alternatives."""
        return (self.places, *self.alternatives)

    @property
    def stations(self) -> tuple[str, ...]:
        """The places that the job occupies wherever it is done."""
        return shared_stations(self.every_places)

    def __post_init__(self) -> None:
        check_names(self, "name", "after", of_jobs=True)
        check_names(self, "places", "alternatives")
        check_alternatives(self, self.kind, self.every_places)
        check_bounds(self, "repetitions", "payload_kg", "dwell_s", "force_n", "release_s", "due_s", "value")
        check_dwell(self, self.kind, self.dwell_s)
        check_duration(self, self.dwell_s, self.repetitions)
        if self.due_s is not None and self.due_s < self.release_s:
            release, due = distinguish(self.release_s, self.due_s, 6)
            raise ValueError(f"JobSpec.due_s must be >= release_s = {release} (got {due}).")


Jobs = Annotated[tuple[JobSpec, ...], msgspec.Meta(min_length=1, max_length=MOST_JOBS)]


class Submission(PersonRequest, frozen=True):
    """Request to `jobs/submit`: add jobs. The same job submitted twice is one job."""

    jobs: Jobs
    by: Person = ""
    """Who submits, for the records."""


class Admission(msgspec.Struct, frozen=True):
    """Whether one submitted job was accepted."""

    job: str
    accepted: bool
    """Also true for an identical job that was accepted before."""
    reason: str = ""
    """Why it is not accepted. Of an accepted job: why it is `given_up` at once, or that it has ended already; otherwise
    ""."""


class SubmissionReply(msgspec.Struct, frozen=True):
    """Reply to a `Submission`; accepted jobs are durable."""

    auctioneer: Name
    jobs: tuple[Admission, ...]
    epoch: str = ""
    """As in `Clock`. A changed epoch means that the fleet has lost its journal: submit open jobs again."""


class QuoteRequest(msgspec.Struct, frozen=True):
    """Request to `arm/*/quote`: estimate the cost of these jobs."""

    auction: Name
    """Name of this round; any text for a dry run."""
    jobs: Annotated[tuple[JobSpec, ...], msgspec.Meta(min_length=1, max_length=MOST_QUOTED)]
    dry_run: bool = False
    """Only an estimate: the quote cannot be awarded, and nothing changes at the arm."""
    cycles: Annotated[dict[Name, Count], msgspec.Meta(max_length=MOST_QUOTED)] = {}
    """Cycles that are done, by job; 0 if not named. The estimate is for the other cycles."""


class PlanQuote(FiniteStruct, frozen=True, omit_defaults=True):
    """Cost of one job for one arm by one of its plans; unknown values are null or left out."""

    plan: Count = 0
    """Number of the plan: an `Award` names it. Different for each plan of a job."""
    peak_c: Celsius | None = None
    """Predicted temperature of the hottest motor during the job."""
    gained_k: Number | None = None
    """`peak_c` above the hottest motor now."""
    p_saturation: Share | None = None
    """Probability that a motor passes the warning limit, starting from the present temperatures."""
    joint_difficulty: tuple[Difficulty, ...] | None = None
    """d_k, [joint]."""
    difficulty: Difficulty | None = None
    """d = Σ_k w_k d_k, with the weights of the arm's twin (`fleet.difficulty`)."""
    duration_s: PlanTime | None = None
    """Duration of the job alone, from home to home."""
    finish_in_s: Duration | None = None
    """Time until its last cycle would be done, after the arm's current jobs; without the way home."""
    space: Name | None = None
    """Name of the space of its plan, from home to home, or a sphere that it does not leave, in the frame of the cell,
    as `sphere:1.5,0,0.4,0.8` (X, Y, Z, radius, m); null for unknown: its whole workspace counts as taken."""


class JobEstimate(msgspec.Struct, frozen=True, omit_defaults=True):
    """The plans by which an arm can do a job, the fastest first, and what each costs."""

    job: Name
    plans: Annotated[tuple[PlanQuote, ...], msgspec.Meta(max_length=MOST_PLANS)] = ()
    """Empty if the job is not feasible for the arm."""
    reason: str = ""
    """Why it is not."""
    too_heavy: bool = False
    """Whether the reason is that the load exceeds the arm's rating."""

    def __post_init__(self) -> None:
        if len({plan.plan for plan in self.plans}) < len(self.plans):
            raise ValueError(f"JobEstimate.plans of '{self.job}' must have different numbers.")
        if self.too_heavy and self.plans:
            raise ValueError(f"JobEstimate.too_heavy of '{self.job}' must be false, as it has plans.")

    @property
    def feasible(self) -> bool:
        """Whether the arm can do the job."""
        return bool(self.plans)

    @property
    def least(self) -> PlanQuote:
        """Lowest-difficulty plan, or an empty PlanQuote."""
        return min(
            self.plans, key=lambda plan: inf if plan.difficulty is None else plan.difficulty, default=PlanQuote()
        )


class Quote(FiniteStruct, frozen=True):
    """Reply to a `QuoteRequest`."""

    arm: Name
    auction: Name
    quote: str
    """Name of this quote, which this arm never uses again, not even after a restart; "" for a dry run."""
    valid_s: Duration
    """Real seconds during which the arm accepts an award that refers to it, counted by the arm."""
    twin: str
    """Version of the twin that scored."""
    time_s: Number
    mode: Mode
    headroom_k: Number
    capacity: Count
    """How many more jobs the arm would accept now."""
    estimates: tuple[JobEstimate, ...]
    """One per requested job, in that order."""
    space: Annotated[tuple[Name, ...], msgspec.Meta(max_length=MOST_JOBS)] | None = None
    """Names of the spaces that the arm takes now and those of its jobs; empty at home without jobs. null if not
    reported: the arm then counts as at home if its mode is idle, otherwise its whole workspace counts as taken."""


class Award(msgspec.Struct, frozen=True):
    """Request to `arm/{arm}/award`: take this job. The same award again gets the same reply and changes nothing.

    A rejection is final: the arm later accepts neither this award nor another for the same job and quote.
    """

    award: Name
    """Unique per job and auction."""
    auction: Name
    auctioneer: Name
    quote: Name
    """The quote that it refers to."""
    job: JobSpec
    cycles: Count = 0
    """Cycles of the job that other arms have done."""
    lease_s: LeaseTime = LEASE_S
    """Real seconds that the arm may work on it without renewing the lease, counted from its quote."""
    plan: Count = 0
    """Number of the quoted plan by which to do it."""
    epoch: str = ""
    """As in `Clock`; the arm stores the last one in its journal."""


class Ack(msgspec.Struct, frozen=True):
    """Reply to an `Award`, durable at the arm before it is sent."""

    arm: Name
    award: Name
    accepted: bool
    reason: str = ""
    """Why the award is rejected."""


class LeaseEntry(msgspec.Struct, frozen=True):
    """A current job of an arm, for which it holds or requests a lease."""

    award: Name
    job: Name
    cycles: Count
    """Done so far, by any arm."""
    phase: Literal["queued", "working", "finishing"]
    """finishing: requests permission to commit (to begin the last cycle), or has it."""


class LeaseRequest(msgspec.Struct, frozen=True):
    """Request to `auction/{auctioneer}/lease/{arm}`: renew the leases of these jobs."""

    arm: Name
    entries: Annotated[tuple[LeaseEntry, ...], msgspec.Meta(max_length=MOST_JOBS)]


class Lease(msgspec.Struct, frozen=True):
    """Reply to a `LeaseRequest`."""

    auctioneer: Name
    lease_s: LeaseTime
    """Real seconds, counted by the arm from the moment it sent the request."""
    granted: tuple[str, ...]
    """Awards whose lease is renewed."""
    revoked: tuple[str, ...]
    """Lost awards: the arm begins no further cycle of them, goes home and reports them."""
    may_commit: tuple[str, ...] = ()
    """Awards with permission to commit: the last cycle may begin under a lease, and these jobs go to no other arm."""


class Report(FiniteStruct, frozen=True):
    """Request to `auction/{auctioneer}/report/{arm}`: outcome of an award. Repeated until there is a `Receipt`."""

    arm: Name
    award: Name
    job: Name
    outcome: Literal["finished", "returned"]
    cycles: Count
    """Done so far, by any arm."""
    time_s: Number
    """When it was finished or returned."""
    reason: str = ""
    unsure: bool = False
    """With `returned`: the arm crashed after it got permission to commit, so it is unknown whether the last cycle was
    done. The job becomes unfinished; another arm might do that cycle a second time."""
    faulted: bool = False
    """With `returned`: the arm faulted in this job. After two faults of one arm, or three of all arms, the job becomes
    `given_up`."""
    restarted: bool = False
    """With `returned`: at a restart. Unsure if the arm had permission to commit."""


class Receipt(msgspec.Struct, frozen=True):
    """Reply to a `Report`, which is durable at the auctioneer."""

    auctioneer: Name
    award: Name


JobState = Literal["waiting", "awarded", "finishing", "finished", "unfinished", "given_up", "cancelled"]
"""waiting: for its release, its predecessors or an arm; finishing: in its last cycle; unfinished: the arm had
permission to commit and sent no message since, or the shift ended before the job was done; given_up: abandoned after
repeated faults in it, or in a job that it waits for; cancelled: by a `ControlRequest`."""
ABANDONED: tuple[JobState, ...] = ("given_up", "cancelled")
SETTLED: tuple[JobState, ...] = ("finished", "unfinished", *ABANDONED)
"""Final states; only a late report that the job is finished, or a `ControlRequest`, may change those other than
finished."""


class JobStatus(msgspec.Struct, frozen=True):
    """State of one job."""

    job: Name
    state: JobState
    arm: str = ""
    """The arm that has it, or had it last; "" for none."""
    award: str = ""
    """The award by which that arm has it, or finished it; "" if it no longer has it."""
    cycles: Count = 0
    """Reported as done, of `repetitions`; the same in a status and a `Result`."""
    finished_s: Number | None = None
    reason: str = ""
    repetitions: Count = 0
    """Cycles of the job; 0 for unknown."""
    finish_s: Number | None = None
    """Predicted fleet time at which it is finished and its arm at home; null for unknown, or if no arm is at work. Only
    `jobs/status` has it: it is null in a `Result`."""
    due_s: Number | None = None
    """Due date; null for none. A `Change` changes it."""
    value: Number | None = None
    """As in `JobSpec`; null for unknown. A `Change` changes it."""
    release_s: Number | None = None
    """As in `JobSpec`; null for unknown."""
    accepted_s: Number | None = None
    """Fleet time at which it was accepted; null for unknown."""
    shift_ended: bool = False
    """It is unfinished only because the shift has ended."""
    not_planned: bool = False
    """It waits, and no arm has a plan for it yet: it is unknown whether one can do it. Only
    `jobs/status` has it: it is false in a `Result`."""


class StatusRequest(msgspec.Struct, frozen=True):
    """Request to `jobs/status`: state of these jobs, or of all if none is named, in pages."""

    jobs: tuple[str, ...] = ()
    after: Annotated[str, msgspec.Meta(max_length=1024)] = ""
    """`next` of the page before; "" for the first page."""


class Status(msgspec.Struct, frozen=True):
    """Reply to a `StatusRequest`: a page of at most 128 jobs. Unknown names are left out."""

    auctioneer: Name
    time_s: Number
    jobs: tuple[JobStatus, ...]
    """First those that need a person: `unfinished`, unless only because the shift has ended. Then those in work, those
    that wait, by release, and all others, the newest first. A job that changes its state between two requests may be on
    two pages, or on none."""
    space: dict[Name, tuple[Name, ...]] = {}
    """Names of the spaces that are closed to other arms, by the arm that takes them or may take them; "*" is its whole
    workspace."""
    epoch: str = ""
    """As in `Clock`."""
    paused: dict[Name, str] = {}
    """Who paused an arm, by arm; "*" for all arms."""
    trouble: str = ""
    """Why its sender accepts and awards no jobs, for example a full disk; "" if it does."""
    left_out: dict[Name, str] = {}
    """Why an arm is awarded no job for a while, by arm: such as unanswered awards."""
    counts: dict[JobState, Count] = {}
    """Number of jobs by state, of all jobs: also those of other pages, and those that the request does not name. Empty
    if the sender does not count them; `jobs` then has all."""
    next: str = ""
    """Send it as `after` to get the next page; "" on the last page."""


class Announcement(msgspec.Struct, frozen=True):
    """Published under `auction/{auctioneer}/announce`: a round begins."""

    auctioneer: Name
    auction: Name
    time_s: Number
    jobs: tuple[str, ...]


class ArmOffer(msgspec.Struct, frozen=True, omit_defaults=True):
    """Offer of an arm for a job in the round in which the job was awarded."""

    arm: Name
    mode: Mode
    free: bool
    """Whether the arm was available: it had capacity, and the places and the space of a plan were free."""
    plan: PlanQuote | None = None
    """The awarded plan, or the lowest-difficulty plan of another arm, with some of its fields; null for none."""


Offers = Annotated[tuple[ArmOffer, ...], msgspec.Meta(max_length=MOST_OFFERS)]


class Result(msgspec.Struct, frozen=True):
    """Published under `auction/{auctioneer}/result`: the state of a job has changed."""

    auctioneer: Name
    number: Count
    """Counts the results of this auctioneer, across restarts."""
    time_s: Number
    status: JobStatus
    auction: str = ""
    difficulty: Number | None = None
    """Quoted by the arm, as are the next two."""
    p_saturation: Number | None = None
    peak_c: Number | None = None
    by: str = ""
    """Who requested the change, by a `Submission` or a `ControlRequest`, or paused the arm that stopped."""
    epoch: str = ""
    """As in `Clock`: `number` restarts with a new epoch."""
    offers: Offers = ()
    """With an award: the offer of its arm, then the best others; empty for other states."""


class ArmEvent(msgspec.Struct, frozen=True, omit_defaults=True):
    """Published under `arm/{arm}/event`: something happened to an arm."""

    arm: Name
    number: Count
    """Counts the events of this arm; unique, with a gap after a restart."""
    time_s: Number
    """Exact fleet time of the event."""
    kind: Name
    """One of those below; skip others."""
    job: str = ""
    """Its job; "" for none."""
    joint: Annotated[int, msgspec.Meta(ge=0, le=64)] = 0
    """Motor, from 1; 0 for none."""
    value: Number | None = None
    """Quantity of the kind; null or left out for none."""
    reason: str = ""
    """Why, in words."""
    epoch: str = ""
    """As in `Clock`, of its time; "" for unknown."""


class ClockRequest(msgspec.Struct, frozen=True):
    """Request to `clock/now`: the fleet time."""


class Clock(FiniteStruct, frozen=True):
    """Reply to a `ClockRequest`."""

    time_s: Number
    """Fleet time of the reply."""
    speed: Annotated[float, msgspec.Meta(ge=MIN_SPEED, le=MAX_SPEED)]
    """Fleet seconds per real second."""
    epoch: str = ""
    """Name of the journal that the fleet continues; a new one after its loss, or in a new shift."""
