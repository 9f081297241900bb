"""A task in the frame of its arm: arms of one kind that stand alike before their places share plans.

Gravity and the floor are the same wherever an arm stands and whichever way it faces, so a plan depends on where places
and fixtures are relative to the base alone.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fleet.job import Fixture, Work
from fleet.robot import Mount, Robot

Triple = tuple[float, float, float]

ARM = "arm"
"""Name of every arm in its own frame."""
DIGITS = 9
"""Decimal places of positions, m, and angles, deg: a nanometre and less, so that rounding errors of the arms' own
positions make no difference."""


class OwnFrame:
    """The frame on the floor below an arm's base, turned with the base about the vertical."""

    def __init__(self, mount: Mount) -> None:
        self._origin = np.array([*mount.position_m[:2], 0.0])
        self._turn_deg = mount.tilt_deg[2]
        turn = np.deg2rad(self._turn_deg)
        self._turn = np.array([[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])

    def robot(self, robot: Robot) -> Robot:
        """The arm itself, without its name."""
        mount = Mount(position_m=self._position(robot.mount.position_m), tilt_deg=self._angles(robot.mount.tilt_deg))
        return replace(robot, name=ARM, mount=mount)

    def fixtures(self, fixtures: Sequence[Fixture]) -> tuple[Fixture, ...]:
        """The same boxes, with their names, which errors report."""
        return tuple(
            replace(each, position_m=self._position(each.position_m), tilt_deg=self._angles(each.tilt_deg))
            for each in fixtures
        )

    def work(self, work: Work) -> Work:
        """The work at the same places, whose names are their numbers from 0."""
        places = (
            replace(
                place, name=str(i), position_m=self._position(place.position_m), tool_deg=self._angles(place.tool_deg)
            )
            for i, place in enumerate(work.places)
        )
        return replace(work, places=tuple(places))

    def _position(self, position_m: Triple) -> Triple:
        x, y, z = (self._turn @ (position_m - self._origin)).tolist()
        return _rounded(x), _rounded(y), _rounded(z)

    def _angles(self, angles_deg: Triple) -> Triple:
        """Roll, pitch, yaw; the last is about the vertical, from −180 to 180."""
        roll, pitch, yaw = angles_deg
        return _rounded(roll), _rounded(pitch), _rounded((yaw - self._turn_deg + 180.0) % 360.0 - 180.0)


def _rounded(value: float) -> float:
    return round(value, DIGITS) + 0.0  # without the sign of zero
