"""Claims of `bid_price` with the arms shuffled: how much who does what matters in the suite.

    thermofleet compare --suite test --difficulty oracle --baseline bid_price \
        --policies bid_price,wsept_local,benchmarks/shuffled.py:Shuffled

Each job that `bid_price` lets begin goes to a random one of the free arms that may claim it, by its fastest plan.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from agents.policy import WAIT, CentralArrayPolicy, legal_options, plans_of
from agents.registry import rule_of
from fleet.observation import Observation

Array = np.ndarray
RULE = "bid_price"


class Shuffled(CentralArrayPolicy):
    """The jobs of `RULE`, each given to a random free arm that may claim it."""

    only_choices = True

    def __init__(self) -> None:
        self._rule: Any = rule_of(RULE).kind()  # an array policy
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift."""
        self._rng = rng
        self._rule.reset(rng)

    @classmethod
    def decide(cls, policies: Sequence[Any], seen: Observation, arms: Sequence[str]) -> Array:
        """The claims of each env."""
        rules = [policy._rule for policy in policies]
        claims: Array = rules[0].decide(rules, seen, arms)
        plans = plans_of(seen)
        legal = legal_options(seen).reshape(*claims.shape, -1, plans)
        last = seen.action_mask.shape[-1] - 1
        shuffled = np.full_like(claims, WAIT)
        for env, arm in np.argwhere((claims != WAIT) & (claims != last)).tolist():
            slot = (claims[env, arm] - 1) // plans
            free = np.flatnonzero(legal[env, :, slot].any(axis=-1) & (shuffled[env] == WAIT))
            if len(free):
                taker = int(policies[env]._rng.choice(free))
                shuffled[env, taker] = 1 + slot * plans + int(legal[env, taker, slot].argmax())
        return shuffled
