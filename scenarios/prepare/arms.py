"""The arms of a scenario: hardware, plans, what in a scenario cannot work, and true temperatures under a plan.

True temperatures serve simulated past jobs and the model `oracle`, which measures regret. They follow from parameters
of the simulator, which arms and policies must not use.
"""

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from fleet.arm.plan_cache import CachedPlanner, LoadedPlans, rest_torque
from fleet.arm.space import FARTHEST_M, collisions_of_homes, conflicts_with_homes
from fleet.difficulty import Blind
from fleet.engine.world import Arm, warm_start
from fleet.errors import InfeasibleJob, distinguish
from fleet.heat.motor import Motors, gen3_motors, thermal_data
from fleet.heat.thermal import WINDING, ThermalModel, ThermalSpread, gen3_network, spread_motors, thermal_model
from fleet.job import Work
from fleet.motion import Plan
from fleet.robot import JOINTS, Robot
from scenarios.prepare.shipped import unpack_shipped
from scenarios.progress import Count, Progress
from scenarios.spec.jobs import alternatives_of
from scenarios.spec.schema import Scenario

log = logging.getLogger(__name__)


class ArmHardware(NamedTuple):
    """An arm's robot, its motors and its thermal model."""

    robot: Robot
    motors: Motors
    thermal: ThermalModel

    def key(self, parts: Sequence[object], *data: bytes) -> str:
        """Cache key of a model of this arm, which also depends on other values, as JSON, and data.

        It is the same on every processor: rates and modes, whose rounding depends on it, follow from the rest.
        """
        network = self.thermal
        values = (*vars(self.motors).values(), network.capacity, network.laplacian, network.to_ambient)
        content = b"".join(np.asarray(value, dtype=float).tobytes() for value in values)
        return hashlib.sha256(msgspec.json.encode(parts) + content + b"".join(data)).hexdigest()[:32]


@dataclass(frozen=True, eq=False)
class PlannedArm:
    """An arm of a scenario with its plans."""

    index: int
    """Index in the scenario; random numbers for the arm depend on it."""
    hardware: ArmHardware
    plans: Mapping[Work, tuple[Plan, ...]]
    infeasible: tuple[InfeasibleJob, ...] = ()
    """Work that the arm cannot do, with reasons."""
    too_heavy: frozenset[Work] = frozenset()
    """Work whose load exceeds the arm's rating."""

    @property
    def all_plans(self) -> list[Plan]:
        """The plans of all works."""
        return [plan for variants in self.plans.values() for plan in variants]


def hardware_of(scenario: Scenario, index: int) -> ArmHardware:
    """The hardware of one arm, with its random deviation from the nominal Gen3; the same for every seed of a run."""
    spec = scenario.arms[index]
    rng = np.random.default_rng(np.random.SeedSequence([scenario.spread.seed, index]))
    spread = ThermalSpread.gen3(scenario.spread.scale)
    motors = spread_motors(gen3_motors(wear=spec.wear), spread, rng)
    if spec.sensor_noise_k is not None:
        motors = replace(motors, sensor_noise_k=np.full(JOINTS, spec.sensor_noise_k))
    network = gen3_network(cooling=spec.cooling, cooling_factor=spec.cooling_factor, spread=spread, rng=rng)
    return ArmHardware(spec.robot(), motors, thermal_model(network))


def air_offsets(scenario: Scenario) -> np.ndarray:
    """Ambient temperature at each arm minus that of the cell, K, [arm]: given by the scenario, plus a random part."""
    sd = scenario.spread.scale * thermal_data()["spread"]["ambient_k"]
    rng = np.random.default_rng(np.random.SeedSequence([scenario.spread.seed, len(scenario.arms), 1]))
    random_k = sd * rng.standard_normal(len(scenario.arms))
    return random_k + np.array([arm.ambient_offset_k for arm in scenario.arms])


