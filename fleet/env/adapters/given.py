"""What adapters are given, checked before a trainer stumbles over it."""

from typing import Any

from gymnasium import spaces
from pettingzoo import ParallelEnv

from fleet.env.vector import BatchEnv

_KEYS = {"observation", "action_mask"}


def batch_for(taker: str, given: Any) -> BatchEnv:
    """A batch, or what wraps one.

    Raises:
        ValueError: it is neither.
    """
    if not all(hasattr(given, name) for name in ("num_envs", "autoreset", "layout")):
        raise ValueError(f"{taker} takes a batch, as scenarios.make_batch() makes it (got {given!r}).")
    return given


def env_for(taker: str, given: Any) -> ParallelEnv[str, Any, Any]:
    """An environment of one shift, with the masks in the observations.

    Raises:
        ValueError: it is none, or the masks are not there.
    """
    if not isinstance(given, ParallelEnv):
        raise ValueError(f"{taker} takes an environment, as scenarios.make_env() makes it (got {given!r}).")
    space = given.observation_space(given.possible_agents[0])
    if not isinstance(space, spaces.Dict) or set(space.keys()) != _KEYS:
        raise ValueError(f"{taker} needs the masks in the observations: make the environment with mask_in='obs'.")
    return given
