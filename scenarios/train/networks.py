"""Train the network of every arm on a scenario by PPO, with validation on separate seeds."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agents.learned.config import TrainingLength
from agents.learned.policy import save_policy
from agents.learned.ppo import PpoConfig, Trainer, imitate
from fleet.engine.batch import RewardWeights
from fleet.env.adapters.torchrl import TorchRLEnv
from fleet.env.vector import BatchEnv, Library
from fleet.fields import option
from scenarios.evaluate.rollout import Act, acts_of, rollout
from scenarios.policy_loader import policy_at, policy_of
from scenarios.prepare.batch import library_of
from scenarios.prepare.fleet import prepare
from scenarios.prepare.randomisation import Randomisation, randomisation_of
from scenarios.progress import Count, Progress, quiet
from scenarios.spec.jobs import weights_of
from scenarios.spec.options import RISK, DifficultyName, RiskName
from scenarios.spec.parse import scenario_hash
from scenarios.spec.schema import Scenario
from scenarios.train.training import NETWORK_STATE, Trained, check_folder, run_training

Array = np.ndarray

VALIDATION_SEED = 2_000_000
"""First validation seed; far from the seeds of comparisons."""


@dataclass(frozen=True, kw_only=True)
class TrainingPlan(TrainingLength):
    """Length of a training, and its validation."""

    validation_envs: int = option("Shifts of a validation.", 32, low=1, high=65_536)


def train(
    scenario: Scenario,
    config: PpoConfig,
    out: Path,
    plan: TrainingPlan,
    *,
    difficulty: DifficultyName = "twin",
    risk: RiskName = RISK,
    randomise: Randomisation | None = None,
    resume: bool = False,
    cache: Path | None = None,
    progress: Progress = quiet,
    tell: Callable[[str], None] = lambda sentence: None,
) -> Trained:
    """Train on a scenario, as `run_training` says; the best network is a policy.

    Args:
        randomise: Varies the shifts of training and validation beyond what the scenario draws.
        resume: Continue the training in the folder; without it the folder must not hold one.
        tell: Called with a sentence after every validation.

    Raises:
        FleetError: a training in the folder without `resume`, `resume` without a training, or a training of another
            scenario, configuration or randomisation, or one that has the iterations of the plan.
    """
    randomise = randomisation_of(randomise)
    card = {
        "scenario": scenario.name,
        "scenario_hash": scenario_hash(scenario),
        "difficulty": difficulty,
        "risk": risk,
        "randomise": asdict(randomise) if randomise else None,  # always there, so that a resume compares it
        "config": asdict(config),
    }
    check_folder(out, card, NETWORK_STATE, resume=resume)
    fleet = prepare(scenario, difficulty=difficulty, risk=risk, randomise=randomise, cache=cache, progress=progress)
    learner = NetworkLearner(library_of(fleet), weights_of(scenario), config, plan.validation_envs)
    if config.warm_start and not resume:
        imitate_rule(learner.search, learner.library, learner.weights, progress)
    return run_training(learner, out, plan, card, resume=resume, progress=progress, tell=tell)


class NetworkLearner:
    """A network on the shifts of one fleet.

    Args:
        count: Number of validation shifts.
    """

    state_file, unit, curves = NETWORK_STATE, "reward of a shift", ("entropy", "clipped", "value_loss")

    def __init__(self, library: Library, weights: RewardWeights, config: PpoConfig, count: int) -> None:
        self.library, self.weights, self.config = library, weights, config
        self.teacher_name = config.warm_start
        self.search = trainer_of(library, weights, config)
        # In intervals, as in `run` and in a live fleet, where an arm above its limit is asked more often than in
        # training.
        self._env = BatchEnv(library, count, weights=weights, ahead_s=np.inf)
        self._seeds = [VALIDATION_SEED + i for i in range(count)]

    def validate(self) -> float:
        """Mean reward of a validation shift."""
        rng = np.random.default_rng(np.random.SeedSequence([VALIDATION_SEED, self.search.done]))
        act = partial(self.search.act, self._env.layout, rng=rng)
        return self._reward(lambda obs, _: act(self._env.layout.join(obs["shared"], obs["own"]), obs["action_mask"]))

    def validate_teacher(self) -> float | None:
        """That of the imitated rule."""
        rule = self.config.warm_start
        if not rule:
            return None
        return self._reward(acts_of(self._env, {e: policy_at(rule, seed) for e, seed in enumerate(self._seeds)}))

    def _reward(self, act: Act) -> float:
        return float(rollout(self._env, self._env.reset(seed=list(self._seeds))[0], act).mean())

    def iterate(self) -> Iterator[dict[str, Any]]:
        return map(asdict, self.search.iterate())

    def save_policy(self, out: Path, validation: float, **details: Any) -> None:
        search = self.search
        counts = {"algorithm": self.config.algorithm, "iterations": search.done, "env_steps": search.env_steps}
        save_policy(search.actor, self.config.size, out, **details, **counts, validation_reward=validation)


def trainer_of(library: Library, weights: RewardWeights, config: PpoConfig) -> Trainer:
    """A trainer on the batched environments of a fleet, with envs spread over the hours of a shift."""

    def envs(count: int, seed: int) -> TorchRLEnv:
        batch = BatchEnv(
            library, count, seed=seed, weights=weights, autoreset=False, decisions=config.decisions, stagger=True,
            ahead_s=np.inf,
        )  # fmt: skip
        return TorchRLEnv(batch)

    return Trainer([(envs, BatchEnv(library, 1, ahead_s=np.inf).layout)], config)


DEMONSTRATIONS = 60
"""Batches of a rule's decisions for a warm start."""
STEPS, TEACHERS = 16, 16
"""Steps of every env in a batch, and its envs."""


def imitate_rule(trainer: Trainer, library: Library, weights: RewardWeights, progress: Progress = quiet) -> None:
    """Warm start: let the actor imitate the rule of the configuration."""
    rng = np.random.default_rng(np.random.SeedSequence([trainer.config.seed, 4]))
    seed = int(rng.integers(2**31))
    teacher = BatchEnv(library, TEACHERS, seed=seed, weights=weights, stagger=True, decisions="events", ahead_s=np.inf)
    imitate(trainer.actor, teacher.layout, _demonstrations(teacher, trainer.config.warm_start, progress), rng)


def _demonstrations(env: BatchEnv, rule: str, progress: Progress) -> Iterator[tuple[Array, Array, Array]]:
    """Batches of a rule's decisions: vectors, masks and actions, [row, …], one row per step, env and arm."""
    policies = [policy_of(rule) for _ in range(env.num_envs)]
    for policy, child in zip(policies, np.random.SeedSequence(0).spawn(env.num_envs), strict=True):
        policy.reset(np.random.default_rng(child))
    act, everywhere = acts_of(env, dict(enumerate(policies))), np.ones(env.num_envs, dtype=bool)
    obs, _ = env.reset()
    for number in range(DEMONSTRATIONS):
        progress(f"imitating {rule}", Count(number, DEMONSTRATIONS))
        rows: list[tuple[Array, Array, Array]] = []
        for _ in range(STEPS):
            actions = act(obs, everywhere)
            rows.append((env.layout.join(obs["shared"], obs["own"]), obs["action_mask"], actions))
            obs, *_ = env.step(actions)
        vectors, masks, actions = (np.concatenate(part) for part in zip(*rows, strict=True))
        yield vectors.reshape(-1, vectors.shape[-1]), masks.reshape(-1, masks.shape[-1]), actions.reshape(-1)
