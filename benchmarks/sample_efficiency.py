"""Sample efficiency of PPO here and in BenchMARL on the same environment: the reward of a shift after env steps.

    python -m benchmarks.sample_efficiency train random rule mappo ippo mappo_warm
    .venv-adapters/benchmarl/bin/python -m benchmarks.sample_efficiency train benchmarl_mappo benchmarl_ippo
    python -m benchmarks.sample_efficiency plot

`make .venv-adapters/benchmarl/.installed` builds the environment of the second command. Every training is appended as a
line to docs/results/sample_efficiency/heat_wave.jsonl; those that are there are skipped. `plot` draws the curves.
`docs/tables.py` makes the table of docs/learning.md from the file.

All methods train on `heat_wave` with the scores of the true state and steps from event to event. After every 6000 env
steps the policy, sampled as in its training, runs the same shifts, whose seeds no training draws. CPU seconds are those
of the training alone, on one thread. BenchMARL has its default hyperparameters; its networks get standardised
observations.
"""

# pyright: reportMissingImports=false

import argparse
import os
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from functools import cache, partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from time import process_time
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
import torch

from benchmarks.result_tables import course, trainings
from fleet.engine.batch import RewardWeights
from fleet.env.vector import BatchEnv, Library, Obs, random_legal
from scenarios.evaluate.rollout import Act, rollout
from scenarios.json_rows import Rows
from scenarios.prepare.batch import library_of
from scenarios.prepare.fleet import Fleet, env_of, prepare
from scenarios.run.log import code_hash
from scenarios.spec.jobs import weights_of
from scenarios.spec.load import load
from scenarios.train.networks import rule_actions

Array = np.ndarray
Training = tuple[list[dict[str, float]], dict[str, Any]]
"""Its points and its configuration."""

SCENARIO, RULE = "heat_wave", "wsept"
BUDGET, EVERY = 24_000, 6_000
"""Env steps of a training, and from one evaluation to the next."""
SHIFTS = [*range(3_000_000, 3_000_064)]
"""Seeds of the evaluation."""
PROBES = [*range(4_000_000, 4_000_016)]
"""Seeds of the random shifts that give mean and deviation of the observations."""
LARGEST = 10.0
"""Standardised observations are clipped to this."""
OUT = Path(f"docs/results/sample_efficiency/{SCENARIO}.jsonl")
PICTURE = Path("docs/pictures/sample_efficiency.png")


@cache
def cell() -> tuple[Fleet, Library, RewardWeights]:
    """What all methods train on."""
    fleet = prepare(load(SCENARIO), difficulty="oracle")
    return fleet, library_of(fleet), weights_of(fleet.scenario)


def batch(count: int) -> BatchEnv:
    """Shifts side by side, from event to event."""
    _, library, weights = cell()
    return BatchEnv(library, count, weights=weights, decisions="events")


class Curve:
    """Rewards in the course of a training, and its CPU seconds without the evaluations."""

    def __init__(self) -> None:
        self.env = batch(len(SHIFTS))
        self.points: list[dict[str, float]] = []
        self._cpu_s, self._since_s = 0.0, process_time()

    def add(self, env_steps: int, hours: float, act: Act) -> None:
        """Evaluate the policy after a number of env steps and simulated hours."""
        self._cpu_s += process_time() - self._since_s
        reward = float(rollout(self.env, self.env.reset(seed=list(SHIFTS))[0], act).mean())
        point = {"env_steps": env_steps, "hours": hours, "cpu_s": self._cpu_s, "reward": reward}
        self.points.append({name: round(value, 3) for name, value in point.items()})
        print(self.points[-1], flush=True)
        self._since_s = process_time()


def run_rule(rule: str, seed: int) -> Training:
    """A rule without training."""
    curve = Curve()
    curve.add(0, 0.0, rule_actions(rule, curve.env, [1000 * seed + n for n in range(len(SHIFTS))]))
    return curve.points, {"rule": rule}


