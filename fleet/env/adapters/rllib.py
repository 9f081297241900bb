"""The environment for RLlib's new API stack, with masks: PPO over one policy that all arms share.

    from functools import partial
    from fleet.env.adapters.rllib import masked_ppo
    from scenarios import make_env
    algo = masked_ppo(partial(make_env, "quickstart", difficulty="blind")).build_algo()
    print(algo.train()["env_runners"]["episode_return_mean"])

Install: `pip install 'thermofleet[rllib]' -c constraints/rllib.txt`. Run with ray 2.60.0, gymnasium 1.2.2 (which RLlib
pins), torch 2.13.0.

What RLlib's own `ParallelPettingZooEnv` does otherwise, and why it is not used here:

- RLlib, and its wrapper too, keep agents in sets and draw actions in their order. Names come in another order in every
  process (PYTHONHASHSEED), and results with them. Here the agents are the arms' numbers 0, 1, …, which come in order.
- It passes the key "observation" on, but RLlib's masking module wants "observations"; without a masking module PPO
  refuses Dict observations.
- It flags every arm as truncated at the horizon, whereupon RLlib's episodes count as terminated and the value of the
  last state is dropped. Here only "__all__" is flagged, which RLlib hands on to the arms as it is.
- Its `render()` passes an argument that no environment takes.

Traps that remain: the factory is pickled into Ray and called there, also where the environment runs in this process.
The arms' rewards are equal, so a return as RLlib prints it is the team's, times the number of arms.
"""

# pyright: reportMissingImports=false

from collections.abc import Callable
from typing import Any

from gymnasium import spaces
from pettingzoo import ParallelEnv
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.multi_agent_env import MultiAgentEnv
from ray.rllib.examples.rl_modules.classes.action_masking_rlm import ActionMaskingTorchRLModule
from ray.tune.registry import register_env

from fleet.env.adapters.given import env_for

NAME = "thermofleet/allocation_v0"
SHARED_POLICY = "arm"

ByArm = dict[int, Any]


class RLlibEnv(MultiAgentEnv):
    """A `ParallelEnv` of Dict observations as RLlib's `MultiAgentEnv`: agent i is `arms[i]`.

    Observations have the vector under "observations" and the mask under "action_mask". The end is told of "__all__"
    alone: terminated if every arm is, else truncated.
    """

    def __init__(self, env: ParallelEnv[str, Any, Any]) -> None:
        self.env = env_for("RLlibEnv", env)
        self.arms = tuple(env.possible_agents)
        self.possible_agents = list(range(len(self.arms)))
        self.agents = list(self.possible_agents)
        self.observation_spaces = {i: renamed_space(env.observation_space(arm)) for i, arm in enumerate(self.arms)}
        self.action_spaces = {i: env.action_space(arm) for i, arm in enumerate(self.arms)}
        super().__init__()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[ByArm, ByArm]:
        """Begin an episode: observations and infos by arm."""
        seen, infos = self.env.reset(seed=seed, options=options)
        self.agents = list(self.possible_agents)
        return self._seen(seen), self._by_number(infos)

    def step(self, action_dict: ByArm) -> tuple[ByArm, ByArm, dict[str, bool], dict[str, bool], ByArm]:
        """One decision of every arm; at the end the last observation comes with it."""
        actions = {self.arms[i]: action_dict[i] for i in sorted(action_dict)}
        seen, rewards, terminated, _, infos = self.env.step(actions)
        over, finished = not self.env.agents, all(terminated.values())
        if over:
            self.agents = []
        ends = {"__all__": over and finished}, {"__all__": over and not finished}
        return self._seen(seen), self._by_number(rewards), *ends, self._by_number(infos)

    def render(self) -> Any:
        """What the environment renders."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def _by_number(self, values: dict[str, Any]) -> ByArm:
        return {i: values[arm] for i, arm in enumerate(self.arms) if arm in values}

    def _seen(self, seen: dict[str, Any]) -> ByArm:
        return {
            i: {"observations": each["observation"], "action_mask": each["action_mask"]}
            for i, each in self._by_number(seen).items()
        }


def renamed_space(space: Any) -> spaces.Dict:
    """The space with its vector under the key that RLlib's masking module reads."""
    return spaces.Dict({"observations": space["observation"], "action_mask": space["action_mask"]})


def shared_policy(agent_id: int, *_: Any, **__: Any) -> str:
    """The name of the one policy of all arms."""
    return SHARED_POLICY


def masked_ppo(factory: Callable[[], ParallelEnv[str, Any, Any]], name: str = NAME) -> PPOConfig:
    """A `PPOConfig` with the environment, its masks and one shared policy; go on as with any other.

    Args:
        factory: Makes the environment, once per env runner and vector index.
        name: Under which the environment is registered with Ray; one name per factory.
    """
    register_env(name, lambda config: RLlibEnv(factory()))
    return (
        PPOConfig()
        # RLlib's check of environments acts at random, whatever the mask.
        .environment(name, disable_env_checking=True)
        .multi_agent(policies={SHARED_POLICY}, policy_mapping_fn=shared_policy)
        .rl_module(rl_module_spec=RLModuleSpec(module_class=ActionMaskingTorchRLModule))
    )
