"""RMS torque relative to a nominal torque: the usual rule for sizing a motor, without learning."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.motion import CHANNELS, Plan
from fleet.motor import Motors, reference_current
from fleet.thermal import WINDING, ThermalModel, steady_state
from twin.baselines.reconstruction import Scores
from twin.vae.window import STD_FLOOR, check_jobs

Array = np.ndarray

TAU = CHANNELS.index("tau")


@dataclass(frozen=True, eq=False)
class TorqueRms:
    """RMS torque over the job's time divided by a nominal torque; the total is the worst joint."""

    name: str
    nominal_nm: Array
    """[joint]."""

    def __post_init__(self) -> None:
        if self.nominal_nm.ndim != 1 or not np.all(self.nominal_nm > 0):
            raise ValueError(f"TorqueRms.nominal_nm must be one torque > 0 per joint (got {self.nominal_nm}).")

    def scores(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Scores:
        """Score of each job; raises as `Scorer` does."""
        check_jobs(plans, repetitions)
        rms = np.stack([_rms_torque(plan, times) for plan, times in zip(plans, repetitions, strict=True)])
        if rms.shape[1] != len(self.nominal_nm):
            raise ValueError(f"'{self.name}' has torques of {len(self.nominal_nm)} joints, a plan has {rms.shape[1]}.")
        per_joint = rms / self.nominal_nm
        return Scores(per_joint, per_joint.max(axis=1))


def _rms_torque(plan: Plan, repetitions: int) -> Array:
    """N·m, [joint]."""
    squares = [
        share * np.square(phase.profile[:, TAU], dtype=float).mean(axis=0)
        for phase, share in zip(plan.phases, plan.weights(repetitions), strict=True)
        if len(phase.profile)
    ]
    return np.sqrt(np.sum(squares, axis=0))


def torque_over_known(records: Sequence[Array]) -> TorqueRms:
    """RMS torque over that of the training motion [time, 3, joint]; needs no motor data."""
    if not records:
        raise ValueError("The torque of the training motion needs at least one record (got none).")
    squares = np.concatenate([np.square(record[:, TAU], dtype=float) for record in records])
    # A joint without load in training has no torque to divide by.
    return TorqueRms("RMS torque / known", np.maximum(np.sqrt(squares.mean(axis=0)), STD_FLOOR[TAU]))


def torque_over_continuous(motors: Motors, thermal: ThermalModel, *, limit_c: float, ambient_c: float) -> TorqueRms:
    """RMS torque over the torque that each joint can hold forever; needs motor and thermal data, which no twin has."""
    torque_nm = continuous_torque(motors, thermal, limit_c=limit_c, ambient_c=ambient_c)
    return TorqueRms("RMS torque / continuous", torque_nm)


def continuous_torque(motors: Motors, thermal: ThermalModel, *, limit_c: float, ambient_c: float) -> Array:
    """Torque at which one joint alone, at rest, reaches a steady `limit_c`, N·m, [joint]; by bisection.

    Raises:
        ValueError: idle heat alone passes the limit.
    """
    joints = len(motors.eta)
    still = np.zeros(joints)
    idle = steady_state(thermal, still, still, motors, ambient_c)
    if idle is None or np.any(idle[WINDING] >= limit_c):
        raise ValueError(f"At {ambient_c:g} °C the arm passes {limit_c:g} °C without any load.")
    low, high = still.copy(), motors.current_max_a * motors.torque_per_amp * motors.eta
    for _ in range(40):
        middle = 0.5 * (low + high)
        hot = np.zeros(joints, dtype=bool)
        for j in range(joints):
            tau = np.where(np.arange(joints) == j, middle, 0.0)
            temp_c = steady_state(thermal, reference_current(tau, still, motors) ** 2, still, motors, ambient_c)
            hot[j] = temp_c is None or temp_c[WINDING][j] > limit_c  # None: a thermal runaway
        low, high = np.where(hot, low, middle), np.where(hot, middle, high)
    return 0.5 * (low + high)
