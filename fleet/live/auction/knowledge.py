"""Observations of a live fleet: quotes and states in the fields that a policy reads in simulation too."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fleet.bus.protocol.auction import JobEstimate, PlanQuote, Quote
from fleet.bus.protocol.messages import State
from fleet.live.auction.rounds import Bidding, Choice
from fleet.observation import LONG_S, Layout, Observation
from fleet.offered_plans import PLANS
from fleet.robot import JOINTS, ThermalLimits

_LOG = logging.getLogger(__name__)

Array = np.ndarray

LEAST_S = 1e-3
"""Shortest duration of a plan: 0 stands for no plan."""
NO_CLAIMS: Mapping[str, int] = {}


@dataclass(frozen=True, kw_only=True)
class LiveFleet:
    """Constants of a shift."""

    arms: tuple[str, ...]
    """In the fleet's order; other arms that quote come after them, by name."""
    limits: ThermalLimits = field(default_factory=ThermalLimits)
    """Motor temperatures of zero headroom (`warning_c`) and of a fault (`error_c`)."""
    horizon_s: float = np.inf
    """Length of the shift; inf if it has no end."""

    def order(self, quotes: Mapping[str, Quote]) -> tuple[str, ...]:
        """Return the arms of the fleet, then any others with a quote."""
        return (*self.arms, *sorted(quotes.keys() - set(self.arms)))


def observe(bidding: Bidding, fleet: LiveFleet, *, last: Mapping[str, int] = NO_CLAIMS) -> dict[str, Observation]:
    """Return the observation of every arm, by name; the jobs of the round are in the slots, in their order.

    An option is a quoted plan, by its number; plans of a number from `PLANS` on are left out. What an arm knows of
    itself is in its quote and its last state, as is what its peers know of it; a peer without either is not heard.

    An arm without capacity, or without a message, counts as working and can claim nothing. A plan without difficulty
    and without P(saturation) has an unknown P and peak, as in simulation. A missing duration counts as the longest of
    the round, a missing housing temperature as that of the motor, and a missing ambient temperature as that of the
    coolest motor.

    Args:
        last: Outcome of the last claim of each arm: 1 won, -1 lost.
    """
    by_arm, limits = {**bidding.full, **bidding.quotes}, fleet.limits
    arms, time_s = fleet.order(by_arm), bidding.time_s
    layout = Layout(len(arms), len(bidding.jobs), plans=PLANS, bids=True)
    quotes, states = [by_arm.get(arm) for arm in arms], [bidding.states.get(arm) for arm in arms]
    estimates = [{} if quote is None else {offer.job: offer for offer in quote.estimates} for quote in quotes]
    offers = [_plans_of(by_job, bidding) for by_job in estimates]
    in_the_way = [
        [bidding.in_the_way(arm, plan.space) if plan else () for plan in row]
        for arm, row in zip(arms, offers, strict=True)
    ]

    def table(value: Callable[[PlanQuote], float | None]) -> Array:
        rows = [[None if plan is None else value(plan) for plan in row] for row in offers]
        return np.array(rows, float).reshape(len(arms), -1)  # [arm, option]; None becomes NaN

    def stated(value: Callable[[State], float | None]) -> Array:
        return np.array([(0.0 if state is None else value(state)) or 0.0 for state in states])

    def per_job(values: Sequence[float]) -> Array:
        return np.broadcast_to(np.array(values, dtype=float), (len(arms), layout.slots))

    def of_all(values: Array | Sequence[float]) -> Array:
        return np.repeat(np.asarray(values, float)[None], len(arms), axis=0)

    heard = [quote or state for quote, state in zip(quotes, states, strict=True)]
    modes = np.array([each.mode if each else "" for each in heard])
    headroom_k = np.array([each.headroom_k if each else 0.0 for each in heard])
    room = np.array([quote is not None and quote.capacity > 0 for quote in quotes]) & (modes != "faulted")
    working = np.isin(modes, ["idle", "working"]) & ~room
    breaks_s = [None if state is None else state.break_in_s for state in states]
    paused = np.array([break_s == 0.0 for break_s in breaks_s])
    feasible = table(lambda offer: 1.0) > 0
    free = np.array([[not in_way for in_way in row] for row in in_the_way]).reshape(feasible.shape)
    stations = [bidding.has_free_stations(job) for job in bidding.jobs]
    difficulty, p_saturation = table(lambda offer: offer.difficulty), table(lambda offer: offer.p_saturation)
    known = ~np.isnan(difficulty)
    least = np.where(known, difficulty, np.inf).reshape(len(arms), -1, PLANS).min(axis=-1)  # [arm, slot]
    least = np.where(np.isfinite(least), least, -1.0)
    scored = known | ~np.isnan(p_saturation)
    quoted_s = table(lambda offer: offer.duration_s)
    longest_s = np.nan_to_num(quoted_s).max(initial=0.0)
    duration_s = np.where(feasible, np.maximum(np.where(np.isnan(quoted_s), longest_s, quoted_s), LEAST_S), 0.0)
    queued_s = [max(job.release_s, bidding.returned.get(job.name, (0, 0.0))[1]) for job in bidding.jobs]
    due_s = per_job([LONG_S + time_s if job.due_s is None else job.due_s for job in bidding.jobs])
    busy_s = stated(lambda state: state.busy_s)
    ambient_c = np.array([each.ambient_c if each else None for each in states], float)  # None becomes NaN
    temp_c = _per_joint(states, "temp_c", np.repeat(limits.warning_c - headroom_k[:, None], JOINTS, axis=1))
    peak_c = np.where(scored, np.nan_to_num(table(lambda offer: offer.peak_c)), 0.0)
    p_saturation = np.where(np.isnan(p_saturation), np.where(feasible, 0.5, 0.0), p_saturation)
    fields = Observation(
        left_s=np.full(len(arms), fleet.horizon_s - time_s),
        working=working | (modes == ""),
        faulted=modes == "faulted",
        busy_s=busy_s,
        break_in_s=np.array(
            [LONG_S if each is None or each.break_in_s is None else each.break_in_s for each in states]
        ),
        last_award=np.array([last.get(arm, 0) for arm in arms]),
        temp_c=temp_c,
        housing_c=_per_joint(states, "housing_c", temp_c),
        ambient_c=np.where(np.isnan(ambient_c), temp_c.min(axis=1), ambient_c),
        headroom_k=headroom_k,
        error_headroom_k=headroom_k + limits.error_c - limits.warning_c,
        job_value=stated(lambda state: state.job_value),
        job_cycles=stated(lambda state: state.job_cycles_left),
        job_peak_c=stated(lambda state: state.job_peak_c),
        job_p=stated(_risk_of_job),
        group=per_job(_groups(bidding)),
        station_free=per_job(stations),
        blocked=(feasible & ~free).reshape(len(arms), layout.slots, PLANS)[..., 0],
        difficulty=np.where(known, difficulty, np.where(feasible, -1.0, 0.0)),
        peak_c=peak_c,
        p_saturation=p_saturation,
        duration_s=duration_s,
        due_in_s=due_s - time_s,
        age_s=time_s - per_job(queued_s),
        payload_kg=per_job([job.payload_kg for job in bidding.jobs]),
        value=per_job([job.value for job in bidding.jobs]),
        returns=per_job([bidding.returned.get(job.name, (0, 0.0))[0] for job in bidding.jobs]),
        expires=per_job([float(job.expires) for job in bidding.jobs]),
        fleet_age_s=of_all([_age_s(arm, bidding) for arm in arms]),
        fleet_working=of_all(working & ~paused),
        fleet_faulted=of_all((modes == "faulted") | paused),
        fleet_busy_s=of_all(busy_s),
        fleet_headroom_k=of_all(headroom_k),
        fleet_difficulty=of_all(least),
        fleet_duration_s=of_all(duration_s),
        fleet_peak_c=of_all(peak_c),
        fleet_p_saturation=of_all(p_saturation),
        peers=layout.peers,
        action_mask=np.zeros(0),
    )
    # Waiting is always legal; a live fleet has no action to give a job back.
    legal = feasible & free & np.repeat(per_job(stations) > 0, PLANS, axis=-1) & room[:, None]
    mask = np.pad(legal.astype(np.int8), ((0, 0), (1, 1)), constant_values=((0, 0), (1, 0)))
    vectors = layout.pack(fields)
    return layout.read_each(arms, vectors[0, : layout.shared], vectors[:, layout.shared :], mask)


