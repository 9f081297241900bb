"""Hindsight: the best schedule that a clairvoyant search finds in the true simulator, a lower bound of the optimum."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from scenarios.bounds.schedule import Claim, Schedules, ShiftSimulator, Simulated, stack

Array = np.ndarray

SIDE_BY_SIDE = 32
"""Schedules that are simulated at a time."""
TOLERANCE = 0.004
"""At the beginning the search goes on from a schedule that is worse by at most this share of the value on offer."""
RESTART = 30
"""Rounds without a better schedule after which the search goes on near the best one."""
LEAST_GAIN = 1e-9
KICKS = 6
"""It is changed fewer times than this before."""


@dataclass(frozen=True, eq=False)
class Hindsight:
    """The best schedule found."""

    reward: float
    start: float
    """Reward of the best start."""
    claims: list[Claim]
    """For `scenarios.bounds.schedule.Replay`."""
    evaluations: int
    seconds: float
    """CPU time of the search after its first simulation."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """When the search ends, at the first of both, and the proof of the upper bound.

    Without a limit of seconds the result depends on nothing but the instance, the code and its libraries.
    """

    seconds: float = 30.0
    """CPU time after the first simulation, which may compile the simulator; inf for no limit."""
    evaluations: int = 1_000_000
    """Simulated shifts."""
    nodes: int = 2000
    """Most nodes of the branch and bound of the upper bound, which has proved something by then; 0: none."""


def hindsight(
    simulator: ShiftSimulator,
    starts: Simulated,
    seed: np.random.SeedSequence,
    budget: Budget | None = None,
    *,
    stopped: Callable[[], bool] = lambda: False,
) -> Hindsight:
    """The best schedule found by large neighbourhood search, never worse than the starts.

    Each round changes the present schedule in many ways, simulates all of them, and goes on from the best, which may be
    slightly worse (record-to-record travel: Dueck, Journal of Computational Physics 104, 1993). The next round also
    tries all changes that were improvements at once.

    Args:
        starts: Results in the same shift of policies, for example.
        seed: Of the changes.
    """
    budget, rng, first = budget or Budget(), np.random.default_rng(seed), int(starts.reward.argmax())
    best, best_claims = float(starts.reward[first]), starts.claims[first]
    changes = _Changes(simulator, rng)
    if changes.none:
        return Hindsight(best, best, best_claims, 0, 0.0)
    present = changes.of_result(starts, np.argsort(-starts.reward)[: simulator.rows // 4])
    value = float(simulator.world.jobs.value[0][simulator.world.jobs.exists[0]].sum())
    tried = stack([present, changes.freed(present)])
    result = simulator.run(tried)
    began_s = time.process_time()  # that run may have compiled the simulator, for a minute
    at = int(result.reward.argmax())
    current, score = changes.in_order(tried, result, at), float(result.reward[at])
    record, since, begun = current, 0, simulator.evaluations
    if score > best:
        best, best_claims = score, result.claims[at]
    joint: list[Schedules] = []
    while not stopped():
        spent_s, spent = time.process_time() - began_s, simulator.evaluations - begun
        used = max(spent_s / budget.seconds, spent / budget.evaluations)
        if used >= 1.0:
            break
        tried = stack([*joint, *(changes.changed(current) for _ in range(simulator.rows - len(joint)))])
        result = simulator.run(tried)
        at, since = int(result.reward.argmax()), since + 1
        top, better = float(result.reward[at]), np.flatnonzero(result.reward > score + LEAST_GAIN)
        joint = changes.joined(current, tried, better[np.argsort(-result.reward[better])])
        if top > best + LEAST_GAIN:
            best, best_claims, since = top, result.claims[at], 0
            record = changes.in_order(tried, result, at)
        if top > min(best - TOLERANCE * value * (1.0 - used), score) - LEAST_GAIN:
            current, score = changes.in_order(tried, result, at), top
        if since >= RESTART:
            kicked = record
            for _ in range(int(rng.integers(KICKS))):
                kicked = changes.changed(kicked)
            result = simulator.run(kicked)
            current, score, since, joint = changes.in_order(kicked, result, 0), float(result.reward[0]), 0, []
    seconds = time.process_time() - began_s
    return Hindsight(best, float(starts.reward[first]), best_claims, simulator.evaluations - begun, seconds)


class _Changes:
    """Changes of schedules of one shift."""

    def __init__(self, simulator: ShiftSimulator, rng: np.random.Generator) -> None:
        world, self._rng = simulator.world, rng
        jobs = simulator.jobs
        self._release_s = world.jobs.release_s[0, :jobs]
        self._horizon_s = world.horizon_s
        self._waits_s = world.dt_s * np.array([1.0, 5.0, 25.0, 125.0])
        can = world.offers.plan[0, :, :jobs] >= 0  # [arm, job, option]
        self._choices = [np.argwhere(can[:, job]) for job in range(jobs)]
        self._jobs = np.flatnonzero([len(each) > 0 for each in self._choices])
        self._stations = [set(row[row >= 0].tolist()) for row in world.jobs.stations[0, :jobs]]

    @property
    def none(self) -> bool:
        """Whether no arm can do any job."""
        return not len(self._jobs)

    def of_result(self, result: Simulated, rows: Sequence[int] | Array) -> Schedules:
        """Schedules that repeat some results; a job that was never awarded is left out."""
        start_s = result.start_s[rows].copy()
        arm, option = result.arm[rows].copy(), result.option[rows].copy()
        for job, choices in enumerate(self._choices):
            if len(choices):
                arm[arm[:, job] < 0, job], option[option[:, job] < 0, job] = choices[0]
        never = ~np.isfinite(start_s)
        return Schedules(np.maximum(arm, 0), np.maximum(option, 0), start_s, np.where(never, 0.0, start_s))

    def freed(self, schedules: Schedules) -> Schedules:
        """The same, but no arm waits with a job that it may claim."""
        copy = schedules.at(range(len(schedules)))
        copy.not_before_s[:] = 0.0
        return copy

    def in_order(self, schedules: Schedules, result: Simulated, row: int) -> Schedules:
        """One of some schedules, with its jobs in the order in which they began in its result."""
        copy, start_s = schedules.at([row]), result.start_s[row]
        begun = np.isfinite(start_s) & np.isfinite(copy.order[0])
        copy.order[0, begun] = start_s[begun]
        return copy

    def joined(self, before: Schedules, tried: Schedules, better: Array) -> list[Schedules]:
        """Schedules with several improvements of one schedule at once: the two best, four best, and so on."""
        found, count = [], 2
        while len(better) >= count and len(found) < 3:
            together = before.at([0])
            for row in better[:count][::-1].tolist():
                for name in Schedules.__dataclass_fields__:
                    old, new, all_ = (getattr(each, name) for each in (before, tried, together))
                    changed = new[row] != old[0]
                    all_[0, changed] = new[row, changed]
            found.append(together)
            count *= 2
        return found

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
        choices = self._choices[job]
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
        """Two jobs that are near in time exchange their arms or their places."""
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
                fits = np.flatnonzero(self._choices[one][:, 0] == arm)
                if len(fits):
                    new.arm[0, one], new.option[0, one] = self._choices[one][int(self._rng.choice(fits))]

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
        """A job is left out, or taken up if it was."""
        missing = self._jobs[~np.isfinite(new.order[0, self._jobs])]
        if len(missing) and self._rng.random() < 0.8:
            job = int(self._rng.choice(missing))
            self._assign(new, job)
            new.order[0, job], new.not_before_s[0, job] = self._time(job, np.inf), 0.0
        else:
            new.order[0, self._one()] = np.inf

    def _window(self, new: Schedules) -> None:
        """Some jobs that are near in time, or share a station, get new arms and places; the others do not wait."""
        job = self._one()
        centre_s = new.order[0, job] if np.isfinite(new.order[0, job]) else self._release_s[job]
        near = np.abs(np.where(np.isfinite(new.order[0]), new.order[0], self._release_s) - centre_s)
        pool = self._jobs[np.argsort(near[self._jobs], kind="stable")[:10]]
        if self._rng.random() < 0.4:
            same = [each for each in self._jobs.tolist() if self._stations[each] & self._stations[job]]
            pool = np.array(sorted(same, key=lambda each: near[each])[:8])
        chosen = self._rng.permutation(pool)[: int(self._rng.integers(2, 6))]
        for each in chosen.tolist():
            if self._rng.random() < 0.6:
                self._assign(new, each)
        new.order[0, chosen] = new.order[0, self._rng.permutation(chosen)]
        late = np.abs(new.order[0] - centre_s) < 3600.0
        new.not_before_s[0, late] = 0.0
