"""From a scenario to a fleet of arms with plans and twins, and to its environment, single or batched."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.policy import PlanningPolicy, Policy
from fleet.arm.plan_cache import rest_torque
from fleet.arm.space import SpaceTable, space_table
from fleet.bus.exchange.channel import PERFECT, Channel, check_channel
from fleet.bus.exchange.memory import Exchange
from fleet.difficulty import Blind
from fleet.engine.batch import Shift
from fleet.engine.profile_plant import ProfilePlant
from fleet.engine.tables import Tables
from fleet.engine.world import Arm, World, build_world, warm_start
from fleet.env.lookahead import CellSimulator
from fleet.errors import FleetError, InfeasibleJob, ScenarioError, distinguish
from fleet.fields import check_instance
from fleet.files import cache_folder
from fleet.job import Job, Work
from fleet.motion import Plan
from fleet.robot import Robot
from fleet.seeding import key_of, shift_seeds
from scenarios.cell_layout import cell_of, near_of
from scenarios.extras import require_extra
from scenarios.prepare.arms import REASONS, PlannedArm, air_offsets, plan_arms, problems_of
from scenarios.prepare.randomisation import Randomisation, ShiftConditions, randomisation_of
from scenarios.prepare.shipped import is_shipped
from scenarios.prepare.surprise import arms_with_surprises
from scenarios.progress import Count, Progress, check_progress, quiet
from scenarios.spec.calendar import absences_of
from scenarios.spec.jobs import JobSampler, all_works, kinds_of, rehearsal_works, weights_of, works_of
from scenarios.spec.load import scenario_with
from scenarios.spec.options import RISK, BusName, DifficultyName, PlantName, RiskName
from scenarios.spec.parse import choose
from scenarios.spec.schema import Scenario

if TYPE_CHECKING:
    from fleet.engine.shift import Episode, Plant
    from fleet.env.allocation_v2 import AllocationEnv, MaskPlace

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Fleet:
    """A scenario's arms, with plans and difficulty models."""

    scenario: Scenario
    arms: tuple[Arm, ...]
    infeasible: tuple[InfeasibleJob, ...]
    """Work that single arms cannot do, with reasons."""
    space: SpaceTable
    """Which plans of two arms exclude each other."""
    randomise: Randomisation = field(default_factory=Randomisation)
    """What varies from shift to shift besides the jobs."""
    variants: tuple["Fleet", ...] = ()
    """The fleets of `randomise.variants`."""
    planned: tuple[PlannedArm, ...] = ()
    """What `prepare` planned, for another scenario of the same cell."""
    difficulty: DifficultyName = "twin"
    risk: RiskName = RISK
    """As in `prepare`."""

    def __repr__(self) -> str:
        return f"<Fleet of {self.scenario.name}: {len(self.arms)} arms, difficulty '{self.difficulty}'>"

    @property
    def all(self) -> tuple["Fleet", ...]:
        """The fleet and its variants."""
        return (self, *self.variants)

    def conditions(self, seed: np.random.SeedSequence) -> ShiftConditions:
        """The conditions of the shift of a seed; its fleet is an index of `all`."""
        return self.randomise.sample(seed, len(self.all))


