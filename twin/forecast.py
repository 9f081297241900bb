"""How hot the motors will get in the next minutes, from every moment of a log at once."""

import numpy as np

from fleet.thermal import WINDING, advance, drive_heat
from twin.heat_log import HeatLog
from twin.rc import RcTwin

Array = np.ndarray


def planned_peaks(twin: RcTwin, log: HeatLog, states_c: Array, ahead_s: float) -> Array:
    """Hottest motor temperatures from each edge of the log's steps to so long after it if the load then is known.

    A planned motion is known before it happens; its load is read from the log's own coming steps.

    Args:
        states_c: What an observer knew at each edge, °C, [step + 1, node].

    Returns:
        °C, [step + 1, joint]; nan where the log ends before.
    """
    return _peaks(twin, log, states_c, ahead_s, *_drive(twin, log))


def continued_peaks(twin: RcTwin, log: HeatLog, states_c: Array, ahead_s: float, *, past_s: float) -> Array:
    """The same if the load of the last `past_s` went on unchanged: nothing of the future is known.

    Returns:
        °C, [step + 1, joint]; nan at edges with less past than that.
    """
    square, friction = _drive(twin, log)
    steps = max(1, round(past_s / float(np.median(log.dt_s))))
    out = np.full((len(log.time_s), square.shape[1]), np.nan)
    if len(square) < steps:
        return out
    mean_square, mean_friction = (_trailing(values, steps) for values in (square, friction))
    count = max(1, int(np.ceil(ahead_s / float(np.median(log.dt_s)))))
    phi, gamma = twin.thermal.step_matrices(ahead_s / count)
    temp = states_c[steps:]
    highest = temp[:, WINDING]
    for _ in range(count):
        heat_w = drive_heat(temp, mean_square, mean_friction, twin.motors)
        temp = advance(temp, heat_w, np.full(len(temp), twin.ambient_c), phi, gamma, twin.thermal.to_ambient)
        highest = np.maximum(highest, temp[:, WINDING])
    out[steps:] = highest
    return out


def _drive(twin: RcTwin, log: HeatLog) -> tuple[Array, Array]:
    """Mean squared current and friction heat of each step, [step, joint]."""
    friction = (twin.motors.coulomb_nm, twin.motors.viscous_nms_per_rad)
    return log.current_sq(*friction), log.friction_w(*friction)


def _trailing(values: Array, steps: int) -> Array:
    """Mean over the `steps` steps before each edge that has so many, [edge, joint]."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return (total[steps:] - total[:-steps]) / steps


def _peaks(twin: RcTwin, log: HeatLog, states_c: Array, ahead_s: float, square: Array, friction: Array) -> Array:
    phi, gamma = twin.thermal.step_matrices(log.dt_s)
    edges = np.arange(len(log.time_s))
    until = np.searchsorted(log.time_s, log.time_s + ahead_s - 1e-9)  # first edge at or after the horizon
    temp = states_c.astype(float).copy()
    highest = temp[:, WINDING].copy()
    for ahead in range(int(np.max(until - edges, initial=0))):
        going = np.flatnonzero(edges + ahead < np.minimum(until, len(log.dt_s)))
        step = going + ahead
        heat_w = drive_heat(temp[going], square[step], friction[step], twin.motors)
        air = np.full(len(going), twin.ambient_c)
        temp[going] = advance(temp[going], heat_w, air, phi[step], gamma[step], twin.thermal.to_ambient)
        highest[going] = np.maximum(highest[going], temp[going][:, WINDING])
    return np.where((until < len(edges))[:, None], highest, np.nan)