class CellPlanner:
    """Plans of one arm of a scenario that keep clear of the other arms at home; cached in a folder."""

    def __init__(self, robot: Robot, scenario: Scenario, folder: Path, loaded: LoadedPlans | None = None) -> None:
        spec = scenario.planning
        self._robot, self._folder, self._clearance_m = robot, folder / "plans", scenario.clearance_m
        self._others = [arm.robot() for arm in scenario.arms if arm.name != robot.name]
        self._planner = CachedPlanner(
            robot, scenario.fixtures, elbows=spec.elbows, speeds=spec.speeds, cache_dir=self._folder, loaded=loaded
        )

    def plan(self, work: Work) -> tuple[Plan, ...]:
        """All variants, as `fleet.arm.planner.Planner.plan`, that come too close to no other arm at home.

        Raises:
            InfeasibleJob: there is none.
        """
        for place in work.places:
            far_m = float(np.linalg.norm(np.subtract(place.position_m, self._robot.mount.position_m)))
            if far_m > FARTHEST_M:  # not worth a search, nor a file in the cache
                raise InfeasibleJob(self._robot.name, place.name, f"reach: {far_m:.2f} m from the base of the arm")
        plans = self._planner.plan(work)
        reasons = conflicts_with_homes(self._robot, self._others, plans, self._clearance_m, self._folder)
        clear = tuple(plan for plan, reason in zip(plans, reasons, strict=True) if reason is None)
        if not clear:
            raise InfeasibleJob(self._robot.name, work.places[0].name, str(reasons[0]))
        return clear


def homes_in_fixtures(scenario: Scenario) -> list[str]:
    """A sentence for each arm that stands or waits inside a fixture, with depth."""
    if not scenario.fixtures:
        return []
    from fleet.arm.model import ArmModel
    from fleet.arm.trajectory import CollisionChecker

    inside = []
    for i, spec in enumerate(scenario.arms):
        robot = spec.robot()
        collision = CollisionChecker(ArmModel(robot, scenario.fixtures)).deepest_collision(robot.home_q()[None])
        if collision:
            inside.append(f"arms[{i}] '{robot.name}' at home: {collision}")
    return inside


def plan_arms(
    scenario: Scenario, indices: Sequence[int], works: Sequence[Work], folder: Path, progress: Progress
) -> list[PlannedArm]:
    """The arms with these indices in the scenario, each with its plans for the works (cached in `folder`)."""
    unpack_shipped(scenario.name, folder)
    planned, loaded = [], LoadedPlans()
    for done, index in enumerate(indices):
        hardware = hardware_of(scenario, index)
        planner = CellPlanner(hardware.robot, scenario, folder, loaded)
        plans: dict[Work, tuple[Plan, ...]] = {}
        infeasible: list[InfeasibleJob] = []
        too_heavy: set[Work] = set()
        for i, work in enumerate(works):
            progress("planning", Count(done + i / len(works), len(indices)))
            try:
                plans[work] = planner.plan(work)
            except InfeasibleJob as error:
                infeasible.append(error)
                if error.too_heavy:
                    too_heavy.add(work)
                log.info("%s", error)
        planned.append(PlannedArm(index, hardware, plans, tuple(infeasible), frozenset(too_heavy)))
    return planned


REASONS = 4
"""Maximum number of reasons in one error message."""


