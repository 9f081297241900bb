"""The composition root: from a scenario to arms with plans and twins, and to the environment they live in."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import fields as dataclass_fields
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from fleet.bus.channel import PERFECT, Channel
from fleet.bus.exchange import Exchange
from fleet.bus.memory import MemoryExchange
from fleet.cache import cache_folder
from fleet.difficulty import Blind, DifficultyModel
from fleet.errors import FleetError, InfeasibleJob, ScenarioError, nearest
from fleet.job import Job, Work
from fleet.motion import Plan
from fleet.motor import Motors, gen3_motors, thermal_data
from fleet.robot import Robot
from fleet.seeds import child
from fleet.sim.kernel import Plant
from fleet.sim.known_plans import KnownPlans, rest_torque
from fleet.sim.plants import ProfilePlant
from fleet.sim.state import World
from fleet.sim.world import Arm, build_world, warm_start
from fleet.thermal import ThermalModel, ThermalSpread, gen3_network, spread_motors, thermal_model
from scenarios.cell import cell_of, near_of
from scenarios.jobs import all_works, draw_jobs, rehearsal_works, works_of
from scenarios.load import load, override
from scenarios.scenario import Scenario

if TYPE_CHECKING:  # an arm alone needs neither an environment nor the physics
    from fleet.env.allocation_v0 import AllocationEnv, MaskPlace
    from fleet.env.episode import Episode

log = logging.getLogger(__name__)

DifficultyName = Literal["twin", "blind", "oracle"]
PlantName = Literal["profile", "mujoco"]
BusName = Literal["zenoh", "memory"]

Progress = Callable[[str, float], None]
"""Told what is going on and the share of it that is done, 0 to 1."""


def quiet(stage: str, share: float) -> None:
    """A `Progress` that says nothing."""


@dataclass(frozen=True, eq=False)
class Fleet:
    """A scenario's arms, ready to work: planned, and with twins that know their cool motion."""

    scenario: Scenario
    arms: tuple[Arm, ...]
    infeasible: tuple[InfeasibleJob, ...]
    """What single arms cannot do, with the reasons."""


def choose(kind: str, name: str, allowed: Any) -> None:
    """Refuse a name that a Literal type does not have.

    Raises:
        ScenarioError: names the nearest one.
    """
    if name not in get_args(allowed):
        raise ScenarioError(f"No {kind} '{name}'{nearest(str(name), get_args(allowed))}")


def prepare(
    scenario: Scenario,
    *,
    difficulty: DifficultyName = "twin",
    cache: str | Path | None = None,
    progress: Progress = quiet,
) -> Fleet:
    """Plan every work for every arm, and give each arm its difficulty model. Cached on content.

    Raises:
        ScenarioError: some work can be done by no arm.
    """
    arms, refused = _arms(scenario, range(len(scenario.arms)), difficulty, cache, progress, every_work=True)
    return Fleet(scenario, tuple(arms), tuple(refused))


def prepare_arm(
    scenario: Scenario,
    name: str,
    *,
    difficulty: DifficultyName = "twin",
    cache: str | Path | None = None,
    progress: Progress = quiet,
) -> Arm:
    """The same of one arm alone: word for word the arm that it is in the scenario's fleet.

    Raises:
        FleetError: the scenario has no such arm.
    """
    (arm,), _ = _arms(scenario, [scenario.index_of(name)], difficulty, cache, progress, every_work=False)
    return arm


def _arms(
    scenario: Scenario,
    places: Sequence[int],
    difficulty: DifficultyName,
    cache: str | Path | None,
    progress: Progress,
    *,
    every_work: bool,
) -> tuple[list[Arm], list[InfeasibleJob]]:
    """The arms at these places of the scenario, and what each cannot do.

    Args:
        every_work: Refuse a scenario in which some work can be done by none of them.
    """
    choose("difficulty", difficulty, DifficultyName)
    if not isinstance(cache, str | Path | None):
        raise ScenarioError(f"cache must be the path of a folder (got {cache!r}).")
    folder = Path(cache) if cache else cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FleetError(f"Cannot keep plans and twins in '{folder}': {error.strerror}.") from error
    bodies = [body_of(scenario, i) for i in places]
    asked = all_works(scenario)
    wanted = rehearsal_works(scenario) if difficulty == "twin" else asked
    plans: list[dict[Work, tuple[Plan, ...]]] = []
    refused: list[InfeasibleJob] = []
    for i, (robot, _, _) in enumerate(bodies):
        possible, impossible = plan_works(
            robot, wanted, scenario, folder, lambda s, i=i: progress("planning", (i + s) / len(bodies))
        )
        plans.append(possible)
        refused += impossible
    if every_work:
        _check_feasible(scenario, plans, refused)
    work = [{w: possible[w] for w in asked if w in possible} for possible in plans]
    models: Sequence[DifficultyModel]
    if difficulty == "twin":
        from scenarios.calibration import calibrated_twins  # both load torch
        from scenarios.rehearse import twins

        known = twins(scenario, bodies, plans, folder, progress, arms=places)
        models = calibrated_twins(scenario, bodies, work, known, folder, progress, arms=places)
    else:
        models = [Blind()] * len(bodies)
    arms = []
    for (robot, motors, thermal), model, own in zip(bodies, models, work, strict=True):
        rest_tau = rest_torque(robot, folder / "plans")
        arm = Arm(robot=robot, motors=motors, thermal=thermal, rest_tau=rest_tau, model=model, plans=own)
        arms.append(_with_oracle(scenario, arm) if difficulty == "oracle" else arm)
    return arms, refused


