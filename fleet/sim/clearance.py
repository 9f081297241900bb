"""Whether an arm on its way runs through the floor or through its own base."""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np

from fleet.sim.models import ArmModel

Array = np.ndarray

ALLOWED_DEPTH_M = 0.005
"""Primitives are a little larger than the real shells here and there."""
CLEARANCE_STEP_RAD = 0.1
"""Postures of a way are looked at so far apart."""
_FLOOR_LINKS = ("half_arm_1", "half_arm_2", "forearm", "wrist_1", "wrist_2", "bracelet")
_BASE_LINKS = ("forearm", "wrist_1", "wrist_2", "bracelet")


class Clearance:
    """Checks postures of one arm against the floor and against its base and shoulder."""

    def __init__(self, arm: ArmModel) -> None:
        self._arm = arm

        def geom(link: str) -> int:
            return arm.model.geom(f"{arm.robot.name}/{link}").id

        pairs = [(part, geom(part), link, geom(link)) for part in ("base", "shoulder") for link in _BASE_LINKS]
        # A base below z = 0 means that the cell's floor is not at zero: nothing to check against.
        if arm.robot.mount.position_m[2] > -ALLOWED_DEPTH_M:
            pairs += [("floor", arm.model.geom("floor").id, link, geom(link)) for link in _FLOOR_LINKS]
        self._pairs = pairs

    def first_hit(self, q: Array) -> str | None:
        """What the first of the postures [posture, joint] that is not clear runs into; None if all are clear."""
        model, data = self._arm.model, self._arm.data
        for posture in q:
            data.qpos[:] = posture
            mujoco.mj_kinematics(model, data)
            for obstacle, a, link, b in self._pairs:
                distance_m = mujoco.mj_geomDistance(model, data, a, b, 1.0, None)
                if distance_m < -ALLOWED_DEPTH_M:
                    return f"{link} would be {-distance_m * 1e3:.0f} mm inside the {obstacle}"
        return None
