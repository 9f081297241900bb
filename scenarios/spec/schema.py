"""The schema of scenario files, with the defaults that `fleet` does not define."""

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from fleet.arrivals import Arrivals
from fleet.breaks import Break
from fleet.bus.exchange.channel import PERFECT, Channel, check_channel
from fleet.engine.batch import RewardWeights
from fleet.env.validation import Decisions
from fleet.errors import MAX_NAME, FleetError, check_between, check_names, check_nonnegative, check_positive, nearest
from fleet.heat.effects import LONGEST_CONTACT_S, SHORTEST_CONTACT_S, burn_threshold_c
from fleet.job import (
    BOUNDS,
    DWELL_S,
    Fixture,
    Kind,
    Place,
    check_alternatives,
    check_bounds,
    check_duration,
    check_dwell,
    check_force,
)
from fleet.observation import MOST_SLOTS
from fleet.robot import Cooling, Mount, Robot, ThermalLimits

SplitName = Literal["train", "validation", "test"]
SPLITS: tuple[SplitName, ...] = get_args(SplitName)
"""Of the suite."""
MOST_SAMPLES = 1_000_000
"""Telemetry samples of an arm in a shift: eleven days at one per second."""
MOST_CLEARANCE_M = 0.2
MOST_FIXTURES = 64
MOST_EXPLORATION = 10_000
MOST_SPREAD = 10.0
MOST_WEIGHT = 1e9
MOST_NOISE_K = 50.0
MOST_BREAKS = 1000
_NOT_OF_ROBOT = ("position_m", "tilt_deg", "sensor_noise_k", "fails")
_NUMBER = 8
"""Characters that the name of a job may have after that of its stream."""


@dataclass(frozen=True, kw_only=True)
class Failures:
    """Failures of an arm that have nothing to do with heat, at random: each stops it at once, until it is repaired."""

    every_s: float
    """Mean time from a repair to the next failure."""
    repair_s: float
    """Mean time to repair."""

    def __post_init__(self) -> None:
        check_between(self, 60.0, BOUNDS["due_s"].high, "every_s")
        check_between(self, 1.0, BOUNDS["due_s"].high, "repair_s")


@dataclass(frozen=True, kw_only=True)
class ArmSpec:
    """One arm of a scenario; `fleet.robot.Robot` and `Mount` define the fields."""

    name: str
    position_m: tuple[float, float, float] = Mount.position_m
    tilt_deg: tuple[float, float, float] = Mount.tilt_deg
    home: str = Robot.home
    tool_kg: float = Robot.tool_kg
    payload_limit_kg: float | None = Robot.payload_limit_kg
    cooling: Cooling = Robot.cooling
    cooling_factor: float = Robot.cooling_factor
    ambient_offset_k: float = Robot.ambient_offset_k
    wear: float = Robot.wear
    sensor_noise_k: float | None = None
    """Standard deviation of a reading of a motor temperature; None: that of the Gen3, at most 0.014 K."""
    fails: Failures | None = None
    """Failures other than by heat; None: it has none."""

    def __post_init__(self) -> None:
        self.robot()
        if self.sensor_noise_k is not None:
            check_between(self, 0.0, MOST_NOISE_K, "sensor_noise_k")

    def robot(self) -> Robot:
        """The arm with its mount."""
        own = {name: value for name, value in vars(self).items() if name not in _NOT_OF_ROBOT}
        return Robot(mount=Mount(position_m=self.position_m, tilt_deg=self.tilt_deg), **own)


