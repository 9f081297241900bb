"""Dispatching rules: the ladder's lowest rungs, each with one idea.

All of them keep the fleet busy: an arm that may work does. They differ in who takes which job.
"""

from collections.abc import Callable, Mapping

import numpy as np

from agents.consensus import Consensus
from agents.dispatch import Wspt, WsptCool
from agents.hearsay import Trust, advantage
from agents.policy import WAIT, Policy, legal_slots
from fleet.env.observation import Observation
from fleet.errors import nearest


class RandomLegal:
    """Every free arm claims a random legal job."""

    only_choices = True

    def __init__(self) -> None:
        self._rng = np.random.default_rng(0)

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift."""
        self._rng = rng

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """A uniform choice among the legal claims of each arm; WAIT only where there is none."""
        return {arm: self._choose(obs) for arm, obs in observations.items()}

    def _choose(self, observation: Observation) -> int:
        choices = legal_slots(observation)
        return int(self._rng.choice(choices)) + 1 if choices else WAIT


class RoundRobin:
    """The oldest job goes to the next arm in turn that is free and able."""

    only_choices = True

    def __init__(self) -> None:
        self._turn = 0

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift: the first arm's turn."""
        self._turn = 0

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """Walk the queue from the oldest job, handing each to the next able arm."""
        arms = list(observations)
        actions = dict.fromkeys(arms, WAIT)
        for slot in _slots(observations):
            for step in range(len(arms)):
                arm = arms[(self._turn + step) % len(arms)]
                if actions[arm] == WAIT and observations[arm].action_mask[slot + 1]:
                    actions[arm] = slot + 1
                    self._turn = (self._turn + step + 1) % len(arms)
                    break
        return actions


class CoolestFirst:
    """The oldest job goes to the free arm with most headroom."""

    only_choices = True

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing to begin."""

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """Walk the queue from the oldest job, handing each to the coolest able arm."""
        coolest = sorted(observations, key=lambda arm: -float(observations[arm].headroom_k))
        actions = dict.fromkeys(observations, WAIT)
        for slot in _slots(observations):
            for arm in coolest:
                if actions[arm] == WAIT and observations[arm].action_mask[slot + 1]:
                    actions[arm] = slot + 1
                    break
        return actions


class LeastDifficulty:
    """The pair of free arm and job with the least difficulty first, reckoned against what the fleet finds on average.

    Some work is new to every twin and would be left by all if plain difficulties were compared across jobs; what one
    arm finds harder than the others is what the choice can change. Each arm works this out by itself, from its own
    scores, what its peers told it and its place in the fleet, which settles ties; so the rule needs nobody in the
    middle. Where nobody has a score, free arms take the oldest jobs in the fleet's order. What a peer told a while ago
    counts for less, and a peer not heard for long is not left anything, as `agents.hearsay` has it.
    """

    only_choices = True

    def __init__(self, trust: Trust | None = None) -> None:
        self._trust = trust or Trust()

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing to begin."""

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """Each arm's claim from its own observation."""
        return {arm: self._choose(obs, place) for place, (arm, obs) in enumerate(observations.items())}

    def _choose(self, observation: Observation, place: int) -> int:
        mine = legal_slots(observation)
        if not mine:
            return WAIT
        harder = advantage(observation, place, _open(observation, mine), self._trust)
        free = self._trust.free(observation)
        able = ~np.isnan(harder) & np.insert(free, place, True)[:, None]
        costs = np.where(able, harder, np.inf).round(9)
        while np.isfinite(costs).any():
            slot, arm = np.unravel_index(int(np.argmin(costs.T)), costs.T.shape)  # ties: oldest job, first arm
            if arm == place:
                return int(slot) + 1
            costs[arm, :] = np.inf
            costs[:, slot] = np.inf
        if observation.known[mine].any():
            return WAIT
        before = int(free[:place].sum())  # free arms with the first word
        return mine[min(before, len(mine) - 1)] + 1


def _open(observation: Observation, mine: list[int]) -> np.ndarray:
    """Slots that somebody may claim now, bool, [slot]: not empty, and not one that only its busy station closes."""
    may = np.isin(np.arange(len(observation.offered)), mine)
    return (observation.offered > 0) & (may | (observation.feasible == 0))


def _slots(observations: Mapping[str, Observation]) -> range:
    first = next(iter(observations.values()))
    return range(len(first.offered))


RULES: dict[str, Callable[[], Policy]] = {
    "random": RandomLegal,
    "round_robin": RoundRobin,
    "coolest_first": CoolestFirst,
    "least_difficulty": LeastDifficulty,
    "consensus": Consensus,
    "wspt": Wspt,
    "wspt_cool": WsptCool,
}
"""Policies by the name under which `--policy` knows them."""


def make_policy(name: str) -> Policy:
    """A fresh policy by name.

    Raises:
        ValueError: no such policy; names the nearest one.
    """
    if name not in RULES:
        raise ValueError(f"No policy '{name}'{nearest(name, RULES)}")
    return RULES[name]()
