"""Many shifts at once: the batched environment for trainers.

`fleet.env.allocation_v2` is one row of it: a row does not depend on the number of rows.

Large arrays are reused when nobody holds them any more: clearing the pages of a new array costs more than filling it.
"""

import ctypes
import os
import sys
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from gymnasium import spaces

from fleet.bus.exchange.memory import Exchange
from fleet.engine.batch import TERMS, Engine, Parts, RewardWeights, Shift, empty_parts
from fleet.engine.shift import deliver
from fleet.engine.state import State
from fleet.engine.step import FINISHED, JOBS_DONE, OUTCOME, TICK, TOTAL
from fleet.engine.tables import INFO, Tables
from fleet.env.lookahead import CellSimulator, Lookahead
from fleet.env.validation import (
    Decisions,
    at_least_one,
    check_choice,
    check_reset_options,
    seeds_of,
    switch,
    time_from_zero,
)
from fleet.observation import Layout, Observation
from fleet.seeding import exchange_seed, shift_seeds

Array = np.ndarray


def _references(arrays: list[Array], place: int) -> int:
    """Reference count of an array in a list, measured within this function."""
    array = arrays[place]
    return sys.getrefcount(array)


_ALONE = _references([np.empty(0)], 0)
"""Reference count of an array that only the list holds, measured because interpreters count differently. A view of an
array adds one."""


class Shelf:
    """A pool of arrays of one shape and type, with undefined content.

    Args:
        keep: Maximum number of arrays kept for reuse.
    """

    def __init__(self, shape: tuple[int, ...], dtype: type, *, keep: int = 4) -> None:
        self._shape, self._dtype, self._keep = shape, dtype, keep
        self._arrays: list[Array] = []

    def take(self) -> Array:
        """An array that nobody else holds."""
        for place in range(len(self._arrays)):
            if _references(self._arrays, place) == _ALONE:
                return self._arrays[place]
        array = np.empty(self._shape, self._dtype)
        if len(self._arrays) < self._keep:
            self._arrays.append(array)
        return array

    def __getstate__(self) -> dict[str, object]:
        """State for pickling, without the arrays, which their holders pickle."""
        return {**vars(self), "_arrays": []}


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Of `mallopt` in glibc's malloc.h."""
_MOST = 2**31 - 1


def keep_pages() -> bool:
    """Keep the memory of freed arrays in this process for new ones.

    For trainers that stack every rollout into new arrays of some hundred megabytes: glibc returns freed arrays to the
    system, which clears their pages again for the next ones, and that costs as much as the steps. The whole process is
    affected, and its memory does not shrink any more.

    Returns:
        Whether it worked: False if the C library is not glibc.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    return mallopt is not None and all(mallopt(which, _MOST) == 1 for which in (_MMAP_THRESHOLD, _TRIM_THRESHOLD))


REWARDS = tuple(f"reward_{name}" for name in TERMS)
"""Names of the reward terms in infos."""
AHEAD_S = 0.0
"""Options are given to free arms; see `Layout.ahead_s`."""


def arm_spaces(layout: Layout) -> tuple[spaces.Dict, spaces.Discrete]:
    """Observation and action space of one arm."""
    low, high = layout.bounds
    observation = spaces.Dict(
        {
            "observation": spaces.Box(low, high, dtype=np.float32),
            "action_mask": spaces.Box(0, 1, (layout.actions,), dtype=np.int8),
        }
    )
    return observation, spaces.Discrete(layout.actions)


Obs = dict[str, Array]
"""What arms know, in both parts of `fleet.observation.Layout`, and their legal actions: {"shared": float32 [env,
shared], "own": float32 [env, arm, own], "action_mask": int8 [env, arm, option + 2]}; `Layout.join` makes vectors."""


@dataclass(frozen=True, eq=False)
class Library:
    """Fleets with plans and predictions, and a sampler of their shifts."""

    arms: tuple[str, ...]
    slots: int
    tables: Tables
    draw: Callable[[np.random.SeedSequence], Shift]
    near: tuple[tuple[int, ...], ...] | None = None
    """The peers each arm has in its vector; see `fleet.observation.Layout`."""
    twins: tuple[str, ...] | None = None
    """Version of each arm's difficulty model, for messages."""