def prepare(
    scenario: str | Path | Scenario,
    *,
    difficulty: DifficultyName = "twin",
    risk: RiskName = RISK,
    randomise: Randomisation | None = None,
    training: int = 0,
    cache: str | Path | None = None,
    progress: Progress = quiet,
    like: Fleet | None = None,
) -> Fleet:
    """Plan every task type for every arm, and assign each arm its difficulty model; both are cached by content.

    Args:
        scenario: A library name, a .toml file, or a `Scenario`.
        randomise: In addition to what a scenario samples for a shift: ambient temperature, arrivals, fleets.
        training: Which training of the twins, from 0.
        like: Prepared from a scenario with the same arms, cell and task types; its plans and space table are reused.

    Raises:
        ScenarioError: no such scenario, no arm can do some work, an arm can do none, arms at home are too close to each
            other, or a variant is no fleet of the same arms and jobs.
        MissingExtra: twins must be trained, and the libraries for it are not installed.
    """
    randomise = randomisation_of(randomise)
    if not isinstance(training, int) or training < 0:
        raise FleetError(f"training must be an integer >= 0 (got {training!r}).")
    check_progress(progress)
    if like is not None:
        check_instance("like", like, Fleet, "the result of prepare()")
    specs = randomise.scenarios_of(scenario_with(scenario, {}, prepare))
    fleets: list[Fleet] = []
    for i, spec in enumerate(specs):
        share = progress if len(specs) == 1 else lambda stage, s, i=i: progress(stage, (i + s) / len(specs))
        made = like and like.all[i]
        arms, planned = _arms(
            spec, range(len(spec.arms)), difficulty, risk, cache, share, every_work=True, training=training, like=made
        )
        plans = [plan for arm in arms for variants in arm.plans.values() for plan in variants]
        robots = [arm.robot for arm in arms]
        space = made.space if made else space_of(spec, robots, plans, _folder(cache), share)
        refused = tuple(error for arm in planned for error in arm.infeasible)

        fleets.append(
            Fleet(spec, tuple(arms), refused, space, planned=tuple(planned), difficulty=difficulty, risk=risk)
        )
    late = list(unfinishable_jobs(specs[0], fleets[0].planned))
    for sentence in late[:REASONS]:
        _LOG.warning("%s", sentence)
    if len(late) > REASONS:
        _LOG.warning("%s.toml: %d more jobs cannot finish in time.", specs[0].name, len(late) - REASONS)
    return replace(fleets[0], randomise=randomise, variants=tuple(fleets[1:]))


def space_of(
    scenario: Scenario, robots: Sequence[Robot], plans: Sequence[Plan], folder: Path, progress: Progress = quiet
) -> SpaceTable:
    """Space of the plans of a scenario's arms; cached in `folder`."""

    def report(done: int, total: int) -> None:
        progress("finding motions that exclude each other", Count(done, total))

    return space_table(robots, plans, scenario.clearance_m, folder / "plans", report)


def prepare_arm(
    scenario: Scenario,
    name: str,
    *,
    difficulty: DifficultyName = "twin",
    risk: RiskName = RISK,
    cache: str | Path | None = None,
    progress: Progress = quiet,
) -> Arm:
    """One arm of a scenario, equal to the arm of the same name in the prepared fleet.

    Raises:
        FleetError: the scenario has no such arm.
    """
    (arm,), _ = _arms(scenario, [scenario.index_of(name)], difficulty, risk, cache, progress, every_work=False)
    return arm


def _arms(
    scenario: Scenario,
    indices: Sequence[int],
    difficulty: DifficultyName,
    risk: RiskName,
    cache: str | Path | None,
    progress: Progress,
    *,
    every_work: bool,
    training: int = 0,
    like: Fleet | None = None,
) -> tuple[list[Arm], Sequence[PlannedArm]]:
    """The arms with these indices in the scenario, with their difficulty models, and as they were planned.

    Args:
        every_work: Raise if none of the arms can do some work.
    """
    check_progress(progress)
    if choose("difficulty", difficulty, DifficultyName) == "twin" and not is_shipped(scenario.name):
        require_extra("twin")
    choose("risk", risk, RiskName)
    folder = _folder(cache)
    asked = all_works(scenario)
    works = rehearsal_works(scenario) if difficulty == "twin" else asked
    planned = like.planned if like else plan_arms(scenario, indices, works, folder, progress)
    if problems := cell_problems(scenario, planned if every_work else (), folder):
        raise ScenarioError("\n".join(problems))
    arms = [arm.before or arm for arm in like.arms] if like else [_blind_arm(arm, asked, folder) for arm in planned]
    if difficulty == "twin":
        from scenarios.prepare.calibrate import calibrate_networks
        from scenarios.prepare.twins import train_twins, training_seed
        from twin.thermal.thermal_twin import CalibratedTwin

        twins = train_twins(scenario, planned, folder, progress, seed=training_seed(scenario, training))
        heats = calibrate_networks(scenario, planned, folder, progress, risk=risk)
        arms = [
            replace(arm, model=CalibratedTwin(twin, heat), known=(heat.thermal, heat.motors), learns=True)
            for arm, twin, heat in zip(arms, twins, heats, strict=True)
        ]
    elif difficulty == "oracle":
        return [_with_oracle(scenario, arm) for arm in arms_with_surprises(scenario, arms)], planned
    return list(arms_with_surprises(scenario, arms)), planned


