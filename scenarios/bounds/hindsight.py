"""Hindsight: the best schedule that a clairvoyant search finds in the true simulator, a lower bound of the optimum."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from agents.schedules import LEAST_GAIN, Schedules, stack
from scenarios.bounds.schedule import Claim, ShiftSimulator, Simulated

Array = np.ndarray

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
    changes = simulator.changes(rng)
    if changes.none:
        return Hindsight(best, best, best_claims, 0, 0.0)
    chosen = np.argsort(-starts.reward)[: simulator.rows // 4]
    present = changes.of_awards(starts.start_s[chosen], starts.arm[chosen], starts.option[chosen])
    value = float(simulator.world.jobs.value[0][simulator.world.jobs.exists[0]].sum())
    tried = stack([present, changes.freed(present)])
    result = simulator.run(tried)
    began_s = time.process_time()  # that run may have compiled the simulator, for a minute
    at = int(result.reward.argmax())
    current, score = changes.in_order(tried, result.start_s, at), float(result.reward[at])
    record, since, begun = current, 0, simulator.evaluations
    if score > best:
        best, best_claims = score, result.claims[at]
    joint: list[Schedules] = []
    while not stopped():
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
    return Hindsight(best, float(starts.reward[first]), best_claims, simulator.evaluations - begun, seconds)