class BatchEnv:
    """`num_envs` shifts side by side; all arms of an env share its reward.

    An env whose shift ended begins the next one in the same step (unless `autoreset` is off): its observation is the
    first of the new shift, and the last one of the old shift is in `info["final_obs"]`.

    Args:
        library: Source of the shifts.
        num_envs: Number of rows, >= 1.
        seed: Seed of the first `reset` without a seed.
        weights: Of the reward terms.
        max_cycles: Ends a shift earlier than its horizon, in decision intervals.
        autoreset: Begin the next shift automatically; otherwise call `reset(rows=…)` before the next step.
        stagger: Truncate the first shift of env e after (e + 1) / num_envs of its length, so that short rollouts of a
            learner cover the whole shift.
        threads: Number of threads; results do not depend on it. Useful from a few hundred envs on.
        exchanges: What carries the messages of the arms of each env; perfect and immediate if not given.
        decisions: Length of a step: one decision "interval", or until an arm may claim a job ("events"), which takes no
            exchanges.
        scaled: Vectors hold values of order 1 (`Field.scale`); otherwise they have the units of the fields.
        ahead_s: Options of arms that are home later than this are 0: they cannot claim soon. inf for those of all.
        bids: Vectors hold the bids of members; see `fleet.observation.Layout`.
        keep_path: Keep the temperatures of the whole shift in `path_c`.
        shares_heat: Without exchanges: whether the arms tell each other what heat they measure, as on a perfect bus.
        keep_events, trace: As `events` and `trace` of `fleet.engine.batch.Engine`.

    Attributes:
        engine: Steps the shifts.
        parts: Both parts of the current observations.
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
        threads: int = 1,
        exchanges: Sequence[Exchange] | None = None,
        decisions: Decisions = "interval",
        scaled: bool = True,
        ahead_s: float = AHEAD_S,
        bids: bool = False,
        keep_path: bool = False,
        shares_heat: bool = True,
        keep_events: bool = False,
        trace: bool = False,
    ) -> None:
        self.num_envs = num_envs = at_least_one("num_envs", num_envs)
        self.agents = library.arms
        """Names of the arms, in the order of the arm axis."""
        self.layout = Layout(
            len(library.arms),
            library.slots,
            library.near,
            library.tables.work.shape[3],
            scaled=switch("scaled", scaled),
            delivered=exchanges is not None,
            ahead_s=time_from_zero("ahead_s", ahead_s),
            bids=switch("bids", bids),
        )
        _check_memory(num_envs, self.layout)
        autoreset, stagger = switch("autoreset", autoreset), switch("stagger", stagger)
        ticks = library.tables.ticks
        self._whole = ticks if max_cycles is None else min(ticks, at_least_one("max_cycles", max_cycles))
        """Decision intervals of a whole shift."""
        share = (np.arange(num_envs) + 1) / num_envs if stagger else np.ones(num_envs)
        self._last_tick = np.ceil(self._whole * share).astype(int)
        """Number of decision intervals of the current shift of each env."""
        self.single_observation_space, self.single_action_space = arm_spaces(self.layout)
        """Of one arm, with both parts as one vector."""
        self.autoreset = autoreset
        self._shelves = [Shelf(each.shape, np.float32) for each in empty_parts(self.layout, num_envs)]
        self._library = library
        self.engine = Engine(
            library.tables,
            num_envs,
            self.layout,
            weights or RewardWeights(),
            events=keep_events,
            trace=trace,
            path=keep_path,
            shares_heat=shares_heat,
            threads=at_least_one("threads", threads),
        )
        self.parts = self._no_parts()
        self._all = np.arange(num_envs)
        self._seeds = seeds_of(seed, num_envs)
        self._fresh = np.ones(num_envs, dtype=bool)
        """Rows whose next shift is that of their seed itself."""
        self._over, self._tick = np.ones(num_envs, dtype=bool), np.zeros(num_envs)
        self._begun = False
        if exchanges is not None and len(exchanges) != num_envs:
            raise ValueError(f"exchanges must be one per env ({num_envs}, got {len(exchanges)}).")
        check_choice("decisions", decisions, get_args(Decisions))
        self._until_choice = decisions == "events"
        if self._until_choice and exchanges is not None:
            raise ValueError("decisions='events' takes no exchanges: messages are exchanged once per interval.")
        self._elapsed_s = np.zeros(num_envs)
        """Length of the last step of each env."""
        self._exchanges = exchanges
        self._names: list[tuple[str, ...]] = [()] * num_envs
        """Of the jobs of each env."""
        self._delivered = None if exchanges is None else self._no_parts()
        """Knowledge of the arms with their received messages; only with exchanges."""

    def __copy__(self) -> "BatchEnv":
        return deepcopy(self)

    @property
    def state(self) -> State:
        """Copy of the true state of all envs (not for policies)."""
        self._check_begun("looking at its state")
        return self.engine.state.copy()

    @property
    def path_c(self) -> Array:
        """True temperatures at the end of each interval of the current shifts, °C, [env, tick, arm, node] (not for
        policies); only with `keep_path`."""
        return self.engine.path_c

    @property
    def temp_c(self) -> Array:
        """True temperatures, °C, [env, arm, node], a view that the next step overwrites (not for policies)."""
        self._check_begun("looking at its temperatures")
        return self.engine.state.temp_c

    def reset(
        self,
        seed: int | Sequence[int] | None = None,
        *,
        rows: Array | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Obs, dict[str, Any]]:
        """Begin new shifts.

        Args:
            seed: Env e begins the shift of `seed + e`, or of `seed[e]`; without one, the next of its row's seed.
            rows: Only in these envs, int [n] or bool [env]; the others continue.
            options: None, or empty.

        Returns:
            Observations, and the infos of `step`.

        Raises:
            ValueError: an invalid seed or row, or an option.
        """
        check_reset_options(options)
        if seed is not None:
            if rows is not None:
                raise ValueError("reset(seed=…) seeds all envs: give seed or rows, not both.")
            self._seeds, self._fresh = seeds_of(seed, self.num_envs), np.ones(self.num_envs, dtype=bool)
        chosen = self._rows_of(rows)
        if not self._begun and len(chosen) < self.num_envs:
            raise RuntimeError("No episode has started: call reset() for all envs before reset(rows=…).")
        self.parts = self._no_parts()
        self._begin(chosen)
        if len(chosen) < self.num_envs:
            self._observe(np.setdiff1d(self._all, chosen), self.parts)
        nothing = np.zeros((self.num_envs, OUTCOME))
        self._elapsed_s[chosen] = 0.0
        nothing[:, JOBS_DONE] = self.engine.state.done
        return self._obs(), self._info(nothing, np.zeros(0, dtype=int), None)

    def step(self, actions: object) -> tuple[Obs, Array, Array, Array, dict[str, Any]]:
        """One step of every env.

        Args:
            actions: int [env, arm]: 0 waits or continues, k claims option k - 1, the last action returns the job; an
                illegal action is a wait.

        Returns:
            What the arms know; the reward, float64 [env]; terminated and truncated, bool [env]; and infos of the step
            that was made: `faults`, `illegal`, `peak_c`, `above_warning_s` [env, arm], `jobs_done`, `elapsed_s` [env],
            `reward_…` for each term [env], `final_envs`, int [n], the envs whose shift ended, and `final_obs`, what
            their arms knew at its end, [n, arm, …].

        Raises:
            RuntimeError: before reset, or after the end of the shift of an env.
            ValueError: actions of another type or shape.
        """
        self._check_begun("step()")
        if not self.autoreset and self._over.any():
            which = np.flatnonzero(self._over)
            raise RuntimeError(
                f"The shift of {len(which)} env(s) is over (first: env {which[0]}): call reset(rows=…) before step()."
            )
        chosen, parts = self._checked(actions), self._no_parts()
        outcome = self.engine.step(chosen, parts, self._last_tick if self._until_choice else None)
        tick, finished = outcome[:, TICK], outcome[:, FINISHED] > 0
        self._elapsed_s = (tick - self._tick) * self.engine.tables.dt_s
        self._tick, self.parts = tick, parts
        self.deliver(self._all)
        truncated = ~finished & (tick >= self._last_tick)
        self._over = finished | truncated
        ended = np.flatnonzero(self._over)
        self._last_tick[ended] = self._whole
        last = self._obs(ended) if len(ended) and self.autoreset else None
        info = self._info(outcome, ended, last)
        if last is not None:
            self._begin(ended)
        return self._obs(), outcome[:, TOTAL].copy(), finished, truncated, info

    def joined(self, obs: Obs) -> Obs:
        """Both parts of observations as one vector for each arm: {"observation": [env, arm, size], "action_mask"}."""
        return {"observation": self.layout.join(obs["shared"], obs["own"]), "action_mask": obs["action_mask"]}

    def knowledge(self) -> Observation:
        """Current observations by field, leading axes [env, arm], as policies read them."""
        self._check_begun("knowledge()")
        parts = self._no_parts()  # the caller may have written into the last ones
        self._observe(self._all, parts)
        return self.layout.read_parts(*parts, self.engine.mask.copy())

    def lookahead(self, simulator: CellSimulator, env: int) -> Lookahead:
        """A simulator of the cell for the shifts of an env, for policies that plan."""
        return Lookahead(simulator, self.engine, env)

    def close(self) -> None:
        """Do nothing: a batch holds no resources."""

    def _begin(self, rows: Array) -> None:
        if not len(rows):
            return
        seeds = [self._seeds[e] if self._fresh[e] else self._seeds[e].spawn(1)[0] for e in rows.tolist()]
        self._fresh[rows] = False
        sensors = [] if self._exchanges is None else [shift_seeds(seed)[1] for seed in seeds]
        self.begin(rows, [self._library.draw(seed) for seed in seeds], sensors)

    def begin(self, rows: Array, shifts: Sequence[Shift], sensors: Sequence[np.random.SeedSequence]) -> None:
        """Begin given shifts in some envs, with their observations in `parts`.

        Args:
            sensors: Seed of the sensors of each shift, from which delays and losses of messages follow; only read with
                exchanges.
        """
        self.engine.reset(rows, shifts)
        self._begun, self._over[rows], self._tick[rows] = True, False, 0
        self.engine.observe(rows, self.parts)
        if self._exchanges is not None:
            for e, shift, seed in zip(rows.tolist(), shifts, sensors, strict=True):
                self._exchanges[e].begin(np.random.default_rng(exchange_seed(seed)))
                self._names[e] = shift.names or tuple(map(str, range(len(shift.kind))))
        self.deliver(rows)

    def _observe(self, rows: Array, parts: Parts) -> None:
        """Write the current observations of some envs into `parts` again."""
        if self._delivered is None:
            self.engine.observe(rows, parts)
        else:
            for part, delivered in zip(parts, self._delivered, strict=True):
                part[rows] = delivered[rows]

    def deliver(self, rows: Array) -> None:
        """Replace what the arms of some envs observe of each other, in `parts`, by the delivered messages."""
        if self._exchanges is None or self._delivered is None:
            return
        twins = self._library.twins or ("",) * len(self.agents)
        for e in rows.tolist():
            deliver(self._exchanges[e], self.engine, self.parts, self._names[e], twins, e)
        for part, delivered in zip(self.parts, self._delivered, strict=True):
            delivered[rows] = part[rows]

    def _obs(self, rows: Array | None = None) -> Obs:
        shared, own = self.parts
        if rows is None:
            return {"shared": shared, "own": own, "action_mask": self.engine.mask.copy()}
        return {"shared": shared[rows], "own": own[rows], "action_mask": self.engine.mask[rows]}

    def _info(self, outcome: Array, ended: Array, last: Obs | None) -> dict[str, Any]:
        infos = self.engine.infos.copy()
        if last is None:
            shared, own = empty_parts(self.layout, 0)
            mask = np.zeros((0, self.layout.arms, self.layout.actions), np.int8)
            last = {"shared": shared, "own": own, "action_mask": mask}
        return {
            **{name: infos[name] for name in INFO.names or ()},
            "jobs_done": outcome[:, JOBS_DONE],
            "elapsed_s": self._elapsed_s.copy(),
            **{name: outcome[:, n] for n, name in enumerate(REWARDS)},
            "final_envs": ended,
            "final_obs": last,
        }

    def _no_parts(self) -> Parts:
        """Arrays for observations: unused ones of an earlier step, if there are any."""
        shared, own = (shelf.take() for shelf in self._shelves)
        return shared, own

    def _checked(self, actions: object) -> Array:
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
            return self._all
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
            raise RuntimeError(f"No episode has started: call reset() before {what}.")


def _check_memory(num_envs: int, layout: Layout) -> None:
    """Check that the observations fit into memory; otherwise the system would kill the process."""
    needed = num_envs * layout.arms * (layout.size * np.dtype(np.float32).itemsize + layout.actions)
    held = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if needed > held:
        raise ValueError(
            f"num_envs must be at most {held * num_envs // needed}, as this machine has {held / 1e9:.0f} GB: the "
            f"observations of {num_envs} envs need {needed / 1e9:.0f} GB."
        )
