"""Body of a live arm, that is its motion, heat and sensors: simulated, or replayed from the log of a real arm."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import ceil, floor
from typing import Literal, Protocol

import numpy as np

from fleet.difficulty import Blind
from fleet.engine.corrections import compare, line_of
from fleet.engine.profile_plant import ProfilePlant, telemetry_of
from fleet.engine.shift import StepRecord, initial, step
from fleet.engine.state import DONE, State
from fleet.engine.step import ROUNDING_S
from fleet.engine.world import Arm, World, build_world, law_of
from fleet.errors import distinguish
from fleet.events import Event
from fleet.heat.motor import current
from fleet.heat.thermal import HOUSING, WINDING, ThermalModel
from fleet.job import Job
from fleet.motion import Plan
from fleet.robot import JOINTS, ThermalLimits
from fleet.telemetry import FAULTED, MODES, WORKING, Mode

Array = np.ndarray


UNKNOWN = (1.0, 0.0)
"""`Body.found` of an arm that has found nothing."""


@dataclass(frozen=True)
class SensorReading:
    """Sensor values of one arm; empty where there is no sensor."""

    mode: Mode
    temp_c: tuple[float, ...]
    """Motor temperatures, [joint]."""
    q: tuple[float, ...] = ()
    """rad, [joint]."""
    qd: tuple[float, ...] = ()
    """rad/s, [joint]."""
    tau: tuple[float, ...] = ()
    """N·m, [joint]."""
    current_a: tuple[float, ...] = ()
    """[joint]."""
    motion_difficulty: float | None = field(default=None, kw_only=True)
    """As in `fleet.bus.protocol.messages.State`, like the next one."""
    expected_c: tuple[float, ...] = field(default=(), kw_only=True)


class Body(Protocol):
    """Executes its current job as fleet time passes, up to the cycles that it is allowed."""

    @property
    def time_s(self) -> float:
        """Simulated up to this fleet time."""
        ...

    @property
    def job(self) -> str:
        """Name of the current job; "" for none."""
        ...

    @property
    def is_free(self) -> bool:
        """Whether it is at home, not faulted, and without a job."""
        ...

    @property
    def away(self) -> Plan | None:
        """Plan along which it is away from home, also where a fault stopped it; None at home."""
        ...

    @property
    def housing_c(self) -> Array:
        """Estimated housing temperatures, which have no sensor, °C, [joint]."""
        ...

    @property
    def cycles(self) -> int:
        """Cycles of the current job that are done, by any arm."""
        ...

    @property
    def excess(self) -> float | None:
        """Heat of the current job's cycles that it measures over that which it expects, less 1; None if unknown."""
        ...

    @property
    def found(self) -> tuple[float, float]:
        """Ratio of the measured to the expected heat, and by how much its sensors read too much, K; 1 and 0 if unknown.

        See `fleet.engine.corrections.line_of`.
        """
        ...

    def last_cycle_in_s(self) -> float:
        """Seconds until the last cycle of the current job could begin; inf without a job."""
        ...

    def free_in_s(self) -> float:
        """Seconds until it could be free if it may do all of the current job; inf while it is faulted."""
        ...

    def start(self, job: Job, plan: Plan, cycles: int) -> None:
        """Take a job of which `cycles` are done; it must be free. Nothing moves before `allow_cycles`."""
        ...

    def allow_cycles(self, cycles: int) -> None:
        """Limit the cycles of the current job that may be begun, including those done; one in progress is finished."""
        ...

    def clear_fault(self) -> str:
        """Clear a fault at once, if it may be; return why it may not, or ""."""
        ...

    def release(self) -> None:
        """Finish the cycle, return home, release the job."""
        ...

    def advance(self, until_s: float) -> list[Event]:
        """Simulate up to a fleet time, or part of the way, and return the events; `finish` and `return` end the job."""
        ...

    def set_time(self, time_s: float) -> None:
        """Set the fleet time without advancing."""
        ...

    def set_step(self, dt_s: float) -> None:
        """Set the interval at which the body is read, fleet seconds."""
        ...

    def read_sensors(self) -> SensorReading:
        """Return the present sensor values."""
        ...


