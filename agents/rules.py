"""Dispatching rules, and policies that assign jobs by costs [env, arm, option].

Except `wspt_cool` the rules are non-idling: a free arm that may claim a job does so. Costs are +inf where an arm may
not claim a job; lower is better, and only differences count.

Assignments may pair two jobs that share a station, or two plans that exclude each other. As with any claims, the arm
with the lower difficulty then gets its job, and the other arm chooses again.

Source of the rules: Pinedo, Scheduling, 6th ed., Springer 2022, chapter 14.
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np

from agents.policy import WAIT, ArrayPolicy, CentralArrayPolicy, legal_options, one_fleet, per_option, plans_of
from agents.staleness import advantage, free_peers, in_fleet, known_difficulty
from fleet.observation import LazyObservation, Observation

Array = np.ndarray

NONE = -1
"""Option of an arm that claims nothing; the action of an option is one more."""


class RandomLegal(ArrayPolicy):
    """Every free arm claims a random legal job. Scope arm: it reads the arm's own mask."""

    scope: ClassVar = "arm"
    reads_messages: ClassVar = False
    only_choices = True

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift."""
        self._rng = rng

    def choose(self, observation: Observation, arm_index: int) -> int:
        """A uniform choice among the legal claims; WAIT without one."""
        return int(self.decide([self], one_fleet([observation]), ("",))[0, 0])

    @classmethod
    def decide(cls, policies: Sequence[Any], seen: Observation, arms: Sequence[str]) -> Array:
        """Those of every arm, in the order of the arms."""
        legal = legal_options(seen)
        actions = np.full(legal.shape[:2], WAIT)
        for env, arm in np.argwhere(legal.any(axis=-1)).tolist():
            options = legal[env, arm].nonzero()[0]
            actions[env, arm] = 1 + options[policies[env]._rng.integers(len(options))]
        return actions


class RoundRobin(CentralArrayPolicy):
    """The oldest job goes to the next able arm in turn."""

    only_choices = True

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift: the first arm's turn."""
        self._turn = 0

    @classmethod
    def decide(cls, policies: Sequence[Any], seen: Observation, arms: Sequence[str]) -> Array:
        """One pass over the slots from the oldest job; each goes to the next able arm."""
        turn = np.array([policy._turn for policy in policies])
        rank = (np.arange(len(arms)) - turn[:, None]) % len(arms)
        actions = oldest_jobs_to(rank, seen, in_turn=True)
        for policy, first in zip(policies, rank.argmin(axis=1).tolist(), strict=True):
            policy._turn = first
        return actions


class CoolestFirst(CentralArrayPolicy):
    """The oldest job goes to the free arm with most headroom."""

    only_choices = True

    def actions(self, seen: Observation) -> Array:
        """One pass over the slots from the oldest job; each goes to the coolest able arm."""
        return oldest_jobs_to(_ranks(-seen.headroom_k), seen)


class LeastDifficulty(ArrayPolicy):
    """The pair of free arm and job with the least difficulty relative to the fleet's average for that job first.

    With absolute difficulties no arm would claim a task that is new to every twin. Scope arm: each arm computes it from
    its own scores, those its peers shared, and its index in the fleet, which breaks ties. Without any score, free arms
    claim the oldest jobs in the fleet's order. `agents.staleness` discounts old messages.
    """

    scope: ClassVar = "arm"
    only_choices = True

    def choose(self, observation: Observation, arm_index: int) -> int:
        """This arm's claim under the assumption that its peers follow the same rule."""
        return int(_claims_of_arms(one_fleet([observation]), np.array([arm_index]))[0, 0])

    def actions(self, seen: Observation) -> Array:
        """The claim of every arm by its own observation."""
        return _claims_of_arms(seen, np.arange(seen.action_mask.shape[1]))


