"""Speed of other environments, each measured in a separate process; prints a JSON object.

    python -m benchmarks.peers mpe|rware|vmas|ocean|craftax ENVS

They are not part of thermofleet and it imports none of them; `make bench-env` installs them. VMAS is under GPL-3.
"""

import os
import sys

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import json
import time
import warnings
from collections.abc import Callable
from typing import Any  # observations of other packages

import numpy as np

from benchmarks.harness import step_figures

warnings.filterwarnings("ignore")
WINDOW_S = 1.5

Step = Callable[[], Any]
"""Steps all envs with random actions, and returns their observations."""


def mpe(envs: int) -> tuple[Step, int]:
    """PettingZoo's MPE simple_spread, parallel, with defaults: three agents, 25 cycles."""
    from mpe2 import simple_spread_v3  # pyright: ignore[reportMissingImports]  # of the extra bench

    assert envs == 1
    env, rng = simple_spread_v3.parallel_env(), np.random.default_rng(0)
    env.reset(seed=0)
    actions = env.action_space(env.possible_agents[0]).n

    def step() -> Any:
        seen, *_ = env.step(dict(zip(env.agents, rng.integers(actions, size=len(env.agents)).tolist(), strict=True)))
        if not env.agents:
            env.reset()
        return seen

    return step, len(env.possible_agents)


def rware(envs: int) -> tuple[Step, int]:
    """The robotic warehouse, tiny, four agents."""
    import gymnasium
    import rware  # noqa: F401  # registers itself  # pyright: ignore[reportMissingImports]

    assert envs == 1
    env, rng = gymnasium.make("rware-tiny-4ag-v2"), np.random.default_rng(0)
    env.reset(seed=0)

    def step() -> Any:
        seen, _, over, cut, _ = env.step(tuple(rng.integers(5, size=4).tolist()))
        if over or cut:
            env.reset()
        return seen

    return step, 4


def vmas(envs: int) -> tuple[Step, int]:
    """VMAS simple_spread with its own random actions, reset every 100 steps."""
    import torch
    from vmas import make_env  # pyright: ignore[reportMissingImports]

    torch.set_num_threads(1)
    env = make_env(scenario="simple_spread", num_envs=envs, device="cpu", seed=0)
    count = 0

    def step() -> Any:
        nonlocal count
        seen, *_ = env.step([env.get_random_action(agent) for agent in env.agents])
        count += 1
        if count % 100 == 0:
            env.reset()
        return seen

    return step, len(env.agents)


def ocean(envs: int) -> tuple[Step, int]:
    """PufferLib's robotic warehouse in C, tiny, four agents; an episode does not end."""
    from ocean_rware import binding  # pyright: ignore[reportMissingImports]  # compiled by make bench-env

    agents, rng = 4, np.random.default_rng(0)
    types = {"actions": np.int32, "rewards": np.float32, "terminated": np.uint8, "cut": np.uint8}
    buffers: dict[str, np.ndarray] = {"seen": np.zeros((envs, agents, 27), np.float32)}
    buffers |= {name: np.zeros((envs, agents), dtype) for name, dtype in types.items()}
    options = {"width": 1280, "height": 640, "map_choice": 1, "num_agents": agents, "num_requested_shelves": agents}
    options |= {"grid_square_size": 64, "human_agent_idx": 0}
    rows = enumerate(zip(*buffers.values(), strict=True))
    batch = binding.vectorize(*(binding.env_init(*row, env, **options) for env, row in rows))
    binding.vec_reset(batch, 0)

    def step() -> Any:
        buffers["actions"][:] = rng.integers(5, size=(envs, agents), dtype=np.int32)
        binding.vec_step(batch)
        return buffers["seen"]  # the C code writes to all buffers, so they live as long as this function

    return step, agents


def craftax(envs: int) -> tuple[Step, int]:
    """Craftax-Classic with symbolic observations, compiled by JAX; all envs are reset every 200 steps.

    Its own automatic reset makes a new world for every env at every step, which is slower.
    """
    import jax  # pyright: ignore[reportMissingImports]
    from craftax.craftax_env import make_craftax_env_from_name  # pyright: ignore[reportMissingImports]

    env = make_craftax_env_from_name("Craftax-Classic-Symbolic-v1", auto_reset=False)
    actions = env.action_space(env.default_params).n

    def begin(key: Any) -> Any:
        return jax.vmap(env.reset)(jax.random.split(key, envs))

    def advance(key: Any, state: Any) -> Any:
        key, chosen, own = jax.random.split(key, 3)
        sampled = jax.random.randint(chosen, (envs,), 0, actions)
        seen, state, reward, done, _ = jax.vmap(env.step)(jax.random.split(own, envs), state, sampled)
        return key, state, seen, reward, done

    reset, move = jax.jit(begin), jax.jit(advance, donate_argnums=1)
    key = jax.random.PRNGKey(0)
    _, state = reset(key)
    count = 0

    def step() -> Any:
        nonlocal key, state, count
        key, state, seen, *_ = move(key, state)
        count += 1
        if count % 200 == 0:
            _, state = reset(key)
        return seen.block_until_ready()

    return step, 1


PEERS = {"mpe": mpe, "rware": rware, "vmas": vmas, "ocean": ocean, "craftax": craftax}


def main() -> None:
    """Measure the named peer."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    envs = int(sys.argv[2])
    step, agents = PEERS[sys.argv[1]](envs)

    def window() -> tuple[int, Any]:
        begin_s, steps, seen = time.process_time(), 0, None
        while time.process_time() - begin_s < WINDOW_S:
            seen = step()
            steps += 1
        return steps, seen

    print(json.dumps(step_figures(window, envs, agents)))


if __name__ == "__main__":
    main()
