"""Many shifts side by side in arrays, stepped by the compiled kernel: behind the batch and the single env alike."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fleet.env.fields import form_of, look, turn
from fleet.env.observation import Layout
from fleet.env.reward import TERMS, RewardWeights, scale
from fleet.sim.beginning import begin
from fleet.sim.state import State
from fleet.sim.tables import Drawn, Offer, Rows, Tables, state_of
from fleet.thermal import NODES

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Shift:
    """What was drawn for one shift; arrays [job], in the order of release."""

    lot: int
    """Which fleet of the tables."""
    air_k: float
    """By how much its air is warmer than the lot's."""
    kind: Array
    release_s: Array
    due_s: Array
    repetitions: Array
    after: Array
    """int [job, n], −1 for none."""
    key: int
    """Of the sensor noise, 64 bits; see `fleet.sim.noise`."""


class Engine:
    """Steps shifts in place; `begin` puts a new shift into a row.

    Args:
        tables: What does not change.
        envs: Number of rows.
        layout: Of the observation.
        weights: Of the reward terms.
        jobs: For how many jobs a shift there is room from the beginning; room is made for more.
    """

    def __init__(self, tables: Tables, envs: int, layout: Layout, weights: RewardWeights, *, jobs: int = 1) -> None:
        arms, slots = layout.arms, layout.slots
        self.tables, self.layout = tables, layout
        self._worth = scale(np.ones(len(TERMS)), np.array([getattr(weights, name) for name in TERMS]))
        self._offer = Offer(
            on_offer=np.full((envs, slots), -1),
            mask=np.zeros((envs, arms, slots + 1), np.int8),
            open=np.zeros(envs, int),
            queue=np.zeros((envs, jobs), np.int32),
            head=np.zeros(envs, int),
            hand=np.zeros((envs, arms), int),
            owed=np.zeros((envs, arms), bool),
        )
        self._offer.mask[:, :, 0] = 1
        self._all = np.arange(envs)
        self._form = form_of(layout)
        self._drawn, self._rows = _arrays(envs, arms, jobs, 0)

    @property
    def envs(self) -> int:
        """Number of rows."""
        return len(self._all)

    @property
    def mask(self) -> Array:
        """Legal actions now, int8 [env, arm, slot + 1]; a view that the next step overwrites."""
        return self._offer.mask

    @property
    def rows(self) -> Rows:
        """The state itself, to be looked at only."""
        return self._rows

    @property
    def drawn(self) -> Drawn:
        """The shifts themselves, to be looked at only."""
        return self._drawn

    def state(self, env: int = 0) -> State:
        """The state of one env, [1, ...], in arrays of its own."""
        return state_of(self._rows, env, env + 1)

    def state_of_all(self) -> State:
        """The state of all envs, in arrays of its own."""
        return state_of(self._rows, 0, self.envs)

    @property
    def open(self) -> Array:
        """Jobs not done, int [env]."""
        return self._offer.open

    def begin(self, envs: Array, shifts: Sequence[Shift]) -> None:
        """Put a new shift into each of some rows; `observe` then tells what their arms know."""
        first = np.cumsum([0, *(len(shift.kind) for shift in shifts)])
        most, have = max(shift.after.shape[1] for shift in shifts), self._drawn.kind.shape[1]
        after = np.concatenate([_wider(shift.after, most) for shift in shifts])
        waits = int((after >= 0).sum(axis=1).max(initial=0))
        after = -np.sort(-after, axis=1)[:, :waits]
        jobs = int(np.diff(first).max())
        if jobs > have or waits > self._drawn.after.shape[2]:
            self._make_room(jobs, waits)

        def jobs_by(name: str) -> Array:
            return np.concatenate([getattr(shift, name) for shift in shifts])

        begin(
            self.tables, self._drawn, self._rows, self._offer, envs,
            np.array([shift.lot for shift in shifts]), np.array([shift.air_k for shift in shifts]),
            np.array([shift.key for shift in shifts], np.uint64), first,
            jobs_by("kind"), jobs_by("release_s"), jobs_by("due_s"), jobs_by("repetitions"), after,
        )  # fmt: skip

    def observe(self, envs: Array, out: Array) -> None:
        """What the arms of some envs know at the beginning of a shift, into float32 [env, arm, size]."""
        look(
            self.tables, self._drawn, self._rows, self._offer, envs, self._form, out,
        )  # fmt: skip

    def step(self, actions: Array, out: Array) -> tuple[Array, Array, Array]:
        """One decision interval of every env.

        Args:
            actions: int64 [env, arm]; anything outside the mask is a wait, and counted.
            out: Takes what the arms know thereafter, float32 [env, arm, size].

        Returns:
            Weighted reward terms [env, term], their sum [env], and which envs have done all their jobs, bool [env].
        """
        terms = np.empty((self.envs, len(TERMS) + 1))
        turn(
            self.tables, self._drawn, self._rows, self._offer, actions, self._worth, terms, self._all,
            self._form, out,
        )  # fmt: skip
        return terms[:, :-1], terms[:, -1], (self._offer.open == 0) & (self._drawn.jobs > 0)

    def _make_room(self, jobs: int, waits: int) -> None:
        """For more jobs a shift, a tenth more than asked for, keeping what is there."""
        have = self._drawn.kind.shape[1]
        jobs = jobs + jobs // 10 if jobs > have else have
        waits = max(self._drawn.after.shape[2], waits)
        envs, arms = self._rows.mode.shape
        drawn, rows = _arrays(envs, arms, jobs, waits)
        queue = np.zeros((envs, jobs), np.int32)
        for new, old in zip((*drawn, *rows, queue), (*self._drawn, *self._rows, self._offer.queue), strict=True):
            new[tuple(slice(0, n) for n in old.shape)] = old
        self._offer = self._offer._replace(queue=queue)
        self._drawn, self._rows = drawn, rows

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._make_room(0, 0)  # what was pickled no longer lies job by job


