"""Train prices of `bid_price` over a split of the suite by evolution, with validation on another split."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.learned.config import TrainingLength
from agents.learned.evolution import Evolution, EvolutionConfig
from agents.pairs import PARAMETERS, LearnedPrices, save_pairs
from fleet.engine.batch import RewardWeights
from fleet.env.vector import BatchEnv, Library
from fleet.fields import option
from scenarios.evaluate.references import ShiftReference
from scenarios.evaluate.rollout import acts_of, rollout
from scenarios.prepare.batch import library_of
from scenarios.prepare.fleet import prepare
from scenarios.progress import Count, Progress, quiet
from scenarios.spec.jobs import weights_of
from scenarios.spec.options import RISK, DifficultyName, RiskName
from scenarios.suite.splits import Instance
from scenarios.train.training import PAIRS_STATE, Trained, check_folder, run_training

Array = np.ndarray

MOST_LOSS = 1.0
"""A sample loses at most this much to the best one in a shift, so that one shift does not decide an iteration."""


@dataclass(frozen=True, eq=False)
class TrainingInstance:
    """One instance, ready for batches of its shifts."""

    name: str
    seed: int
    """Of the instance itself."""
    library: Library
    weights: RewardWeights
    reference: ShiftReference | None = None
    """Of the shift of its own seed."""

    @property
    def arms(self) -> int:
        return len(self.library.arms)

    @property
    def value(self) -> float:
        """Value of all jobs of its own shift."""
        shift = self.library.draw(np.random.SeedSequence(self.seed))
        return max(float(self.library.tables.value[shift.fleet, shift.kind].sum()), 1.0)

    @property
    def unit(self) -> float:
        """What rewards of its shifts are divided by: the unit of the reference; without one, the value of all jobs."""
        return self.reference.unit if self.reference else self.value

    @property
    def random(self) -> float:
        """Mean reward of the policy `random` in the shift of its own seed; 0 without a reference."""
        return self.reference.random if self.reference else 0.0


def training_instances(
    instances: Sequence[Instance],
    *,
    difficulty: DifficultyName = "oracle",
    risk: RiskName = RISK,
    known: Mapping[tuple[str, int], ShiftReference] | None = None,
    progress: Progress = quiet,
) -> list[TrainingInstance]:
    """Prepare instances; a cell is planned once.

    Args:
        known: References by instance and seed, as far as there are some.
    """
    prepared: list[TrainingInstance] = []
    for instance in instances:
        progress(f"preparing {instance.name}", Count(len(prepared), len(instances)))
        fleet = prepare(instance.scenario, difficulty=difficulty, risk=risk)
        reference = (known or {}).get((instance.name, instance.seed))
        library, weights = library_of(fleet), weights_of(instance.scenario)
        prepared.append(TrainingInstance(instance.name, instance.seed, library, weights, reference))
    return prepared


def rewards(instance: TrainingInstance, parameters: Array, seeds: Sequence[int]) -> Array:
    """Reward of one shift for each row of parameters and its seed, [row].

    Perfect and immediate messages; decisions are asked for by events, which changes no result of a central policy.

    Args:
        parameters: [row, parameter] of `agents.pairs`.
    """
    env = BatchEnv(
        instance.library, len(seeds), weights=instance.weights, decisions="events", scaled=False, ahead_s=np.inf
    )
    policies = {row: LearnedPrices(each) for row, each in enumerate(parameters)}
    return rollout(env, env.reset(seed=list(seeds))[0], acts_of(env, policies))


@dataclass(frozen=True, kw_only=True)
class PairPlan(TrainingLength):
    """Length of a training, and its validation."""

    instances: int = option(
        "Instances of an iteration, of different cells; all samples have the same shifts.", 24, low=1, high=10_000
    )
    validate_every: int = option("Iterations from one validation to the next.", 5, low=1, high=1_000_000)


def train_pairs(
    training: Sequence[TrainingInstance],
    validation: Sequence[TrainingInstance],
    config: EvolutionConfig,
    out: Path,
    plan: PairPlan,
    *,
    card: dict[str, object],
    resume: bool = False,
    tell: Callable[[str], None] = lambda sentence: None,
) -> Trained:
    """Train over instances, as `run_training` says; the best parameters are a policy.

    It begins with zeros, which is `bid_price`.

    Args:
        card: What else `pairs.json` and `training.json` say; a resume must have the same.

    Raises:
        FleetError: a training in the folder without `resume`, `resume` without a training, or another training, or one
            that has the iterations of the plan.
    """
    card = {**card, "config": asdict(config), "instances": plan.instances}
    check_folder(out, card, PAIRS_STATE, resume=resume)
    learner = PairLearner(Evolution(np.zeros(PARAMETERS), config), training, validation, plan.instances)
    return run_training(learner, out, plan, card, resume=resume, tell=tell)


class PairLearner:
    """Parameters of scores of pairs.

    Args:
        count: Instances of an iteration.
    """

    state_file, unit, curves, teacher_name = PAIRS_STATE, "normalised score", (), "bid_price"

    def __init__(
        self,
        search: Evolution,
        training: Sequence[TrainingInstance],
        validation: Sequence[TrainingInstance],
        count: int,
    ) -> None:
        self.search, self.training, self.validation, self.count = search, training, validation, count

    def validate(self) -> float:
        """Score of the running average."""
        return validation_score(self.validation, self.search.average)

    def validate_teacher(self) -> float:
        """That of `bid_price`."""
        return validation_score(self.validation, np.zeros(PARAMETERS))

    def iterate(self) -> Iterator[dict[str, Any]]:
        while True:
            began_s = time.monotonic()
            fitness = self.fitness()
            self.search.tell(fitness)
            row = {"number": self.search.done, "fitness": float(fitness.mean()), "spread": float(fitness.std())}
            yield row | {"seconds": time.monotonic() - began_s}

    def fitness(self) -> Array:
        """Mean reward of every sample in units of the instance, on shifts that all samples share, [sample].

        Large fleets are drawn less often, as their shifts take longer.
        """
        search = self.search
        rng = np.random.default_rng(np.random.SeedSequence([search.config.seed, 2, search.done]))
        weights = np.array([max(each.arms, 4.0) ** -2 for each in self.training])
        count = min(self.count, len(self.training))
        chosen = rng.choice(len(self.training), size=count, replace=False, p=weights / weights.sum())
        samples, total = search.ask(), np.zeros(search.config.samples)
        for index in chosen.tolist():
            instance, seed = self.training[index], int(rng.integers(2**31))
            scores = rewards(instance, samples, [seed] * len(samples)) / instance.unit
            total += np.maximum(scores, scores.max() - MOST_LOSS)
        return total / len(chosen)

    def save_policy(self, out: Path, validation: float, **details: Any) -> None:
        save_pairs(self.search.average, out, **details, iterations=self.search.done, validation=validation)


def validation_score(instances: Sequence[TrainingInstance], parameters: Array) -> float:
    """Mean normalised score of parameters on the shift of each instance's own seed."""
    found = [(rewards(each, parameters[None], [each.seed])[0] - each.random) / each.unit for each in instances]
    return float(np.mean(found))
