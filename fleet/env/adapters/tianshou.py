"""The environment for Tianshou, with masks: the arms decide in turn, then the step is taken.

Example, installation and tested versions: docs/trainers.md.

Traps, all of Tianshou:

- Only the DQN family reads the mask. PPO, A2C and SAC for discrete actions do not: use a network that does.
- In training a team's arms explore by `eps_inference`: Tianshou sets only the team, not its arms, to training.
- One transition is one arm's turn, its successor is the next arm's turn, and the reward comes with the last arm's turn.
  So set `n_step_return_horizon=len(env.agents)`: then an arm's return includes the reward of its own step, and its
  successor is its own next turn. With 1, only the last arm's transitions have a reward.
- A discount `gamma` counts once per turn: for a discount g per decision, use g ** (1 / len(env.agents)).
- A step of a collector is a turn: an episode of 40 decisions and 3 arms has 120.
"""

# pyright: reportMissingImports=false

from typing import Any

import numpy as np
from pettingzoo.utils import parallel_to_aec

from fleet.env.adapters.arguments import Env, check_env, imported_trainer

with imported_trainer("tianshou", "constraints/tianshou.txt"):
    from tianshou.env.pettingzoo_env import PettingZooEnv


class TianshouEnv(PettingZooEnv):
    """A `ParallelEnv` with Dict observations as Tianshou's `PettingZooEnv`, turn by turn.

    Masks are bool arrays. The rewards of each turn are a new array, [arm]; Tianshou reuses one list.
    """

    def __init__(self, env: Env) -> None:
        super().__init__(parallel_to_aec(check_env("TianshouEnv", env)))
        self.render_mode = getattr(env, "render_mode", None)

    # Any: the signatures are Tianshou's.
    def reset(self, *args: Any, **kwargs: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; the first arm's observation and info."""
        observation, info = super().reset(*args, **kwargs)
        return _with_bool_mask(observation), info

    def step(self, action: Any) -> tuple[dict[str, Any], np.ndarray, bool, bool, dict[str, Any]]:
        """One arm's decision: the next arm's observation, rewards [arm], terminated, truncated, the next arm's info."""
        observation, rewards, terminated, truncated, info = super().step(action)
        return _with_bool_mask(observation), np.array(rewards, dtype=np.float32), terminated, truncated, info


def _with_bool_mask(observation: dict[str, Any]) -> dict[str, Any]:
    return {**observation, "mask": np.array(observation["mask"], dtype=bool)}
