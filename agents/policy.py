"""What a policy is: it sees what the arms know, and says what each of them does."""

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from fleet.env.observation import Observation

WAIT = 0
"""The action that is always legal: wait, or go on with the job in hand."""


class Policy(Protocol):
    """Chooses one slot (or WAIT) for every arm."""

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift; `rng` is the policy's only source of chance."""
        ...

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """One action per arm: WAIT, or k to claim the job in slot k (k = 1 is `observation.difficulty[0]`)."""
        ...


def legal_slots(observation: Observation) -> list[int]:
    """Slots (from 0) that this arm may claim now, oldest job first."""
    return np.flatnonzero(observation.action_mask[1:]).tolist()
