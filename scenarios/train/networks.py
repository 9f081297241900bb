"""Train a policy on a scenario: iterations, checkpoints, validation on separate seeds, and learning curves."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agents.learned.config import TrainingLength
from agents.learned.evolution import CURVE, TrainingLog, read_log
from agents.learned.policy import save_policy
from agents.learned.ppo import PpoConfig, Trainer, imitate
from fleet.engine.batch import RewardWeights
from fleet.env.adapters.torchrl import TorchRLEnv
from fleet.env.validation import actions_of
from fleet.env.vector import BatchEnv, Library
from fleet.files import atomic_path
from scenarios.evaluate.rollout import Act, acts_of, known_in, rollout
from scenarios.policy_loader import policy_at, policy_of
from scenarios.prepare.batch import library_of
from scenarios.prepare.fleet import prepare
from scenarios.prepare.randomisation import Randomisation, randomisation_of
from scenarios.progress import Count, Progress, quiet
from scenarios.spec.jobs import weights_of
from scenarios.spec.options import RISK, DifficultyName, RiskName
from scenarios.spec.parse import scenario_hash
from scenarios.spec.schema import Scenario
from scenarios.train.instances import (
    NETWORK_STATE,
    Trained,
    TrainingInstance,
    check_folder,
    holds_training,
    skip_complete,
    write_card,
)

Array = np.ndarray

VALIDATION_SEED = 2_000_000
"""First validation seed; far from the seeds of comparisons."""


@dataclass(frozen=True, kw_only=True)
class TrainingPlan(TrainingLength):
    """Length of a training, and its validation."""

    validate_every: int = 20
    """Iterations from one validation to the next."""
    validation_envs: int = 32


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
    """Write into a folder the best network as a policy, the last state for a resume, and the curves.

    Ctrl-C ends the training early and keeps its result; before the end of the validation of iteration 0 there is none.

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
    library, weights = library_of(fleet), weights_of(scenario)
    # In intervals, as in `run` and in a live fleet, where an arm above its limit is asked more often than in training.
    env = BatchEnv(library, plan.validation_envs, weights=weights)
    judge = Validation(env, [VALIDATION_SEED + i for i in range(plan.validation_envs)], np.ones(plan.validation_envs))
    return _train([(library, weights)], [judge], config, out, plan, card, resume, progress, tell)


def train_on_split(
    grounds: Sequence[TrainingInstance],
    judges: Sequence[TrainingInstance],
    config: PpoConfig,
    out: Path,
    plan: TrainingPlan,
    *,
    card: dict[str, Any],
    resume: bool = False,
    progress: Progress = quiet,
    tell: Callable[[str], None] = lambda sentence: None,
) -> Trained:
    """As `train`, on instances in turns: an iteration for each. Rewards of validation are shares of the value of all
    jobs.

    Args:
        grounds, judges: Instances of training and of validation.
        card: What else the card says; a resume must have the same.
    """
    card = {**card, "config": asdict(config)}
    check_folder(out, card, NETWORK_STATE, resume=resume)
    judging = [
        Validation(
            BatchEnv(judge.library, len(seeds), weights=judge.weights), seeds, np.array([*map(judge.value, seeds)])
        )
        for judge in judges
        for seeds in [judge.shifts]
    ]
    cells = [(ground.library, ground.weights) for ground in grounds]
    return _train(cells, judging, config, out, plan, card, resume, progress, tell)


@dataclass(frozen=True, eq=False)
class Validation:
    """Validation shifts of one environment."""

    env: BatchEnv
    seeds: Sequence[int]
    units: Array
    """What the reward of each shift is divided by, [env]."""

    def reward(self, act: Act) -> float:
        """Mean reward of a shift, in its unit."""
        return float((rollout(self.env, self.env.reset(seed=list(self.seeds))[0], act) / self.units).mean())


def _train(
    cells: Sequence[tuple[Library, RewardWeights]],
    judges: Sequence[Validation],
    config: PpoConfig,
    out: Path,
    plan: TrainingPlan,
    card: dict[str, Any],
    resume: bool,
    progress: Progress,
    tell: Callable[[str], None],
) -> Trained:
    trainer = trainer_of(cells, config)
    best, before_s = -np.inf, 0.0
    if resume:
        numbers = trainer.load(out / NETWORK_STATE)
        best, before_s = numbers["best"], numbers.get("seconds", 0.0)
        if skip_complete(out, plan, trainer.done, before_s, tell):
            return Trained(trainer.done, best, before_s, interrupted=False)
    elif config.warm_start:
        imitate_rule(trainer, cells, progress)
    out.mkdir(parents=True, exist_ok=True)
    log, interrupted = TrainingLog(out), False
    began_s = time.monotonic() - before_s  # as if the sessions had followed each other

    def validate(number: int, env_steps: int) -> None:
        nonlocal best
        rng = np.random.default_rng(np.random.SeedSequence([VALIDATION_SEED, number]))

        def reward_of(judge: Validation) -> float:
            act = partial(trainer.act, judge.env.layout, rng=rng)
            return judge.reward(lambda obs, _: act(obs["observation"], obs["action_mask"]))

        reward = float(np.mean([reward_of(judge) for judge in judges]))
        if not holds_training(out):
            trainer.save(out / NETWORK_STATE, best=best)  # without a policy yet
            write_card(out, card)
        if reward > best:
            best = reward
            details = {"algorithm": config.algorithm, "iterations": number, "env_steps": env_steps}
            save_policy(trainer.actor, config.size, out, **card, **details, validation_reward=reward)
        trainer.save(out / NETWORK_STATE, best=best, seconds=time.monotonic() - began_s)
        log.add(number, {"iteration": number, "validation_reward": reward})
        tell(f"Iteration {number}: {reward:.4g} per shift on the validation seeds, best {best:.4g}.")

    iteration, validated = None, 0
    try:
        if best == -np.inf:
            teacher: float | None = None
            if rule := config.warm_start:
                teacher = float(np.mean([judge.reward(rule_actions(rule, judge.env, judge.seeds)) for judge in judges]))
                tell(f"Teacher {rule}: {teacher:.4g} per shift on the validation seeds.")
            validate(0, 0)
            if teacher is not None:
                log.add(0, {"teacher": teacher})
        for iteration in trainer.iterate():
            log.add(iteration.number, asdict(iteration))
            share = plan.share(iteration.number, time.monotonic() - began_s, before_s)
            progress(f"iteration {iteration.number}, best {best:.4g}", min(share, 1.0))
            if iteration.number % plan.validate_every == 0 or share >= 1.0:
                validate(iteration.number, iteration.env_steps)
                validated = iteration.number
            if share >= 1.0:
                break
    except KeyboardInterrupt:
        interrupted = True
        if best == -np.inf:
            raise
        if iteration is not None and validated < iteration.number:
            validate(iteration.number, iteration.env_steps)
    draw_curves(out)
    return Trained(trainer.done, best, time.monotonic() - began_s, interrupted)


