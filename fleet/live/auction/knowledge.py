"""Observations of a live fleet: what the arms answered, in the fields that a policy reads in simulation too."""

import logging
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass

import numpy as np

from fleet.bus.protocol.auction import JobEstimate, Quote
from fleet.live.auction.round import Bidding
from fleet.observation import LONG_S, Layout, Observation, all_peers
from fleet.robot import JOINTS

_LOG = logging.getLogger(__name__)

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class LiveFleet:
    """What is fixed for a whole shift."""

    arms: tuple[str, ...]
    """In the fleet's order; other arms that answer come after them, by name."""
    warning_c: float
    """Motor temperature from which headroom is counted."""
    horizon_s: float = np.inf
    """Length of the shift; inf if it has no end."""

    def order(self, answered: Mapping[str, Quote]) -> tuple[str, ...]:
        """The arms of the fleet, and any others that answered."""
        return (*self.arms, *sorted(answered.keys() - set(self.arms)))


def observe(bidding: Bidding, fleet: LiveFleet, *, lost: Container[str] = ()) -> dict[str, Observation]:
    """What every arm knows, by name; the jobs of the round are in the slots, in their order.

    An arm that takes no job now counts as working, with nothing to claim. Of an arm that did not answer nothing is
    known. The probability to pass the warning limit is the quoted one; without one it is 1 or 0 by the quoted peak, and
    0.5 without either. A duration that an arm does not quote counts as the longest of the round.

    Args:
        lost: Arms whose last claim was given to another.
    """
    answered = {**bidding.full, **bidding.quotes}
    arms, time_s = fleet.order(answered), bidding.time_s
    layout, peers = Layout(len(arms), len(bidding.jobs)), all_peers(len(arms))
    quotes = [answered.get(arm) for arm in arms]
    offers = [_offers_of(quote, bidding) for quote in quotes]

    def each(value: Callable[[Quote], float]) -> Array:
        return np.array([0.0 if quote is None else value(quote) for quote in quotes])

    def table(value: Callable[[JobEstimate], float | None]) -> Array:
        values = [[None if offer is None else value(offer) for offer in row] for row in offers]
        return np.array([[np.nan if v is None else v for v in row] for row in values], float).reshape(len(arms), -1)

    def job(values: list[float]) -> Array:
        return np.broadcast_to(np.array(values, dtype=float), (len(arms), layout.slots))

    heard = each(lambda quote: 1.0)
    faulted = each(lambda quote: quote.mode == "faulted")
    room = each(lambda quote: quote.capacity > 0) * (1.0 - faulted)
    feasible = table(lambda offer: 1.0) > 0
    difficulty = table(lambda offer: offer.difficulty)
    known = ~np.isnan(difficulty)
    quoted_s = table(lambda offer: offer.duration_s)
    longest_s = np.nanmax(quoted_s) if (~np.isnan(quoted_s)).any() else 0.0
    duration_s = np.where(feasible, np.where(np.isnan(quoted_s), longest_s, quoted_s), 0.0)
    busy_s = np.nan_to_num(table(lambda offer: offer.finish_in_s) - quoted_s).max(axis=1, initial=0.0)
    queued_s = [max(word.release_s, bidding.returned.get(word.name, (0, 0.0))[1]) for word in bidding.jobs]
    due_s = job([LONG_S + time_s if word.due_s is None else word.due_s for word in bidding.jobs])
    headroom_k = each(lambda quote: quote.headroom_k)
    told = {"known": known, "difficulty": np.where(known, difficulty, 0.0)}
    known_by_all = Observation(
        clock=np.full(len(arms), time_s / fleet.horizon_s),
        idle=room,
        working=heard * (1.0 - faulted) * (1.0 - room),
        faulted=faulted,
        busy_s=busy_s,
        last_award=np.array([-1.0 if arm in lost else 0.0 for arm in arms]),
        temp_c=np.array([_temp_c(arm, k, bidding, fleet) for arm, k in zip(arms, headroom_k, strict=True)]),
        headroom_k=headroom_k,
        offered=job([1.0] * layout.slots),
        feasible=feasible,
        **told,
        p_saturation=_risk(table(lambda offer: offer.p_saturation), table(lambda offer: offer.peak_c), fleet.warning_c),
        duration_s=duration_s,
        slack_s=due_s - time_s - duration_s,
        age_s=time_s - job(queued_s),
        payload_kg=job([word.payload_kg for word in bidding.jobs]),
        value=job([word.value for word in bidding.jobs]),
        returns=job([bidding.returned.get(word.name, (0, 0.0))[0] for word in bidding.jobs]),
        peer_heard=heard[peers],
        peer_age_s=np.where(heard > 0, [bidding.ages_s.get(arm, 0.0) for arm in arms], LONG_S)[peers],
        peer_working=(heard * (1.0 - faulted) * (1.0 - room))[peers],
        peer_faulted=faulted[peers],
        peer_headroom_k=headroom_k[peers],
        peer_known=told["known"][peers],
        peer_difficulty=told["difficulty"][peers],
        action_mask=np.zeros(0),
    )
    mask = np.insert(feasible & (room > 0)[:, None], 0, True, axis=1).astype(np.int8)
    vectors = layout.pack(known_by_all)
    return {arm: layout.read(vectors[a], mask[a]) for a, arm in enumerate(arms)}


def claimed_jobs(
    bidding: Bidding, observations: Mapping[str, Observation], actions: Mapping[str, int]
) -> dict[str, str]:
    """The job that each arm claims: action 0 waits, k claims slot k. An illegal action is logged and is a wait."""
    claims: dict[str, str] = {}
    for arm, action in actions.items():
        mask = observations[arm].action_mask
        if not (0 <= action < len(mask) and mask[action]):
            _LOG.error("The policy chose the illegal action %d for '%s': it counts as a wait.", action, arm)
        elif action:
            claims[arm] = bidding.jobs[action - 1].name
    return claims


def _offers_of(quote: Quote | None, bidding: Bidding) -> list[JobEstimate | None]:
    """The feasible offer for each job of the round."""
    by_job = {} if quote is None else {offer.job: offer for offer in quote.estimates if offer.feasible}
    return [by_job.get(word.name) for word in bidding.jobs]


def _temp_c(arm: str, headroom_k: float, bidding: Bidding, fleet: LiveFleet) -> Array:
    """Motor temperatures as the arm last published them, [joint]; without any, all as warm as its hottest."""
    state = bidding.states.get(arm)
    if state is None or len(state.temp_c) != JOINTS:
        return np.full(JOINTS, fleet.warning_c - headroom_k)
    return np.array(state.temp_c)


def _risk(p_saturation: Array, peak_c: Array, warning_c: float) -> Array:
    by_peak = np.where(np.isnan(peak_c), 0.5, peak_c > warning_c)
    return np.where(np.isnan(p_saturation), by_peak, p_saturation)
