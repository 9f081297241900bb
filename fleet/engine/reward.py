"""Reward terms: named, weighted in the scenario, summed in one place, reported apart."""

from dataclasses import astuple, dataclass, fields

import numpy as np


@dataclass(frozen=True, kw_only=True)
class RewardWeights:
    """What each term is worth to the fleet; all arms share one reward."""

    finished_value: float = 1.0
    """Per unit of value of a finished job."""
    tardiness: float = -0.01
    """Per unit of value and minute by which a job was finished late."""
    above_warning: float = -0.05
    """Per minute an arm has a motor above the warning limit."""
    faults: float = -5.0
    """Per fault."""
    energy: float = -0.001
    """Per W·h turned to heat."""


TERMS = tuple(f.name for f in fields(RewardWeights))
_UNITS = np.array([1.0, 1.0, 60.0, 1.0, 3600.0])
"""The weights count minutes and watt hours, the simulator seconds and joules."""


def weights_per_unit(weights: RewardWeights) -> np.ndarray:
    """Reward per unit of value, value times minutes late, s above warning, faults and J, [term]."""
    return np.array(astuple(weights)) / _UNITS
