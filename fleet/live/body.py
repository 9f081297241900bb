"""The body of an arm: what moves and gets warm when the arm works.

`SimulatedBody` steps the one engine of the shift, `fleet.sim.kernel`, in a world of one arm and the one job in hand. A
job is done in stints: the arm leaves home, does the cycles that it may do, and comes home again; what it may do can
grow while it is at it, so a job that is let through to its end is one stint, as in a shift.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil, floor
from typing import Literal, Protocol

import numpy as np

from fleet.difficulty import Blind
from fleet.events import Event
from fleet.job import Job
from fleet.motion import Plan
from fleet.motor import current
from fleet.robot import ThermalLimits
from fleet.sim.claims import Board
from fleet.sim.kernel import ROUNDING_S, Step, step
from fleet.sim.plants import ProfilePlant
from fleet.sim.state import DONE, State, World, initial
from fleet.sim.world import Arm, build_world
from fleet.telemetry import FAULTED, MODES, WORKING, Mode
from fleet.thermal import HOUSING, WINDING

Array = np.ndarray

MOST_STEPS = 200
"""Of one call: a body that has fallen far behind catches up little by little."""
NOTHING_ON_OFFER = Board(on_offer=np.array([[-1]]), mask=np.array([[[True, False]]]))
"""To one arm that claims nothing: what hangs out need not be looked up."""
_TOLD = ("torque_warning", "home", "warning", "fault", "recover")
"""Events of the kernel that are true of a live arm as they are."""
_KEPT = ("tick", "temp_c", "mode", "clear_at_s", "faults", "peak_c", "above_warning_s", "busy_s", "lost_s", "energy_j")
"""What of a state goes on when the job changes."""


@dataclass(frozen=True)
class Reading:
    """What the sensors of one arm say."""

    mode: Mode
    temp_c: tuple[float, ...]
    """Motor temperatures, [joint]."""
    q: tuple[float, ...] = ()
    """rad, [joint]; empty where not known, as the others below."""
    qd: tuple[float, ...] = ()
    """rad/s."""
    tau: tuple[float, ...] = ()
    """N·m."""
    current_a: tuple[float, ...] = ()


class Body(Protocol):
    """Does what it may of the job in hand as time goes on."""

    @property
    def time_s(self) -> float:
        """The fleet's time until which it has lived."""
        ...

    @property
    def job(self) -> str:
        """Name of the job in hand; "" for none."""
        ...

    @property
    def free(self) -> bool:
        """Whether it stands at home, whole, with nothing in hand."""
        ...

    @property
    def cycles(self) -> int:
        """Done of the job in hand, those of others included."""
        ...

    def last_in_s(self) -> float:
        """Seconds until the last cycle of the job in hand could begin; inf for none."""
        ...

    def free_in_s(self) -> float:
        """Seconds until it could be free, if it may do all of the job in hand; inf while it is faulted."""
        ...

    def begin(self, job: Job, plan: Plan, cycles: int) -> None:
        """Take a job in hand of which `cycles` are done; it must be free. Nothing moves before `permit`."""
        ...

    def permit(self, cycles: int) -> None:
        """So many cycles of the job in hand may be begun, those done included; one that was begun is ended."""
        ...

    def let_go(self) -> None:
        """Go home after the cycle that was begun, and forget the job."""
        ...

    def advance(self, until_s: float) -> list[Event]:
        """Live up to a time, or as far as it gets, and tell what happened; `finish` and `return` end the job."""
        ...

    def set_time(self, time_s: float) -> None:
        """From now on the fleet's time is another."""
        ...

    def set_pace(self, dt_s: float) -> None:
        """From now on it is looked at every so many fleet seconds."""
        ...

    def read(self) -> Reading:
        """What its sensors say now."""
        ...


@dataclass(eq=False)
class _Task:
    """The job in hand."""

    job: Job
    plan: Plan
    before: int
    """Cycles done before the present stint."""
    may: int
    """Cycles that may be begun in all."""
    dropped: bool = False
    """Finished or let go of: only the way home is left."""


