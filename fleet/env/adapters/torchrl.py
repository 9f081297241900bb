"""The batch for TorchRL: a batched `EnvBase` with masks and one group "arms", without Python code per env.

Example, installation and tested versions: docs/trainers.md.

| key | value |
|---|---|
| ("arms", "observation") | float32 [env, arm, size], the parts below joined |
| "shared", ("arms", "own") | float32 [env, shared] and [env, arm, own], instead, with `joined=False` |
| ("arms", "action_mask") | bool [env, arm, action] |
| ("arms", "action") | int64 [env, arm] |
| ("arms", "reward") | float32 [env, arm, 1], the team's reward of the whole step for every arm |
| ("arms", "elapsed_s") | float32 [env, arm, 1], length of the step that led here, 0 after a reset |
| "done", "terminated", "truncated" | bool [env, 1] |
| "state" | float32 [env, arm * size], with `state=True`, for central critics |
| ("arms", "info", …), ("info", …) | float32 [env, arm, 1] and [env, 1], with `infos=True`, see `BatchEnv.step` |

Traps:

- `env.set_seed(s)` takes effect at the next `reset()`: env e starts the episode of seed s + e, and later episodes
  follow from it. Random actions are drawn by torch: call `torch.manual_seed` too, or nothing repeats.
- The action spec has the current mask, so `env.rand_action` is always legal; a policy must read the key.
- An illegal action is a wait, counted in ("arms", "info", "illegal"), never an error.
- With `decisions="events"` steps differ in length. Value estimators raise gamma to the power of the entry that
  `set_keys(steps_to_next_obs=("next", "arms", "elapsed_s"))` names: make gamma the discount of one second.
- Use one thread (`OMP_NUM_THREADS=1`): the arrays are too small for more threads to help.
- `rollout` stacks its frames into new tensors, each observation twice. With `joined=False` there is less to stack, and
  `fleet.env.vector.keep_pages()`, called once, keeps the system from clearing their memory for every rollout.
"""

# pyright: reportPrivateImportUsage=false

from typing import Any

import numpy as np

from fleet.env.adapters.arguments import ARM_INFOS, TEAM_INFOS, Infos, check_batch, imported_trainer
from fleet.env.random_actions import pick_legal
from fleet.env.validation import seed_of, switch
from fleet.env.vector import BatchEnv, Obs

with imported_trainer("learn", "constraints.txt"):
    import torch
    from tensordict import TensorDict, TensorDictBase
    from torch import Size
    from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
    from torchrl.envs import EnvBase

GROUP = "arms"
ENDS = ("done", "terminated", "truncated")


