"""What a policy is: it reads observations and answers with actions.

Every policy has a scope. A `central` one sees the observations of all arms, as an allocator does that has asked them
all; in a live fleet it runs in the auctioneer. An `arm` one sees a single observation: what one arm knows of itself and
what its peers shared; in a live fleet it runs in the process of each arm.
"""

from collections.abc import Callable, Mapping
from typing import ClassVar, Protocol

import numpy as np

from fleet.observation import Observation

SCOPES = ("central", "arm")

WAIT = 0
"""The action that is always legal: wait, or go on with the current job."""


class Policy(Protocol):
    """Chooses one slot (or WAIT) for every arm.

    A policy of scope `arm` is made one with `EveryArm`, unless it brings an `act` of its own.
    """

    scope: ClassVar[str]

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift; `rng` is the policy's only source of randomness."""
        ...

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """One action per arm: WAIT, or k to claim the job in slot k (k = 1 is `observation.difficulty[0]`)."""
        ...


class ArmPolicy(Protocol):
    """Chooses one slot (or WAIT) for one arm; every arm has an instance of its own."""

    scope: ClassVar[str]

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift; `rng` is the policy's only source of randomness."""
        ...

    def choose(self, observation: Observation, place: int) -> int:
        """WAIT, or k to claim the job in slot k.

        Args:
            place: Index of this arm in the fleet, for example to settle ties.
        """
        ...


class EveryArm:
    """Runs an arm policy where all arms are asked: one instance for each arm, each given its own observation only."""

    scope: ClassVar = "arm"

    def __init__(self, make: Callable[[], ArmPolicy]) -> None:
        """Prepare it; `make` is the class of the policy."""
        self._make, self.kind = make, type(make())
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift; the instances draw from one generator, in the order of the arms."""
        self._rng = rng
        self._instances: dict[str, ArmPolicy] = {}

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """What each arm chooses."""
        return {arm: self._of(arm).choose(seen, place) for place, (arm, seen) in enumerate(observations.items())}

    def _of(self, arm: str) -> ArmPolicy:
        if arm not in self._instances:
            self._instances[arm] = self._make()
            self._instances[arm].reset(self._rng)
        return self._instances[arm]


def for_all_arms(make: Callable[[], Policy] | Callable[[], ArmPolicy]) -> Policy:
    """A fresh policy for all arms: an arm policy without an `act` of its own is run by `EveryArm`."""
    policy: Policy | ArmPolicy = make()
    if hasattr(policy, "act"):
        return policy  # pyright: ignore[reportReturnType]  # it has the method
    return EveryArm(make)  # pyright: ignore[reportArgumentType]  # it lacks the other method


def only_choices(policy: Policy) -> bool:
    """Whether the policy need not be asked while no arm may claim anything.

    A class says so with `only_choices = True`: it then answers WAIT for all arms, draws no random number and remembers
    nothing. This saves nine calls of ten. A subclass has to repeat it.
    """
    kind = policy.kind if isinstance(policy, EveryArm) else type(policy)
    return vars(kind).get("only_choices") is True


def legal_slots(observation: Observation) -> list[int]:
    """Slots (from 0) that this arm may claim now, oldest job first."""
    return np.flatnonzero(observation.action_mask[1:]).tolist()