def _groups(bidding: Bidding) -> list[float]:
    """Return a number for each job of the round: jobs that share a station have the same."""
    groups: list[float] = []
    for k, job in enumerate(bidding.jobs):
        alike = [groups[i] for i, other in enumerate(bidding.jobs[:k]) if set(job.stations) & set(other.stations)]
        groups.append(alike[0] if alike else k + 1.0)
    return groups


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


def _plans_of(by_job: Mapping[str, JobEstimate], bidding: Bidding) -> list[PlanQuote | None]:
    """Return the quoted plan of each option of the round."""
    quoted = {name: {plan.plan: plan for plan in offer.plans} for name, offer in by_job.items()}
    return [quoted.get(job.name, {}).get(plan) for job in bidding.jobs for plan in range(PLANS)]


def _per_joint(states: Sequence[State | None], name: str, otherwise_c: Array) -> Array:
    """Return temperatures of the joints by the states, [arm, joint]; `otherwise_c` where a state has none."""
    rows = [() if state is None else getattr(state, name) for state in states]
    return np.array([row if len(row) == JOINTS else other for row, other in zip(rows, otherwise_c, strict=True)])


def _risk_of_job(state: State) -> float:
    """Return P(saturation) of the rest of the current job, 0.5 if unknown, and 0 without one."""
    if not state.job_cycles_left:
        return 0.0
    return 0.5 if state.job_p_saturation is None else state.job_p_saturation


def _age_s(arm: str, bidding: Bidding) -> float:
    """Return the age of the newest message of an arm."""
    quote, state = bidding.quotes.get(arm) or bidding.full.get(arm), bidding.states.get(arm)
    sent_s = [message.time_s for message in (quote, state) if message is not None]
    return max(0.0, bidding.time_s - max(sent_s)) if sent_s else LONG_S
