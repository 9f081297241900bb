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


def terms(world: World, before: State, after: State, weights: RewardWeights) -> dict[str, Array]:
    """Weighted reward terms of one step by name, each [env]; their sum is the reward."""
    fresh = (after.status == DONE) & (before.status != DONE)
    value = np.where(fresh, world.jobs.value, 0.0)
    finished_s = np.where(fresh, after.finished_s, 0.0)
    due_s = np.where(fresh, world.jobs.due_s, 0.0)
    late_min = np.maximum(finished_s - due_s, 0.0) / 60.0
    raw = {
        "finished_value": value.sum(axis=1),
        "tardiness": (value * late_min).sum(axis=1),
        "above_warning": (after.above_warning_s - before.above_warning_s).sum(axis=1) / 60.0,
        "faults": (after.faults - before.faults).sum(axis=1).astype(float),
        "energy": (after.energy_j - before.energy_j).sum(axis=1) / 3600.0,
    }
    return {name: getattr(weights, name) * raw[name] for name in TERMS}
