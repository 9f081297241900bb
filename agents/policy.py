"""The protocol of policies, which choose actions from observations.

Every policy has a scope. A `central` policy sees the observations of all arms; in a live fleet it runs in the
auctioneer. An `arm` policy sees one observation: an arm's own state and what its peers shared; in a live fleet it runs
in the process of each arm.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from agents.staleness import fleet_as_shared
from fleet.errors import FleetError
from fleet.observation import FIELDS, LazyObservation, Observation

Array = np.ndarray

SHARED = frozenset(field.name for field in FIELDS if field.part == "fleet")
"""Fields of an observation that come by messages of peers."""

SCOPES = ("central", "arm")

WAIT = 0
"""The action that is always legal: wait, or continue the current job."""


class _Resettable(Protocol):
    scope: ClassVar[str]

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift; `rng` is the policy's only source of randomness."""
        ...


class Policy(_Resettable, Protocol):
    """Chooses one option (or WAIT) for every arm: a plan for the job of a slot, see `fleet.observation.Observation`.

    `EveryArm` makes one from a policy of scope `arm` without an `act` of its own.
    """

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """One action per arm: WAIT, k to claim option k - 1 (k = 1 is `observation.difficulty[0]`), or the last action
        to give the current job back after the present cycle."""
        ...


class CellLookahead(Protocol):
    """A simulator of a cell, tied to one of its shifts: `fleet.env.lookahead.Lookahead`, which explains the members."""

    @property
    def simulator(self) -> Any:  # fleet.env.lookahead.CellSimulator
        """Simulates schedules (`agents.schedules.Schedules`) from the time of the last `look`."""
        ...

    @property
    def slot_job(self) -> Array:
        """Jobs in the slots of the observation by their numbers, int [slot], −1 for an empty one."""
        ...

    @property
    def now_s(self) -> float:
        """Time since the shift began."""
        ...

    def with_limits(self, warning_c: float, error_c: float) -> "CellLookahead":
        """The same simulator with other motor limits, °C, for example with a margin."""
        ...

    def look(self, seen: Mapping[str, Observation]) -> Any:  # fleet.env.lookahead.Present
        """Begin at the present."""
        ...


@runtime_checkable
class PlanningPolicy(Protocol):
    """A policy that plans in a simulator of its cell."""

    def plan_in(self, cell: CellLookahead) -> None:
        """Plan in the simulator of a shift; called once before it begins."""
        ...


def no_simulator(name: str) -> FleetError:
    """The error of a policy that plans, where there is no simulator of its cell."""
    return FleetError(
        f"The policy '{name}' needs a simulator of its cell, which is not available here. Use it in `run`, `compare` "
        "and `bounds`. Choose another, for example bid_price."
    )


class ArmPolicy(_Resettable, Protocol):
    """Chooses one option (or WAIT) for one arm; every arm has an instance of its own."""

    def choose(self, observation: Observation, arm_index: int) -> int:
        """WAIT, k to claim option k - 1, or the last action to give the job back.

        Args:
            arm_index: The arm's index in the fleet, for example to break ties.
        """
        ...


class ArrayPolicy:
    """Base of policies that decide for any number of fleets at once, on arrays.

    Without a state a policy has `actions`, with one `decide`. One of scope `arm` has `choose` as well, for one arm.
    """

    scope: ClassVar[str] = "central"

    def __init__(self) -> None:
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift; there is nothing to reset."""

    def actions(self, seen: Observation) -> Array:
        """Actions, int [env, arm], for observations [env, arm]."""
        raise NotImplementedError

    @classmethod
    def decide(cls, policies: Sequence[Any], seen: Observation, arms: Sequence[str]) -> Array:
        """Actions, int [env, arm], for observations [env, arm].

        Args:
            policies: Of each env, of this class and with equal parameters.
            arms: Names of the arms.
        """
        return policies[0].actions(seen)

    def act_in_fleet(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """Actions for one fleet; see `Policy.act`."""
        if only_choices(self) and not any(seen.action_mask[1:-1].any() for seen in observations.values()):  # pyright: ignore
            return dict.fromkeys(observations, WAIT)
        actions = self.decide([self], one_fleet(tuple(observations.values())), tuple(observations))
        return dict(zip(observations, actions[0].tolist(), strict=True))


class CentralArrayPolicy(ArrayPolicy):
    """An `ArrayPolicy` that sees the observations of all arms."""

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """One action per arm; see `Policy`."""
        return self.act_in_fleet(observations)


def one_fleet(observations: Sequence[Observation]) -> Observation:
    """Observations of the arms of a fleet as one, with the axes [1, arm]."""
    return LazyObservation(lambda name: np.stack([getattr(each, name) for each in observations])[None])


class Local(ArrayPolicy):
    """Base of policies of scope `arm`: a central policy that is given the arm's own observation only.

    It needs no message of a peer. Arms may claim the same job; then the env decides, and the others claim again.
    """

    scope: ClassVar = "arm"
    reads_messages: ClassVar = False
    central: ClassVar[type[Policy]]
    """The central policy."""

    def __init__(self) -> None:
        """Make the central policy.

        Raises:
            FleetError: there is none, or it plans in a simulator, which an arm alone does not have.
        """
        central = getattr(self, "central", None)
        if not hasattr(central, "act") or hasattr(central, "plan_in"):
            raise FleetError(
                f"{type(self).__name__} has no central policy that an arm can have alone (got {central!r}). Add to the "
                "class: central = a class with act(observations), without plan_in()."
            )
        self._policy = self.central()

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift."""
        self._policy.reset(rng)

    def choose(self, observation: Observation, arm_index: int) -> int:
        """The action of the central policy for a fleet of this arm; it waits without one."""
        return self._policy.act({"": observation}).get("", WAIT)

    def actions(self, seen: Observation) -> Array:
        """Those of every arm for itself, if the central policy is an `ArrayPolicy` without a state."""
        alone = LazyObservation(lambda name: (field := getattr(seen, name)).reshape(-1, 1, *field.shape[2:]))
        assert isinstance(self._policy, ArrayPolicy)
        return self._policy.actions(alone).reshape(seen.action_mask.shape[:2])


