"""From nouns to arrays: the plan table, the offers of every arm for every job, and the world of a shift."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from fleet.difficulty import Difficulty, DifficultyModel, Forecast, stack_forecasts
from fleet.engine.state import JobTable, Law, Offers, PlanTable, World, no_absences
from fleet.heat.motor import Motors, gen3_motors, stack_motors
from fleet.heat.thermal import (
    HOUSING,
    WINDING,
    HousingObserver,
    ThermalModel,
    gen3_network,
    housing_observer,
    node_heat,
    stack_models,
    steady_state,
    thermal_model,
)
from fleet.job import Job, Work, check_precedence
from fleet.motion import Drive, Plan, drive
from fleet.offered_plans import PLANS, offered_plans
from fleet.robot import GEN3, Robot, ThermalLimits

Array = np.ndarray
CYCLES_S = 900.0
"""Time after which rises of the hottest motor are compared: that of a typical job, before its housing has settled."""
Space = Callable[[Sequence[Plan]], tuple[Array, Array]]
"""Volume of each plan, int [plan], and which volumes two arms cannot take at a time, bool [volume, volume]."""


@dataclass(frozen=True, eq=False)
class Arm:
    """One arm with everything that is its own."""

    robot: Robot
    motors: Motors
    """[joint]."""
    thermal: ThermalModel
    rest_tau: Array
    """Torque that holds the home posture, N·m, [joint]."""
    model: DifficultyModel
    """Its twin, or what stands in for it."""
    plans: Mapping[Work, tuple[Plan, ...]]
    """Variants per work it can do; a work it cannot do is missing."""
    too_heavy: frozenset[Work] = frozenset()
    """Works whose load exceeds its rating."""
    known: tuple[ThermalModel, Motors] | None = None
    """What the arm knows of its own heat, for its estimate of the housings; None: a nominal arm with its cooling."""
    before: "Arm | None" = None
    """The arm as prepared, if something of it has changed since."""
    executed: Mapping[Plan, Plan] = field(default_factory=dict)
    """Plans with their true torques, where these differ from the planned ones."""
    drift_k_per_s: float = 0.0
    """Drift of its readings of motor temperatures."""
    learns: bool = False
    """Whether it corrects its predictions by the heat and the temperatures that it measures; all arms of a fleet do, or
    none."""

    @cached_property
    def _offered(self) -> dict[tuple[Work, ...], "ScoredPlans"]:
        return {}

    @cached_property
    def warm_c(self) -> dict[float, Array]:
        """Settled temperatures by the air they settled in, as `warm_start` finds them."""
        return {}

    @cached_property
    def _driven(self) -> dict[int, tuple[Plan, tuple[Array, Array, Array, Array, float]]]:
        return {}

    def offers(self, *works: Work) -> "ScoredPlans":
        """Its plans for works that serve alike, by repetitions; kept, because shift after shift asks for the same."""
        if works not in self._offered:
            variants = [plan for work in works for plan in self.plans.get(work, ())]
            self._offered[works] = ScoredPlans(self.model, variants)
        return self._offered[works]

    def driven(self, plan: Plan) -> tuple[Array, Array, Array, Array, float]:
        """Of one of its plans: durations, s, [phase], mean squared current and friction heat, [phase, joint], largest
        torques, [joint], and what it measures of `excess`."""
        if id(plan) not in self._driven:  # with the plan itself, so that its id stays its own
            phases = self.executed.get(plan, plan).phases
            times_s = np.array([phase.duration_s for phase in phases])
            drives = [drive(phase.profile, self.motors) for phase in phases]
            peak = np.abs(np.concatenate([phase.profile[:, 2] for phase in phases])).max(axis=0).astype(float)
            current_sq, friction_w = (np.array([getattr(d, n) for d in drives]) for n in ("current_sq", "friction_w"))
            excess = self.excess(plan, drives[1]) if self.learns else 0.0
            self._driven[id(plan)] = plan, (times_s, current_sq, friction_w, peak, excess)
        return self._driven[id(plan)][1]

    def excess(self, plan: Plan, measured: Drive) -> float:
        """Rise of the hottest motor by measured currents and joint torques, over that by those of the plan, less 1.

        Both after `CYCLES_S` of cycles, by the network and motors that the arm knows.
        """
        _, motors = self.beliefs
        expected_k, measured_k = (
            (self._rise_by_heat @ node_heat(motors.copper_w_per_a2 * load.current_sq, load.friction_w))[WINDING].max()
            for load in (drive(plan.cycle.profile, motors), measured)
        )
        return float(measured_k / expected_k) - 1.0 if expected_k > 0 else 0.0

    @cached_property
    def _rise_by_heat(self) -> Array:
        """Rise by constant heat for `CYCLES_S` in the network that the arm knows, K/W, [node, node]."""
        return self.beliefs[0].step_matrices(CYCLES_S)[1]

    def rest_drive(self, motors: Motors | None = None) -> Drive:
        """Mean heat drive of standing at home, each [joint]; of other motors if given."""
        still = np.stack([self.robot.home_q(), np.zeros_like(self.rest_tau), self.rest_tau])[None]
        return drive(still, motors or self.motors)

    @cached_property
    def beliefs(self) -> tuple[ThermalModel, Motors]:
        """`known`, or a nominal arm with this arm's cooling."""
        return self.known or (thermal_model(gen3_network(cooling=self.robot.cooling)), gen3_motors())

    @lru_cache(maxsize=64)  # noqa: B019  # of the arms of the last fleets
    def believed_housings(self, ambient_c: float) -> Array:
        """Housing temperatures that the arm expects after hours at home, °C, [joint]; the ambient if none settle."""
        thermal, motors = self.beliefs
        rest = self.rest_drive(motors)
        settled = steady_state(thermal, rest.current_sq, rest.friction_w, motors, ambient_c)
        return np.full(len(self.rest_tau), ambient_c) if settled is None else settled[HOUSING]