def problems_of(scenario: Scenario, arms: Sequence[PlannedArm], folder: Path) -> list[str]:
    """Everything in a scenario that cannot work, one sentence each.

    Args:
        arms: With plans for all works; the work of a stream that none can do is a problem. If there are none, only
            the arms at home are compared.
        folder: Of the cache.
    """
    file = f"{scenario.name}.toml"
    robots = [spec.robot() for spec in scenario.arms]
    near = collisions_of_homes(robots, scenario.clearance_m, folder / "plans")
    advice = "move or turn an arm, or give it another `home`"
    if scenario.clearance_m:
        advice = "move or turn an arm, give it another `home`, or lower clearance_m"
    problems = [f"{file}: arms: {sentence}; {advice}." for sentence in near]
    problems += [
        f"{file}: {sentence}; move the arm or the fixture, or give the arm another `home`."
        for sentence in homes_in_fixtures(scenario)
    ]
    problems += [f"{file}: {sentence}." for sentence in _outside_limits_at_home(scenario, arms, folder)]
    infeasible = [error for arm in arms for error in arm.infeasible]
    possible = {work for arm in arms for work in arm.plans}
    # By column and reasons: the sentence on the first job, and the others.
    impossible = dict[tuple[str, tuple[str, ...]], tuple[str, list[str]]]()
    for i, stream in enumerate(scenario.jobs if arms else ()):
        loads = [f"{kg:g}" for kg in stream.payload_kg if possible.isdisjoint(alternatives_of(scenario, stream, kg))]
        if not loads:
            continue
        names = set(chain.from_iterable(stream.alternatives))
        here = [error for error in infeasible if error.place in names]
        reasons = list(dict.fromkeys(f"{error.arm} at '{error.place}': {error.reason}" for error in here))
        if near and any(reason.endswith("at home") for reason in reasons):
            continue  # it may be possible once the homes are apart
        more = f"; and {len(reasons) - REASONS} more" if len(reasons) > REASONS else ""
        column = "payload" if stream.row and here and all(error.too_heavy for error in here) else "places"
        sentence = (
            f"{file}: {stream.place_of(i, column)}: no arm can do '{stream.name}' with {' or '.join(loads)} kg "
            f"({'; '.join(reasons[:REASONS])}{more}); move the places or an arm, or make the load lighter."
        )
        if (alike := (column, tuple(reasons))) in impossible:
            impossible[alike][1].append(f"'{stream.name}' ({stream.place_of(i, column)})")
        else:
            impossible[alike] = sentence, []
    return problems + [_with_others(sentence, others) for sentence, others in impossible.values()]


def _with_others(sentence: str, others: Sequence[str]) -> str:
    """A sentence on a job, and how many other jobs have the same reasons."""
    if len(others) < 2:
        return f"{sentence} The same holds for {others[0]}." if others else sentence
    return f"{sentence} The same holds for {len(others)} other jobs, {others[0]} to {others[-1]}."


def _outside_limits_at_home(scenario: Scenario, arms: Sequence[PlannedArm], folder: Path) -> list[str]:
    """A sentence for each arm that begins too cold, or that never settles at home though the shift begins settled."""
    cell_c, offsets_k = float(scenario.ambient.at(np.zeros(1))[0]), air_offsets(scenario)
    lower_c, problems = scenario.limits.lower_c, list[str]()
    for arm in arms:
        ambient_c = coldest_c = cell_c + float(offsets_k[arm.index])
        if scenario.start == "idle_warm":
            robot, motors, thermal = arm.hardware
            rest_tau = rest_torque(robot, folder / "plans")
            still = Arm(robot=robot, motors=motors, thermal=thermal, rest_tau=rest_tau, model=Blind(), plans={})
            try:
                coldest_c = float(warm_start(still, ambient_c)[WINDING].min())
            except ValueError as error:
                reason = str(error).rstrip(".")
                advice = 'give it more cooling or cooler air, or begin with start = "cold"'
                problems.append(f"arms[{arm.index}]: {reason}; {advice}")
        if coldest_c < lower_c:
            advice = "give it warmer air" + (', or begin with start = "idle_warm"' if scenario.start == "cold" else "")
            name = scenario.arms[arm.index].name
            coldest, lower = distinguish(coldest_c, lower_c)
            problems.append(
                f"arms[{arm.index}]: a motor of '{name}' begins at {coldest} °C, below limits.lower_c ({lower} °C); "
                f"{advice}"
            )
    return problems