def _claims_of_arms(seen: Observation, arm_indices: Array) -> Array:
    """Actions of `LeastDifficulty`, int [env, arm], of the arms with these indices, int [arm]."""
    actions = np.full(seen.action_mask.shape[:2], WAIT)
    env, arm = np.nonzero(legal_options(seen).any(axis=-1))
    if not len(env):
        return actions
    own, arm_index = LazyObservation(lambda name: getattr(seen, name)[env, arm]), arm_indices[arm]  # [n, …]
    legal, slots = legal_options(own), own.offered.shape[-1]
    may, able = (each.reshape(len(env), slots, -1).any(axis=-1) for each in (legal, own.feasible > 0))
    # Not empty, and not closed only by a busy station.
    relative = advantage(own, arm_index, (own.offered > 0) & (may | ~able))
    free = free_peers(own)
    able = ~np.isnan(relative) & in_fleet(free, arm_index, True)[..., None]
    mine = np.minimum(arm_index, free.shape[-1])
    slot = cheapest_options(np.where(able, relative, np.inf).round(9))[np.arange(len(env)), mine]
    before = (free & (np.arange(free.shape[-1]) < arm_index[:, None])).sum(axis=-1)  # free arms that choose first
    in_order = (may & (may.cumsum(axis=-1) > np.minimum(before, may.sum(axis=-1) - 1)[:, None])).argmax(axis=-1)
    unknown = ~(legal & (own.known > 0)).any(axis=-1)
    slot = np.where((slot == NONE) & unknown, in_order, slot)
    actions[env, arm] = 1 + np.where(slot == NONE, NONE, least_difficult(own, slot))
    return actions


class CentralRule(CentralArrayPolicy):
    """Claims of pairs of arm and option by costs [env, arm, option], the cheapest pair first.

    Ties go to the older job, then to the first arm. This is a sequential single-item auction with one job per arm.
    """

    only_choices = True

    def actions(self, seen: Observation) -> Array:
        """The claims of the pairs."""
        return 1 + self.options(self.cost(seen), plans_of(seen))

    def cost(self, seen: Observation) -> Array:
        """Minus the index, [env, arm, option]; inf where an arm may not claim."""
        return np.where(legal_options(seen), -self.index(seen).astype(float), np.inf)

    def index(self, seen: Observation) -> Array:
        """Index of every option, legal or not, [env, arm, option]; −inf for those that must not be claimed."""
        raise NotImplementedError

    def options(self, cost: Array, plans: int) -> Array:
        """The option of each arm or NONE, int [env, arm], by costs of jobs with `plans` options each."""
        return cheapest_options(cost, plans)


class Matched:
    """Base of rules that make as many pairs as possible, at the least total cost."""

    def options(self, cost: Array, plans: int) -> Array:
        """The option of each arm or NONE, int [env, arm], by costs of jobs with `plans` options each."""
        return each_env(matching, cost, plans)


class Wspt(CentralRule):
    """The pair of free arm and job with the highest value per time first: weighted shortest processing time.

    Optimal for the weighted sum of completion times on one machine (W. E. Smith, Naval Research Logistics Quarterly 3,
    1956), a strong rule on unrelated machines. It ignores temperatures.
    """

    most_p = 1.0
    """Largest P(saturation) of a claim."""

    def index(self, seen: Observation) -> Array:
        """Value per second of every option, [env, arm, option]; −inf for those that must not be claimed."""
        rate = per_option(seen, seen.value) / np.maximum(seen.duration_s, 1.0)
        return np.where(seen.p_saturation <= self.most_p, rate, -np.inf)


class WsptCool(Wspt):
    """As `wspt`, but no arm claims a job in which a motor would more likely than not pass the warning limit.

    Such a job waits until an arm has cooled.
    """

    most_p = 0.5


