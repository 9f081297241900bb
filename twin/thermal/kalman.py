"""Housing temperatures, which have no sensor, from an arm's recent log: a Kalman filter on its thermal network."""

from dataclasses import replace

import numpy as np

from fleet.robot import JOINTS
from fleet.thermal import NODES, WINDING, drive_heat
from twin.logs.heat_log import HeatLog
from twin.thermal.thermal_twin import RcTwin

Array = np.ndarray

HOUSING_SD_K = 5.0
"""Standard deviation of a housing from its winding at the start."""
SENSOR_SD_K = 0.05
"""Noise and slow drift of the motor temperature; larger than the noise at rest, which no model follows."""
HEAT_NOISE_W2S = 10.0
"""Intensity of unmodelled heat, W²·s, at every node: half a watt that lasts 20 s, three watts for one."""


def filter_log(twin: RcTwin, log: HeatLog) -> Array:
    """Temperatures of all nodes at the edges of a log's steps, each from the past alone, °C, [step + 1, node].

    Housings start as warm as their windings.
    """
    temp = twin.likely_start(log.temp_c[0])
    spread = np.diag(np.append(np.full(JOINTS, SENSOR_SD_K**2), np.full(JOINTS, HOUSING_SD_K**2)))
    temps = [temp]
    lengths, which = np.unique(np.round(log.dt_s, 2), return_inverse=True)
    steps = [twin.thermal.step_matrices(dt) for dt in lengths]
    # A recorded current does not depend on the magnets.
    motors = twin.motors if log.source == "torque" else replace(twin.motors, alpha_kt_per_k=0.0)
    square = log.current_sq(motors.coulomb_nm, motors.viscous_nms_per_rad)
    friction = log.friction_w(motors.coulomb_nm, motors.viscous_nms_per_rad)
    for k, length in enumerate(which):
        phi, gamma = steps[length]
        heat_w = drive_heat(temp, square[k], friction[k], motors)
        temp = phi @ temp + gamma @ (heat_w + twin.thermal.to_ambient * twin.ambient_c)
        # White heat noise over dt is like an independent constant heat of variance intensity/dt in each step.
        spread = phi @ spread @ phi.T + gamma @ gamma.T * (HEAT_NOISE_W2S / log.dt_s[k])
        temp, spread = _correct(temp, spread, log.temp_c[k + 1])
        temps.append(temp)
    return np.array(temps)


def _correct(temp: Array, spread: Array, measured_c: Array) -> tuple[Array, Array]:
    """State and covariance after a reading of all windings (Joseph's form keeps the covariance symmetric)."""
    of_reading = spread[WINDING, WINDING] + np.eye(JOINTS) * SENSOR_SD_K**2
    gain = np.linalg.solve(of_reading, spread[WINDING]).T  # [node, joint]
    rest = np.eye(NODES)
    rest[:, WINDING] -= gain
    return temp + gain @ (measured_c - temp[WINDING]), rest @ spread @ rest.T + gain @ gain.T * SENSOR_SD_K**2
