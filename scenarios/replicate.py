"""A policy on several seeds, and what each of its shifts came to.

Where arms hear each other at once, the shifts are stepped side by side in the batch; on any other channel one after the
other by the plain kernel. A test holds both together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np

from agents.policy import WAIT, only_choices
from fleet.bus.channel import PERFECT, Channel
from fleet.env.arguments import actions_of
from fleet.env.engine import Shift
from fleet.env.vector import BatchEnv, Library
from fleet.sim.state import DONE, State
from scenarios.batch import library_of
from scenarios.build import Fleet
from scenarios.policies import policy_at
from scenarios.run import RunSpec, run

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What is compared of a shift; `fleet.metrics.Metrics` says what the figures are."""

    reward: float
    """Summed over the shift."""
    value: float
    finished: float
    on_time: float
    faults: float
    above_warning_min: float
    peak_c: float
    """Of the hottest motor of the fleet."""
    availability: float


FIGURES = tuple(field.name for field in fields(Outcome))
"""What is compared, by name."""


def outcomes(fleet: Fleet, policy: str, seeds: Sequence[int], channel: Channel = PERFECT) -> list[Outcome]:
    """The figures of a policy on each seed, the same whatever the other seeds are."""
    if channel.perfect:
        return _side_by_side(fleet, policy, seeds)
    return one_by_one(fleet, policy, seeds, channel)


def one_by_one(fleet: Fleet, policy: str, seeds: Sequence[int], channel: Channel = PERFECT) -> list[Outcome]:
    """By `scenarios.run.run`: any channel, and slow."""
    found = []
    for seed in seeds:
        result = run(fleet, RunSpec(policy=policy, seed=seed, bus="memory", channel=channel), record=False)
        metrics = result.metrics
        found.append(
            Outcome(
                reward=result.total_reward,
                value=metrics.value,
                finished=metrics.finished,
                on_time=metrics.on_time,
                faults=metrics.faults,
                above_warning_min=metrics.above_warning_min,
                peak_c=max(metrics.peak_c.values()),
                availability=metrics.availability,
            )
        )
    return found


def _side_by_side(fleet: Fleet, policy: str, seeds: Sequence[int]) -> list[Outcome]:
    """In one batch, an env and a policy of its own for each seed."""
    library = _library(fleet)
    env = BatchEnv(library, len(seeds), seed=list(seeds), weights=fleet.scenario.reward, autoreset=False)
    policies = [policy_at(policy, seed) for seed in seeds]
    seldom = only_choices(policies[0])
    obs, _ = env.reset()
    reward, running = np.zeros(len(seeds)), np.ones(len(seeds), dtype=bool)
    found: dict[int, Outcome] = {}
    while running.any():
        vectors, mask = obs["observation"], obs["action_mask"]
        asked = running & mask[..., 1:].any(axis=(1, 2)) if seldom else running
        actions = np.full(mask.shape[:2], WAIT)
        for e in np.flatnonzero(asked).tolist():
            seen = {arm: env.layout.read(vectors[e, a], mask[e, a]) for a, arm in enumerate(env.agents)}
            actions[e] = actions_of(env.agents, policies[e].act(seen))
        obs, earned, finished, cut, _ = env.step(actions)
        reward += earned
        over = finished | cut
        if not over.any():
            continue
        state = env.state
        for e in np.flatnonzero(over & running).tolist():
            shift = library.draw(np.random.SeedSequence(int(seeds[e])))
            found[e] = _outcome(library, shift, state, e, float(reward[e]))
        running &= ~over
        if running.any():
            obs, _ = env.reset(rows=over)  # nobody is asked there any more
    return [found[e] for e in range(len(seeds))]


def _outcome(library: Library, shift: Shift, state: State, env: int, reward: float) -> Outcome:
    """Of one env of a batch at the end of its shift."""
    jobs = len(shift.kind)
    done = state.status[env, :jobs] == DONE
    time_s = state.tick[env] * library.tables.dt_s
    return Outcome(
        reward=reward,
        value=float(library.tables.value[shift.lot, shift.kind[done]].sum()),
        finished=int(done.sum()),
        on_time=int((state.finished_s[env, :jobs][done] <= shift.due_s[done]).sum()),
        faults=int(state.faults[env].sum()),
        above_warning_min=float(state.above_warning_s[env].sum() / 60.0),
        peak_c=float(state.peak_c[env].max()),
        availability=float(1.0 - state.lost_s[env].sum() / (time_s * len(library.arms))),
    )


@lru_cache(maxsize=1)
def _library(fleet: Fleet) -> Library:
    return library_of([fleet])