def body_of(scenario: Scenario, index: int) -> tuple[Robot, Motors, ThermalModel]:
    """One arm's robot, motors and thermal model: its own, and the same for every seed of a run."""
    spec = scenario.arms[index]
    rng = np.random.default_rng(np.random.SeedSequence([scenario.spread.seed, index]))
    spread = ThermalSpread.gen3(scenario.spread.scale)
    motors = spread_motors(gen3_motors(wear=spec.wear), spread, rng)
    network = gen3_network(cooling=spec.cooling, cooling_factor=spec.cooling_factor, spread=spread, rng=rng)
    return spec.robot(), motors, thermal_model(network)


def plan_works(
    robot: Robot, wanted: tuple[Work, ...], scenario: Scenario, folder: Path, progress: Callable[[float], None]
) -> tuple[dict[Work, tuple[Plan, ...]], list[InfeasibleJob]]:
    """What one arm can do of what is wanted, with its plans (cached in `folder`), and what it cannot."""
    planner = planner_of(robot, scenario, folder)
    possible: dict[Work, tuple[Plan, ...]] = {}
    refused: list[InfeasibleJob] = []
    for i, work in enumerate(wanted):
        progress(i / len(wanted))
        try:
            possible[work] = planner.plan(work)
        except InfeasibleJob as error:
            refused.append(error)
            log.info("%s", error)
    return possible, refused


def planner_of(robot: Robot, scenario: Scenario, folder: Path) -> KnownPlans:
    """What plans for one arm as the scenario wants it, with its plans cached in `folder`."""
    spec = scenario.planning
    return KnownPlans(robot, elbows=spec.elbows, speeds=spec.speeds, cache_dir=folder / "plans")


TOLD = 4
"""Of how many arms a sentence gives the reason."""


def _check_feasible(
    scenario: Scenario, plans: Sequence[Mapping[Work, tuple[Plan, ...]]], refused: Sequence[InfeasibleJob]
) -> None:
    for i, stream in enumerate(scenario.jobs):
        for work in works_of(scenario, stream):
            if any(work in possible for possible in plans):
                continue
            reasons = list(
                dict.fromkeys(f"{e.arm} at '{e.place}': {e.reason}" for e in refused if e.place in stream.places)
            )
            more = f"; and {len(reasons) - TOLD} more" if len(reasons) > TOLD else ""
            raise ScenarioError(
                f"{scenario.name}.toml: jobs[{i}].places: no arm can do '{stream.name}' with {work.payload_kg:g} kg "
                f"({'; '.join(reasons[:TOLD])}{more}); move the places or an arm, or make the load lighter."
            )


def _with_oracle(scenario: Scenario, arm: Arm) -> Arm:
    from fleet.sim.oracle import Oracle

    air = float(np.mean(scenario.ambient.at(np.linspace(0, scenario.horizon_s, 100)))) + arm.robot.ambient_offset_k
    model = Oracle(arm.motors, arm.thermal, warm_start(arm, air), air, scenario.limits.warning_c)
    return replace(arm, model=model)


def children(seed: np.random.SeedSequence) -> tuple[np.random.SeedSequence, np.random.SeedSequence]:
    """Of the seed of a shift: for its jobs, and for its sensors."""
    return child(seed, 0), child(seed, 1)


def world_of(fleet: Fleet, jobs: Sequence[Job]) -> tuple[World, tuple[Plan, ...]]:
    """The world of a shift with these jobs, and the plans behind the rows of its plan table."""
    scenario = fleet.scenario
    times = (np.arange(scenario.ticks) + 0.5) * scenario.decision_interval_s
    return build_world(
        fleet.arms,
        [jobs],
        limits=scenario.limits,
        dt_s=scenario.decision_interval_s,
        ticks=scenario.ticks,
        slots=scenario.slots,
        ambient_c=scenario.ambient.at(times)[:, None] + air_offsets(scenario),
        start_warm=scenario.start == "idle_warm",
    )


@dataclass(frozen=True, eq=False)
class ShiftFactory:
    """Makes the episode of a seed for one fleet."""

    fleet: Fleet
    plant: PlantName = "profile"

    def __call__(self, seed: np.random.SeedSequence) -> "Episode":
        """Draw the jobs and lay out the world; the same seed gives the same episode."""
        from fleet.env.episode import Episode

        scenario, arms = self.fleet.scenario, self.fleet.arms
        jobs_seed, sensor_seed = children(seed)
        world, plans = world_of(self.fleet, draw_jobs(scenario, jobs_seed))
        robots, rest_tau = [arm.robot for arm in arms], np.stack([arm.rest_tau for arm in arms])
        plant: Plant
        if self.plant == "mujoco":
            from fleet.sim.mujoco_plant import MujocoPlant

            plant = MujocoPlant(robots, plans, rest_tau, scenario.places)
        else:
            plant = ProfilePlant(plans, np.stack([robot.home_q() for robot in robots]), rest_tau)
        twins = tuple(arm.model.version for arm in arms)
        return Episode(world=world, plant=plant, twins=twins, sensors=sensor_seed)


