"""What a shift came to, in the figures of the field."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Outcome of one shift."""

    jobs: int
    """Released before the horizon."""
    finished: int
    value: float
    """Of the finished jobs."""
    value_offered: float
    on_time: int
    """Finished by their due time."""
    tardiness_min: float
    """Summed over finished jobs; lateness that is negative counts as nothing."""
    mean_wait_s: float
    """From release to the first award, over the jobs that were awarded."""
    makespan_s: float
    """When the last job was finished."""
    jobs_per_hour: float
    faults: int
    above_warning_min: float
    """Summed over arms."""
    peak_c: dict[str, float]
    """Hottest motor of each arm."""
    availability: float
    """Share of arm time not lost to faults."""
    utilisation: float
    """Share of arm time spent on jobs."""
    energy_wh: float
    """Turned to heat in the motors, over all arms."""
    heat_gini: float
    """Inequality of the arms' shares of that heat: 0 all alike, towards 1 one arm takes all."""
    messages: int
    """Words that reached a peer."""
    lost_claims: int
    illegal_actions: int


def gini(shares: np.ndarray) -> float:
    """Gini coefficient of non-negative shares, [item] → [0, 1).

    Source: mean absolute difference over twice the mean (Sen, On Economic Inequality, 1973).
    """
    shares = np.asarray(shares, dtype=float)
    if not shares.size:
        raise ValueError("The Gini coefficient needs at least one share.")
    if np.any(shares < 0):
        raise ValueError(f"Shares must be >= 0 (got {shares}).")
    mean = shares.mean()
    if mean == 0:
        return 0.0
    return float(np.abs(shares[:, None] - shares[None, :]).mean() / (2 * mean))
