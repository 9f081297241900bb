"""The proven optimum of a tiny shift, by exhaustive search in the true simulator."""

from itertools import product

import numpy as np

from fleet.engine.batch import Engine, Parts, RewardWeights, empty_parts
from fleet.engine.state import DONE, State
from fleet.engine.step import FINISHED, TOTAL
from fleet.engine.world import World
from fleet.observation import Layout
from scenarios.evaluate.upper_bound import check_signs

Array = np.ndarray
ROWS = 256
"""States that are stepped at a time."""
MOST_STATES = 100_000
"""Most different states at one time."""
_FUTURE = (
    *("temp_c", "mode", "job", "plan", "progress_s", "todo", "clear_at_s", "moved_at_s"),
    *("status", "queued_s", "cycles", "returns", "failed_arm"),
)
"""What decides the rest of a shift; two ways to the same values are one state."""


def optimum(world: World, weights: RewardWeights, at_least: float = -np.inf) -> float:
    """The largest reward that any sequence of actions earns in env 0, or `at_least` if none earns more.

    Every legal action of every arm is tried in every decision interval. A state is left out only if its reward so far
    plus the value of all jobs that are left does not exceed the best reward so far.

    Args:
        at_least: A reward that is known to be possible, which leaves out more.

    Raises:
        ValueError: the shift is too large, or a weight has the wrong sign.
    """
    check_signs(weights)
    shift = world.shifts[0]
    layout = Layout(len(world.arms), world.slots, plans=world.plans_per_job)
    engine = Engine(world.tables, ROWS, layout, weights, jobs=world.jobs)
    rows, parts = np.arange(ROWS), empty_parts(layout, ROWS)
    engine.reset(rows, [shift] * ROWS)
    value = np.zeros(engine.state.jobs.shape[1])
    value[: len(shift.kind)] = weights.finished_value * world.tables.value[0, shift.kind]
    states, rewards, best = [_state_of(engine.state, 0)], [0.0], at_least
    for _ in range(world.ticks):
        children: list[tuple[int, tuple[int, ...]]] = []
        for first in range(0, len(states), ROWS):
            some = states[first : first + ROWS]
            _load(engine, some, parts)
            for n in range(len(some)):
                legal = [np.flatnonzero(engine.mask[n, a]) for a in range(layout.arms)]
                children += [(first + n, tuple(map(int, actions))) for actions in product(*legal)]
        found: dict[bytes, tuple[State, float]] = {}
        for first in range(0, len(children), ROWS):
            some = children[first : first + ROWS]
            _load(engine, [states[parent] for parent, _ in some], parts)
            actions = np.zeros((ROWS, layout.arms), np.int64)
            actions[: len(some)] = [each for _, each in some]
            outcome = engine.step(actions, parts)
            earned, finished = outcome[:, TOTAL], outcome[:, FINISHED] > 0
            left = (np.where(engine.state.status < DONE, 1.0, 0.0) * value).sum(axis=1)
            for n, (parent, _) in enumerate(some):
                reward = rewards[parent] + float(earned[n])
                if finished[n] or engine.state.tick[n] >= world.ticks:
                    best = max(best, reward)
                elif reward + left[n] > best:
                    state = _state_of(engine.state, n)
                    key = b"".join(getattr(state, name).tobytes() for name in _FUTURE)
                    if key not in found or found[key][1] < reward:
                        found[key] = (state, reward)
        if len(found) > MOST_STATES:
            raise ValueError(f"The shift is too large for an exhaustive search: more than {MOST_STATES} states.")
        kept = [(state, reward) for state, reward in found.values()]
        states, rewards = [state for state, _ in kept], [reward for _, reward in kept]
        if not states:
            break
    return best


def _state_of(state: State, row: int) -> State:
    return state.copy(slice(row, row + 1))


def _load(engine: Engine, states: list[State], parts: Parts) -> None:
    """Put states into the first rows, and find their legal actions."""
    for values, *own in zip(engine.state, *states, strict=True):
        values[: len(states)] = np.concatenate(own)
    engine.refresh()
    engine.observe(np.arange(engine.envs), parts)
