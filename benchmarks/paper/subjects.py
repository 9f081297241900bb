"""Subjects of the studies: an arm with its own body, jobs with their true outcome, and how well a score detects heat.

An arm is one of a scenario (`Subject`), with its mount and tool, or the usual one of `make_study`. Labels come from the
simulator's true thermal law, which no twin uses.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count, islice

import networkx as nx
import numpy as np
from scipy.stats import spearmanr
from sklearn.metrics import average_precision_score, roc_auc_score

from benchmarks.paper.harness import scenarios_of
from fleet.arm.random_motions import light_jobs, random_jobs
from fleet.errors import FleetError
from fleet.heat.motor import Motors, friction_torque, gen3_motors
from fleet.heat.thermal import ThermalModel, ThermalSpread, gen3_network, spread_motors, thermal_model
from fleet.motion import CHANNELS, Phase, Plan, distinct
from fleet.robot import JOINTS, Robot, ThermalLimits
from fleet.seeding import child
from scenarios.prepare.arms import ArmHardware
from scenarios.prepare.twins import cold_peaks, records
from scenarios.spec.schema import Scenario
from twin.vae.config import TwinConfig
from twin.vae.window import windows_of

Array = np.ndarray

CARRIER = 1
"""Joint 2 carries the stretched arm: nearly every critical job is critical there (index 0..6)."""
SCENARIOS = "quickstart,active_waiting,heat_wave"
"""Scenarios whose arms are studied."""
RANKING = ("auroc", "auprc", "spearman")
"""Measures that need no threshold."""
LABELS = {"auroc": "AUROC", "auprc": "AUPRC", "spearman": "Spearman"}
ALARM_RATE = 0.05
"""Rate of false alarms on cool jobs."""
SHORT = TwinConfig(
    hidden=16, rate_hz=6.25, window=25, stride=5, score_stride=25, batch=32, restarts=1, max_windows=100_000,
    allow_collapse=True,
)  # fmt: skip
"""Half the hidden units and half the sample rate of a usual twin: an eighth of its time."""
EVERYTHING_C = 1e6
"""A limit that no motor reaches: any motion is cool."""
PHASES = ("approach", "cycle", "retreat")
"""Fields of a plan."""
QD, TAU = CHANNELS.index("qd"), CHANNELS.index("tau")


GRIPPER_KG = 0.925
"""Robotiq 2F-85 with its coupling."""
SUBJECT = Robot(name="arm", tool_kg=GRIPPER_KG)
"""On the floor, as most arms."""
_BATCH = 25
_MOST_BATCHES = 400


@dataclass(frozen=True, eq=False)
class Sample:
    """Jobs with their peak temperatures."""

    plans: tuple[Plan, ...]
    peak_c: Array
    """Hottest winding temperature when the cycle repeats over the horizon from a cold start, °C, [plan, joint]."""
    horizon_s: float

    @property
    def repetitions(self) -> tuple[int, ...]:
        """Repetitions of each plan that fill the horizon."""
        return tuple(max(1, int(np.ceil(self.horizon_s / plan.cycle.duration_s))) for plan in self.plans)

    def __len__(self) -> int:
        return len(self.plans)

    def passes(self, limit_c: float) -> Array:
        """Whether any motor reaches the limit, bool [plan]."""
        return self.peak_c.max(axis=1, initial=-np.inf) >= limit_c

    def records(self) -> list[Array]:
        """Training records of these plans, [time, 3, joint] each."""
        return records(self.plans)


@dataclass(frozen=True, eq=False, kw_only=True)
class Study:
    """One arm with its own thermal parameters, and four disjoint samples of jobs."""

    robot: Robot
    motors: Motors
    network: nx.Graph
    """Thermal network."""
    ambient_c: float
    """Ambient temperature, and every temperature at the start."""
    horizon_s: float
    cool_c: float
    warning_c: float
    train: Sample
    """Cool over the whole horizon."""
    reference: Sample
    """Cool as well, but held out: for thresholds."""
    test: Sample
    """The natural mix, cool to critical."""
    novel: Sample
    """Light motions of other kinds; none is critical."""

    @cached_property
    def thermal(self) -> ThermalModel:
        """The arm's thermal law."""
        return thermal_model(self.network)

    @property
    def hardware(self) -> ArmHardware:
        """The arm's hardware."""
        return ArmHardware(self.robot, self.motors, self.thermal)

    @property
    def critical(self) -> Array:
        """Test jobs in which some motor reaches the warning limit, bool [job]."""
        return self.test.passes(self.warning_c)


