"""Jerk-limited motion from rest to rest, sampled at RATE_HZ, and the torque that it needs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import ruckig

from fleet.errors import InfeasibleJob
from fleet.motion import RATE_HZ, Phase
from fleet.physics.models import ArmModel
from fleet.planning.joint_limits import limit_violation
from fleet.robot import GEN3, JOINTS

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Motion:
    """Sampled joint motion; it ends one sample after the last row, where the next motion begins."""

    q: Array
    """rad, [time, joint]."""
    qd: Array
    """rad/s, [time, joint]."""
    qdd: Array
    """rad/s², [time, joint]."""

    def __len__(self) -> int:
        return len(self.q)


@dataclass(frozen=True, eq=False)
class LoadedMotion:
    """A motion with a constant load at the hand."""

    motion: Motion
    place: str
    """Name of the place that errors report."""
    payload_kg: float = 0.0
    pressing_n: float = 0.0
    direction: tuple[float, float, float] | Array = (0.0, 0.0, 0.0)
    """Unit vector of the pressing force in the world frame, [3]."""


def move(start: Array, end: Array, speed: float) -> Motion:
    """Motion from rest at `start` to rest at `end` on a straight line in joint space.

    Velocity, acceleration and jerk stay below `speed` times those of `GEN3`. The fastest motion is stretched to the
    next whole number of samples, which only lowers them.
    """
    if np.array_equal(start, end):
        return rest(start, 0.0)
    target = ruckig.InputParameter(JOINTS)
    target.current_position, target.target_position = start.tolist(), end.tolist()
    target.max_velocity = [speed * limit for limit in GEN3.velocity]
    target.max_acceleration = [speed * limit for limit in GEN3.acceleration]
    target.max_jerk = [speed * limit for limit in GEN3.jerk]
    target.synchronization = ruckig.Synchronization.Phase
    trajectory = ruckig.Trajectory(JOINTS)
    result = ruckig.Ruckig(JOINTS).calculate(target, trajectory)
    assert result == ruckig.Result.Working, f"{result} from {start} to {end}"
    samples = max(1, int(np.ceil(trajectory.duration * RATE_HZ - 1e-9)))
    shrink = trajectory.duration * RATE_HZ / samples
    q, qd, qdd = np.array([trajectory.at_time(i / RATE_HZ * shrink) for i in range(samples)]).transpose(1, 0, 2)
    return Motion(q, qd * shrink, qdd * shrink**2)


def rest(q: Array, seconds: float) -> Motion:
    """Standstill at `q`, to the nearest whole number of samples."""
    shape = (round(seconds * RATE_HZ), JOINTS)  # stored once, however long
    still = np.broadcast_to(0.0, shape)
    return Motion(np.broadcast_to(q, shape), still, still)


def straight_line(start: Array, end: Array, step_rad: float) -> Array:
    """Postures along a straight line, at most `step_rad` apart in every joint, both ends included, [point, joint]."""
    count = max(1, int(np.ceil(np.max(np.abs(end - start)) / step_rad)))
    return start + (end - start) * np.linspace(0.0, 1.0, count + 1)[:, None]


def build_phase(arm: ArmModel, parts: Sequence[LoadedMotion]) -> Phase:
    """The motions one after the other as a phase of a plan, with the torque of inverse dynamics.

    Raises:
        InfeasibleJob: a limit of the arm is exceeded; names the place and the load.
    """
    if len(parts) == 1 and len(parts[0].motion) > 1 and not parts[0].motion.qd.any():
        first = Motion(*(array[:1] for array in vars(parts[0].motion).values()))
        one = build_phase(arm, [replace(parts[0], motion=first)])
        count = len(parts[0].motion)
        return Phase(
            np.broadcast_to(one.profile[0], (count, *one.profile.shape[1:])),
            np.broadcast_to(one.payload_kg[0], (count,)),
        )
    lengths = [len(part.motion) for part in parts]
    none = np.empty((0, JOINTS))
    q, qd, qdd = (np.concatenate([none, *(getattr(part.motion, n) for part in parts)]) for n in ("q", "qd", "qdd"))
    tau = np.concatenate([none, *(_torque(arm, part) for part in parts)])
    if violation := limit_violation(q, qd, qdd, tau, arm.position_range):
        sample, reason = violation
        part = parts[np.repeat(np.arange(len(parts)), lengths)[sample]]
        pressing = f" pressing {part.pressing_n:g} N" if part.pressing_n else ""
        raise InfeasibleJob(arm.robot.name, part.place, f"{reason}, with {part.payload_kg:g} kg{pressing}")
    payload_kg = np.repeat([part.payload_kg for part in parts], lengths)
    return Phase(np.stack([q, qd, tau], axis=1).astype(np.float32), payload_kg.astype(np.float32))


def _torque(arm: ArmModel, part: LoadedMotion) -> Array:
    """N·m, [time, joint]."""
    motion = part.motion
    force_n = -part.pressing_n * np.asarray(part.direction)  # of the environment on the tool
    if len(motion) and not motion.qd.any():
        # A standstill needs one torque, and it is often most of the samples.
        motion = Motion(motion.q[:1], motion.qd[:1], motion.qdd[:1])
    tau = arm.inverse_dynamics(motion.q, motion.qd, motion.qdd, part.payload_kg, force_n)
    return np.broadcast_to(tau, (len(part.motion), JOINTS)) if len(motion) == 1 else tau
