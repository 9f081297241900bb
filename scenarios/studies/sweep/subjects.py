"""Arms of scenarios as subjects of a study: each with its own body, jobs and true peaks."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleet.motion import Plan
from scenarios.schema import Scenario
from scenarios.studies.setup import Study, make_study

EVERYTHING_C = 1e6
"""A limit that no motor reaches: any motion is cool."""


@dataclass(frozen=True)
class Sizes:
    """Number of jobs."""

    train: int = 200
    reference: int = 100
    test: int = 600


@dataclass(frozen=True, eq=False)
class Subject:
    """One arm of a scenario under one seed."""

    scenario: Scenario
    index: int
    seed: int
    sizes: Sizes
    carrier_only: bool = False
    """Whether twins have networks of the joints up to the carrying one only: much faster, but with d of that one
    alone."""

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
        spec, sizes = self.scenario.twin, {**vars(self.sizes), "novel": 0}
        settings = {"cool_c": spec.cool_c, "horizon_s": spec.horizon_s, "ambient_c": spec.ambient_c} | sizes | changes
        robot = self.scenario.arms[self.index].robot()
        return make_study(self.entropy, robot=robot, **settings)  # pyright: ignore[reportArgumentType]

    def seen(self, plans: Sequence[Plan], carrier: int) -> tuple[Plan, ...]:
        """The plans as the twin sees them, with all joints or those up to the carrying one."""
        return tuple(first_joints(plan, carrier + 1) for plan in plans) if self.carrier_only else tuple(plans)

    def any_motion(self) -> Study:
        """The same arm with training jobs of any heat, and no other jobs."""
        return self.study(cool_c=EVERYTHING_C, reference=0, test=0)


def arm_of(subject: str) -> str:
    """The arm of a subject's name, without the seed."""
    return subject.rsplit("/", 1)[0]


def carrier_of(study: Study) -> int:
    """The joint that overheats in most test jobs, 0 … 6: joint 2 of a standing arm, joint 1 of one on a wall."""
    return int((study.test.peak_c >= study.warning_c).sum(axis=0).argmax())


def first_joints(plan: Plan, joints: int) -> Plan:
    """The same plan, of the first joints of the arm."""
    cut = [replace(phase, profile=phase.profile[:, :, :joints]) for phase in plan.phases]
    return replace(plan, approach=cut[0], cycle=cut[1], retreat=cut[2])


def subjects_of(
    scenarios: Sequence[Scenario],
    *,
    arms: Sequence[int],
    seeds: Sequence[int],
    sizes: Sizes,
    carrier_only: bool = False,
) -> Iterator[Subject]:
    """The arms at these places of every scenario, under every seed."""
    for scenario in scenarios:
        for index in arms:
            if index < len(scenario.arms):
                yield from (Subject(scenario, index, seed, sizes, carrier_only) for seed in seeds)