def make_study(
    seed: np.random.SeedSequence,
    *,
    train: int = 200,
    reference: int = 200,
    test: int = 1200,
    novel: int = 300,
    exploration: int = 0,
    cool_c: float = 40.0,
    horizon_s: float = 1800.0,
    ambient_c: float = 23.0,
    robot: Robot = SUBJECT,
    spread: ThermalSpread | None = None,
) -> Study:
    """A study of one arm. The same seed gives the same study; no sample depends on the sizes of the others.

    Args:
        train: Training jobs, exploration included.
        exploration: Light motions among the training jobs, sampled like those of `novel`, but independently.
        spread: Deviation of the arm from the nominal one, `ThermalSpread.gen3()` by default.

    Raises:
        FleetError: nearly no motion of this arm stays cool.
        ValueError: a size is negative, or more exploration than training.
    """
    if min(train, reference, test, novel, exploration) < 0 or exploration > train:
        raise ValueError(
            "A study needs sizes >= 0 and exploration <= train (got "
            f"train={train}, reference={reference}, test={test}, novel={novel}, exploration={exploration})."
        )
    body, *draws = (np.random.default_rng(child(seed, i)) for i in range(6))
    spread = spread or ThermalSpread.gen3()
    motors = spread_motors(gen3_motors(wear=robot.wear), spread, body)
    network = gen3_network(cooling=robot.cooling, cooling_factor=robot.cooling_factor, spread=spread, rng=body)
    arm = _Simulator(robot, motors, thermal_model(network), ambient_c, horizon_s, cool_c)
    return Study(
        robot=robot,
        motors=motors,
        network=network,
        ambient_c=ambient_c,
        horizon_s=horizon_s,
        cool_c=cool_c,
        warning_c=ThermalLimits().warning_c,
        train=arm.cool_jobs((random_jobs, draws[0], train - exploration), (light_jobs, draws[4], exploration)),
        reference=arm.cool_jobs((random_jobs, draws[1], reference)),
        test=arm.sample(random_jobs(robot, test, draws[2], name="test")),
        novel=arm.sample(light_jobs(robot, novel, draws[3], name="novel")),
    )


@dataclass(frozen=True, eq=False)
class _Simulator:
    robot: Robot
    motors: Motors
    thermal: ThermalModel
    ambient_c: float
    horizon_s: float
    cool_c: float

    def sample(self, plans: Sequence[Plan]) -> Sample:
        """The plans with their peak temperatures."""
        peak_c = cold_peaks(plans, self.motors, self.thermal, ambient_c=self.ambient_c, horizon_s=self.horizon_s)
        return Sample(tuple(plans), peak_c, self.horizon_s)

    def cool_jobs(self, *parts: tuple[Callable[..., Sequence[Plan]], np.random.Generator, int]) -> Sample:
        """Jobs that stay cool over the whole horizon: for each part how to draw them, and their number."""
        jobs = [job for draw, rng, wanted in parts for job in islice(self._cool_jobs(draw, rng), wanted)]
        peak_c = np.array([peak for _, peak in jobs]).reshape(len(jobs), JOINTS)
        return Sample(tuple(plan for plan, _ in jobs), peak_c, self.horizon_s)

    def _cool_jobs(self, draw: Callable[..., Sequence[Plan]], rng: np.random.Generator) -> Iterator[tuple[Plan, Array]]:
        """Cool jobs with their peaks, one by one without end.

        Raises:
            FleetError: many batches without a cool job.
        """
        kind = "light" if draw is light_jobs else "job"
        barren = 0
        for batch in count():
            sample = self.sample(draw(self.robot, _BATCH, rng, name=f"{kind}_{batch}"))
            cool = ~(sample.peak_c.max(axis=1) > self.cool_c)
            barren = 0 if cool.any() else barren + 1
            if barren == _MOST_BATCHES:
                raise FleetError(
                    f"Of {barren * _BATCH} jobs of arm '{self.robot.name}' none stays below {self.cool_c:g} °C for "
                    f"{self.horizon_s:g} s from {self.ambient_c:g} °C; raise cool_c."
                )
            yield from ((sample.plans[i], sample.peak_c[i]) for i in np.flatnonzero(cool))


def detection(score: Array, peak_c: Array, *, limit_c: float) -> dict[str, float]:
    """Quality of scores [job] of held-out jobs with true peaks [job], °C.

    Args:
        limit_c: A job is critical if its peak reaches this.

    Returns:
        `auroc`: probability that a critical job scores above another one. `auprc`: average precision; by chance, the
        share of critical jobs. `spearman`: rank correlation with the true peak.

    Raises:
        ValueError: scores that are not finite, or not one per peak.
        FleetError: no job is critical or all are.
    """
    if score.shape != peak_c.shape or score.ndim != 1:
        raise ValueError(f"Scores and peaks must be [job] alike (got {score.shape} and {peak_c.shape}).")
    if not all(np.isfinite(values).all() for values in (score, peak_c)):
        raise ValueError("Scores and peaks must be finite.")
    critical = peak_c >= limit_c
    if critical.all() or not critical.any():
        raise FleetError(
            f"{critical.sum()} of {len(critical)} test jobs reach {limit_c:g} °C: without some of both kinds no "
            "quality can be measured. Change the payloads, the ambient temperature or the limit."
        )
    return {
        "auroc": float(roc_auc_score(critical, score)),
        "auprc": float(average_precision_score(critical, score)),
        "spearman": float(np.asarray(spearmanr(score, peak_c))[0]),
    }


