"""What an arm learns from the differences of its measured and its expected motor temperatures.

The expected ones are those of its identified network, given the currents that it measures. The simulator and live arms
share this.
"""

import numpy as np

from fleet.jit import Real, jit, jit_inline
from fleet.robot import JOINTS

Array = np.ndarray

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
SMOOTH_S = 100.0
"""Time constant with which measured temperatures are compared with assumed ones."""
SPREAD_K, SPREAD_RATIO, SPREAD_OFFSET_K = np.float32(2.0), np.float32(0.5), np.float32(6.0)
"""Standard deviations before anything is measured: of a difference of temperatures that neither heat nor sensors
explain, of the ratio of heat about 1, and of the offset of the sensors."""
CAUTION_RATIO, CAUTION_OFFSET = np.float32(1.0), np.float32(2.0)
"""Standard errors by which motors must make more heat than expected, and sensors read too much, before it counts."""
MOST_RATIO = np.float32(2.0)
"""Upper bound of the ratio of heat."""


@jit
def compare(moments: Array, expected_c: Array, measured_c: Array, drift_k: Real, ambient_c: Real, dt_s: float) -> None:
    """Smooth the moments of a line through the differences of measured and expected motor temperatures.

    Args:
        moments: Sums over the joints of x, x², y and xy, float32 [4]; x is the expected rise above the air and y the
            difference, K.
        expected_c: After a step, [node].
        measured_c: After the step, less the drift, [joint or node].
    """
    x = xx = y = xy = _ZERO
    for k in range(JOINTS):
        rise_k, more_k = expected_c[k] - ambient_c, measured_c[k] + drift_k - expected_c[k]
        x, xx, y, xy = x + rise_k, xx + rise_k * rise_k, y + more_k, xy + rise_k * more_k
    share = np.float32(min(dt_s / SMOOTH_S, 1.0))
    moments[0] += share * (x - moments[0])
    moments[1] += share * (xx - moments[1])
    moments[2] += share * (y - moments[2])
    moments[3] += share * (xy - moments[3])


@jit_inline
def line_of(moments: Array) -> tuple[Real, Real]:
    """What differences of measured and expected motor temperatures say of the heat and of the sensors of an arm.

    More heat, or worse cooling, makes a difference in proportion to the rise of a motor; sensors that drift alike make
    the same one everywhere. The line is the most probable one with normal priors and a slope of at least 0 (Bishop,
    Pattern Recognition and Machine Learning, 2006, eq. 3.53). Readings count as too high only where that is certain:
    the offset is then the lower end of its interval by the profile likelihood (Venzon & Moolgavkar 1988).

    Args:
        moments: As in `compare`.

    Returns:
        Ratio of the measured to the expected heat, from 1 to `MOST_RATIO`, and offset of the sensors, K.
    """
    weight = _ONE / (SPREAD_K * SPREAD_K)
    a = moments[1] * weight + _ONE / (SPREAD_RATIO * SPREAD_RATIO)
    b = moments[0] * weight
    c = np.float32(JOINTS) * weight + _ONE / (SPREAD_OFFSET_K * SPREAD_OFFSET_K)
    by_y, by_xy = moments[2] * weight, moments[3] * weight
    det = a * c - b * b
    free_k, slope = (a * by_y - b * by_xy) / det, (c * by_xy - b * by_y) / det
    alone_k = by_y / c
    offset_k = free_k if slope >= _ZERO else alone_k
    if offset_k > _ZERO:
        low_k = alone_k - CAUTION_OFFSET / np.sqrt(c)
        if slope >= _ZERO or by_xy > low_k * b:
            below = _ZERO if slope >= _ZERO else slope * slope * det / c
            low_k = free_k - np.sqrt(a / det * (CAUTION_OFFSET * CAUTION_OFFSET + below))
        offset_k = max(low_k, _ZERO)
    certain = (by_xy - offset_k * b) / a - CAUTION_RATIO / np.sqrt(a)
    return min(max(_ONE + certain, _ONE), MOST_RATIO), offset_k