@dataclass(frozen=True, kw_only=True)
class JobStream:
    """A kind of job that arrives repeatedly; payload and repetitions are sampled for each job."""

    name: str
    kind: Kind
    places: tuple[str | tuple[str, ...], ...]
    """Names of places: [from, to] for pick_place and sort, one for hold and press. Or a list of such lists: parallel
    stations, of which each arm takes those that suit it."""
    arrivals: Arrivals
    payload_kg: tuple[float, ...] = (0.0,)
    repetitions: tuple[int, int] = (1, 1)
    """Fewest and most."""
    dwell_s: float = DWELL_S
    """See `fleet.job.Work`: duration of one repetition of a hold or press."""
    force_n: float = 0.0
    value: float = 1.0
    due_s: float = 1800.0
    """Time from release to due date."""
    due: Literal["soft", "hard"] = "soft"
    """soft: a later finish is tardy. hard: a job that waits then expires, begun before or not."""
    after: tuple[str, ...] = ()
    """Streams whose job of the same number must finish first; a stream without such a job is not waited for."""
    numbered: bool = True
    """Whether the names of its jobs have a number after that of the stream. False for a row of a job table."""
    row: str = field(default="", compare=False)
    """File and row of a job of a job table, as errors name it."""

    def place_of(self, index: int, name: str) -> str:
        """Place of a field in its file, for errors; `index` is that of the stream in the scenario."""
        return f"{self.row}, column {name}" if self.row else f"jobs[{index}].{name}"

    @property
    def alternatives(self) -> tuple[tuple[str, ...], ...]:
        """Names of the places of each alternative."""
        alike = tuple(each for each in self.places if not isinstance(each, str))
        return alike or (tuple(each for each in self.places if isinstance(each, str)),)

    def __post_init__(self) -> None:
        if not self.payload_kg:
            raise ValueError("JobStream.payload_kg must not be an empty list")
        if len({isinstance(each, str) for each in self.places}) > 1:
            raise ValueError(f"JobStream.places must be names, or lists of names (got {list(self.places)})")
        check_alternatives(self, self.kind, self.alternatives)
        check_bounds(self, "payload_kg", "repetitions", "dwell_s", "force_n", "value", "due_s")
        low, high = self.repetitions
        if low > high:
            raise ValueError(f"JobStream.repetitions must be [fewest, most] (got {low}, {high})")
        check_dwell(self, self.kind, self.dwell_s)
        check_duration(self, self.dwell_s, high)
        check_force(self, self.kind, self.force_n)
        if not self.numbered and len(self.arrivals.times_s or ()) != 1:
            raise ValueError("JobStream.numbered = false is for streams of one job: arrivals with one time in times_s")


@dataclass(frozen=True, kw_only=True)
class Ambient:
    """Ambient temperature of the cell over the shift."""

    points: tuple[tuple[float, float], ...] = ((0.0, 25.0),)
    """(time s, °C), linear in between, constant outside."""

    def __post_init__(self) -> None:
        times = [t for t, _ in self.points]
        if not times or times != sorted(times):
            raise ValueError("Ambient.points must be a non-empty list of [time_s, temperature_c] in order of time")
        if not all(-40 <= c <= 60 for _, c in self.points):
            raise ValueError(f"Ambient.points must be between -40 and 60 °C (got {[c for _, c in self.points]})")

    def at(self, time_s: np.ndarray) -> np.ndarray:
        """Ambient temperatures at the times, °C, of the same shape."""
        times, temps = zip(*self.points, strict=True)
        return np.interp(time_s, times, temps)


@dataclass(frozen=True, kw_only=True)
class People:
    """People who may touch the arms during the shift."""

    contact_s: float = 1.0
    """Longest time for which they do: 1 s by mistake, minutes where they guide an arm or lean on it."""

    def __post_init__(self) -> None:
        check_between(self, SHORTEST_CONTACT_S, LONGEST_CONTACT_S, "contact_s")

    @property
    def burn_c(self) -> float:
        """Temperature of uncoated metal from which such a contact may burn."""
        return burn_threshold_c(self.contact_s)


@dataclass(frozen=True, kw_only=True)
class Planning:
    """Which plans each arm makes for a work."""

    elbows: int = 3
    speeds: tuple[float, ...] = (1.0, 0.6)
    """Shares of the arm's speed limits."""

    def __post_init__(self) -> None:
        check_between(self, 1, 12, "elbows")
        if not self.speeds:
            raise ValueError("Planning.speeds must have at least one share of the speed limits (got [])")
        check_between(self, 0.05, 1.0, "speeds")


