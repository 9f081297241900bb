"""Postures as a person writes them: a name, or seven angles in degrees."""

import numpy as np

from fleet.errors import FleetError, nearest
from fleet.robot import JOINTS, POSTURES

Array = np.ndarray


class PostureError(FleetError):
    """A posture that cannot be read, or that is beyond a joint stop; says what is allowed."""


def parse_posture(text: str, position_range: Array | None = None) -> Array:
    """Joint positions, rad, [joint], of a posture's name or of seven comma-separated angles in degrees.

    Args:
        position_range: Lowest and highest joint position, rad, [joint, 2]; not checked if not given.

    Raises:
        PostureError: unknown name, not seven numbers, or a joint beyond its stop.
    """
    if text in POSTURES:
        return np.array(POSTURES[text])
    try:
        degrees = np.array([float(part) for part in text.split(",")])
    except ValueError:
        hint = nearest(text, POSTURES).removesuffix(".")
        raise PostureError(f"No posture '{text}'{hint}, or {JOINTS} comma-separated angles in degrees.") from None
    if degrees.shape != (JOINTS,) or not np.all(np.isfinite(degrees)):
        raise PostureError(f"A posture is a name or {JOINTS} comma-separated angles in degrees (got '{text}').")
    if position_range is not None:
        low, high = np.rad2deg(position_range).T
        for j in np.flatnonzero((degrees < low) | (degrees > high)):
            raise PostureError(f"Joint {j + 1} turns from {low[j]:.1f} to {high[j]:.1f} degrees (got {degrees[j]:g}).")
    return np.deg2rad(degrees)