def train_here(algorithm: Any, seed: int, warm_start: str = "") -> Training:
    """PPO of `agents.learned`; 30 envs and 20 steps instead of 32 and 16, so that `EVERY` is a whole number of
    iterations."""
    from agents.learned.ppo import PpoConfig
    from scenarios.train.networks import DEMONSTRATIONS, STEPS, TEACHERS, imitate_rule, trainer_of

    config = PpoConfig(algorithm=algorithm, envs=30, steps=20, warm_start=warm_start, seed=seed)
    (_, library, weights), curve, hours = cell(), Curve(), 0.0
    trainer = trainer_of(library, weights, config)
    if warm_start:
        imitate_rule(trainer, library, weights)
    rng = np.random.default_rng(np.random.SeedSequence([seed, SHIFTS[0]]))

    def act(obs: Obs, _: Array) -> Array:
        return trainer.act(curve.env.layout, curve.env.joined(obs)["observation"], obs["action_mask"], rng)

    curve.add(0, 0.0, act)
    for iteration in trainer.iterate():
        hours += iteration.hours
        if iteration.env_steps % EVERY == 0:
            curve.add(iteration.env_steps, hours, act)
        if iteration.env_steps >= BUDGET:
            break
    shown = DEMONSTRATIONS * STEPS * TEACHERS if warm_start else 0
    return curve.points, {**asdict(config), "demonstrated_env_steps": shown}


@cache
def probe() -> tuple[Array, Array]:
    """Mean and deviation of every element of the observation under random actions, [size]."""
    env, rng = batch(len(PROBES)), np.random.default_rng(0)
    obs, _ = env.reset(seed=PROBES)
    seen = list[Array]()
    for _ in range(400):
        obs, *_ = env.step(random_legal(obs["action_mask"], rng))
        seen.append(env.joined(obs)["observation"].reshape(-1, env.layout.size))
    vectors = np.concatenate(seen).astype(float)
    spread = vectors.std(axis=0)
    return vectors.mean(axis=0), np.where(spread > 1e-6, spread, 1.0)


def standardise(vectors: Array) -> Array:
    """Observations [..., size] with mean 0 and deviation 1."""
    mean, spread = probe()
    return np.clip((vectors - mean) / spread, -LARGEST, LARGEST).astype(np.float32)


def train_benchmarl(algorithm: str, seed: int) -> Training:
    """BenchMARL's PPO with its default MLP and hyperparameters."""
    import benchmarl.algorithms
    from benchmarl.experiment import Callback, Experiment, ExperimentConfig
    from benchmarl.models.mlp import MlpConfig
    from tensordict import TensorDict
    from torchrl.envs.transforms import ClipTransform, ObservationNorm
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    from fleet.env.adapters.benchmarl import GROUP, AllocationTask

    config = ExperimentConfig.get_from_yaml()
    config.loggers, config.create_json, config.evaluation, config.render = [], False, False, False
    config.max_n_frames = BUDGET
    parts = getattr(benchmarl.algorithms, f"{algorithm}Config").get_from_yaml(), MlpConfig.get_from_yaml()
    curve = Curve()

    class Standardised(AllocationTask):
        def get_env_transforms(self, env: Any) -> list[Any]:
            mean, spread = (torch.as_tensor(each, dtype=torch.float32) for each in probe())
            keys, arms = ((GROUP, "observation", "observation"), "state"), len(env.group_map[GROUP])
            return [
                *(
                    ObservationNorm(mean.repeat(n), spread.repeat(n), in_keys=[key], standard_normal=True)
                    for key, n in zip(keys, (1, arms), strict=True)
                ),
                ClipTransform(in_keys=[*keys], low=-LARGEST, high=LARGEST),
            ]

        def __reduce__(self) -> Any:  # BenchMARL pickles tasks and callbacks
            return dict, ()

    def act(obs: Obs, _: Array) -> Array:
        obs = curve.env.joined(obs)
        lead = obs["observation"].shape[:2]
        inner = TensorDict({"observation": torch.from_numpy(standardise(obs["observation"]))}, lead)
        arms = TensorDict({"observation": inner, "action_mask": torch.from_numpy(obs["action_mask"]).bool()}, lead)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            return experiment.policy(TensorDict({GROUP: arms}, lead[:1]))[GROUP, "action"].numpy()

    class Evaluation(Callback):
        steps, hours = 0, 0.0

        def on_batch_collected(self, batch: Any) -> None:
            self.steps += batch.numel()
            self.hours += float(batch["next", GROUP, "info", "elapsed_s"].double().mean(dim=-1).sum()) / 3600.0

        def on_train_end(self, training_td: Any, group: str) -> None:
            with torch.random.fork_rng():
                curve.add(self.steps, self.hours, act)

        def __reduce__(self) -> Any:  # BenchMARL pickles callbacks
            return dict, ()

    with tempfile.TemporaryDirectory() as config.save_folder:
        task = Standardised(SCENARIO, lambda: env_of(cell()[0], decisions="events"), max_steps=10_000)
        experiment = Experiment(task, *parts, seed=seed, config=config, callbacks=[Evaluation()])
        with torch.random.fork_rng():
            curve.add(0, 0.0, act)
        experiment.run()
    used = ("gamma", "lr", "adam_eps", "clip_grad_norm", "clip_grad_val", "share_policy_params")
    chosen = {name: value for name, value in vars(config).items() if name in used or name.startswith("on_policy")}
    return curve.points, chosen | {key: str(value) for part in parts for key, value in vars(part).items()}


