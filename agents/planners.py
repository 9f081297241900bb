"""Policies that plan ahead: model predictive control in a simulator of the cell, and a rolling horizon.

Model predictive control (`Mpc`) searches repeatedly for the best schedule of the open jobs. When an arm may claim a
job, and a job is new in the slots or the last search is `every_s` old, the policy searches for a schedule of all jobs
in the slots: which arm does which job, by which plan, when. The worth of a schedule is its simulated reward until the
end of the shift; what comes a time t later counts exp(−t / `tau_s`), because jobs that arrive later will need the arms
too. The simulator has one temperature for each motor, although the true one is uncertain: each award costs the expected
loss by a fault, by the predicted peak of a start now, as in `wsept`. The search begins at the last schedule and tries
each new job at the beginning, in the middle and at the end of the order, by every plan; then it tries random changes
(large neighbourhood search). In between the arms follow the schedule.

The simulator knows what a dispatcher of the cell knows, see `fleet.env.lookahead`: no job that has no slot yet, no
true temperature, no thermal network but that which the arms know.

Sources: Mayne et al., Automatica 36, 2000 (model predictive control); Shaw, CP 1998 (large neighbourhood search).

The rolling horizon (`RollingHorizon`) plans the next hour anew at every decision. Each arm, also a busy one from the
moment it is home, gets a sequence of at most two plans for open jobs, each job in at most one sequence. The program
chooses among the enumerated sequences (set packing, a mixed-integer program, solved by HiGHS within a time limit). A
sequence earns, for each of its jobs,

- the expected worth of `wsept`, discounted until the finish by exp(−time / 30 min): jobs that arrive later need the
  arm too, so time has a price, without which plans wait for ever cooler arms, and
- a fifth of the cost of tardiness that it avoids, compared with a start at the end of the horizon; a job that is not in
  the plan is seldom so late.

The heat of a plan that begins later follows from its predicted peak, which the arm computes by its identified thermal
network for a start now. Of a network with one time constant τ, the temperature at the end of a plan of duration d is
linear in that at its beginning, with the factor exp(−d / τ). Cooling below the present temperature does not count.

A job whose station or space is taken now can begin when the last arm at work is home: the observation does not say
which arm is in its way. Two sequences may disagree about a station or a space that is free now. As with any claims, one
of the arms then gets its job, and the other chooses again. Precedence is that of the offers: a job is offered when
those before it are done.

Source: Ovacik & Uzsoy, International Journal of Production Research 32, 1994 (rolling horizons).
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from agents.heat import Wsept
from agents.policy import WAIT, CellLookahead, no_simulator, one_fleet, per_option, plans_of
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
    tau_s: ClassVar = 1800.0
    """Time in which the worth of a later reward falls to 1/e: chosen on 32 instances of the validation split of the
    suite, in which heat binds, among 600, 1200, 1800 and 3600."""
    every_s: ClassVar = 300.0
    """Age of a search after which the next decision searches again, also without a new job."""
    least_discount: ClassVar = 0.01
    """The simulation of a schedule ends where a reward counts less."""
    evaluations: ClassVar = 128
    """Changes that each search tries, in steps of `CellSimulator.rows`; it ends before if a step has nothing new."""

    def __init__(self) -> None:
        self._cell: CellLookahead | None = None
        self.reset(np.random.default_rng(0))

    def plan_in(self, cell: CellLookahead) -> None:
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

    def expected_loss(self, observations: Mapping[str, Observation]) -> Array:
        """Expected loss of value by a fault, and its price, of every plan begun now, [slot, arm, option]."""
        seen = one_fleet(list(observations.values()))
        loss = per_option(seen, seen.value) - Wsept.worth(seen, factors=(1.0, 1.0, 0.0))
        return loss[0].reshape(len(observations), -1, plans_of(seen)).swapaxes(0, 1)

    def _search(self, cell: CellLookahead, observations: Mapping[str, Observation], new: list[int]) -> Schedules:
        """The best schedule found for the jobs in the slots."""
        present, simulator, rng = cell.look(observations), cell.simulator, self._rng
        jobs, now_s, horizon_s, dt_s = present.can.shape[1], present.now_s, simulator.horizon_s, simulator.dt_s
        later_s = np.maximum(np.arange(round(horizon_s / dt_s)) * dt_s - now_s, 0.0)
        discount, released_s = np.exp(-later_s / self.tau_s), np.full(jobs, now_s)
        costs = np.zeros((jobs, *present.can.shape[::2]))
        filled = cell.slot_job >= 0
        costs[cell.slot_job[filled]] = self.expected_loss(observations)[filled]
        memory = _Memory(simulator, discount[discount >= self.least_discount], now_s, costs, self.tau_s)
        changes = Changes(present.can, present.stations, released_s, horizon_s, dt_s, rng, present.open)
        best = self._schedule or _no_job(jobs)
        best.not_before_s[best.not_before_s <= now_s] = 0.0
        reward = float(memory.run(best)[0][0])

        for job in new:
            if job in changes.choices:
                tried = _inserted(best, job, changes.choices[job], present.open, now_s, simulator.rows, rng)
                rewards, _ = memory.run(tried)
                at = int(rewards.argmax())
                if rewards[at] > reward + LEAST_GAIN:
                    best, reward = tried.at([at]), float(rewards[at])

        joint: list[Schedules] = []
        for _ in range(0 if changes.none else self.evaluations // simulator.rows):
            tried = changes.neighbours(best, joint, simulator.rows)
            known = len(memory.results)
            rewards, start_s = memory.run(tried)
            if len(memory.results) == known:
                break
            at, joint = int(rewards.argmax()), changes.joined(best, reward, tried, rewards)
            if rewards[at] > reward + LEAST_GAIN:
                best, reward = changes.in_order(tried, start_s, at), float(rewards[at])
        return best


class _Memory:
    """The results of the schedules of one search: most random changes of a few jobs repeat an earlier schedule.

    Args:
        discount: Of the reward of each step, [tick].
        costs: Of the award of each job, [job, arm, option], discounted by exp(−time / `tau_s`).
    """

    def __init__(self, simulator: Any, discount: Array, now_s: float, costs: Array, tau_s: float) -> None:
        self._simulator, self._discount, self._now_s = simulator, discount, now_s
        self._costs, self._tau_s = costs, tau_s
        self.results: dict[bytes, tuple[float, Array]] = {}

    def run(self, schedules: Schedules) -> tuple[Array, Array]:
        """Discounted rewards, [schedule], and when each job was last awarded, inf if never, [schedule, job]."""
        keys = schedules.keys(self._now_s)
        new = {key: row for row, key in enumerate(keys) if key not in self.results}
        if new:
            tried = schedules.at(list(new.values()))
            found = self._simulator.run(tried, self._discount)
            later_s = found.start_s - self._now_s
            cost = self._costs[np.arange(len(self._costs)), tried.arm, tried.option]
            cost = np.where(later_s >= 0, cost * np.exp(-np.maximum(later_s, 0.0) / self._tau_s), 0.0).sum(axis=1)
            rewards = (found.reward - cost).tolist()
            self.results.update(zip(new, zip(rewards, found.start_s, strict=True), strict=True))
        rewards, start_s = zip(*(self.results[key] for key in keys), strict=True)
        return np.array(rewards), np.stack(start_s)


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
    """Of each arm with a legal claim for a job of its own, the first in the schedule; see `choose_claims`."""
    arms, first, actions = list(observations), dict[str, float](), dict[str, int]()
    for slot, job in enumerate(slot_job.tolist()):
        if job < 0 or schedule.not_before_s[0, job] > now_s:
            continue
        arm, order = arms[schedule.arm[0, job]], float(schedule.order[0, job])
        action = 1 + slot * plans_of(observations[arm]) + int(schedule.option[0, job])
        if order < first.get(arm, np.inf) and observations[arm].action_mask[action]:
            first[arm], actions[arm] = order, action
    return actions


NONE = -1
"""Option of a sequence without a second job."""


class Solution(NamedTuple):
    """Result of the solver for one decision."""

    chosen: list[int]
    """Indices of the chosen sequences."""
    worth: float
    gap: float
    """Relative distance of the worth to the bound of the solver, 0 if it is proven optimal."""


class Sequences(NamedTuple):
    """Sequences of one arm."""

    first: Array
    """Option, [sequence]."""
    second: Array
    """Option or NONE, [sequence]."""
    waits: Array
    """Whether the first plan cannot begin now, bool [sequence]."""
    worth: Array
    """[sequence], each above 0."""


class RollingHorizon(Wsept):
    """The best sequences of up to two jobs per arm within an hour, by expected worth and tardiness; see the module.

    `solution` is that of the last decision, with its gap. Scope central: it plans for all arms. A decision ends with
    the best sequences so far after `nodes` nodes; if it reaches `time_limit_s` before, a shift no longer repeats
    exactly.
    """

    scope: ClassVar = "central"
    horizon_s: ClassVar = 3600.0
    nodes: ClassVar = 100
    """Most nodes of the solver's branch and bound at each decision; nearly all end at the first."""
    time_limit_s: ClassVar = 1.0
    """For the solver, at each decision, so that a live fleet never waits for long."""
    tau_s: ClassVar = 1800.0
    """Time constant of a motor with its housing: a nominal joint 2 cools from 75 to 42 °C in 1900 s at 30 °C."""
    discount_s: ClassVar = 1800.0
    """Time in which the worth of a later finish falls to 1/e."""
    tardiness_share: ClassVar = 0.2
    firsts: ClassVar = 16
    """Plans per arm with the most worth that may be the first of a sequence; half as many may be the second."""

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift."""
        self.solution: Solution | None = None

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """The claims of the sequences whose first plan can begin now."""
        if not any(seen.action_mask[1:-1].any() for seen in observations.values()):
            return dict.fromkeys(observations, WAIT)
        fleet = list(observations.values())
        home_s = max((float(seen.busy_s) for seen in fleet if seen.working), default=0.0)
        found = [self.sequences(seen, home_s) for seen in fleet]
        self.solution = pack(found, len(fleet[0].offered), plans_of(fleet[0]), self.time_limit_s, self.nodes)
        arm = np.repeat(np.arange(len(found)), [len(each.first) for each in found])
        first, waits = (np.concatenate([getattr(each, name) for each in found]) for name in ("first", "waits"))
        actions = {list(observations)[arm[i]]: 1 + int(first[i]) for i in self.solution.chosen if not waits[i]}
        return dict.fromkeys(observations, WAIT) | actions

    def sequences(self, seen: Observation, home_s: float) -> Sequences:
        """The sequences of an arm with a positive worth.

        Args:
            home_s: Time until the last arm at work is home.
        """
        free_s = float(seen.busy_s)
        hottest_c = float(seen.temp_c.max())
        free_c = max(hottest_c, float(seen.job_peak_c)) if seen.working else hottest_c
        legal = seen.action_mask[1:-1] > 0
        open_now = (legal | (seen.working > 0)) & (per_option(seen, seen.station_free) > 0)
        begin_s = np.maximum(free_s, np.where(open_now, 0.0, home_s))
        can = (seen.feasible > 0) & (per_option(seen, seen.offered) > 0) & (seen.faulted == 0)
        peak_c = self.predicted_peak_c(seen.peak_c, seen.p_saturation, float(seen.headroom_k) + hottest_c).astype(float)
        d = seen.duration_s.astype(float)
        one, one_c = self._earn(seen, peak_c, begin_s, self._cooled(free_c, seen, begin_s - free_s), hottest_c)
        one = np.where(can & (begin_s < self.horizon_s), one, -np.inf)
        rank = np.argsort(-one, kind="stable")
        rank = rank[one[rank] > 0][: self.firsts]
        head, tail = np.meshgrid(rank, rank[: self.firsts // 2], indexing="ij")
        plans = plans_of(seen)
        other = head // plans != tail // plans
        head, tail = head[other], tail[other]
        home = begin_s[head] + d[head]
        then_s = np.maximum(home, begin_s[tail])
        start_c = self._cooled(one_c[head], seen, then_s - home)
        two, _ = self._earn(seen, peak_c, then_s, start_c, hottest_c, tail)
        good = (then_s < self.horizon_s) & (two > 0)
        head, tail, both = head[good], tail[good], one[head[good]] + two[good]
        first = np.concatenate([rank, head])
        second = np.concatenate([np.full(len(rank), NONE), tail])
        return Sequences(first, second, ~legal[first], np.concatenate([one[rank], both]))

    def _cooled(self, hot_c: Array | float, seen: Observation, idle_s: Array) -> Array:
        """Temperature of the hottest motor after some idle time, °C."""
        air_c = float(seen.ambient_c)
        return air_c + (hot_c - air_c) * np.exp(-idle_s / self.tau_s)

    def _earn(
        self,
        seen: Observation,
        peak_c: Array,
        begin_s: Array,
        start_c: Array,
        hottest_c: float,
        options: Array | slice = slice(None),
    ) -> tuple[Array, Array]:
        """Worth of plans by start time and start temperature, and their peak temperatures, °C.

        Args:
            peak_c: Predicted for a start now, [option].
            begin_s, start_c: [n].
            hottest_c: Hottest motor now.
            options: The plan of each, [n].
        """
        d = np.maximum(seen.duration_s.astype(float), 1.0)[options]
        value = per_option(seen, seen.value).astype(float)[options]
        due_s = seen.slack_s.astype(float)[options] + d
        warmer_k = np.maximum(start_c - hottest_c, 0.0)
        later_c = np.maximum(peak_c[options] + warmer_k * np.exp(-d / self.tau_s), start_c)
        warning_c, error_c = float(seen.headroom_k) + hottest_c, float(seen.error_headroom_k) + hottest_c
        worth = self.worth_of(value, d, later_c, start_c, warning_c, error_c + self.margin_k)
        late_s = np.maximum(self.horizon_s + d - due_s, 0.0) - np.maximum(begin_s + d - due_s, 0.0)
        late = self.tardiness_share * self.tardiness_price * value * late_s / 60.0
        earned = worth * np.exp(-(begin_s + d) / self.discount_s) + late
        expired = (per_option(seen, seen.expires)[options] > 0) & (begin_s >= due_s)
        return np.where((worth > 0) & ~expired, earned, -np.inf), later_c


def pack(sequences: Sequence[Sequences], slots: int, plans: int, time_limit_s: float, nodes: int) -> Solution:
    """The sequences with the most worth, at most one of each arm, and each job in at most one of them."""
    from scipy.optimize import LinearConstraint, milp  # slow import that few processes need
    from scipy.sparse import csr_array

    counts = [len(each.first) for each in sequences]
    total = sum(counts)
    if not total:
        return Solution([], 0.0, 0.0)
    arm = np.repeat(np.arange(len(sequences)), counts)
    first, second, worth = (np.concatenate([each[i] for each in sequences]) for i in (0, 1, 3))
    has_second = np.flatnonzero(second != NONE)
    rows = np.concatenate([arm, len(sequences) + first // plans, len(sequences) + second[has_second] // plans])
    columns = np.concatenate([np.arange(total), np.arange(total), has_second])
    once = csr_array((np.ones(len(rows)), (rows, columns)), shape=(len(sequences) + slots, total))
    result = milp(
        -worth,
        integrality=np.ones(total),
        bounds=(0, 1),
        constraints=LinearConstraint(once, -np.inf, 1.0),
        options={"time_limit": time_limit_s, "node_limit": nodes},
    )
    if result.x is None:  # no solution within the limits
        return Solution(_greedy(arm, first // plans, second // plans, worth), 0.0, np.inf)
    chosen = np.flatnonzero(result.x > 0.5).tolist()
    return Solution(chosen, float(-result.fun), float(result.mip_gap or 0.0))


def _greedy(arm: Array, first: Array, second: Array, worth: Array) -> list[int]:
    """Sequences by worth, the best first, each arm and job once; `second` is negative without a second job."""
    chosen, arms, jobs = list[int](), set[int](), set[int]()
    for i in np.argsort(-worth, kind="stable").tolist():
        wanted = {int(job) for job in (first[i], second[i]) if job >= 0}
        if int(arm[i]) not in arms and not jobs & wanted:
            chosen.append(i)
            arms.add(int(arm[i]))
            jobs |= wanted
    return chosen