MOVING_RAD_S = 0.01
"""The arm is working when a joint is faster than this."""


@dataclass(frozen=True, eq=False)
class SensorLog:
    """Sensor readings of one arm, each [time, joint], SI; None for what was not logged."""

    time_s: Array
    """Strictly increasing, [time]."""
    temp_c: Array
    q: Array
    qd: Array
    tau: Array
    current_a: Array | None = None

    def part(self, rows: slice) -> "SensorLog":
        """Some of the samples."""
        current_a = None if self.current_a is None else self.current_a[rows]
        time_s, temp_c, q, qd, tau = (each[rows] for each in (self.time_s, self.temp_c, self.q, self.qd, self.tau))
        return SensorLog(time_s, temp_c, q, qd, tau, current_a)


class MotionMonitor(Protocol):
    """Compares what an arm does with what its twin and its thermal network expect."""

    def add(
        self, time_s: Array, temp_c: Array, q: Array, qd: Array, tau: Array, current_a: Array | None = None
    ) -> None:
        """Take readings that are later than those before, as in `SensorLog`."""
        ...

    @property
    def version(self) -> str:
        """Versions of twin and network."""
        ...

    @property
    def scores(self) -> tuple[float | None, tuple[float, ...]]:
        """`motion_difficulty` and `expected_c`, as in `fleet.bus.protocol.messages.State`."""
        ...


class ReplayBody:
    """Body that replays a log once, in fleet time, and accepts no work; then it keeps the last sample.

    Args:
        time_s: Fleet time of the first sample.
        monitor: Gets every sample when it has passed.
    """

    def __init__(self, log: SensorLog, *, time_s: float = 0.0, monitor: MotionMonitor | None = None) -> None:
        if not len(log.time_s):
            raise ValueError("A log needs at least one sample.")
        self._log, self._monitor, self._monitored = log, monitor, 0
        self._start_s = self._now_s = time_s

    @property
    def time_s(self) -> float:
        return self._now_s

    @property
    def over(self) -> bool:
        """Whether its last sample has passed."""
        return self._row == len(self._log.time_s) - 1

    @property
    def excess(self) -> float | None:
        return None

    @property
    def housing_c(self) -> np.ndarray:
        return self._log.temp_c[self._row]  # as warm as the motors: no job is quoted

    # It takes no jobs.

    job, is_free, cycles, away, found = "", False, 0, None, UNKNOWN

    def last_cycle_in_s(self) -> float:
        return np.inf

    def free_in_s(self) -> float:
        return np.inf

    def start(self, job: Job, plan: Plan, cycles: int) -> None:
        raise ValueError(f"A replayed log takes no jobs (got '{job.name}').")

    def allow_cycles(self, cycles: int) -> None:
        pass

    def release(self) -> None:
        pass

    # Its log

    def advance(self, until_s: float) -> list[Event]:
        self._now_s = max(self._now_s, until_s)
        return []

    def set_time(self, time_s: float) -> None:
        self._start_s += time_s - self._now_s
        self._now_s = time_s

    def clear_fault(self) -> str:
        return "a recorded arm has no faults"

    def set_step(self, dt_s: float) -> None:
        pass  # samples are read at any time

    def read_sensors(self) -> SensorReading:
        log, row = self._log, self._row
        qd = np.zeros_like(log.qd[row]) if self.over else log.qd[row]
        current_a = () if log.current_a is None else tuple(log.current_a[row].tolist())
        mode = "working" if np.abs(qd).max() > MOVING_RAD_S else "idle"
        temp_c, q, tau = (tuple(values[row].tolist()) for values in (log.temp_c, log.q, log.tau))
        reading = SensorReading(mode, temp_c, q, tuple(qd.tolist()), tau, current_a)
        if self._monitor is None:
            return reading
        if row >= self._monitored:
            self._monitor.add(**vars(log.part(slice(self._monitored, row + 1))))
            self._monitored = row + 1
        difficulty, expected_c = self._monitor.scores
        return replace(reading, motion_difficulty=difficulty, expected_c=expected_c)

    @property
    def _row(self) -> int:
        into_s = self._log.time_s[0] + self._now_s - self._start_s
        after = np.searchsorted(self._log.time_s, into_s + 1e-9, side="right")  # pyright: ignore[reportUnknownVariableType]
        return max(0, int(after) - 1)  # pyright: ignore[reportUnknownArgumentType]


