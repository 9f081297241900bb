"""Inverse kinematics of the Gen3: closed-form postures as seeds, refined on the exact model."""

from dataclasses import dataclass
from itertools import product

import mink
import numpy as np

from fleet.arm.model import ArmModel
from fleet.errors import distinguish
from fleet.robot import GEN3, JOINTS

Array = np.ndarray

SHOULDER_M = 0.28481
"""Height of joint 2 over the base plate."""
UPPER_ARM_M = 0.42076
"""Joint 2 to joint 4."""
FOREARM_M = 0.31436
"""Joint 4 to joint 6."""
HAND_M = 0.167455
"""Joint 6 to the flange."""
REACH_M = UPPER_ARM_M + FOREARM_M + HAND_M
"""Shoulder to flange, outstretched: 0.902 m in Kinova's user guide."""

POSITION_TOLERANCE_M = 1e-3
ANGLE_TOLERANCE_RAD = np.deg2rad(0.5)
# Tighter than the tolerances above, which hold after rounding to float32.
_SOLVED_M = 1e-5
_SOLVED_RAD = 1e-5
_STEPS = 40
_STEP_RAD = 0.3
_SEEDS = 3
_SEED_SLACK_M = 0.001  # Half of this is the lengthening by the lateral offsets of the links, 25 mm in all.
_SEED_SLACK_RAD = 0.1
_WRIST_M = UPPER_ARM_M + FOREARM_M
_FULL = 0.985  # Share of the reach beyond which a miss is reported as out of reach.
_AT_STOP_RAD = 0.01
_BENT = 0.998  # Largest share of the reach to which a seed stretches the arm.


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of the tool in the world."""

    position_m: Array
    """[3]."""
    rotation: Array
    """Tool frame to world, [3, 3]."""

    def retracted(self, distance_m: float) -> "Pose":
        """The pose moved back along its own z axis."""
        return Pose(self.position_m - distance_m * self.rotation[:, 2], self.rotation)


class Unreachable(Exception):
    """No joint positions put the tool at the pose; the message states the reason with its numbers."""


class InverseKinematics:
    """Joint positions that put one arm's tool at a pose.

    Seven joints leave one degree of freedom, the angle of the elbow about the line shoulder–wrist. An arm without the
    12 mm offset of its links has a closed-form solution for each angle; mink refines it on the exact model.
    """

    def __init__(self, arm: ArmModel) -> None:
        self._arm = arm
        self._base = arm.robot.mount.rotation()
        self._origin = np.asarray(arm.robot.mount.position_m)
        self._configuration = mink.Configuration(arm.model)
        self._tool = mink.FrameTask(
            f"{arm.robot.name}/tool", "site", position_cost=1.0, orientation_cost=0.3, lm_damping=1e-6
        )
        self._posture = mink.PostureTask(arm.model, cost=1e-3)
        self._limit = mink.ConfigurationLimit(arm.model)

    def solve(self, pose: Pose, elbow_deg: float, near: Array) -> Array:
        """Joint positions with this elbow angle, as close to `near` as whole turns allow, rad, [joint].

        Raises:
            Unreachable: too far, too near, beyond a joint stop, or not converged.
        """
        failure: Unreachable | None = None
        for seed in self._seeds(pose, elbow_deg, near):
            try:
                return nearest_turn(self._refine(pose, seed), near)
            except Unreachable as error:
                failure = failure or error
        assert failure is not None
        raise failure

    def error(self, pose: Pose, q: Array) -> tuple[float, float]:
        """Distance, m, and angle, rad, between the tool at q and the pose."""
        position, turn = self._arm.tool_pose(q)
        return float(np.linalg.norm(position - pose.position_m)), angle_between(turn, pose.rotation)

    def _in_base(self, pose: Pose) -> Pose:
        return Pose(self._base.T @ (pose.position_m - self._origin), self._base.T @ pose.rotation)

    def _seeds(self, pose: Pose, elbow_deg: float, near: Array) -> list[Array]:
        """Joint positions close to the pose, at least one, in order of travel time from `near`."""
        target = self._in_base(pose)
        tool, wrist = _from_shoulder(target)
        tool_m, wrist_m = float(np.linalg.norm(tool)), float(np.linalg.norm(wrist))
        if tool_m > REACH_M + _SEED_SLACK_M or wrist_m > _WRIST_M + _SEED_SLACK_M:
            raise Unreachable(_out_of_reach(tool_m, wrist_m))
        # A straight arm is singular, and the iteration could not bend it.
        wrist *= min(1.0, _BENT * _WRIST_M / max(wrist_m, 1e-9))
        elbow = _elbow(wrist, elbow_deg, near)
        seeds = [
            nearest_turn(_angles(elbow, wrist, target.rotation, flips), near) for flips in product((1, -1), repeat=3)
        ]
        seeds.sort(key=lambda q: _travel_s(q, near))
        low, high = self._arm.position_range.T
        # Joint stops are symmetric, so either all flips are within them or none.
        beyond = np.maximum(low - seeds[0], seeds[0] - high)
        worst = int(np.argmax(beyond))
        if beyond[worst] > _SEED_SLACK_RAD:
            raise Unreachable(
                f"joint limit: joint_{worst + 1} would have to be at {seeds[0][worst]:.2f} rad, "
                f"allowed {low[worst]:.2f} to {high[worst]:.2f}"
            )
        return [np.clip(seed, low, high) for seed in seeds[:_SEEDS]]

    def _refine(self, pose: Pose, seed: Array) -> Array:
        configuration = self._configuration
        configuration.update(seed)
        self._posture.set_target(seed)
        self._tool.set_target(
            mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(pose.rotation), pose.position_m)
        )
        for step in range(_STEPS):
            distance, angle = self.error(pose, configuration.q)
            if distance < _SOLVED_M and angle < _SOLVED_RAD:
                return configuration.q.copy()
            # The posture task keeps the free elbow in place at first; at the end it would only bias the tool.
            tasks = [self._tool, self._posture] if step < _STEPS // 2 else [self._tool]
            try:
                velocity = mink.solve_ik(
                    configuration, tasks, dt=1.0, solver="daqp", damping=1e-9, limits=[self._limit]
                )
            except mink.NoSolutionFound as error:
                raise Unreachable(f"no IK solution: {error}") from error
            # A full step from far away, or near a singularity, would leave the range of the linearisation.
            configuration.integrate_inplace(velocity * min(1.0, _STEP_RAD / max(np.max(np.abs(velocity)), 1e-12)), 1.0)
        distance, angle = self.error(pose, configuration.q)
        if distance < POSITION_TOLERANCE_M / 2 and angle < ANGLE_TOLERANCE_RAD / 2:
            return configuration.q.copy()
        raise Unreachable(
            self._why_short(pose, configuration.q, f"{distance * 1e3:.0f} mm and {np.rad2deg(angle):.1f} deg")
        )

    def _why_short(self, pose: Pose, q: Array, short: str) -> str:
        """Reason why the iteration stopped at q, away from the pose."""
        low, high = self._arm.position_range.T
        at_stop = np.minimum(q - low, high - q) < _AT_STOP_RAD
        if at_stop.any():
            joint = int(np.argmax(at_stop))
            return f"joint limit: with joint_{joint + 1} at its stop, {q[joint]:.2f} rad, the tool is {short} off"
        tool_m, wrist_m = (float(np.linalg.norm(vector)) for vector in _from_shoulder(self._in_base(pose)))
        if tool_m > _FULL * REACH_M or wrist_m > _FULL * _WRIST_M:
            return _out_of_reach(tool_m, wrist_m)
        return f"no IK solution: the tool is {short} off after {_STEPS} steps"


def _travel_s(q: Array, near: Array) -> tuple[float, float]:
    """Time of the slowest joint and sum over the joints, s, rounded: often several flips differ in other joints
    than the slowest, and the choice must not depend on the last digit, which depends on the processor."""
    times_s = np.abs(q - near) / GEN3.velocity
    return round(float(times_s.max()), 6), round(float(times_s.sum()), 6)


def _from_shoulder(target: Pose) -> tuple[Array, Array]:
    """Vectors from joint 2 to the tool point and to joint 6, m, [3], of a pose in the base frame."""
    tool = target.position_m - (0.0, 0.0, SHOULDER_M)
    return tool, target.position_m - HAND_M * target.rotation[:, 2] - (0.0, 0.0, SHOULDER_M)


def nearest_turn(q: Array, near: Array) -> Array:
    """The positions with the continuous joints (1, 3, 5, 7) moved by whole turns to be closest to `near`."""
    turned = q.copy()
    turned[::2] -= 2 * np.pi * np.round((q[::2] - near[::2]) / (2 * np.pi))
    return turned


def angle_between(a: Array, b: Array) -> float:
    """Angle of the rotation between two frames, rad; exact for small angles too."""
    return float(2 * np.arcsin(min(1.0, np.linalg.norm(a - b) / np.sqrt(8.0))))


def _out_of_reach(tool_m: float, wrist_m: float) -> str:
    tool, reach = distinguish(tool_m, REACH_M, 3)
    reason = f"reach: {tool} m from the shoulder, the arm has {reach} m"
    if tool_m > REACH_M:
        return reason
    wrist, most = distinguish(wrist_m, _WRIST_M, 3)
    return f"{reason}; with this tool direction its wrist would be {wrist} m away, at most {most} m"


def _elbow(wrist: Array, elbow_deg: float, near: Array) -> Array:
    """Vector from shoulder to elbow in the base frame, [3]; at 0 deg the elbow is furthest along z."""
    distance = float(np.linalg.norm(wrist))
    axis = wrist / distance if distance > 1e-9 else np.array([0.0, 0.0, 1.0])
    along = (UPPER_ARM_M**2 - FOREARM_M**2 + distance**2) / (2 * max(distance, 1e-9))
    along = float(np.clip(along, -UPPER_ARM_M, UPPER_ARM_M))
    up = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
    if np.linalg.norm(up) < 1e-6:  # The wrist is on the base axis: all elbow angles are equivalent.
        up = np.array([-np.cos(near[0]), np.sin(near[0]), 0.0])
    up /= np.linalg.norm(up)
    turn = np.deg2rad(elbow_deg)
    side = np.cos(turn) * up + np.sin(turn) * np.cross(axis, up)
    return along * axis + np.sqrt(UPPER_ARM_M**2 - along**2) * side


def _angles(elbow: Array, wrist: Array, turn: Array, flips: tuple[int, ...]) -> Array:
    """Joint positions of the arm without offsets, [joint].

    Its tool frame is Rz(−q1) Ry(q2) Rz(−q3) Ry(q4) Rz(−q5) Ry(q6) Rz(−q7) in the base frame, with every link
    along z of its own frame; `flips` are the signs of q2, q4 and q6.
    """
    upper = elbow / np.linalg.norm(elbow)
    lower = (wrist - elbow) / np.linalg.norm(wrist - elbow)
    q = np.empty(JOINTS)
    q[0], q[1] = _point(upper, flips[0])
    frame = _rz(-q[0]) @ _ry(q[1])
    q[2], q[3] = _point(frame.T @ lower, flips[1])
    frame = frame @ _rz(-q[2]) @ _ry(q[3])
    hand = frame.T @ turn
    q[4], q[5] = _point(hand[:, 2], flips[2])
    last = (_rz(-q[4]) @ _ry(q[5])).T @ hand
    q[6] = -np.arctan2(last[1, 0], last[0, 0])
    return q


def _point(direction: Array, sign: int) -> tuple[float, float]:
    """Angles (a, b) with Rz(−a) Ry(b) z = direction and b of the given sign."""
    x, y, z = direction
    return -float(np.arctan2(sign * y, sign * x)), sign * float(np.arctan2(np.hypot(x, y), z))


def _rz(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _ry(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
