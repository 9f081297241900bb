"""From nouns to arrays: arms with their plans, and jobs, as the tables and shifts of the engine."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from fleet.difficulty import Difficulty, DifficultyModel, Forecast, forecast_arrays, stack_forecasts
from fleet.engine.batch import Shift
from fleet.engine.state import ARM, LANES, no_absences
from fleet.engine.tables import LAW, MODAL, PLAN, WORK, Tables, bits, owned
from fleet.heat.motor import Motors, gen3_motors, stack_motors
from fleet.heat.thermal import (
    HOUSING,
    NODES,
    WINDING,
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
from fleet.robot import JOINTS, Robot, ThermalLimits
from fleet.telemetry import IDLE

Array = np.ndarray
CYCLES_S = 900.0
"""Time after which rises of the hottest motor are compared: that of a typical job, before its housing has settled."""
Space = Callable[[Sequence[Plan]], tuple[Array, Array]]
"""Volume of each plan, int [plan], and which volumes two arms cannot take at a time, bool [volume, volume]."""

Driven = tuple[Array, Array, Array, Array, float]
"""Of a plan: durations, s, [phase], mean squared current and friction heat, [phase, joint], largest torques, [joint],
and what its arm measures of `excess`."""


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
    def _driven(self) -> dict[int, tuple[Plan, Driven]]:
        return {}

    def offers(self, *works: Work) -> "ScoredPlans":
        """Its plans for works that serve alike, by repetitions; kept, because shift after shift asks for the same."""
        if works not in self._offered:
            variants = [plan for work in works for plan in self.plans.get(work, ())]
            self._offered[works] = ScoredPlans(self.model, variants)
        return self._offered[works]

    def driven(self, plan: Plan) -> Driven:
        """What one of its plans does to its motors."""
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


@dataclass(frozen=True, eq=False)
class World:
    """A fleet and its shifts, one in each env: the arrays of the engine, and what stands behind them."""

    fleet: tuple[Arm, ...]
    slots: int
    """Jobs on offer at a time, K."""
    kinds: tuple[Job, ...]
    """A job of each kind of the tables."""
    plans: tuple[Plan, ...]
    """Those of the rows of the plan table."""
    tables: Tables
    """With one fleet."""
    shifts: tuple[Shift, ...]
    """Of each env."""

    @cached_property
    def arms(self) -> tuple[str, ...]:
        """Names of the arms."""
        return tuple(arm.robot.name for arm in self.fleet)

    @cached_property
    def motors(self) -> Motors:
        """[arm, joint]."""
        return stack_motors([arm.motors for arm in self.fleet])

    @cached_property
    def thermal(self) -> ThermalModel:
        """[arm, ...]."""
        return stack_models([arm.thermal for arm in self.fleet])

    @property
    def stations(self) -> tuple[str, ...]:
        """Names of the stations of all jobs."""
        return stations_of(self.kinds)

    @property
    def dt_s(self) -> float:
        """Decision interval: the length of one step."""
        return self.tables.dt_s

    @property
    def ticks(self) -> int:
        """Steps until the horizon."""
        return self.tables.ticks

    @property
    def horizon_s(self) -> float:
        """Length of a shift, s."""
        return self.ticks * self.dt_s

    @property
    def plans_per_job(self) -> int:
        """Plans that an arm may have for a job."""
        return self.tables.work.shape[3]

    @cached_property
    def conflicts(self) -> Array:
        """Whether two arms cannot be away along two plans at a time, bool [plan, plan]."""
        work, volume = self.tables.work, np.zeros(len(self.tables.plans), int)
        volume[work["plan"][work["plan"] >= 0]] = work["volume"][work["plan"] >= 0]
        taken = np.unpackbits(self.tables.excluded.view(np.uint8), axis=1, bitorder="little")
        return taken[:, volume] > 0

    @property
    def jobs(self) -> int:
        """Largest number of jobs of a shift, at least 1."""
        return max(1, *(len(shift.kind) for shift in self.shifts))


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
) -> World:
    """The world of one or more parallel shifts, in which each job is a kind of its own.

    Args:
        shifts: The jobs of each env.
        ambient_c: Air at each arm during each tick, [tick, arm].
        start_warm: Arms begin at their idle equilibrium rather than at ambient.
        space: Which plans of two arms would touch; none if not given.
        plans_per_job: Most plans that an arm offers for a job.
        absences: Breaks and failures in each env, `ABSENCE` [absence]; none if not given.
    """
    kinds = tuple(job for jobs in shifts for job in jobs)
    plans, driven, work, forecasts = _offers(arms, kinds, plans_per_job)
    if space is None and any(job.alternatives for job in kinds):
        space = station_space  # the stations of these jobs depend on the plan
    volume, conflicts = space(plans) if space and plans else (np.zeros(max(1, len(plans)), int), np.zeros((1, 1), bool))
    work["volume"] = np.where(work["plan"] >= 0, volume[work["plan"]], 0)
    motors, learns = stack_motors([arm.motors for arm in arms]), all(arm.learns for arm in arms)
    believed = [heating_of(*arm.beliefs, dt_s) if learns else np.zeros((), LAW) for arm in arms]
    begin_c = [(arm, c, start_warm) for arm, c in zip(arms, ambient_c[0].tolist(), strict=True)]
    first, block, curve = forecast_arrays(stack_forecasts(forecasts) if forecasts else None, LANES).values()
    alike: dict[tuple[Work, ...], int] = {}
    tables = Tables(
        dt_s=float(dt_s),
        ticks=int(ticks),
        warning_c=float(limits.warning_c),
        error_c=float(limits.error_c),
        restart_c=float(limits.restart_c),
        clear_s=float(limits.clear_s),
        move_home_s=float(limits.move_home_s),
        power_off=bool(limits.power_off_on_fault),
        alpha_cu_per_k=float(motors.alpha_cu_per_k),
        alpha_kt_per_k=float(motors.alpha_kt_per_k),
        reference_c=float(motors.reference_c),
        ambient_c=np.array(ambient_c, dtype=float)[None],
        learns=learns,
        law=np.stack([law_of(arm, dt_s) for arm in arms])[None],
        believed=np.stack(believed)[None],
        modal=np.stack([_modal(*each) for each in begin_c])[None],
        start=np.stack([_at_home(arm, no_kind=work.shape[1]) for arm in arms])[None],
        plans=np.stack([_plan(each) for each in driven] or [np.zeros((), PLAN)]),
        excluded=bits(conflicts[volume]),
        work=work,
        forecast_first=first,
        forecast_block=block.astype(np.float32),
        forecast_curve=curve.astype(np.float32),
        least=np.nan_to_num(np.fmin.reduce(work["difficulty"], axis=-1), nan=-1.0),
        stations=_stations(kinds),
        payload_kg=_of_kinds(kinds, lambda job: job.work.payload_kg),
        value=_of_kinds(kinds, lambda job: job.value),
        alike=_of_kinds(kinds, lambda job: alike.setdefault(job.works, len(alike))).astype(int),
    )
    ends = np.cumsum([0, *map(len, shifts)]).tolist()
    own = tuple(_shift_of(jobs, at, absences) for jobs, at in zip(shifts, ends, strict=False))
    return World(tuple(arms), slots, kinds, plans, owned(tables), own)


def stations_of(jobs: Sequence[Job]) -> tuple[str, ...]:
    """Names of the stations of jobs."""
    return tuple(dict.fromkeys(name for job in jobs for name in job.stations))


def station_space(plans: Sequence[Plan]) -> tuple[Array, Array]:
    """Space of arms that never touch: plans exclude each other only at a station; see `Space`."""
    numbers: dict[tuple[str, tuple[str, ...]], int] = {}
    volume = [numbers.setdefault((plan.arm, plan.work.stations), len(numbers)) for plan in plans]
    stations = list(dict.fromkeys(name for _, names in numbers for name in names))
    needs = np.array([[station in names for station in stations] for _, names in numbers])
    return np.array(volume, dtype=int), needs.astype(int) @ needs.T > 0


def law_of(arm: Arm, dt_s: float) -> Array:
    """How an arm heats up, and what it estimates of it, in steps of a length, `LAW`."""
    observer = housing_observer(*arm.beliefs, dt_s)
    return _filled(
        heating_of(arm.thermal, arm.motors, dt_s),
        housing_keep=observer.keep.T,
        housing_gain=observer.gain.T,
        housing_winding=observer.from_winding,
        housing_ambient=observer.from_ambient,
        housing_idle_w=observer.idle_w,
        sensor_noise_k=arm.motors.sensor_noise_k,
        drift_k_per_s=arm.drift_k_per_s,
    )


def heating_of(thermal: ThermalModel, motors: Motors, dt_s: float) -> Array:
    """How a network heats up in steps of a length: a `LAW` without estimates and sensors."""
    phi, gamma = thermal.step_matrices(dt_s)
    return _filled(
        np.zeros((), LAW),
        step=np.concatenate([phi - np.eye(NODES), gamma], axis=-1).T,
        to_ambient=thermal.to_ambient,
        copper_w_per_a2=motors.copper_w_per_a2,
        idle_w=motors.idle_w,
    )


def _modal(arm: Arm, ambient_c: float, start_warm: bool) -> Array:
    """The thermal network by its modes, and the temperatures at the start of a shift, `MODAL`."""
    thermal = arm.thermal
    return _filled(
        np.zeros((), MODAL),
        root_capacity=np.sqrt(thermal.capacity),
        rates=thermal.rates,
        modes=thermal.modes,
        to_ambient=thermal.to_ambient,
        idle_w=arm.motors.idle_w,
        start_c=warm_start(arm, ambient_c) if start_warm else np.full(NODES, ambient_c),
        start_housing_c=arm.believed_housings(ambient_c) if start_warm else np.full(JOINTS, ambient_c),
    )


def _at_home(arm: Arm, no_kind: int) -> Array:
    """The arm at the start of a shift, `ARM`; `no_kind` is the kind of no job."""
    rest = arm.rest_drive()
    return _filled(
        np.zeros((), ARM),
        mode=IDLE,
        plan=-1,
        job=-1,
        kind=no_kind,
        current_sq=rest.current_sq,
        friction_w=rest.friction_w,
        phase_end_s=np.inf,
        clear_at_s=np.inf,
        moved_at_s=np.inf,
    )


def _offers(
    arms: Sequence[Arm], kinds: Sequence[Job], most: int
) -> tuple[tuple[Plan, ...], list[Driven], Array, list[Forecast]]:
    """The plans of all arms for kinds of jobs, what their motion is, `WORK` [1, kind, arm, plan] but for the volumes,
    and the forecasts to which it refers."""
    work = np.zeros((1, max(1, len(kinds)), len(arms), most), WORK)
    for name in ("risk", "peak", "plan"):
        work[name] = -1
    work["difficulty"] = work["p_saturation"] = np.nan
    rows: dict[int, int] = {}
    plans: list[Plan] = []
    driven: list[Driven] = []
    forecasts: dict[int, tuple[int, Forecast]] = {}
    able: dict[Work, list[int]] = {}  # few of a large cell
    for a, arm in enumerate(arms):
        for each in arm.plans:
            able.setdefault(each, []).append(a)

    def row_of(forecast: Forecast | None) -> int:
        return -1 if forecast is None else forecasts.setdefault(id(forecast), (len(forecasts), forecast))[0]

    for j, job in enumerate(kinds):
        for a in sorted({a for each in job.works for a in able.get(each, ())}):
            for n, (offer, score) in enumerate(arms[a].offers(*job.works)[job.repetitions][:most]):
                if id(offer) not in rows:
                    rows[id(offer)] = len(plans)
                    plans.append(offer)
                    driven.append(arms[a].driven(offer))
                times_s, cell = driven[rows[id(offer)]][0], work[0, j, a, n]
                cell["plan"], cell["travel_s"], cell["cycle_s"] = rows[id(offer)], times_s[0] + times_s[2], times_s[1]
                if score is not None:
                    cell["difficulty"], cell["risk"], cell["peak"] = score.total, row_of(score.risk), row_of(score.peak)
                    cell["p_saturation"] = np.nan if score.p_saturation is None else score.p_saturation
    return tuple(plans), driven, work, [forecast for _, forecast in forecasts.values()]


def _plan(driven: Driven) -> Array:
    """A row of the plan table, `PLAN`."""
    times_s, current_sq, friction_w, _, excess = driven
    return _filled(np.zeros((), PLAN), times_s=times_s, current_sq=current_sq, friction_w=friction_w, excess=excess)


def _stations(kinds: Sequence[Job]) -> Array:
    """Stations of each kind of job as bits, uint64 [1, kind + 1, word]; the last row, no job, has none."""
    names = stations_of(kinds)
    flags = np.zeros((1, max(1, len(kinds)) + 1, len(names)), bool)
    for j, job in enumerate(kinds):
        flags[0, j, [names.index(name) for name in job.stations]] = True
    return bits(flags)


def _of_kinds(kinds: Sequence[Job], value: Callable[[Job], float]) -> Array:
    """A number of each kind of job, [1, kind]; 0 if there is none."""
    return np.array([[value(job) for job in kinds] or [0.0]], dtype=float)


def _shift_of(jobs: Sequence[Job], first_kind: int, absences: Array | None) -> Shift:
    """The shift of jobs, whose kinds are consecutive."""
    check_precedence(jobs)
    index = {job.name: j for j, job in enumerate(jobs)}
    after = np.full((len(jobs), max((len(job.after) for job in jobs), default=0) or 1), -1)
    for row, job in zip(after, jobs, strict=True):
        row[: len(job.after)] = [index[name] for name in job.after]
    return Shift(
        kind=np.arange(first_kind, first_kind + len(jobs)),
        release_s=np.array([job.release_s for job in jobs], dtype=float),
        due_s=np.array([job.due_s for job in jobs], dtype=float),
        repetitions=np.array([job.repetitions for job in jobs], dtype=int),
        expires=np.array([job.expires for job in jobs], dtype=bool),
        after=after,
        absences=no_absences() if absences is None else absences,
        names=tuple(index),
    )


def _filled(record: Array, **fields: Array | float) -> Array:
    """The record with some fields, whose values are padded with zeros."""
    for name, values in fields.items():
        record[name][tuple(slice(0, n) for n in np.shape(values))] = values
    return record
