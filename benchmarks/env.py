"""Env steps per CPU-second on one core and one thread, beside other environments.

    make bench-env                          # installs the other environments and runs this
    .venv/bin/python -m benchmarks.env      # skips environments that are not installed

Every row is a separate process, pinned to one core, and the median of three windows. A window is a whole shift (720
steps), so resets are included. Actions are random legal ones, and choosing them is included:
`fleet.env.random_actions.random_legal` for the batch, the same by hand for the single environment. For more than four
arms, the arms of quickstart are repeated, and its arrival rates multiplied; there are always 16 slots.
"""

import os
import sys

os.environ["OMP_NUM_THREADS"] = "1"

import statistics
import subprocess
import time
from dataclasses import replace
from importlib.util import find_spec

import numpy as np

from benchmarks.harness import median_rate, rss_mb
from fleet.engine.tables import Tables
from fleet.env.random_actions import random_legal
from fleet.env.vector import BatchEnv, Library, keep_pages
from scenarios.prepare.batch import library_of
from scenarios.prepare.fleet import Randomisation, env_of, prepare
from scenarios.spec.load import load
from scenarios.spec.options import DifficultyName

WINDOWS, SHIFT = 3, 720


def single(difficulty: DifficultyName) -> float:
    """Measure the `ParallelEnv`."""
    env = env_of(prepare(load("quickstart"), difficulty=difficulty))
    rng, seen = np.random.default_rng(0), {}

    def window() -> int:
        nonlocal seen
        steps = 2 * SHIFT
        for _ in range(steps):
            if not env.agents:
                seen, _ = env.reset()
            actions = {}
            for arm, share in zip(env.agents, rng.random(len(env.agents)).tolist(), strict=True):
                legal = seen[arm]["action_mask"].nonzero()[0]
                actions[arm] = int(legal[int(share * len(legal))])
            seen, *_ = env.step(actions)
        return steps

    seen, _ = env.reset(seed=0)
    for _ in range(10):  # fills the caches: a twin scores every possible job once
        env.reset()
    return median_rate(window)


def library(difficulty: DifficultyName, arms: int = 4, peers: int | None = None) -> Library:
    """Return quickstart with its four arms repeated, and arrival rates multiplied accordingly.

    The axis of the arms in each table is the one that is shorter for a fleet of three.

    Args:
        peers: Number of peers in the vector of each arm; default: all others.
    """
    scenario = load("quickstart")
    times = arms // len(scenario.arms)
    one = library_of(prepare(scenario, difficulty=difficulty, randomise=Randomisation(arrivals=(times, times))))
    fewer = library_of(prepare(replace(scenario, arms=scenario.arms[:-1]), difficulty="blind"))
    repeated = {}
    for name, table, shorter in zip(Tables._fields, one.tables, fewer.tables, strict=True):
        axes = list(zip(np.shape(table), np.shape(shorter), strict=True))
        if (pair := (len(scenario.arms), len(scenario.arms) - 1)) in axes:
            repeated[name] = np.concatenate([table] * times, axis=axes.index(pair))
    near = None if peers is None else tuple(tuple((a - p - 1) % arms for p in range(peers)) for a in range(arms))
    return Library(tuple(f"arm_{a}" for a in range(arms)), one.slots, one.tables._replace(**repeated), one.draw, near)


def batch(difficulty: DifficultyName, envs: int, arms: int = 4, peers: int | None = None) -> float:
    """Measure a batch."""
    env, rng = BatchEnv(library(difficulty, arms, peers), envs, seed=0), np.random.default_rng(0)
    seen, _ = env.reset()

    def window() -> int:
        nonlocal seen
        for _ in range(SHIFT):
            seen, *_ = env.step(random_legal(seen["action_mask"], rng))
        return envs * SHIFT

    return median_rate(window)


