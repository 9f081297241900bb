"""The environment for AgileRL: observations are vectors, masks are in the infos.

Example, installation and tested versions: docs/trainers.md.

Traps:

- AgileRL asserts that no mask is in the observation and reads it from the infos. IPPO takes masks as lists, fails on
  arrays, and so takes one environment only; MADDPG and MATD3 take both, and arrays from several environments at once.
- After an episode AgileRL's wrapper of a single environment resets, returns the new observation and keeps the old
  infos, so the first claims of the next episode would follow a stale mask. `AgileRLEnv.reset` updates those infos too.
- IPPO samples its actions under the mask but learns without it (`_learn_individual`): the likelihood ratio, which
  should be 1 before the first update, was seen at 0.19. MADDPG and MATD3 have no such ratio.
- Agents whose names agree up to the last "_" share one actor: `arm_0` and `arm_1`, or `floor_left` and
  `floor_right`. An arm named `wall` learns alone.
- There is only one "done": a truncated episode counts as terminated.
- `pip install agilerl` alone does not import without `peft`.
"""

# pyright: reportMissingImports=false

from typing import Any, Literal, get_args

from gymnasium import spaces
from pettingzoo.utils import BaseParallelWrapper

from fleet.env.adapters.arguments import ByArm, Env, arm_space, check_env
from fleet.env.validation import check_choice

MaskKind = Literal["list", "array"]


class AgileRLEnv(BaseParallelWrapper[str, Any, Any]):
    """A `ParallelEnv` with vectors as observations and `action_mask` in every info.

    Args:
        env: The environment, with Dict observations.
        masks: "list" for IPPO, "array" for MADDPG and MATD3.
    """

    def __init__(self, env: Env, *, masks: MaskKind) -> None:
        check_choice("masks", masks, get_args(MaskKind))
        super().__init__(check_env("AgileRLEnv", env))
        self.masks = masks
        self._last: ByArm = {}
        self.observation_spaces = {arm: arm_space(env, arm)["observation"] for arm in env.possible_agents}

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """The space of the vector; the same object on every call."""
        return self.observation_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[ByArm, ByArm]:
        """Start an episode; vectors and infos by arm. The last infos of the episode before are updated in place."""
        vectors, infos = self._split(*self.env.reset(seed=seed, options=options))
        for arm, stale in self._last.items():
            stale.update(infos[arm])
        self._last = {}
        return vectors, infos

    def step(self, actions: ByArm) -> tuple[ByArm, ByArm, ByArm, ByArm, ByArm]:
        """One decision of every arm."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        vectors, infos = self._split(observations, infos)
        if not self.env.agents:
            self._last = infos
        return vectors, rewards, terminated, truncated, infos

    def _split(self, observations: ByArm, infos: ByArm) -> tuple[ByArm, ByArm]:
        vectors = {arm: each["observation"] for arm, each in observations.items()}
        masks = {arm: each["action_mask"] for arm, each in observations.items()}
        if self.masks == "list":
            masks = {arm: mask.tolist() for arm, mask in masks.items()}
        return vectors, {arm: infos[arm] | {"action_mask": masks[arm]} for arm in observations}
