"""A policy on several seeds, and the figures of each of its shifts."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np

from agents.policy import WAIT, only_choices
from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.bus.exchange.memory import MemoryExchange
from fleet.engine.batch import Shift
from fleet.engine.state import DONE, State
from fleet.env.validation import actions_of
from fleet.env.vector import BatchEnv, Library
from scenarios.policy_loader import policy_at
from scenarios.prepare.fleet import Fleet
from scenarios.run.batch import library_of

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What is compared of a shift; `fleet.metrics.Metrics` describes the figures."""

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
"""Names of what is compared."""


def outcomes(fleet: Fleet, policy: str, seeds: Sequence[int], channel: Channel = PERFECT) -> list[Outcome]:
    """The figures of a policy on each seed, the same whatever the other seeds are.

    One batch: an env, an exchange and a policy of its own for each seed.
    """
    library = _library(fleet)
    exchanges = None if channel.perfect else [MemoryExchange(library.arms, channel) for _ in seeds]
    env = BatchEnv(
        library,
        len(seeds),
        seed=list(seeds),
        weights=fleet.scenario.reward,
        autoreset=False,
        exchanges=exchanges,
    )
    policies = [policy_at(policy, seed) for seed in seeds]
    only_when_asked = only_choices(policies[0])
    obs, _ = env.reset()
    reward, running = np.zeros(len(seeds)), np.ones(len(seeds), dtype=bool)
    results: dict[int, Outcome] = {}
    while running.any():
        vectors, mask = obs["observation"], obs["action_mask"]
        asked = running & mask[..., 1:].any(axis=(1, 2)) if only_when_asked else running
        actions = np.full(mask.shape[:2], WAIT)
        for e in np.flatnonzero(asked).tolist():
            known = {arm: env.layout.read(vectors[e, a], mask[e, a]) for a, arm in enumerate(env.agents)}
            actions[e] = actions_of(env.agents, policies[e].act(known))
        obs, earned, finished, cut, _ = env.step(actions)
        reward += earned
        over = finished | cut
        if not over.any():
            continue
        state = env.state
        for e in np.flatnonzero(over & running).tolist():
            shift = library.draw(np.random.SeedSequence(int(seeds[e])))
            results[e] = _outcome(library, shift, state, e, float(reward[e]))
        running &= ~over
        if running.any():
            obs, _ = env.reset(rows=over)  # these envs are not asked any more
    return [results[e] for e in range(len(seeds))]


def _outcome(library: Library, shift: Shift, state: State, env: int, reward: float) -> Outcome:
    """The figures of one env of a batch at the end of its shift."""
    jobs = len(shift.kind)
    done = state.status[env, :jobs] == DONE
    time_s = state.tick[env] * library.tables.dt_s
    return Outcome(
        reward=reward,
        value=float(library.tables.value[shift.fleet, shift.kind[done]].sum()),
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
