"""Checks of what a caller of the environment gives."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, TypeGuard

import numpy as np

from fleet.fields import MAX_SEED

Decisions = Literal["interval", "events"]
"""Length of a step: one decision interval, or until an arm may claim a job or passes its warning limit at work."""


_LARGEST = 2**62
IGNORED_OPTION = "options"
"""Option of a reset that the tests of PettingZoo give."""


def seed_of(seed: object) -> np.random.SeedSequence:
    """Seed of a shift.

    Raises:
        ValueError: no integer from 0 to `MAX_SEED`.
    """
    if not _whole(seed) or not 0 <= seed <= MAX_SEED:
        raise ValueError(f"seed must be an integer from 0 to {MAX_SEED} (got {seed!r}).")
    return np.random.SeedSequence(int(seed))


def seeds_of(seed: object, envs: int) -> list[np.random.SeedSequence]:
    """Seeds of a batch: consecutive from one seed (0 follows `MAX_SEED`), one for each env, or random without any.

    Raises:
        ValueError: neither one seed nor one for each env.
    """
    if seed is None:
        return np.random.SeedSequence().spawn(envs)
    if _whole(seed):
        seed_of(seed)
        return [seed_of((int(seed) + e) % (MAX_SEED + 1)) for e in range(envs)]  # as a uint8, 255 + 1 would be 0
    if isinstance(seed, list | tuple | range | np.ndarray) and np.shape(seed) == (envs,):
        return [seed_of(each) for each in seed]
    raise ValueError(f"seed must be one integer or one for each of {envs} envs (got {seed!r}).")


def check_reset_options(options: object, *allowed: str) -> None:
    """Raise a ValueError unless options of a reset are a mapping with no others than the allowed names, or None."""
    if not isinstance(options, Mapping | None):
        raise ValueError(f"options must be a dictionary or None (got {options!r}).")
    if unknown := (options or {}).keys() - {*allowed, IGNORED_OPTION}:
        raise ValueError(
            f"reset() has no option {min(unknown, key=str)!r}. Allowed: {', '.join(allowed) or 'none'}. make_env() and "
            "make_batch() change the scenario."
        )


def at_least_one(name: str, value: object) -> int:
    """A count.

    Raises:
        ValueError: no integer, one below 1, or above 2**62.
    """
    if not _whole(value) or value < 1 or value > _LARGEST:
        raise ValueError(f"{name} must be an integer from 1 to 2**62 (got {value!r}).")
    return int(value)


def switch(name: str, value: object) -> bool:
    """A boolean.

    Raises:
        ValueError: no boolean.
    """
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False (got {value!r}).")
    return bool(value)


def time_from_zero(name: str, value: object) -> float:
    """A time >= 0, or infinity.

    Raises:
        ValueError: no such number.
    """
    if isinstance(value, bool) or not isinstance(value, float | int | np.floating | np.integer) or not value >= 0:
        raise ValueError(f"{name} must be a number of seconds >= 0, or inf (got {value!r}).")
    return float(value)


def check_choice(name: str, value: object, allowed: Iterable[object]) -> None:
    """Raise a ValueError unless the value is one of the allowed ones."""
    if value not in (allowed := tuple(allowed)):
        raise ValueError(f"{name} must be one of {', '.join(map(repr, allowed))} (got {value!r}).")


def actions_of(agents: Sequence[str], actions: object) -> np.ndarray:
    """Action of each agent, int64 [agent]; an omitted agent waits.

    Raises:
        ValueError: no dictionary, an action that is no integer, or one of an agent that is not there.
    """
    if not isinstance(actions, Mapping):
        raise ValueError(f"actions must be a dictionary of agents and their actions (got {actions!r}).")
    if unknown := actions.keys() - set(agents):
        agent_of(agents, min(unknown, key=str))
    return np.array([_integer(agent, actions.get(agent, 0)) for agent in agents], dtype=np.int64)


def agent_of(agents: Sequence[str], agent: object) -> str:
    """A live agent.

    Raises:
        ValueError: there is no such agent; names those that exist.
    """
    if agent not in agents:
        raise ValueError(f"No agent '{agent}' in this fleet. Agents: {', '.join(agents)}.")
    return str(agent)


def _integer(agent: str, action: object) -> int:
    """One integer, also in an array of one element, which some trainers return; no list.

    One beyond 64 bits becomes an action that no action space has, so the agent waits.
    """
    if type(action) is not int:
        value = np.asarray(action if hasattr(action, "__array__") else ())
        if value.size == 1 and np.issubdtype(value.dtype, np.integer):
            action = int(value.reshape(()))
        elif not isinstance(action, int) or isinstance(action, bool):
            raise ValueError(f"The action of '{agent}' must be one integer (got {action!r}).")
    return max(-_LARGEST, min(_LARGEST, int(action)))


def _whole(value: object) -> TypeGuard[int]:
    """Whether it is one integer, of Python or NumPy."""
    if isinstance(value, int):
        return not isinstance(value, bool)
    return isinstance(value, np.integer | np.ndarray) and np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iu"
