"""Motion as the drives record it: torque computed from the motor current, so friction is included."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from fleet.motion import CHANNELS, Phase, Plan, distinct
from fleet.motor import Motors, friction_torque

Array = np.ndarray

QD, TAU = CHANNELS.index("qd"), CHANNELS.index("tau")


def sensed(plans: Iterable[Plan], motors: Motors) -> tuple[Plan, ...]:
    """The plans with tau + eta · friction in place of tau: i · N·Kt · eta, the torque that the current stands for.

    Args:
        motors: The true motors of the arm, whose friction the drives overcome.
    """
    return tuple(
        replace(plan, **{name: _sensed(getattr(plan, name), motors) for name in ("approach", "cycle", "retreat")})
        for plan in plans
    )


def _sensed(phase: Phase, motors: Motors) -> Phase:
    if len(distinct(phase.profile)) < len(phase.profile):  # a standstill, without friction
        return phase
    profile = np.array(phase.profile)
    profile[:, TAU] += (motors.eta * friction_torque(profile[:, QD].astype(float), motors)).astype(profile.dtype)
    return replace(phase, profile=profile)
