"""Peak motor temperatures in the next minutes, from every moment of a log."""

from itertools import repeat

import numpy as np

from fleet.motion import Drive
from fleet.thermal import WINDING, drive_heat, temperature_steps
from twin.logs.heat_log import HeatLog
from twin.thermal.thermal_twin import RcTwin

Array = np.ndarray


def planned_peaks(twin: RcTwin, log: HeatLog, states_c: Array, ahead_s: float) -> Array:
    """Peaks within `ahead_s` after each edge of the log's steps, with the load of the log's coming steps.

    The load of a planned motion is known in advance.

    Args:
        states_c: Estimated temperatures at each edge, °C, [step + 1, node].

    Returns:
        °C, [step + 1, joint]; nan where the log ends before.
    """
    load = _drive(twin, log)
    edges = np.arange(len(log.time_s))
    until = np.searchsorted(log.time_s, log.time_s + ahead_s - 1e-9)  # first edge at or after the horizon
    temp_c = states_c.astype(float)
    peak_c = temp_c[:, WINDING]
    for ahead in range(int(np.max(until - edges, initial=0))):
        step = np.minimum(edges + ahead, len(log.dt_s) - 1)
        heat_w = drive_heat(temp_c, load.current_sq[step], load.friction_w[step], twin.motors)
        within = (edges + ahead < np.minimum(until, len(log.dt_s)))[:, None]
        temp_c = np.where(within, twin.thermal.step(temp_c, heat_w, twin.ambient_c, log.dt_s[step]), temp_c)
        peak_c = np.maximum(peak_c, temp_c[:, WINDING])
    return np.where((until < len(edges))[:, None], peak_c, np.nan)


def continued_peaks(twin: RcTwin, log: HeatLog, states_c: Array, ahead_s: float, *, past_s: float) -> Array:
    """The same if the mean load of the last `past_s` continues, without knowledge of the future.

    Returns:
        °C, [step + 1, joint]; nan at edges with less past than `past_s`.
    """
    load = _drive(twin, log)
    step_s = float(np.median(log.dt_s))
    past, count = max(1, round(past_s / step_s)), max(1, int(np.ceil(ahead_s / step_s)))
    peak_c = np.full((len(log.time_s), load.current_sq.shape[1]), np.nan)
    if len(load.current_sq) >= past:
        mean = Drive(_trailing_mean(load.current_sq, past), _trailing_mean(load.friction_w, past))
        rows = temperature_steps(
            repeat(mean, count),
            ahead_s / count,
            motors=twin.motors,
            thermal=twin.thermal,
            start_c=states_c[past:],
            ambient_c=twin.ambient_c,
        )
        peak_c[past:] = np.max([temp_c[:, WINDING] for temp_c in rows], axis=0)
    return peak_c


def _drive(twin: RcTwin, log: HeatLog) -> Drive:
    """Mean drive of each step, [step, joint]."""
    friction = (twin.motors.coulomb_nm, twin.motors.viscous_nms_per_rad)
    return Drive(log.current_sq(*friction), log.friction_w(*friction))


def _trailing_mean(values: Array, steps: int) -> Array:
    """Mean over the `steps` steps before each edge after them, [edge, joint]."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return (total[steps:] - total[:-steps]) / steps
