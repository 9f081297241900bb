"""A network that learned nothing, beside which a twin is judged.

RMS torque relative to a nominal torque: the usual rule for sizing a motor, without learning.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleet.motion import CHANNELS, Plan
from twin.vae.config import TwinConfig
from twin.vae.window import STD_FLOOR, check_jobs


def untrained_config(config: TwinConfig) -> TwinConfig:
    """A VAE with its initial weights: one epoch at a rate below what the weights can resolve."""
    return replace(config, epochs=1, learning_rate=1e-12, restarts=1, allow_collapse=True)


Array = np.ndarray

TAU = CHANNELS.index("tau")


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of some jobs, larger for harder ones, in the scorer's own unit."""

    per_joint: Array
    """[job, joint]."""
    total: Array
    """[job]."""


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
        """Score of each job, a repeated plan.

        Raises:
            ValueError: no jobs, repetitions < 1, or a plan without motion, not finite or of other joints.
        """
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
