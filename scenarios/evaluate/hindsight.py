"""Hindsight: the best schedule that a clairvoyant search finds in the true simulator, a lower bound of the optimum; and
the simulator, which plays schedules and policies in one shift many times side by side."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from agents.policy import WAIT, PlanningPolicy, Policy, only_choices
from agents.schedules import LEAST_GAIN, Changes, Schedules, stack
from fleet.engine.batch import Engine, RewardWeights, empty_parts
from fleet.engine.step import FINISHED, TOTAL
from fleet.engine.world import World
from fleet.env.lookahead import CellSimulator, Lookahead
from fleet.env.validation import actions_of
from fleet.observation import Layout, Observation
from scenarios.evaluate.rollout import UNLIMITED, DecisionLimit
from scenarios.spec.options import Budget

Array = np.ndarray


Claim = tuple[int, int, int]
"""Decision interval, arm (its index) and action."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """Results of schedules or of policies."""

    reward: Array
    """[schedule]."""
    start_s: Array
    """When each job was last awarded, inf if never, [schedule, job]."""
    arm: Array
    """To which arm, int [schedule, job]."""
    option: Array
    """With which plan, int [schedule, job]."""
    claims: list[list[Claim]]
    """The claims of each schedule that were won, and jobs given back, in the order of time."""


def joined(results: Sequence[Simulated]) -> Simulated:
    names = ("reward", "start_s", "arm", "option")
    arrays = (np.concatenate([getattr(each, name) for each in results]) for name in names)
    return Simulated(*arrays, claims=[claims for each in results for claims in each.claims])


class ShiftSimulator:
    """Simulates one shift many times side by side.

    Args:
        world: Its env 0.
        rows: Number of simulations at a time.
        noise_key: Of the sensors, which only policies notice.
        simulator: Makes that of the same shift for a policy that plans.
        bids: Whether policies see the bids of peers.
        compiled: As in `Engine`.
    """

    def __init__(
        self,
        world: World,
        weights: RewardWeights,
        rows: int,
        *,
        noise_key: int = 0,
        simulator: Callable[[], CellSimulator] | None = None,
        bids: bool = False,
        compiled: bool | None = None,
    ) -> None:
        self.world, self.rows, self._simulator = world, rows, simulator
        self._shift = replace(world.shifts[0], noise_key=noise_key)
        self.jobs = len(self._shift.kind)
        self.evaluations = 0
        """Shifts simulated so far."""
        self._layout = Layout(len(world.arms), world.slots, plans=world.plans_per_job, bids=bids)
        self._engine = Engine(world.tables, rows, self._layout, weights, jobs=self.jobs, compiled=compiled)
        self._parts = empty_parts(self._layout, rows)

    def changes(self, rng: np.random.Generator) -> Changes:
        tables, shift = self.world.tables, self._shift
        can = tables.work["plan"][0, shift.kind].swapaxes(0, 1) >= 0
        stations = tables.stations[0, shift.kind]
        return Changes(can, stations, shift.release_s, self.world.horizon_s, self.world.dt_s, rng)

    def run(self, schedules: Schedules) -> Simulated:
        """The results of at most `rows` schedules."""
        given = len(schedules.arm)
        self._engine.reset(np.arange(given), [self._shift] * given)
        played = self._engine.play(schedules, np.ones(self.world.ticks))
        self.evaluations += given
        lists = [
            [(tick, a, action) for tick, a, action in played.claims[e, : played.won[e]].tolist()] for e in range(given)
        ]
        return Simulated(played.reward, played.start_s, schedules.arm, schedules.option, lists)

    def follow(self, policies: Sequence[Policy], limit: DecisionLimit = UNLIMITED) -> Simulated:
        """The results of at most `rows` policies, each at the beginning of its shift.

        Args:
            limit: Of the time of a decision.
        """
        engine, world, given = self._engine, self.world, len(policies)
        skips = all(only_choices(policy) for policy in policies)
        engine.reset(np.arange(self.rows), [self._shift] * self.rows)
        engine.observe(np.arange(self.rows), self._parts)
        for e, policy in enumerate(policies):
            if isinstance(policy, PlanningPolicy) and self._simulator:
                policy.plan_in(Lookahead(self._simulator(), engine, e))
        reward, running = np.zeros(self.rows), np.ones(self.rows, bool)
        running[given:] = False
        start_s = np.full((self.rows, self.jobs), np.inf)
        arm_of, option_of = np.full((self.rows, self.jobs), -1), np.full((self.rows, self.jobs), -1)
        claims: list[list[Claim]] = [[] for _ in range(self.rows)]
        until = np.full(self.rows, world.ticks, np.int64) if skips else None
        give_back, options = self._layout.actions - 1, self._layout.plans
        while running.any():
            asked = running & engine.mask[..., 1:-1].any(axis=(1, 2)) if skips else running
            actions = self._actions(policies, asked, limit)
            tick, slot_job = engine.state.tick.copy(), engine.offers.slot_job.copy()
            legal = np.take_along_axis(engine.mask, np.clip(actions, 0, give_back)[..., None], axis=2)[..., 0] > 0
            outcome = engine.step(actions, self._parts, until)
            reward += np.where(running, outcome[:, TOTAL], 0.0)
            for e, a in np.argwhere((actions > 0) & legal & running[:, None]).tolist():
                action = int(actions[e, a])
                if action < give_back and engine.state.last_award[e, a] != 1:
                    continue
                claims[e].append((int(tick[e]), a, action))
                if action < give_back:
                    slot, option = divmod(action - 1, options)
                    job = slot_job[e, slot]
                    start_s[e, job], arm_of[e, job], option_of[e, job] = tick[e] * world.dt_s, a, option
            running &= (outcome[:, FINISHED] == 0) & (engine.state.tick < world.ticks)
        self.evaluations += given
        return Simulated(reward[:given], start_s[:given], arm_of[:given], option_of[:given], claims[:given])

    def _actions(self, policies: Sequence[Policy], asked: Array, limit: DecisionLimit) -> Array:
        names, mask = self.world.arms, self._engine.mask
        actions = np.full((self.rows, len(names)), WAIT, np.int64)
        for e in np.flatnonzero(asked).tolist():
            known = self._layout.read_each(names, self._parts[0][e], self._parts[1][e], mask[e])
            with limit.decision():
                actions[e] = actions_of(names, policies[e].act(known))
        return actions


def without_scores(world: World) -> World:
    """Remove the predicted peaks and probabilities from a world, which only policies read; the difficulties stay, by
    which conflicting claims are resolved."""
    tables = world.tables
    work, curve = tables.work.copy(), tables.forecast_curve[:0]
    work["risk"] = work["peak"] = -1
    return replace(world, tables=tables._replace(work=work, forecast_curve=curve))


@dataclass
class ScheduleReplay:
    """A policy that repeats the claims of a schedule; in the shift that it was made for, it has the same result."""

    claims: Sequence[Claim]
    scope: ClassVar = "central"
    _interval: int = field(default=0, init=False)

    def reset(self, rng: np.random.Generator) -> None:
        self._interval = 0

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """The claims of this decision interval; to be called once in each."""
        arms = list(observations)
        actions = dict.fromkeys(arms, WAIT) | {
            arms[a]: action for tick, a, action in self.claims if tick == self._interval
        }
        self._interval += 1
        return actions


SIDE_BY_SIDE = 32
"""Schedules that are simulated at a time."""
TOLERANCE = 0.004
"""At the beginning the search goes on from a schedule that is worse by at most this share of the value on offer."""
RESTART = 30
"""Rounds without a better schedule after which the search goes on near the best one."""
KICKS = 6
"""It is changed fewer times than this before."""


@dataclass(frozen=True, eq=False)
class Hindsight:
    """The best schedule found."""

    reward: float
    claims: list[Claim]
    """For `ScheduleReplay`."""
    evaluations: int
    seconds: float
    """CPU time of the search after its first simulation."""


def hindsight(
    simulator: ShiftSimulator,
    starts: Simulated,
    seed: np.random.SeedSequence,
    budget: Budget | None = None,
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
    changes = simulator.changes(rng)
    if changes.none:
        return Hindsight(best, best_claims, 0, 0.0)
    chosen = np.argsort(-starts.reward)[: simulator.rows // 4]
    present = changes.of_awards(starts.start_s[chosen], starts.arm[chosen], starts.option[chosen])
    world = simulator.world
    value = float(world.tables.value[0, world.shifts[0].kind].sum())
    tried = stack([present, changes.freed(present)])
    result = simulator.run(tried)
    began_s = time.process_time()  # that run may have compiled the simulator, for a minute
    at = int(result.reward.argmax())
    current, score = changes.in_order(tried, result.start_s, at), float(result.reward[at])
    record, since, begun = current, 0, simulator.evaluations
    if score > best:
        best, best_claims = score, result.claims[at]
    joint: list[Schedules] = []
    while True:
        spent_s, spent = time.process_time() - began_s, simulator.evaluations - begun
        used = max(spent_s / budget.seconds, spent / budget.evaluations)
        if used >= 1.0:
            break
        tried = changes.neighbours(current, joint, simulator.rows)
        result = simulator.run(tried)
        at, since = int(result.reward.argmax()), since + 1
        top, joint = float(result.reward[at]), changes.joined(current, score, tried, result.reward)
        if top > best + LEAST_GAIN:
            best, best_claims, since = top, result.claims[at], 0
            record = changes.in_order(tried, result.start_s, at)
        if top > min(best - TOLERANCE * value * (1.0 - used), score) - LEAST_GAIN:
            current, score = changes.in_order(tried, result.start_s, at), top
        if since >= RESTART:
            kicked = record
            for _ in range(int(rng.integers(KICKS))):
                kicked = changes.changed(kicked)
            result = simulator.run(kicked)
            current, score, since, joint = changes.in_order(kicked, result.start_s, 0), float(result.reward[0]), 0, []
    seconds = time.process_time() - began_s
    return Hindsight(best, best_claims, simulator.evaluations - begun, seconds)
