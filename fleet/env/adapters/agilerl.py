"""The environment for AgileRL: the vector alone as observation, the mask in the infos.

from agilerl.algorithms import IPPO
from fleet.env.adapters.agilerl import AgileRLEnv
from scenarios import make_env
env = AgileRLEnv(make_env("quickstart", difficulty="blind"), masks="list")
seen, infos = env.reset(seed=0)  # {"arm_0": vector, …}, {"arm_0": {"action_mask": [1, 0, …], …}, …}

Install: `pip install thermofleet -c constraints.txt`, then `pip install --no-deps -r constraints/agilerl.txt`. Run with
agilerl 2.58.0 on PettingZoo 1.27.0, torch 2.13.0. There is no extra, because AgileRL asks for PettingZoo < 1.27, which
this environment cannot do with; it was not seen to need it.

Traps:

- AgileRL asserts that no mask is in the observation, and reads it from the infos. IPPO takes lists and stumbles over
  arrays, and so takes one environment only; MADDPG and MATD3 take both, and arrays from several environments at once.
- After the end of an episode its wrapper of one environment resets, hands out the new observation, and keeps the old
  infos, so the first claims of an episode would follow a stale mask. `AgileRLEnv.reset` writes into those infos too.
- IPPO draws its actions under the mask but learns as if there had been none (`_learn_individual`): the likelihood
  ratio, 1 by rights before the first update, was seen at 0.19. MADDPG and MATD3 have no such ratio.
- It shares one actor among agents whose names agree up to the last "_": `arm_0` and `arm_1`, or `floor_left` and
  `floor_right`. An arm named `wall` learns alone.
- It knows one "done": a shift cut at the horizon counts as one that is finished.
- `pip install agilerl` alone does not import without `peft`.
"""

# pyright: reportMissingImports=false

from typing import Any, Literal, get_args

from gymnasium import spaces
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from fleet.env.adapters.given import env_for

MaskKind = Literal["list", "array"]


class AgileRLEnv(BaseParallelWrapper[str, Any, Any]):
    """A `ParallelEnv` of Dict observations with vectors as observations and `action_mask` in every info.

    Args:
        env: The environment.
        masks: "list" for IPPO, "array" for MADDPG and MATD3.
    """

    def __init__(self, env: ParallelEnv[str, Any, Any], *, masks: MaskKind) -> None:
        if masks not in get_args(MaskKind):
            raise ValueError(f"masks must be 'list' (for IPPO) or 'array' (for MADDPG and MATD3), got {masks!r}.")
        super().__init__(env_for("AgileRLEnv", env))
        self.masks = masks
        self._last: dict[str, Any] = {}
        whole: dict[str, Any] = {arm: env.observation_space(arm) for arm in env.possible_agents}
        self.observation_spaces = {arm: space["observation"] for arm, space in whole.items()}

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """The space of the vector; the same object on every call."""
        return self.observation_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], Any]:
        """Begin an episode: vectors and infos by arm, also in the infos that the end of the last one came with."""
        vectors, infos = self._split(*self.env.reset(seed=seed, options=options))
        for arm, stale in self._last.items():
            stale.update(infos[arm])
        self._last = {}
        return vectors, infos

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], Any, Any, Any, Any]:
        """One decision of every arm."""
        seen, rewards, terminated, truncated, infos = self.env.step(actions)
        vectors, infos = self._split(seen, infos)
        if not self.env.agents:
            self._last = infos
        return vectors, rewards, terminated, truncated, infos

    def _split(self, seen: dict[str, Any], infos: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        vectors = {arm: each["observation"] for arm, each in seen.items()}
        masks = {arm: each["action_mask"] for arm, each in seen.items()}
        if self.masks == "list":
            masks = {arm: mask.tolist() for arm, mask in masks.items()}
        return vectors, {arm: infos[arm] | {"action_mask": masks[arm]} for arm in seen}
