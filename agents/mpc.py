"""Model predictive control: search repeatedly for the best schedule of the open jobs, in a simulator of the cell.

When an arm may claim a job, and a job is new in the slots or the last search is `every_s` old, the policy searches for
a schedule of all jobs in the slots: which arm does which job, by which plan, when. The worth of a schedule is its
simulated reward until the end of the shift; what comes a time t later counts exp(−t / `tau_s`), because jobs that
arrive later will need the arms too. The search begins at the last schedule and tries each new job at the beginning, in
the middle and at the end of the order, by every plan; then it tries random changes (large neighbourhood search). In
between the arms follow the schedule.

The simulator knows what a dispatcher of the cell knows, see `fleet.env.lookahead`: no job that has no slot yet, no
true temperature, no thermal network but that which the arms know.

Sources: Mayne et al., Automatica 36, 2000 (model predictive control); Shaw, CP 1998 (large neighbourhood search).
"""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from agents.policy import WAIT, Lookahead, no_simulator, plans_of
from agents.schedules import LEAST_GAIN, Changes, Schedules
from fleet.observation import Observation

Array = np.ndarray

BEHIND_S = 1.0
"""Difference of the order of a job that comes right before or after another in a schedule."""


class Mpc:
    """Model predictive control with a simulator of the cell; see the module. Scope central: it plans for all arms.

    It plans only where there is a simulator of its cell, which `plan_in` gives it: in `run`, `compare` and `bounds`,
    not in a live fleet.
    """

    scope: ClassVar = "central"
    only_choices = True
    tau_s: ClassVar = 600.0
    """Time in which the worth of a later reward falls to 1/e: chosen on 24 instances of the validation split of the
    suite among 300, 600, 900, 1200, 2400, 3600 and 7200."""
    every_s: ClassVar = 300.0
    """Age of a search after which the next decision searches again, also without a new job."""
    evaluations: ClassVar = 128
    """Simulated changes of each search."""

    def __init__(self) -> None:
        self._cell: Lookahead | None = None
        self.reset(np.random.default_rng(0))

    def plan_in(self, cell: Lookahead) -> None:
        """Plan in the simulator of a shift, from its beginning."""
        self._cell = cell

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift."""
        self._rng = rng
        self._schedule: Schedules | None = None
        self._planned: set[int] = set()
        """Jobs of earlier searches."""
        self.searched_s = -np.inf
        """Time of the last search."""

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """Of each free arm, the claim that comes first in the schedule among those that are legal now.

        Raises:
            FleetError: there is no simulator of the cell.
        """
        actions = dict.fromkeys(observations, WAIT)
        if not any(seen.action_mask[1:-1].any() for seen in observations.values()):
            return actions
        if self._cell is None:
            raise no_simulator("mpc")
        cell, now_s = self._cell, self._cell.now_s
        slot_job = cell.slot_job
        new = [job for job in slot_job[slot_job >= 0].tolist() if job not in self._planned]
        if new or now_s - self.searched_s >= self.every_s:
            self._schedule, self.searched_s = self._search(cell, observations, new), now_s
            self._planned.update(new)
        assert self._schedule is not None
        return actions | _claims(self._schedule, slot_job, observations, now_s)

    def _search(self, cell: Lookahead, observations: Mapping[str, Observation], new: list[int]) -> Schedules:
        """The best schedule found for the jobs in the slots."""
        present, simulator, rng = cell.look(observations), cell.simulator, self._rng
        jobs, now_s, horizon_s, dt_s = present.can.shape[1], present.now_s, simulator.horizon_s, simulator.dt_s
        later_s = np.maximum(np.arange(round(horizon_s / dt_s)) * dt_s - now_s, 0.0)
        discount, released_s = np.exp(-later_s / self.tau_s), np.full(jobs, now_s)
        changes = Changes(present.can, present.stations, released_s, horizon_s, dt_s, rng, present.open)
        best = self._schedule or _no_job(jobs)
        best.not_before_s[best.not_before_s <= now_s] = 0.0
        reward = float(simulator.run(best, discount).reward[0])

        for job in new:
            if job in changes.choices:
                tried = _inserted(best, job, changes.choices[job], present.open, now_s, simulator.rows, rng)
                rewards = simulator.run(tried, discount).reward
                at = int(rewards.argmax())
                if rewards[at] > reward + LEAST_GAIN:
                    best, reward = tried.at([at]), float(rewards[at])

        joint: list[Schedules] = []
        for _ in range(0 if changes.none else self.evaluations // simulator.rows):
            tried = changes.neighbours(best, joint, simulator.rows)
            result = simulator.run(tried, discount)
            at, joint = int(result.reward.argmax()), changes.joined(best, reward, tried, result.reward)
            if result.reward[at] > reward + LEAST_GAIN:
                best, reward = changes.in_order(tried, result.start_s, at), float(result.reward[at])
        return best


def _no_job(jobs: int) -> Schedules:
    """A schedule without jobs."""
    nobody = np.zeros((1, jobs), int)
    return Schedules(nobody, nobody.copy(), np.full((1, jobs), np.inf), np.zeros((1, jobs)))


def _inserted(
    schedule: Schedules, job: int, choices: Array, open_: Array, now_s: float, most: int, rng: np.random.Generator
) -> Schedules:
    """Schedules with one more job: by every plan for it, before, amid or behind the other open jobs; a random sample of
    at most `most`."""
    order = np.sort(schedule.order[0, open_])
    order = order[np.isfinite(order)]
    places = [order[0] - BEHIND_S, order[len(order) // 2], order[-1] + BEHIND_S] if len(order) else [now_s]
    ways = [(arm, option, place) for arm, option in choices.tolist() for place in places]
    if len(ways) > most:
        ways = [ways[i] for i in rng.choice(len(ways), most, replace=False)]
    tried = schedule.at([0] * len(ways))
    tried.arm[:, job], tried.option[:, job], tried.order[:, job] = zip(*ways, strict=True)
    tried.not_before_s[:, job] = 0.0
    return tried


def _claims(
    schedule: Schedules, slot_job: Array, observations: Mapping[str, Observation], now_s: float
) -> dict[str, int]:
    """Of each arm with a legal claim for a job of its own, the first in the schedule; see `fleet.engine.play`."""
    arms, first, actions = list(observations), dict[str, float](), dict[str, int]()
    for slot, job in enumerate(slot_job.tolist()):
        if job < 0 or schedule.not_before_s[0, job] > now_s:
            continue
        arm, order = arms[schedule.arm[0, job]], float(schedule.order[0, job])
        action = 1 + slot * plans_of(observations[arm]) + int(schedule.option[0, job])
        if order < first.get(arm, np.inf) and observations[arm].action_mask[action]:
            first[arm], actions[arm] = order, action
    return actions