def trainer_of(cells: Sequence[tuple[Library, RewardWeights]], config: PpoConfig) -> Trainer:
    """A trainer on the batched environments of some cells, with envs spread over the hours of a shift."""
    options: Any = {"autoreset": False, "decisions": config.decisions, "stagger": True}  # two kinds of values

    def factory(library: Library, weights: RewardWeights) -> Callable[[int, int], TorchRLEnv]:
        return lambda envs, seed: TorchRLEnv(BatchEnv(library, envs, seed=seed, weights=weights, **options))

    return Trainer([(factory(*cell), BatchEnv(cell[0], 1).layout) for cell in cells], config)


DEMONSTRATIONS = 60
"""Batches of a rule's decisions for a warm start, of all cells together."""
STEPS, TEACHERS = 16, 16
"""Steps of every env in a batch, and its envs."""


def imitate_rule(trainer: Trainer, cells: Sequence[tuple[Library, RewardWeights]], progress: Progress = quiet) -> None:
    """Warm start: let the actor imitate the rule of the configuration."""
    rule, rng = trainer.config.warm_start, np.random.default_rng(np.random.SeedSequence([trainer.config.seed, 4]))
    for library, weights in cells:
        seed = int(rng.integers(2**31))
        teacher = BatchEnv(library, TEACHERS, seed=seed, weights=weights, stagger=True, decisions="events")
        batches = max(1, DEMONSTRATIONS // len(cells))
        imitate(trainer.actor, teacher.layout, _demonstrations(teacher, rule, batches, progress), rng)


def _demonstrations(env: BatchEnv, rule: str, count: int, progress: Progress) -> Iterator[tuple[Array, Array, Array]]:
    """Batches of a rule's decisions: vectors, masks and actions, [row, …], one row per step, env and arm."""
    policies = [policy_of(rule) for _ in range(env.num_envs)]
    for policy, child in zip(policies, np.random.SeedSequence(0).spawn(env.num_envs), strict=True):
        policy.reset(np.random.default_rng(child))
    obs, _ = env.reset()
    for number in range(count):
        progress(f"imitating {rule}", Count(number, count))
        rows: list[tuple[Array, Array, Array]] = []
        for _ in range(STEPS):
            actions = np.array([actions_of(env.agents, p.act(known_in(env, e, obs))) for e, p in enumerate(policies)])
            rows.append((obs["observation"], obs["action_mask"], actions))
            obs, *_ = env.step(actions)
        vectors, masks, actions = (np.concatenate(part) for part in zip(*rows, strict=True))
        yield vectors.reshape(-1, vectors.shape[-1]), masks.reshape(-1, masks.shape[-1]), actions.reshape(-1)


def rule_actions(rule: str, env: BatchEnv, seeds: Sequence[int]) -> Act:
    """Actions of a rule, one instance for each env, [env, arm]."""
    return acts_of(env, {e: policy_at(rule, seed) for e, seed in enumerate(seeds)})


def draw_curves(folder: Path) -> None:
    """Plot validation reward, entropy, clipped share and value loss against the iteration."""
    from matplotlib.figure import Figure  # without a display

    rows = read_log(folder)
    iterations = [row for row in rows if "env_steps" in row]
    validations = [row for row in rows if "validation_reward" in row]
    figure = Figure(figsize=(9, 6), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.plot([r["iteration"] for r in validations], [r["validation_reward"] for r in validations], "o-", ms=3)
    for row in rows:
        if "teacher" in row:
            top.axhline(row["teacher"], color="k", lw=1, ls="--", label="the rule that was imitated")
            top.legend(frameon=False)
    top.set_ylabel("reward of a shift, validation seeds")
    labels = {"entropy": "entropy of choices, nat", "clipped": "share of clipped ratios", "value_loss": "value loss"}
    for name, label in labels.items():
        bottom.plot([r["number"] for r in iterations], [r[name] for r in iterations], label=label)
    bottom.set_xlabel("iteration")
    bottom.legend(frameon=False)
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
    with atomic_path(folder / CURVE) as draft:
        figure.savefig(draft, dpi=120, format="png")
