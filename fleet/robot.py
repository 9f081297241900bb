"""A Kinova Gen3 arm of the fleet: limits, mount, postures and individual properties."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from fleet.errors import check_between, check_coordinates, check_nonnegative, nearest

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

Cooling = Literal["still_air", "heat_sink", "heat_spreader", "forced_air", "liquid", "immersion", "vacuum"]


@dataclass(frozen=True, kw_only=True)
class CoolingStrategy:
    """Change of the thermal network of every joint by a cooling strategy, relative to still air."""

    ambient_factor: float = 1.0
    """Factor on the conductance from housing to ambient."""
    capacity_factor: float = 1.0
    """Factor on the heat capacity of the housing."""
    neighbour_w_per_k: float = 0.0
    """Conductance added between the housings of neighbouring joints."""
    winding_ratio: float = 0.0
    """Whole conductance from winding to ambient as a multiple of that with `liquid`, where the medium reaches the
    winding; 0: it does not, and all heat passes the housing."""


COOLING: dict[Cooling, CoolingStrategy] = {
    "still_air": CoolingStrategy(),
    "heat_sink": CoolingStrategy(ambient_factor=1.8, capacity_factor=1.35),
    "heat_spreader": CoolingStrategy(neighbour_w_per_k=0.2, capacity_factor=1.1),
    "forced_air": CoolingStrategy(ambient_factor=2.5),
    "liquid": CoolingStrategy(ambient_factor=6.0),
    "immersion": CoolingStrategy(ambient_factor=6.0, winding_ratio=3.7),
    "vacuum": CoolingStrategy(ambient_factor=0.5),
}
"""The cooling strategies. Engineering values, not measured on a Gen3; docs/concepts/cooling.md has their sources.

