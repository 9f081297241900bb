"""Check of a sampled motion against the arm's limits of torque, velocity, acceleration and joint position."""

import numpy as np

from fleet.robot import GEN3

Array = np.ndarray

_TOLERANCE = 1e-6


def limit_violation(q: Array, qd: Array, qdd: Array, tau: Array, position_range: Array) -> tuple[int, str] | None:
    """The sample that exceeds a limit most, with the reason in words; None if all limits are kept.

    Args:
        q, qd, qdd, tau: Motion and torque, [time, joint].
        position_range: Lowest and highest joint position, rad, [joint, 2], symmetric; see `ArmModel.position_range`.
    """
    if len(q) == 0:
        return None
    for name, unit, value, limit in (
        ("torque", "N·m", np.abs(tau), np.array(GEN3.torque_clip)),
        ("velocity", "rad/s", np.abs(qd), np.array(GEN3.velocity)),
        ("acceleration", "rad/s²", np.abs(qdd), np.array(GEN3.acceleration)),
        ("joint limit", "rad", np.abs(q), position_range[:, 1]),
    ):
        share = value / limit
        sample, joint = (int(i) for i in np.unravel_index(np.argmax(share), share.shape))
        if share[sample, joint] > 1.0 + _TOLERANCE:
            return sample, (
                f"{name}: joint_{joint + 1} needs {value[sample, joint]:.1f} {unit}, allowed {limit[joint]:.1f} {unit}"
            )
    return None
