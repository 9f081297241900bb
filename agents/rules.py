"""Dispatching rules, and policies that assign jobs by a cost matrix [arm, option].

Except `wspt_cool` the rules are non-idling: a free arm that may claim a job does so. Costs are +inf where an arm may
not claim a job; lower is better, and only differences count.

Assignments may pair two jobs that share a station, or two plans that exclude each other. As with any claims, the arm
with the lower difficulty then gets its job, and the other arm chooses again.

Source of the rules: Pinedo, Scheduling, 6th ed., Springer 2022, chapter 14.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from agents.policy import WAIT, legal_options, per_option, plans_of
from agents.staleness import advantage, free_peers, known_difficulty
from fleet.observation import Observation

Array = np.ndarray


class Stateless:
    """A policy without state from step to step."""

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing to reset."""


class RandomLegal:
    """Every free arm claims a random legal job. Scope arm: it reads the arm's own mask."""

    scope: ClassVar = "arm"
    only_choices = True

    def __init__(self) -> None:
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift."""
        self._rng = rng

    def choose(self, observation: Observation, place: int) -> int:
        """A uniform choice among the legal claims; WAIT without one."""
        choices = legal_options(observation)
        return int(self._rng.choice(choices)) + 1 if choices else WAIT


class RoundRobin:
    """The oldest job goes to the next able arm in turn."""

    scope: ClassVar = "central"
    only_choices = True

    def __init__(self) -> None:
        self._turn = 0

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift: the first arm's turn."""
        self._turn = 0

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """One pass over the slots from the oldest job; each goes to the next able arm."""
        arms = list(observations)
        actions = dict.fromkeys(arms, WAIT)
        for slot in range(len(observations[arms[0]].offered)):
            in_turn = [arms[(self._turn + step) % len(arms)] for step in range(len(arms))]
            arm, option = _first_able(in_turn, slot, observations, actions)
            if arm is not None:
                actions[arm] = option + 1
                self._turn = (arms.index(arm) + 1) % len(arms)
        return actions


class CoolestFirst(Stateless):
    """The oldest job goes to the free arm with most headroom."""

    scope: ClassVar = "central"
    only_choices = True

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """One pass over the slots from the oldest job; each goes to the coolest able arm."""
        return oldest_jobs_to(sorted(observations, key=lambda arm: -float(observations[arm].headroom_k)), observations)