METHODS: dict[str, Callable[[int], Training]] = {
    "random": partial(run_rule, "random"),
    "rule": partial(run_rule, RULE),
    "mappo": partial(train_here, "mappo"),
    "ippo": partial(train_here, "ippo"),
    "mappo_warm": partial(train_here, "mappo", warm_start=RULE),
    "benchmarl_mappo": partial(train_benchmarl, "Mappo"),
    "benchmarl_ippo": partial(train_benchmarl, "Ippo"),
}


def train(methods: list[str], seeds: int, out: Path) -> None:
    """Append the trainings that are not yet in the file."""
    torch.set_num_threads(1)
    rows = Rows(out)
    for seed in range(seeds):
        for method in methods:
            if (key := f"{method}/{seed}") not in rows:
                print(key, flush=True)
                points, config = METHODS[method](seed)
                rows.append(key, {"method": method, "seed": seed, "points": points, "config": config} | made_with())


def made_with() -> dict[str, Any]:
    """Scenario, evaluation, versions and code of a row."""
    packages = ("torch", "torchrl", "tensordict", "benchmarl", "numpy")
    versions = {package: version(package) for package in packages if find_spec(package)}
    shifts = {"first_seed": SHIFTS[0], "count": len(SHIFTS)}
    return {"scenario": SCENARIO, "difficulty": "oracle", "shifts": shifts, "versions": versions, "code": code_hash()}


def plot(out: Path) -> None:
    """Draw the mean of every method, and each training as a thin line."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    for number, (label, own) in enumerate(trainings(out).items()):
        steps, means = zip(*course(own).items(), strict=True)
        label, color = label.replace("`", ""), f"C{number}"
        if len(steps) == 1:
            axes.axhline(means[0].mean, color="k", lw=1, ls=("--", ":")[number % 2], label=label)
            continue
        axes.plot(steps, [each.mean for each in means], "o-", ms=3, color=color, label=label)
        for row in own:
            axes.plot(steps, [point["reward"] for point in row["points"]], color=color, lw=0.5, alpha=0.6)
    axes.set(xlabel="env steps", ylabel="reward of a shift")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    figure.savefig(PICTURE, dpi=130)


def main() -> None:
    """Train or plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("train", "plot"))
    parser.add_argument("methods", nargs="*", help=", ".join(METHODS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    if options.what == "plot":
        plot(options.out)
    else:
        train(options.methods, options.seeds, options.out)


if __name__ == "__main__":
    main()
