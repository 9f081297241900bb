"""Introduces the auctioneer, which collects quotes, to the rules of `agents`, which see arrays of costs."""

import math
from collections.abc import Callable

import numpy as np

from agents.auction import Lot, assignment_by_name
from agents.cost import Bids, cost_by_name
from fleet.bus.trade import Offer
from fleet.errors import FleetError
from fleet.live.bidding import Allocate, Bidding


def allocation(rule: str, assignment: str, warning_c: float) -> Allocate:
    """How the jobs of a round are given away.

    Args:
        rule: Name of a preset of `agents.cost`.
        assignment: Name of a rule of `agents.auction`.
        warning_c: Motor temperature from which headroom is counted.

    Raises:
        FleetError: no such rule; names the nearest.
    """
    try:
        cost, assign = cost_by_name(rule), assignment_by_name(assignment)
    except ValueError as error:
        raise FleetError(str(error)) from error

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
