"""A Kinova Gen3 arm as the fleet sees it: its limits, its mount, its own body and its own heat."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from fleet.errors import nearest

JOINTS = 7
"""Joints of a Gen3; the last axis of every joint array."""

POSTURES: dict[str, tuple[float, ...]] = {
    "home": (0.0, 0.26179939, 3.14159265, -2.26892803, 0.0, 0.95993109, 1.57079633),
    "retract": (0.0, -0.34906585, 3.14159265, -2.54818071, 0.0, -0.87266463, 1.57079633),
    "vertical": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "outstretched": (0.0, 1.57079633, 0.0, 0.0, 0.0, 0.0, 0.0),
    "raised": (0.0, 1.04719755, 0.0, 1.04719755, 0.0, 0.0, 0.0),
}
"""Named joint positions, rad. home, retract and vertical are Kinova's keyframes."""

Cooling = Literal["still_air", "forced_air", "liquid", "immersion", "vacuum"]


@dataclass(frozen=True, kw_only=True)
class JointLimits:
    """What a Gen3 joint may do; position ranges live in `gen3.xml`. Each a tuple of 7.

    Source: Kinova Gen3 MoveIt configuration (hard velocity), control acceleration limits, user guide
    p. 85 (safety torque warning); clip is 95 % of maximum current times N·Kt.
    """

    velocity: tuple[float, ...] = (1.33,) * 4 + (1.16,) * 3
    """rad/s."""
    acceleration: tuple[float, ...] = (4.94,) * 4 + (9.5,) * 3
    """rad/s²."""
    jerk: tuple[float, ...] = (50.0,) * 4 + (95.0,) * 3
    """rad/s³. Kinova publishes none: the acceleration is reached in a tenth of a second."""
    torque_warning: tuple[float, ...] = (56.7,) * 4 + (29.4,) * 3
    """N·m."""
    torque_clip: tuple[float, ...] = (104.0,) * 4 + (43.0,) * 3
    """N·m."""


GEN3 = JointLimits()


@dataclass(frozen=True, kw_only=True)
class ThermalLimits:
    """At which motor temperature an arm warns, faults and may start again.

    Source: Kinova Gen3 user guide, safety thresholds of the motor temperature.
    """

    warning_c: float = 60.0
    error_c: float = 75.0
    restart_c: float = 50.0
    """Every motor must be below this before a fault may be cleared."""
    clear_s: float = 60.0
    """Time somebody needs to clear the fault once the arm is cool."""
    power_off_on_fault: bool = True
    """Drives off while faulted: no idle heat, so the arm cools towards the room."""

    def __post_init__(self) -> None:
        if not self.restart_c < self.warning_c < self.error_c:
            raise ValueError(
                "ThermalLimits need restart_c < warning_c < error_c "
                f"(got {self.restart_c}, {self.warning_c}, {self.error_c})."
            )
        if self.clear_s < 0:
            raise ValueError(f"ThermalLimits.clear_s must be >= 0 (got {self.clear_s}).")


def rotation(roll_pitch_yaw_deg: tuple[float, float, float]) -> np.ndarray:
    """Body frame to world, [3, 3], for angles about the fixed world axes x, y, z in this order, deg."""
    roll, pitch, yaw = np.deg2rad(roll_pitch_yaw_deg)
    cr, sr, cp, sp, cy, sy = (
        np.cos(roll),
        np.sin(roll),
        np.cos(pitch),
        np.sin(pitch),
        np.cos(yaw),
        np.sin(yaw),
    )
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def angles_deg(turned: np.ndarray) -> tuple[float, float, float]:
    """Roll, pitch, yaw of a rotation [3, 3], deg: the inverse of `rotation`. With the pitch at ±90°, yaw is 0."""
    pitch = np.arctan2(-turned[2, 0], np.hypot(turned[0, 0], turned[1, 0]))
    if abs(np.cos(pitch)) < 1e-6:
        roll, yaw = np.arctan2(-turned[1, 2], turned[1, 1]), 0.0
    else:
        roll, yaw = np.arctan2(turned[2, 1], turned[2, 2]), np.arctan2(turned[1, 0], turned[0, 0])
    return float(np.rad2deg(roll)), float(np.rad2deg(pitch)), float(np.rad2deg(yaw))


@dataclass(frozen=True, kw_only=True)
class Mount:
    """Where an arm's base stands in the cell, and how it is turned."""

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Base frame in the world, m."""
    tilt_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw about the fixed world axes x, y, z, deg. (0,0,0) floor, (180,0,0) ceiling, (0,90,0) wall."""

    def rotation(self) -> np.ndarray:
        """Base frame to world, [3, 3]."""
        return rotation(self.tilt_deg)


@dataclass(frozen=True, kw_only=True)
class Robot:
    """One arm: name, place, rest posture, and what makes its heat its own."""

    name: str
    mount: Mount = field(default_factory=Mount)
    home: str = "home"
    """Posture, by name, in which it waits and between which all its jobs begin and end."""
    tool_kg: float = 0.0
    """Mass of the gripper, at the flange."""
    cooling: Cooling = "still_air"
    cooling_factor: float = 1.0
    """Scales the conductance from housings to ambient; 0.7 is a dusty, badly placed arm."""
    ambient_offset_k: float = 0.0
    """Air at this arm over the air of the cell."""
    wear: float = 0.0
    """Share by which joint friction has grown (harmonic drives wear into friction)."""

    def __post_init__(self) -> None:
        if not self.name or any(c in self.name for c in "/*$?#@ "):
            raise ValueError(f"Robot.name must be non-empty, without any of / * $ ? # @ or space (got '{self.name}').")
        if self.home not in POSTURES:
            raise ValueError(f"Robot.home '{self.home}' is no posture{nearest(self.home, POSTURES)}")
        if self.tool_kg < 0:
            raise ValueError(f"Robot.tool_kg must be >= 0 (got {self.tool_kg}).")
        if self.cooling_factor <= 0:
            raise ValueError(f"Robot.cooling_factor must be > 0 (got {self.cooling_factor}).")
        if self.wear < 0:
            raise ValueError(f"Robot.wear must be >= 0 (got {self.wear}).")

    def home_q(self) -> np.ndarray:
        """Joint positions at rest, rad, [joint]."""
        return np.array(POSTURES[self.home])
