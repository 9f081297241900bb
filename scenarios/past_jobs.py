"""An arm's past jobs: begun at whatever temperature the work before had left, in air that nobody measured.

They carry what an arm's own recordings tell it: how long it worked, its motor temperatures before, the hottest after.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.motion import Drive, Plan, drive
from fleet.motor import reference_current
from fleet.sim.models import ArmModel
from fleet.sim.oracle import Warmed, warmed
from fleet.thermal import NODES, WINDING
from scenarios.study import Study

Array = np.ndarray

AMBIENT_C = (19.0, 27.0)
"""Air of a job, unknown to any model."""
DURATION_S = (180.0, 2700.0)
EARLIER_S = (300.0, 3600.0)
"""How long the job before lasted, where there was one."""
REST_S = (0.0, 1800.0)
"""Rest, powered, between the job before and this one."""
COOLING_STEP_S = 300.0
COOLING_STEPS = 12
"""An arm above the limit rests on in such steps until it is below, an hour at most."""
BEFORE = {"cold": 0.15, "idle": 0.25, "work": 0.6}
"""Share of the jobs that begin switched on just now, long idle, and after a job and a rest."""


@dataclass(frozen=True, eq=False)
class PastJobs:
    """Jobs that one arm has done, with what it knew before and what came of it."""

    plans: tuple[Plan, ...]
    repetitions: Array
    """int [job]."""
    duration_s: Array
    """From leaving home to being home again, [job]."""
    start_c: Array
    """True temperatures at the start, [job, node]; hidden from the arm."""
    measured_c: Array
    """Motor temperatures that the sensors gave at the start, [job, joint]."""
    ambient_c: Array
    """True air, [job]; hidden from the arm."""
    peak_c: Array
    """Hottest winding temperature during the job, [job, joint]."""
    warning_c: float

    def __len__(self) -> int:
        return len(self.plans)

    @property
    def passed(self) -> Array:
        """Whether some motor reached the warning limit, bool [job]."""
        return self.peak_c.max(axis=1, initial=-np.inf) >= self.warning_c


def past_jobs(study: Study, plans: Sequence[Plan], rng: np.random.Generator) -> PastJobs:
    """One past job of the study's arm for each plan, repeated for 3 to 45 minutes. Every job begins below the limit.

    The job before is drawn from the same plans.
    """
    count = len(plans)
    wanted_s = rng.uniform(*DURATION_S, count)
    repetitions = np.array([_times(plan, s) for plan, s in zip(plans, wanted_s, strict=True)], dtype=int)
    ambient = rng.uniform(*AMBIENT_C, count)
    start = _start(study, plans, ambient, rng)
    noise = study.motors.sensor_noise_k * rng.standard_normal((count, study.motors.sensor_noise_k.size))
    return PastJobs(
        plans=tuple(plans),
        repetitions=repetitions,
        duration_s=np.array([p.duration_s(int(n)) for p, n in zip(plans, repetitions, strict=True)]),
        start_c=start,
        measured_c=start[:, WINDING] + noise,
        ambient_c=ambient,
        peak_c=_worked(study, plans, repetitions, start, ambient).highest_c,
        warning_c=study.warning_c,
    )


def _times(plan: Plan, duration_s: float) -> int:
    """Repetitions that come closest to the duration, at least one."""
    around_s = plan.approach.duration_s + plan.retreat.duration_s
    return max(1, round((duration_s - around_s) / plan.cycle.duration_s))


def _start(study: Study, plans: Sequence[Plan], ambient: Array, rng: np.random.Generator) -> Array:
    """Temperatures at which the jobs begin, °C, [job, node]."""
    count = len(plans)
    before = rng.choice(list(BEFORE), size=count, p=list(BEFORE.values()))
    cold = np.broadcast_to(ambient[:, None], (count, NODES)).copy()
    long_idle = _rested(study, cold, np.full(count, 4 * 3600.0), ambient)
    # Between switched on just now and long idle: shifts begin at any time.
    warm_up = cold + rng.uniform(0.0, 1.0, (count, 1)) * (long_idle - cold)
    earlier = [plans[i] for i in rng.integers(count, size=count)] if count else []
    lasted_s = rng.uniform(*EARLIER_S, count)
    times = np.array([_times(plan, s) for plan, s in zip(earlier, lasted_s, strict=True)], dtype=int)
    after = _worked(study, earlier, times, warm_up, ambient).end_c
    after = _rested(study, after, rng.uniform(*REST_S, count), ambient)
    start = np.select([(before == "cold")[:, None], (before == "idle")[:, None]], [cold, long_idle], after)
    for _ in range(COOLING_STEPS):
        start = _rested(study, start, _hot(study, start) * COOLING_STEP_S, ambient)
    # What idles above the limit, in warm air and with a badly cooled wrist, has to be switched off to go on.
    return np.where(_hot(study, start)[:, None], cold, start)


def _hot(study: Study, temp: Array) -> Array:
    return temp[:, WINDING].max(axis=1, initial=-np.inf) >= study.warning_c


def _worked(study: Study, plans: Sequence[Plan], times: Array, start: Array, ambient: Array) -> Warmed:
    """What approach, repeated cycle and retreat make of the temperatures."""
    highest, temp = start[:, WINDING], start
    for phase in ("approach", "cycle", "retreat"):
        stretches = [getattr(plan, phase) for plan in plans]
        repeated = times if phase == "cycle" else np.ones(len(plans))
        passed = warmed(
            [drive(stretch.profile, study.motors) for stretch in stretches],
            np.array([stretch.duration_s for stretch in stretches]) * repeated,
            motors=study.motors,
            thermal=study.thermal,
            start_c=temp,
            ambient_c=ambient,
        )
        temp, highest = passed.end_c, np.maximum(highest, passed.highest_c)
    return Warmed(temp, highest)


def _rested(study: Study, start: Array, duration_s: Array, ambient: Array) -> Array:
    """Temperatures after standing at home, powered, °C, [job, node]."""
    still = np.zeros(study.motors.idle_w.shape)
    tau = ArmModel(study.robot).gravity_torque(study.robot.home_q())
    idle = Drive(reference_current(tau, still, study.motors) ** 2, still)
    return warmed(
        [idle] * len(start),
        duration_s,
        motors=study.motors,
        thermal=study.thermal,
        start_c=start,
        ambient_c=ambient,
    ).end_c
