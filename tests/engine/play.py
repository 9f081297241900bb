"""Shifts played with given actions."""

import numpy as np

from fleet.engine.shift import Stepped, initial, step
from fleet.events import Event

DT_S = 10.0


def play(world, plant, actions, log=None, state=None) -> list[Stepped]:
    """Play a shift with actions [tick][arm] for all envs; afterwards all arms wait."""
    state = initial(world) if state is None else state
    steps = []
    for tick in range(world.ticks):
        chosen = np.zeros((len(world.shifts), len(world.arms)), dtype=int)
        if tick < len(actions):
            chosen[:] = actions[tick]
        steps.append(step(world, state, chosen, plant, log))
        state = steps[-1].state
    return steps


def times(log: list[Event], kind: str) -> list[float]:
    return [e.time_s for e in log if e.kind == kind]