@dataclass(frozen=True)
class Sizes:
    """Number of jobs."""

    train: int = 200
    test: int = 600


@dataclass(frozen=True, eq=False)
class Subject:
    """One arm of a scenario under one seed."""

    scenario: Scenario
    index: int
    seed: int
    sizes: Sizes

    @property
    def name(self) -> str:
        """`SCENARIO/ARM/SEED`."""
        return f"{self.scenario.name}/{self.scenario.arms[self.index].name}/{self.seed}"

    @property
    def entropy(self) -> np.random.SeedSequence:
        """Seed of the study and of the training, by scenario, arm and seed."""
        scenario = int.from_bytes(hashlib.sha256(self.scenario.name.encode()).digest()[:4], "little")
        return np.random.SeedSequence([self.seed, self.index, scenario])

    def study(self, **changes: float) -> Study:
        """The arm in its scenario's usual ambient temperature with random jobs; `changes` as in `make_study`."""
        spec, sizes = self.scenario.twin, {**vars(self.sizes), "reference": 0, "novel": 0}
        settings = {"cool_c": spec.cool_c, "horizon_s": spec.horizon_s, "ambient_c": spec.ambient_c} | sizes | changes
        robot = self.scenario.arms[self.index].robot()
        return make_study(self.entropy, robot=robot, **settings)  # pyright: ignore[reportArgumentType]

    def any_motion(self) -> Study:
        """The same arm with training jobs of any heat, and no other jobs."""
        return self.study(cool_c=EVERYTHING_C, test=0)


def arm_of(subject: str) -> str:
    """The arm of a subject's name, without the seed."""
    return subject.rsplit("/", 1)[0]


def carrier_of(study: Study) -> int:
    """The joint that overheats in most test jobs, 0 … 6: joint 2 of a standing arm, joint 1 of one on a wall."""
    return int((study.test.peak_c >= study.warning_c).sum(axis=0).argmax())


def up_to_joint(plans: Iterable[Plan], last: int) -> tuple[Plan, ...]:
    """The same plans, of the joints up to one, 0 … 6. Joints have networks of their own, so fewer train faster."""
    return tuple(
        replace(plan, **{name: _first_joints(getattr(plan, name), last + 1) for name in PHASES}) for plan in plans
    )


def _first_joints(phase: Phase, joints: int) -> Phase:
    return replace(phase, profile=phase.profile[:, :, :joints])


def subjects_of(scenarios: Iterable[str], *, arms: Sequence[int], seeds: Sequence[int], sizes: Sizes) -> list[Subject]:
    """The arms with these indices of every scenario, under every seed.

    Raises:
        FleetError: a scenario is unknown, or an arm index is too large.
    """
    chosen = scenarios_of(list(scenarios))
    last = max(len(scenario.arms) for scenario in chosen) - 1
    if max(arms) > last:
        raise FleetError(f"--arms must be 0 to {last}, as the scenarios have arms (got {max(arms)}).")
    return [
        Subject(scenario, index, seed, sizes)
        for scenario in chosen
        for index in arms
        if index < len(scenario.arms)
        for seed in seeds
    ]


def with_steps(config: TwinConfig, parts: Sequence[Array], steps: int) -> TwinConfig:
    """The configuration with the number of epochs on these records that is closest to a number of steps."""
    batches = -(-len(windows_of(parts, config)) // config.batch)
    return replace(config, epochs=max(1, round(steps / batches)))


def sensed(plans: Iterable[Plan], motors: Motors) -> tuple[Plan, ...]:
    """The plans with tau + eta · friction in place of tau: i · N·Kt · eta, the torque that the current stands for.

    Args:
        motors: The true motors of the arm, whose friction the drives overcome.
    """
    return tuple(replace(plan, **{name: _sensed(getattr(plan, name), motors) for name in PHASES}) for plan in plans)


def _sensed(phase: Phase, motors: Motors) -> Phase:
    if len(distinct(phase.profile)) < len(phase.profile):  # a standstill, without friction
        return phase
    profile = np.array(phase.profile)
    profile[:, TAU] += (motors.eta * friction_torque(profile[:, QD].astype(float), motors)).astype(profile.dtype)
    return replace(phase, profile=profile)