class ScoredPlans(dict[int, list[tuple[Plan, Difficulty | None]]]):
    """The plans on offer for a job by number of repetitions, with their scores; scored when first asked for."""

    def __init__(self, model: DifficultyModel, variants: Sequence[Plan]) -> None:
        super().__init__()
        self._model, self._variants = model, variants

    def __missing__(self, repetitions: int) -> list[tuple[Plan, Difficulty | None]]:
        offered = offered_plans(self._variants, repetitions)
        self[repetitions] = [(plan, self._model.score(plan, repetitions)) for plan in offered]
        return self[repetitions]


def warm_start(arm: Arm, ambient_c: float) -> Array:
    """Temperatures of an arm that has stood powered at home for hours until the shift, °C, [node].

    Raises:
        ValueError: standing at home alone overheats it.
    """
    arm = arm.before or arm
    known = arm.warm_c.get(ambient_c)
    if known is None:
        rest = arm.rest_drive()
        known = steady_state(arm.thermal, rest.current_sq, rest.friction_w, arm.motors, ambient_c)
    if known is None:
        raise ValueError(
            f"Arm '{arm.robot.name}' has no steady state when idle at home at {ambient_c:g} °C ambient temperature."
        )
    arm.warm_c[ambient_c] = known
    return known.copy()