MAX_STEPS = 200
"""Steps per call: a body that is far behind catches up gradually."""
_REPORTED = ("torque_warning", "home", "warning", "fault", "recover", "moved")
"""Events of the engine that a live arm reports unchanged."""
_CARRIED = (
    "tick",
    "temp_c",
    "housing_c",
    "mode",
    "clear_at_s",
    "faults",
    "peak_c",
    "above_warning_s",
    "busy_s",
    "lost_s",
    "energy_j",
)
"""Fields of the state that are kept when the job changes."""


@dataclass(eq=False)
class ExpectedTemperatures:
    """Temperatures that the identified network of an arm yields for the heat that it measures.

    It is the live counterpart of `fleet.engine.step.compare_temperatures`.
    """

    thermal: ThermalModel
    """Its network, as identified."""
    temp_c: Array
    """[node]."""
    moments: Array = field(default_factory=lambda: np.zeros(4, np.float32))
    """See `fleet.engine.corrections.compare`."""

    def step(self, heat_w: Array, dt_s: float, ambient_c: float, measured_c: Array) -> None:
        """Advance by one step.

        Args:
            heat_w: [node].
            measured_c: At its end, [joint]; a step without it leaves `moments` as they are.
        """
        self.temp_c = self.thermal.step(self.temp_c, heat_w, ambient_c, dt_s)
        if np.isfinite(measured_c).all() and np.isfinite(self.temp_c).all():
            compare(self.moments, self.temp_c, measured_c, 0.0, ambient_c, dt_s)


@dataclass(eq=False)
class _Current:
    """The current job."""

    job: Job
    plan: Plan
    before: int
    """Cycles done before this stint."""
    allowed: int
    """Cycles that may be begun, including those done."""
    released: bool = False
    """Finished or released: only the way home is left."""


