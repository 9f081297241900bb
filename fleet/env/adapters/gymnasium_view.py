"""The environment for Gymnasium: one dispatcher decides for all arms, in one episode or in many at once.

Example, installation and tested versions: docs/trainers.md.

Observations are Dict {"observation": float32 [arm, size], "action_mask": int8 [arm, action]}, actions are
MultiDiscrete [arm], the reward is the team's.

Traps:

- Every arm has its own mask. `action_space.sample(mask=info["action_mask"])` is legal for `DispatcherEnv`; two arms may
  still claim the same job, and then the better score wins.
- The vector form starts the next episode in the same step (`AutoresetMode.SAME_STEP`): the last observation is in
  `info["final_obs"]`, its rows are given by `info["_final_obs"]`. With a batch made with `autoreset=False` it resets
  the rows of `options={"reset_mask": bool [env]}` (`AutoresetMode.DISABLED`).
- Observations are in raw units; wrappers such as `FlattenObservation` take them like any Dict.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from fleet.env.adapters.arguments import ARM_INFOS, TEAM_INFOS, Env, Infos, arm_space, check_batch, check_env
from fleet.env.validation import check_reset_options
from fleet.env.vector import BatchEnv

Array = np.ndarray
Observation = dict[str, Array]


class DispatcherEnv(gymnasium.Env[Observation, Array]):
    """A `ParallelEnv` with Dict observations as a Gymnasium `Env` with one agent for all arms.

    Infos are `action_mask`, a tuple of int8 [action] for each arm, and each number of the arms' infos, as float64
    [arm].
    """

    def __init__(self, env: Env) -> None:
        self.env = env = check_env("DispatcherEnv", env)
        self.arms = tuple(env.possible_agents)
        self.observation_space = dispatcher_space(arm_space(env, self.arms[0]), len(self.arms))
        discrete = env.action_space(self.arms[0])
        assert isinstance(discrete, spaces.Discrete)
        actions = int(discrete.n)
        self.action_space = spaces.MultiDiscrete([actions] * len(self.arms))
        self.render_mode = getattr(env, "render_mode", None)
        self.metadata = dict(env.metadata)
        self._mask = np.zeros((len(self.arms), actions), np.int8)

    def reset(self, *, seed: int | None = None, options: Infos | None = None) -> tuple[Observation, Infos]:
        """Start an episode."""
        super().reset(seed=seed)
        return self._stacked(*self.env.reset(seed=seed, options=options))

    def step(self, action: Array) -> tuple[Observation, float, bool, bool, Infos]:
        """One decision for all arms, int [arm], with the actions of `AllocationEnv`. Returns the team's reward."""
        values = np.asarray(action)
        if values.shape != (len(self.arms),):
            raise ValueError(f"action must be one integer for each of {len(self.arms)} arms (got {action!r}).")
        each, rewards, terminated, truncated, infos = self.env.step(dict(zip(self.arms, values, strict=True)))
        observation, info = self._stacked(each, infos)
        arm = self.arms[0]
        return observation, float(rewards[arm]), terminated[arm], truncated[arm], info

    def action_masks(self) -> Array:
        """The masks of all arms one after the other, bool [arm * action], as sb3-contrib reads them."""
        return self._mask.reshape(-1) == 1

    def render(self) -> Any:  # as Gymnasium has it
        """The environment's picture."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def _stacked(self, each: dict[str, Observation], infos: dict[str, Infos]) -> tuple[Observation, Infos]:
        stacked = {key: np.stack([each[arm][key] for arm in self.arms]) for key in ("observation", "action_mask")}
        self._mask = stacked["action_mask"]
        numbers = {key: np.array([infos[arm][key] for arm in self.arms], float) for key in infos[self.arms[0]]}
        return stacked, {**numbers, "action_mask": tuple(self._mask.copy())}


class DispatcherVectorEnv(VectorEnv[Observation, Array, Array]):
    """A `BatchEnv` as a Gymnasium `VectorEnv` with one dispatcher in each env.

    Infos are arrays [env, …]: `action_mask`, the infos of `BatchEnv.step`, and where an episode ended `final_obs` and
    `final_info`, with the rows in `_final_obs` and `_final_info` as in Gymnasium.
    """

    def __init__(self, batch: BatchEnv) -> None:
        self.batch = batch = check_batch("DispatcherVectorEnv", batch)
        arms = len(batch.agents)
        self.num_envs = batch.num_envs
        mode = AutoresetMode.SAME_STEP if batch.autoreset else AutoresetMode.DISABLED
        self.metadata = {"autoreset_mode": mode, "render_modes": []}
        self.single_observation_space = dispatcher_space(batch.single_observation_space, arms)
        self.single_action_space = spaces.MultiDiscrete([int(batch.single_action_space.n)] * arms)
        self.observation_space = batch_space(self.single_observation_space, batch.num_envs)
        self.action_space = batch_space(self.single_action_space, batch.num_envs)
        self._mask = np.zeros((batch.num_envs, arms, batch.layout.actions), np.int8)

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: Infos | None = None
    ) -> tuple[Observation, Infos]:
        """Start episodes with seed + e or seed[e] in env e; only where `options["reset_mask"]` is true, if given."""
        check_reset_options(options, "reset_mask")
        super().reset(seed=seed if isinstance(seed, int) else None)
        obs, info = self.batch.reset(seed, rows=(options or {}).get("reset_mask"))
        self._mask = obs["action_mask"]
        return self.batch.joined(obs), self._numbers(info)

    def step(self, actions: Array) -> tuple[Observation, Array, Array, Array, Infos]:
        """One decision of every arm of every env, int [env, arm]."""
        obs, reward, terminated, truncated, info = self.batch.step(actions)
        self._mask = obs["action_mask"]
        numbers = self._numbers(info)
        if self.batch.autoreset and len(info["final_envs"]):
            ended = terminated | truncated
            numbers |= {"final_obs": self._last(info), "_final_obs": ended}
            numbers |= {"final_info": self._numbers(info, masks=False), "_final_info": ended}
        return self.batch.joined(obs), reward, terminated, truncated, numbers

    def legal_sample(self, rng: np.random.Generator | None = None) -> Array:
        """Random legal actions, all equally likely, int64 [env, arm]."""
        if not self._mask.any():
            raise RuntimeError("Call reset() before legal_sample(): there is no episode yet.")
        rng = rng or self.np_random
        counts = self._mask.cumsum(axis=-1)
        nth = rng.integers(counts[..., -1])
        return (counts > nth[..., None]).argmax(axis=-1)

    def close_extras(self, **_: object) -> None:
        """Close the batch."""
        self.batch.close()

    def _numbers(self, info: Infos, *, masks: bool = True) -> Infos:
        numbers = {name: info[name] for name in (*ARM_INFOS, *TEAM_INFOS)}
        return numbers | {"action_mask": self._mask} if masks else numbers

    def _last(self, info: Infos) -> Observation:
        """Last observation of each episode that ended, zeros for the others, [env, arm, …]."""
        last = {}
        for key, values in self.batch.joined(info["final_obs"]).items():
            last[key] = np.zeros((self.num_envs, *values.shape[1:]), values.dtype)
            last[key][info["final_envs"]] = values
        return last


def dispatcher_space(arm: spaces.Dict, arms: int) -> spaces.Space[Any]:
    """Observation space of a dispatcher: the space of one arm with a leading axis of arms."""
    return spaces.Dict(
        {
            key: spaces.Box(np.tile(box.low, (arms, 1)), np.tile(box.high, (arms, 1)), dtype=box.dtype)
            for key, box in arm.items()
            if isinstance(box, spaces.Box)
        }
    )