def build_world(
    arms: Sequence[Arm],
    shifts: Sequence[Sequence[Job]],
    *,
    limits: ThermalLimits,
    dt_s: float,
    ticks: int,
    slots: int,
    ambient_c: Array,
    start_warm: bool,
    space: Space | None = None,
    plans_per_job: int = PLANS,
    absences: Array | None = None,
) -> tuple[World, tuple[Plan, ...]]:
    """The world of one or more parallel shifts, and the plans behind the rows of its plan table.

    Args:
        shifts: The jobs of each env.
        ambient_c: Air at each arm during each tick, [tick, arm].
        start_warm: Arms begin at their idle equilibrium rather than at ambient.
        space: Which plans of two arms would touch; none if not given.
        plans_per_job: Most plans that an arm offers for a job.
        absences: Breaks and failures, `ABSENCE` [absence]; none if not given.
    """
    motors, thermal, rest, phi, gamma, observer, believed = _laws(tuple(arms), dt_s)
    plans, offers = _offers(arms, shifts, plans_per_job)
    if space is None and any(job.alternatives for jobs in shifts for job in jobs):
        space = station_space  # the stations of these jobs depend on the plan
    volume, conflicts = space(plans) if space and plans else (np.zeros(max(1, len(plans)), int), np.zeros((1, 1), bool))
    start = np.repeat(ambient_c[0][:, None], thermal.capacity.shape[-1], axis=1)
    housing_c = np.repeat(ambient_c[0][:, None], len(GEN3.velocity), axis=1)
    if start_warm:
        housing_c = np.stack([a.believed_housings(c) for a, c in zip(arms, ambient_c[0].tolist(), strict=True)])
        start = np.stack([warm_start(a, c) for a, c in zip(arms, ambient_c[0].tolist(), strict=True)])
    stations = tuple(dict.fromkeys(name for jobs in shifts for job in jobs for name in job.stations))
    world = World(
        arms=tuple(arm.robot.name for arm in arms),
        stations=stations,
        dt_s=dt_s,
        ticks=ticks,
        slots=slots,
        ambient_c=ambient_c,
        thermal=thermal,
        motors=motors,
        limits=limits,
        torque_warning=np.array(GEN3.torque_warning),
        rest=rest,
        plans=_plan_table(plans, {arm.robot.name: arm for arm in arms}, volume),
        jobs=_job_table(shifts, stations),
        offers=offers,
        conflicts=conflicts,
        observer=observer,
        start_c=start,
        start_housing_c=housing_c,
        phi=phi,
        gamma=gamma,
        drift_k_per_s=np.array([arm.drift_k_per_s for arm in arms]),
        believed=believed,
        absences=no_absences() if absences is None else absences,
    )
    return world, plans


def station_space(plans: Sequence[Plan]) -> tuple[Array, Array]:
    """Space of arms that never touch: plans exclude each other only at a station; see `Space`."""
    numbers: dict[tuple[str, tuple[str, ...]], int] = {}
    volume = [numbers.setdefault((plan.arm, plan.work.stations), len(numbers)) for plan in plans]
    stations = list(dict.fromkeys(name for _, names in numbers for name in names))
    needs = np.array([[station in names for station in stations] for _, names in numbers])
    return np.array(volume, dtype=int), needs.astype(int) @ needs.T > 0


@lru_cache(maxsize=8)
def _laws(
    arms: tuple[Arm, ...], dt_s: float
) -> tuple[Motors, ThermalModel, Drive, Array, Array, HousingObserver, Law | None]:
    """What is the same in every shift: motors, thermal models and rest of a fleet, [arm, ...], the matrices of a step,
    the observers of the arms' housings, and what the arms believe."""
    thermal, drives = stack_models([arm.thermal for arm in arms]), [arm.rest_drive() for arm in arms]
    rest = Drive(np.stack([d.current_sq for d in drives]), np.stack([d.friction_w for d in drives]))
    observers = [housing_observer(*arm.beliefs, dt_s) for arm in arms]
    observer = HousingObserver(*(np.stack(parts) for parts in zip(*observers, strict=True)))
    believed = None
    if all(arm.learns for arm in arms):
        known, motors = stack_models([arm.beliefs[0] for arm in arms]), stack_motors([arm.beliefs[1] for arm in arms])
        believed = Law(motors, known, *known.step_matrices(dt_s))
    return stack_motors([arm.motors for arm in arms]), thermal, rest, *thermal.step_matrices(dt_s), observer, believed


