"""Dispatching rules. Except `wspt_cool` they are non-idling: a free arm that may claim a job does so."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from agents.policy import WAIT, legal_options, per_option, plans_of
from agents.staleness import Trust, advantage, known_difficulty
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
    """The oldest job goes to the next able arm in turn. Scope central: it reads the mask of every arm."""

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
        for slot in range(_slots(observations)):
            in_turn = [arms[(self._turn + step) % len(arms)] for step in range(len(arms))]
            arm, option = _first_able(in_turn, slot, observations, actions)
            if arm is not None:
                actions[arm] = option + 1
                self._turn = (arms.index(arm) + 1) % len(arms)
        return actions


class CoolestFirst(Stateless):
    """The oldest job goes to the free arm with most headroom. Scope central: it compares all headrooms."""

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

    def __init__(self, trust: Trust | None = None) -> None:
        self._trust = trust or Trust()

    def choose(self, observation: Observation, place: int) -> int:
        """This arm's claim under the assumption that its peers follow the same rule."""
        mine = legal_options(observation)
        if not mine:
            return WAIT
        plans = plans_of(observation)
        slots = list(dict.fromkeys(option // plans for option in mine))
        relative = advantage(observation, place, _open(observation, slots), self._trust)
        free = self._trust.free(observation)
        able = ~np.isnan(relative) & np.insert(free, place, True)[:, None]
        for arm, slot in cheapest_pairs(np.where(able, relative, np.inf).round(9)):
            if arm == place:
                return least_difficult(observation, slot) + 1
        if observation.known[mine].any():
            return WAIT
        before = int(free[:place].sum())  # free arms that choose first
        return least_difficult(observation, slots[min(before, len(slots) - 1)]) + 1


class IndexRule(Stateless):
    """The pair of free arm and job with the highest index first; ties go to the older job, then to the first arm."""

    scope: ClassVar = "central"

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """The claims of the pairs."""
        cost = np.stack(
            [
                np.where(seen.action_mask[1:-1] > 0, -self.index(seen).astype(float), np.inf)
                for seen in observations.values()
            ]
        )
        return claims_of(observations, cheapest_pairs(cost, _plans(observations)))

    def index(self, seen: Observation) -> Array:
        """Index of every option, legal or not, [option]; −inf for those that must not be claimed."""
        raise NotImplementedError


class Wspt(IndexRule):
    """The pair of free arm and job with the highest value per time first: weighted shortest processing time.

    Optimal for the weighted sum of completion times on one machine (W. E. Smith, Naval Research Logistics Quarterly 3,
    1956), a strong rule on unrelated machines. It ignores temperatures. Scope central: it compares the arms' times.
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

    Such a job waits until an arm has cooled. Scope central, as `wspt`.
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
    for slot in range(_slots(observations)):
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


def _slots(observations: Mapping[str, Observation]) -> int:
    return len(next(iter(observations.values())).offered)


def _plans(observations: Mapping[str, Observation]) -> int:
    return plans_of(next(iter(observations.values())))


def _first_able(
    arms: Sequence[str], slot: int, observations: Mapping[str, Observation], actions: Mapping[str, int]
) -> tuple[str | None, int]:
    """The first of the arms that may claim the slot and has no claim yet, and its fastest legal option."""
    plans = _plans(observations)
    for arm in arms:
        if actions[arm] == WAIT:
            for option in range(slot * plans, (slot + 1) * plans):
                if observations[arm].action_mask[option + 1]:
                    return arm, option
    return None, -1
