"""The compiled step where a limit is passed within it: exact moments, as `fleet.sim.faults` has them.

A stretch of constant heat is held as the modes of the thermal network: T(t) = M (exp(−λt) y + (1 − exp(−λt))/λ z)
with M = C^(−1/2) V, y = Vᵀ C^(1/2) T₀ and z = Vᵀ C^(−1/2) (P + g Ta).
"""

import math

import numpy as np

from fleet.robot import JOINTS
from fleet.sim.faults import BISECTIONS
from fleet.sim.jit import inner
from fleet.sim.tables import Tables
from fleet.thermal import NODES

Array = np.ndarray


@inner
def hottest(temp_c: Array) -> float:
    """Of the motors, [node]."""
    return max(
        max(max(temp_c[0], temp_c[1]), max(temp_c[2], temp_c[3])),
        max(max(temp_c[4], temp_c[5]), temp_c[6]),
    )


@inner
def into_modes(t: Tables, lot: int, a: int, temp_c: Array, load_w: Array, modal: Array) -> None:
    """y and z of a stretch that begins at these temperatures, [2, mode]; the load is heat and what the air gives."""
    modal[:] = 0.0
    for n in range(NODES):
        root = t.root[lot, a, n]
        warm = root * temp_c[n]
        load = load_w[n] / root
        for m in range(NODES):
            modal[0, m] += t.modes[lot, a, n, m] * warm
            modal[1, m] += t.modes[lot, a, n, m] * load


@inner
def at(t: Tables, lot: int, a: int, modal: Array, time_s: float, out: Array) -> None:
    """Temperatures so long after the beginning of a stretch, [node]."""
    out[:] = 0.0
    for m in range(NODES):
        rate = t.rates[lot, a, m]
        now = math.exp(-rate * time_s) * modal[0, m] - math.expm1(-rate * time_s) / rate * modal[1, m]
        for n in range(NODES):
            out[n] += t.modes[lot, a, n, m] * now
    for n in range(NODES):
        out[n] /= t.root[lot, a, n]


@inner
def crossing_s(
    t: Tables, lot: int, a: int, modal: Array, length_s: float, limit_c: float, rising: bool, out: Array
) -> float:
    """When in a stretch the hottest motor passes a limit, from its beginning; its length if it does not."""
    low, high = 0.0, length_s
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        at(t, lot, a, modal, middle, out)
        if (hottest(out) >= limit_c) == rising:
            high = middle
        else:
            low = middle
    return high


@inner
def braked_load(t: Tables, lot: int, a: int, air_c: float, out: Array) -> float:
    """Load of an arm on its brakes, W, [node]; returns the heat in it."""
    heat_w = 0.0
    for n in range(NODES):
        out[n] = t.to_ambient[lot, a, n] * air_c
    if not t.power_off:
        for j in range(JOINTS):
            out[JOINTS + j] += t.motor[lot, a, 1, j]
            heat_w += t.motor[lot, a, 1, j]
    return heat_w


@inner
def above_s(t: Tables, lot: int, a: int, modal: Array, begin_c: Array, length_s: float, out: Array) -> float:
    """How long of a stretch the hottest motor is above the warning limit; leaves its end in `out`."""
    begins = hottest(begin_c) >= t.warning_c
    at(t, lot, a, modal, length_s, out)
    ends = hottest(out) >= t.warning_c
    if begins == ends:
        return length_s if begins else 0.0
    passed_s = crossing_s(t, lot, a, modal, length_s, t.warning_c, not begins, out)
    at(t, lot, a, modal, length_s, out)
    return passed_s if begins else length_s - passed_s
