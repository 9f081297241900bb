"""Schedules of the jobs of a shift, and random changes of them: the neighbourhood of a local search."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

Array = np.ndarray

LEAST_GAIN = 1e-9
"""A smaller difference of rewards is no gain."""


_SHARES = np.array([2, 1, 1, 1, 1, 1, 1]) / 8
"""Probabilities of the kinds of random changes, as in `Changes`."""


class Schedules(NamedTuple):
    """Arm, plan and order of each job; arrays [schedule, job].

    A free arm claims, of its jobs that it may claim, the one that comes first.
    """

    arm: Array
    """int."""
    option: Array
    """Index of the plan among those of the job, int."""
    order: Array
    """Jobs with smaller numbers come first; inf for a job that is left out."""
    not_before_s: Array
    """No arm claims the job earlier."""

    def at(self, rows: Sequence[int] | Array) -> "Schedules":
        """Copies of some schedules."""
        chosen = np.asarray(rows, dtype=int)
        return Schedules(*(values[chosen].copy() for values in self))

    def keys(self, now_s: float) -> list[bytes]:
        """A key of each schedule; schedules with the same one have the same result from a time on.

        Only the order of the jobs of an arm counts, and waiting until later than `now_s`.
        """
        planned = np.isfinite(self.order)
        arm, option = (np.where(planned, each, -1) for each in (self.arm, self.option))
        job = np.lexsort((self.order, arm), axis=-1)
        ordered = np.take_along_axis(np.where(planned, self.order, -1.0), job, axis=-1)
        later = np.diff(ordered, axis=-1, prepend=-1.0) != 0  # not at once with the one before
        waits = np.where(planned & (self.not_before_s > now_s), self.not_before_s, 0.0)
        parts = np.concatenate([arm, option, job * 2 + later, waits.view(np.int64)], axis=-1)
        return [row.tobytes() for row in parts]


def stack(schedules: Sequence[Schedules]) -> Schedules:
    """Schedules one after the other."""
    return Schedules(*(np.concatenate(parts) for parts in zip(*schedules, strict=True)))


class Changes:
    """Changes of schedules of one shift.

    Args:
        can: Whether an arm has a plan, bool [arm, job, option].
        stations: Those of each job as bits, uint64 [job, word].
        release_s: No job comes earlier in a schedule, [job].
        horizon_s: Length of the shift.
        dt_s: Decision interval.
        jobs: Those that may be changed, int [n]; all if not given.
    """

    def __init__(
        self,
        can: Array,
        stations: Array,
        release_s: Array,
        horizon_s: float,
        dt_s: float,
        rng: np.random.Generator,
        jobs: Array | None = None,
    ) -> None:
        self._stations, self._release_s, self._horizon_s, self._rng = stations, release_s, horizon_s, rng
        self._waits_s = dt_s * np.array([1.0, 5.0, 25.0, 125.0])
        every = range(can.shape[1]) if jobs is None else jobs.tolist()
        self.choices = {job: found for job in every if len(found := np.argwhere(can[:, job]))}
        """Arm and option of every plan for a job that some arm can do, int [choice, 2]."""
        self._jobs = np.array(list(self.choices), dtype=int)
        self._plans = np.concatenate([np.zeros((0, 2), int), *self.choices.values()])
        """The choices of all jobs, one after the other, int [plan, 2]."""
        self._count = np.zeros((can.shape[1], len(can)), int)
        """Number of plans of each arm for each job, int [job, arm]."""
        self._count[self._jobs] = can[:, self._jobs].sum(axis=-1).T
        first = np.cumsum([0, *self._count[self._jobs].ravel()])[:-1].reshape(-1, len(can))
        self._first = np.zeros_like(self._count)
        """The first of them among the choices, int [job, arm]."""
        self._first[self._jobs] = first
        self._kinds = (
            self._move, self._swap, self._reorder, self._free, self._delay, self._leave_out, self._window
        )  # fmt: skip

    @property
    def none(self) -> bool:
        """Whether no arm can do any job."""
        return not len(self._jobs)

    def of_awards(self, start_s: Array, arm: Array, option: Array) -> Schedules:
        """Schedules that repeat the last award of each job, [schedule, job]; one that was never awarded is left out.

        Args:
            start_s: When it was, inf if never.
            arm: To which arm, int, below 0 if never.
            option: With which plan, int, likewise.
        """
        start_s, arm, option = start_s.copy(), arm.copy(), option.copy()
        for job, choices in self.choices.items():
            arm[arm[:, job] < 0, job], option[option[:, job] < 0, job] = choices[0]
        never = ~np.isfinite(start_s)
        return Schedules(np.maximum(arm, 0), np.maximum(option, 0), start_s, np.where(never, 0.0, start_s))

    def freed(self, schedules: Schedules) -> Schedules:
        """The same, but no arm waits with a job that it may claim."""
        copy = schedules.at(range(len(schedules.arm)))
        copy.not_before_s[:] = 0.0
        return copy

    def in_order(self, schedules: Schedules, start_s: Array, row: int) -> Schedules:
        """One of some schedules, with its jobs in the order in which they began.

        Args:
            start_s: When each job was last awarded, inf if never, [schedule, job].
        """
        copy = schedules.at([row])
        begun = np.isfinite(start_s[row]) & np.isfinite(copy.order[0])
        copy.order[0, begun] = start_s[row, begun]
        return copy

    def joined(self, before: Schedules, score: float, tried: Schedules, reward: Array) -> list[Schedules]:
        """Schedules with several improvements of one schedule at once: the two, four and eight best.

        Args:
            score: Reward of the schedule before.
            reward: Of its neighbours that were tried, [schedule].
        """
        better = np.flatnonzero(reward > score + LEAST_GAIN)
        better, found, count = better[np.argsort(-reward[better])], list[Schedules](), 2
        while len(better) >= count and len(found) < 3:
            together = before.at([0])
            for row in better[:count][::-1].tolist():
                for name in Schedules._fields:
                    old, new, all_ = (getattr(each, name) for each in (before, tried, together))
                    changed = new[row] != old[0]
                    all_[0, changed] = new[row, changed]
            found.append(together)
            count *= 2
        return found

    def neighbours(self, schedule: Schedules, first: Sequence[Schedules], count: int) -> Schedules:
        """Some schedules, and random neighbours of a schedule up to a number."""
        new = schedule.at([0] * (count - len(first)))
        times = np.array(self._rng.multinomial(self._rng.geometric(0.6, len(new.arm)), _SHARES))  # [schedule, kind]
        for k, change in enumerate(self._kinds):
            for made in range(times[:, k].max(initial=0)):
                change(new, np.flatnonzero(times[:, k] > made))
        return stack([*first, new])

    def changed(self, schedule: Schedules) -> Schedules:
        """A random neighbour of a schedule."""
        return self.neighbours(schedule, [], 1)

    # Each of these changes some rows, int [n], of schedules.

    def _one(self, rows: Array) -> Array:
        """A random job for each row."""
        return self._jobs[self._rng.integers(len(self._jobs), size=len(rows))]

    def _assign(self, new: Schedules, rows: Array, job: Array) -> None:
        """A random plan for a job of each row."""
        plan = self._first[job, 0] + self._rng.integers(self._count[job].sum(axis=-1))
        new.arm[rows, job], new.option[rows, job] = self._plans[plan].T

    def _place(self, new: Schedules, rows: Array, job: Array) -> None:
        """A moment near that of a job, not before its release."""
        order, release_s = new.order[rows, job], self._release_s[job]
        near_s = np.where(np.isfinite(order), order, release_s)
        shift_s = self._rng.normal(size=len(rows)) * self._rng.choice(2.0 * self._waits_s, len(rows))
        new.order[rows, job] = np.clip(near_s + shift_s, release_s, self._horizon_s)
        new.not_before_s[rows, job] = 0.0

    def _move(self, new: Schedules, rows: Array) -> None:
        """Another arm or plan, and another place in the order."""
        job = self._one(rows)
        self._assign(new, rows, job)
        self._place(new, rows, job)

    def _reorder(self, new: Schedules, rows: Array) -> None:
        """Another place in the order of its arm."""
        self._place(new, rows, self._one(rows))

    def _swap(self, new: Schedules, rows: Array) -> None:
        """Two jobs that are near in time exchange their places, half of the time their arms, too."""
        job = self._one(rows)
        planned = np.isfinite(new.order[rows, job])
        rows, job = rows[planned], job[planned]
        distance_s = np.abs(new.order[rows][:, self._jobs] - new.order[rows, job][:, None])
        nearest = np.argsort(distance_s, axis=-1, kind="stable")
        among = np.minimum(np.isfinite(distance_s).sum(axis=-1), 12)
        other = self._jobs[nearest[np.arange(len(rows)), self._rng.integers(among)]]
        new.order[rows, job], new.order[rows, other] = new.order[rows, other], new.order[rows, job]
        new.not_before_s[rows, job] = new.not_before_s[rows, other] = 0.0
        half = self._rng.random(len(rows)) < 0.5
        rows, job, other = rows[half], job[half], other[half]
        arms = new.arm[rows, other], new.arm[rows, job]
        for each, arm in zip((job, other), arms, strict=True):
            fits = self._count[each, arm] > 0
            at, arm = (rows[fits], each[fits]), arm[fits]
            plan = self._first[at[1], arm] + self._rng.integers(self._count[at[1], arm])
            new.arm[at], new.option[at] = arm, self._plans[plan, 1]

    def _free(self, new: Schedules, rows: Array) -> None:
        """The arms no longer wait with the jobs of a stretch of time."""
        begin_s = self._rng.uniform(0.0, self._horizon_s, (len(rows), 1))
        length_s = self._rng.choice([1800.0, 7200.0, np.inf], (len(rows), 1))
        inside = (new.order[rows] >= begin_s) & (new.order[rows] <= begin_s + length_s)
        same = new.arm[rows] == new.arm[rows, self._one(rows)][:, None]
        inside &= same | (self._rng.random((len(rows), 1)) < 0.5)
        new.not_before_s[rows] = np.where(inside, 0.0, new.not_before_s[rows])

    def _delay(self, new: Schedules, rows: Array) -> None:
        """The arm waits before it claims a job."""
        job = self._one(rows)
        planned = np.isfinite(new.order[rows, job])
        rows, job = rows[planned], job[planned]
        wait_s = self._rng.exponential(self._rng.choice(self._waits_s, len(rows)))
        new.not_before_s[rows, job] = new.order[rows, job] + wait_s

    def _leave_out(self, new: Schedules, rows: Array) -> None:
        """Mostly a job that is left out is taken up; otherwise one is left out."""
        missing = ~np.isfinite(new.order[rows][:, self._jobs])
        takes_up = missing.any(axis=-1) & (self._rng.random(len(rows)) < 0.8)
        new.order[rows[~takes_up], self._one(rows[~takes_up])] = np.inf
        rows, missing = rows[takes_up], missing[takes_up]
        job = self._jobs[np.where(missing, self._rng.random(missing.shape), -1.0).argmax(axis=-1)]
        self._assign(new, rows, job)
        self._place(new, rows, job)

    def _window(self, new: Schedules, rows: Array) -> None:
        """Some jobs that are near in time, or share a station, get new arms and places; no job within an hour waits."""
        job, rng = self._one(rows), self._rng
        time_s = np.where(np.isfinite(new.order[rows]), new.order[rows], self._release_s)
        centre_s = time_s[np.arange(len(rows)), job][:, None]
        distance_s = np.abs(time_s - centre_s)[:, self._jobs]
        by_station = rng.random((len(rows), 1)) < 0.4
        shares = (self._stations[self._jobs] & self._stations[job][:, None]).any(axis=-1)
        distance_s = np.where(shares | ~by_station, distance_s, np.inf)
        pool = np.argsort(distance_s, axis=-1, kind="stable")[:, :10]
        size = np.where(by_station, 8, 10).clip(max=np.isfinite(distance_s).sum(axis=-1, keepdims=True))
        count = rng.integers(2, 6, (len(rows), 1)).clip(max=size)
        lot = np.where(np.arange(pool.shape[1]) < size, rng.random(pool.shape), np.inf)
        chosen = self._jobs[np.take_along_axis(pool, np.argsort(lot, axis=-1), axis=-1)]
        inside = np.arange(pool.shape[1]) < count
        other = np.argsort(np.where(inside, rng.random(pool.shape), np.inf), axis=-1)
        order = new.order[rows[:, None], np.take_along_axis(chosen, other, axis=-1)]
        at = np.broadcast_to(rows[:, None], inside.shape)[inside], chosen[inside]
        new.order[at] = order[inside]
        moved = rng.random(len(at[0])) < 0.6
        self._assign(new, at[0][moved], at[1][moved])
        late = np.abs(new.order[rows] - centre_s) < 3600.0
        new.not_before_s[rows] = np.where(late, 0.0, new.not_before_s[rows])
