"""Who gets what in a live fleet, by the name of a policy: of an auctioneer's, or of arms that agree among themselves.

Introduces those who collect bids to the rules of `agents`, which see arrays of costs.
"""

import math
from collections.abc import Callable

import networkx as nx
import numpy as np

from agents.auction import Lot, assignment_by_name
from agents.consensus import consensus
from agents.cost import Bids, cost_by_name
from fleet.bus.trade import Offer
from fleet.errors import FleetError, nearest
from fleet.live.bidding import Allocate, Bidding


def agreed(lot: Lot) -> dict[str, str]:
    """What the arms agree on by bidding among themselves; of jobs at one station the cheapest stays.

    Whoever has to give way bids again for what is left, so without shared stations it is the agreement itself.
    """
    stations = dict(zip(lot.jobs, lot.stations, strict=True))
    cost = {
        arm: {job: float(c) for job, c in zip(lot.jobs, row, strict=True) if math.isfinite(c)}
        for arm, row in zip(lot.arms, lot.cost, strict=True)
    }
    out: dict[str, str] = {}
    for _ in lot.jobs:  # every turn gives at least one away
        taken = frozenset(place for job in out for place in stations[job])
        left = {
            arm: {job: c for job, c in costs.items() if job not in out and not taken & stations[job]}
            for arm, costs in cost.items()
            if arm not in out.values()
        }
        result = consensus(left, nx.complete_graph(sorted(left)))
        won = sorted((left[arm][job], job, arm) for arm, job in result.items() if job is not None)
        if not won:
            break
        for _, job, arm in won:
            if not taken & stations[job]:
                out[job] = arm
                taken |= stations[job]
    return out


POLICIES: dict[str, tuple[str, str]] = {
    "matching": ("thermal", "matching"),
    "ssi": ("thermal", "ssi"),
    "quickest_matching": ("quickest", "matching"),
    "quickest_ssi": ("quickest", "ssi"),
    "consensus": ("thermal", "consensus"),
}
"""What a job costs an arm, and who gets what, by the name under which `--policy` knows them."""
AMONG_ARMS = ("consensus",)
"""Those by which the arms agree among themselves, without an auctioneer."""


def check(name: str) -> None:
    """Refuse what is no policy of a live fleet.

    Raises:
        FleetError: names the nearest.
    """
    if name not in POLICIES:
        raise FleetError(f"No policy '{name}' of a live fleet{nearest(name, POLICIES)}")


def allocation(policy: str, warning_c: float) -> Allocate:
    """How the jobs of a round are given away.

    Args:
        policy: Its name.
        warning_c: Motor temperature from which headroom is counted.

    Raises:
        FleetError: no such policy; names the nearest.
    """
    check(policy)
    what, how = POLICIES[policy]
    cost, assign = cost_by_name(what), agreed if how == "consensus" else assignment_by_name(how)

    def allocate(bidding: Bidding) -> dict[str, str]:
        arms = tuple(sorted(bidding.quotes))
        return assign(
            Lot(
                arms=arms,
                jobs=tuple(word.name for word in bidding.jobs),
                cost=cost(bids_of(bidding, arms, warning_c)),
                capacity=(1,) * len(arms),
                stations=tuple(frozenset(word.places) for word in bidding.jobs),
            )
        )

    return allocate


def bids_of(bidding: Bidding, arms: tuple[str, ...], warning_c: float) -> Bids:
    """What the arms offered as arrays [arm, job]."""
    offers = [[bidding.offer(arm, word.name) for word in bidding.jobs] for arm in arms]

    def table(value: Callable[[Offer], float | None]) -> np.ndarray:
        rows = [[None if offer is None else value(offer) for offer in row] for row in offers]
        return np.array([[math.nan if x is None else x for x in row] for row in rows], dtype=float)

    finish_s = table(lambda offer: offer.finish_in_s)
    due_s = np.array([math.inf if word.due_s is None else word.due_s for word in bidding.jobs])
    return Bids(
        feasible=np.array([[offer is not None for offer in row] for row in offers], dtype=bool),
        difficulty=table(lambda offer: offer.d),
        p_saturation=table(lambda offer: offer.p_saturation),
        peak_headroom_k=table(lambda offer: None if offer.peak_c is None else warning_c - offer.peak_c),
        finish_s=finish_s,
        tardiness_s=np.maximum(0.0, bidding.time_s + finish_s - due_s),
        value=np.array([word.value for word in bidding.jobs], dtype=float),
    )