def _offers(arms: Sequence[Arm], shifts: Sequence[Sequence[Job]], most: int) -> tuple[tuple[Plan, ...], Offers]:
    shape = (len(shifts), len(arms), max(1, *map(len, shifts)), most)
    plan, total, p_saturation = np.full(shape, -1), np.full(shape, np.nan), np.full(shape, np.nan)
    risk, peak = np.full(shape, -1), np.full(shape, -1)
    rows: dict[int, int] = {}
    plans: list[Plan] = []
    forecasts: dict[int, tuple[int, Forecast]] = {}

    def row_of(forecast: Forecast | None) -> int:
        return -1 if forecast is None else forecasts.setdefault(id(forecast), (len(forecasts), forecast))[0]

    able = _arms_of_works(tuple(arms))
    offered: dict[tuple[int, int], list[tuple[int, ScoredPlans]]] = {}  # by id: hashing takes longest
    for e, jobs in enumerate(shifts):
        for j, job in enumerate(jobs):
            alike = id(job.work), id(job.alternatives)
            if alike not in offered:
                those = sorted({a for work in job.works for a in able.get(work, ())})
                offered[alike] = [(a, arms[a].offers(*job.works)) for a in those]
            for a, offers in offered[alike]:
                for n, (offer, score) in enumerate(offers[job.repetitions][:most]):
                    if id(offer) not in rows:
                        rows[id(offer)] = len(plans)
                        plans.append(offer)
                    plan[e, a, j, n] = rows[id(offer)]
                    if score is not None:
                        total[e, a, j, n] = score.total
                        p_saturation[e, a, j, n] = np.nan if score.p_saturation is None else score.p_saturation
                        risk[e, a, j, n], peak[e, a, j, n] = row_of(score.risk), row_of(score.peak)
    stack = stack_forecasts([forecast for _, forecast in forecasts.values()]) if forecasts else None
    scores = {"difficulty": total, "p_saturation": p_saturation, "risk": risk, "peak": peak, "forecasts": stack}
    return tuple(plans), Offers(plan=plan, **scores)


@lru_cache(maxsize=8)
def _arms_of_works(arms: tuple[Arm, ...]) -> dict[Work, list[int]]:
    """The arms that have plans for each work: few of a large cell."""
    able: dict[Work, list[int]] = {}
    for a, arm in enumerate(arms):
        for work in arm.plans:
            able.setdefault(work, []).append(a)
    return able


def _plan_table(plans: Sequence[Plan], arms: Mapping[str, Arm], volume: Array) -> PlanTable:
    if not plans:
        joints = len(GEN3.velocity)
        empty = np.zeros((1, 3, joints))
        return PlanTable(np.zeros((1, 3)), empty, empty, np.zeros((1, joints)), volume, np.zeros(1))
    driven = zip(*(arms[plan.arm].driven(plan) for plan in plans), strict=True)
    times_s, current_sq, friction_w, peak_tau, excess = map(np.array, driven)
    return PlanTable(times_s, current_sq, friction_w, peak_tau, volume, excess)


def _job_table(shifts: Sequence[Sequence[Job]], stations: Sequence[str]) -> JobTable:
    station = {name: i for i, name in enumerate(stations)}
    after: list[list[list[int]]] = []
    for jobs in shifts:
        check_precedence(jobs)
        index = {job.name: j for j, job in enumerate(jobs)}
        after.append([[index[name] for name in job.after] for job in jobs])
    most = max(1, *map(len, shifts))
    alike: dict[tuple[Work, ...], int] = {}

    def table(of: Callable[[Job], float], missing: float, dtype: type = float) -> Array:
        rows = [[of(job) for job in jobs] + [missing] * (most - len(jobs)) for jobs in shifts]
        return np.array(rows, dtype=dtype)

    def lists(rows: Sequence[Sequence[Sequence[int]]]) -> Array:
        longest = max((len(each) for row in rows for each in row), default=0) or 1
        full = [[[*each, *[-1] * (longest - len(each))] for each in row] for row in rows]
        return np.array([row + [[-1] * longest] * (most - len(row)) for row in full], dtype=int)

    return JobTable(
        names=tuple(tuple(job.name for job in jobs) for jobs in shifts),
        exists=np.arange(most) < np.array([[len(jobs)] for jobs in shifts]),
        release_s=table(lambda job: job.release_s, np.inf),
        due_s=table(lambda job: job.due_s, np.inf),
        value=table(lambda job: job.value, 0.0),
        payload_kg=table(lambda job: job.work.payload_kg, 0.0),
        repetitions=table(lambda job: job.repetitions, 1, int),
        after=lists(after),
        expires=table(lambda job: job.expires, False, bool),
        alike=table(lambda job: alike.setdefault(job.works, len(alike)), 0, int),
        stations=lists([[[station[name] for name in job.stations] for job in jobs] for jobs in shifts]),
    )