def cheapest_options(cost: Array, plans: int = 1) -> Array:
    """Options of arms by costs [..., arm, option], chosen greedily, the cheapest pair first: int [..., arm] or NONE.

    Each arm and each slot, which has `plans` options, is in at most one pair; inf is never paired. Ties go to the first
    option, then to the first arm. This is the outcome of a sequential single-item auction with one job per arm
    (Lagoudakis et al. 2005, Robotics: Science and Systems; Koenig et al. 2006, AAAI).
    """
    if not cost.size:
        return np.full(cost.shape[:-1], NONE)
    arms, options = cost.shape[-2:]
    left = np.swapaxes(cost, -1, -2).reshape(-1, options, arms).astype(float)  # the order of ties
    chosen, row = np.full((len(left), arms), NONE), np.arange(len(left))
    while left.size:
        option, arm = np.divmod(left.reshape(len(left), -1).argmin(axis=1), arms)
        paired = left[np.arange(len(left)), option, arm] != np.inf
        if not paired.all():
            left, row, option, arm = left[paired], row[paired], option[paired], arm[paired]
        chosen[row, arm], each = option, np.arange(len(row))
        left[each, :, arm] = np.inf
        left.reshape(len(row), options // plans, plans, arms)[each, option // plans] = np.inf
    return chosen.reshape(cost.shape[:-1])


def oldest_jobs_to(rank: Array, seen: Observation, *, in_turn: bool = False) -> Array:
    """Actions, int [env, arm], after one pass over the slots from the oldest job; each goes to the first able arm.

    Args:
        rank: Order of the arms, int [env, arm], from 0.
        in_turn: Whether the arm after the last one that gets a job is then the first; `rank` is changed.
    """
    envs, arms = rank.shape
    legal = legal_options(seen).reshape(envs, arms, -1, plans_of(seen))
    may = np.any(legal, axis=-1)
    actions = np.full((envs, arms), WAIT)
    for slot in np.unique(may.nonzero()[2]).tolist():
        order = np.where(may[:, :, slot] & (actions == WAIT), rank, arms)
        arm = order.argmin(axis=1)
        env = np.flatnonzero(order[np.arange(envs), arm] < arms)
        arm = arm[env]
        actions[env, arm] = 1 + slot * legal.shape[-1] + legal[env, arm, slot].argmax(axis=-1)
        if in_turn:
            rank[env] = (rank[env] - rank[env, arm][:, None] - 1) % arms
    return actions


def _ranks(values: Array) -> Array:
    """Rank of each arm by a value, the least first, int [env, arm]; ties: the first arm."""
    return values.argsort(axis=-1, kind="stable").argsort(axis=-1)


UNKNOWN = 1e9
"""More than any difficulty."""


def least_difficult(seen: Observation, slot: Array) -> Array:
    """The legal option of a slot with the least difficulty, int [...]; the fastest one if none is known.

    Args:
        slot: With a legal option, int [...].
    """
    plans, known = plans_of(seen), np.nan_to_num(known_difficulty(seen), nan=UNKNOWN)
    here = np.where(legal_options(seen), known, np.inf)
    of_slot = np.take_along_axis(here, slot[..., None] * plans + np.arange(plans), axis=-1)
    return slot * plans + of_slot.argmin(axis=-1)


RISK = 9.0
"""The cost of a job in which a motor surely passes its warning limit is 1 + RISK times its difficulty."""
LATE_PER_H = 1.0
"""Cost of an hour of tardiness for each unit of a job's value, in units of difficulty."""
TIME_PER_H = 0.01
"""Cost of an hour until the finish: it decides where difficulties are equal."""
COST_DIGITS = 9
"""Costs are rounded to this many digits, so that rounding errors do not break ties."""


def thermal(seen: Observation) -> Array:
    """Difficulty weighted by risk, relative to the fleet's average for that job; late and valuable jobs come first.

    The difficulty is weighted by 1 + RISK · P(saturation). As in `agents.rules.LeastDifficulty` it is relative to the
    average of the arms that may claim the job, and an unknown difficulty equals that average. If no arm has a
    difficulty, the risk decides, then the time until the finish.

    Args:
        seen: Observations [env, arm].

    Returns:
        Cost [env, arm, option], inf where an arm may not claim.
    """
    able, plans = legal_options(seen), plans_of(seen)
    difficulty, known = seen.difficulty.astype(float), seen.known > 0
    difficulty = np.where(known, difficulty, _mean(difficulty, known & able, plans, otherwise=1.0))
    tardiness_s = np.maximum(0.0, _busy_s(seen) - seen.slack_s)
    late = LATE_PER_H * per_option(seen, seen.value.astype(float)) * tardiness_s / 3600.0
    time = TIME_PER_H * _finish_s(seen) / 3600.0
    cost = difficulty * (1.0 + RISK * seen.p_saturation.astype(float)) + late + time
    # Waiting makes a job late for every arm: the average lateness decides between jobs, not between arms.
    return np.where(able, cost - _mean(cost, able, plans) - _mean(late, able, plans), np.inf).round(COST_DIGITS)


def quickest(seen: Observation) -> Array:
    """Seconds until the arm would finish the job; heat is ignored. Arguments and shape as of `thermal`."""
    return np.where(legal_options(seen), _finish_s(seen), np.inf).round(COST_DIGITS)


def _finish_s(seen: Observation) -> Array:
    """Seconds until the arm would finish the job, after its current one, [env, arm, option]."""
    return _busy_s(seen) + seen.duration_s


def _busy_s(seen: Observation) -> Array:
    return seen.busy_s.astype(float)[..., None]


def _mean(values: Array, where: Array, plans: int, otherwise: float = 0.0) -> Array:
    """Average over some of the arms and the plans of a job, [env, 1, option]; the same for all plans of a job."""
    shape = (len(values), 1, -1, plans)
    total = np.where(where, values, 0.0).sum(axis=1).reshape(shape).sum(axis=-1)
    count = where.sum(axis=1).reshape(shape).sum(axis=-1)
    return np.repeat(np.where(count > 0, total / np.maximum(count, 1), otherwise), plans, axis=-1)


class Ssi(CentralRule):
    """Sequential single-item auction: the pair of arm and job with the least thermal cost first."""

    def cost(self, seen: Observation) -> Array:
        """[env, arm, option]."""
        return thermal(seen)


class Matching(Matched, Ssi):
    """As many jobs as possible at the least total thermal cost: an optimal matching of arms and jobs."""


class QuickestSsi(CentralRule):
    """As `ssi`, by the time until the finish alone."""

    def cost(self, seen: Observation) -> Array:
        """[env, arm, option]."""
        return quickest(seen)


class QuickestMatching(Matched, QuickestSsi):
    """As `matching`, by the time until the finish alone."""


class Ahead:
    """Base of assignments in which arms that are home soon take part, by the time until they would finish.

    A pair of such an arm claims nothing: its job waits for it, and the next decision finds it free or makes another
    plan. The arm's predicted peak is that from its present temperatures. Whether its space will be free is unknown.
    """

    soon_s: ClassVar = 120.0
    """Longest time until such an arm is home."""

    def actions(self, seen: Observation) -> Array:
        """The claims of the pairs whose arm is free."""
        actions: Array = super().actions(self._soon(seen))  # pyright: ignore
        legal = np.take_along_axis(seen.action_mask, actions[..., None], axis=-1)[..., 0]
        return np.where(legal > 0, actions, WAIT)

    def _soon(self, seen: Observation) -> Observation:
        """The observations; of arms that are home soon with the claims that they could make, and their times then."""
        soon = (seen.working > 0) & (seen.busy_s <= self.soon_s)
        mask, late_s = seen.action_mask.copy(), np.where(soon, seen.busy_s, 0)[..., None]
        could = (seen.feasible > 0) & (per_option(seen, seen.station_free) > 0)
        mask[..., 1:-1] = np.where(soon[..., None], could, mask[..., 1:-1])
        return LazyObservation(
            lambda name: getattr(seen, name),
            action_mask=mask,
            busy_s=np.where(soon, 0, seen.busy_s),
            duration_s=np.where(seen.feasible, seen.duration_s + late_s, 0),
        )


class MatchingAhead(Ahead, Matching):
    """As `matching`, with arms that are home soon as well."""


def each_env(pairs: Callable[[Array], list[tuple[int, int]]], cost: Array, plans: int) -> Array:
    """The option of each arm or NONE, int [..., arm], by an assignment of arms and slots in each env.

    Args:
        pairs: Pairs (arm, slot) by costs [arm, slot]; each arm has the cheapest plan for its job.
        cost: [..., arm, option].
    """
    if not cost.size:
        return np.full(cost.shape[:-1], NONE)
    by_slot = cost.reshape(-1, cost.shape[-2], cost.shape[-1] // plans, plans)
    best, least = by_slot.argmin(axis=-1), by_slot.min(axis=-1)
    chosen = np.full(least.shape[:2], NONE)
    for env in np.flatnonzero(np.isfinite(least).any(axis=(1, 2))).tolist():
        for arm, slot in pairs(least[env]):
            chosen[env, arm] = slot * plans + best[env, arm, slot]
    return chosen.reshape(cost.shape[:-1])


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


TIME_DIGITS = 1
"""Due dates of a job by different arms are equal up to rounding; decimals of a second that count."""


class Fifo(CentralRule):
    """First in, first out: the oldest job of the queue first, to the arm that needs the least time for it."""

    def index(self, seen: Observation) -> Array:
        """Place in the queue from its end, then the shorter duration, [env, arm, option]."""
        return _first_by(per_option(seen, np.arange(seen.offered.shape[-1])), seen.duration_s)


class Edd(CentralRule):
    """Earliest due date first, to the arm that needs the least time for the job.

    Optimal for the largest lateness on one machine (Jackson 1955).
    """

    def index(self, seen: Observation) -> Array:
        """Minus the time until the due date, then the shorter duration, [env, arm, option]."""
        return _first_by((seen.slack_s.astype(float) + seen.duration_s).round(TIME_DIGITS), seen.duration_s)


class Spt(QuickestSsi):
    """Shortest processing time first: the claims of `quickest_ssi`, whose arms are all free when they claim.

    Optimal for the sum of completion times on one machine (Smith 1956).
    """


class Atc(CentralRule):
    """Apparent tardiness cost: value per time, discounted by exp(−slack / (k · mean duration)) until the slack is 0.

    Without slack it is `wspt`; with much slack the less urgent job waits.

    Source: Vepsalainen & Morton, Management Science 33, 1987; k = 2 as there for little congestion.
    """

    look_ahead: ClassVar = 2.0
    """k."""

    def index(self, seen: Observation) -> Array:
        """Value per second times urgency, [env, arm, option]."""
        duration_s, legal = np.maximum(seen.duration_s, 1.0).astype(float), legal_options(seen)
        count = legal.sum(axis=-1, keepdims=True)
        mean_s = np.where(
            count > 0, np.where(legal, duration_s, 0.0).sum(axis=-1, keepdims=True) / np.maximum(count, 1), 1.0
        )
        urgency = np.exp(-np.maximum(seen.slack_s, 0.0) / (self.look_ahead * mean_s))
        return per_option(seen, seen.value) / duration_s * urgency


class LeastLoaded(CentralArrayPolicy):
    """The oldest job goes to the able arm with the least working time in this shift, by the durations of its claimed
    plans.

    The observation does not contain the working time, so the rule adds up the durations of its claims, without those
    that lost.
    """

    only_choices = False
    """A lost claim becomes known in the next interval."""

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift: no arm has worked."""
        self._load_s: dict[str, float] = {}
        self._claimed_s: dict[str, float] = {}

    @classmethod
    def decide(cls, policies: Sequence[Any], seen: Observation, arms: Sequence[str]) -> Array:
        """One pass over the slots from the oldest job; each goes to the able arm with the least working time."""
        for env, policy in enumerate(policies):
            for arm, claimed_s in policy._claimed_s.items():
                if arm in arms and seen.last_award[env, arms.index(arm)] < 0:
                    policy._load_s[arm] -= claimed_s
            policy._claimed_s = {}
        if not seen.action_mask[..., 1:-1].any():
            return np.full(seen.action_mask.shape[:2], WAIT)
        load_s = np.array([[policy._load_s.get(arm, 0.0) for arm in arms] for policy in policies])
        actions = oldest_jobs_to(_ranks(load_s), seen)
        for env, arm in np.argwhere(actions != WAIT).tolist():
            policy, claimed_s = policies[env], float(seen.duration_s[env, arm, actions[env, arm] - 1])
            policy._claimed_s[arms[arm]] = claimed_s
            policy._load_s[arms[arm]] = policy._load_s.get(arms[arm], 0.0) + claimed_s
        return actions


def _first_by(first: Array, then: Array) -> Array:
    """Index by one quantity and, where it is equal, by another; less is better, and both are below 10⁶."""
    return -(first.astype(float) * 1e6 + then)