class Shared(ArrayPolicy):
    """Base of policies of scope `arm`: a central policy for all arms, by what they share.

    Every arm decides for itself and for its peers, and makes its own claim. With the same messages all arms come to the
    same decision. A peer without a message, or with none younger than `agents.staleness.EXPIRY_S`, has no plan.
    """

    scope: ClassVar = "arm"
    central: ClassVar[type[ArrayPolicy]]
    """The central policy; it must decide on arrays."""

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift."""
        self._rng = rng
        self._instances: dict[int, ArrayPolicy] = {}

    def choose(self, observation: Observation, arm_index: int) -> int:
        """The arm's own claim."""
        seen = LazyObservation(lambda name: np.asarray(getattr(observation, name))[None])
        return int(self._claims([self.of(arm_index)], seen, np.array([arm_index]))[0])

    @classmethod
    def decide(cls, policies: Sequence[Any], seen: Observation, arms: Sequence[str]) -> Array:
        """The claim of every arm by its own observation."""
        shape = seen.action_mask.shape[:2]
        each = LazyObservation(lambda name: (field := getattr(seen, name)).reshape(math.prod(shape), *field.shape[2:]))
        central = [policy.of(arm_index) for policy in policies for arm_index in range(shape[1])]
        return cls._claims(central, each, np.tile(np.arange(shape[1]), shape[0])).reshape(shape)

    def of(self, arm_index: int) -> ArrayPolicy:
        """The instance of the central policy of the arm with this index."""
        if arm_index not in self._instances:
            self._instances[arm_index] = self.central()
            self._instances[arm_index].reset(self._rng)
        return self._instances[arm_index]

    @classmethod
    def _claims(cls, policies: Sequence[ArrayPolicy], own: Observation, arm_index: Array) -> Array:
        """The claims of some arms, int [n].

        Args:
            policies: Instances of the central policy, [n].
            own: Observations of the arms, [n].
            arm_index: Their indices in their fleets, int [n].
        """
        fleet = fleet_as_shared(own, arm_index)
        arms = [str(arm) for arm in range(fleet.working.shape[1])]
        return cls.central.decide(policies, fleet, arms)[
            np.arange(len(arm_index)), np.minimum(arm_index, len(arms) - 1)
        ]


