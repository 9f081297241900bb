"""Hidden housing temperatures from an arm's recent log: a Kalman filter through the exact step of its network."""

from dataclasses import dataclass

import numpy as np

from fleet.motor import copper_loss, magnet_factor
from fleet.robot import JOINTS
from fleet.thermal import HOUSING, NODES, WINDING, node_heat
from twin.heat_log import STEP_S, HeatLog, Source, heat_logs
from twin.rc import RcTwin
from twin.recording import Recording

Array = np.ndarray

HOUSING_SD_K = 5.0
"""How far a housing may be from its winding before anything is known."""
SENSOR_SD_K = 0.05
"""Noise and slow wander of the motor temperature; larger than the noise at rest, which no model follows."""
HEAT_NOISE_W2S = 10.0
"""Intensity of heat that no law explains, W²·s, at every node: half a watt that lasts 20 s, three watts for one."""


@dataclass(frozen=True, eq=False)
class Observed:
    """What a log tells of all nodes, each moment from the past of the log alone."""

    time_s: Array
    """[time]."""
    temp_c: Array
    """[time, node]."""
    sd_k: Array
    """[time, node]."""

    def at(self, time_s: float) -> Array:
        """The state known at a moment: the last one at or before it, °C, [node].

        Raises:
            ValueError: the log had not begun.
        """
        row = int(np.searchsorted(self.time_s, time_s, side="right")) - 1
        if row < 0:
            raise ValueError(f"The log begins at {self.time_s[0]:g} s, after {time_s:g} s.")
        return self.temp_c[row]


def observe(twin: RcTwin, recording: Recording, *, source: Source = "current", step_s: float = STEP_S) -> Observed:
    """Temperatures of all nodes during a recording, filtered step by step.

    Begins anew after each gap, from housings as warm as their windings.

    Raises:
        ValueError: a recording without temperatures, without currents where they are the source, or too short.
    """
    parts = [filtered(twin, log) for log in heat_logs(recording, twin.motors, source, step_s=step_s)]
    if not parts:
        raise ValueError(f"Recording '{recording.name}' is too short to observe: it needs three steps of {step_s:g} s.")
    return Observed(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("time_s", "temp_c", "sd_k")))


def filtered(twin: RcTwin, log: HeatLog) -> Observed:
    """Temperatures of all nodes at the edges of one stretch's steps."""
    temp = twin.likely_start(log.temp_c[0])
    spread = np.diag(np.append(np.full(JOINTS, SENSOR_SD_K**2), np.full(JOINTS, HOUSING_SD_K**2)))
    temps, variances = [temp], [np.diag(spread)]
    lengths, which = np.unique(np.round(log.dt_s, 2), return_inverse=True)
    steps = [twin.thermal.step_matrices(dt) for dt in lengths]
    square = log.current_sq(twin.motors.coulomb_nm, twin.motors.viscous_nms_per_rad)
    friction = log.friction_w(twin.motors.coulomb_nm, twin.motors.viscous_nms_per_rad)
    for k, kind in enumerate(which):
        phi, gamma = steps[kind]
        at_magnets = magnet_factor(temp[HOUSING], twin.motors) ** 2 if log.source == "torque" else 1.0
        heat_w = node_heat(
            copper_loss(square[k] / at_magnets, temp[WINDING], twin.motors), twin.motors.idle_w + friction[k]
        )
        temp = phi @ temp + gamma @ (heat_w + twin.thermal.to_ambient * twin.ambient_c)
        # White heat noise over dt is like an independent constant heat of variance intensity/dt in each step.
        spread = phi @ spread @ phi.T + gamma @ gamma.T * (HEAT_NOISE_W2S / log.dt_s[k])
        temp, spread = _corrected(temp, spread, log.temp_c[k + 1])
        temps.append(temp)
        variances.append(np.diag(spread))
    return Observed(log.time_s, np.array(temps), np.sqrt(np.array(variances)))


def _corrected(temp: Array, spread: Array, measured_c: Array) -> tuple[Array, Array]:
    """State and covariance after a reading of all windings (Joseph's form keeps the covariance symmetric)."""
    of_reading = spread[WINDING, WINDING] + np.eye(JOINTS) * SENSOR_SD_K**2
    gain = np.linalg.solve(of_reading, spread[WINDING]).T  # [node, joint]
    rest = np.eye(NODES)
    rest[:, WINDING] -= gain
    return temp + gain @ (measured_c - temp[WINDING]), rest @ spread @ rest.T + gain @ gain.T * SENSOR_SD_K**2
