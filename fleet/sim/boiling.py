"""The compiled step where a limit is passed within it: exact moments, as `fleet.sim.faults` has them.

A stretch of constant heat is held as the modes of the thermal network: T(t) = M (exp(−λt) y + (1 − exp(−λt))/λ z)
with M = C^(−1/2) V, y = Vᵀ C^(1/2) T₀ and z = Vᵀ C^(−1/2) (P + g Ta).
"""

import math

import numpy as np

from fleet.robot import JOINTS
from fleet.sim.faults import TOLERANCE_S
from fleet.sim.jit import inner, rare
from fleet.sim.tables import Tables
from fleet.thermal import NODES

Array = np.ndarray

MOST_STEPS = 100
"""Of finding a crossing; some ten are enough."""


@inner
def hottest(temp_c: Array) -> float:
    """Of the motors, [node]."""
    return max(
        max(max(temp_c[0], temp_c[1]), max(temp_c[2], temp_c[3])),
        max(max(temp_c[4], temp_c[5]), temp_c[6]),
    )


@rare
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


@rare
def at(t: Tables, lot: int, a: int, modal: Array, time_s: float, out: Array) -> None:
    """Temperatures so long after the beginning of a stretch, [node]."""
    out[:] = 0.0
    for m in range(NODES):
        rate = t.rates[lot, a, m]
        now = modal[0, m] + math.expm1(-rate * time_s) * (modal[0, m] - modal[1, m] / rate)
        for n in range(NODES):
            out[n] += t.modes[lot, a, n, m] * now
    for n in range(NODES):
        out[n] /= t.root[lot, a, n]


@rare
def hottest_at(t: Tables, lot: int, a: int, modal: Array, time_s: float) -> float:
    """The hottest motor so long after the beginning of a stretch."""
    now = np.empty(NODES)
    at(t, lot, a, modal, time_s, now)
    return hottest(now)


@rare
def crossing_s(
    t: Tables, lot: int, a: int, modal: Array, length_s: float, limit_c: float, first_c: float, last_c: float
) -> float:
    """When in a stretch the hottest motor passes a limit that lies between its first and its last temperature.

    Inverse quadratic interpolation where that is safe, else halving: Chandrupatla (1997), Advances in Engineering
    Software 28(3), 145-149.

    Returns:
        The end of the bracket that is past the limit, s from the beginning of the stretch.
    """
    rising, x, y, other, f_other = last_c >= limit_c, length_s, last_c - limit_c, 0.0, first_c - limit_c
    share = 0.5
    for _ in range(MOST_STEPS):
        width_s = abs(x - other)
        least = 0.5 * TOLERANCE_S / width_s
        if y == 0.0:
            return x
        if least > 0.25:
            break
        new = x + min(max(share, least), 1.0 - least) * (other - x)
        f_new = hottest_at(t, lot, a, modal, new) - limit_c
        if (f_new >= 0.0) == (y >= 0.0):
            third, f_third = x, y
        else:
            third, f_third, other, f_other = other, f_other, x, y
        x, y = new, f_new
        xi, phi = (x - other) / (third - other), (y - f_other) / (f_third - f_other)
        if phi * phi < xi and (1.0 - phi) * (1.0 - phi) < 1.0 - xi:
            share = y / (f_other - y) * f_third / (f_other - f_third)
            share += (third - x) / (other - x) * y / (f_third - y) * f_other / (f_third - f_other)
        else:
            share = 0.5
    return x if (y >= 0.0) == rising else other


@rare
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


@rare
def above_s(
    t: Tables, lot: int, a: int, modal: Array, length_s: float, first_c: float, last_c: float
) -> float:  # fmt: skip
    """How long of a stretch the hottest motor is above the warning limit."""
    begins = first_c >= t.warning_c
    if begins == (last_c >= t.warning_c):
        return length_s if begins else 0.0
    passed_s = crossing_s(t, lot, a, modal, length_s, t.warning_c, first_c, last_c)
    return passed_s if begins else length_s - passed_s
