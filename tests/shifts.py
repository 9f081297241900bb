"""Worlds with other tables, and shifts that are played with arrays of actions."""

import os
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np

from fleet.engine.batch import RewardWeights
from fleet.engine.shift import Episode
from fleet.engine.state import State
from fleet.engine.tables import bits, owned
from fleet.engine.world import World
from fleet.env.allocation_v2 import AllocationEnv


def with_tables(world: World, **fields: np.ndarray) -> World:
    """Return the world with other tables; the least difficulties follow from them."""
    tables = world.tables._replace(**fields)
    least = np.nan_to_num(np.fmin.reduce(tables.work["difficulty"], axis=-1), nan=-1.0)
    return replace(world, tables=owned(tables._replace(least=least)))


def with_work(world: World, **fields: Any) -> World:
    """Return the world with other values of what arms know of their plans, broadcast to [kind, arm, plan]."""
    work = world.tables.work.copy()
    for name, values in fields.items():
        work[name] = values
    return with_tables(world, work=work)


def with_conflicts(world: World, conflicts: np.ndarray) -> World:
    """Return the world in which each plan has its own volume; conflicts are bool [plan, plan]."""
    other = with_work(world, volume=np.maximum(world.tables.work["plan"], 0))
    return with_tables(other, excluded=bits(conflicts))


class Single:
    """An episode in the single environment, step by step.

    Args:
        compiled: Compile the engine, or run it in plain Python.
        options: Of the environment.
    """

    def __init__(self, episode: Episode, weights: RewardWeights | None = None, *, compiled: bool = True, **options):
        options = {"scaled": False, "ahead_s": np.inf, **options}
        with patch.dict(os.environ, {"NUMBA_DISABLE_JIT": "0" if compiled else "1"}):
            self.env = AllocationEnv(lambda seed: episode, weights=weights, **options)
        self.layout, self.engine = self.env.layout, self.env.batch.engine
        _, self.infos = self.env.reset(seed=0)

    @property
    def parts(self) -> tuple[np.ndarray, np.ndarray]:
        shared, own = self.env.batch.parts
        return shared[0], own[0]

    @property
    def state(self) -> State:
        return self.env.truth

    @property
    def mask(self) -> np.ndarray:
        return self.engine.mask[0]

    @property
    def tick(self) -> int:
        return self.env.tick

    def step(self, actions: np.ndarray) -> np.ndarray:
        """Return the outcome of a step, also after the last job is done."""
        self.env.agents = list(self.env.possible_agents)
        outcome, *_ = self.env.advance(dict(zip(self.env.agents, actions.tolist(), strict=True)))
        return outcome
