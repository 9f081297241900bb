"""The simulator's two values: what is fixed for a shift (`World`) and what changes (`State`).

Arrays have a leading env axis [env, ...]; a single shift is env = 1.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from fleet.difficulty import Forecast
from fleet.heat.motor import Motors
from fleet.heat.thermal import NODES, HousingObserver, ThermalModel
from fleet.job import MOST_FAULTS
from fleet.motion import Drive
from fleet.robot import JOINTS, ThermalLimits
from fleet.telemetry import IDLE

Array = np.ndarray

WAITING, RUNNING, DONE, GIVEN_UP, EXPIRED = range(5)
"""Status of a job."""


@dataclass(frozen=True, eq=False)
class JobTable:
    """The jobs of each env as arrays; rows beyond an env's jobs have `exists` False."""

    names: tuple[tuple[str, ...], ...]
    """[env][job]."""
    exists: Array
    """bool [env, job]."""
    release_s: Array
    due_s: Array
    value: Array
    payload_kg: Array
    repetitions: Array
    """int [env, job]."""
    after: Array
    """Indices of the jobs that must be done first, int [env, job, n], −1 for none."""
    expires: Array
    """Whether the job expires at its due date if no arm has begun it, bool [env, job]."""
    stations: Array
    """Indices of the stations it occupies, int [env, job, n], −1 for none."""


@dataclass(frozen=True, eq=False)
class PlanTable:
    """The distinct plans as arrays; phases are approach, cycle, retreat."""

    times_s: Array
    """Duration of each phase, [plan, phase]."""
    current_sq: Array
    """Mean squared reference current, A², [plan, phase, joint]."""
    friction_w: Array
    """Mean friction heat, W, [plan, phase, joint]."""
    peak_tau: Array
    """Largest torque magnitude, N·m, [plan, joint]."""
    volume: Array
    """Index of the space that the arm takes, int [plan]."""


@dataclass(frozen=True, eq=False)
class Offers:
    """The plans of each arm for each job, the fastest first, and their scores."""

    plan: Array
    """Row of the `PlanTable`, int [env, arm, job, plan]; −1 where the arm has none."""
    difficulty: Array
    """d, [env, arm, job, plan]; NaN where there is no score."""
    p_saturation: Array
    """Probability from models that ignore the start temperature, [env, arm, job, plan]; NaN where unknown."""
    risk: Array
    """Row of `forecasts` for P, int [env, arm, job, plan]; −1 where the model has none."""
    peak: Array
    """Row of `forecasts` for the peak temperature, int [env, arm, job, plan]; −1 where the model has none."""
    forecasts: Forecast | None
    """[forecast, ...]; None where no model of the fleet has any."""
    too_heavy: Array
    """Whether the load exceeds the arm's rating, bool [env, arm, job]."""


@dataclass(frozen=True, eq=False)
class World:
    """Everything that does not change during a shift."""

    arms: tuple[str, ...]
    stations: tuple[str, ...]
    dt_s: float
    """Decision interval: the length of one step."""
    ticks: int
    """Steps until the horizon."""
    slots: int
    """Jobs on offer at a time, K."""
    ambient_c: Array
    """Ambient temperature at each arm during each tick, °C, [tick, arm]."""
    thermal: ThermalModel
    """[arm, ...]."""
    motors: Motors
    """[arm, joint]."""
    limits: ThermalLimits
    torque_warning: Array
    """N·m, [joint]."""
    rest: Drive
    """Heat drive of standing in the home posture, [arm, joint]."""
    plans: PlanTable
    jobs: JobTable
    offers: Offers
    conflicts: Array
    """Whether two arms cannot take two volumes at a time, bool [volume, volume]."""
    observer: HousingObserver
    """How each arm estimates its housing temperatures, [arm, ...]."""
    start_c: Array
    """Temperatures at the start of the shift, [arm, node]."""
    start_housing_c: Array
    """Estimates of the housing temperatures at the start, [arm, joint]."""
    phi: Array
    gamma: Array
    """Step matrices for `dt_s`, [arm, node, node]."""

    @property
    def horizon_s(self) -> float:
        """Length of the shift, s."""
        return self.ticks * self.dt_s

    @property
    def plans_per_job(self) -> int:
        """Plans that an arm may have for a job."""
        return self.offers.plan.shape[-1]

    @property
    def envs(self) -> int:
        """Number of parallel shifts."""
        return len(self.jobs.exists)


