"""The arm itself, as `fleet.live.arm.body.Body`, without heat and in continuous time; and what it quotes for jobs.

It leaves home, does the cycles that it is allowed, and returns home. Each departure, return and last cycle is told to
`Deeds`, which checks the rules.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from random import Random
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np

from fleet.bus.protocol.auction import JobEstimate, JobSpec, PlanQuote
from fleet.events import Event
from fleet.live.arm.body import UNKNOWN, SensorReading
from fleet.robot import JOINTS

HOUSING_C = np.full(JOINTS, 30.0)
TEMP_C = (35.0,) * JOINTS
ZERO_S = 1e-6


class Deeds(Protocol):
    """Hears what an arm does."""

    def departs(self, arm: str, space: str) -> None: ...

    def is_home(self, arm: str) -> None: ...

    def begins_last_cycle(self, arm: str, job: str) -> None: ...

    def breaks_last_cycle_off(self, arm: str, job: str) -> None: ...

    def finishes(self, arm: str, job: str) -> None: ...


@dataclass(eq=False)
class SimulatedPlan:
    """A plan: durations of its phases, and the name of its space."""

    space: str
    approach: Any
    cycle: Any
    retreat: Any

    def duration_s(self, repetitions: int) -> float:
        return self.approach.duration_s + repetitions * self.cycle.duration_s + self.retreat.duration_s


def plan_of(arm: str, job: JobSpec, number: int) -> SimulatedPlan:
    """Return a plan of an arm; the same in every call."""
    rng = Random(f"{arm} {job.places} {job.kind} {number}")
    times = (rng.uniform(2.0, 10.0), max(job.dwell_s, 0.1) + rng.uniform(1.0, 10.0), rng.uniform(2.0, 10.0))
    return SimulatedPlan(f"{arm}:{job.places[0]}:{number}", *(SimpleNamespace(duration_s=t) for t in times))


class SimulatedEstimator:
    """Quotes as `fleet.live.arm.estimator.Estimator`: some jobs are infeasible, some have two plans."""

    model = SimpleNamespace(version="simulated")

    def __init__(self, arm: str, first: str) -> None:
        """Prepare; the arm `first` can do every job."""
        self._arm, self._first = arm, first
        self._known: dict[str, tuple[Any, ...]] = {}
        self._quoted: dict[str, JobEstimate] = {}

    def is_prepared(self, job: JobSpec, done: int = 0) -> bool:
        return True

    def prepare(self, job: JobSpec, done: int = 0) -> None:
        """Do nothing: every job is prepared."""

    def job(self, job: JobSpec) -> JobSpec:
        return job

    def excess_of(self, job: JobSpec) -> float:
        return 0.0

    def plans(self, job: JobSpec) -> tuple[Any, ...]:
        if job.name not in self._known:
            rng = Random(f"{self._arm} {job.name}")
            count = rng.choice([1, 1, 2]) if self._arm == self._first or rng.random() > 0.15 else 0
            scored = [
                SimpleNamespace(plan=plan_of(self._arm, job, n), difficulty=None, d=rng.random()) for n in range(count)
            ]
            self._known[job.name] = tuple(scored)
        return self._known[job.name]

    def space_of(self, job: JobSpec, plan: int) -> str | None:
        plans = self.plans(job)
        return plans[plan].plan.space if plan < len(plans) else None

    def estimate(
        self, jobs: tuple[JobSpec, ...], known_c: Any, busy_s: float, cycles: Mapping[str, int]
    ) -> tuple[JobEstimate, ...]:
        return tuple(map(self._estimate, jobs))

    def _estimate(self, job: JobSpec) -> JobEstimate:
        if job.name not in self._quoted:
            plans = (
                PlanQuote(plan=n, difficulty=scored.d, finish_in_s=1.0, space=scored.plan.space)
                for n, scored in enumerate(self.plans(job))
            )
            self._quoted[job.name] = JobEstimate(job.name, tuple(plans))
        return self._quoted[job.name]


class SimulatedArm:
    """One arm; all times are fleet seconds."""

    def __init__(self, name: str, deeds: Deeds, time_s: float) -> None:
        self.name, self.time_s, self._deeds = name, time_s, deeds
        self.housing_c, self.excess, self.found = HOUSING_C, None, UNKNOWN
        self._task: JobSpec | None = None
        self._plan: SimulatedPlan | None = None
        self._before = self._allowed = self._todo = 0
        self._released = self._last_begun = False
        self._left_s: float | None = None
        """When it left home; None at home."""
        self._home_s: float | None = None
        """When it is home again; None before it turns back."""
        self._fault_s = 0.0
        """Length of a fault that begins now; 0 for none."""
        self._clear_s: float | None = None
        """When a fault is over; None without."""

    # As `Body`

    @property
    def job(self) -> str:
        return "" if self._task is None or self._released else self._task.name

    @property
    def is_free(self) -> bool:
        return self._task is None and self._left_s is None and self._clear_s is None

    @property
    def away(self) -> Any:
        return None if self._left_s is None else self._plan

    @property
    def cycles(self) -> int:
        return self._before + self._begun(math.floor)

    def last_cycle_in_s(self) -> float:
        if self._task is None or self._released or self._clear_s is not None:
            return math.inf
        assert self._plan is not None
        last = self._task.repetitions - 1 - self._before
        wait_s = self._plan.approach.duration_s + last * self._plan.cycle.duration_s
        if self._working:
            assert self._left_s is not None
            return max(0.0, self._left_s + wait_s - self.time_s)
        return self._home_in_s + wait_s

    def free_in_s(self) -> float:
        if self._clear_s is not None:
            return math.inf
        if self._task is None or self._released:
            return self._home_in_s
        assert self._plan is not None
        return self.last_cycle_in_s() + self._plan.cycle.duration_s + self._plan.retreat.duration_s

    def clear_fault(self) -> str:
        return "it clears by itself"

    def read_sensors(self) -> SensorReading:
        mode = "faulted" if self._clear_s is not None else "idle" if self._left_s is None else "working"
        return SensorReading(mode, TEMP_C)

    def start(self, job: JobSpec, plan: SimulatedPlan, cycles: int) -> None:
        assert self.is_free
        assert 0 <= cycles < job.repetitions
        self._task, self._plan = job, plan
        self._before = self._allowed = cycles
        self._released = self._last_begun = False

    def allow_cycles(self, cycles: int) -> None:
        if self._task is not None and not self._released:
            self._allowed = min(cycles, self._task.repetitions)

    def release(self) -> None:
        if self._task is not None:
            self._allowed, self._released = 0, True
            if self._left_s is None:
                self._task = None

    def set_time(self, time_s: float) -> None:
        shift_s = time_s - self.time_s
        self.time_s = time_s
        for name in ("_left_s", "_home_s", "_clear_s"):
            if getattr(self, name) is not None:
                setattr(self, name, getattr(self, name) + shift_s)

    def set_step(self, dt_s: float) -> None:
        """Do nothing: time is continuous."""

    def advance(self, until_s: float) -> list[Event]:
        events: list[Event] = []
        while self.time_s < until_s:
            if self._fault_s:
                self._fail(events)
            if self._clear_s is not None:
                self._stand(until_s, events)
            elif self._left_s is None:
                if self._task is None or self._released or self._allowed <= self._before:
                    self.time_s = until_s
                else:
                    self._leave()
            elif self._home_s is None:
                self._work(until_s, events)
            else:
                self._return(until_s, events)
        return events

    # Faults

    def fail(self, seconds: float) -> None:
        """Fault at once, for some time."""
        self._fault_s = seconds

    def move_home(self) -> None:
        """Have a person break off what it does and move it home."""
        self._break_off()
        self._before += self._begun(math.floor)
        self._come_home()

    # Inside

    @property
    def _working(self) -> bool:
        return self._left_s is not None and self._home_s is None

    @property
    def _home_in_s(self) -> float:
        if self._left_s is None:
            return 0.0
        if self._home_s is not None:
            return max(0.0, self._home_s - self.time_s)
        assert self._plan is not None
        end_s = self._left_s + self._plan.approach.duration_s + self._todo * self._plan.cycle.duration_s
        return max(0.0, end_s + self._plan.retreat.duration_s - self.time_s)

    def _begun(self, whole: Any = math.ceil) -> int:
        """Cycles of this stint that were begun, or with `floor` those that are complete."""
        if not self._working:
            return 0
        assert self._left_s is not None
        assert self._plan is not None
        count = (self.time_s - self._left_s - self._plan.approach.duration_s) / self._plan.cycle.duration_s
        return min(max(0, whole(count + (ZERO_S if whole is math.floor else -ZERO_S))), self._todo)

    def _leave(self) -> None:
        assert self._plan is not None
        self._left_s, self._todo, self._home_s = self.time_s, self._allowed - self._before, None
        self._deeds.departs(self.name, self._plan.space)

    def _work(self, until_s: float, events: list[Event]) -> None:
        assert self._task is not None
        assert self._plan is not None
        assert self._left_s is not None
        self._todo = max(self._allowed - self._before, self._begun())
        last_s = self._left_s + self._plan.approach.duration_s + (self._todo - 1) * self._plan.cycle.duration_s
        end_s = last_s + self._plan.cycle.duration_s
        is_last = self._todo > 0 and self._before + self._todo == self._task.repetitions
        if is_last and not self._last_begun and until_s > last_s:
            self._last_begun = True
            self._deeds.begins_last_cycle(self.name, self._task.name)
        if end_s > until_s:
            self.time_s = until_s
            return
        self.time_s = max(self.time_s, end_s)
        self._before += self._todo
        self._home_s, self._todo = self.time_s + self._plan.retreat.duration_s, 0
        if self._before == self._task.repetitions:
            self._deeds.finishes(self.name, self._task.name)
            if not self._released:
                events.append(Event(time_s=self.time_s, kind="finish", arm=self.name, job=self._task.name, value=0.0))
            self._released, self._last_begun = True, False

    def _return(self, until_s: float, events: list[Event]) -> None:
        assert self._home_s is not None
        if self._home_s > until_s:
            self.time_s = until_s
            return
        self.time_s = max(self.time_s, self._home_s)
        self._come_home()
        events.append(Event(time_s=self.time_s, kind="home", arm=self.name))

    def _come_home(self) -> None:
        if self._left_s is not None:
            self._deeds.is_home(self.name)
        self._left_s = self._home_s = self._clear_s = None
        if self._released:
            self._task = None

    def _break_off(self) -> None:
        """Stop in the middle of a cycle, which then does not count."""
        if self._task is not None and self._last_begun:
            self._last_begun = False
            self._deeds.breaks_last_cycle_off(self.name, self._task.name)

    def _fail(self, events: list[Event]) -> None:
        self._clear_s, self._fault_s = self.time_s + self._fault_s, 0.0
        events.append(Event(time_s=self.time_s, kind="fault", arm=self.name))
        if self._task is None or self._released:
            self._break_off()
            return
        kept, job = self._before + self._begun(math.floor), self._task.name
        self._break_off()
        events.append(
            Event(time_s=self.time_s, kind="return", arm=self.name, job=job, value=float(kept), reason="it faulted")
        )
        self._released = True
        if self._left_s is None:
            self._task = None

    def _stand(self, until_s: float, events: list[Event]) -> None:
        assert self._clear_s is not None
        if self._clear_s > until_s:
            self.time_s = until_s
            return
        self.time_s, self._clear_s = max(self.time_s, self._clear_s), None
        if self._left_s is not None:
            assert self._plan is not None
            self._home_s = self.time_s + self._plan.retreat.duration_s
        events.append(Event(time_s=self.time_s, kind="recover", arm=self.name))