def cell_problems(scenario: Scenario, arms: Sequence[PlannedArm], folder: Path) -> list[str]:
    """As `problems_of`; without such problems, a sentence for each arm that can do no job of the scenario."""
    if problems := problems_of(scenario, arms, folder):
        return problems
    for arm in arms:
        if not any(work in arm.plans for work in all_works(scenario)):
            name, reasons = arm.hardware.robot.name, dict.fromkeys(f"{e.place}: {e.reason}" for e in arm.infeasible)
            more = f"; and {len(reasons) - REASONS} more" if len(reasons) > REASONS else ""
            problems.append(
                f"{scenario.name}.toml: arms[{arm.index}]: '{name}' can do no job ({'; '.join(list(reasons)[:REASONS])}"
                f"{more}); move the arm or the places, give it jobs, or leave it out."
            )
    return problems


def unfinishable_jobs(scenario: Scenario, arms: Sequence[PlannedArm]) -> Iterator[str]:
    """A sentence for each stream whose jobs cannot finish before they are due, or in the shift.

    A table with whole minutes probably has them as h:mm, so there is no question about their unit.
    """

    @cache
    def least_s(works: tuple[Work, ...], cycles: int) -> float:
        plans = (plan for arm in arms for work in works for plan in arm.plans.get(work, ()))
        return min((plan.approach.duration_s + cycles * plan.cycle.duration_s for plan in plans), default=0.0)

    for i, stream in enumerate(scenario.jobs):
        cycles, spec = stream.repetitions[0], stream.arrivals
        left_s = scenario.horizon_s - spec.start_s - min(spec.times_s or (0.0,))
        place, until = stream.place_of(i, "release") if stream.row else "horizon_s", "the shift ends"
        if stream.due == "soft" and stream.due_s < left_s:  # a hard job must only begin before it is due
            left_s, place, until = stream.due_s, stream.place_of(i, "due" if stream.row else "due_s"), "it is due"
        needed_s = least_s(works_of(scenario, stream), cycles)
        if (left_s < 0 and spec.times_s) or needed_s <= left_s:  # parsing reports times outside the shift
            continue
        left_s = max(left_s, 0.0)
        unit = next((name for name, s in (("minutes", 60.0), ("hours", 3600.0)) if s * left_s >= needed_s), "")
        if stream.row and not any(time_s % 60.0 for time_s in (*(spec.times_s or ()), stream.due_s)):
            unit = ""
        needed, left = distinguish(needed_s, left_s)
        yield (
            f"{scenario.name}.toml: {place}: '{stream.name}' takes at least {needed} s ({cycles} "
            f"cycle{'s' * (cycles > 1)}), but has {left} s until {until}."
            f"{unit and f' Are its times {unit}? Give seconds.'}"
        )


def _blind_arm(planned: PlannedArm, works: Sequence[Work], folder: Path) -> Arm:
    """The arm with its plans for these works, without scores."""
    robot, motors, thermal = planned.hardware
    return Arm(
        robot=robot,
        motors=motors,
        thermal=thermal,
        rest_tau=rest_torque(robot, folder / "plans"),
        model=Blind(),
        plans={work: planned.plans[work] for work in works if work in planned.plans},
        too_heavy=planned.too_heavy,
    )


def _folder(cache: str | Path | None) -> Path:
    """Folder of plans and twins; made if it does not exist."""
    if not isinstance(cache, str | Path | None):
        raise ScenarioError(f"cache must be the path of a folder (got {cache!r}).")
    folder = Path(cache) if cache else cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FleetError(f"Cannot keep plans and twins in '{folder}': {error.strerror}.") from error
    return folder


def _with_oracle(scenario: Scenario, arm: Arm) -> Arm:
    from scenarios.prepare.oracle import Oracle

    cell_c = float(np.mean(scenario.ambient.at(np.linspace(0, scenario.horizon_s, 100))))
    ambient_c = cell_c + arm.robot.ambient_offset_k
    model = Oracle(
        arm.motors, arm.thermal, warm_start(arm, ambient_c), ambient_c, scenario.limits.warning_c, arm.executed
    )
    return replace(arm, model=model, known=(arm.thermal, arm.motors), drift_k_per_s=0.0)


def world_of(fleet: Fleet, jobs: Sequence[Job], absences: np.ndarray | None = None) -> World:
    """The world of a shift with these jobs; arguments as in `build_world`."""
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
        space=fleet.space.rows,
        absences=absences,
    )


