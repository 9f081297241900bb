"""Jerk-limited motion from rest to rest with its torque, and checks of its limits and collisions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import ruckig

from fleet.arm.model import ArmModel, links_of, payload_bodies, set_payload_balls
from fleet.errors import InfeasibleJob, distinguish
from fleet.motion import RATE_HZ, Phase
from fleet.robot import GEN3, JOINTS

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

Array = np.ndarray

_TOLERANCE = 1e-6


def limit_violation(q: Array, qd: Array, qdd: Array, tau: Array, position_range: Array) -> tuple[int, str] | None:
    """The sample that exceeds a limit most, with the reason as text; None if all limits are kept.

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
            needed, allowed = distinguish(value[sample, joint], limit[joint])
            return sample, f"{name}: joint_{joint + 1} needs {needed} {unit}, allowed {allowed} {unit}"
    return None


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Sampled joint motion; the next motion begins one sample after the last row."""

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

    motion: JointMotion
    place: str
    """Name of the place that errors report."""
    payload_kg: float = 0.0
    pressing_n: float = 0.0
    direction: tuple[float, float, float] | Array = (0.0, 0.0, 0.0)
    """Unit vector of the pressing force in the world frame, [3]."""


def move(start: Array, end: Array, speed: float) -> JointMotion:
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
    return JointMotion(q, qd * shrink, qdd * shrink**2)


def rest(q: Array, seconds: float) -> JointMotion:
    """Standstill at `q` for the nearest whole number of samples."""
    shape = (round(seconds * RATE_HZ), JOINTS)  # stored once, however long
    still = np.broadcast_to(0.0, shape)
    return JointMotion(np.broadcast_to(q, shape), still, still)


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
        first = JointMotion(*(array[:1] for array in vars(parts[0].motion).values()))
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
        # A standstill needs one torque, and is often most of the samples.
        motion = JointMotion(motion.q[:1], motion.qd[:1], motion.qdd[:1])
    tau = arm.inverse_dynamics(motion.q, motion.qd, motion.qdd, part.payload_kg, force_n)
    return np.broadcast_to(tau, (len(part.motion), JOINTS)) if len(motion) == 1 else tau


ALLOWED_DEPTH_M = 0.005
"""Allowed depth of a link in the arm's own base or shoulder: some primitives are larger than the shells."""
GAP_M = 0.002
"""Smallest distance to floor and fixtures: a margin for deviations from the plan and for motion between two checked
postures."""
CHECK_STEP_RAD = 0.02
"""Largest joint step between two checked postures of a path: 18 mm at the end of an outstretched arm."""
HALF_MM = 5e-4
FAR_M = 0.5
"""Distances above this are not measured."""
_BASE_LINKS = ("forearm", "wrist_1", "wrist_2", "bracelet")


class CollisionChecker:
    """Checks postures of one arm against its base and shoulder, the floor, and the fixtures of its model.

    The payload counts as a ball at the flange.
    """

    def __init__(self, arm: ArmModel) -> None:
        self._arm = arm
        model, name = arm.model, arm.robot.name
        geoms = {link: model.geom(f"{name}/{link}").id for link in (*links_of(model, name), "payload")}
        self._pairs = [
            (part, geoms[part], link, geoms[link], -ALLOWED_DEPTH_M)
            for part in ("base", "shoulder")
            for link in _BASE_LINKS
        ]
        obstacles = [g for g in range(model.ngeom) if model.geom_bodyid[g] == 0 and model.geom_contype[g]]
        for g in obstacles:
            kind, own, *_ = [*model.geom(g).name.split("/"), ""]
            label = f"{kind} '{own}'" if own else kind
            # The base stands on the floor or on a fixture.
            self._pairs += [(label, g, link, geom, GAP_M) for link, geom in geoms.items() if link != "base"]
            self._pairs += [(label, g, "base", geoms["base"], -ALLOWED_DEPTH_M)] * bool(own)
        self._ball = payload_bodies(model, [arm.robot])

    def deepest_collision(self, q: Array, payload_kg: float = 0.0) -> str | None:
        """Description of the deepest collision among postures [posture, joint], or None."""
        model, data = self._arm.model, self._arm.data
        set_payload_balls(model, self._ball, np.array([payload_kg]))
        pairs = [pair for pair in self._pairs if pair[2] != "payload" or payload_kg > 0]
        missing_m, deepest = 0.0, None
        for posture in q:
            data.qpos[:] = posture
            mujoco.mj_kinematics(model, data)
            for obstacle, a, link, b, least_m in pairs:
                distance_m = mujoco.mj_geomDistance(model, data, a, b, FAR_M, None)
                if least_m - distance_m > missing_m:
                    missing_m = least_m - distance_m
                    if distance_m < -HALF_MM:
                        deepest = f"{link} would be {-distance_m * 1e3:.0f} mm inside the {obstacle}"
                    else:
                        close = f"{max(0.0, distance_m) * 1e3:.1f} mm from the {obstacle}"
                        deepest = f"{link} would be {close}, less than {least_m * 1e3:g} mm"
        return deepest

    def on_path(self, start: Array, end: Array, payload_kg: float = 0.0) -> str | None:
        """Reason why the straight path in joint space between two postures collides, or None."""
        collision = self.deepest_collision(straight_line(start, end, CHECK_STEP_RAD), payload_kg)
        return collision and f"collision: {collision} on the way"
