"""Thermal difficulty of a planned motion for one arm's motors, and the protocol of models that score it.

d = Σ_k w_k d_k, d_k = 1 − exp(−e_k). e_k is the time mean of the absolute reconstruction error of joint k, summed over
the channels (E. Guiffo Kaigom, arXiv 2509.12740; the sign is chosen so that d_k → 1 for unknown motion). In the paper
all weights are 1. Here w_k is proportional to the heat of joint k in the arm's cool motion (`heat_weights`), so that a
new posture of a joint without load does not count as much as new load.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from fleet.jit import Real, jit_inline
from fleet.motion import Plan
from fleet.robot import JOINTS

Array = np.ndarray


def difficulty_of_error(error: Array) -> Array:
    """d_k = 1 − exp(−e_k), in [0, 1), same shape as the errors e_k >= 0."""
    return -np.expm1(-error)


def heat_weights(torque_sq: Array) -> Array:
    """Weights w_k of the joints, [joint], with the sum `joints`: shares in the mean squared torque.

    Args:
        torque_sq: Mean squared torque of the joints in the arm's cool motion, (N·m)², [joint].
    """
    return torque_sq * (len(torque_sq) / torque_sq.sum())


SETTLING_S = 120.0
"""A plan saturates if a motor is at or above the warning limit at any moment from this time after its start until its
end (for a shorter plan: at its end), or if a fault ends it. Earlier temperatures may come from previous work, so a plan
that lets a warm motor cool at once does not saturate. Predicted and true peaks count from the same time."""

KNOWN = 2 * JOINTS + 1
"""Number of known temperatures at the start of a plan, °C: measured motors, estimated housings, ambient."""


def known_temperatures(motor_c: Array, housing_c: Array, ambient_c: Array | float) -> Array:
    """Known temperatures as one array, °C, [..., KNOWN].

    Args:
        motor_c: Measured motor temperatures, [..., joint].
        housing_c: Estimated housing temperatures, [..., joint].
        ambient_c: Ambient temperature, [...].
    """
    ambient = np.broadcast_to(np.asarray(ambient_c, dtype=float)[..., None], (*np.shape(motor_c)[:-1], 1))
    return np.concatenate([motor_c, housing_c, ambient], axis=-1)


@dataclass(frozen=True, eq=False)
class Forecast:
    """Maximum of affine functions of the known temperatures at the start of a plan, and a probability from it.

    value = max over pieces of offset + weight @ known_c, P = link(value). A logistic regression has one piece. A
    thermal network that is linear in its initial temperatures has one per joint and moment. Leading axes [...] are for
    several plans.
    """

    offset: Array
    """Value of each piece at 0 °C, [..., piece]; −inf for an unused piece."""
    weight: Array
    """Slope of each piece, 1/K, [..., piece, KNOWN]."""
    curve: Array | None = None
    """Link function, [..., knot, (value, probability)]: both non-decreasing, linear between the knots and constant
    beyond. None, or NaN as first value: the logistic function."""
    time_s: Array | None = None
    """Moment of each piece after the start, s, [..., piece]; 0: it counts at any time. None: all 0."""
    gain: Array | None = None
    """By how much each piece rises if the load makes twice the heat that was assumed, [..., piece]; None: all 0."""

    def __post_init__(self) -> None:
        if self.offset.shape[-1:] in ((), (0,)) or self.weight.shape != (*self.offset.shape, KNOWN):
            raise ValueError(
                f"Forecast needs offset [..., piece] and weight [..., piece, {KNOWN}] with at least one piece "
                f"(got {self.offset.shape} and {self.weight.shape})."
            )
        if np.isnan(self.offset).any() or not np.isfinite(self.weight).all():
            raise ValueError("Forecast.offset must not be NaN, and Forecast.weight must be finite.")
        if self.curve is not None and (
            self.curve.shape[-1:] != (2,) or self.curve.shape[:-2] != self.offset.shape[:-1]
        ):
            raise ValueError(f"Forecast.curve must be [..., knot, 2] (got {self.curve.shape}).")
        if self.time_s is not None and (self.time_s.shape != self.offset.shape or not (self.time_s >= 0).all()):
            raise ValueError(f"Forecast.time_s must be >= 0, one per piece (got shape {np.shape(self.time_s)}).")
        if self.gain is not None and (self.gain.shape != self.offset.shape or not np.isfinite(self.gain).all()):
            raise ValueError(f"Forecast.gain must be finite, one per piece (got shape {np.shape(self.gain)}).")

    def value(self, known_c: Array, left_s: float = np.inf, excess: float = 0.0) -> Array:
        """The value [...] from known temperatures [..., KNOWN], without the pieces of moments later than `left_s`.

        Args:
            excess: Heat of the load over the assumed heat, less 1.
        """
        offset = self.offset if self.gain is None else self.offset + excess * self.gain
        values = offset + (self.weight @ np.asarray(known_c, dtype=float)[..., None])[..., 0]
        if self.time_s is not None:
            values = np.where(self.time_s <= left_s, values, -np.inf)
        return values.max(axis=-1)

    def at(self, known_c: Array, left_s: float = np.inf, excess: float = 0.0) -> Array:
        """The probability [...]; arguments as in `value`."""
        curve = np.zeros((0, 2)) if self.curve is None else self.curve
        return _LINKS(self.value(known_c, left_s, excess), curve)

    def __getitem__(self, row: Array | int) -> "Forecast":
        """Rows of the first axis."""
        curve, time_s, gain = (None if part is None else part[row] for part in (self.curve, self.time_s, self.gain))
        return Forecast(self.offset[row], self.weight[row], curve, time_s, gain)


def stack_forecasts(forecasts: Sequence[Forecast]) -> Forecast:
    """Stack forecasts of single plans along a leading axis; their numbers of pieces and knots may differ."""
    pieces = max(len(each.offset) for each in forecasts)
    knots = max(0 if each.curve is None else len(each.curve) for each in forecasts)
    offset = np.full((len(forecasts), pieces), -np.inf)
    time_s, gain = np.zeros((2, len(forecasts), pieces))
    weight = np.zeros((len(forecasts), pieces, KNOWN))
    for row, each in enumerate(forecasts):
        count = len(each.offset)
        offset[row, :count], weight[row, :count] = each.offset, each.weight
        if each.time_s is not None:
            time_s[row, :count] = each.time_s
        if each.gain is not None:
            gain[row, :count] = each.gain
    if not knots:
        return Forecast(offset, weight, None, time_s, gain)
    curves = [np.zeros((1, 0, 2)) if each.curve is None else each.curve[None] for each in forecasts]
    return Forecast(offset, weight, np.concatenate([extend_curve(curve, knots) for curve in curves]), time_s, gain)


def forecast_arrays(forecasts: Forecast | None, lanes: int) -> dict[str, Array]:
    """Convert stacked forecasts to arrays of the engine, without pieces that never count; empty for None.

    Returns:
        forecast_first, first block of each forecast, and the number of all blocks, int [forecast + 1];
        forecast_block [block, 3 + KNOWN, lane], offset, moment, gain and slopes of each piece, padded with offsets of
        −inf; and forecast_curve [forecast, knot, 2].
    """
    if forecasts is None:
        empty = np.zeros((0, 3 + KNOWN, lanes)), np.zeros((0, 0, 2))
        return dict(zip(_FORECAST_TABLES, (np.zeros(1, int), *empty), strict=True))
    count = len(forecasts.offset)
    size = -(-forecasts.offset.shape[1] // lanes)
    pieces = np.zeros((count, 3 + KNOWN, size * lanes))
    pieces[:, 0] = -np.inf
    used = slice(0, forecasts.offset.shape[1])
    pieces[:, 0, used], pieces[:, 3:, used] = forecasts.offset, forecasts.weight.swapaxes(1, 2)
    if forecasts.time_s is not None:
        pieces[:, 1, used] = forecasts.time_s
    if forecasts.gain is not None:
        pieces[:, 2, used] = forecasts.gain
    blocks = pieces.reshape(count, 3 + KNOWN, size, lanes).swapaxes(1, 2)
    counts = (blocks[:, :, 0] > -np.inf).any(axis=-1)
    curve = np.zeros((count, 0, 2)) if forecasts.curve is None else forecasts.curve
    first = np.cumsum([0, *counts.sum(axis=1)])
    return dict(zip(_FORECAST_TABLES, (first, blocks[counts], curve), strict=True))


_FORECAST_TABLES = ("forecast_first", "forecast_block", "forecast_curve")


def extend_curve(curve: Array, knots: int) -> Array:
    """Pad curves [forecast, knot, 2] to more knots: constant beyond the last; NaN where there is no curve.

    Args:
        knots: Number of knots of the result.
    """
    more = knots - curve.shape[1]
    if not len(curve):
        return np.zeros((0, knots, 2), curve.dtype)
    if not more:
        return curve
    if not curve.shape[1]:
        return np.full((len(curve), knots, 2), np.nan, curve.dtype)
    beyond = np.repeat(curve[:, -1:], more, axis=1)
    beyond[..., 0] = np.where(np.isnan(curve[:, :1, 0]), np.nan, np.inf)
    return np.concatenate([curve, beyond], axis=1)


@jit_inline
def probability_of(value: Real, curve: Array) -> float:
    """Probability for a forecast's value; see `Forecast`.

    Args:
        curve: [knot, 2]; without knots, and where the first value is NaN, the link is the logistic function.
    """
    knots = len(curve)
    if knots == 0 or math.isnan(curve[0, 0]):
        return 0.5 * (1.0 + math.tanh(0.5 * value))  # the logistic function, without overflow
    right = 0
    while right < knots and value >= curve[right, 0]:
        right += 1
    below, above = max(right - 1, 0), min(right, knots - 1)
    x0, p0 = curve[below, 0], curve[below, 1]
    x1, p1 = curve[above, 0], curve[above, 1]
    if not (math.isfinite(x1) and x1 > x0):
        return p0
    return p0 + min(max((value - x0) / (x1 - x0), 0.0), 1.0) * (p1 - p0)


_LINKS = np.vectorize(probability_of, otypes=[float], signature="(),(k,c)->()")


@dataclass(frozen=True, eq=False)
class Difficulty:
    """Scores of one plan by a difficulty model."""

    per_joint: Array
    """d_k, [joint], each in [0, 1)."""
    p_saturation: float | None = None
    """P(saturation) by a model with fixed start temperatures; None if the model has no P, or gives `risk`."""
    risk: Forecast | None = None
    """P(saturation) as a function of the known temperatures at the start."""
    peak: Forecast | None = None
    """Hottest motor temperature during the plan (see `SETTLING_S`), °C, as a function of the known temperatures at the
    start. With a curve it also gives P(saturation), unless there is a `risk`."""
    weight: Array | None = None
    """w_k, [joint], with the sum `joints`; None: all 1."""

    def __post_init__(self) -> None:
        if self.p_saturation is not None and self.risk is not None:
            raise ValueError("A Difficulty has p_saturation or risk, not both: risk.at(known_c) is the probability.")

    @cached_property
    def total(self) -> float:
        """d = Σ_k w_k d_k, in [0, joints)."""
        return float(np.sum(self.per_joint if self.weight is None else self.weight * self.per_joint))

    def p_at(self, known_c: Array, left_s: float = np.inf, excess: float = 0.0) -> float | None:
        """P(saturation) from known temperatures [KNOWN]; None if unknown.

        Args:
            left_s: Time until the plan ends, if it has begun.
            excess: As in `Forecast.value`.
        """
        if self.risk is not None:
            return float(self.risk.at(known_c, left_s, excess))
        if self.p_saturation is None and self.peak is not None and self.peak.curve is not None:
            return float(self.peak.at(known_c, left_s, excess))
        return self.p_saturation

    def peak_at(self, known_c: Array, left_s: float = np.inf, excess: float = 0.0) -> float | None:
        """Predicted hottest motor temperature during the plan, °C; None if unknown; arguments as in `p_at`.

        Of a plan that has begun, it is at least the hottest motor now.
        """
        if self.peak is None:
            return None
        peak_c = float(self.peak.value(known_c, left_s, excess))
        return peak_c if left_s == np.inf else max(peak_c, float(known_c[:JOINTS].max()))


class DifficultyModel(Protocol):
    """Predicts difficulty, peak and P(saturation) of plans of one arm."""

    @property
    def version(self) -> str:
        """Version of the model, recorded with each score."""
        ...

    def score(self, plan: Plan, repetitions: int) -> Difficulty | None:
        """Difficulty of repeating the plan's cycle `repetitions` times; None if the model has no score."""
        ...


@dataclass(frozen=True)
class Blind:
    """A model without predictions: every difficulty is None."""

    version: str = "blind"

    def score(self, plan: Plan, repetitions: int) -> Difficulty | None:
        """Return None."""
        return None
