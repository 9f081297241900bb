"""Shifts of a split of the suite as batches, for a learner of scores of pairs: one batched environment per instance."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agents.pair_scores import claims, scores
from agents.policy import WAIT
from fleet.engine.reward import RewardWeights
from fleet.env.vector import BatchEnv, Library
from scenarios.fault_price import weights_of
from scenarios.prepare.fleet import RISK, DifficultyName, RiskName, prepare
from scenarios.progress import Count, Progress, quiet
from scenarios.run.batch import library_of
from scenarios.suite.splits import Instance, split

Array = np.ndarray

SHIFTS = 4
"""Shifts of a validation instance: that of its own seed, and others."""


@dataclass(frozen=True, eq=False)
class Ground:
    """One instance, ready for batches of its shifts."""

    name: str
    seed: int
    """Of the instance itself."""
    library: Library
    weights: RewardWeights

    @property
    def shifts(self) -> list[int]:
        """Seeds of its shifts in validation: its own, and the next ones."""
        return [*range(self.seed, self.seed + SHIFTS)]

    @property
    def arms(self) -> int:
        """Number of arms."""
        return len(self.library.arms)

    def value(self, seed: int) -> float:
        """Value of all jobs that arrive in the shift of a seed: the unit of a fitness, so that instances are alike."""
        shift = self.library.draw(np.random.SeedSequence(seed))
        return max(float(self.library.tables.value[shift.fleet, shift.kind].sum()), 1.0)


def ground_of(
    instance: Instance,
    *,
    difficulty: DifficultyName = "oracle",
    risk: RiskName = RISK,
    cache: Path | None = None,
) -> Ground:
    """Prepare an instance; its cell is prepared once."""
    fleet = prepare(instance.scenario, difficulty=difficulty, risk=risk, cache=cache)
    weights = weights_of(instance.scenario)
    return Ground(instance.name, instance.seed, library_of(fleet), weights)


def grounds_of(
    name: str,
    count: int,
    *,
    difficulty: DifficultyName = "oracle",
    risk: RiskName = RISK,
    cache: Path | None = None,
    progress: Progress = quiet,
) -> list[Ground]:
    """The first instances of a split, in turns of its cells.

    Raises:
        ScenarioError: there is no such split.
    """
    grounds: list[Ground] = []
    for instance in split(name)[:count]:
        progress(f"preparing {instance.name}", Count(len(grounds), count))
        grounds.append(ground_of(instance, difficulty=difficulty, risk=risk, cache=cache))
    return grounds


def rewards(ground: Ground, parameters: Array, seeds: Sequence[int]) -> Array:
    """Reward of one shift for each row of parameters and its seed, [row].

    Perfect and immediate messages; decisions are asked for by events, which changes no result of a central policy.

    Args:
        parameters: [row, parameter] of `agents.pair_scores`.
    """
    env = BatchEnv(ground.library, len(seeds), seed=list(seeds), weights=ground.weights, decisions="events")
    obs, _ = env.reset()
    total, over = np.zeros(len(seeds)), np.zeros(len(seeds), dtype=bool)
    while not over.all():
        actions = np.full((len(seeds), ground.arms), WAIT)
        asked = np.flatnonzero(~over & obs["action_mask"][..., 1:-1].any(axis=(1, 2)))
        if len(asked):
            seen = env.layout.read(obs["observation"][asked], obs["action_mask"][asked])
            for row, score in zip(asked.tolist(), scores(seen, parameters[asked]), strict=True):
                actions[row] = claims(score, env.layout.plans)
        obs, reward, terminated, truncated, _ = env.step(actions)
        total += np.where(over, 0.0, reward)
        over |= terminated | truncated
    return total
