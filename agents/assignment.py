"""Central policies that assign jobs by a cost matrix [arm, option] of `agents.costs`.

They may assign two jobs that share a station, or two plans that exclude each other. As with any claims, the arm with
the lower difficulty then gets its job, and the other arm chooses again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from agents.costs import quickest, thermal
from agents.policy import WAIT, per_option, plans_of
from agents.rules import Stateless, cheapest_pairs, claims_of
from fleet.observation import Observation

Array = np.ndarray


class Ssi(Stateless):
    """Sequential single-item auction: greedy, the cheapest pair of arm and job first.

    Scope central: it compares the costs of all arms.
    """

    scope: ClassVar = "central"
    only_choices = True

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """The claims of the pairs of arm and job."""
        if not any(seen.action_mask[1:-1].any() for seen in observations.values()):
            return dict.fromkeys(observations, WAIT)
        seen = list(observations.values())
        return claims_of(observations, self.pairs(self.cost(seen), plans_of(seen[0])))

    def cost(self, observations: Sequence[Observation]) -> Array:
        """[arm, option] of the observations of all arms."""
        return thermal(observations)

    def pairs(self, cost: Array, plans: int) -> list[tuple[int, int]]:
        """Pairs (arm, option) of a cost matrix [arm, option]."""
        return cheapest_pairs(cost, plans)


class Matching(Ssi):
    """As many jobs as possible at the least total cost: an optimal matching of arms and jobs.

    Scope central: it compares the costs of all arms.
    """

    only_choices = True

    def pairs(self, cost: Array, plans: int) -> list[tuple[int, int]]:
        """Pairs (arm, option) of a cost matrix [arm, option]."""
        return matched_options(cost, plans)


class QuickestSsi(Ssi):
    """As `ssi`, by the time until the finish alone. Scope central."""

    only_choices = True

    def cost(self, observations: Sequence[Observation]) -> Array:
        """[arm, option] of the observations of all arms."""
        return quickest(observations)


class QuickestMatching(QuickestSsi, Matching):
    """As `matching`, by the time until the finish alone. Scope central."""

    only_choices = True


class Ahead:
    """Base of assignments in which arms that are home soon take part, by the time until they would finish.

    A pair of such an arm claims nothing: its job waits for it, and the next decision finds it free or makes another
    plan. The arm's predicted peak is that from its present temperatures. Whether its space will be free is unknown:
    `space_free` of an arm at work is always 0.
    """

    soon_s: ClassVar = 120.0
    """Longest time until such an arm is home."""

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """The claims of the pairs whose arm is free."""
        if not any(seen.action_mask[1:-1].any() for seen in observations.values()):
            return dict.fromkeys(observations, WAIT)
        actions = super().act({arm: self._soon(seen) for arm, seen in observations.items()})  # pyright: ignore
        return {arm: action if observations[arm].action_mask[action] else WAIT for arm, action in actions.items()}

    def _soon(self, seen: Observation) -> Observation:
        """The observation of an arm that is home soon, with the claims that it could make and their times then."""
        if not (seen.working and seen.busy_s <= self.soon_s):
            return seen
        mask = seen.action_mask.copy()
        mask[1:-1] = (seen.feasible > 0) & (per_option(seen, seen.station_free) > 0)
        late_s = float(seen.busy_s)
        return replace(
            seen,
            action_mask=mask,
            busy_s=np.zeros_like(seen.busy_s),
            duration_s=seen.duration_s + late_s,
            slack_s=seen.slack_s - late_s,
        )


class MatchingAhead(Ahead, Matching):
    """As `matching`, with arms that are home soon as well. Scope central, as `matching`."""

    only_choices = True


def matched_options(cost: Array, plans: int) -> list[tuple[int, int]]:
    """As `matching`, pairs (arm, option) of a cost matrix [arm, option]: each arm has the cheapest plan for its job."""
    by_slot = cost.reshape(len(cost), -1, plans)
    best = by_slot.argmin(axis=2)
    return [(arm, slot * plans + int(best[arm, slot])) for arm, slot in matching(by_slot.min(axis=2))]


def matching(cost: Array) -> list[tuple[int, int]]:
    """The cheapest of the largest matchings of a cost matrix [arm, slot], as pairs (arm, slot); inf is never paired.

    Source: Kuhn 1955; Crouse 2016 for rectangular matrices.
    """
    from scipy.optimize import linear_sum_assignment  # slow import that few processes need

    allowed = np.isfinite(cost)
    if not allowed.any():
        return []
    cost = cost - cost[allowed].min()
    # More than any saving elsewhere, so that a forbidden pair is the last resort.
    forbidden = (cost[allowed].max() + 1.0) * (min(cost.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(allowed, cost, forbidden))
    return [(a, j) for a, j in zip(rows.tolist(), columns.tolist(), strict=True) if allowed[a, j]]
