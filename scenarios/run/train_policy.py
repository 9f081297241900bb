"""Train a policy on a scenario: iterations, checkpoints, a validation on seeds of its own, and the curves."""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agents.learned.imitation import imitate
from agents.learned.policy import CARD, save_policy
from agents.learned.ppo import Iteration, PpoConfig, Trainer
from agents.policy import Policy
from fleet.env.adapters.torchrl import TorchRLEnv
from fleet.env.vector import BatchEnv, Obs
from fleet.errors import FleetError
from fleet.files import atomic_path
from scenarios.policy_loader import policy_of
from scenarios.prepare.fleet import DifficultyName, prepare
from scenarios.progress import Progress, quiet
from scenarios.run.batch import library_of
from scenarios.run.shift import scenario_hash
from scenarios.schema import Scenario

Array = np.ndarray

VALIDATION_SEED = 2_000_000
"""First of the seeds on which the best network is chosen: far from those that people compare on."""
STATE, LOG, CURVE = "training.pt", "progress.jsonl", "curve.png"


@dataclass(frozen=True, kw_only=True)
class TrainingPlan:
    """How long to train, and how often to look."""

    minutes: float = 30.0
    iterations: int | None = None
    """Ends it earlier; counts those before a resume."""
    validate_every: int = 20
    """Iterations."""
    validation_envs: int = 32

    def __post_init__(self) -> None:
        if not self.minutes > 0:
            raise FleetError(f"minutes must be > 0 (got {self.minutes}).")
        for name in ("validate_every", "validation_envs"):
            if getattr(self, name) < 1:
                raise FleetError(f"{name} must be >= 1 (got {getattr(self, name)}).")
        if self.iterations is not None and self.iterations < 1:
            raise FleetError(f"iterations must be >= 1 (got {self.iterations}).")


@dataclass(frozen=True)
class Trained:
    """What came out."""

    iterations: int
    env_steps: int
    best: float
    """Mean reward of a shift on the validation seeds, of the network that is kept."""
    seconds: float
    interrupted: bool


def train(
    scenario: Scenario,
    config: PpoConfig,
    out: Path,
    plan: TrainingPlan,
    *,
    difficulty: DifficultyName = "twin",
    resume: bool = False,
    cache: Path | None = None,
    progress: Progress = quiet,
    tell: Callable[[str], None] = lambda sentence: None,
) -> Trained:
    """Train into a folder: the best network as a policy, the last one to resume from, and the curves.

    Ctrl-C ends it early, with what there is.

    Args:
        resume: Go on from the folder's training; else the folder must not hold one.
        tell: Takes a sentence at every validation.

    Raises:
        FleetError: the folder holds a training and is not to be resumed, or the other way round, or one of another
            scenario or configuration.
    """
    card = {
        "scenario": scenario.name,
        "scenario_hash": scenario_hash(scenario),
        "difficulty": difficulty,
        "config": asdict(config),
    }
    _check_folder(out, card, resume=resume)
    fleet = prepare(scenario, difficulty=difficulty, cache=cache, progress=progress)
    library = library_of([fleet])

    def make_env(envs: int, seed: int) -> TorchRLEnv:
        return TorchRLEnv(BatchEnv(library, envs, seed=seed, weights=scenario.reward, autoreset=False, stagger=True))

    judge = BatchEnv(library, plan.validation_envs, weights=scenario.reward)
    trainer = Trainer(make_env, judge.layout, config)
    best = -np.inf
    rng = np.random.default_rng(np.random.SeedSequence([config.seed, 4]))
    if not resume and config.warm_start:
        teacher = BatchEnv(library, 16, seed=int(rng.integers(2**31)), weights=scenario.reward, stagger=True)
        imitate(trainer.actor, judge.layout, _shown(teacher, config.warm_start, progress), rng)
    if resume:
        best = trainer.load(out / STATE)["best"]
        if plan.iterations is not None and trainer.done >= plan.iterations:
            raise FleetError(f"The training in '{out}' has {trainer.done} iterations: --iterations must be more.")
    out.mkdir(parents=True, exist_ok=True)
    (out / "training.json").write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")
    began_s, interrupted = time.monotonic(), False
    seeds = [VALIDATION_SEED + i for i in range(plan.validation_envs)]

    def look(told: Iteration) -> None:
        nonlocal best
        rng = np.random.default_rng(np.random.SeedSequence([VALIDATION_SEED, told.number]))
        act = partial(trainer.act, rng=rng)
        reward = float(returns(judge, lambda obs: act(obs["observation"], obs["action_mask"]), seeds).mean())
        if reward > best:
            best = reward
            more = {"algorithm": config.algorithm, "iterations": told.number, "env_steps": told.env_steps}
            save_policy(trainer.actor, config.size, out, **card, **more, validation_reward=reward)
        trainer.save(out / STATE, best=best)
        _append(out / LOG, {"iteration": told.number, "validation_reward": reward})
        tell(f"Iteration {told.number}: {reward:.1f} a shift on the validation seeds, {best:.1f} the best so far.")

    told, looked = None, 0
    try:
        for told in trainer.iterate():
            _append(out / LOG, asdict(told))
            spent_s = time.monotonic() - began_s
            share = max(spent_s / (60.0 * plan.minutes), told.number / (plan.iterations or np.inf))
            progress(f"iteration {told.number}, best {best:.1f}", min(share, 1.0))
            if told.number % plan.validate_every == 0 or share >= 1.0:
                look(told)
                looked = told.number
            if share >= 1.0:
                break
    except KeyboardInterrupt:
        interrupted = True
        if told is None:
            raise
        if looked < told.number:
            look(told)
    draw_curves(out)
    return Trained(trainer.done, trainer.env_steps, best, time.monotonic() - began_s, interrupted)


