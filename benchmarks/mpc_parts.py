"""`mpc` without heat, for `thermofleet compare`; docs/leaderboard.md has the command."""

from agents.planners import Mpc
from agents.policy import CellLookahead

OUT_OF_REACH_C = 1e6
"""Limits of motor temperatures where heat shall not count."""


class WithoutHeat(Mpc):
    """In the simulator no motor comes near a limit."""

    only_choices = True

    def plan_in(self, cell: CellLookahead) -> None:
        """Plan in the simulator of a shift, with limits out of reach."""
        super().plan_in(cell.with_limits(OUT_OF_REACH_C, OUT_OF_REACH_C))
