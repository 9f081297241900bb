"""What it would cost to give each job to each arm: one matrix [arm, job] out of what the arms bid."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fleet.errors import nearest

Array = np.ndarray

RISK = 9.0
"""A job in which a motor surely passes its warning limit counts as 1 + RISK times as difficult as a cool one."""
UNKNOWN_RISK = 0.5
LATE_PER_H = 1.0
"""What an hour of tardiness costs for each unit of a job's value, in units of difficulty."""
HASTE_PER_H = 0.01
"""What an hour until the finish costs: it settles what difficulty leaves open."""
TIE_DIGITS = 9
"""Costs that differ further behind are alike; only rounding told them apart."""


@dataclass(frozen=True, eq=False)
class Bids:
    """What the arms said about the jobs on offer; arrays [arm, job] with NaN for what is not known."""

    feasible: Array
    """Whether the arm could do it and would take it now, bool."""
    difficulty: Array
    """d."""
    p_saturation: Array
    """Probability that a motor passes the warning limit."""
    peak_headroom_k: Array
    """Warning limit minus the hottest motor that the arm predicts during the job."""
    finish_s: Array
    """From now until it would be finished."""
    tardiness_s: Array
    """By how much it would then be late, 0 if it is not."""
    value: Array
    """[job]."""

    def __post_init__(self) -> None:
        shape = np.shape(self.feasible)
        for name in ("difficulty", "p_saturation", "peak_headroom_k", "finish_s", "tardiness_s"):
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"Bids.{name} must be {shape} like feasible (got {np.shape(getattr(self, name))}).")
        if np.shape(self.value) != shape[1:]:
            raise ValueError(f"Bids.value must be {shape[1:]}, one per job (got {np.shape(self.value)}).")


Cost = Callable[[Bids], Array]
"""[arm, job]; +inf where the arm may not have the job. Lower is better; only differences count."""


def thermal(bids: Bids) -> Array:
    """Difficulty weighed by risk, against the fleet's average for that job; late and valuable work comes first.

    Each arm's difficulty counts 1 + RISK · P(saturation) times. As with `agents.rules.LeastDifficulty` it is reckoned
    against what the arms that could do the job find on average: some work is new to every twin, and what the choice
    can change is who does it. Where P is not known, the predicted peak stands in for it: beyond the warning limit or
    not. Where nobody has a difficulty, risk alone decides, and after it the time until the finish.
    """
    able = bids.feasible.astype(bool)
    difficulty = _filled(bids.difficulty, able, otherwise=1.0)
    late = LATE_PER_H * bids.value * _filled(bids.tardiness_s, able) / 3600.0
    haste = HASTE_PER_H * _filled(bids.finish_s, able) / 3600.0
    cost = _relative(difficulty * (1.0 + RISK * risk(bids)) + late + haste, able)
    # What waits is late for whoever takes it: that says which job, not which arm.
    return np.where(able, cost - _average(late, able), np.inf).round(TIE_DIGITS)


def quickest(bids: Bids) -> Array:
    """Seconds until the arm would have finished the job; unknown counts as the slowest known. Heat counts nothing."""
    able = bids.feasible.astype(bool)
    known = able & ~np.isnan(bids.finish_s)
    slowest = bids.finish_s[known].max() if known.any() else 0.0
    return np.where(able, np.where(known, bids.finish_s, slowest), np.inf).round(TIE_DIGITS)


def risk(bids: Bids) -> Array:
    """Probability that a motor passes its warning limit; the predicted peak stands in for it where it is not known."""
    peak = np.where(np.isnan(bids.peak_headroom_k), UNKNOWN_RISK, bids.peak_headroom_k < 0)
    return np.where(np.isnan(bids.p_saturation), peak, bids.p_saturation)


COSTS: dict[str, Cost] = {"thermal": thermal, "quickest": quickest}
"""Presets by their names."""


def cost_by_name(name: str) -> Cost:
    """The preset.

    Raises:
        ValueError: no such one; names the nearest.
    """
    if name not in COSTS:
        raise ValueError(f"No rule '{name}'{nearest(name, COSTS)}")
    return COSTS[name]


def _average(values: Array, known: Array) -> Array:
    """Over the arms that know a value, [job]; 0 where none does."""
    return np.where(known, values, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)


def _relative(values: Array, able: Array) -> Array:
    return np.where(able, values, 0.0) - _average(values, able)


def _filled(values: Array, able: Array, otherwise: float = 0.0) -> Array:
    """Unknown values as the average of what the able ones know of that job; `otherwise` where none does."""
    known = able & ~np.isnan(values)
    fill = np.where(known.any(axis=0), _average(values, known), otherwise)
    return np.where(np.isnan(values), fill, values)
