"""The batch for TorchRL, natively: a batched `EnvBase` with masks, one group "arms", no step of Python per env.

    from fleet.env.adapters.torchrl import TorchRLEnv
    from scenarios import make_batch
    env = TorchRLEnv(make_batch("quickstart", 64, difficulty="blind", autoreset=False), seed=0)
    frames = env.rollout(100, break_when_any_done=False)  # random actions, legal ones only

Install: `pip install 'thermofleet[learn]' -c constraints.txt`. Run with torchrl 0.14.1, tensordict 0.14.3, torch
2.13.0.

| key | value |
|---|---|
| ("arms", "observation") | float32 [env, arm, size], raw units: scale by `layout.bounds` or in the network |
| ("arms", "action_mask") | bool [env, arm, slot + 1] |
| ("arms", "action") | int64 [env, arm] |
| ("arms", "reward") | float32 [env, arm, 1], the team's reward, the same for all arms |
| "done", "terminated", "truncated" | bool [env, 1] |
| "state" | float32 [env, arm * size], with `state=True`, for central critics |
| ("arms", "info", …), ("info", …) | float32 [env, arm, 1] and [env, 1], with `infos=True`, see `BatchEnv.step` |

Traps:

- `env.set_seed(s)` holds from the next `reset()` on: env e then begins the shift of s + e, and later shifts follow from
  it. Random actions are torch's: `torch.manual_seed` too, or nothing repeats.
- The action spec carries the mask of now, so `env.rand_action` is always legal; a policy must read the key.
- What is sent against the mask is a wait, counted in ("arms", "info", "illegal"), never an error.
- Pin the threads for speed (`OMP_NUM_THREADS=1`): the arrays are too small for more to help.
- `rollout` stacks all it saw into new tensors. `fleet.env.shelf.keep_pages()`, called once, keeps the system from
  clearing their memory anew for every rollout: half as many steps a second again.
"""

# pyright: reportPrivateImportUsage=false

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Size
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from fleet.env.adapters.given import batch_for
from fleet.env.chance import pick
from fleet.env.reward import TERMS
from fleet.env.vector import BatchEnv, Obs

GROUP = "arms"

OF_ARMS = ("faults", "illegal", "peak_c", "above_warning_s")
OF_TEAM = ("jobs_done", *(f"reward_{term}" for term in TERMS))
"""What `infos=True` shows of the batch's infos."""

ENDS = ("done", "terminated", "truncated")