class SimulatedBody:
    """One arm of the simulator in real time, as `Body` describes.

    It steps `fleet.engine.step` in a world of one arm and its current job. A job is done in stints: the arm leaves
    home, does the cycles that it is allowed, and returns home. The allowed cycles can grow during a stint, so a job
    that is allowed to its end is one stint, as in a simulated shift. After a fault the arm stands where it stopped.
    Once it has recovered it ends that cycle and goes home, if no person has moved it home before
    (`ThermalLimits.move_home_s`).

    Args:
        arm: True parameters of the arm; its plans and its model are not used.
        ambient_c: Ambient temperature at the arm, °C, by fleet time.
        dt_s: Length of a step, fleet seconds.
        max_dt_s: Upper limit of the length of a step; an idle arm has none, as its constant heat is integrated exactly.
        time_s: Fleet time at the start.
        warm: Whether it has been powered at home for hours; else all is at ambient temperature.
    """

    def __init__(
        self,
        arm: Arm,
        limits: ThermalLimits,
        ambient_c: Callable[[float], float],
        *,
        dt_s: float,
        rng: np.random.Generator,
        max_dt_s: float = np.inf,
        time_s: float = 0.0,
        warm: bool = True,
    ) -> None:
        if not (dt_s > 0 and max_dt_s > 0):
            raise ValueError(f"SimulatedBody.dt_s and max_dt_s must be > 0 (got {dt_s}, {max_dt_s}).")
        self._arm, self._limits, self._ambient_c, self._rng = arm, limits, ambient_c, rng
        self._dt_s: float = min(dt_s, max_dt_s)
        self._max_dt_s = max_dt_s
        self._start_s = time_s
        self._task: _Current | None = None
        self._plan: Plan | None = None
        """Plan of the current or last job."""
        self._world, self._plant = self._build_world(None, warm=warm)
        self._state = initial(self._world)
        self._last: tuple[World, StepRecord] | None = None
        start_c = np.concatenate([self._state.temp_c[0, 0, WINDING], self._state.housing_c[0, 0]])
        self._expected = ExpectedTemperatures(arm.beliefs[0], start_c) if arm.learns else None

    # Properties

    @property
    def time_s(self) -> float:
        return self._start_s + float(self._state.tick[0]) * self._dt_s

    @property
    def job(self) -> str:
        return "" if self._task is None or self._task.released else self._task.job.name

    @property
    def is_free(self) -> bool:
        return self._task is None and self._state.mode[0, 0] not in (WORKING, FAULTED)

    @property
    def away(self) -> Plan | None:
        return self._plan if self._state.plan[0, 0] >= 0 else None

    @property
    def housing_c(self) -> Array:
        return self._state.housing_c[0, 0]  # the estimate of the arm's observer, not the true temperatures

    @property
    def cycles(self) -> int:
        assert self._task is not None, "no current job"
        return self._task.before + self._begun(done=True)

    @property
    def excess(self) -> float | None:
        if not self._arm.learns or self._plan is None or not self._in_stint or self._progress_s < self._times_s[0]:
            return None
        return self._arm.driven(self._plan)[-1]

    @property
    def found(self) -> tuple[float, float]:
        if self._expected is None:
            return UNKNOWN
        ratio, offset_k = line_of(self._expected.moments)
        return float(ratio), float(offset_k)

    @property
    def truth(self) -> State:
        """State of the simulator, for tests only."""
        return self._state

    def last_cycle_in_s(self) -> float:
        task = self._task
        if task is None or task.released or self._faulted:
            return np.inf
        last = task.job.repetitions - 1
        if self._in_stint:
            approach_s, cycle_s, _ = self._times_s
            return max(0.0, approach_s + (last - task.before) * cycle_s - self._progress_s)
        return self._home_in_s + task.plan.approach.duration_s + (last - self.cycles) * task.plan.cycle.duration_s

    def free_in_s(self) -> float:
        if self._faulted:
            return np.inf
        task = self._task
        if task is None or task.released:
            return self._home_in_s
        if self._in_stint:  # all of the job, not only the cycles that are allowed now
            more = task.job.repetitions - task.before - int(self._state.todo[0, 0])
            return self._home_in_s + more * task.plan.cycle.duration_s
        return self.last_cycle_in_s() + task.plan.cycle.duration_s + task.plan.retreat.duration_s

    def read_sensors(self) -> SensorReading:
        if self._last is None:
            still = np.zeros_like(self._arm.rest_tau)
            temp_c, motors, tau = self._state.temp_c[0, 0], self._arm.motors, self._arm.rest_tau
            noisy_c = temp_c[WINDING] + self._drift_k + motors.sensor_noise_k * self._rng.standard_normal(still.shape)
            values = (noisy_c, self._arm.robot.home_q(), still, tau, current(tau, still, temp_c[HOUSING], motors))
            return SensorReading("idle", *(tuple(v.tolist()) for v in values))
        world, record = self._last
        end_s = np.array([world.dt_s])
        motion = self._plant.motion(world, record, end_s)
        sample = telemetry_of(world, record, end_s, motion, self._rng.standard_normal((1, 1, 1, motion.shape[-1])))
        values = (sample.temp_c, sample.q, sample.qd, sample.tau, sample.current_a)
        return SensorReading(
            MODES[int(self._state.mode.item(0, 0))], *(tuple(value[0, 0].tolist()) for value in values)
        )

    # Commands

    def start(self, job: Job, plan: Plan, cycles: int) -> None:
        if not self.is_free:
            raise ValueError(f"Arm '{self._arm.robot.name}' is not free and cannot start '{job.name}'.")
        if not 0 <= cycles < job.repetitions:
            raise ValueError(f"cycles must be 0 to {job.repetitions - 1} for '{job.name}' (got {cycles}).")
        self._task, self._plan = _Current(job, plan, cycles, allowed=cycles), plan
        self.set_step(self._dt_s)  # an idle arm may have had a longer one
        self._world, self._plant = self._build_world(self._task)
        self._state = self._carried(self._world)

    def allow_cycles(self, cycles: int) -> None:
        if self._task is not None and not self._task.released:
            self._task.allowed = min(cycles, self._task.job.repetitions)

    def release(self) -> None:
        if self._task is not None:
            self._task.allowed, self._task.released = 0, True
            if not self._working:
                self._task = None

    def clear_fault(self) -> str:
        hottest_c = float(self._state.temp_c[0, 0, WINDING].max())
        if hottest_c >= self._limits.restart_c:
            is_c, limit_c = distinguish(hottest_c, self._limits.restart_c, 3)
            return f"a motor has {is_c} °C; a fault can be cleared below {limit_c} °C"
        self._state = self._state.changed(clear_at_s=np.full((1, 1), float(self._state.tick[0]) * self._dt_s))
        return ""

    def set_time(self, time_s: float) -> None:
        self._start_s += time_s - self.time_s

    def set_step(self, dt_s: float) -> None:
        if not dt_s > 0:
            raise ValueError(f"The step of a body must be > 0 s (got {dt_s}).")
        time_s, before_s = self.time_s, float(self._state.tick[0]) * self._dt_s
        if not (self.is_free and self.away is None):
            dt_s = min(dt_s, self._max_dt_s)
        ticks = int(before_s / dt_s + ROUNDING_S)
        # The engine counts its time in ticks of the new length, of which as many have passed.
        later_s = ticks * dt_s - before_s
        clear_at_s, moved_at_s = self._state.clear_at_s + later_s, self._state.moved_at_s + later_s
        tables = self._world.tables._replace(dt_s=dt_s, law=law_of(self._arm, dt_s)[None, None])
        self._world = replace(self._world, tables=tables)
        self._state = self._state.changed(tick=np.array([ticks]), clear_at_s=clear_at_s, moved_at_s=moved_at_s)
        self._dt_s = dt_s
        self.set_time(time_s)

    def advance(self, until_s: float) -> list[Event]:
        """Simulate up to a fleet time, at most `MAX_STEPS` steps."""
        events: list[Event] = []
        steps = int((until_s - self.time_s) / self._dt_s + 1e-6)
        for _ in range(min(max(steps, 0), MAX_STEPS)):
            events += self._step()
        return events

    # One step

    def _step(self) -> list[Event]:
        task, log, shift_s = self._task, list[Event](), self._start_s
        ambient_c = self._ambient_c(self.time_s + 0.5 * self._dt_s)
        self._world.tables.ambient_c[:] = ambient_c
        leaves = task is not None and self._prepare_stint(task)
        done = step(self._world, self._state, np.array([[int(leaves)]]), self._plant, log, compiled=False)
        self._last, self._state = (self._world, done.record), done.state
        if self._expected is not None:
            self._correct_housings(line_of(self._expected.moments)[1])
            self._compare(self._expected, done.record, ambient_c)
        events = [replace(e, time_s=e.time_s + shift_s) for e in log if e.kind in _REPORTED]
        return events if task is None else events + self._job_events(task, int(done.record.todo[0, 0]), log, shift_s)

    def _correct_housings(self, offset_k: float) -> None:
        """Change the estimate of the housings after a step to that from readings less an offset."""
        law = self._world.tables.law[0, 0]
        less_k = (law["housing_winding"] * offset_k) @ law["housing_gain"]
        self._state = self._state.changed(housing_c=self._state.housing_c - less_k[:JOINTS])

    def _compare(self, expected: ExpectedTemperatures, record: StepRecord, ambient_c: float) -> None:
        """Compare temperatures with those expected of the heat in a step, by currents and the copper that it knows."""
        heat_w, known = record.heat_w[0, 0].copy(), self._arm.beliefs[1]
        heat_w[WINDING] *= known.copper_w_per_a2 / self._arm.motors.copper_w_per_a2
        expected.step(heat_w, self._dt_s, ambient_c, self._state.temp_c[0, 0, WINDING] + self._drift_k)

    def _prepare_stint(self, task: _Current) -> bool:
        """Apply the allowed cycles to the next step; return whether the arm leaves home in it."""
        state = self._state
        if self._faulted:
            return False
        if not self._working:
            if task.allowed <= task.before:
                return False
            self._state = self._carried(self._world).changed(repetitions=task.allowed - task.before)
            return True
        if self._in_stint:
            todo = max(task.allowed - task.before, self._begun())
            if todo != state.todo[0, 0]:
                approach_s, cycle_s, _ = self._times_s
                # A job that ends at this very moment has not ended for the engine yet.
                progress_s = min(self._progress_s, approach_s + todo * cycle_s - 2 * ROUNDING_S)
                # With fewer cycles than repetitions, the engine would take the job for given back.
                self._state = state.changed(todo=todo, progress_s=progress_s, repetitions=todo)
        return False

    def _job_events(self, task: _Current, done: int, log: list[Event], shift_s: float) -> list[Event]:
        """Return the events of the current job in a step; drop the job where it ended.

        Args:
            done: Cycles of the stint, if it ended.
        """
        events: list[Event] = []
        total = task.job.repetitions

        def report(kind: Literal["finish", "return"], at_s: float, value: float, reason: str) -> None:
            arm, job = self._arm.robot.name, task.job.name
            if not task.released:
                events.append(Event(time_s=at_s, kind=kind, arm=arm, job=job, value=value, reason=reason))

        for each in log:
            at_s = each.time_s + shift_s
            if each.kind == "finish":
                task.before += done
                if task.before == total:
                    late_s = max(0.0, at_s - task.job.due_s)
                    report("finish", at_s, late_s, f"late by {late_s:.0f} s" if late_s else "on time")
                    task.released = True
            elif each.kind == "home" and task.released:
                self._task = None
            elif each.kind == "fault":
                kept = next((int(e.value) for e in log if e.kind == "return"), 0)
                cycles = task.before + kept
                report("return", at_s, float(cycles), f"{cycles} of {total} cycles kept")
                self._task = None
        return events

    @property
    def _drift_k(self) -> float:
        """By which its readings have drifted since its start, as the engine counts time."""
        return self._arm.drift_k_per_s * float(self._state.tick[0]) * self._dt_s

    # Arrays of the engine

    def _build_world(self, task: _Current | None, *, warm: bool = False) -> tuple[World, ProfilePlant]:
        plans = {} if task is None else {task.job.work: (task.plan,)}
        jobs = [] if task is None else [replace(task.job, release_s=0.0, due_s=np.inf, after=())]
        world = build_world(
            [replace(self._arm, model=Blind(), plans=plans, learns=False)],
            [jobs],
            limits=self._limits,
            dt_s=self._dt_s,
            ticks=1,
            slots=1,
            ambient_c=np.array([[self._ambient_c(self._start_s)]]),
            start_warm=warm,
        )
        executed = [self._arm.executed.get(plan, plan) for plan in world.plans]
        return world, ProfilePlant(executed, self._arm.robot.home_q()[None], self._arm.rest_tau[None])

    def _carried(self, world: World) -> State:
        """State at home before a stint, with temperatures and counters of the present state."""
        return initial(world).changed(**{name: getattr(self._state, name).copy() for name in _CARRIED})

    @property
    def _faulted(self) -> bool:
        return bool(self._state.mode[0, 0] == FAULTED)

    @property
    def _working(self) -> bool:
        return bool(self._state.mode[0, 0] == WORKING)

    @property
    def _in_stint(self) -> bool:
        """Whether it is at work, and not yet on its way home."""
        return self._working and bool(self._state.status[0, 0] != DONE)

    @property
    def _progress_s(self) -> float:
        return float(self._state.progress_s[0, 0])

    @property
    def _times_s(self) -> tuple[float, float, float]:
        """Durations of approach, cycle and retreat."""
        return tuple(self._world.tables.plans["times_s"][0].tolist())

    def _begun(self, *, done: bool = False) -> int:
        """Cycles of this stint that were begun, or with `done` those that are complete."""
        if not self._in_stint:
            return 0
        approach_s, cycle_s, _ = self._times_s
        count = (self._progress_s - approach_s) / cycle_s
        whole = floor(count + ROUNDING_S) if done else ceil(count - ROUNDING_S)
        return min(max(whole, 0), int(self._state.todo[0, 0]))

    @property
    def _home_in_s(self) -> float:
        """Seconds until it is home if this stint is not extended."""
        if not self._working:
            return 0.0
        approach_s, cycle_s, retreat_s = self._times_s
        return max(0.0, approach_s + float(self._state.todo[0, 0]) * cycle_s + retreat_s - self._progress_s)
