"""The loop that executes schedules in the simulator; compiled, without observations."""

from typing import Any, NamedTuple

import numpy as np

from fleet.engine.claims import resolve_claims, update_offers
from fleet.engine.step import step_arms
from fleet.engine.tables import Simulation
from fleet.jit import kernel, nonnegative
from fleet.job import MOST_FAULTS

Array = np.ndarray

Plans = tuple[Array, Array, Array, Array]
"""Schedules (`agents.schedules.Schedules`): arm, option, order and earliest time of each job, [schedule, job]."""


class Executed(NamedTuple):
    """What came of schedules."""

    reward: Array
    """Discounted, [schedule]."""
    start_s: Array
    """When each job was last awarded, inf if never, [schedule, job]."""
    claims: Array
    """The claims that were won, in the order of time: decision interval, arm and action, int [schedule, claim, 3]."""
    won: Array
    """Their number, int [schedule]."""


def execute(
    bundle: Any,  # numba's where the loop is compiled
    weights: Array,
    envs: int,
    schedules: Plans,
    discount: Array,
    *,
    compiled: bool | None,
) -> Executed:
    """Execute one schedule in each of the first of `envs` rows; see `play_rows`."""
    given, jobs = schedules[0].shape
    claims, count = np.zeros((given, MOST_FAULTS * jobs, 3), np.int64), np.zeros(given, np.int64)
    done = Executed(np.zeros(given), np.full((given, jobs), np.inf), claims, count)
    terms = np.empty((envs, len(weights) + 1))
    play_rows.chosen(compiled)(bundle, weights, terms, *schedules, np.arange(given), *done, discount)
    return done


@kernel
def play_rows(
    sim: Simulation,
    weights: Array,
    terms: Array,
    arm: Array,
    option: Array,
    order: Array,
    not_before_s: Array,
    rows: Array,
    reward: Array,
    start_s: Array,
    claims: Array,
    count: Array,
    discount: Array,
) -> None:
    """Execute the schedule of each of some envs from its present state to the end of its shift.

    Args:
        weights: Reward per unit of each term, [term].
        terms: Room for the reward terms and their sum, [env, term + 1].
        arm: Schedules (`agents.schedules.Schedules`), int [env, job]; likewise option, order, not_before_s.
        rows: int [row].
        reward: Receives the discounted reward of each from now on, [env].
        start_s: Receives when each job was last awarded, [env, job].
        claims: Receives the claims that were won: interval, arm, action, int [env, claim, 3]; others are dropped.
        count: Receives their number, int [env].
        discount: Factor on the reward of each step, [tick].
    """
    t, s, o = sim.tables, sim.state, sim.offers
    arms, slots, options = s.mode.shape[1], o.slot_job.shape[1], t.work.shape[3]
    one, actions = np.empty(1, np.int64), np.zeros((s.mode.shape[0], arms), np.int64)
    first = np.empty(arms)
    for row in rows:
        e = nonnegative(row)
        one[0], reward[e], count[e] = e, 0.0, 0
        update_offers(sim.tables, sim.jobs, sim.state, sim.offers, sim.events, one)
        while s.tick[e] < t.ticks and (o.unfinished[e] > 0 or sim.jobs.number[e] == 0):
            tick, claimed = s.tick[e], False
            for a in range(arms):
                first[a], actions[e, a] = np.inf, 0
            for k in range(slots):
                j = o.slot_job[e, k]
                if j < 0 or not_before_s[e, j] > tick * t.dt_s:
                    continue
                a, action = arm[e, j], 1 + k * options + option[e, j]
                if order[e, j] < first[a] and o.mask[e, a, action] != 0:
                    first[a], actions[e, a], claimed = order[e, j], action, True
            if claimed:
                resolve_claims(sim, actions, one)
                for a in range(arms):
                    if actions[e, a] > 0 and s.last_award[e, a] == 1:
                        start_s[e, s.job[e, a]] = tick * t.dt_s
                        if count[e] < claims.shape[1]:
                            n = count[e]
                            claims[e, n, 0], claims[e, n, 1], claims[e, n, 2] = tick, a, actions[e, a]
                            count[e] += 1
            step_arms(sim, weights, terms, one)
            update_offers(sim.tables, sim.jobs, sim.state, sim.offers, sim.events, one)
            reward[e] += discount[tick] * terms[e, terms.shape[1] - 1]