IMITATED = 60
"""Batches of decisions of a rule that the actor is shown for a warm start."""
DECISIONS = 128
"""In each, of every env."""


def _shown(env: BatchEnv, rule: str, progress: Progress) -> Iterator[tuple[Array, Array, Array]]:
    """What a rule does in a batch: vectors, masks and actions, [row, …], rows of all arms at all moments."""
    policies = [policy_of(rule) for _ in range(env.num_envs)]
    for policy, child in zip(policies, np.random.SeedSequence(0).spawn(env.num_envs), strict=True):
        policy.reset(np.random.default_rng(child))
    obs, _ = env.reset()
    for number in range(IMITATED):
        progress(f"imitating {rule}", number / IMITATED)
        rows: list[tuple[Array, Array, Array]] = []
        for _ in range(DECISIONS):
            actions = np.array([_asked(env, obs, policy, e) for e, policy in enumerate(policies)])
            rows.append((obs["observation"], obs["action_mask"], actions))
            obs, *_ = env.step(actions)
        vectors, masks, actions = (np.concatenate(part) for part in zip(*rows, strict=True))
        yield vectors.reshape(-1, vectors.shape[-1]), masks.reshape(-1, masks.shape[-1]), actions.reshape(-1)


def _asked(env: BatchEnv, obs: Obs, policy: Policy, e: int) -> list[int]:
    """What a policy does in one env, int [arm]."""
    vectors, masks, read = obs["observation"][e], obs["action_mask"][e], env.layout.read
    actions = policy.act({arm: read(vectors[a], masks[a]) for a, arm in enumerate(env.agents)})
    return [actions[arm] for arm in env.agents]


def returns(env: BatchEnv, act: Callable[[Obs], Array], seeds: Sequence[int]) -> Array:
    """Reward of the shift of each seed from beginning to end, [env]."""
    obs, _ = env.reset(seed=list(seeds))
    total, over = np.zeros(env.num_envs), np.zeros(env.num_envs, dtype=bool)
    while not over.all():
        obs, reward, terminated, truncated, _ = env.step(act(obs))
        total += np.where(over, 0.0, reward)
        over |= terminated | truncated
    return total


def draw_curves(folder: Path) -> None:
    """The curves of a training as a picture: reward of training and validation, entropy, clipped share."""
    from matplotlib.figure import Figure  # no display is looked for

    rows = [json.loads(line) for line in (folder / LOG).read_text(encoding="utf-8").splitlines()]
    seen = [row for row in rows if "env_steps" in row]
    judged = [row for row in rows if "validation_reward" in row]
    figure = Figure(figsize=(9, 6), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.plot([r["iteration"] for r in judged], [r["validation_reward"] for r in judged], "o-", ms=3)
    top.set_ylabel("reward of a shift, validation seeds")
    bottom.plot([r["number"] for r in seen], [r["entropy"] for r in seen], label="entropy of choices, nat")
    bottom.plot([r["number"] for r in seen], [r["clipped"] for r in seen], label="share of clipped ratios")
    bottom.plot([r["number"] for r in seen], [r["value_loss"] for r in seen], label="value loss")
    bottom.set_xlabel("iteration")
    bottom.legend(frameon=False)
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
    with atomic_path(folder / CURVE) as draft:
        figure.savefig(draft, dpi=120, format="png")


def _check_folder(out: Path, card: dict[str, Any], *, resume: bool) -> None:
    there = out / "training.json"
    if not resume:
        if there.exists() or (out / CARD).exists():
            raise FleetError(f"'{out}' holds a training already: give --resume to go on with it, or another --out.")
        return
    try:
        before = json.loads(there.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FleetError(f"'{out}' holds no training to resume.") from None
    if not (out / STATE).is_file():
        raise FleetError(f"The training in '{out}' ended before its first checkpoint: begin anew in another --out.")
    was, now = (each | each.get("config", {}) | {"config": None} for each in (before, json.loads(json.dumps(card))))
    for name, value in now.items():
        if was.get(name) != value:
            raise FleetError(f"The training in '{out}' was of another {name} ({was.get(name)}, now {value}).")


def _append(path: Path, row: dict[str, Any]) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")