class SimulatedBody:
    """One arm of the simulator in real time.

    Args:
        arm: Its truth: motors, heat, posture at rest. Its plans and its model are not looked at.
        air_c: Air at the arm, °C, at a time of the fleet.
        dt_s: Length of a step, fleet seconds.
        longest_s: No step is longer, whatever the pace.
        time_s: The fleet's time at its birth.
        warm: Whether it has stood powered at home for hours, or is as cold as the air.
    """

    def __init__(
        self,
        arm: Arm,
        limits: ThermalLimits,
        air_c: Callable[[float], float],
        *,
        dt_s: float,
        rng: np.random.Generator,
        longest_s: float = np.inf,
        time_s: float = 0.0,
        warm: bool = True,
    ) -> None:
        if not (dt_s > 0 and longest_s > 0):
            raise ValueError(f"SimulatedBody.dt_s and longest_s must be > 0 (got {dt_s}, {longest_s}).")
        self._arm, self._limits, self._air_c, self._rng = arm, limits, air_c, rng
        self._dt_s, self._longest_s = min(dt_s, longest_s), longest_s
        self._began_s = time_s
        self._task: _Task | None = None
        self._world, self._plant = self._laid_out(None, warm=warm)
        self._state = initial(self._world)
        self._last: tuple[World, Step] | None = None

    # What it is

    @property
    def time_s(self) -> float:
        """The fleet's time until which it has lived."""
        return self._began_s + float(self._state.tick[0]) * self._dt_s

    @property
    def job(self) -> str:
        """Name of the job in hand; "" for none."""
        return "" if self._task is None or self._task.dropped else self._task.job.name

    @property
    def free(self) -> bool:
        """Whether it stands at home, whole, with nothing in hand."""
        return self._task is None and self._state.mode[0, 0] not in (WORKING, FAULTED)

    @property
    def cycles(self) -> int:
        """Done of the job in hand, those of others included."""
        assert self._task is not None, "no job in hand"
        return self._task.before + self._begun(done=True)

    @property
    def truth(self) -> State:
        """The simulator's state, for tests and nobody else."""
        return self._state

    def last_in_s(self) -> float:
        """Seconds until the last cycle of the job in hand could begin; inf for none."""
        task = self._task
        if task is None or task.dropped or self._faulted:
            return np.inf
        last = task.job.repetitions - 1
        if self._in_stint:
            approach_s, cycle_s, _ = self._times_s
            return max(0.0, approach_s + (last - task.before) * cycle_s - self._progress_s)
        return self._home_in_s + task.plan.approach.duration_s + (last - self.cycles) * task.plan.cycle.duration_s

    def free_in_s(self) -> float:
        """Seconds until it could be free, if it may do all of the job in hand; inf while it is faulted."""
        if self._faulted:
            return np.inf
        last_in_s = self.last_in_s()
        if self._task is None or not np.isfinite(last_in_s):
            return self._home_in_s
        return last_in_s + self._task.plan.cycle.duration_s + self._task.plan.retreat.duration_s

    def read(self) -> Reading:
        """What its sensors say now."""
        if self._last is None:
            still = np.zeros_like(self._arm.rest_tau)
            temp_c, motors, tau = self._state.temp_c[0, 0], self._arm.motors, self._arm.rest_tau
            noisy_c = temp_c[WINDING] + motors.sensor_noise_k * self._rng.standard_normal(still.shape)
            values = (noisy_c, self._arm.robot.home_q(), still, tau, current(tau, still, temp_c[HOUSING], motors))
            return Reading("idle", *(tuple(v.tolist()) for v in values))
        world, step_made = self._last
        said = self._plant.readings(world, step_made, np.array([world.dt_s]), self._rng)
        values = (said.temp_c, said.q, said.qd, said.tau, said.current_a)
        return Reading(MODES[self._state.mode[0, 0]], *(tuple(value[0, 0].tolist()) for value in values))

    # What it does

    def begin(self, job: Job, plan: Plan, cycles: int) -> None:
        """Take a job in hand of which `cycles` are done; it must be free. Nothing moves before `permit`."""
        if not self.free:
            raise ValueError(f"Arm '{self._arm.robot.name}' has '{self.job}' in hand and cannot begin '{job.name}'.")
        if not 0 <= cycles < job.repetitions:
            raise ValueError(f"Of {job.repetitions} cycles of '{job.name}' {cycles} are done: there must be some left.")
        self._task = _Task(job, plan, cycles, may=cycles)
        self._world, self._plant = self._laid_out(self._task)
        self._state = self._carried(self._world)

    def permit(self, cycles: int) -> None:
        """So many cycles of the job in hand may be begun, those done included; one that was begun is ended."""
        if self._task is not None and not self._task.dropped:
            self._task.may = min(cycles, self._task.job.repetitions)

    def let_go(self) -> None:
        """Go home after the cycle that was begun, and forget the job."""
        if self._task is not None:
            self._task.may, self._task.dropped = 0, True
            if not self._working:
                self._task = None

    def set_time(self, time_s: float) -> None:
        """From now on the fleet's time is another."""
        self._began_s += time_s - self.time_s

    def set_pace(self, dt_s: float) -> None:
        """From now on it is looked at every so many fleet seconds: that is how long a step lasts."""
        time_s, ticks, dt_s = self.time_s, float(self._state.tick[0]), min(dt_s, self._longest_s)
        phi, gamma = self._world.thermal.step_matrices(dt_s)
        # The simulator counts its time in ticks of the new length.
        clear_at_s = self._state.clear_at_s + ticks * (dt_s - self._dt_s)
        self._world = replace(self._world, dt_s=dt_s, phi=phi, gamma=gamma)
        self._state = replace(self._state, clear_at_s=clear_at_s)
        self._dt_s = dt_s
        self.set_time(time_s)

    def advance(self, until_s: float) -> list[Event]:
        """Live up to a time, or as far as it gets, and tell what happened; `finish` and `return` end the job."""
        events: list[Event] = []
        steps = int((until_s - self.time_s) / self._dt_s + 1e-6)
        for _ in range(min(max(steps, 0), MOST_STEPS)):
            events += self._step()
        return events

    # One step

    def _step(self) -> list[Event]:
        task, log, shift_s = self._task, list[Event](), self._began_s
        air_c = self._air_c(self.time_s + 0.5 * self._dt_s)
        if air_c != self._world.ambient_c[0, 0]:
            self._world = replace(self._world, ambient_c=np.array([[air_c]]))
        goes = task is not None and self._set_out(task)
        board = None if goes else NOTHING_ON_OFFER
        done = step(self._world, self._state, np.array([[int(goes)]]), np.zeros((1, 1, 1)), self._plant, log, board)
        self._last, self._state = (self._world, done), done.state
        events = [replace(e, time_s=e.time_s + shift_s) for e in log if e.kind in _TOLD]
        return events if task is None else events + self._told(task, int(done.began.todo[0, 0]), log, shift_s)

    def _set_out(self, task: _Task) -> bool:
        """Let the coming step know what may be done; whether the arm leaves home in it."""
        state = self._state
        if self._faulted:
            return False
        if not self._working:
            if task.may <= task.before:
                return False
            table = replace(self._world.jobs, repetitions=np.array([[task.may - task.before]]))
            self._world = replace(self._world, jobs=table)
            self._state = self._carried(self._world)
            return True
        if self._in_stint:
            todo = max(task.may - task.before, self._begun())
            if todo != state.todo[0, 0]:
                self._state = replace(state, todo=np.array([[todo]]))
        return False

    def _told(self, task: _Task, done: int, log: list[Event], shift_s: float) -> list[Event]:
        """What a step means for the job in hand; forgets it where it ended.

        Args:
            done: Cycles of the stint, if it ended.
        """
        told: list[Event] = []
        for each in log:
            at_s = each.time_s + shift_s
            if each.kind == "finish":
                task.before += done
                if task.before == task.job.repetitions and not task.dropped:
                    late_s = max(0.0, at_s - task.job.due_s)
                    text = f"late by {late_s:.0f} s" if late_s else "on time"
                    told.append(self._event(task, at_s, "finish", late_s, text))
                    task.dropped = True
            elif each.kind == "home":
                if task.dropped:
                    self._task = None
            elif each.kind == "fault":
                kept = next((int(e.value) for e in log if e.kind == "return"), 0)
                if not task.dropped:
                    cycles = task.before + kept
                    text = f"{cycles} of {task.job.repetitions} cycles kept"
                    told.append(self._event(task, at_s, "return", float(cycles), text))
                self._task = None
        return told

    def _event(self, task: _Task, at_s: float, kind: Literal["finish", "return"], value: float, reason: str) -> Event:
        name = self._arm.robot.name
        return Event(time_s=at_s, kind=kind, arm=name, job=task.job.name, value=value, reason=reason)

    # The simulator's arrays of one arm

    def _laid_out(self, task: _Task | None, *, warm: bool = False) -> tuple[World, ProfilePlant]:
        plans = {} if task is None else {task.job.work: (task.plan,)}
        jobs = [] if task is None else [replace(task.job, release_s=0.0, due_s=np.inf, after=())]
        world, rows = build_world(
            [replace(self._arm, model=Blind(), plans=plans)],
            [jobs],
            limits=self._limits,
            dt_s=self._dt_s,
            ticks=1,
            slots=1,
            ambient_c=np.array([[self._air_c(self._began_s)]]),
            start_warm=warm,
        )
        return world, ProfilePlant(rows, self._arm.robot.home_q()[None], self._arm.rest_tau[None])

    def _carried(self, world: World) -> State:
        """The state at home before a stint, with all that is true of the arm as it was."""
        return replace(initial(world), **{name: getattr(self._state, name).copy() for name in _KEPT})

    @property
    def _faulted(self) -> bool:
        return bool(self._state.mode[0, 0] == FAULTED)

    @property
    def _working(self) -> bool:
        return bool(self._state.mode[0, 0] == WORKING)

    @property
    def _in_stint(self) -> bool:
        """Whether it is away, and not yet on its way home."""
        return self._working and bool(self._state.status[0, 0] != DONE)

    @property
    def _progress_s(self) -> float:
        return float(self._state.progress_s[0, 0])

    @property
    def _times_s(self) -> tuple[float, float, float]:
        """Of approach, cycle and retreat."""
        approach, cycle, retreat = self._world.plans.times_s[0].tolist()
        return approach, cycle, retreat

    def _begun(self, *, done: bool = False) -> int:
        """Cycles of this stint that were begun, or with `done` those that are over."""
        if not self._in_stint:
            return 0
        approach_s, cycle_s, _ = self._times_s
        count = (self._progress_s - approach_s) / cycle_s
        whole = floor(count + ROUNDING_S) if done else ceil(count - ROUNDING_S)
        return min(max(whole, 0), int(self._state.todo[0, 0]))

    @property
    def _home_in_s(self) -> float:
        """Seconds until it is home if it begins no further cycle than it set out to do."""
        if not self._working:
            return 0.0
        approach_s, cycle_s, retreat_s = self._times_s
        return max(0.0, approach_s + float(self._state.todo[0, 0]) * cycle_s + retreat_s - self._progress_s)
