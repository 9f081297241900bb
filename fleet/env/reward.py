"""Reward terms: named, weighted in the scenario, summed in one place, reported apart."""

from dataclasses import dataclass, fields

import numpy as np

from fleet.sim.state import DONE, State, World

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class RewardWeights:
    """What each term is worth to the fleet; all arms share one reward."""

    finished_value: float = 1.0
    """Per unit of value of a job finished."""
    tardiness: float = -0.01
    """Per unit of value and minute by which a job was finished late."""
    above_warning: float = -0.05
    """Per minute an arm has a motor above the warning limit."""
    faults: float = -5.0
    """Per fault."""
    energy: float = -0.001
    """Per W·h turned to heat."""


TERMS = tuple(f.name for f in fields(RewardWeights))
_UNITS = np.array([1.0, 1.0, 60.0, 1.0, 3600.0])
"""Of the weights: minutes and watt hours where the simulator counts s and J."""


def terms(world: World, before: State, after: State, weights: RewardWeights) -> dict[str, Array]:
    """Weighted reward terms of one step by name, each [env]; their sum is the reward."""
    fresh = (after.status == DONE) & (before.status != DONE)
    value = np.where(fresh, world.jobs.value, 0.0)
    finished_s = np.where(fresh, after.finished_s, 0.0)
    due_s = np.where(fresh, world.jobs.due_s, 0.0)
    late_min = np.maximum(finished_s - due_s, 0.0) / 60.0
    raw = np.stack(
        [
            value.sum(axis=1),
            (value * late_min).sum(axis=1),
            (after.above_warning_s - before.above_warning_s).sum(axis=1),
            (after.faults - before.faults).sum(axis=1),
            (after.energy_j - before.energy_j).sum(axis=1),
        ],
        axis=1,
    )
    scaled = scale(raw, np.array([getattr(weights, name) for name in TERMS]))
    return dict(zip(TERMS, scaled.T, strict=True))


def scale(raw: Array, weights: Array) -> Array:
    """What the terms are worth, [env, term].

    Args:
        raw: Finished value, that value times its minutes of tardiness, s above warning, faults, J, [env, term].
        weights: Of the terms, [term].
    """
    return raw / _UNITS * weights
