"""A policy on several seeds, the figures of each of its shifts, and a limit on the time of its decisions."""

import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from agents.policy import WAIT, PlanningPolicy, Policy, on_arrays, only_choices, reads_messages
from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.bus.exchange.memory import Exchange
from fleet.env.lookahead import CellSimulator
from fleet.env.validation import actions_of
from fleet.env.vector import BatchEnv, Obs
from scenarios.evaluate.statistics import FigureKind
from scenarios.policy_loader import OnBus, failure, is_ctrl_c, policy_at
from scenarios.prepare.batch import library_of
from scenarios.prepare.fleet import Fleet, as_known, simulator_of
from scenarios.run.metrics import HeatUse, common_figures
from scenarios.spec.jobs import weights_of
from scenarios.spec.options import DECISION_LIMIT_S

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Figures of a shift that are compared; see `scenarios.run.metrics.Metrics`."""

    reward: float
    """Summed over the shift."""
    value: float
    finished: float
    on_time: float
    faults: float
    above_warning_min: float
    peak_c: float
    """Temperature of the hottest motor of the fleet."""
    availability: float
    insulation_ppb: float
    """Billionths of the rated life that the most aged winding of the fleet used."""
    tool_drift_mm: float
    """Of the arm whose tool point drifted most."""
    hot_surface_min: float


KINDS = {
    "reward": FigureKind("reward", least=-math.inf),
    "value": FigureKind("value"),
    "finished": FigureKind("jobs finished", is_count=True),
    "on_time": FigureKind("jobs on time", is_count=True),
    "faults": FigureKind("faults", is_count=True),
    "above_warning_min": FigureKind("min above warning"),
    "peak_c": FigureKind("hottest motor, °C", least=-math.inf),
    "availability": FigureKind("availability, 0–1", digits=3, most=1.0),
    "insulation_ppb": FigureKind("insulation, ppb"),
    "tool_drift_mm": FigureKind("tool drift, mm", digits=2),
    "hot_surface_min": FigureKind("hot surface, min"),
}
"""The compared figures by their names in `Outcome`, in its order."""
FIGURES = tuple(KINDS)


@dataclass(frozen=True)
class ShiftResult:
    """One shift under a policy."""

    outcome: Outcome | None
    """None after an error."""
    illegal: int
    """Illegal actions of all arms; 0 after an error."""
    error: BaseException | None = None
    """What the policy raised, or why its actions could not be taken."""
    time_s: float = 0.0
    """Time of the error in the shift."""


def outcomes(fleet: Fleet, policy: str, seeds: Sequence[int], channel: Channel = PERFECT) -> list[Outcome]:
    """The figures of a policy on each seed, independent of the other seeds.

    Raises:
        PolicyFailed: a user-defined policy raised something, was slower than `DECISION_LIMIT_S`, or returned no action.
        Exception: of a built-in policy.
    """
    results = play(fleet, policy, seeds, channel, DECISION_LIMIT_S)
    for seed, result in zip(seeds, results, strict=True):
        if result.error is not None:
            where = f"{fleet.scenario.name}/{seed}, at {result.time_s:g} s of the shift"
            raise failure(policy, result.error, where) from result.error
    return [result.outcome for result in results if result.outcome is not None]


def play(
    fleet: Fleet,
    policy: str,
    seeds: Sequence[int],
    channel: Channel = PERFECT,
    limit_s: float | None = None,
) -> list[ShiftResult]:
    """The shift of each seed under a policy; an error of the policy ends its shift alone.

    The shifts are one batch, with an env, an exchange and a policy for each seed.

    Args:
        limit_s: Most time for a decision, s of real time.
    """
    library, channel = _library(fleet), fleet.scenario.channel(channel)
    running, time_s = np.ones(len(seeds), dtype=bool), np.zeros(len(seeds))
    results: dict[int, ShiftResult] = {}
    policies: dict[int, Policy] = {}
    limit, dt_s = DecisionLimit(limit_s), library.tables.dt_s

    @contextmanager
    def guarded(envs: Sequence[int]) -> Iterator[None]:
        try:
            with limit.decision():
                yield
        except BaseException as error:  # of the policy
            if is_ctrl_c(error):
                raise
            for e in envs:
                results[e], running[e] = ShiftResult(None, 0, error, float(time_s[e])), False

    def after_step(reward: Array, elapsed_s: Array, ended: Array) -> None:
        time_s[:] += elapsed_s
        if not ended.any():
            return
        state = env.state
        for e in np.flatnonzero(ended).tolist():
            shift = library.draw(np.random.SeedSequence(int(seeds[e])))
            value = library.tables.value[shift.fleet, shift.kind]
            heat = HeatUse(start_c[e], fleet.scenario.people.burn_c)
            heat.add(env.path_c[e, : state.tick[e]], dt_s)
            found = Outcome(
                **common_figures(state, e, value, shift.due_s, dt_s),
                reward=float(reward[e]),
                peak_c=float(state.peak_c[e].max()),
                insulation_ppb=float(heat.insulation_ppb.max()),
                tool_drift_mm=float(heat.tool_drift_mm.max()),
                hot_surface_min=float(heat.hot_surface_min.sum()),
            )
            results[e] = ShiftResult(found, int(state.illegal[e].sum()))

    with limit.watching():
        for e, seed in enumerate(seeds):
            with guarded([e]):
                policies[e] = policy_at(policy, seed, OnBus(fleet=fleet.scenario.name))
        messages, at_once = any(reads_messages(each) for each in policies.values()), channel.perfect
        if not messages:
            channel = PERFECT
        waits = channel.perfect and all(only_choices(each) for each in policies.values())
        env = BatchEnv(
            library,
            len(seeds),
            seed=list(seeds),
            weights=weights_of(fleet.scenario),
            autoreset=False,
            exchanges=None if channel.perfect else [Exchange(library.arms, channel) for _ in seeds],
            decisions="events" if waits else "interval",
            scaled=False,
            ahead_s=np.inf,
            bids=messages,
            keep_path=True,
            shares_heat=at_once,
        )
        obs, _ = env.reset()
        start_c = env.temp_c.copy()
        for e, each in policies.items():
            if isinstance(each, PlanningPolicy):
                cell = env.lookahead(_simulator(fleet), e)  # may compile, which is no time of the policy
                with guarded([e]):
                    each.plan_in(cell)
        rollout(env, obs, acts_of(env, policies, guarded), running=running, after_step=after_step)
    policies.clear()  # the traceback of an error keeps this frame, and a policy may have an open connection
    return [results[e] for e in range(len(seeds))]


Act = Callable[[Obs, Array], Array]
"""Actions, int [env, arm], of what the arms know and of the envs whose shift goes on, bool [env]."""
AfterStep = Callable[[Array, Array, Array], None]
"""What is done after a step, with the reward so far [env], the length of the step, s, [env], and the envs whose shift
ended in it, bool [env]."""


def rollout(
    env: BatchEnv, obs: Obs, act: Act, *, running: Array | None = None, after_step: AfterStep | None = None
) -> Array:
    """Total reward of a shift of each env, [env].

    Args:
        obs: Of the reset that began the shifts.
        running: Envs whose shift is played, bool [env]; one that `act` makes False in it ends early. Default: all.
    """
    reward, running = np.zeros(env.num_envs), np.ones(env.num_envs, dtype=bool) if running is None else running
    while running.any():
        obs, earned, terminated, truncated, info = env.step(act(obs, running))
        over = terminated | truncated
        reward += np.where(running, earned, 0.0)
        if after_step:
            after_step(reward, info["elapsed_s"], over & running)
        running &= ~over
        if over.any() and running.any() and not env.autoreset:
            obs, _ = env.reset(rows=over)
    return reward


def acts_of(
    env: BatchEnv,
    policies: Mapping[int, Policy],
    guarded: Callable[[Sequence[int]], AbstractContextManager[None]] = lambda envs: nullcontext(),
) -> Act:
    """The actions of one policy of a kind for each env; those that want to choose only are asked if there is a choice.

    Args:
        policies: By env, each at the beginning of its shift.
        guarded: Context of the decisions of some envs: of one, or of all if the policy decides on arrays.
    """
    only_when_asked = bool(policies) and only_choices(next(iter(policies.values())))
    together = on_arrays(policies, env.agents)

    def act(obs: Obs, running: Array) -> Array:
        mask = obs["action_mask"]
        asked = running & mask[..., 1:-1].any(axis=(1, 2)) if only_when_asked else running
        actions, envs = np.full(mask.shape[:2], WAIT), np.flatnonzero(asked)
        if together and len(envs):
            with guarded(envs.tolist()):
                actions[envs] = together(envs, env.layout.read_parts(obs["shared"][envs], obs["own"][envs], mask[envs]))
            return actions
        for e in envs.tolist():
            with guarded([e]):
                known = env.layout.read_each(env.agents, obs["shared"][e], obs["own"][e], mask[e])
                actions[e] = actions_of(env.agents, policies[e].act(known))
        return actions

    return act


_library = lru_cache(maxsize=1)(library_of)


@lru_cache(maxsize=1)
def _simulator(fleet: Fleet) -> CellSimulator:
    return simulator_of(fleet, library_of(as_known(fleet)).tables)


AGAIN_S = 1.0
"""An alarm is repeated, in case the policy catches the first one."""
MOST_CAUGHT = 5
"""Alarms of one decision that a policy may catch; at the next one the process ends."""


class TooSlow(BaseException):
    """A decision took too long; no `Exception`, so that a policy does not catch it by accident."""


class DecisionLimit:
    """Ends decisions that take longer than `limit_s`, s of real time; None for no limit.

    In the main thread of a process an alarm interrupts Python code. Elsewhere, and in libraries that do not return, a
    decision is only found too slow when it ends. A policy that catches every alarm can be ended only with its process.
    """

    def __init__(self, limit_s: float | None) -> None:
        self.limit_s = limit_s
        self._rung = 0
        self._alarm = limit_s is not None and hasattr(signal, "setitimer")
        self._alarm = self._alarm and threading.current_thread() is threading.main_thread()

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Take the alarm of the process until the end of the block."""
        if not self._alarm:
            yield
            return
        before = signal.signal(signal.SIGALRM, self._ring)
        try:
            yield
        finally:
            signal.signal(signal.SIGALRM, before)

    @contextmanager
    def decision(self) -> Iterator[None]:
        """Limit the block.

        Raises:
            TooSlow: it took too long.
        """
        if self.limit_s is None:
            yield
            return
        began_s, self._rung = time.monotonic(), 0
        if self._alarm:
            signal.setitimer(signal.ITIMER_REAL, self.limit_s, AGAIN_S)
        try:
            yield
        finally:
            if self._alarm:
                signal.setitimer(signal.ITIMER_REAL, 0.0)
        if time.monotonic() - began_s > self.limit_s:
            self._ring()

    def _ring(self, *_: object) -> None:
        self._rung += 1
        if self._rung > MOST_CAUGHT:
            text = f"A decision took longer than {self.limit_s:g} s, and the policy catches what should end it; "
            os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, f"{text}its process ends.\n".encode())
            os._exit(1)
        raise TooSlow(f"a decision took longer than {self.limit_s:g} s (--decision-limit)")


UNLIMITED = DecisionLimit(None)