class LeastDifficulty(Stateless):
    """The pair of free arm and job with the least difficulty relative to the fleet's average for that job first.

    With absolute difficulties no arm would claim a task that is new to every twin. Scope arm: each arm computes it from
    its own scores, those its peers shared, and its place in the fleet, which breaks ties. Without any score, free arms
    claim the oldest jobs in the fleet's order. `agents.staleness` discounts old messages.
    """

    scope: ClassVar = "arm"
    only_choices = True

    def choose(self, observation: Observation, place: int) -> int:
        """This arm's claim under the assumption that its peers follow the same rule."""
        mine = legal_options(observation)
        if not mine:
            return WAIT
        plans = plans_of(observation)
        slots = list(dict.fromkeys(option // plans for option in mine))
        relative = advantage(observation, place, _open(observation, slots))
        free = free_peers(observation)
        able = ~np.isnan(relative) & np.insert(free, place, True)[:, None]
        for arm, slot in cheapest_pairs(np.where(able, relative, np.inf).round(9)):
            if arm == place:
                return least_difficult(observation, slot) + 1
        if observation.known[mine].any():
            return WAIT
        before = int(free[:place].sum())  # free arms that choose first
        return least_difficult(observation, slots[min(before, len(slots) - 1)]) + 1


class CentralRule(Stateless):
    """Claims of pairs of arm and option by a cost matrix [arm, option], the cheapest pair first.

    Ties go to the older job, then to the first arm. This is a sequential single-item auction with one job per arm.
    """

    scope: ClassVar = "central"

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """The claims of the pairs."""
        if not any(seen.action_mask[1:-1].any() for seen in observations.values()):
            return dict.fromkeys(observations, WAIT)
        seen = list(observations.values())
        return claims_of(observations, self.pairs(self.cost(seen), plans_of(seen[0])))

    def cost(self, observations: Sequence[Observation]) -> Array:
        """Minus the index, [arm, option]; inf where an arm may not claim."""
        legal = [seen.action_mask[1:-1] > 0 for seen in observations]
        return np.where(legal, [-self.index(seen).astype(float) for seen in observations], np.inf)

    def index(self, seen: Observation) -> Array:
        """Index of every option, legal or not, [option]; −inf for those that must not be claimed."""
        raise NotImplementedError

    def pairs(self, cost: Array, plans: int) -> list[tuple[int, int]]:
        """Pairs (arm, option) of a cost matrix [arm, option] of jobs with `plans` options each."""
        return cheapest_pairs(cost, plans)


class Matched:
    """Base of rules that make as many pairs as possible, at the least total cost."""

    def pairs(self, cost: Array, plans: int) -> list[tuple[int, int]]:
        """Pairs (arm, option) of a cost matrix [arm, option] of jobs with `plans` options each."""
        return matched_options(cost, plans)


class Wspt(CentralRule):
    """The pair of free arm and job with the highest value per time first: weighted shortest processing time.

    Optimal for the weighted sum of completion times on one machine (W. E. Smith, Naval Research Logistics Quarterly 3,
    1956), a strong rule on unrelated machines. It ignores temperatures.
    """

    only_choices = True
    most_p = 1.0
    """Largest P(saturation) of a claim."""

    def index(self, seen: Observation) -> Array:
        """Value per second of every option, [option]; −inf for those that must not be claimed."""
        rate = per_option(seen, seen.value) / np.maximum(seen.duration_s, 1.0)
        return np.where(seen.p_saturation <= self.most_p, rate, -np.inf)


class WsptCool(Wspt):
    """As `wspt`, but no arm claims a job in which a motor would more likely than not pass the warning limit.

    Such a job waits until an arm has cooled.
    """

    only_choices = True
    most_p = 0.5


def cheapest_pairs(cost: Array, plans: int = 1) -> list[tuple[int, int]]:
    """Pairs (arm, option) of a cost matrix [arm, option], chosen greedily, the cheapest first.

    Each arm and each slot, which has `plans` options, is in at most one pair; inf is never paired. Ties go to the first
    option, then to the first arm. This is the outcome of a sequential single-item auction with one job per arm
    (Lagoudakis et al. 2005, Robotics: Science and Systems; Koenig et al. 2006, AAAI).
    """
    left, pairs = cost.T.astype(float), list[tuple[int, int]]()  # by option, then by arm: the order of ties
    while left.size:
        option, arm = divmod(int(left.argmin()), len(cost))
        if left[option, arm] == np.inf:
            break
        pairs.append((arm, option))
        first = option - option % plans
        left[:, arm] = left[first : first + plans] = np.inf
    return pairs


def claims_of(observations: Mapping[str, Observation], pairs: list[tuple[int, int]]) -> dict[str, int]:
    """The actions of pairs of arm and option, each by its index; arms in no pair wait."""
    arms = list(observations)
    return dict.fromkeys(arms, WAIT) | {arms[arm]: option + 1 for arm, option in pairs}


def oldest_jobs_to(order: Sequence[str], observations: Mapping[str, Observation]) -> dict[str, int]:
    """Actions after one pass over the slots from the oldest job; each goes to the first able arm of an order."""
    actions = dict.fromkeys(observations, WAIT)
    for slot in range(len(observations[order[0]].offered)):
        arm, option = _first_able(order, slot, observations, actions)
        if arm is not None:
            actions[arm] = option + 1
    return actions


def least_difficult(observation: Observation, slot: int) -> int:
    """The legal option of a slot with the least difficulty; the fastest one if none is known."""
    plans, difficulty = plans_of(observation), np.nan_to_num(known_difficulty(observation), nan=np.inf)
    here = [option for option in legal_options(observation) if option // plans == slot]
    return min(here, key=lambda option: float(difficulty[option]))


def _open(observation: Observation, mine: list[int]) -> Array:
    """Slots that some arm may claim now, bool, [slot]: not empty, and not closed only by a busy station."""
    slots = len(observation.offered)
    may, able = np.isin(np.arange(slots), mine), observation.feasible.reshape(slots, -1).any(axis=1)
    return (observation.offered > 0) & (may | ~able)


def _first_able(
    arms: Sequence[str], slot: int, observations: Mapping[str, Observation], actions: Mapping[str, int]
) -> tuple[str | None, int]:
    """The first of the arms that may claim the slot and has no claim yet, and its fastest legal option."""
    plans = plans_of(observations[arms[0]])
    for arm in arms:
        if actions[arm] == WAIT:
            for option in range(slot * plans, (slot + 1) * plans):
                if observations[arm].action_mask[option + 1]:
                    return arm, option
    return None, -1


RISK = 9.0
"""The cost of a job in which a motor surely passes its warning limit is 1 + RISK times its difficulty."""
LATE_PER_H = 1.0
"""Cost of an hour of tardiness for each unit of a job's value, in units of difficulty."""
TIME_PER_H = 0.01
"""Cost of an hour until the finish: it decides where difficulties are equal."""
COST_DIGITS = 9
"""Costs are rounded to this many digits, so that rounding errors do not break ties."""


def thermal(observations: Sequence[Observation]) -> Array:
    """Difficulty weighted by risk, relative to the fleet's average for that job; late and valuable jobs come first.

    The difficulty is weighted by 1 + RISK · P(saturation). As in `agents.rules.LeastDifficulty` it is relative to the
    average of the arms that may claim the job, and an unknown difficulty equals that average. If no arm has a
    difficulty, the risk decides, then the time until the finish.
    """
    able, one = _able(observations), observations[0]
    difficulty, known = _stack(observations, "difficulty"), _stack(observations, "known") > 0
    difficulty = np.where(known, difficulty, _mean(difficulty, known & able, one, otherwise=1.0))
    tardiness_s = np.maximum(0.0, _busy_s(observations) - _stack(observations, "slack_s"))
    late = LATE_PER_H * per_option(one, _stack(observations, "value")) * tardiness_s / 3600.0
    time = TIME_PER_H * _finish_s(observations) / 3600.0
    cost = difficulty * (1.0 + RISK * _stack(observations, "p_saturation")) + late + time
    # Waiting makes a job late for every arm: the average lateness decides between jobs, not between arms.
    return np.where(able, cost - _mean(cost, able, one) - _mean(late, able, one), np.inf).round(COST_DIGITS)


def quickest(observations: Sequence[Observation]) -> Array:
    """Seconds until the arm would finish the job; heat is ignored."""
    return np.where(_able(observations), _finish_s(observations), np.inf).round(COST_DIGITS)


def _able(observations: Sequence[Observation]) -> Array:
    """Whether the arm may claim the job now, bool, [arm, option]."""
    return np.stack([seen.action_mask[1:-1] for seen in observations]) > 0


def _finish_s(observations: Sequence[Observation]) -> Array:
    """Seconds until the arm would finish the job, after its current one, [arm, option]."""
    return _busy_s(observations) + _stack(observations, "duration_s")


def _busy_s(observations: Sequence[Observation]) -> Array:
    return np.array([[float(seen.busy_s)] for seen in observations])


def _stack(observations: Sequence[Observation], field: str) -> Array:
    return np.stack([np.asarray(getattr(seen, field), dtype=float) for seen in observations])


def _mean(values: Array, where: Array, one: Observation, otherwise: float = 0.0) -> Array:
    """Average over some of the arms and the plans of a job, [option]; the same for all plans of a job.

    Args:
        one: Any observation of the fleet.
    """
    plans = plans_of(one)
    total = np.where(where, values, 0.0).sum(axis=0).reshape(-1, plans).sum(axis=1)
    count = where.sum(axis=0).reshape(-1, plans).sum(axis=1)
    return per_option(one, np.where(count > 0, total / np.maximum(count, 1), otherwise))


class Ssi(CentralRule):
    """Sequential single-item auction: the pair of arm and job with the least thermal cost first."""

    only_choices = True

    def cost(self, observations: Sequence[Observation]) -> Array:
        """[arm, option] of the observations of all arms."""
        return thermal(observations)


class Matching(Matched, Ssi):
    """As many jobs as possible at the least total thermal cost: an optimal matching of arms and jobs."""

    only_choices = True


class QuickestSsi(CentralRule):
    """As `ssi`, by the time until the finish alone."""

    only_choices = True

    def cost(self, observations: Sequence[Observation]) -> Array:
        """[arm, option] of the observations of all arms."""
        return quickest(observations)


class QuickestMatching(Matched, QuickestSsi):
    """As `matching`, by the time until the finish alone."""

    only_choices = True


class Ahead:
    """Base of assignments in which arms that are home soon take part, by the time until they would finish.

    A pair of such an arm claims nothing: its job waits for it, and the next decision finds it free or makes another
    plan. The arm's predicted peak is that from its present temperatures. Whether its space will be free is unknown.
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
            duration_s=np.where(seen.feasible, seen.duration_s + np.float32(late_s), np.float32(0.0)),
        )


class MatchingAhead(Ahead, Matching):
    """As `matching`, with arms that are home soon as well."""

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


TIME_DIGITS = 1
"""Due dates of a job by different arms are equal up to rounding; decimals of a second that count."""


class Fifo(CentralRule):
    """First in, first out: the oldest job of the queue first, to the arm that needs the least time for it."""

    only_choices = True

    def index(self, seen: Observation) -> Array:
        """Place in the queue from its end, then the shorter duration, [option]."""
        return _first_by(per_option(seen, np.arange(len(seen.offered))), seen.duration_s)


class Edd(CentralRule):
    """Earliest due date first, to the arm that needs the least time for the job.

    Optimal for the largest lateness on one machine (Jackson 1955).
    """

    only_choices = True

    def index(self, seen: Observation) -> Array:
        """Minus the time until the due date, then the shorter duration, [option]."""
        return _first_by((seen.slack_s.astype(float) + seen.duration_s).round(TIME_DIGITS), seen.duration_s)


class Spt(QuickestSsi):
    """Shortest processing time first: the claims of `quickest_ssi`, whose arms are all free when they claim.

    Optimal for the sum of completion times on one machine (Smith 1956).
    """

    only_choices = True


class Atc(CentralRule):
    """Apparent tardiness cost: value per time, discounted by exp(−slack / (k · mean duration)) until the slack is 0.

    Without slack it is `wspt`; with much slack the less urgent job waits.

    Source: Vepsalainen & Morton, Management Science 33, 1987; k = 2 as there for little congestion.
    """

    only_choices = True
    look_ahead: ClassVar = 2.0
    """k."""

    def index(self, seen: Observation) -> Array:
        """Value per second times urgency, [option]."""
        duration_s, legal = np.maximum(seen.duration_s, 1.0).astype(float), seen.action_mask[1:-1] > 0
        mean_s = duration_s[legal].mean() if legal.any() else 1.0
        urgency = np.exp(-np.maximum(seen.slack_s, 0.0) / (self.look_ahead * mean_s))
        return per_option(seen, seen.value) / duration_s * urgency


class LeastLoaded:
    """The oldest job goes to the able arm with the least working time in this shift, by the durations of its claimed
    plans.

    The observation does not contain the working time, so the rule adds up the durations of its claims, without those
    that lost.
    """

    scope: ClassVar = "central"
    only_choices = False
    """A lost claim becomes known in the next interval."""

    def __init__(self) -> None:
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift: no arm has worked."""
        self._load_s: dict[str, float] = {}
        self._claimed_s: dict[str, float] = {}

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """One pass over the slots from the oldest job; each goes to the able arm with the least working time."""
        for arm, claimed_s in self._claimed_s.items():
            if arm in observations and observations[arm].last_award < 0:
                self._load_s[arm] -= claimed_s
        self._claimed_s = {}
        if not any(seen.action_mask[1:-1].any() for seen in observations.values()):
            return dict.fromkeys(observations, WAIT)
        actions = oldest_jobs_to(sorted(observations, key=lambda arm: self._load_s.get(arm, 0.0)), observations)
        self._claimed_s = {
            arm: float(observations[arm].duration_s[action - 1]) for arm, action in actions.items() if action != WAIT
        }
        for arm, claimed_s in self._claimed_s.items():
            self._load_s[arm] = self._load_s.get(arm, 0.0) + claimed_s
        return actions


def _first_by(first: Array, then: Array) -> Array:
    """Index by one quantity and, where it is equal, by another; less is better, and both are below 10⁶."""
    return -(first.astype(float) * 1e6 + then)
