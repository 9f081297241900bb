"""The batch for Stable-Baselines3: every arm of every env is a row of one `VecEnv`, with masks for MaskablePPO.

Example, installation and tested versions: docs/trainers.md.

All arms share one policy, and each row gets the team's reward.

Why SuperSuit is not used: MaskablePPO finds no masks through it (`has_attr` is missing), `seed` fails, and most of its
wrappers refuse Dict observations.

Traps:

- PPO, A2C and DQN of Stable-Baselines3 itself read no masks. Their illegal actions are waits, counted in `illegal` of
  the infos at an episode's end. Use MaskablePPO.
- `n_steps` and `total_timesteps` count rows: a step of 16 envs with 4 arms is 64 timesteps.
- Observations are in raw units. `VecNormalize` scales them and passes the masks on.
- The next episode starts in the step that ends one; the last observation is `terminal_observation` in the infos.
"""

# pyright: reportMissingImports=false

from collections.abc import Iterable, Sequence
from typing import Any, Literal, get_args

import numpy as np

from fleet.env.adapters.arguments import check_batch, imported_trainer
from fleet.env.validation import check_choice
from fleet.env.vector import BatchEnv, Obs

with imported_trainer("sb3", "constraints/sb3.txt"):
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import VecEnv

Array = np.ndarray
Kind = Literal["vector", "dict"]


class ArmsVecEnv(VecEnv):
    """A `BatchEnv` as a `VecEnv` of num_envs * arms rows: row env * arms + arm.

    Infos are empty except at the end of an episode: `terminal_observation`, `TimeLimit.truncated`, `episode` with
    return "r" and length "l", and the arm's `faults` and `illegal`.

    Args:
        batch: The episodes, with `autoreset` on.
        observation: "vector" for "MlpPolicy", or "dict" with vector and mask for "MultiInputPolicy".
    """

    def __init__(self, batch: BatchEnv, *, observation: Kind = "vector") -> None:
        check_choice("observation", observation, get_args(Kind))
        self.batch, self.arms = check_batch("ArmsVecEnv", batch, autoreset=True), len(batch.agents)
        self.kind: Kind = observation
        space = batch.single_observation_space
        rows = batch.num_envs * self.arms
        super().__init__(rows, space if observation == "dict" else space["observation"], batch.single_action_space)
        self._mask = np.ones((rows, batch.layout.actions), dtype=bool)
        self._next: int | None = None
        self._actions = np.zeros((batch.num_envs, self.arms), dtype=np.int64)
        self._returns, self._lengths = np.zeros(batch.num_envs), np.zeros(batch.num_envs, dtype=int)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed env e with seed + e at the next `reset`; returns the seed of each row's env."""
        self._next = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else int(seed)
        return [self._next + row // self.arms for row in range(self.num_envs)]

    def reset(self) -> Array | dict[str, Array]:
        """Start new episodes in all envs."""
        seed, self._next = self._next, None
        obs, _ = self.batch.reset(seed)
        self._returns[:], self._lengths[:] = 0.0, 0
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return self._rows(obs)

    def step_async(self, actions: Array) -> None:
        """Keep the actions, int [row], for `step_wait`."""
        self._actions = np.asarray(actions).reshape(-1, self.arms)

    def step_wait(self) -> tuple[Array | dict[str, Array], Array, Array, list[dict[str, Any]]]:
        """One decision of every row: observations, float32 rewards, ends and infos, [row]."""
        obs, reward, terminated, truncated, info = self.batch.step(self._actions)
        self._returns += reward
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        final = self.batch.joined(info["final_obs"])
        for n, env in enumerate(info["final_envs"].tolist()):
            for arm in range(self.arms):
                last = {key: values[n, arm] for key, values in final.items()}
                infos[env * self.arms + arm] = {
                    "terminal_observation": last if self.kind == "dict" else last["observation"],
                    "TimeLimit.truncated": bool(truncated[env]),
                    "episode": {"r": float(self._returns[env]), "l": int(self._lengths[env])},
                    "faults": int(info["faults"][env, arm]),
                    "illegal": int(info["illegal"][env, arm]),
                }
            self._returns[env], self._lengths[env] = 0.0, 0
        done = np.repeat(terminated | truncated, self.arms)
        return self._rows(obs), np.repeat(reward.astype(np.float32), self.arms), done, infos

    def action_masks(self) -> Array:
        """Legal actions now, bool [row, action]."""
        return self._mask

    def close(self) -> None:
        """Close the batch."""
        self.batch.close()

    def has_attr(self, attr_name: str) -> bool:
        """Whether the rows have this attribute; `action_masks` is one."""
        return attr_name in ("action_masks", "render_mode")

    # Any: the signatures are Stable-Baselines3's.
    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Attribute of each row."""
        if attr_name == "render_mode":
            return [None for _ in self._get_indices(indices)]
        if attr_name == "action_masks":
            return [lambda row=row: self._mask[row] for row in self._get_indices(indices)]
        raise AttributeError(f"A row has no {attr_name!r}. There are: action_masks, render_mode.")

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise an AttributeError: the rows are one batch."""
        raise AttributeError(f"The rows are one batch: {attr_name!r} cannot be set in them.")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Result of `action_masks`, the only method of a row, for each row."""
        if method_name != "action_masks":
            raise AttributeError(f"A row has no method {method_name!r}. There is: action_masks.")
        return list(self._mask) if indices is None else [self._mask[row] for row in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """True for `Monitor`: the infos already have what it would add."""
        rows: Iterable[int] = self._get_indices(indices)
        return [wrapper_class is Monitor for _ in rows]

    def _rows(self, obs: Obs) -> Array | dict[str, Array]:
        flat = {key: values.reshape(self.num_envs, -1) for key, values in self.batch.joined(obs).items()}
        self._mask = flat["action_mask"] == 1
        return flat if self.kind == "dict" else flat["observation"]