def _wider(after: Array, waits: int) -> Array:
    return np.pad(after, ((0, 0), (0, waits - after.shape[1])), constant_values=-1) if after.shape[1] < waits else after


CACHE_LINE = 64
_RECORD = ("release_s", "due_s", "queued_s", "kind", "repetitions", "cycles", "returns", "status")
"""Of a job, what is looked at together: just a cache line, where it is looked for in as many places otherwise."""


def _arrays(envs: int, arms: int, jobs: int, waits: int) -> tuple[Drawn, Rows]:
    """For so many jobs, each of which waits for so many others; there are none yet."""
    line = CACHE_LINE // 8
    room = np.zeros(envs * jobs * line + line)
    first = -room.ctypes.data % CACHE_LINE // 8
    records = room[first : first + envs * jobs * line].reshape(envs, jobs, line)
    job = {
        name: (records if name.endswith("_s") else records.view(np.int64))[..., place]
        for place, name in enumerate(_RECORD)
    }
    job["release_s"][:], job["due_s"][:], job["repetitions"][:] = np.inf, np.inf, 1
    drawn = Drawn(
        lot=np.zeros(envs, int),
        air_k=np.zeros(envs),
        key=np.zeros(envs, np.uint64),
        jobs=np.zeros(envs, int),
        after=np.full((envs, jobs, waits), -1),
        **{name: job[name] for name in ("kind", "release_s", "due_s", "repetitions")},
    )
    per_arm = {
        name: np.zeros((envs, arms))
        for name in ("progress_s", "clear_at_s", "peak_c", "above_warning_s", "busy_s", "lost_s", "energy_j")
    }
    counts = {name: np.zeros((envs, arms), int) for name in ("mode", "job", "todo", "last_award", "faults", "illegal")}
    rows = Rows(
        tick=np.zeros(envs, int),
        temp_c=np.zeros((envs, arms, NODES)),
        **per_arm,
        **counts,
        finished_s=np.zeros((envs, jobs)),
        **{name: job[name] for name in ("status", "queued_s", "cycles", "returns")},
    )
    return drawn, rows


def shifts_of(drawn: Drawn, keys: Sequence[int]) -> list[Shift]:
    """The shifts of a world as `tables_of` gives it, with the keys of their sensor noise."""
    return [
        Shift(
            lot=int(drawn.lot[e]),
            air_k=float(drawn.air_k[e]),
            kind=drawn.kind[e, :count],
            release_s=drawn.release_s[e, :count],
            due_s=drawn.due_s[e, :count],
            repetitions=drawn.repetitions[e, :count],
            after=drawn.after[e, :count],
            key=key,
        )
        for e, (count, key) in enumerate(zip(drawn.jobs.tolist(), keys, strict=True))
    ]