def air_offsets(scenario: Scenario) -> np.ndarray:
    """Air at each arm over the air of the cell, K, [arm]: the scenario's own, and what the place adds by chance."""
    sd = scenario.spread.scale * thermal_data()["spread"]["ambient_k"]
    rng = np.random.default_rng(np.random.SeedSequence([scenario.spread.seed, len(scenario.arms), 1]))
    drawn = sd * rng.standard_normal(len(scenario.arms))
    return drawn + np.array([arm.ambient_offset_k for arm in scenario.arms])


def open_exchange(
    bus: BusName, arms: tuple[str, ...], fleet: str, endpoint: str | None = None, channel: Channel = PERFECT
) -> Exchange:
    """The exchange by name; over Zenoh by the router at a loopback endpoint, or by an in-process one of its own.

    Raises:
        FleetError: no such bus, or a channel that speaks of other arms.
    """
    choose("bus", bus, BusName)
    try:
        if bus == "memory":
            return MemoryExchange(arms, channel)
        from fleet.bus.session import ZenohExchange

        return ZenohExchange(arms, fleet, endpoint, channel=channel)
    except ValueError as error:
        raise FleetError(str(error)) from error


def chosen_of(scenario: str | Path | Scenario, overrides: Mapping[str, Any], door: Callable[..., Any]) -> Scenario:
    """The scenario with its overrides; a name that is neither a field nor an option of the door is refused.

    Raises:
        ScenarioError: names the nearest of both.
    """
    if not isinstance(scenario, str | Path | Scenario):
        raise ScenarioError(f"scenario must be a library name, a .toml file or a Scenario (got {scenario!r}).")
    chosen = scenario if isinstance(scenario, Scenario) else load(scenario)
    fields = [field.name for field in dataclass_fields(Scenario)]
    options = [name for name, taken in signature(door).parameters.items() if taken.kind is Parameter.KEYWORD_ONLY]
    for name in overrides:
        if name == "seed":
            raise ScenarioError("make_env() takes no seed: give it to reset(seed=…).")
        if name not in fields:
            allowed = nearest(name, [*fields, *options])
            raise ScenarioError(f"{chosen.name} with overrides: unknown key '{name}'{allowed}")
    return override(chosen, **overrides) if overrides else chosen


def make_env(
    scenario: str | Path | Scenario,
    *,
    difficulty: DifficultyName = "twin",
    plant: PlantName = "profile",
    bus: BusName = "memory",
    channel: Channel = PERFECT,
    cache: str | Path | None = None,
    max_cycles: int | None = None,
    render_mode: str | None = None,
    mask_in: "MaskPlace" = "obs",
    peers: int | None = None,
    progress: Progress = quiet,
    **overrides: Any,
) -> "AllocationEnv":
    """The PettingZoo `ParallelEnv` of a scenario.

    Args:
        scenario: A library name, a .toml file, or a `Scenario`.
        difficulty: What scores the plans: the arms' twins (trained or taken from the cache), `blind` or `oracle`.
        plant: What moves the arms.
        bus: What carries the words between arms.
        channel: What becomes of words on the way: topology, delay, loss, partitions.
        cache: Folder of plans and twins.
        max_cycles, render_mode, mask_in: As in `fleet.env.allocation_v0.AllocationEnv`.
        peers: So many peers are in what an arm observes, those mounted nearest to it; all if not given.
        overrides: Top-level fields of the scenario to change, for example `horizon_s=600`.
    """
    if not isinstance(channel, Channel):
        raise ScenarioError(f"channel must be a fleet.bus.channel.Channel (got {channel!r}).")
    chosen = chosen_of(scenario, overrides, make_env)
    near = near_of(chosen, peers)
    fleet = prepare(chosen, difficulty=difficulty, cache=cache, progress=progress)
    options = {"max_cycles": max_cycles, "render_mode": render_mode, "mask_in": mask_in, "near": near}
    return env_of(fleet, plant=plant, bus=bus, channel=channel, **options)


def env_of(
    fleet: Fleet,
    *,
    plant: PlantName = "profile",
    bus: BusName = "memory",
    endpoint: str | None = None,
    channel: Channel = PERFECT,
    **options: Any,
) -> "AllocationEnv":
    """The `ParallelEnv` of a fleet that is ready; arguments as in `open_exchange`, options as in `AllocationEnv`."""
    from fleet.env.allocation_v0 import parallel_env

    choose("plant", plant, PlantName)
    names = tuple(arm.robot.name for arm in fleet.arms)
    exchange = open_exchange(bus, names, fleet.scenario.name, endpoint, channel)
    options = {"weights": fleet.scenario.reward, "cell": cell_of(fleet.scenario), **options}
    return parallel_env(ShiftFactory(fleet, plant), exchange=exchange, **options)