class TorchRLEnv(EnvBase):
    """A `BatchEnv` as TorchRL's batched `EnvBase`, `batch_size` [num_envs], on the CPU.

    Args:
        batch: The shifts, made with `autoreset=False`: TorchRL resets what is done, by "_reset".
        seed: As `set_seed`; without one, the seed of the batch.
        state: Give "state" too.
        infos: Give the infos too.
    """

    def __init__(self, batch: BatchEnv, *, seed: int | None = None, state: bool = False, infos: bool = False) -> None:
        batch = batch_for("TorchRLEnv", batch)
        if batch.autoreset:
            raise ValueError("TorchRL resets by itself: give TorchRLEnv a batch made with autoreset=False.")
        super().__init__(device="cpu", batch_size=(batch.num_envs,))
        self.batch = batch
        self.layout = batch.layout
        self.group_map = {GROUP: list(batch.agents)}
        self._state, self._infos = state, infos
        self._seed = seed
        self._over = torch.zeros(batch.num_envs, 1, dtype=torch.bool)
        """Done, as TorchRL was told."""
        self._ended = self._over
        """Whose shift is over in the batch; what is done and not among them was begun anew, unseen."""
        envs, arms, size = batch.num_envs, len(batch.agents), batch.layout.size
        actions = batch.layout.slots + 1
        low, high = (torch.from_numpy(bound.copy()).expand(envs, arms, size) for bound in batch.layout.bounds)
        seen = Composite(
            observation=Bounded(low, high, dtype=torch.float32),
            action_mask=Binary(actions, shape=Size((envs, arms, actions)), dtype=torch.bool),
            shape=(envs, arms),
        )
        observed: dict[str, Any] = {GROUP: seen}
        if infos:
            seen["info"] = Composite({name: Unbounded(Size((envs, arms, 1))) for name in OF_ARMS}, shape=(envs, arms))
            observed["info"] = Composite({name: Unbounded(Size((envs, 1))) for name in OF_TEAM}, shape=(envs,))
        if state:
            observed["state"] = Bounded(low.reshape(envs, -1), high.reshape(envs, -1), dtype=torch.float32)
        self._action = Categorical(actions, shape=Size((envs, arms)), dtype=torch.int64)
        self._mask = torch.ones(envs, arms, actions, dtype=torch.bool)
        reward = Composite(reward=Unbounded(Size((envs, arms, 1))), shape=(envs, arms))
        self.observation_spec = Composite(observed, shape=(envs,))
        self.action_spec = Composite({GROUP: Composite(action=self._action, shape=(envs, arms))}, shape=(envs,))
        self.reward_spec = Composite({GROUP: reward}, shape=(envs,))
        self.done_spec = Composite({end: Binary(1, Size((envs, 1)), dtype=torch.bool) for end in ENDS}, shape=(envs,))

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the batch."""
        self.batch.close()
        super().close(raise_if_closed=raise_if_closed)

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Actions at random, each legal one as likely; also what `rollout` takes without a policy.

        The same as the action spec draws, at a small part of its price.
        """
        lead = self._mask.shape[:-1]
        action = torch.empty(lead.numel(), dtype=torch.int64)
        rows = self._mask.view(torch.int8).reshape(len(action), -1)
        pick(rows.numpy(), torch.rand(len(action), dtype=torch.float64).numpy(), action.numpy())
        actions = TensorDict({GROUP: TensorDict({"action": action.reshape(lead)}, lead)}, self.batch_size)
        return actions if tensordict is None else tensordict.update(actions)

    def _set_seed(self, seed: int | None) -> None:
        self._seed = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else int(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        chosen = None if tensordict is None else tensordict.get("_reset", None)
        if chosen is None or chosen.all():
            seed, self._seed = self._seed, None
            obs, info = self.batch.reset(seed)
            self._over = self._ended = torch.zeros_like(self._over)
        else:
            chosen = chosen.reshape(-1, 1)
            obs, info = self.batch.reset(rows=chosen.squeeze(-1).numpy())
            self._over, self._ended = self._over & ~chosen, self._ended & ~chosen
        return self._told(obs, info, done=self._over.clone())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        going = tensordict.get("_step", None)
        waiting = None if going is None else self._left_out(going)
        obs, reward, terminated, truncated, info = self.batch.step(tensordict[GROUP, "action"].numpy())
        ends = {"terminated": terminated[:, None], "truncated": truncated[:, None]}
        self._ended = torch.from_numpy(ends["terminated"] | ends["truncated"])
        self._over = self._ended if waiting is None else self._ended | waiting
        told = self._told(
            obs, info, done=self._over.clone(), **{end: torch.from_numpy(value) for end, value in ends.items()}
        )
        arms = len(self.batch.agents)
        shared = np.repeat(reward.astype(np.float32), arms).reshape(-1, arms, 1)
        told[GROUP, "reward"] = torch.from_numpy(shared)
        if waiting is None:
            return told
        return self._skip_tensordict(tensordict).where(waiting.squeeze(-1), told)

    def _left_out(self, going: torch.Tensor) -> torch.Tensor:
        """Rollouts that go on until all envs are done leave out those that are: the batch begins them anew, unseen."""
        waiting = ~going.reshape(-1, 1)
        if (waiting & ~self._over).any():
            raise ValueError('"_step" can only leave out envs that are done: all others are stepped together.')
        if (waiting & self._ended).any():
            self.batch.reset(rows=(waiting & self._ended).squeeze(-1).numpy())
        return waiting

    def _told(self, obs: Obs, info: dict[str, Any], **ends: torch.Tensor) -> TensorDict:
        """What the batch told as tensors; arrays are handed on, not copied."""
        envs, arms = self.batch.num_envs, len(self.batch.agents)
        vectors = torch.from_numpy(obs["observation"])
        mask = torch.from_numpy(obs["action_mask"]).view(torch.bool)
        self._action.update_mask(mask)
        self._mask = mask
        group = {"observation": vectors, "action_mask": mask}
        source: dict[str, Any] = dict(ends)
        if self._infos:
            group["info"] = _leaves(info, OF_ARMS, (envs, arms))
            source["info"] = _leaves(info, OF_TEAM, (envs,))
        if self._state:
            source["state"] = vectors.reshape(envs, -1)
        source[GROUP] = TensorDict(group, (envs, arms), device=self.device)
        return TensorDict(source, (envs,), device=self.device)


def _leaves(info: dict[str, Any], names: tuple[str, ...], lead: tuple[int, ...]) -> TensorDict:
    return TensorDict({name: torch.from_numpy(info[name][..., None].astype(np.float32)) for name in names}, lead)
