"""Motion from rest to rest: jerk-limited, all joints in phase, sampled at exactly RATE_HZ."""

from dataclasses import dataclass

import numpy as np
import ruckig

from fleet.motion import RATE_HZ
from fleet.robot import GEN3, JOINTS

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Motion:
    """Sampled joint motion. It ends one sample after the last, where the next motion begins."""

    q: Array
    """rad, [time, joint]."""
    qd: Array
    """rad/s, [time, joint]."""
    qdd: Array
    """rad/s², [time, joint]."""

    def __len__(self) -> int:
        return len(self.q)


def move(start: Array, end: Array, speed: float) -> Motion:
    """From rest at `start` to rest at `end`, on a straight line in joint space.

    Velocity, acceleration and jerk stay below `speed` times those of `GEN3`. The fastest motion is stretched to the
    next whole number of samples, which only lowers them.
    """
    if np.array_equal(start, end):
        return rest(start, 0.0)
    wish = ruckig.InputParameter(JOINTS)
    wish.current_position, wish.target_position = start.tolist(), end.tolist()
    wish.max_velocity = [speed * limit for limit in GEN3.velocity]
    wish.max_acceleration = [speed * limit for limit in GEN3.acceleration]
    wish.max_jerk = [speed * limit for limit in GEN3.jerk]
    wish.synchronization = ruckig.Synchronization.Phase
    trajectory = ruckig.Trajectory(JOINTS)
    result = ruckig.Ruckig(JOINTS).calculate(wish, trajectory)
    assert result == ruckig.Result.Working, f"{result} from {start} to {end}"
    samples = max(1, int(np.ceil(trajectory.duration * RATE_HZ - 1e-9)))
    shrink = trajectory.duration * RATE_HZ / samples
    q, qd, qdd = np.array([trajectory.at_time(i / RATE_HZ * shrink) for i in range(samples)]).transpose(1, 0, 2)
    return Motion(q, qd * shrink, qdd * shrink**2)


def rest(q: Array, seconds: float) -> Motion:
    """Standing still, to the nearest whole number of samples."""
    still = np.zeros((round(seconds * RATE_HZ), JOINTS))
    return Motion(still + q, still, still)


def joined(motions: list[Motion]) -> Motion:
    """One motion after the other."""
    parts = [np.stack([motion.q, motion.qd, motion.qdd]) for motion in motions]
    return Motion(*np.concatenate([np.empty((3, 0, JOINTS)), *parts], axis=1))


def line(start: Array, end: Array, step_rad: float) -> Array:
    """Joint positions along a straight line, no joint moving further than the step, [point, joint]."""
    count = max(1, int(np.ceil(np.max(np.abs(end - start)) / step_rad)))
    return start + (end - start) * np.linspace(0.0, 1.0, count + 1)[:, None]
