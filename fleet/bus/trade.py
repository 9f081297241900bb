"""What arms, auctioneers and outsiders say to each other about jobs: the words of the auction.

The order of a job's life: a `Submission` is acknowledged; the auctioneer asks all arms for a `Quote` and sends the
`Award` to one, which answers an `Ack`; while it holds the job it renews its lease with a `LeaseRequest`; before its
last cycle it asks for leave to finish; then it makes a `Report`, again and again until there is a `Receipt`.

Why a job is never done twice: an arm takes an award only within `Quote.valid_s` of its own quote, works only while it
holds a lease that it counts from the moment it *asked*, and begins the last cycle only with leave to finish. The
auctioneer counts the same lease from the moment it *answered*, so it always ends later there; it gives the job to
another only after that, and never once it has given leave to finish. Durations are real seconds on each one's own
monotonic clock: nobody's wall clock matters. (Leases: Gray & Cheriton 1989, SOSP.)

Units: fields that end in `_s` are seconds of the fleet's time, unless they say *real*.
"""

from typing import Annotated, Literal

import msgspec

from fleet.bus.messages import Name, finite
from fleet.job import Kind
from fleet.telemetry import Mode

Count = Annotated[int, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
MOST_JOBS = 128
"""In one word: more are several words, so that none grows beyond what the router lets through."""


class JobWord(msgspec.Struct, frozen=True, omit_defaults=True):
    """A job as it travels; what its fields mean is said in `fleet.job.Work` and `fleet.job.Job`."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=128)]
    """Unique in the fleet: the same name again is the same job."""
    kind: Kind
    places: Annotated[tuple[Name, ...], msgspec.Meta(min_length=1, max_length=2)]
    """Names of places of the cell: from, to for pick_place and sort; one for hold and press."""
    repetitions: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 1
    payload_kg: NotNegative = 0.0
    dwell_s: Positive = 0.5
    force_n: NotNegative = 0.0
    release_s: NotNegative = 0.0
    """Not before this."""
    due_s: float | None = None
    """Soft; None for no hurry."""
    value: float = 1.0
    after: tuple[Name, ...] = ()
    """Jobs that must be finished first."""

    def __post_init__(self) -> None:
        wanted = 2 if self.kind in ("pick_place", "sort") else 1
        if len(self.places) != wanted:
            raise ValueError(f"A {self.kind} needs {wanted} place(s), got {len(self.places)}.")
        if self.due_s is not None and self.due_s < self.release_s:
            raise ValueError(f"JobWord.due_s must be >= release_s = {self.release_s:g} (got {self.due_s:g}).")
        for name in ("payload_kg", "dwell_s", "force_n", "release_s", "due_s", "value"):
            finite("JobWord", name, (getattr(self, name),))


Jobs = Annotated[tuple[JobWord, ...], msgspec.Meta(min_length=1, max_length=MOST_JOBS)]


class Submission(msgspec.Struct, frozen=True):
    """To `jobs/submit`: jobs that somebody wants done. The same job twice is one job."""

    jobs: Jobs
    by: str = ""
    """Who asks, for the records."""


class Admission(msgspec.Struct, frozen=True):
    """What became of one submitted job."""

    job: str
    accepted: bool
    """True also for one that was there already, word for word."""
    reason: str = ""


class Submitted(msgspec.Struct, frozen=True):
    """Answer to a `Submission`: every accepted job is on disk."""

    auctioneer: Name
    jobs: tuple[Admission, ...]


class QuoteRequest(msgspec.Struct, frozen=True):
    """To `arm/*/quote`: what would these jobs cost you?"""

    auction: Name
    """Name of this round; anything for a dry run."""
    jobs: Jobs
    dry_run: bool = False
    """Only asking: the quote cannot be awarded, and nothing changes at the arm."""


class Offer(msgspec.Struct, frozen=True):
    """One job in a quote; what is not known is null."""

    job: Name
    feasible: bool
    reason: str = ""
    """Why not, where it is not feasible."""
    difficulty: tuple[float, ...] | None = None
    """d_k, [joint]."""
    d: float | None = None
    """Σ_k d_k."""
    p_saturation: Share | None = None
    """Probability that a motor passes the warning limit, from the temperatures of now."""
    peak_c: float | None = None
    """Hottest motor that the arm predicts during the job."""
    duration_s: float | None = None
    """Of the job alone."""
    finish_in_s: float | None = None
    """Until it would be finished, from now: what the arm has in hand comes first."""

    def __post_init__(self) -> None:
        finite("Offer", "difficulty", self.difficulty or ())
        for name in ("d", "p_saturation", "peak_c", "duration_s", "finish_in_s"):
            finite("Offer", name, (getattr(self, name),))


class Quote(msgspec.Struct, frozen=True):
    """Answer to a `QuoteRequest`."""

    arm: Name
    auction: Name
    quote: str
    """Name of this quote, never used again by this arm, also after a restart; "" for a dry run."""
    valid_s: float
    """Real seconds during which the arm takes an award on it, counted by the arm."""
    twin: str
    """Version of the twin that scored."""
    time_s: float
    mode: Mode
    headroom_k: float
    capacity: Count
    """How many more jobs the arm would take now."""
    offers: tuple[Offer, ...]
    """One per job asked for, in that order."""

    def __post_init__(self) -> None:
        for name in ("valid_s", "time_s", "headroom_k"):
            finite("Quote", name, (getattr(self, name),))


class Award(msgspec.Struct, frozen=True):
    """To `arm/{arm}/award`: this job is yours. The same award again gets the same answer and changes nothing.

    A refusal is final: neither this award nor another for that job on the same quote will be taken later.
    """

    award: Name
    """Unique per job and auction."""
    auction: Name
    auctioneer: Name
    quote: Name
    """The quote it rests on."""
    job: JobWord
    cycles: Count = 0
    """Cycles of it that others have done already."""
    lease_s: Positive = 6.0
    """Real seconds that the arm may work on it without renewing, counted from its quote."""


class Ack(msgspec.Struct, frozen=True):
    """Answer to an `Award`, on the arm's disk before it is given."""

    arm: Name
    award: Name
    accepted: bool
    reason: str = ""
    """Why not."""


class Hold(msgspec.Struct, frozen=True):
    """A job that an arm has in hand."""

    award: Name
    job: Name
    cycles: Count
    """Done so far, those of others included."""
    phase: Literal["queued", "working", "finishing"]
    """finishing: asks for leave to begin the last cycle, or has it."""


class LeaseRequest(msgspec.Struct, frozen=True):
    """To `auction/{auctioneer}/lease/{arm}`: these are the jobs I hold; may I go on?"""

    arm: Name
    holds: Annotated[tuple[Hold, ...], msgspec.Meta(max_length=MOST_JOBS)]


class Lease(msgspec.Struct, frozen=True):
    """Answer to a `LeaseRequest`."""

    auctioneer: Name
    lease_s: Positive
    """Real seconds, counted by the arm from the moment it asked."""
    granted: tuple[str, ...]
    """Awards that the arm may go on with."""
    lost: tuple[str, ...]
    """Awards that are no longer its own: it must let go of them."""
    leave: tuple[str, ...] = ()
    """Awards whose last cycle it may begin; nobody else gets those jobs any more."""


class Report(msgspec.Struct, frozen=True):
    """To `auction/{auctioneer}/report/{arm}`: what became of an award. Said again until there is a `Receipt`."""

    arm: Name
    award: Name
    job: Name
    outcome: Literal["finished", "returned"]
    cycles: Count
    """Done so far, those of others included."""
    time_s: float
    """When it was finished or given back."""
    reason: str = ""
    unsure: bool = False
    """With `returned`: the arm crashed after it was given leave to finish, so nobody knows whether the last cycle was
    done. The job is reported unfinished rather than given to another, who might do that cycle a second time."""

    def __post_init__(self) -> None:
        finite("Report", "time_s", (self.time_s,))


class Receipt(msgspec.Struct, frozen=True):
    """Answer to a `Report`: it is on the auctioneer's disk."""

    auctioneer: Name
    award: Name


JobState = Literal["waiting", "awarded", "finishing", "finished", "unfinished"]
"""waiting: for its release, its predecessors or an arm; finishing: in its last cycle; unfinished: it was given leave to
finish and nobody has heard since, or the fleet ended before it was done."""


class JobStatus(msgspec.Struct, frozen=True):
    """Where a job stands."""

    job: Name
    state: JobState
    arm: str = ""
    award: str = ""
    cycles: Count = 0
    finished_s: float | None = None
    reason: str = ""


class StatusRequest(msgspec.Struct, frozen=True):
    """To `jobs/status`: where do these jobs stand? All of them if none is named; of more than 128, all that one answer
    holds, those that may still change come first."""

    jobs: tuple[str, ...] = ()


class Status(msgspec.Struct, frozen=True):
    """Answer to a `StatusRequest`; names that nobody knows are left out."""

    auctioneer: Name
    time_s: float
    jobs: tuple[JobStatus, ...]


class Announce(msgspec.Struct, frozen=True):
    """Under `auction/{auctioneer}/announce`: a round begins."""

    auctioneer: Name
    auction: Name
    time_s: float
    jobs: tuple[str, ...]


class Result(msgspec.Struct, frozen=True):
    """Under `auction/{auctioneer}/result`: a job's state has changed."""

    auctioneer: Name
    number: Count
    """Counts the results of this auctioneer, also over restarts."""
    time_s: float
    status: JobStatus
    auction: str = ""
    d: float | None = None
    """Difficulty that the arm quoted."""
    p_saturation: float | None = None


class ArmEvent(msgspec.Struct, frozen=True, omit_defaults=True):
    """Under `arm/{arm}/event`: something happened to an arm; kinds as in `fleet.events`."""

    arm: Name
    number: Count
    """Counts the events of this arm; never the same again, and with a leap after a restart."""
    time_s: float
    kind: Name
    job: str = ""
    joint: Annotated[int, msgspec.Meta(ge=0)] = 0
    value: float | None = None
    reason: str = ""


class ClockRequest(msgspec.Struct, frozen=True):
    """To `clock/now`: what time is it in the fleet?"""


class Clock(msgspec.Struct, frozen=True):
    """Answer to a `ClockRequest`."""

    time_s: float
    """The fleet's time when this was said."""
    speed: Positive
    """Fleet seconds per real second."""

    def __post_init__(self) -> None:
        finite("Clock", "time_s", (self.time_s,))
        finite("Clock", "speed", (self.speed,))