@dataclass(frozen=True, kw_only=True)
class TwinSpec:
    """How the twins of the arms are trained."""

    size: Literal["quick", "full"] = "full"
    """quick: fewer windows and fewer epochs."""
    cool_c: float = 40.0
    """A motion is cool if no motor passes this temperature within the horizon."""
    horizon_s: float = 1800.0
    ambient_c: float = 22.0
    """Ambient temperature while the motion repeats from a cold start."""
    payload_kg: tuple[float, ...] = (0.0, 0.5, 1.0)
    """Light payloads with which every motion of the scenario is also simulated for training."""
    exploration: int = 64
    """Number of further light motions for training: folded, elbow out, fast wrist, turned base; 0: none."""
    air_c: tuple[float, float] | None = None
    """Lowest and highest ambient temperature of the cell in the arms' past jobs; None: those of the shift."""

    def __post_init__(self) -> None:
        check_positive(self, "horizon_s")
        if self.cool_c <= self.ambient_c:
            raise ValueError(f"TwinSpec.cool_c must be above ambient_c (got {self.cool_c}, {self.ambient_c})")
        if min(self.payload_kg, default=0.0) < 0:
            raise ValueError(f"TwinSpec.payload_kg must be masses >= 0 (got {list(self.payload_kg)})")
        if self.air_c is not None and not -40 <= self.air_c[0] <= self.air_c[1] <= 60:
            raise ValueError(f"TwinSpec.air_c must be [lowest, highest] between -40 and 60 °C (got {list(self.air_c)})")
        check_between(self, 0, MOST_EXPLORATION, "exploration")


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Random deviation of the arms from the nominal Gen3; the same for every seed of a run."""

    scale: float = 1.0
    """Factor on the log-normal standard deviations of `fleet.heat.thermal.ThermalSpread.gen3`; 0: equal arms."""
    seed: int = 0
    """Seed of the deviations."""

    def __post_init__(self) -> None:
        check_between(self, 0.0, MOST_SPREAD, "scale")
        check_nonnegative(self, "seed")


SurpriseKind = Literal["payload", "friction", "fan", "sensor"]
_SIZES: dict[SurpriseKind, tuple[float, float]] = {
    "payload": (0.1, 5.0),
    "friction": (0.0, 10.0),
    "fan": (0.0, 0.0),
    "sensor": (-50.0, 50.0),
}


@dataclass(frozen=True, kw_only=True)
class Surprise:
    """A change since the arms were prepared that their predictions do not contain.

    payload: the load of some jobs has another mass than declared. friction: the joints of an arm have more friction
    than when its network was identified. fan: the fan of an arm stops when the shift begins. sensor: the motor
    temperatures that an arm reads drift. The true temperatures still decide about warnings and faults.
    """

    kind: SurpriseKind
    arm: str = ""
    """The arm; "" for a payload."""
    jobs: str = ""
    """Of a payload: the stream of jobs."""
    size: float = 0.0
    """payload: factor on the mass, 0.1 to 5. friction: share of the friction of a new arm that is added, 0 to 10.
    sensor: drift of the readings, K/h, -50 to 50. fan: 0."""

    def __post_init__(self) -> None:
        subject, other = ("jobs", "arm") if self.kind == "payload" else ("arm", "jobs")
        if not getattr(self, subject) or getattr(self, other):
            given = f"{subject} = '{getattr(self, subject)}', {other} = '{getattr(self, other)}'"
            raise ValueError(f"Surprise of kind {self.kind} needs `{subject}` and no `{other}` (got {given})")
        check_between(self, *_SIZES[self.kind], "size")


@dataclass(frozen=True, kw_only=True)
class RewardSpec:
    """Weights of the reward terms; `fleet.engine.batch.RewardWeights` defines the fields."""

    finished_value: float = RewardWeights.finished_value
    tardiness: float = RewardWeights.tardiness
    above_warning: float = RewardWeights.above_warning
    faults: float | None = None
    """None: minus the price of a fault, see `scenarios.spec.jobs`."""
    energy: float = RewardWeights.energy

    def __post_init__(self) -> None:
        given = [name for name in vars(RewardWeights()) if getattr(self, name) is not None]
        check_between(self, -MOST_WEIGHT, MOST_WEIGHT, *given)
        for name in given:
            if name != "finished_value" and getattr(self, name) > 0:
                raise ValueError(
                    f"RewardSpec.{name} must be <= 0, as costs are negative (got {getattr(self, name):g})."
                )


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """One shift of one fleet in one cell."""

    name: str
    description: str
    horizon_s: float
    """In a scenario file a multiple of `decision_interval_s`."""
    arms: tuple[ArmSpec, ...]
    places: tuple[Place, ...]
    jobs: tuple[JobStream, ...]
    fixtures: tuple[Fixture, ...] = ()
    decision_interval_s: float = 10.0
    decisions: Decisions = "interval"
    """Length of a step of the environment: one decision interval, or until an arm has a choice."""
    clearance_m: float = 0.02
    """Smallest distance that two arms keep from each other."""
    slots: int = 16
    start: Literal["idle_warm", "cold"] = "idle_warm"
    telemetry_interval_s: float = 1.0
    ambient: Ambient = field(default_factory=Ambient)
    limits: ThermalLimits = field(default_factory=ThermalLimits)
    people: People = field(default_factory=People)
    reward: RewardSpec = field(default_factory=RewardSpec)
    planning: Planning = field(default_factory=Planning)
    twin: TwinSpec = field(default_factory=TwinSpec)
    spread: Spread = field(default_factory=Spread)
    bus: Channel = PERFECT
    """How the arms' messages reach their peers in a simulated shift. A channel that a command or a call is given, other
    than a perfect one, takes its place."""
    surprises: tuple[Surprise, ...] = ()
    breaks: tuple[Break, ...] = ()
    shift_begin: str | None = None
    """Date, time and zone of the begin of the shift, to which times of day refer."""
    time_zone: str | None = None
    """IANA name of the zone of times of day, such as Europe/Berlin, with its summer time; None: that of `shift_begin`,
    which then has one."""

    def __post_init__(self) -> None:
        check_positive(self, "horizon_s", "decision_interval_s", "telemetry_interval_s")
        if self.decision_interval_s > self.horizon_s:
            hours = f"; is horizon_s in hours? {self.horizon_s:g} h is {3600 * self.horizon_s:g} s"
            raise ValueError(
                "Scenario.decision_interval_s must not exceed horizon_s "
                f"(got {self.decision_interval_s}, {self.horizon_s}){hours if self.horizon_s <= 24 else ''}"
            )
        if self.telemetry_interval_s > self.decision_interval_s:
            raise ValueError(
                "Scenario.telemetry_interval_s must not exceed decision_interval_s "
                f"(got {self.telemetry_interval_s}, {self.decision_interval_s})"
            )
        check_between(self, 0.0, MOST_CLEARANCE_M, "clearance_m")
        check_between(self, 1, MOST_SLOTS, "slots")
        if len(self.fixtures) > MOST_FIXTURES:
            raise ValueError(f"Scenario.fixtures must be at most {MOST_FIXTURES} (got {len(self.fixtures)})")
        if self.horizon_s / self.telemetry_interval_s > MOST_SAMPLES:
            raise ValueError(
                f"Scenario.horizon_s must be at most {MOST_SAMPLES} times telemetry_interval_s "
                f"(got {self.horizon_s}, {self.telemetry_interval_s})"
            )
        latest_s = self.horizon_s + max((stream.due_s for stream in self.jobs), default=0.0)
        if latest_s > BOUNDS["due_s"].high:
            raise ValueError(
                f"Scenario.jobs: horizon_s plus the longest due_s must be at most {BOUNDS['due_s'].high:.15g} s "
                f"(got {latest_s:.15g})"
            )
        check_names(self, "name")
        for kind in ("arms", "places", "fixtures", "jobs"):
            for i, each in enumerate(getattr(self, kind)):
                try:
                    check_names(each, "name", of_jobs=kind == "jobs")
                except ValueError as error:
                    raise ValueError(f"Scenario.{kind}[{i}].{str(error).partition('.')[2]}") from error
        for stream in self.jobs:
            if stream.numbered and len(stream.name) > MAX_NAME - _NUMBER:
                raise ValueError(
                    f"JobStream.name must have at most {MAX_NAME - _NUMBER} characters, as its jobs have a number "
                    f"after it (got {len(stream.name)})"
                )

    def channel(self, given: Channel) -> Channel:
        """The given channel between the arms; that of the scenario if the given one is perfect.

        Raises:
            ArgumentError: it is no channel.
        """
        check_channel(given)
        return self.bus if given.perfect else given

    @property
    def ticks(self) -> int:
        """Decision intervals in the shift."""
        return max(1, round(self.horizon_s / self.decision_interval_s))

    def index_of(self, arm: str) -> int:
        """Index of an arm in `arms`.

        Raises:
            FleetError: there is no such arm; names the known ones.
        """
        names = [spec.name for spec in self.arms]
        if arm not in names:
            raise FleetError(f"No arm '{arm}' in {self.name}{nearest(arm, names)}")
        return names.index(arm)
