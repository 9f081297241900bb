"""Simulated past jobs of an arm, with the records that a real arm would have of them.

Each job begins at the temperature that earlier work left, at an ambient temperature that is not measured. The records
hold the duration, the motor temperatures before the job, and the hottest temperatures during it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.motion import Drive, Plan, drives, static_drive
from fleet.physics.models import ArmModel
from fleet.thermal import NODES, WINDING, SimulatedTemperatures, simulate_temperatures
from scenarios.prepare.planned_arm import ArmHardware
from twin.saturation.fit import Experience
from twin.vae.twin import Twin

Array = np.ndarray

AMBIENT_C = (19.0, 27.0)
"""Range of the ambient temperature, which no model receives."""
DURATION_S = (180.0, 2700.0)
EARLIER_S = (300.0, 3600.0)
"""Range of the duration of the job before."""
REST_S = (0.0, 1800.0)
"""Range of the powered rest between the job before and this one."""
COOLING_STEP_S = 300.0
COOLING_STEPS = 12
"""An arm above the limit rests on in such steps until it is below, for at most an hour."""
BEFORE = {"cold": 0.15, "idle": 0.25, "work": 0.6}
"""Shares of the jobs that begin just after power-on, after a long idle time, and after a job and a rest."""


@dataclass(frozen=True, eq=False)
class PastJobs:
    """Jobs that one arm has done, with the measurements before and the outcome."""

    plans: tuple[Plan, ...]
    repetitions: Array
    """int [job]."""
    duration_s: Array
    """From leaving home to being home again, [job]."""
    start_c: Array
    """True temperatures at the start, [job, node]; hidden from the arm."""
    measured_c: Array
    """Measured motor temperatures at the start, [job, joint]."""
    ambient_c: Array
    """True ambient temperature, [job]; hidden from the arm."""
    peak_c: Array
    """Hottest winding temperature during the job, [job, joint]."""
    warning_c: float

    def __len__(self) -> int:
        return len(self.plans)

    @property
    def passed(self) -> Array:
        """Whether any motor reached the warning limit, bool [job]."""
        return self.peak_c.max(axis=1, initial=-np.inf) >= self.warning_c


def past_jobs(hardware: ArmHardware, plans: Sequence[Plan], rng: np.random.Generator, *, warning_c: float) -> PastJobs:
    """One past job of an arm for each plan, repeated for 3 to 45 minutes; every job begins below the limit.

    The earlier jobs are drawn from the same plans.
    """
    history = _Simulator(hardware, warning_c)
    count, noise_k = len(plans), hardware.motors.sensor_noise_k
    wanted_s = rng.uniform(*DURATION_S, count)
    repetitions = _repetitions(plans, wanted_s)
    ambient = rng.uniform(*AMBIENT_C, count)
    start = history.start(plans, ambient, rng)
    return PastJobs(
        plans=tuple(plans),
        repetitions=repetitions,
        duration_s=np.array([p.duration_s(int(n)) for p, n in zip(plans, repetitions, strict=True)]),
        start_c=start,
        measured_c=start[:, WINDING] + noise_k * rng.standard_normal((count, noise_k.size)),
        ambient_c=ambient,
        peak_c=history.work(plans, repetitions, start, ambient).highest_c,
        warning_c=warning_c,
    )


def experience(twin: Twin, jobs: PastJobs) -> Experience:
    """The past jobs with the features that the arm's twin computes for them."""
    repetitions = jobs.repetitions.tolist()
    return Experience.of_jobs(twin, jobs.plans, repetitions, temp_c=jobs.measured_c, passed=jobs.passed)


def _repetitions(plans: Sequence[Plan], duration_s: Array) -> Array:
    """Repetitions that come closest to the durations, at least one, int [job]."""
    around_s = [plan.approach.duration_s + plan.retreat.duration_s for plan in plans]
    cycle_s = [plan.cycle.duration_s for plan in plans]
    return np.array(
        [max(1, round((d - a) / c)) for d, a, c in zip(duration_s, around_s, cycle_s, strict=True)], dtype=int
    )


@dataclass(frozen=True, eq=False)
class _Simulator:
    """True temperatures of one arm through work and rest; temperatures are °C, [job, node]."""

    hardware: ArmHardware
    warning_c: float

    def start(self, plans: Sequence[Plan], ambient: Array, rng: np.random.Generator) -> Array:
        """Temperatures at which the jobs begin."""
        count = len(plans)
        before = rng.choice(list(BEFORE), size=count, p=list(BEFORE.values()))
        cold = np.broadcast_to(ambient[:, None], (count, NODES)).copy()
        long_idle = self.rest(cold, np.full(count, 4 * 3600.0), ambient)
        # Somewhere between power-on and a long idle time: shifts begin at any time.
        warm_up = cold + rng.uniform(0.0, 1.0, (count, 1)) * (long_idle - cold)
        earlier = [plans[i] for i in rng.integers(count, size=count)] if count else []
        repetitions = _repetitions(earlier, rng.uniform(*EARLIER_S, count))
        after = self.work(earlier, repetitions, warm_up, ambient).end_c
        after = self.rest(after, rng.uniform(*REST_S, count), ambient)
        start = np.select([(before == "cold")[:, None], (before == "idle")[:, None]], [cold, long_idle], after)
        for _ in range(COOLING_STEPS):
            start = self.rest(start, self._hot(start) * COOLING_STEP_S, ambient)
        # An arm that idles above the limit, in warm air with a badly cooled wrist, must be powered off first.
        return np.where(self._hot(start)[:, None], cold, start)

    def work(self, plans: Sequence[Plan], repetitions: Array, start: Array, ambient: Array) -> SimulatedTemperatures:
        """Temperatures after approach, repeated cycle and retreat."""
        highest, temp = start[:, WINDING], start
        for name in ("approach", "cycle", "retreat"):
            phases = [getattr(plan, name) for plan in plans]
            duration_s = np.array([phase.duration_s for phase in phases])
            if name == "cycle":
                duration_s = duration_s * repetitions
            load = drives([phase.profile for phase in phases], self.hardware.motors)
            after = self._simulate(load, duration_s, temp, ambient)
            temp, highest = after.end_c, np.maximum(highest, after.highest_c)
        return SimulatedTemperatures(temp, highest)

    def rest(self, start: Array, duration_s: Array, ambient: Array) -> Array:
        """Temperatures after standing at home, powered."""
        robot, motors, _ = self.hardware
        idle = static_drive(ArmModel(robot).gravity_torque(robot.home_q()), motors)
        return self._simulate(idle, duration_s, start, ambient).end_c

    def _hot(self, temp: Array) -> Array:
        return temp[:, WINDING].max(axis=1, initial=-np.inf) >= self.warning_c

    def _simulate(self, load: Drive, duration_s: Array, start: Array, ambient: Array) -> SimulatedTemperatures:
        _, motors, thermal = self.hardware
        return simulate_temperatures(load, duration_s, motors=motors, thermal=thermal, start_c=start, ambient_c=ambient)