class EveryArm:
    """Runs an arm policy for all arms: one instance per arm, which sees this arm's observation only."""

    scope: ClassVar = "arm"

    def __init__(self, make: Callable[[], ArmPolicy]) -> None:
        """`make` is the class of the policy."""
        first = make()
        self._make, self.kind = make, type(first)
        if hasattr(first, "plan_in"):
            raise FleetError(f"{self.kind.__name__} has plan_in(), but only scope central gets a simulator.")
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift; the instances draw from one generator, in the order of the arms."""
        self._rng = rng
        self._instances: dict[str, ArmPolicy] = {}

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """The choice of each arm."""
        together = on_arrays({0: self}, tuple(observations))
        if together:
            actions = together(np.zeros(1, dtype=int), one_fleet(tuple(observations.values())))
            return dict(zip(observations, actions[0].tolist(), strict=True))
        known = observations.values() if reads_messages(self) else map(own_only, observations.values())
        return {
            arm: self.of(arm).choose(seen, i) for i, (arm, seen) in enumerate(zip(observations, known, strict=True))
        }

    def of(self, arm: str) -> ArmPolicy:
        """The instance of an arm."""
        if arm not in self._instances:
            self._instances[arm] = self._make()
            self._instances[arm].reset(self._rng)
        return self._instances[arm]


def for_all_arms(make: Callable[[], Policy] | Callable[[], ArmPolicy]) -> Policy:
    """A new policy for all arms; `EveryArm` runs an arm policy without an `act` of its own."""
    policy: Policy | ArmPolicy = make()
    if hasattr(policy, "act"):
        return policy  # pyright: ignore[reportReturnType]  # hasattr does not narrow the type
    return EveryArm(make)  # pyright: ignore[reportArgumentType]


def on_arrays(policies: Mapping[int, Policy], arms: Sequence[str]) -> Callable[[Array, Observation], Array] | None:
    """The actions, int [n, arm], of the policies of some envs, int [n], for their observations [n, arm].

    Args:
        policies: By env, all of one kind.

    Returns:
        None if the policies do not decide on arrays: then call `act` of each.
    """
    first = next(iter(policies.values()), None)
    kind = _kind_of(first)
    if not _decides(kind):
        return None
    each = {e: policy.of(arms[0]) if isinstance(policy, EveryArm) else policy for e, policy in policies.items()}
    given = own_only if isinstance(first, EveryArm) and not reads_messages(first) else lambda seen: seen
    return lambda envs, seen: kind.decide([each[e] for e in envs.tolist()], given(seen), arms)


def _decides(kind: type) -> bool:
    """Whether a class decides on arrays, and no subclass of its replaces the method for one fleet or arm."""
    if issubclass(kind, Local):
        central: Any = kind.central
        if not _decides(central) or central.decide.__func__ is not ArrayPolicy.decide.__func__:
            return False
    for each in kind.__mro__ if issubclass(kind, ArrayPolicy) else ():
        if not vars(each).keys().isdisjoint(("decide", "actions")):
            return True
        if not vars(each).keys().isdisjoint(("act", "choose")):
            return False
    return False


def only_choices(policy: Policy) -> bool:
    """Whether calls of the policy can be skipped while no arm may claim a job, which is nine steps of ten.

    A class declares `only_choices = True` if it then returns WAIT for all arms, draws no random number and changes no
    state. The classes of this package inherit it; other subclasses must declare it again.
    """
    kind = _kind_of(policy)
    inherits = kind.__module__.startswith("agents.")
    return (getattr(kind, "only_choices", False) if inherits else vars(kind).get("only_choices")) is True


def reads_messages(policy: Policy) -> bool:
    """Whether the decisions of a policy depend on messages between arms: the bus affects no other.

    A central policy sees the observations of all arms. A class of scope `arm` declares `reads_messages = False` if it
    reads no field of the fleet; `EveryArm` then refuses these fields.
    """
    return getattr(policy, "scope", "central") == "arm" and getattr(_kind_of(policy), "reads_messages", True)


def own_only(seen: Observation) -> Observation:
    """The observation without what arms share: a policy that declares `reads_messages = False` and reads it fails."""

    def read(name: str) -> Array:
        if name in SHARED:
            raise ValueError(f"The policy declares reads_messages = False, but reads {name}, which its peers send.")
        return getattr(seen, name)

    return LazyObservation(read)


def _kind_of(policy: Policy | None) -> Any:
    """The class of a policy, or of the arm policies that `EveryArm` runs (Any: callers read what it declares)."""
    return policy.kind if isinstance(policy, EveryArm) else type(policy)


def legal_options(observation: Observation) -> Array:
    """Whether an arm may claim each option now, bool [..., option]: oldest job first, then the fastest plan."""
    return observation.action_mask[..., 1:-1] > 0


def plans_of(observation: Observation) -> int:
    """Number of options of a slot."""
    return observation.difficulty.shape[-1] // observation.group.shape[-1]


def per_option(observation: Observation, per_slot: Array) -> Array:
    """Values of slots, [..., slot], for each option, [..., option]."""
    return np.repeat(per_slot, plans_of(observation), axis=-1)


def without_empty(seen: Observation) -> Observation:
    """The observation without trailing slots that are empty in all envs."""
    plans = plans_of(seen)
    legal = seen.action_mask[..., 1:-1].any(axis=(0, 1)).reshape(-1, plans).any(axis=-1)
    used = np.flatnonzero(legal | seen.offered.any(axis=(0, 1)))
    slots = int(used[-1]) + 1 if len(used) else 1
    if slots == seen.offered.shape[-1]:
        return seen
    ends = {"slot": slots, "option": slots * plans}
    short = {field.name: ends[field.axes[-1]] for field in FIELDS if field.axes and field.axes[-1] in ends}
    mask = seen.action_mask[..., [*range(1 + slots * plans), -1]]
    return LazyObservation(lambda name: getattr(seen, name)[..., : short.get(name)], action_mask=mask)
