"""Check of postures for collisions of an arm with the floor and with its own base."""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np

from fleet.physics.models import ArmModel
from fleet.planning.trajectory import straight_line

Array = np.ndarray

ALLOWED_DEPTH_M = 0.005
"""The collision primitives are in some places a little larger than the real shells."""
CHECK_STEP_RAD = 0.1
"""Largest joint step between two checked postures of a path."""
_FLOOR_LINKS = ("half_arm_1", "half_arm_2", "forearm", "wrist_1", "wrist_2", "bracelet")
_BASE_LINKS = ("forearm", "wrist_1", "wrist_2", "bracelet")


class CollisionChecker:
    """Checks postures of one arm against the floor and against its base and shoulder."""

    def __init__(self, arm: ArmModel) -> None:
        self._arm = arm

        def geom(link: str) -> int:
            return arm.model.geom(f"{arm.robot.name}/{link}").id

        self._pairs = [(part, geom(part), link, geom(link)) for part in ("base", "shoulder") for link in _BASE_LINKS]
        # A base below z = 0 means that the cell's floor is not at zero: its height is unknown, so it is not checked.
        if arm.robot.mount.position_m[2] > -ALLOWED_DEPTH_M:
            self._pairs += [("floor", arm.model.geom("floor").id, link, geom(link)) for link in _FLOOR_LINKS]

    def first_collision(self, q: Array) -> str | None:
        """Description of the first collision among the postures [posture, joint]; None if there is none."""
        model, data = self._arm.model, self._arm.data
        for posture in q:
            data.qpos[:] = posture
            mujoco.mj_kinematics(model, data)
            for obstacle, a, link, b in self._pairs:
                distance_m = mujoco.mj_geomDistance(model, data, a, b, 1.0, None)
                if distance_m < -ALLOWED_DEPTH_M:
                    return f"{link} would be {-distance_m * 1e3:.0f} mm inside the {obstacle}"
        return None

    def on_path(self, start: Array, end: Array) -> str | None:
        """Reason why the straight path in joint space between two postures collides; None if it is clear."""
        collision = self.first_collision(straight_line(start, end, CHECK_STEP_RAD))
        return collision and f"collision: {collision} on the way"
