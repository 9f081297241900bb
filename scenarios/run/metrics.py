"""Metrics of one shift."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Metrics of one shift; times from its beginning."""

    jobs: int
    """Released before the horizon."""
    finished: int
    value: float
    """Of the finished jobs."""
    value_offered: float
    given_up: int
    """Jobs that faulted too often, and those that waited for one that was given up or expired."""
    expired: int
    """Jobs that waited at their hard due date."""
    on_time: int
    """Finished by their due time."""
    tardiness_min: float
    """Sum over finished jobs of max(0, finish − due)."""
    mean_wait_s: float
    """From release to the first award, mean over the awarded jobs."""
    makespan_s: float
    """Time at which the last job was finished."""
    jobs_per_hour: float
    faults: int
    moved_home: int
    """How often a person moved a faulted arm home."""
    contacts: int | None
    """Of arms and payloads with other arms, the floor or fixtures; None if the plant does not look for them."""
    above_warning_min: float
    """Sum over arms of the time with a motor above the warning limit."""
    peak_c: dict[str, float]
    """Highest motor temperature of each arm."""
    availability: float
    """Share of the arms' time not lost to faults."""
    utilisation: float
    """Share of the arms' time spent on jobs."""
    energy_wh: float
    """Energy turned to heat in the motors of all arms."""
    heat_gini: float
    """Gini coefficient of the arms' shares of that heat: 0 all equal, near 1 one arm has all."""
    insulation_ppb: dict[str, float]
    """Of each arm: billionths of the rated life that its most aged winding used; see `fleet.heat.insulation`."""
    tool_drift_mm: dict[str, float]
    """Of each arm: the most that heat moved its tool point since the beginning of the shift, if it is stretched; see
    `fleet.heat.tool_drift`."""
    hot_surface_min: float
    """Sum over arms of the time with a surface above the burn threshold of the scenario's `people.contact_s`."""
    surface_c: dict[str, float]
    """Hottest surface of each arm that can be touched; see `fleet.heat.touch`."""
    messages: int
    """Messages delivered to a peer."""
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
