"""Shifts of a split of the suite as batches, for a learner of scores of pairs: one batched environment per instance.

The folder of a training: whether one may begin or continue there, and whether it is complete.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.learned.config import TrainingLength
from agents.pairs import scores
from agents.policy import WAIT
from agents.rules import matched_options
from fleet.engine.batch import RewardWeights
from fleet.env.vector import BatchEnv, Library, Obs
from fleet.errors import FleetError
from fleet.files import atomic_path
from scenarios.evaluate.rollout import rollout
from scenarios.prepare.batch import library_of
from scenarios.prepare.fleet import prepare
from scenarios.progress import Count, Progress, quiet
from scenarios.spec.jobs import weights_of
from scenarios.spec.options import RISK, DifficultyName, RiskName
from scenarios.suite.splits import Instance

Array = np.ndarray

SHIFTS = 4
"""Shifts of a validation instance: that of its own seed, and others."""


KnownRewards = Mapping[tuple[str, int], tuple[float, float]]
"""Rewards of random and of the hindsight in the shift of an instance and its seed."""


@dataclass(frozen=True, eq=False)
class TrainingInstance:
    """One instance, ready for batches of its shifts."""

    name: str
    seed: int
    """Of the instance itself."""
    library: Library
    weights: RewardWeights
    random: float = 0.0
    """Mean reward of the policy `random` in the shift of its own seed; 0 without a reference."""
    span: float | None = None
    """Reward of the hindsight of that shift less `random`; None without a reference."""

    @property
    def shifts(self) -> list[int]:
        """Seeds of its shifts in validation: its own, and the next ones."""
        return [*range(self.seed, self.seed + SHIFTS)]

    @property
    def arms(self) -> int:
        return len(self.library.arms)

    def value(self, seed: int) -> float:
        """Value of all jobs that arrive in the shift of a seed: the unit of a fitness, so that instances are alike."""
        shift = self.library.draw(np.random.SeedSequence(seed))
        return max(float(self.library.tables.value[shift.fleet, shift.kind].sum()), 1.0)

    @property
    def unit(self) -> float:
        """What rewards of its shifts are divided by: the span, or the value of all jobs without a reference."""
        return self.value(self.seed) if self.span is None else self.span


def training_instance(
    instance: Instance,
    *,
    difficulty: DifficultyName = "oracle",
    risk: RiskName = RISK,
    cache: Path | None = None,
    known: KnownRewards | None = None,
) -> TrainingInstance:
    """Prepare an instance; its cell is planned once."""
    fleet = prepare(instance.scenario, difficulty=difficulty, risk=risk, cache=cache)
    random, hindsight = (known or {}).get((instance.name, instance.seed), (0.0, None))
    span = None if hindsight is None else hindsight - random
    return TrainingInstance(
        instance.name, instance.seed, library_of(fleet), weights_of(instance.scenario), random, span
    )


def training_instances(
    instances: Sequence[Instance],
    *,
    difficulty: DifficultyName = "oracle",
    risk: RiskName = RISK,
    cache: Path | None = None,
    known: KnownRewards | None = None,
    progress: Progress = quiet,
) -> list[TrainingInstance]:
    """Prepare instances.

    Args:
        known: References of those instances that have one.
    """
    grounds: list[TrainingInstance] = []
    for instance in instances:
        progress(f"preparing {instance.name}", Count(len(grounds), len(instances)))
        grounds.append(training_instance(instance, difficulty=difficulty, risk=risk, cache=cache, known=known))
    return grounds


def rewards(ground: TrainingInstance, parameters: Array, seeds: Sequence[int]) -> Array:
    """Reward of one shift for each row of parameters and its seed, [row].

    Perfect and immediate messages; decisions are asked for by events, which changes no result of a central policy.

    Args:
        parameters: [row, parameter] of `agents.pairs`.
    """
    env = BatchEnv(ground.library, len(seeds), weights=ground.weights, decisions="events")

    def act(obs: Obs, running: Array) -> Array:
        actions = np.full((len(seeds), ground.arms), WAIT)
        asked = np.flatnonzero(running & obs["action_mask"][..., 1:-1].any(axis=(1, 2)))
        if len(asked):
            seen = env.layout.read(obs["observation"][asked], obs["action_mask"][asked])
            score = scores(seen, parameters[asked])
            for k in np.flatnonzero(np.isfinite(score).any(axis=(1, 2))).tolist():
                for arm, option in matched_options(-score[k], env.layout.plans):
                    actions[asked[k], arm] = 1 + option
        return actions

    return rollout(env, env.reset(seed=list(seeds))[0], act)


@dataclass(frozen=True)
class Trained:
    """Result of a training in all its sessions."""

    iterations: int
    best: float
    """Validation of the saved policy."""
    seconds: float
    interrupted: bool


TRAINING = "training.json"
"""Settings that a resume must repeat; written after the first state, so that a folder with it can be resumed."""
PAIRS_STATE, NETWORK_STATE = "training.npz", "training.pt"
POLICIES = ("pairs.json", "policy.json")
"""Cards of trained policies (`agents.learned.policy.CARD` needs PyTorch)."""


def holds_training(out: Path) -> bool:
    """Whether a folder has a training to resume."""
    return (out / TRAINING).is_file() and any((out / state).is_file() for state in (PAIRS_STATE, NETWORK_STATE))


def check_folder(out: Path, card: Mapping[str, Any], state: str, *, resume: bool) -> None:
    """Check that a training may begin in a folder, or continue from its state there.

    Raises:
        FleetError: a training or a policy in the folder without `resume`, `resume` without a training, or a training
            with another card.
    """
    if not resume:
        if holds_training(out):
            raise FleetError(f"'{out}' holds a training already. Continue it with --resume, or choose another --out.")
        if any((out / policy).is_file() for policy in POLICIES):
            raise FleetError(
                f"'{out}' holds a policy without a training to resume. Choose another --out, or move the policy."
            )
        return
    if not (holds_training(out) and (out / state).is_file()):
        raise FleetError(f"'{out}' holds no training to resume.")
    before = json.loads((out / TRAINING).read_text(encoding="utf-8"))
    was, now = (each | each.get("config", {}) | {"config": None} for each in (before, json.loads(json.dumps(card))))
    for name, value in now.items():
        if was.get(name) != value:
            raise FleetError(f"The training in '{out}' has {name} = {was.get(name)} (got {value}).")


def write_card(out: Path, card: Mapping[str, Any]) -> None:
    """Mark a folder as a training that can be resumed; call it after its first state is saved."""
    with atomic_path(out / TRAINING) as draft:
        draft.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def skip_complete(
    out: Path, plan: TrainingLength, iterations: int, before_s: float, tell: Callable[[str], None]
) -> bool:
    """Whether a training to resume is complete, which a sentence says.

    Raises:
        FleetError: it has its iterations, and the plan is not `in_total`.
    """
    if plan.share(iterations, before_s, before_s) < 1.0:
        return False
    if not plan.in_total:
        raise FleetError(f"The training in '{out}' has {iterations} iterations: --iterations must be more.")
    tell(f"Skipped the training in '{out}', because it is complete.")
    return True
