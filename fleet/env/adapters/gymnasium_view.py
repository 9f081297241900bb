"""The environment for Gymnasium: one dispatcher decides for all arms, alone or in many shifts at once.

    from fleet.env.adapters.gymnasium_view import DispatcherEnv, DispatcherVectorEnv
    from scenarios import make_batch, make_env
    env = DispatcherEnv(make_env("quickstart", difficulty="blind"))
    many = DispatcherVectorEnv(make_batch("quickstart", 64, difficulty="blind"))
    seen, info = many.reset(seed=0)
    seen, *_ = many.step(many.legal_sample())

Both observe Dict {"observation": float32 [arm, size], "action_mask": int8 [arm, slot + 1]} and answer
MultiDiscrete [arm]; the reward is the team's, once. Nothing to install: Gymnasium comes with thermofleet.

Traps:

- Every arm has a mask of its own. `action_space.sample(mask=info["action_mask"])` is legal for `DispatcherEnv`; two
  arms may still claim the same job, and then the better score wins.
- The vector form begins a new shift in the same step (`AutoresetMode.SAME_STEP`): the last observation is in
  `info["final_obs"]`, its rows given by `info["_final_obs"]`. Of a batch made with `autoreset=False` it resets where
  `options={"reset_mask": bool [env]}` says (`AutoresetMode.DISABLED`).
- Observations are in raw units; `FlattenObservation` and the like take them as any Dict.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from pettingzoo import ParallelEnv

from fleet.env.adapters.given import batch_for, env_for
from fleet.env.reward import TERMS
from fleet.env.vector import BatchEnv

Array = np.ndarray
Seen = dict[str, Array]


class DispatcherEnv(gymnasium.Env[Seen, Array]):
    """A `ParallelEnv` of Dict observations as a Gymnasium `Env` with one agent for all arms.

    Infos are of the team: `action_mask`, a tuple of int8 [slot + 1] for each arm, and each number of the arms' infos,
    as float64 [arm].
    """

    def __init__(self, env: ParallelEnv[str, Any, Any]) -> None:
        self.env = env = env_for("DispatcherEnv", env)
        self.arms = tuple(env.possible_agents)
        first: Any = env.observation_space(self.arms[0])
        actions: Any = env.action_space(self.arms[0])
        self.observation_space = dispatcher_space(first, len(self.arms))
        self.action_space = spaces.MultiDiscrete([int(actions.n)] * len(self.arms))
        self.render_mode = getattr(env, "render_mode", None)
        self.metadata = dict(env.metadata)
        self._mask = np.zeros((len(self.arms), int(actions.n)), np.int8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        """Begin a shift."""
        super().reset(seed=seed)
        return self._told(*self.env.reset(seed=seed, options=options))

    def step(self, action: Array) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """One decision for all arms, int [arm]: 0 waits or goes on, k claims slot k; the team's reward."""
        values = np.asarray(action)
        if values.shape != (len(self.arms),):
            raise ValueError(f"action must be one integer for each of {len(self.arms)} arms (got {action!r}).")
        seen, rewards, terminated, truncated, infos = self.env.step(dict(zip(self.arms, values, strict=True)))
        told, info = self._told(seen, infos)
        arm = self.arms[0]
        return told, float(rewards[arm]), terminated[arm], truncated[arm], info

    def action_masks(self) -> Array:
        """The masks of all arms one after the other, bool [arm * (slot + 1)], as sb3-contrib reads them."""
        return self._mask.reshape(-1) == 1

    def render(self) -> Any:
        """What the environment renders."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def _told(self, seen: dict[str, Any], infos: dict[str, dict[str, Any]]) -> tuple[Seen, dict[str, Any]]:
        told = {key: np.stack([seen[arm][key] for arm in self.arms]) for key in ("observation", "action_mask")}
        self._mask = told["action_mask"]
        numbers = {key: np.array([infos[arm][key] for arm in self.arms], float) for key in infos[self.arms[0]]}
        return told, {**numbers, "action_mask": tuple(self._mask.copy())}


class DispatcherVectorEnv(VectorEnv[Seen, Array, Array]):
    """A `BatchEnv` as a Gymnasium `VectorEnv`: a dispatcher in each env, arrays throughout.

    Infos are arrays [env, …]: `action_mask`, those of `BatchEnv.step`, and where a shift ended `final_obs` and
    `final_info`, with the rows in `_final_obs` and `_final_info` as Gymnasium has it.
    """

    def __init__(self, batch: BatchEnv) -> None:
        self.batch = batch = batch_for("DispatcherVectorEnv", batch)
        arms = len(batch.agents)
        self.num_envs = batch.num_envs
        mode = AutoresetMode.SAME_STEP if batch.autoreset else AutoresetMode.DISABLED
        self.metadata = {"autoreset_mode": mode, "render_modes": []}
        self.single_observation_space = dispatcher_space(batch.single_observation_space, arms)
        self.single_action_space = spaces.MultiDiscrete([int(batch.single_action_space.n)] * arms)
        self.observation_space = batch_space(self.single_observation_space, batch.num_envs)
        self.action_space = batch_space(self.single_action_space, batch.num_envs)
        self._mask = np.zeros((batch.num_envs, arms, batch.layout.slots + 1), np.int8)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        """Begin new shifts: env e that of seed + e, or of seed[e]; or only where `options["reset_mask"]` is true."""
        super().reset(seed=seed if isinstance(seed, int) else None)
        obs, info = self.batch.reset(seed, rows=(options or {}).get("reset_mask"))
        self._mask = obs["action_mask"]
        return dict(obs), self._numbers(info)

    def step(self, actions: Array) -> tuple[Seen, Array, Array, Array, dict[str, Any]]:
        """One decision of every env, int [env, arm]."""
        obs, reward, terminated, truncated, info = self.batch.step(actions)
        self._mask = obs["action_mask"]
        told = self._numbers(info)
        ended = info["final_envs"]
        if self.batch.autoreset and len(ended):
            over = terminated | truncated
            told |= {"final_obs": self._last(info), "_final_obs": over}
            told |= {"final_info": self._numbers(info, masks=False), "_final_info": over}
        return dict(obs), reward, terminated, truncated, told

    def legal_sample(self, rng: np.random.Generator | None = None) -> Array:
        """A random answer for every arm of every env, each legal one as likely, int64 [env, arm]."""
        if not self._mask.any():
            raise RuntimeError("Nothing was begun yet: call reset() before legal_sample().")
        rng = rng or self.np_random
        counts = self._mask.cumsum(axis=-1)
        nth = rng.integers(counts[..., -1])
        return (counts > nth[..., None]).argmax(axis=-1)

    def close_extras(self, **_: Any) -> None:
        """Close the batch."""
        self.batch.close()

    def _numbers(self, info: dict[str, Any], *, masks: bool = True) -> dict[str, Any]:
        names = ("faults", "illegal", "peak_c", "above_warning_s", "jobs_done", *(f"reward_{term}" for term in TERMS))
        numbers = {name: info[name] for name in names}
        return numbers | {"action_mask": self._mask} if masks else numbers

    def _last(self, info: dict[str, Any]) -> Seen:
        """What the dispatchers saw at the end of a shift, zeros where none ended, [env, arm, …]."""
        last = {}
        for key, values in info["final_obs"].items():
            last[key] = np.zeros((self.num_envs, *values.shape[1:]), values.dtype)
            last[key][info["final_envs"]] = values
        return last


def dispatcher_space(arm: spaces.Dict, arms: int) -> spaces.Space[Any]:
    """What a dispatcher observes where each arm observes `arm`: the same with an axis of arms before."""
    inner: dict[str, Any] = dict(arm.items())
    return spaces.Dict(
        {
            key: spaces.Box(np.tile(box.low, (arms, 1)), np.tile(box.high, (arms, 1)), dtype=box.dtype)
            for key, box in inner.items()
        }
    )
