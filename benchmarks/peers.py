"""Steps per CPU-second of other environments, each measured in a separate process; prints one line.

    python -m benchmarks.peers mpe|rware|vmas ENVS

They are not part of thermofleet and it imports none of them; `make bench-env` installs them. VMAS is under GPL-3.
"""

import os
import sys

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"

import time
import warnings
from collections.abc import Callable

import numpy as np

from benchmarks.harness import median_rate

warnings.filterwarnings("ignore")
WINDOW_S = 1.5


def rate(step: Callable[[], None], envs: int) -> float:
    """Env steps per CPU-second."""

    def window() -> int:
        begin, steps = time.process_time(), 0
        while time.process_time() - begin < WINDOW_S:
            step()
            steps += 1
        return envs * steps

    return median_rate(window)


def mpe() -> Callable[[], None]:
    """PettingZoo's MPE simple_spread, parallel, with defaults: three agents, 25 cycles."""
    from mpe2 import simple_spread_v3  # pyright: ignore[reportMissingImports]  # of the extra bench

    env, rng = simple_spread_v3.parallel_env(), np.random.default_rng(0)
    env.reset(seed=0)
    actions = env.action_space(env.possible_agents[0]).n

    def step() -> None:
        env.step(dict(zip(env.agents, rng.integers(actions, size=len(env.agents)).tolist(), strict=True)))
        if not env.agents:
            env.reset()

    return step


def rware() -> Callable[[], None]:
    """The robotic warehouse, tiny, four agents."""
    import gymnasium
    import rware  # noqa: F401  # registers itself  # pyright: ignore[reportMissingImports]

    env, rng = gymnasium.make("rware-tiny-4ag-v2"), np.random.default_rng(0)
    env.reset(seed=0)

    def step() -> None:
        _, _, over, cut, _ = env.step(tuple(rng.integers(5, size=4).tolist()))
        if over or cut:
            env.reset()

    return step


def vmas(envs: int) -> Callable[[], None]:
    """VMAS simple_spread with its own random actions, reset every 100 steps."""
    import torch
    from vmas import make_env  # pyright: ignore[reportMissingImports]

    torch.set_num_threads(1)
    env = make_env(scenario="simple_spread", num_envs=envs, device="cpu", seed=0)
    count = 0

    def step() -> None:
        nonlocal count
        env.step([env.get_random_action(agent) for agent in env.agents])
        count += 1
        if count % 100 == 0:
            env.reset()

    return step


def main() -> None:
    """Measure the named peer."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    name, envs = sys.argv[1], int(sys.argv[2])
    step = {"mpe": mpe, "rware": rware, "vmas": lambda: vmas(envs)}[name]()
    print(rate(step, envs))


if __name__ == "__main__":
    main()