@dataclass(frozen=True, eq=False)
class ShiftFactory:
    """Makes the shifts of a fleet: for the batch as arrays, for the single environment as episodes."""

    fleet: Fleet
    plant: PlantName = "profile"

    @cached_property
    def worlds(self) -> tuple[World, ...]:
        """Of the fleet and of its variants, with a job of each kind of the scenario."""
        return tuple(world_of(each, kinds_of(each.scenario)) for each in self.fleet.all)

    @cached_property
    def _sampler(self) -> JobSampler:
        return JobSampler(self.fleet.scenario)

    def draw(self, seed: np.random.SeedSequence, *, named: bool = False) -> Shift:
        """The shift of a seed.

        Args:
            named: With the names of its jobs.
        """
        conditions = self.fleet.conditions(seed)
        jobs_seed, sensor_seed = shift_seeds(seed)
        return self._sampler.shift(
            jobs_seed,
            conditions.arrivals,
            named=named,
            fleet=conditions.fleet,
            ambient_offset_k=conditions.ambient_k,
            noise_key=key_of(sensor_seed),
            absences=absences_of(self.fleet.all[conditions.fleet].scenario, seed),
        )

    def __call__(self, seed: np.random.SeedSequence) -> "Episode":
        """The episode of a seed; the same seed gives the same episode."""
        from fleet.engine.shift import Episode

        shift = self.draw(seed, named=True)
        fleet, world = self.fleet.all[shift.fleet], self.worlds[shift.fleet]
        world = replace(world, shifts=(replace(shift, fleet=0),))
        robots, rest_tau = [arm.robot for arm in fleet.arms], np.stack([arm.rest_tau for arm in fleet.arms])
        others = {plan: other for arm in fleet.arms for plan, other in arm.executed.items()}
        executed = tuple(others.get(plan, plan) for plan in world.plans)
        plant: Plant
        if self.plant == "mujoco":
            from fleet.arm.plant import MujocoPlant

            plant = MujocoPlant(robots, executed, rest_tau, fleet.scenario.places, fleet.scenario.fixtures)
        else:
            plant = ProfilePlant(executed, np.stack([robot.home_q() for robot in robots]), rest_tau)
        twins = tuple(arm.model.version for arm in fleet.arms)
        return Episode(world=world, plant=plant, twins=twins, sensors=shift_seeds(seed)[1])


def with_surprises(fleet: Fleet) -> Fleet:
    """The fleet as it is in the shifts of its scenario, with the scenario's surprises."""
    variants = tuple(with_surprises(each) for each in fleet.variants)
    return replace(fleet, arms=arms_with_surprises(fleet.scenario, fleet.arms), variants=variants)


def as_known(fleet: Fleet) -> Fleet:
    """The fleet with the thermal networks and motors that its arms know, and without scores."""
    variants = tuple(as_known(each) for each in fleet.variants)
    return replace(fleet, arms=tuple(_as_known(arm) for arm in fleet.arms), variants=variants)


def _as_known(arm: Arm) -> Arm:
    from scenarios.prepare.oracle import Oracle

    thermal, motors = arm.beliefs
    known = replace(
        arm, thermal=thermal, motors=motors, model=Blind(), known=arm.beliefs, drift_k_per_s=0.0, learns=False
    )
    return known if isinstance(arm.model, Oracle) else replace(known, before=None, executed={})


def simulator_of(fleet: Fleet, tables: Tables) -> CellSimulator:
    """The simulator of a cell for policies that plan.

    Args:
        tables: Of `as_known(fleet)`.
    """
    return CellSimulator(tables, len(fleet.arms), fleet.scenario.slots, weights_of(fleet.scenario))


def simulator_of_shift(fleet: Fleet, seed: int) -> CellSimulator:
    """The simulator of a cell for the shift of one seed."""
    known = as_known(fleet)
    variant = known.all[fleet.conditions(np.random.SeedSequence(seed)).fleet]
    return simulator_of(fleet, world_of(variant, kinds_of(variant.scenario)).tables)


def let_plan(policy: Policy, fleet: Fleet, env: "AllocationEnv", seed: int) -> None:
    """Give a policy that plans a simulator of the shift that an env has just begun, of a prepared fleet and a seed."""
    if isinstance(policy, PlanningPolicy):
        policy.plan_in(env.lookahead(simulator_of_shift(fleet, seed)))


