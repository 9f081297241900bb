"""Temperature limits of a Gen3's actuators, and a bound for the core, which has no model.

The core is the microcontroller of an actuator. Its heat P_c is part of the idle heat, and it sits in the housing, so it
settles R_c P_c above the housing. Neither number is published, and no log has its temperature, so it cannot be
identified. `core_allowance_k_per_w` says how large R_c must be for the core to matter before the motor does.
"""

from typing import NamedTuple

from fleet.motor import thermal_data
from fleet.robot import ThermalLimits


class Bounds(NamedTuple):
    """Thresholds of one temperature, °C."""

    lower_c: float
    warning_c: float
    error_c: float
    upper_c: float


MOTOR = Bounds(ThermalLimits.lower_c, ThermalLimits.warning_c, ThermalLimits.error_c, 80.0)
CORE = Bounds(0.0, 80.0, 90.0, 100.0)
"""Kinova Gen3 user guide, actuator safety items."""


def core_allowance_k_per_w(joint: int, ambient_c: float, limits: ThermalLimits | None = None) -> float:
    """Least thermal resistance from core to housing with which the core warns before the motor reaches its error limit.

    The worst case for the core: a joint without neighbours whose motor settles exactly at the error limit, so that its
    housing is as warm as it can be, and a core that makes all of the idle heat.

    Args:
        joint: 0..6.
        limits: Default: those of a Gen3.

    Returns:
        K/W; a smaller resistance lets the motor stop the arm first.
    """
    data, limits = thermal_data(), limits or ThermalLimits()
    outer, inner = data["housing_ambient_k_per_w"][joint], data["winding_housing_k_per_w"][joint]
    idle_w = data["idle_w"][joint]
    copper_w = max(0.0, (limits.error_c - ambient_c - outer * idle_w) / (outer + inner))
    housing_c = ambient_c + outer * (copper_w + idle_w)
    return (CORE.warning_c - housing_c) / idle_w
