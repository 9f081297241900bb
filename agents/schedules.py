"""Schedules of the jobs of a shift, and random changes of them: the neighbourhood of a local search."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

Array = np.ndarray

LEAST_GAIN = 1e-9
"""A smaller difference of rewards is no gain."""


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
        return stack([*first, *(self.changed(schedule) for _ in range(count - len(first)))])

    def changed(self, schedule: Schedules) -> Schedules:
        """A random neighbour of a schedule."""
        new, rng = schedule.at([0]), self._rng
        kinds = (
            self._move,
            self._move,
            self._swap,
            self._reorder,
            self._free,
            self._delay,
            self._leave_out,
            self._window,
        )
        for _ in range(1 + int(rng.geometric(0.6) - 1)):
            kinds[int(rng.integers(len(kinds)))](new)
        return new

    def _one(self) -> int:
        return int(self._rng.choice(self._jobs))

    def _assign(self, new: Schedules, job: int) -> None:
        choices = self.choices[job]
        new.arm[0, job], new.option[0, job] = choices[int(self._rng.integers(len(choices)))]

    def _time(self, job: int, order: float) -> float:
        """A moment near that of a job, not before its release."""
        near = order if np.isfinite(order) else self._release_s[job]
        shifted = near + self._rng.normal() * self._rng.choice(2.0 * self._waits_s)
        return float(np.clip(shifted, self._release_s[job], self._horizon_s))

    def _move(self, new: Schedules) -> None:
        """Another arm or plan, and another place in the order."""
        job = self._one()
        self._assign(new, job)
        new.order[0, job], new.not_before_s[0, job] = self._time(job, new.order[0, job]), 0.0

    def _reorder(self, new: Schedules) -> None:
        """Another place in the order of its arm."""
        job = self._one()
        new.order[0, job], new.not_before_s[0, job] = self._time(job, new.order[0, job]), 0.0

    def _swap(self, new: Schedules) -> None:
        """Two jobs that are near in time exchange their places, half of the time their arms, too."""
        job = self._one()
        begun = self._jobs[np.isfinite(new.order[0, self._jobs])]
        if not np.isfinite(new.order[0, job]):
            return
        others = begun[np.argsort(np.abs(new.order[0, begun] - new.order[0, job]), kind="stable")[:12]]
        other = int(self._rng.choice(others))
        first, second = [job, other], [other, job]
        new.order[0, first], new.not_before_s[0, first] = new.order[0, second], 0.0
        if self._rng.random() < 0.5:
            for one, arm in zip(first, new.arm[0, second].tolist(), strict=True):
                fits = np.flatnonzero(self.choices[one][:, 0] == arm)
                if len(fits):
                    new.arm[0, one], new.option[0, one] = self.choices[one][int(self._rng.choice(fits))]

    def _free(self, new: Schedules) -> None:
        """The arms no longer wait with the jobs of a stretch of time."""
        begin_s, length_s = self._rng.uniform(0.0, self._horizon_s), self._rng.choice([1800.0, 7200.0, np.inf])
        inside = (new.order[0] >= begin_s) & (new.order[0] <= begin_s + length_s)
        if self._rng.random() < 0.5:
            inside &= new.arm[0] == new.arm[0, self._one()]
        new.not_before_s[0, inside] = 0.0

    def _delay(self, new: Schedules) -> None:
        """The arm waits before it claims a job."""
        job = self._one()
        if np.isfinite(new.order[0, job]):
            new.not_before_s[0, job] = new.order[0, job] + self._rng.exponential(self._rng.choice(self._waits_s))

    def _leave_out(self, new: Schedules) -> None:
        """Mostly a job that is left out is taken up; otherwise one is left out."""
        missing = self._jobs[~np.isfinite(new.order[0, self._jobs])]
        if len(missing) and self._rng.random() < 0.8:
            job = int(self._rng.choice(missing))
            self._assign(new, job)
            new.order[0, job], new.not_before_s[0, job] = self._time(job, np.inf), 0.0
        else:
            new.order[0, self._one()] = np.inf

    def _window(self, new: Schedules) -> None:
        """Some jobs that are near in time, or share a station, get new arms and places; no job within an hour waits."""
        job = self._one()
        centre_s = new.order[0, job] if np.isfinite(new.order[0, job]) else self._release_s[job]
        near = np.abs(np.where(np.isfinite(new.order[0]), new.order[0], self._release_s) - centre_s)
        pool = self._jobs[np.argsort(near[self._jobs], kind="stable")[:10]]
        if self._rng.random() < 0.4:
            same = self._jobs[(self._stations[self._jobs] & self._stations[job]).any(axis=1)]
            pool = same[np.argsort(near[same], kind="stable")[:8]]
        chosen = self._rng.permutation(pool)[: int(self._rng.integers(2, 6))]
        for each in chosen.tolist():
            if self._rng.random() < 0.6:
                self._assign(new, each)
        new.order[0, chosen] = new.order[0, self._rng.permutation(chosen)]
        late = np.abs(new.order[0] - centre_s) < 3600.0
        new.not_before_s[0, late] = 0.0
