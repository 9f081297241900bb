"""`mpc` without heat, for `thermofleet compare`; docs/leaderboard.md has the command."""

from collections.abc import Mapping

import numpy as np

from agents.planners import Mpc
from agents.policy import CellLookahead
from fleet.observation import Observation

OUT_OF_REACH_C = 1e6
"""Limits of motor temperatures where heat shall not count."""


class WithoutHeat(Mpc):
    """In the simulator no motor comes near a limit, and no fault is expected."""

    only_choices = True

    def plan_in(self, cell: CellLookahead) -> None:
        """Plan in the simulator of a shift, with limits out of reach."""
        super().plan_in(cell.with_limits(OUT_OF_REACH_C, OUT_OF_REACH_C))

    def expected_loss(self, observations: Mapping[str, Observation]) -> np.ndarray:
        """None, [slot, arm, option]."""
        return np.zeros_like(super().expected_loss(observations))
