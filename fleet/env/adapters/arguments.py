"""Import of trainers, checks of the environments and batches given to adapters, and the infos that they pass on."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gymnasium import spaces
from pettingzoo import ParallelEnv

from fleet.engine.batch import TERMS
from fleet.env.vector import BatchEnv
from fleet.errors import install

# Any: PettingZoo, Gymnasium and the trainers leave the types of observations, actions and infos open.
Env = ParallelEnv[str, Any, Any]
ByArm = dict[str, Any]
Infos = dict[str, Any]

ARM_INFOS = ("faults", "illegal", "peak_c", "above_warning_s")
TEAM_INFOS = ("jobs_done", "elapsed_s", *(f"reward_{term}" for term in TERMS))
"""Infos of `BatchEnv.step` that are numbers, per arm and per team."""


@contextmanager
def imported_trainer(extra: str, constraints: str) -> Iterator[None]:
    """Name the command that installs a trainer in the error of an import without it."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{error}: {install(extra, constraints)}.", name=error.name) from error


def check_batch(adapter: str, batch: object, *, autoreset: bool | None = None) -> BatchEnv:
    """The batch, or a wrapper of one.

    Args:
        autoreset: Value that the adapter needs; None for any.

    Raises:
        ValueError: it is neither, or resets otherwise.
    """
    if not all(hasattr(batch, name) for name in ("num_envs", "autoreset", "layout")):
        raise ValueError(f"{adapter} takes a batch made by thermofleet.make_batch() (got {batch!r}).")
    checked: Any = batch  # by the attributes above
    if autoreset is not None and checked.autoreset != autoreset:
        raise ValueError(
            f"{adapter} needs a batch made with autoreset={autoreset} (got a batch with autoreset={checked.autoreset})."
        )
    return checked


def check_env(adapter: str, env: object) -> Env:
    """The environment, with the masks in the observations.

    Raises:
        ValueError: it is not a `ParallelEnv`, or the masks are not there.
    """
    if not isinstance(env, ParallelEnv):
        raise ValueError(f"{adapter} takes an environment made by thermofleet.make_env() (got {env!r}).")
    space = env.observation_space(env.possible_agents[0])
    if not isinstance(space, spaces.Dict) or set(space.keys()) != {"observation", "action_mask"}:
        raise ValueError(f"{adapter} needs the masks in the observations: make the environment with mask_in='obs'.")
    return env


def arm_space(env: Env, arm: str) -> spaces.Dict:
    """Observation space of an arm of an environment checked by `check_env`."""
    space = env.observation_space(arm)
    assert isinstance(space, spaces.Dict)
    return space
