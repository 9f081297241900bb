"""A Kinova Gen3 arm of the fleet: limits, mount, postures and individual properties."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from fleet.errors import check_nonnegative, check_positive, nearest

JOINTS = 7
"""Number of joints of a Gen3; length of the last axis of every joint array."""

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
    """Limits of the Gen3 joints, 7 values each; position ranges are in `gen3.xml`.

    Source: Kinova Gen3 MoveIt configuration (hard velocity), control acceleration limits, user guide
    p. 85 (safety torque warning); the clip is 95 % of the maximum current times N·Kt.
    """

    velocity: tuple[float, ...] = (1.33,) * 4 + (1.16,) * 3
    """rad/s."""
    acceleration: tuple[float, ...] = (4.94,) * 4 + (9.5,) * 3
    """rad/s²."""
    jerk: tuple[float, ...] = (50.0,) * 4 + (95.0,) * 3
    """rad/s³. Kinova publishes none; with this the acceleration is reached in a tenth of a second."""
    torque_warning: tuple[float, ...] = (56.7,) * 4 + (29.4,) * 3
    """N·m."""
    torque_clip: tuple[float, ...] = (104.0,) * 4 + (43.0,) * 3
    """N·m."""


GEN3 = JointLimits()


@dataclass(frozen=True, kw_only=True)
class ThermalLimits:
    """Motor temperatures at which an arm warns, faults and may restart.

    Source: Kinova Gen3 user guide, safety thresholds of the motor temperature.
    """

    warning_c: float = 60.0
    error_c: float = 75.0
    restart_c: float = 50.0
    """A fault may be cleared once every motor is below this."""
    clear_s: float = 60.0
    """Time to clear the fault once the arm is cool."""
    move_home_s: float = 900.0
    """Time after a fault in which a person moves the arm home, if it has not gone there before."""
    power_off_on_fault: bool = True
    """Switch the drives off while faulted: no idle heat, so the arm cools to ambient temperature."""

    def __post_init__(self) -> None:
        if not self.restart_c < self.warning_c < self.error_c:
            raise ValueError(
                "ThermalLimits need restart_c < warning_c < error_c "
                f"(got {self.restart_c}, {self.warning_c}, {self.error_c})."
            )
        check_nonnegative(self, "clear_s", "move_home_s")


def rotation(roll_pitch_yaw_deg: tuple[float, float, float]) -> np.ndarray:
    """Rotation from body frame to world, [3, 3], for angles about the fixed world axes x, y, z in this order, deg."""
    angles = np.deg2rad(roll_pitch_yaw_deg)
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def angles_deg(turned: np.ndarray) -> tuple[float, float, float]:
    """Roll, pitch, yaw of a rotation [3, 3], deg: the inverse of `rotation`. At a pitch of ±90° yaw is 0."""
    pitch = np.arctan2(-turned[2, 0], np.hypot(turned[0, 0], turned[1, 0]))
    if abs(np.cos(pitch)) < 1e-6:
        roll, yaw = np.arctan2(-turned[1, 2], turned[1, 1]), 0.0
    else:
        roll, yaw = np.arctan2(turned[2, 1], turned[2, 2]), np.arctan2(turned[1, 0], turned[0, 0])
    return float(np.rad2deg(roll)), float(np.rad2deg(pitch)), float(np.rad2deg(yaw))


@dataclass(frozen=True, kw_only=True)
class Mount:
    """Position and orientation of an arm's base in the cell."""

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin of the base frame in the world, m."""
    tilt_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw about the fixed world axes x, y, z, deg. (0,0,0) floor, (180,0,0) ceiling, (0,90,0) wall."""

    def rotation(self) -> np.ndarray:
        """Rotation from base frame to world, [3, 3]."""
        return rotation(self.tilt_deg)


@dataclass(frozen=True, kw_only=True)
class Robot:
    """One arm: name, mount, home posture and its individual thermal properties."""

    name: str
    mount: Mount = field(default_factory=Mount)
    home: str = "home"
    """Name of the posture in which it waits and in which all its jobs start and end."""
    tool_kg: float = 0.0
    """Mass of the gripper at the flange."""
    cooling: Cooling = "still_air"
    cooling_factor: float = 1.0
    """Scales the conductance from housings to ambient; for example 0.7 for a dusty, badly ventilated arm."""
    ambient_offset_k: float = 0.0
    """Ambient temperature at this arm minus that of the cell."""
    wear: float = 0.0
    """Share by which joint friction has increased (worn harmonic drives have more friction)."""

    def __post_init__(self) -> None:
        if not self.name or any(c in self.name for c in "/*$?#@ "):
            raise ValueError(f"Robot.name must be non-empty, without any of / * $ ? # @ or space (got '{self.name}').")
        if self.home not in POSTURES:
            raise ValueError(f"Robot.home '{self.home}' is no posture{nearest(self.home, POSTURES)}")
        check_nonnegative(self, "tool_kg", "wear")
        check_positive(self, "cooling_factor")

    def home_q(self) -> np.ndarray:
        """Joint positions at home, rad, [joint]."""
        return np.array(POSTURES[self.home])
