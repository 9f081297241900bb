"""Observations of a live fleet: quotes and states in the fields that a policy reads in simulation too."""

import logging
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass

import numpy as np

from fleet.bus.protocol.auction import PlanQuote, Quote
from fleet.live.auction.round import Bidding, Choice
from fleet.observation import LONG_S, Layout, Observation, all_peers
from fleet.offered_plans import PLANS
from fleet.robot import JOINTS

_LOG = logging.getLogger(__name__)

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class LiveFleet:
    """Constants of a shift."""

    arms: tuple[str, ...]
    """In the fleet's order; other arms that quote come after them, by name."""
    warning_c: float
    """Motor temperature of zero headroom."""
    horizon_s: float = np.inf
    """Length of the shift; inf if it has no end."""

    def order(self, quotes: Mapping[str, Quote]) -> tuple[str, ...]:
        """Return the arms of the fleet, then any others with a quote."""
        return (*self.arms, *sorted(quotes.keys() - set(self.arms)))


def observe(bidding: Bidding, fleet: LiveFleet, *, lost: Container[str] = ()) -> dict[str, Observation]:
    """Return the observation of every arm, by name; the jobs of the round are in the slots, in their order.

    An option is a quoted plan, by its number; plans of a number from `PLANS` on are left out.

    Some fields are on no message: `ambient_c`, `job_value`, `job_cycles`, `job_peak_c`, `job_p`, `too_heavy` and
    `peer_blocks` are 0, `station_free` is 1, `space_free` equals `feasible`, `housing_c` equals `temp_c`, and
    `last_award` is never 1. `busy_s` and `peer_busy_s` follow from the quotes of the round.

    An arm without capacity counts as working and can claim nothing; an arm without a quote has an unknown state. The
    probability to pass the warning limit is the quoted one; without it, 1 or 0 by the quoted peak; without either, 0.5.
    A missing duration counts as the longest of the round.

    Args:
        lost: Arms whose last claim was lost to another arm.
    """
    by_arm = {**bidding.full, **bidding.quotes}
    arms, time_s = fleet.order(by_arm), bidding.time_s
    layout, peers = Layout(len(arms), len(bidding.jobs), plans=PLANS), all_peers(len(arms))
    quotes = [by_arm.get(arm) for arm in arms]
    offers = [_plans_of(quote, bidding) for quote in quotes]

    def each(value: Callable[[Quote], float]) -> Array:
        return np.array([0.0 if quote is None else value(quote) for quote in quotes])

    def table(value: Callable[[PlanQuote], float | None]) -> Array:
        rows = [[None if plan is None else value(plan) for plan in row] for row in offers]
        return np.array(rows, float).reshape(len(arms), -1)  # [arm, option]; None becomes NaN

    def per_option(per_slot: Array) -> Array:
        return np.repeat(per_slot, PLANS, axis=-1)

    def per_job(values: list[float]) -> Array:
        return np.broadcast_to(np.array(values, dtype=float), (len(arms), layout.slots))

    quoted = each(lambda quote: 1.0)
    faulted = each(lambda quote: quote.mode == "faulted")
    room = each(lambda quote: quote.capacity > 0) * (1.0 - faulted)
    feasible = table(lambda offer: 1.0) > 0
    difficulty = table(lambda offer: offer.difficulty)
    known = ~np.isnan(difficulty)
    quoted_s = table(lambda offer: offer.duration_s)
    longest_s = np.nan_to_num(quoted_s).max(initial=0.0)
    duration_s = np.where(feasible, np.where(np.isnan(quoted_s), longest_s, quoted_s), 0.0)
    busy_s = np.nan_to_num(table(lambda offer: offer.finish_in_s) - quoted_s).max(axis=1, initial=0.0)
    queued_s = [max(job.release_s, bidding.returned.get(job.name, (0, 0.0))[1]) for job in bidding.jobs]
    due_s = per_job([LONG_S + time_s if job.due_s is None else job.due_s for job in bidding.jobs])
    headroom_k = each(lambda quote: quote.headroom_k)
    difficulty = np.where(known, difficulty, 0.0)
    working = quoted * (1.0 - faulted) * (1.0 - room)
    least = np.where(known, difficulty, np.inf).reshape(len(arms), -1, PLANS).min(axis=-1)  # [arm, slot]
    peak_c = table(lambda offer: offer.peak_c)
    temp_c = np.array([_temp_c(arm, k, bidding, fleet) for arm, k in zip(arms, headroom_k, strict=True)])
    nothing, no_slots = np.zeros(len(arms)), np.zeros((len(arms), layout.slots))
    fields = Observation(
        clock=np.full(len(arms), time_s / fleet.horizon_s),
        idle=room,
        working=working,
        faulted=faulted,
        busy_s=busy_s,
        last_award=np.array([-1.0 if arm in lost else 0.0 for arm in arms]),
        temp_c=temp_c,
        housing_c=temp_c,
        ambient_c=np.zeros(len(arms)),
        headroom_k=headroom_k,
        job_value=nothing,
        job_cycles=nothing,
        job_peak_c=nothing,
        job_p=nothing,
        offered=per_job([1.0] * layout.slots),
        station_free=per_job([1.0] * layout.slots),
        too_heavy=no_slots,
        feasible=feasible,
        space_free=feasible,
        known=known,
        difficulty=difficulty,
        peak_c=np.nan_to_num(peak_c),
        p_saturation=_risk(table(lambda offer: offer.p_saturation), peak_c, fleet.warning_c),
        duration_s=duration_s,
        slack_s=np.where(feasible, per_option(due_s) - time_s - duration_s, 0.0),
        age_s=time_s - per_job(queued_s),
        payload_kg=per_job([job.payload_kg for job in bidding.jobs]),
        value=per_job([job.value for job in bidding.jobs]),
        returns=per_job([bidding.returned.get(job.name, (0, 0.0))[0] for job in bidding.jobs]),
        expires=per_job([float(job.expires) for job in bidding.jobs]),
        peer_heard=quoted[peers],
        peer_age_s=np.where(quoted > 0, [bidding.ages_s.get(arm, 0.0) for arm in arms], LONG_S)[peers],
        peer_working=working[peers],
        peer_faulted=faulted[peers],
        peer_headroom_k=headroom_k[peers],
        peer_busy_s=busy_s[peers],
        peer_known=np.isfinite(least)[peers],
        peer_difficulty=np.where(np.isfinite(least), least, 0.0)[peers],
        peer_blocks=no_slots[peers],
        action_mask=np.zeros(0),
    )
    # Waiting is always legal; a live fleet has no action to give a job back.
    mask = np.pad((feasible & (room > 0)[:, None]).astype(np.int8), ((0, 0), (1, 1)), constant_values=((0, 0), (1, 0)))
    vectors = layout.pack(fields)
    return {arm: layout.read(vectors[a], mask[a]) for a, arm in enumerate(arms)}