class TorchRLEnv(EnvBase):
    """A `BatchEnv` as TorchRL's batched `EnvBase`, `batch_size` [num_envs], on the CPU.

    Args:
        batch: Made with `autoreset=False`: TorchRL resets finished envs, by "_reset".
        seed: As in `set_seed`; by default the seed of the batch.
        joined: Join the parts of an observation to the vector of each arm.
        state: Include "state".
        infos: Include the infos, numbers of `BatchEnv.step`.
    """

    def __init__(
        self,
        batch: BatchEnv,
        *,
        seed: int | None = None,
        joined: bool = True,
        state: bool = False,
        infos: bool = False,
    ) -> None:
        batch = check_batch("TorchRLEnv", batch, autoreset=False)
        super().__init__(device="cpu", batch_size=(batch.num_envs,))
        self.batch = batch
        self.layout = batch.layout
        self.group_map = {GROUP: list(batch.agents)}
        self._joined, self._state, self._infos = (
            switch("joined", joined),
            switch("state", state),
            switch("infos", infos),
        )
        self._seed: int | None = None
        if seed is not None:
            self._set_seed(seed)
        self._done = torch.zeros(batch.num_envs, 1, dtype=torch.bool)
        """Envs reported to TorchRL as done."""
        self._ended = self._done
        """Envs of the batch whose episode is over; other done envs have started a new one that nobody sees."""
        envs, arms = batch.num_envs, len(batch.agents)
        actions, cut = batch.layout.actions, batch.layout.shared
        low, high = (torch.from_numpy(bound.copy()).expand(envs, arms, -1) for bound in batch.layout.bounds)
        seen = Composite(
            action_mask=Binary(actions, shape=Size((envs, arms, actions)), dtype=torch.bool),
            elapsed_s=Unbounded(Size((envs, arms, 1))),
            shape=(envs, arms),
        )
        observed: dict[str, Any] = {GROUP: seen}
        if joined:
            seen["observation"] = Bounded(low, high, dtype=torch.float32)
        else:
            seen["own"] = Bounded(low[..., cut:], high[..., cut:], dtype=torch.float32)
            observed["shared"] = Bounded(low[:, 0, :cut], high[:, 0, :cut], dtype=torch.float32)
        if infos:
            seen["info"] = Composite({name: Unbounded(Size((envs, arms, 1))) for name in ARM_INFOS}, shape=(envs, arms))
            observed["info"] = Composite({name: Unbounded(Size((envs, 1))) for name in TEAM_INFOS}, shape=(envs,))
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
        """Random legal actions, all equally likely; `rollout` uses it if there is no policy.

        Distributed as the action spec's samples, and much faster.
        """
        lead = self._mask.shape[:-1]
        action = torch.empty(lead.numel(), dtype=torch.int64)
        rows = self._mask.view(torch.int8).reshape(len(action), -1)
        pick_legal.chosen()(rows.numpy(), torch.rand(len(action), dtype=torch.float64).numpy(), action.numpy())
        actions = TensorDict({GROUP: TensorDict({"action": action.reshape(lead)}, lead)}, self.batch_size)
        return actions if tensordict is None else tensordict.update(actions)

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        seed_of(seed)
        self._seed = int(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        chosen = None if tensordict is None else tensordict.get("_reset", None)
        if chosen is None or chosen.all():
            seed, self._seed = self._seed, None
            obs, info = self.batch.reset(seed)
            self._done = self._ended = torch.zeros_like(self._done)
        else:
            chosen = chosen.reshape(-1, 1)
            obs, info = self.batch.reset(rows=chosen.squeeze(-1).numpy())
            self._done, self._ended = self._done & ~chosen, self._ended & ~chosen
        return self._tensors(obs, info, done=self._done.clone())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        going = tensordict.get("_step", None)
        waiting = None if going is None else self._waiting(going)
        obs, reward, terminated, truncated, info = self.batch.step(tensordict[GROUP, "action"].numpy())
        ends = {"terminated": terminated[:, None], "truncated": truncated[:, None]}
        self._ended = torch.from_numpy(ends["terminated"] | ends["truncated"])
        self._done = self._ended if waiting is None else self._ended | waiting
        tensors = self._tensors(
            obs, info, done=self._done.clone(), **{end: torch.from_numpy(value) for end, value in ends.items()}
        )
        arms = len(self.batch.agents)
        shared = np.repeat(reward.astype(np.float32), arms).reshape(-1, arms, 1)
        tensors[GROUP, "reward"] = torch.from_numpy(shared)
        if waiting is None:
            return tensors
        return self._skip_tensordict(tensordict).where(waiting.squeeze(-1), tensors)

    def _waiting(self, going: torch.Tensor) -> torch.Tensor:
        """Done envs that a rollout no longer steps; the batch resets them and steps them unseen. Bool [env, 1]."""
        waiting = ~going.reshape(-1, 1)
        if (waiting & ~self._done).any():
            raise ValueError('"_step" can only leave out envs that are done; all others are stepped together.')
        if (waiting & self._ended).any():
            self.batch.reset(rows=(waiting & self._ended).squeeze(-1).numpy())
        return waiting

    def _tensors(self, obs: Obs, info: Infos, **ends: torch.Tensor) -> TensorDict:
        """Result of the batch as tensors that share the arrays' memory."""
        envs, arms = self.batch.num_envs, len(self.batch.agents)
        mask = torch.from_numpy(obs["action_mask"]).view(torch.bool)
        self._action.update_mask(mask)
        self._mask = mask
        elapsed_s = np.repeat(info["elapsed_s"].astype(np.float32), arms).reshape(envs, arms, 1)
        group: dict[str, Any] = {"action_mask": mask, "elapsed_s": torch.from_numpy(elapsed_s)}
        source: dict[str, Any] = dict(ends)
        if self._joined or self._state:
            vectors = torch.from_numpy(self.layout.join(obs["shared"], obs["own"]))
            group |= {"observation": vectors} if self._joined else {}
            source |= {"state": vectors.reshape(envs, -1)} if self._state else {}
        if not self._joined:
            group["own"], source["shared"] = torch.from_numpy(obs["own"]), torch.from_numpy(obs["shared"])
        if self._infos:
            group["info"] = _leaves(info, ARM_INFOS, (envs, arms))
            source["info"] = _leaves(info, TEAM_INFOS, (envs,))
        source[GROUP] = TensorDict(group, (envs, arms), device=self.device)
        return TensorDict(source, (envs,), device=self.device)


def _leaves(info: Infos, names: tuple[str, ...], lead: tuple[int, ...]) -> TensorDict:
    return TensorDict({name: torch.from_numpy(info[name][..., None].astype(np.float32)) for name in names}, lead)
