"""Motor law: current from joint torque and speed, and heat from current.

Equations: i = (tau/eta + tau_f) / (N·Kt·(1 + a_kt (Th − 25))), tau_f = tau_c·tanh(qd/v0) + b·qd,
copper loss K_cu (1 + a_cu (Tw − 25)) i², friction heat tau_f·qd. Numbers: `fleet/data/gen3_thermal.json`.
"""

import json
from dataclasses import dataclass, fields, replace
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from fleet.jit import jit_inline

Array = np.ndarray
Numbers = Any
"""An array or one number, which numba compiles alike."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Motors:
    """Parameters of the seven joint motors; arrays [..., joint] with leading axes for several arms."""

    torque_per_amp: Array
    """N·Kt at the reference temperature, N·m/A at the joint."""
    eta: Array
    """Gear efficiency."""
    coulomb_nm: Array
    viscous_nms_per_rad: Array
    copper_w_per_a2: Array
    """Copper loss per squared current at the reference temperature."""
    idle_w: Array
    """Heat of the powered drive at rest, emitted into the housing."""
    current_max_a: Array
    sensor_noise_k: Array
    """Standard deviation of a motor temperature reading."""
    alpha_cu_per_k: float
    alpha_kt_per_k: float
    reference_c: float
    v0_rad_s: float
    """Speed scale of the onset of Coulomb friction."""

    def __post_init__(self) -> None:
        for name in ("torque_per_amp", "eta", "copper_w_per_a2", "current_max_a", "v0_rad_s"):
            if not np.all(np.greater(getattr(self, name), 0)):
                raise ValueError(f"Motors.{name} must be > 0 (got {getattr(self, name)}).")
        for name in ("coulomb_nm", "viscous_nms_per_rad", "idle_w", "sensor_noise_k"):
            if not np.all(np.greater_equal(getattr(self, name), 0)):
                raise ValueError(f"Motors.{name} must be >= 0 (got {getattr(self, name)}).")


@cache
def thermal_data() -> dict[str, Any]:  # Any: values of parsed JSON
    """Identified Gen3 parameters, with their source, from the data file of this package."""
    text = resources.files("fleet").joinpath("data/gen3_thermal.json").read_text(encoding="utf-8")
    return json.loads(text)


def gen3_motors(*, wear: float = 0.0) -> Motors:
    """Motors of a nominal Gen3 with joint friction increased by the share `wear`."""
    data = thermal_data()
    values = {name: np.array(value, dtype=float) if isinstance(value, list) else value for name, value in data.items()}
    nominal: dict[str, Any] = {field.name: values[field.name] for field in fields(Motors) if field.name in values}
    for name in ("coulomb_nm", "viscous_nms_per_rad"):
        nominal[name] = nominal[name] * (1.0 + wear)
    return Motors(torque_per_amp=values["gear_ratio"] * values["kt_nm_per_a"], **nominal)


def stack_motors(motors: list[Motors]) -> Motors:
    """Motors of several arms as one value, arrays [arm, joint].

    Raises:
        ValueError: no motors, or scalar constants that differ between arms.
    """
    if not motors:
        raise ValueError("stack_motors needs the motors of at least one arm.")
    arrays = {}
    for name in (f.name for f in fields(Motors)):
        values = [getattr(m, name) for m in motors]
        if isinstance(values[0], np.ndarray):
            arrays[name] = np.stack(values)
        elif any(value != values[0] for value in values):
            raise ValueError(f"Motors.{name} must be equal for all stacked arms (got {values}).")
    return replace(motors[0], **arrays)


def friction_torque(qd: Array, motors: Motors) -> Array:
    """Friction torque at joint speed `qd` rad/s, N·m, [..., joint]."""
    return motors.coulomb_nm * np.tanh(qd / motors.v0_rad_s) + motors.viscous_nms_per_rad * qd


def friction_heat(qd: Array, motors: Motors) -> Array:
    """Friction power at joint speed `qd` rad/s, W, [..., joint], >= 0."""
    return friction_torque(qd, motors) * qd


def reference_current(tau: Array, qd: Array, motors: Motors) -> Array:
    """Motor current with the magnets at the reference temperature, A, [..., joint].

    Divide by `magnet_factor` for other temperatures; so the heat of a planned motion is computed once.
    """
    return (tau / motors.eta + friction_torque(qd, motors)) / motors.torque_per_amp


@jit_inline
def magnet_factor(housing_c: Numbers, motors: Any) -> Numbers:  # motors: see below
    """Torque constant at a housing temperature over that at the reference temperature, same shape.

    Args:
        housing_c: °C, an array or one number.
        motors: `Motors`, or the engine's tables of them.
    """
    return 1.0 + motors.alpha_kt_per_k * (housing_c - motors.reference_c)


def current(tau: Array, qd: Array, housing_c: Array, motors: Motors) -> Array:
    """Motor current, A, [..., joint], for joint torque `tau` N·m, speed `qd` rad/s, housing temperature °C."""
    return reference_current(tau, qd, motors) / magnet_factor(housing_c, motors)


@jit_inline
def winding_heat(copper_w_per_a2: Numbers, current_sq: Numbers, winding_c: Numbers, motors: Any) -> Numbers:
    """Heat in the winding, W: K_cu (1 + a_cu (Tw − 25)) i², elementwise over arrays or single numbers.

    Args:
        copper_w_per_a2: K_cu, W/A².
        current_sq: (Mean) squared motor current i², A².
        winding_c: Winding temperature Tw, °C.
        motors: `Motors`, or the engine's tables of them.
    """
    return copper_w_per_a2 * (1.0 + motors.alpha_cu_per_k * (winding_c - motors.reference_c)) * current_sq


def copper_loss(current_sq: Array, winding_c: Array, motors: Motors) -> Array:
    """Heat in the windings of an arm, W, [..., joint]; see `winding_heat`."""
    return winding_heat(motors.copper_w_per_a2, current_sq, winding_c, motors)
