"""Inverse kinematics: which of several postures it chooses must not hang on the last digit of a number."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.arm.kinematics import InverseKinematics, Pose, Unreachable
from fleet.arm.model import ELBOW_ANGLES_DEG, ArmModel
from fleet.robot import Mount, Robot, rotation

DOWN = rotation((180.0, 0.0, 0.0))
ROUNDING_M = 1e-13
"""More than the numeric libraries of two processors differ in."""


@pytest.mark.parametrize("home", ["home", "retract"])
@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0, 0.0), (180.0, 0.0, 0.0)])
def test_the_last_digit_chooses_no_posture(home, tilt_deg):
    """Straight ahead, where the arm can turn to either side, and on a grid like that of stations."""
    robot = Robot(name="a", home=home, mount=Mount(position_m=(0.0, 0.0, 0.9 if tilt_deg[0] else 0.0)))
    arm = ArmModel(replace(robot, mount=replace(robot.mount, tilt_deg=tilt_deg)))
    inverse, rng, compared = InverseKinematics(arm), np.random.default_rng(0), 0
    for x in (-0.45, 0.3, 0.45):
        for y in (-0.3, 0.0, 0.3):
            for elbow_deg in ELBOW_ANGLES_DEG:
                pose = Pose(np.array([x, y, 0.25]), DOWN)
                try:
                    q = inverse.solve(pose, elbow_deg, robot.home_q())
                except Unreachable:
                    continue
                moved = Pose(pose.position_m + ROUNDING_M * rng.standard_normal(3), DOWN)
                np.testing.assert_allclose(inverse.solve(moved, elbow_deg, robot.home_q()), q, atol=1e-6)
                compared += 1
    assert compared > 50
