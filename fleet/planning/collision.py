"""Check of postures and paths for collisions of an arm with its own base, the floor and the fixtures."""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np

from fleet.physics.models import ArmModel, links_of, payload_bodies, set_payload_balls
from fleet.planning.trajectory import straight_line

Array = np.ndarray

ALLOWED_DEPTH_M = 0.005
"""Of a link in the arm's own base or shoulder: the primitives are in some places a little larger than the shells."""
GAP_M = 0.002
"""Smallest distance to floor and fixtures: for what the arm deviates from its plan, and for the way between two
checked postures."""
CHECK_STEP_RAD = 0.02
"""Largest joint step between two checked postures of a path: 18 mm at the end of an outstretched arm."""
HALF_MM = 5e-4
FAR_M = 0.5
"""Largest distance that is measured."""
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
            kind, _, own = model.geom(g).name.partition("/")
            label = f"{kind} '{own}'" if own else kind
            # The base stands on the floor or on a fixture.
            self._pairs += [(label, g, link, geom, GAP_M) for link, geom in geoms.items() if link != "base"]
            self._pairs += [(label, g, "base", geoms["base"], -ALLOWED_DEPTH_M)] * bool(own)
        self._ball = payload_bodies(model, [arm.robot])

    def deepest_collision(self, q: Array, payload_kg: float = 0.0) -> str | None:
        """Description of the deepest collision among the postures [posture, joint]; None if there is none."""
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
        """Reason why the straight path in joint space between two postures collides; None if it is clear."""
        collision = self.deepest_collision(straight_line(start, end, CHECK_STEP_RAD), payload_kg)
        return collision and f"collision: {collision} on the way"