def claimed_jobs(
    bidding: Bidding, observations: Mapping[str, Observation], actions: Mapping[str, int]
) -> dict[str, Choice]:
    """Return what each arm claims: action 0 waits, 1 + option claims; an illegal action is logged and waits."""
    claims: dict[str, Choice] = {}
    for arm, action in actions.items():
        mask = observations[arm].action_mask
        if not (0 <= action < len(mask) and mask[action]):
            _LOG.error("The policy chose the illegal action %d for '%s': it counts as waiting.", action, arm)
        elif action:
            slot, plan = divmod(action - 1, PLANS)
            claims[arm] = Choice(bidding.jobs[slot].name, plan)
    return claims


def _plans_of(quote: Quote | None, bidding: Bidding) -> list[PlanQuote | None]:
    """Return the quoted plan of each option of the round."""
    by_job = (
        {} if quote is None else {offer.job: {plan.plan: plan for plan in offer.plans} for offer in quote.estimates}
    )
    return [by_job.get(job.name, {}).get(plan) for job in bidding.jobs for plan in range(PLANS)]


def _temp_c(arm: str, headroom_k: float, bidding: Bidding, fleet: LiveFleet) -> Array:
    """Return the published motor temperatures, [joint]; without any, the hottest one for all."""
    state = bidding.states.get(arm)
    if state is None or len(state.temp_c) != JOINTS:
        return np.full(JOINTS, fleet.warning_c - headroom_k)
    return np.array(state.temp_c)


def _risk(p_saturation: Array, peak_c: Array, warning_c: float) -> Array:
    by_peak = np.where(np.isnan(peak_c), 0.5, peak_c > warning_c)
    return np.where(np.isnan(p_saturation), by_peak, p_saturation)
