"""Speed of the environments on one core and one thread beside other environments, and beside copies of observations.

    make bench-env                                                  # installs the other environments and runs this
    .venv/bin/python -m benchmarks.env [--out docs/results/env.json] # skips environments that are not installed

Every row is a separate process, pinned to one core, and the median of three windows. A window is a whole shift (720
steps), so resets are included. Actions are random legal ones, and choosing them is included:
`fleet.env.random_actions.random_legal` for the batch, the same by hand for the single environment. For more than four
arms, the arms of quickstart are repeated, and its arrival rates multiplied; there are always 16 slots. The bytes of a
step are those of all arrays of its observations, and `np.copyto` copies arrays of that size in the same process.
"""

import os
import sys

os.environ["OMP_NUM_THREADS"] = "1"

import json
import platform
import statistics
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple  # values of JSON

import numpy as np

from benchmarks.harness import machine, options, rss_mb, step_figures, write_text
from benchmarks.result_tables import env_ratios_table, env_table
from fleet.engine.tables import Tables
from fleet.env.random_actions import random_legal
from fleet.env.vector import BatchEnv, Library, keep_pages
from scenarios.prepare.batch import library_of
from scenarios.prepare.fleet import Randomisation, env_of, prepare
from scenarios.spec.load import load
from scenarios.spec.options import DifficultyName

WINDOWS, SHIFT, LONGEST_S = 3, 720, 1200


def single(difficulty: DifficultyName) -> dict[str, float]:
    """Measure the `ParallelEnv`."""
    env = env_of(prepare(load("quickstart"), difficulty=difficulty))
    rng, seen = np.random.default_rng(0), {}

    def window() -> tuple[int, Any]:
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
        return steps, seen

    seen, _ = env.reset(seed=0)
    for _ in range(10):  # fills the caches: a twin scores every possible job once
        env.reset()
    return step_figures(window, 1, len(env.possible_agents))


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


def batch(difficulty: DifficultyName, envs: int, arms: int = 4, peers: int | None = None) -> dict[str, float]:
    """Measure a batch."""
    env, rng = BatchEnv(library(difficulty, arms, peers), envs, seed=0), np.random.default_rng(0)
    seen, _ = env.reset()

    def window() -> tuple[int, Any]:
        nonlocal seen
        for _ in range(SHIFT):
            seen, *_ = env.step(random_legal(seen["action_mask"], rng))
        return SHIFT, seen

    return step_figures(window, envs, arms)


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


