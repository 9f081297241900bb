"""The environment for Tianshou, with masks: the arms decide one after the other, then the step is taken.

    from fleet.env.adapters.tianshou import TianshouEnv
    from scenarios import make_env
    env = TianshouEnv(make_env("quickstart", difficulty="blind"))
    seen, info = env.reset(seed=0)  # {"agent_id": "arm_0", "obs": vector, "mask": who may do what}
    seen, rewards, terminated, truncated, info = env.step(0)  # now it is arm_1's turn

Install: `pip install 'thermofleet[tianshou]' -c constraints/tianshou.txt`. Run with tianshou 2.0.1, torch 2.13.0.

Traps, all of Tianshou's own making:

- Only the DQN family reads the mask. PPO, A2C and SAC for discrete actions do not: give them a network that does.
- In training a team's arms explore by `eps_inference`: Tianshou tells only the team, not its arms, that it is training.
- One transition is one arm's turn, its successor the next arm's turn, and the reward comes with the last arm's turn. So
  set `n_step_return_horizon=len(env.agents)`: then an arm's return holds the reward of its own step, and its successor
  is its own next turn. With 1, only the last arm's transitions hold a reward.
- A discount `gamma` counts once per turn: for a discount g per decision, give g ** (1 / len(env.agents)).
- A step of a collector is a turn: an episode of 40 decisions and 3 arms has 120.
"""

# pyright: reportMissingImports=false

from typing import Any

import numpy as np
from pettingzoo import ParallelEnv
from pettingzoo.utils import parallel_to_aec
from tianshou.env.pettingzoo_env import PettingZooEnv

from fleet.env.adapters.given import env_for


class TianshouEnv(PettingZooEnv):
    """A `ParallelEnv` of Dict observations as Tianshou's `PettingZooEnv`, turn by turn.

    The mask is an array of bool, the rewards of each turn are an array of its own, [arm] (Tianshou hands out one list
    and writes on in it).
    """

    def __init__(self, env: ParallelEnv[str, Any, Any]) -> None:
        super().__init__(parallel_to_aec(env_for("TianshouEnv", env)))
        self.render_mode = getattr(env, "render_mode", None)

    def reset(self, *args: Any, **kwargs: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode: what the first arm sees, and its info."""
        seen, info = super().reset(*args, **kwargs)
        return _plain(seen), info

    def step(self, action: Any) -> tuple[dict[str, Any], Any, bool, bool, dict[str, Any]]:
        """One arm's decision: what the next arm sees, rewards [arm], the two ends, the next arm's info."""
        seen, rewards, terminated, truncated, info = super().step(action)
        return _plain(seen), np.array(rewards, dtype=np.float32), terminated, truncated, info


def _plain(seen: dict[str, Any]) -> dict[str, Any]:
    return {**seen, "mask": np.array(seen["mask"], dtype=bool)}