def open_exchange(
    bus: BusName, arms: tuple[str, ...], fleet: str, endpoint: str | None = None, channel: Channel = PERFECT
) -> Exchange:
    """The exchange of a name; over Zenoh it uses the router at the endpoint, or an in-process router.

    Raises:
        FleetError: there is no such bus, the channel names other arms, or the library of the bus is not installed.
    """
    choose("bus", bus, BusName)
    try:
        if bus == "memory":
            return Exchange(arms, channel)
        require_extra("bus")
        from fleet.bus.exchange.zenoh import ZenohExchange

        return ZenohExchange(arms, fleet, endpoint, channel=channel)
    except ValueError as error:
        raise FleetError(str(error)) from error


_BATCHED = frozenset({"num_envs", "autoreset", "stagger", "threads"})
"""Options of `make_batch` that one environment does not have."""


def make_env(
    scenario: str | Path | Scenario,
    *,
    difficulty: DifficultyName = "twin",
    risk: RiskName = RISK,
    randomise: Randomisation | None = None,
    plant: PlantName = "profile",
    bus: BusName = "memory",
    channel: Channel = PERFECT,
    cache: str | Path | None = None,
    max_cycles: int | None = None,
    render_mode: str | None = None,
    mask_in: "MaskPlace" = "obs",
    peers: int | None = None,
    scaled: bool = True,
    ahead_s: float = 0.0,
    bids: bool = False,
    progress: Progress = quiet,
    **overrides: Any,  # one type per field
) -> "AllocationEnv":
    """The PettingZoo `ParallelEnv` of a scenario.

    Args:
        scenario: A library name, a .toml file, or a `Scenario`.
        difficulty: Source of the scores: `twin` (from the cache, or trained), `blind` (none) or `oracle` (true values).
        risk: Model of the twins' P(saturation); see `RiskName`.
        randomise: In addition to what a scenario samples: ambient temperature, arrivals, fleets.
        plant: Motion of the arms: `profile` (exactly as planned) or `mujoco` (closed loop).
        bus: Transport of the messages between arms.
        channel: Topology, delay, loss and partitions of the messages; if it is perfect, those of the scenario.
        cache: Folder of plans and twins.
        max_cycles, render_mode, mask_in: As in `fleet.env.allocation_v2.AllocationEnv`.
        peers: Number of peers in an arm's observation, the nearest ones; default: all.
        scaled, ahead_s: As in `fleet.env.vector.BatchEnv`. `thermofleet run` and `compare` give their policies
            False and infinity.
        bids: Whether an arm observes its peers' predictions for the open jobs.
        overrides: Top-level fields of the scenario to change, for example `horizon_s=600`; Any, as fields differ.

    Raises:
        ArgumentError, ScenarioError: an argument is not allowed.
        FleetError: the fleet cannot be prepared.
    """
    check_channel(channel)
    if batched := sorted(_BATCHED & set(overrides)):
        raise ScenarioError(f"make_env() takes no {batched[0]}; only make_batch() does.")
    chosen = scenario_with(scenario, overrides, make_env)
    near = near_of(chosen, peers)
    fleet = prepare(chosen, difficulty=difficulty, risk=risk, randomise=randomise, cache=cache, progress=progress)
    options = {"max_cycles": max_cycles, "render_mode": render_mode, "mask_in": mask_in, "near": near}
    options |= {"scaled": scaled, "ahead_s": ahead_s, "bids": bids}
    return env_of(fleet, plant=plant, bus=bus, channel=channel, **options)


def env_of(
    fleet: Fleet,
    *,
    plant: PlantName = "profile",
    bus: BusName = "memory",
    endpoint: str | None = None,
    channel: Channel = PERFECT,
    **options: Any,  # passed on
) -> "AllocationEnv":
    """The `ParallelEnv` of a prepared fleet; arguments as in `open_exchange`, options (Any) as in `AllocationEnv`."""
    from fleet.env.allocation_v2 import parallel_env

    choose("plant", plant, PlantName)
    names = tuple(arm.robot.name for arm in fleet.arms)
    exchange = open_exchange(bus, names, fleet.scenario.name, endpoint, fleet.scenario.channel(channel))
    options = {"weights": weights_of(fleet.scenario), "cell": cell_of(fleet.scenario), **options}
    options.setdefault("decisions", fleet.scenario.decisions)
    return parallel_env(ShiftFactory(fleet, plant), exchange=exchange, **options)