def torchrl(envs: int, *, joined: bool = True, kept: bool = False) -> dict[str, float]:
    """Measure rollouts of TorchRL with its random policy."""
    if kept and not keep_pages():
        raise SystemExit("keep_pages() needs glibc.")
    import torch

    from fleet.env.adapters.torchrl import TorchRLEnv

    torch.set_num_threads(1)
    env = TorchRLEnv(BatchEnv(library("blind"), envs, seed=0, autoreset=False), seed=0, joined=joined)
    begin, length = env.reset(), 90

    def window() -> tuple[int, Any]:
        nonlocal begin
        for _ in range(SHIFT // length):
            frames = env.rollout(length, break_when_any_done=False, auto_reset=False, tensordict=begin)
            begin = env.step_mdp(frames[:, -1])
        return SHIFT, [begin[key] for key in env.observation_keys]

    return step_figures(window, envs, len(env.batch.agents))


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


class Row(NamedTuple):
    """A row of the table."""

    what: str
    command: tuple[str, ...]
    """Module of `benchmarks`, and its arguments."""
    needs: str = "numpy"
    """The Python module that must be installed."""


def rows() -> Iterator[Row]:
    """All rows of the table."""
    for difficulty in ("blind", "twin"):
        yield Row(f"single ParallelEnv, {difficulty}", ("env", "single", difficulty))
        for envs in ("32", "1024"):
            yield Row(f"batch of {envs}, {difficulty}", ("env", "batch", difficulty, envs))
    yield Row("TorchRL rollout of 1024, blind", ("env", "torchrl", "1024"), "torchrl")
    yield Row("the same, parts not joined", ("env", "torchrl", "1024", "parts"), "torchrl")
    yield Row("the same after keep_pages()", ("env", "torchrl", "1024", "kept"), "torchrl")
    yield Row("MPE simple_spread", ("peers", "mpe", "1"), "mpe2")
    yield Row("RWARE tiny", ("peers", "rware", "1"), "rware")
    for envs in ("1", "32", "1024"):
        yield Row(f"VMAS simple_spread, {envs}", ("peers", "vmas", envs), "vmas")
    for envs in ("32", "1024"):
        yield Row(f"PufferLib Ocean RWARE tiny (C), {envs}", ("peers", "ocean", envs), "ocean_rware")
    yield Row("Craftax-Classic (JAX), 64", ("peers", "craftax", "64"), "craftax")
    for peers, what in (((), "all peers"), (("3",), "3 peers")):
        for arms in ("4", "8", "16", "64"):
            yield Row(f"64 envs of {arms} arms that observe {what}", ("env", "batch", "blind", "64", arms, *peers))


RATIOS = (
    ("1024 envs against VMAS 1024, blind", ("batch of 1024, blind", "VMAS simple_spread, 1024"), "≥ 2"),
    ("32 envs against VMAS 32, blind", ("batch of 32, blind", "VMAS simple_spread, 32"), "≥ 28"),
    ("single env against MPE", ("single ParallelEnv, blind", "MPE simple_spread"), "≥ 15"),
    ("single env against RWARE", ("single ParallelEnv, blind", "RWARE tiny"), "≥ 13"),
    ("1024 envs with twins against blind", ("batch of 1024, twin", "batch of 1024, blind"), "≥ 0.8"),
    ("TorchRL rollout against the bare batch", ("the same, parts not joined", "batch of 1024, blind"), "≥ 0.7"),
)
"""What the ratio of the steps per second of two rows means, the rows, and the goal."""
SMALL, LARGE = (f"64 envs of {arms} arms that observe all peers" for arms in (4, 64))

MEASURED = {
    "single": lambda difficulty: single(difficulty),
    "batch": lambda difficulty, envs, arms="4", *peers: batch(difficulty, int(envs), int(arms), *map(int, peers)),
    "torchrl": lambda envs, how="": torchrl(int(envs), joined=not how, kept=how == "kept"),
    "threads": lambda envs: {"speed_up": two_threads(int(envs))},
    "memory": lambda envs, arms: {"mb": memory(int(envs), int(arms))},
}


def measured(*command: str) -> dict[str, Any]:
    """Run a measurement in a separate process; if it fails, return the reason as `missing`."""
    print(" ".join(command), "…", file=sys.stderr, flush=True)
    program = [sys.executable, "-m", f"benchmarks.{command[0]}", *command[1:]]
    try:
        done = subprocess.run(program, capture_output=True, text=True, timeout=LONGEST_S, check=False)
    except subprocess.TimeoutExpired:
        return {"missing": f"not done after {LONGEST_S} s"}
    if done.returncode:
        return {"missing": f"failed: {(done.stderr.strip().splitlines() or [f'exit code {done.returncode}'])[-1]}"}
    return json.loads(done.stdout.splitlines()[-1])


def ratios(found: dict[str, dict[str, Any]], speed_up: float | None) -> Iterator[dict[str, Any]]:
    """Every ratio with its goal; None if one of its rows is missing."""

    def ratio(above: float | None, below: float | None) -> float | None:
        return None if above is None or below is None else above / below

    for what, names, goal in RATIOS:
        yield {"what": what, "ratio": ratio(*(found[name].get("steps_per_s") for name in names)), "goal": goal}
    one = found["batch of 1024, blind"]
    share = ratio(one.get("observed_gb_per_s"), one.get("copied_gb_per_s"))
    yield {"what": "observations of 1024 envs against np.copyto", "ratio": share, "goal": "≥ 0.25"}
    growth = ratio(*(found[name].get("ns_per_agent_step") for name in (LARGE, SMALL)))
    yield {"what": "time per arm step, 64 arms against 4, all peers", "ratio": growth, "goal": "≤ 1.3"}
    yield {"what": "two threads against one, 1024 envs, wall clock", "ratio": speed_up, "goal": "≥ 1.7"}


def main() -> None:
    """Measure all rows, and print them and their ratios."""
    given = options(__doc__, out=(Path, "file of the result, as JSON"))
    busy = machine()
    found: dict[str, dict[str, Any]] = {}
    for what, command, needs in rows():
        installed = find_spec(needs) is not None
        found[what] = measured(*command) if installed else {"missing": "not installed; make bench-env installs it"}
    threads = measured("env", "threads", "1024")
    result = {
        **busy,
        "python": platform.python_version(),
        "rows": [{"what": what, **figures} for what, figures in found.items()],
        "ratios": list(ratios(found, threads.get("speed_up"))),
        "memory_mb": measured("env", "memory", "1024", "8").get("mb"),
    }
    print(env_table(result), env_ratios_table(result), sep="\n\n")
    if given.out is not None:
        write_text(given.out, json.dumps(result, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    if sys.argv[1:] and sys.argv[1] in MEASURED:
        if sys.argv[1] != "threads":
            os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        print(json.dumps(MEASURED[sys.argv[1]](*sys.argv[2:])))
    else:
        main()