Still air at the surface of a link carries about 5 W/m²K by convection and 5.5 by radiation (4·ε·σ·T³, ε ≈ 0.9, T ≈ 305
K), so vacuum keeps about half. A heat sink of finned aluminium, 0.3 kg at a large joint, triples the surface for
convection at 90 % fin efficiency and leaves radiation. A heat spreader is a copper strip of 1 mm × 100 mm over 0.2 m
from each housing to the next. Forced air and liquid are the lower ends of the film coefficients in Incropera & DeWitt,
table 1.1, limited by conduction through the shell; their ratio fits the motor of Zhu et al.
(`benchmarks/paper/cooling.py`). Immersion is that motor's: the liquid reaches the winding, and the whole conductance is
3.7 times that with liquid.
"""


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
class PayloadRating:
    """Mass that a Gen3 may carry at its flange, gripper included, by reach and by time.

    Reach is the distance from joint 2 to the tool point. The continuous rating falls linearly from mid-range to full
    reach. A load that the arm can put down again in time has the temporary rating at any reach.

    Source: Kinova Gen3 user guide, p. 16 (the three masses) and p. 56 (less with reach and with time, less the
    gripper). It gives neither the mid-range nor the time: here half the reach, and the time within which the temporary
    mass at full reach heats joint 2 of an idle-warm nominal arm at 25 °C at most to the warning limit (130 s).
    """

    mid_range_m: float = 0.451
    full_reach_m: float = 0.902
    mid_range_kg: float = 4.0
    full_reach_kg: float = 1.1
    temporary_kg: float = 4.5
    temporary_s: float = 120.0

    def allowed_kg(self, reach_m: float, carried_s: float) -> float:
        """Largest mass at a reach, carried for a time without putting it down, kg."""
        if carried_s <= self.temporary_s:
            return self.temporary_kg
        ends_m, ends_kg = (self.mid_range_m, self.full_reach_m), (self.mid_range_kg, self.full_reach_kg)
        return float(np.interp(reach_m, ends_m, ends_kg))


RATING = PayloadRating()


LONGEST_S = 7 * 24 * 3600.0
"""Largest `move_home_s` and `clear_s`."""
LEAST_LIMIT_C, MOST_LIMIT_C = -60.0, 1000.0
MOST_OFFSET_K = 50.0
LEAST_COOLING, MOST_COOLING = 0.01, 100.0
MOST_WEAR = 10.0


@dataclass(frozen=True, kw_only=True)
class ThermalLimits:
    """Motor temperatures at which an arm warns, faults and may restart.

    Source: Kinova Gen3 user guide, safety thresholds of the motor temperature.
    """

    lower_c: float = 0.0
    """Lowest motor temperature at the start of a shift."""
    warning_c: float = 60.0
    error_c: float = 75.0
    restart_c: float = 50.0
    """A fault can be cleared when every motor is below this."""
    clear_s: float = 60.0
    """Time to clear the fault once the arm is cool."""
    move_home_s: float = 900.0
    """Time after a fault in which a person moves the arm home, if it has not gone there before."""
    power_off_on_fault: bool = True
    """Switch the drives off while faulted: no idle heat, so the arm cools to ambient temperature."""

    def __post_init__(self) -> None:
        if not self.lower_c < self.restart_c < self.warning_c < self.error_c:
            raise ValueError(
                "ThermalLimits need lower_c < restart_c < warning_c < error_c "
                f"(got {self.lower_c}, {self.restart_c}, {self.warning_c}, {self.error_c})."
            )
        check_between(self, LEAST_LIMIT_C, MOST_LIMIT_C, "lower_c", "error_c")
        check_between(self, 0.0, LONGEST_S, "clear_s", "move_home_s")


def rotation(roll_pitch_yaw_deg: tuple[float, float, float]) -> np.ndarray:
    """Rotation from body frame to world, [3, 3], for angles about the fixed world axes x, y, z in this order, deg."""
    angles = np.deg2rad(roll_pitch_yaw_deg)
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def half_turn(angle: np.ndarray) -> np.ndarray:
    """Angles within half a turn of zero, rad."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


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

    def __post_init__(self) -> None:
        check_coordinates(self, "position_m")
        check_between(self, -360.0, 360.0, "tilt_deg")

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
    """Mass of the gripper at the flange; it counts against the payload rating."""
    payload_limit_kg: float | None = None
    """Payload limit of this arm at any reach; None: the rating of the Gen3 only."""
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
        check_nonnegative(self, "tool_kg")
        check_between(self, 0.0, MOST_WEAR, "wear")
        check_between(self, LEAST_COOLING, MOST_COOLING, "cooling_factor")
        check_between(self, -MOST_OFFSET_K, MOST_OFFSET_K, "ambient_offset_k")
        if self.tool_kg > RATING.temporary_kg:
            raise ValueError(
                f"Robot.tool_kg must be at most {RATING.temporary_kg:g}, the rating of the Gen3 (got {self.tool_kg})."
            )
        if self.payload_limit_kg is not None:
            check_nonnegative(self, "payload_limit_kg")

    def overload(self, payload_kg: float, reach_m: float, carried_s: float) -> str:
        """Reason against carrying a payload at a reach for a time; "" if it is allowed. No payload is never an
        overload."""
        limit_kg = self.payload_limit_kg
        if limit_kg is not None and payload_kg > limit_kg:
            return f"{payload_kg:g} kg is beyond this arm's limit of {limit_kg:g} kg"
        rated_kg = max(0.0, RATING.allowed_kg(reach_m, carried_s) - self.tool_kg)
        if not payload_kg or payload_kg <= rated_kg:
            return ""
        tool = f" beside a tool of {self.tool_kg:g} kg" if self.tool_kg else ""
        reason = f"{payload_kg:g} kg at {reach_m:.2f} m reach is beyond the rating of {rated_kg:.1f} kg{tool}"
        if carried_s <= RATING.temporary_s:
            return reason
        return f"{reason} for a load that is carried for more than {RATING.temporary_s:g} s at a time"

    def home_q(self) -> np.ndarray:
        """Joint positions at home, rad, [joint]."""
        return np.array(POSTURES[self.home])
