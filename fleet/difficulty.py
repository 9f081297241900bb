"""Thermal difficulty of a planned motion for one arm's motors, and the protocol of models that score it.

d = Σ_k d_k, d_k = 1 − exp(−e_k) with e_k the time mean of the absolute reconstruction error of joint k, summed
over the channels (E. Guiffo Kaigom, arXiv 2509.12740; read so that d_k → 1 for unknown motion).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from fleet.jit import jit_inline
from fleet.motion import Plan
from fleet.robot import JOINTS

Array = np.ndarray


def difficulty_of_error(error: Array) -> Array:
    """d_k = 1 − exp(−e_k), in [0, 1), same shape as the errors e_k >= 0."""
    return -np.expm1(-error)


@dataclass(frozen=True, eq=False)
class Risk:
    """Probability that a motor passes the warning limit, as a function of the motor temperatures at the start.

    P = link(max over pieces of offset + weight @ temp_c). One piece is a logistic regression; one piece per joint and
    time is a thermal network that is linear in its start. Leading axes [...] for several plans.
    """

    offset: Array
    """Score of each piece at 0 °C, [..., piece]; −inf for an unused piece."""
    weight: Array
    """Slope of each piece, 1/K, [..., piece, joint]."""
    curve: Array | None = None
    """Link function as score and probability [..., knot, 2], both non-decreasing, linear between the knots and constant
    beyond. None, or NaN as first score: the logistic function."""

    def __post_init__(self) -> None:
        if self.offset.shape[-1:] in ((), (0,)) or self.weight.shape[:-1] != self.offset.shape:
            raise ValueError(
                "Risk needs offset [..., piece] and weight [..., piece, joint] with at least one piece "
                f"(got {self.offset.shape} and {self.weight.shape})."
            )
        if np.isnan(self.offset).any() or not np.isfinite(self.weight).all():
            raise ValueError("Risk.offset must not be NaN, and Risk.weight must be finite.")
        if self.curve is not None and (
            self.curve.shape[-1:] != (2,) or self.curve.shape[:-2] != self.offset.shape[:-1]
        ):
            raise ValueError(f"Risk.curve must be [..., knot, 2] (got {self.curve.shape}).")

    def at(self, temp_c: Array) -> Array:
        """Probability [...] at measured motor temperatures [..., joint], °C."""
        curve = np.zeros((0, 2)) if self.curve is None else self.curve
        return _PROBABILITIES(self.offset, self.weight, curve, np.asarray(temp_c, dtype=float))

    def __getitem__(self, row: Array | int) -> "Risk":
        """Rows of the first axis."""
        return Risk(self.offset[row], self.weight[row], None if self.curve is None else self.curve[row])


def stack_risks(risks: Sequence[Risk]) -> Risk:
    """Risks of single plans as one with a leading axis [risk, ...]; numbers of pieces and knots may differ."""
    pieces = max(len(risk.offset) for risk in risks)
    knots = max(0 if risk.curve is None else len(risk.curve) for risk in risks)
    offset = np.full((len(risks), pieces), -np.inf)
    weight = np.zeros((len(risks), pieces, risks[0].weight.shape[-1]))
    curve = np.full((len(risks), knots, 2), np.nan)
    for row, risk in enumerate(risks):
        offset[row, : len(risk.offset)], weight[row, : len(risk.offset)] = risk.offset, risk.weight
        if risk.curve is not None:
            curve[row, : len(risk.curve)] = risk.curve
            curve[row, len(risk.curve) :] = np.inf, risk.curve[-1, 1]
    return Risk(offset, weight, curve if knots else None)


@jit_inline
def passing_probability(offset: Array, weight: Array, curve: Array, temp_c: Array) -> float:
    """Probability that a motor passes the warning limit; see `Risk`.

    Args:
        offset: [piece].
        weight: [piece, joint].
        curve: [knot, 2]; without knots, and where the first score is NaN, the link is the logistic function.
        temp_c: Motor temperatures, °C, [joint].
    """
    score = -np.inf
    for piece in range(len(offset)):
        linear = offset[piece]
        for k in range(JOINTS):
            linear += weight[piece, k] * temp_c[k]
        score = max(score, linear)
    knots = len(curve)
    if knots == 0 or math.isnan(curve[0, 0]):
        return 0.5 * (1.0 + math.tanh(0.5 * score))  # the logistic function, without overflow
    right = 0
    while right < knots and score >= curve[right, 0]:
        right += 1
    below, above = max(right - 1, 0), min(right, knots - 1)
    x0, p0 = curve[below, 0], curve[below, 1]
    x1, p1 = curve[above, 0], curve[above, 1]
    if not (math.isfinite(x1) and x1 > x0):
        return p0
    return p0 + min(max((score - x0) / (x1 - x0), 0.0), 1.0) * (p1 - p0)


_PROBABILITIES = np.vectorize(passing_probability, otypes=[float], signature="(p),(p,j),(k,c),(j)->()")


@dataclass(frozen=True, eq=False)
class Difficulty:
    """Scores of one plan by a difficulty model."""

    per_joint: Array
    """d_k, [joint], each in [0, 1)."""
    p_saturation: float | None = None
    """Probability that a motor passes the warning limit, by a model that assumes the start temperatures; None if the
    model has none, or gives `risk`."""
    risk: Risk | None = None
    """The probability as a function of the motor temperatures at the start."""

    def __post_init__(self) -> None:
        if self.p_saturation is not None and self.risk is not None:
            raise ValueError("A Difficulty has p_saturation or risk, not both: risk.at(temp_c) is the probability.")

    @cached_property
    def total(self) -> float:
        """d = Σ_k d_k, in [0, joints)."""
        return float(np.sum(self.per_joint))

    def p_at(self, temp_c: Array) -> float | None:
        """Probability that a motor passes the warning limit from motor temperatures [joint]; None if unknown."""
        return self.p_saturation if self.risk is None else float(self.risk.at(temp_c))


class DifficultyModel(Protocol):
    """Scores plans of one arm without moving it."""

    @property
    def version(self) -> str:
        """Version of the model, recorded with each score."""
        ...

    def score(self, plan: Plan, repetitions: int) -> Difficulty | None:
        """Difficulty of repeating the plan's cycle `repetitions` times; None if the model has no score."""
        ...


@dataclass(frozen=True)
class Blind:
    """A model without scores: every difficulty is None."""

    version: str = "blind"

    def score(self, plan: Plan, repetitions: int) -> Difficulty | None:
        """Return None."""
        return None
