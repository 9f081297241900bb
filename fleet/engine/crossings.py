"""Exact moments at which a motor crosses a temperature limit within a step, and the step that contains one.

Under constant heat the network's temperatures are T(t) = M (y + (exp(−λt) − 1)(y − z/λ)) with M = C^(−1/2) V,
y = Vᵀ C^(1/2) T₀ and z = Vᵀ C^(−1/2) (P + g Ta), λ and V the rates and modes of `fleet.heat.thermal.ThermalModel`.
"""

import math
from typing import NamedTuple

import numpy as np

from fleet.engine.tables import Tables
from fleet.heat.thermal import NODES
from fleet.jit import Real, jit, jit_inline
from fleet.robot import JOINTS
from fleet.telemetry import FAULTED

Array = np.ndarray

TOLERANCE_S = 1e-10
"""Accuracy of a crossing's moment."""
Y, Z, NOW, LAST, STOPPED, BRAKES = range(6)
"""Rows of `modal` [6, node]: y and z of an interval, and room for temperatures and loads."""
MOST_STEPS = 100
"""Iterations of the root search; about ten are enough."""


class Crossed(NamedTuple):
    """A step in which a limit was crossed."""

    cut_s: float
    """Seconds until a fault stopped the arm; the whole step if none did."""
    above_s: float
    """Seconds above the warning limit."""
    energy_j: float
    peak_c: float
    """Hottest motor at the fault and at the end of the step."""
    cool_s: float
    """Moment from which every motor is below the restart limit; inf if there is none."""
    warned_s: float
    """Moment at which the warning limit was crossed upwards; inf if it was not."""
    warned_joint: int
    """Motor that crossed it."""
    fault_joint: int
    """Motor that crossed the error limit."""


@jit_inline
def hottest(temp_c: Array) -> float:
    """Temperature of the hottest motor, from [node]."""
    return max(
        max(max(temp_c[0], temp_c[1]), max(temp_c[2], temp_c[3])),
        max(max(temp_c[4], temp_c[5]), temp_c[6]),
    )


@jit
def to_modes(net: Array, temp_c: Array, load_w: Array, modal: Array) -> None:
    """Put y and z of an interval that begins at these temperatures into the first rows of `modal`.

    Args:
        net: A `MODAL` record.
        load_w: Heat plus conductance to ambient times ambient temperature, W, [node].
    """
    for m in range(NODES):
        modal[Y, m] = modal[Z, m] = 0.0
    for n in range(NODES):
        root = net["root_capacity"][n]
        warm = root * temp_c[n]
        load = load_w[n] / root
        for m in range(NODES):
            modal[Y, m] += net["modes"][n, m] * warm
            modal[Z, m] += net["modes"][n, m] * load


@jit
def temperatures_at(net: Array, modal: Array, time_s: float, out: Array) -> None:
    """Put the temperatures at a moment of an interval into `out` [node]."""
    for n in range(NODES):
        out[n] = 0.0
    for m in range(NODES):
        rate = net["rates"][m]
        now = modal[Y, m] + math.expm1(-rate * time_s) * (modal[Y, m] - modal[Z, m] / rate)
        for n in range(NODES):
            out[n] += net["modes"][n, m] * now
    for n in range(NODES):
        out[n] /= net["root_capacity"][n]


@jit
def hottest_at(net: Array, modal: Array, time_s: float) -> float:
    """Return the temperature of the hottest motor at a moment of an interval."""
    temperatures_at(net, modal, time_s, modal[NOW])
    return hottest(modal[NOW])


@jit_inline
def hottest_joint(temp_c: Array) -> int:
    """Return the index of the hottest motor, from [node]."""
    joint = 0
    for k in range(1, JOINTS):
        joint = k if temp_c[k] > temp_c[joint] else joint
    return joint


@jit
def crossing_s(net: Array, modal: Array, length_s: float, limit_c: float, first_c: float, last_c: float) -> float:
    """Return when the hottest motor crosses a limit that lies between its first and last temperature.

    Inverse quadratic interpolation where it is safe, else bisection: Chandrupatla (1997), Advances in Engineering
    Software 28(3), 145-149.

    Returns:
        The end of the bracket that is past the limit, s from the beginning of the interval.
    """
    rising, x, y, other, f_other = last_c >= limit_c, length_s, last_c - limit_c, 0.0, first_c - limit_c
    share, third, f_third = 0.5, 0.0, 0.0
    for _ in range(MOST_STEPS):
        width_s = abs(x - other)
        least = 0.5 * TOLERANCE_S / width_s
        if y == 0.0:
            return x
        if least > 0.25:
            break
        new = x + min(max(share, least), 1.0 - least) * (other - x)
        f_new = hottest_at(net, modal, new) - limit_c
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


