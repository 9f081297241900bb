"""Thermal difficulty: how hard a planned motion is for one arm's motors, and who can say so.

d = Σ_k d_k, d_k = 1 − exp(−e_k) with e_k the time mean of the absolute reconstruction error of joint k, summed
over the channels (E. Guiffo Kaigom, arXiv 2509.12740; the reading in which d_k → 1 for motion not known).
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fleet.motion import Plan

Array = np.ndarray


def difficulty_of_error(error: Array) -> Array:
    """d_k = 1 − exp(−e_k), in [0, 1), same shape as the errors e_k >= 0."""
    return -np.expm1(-error)


@dataclass(frozen=True, eq=False)
class Difficulty:
    """What a model says of one plan."""

    per_joint: Array
    """d_k, [joint], each in [0, 1)."""
    p_saturation: float | None = None
    """Probability that a motor passes the warning limit; None where the model cannot say."""

    @property
    def total(self) -> float:
        """d = Σ_k d_k, in [0, joints)."""
        return float(np.sum(self.per_joint))


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
