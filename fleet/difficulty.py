"""Thermal difficulty: how hard a planned motion is for one arm's motors, and who can say so.

d = Σ_k d_k, d_k = 1 − exp(−e_k) with e_k the time mean of the absolute reconstruction error of joint k, summed
over the channels (E. Guiffo Kaigom, arXiv 2509.12740; the reading in which d_k → 1 for motion not known).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from fleet.motion import Plan

Array = np.ndarray


def difficulty_of_error(error: Array) -> Array:
    """d_k = 1 − exp(−e_k), in [0, 1), same shape as the errors e_k >= 0."""
    return -np.expm1(-error)


@dataclass(frozen=True, eq=False)
class Risk:
    """How the probability that a motor passes the warning limit depends on the motor temperatures at the start.

    P = link(max over pieces of offset + weight @ temp_c): one piece is a logistic regression, one piece per joint and
    time a thermal network that is linear in its start. Leading axes [...] for several plans.
    """

    offset: Array
    """Score of each piece at 0 °C, [..., piece]; −inf for a piece that does not count."""
    weight: Array
    """Slope of each piece, 1/K, [..., piece, joint]."""
    curve: Array | None = None
    """Score and probability [..., knot, 2], neither falling, linear between and constant beyond the knots; without
    one, and where its first score is NaN, the link is the logistic function."""

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
        """Probability at motor temperatures [..., joint] as measured now, °C, each in [0, 1], [...]."""
        temp = np.asarray(temp_c, dtype=float)
        score = (self.offset + (self.weight @ temp[..., None])[..., 0]).max(axis=-1)
        logistic = 0.5 * (1.0 + np.tanh(0.5 * score))  # the logistic function, without overflow
        if self.curve is None:
            return logistic
        return np.where(np.isnan(self.curve[..., 0, 0]), logistic, _interpolated(score, self.curve))

    def __getitem__(self, row: Array | int) -> "Risk":
        """The risks of some rows of the first axis."""
        return Risk(self.offset[row], self.weight[row], None if self.curve is None else self.curve[row])


def stack_risks(risks: Sequence[Risk]) -> Risk:
    """Risks of single plans, of unequal numbers of pieces and knots, as one with a leading axis [risk, ...]."""
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


def _interpolated(score: Array, curve: Array) -> Array:
    """Linear interpolation in a curve [..., knot, 2] at scores [...], constant beyond its ends."""
    knots, p = np.moveaxis(curve, -1, 0)
    right = (score[..., None] >= knots).sum(axis=-1)[..., None]  # 0: left of all
    above, below = np.minimum(right, knots.shape[-1] - 1), np.maximum(right - 1, 0)
    (x0, p0), (x1, p1) = (
        [
            np.take_along_axis(np.broadcast_to(v, (*score.shape, knots.shape[-1])), k, axis=-1)[..., 0]
            for v in (knots, p)
        ]
        for k in (below, above)
    )
    inside = np.isfinite(x1) & (x1 > x0)
    share = np.divide(score - x0, x1 - x0, out=np.zeros_like(score), where=inside)
    return p0 + np.clip(share, 0.0, 1.0) * np.where(inside, p1 - p0, 0.0)


@dataclass(frozen=True, eq=False)
class Difficulty:
    """What a model says of one plan."""

    per_joint: Array
    """d_k, [joint], each in [0, 1)."""
    p_saturation: float | None = None
    """Probability that a motor passes the warning limit, of a model that takes the start for granted; None where
    the model cannot say, or says it by `risk`."""
    risk: Risk | None = None
    """The same of a model that knows how it depends on the motor temperatures at the start."""

    def __post_init__(self) -> None:
        if self.p_saturation is not None and self.risk is not None:
            raise ValueError("A Difficulty has p_saturation or risk, not both: risk.at(temp_c) is the probability.")

    @cached_property
    def total(self) -> float:
        """d = Σ_k d_k, in [0, joints)."""
        return float(np.sum(self.per_joint))

    def p_at(self, temp_c: Array) -> float | None:
        """Probability that a motor passes the warning limit from motor temperatures [joint]; None where not known."""
        return self.p_saturation if self.risk is None else float(self.risk.at(temp_c))


class DifficultyModel(Protocol):
    """Says how hard a plan is for one arm, without moving it."""

    @property
    def version(self) -> str:
        """What produced the score, for the digital thread."""
        ...

    def score(self, plan: Plan, repetitions: int) -> Difficulty | None:
        """Difficulty of doing the plan so many times; None when the model has no opinion."""
        ...


@dataclass(frozen=True)
class Blind:
    """Knows nothing and says so: every score is None."""

    version: str = "blind"

    def score(self, plan: Plan, repetitions: int) -> Difficulty | None:
        """None, always."""
        return None
