"""The environment for RLlib's new API stack, with masks: PPO over one policy that all arms share.

Example, installation and tested versions: docs/trainers.md.

Why RLlib's own `ParallelPettingZooEnv` is not used:

- RLlib and its wrapper keep agents in sets and sample actions in their order. The order of names changes with every
  process (PYTHONHASHSEED), and the results with it. Here the agents are the arms' numbers 0, 1, …, which keep order.
- The wrapper passes on the key "observation", but RLlib's masking module needs "observations"; without a masking
  module PPO refuses Dict observations.
- The wrapper flags every arm as truncated at the horizon. RLlib then takes the episode for terminated and drops the
  value of the last state. Here only "__all__" is flagged, which RLlib applies to the arms as it is.
- Its `render()` passes an argument that no environment takes.

Remaining traps: Ray pickles the factory and calls it, also if the environment runs in this process. The arms' rewards
are equal, so a return as RLlib prints it is the team's, times the number of arms.
"""

# pyright: reportMissingImports=false

from collections.abc import Callable
from typing import Any

from gymnasium import spaces

from fleet.env.adapters.arguments import Env, arm_space, check_env, imported_trainer

with imported_trainer("rllib", "constraints/rllib.txt"):
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.core.rl_module.rl_module import RLModuleSpec
    from ray.rllib.env.multi_agent_env import MultiAgentEnv
    from ray.rllib.examples.rl_modules.classes.action_masking_rlm import ActionMaskingTorchRLModule
    from ray.tune.registry import register_env

NAME = "thermofleet/allocation_v2"
SHARED_POLICY = "arm"

ByArm = dict[int, Any]


class RLlibEnv(MultiAgentEnv):
    """A `ParallelEnv` with Dict observations as RLlib's `MultiAgentEnv`: agent i is `arms[i]`.

    Observations have the vector under "observations" and the mask under "action_mask". Only "__all__" is flagged at
    the end: terminated if every arm is, else truncated.
    """

    def __init__(self, env: Env) -> None:
        self.env = check_env("RLlibEnv", env)
        self.arms = tuple(env.possible_agents)
        self.possible_agents = list(range(len(self.arms)))
        self.agents = list(self.possible_agents)
        self.observation_spaces = {i: renamed_space(arm_space(env, arm)) for i, arm in enumerate(self.arms)}
        self.action_spaces = {i: env.action_space(arm) for i, arm in enumerate(self.arms)}
        super().__init__()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[ByArm, ByArm]:
        """Start an episode; observations and infos by arm."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self.agents = list(self.possible_agents)
        return self._renamed(observations), self._by_number(infos)

    def step(self, action_dict: ByArm) -> tuple[ByArm, ByArm, dict[str, bool], dict[str, bool], ByArm]:
        """One decision of every arm; at the end this includes the last observation."""
        actions = {self.arms[i]: action_dict[i] for i in sorted(action_dict)}
        observations, rewards, terminated, _, infos = self.env.step(actions)
        over, finished = not self.env.agents, all(terminated.values())
        if over:
            self.agents = []
        ends = {"__all__": over and finished}, {"__all__": over and not finished}
        return self._renamed(observations), self._by_number(rewards), *ends, self._by_number(infos)

    def render(self) -> object:
        """The environment's picture."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def _by_number(self, values: dict[str, Any]) -> ByArm:
        return {i: values[arm] for i, arm in enumerate(self.arms) if arm in values}

    def _renamed(self, observations: dict[str, Any]) -> ByArm:
        return {
            i: {"observations": each["observation"], "action_mask": each["action_mask"]}
            for i, each in self._by_number(observations).items()
        }


def renamed_space(space: spaces.Dict) -> spaces.Dict:
    """The space with the vector under the key that RLlib's masking module reads."""
    return spaces.Dict({"observations": space["observation"], "action_mask": space["action_mask"]})


def shared_policy(agent_id: int, *_: object, **__: object) -> str:
    """The name of the one policy of all arms."""
    return SHARED_POLICY


def masked_ppo(factory: Callable[[], Env], name: str = NAME) -> PPOConfig:
    """A `PPOConfig` with the environment, its masks and one shared policy.

    Args:
        factory: Makes the environment, once per env runner and vector index.
        name: Registers the environment with Ray; one name per factory.
    """
    register_env(name, lambda config: RLlibEnv(factory()))
    return (
        PPOConfig()
        # RLlib's environment check takes random actions and ignores the mask.
        .environment(name, disable_env_checking=True)
        .multi_agent(policies={SHARED_POLICY}, policy_mapping_fn=shared_policy)
        .rl_module(rl_module_spec=RLModuleSpec(module_class=ActionMaskingTorchRLModule))
    )