@jit
def braked_load(net: Array, power_off: bool, ambient_c: Real, out: Array) -> float:
    """Put the load of an arm on its brakes into `out`, W, [node]; return the heat in it."""
    heat_w = 0.0
    for n in range(NODES):
        out[n] = net["to_ambient"][n] * ambient_c
    if not power_off:
        for j in range(JOINTS):
            out[JOINTS + j] += net["idle_w"][j]
            heat_w += net["idle_w"][j]
    return heat_w


@jit
def step_with_crossing(
    t: Tables, net: Array, mode: int, begin: Array, heat_w: float, ambient_c: Real, end: Array, modal: Array
) -> Crossed:
    """Step an arm that crosses a limit or is faulted; `end` becomes its true temperatures at the end.

    Args:
        net: A `MODAL` record.
        begin: Temperatures, then loads (heat, and conductance times ambient temperature), [from].
        heat_w: Total heat until a fault.
        modal: Room, [6, node].
    """
    dt_s, faulted, last, stopped = t.dt_s, mode == FAULTED, modal[LAST], modal[STOPPED]
    to_modes(net, begin, begin[NODES:], modal)
    temperatures_at(net, modal, dt_s, last)
    first_c, last_c = np.float64(hottest(begin)), hottest(last)
    if faulted or last_c < t.error_c:
        cool_s = np.inf
        if faulted and last_c < t.restart_c:
            cool_s = 0.0
            if first_c >= t.restart_c:
                cool_s = crossing_s(net, modal, dt_s, t.restart_c, first_c, last_c)
        above, warned_s, joint = warning_in(t.warning_c, net, modal, dt_s, first_c, last_c)
        for n in range(NODES):
            end[n] = last[n]
        return Crossed(dt_s, above, heat_w * dt_s, last_c, cool_s, warned_s, joint, -1)
    cut_s = 0.0
    if first_c < t.error_c:
        cut_s = crossing_s(net, modal, dt_s, t.error_c, first_c, last_c)
    temperatures_at(net, modal, cut_s, stopped)
    stopped_c, fault_joint = hottest(stopped), hottest_joint(stopped)
    above, warned_s, joint = warning_in(t.warning_c, net, modal, cut_s, first_c, stopped_c)
    brakes_w = braked_load(net, t.power_off, ambient_c, modal[BRAKES])
    to_modes(net, stopped, modal[BRAKES], modal)
    left_s = dt_s - cut_s
    temperatures_at(net, modal, left_s, last)
    last_c = hottest(last)
    above_braked, warned_braked_s, joint_braked = warning_in(t.warning_c, net, modal, left_s, stopped_c, last_c)
    if warned_braked_s < np.inf:
        warned_s, joint = cut_s + warned_braked_s, joint_braked
    peak, cool_s = max(stopped_c, last_c), np.inf
    if last_c < t.restart_c:
        cool_s = cut_s
        if peak >= t.restart_c:
            cool_s = cut_s + crossing_s(net, modal, left_s, t.restart_c, stopped_c, last_c)
    energy_j = heat_w * cut_s + brakes_w * left_s
    for n in range(NODES):
        end[n] = last[n]
    return Crossed(cut_s, above + above_braked, energy_j, peak, cool_s, warned_s, joint, fault_joint)


@jit
def warning_in(
    warning_c: float, net: Array, modal: Array, length_s: float, first_c: float, last_c: float
) -> tuple[float, float, int]:
    """Return seconds above the warning limit in an interval, the moment it is crossed upwards (inf), and the motor."""
    begins = first_c >= warning_c
    if begins == (last_c >= warning_c):
        return (length_s if begins else 0.0), np.inf, -1
    passed_s = crossing_s(net, modal, length_s, warning_c, first_c, last_c)
    if begins:
        return passed_s, np.inf, -1
    temperatures_at(net, modal, passed_s, modal[NOW])
    return length_s - passed_s, passed_s, hottest_joint(modal[NOW])
