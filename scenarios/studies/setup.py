"""Jobs on which twins are judged: one arm with cool training jobs, a natural mix of test jobs, and light novel motions.

Labels come from the simulator's true thermal law, which no twin uses.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count, islice
from pathlib import Path

import networkx as nx
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
from scenarios.prepare.train_twins import train_or_load
from twin.vae.config import TwinConfig
from twin.vae.twin import Twin

Array = np.ndarray

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
class Bench:
    """Seeds, each with its own study, and how to train their twins."""

    seeds: Sequence[np.random.SeedSequence]
    config: TwinConfig
    folder: Path
    """Cache of trained twins."""
    make: Callable[..., Study] = make_study
    """Makes the study of a seed; sizes as in `make_study`."""

    def studies(self, **sizes: int) -> Iterator[tuple[np.random.SeedSequence, Study, Twin]]:
        """Every seed, its study in these sizes, and the twin trained on it.

        Raises:
            ValueError: no seeds.
        """
        if not self.seeds:
            raise ValueError("A bench needs at least one seed.")
        for seed in self.seeds:
            study = self.make(seed, **sizes)
            yield seed, study, self.train(study.train.records(), study, seed)

    def train(
        self, records: list[Array], study: Study, seed: np.random.SeedSequence, config: TwinConfig | None = None
    ) -> Twin:
        """A twin of these records, by default with the configuration of the bench."""
        return train_or_load(records, config or self.config, seed, arm=study.robot.name, folder=self.folder)


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
        return Sample(tuple(plans), peak_c)

    def cool_jobs(self, *parts: tuple[Callable[..., Sequence[Plan]], np.random.Generator, int]) -> Sample:
        """Jobs that stay cool over the whole horizon: for each part how to draw them, and their number."""
        jobs = [job for draw, rng, wanted in parts for job in islice(self._cool_jobs(draw, rng), wanted)]
        peak_c = np.array([peak for _, peak in jobs]).reshape(len(jobs), JOINTS)
        return Sample(tuple(plan for plan, _ in jobs), peak_c)

    def _cool_jobs(self, draw: Callable[..., Sequence[Plan]], rng: np.random.Generator) -> Iterator[tuple[Plan, Array]]:
        """Cool jobs with their peaks, one by one without end.

        Raises:
            FleetError: many batches without a cool job.
        """
        kind = "light" if draw is light_jobs else "job"
        barren = 0
        for batch in count():
            drawn = self.sample(draw(self.robot, _BATCH, rng, name=f"{kind}_{batch}"))
            cool = ~(drawn.peak_c.max(axis=1) > self.cool_c)
            barren = 0 if cool.any() else barren + 1
            if barren == _MOST_BATCHES:
                raise FleetError(
                    f"Of {barren * _BATCH} jobs of arm '{self.robot.name}' none stays below {self.cool_c:g} °C for "
                    f"{self.horizon_s:g} s from {self.ambient_c:g} °C; raise cool_c."
                )
            yield from ((drawn.plans[i], drawn.peak_c[i]) for i in np.flatnonzero(cool))
