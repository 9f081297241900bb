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
    """Per fault; a scenario without `reward.faults` takes the price of a fault, see `FaultPrice`."""
    energy: float = -0.001
    """Per W·h turned to heat."""


@dataclass(frozen=True)
class FaultPrice:
    """What a fault costs a fleet: the value of the jobs that arrive while the arm is expected to be lost."""

    value_per_s: float
    """Expected value of arriving jobs, 1/s."""
    downtime_s: float
    """Expected time from a fault until the arm works again."""

    @property
    def price(self) -> float:
        """The product of both, in units of value."""
        return self.value_per_s * self.downtime_s


TERMS = tuple(f.name for f in fields(RewardWeights))
_UNITS = np.array([1.0, 1.0, 60.0, 1.0, 3600.0])
"""The weights count minutes and watt hours, the simulator seconds and joules."""


def weights_per_unit(weights: RewardWeights) -> np.ndarray:
    """Reward per unit of value, value times minutes late, s above warning, faults and J, [term]."""
    return np.array(astuple(weights)) / _UNITS
