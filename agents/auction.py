"""Who gets which job: from a cost matrix [arm, job] to an assignment, by rules with one idea each.

Names settle ties, so the order in which arms answered changes nothing. A job occupies its stations, and a station
serves one job at a time, so jobs that share one are not awarded together.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module

import numpy as np

from fleet.errors import nearest

Array = np.ndarray
Assignment = dict[str, str]
"""Arm of each job that is given away."""


@dataclass(frozen=True, eq=False)
class Lot:
    """Jobs that come under the hammer together."""

    arms: tuple[str, ...]
    jobs: tuple[str, ...]
    cost: Array
    """[arm, job]; +inf where the arm may not have the job."""
    capacity: tuple[int, ...]
    """How many jobs each arm takes at most, [arm]."""
    stations: tuple[frozenset[str], ...]
    """What each job occupies, [job]."""

    def __post_init__(self) -> None:
        shape = (len(self.arms), len(self.jobs))
        if np.shape(self.cost) != shape or len(self.capacity) != shape[0] or len(self.stations) != shape[1]:
            raise ValueError(
                f"A lot of {shape[0]} arm(s) and {shape[1]} job(s) needs so many capacities and stations, and a cost "
                f"for every pair (got {len(self.capacity)}, {len(self.stations)} and {np.shape(self.cost)})."
            )
        if len(set(self.arms)) != shape[0] or len(set(self.jobs)) != shape[1]:
            raise ValueError("A lot names every arm and every job once.")
        if np.isnan(self.cost).any() or np.isneginf(self.cost).any():
            raise ValueError("A cost is a number, or +inf for what may not be.")

    def total(self, assignment: Assignment) -> float:
        """Sum of the costs of an assignment."""
        return float(sum(self.cost[self.arms.index(arm), self.jobs.index(job)] for job, arm in assignment.items()))


AssignmentRule = Callable[[Lot], Assignment]


def sequential(lot: Lot) -> Assignment:
    """Sequential single-item auction: the cheapest pair of arm and job first, then the cheapest of what is left.

    With one job per arm and fresh bids in the next round it is the auction of the literature, in which every arm bids
    anew after each award. (Lagoudakis et al. 2005, Robotics: Science and Systems; Koenig et al. 2006, AAAI.)
    """
    lot = _by_name(lot)
    room = list(lot.capacity)
    taken: set[str] = set()
    out: Assignment = {}
    # By job, then by arm: a stable sort leaves ties in the order of their names.
    for place in np.argsort(lot.cost.T, axis=None, kind="stable").tolist():
        j, a = divmod(place, len(lot.arms))
        if np.isinf(lot.cost[a, j]):
            break
        if room[a] and lot.jobs[j] not in out and not taken & lot.stations[j]:
            room[a] -= 1
            taken |= lot.stations[j]
            out[lot.jobs[j]] = lot.arms[a]
    return out


def matching(lot: Lot) -> Assignment:
    """As many jobs as can be given away, at the least total cost: a matching over the whole batch.

    Without shared stations it is the optimum. Of jobs that want the same station the cheapest stays and the rest is
    matched again; where that turns out worse than `sequential`, that one is taken: it is never worse.
    """
    lot = _by_name(lot)
    open_lot, found = lot, _matched(lot)
    for _ in lot.jobs:  # every turn closes at least one job
        losers = _losers(lot, found)
        if not losers:
            break
        closed = np.isin(lot.jobs, losers)
        open_lot = replace(open_lot, cost=np.where(closed, np.inf, open_lot.cost))
        found = _matched(open_lot)
    greedy = sequential(lot)
    return min(found, greedy, key=lambda out: (-len(out), lot.total(out)))


ASSIGNMENTS: dict[str, AssignmentRule] = {"ssi": sequential, "matching": matching}
"""Rules by their names."""


def assignment_by_name(name: str) -> AssignmentRule:
    """The rule.

    Raises:
        ValueError: no such one; names the nearest.
    """
    if name not in ASSIGNMENTS:
        raise ValueError(f"No assignment '{name}'{nearest(name, ASSIGNMENTS)}")
    if name == "matching":  # loaded now rather than in the first round
        import_module("scipy.optimize")
    return ASSIGNMENTS[name]


def _by_name(lot: Lot) -> Lot:
    """The lot with its arms and jobs in the order of their names."""
    a = sorted(range(len(lot.arms)), key=lambda i: lot.arms[i])
    j = sorted(range(len(lot.jobs)), key=lambda i: lot.jobs[i])
    return Lot(
        arms=tuple(lot.arms[i] for i in a),
        jobs=tuple(lot.jobs[i] for i in j),
        cost=lot.cost[np.ix_(a, j)],
        capacity=tuple(lot.capacity[i] for i in a),
        stations=tuple(lot.stations[i] for i in j),
    )


def _matched(lot: Lot) -> Assignment:
    """The cheapest of the largest matchings, stations aside. (Kuhn 1955; Crouse 2016 for rectangular matrices.)"""
    from scipy.optimize import linear_sum_assignment  # some time to load, and only the auctioneer needs it

    rows = [a for a, room in enumerate(lot.capacity) for _ in range(min(room, len(lot.jobs)))]
    cost = lot.cost[rows]
    may = np.isfinite(cost)
    if not may.any():
        return {}
    cost = cost - cost[may].min()
    # So dear that no saving elsewhere makes up for a pair that may not be.
    never = (cost[may].max() + 1.0) * (min(cost.shape) + 1)
    pairs = zip(*linear_sum_assignment(np.where(may, cost, never)), strict=True)
    return {lot.jobs[j]: lot.arms[rows[row]] for row, j in pairs if may[row, j]}


def _losers(lot: Lot, found: Assignment) -> list[str]:
    """Jobs of an assignment that want a station which a cheaper one, or one of an earlier name, has."""
    taken: set[str] = set()
    losers: list[str] = []
    for job in sorted(found, key=lambda job: (lot.total({job: found[job]}), job)):
        stations = lot.stations[lot.jobs.index(job)]
        if taken & stations:
            losers.append(job)
        else:
            taken |= stations
    return losers
