"""Many shifts at once: the batched environment, as trainers want it.

The same engine as the single environment, `fleet.env.allocation_v0`, with a leading env axis: a row is that env, bit
for bit, whatever the number of rows.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fleet.env.arguments import at_least_one, seeds_of, switch
from fleet.env.chance import random_legal as random_legal
from fleet.env.engine import Engine, Shift
from fleet.env.observation import Layout, Observation
from fleet.env.reward import TERMS, RewardWeights
from fleet.env.shelf import Shelf
from fleet.env.spaces import arm_spaces
from fleet.sim.state import State
from fleet.sim.tables import Tables

Array = np.ndarray
Obs = dict[str, Array]
"""{"observation": float32 [env, arm, size], "action_mask": int8 [env, arm, slot + 1]}."""


@dataclass(frozen=True, eq=False)
class Library:
    """Fleets that are planned and scored, and the shifts that can be drawn for them."""

    arms: tuple[str, ...]
    slots: int
    tables: Tables
    draw: Callable[[np.random.SeedSequence], Shift]
    near: tuple[tuple[int, ...], ...] | None = None
    """The peers each arm has in its vector; see `fleet.env.observation.Layout`."""


class BatchEnv:
    """`num_envs` shifts side by side; all arms of an env share its reward.

    An env whose shift ended begins the next one in the same step (unless `autoreset` is off): its observation is then
    the first of the new shift, and the last of the old one is in `info["final_obs"]`.

    Args:
        library: Where the shifts come from.
        num_envs: Number of rows, >= 1.
        seed: Of the first `reset`, which takes another if it is given one.
        weights: Of the reward terms.
        max_cycles: Ends a shift earlier than its horizon, in decision intervals.
        autoreset: Begin a new shift by itself; otherwise `reset(rows=…)` must, before the next step.
        stagger: Cut the first shift of env e after (e + 1) / num_envs of its length, so that from then on the envs are
            spread over the hours of a shift, as a learner wants them that sees a few hours at a time.
    """

    def __init__(
        self,
        library: Library,
        num_envs: int,
        *,
        seed: int | Sequence[int] | None = None,
        weights: RewardWeights | None = None,
        max_cycles: int | None = None,
        autoreset: bool = True,
        stagger: bool = False,
    ) -> None:
        self.num_envs = num_envs = at_least_one("num_envs", num_envs)
        autoreset, stagger = switch("autoreset", autoreset), switch("stagger", stagger)
        ticks = library.tables.ticks
        self._whole = ticks if max_cycles is None else min(ticks, at_least_one("max_cycles", max_cycles))
        """Decision intervals of a shift that is not cut."""
        share = (np.arange(num_envs) + 1) / num_envs if stagger else np.ones(num_envs)
        self._last_tick = np.ceil(self._whole * share).astype(int)
        """Of the present shift of each env."""
        self.agents = library.arms
        """Names of the arms, in the order of the arm axis."""
        self.layout = Layout(len(library.arms), library.slots, library.near)
        self.single_observation_space, self.single_action_space = arm_spaces(self.layout)
        """Of one arm."""
        self.autoreset = autoreset
        self._shelf = Shelf((num_envs, len(library.arms), self.layout.size), np.float32)
        self._library = library
        self._engine = Engine(library.tables, num_envs, self.layout, weights or RewardWeights())
        self._seeds = seeds_of(seed, num_envs)
        self._fresh = np.ones(num_envs, dtype=bool)
        """Rows whose next shift is that of their seed itself."""
        self._over = np.ones(num_envs, dtype=bool)
        self._begun = False

    @property
    def state(self) -> State:
        """The simulator's truth of all envs, in arrays of its own (not for policies)."""
        self._check_begun("looking at its state")
        return self._engine.state_of_all()

    def reset(
        self, seed: int | Sequence[int] | None = None, *, rows: Array | Sequence[int] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        """Begin new shifts.

        Args:
            seed: Env e begins the shift of `seed + e`, or of `seed[e]`; without one, the next of its row's seed.
            rows: Only in these envs, int [n] or bool [env]; the others go on.

        Returns:
            What all arms know, and the infos of `step`.

        Raises:
            ValueError: a seed or a row that cannot be.
        """
        if seed is not None:
            if rows is not None:
                raise ValueError("reset(seed=…) seeds all envs: give seed or rows, not both.")
            self._seeds, self._fresh = seeds_of(seed, self.num_envs), np.ones(self.num_envs, dtype=bool)
        chosen = self._rows_of(rows)
        if not self._begun and len(chosen) < self.num_envs:
            raise RuntimeError("Nothing was begun yet: call reset() for all envs before reset(rows=…).")
        self._vectors = self._no_vectors()
        self._begin(chosen)
        if len(chosen) < self.num_envs:
            self._engine.observe(np.setdiff1d(np.arange(self.num_envs), chosen), self._vectors)
        self._begun = True
        raw = np.zeros((self.num_envs, len(TERMS)))
        return self._obs(), self._info(raw, np.zeros(0, dtype=int), None)

    def step(self, actions: Any) -> tuple[Obs, Array, Array, Array, dict[str, Any]]:
        """One decision interval of every env.

        Args:
            actions: int [env, arm]: 0 waits or goes on, k claims slot k; what is outside the mask is a wait.

        Returns:
            What the arms know; the reward, float64 [env]; terminated and truncated, bool [env]; and infos of the step
            that was made: `faults`, `illegal`, `peak_c`, `above_warning_s` [env, arm], `jobs_done` [env],
            `reward_…` for each term [env], `final_envs`, int [n], the envs whose shift ended, and `final_obs`, what
            their arms knew at its end, [n, arm, …].

        Raises:
            RuntimeError: before reset, or of an env whose shift is over.
            ValueError: actions of another type or shape.
        """
        self._check_begun("step()")
        if not self.autoreset and self._over.any():
            which = np.flatnonzero(self._over)
            raise RuntimeError(
                f"The shift of {len(which)} env(s) is over (first: env {which[0]}): call reset(rows=…) before step()."
            )
        chosen = self._checked(actions)
        vectors = self._no_vectors()
        terms, reward, finished = self._engine.step(chosen, vectors)
        truncated = ~finished & (self._engine.rows.tick >= self._last_tick)
        self._vectors, self._over = vectors, finished | truncated
        ended = np.flatnonzero(self._over)
        self._last_tick[ended] = self._whole
        last = self._obs(ended) if len(ended) and self.autoreset else None
        info = self._info(terms, ended, last)
        if last is not None:
            self._begin(ended)
        return self._obs(), reward.copy(), finished, truncated, info

    def knowledge(self) -> Observation:
        """What the arms know now by name, leading axes [env, arm], as policies read it."""
        self._check_begun("knowledge()")
        vectors = self._no_vectors()  # what was handed out may have been written into
        self._engine.observe(np.arange(self.num_envs), vectors)
        return self.layout.read(vectors, self._engine.mask.copy())

    def close(self) -> None:
        """Nothing is held open."""

    def _begin(self, rows: Array) -> None:
        if not len(rows):
            return
        chosen = ((self._seeds[e], self._fresh[e]) for e in rows.tolist())
        draw = self._library.draw
        self._engine.begin(rows, [draw(seeds if fresh else seeds.spawn(1)[0]) for seeds, fresh in chosen])
        self._fresh[rows], self._over[rows] = False, False
        self._engine.observe(rows, self._vectors)

    def _obs(self, rows: Array | None = None) -> Obs:
        if rows is None:
            return {"observation": self._vectors, "action_mask": self._engine.mask.copy()}
        return {"observation": self._vectors[rows], "action_mask": self._engine.mask[rows]}

    def _info(self, terms: Array, ended: Array, last: Obs | None) -> dict[str, Any]:
        rows, drawn = self._engine.rows, self._engine.drawn
        if last is None:
            arms, slots = self.layout.arms, self.layout.slots
            last = {
                "observation": np.zeros((0, arms, self.layout.size), np.float32),
                "action_mask": np.zeros((0, arms, slots + 1), np.int8),
            }
        return {
            "faults": rows.faults.copy(),
            "illegal": rows.illegal.copy(),
            "peak_c": rows.peak_c.copy(),
            "above_warning_s": rows.above_warning_s.copy(),
            "jobs_done": drawn.jobs - self._engine.open,
            **{f"reward_{name}": terms[:, n] for n, name in enumerate(TERMS)},
            "final_envs": ended,
            "final_obs": last,
        }

    def _no_vectors(self) -> Array:
        """For vectors to be written to: of earlier steps, if nobody has them any more."""
        return self._shelf.take()

    def _checked(self, actions: Any) -> Array:
        shape = (self.num_envs, self.layout.arms)
        try:
            values = np.asarray(actions)
        except ValueError as error:
            raise ValueError(
                f"actions must be integers [env, arm] of shape {shape} (got rows of unlike length)."
            ) from error
        if values.shape != shape or values.dtype.kind not in "iu":
            raise ValueError(
                f"actions must be integers [env, arm] of shape {shape} (got {values.dtype} of shape {values.shape})."
            )
        return np.ascontiguousarray(values, dtype=np.int64)

    def _rows_of(self, rows: Array | Sequence[int] | None) -> Array:
        if rows is None:
            return np.arange(self.num_envs)
        chosen = np.asarray(rows)
        if chosen.dtype == bool and chosen.shape == (self.num_envs,):
            return np.flatnonzero(chosen)
        if chosen.ndim != 1 or (chosen.size and chosen.dtype.kind not in "iu"):
            raise ValueError(f"rows must be int [n] or bool [{self.num_envs}] (got {rows!r}).")
        if chosen.size and not (chosen.min() >= 0 and chosen.max() < self.num_envs):
            raise ValueError(f"rows must be from 0 to {self.num_envs - 1} (got {rows!r}).")
        return np.unique(chosen.astype(int))

    def _check_begun(self, what: str) -> None:
        if not self._begun:
            raise RuntimeError(f"Nothing was begun yet: call reset() before {what}.")
