"""Puts a MuJoCo model of the cell into recorded postures, with motors coloured by their temperature."""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence

import mujoco
import numpy as np

from fleet.env.render.heat import heat_colour
from fleet.job import Fixture, Place
from fleet.physics.models import build_cell, payload_bodies, set_payload_balls
from fleet.robot import JOINTS, Robot, ThermalLimits

Array = np.ndarray

MOTOR_M, HOT_MOTOR_M = 0.052, 0.074
"""Radius of the sphere of a cool motor and of one at the error limit: a hotter motor is also larger."""


def motor_radius_m(temp_c: Array, error_c: float) -> Array:
    """Radius of the sphere of a motor at a temperature in °C, m."""
    heat = np.clip((temp_c - 20.0) / (error_c - 20.0), 0.0, 1.0)
    return MOTOR_M + heat * (HOT_MOTOR_M - MOTOR_M)


class CellPlayer:
    """The model of a cell, `model`, and its state, `data`.

    Args:
        meshes: Kinova's shells instead of primitives, see `fleet.physics.models.build_cell`.

    Raises:
        FleetError: the meshes are not available.
    """

    def __init__(
        self,
        robots: Sequence[Robot],
        places: Sequence[Place] = (),
        fixtures: Sequence[Fixture] = (),
        *,
        limits: ThermalLimits,
        meshes: bool = False,
    ) -> None:
        self.model = build_cell(robots, places, fixtures, meshes=meshes)
        self.data = mujoco.MjData(self.model)
        self._limits, self._payloads = limits, payload_bodies(self.model, robots)
        sites = [f"{robot.name}/motor_{joint + 1}" for robot in robots for joint in range(JOINTS)]
        self._motors = np.array([self.model.site(name).id for name in sites])
        self.model.site_group[self._motors] = 0

    def show(self, q: Array, temp_c: Array, payload_kg: Array) -> None:
        """Take postures [arm, joint] in rad, temperatures [arm, joint] in °C and payloads [arm] in kg."""
        self.data.qpos[:] = q.ravel()
        warning_c, error_c = self._limits.warning_c, self._limits.error_c
        self.model.site_rgba[self._motors, :3] = heat_colour(temp_c.ravel(), warning_c, error_c)
        self.model.site_size[self._motors, 0] = motor_radius_m(temp_c.ravel(), error_c)
        set_payload_balls(self.model, self._payloads, payload_kg)
        mujoco.mj_forward(self.model, self.data)