def two_threads(envs: int) -> float:
    """Return the speed on two threads relative to one; median of alternating windows."""
    shared, ratios = library("blind"), []
    batches = [BatchEnv(shared, envs, seed=0, threads=threads) for threads in (1, 2)]
    seen = [env.reset()[0] for env in batches]
    rng = np.random.default_rng(0)
    for _ in range(WINDOWS + 1):
        took_s = []
        for n, env in enumerate(batches):
            actions = random_legal(seen[n]["action_mask"], rng)
            begin = time.perf_counter()
            for _ in range(SHIFT // 4):
                seen[n], *_ = env.step(actions)
            took_s.append(time.perf_counter() - begin)
        ratios.append(took_s[0] / took_s[1])
    return statistics.median(ratios[1:])


def torchrl(envs: int, *, kept: bool = False) -> float:
    """Measure rollouts of TorchRL with its random policy."""
    if kept and not keep_pages():
        raise SystemExit("keep_pages() needs glibc.")
    import torch

    from fleet.env.adapters.torchrl import TorchRLEnv

    torch.set_num_threads(1)
    env = TorchRLEnv(BatchEnv(library("blind"), envs, seed=0, autoreset=False), seed=0)
    begin, length = env.reset(), 90

    def window() -> int:
        nonlocal begin
        for _ in range(SHIFT // length):
            frames = env.rollout(length, break_when_any_done=False, auto_reset=False, tensordict=begin)
            begin = env.step_mdp(frames[:, -1])
        return envs * SHIFT

    return median_rate(window)


def memory(envs: int, arms: int) -> float:
    """Return the MB that a batch adds to a process with one env."""
    shared, rng = library("blind", arms), np.random.default_rng(0)

    def run(count: int) -> BatchEnv:
        env = BatchEnv(shared, count, seed=0)
        seen, _ = env.reset()
        for _ in range(SHIFT + 10):
            seen, *_ = env.step(random_legal(seen["action_mask"], rng))
        return env

    run(1)
    before = rss_mb()
    many = run(envs)
    after = rss_mb()
    assert many.num_envs == envs
    return after - before


ROWS = {
    "single": lambda difficulty: single(difficulty),
    "batch": lambda difficulty, envs, arms="4", *peers: batch(difficulty, int(envs), int(arms), *map(int, peers)),
    "threads": lambda envs: two_threads(int(envs)),
    "torchrl": lambda envs, pages="": torchrl(int(envs), kept=pages == "kept"),
    "memory": lambda envs, arms: memory(int(envs), int(arms)),
}


def measured(*command: str) -> float | None:
    """Run a measurement in a separate process; if it fails, print the reason and return None."""
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{command[0]}", *command[1:]],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    if done.returncode:
        print(f"  {' '.join(command[1:])} failed: {done.stderr.strip().splitlines()[-1:]}", flush=True)
        return None
    return float(done.stdout.split()[-1])


def line(what: str, value: float | None, target: float | None = None, unit: str = "") -> None:
    """Print one row of the table."""
    aim = "" if target is None else f"{target:>12,.0f}"
    print(f"{what:<52}{'-' if value is None else f'{value:,.0f}':>12}{aim:>12} {unit}", flush=True)


def main() -> None:
    """Print the table."""
    print(f"{'env steps per CPU-second, one core':<52}{'measured':>12}{'target':>12}")
    for difficulty in ("blind", "twin"):
        line(f"single ParallelEnv, {difficulty}", measured("env", "single", difficulty), 40_000)
        line(f"batch of 32, {difficulty}", measured("env", "batch", difficulty, "32"), 600_000)
        line(f"batch of 1024, {difficulty}", measured("env", "batch", difficulty, "1024"), 1_000_000)
    print(f"two threads against one, 1024 envs, wall clock: {measured('env', 'threads', '1024')} times (target 1.8)")
    if find_spec("torchrl") is None:
        print("TorchRL is not installed; install it with: pip install -e '.[learn]' -c constraints.txt")
    else:
        line("TorchRL rollout of 1024, blind", measured("env", "torchrl", "1024"), 300_000)
        line("the same after keep_pages()", measured("env", "torchrl", "1024", "kept"), 300_000)
    for name, module, envs in (("mpe", "mpe2", (1,)), ("rware", "rware", (1,)), ("vmas", "vmas", (1, 32, 1024))):
        if find_spec(module) is None:
            print(f"{name} is not installed; make bench-env installs it")
            continue
        for count in envs:
            line(f"{name}, {count}", measured("peers", name, str(count)))
    for peers, what in (((), "all peers"), (("3",), "3 peers")):
        for arms in (4, 8, 16, 64):
            rate = measured("env", "batch", "blind", "64", str(arms), *peers)
            cost_ns = None if rate is None else 1e9 / (rate * arms)
            line(f"64 envs of {arms} arms that observe {what}: one arm step", cost_ns, unit="ns")
    line("memory of 1024 envs with 8 arms", measured("env", "memory", "1024", "8"), 200, "MB")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        if sys.argv[1] != "threads":
            os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        print(ROWS[sys.argv[1]](*sys.argv[2:]))
    else:
        main()
