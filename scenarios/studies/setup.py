"""Jobs on which twins are judged: one arm with cool training jobs, a natural mix of test jobs, and light novel motions.

Labels come from the simulator's true thermal law, which no twin sees.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from fleet.errors import FleetError
from fleet.motion import Plan
from fleet.motor import Motors, gen3_motors
from fleet.planning.random_motions import light_jobs, random_jobs
from fleet.robot import JOINTS, Robot, ThermalLimits
from fleet.seeding import child
from fleet.thermal import ThermalModel, ThermalSpread, gen3_network, spread_motors, thermal_model
from scenarios.prepare.cool_motion import cold_peaks, records
from scenarios.prepare.planned_arm import ArmHardware

Array = np.ndarray

GRIPPER_KG = 0.925
"""Robotiq 2F-85 with its coupling."""
SUBJECT = Robot(name="arm", tool_kg=GRIPPER_KG)
"""On the floor, as most arms stand."""
_BATCH = 25
_MOST_BATCHES = 400


@dataclass(frozen=True, eq=False)
class Sample:
    """Jobs with their peak temperatures."""

    plans: tuple[Plan, ...]
    peak_c: Array
    """Hottest winding temperature when the cycle repeats over the horizon from a cold start, °C, [plan, joint]."""

    def __len__(self) -> int:
        return len(self.plans)

    def passes(self, limit_c: float) -> Array:
        """Whether any motor reaches the limit, bool [plan]."""
        return self.peak_c.max(axis=1, initial=-np.inf) >= limit_c

    def records(self) -> list[Array]:
        """Training records of these plans, [time, 3, joint] each."""
        return records(self.plans)


@dataclass(frozen=True, eq=False)
class Study:
    """One arm with its own thermal parameters, and four disjoint samples of jobs."""

    robot: Robot
    motors: Motors
    thermal: ThermalModel
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
        exploration: Light motions among the training jobs, drawn as those of `novel`, but independently.
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
    body, *draws = _children(seed, 6)
    motors, thermal = _body(robot, spread or ThermalSpread.gen3(), body)
    arm = _Subject(robot, motors, thermal, ambient_c, horizon_s)
    natural, explored = arm.cool_jobs(draws[0], cool_c), arm.cool_jobs(draws[4], cool_c, light=True)
    learned = _gathered([*islice(natural, train - exploration), *islice(explored, exploration)])
    held_out = _gathered(islice(arm.cool_jobs(draws[1], cool_c), reference))
    mixed = arm.judged(random_jobs(robot, test, draws[2], name="test"))
    news = arm.judged(light_jobs(robot, novel, draws[3], name="novel"))
    limit_c = ThermalLimits().warning_c
    return Study(robot, motors, thermal, ambient_c, horizon_s, cool_c, limit_c, learned, held_out, mixed, news)


def _children(seed: np.random.SeedSequence, count: int) -> list[np.random.Generator]:
    """Independent generators."""
    return [np.random.default_rng(child(seed, i)) for i in range(count)]


def _body(robot: Robot, spread: ThermalSpread, rng: np.random.Generator) -> tuple[Motors, ThermalModel]:
    motors = spread_motors(gen3_motors(wear=robot.wear), spread, rng)
    network = gen3_network(cooling=robot.cooling, cooling_factor=robot.cooling_factor, spread=spread, rng=rng)
    return motors, thermal_model(network)


@dataclass(frozen=True, eq=False)
class _Subject:
    robot: Robot
    motors: Motors
    thermal: ThermalModel
    ambient_c: float
    horizon_s: float

    def judged(self, plans: Sequence[Plan]) -> Sample:
        """The plans with their peak temperatures."""
        highest = cold_peaks(plans, self.motors, self.thermal, ambient_c=self.ambient_c, horizon_s=self.horizon_s)
        return Sample(tuple(plans), highest)

    def cool_jobs(
        self, rng: np.random.Generator, cool_c: float, *, light: bool = False
    ) -> Iterator[tuple[Plan, Array]]:
        """Jobs that stay cool over the whole horizon, with their peaks, one by one without end.

        Raises:
            FleetError: many batches without a cool job.
        """
        draw = light_jobs if light else random_jobs
        barren = 0
        for batch in range(10**9):
            drawn = self.judged(draw(self.robot, _BATCH, rng, name=f"{'light' if light else 'job'}_{batch}"))
            cool = ~(drawn.peak_c.max(axis=1) > cool_c)
            barren = 0 if cool.any() else barren + 1
            if barren == _MOST_BATCHES:
                raise FleetError(
                    f"Of {barren * _BATCH} jobs of arm '{self.robot.name}' none stays below {cool_c:g} °C for "
                    f"{self.horizon_s:g} s from {self.ambient_c:g} °C; raise cool_c."
                )
            yield from ((plan, drawn.peak_c[i]) for i, plan in enumerate(drawn.plans) if cool[i])


def _gathered(jobs: Sequence[tuple[Plan, Array]] | Iterator[tuple[Plan, Array]]) -> Sample:
    kept = list(jobs)
    highest = np.array([peak for _, peak in kept]).reshape(len(kept), JOINTS)
    return Sample(tuple(plan for plan, _ in kept), highest)
