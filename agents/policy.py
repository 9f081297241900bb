"""What a policy is: it sees what the arms know, and says what each of them does."""

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from fleet.env.observation import Observation

WAIT = 0
"""The action that is always legal: wait, or go on with the job in hand."""


class Policy(Protocol):
    """Chooses one slot (or WAIT) for every arm.

    One that has nothing to do where there is nothing to choose may say so: see `only_choices`.
    """

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift; `rng` is the policy's only source of chance."""
        ...

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """One action per arm: WAIT, or k to claim the job in slot k (k = 1 is `observation.difficulty[0]`)."""
        ...


def only_choices(policy: Policy) -> bool:
    """Whether the class says `only_choices = True` of itself: where no arm may claim anything, `act` answers WAIT for
    all of them, draws nothing and remembers nothing, so it need not be asked then, nine times of ten.

    A class that is made of another has to say so again.
    """
    return vars(type(policy)).get("only_choices") is True


def legal_slots(observation: Observation) -> list[int]:
    """Slots (from 0) that this arm may claim now, oldest job first."""
    return np.flatnonzero(observation.action_mask[1:]).tolist()