class State(NamedTuple):
    """All that changes during a shift; kernels write into its arrays."""

    tick: Array
    """int [env]."""
    temp_c: Array
    """[env, arm, node]."""
    housing_c: Array
    """What each arm estimates its housing temperatures to be, [env, arm, joint]."""
    mode: Array
    """IDLE, WORKING or FAULTED, int [env, arm]."""
    job: Array
    """Index of the current job, int [env, arm], −1 for none."""
    plan: Array
    """Row of the `PlanTable` along which the arm is away from home, int [env, arm]; −1 at home."""
    progress_s: Array
    """How far along it, in its time since leaving home, [env, arm]; a fault stops it."""
    todo: Array
    """Cycles the arm set out to do, int [env, arm]."""
    clear_at_s: Array
    """When the fault will be cleared, inf while too hot or not faulted, [env, arm]."""
    moved_at_s: Array
    """When a person will move the faulted arm home, inf if it is there or not faulted, [env, arm]."""
    last_award: Array
    """1 the last claim was won, −1 lost, 0 none was made, int [env, arm]."""
    faults: Array
    """Count so far, int [env, arm]."""
    illegal: Array
    """Illegal actions so far, int [env, arm]."""
    peak_c: Array
    """Hottest motor so far, [env, arm]."""
    above_warning_s: Array
    """[env, arm]."""
    busy_s: Array
    """Time away from home, [env, arm]."""
    lost_s: Array
    """Time faulted, [env, arm]."""
    energy_j: Array
    """Electrical energy turned to heat, [env, arm]. Over closed cycles mechanical work sums to zero."""
    status: Array
    """WAITING, RUNNING, DONE, GIVEN_UP or EXPIRED, int [env, job]."""
    queued_s: Array
    """When the job was released or last returned, [env, job]."""
    cycles: Array
    """Cycles finished and kept, int [env, job]."""
    returns: Array
    """How many times a fault returned it to the queue, int [env, job]."""
    failed_arm: Array
    """Arms that it faulted so far, int [env, job, MOST_FAULTS - 1], −1 for none."""
    finished_s: Array
    """NaN until done, [env, job]."""

    def copy(self, envs: slice = slice(None)) -> Self:
        """The state of some envs in arrays of its own."""
        return type(self)(*(values[envs].copy() for values in self))


PER_JOB = ("status", "queued_s", "cycles", "returns", "failed_arm", "finished_s")
"""Arrays of a state with the axes [env, job, ...]; the others have [env, arm, ...] or [env]."""


def initial(world: World) -> State:
    """Every arm at home, at its start temperature; every job waiting."""
    envs, arms, jobs = world.envs, len(world.arms), world.jobs.exists.shape[1]

    def per_arm(value: float, dtype: type = float) -> Array:
        return np.full((envs, arms), value, dtype=dtype)

    temp = np.broadcast_to(world.start_c, (envs, arms, NODES)).copy()
    peak = temp[..., : NODES // 2].max(axis=-1)
    return State(
        tick=np.zeros(envs, dtype=int),
        temp_c=temp,
        housing_c=np.broadcast_to(world.start_housing_c, (envs, arms, JOINTS)).copy(),
        mode=per_arm(IDLE, int),
        job=per_arm(-1, int),
        plan=per_arm(-1, int),
        progress_s=per_arm(0.0),
        todo=per_arm(0, int),
        clear_at_s=per_arm(np.inf),
        moved_at_s=per_arm(np.inf),
        last_award=per_arm(0, int),
        faults=per_arm(0, int),
        illegal=per_arm(0, int),
        peak_c=peak,
        above_warning_s=per_arm(0.0),
        busy_s=per_arm(0.0),
        lost_s=per_arm(0.0),
        energy_j=per_arm(0.0),
        status=np.full((envs, jobs), WAITING),
        queued_s=world.jobs.release_s.copy(),
        cycles=np.zeros((envs, jobs), dtype=int),
        returns=np.zeros((envs, jobs), dtype=int),
        failed_arm=np.full((envs, jobs, MOST_FAULTS - 1), -1),
        finished_s=np.full((envs, jobs), np.nan),
    )
