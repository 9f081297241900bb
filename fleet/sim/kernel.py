"""One step of the shift, for any number of envs: claims, motion, heat, faults, recovery.

Pure: a new state comes out, the old one is untouched. Heat is constant over a step (the mean of what the motors
do in it, with loss from the temperatures at its start) and the thermal step is exact for it, so the moments at
which a limit is passed are exact too.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fleet.events import Event
from fleet.motion import Drive
from fleet.sim import claims, faults
from fleet.sim.claims import Board
from fleet.sim.faults import Heating, event
from fleet.sim.state import DONE, RUNNING, State, World
from fleet.telemetry import FAULTED, IDLE, WORKING, Telemetry
from fleet.thermal import HOUSING, drive_heat

Array = np.ndarray

ROUNDING_S = 1e-9
"""Sums of phases may be this much off; a whole step must not be lost to it."""


@dataclass(frozen=True, eq=False)
class Timeline:
    """How each arm spends a step."""

    spans_s: Array
    """Seconds in approach, cycle, retreat and rest, [env, arm, 4]; all zero while faulted."""
    plan: Array
    """Row of the plan table in hand, int [env, arm]; 0 where there is none."""
    starts_s: Array
    """When each phase begins, in time since leaving home, [env, arm, phase]."""
    done_s: Array
    """Seconds into the step at which the job is finished, [env, arm]; inf if not in it."""
    home_s: Array
    """Seconds into the step at which the arm is free again; inf if not in it."""


@dataclass(frozen=True, eq=False)
class Step:
    """What one call of `step` gives."""

    state: State
    """After the decision interval."""
    began: State
    """At its beginning, with the awards made."""
    path: Timeline
    heating: Heating

    @property
    def cut_s(self) -> Array:
        """Seconds each arm moved before a fault stopped it, [env, arm]; the whole interval if none did."""
        return self.heating.cut_s


class Plant(Protocol):
    """Moves the arms and says what their motors did."""

    def drive(self, world: World, state: State, timeline: Timeline) -> Drive:
        """Mean heat drive over the step, each [env, arm, joint]."""
        ...

    def readings(self, world: World, step: "Step", offsets_s: Array, rng: np.random.Generator) -> Telemetry:
        """What the sensors of env 0 said at moments of the step just driven, s into it, [sample], in (0, dt_s]."""
        ...


def timeline(world: World, state: State) -> Timeline:
    """Which phases of its plan each arm passes through in the coming step."""
    working = state.mode == WORKING
    env, arm = np.indices(state.job.shape)
    plan = np.where(working, world.offers.plan[env, arm, state.job], 0)
    lengths = world.plans.times_s[plan].copy()
    lengths[..., 1] *= state.todo
    ends = np.cumsum(lengths, axis=-1)
    starts = ends - lengths
    begin = state.progress_s[..., None]
    spans = np.clip(np.minimum(begin + world.dt_s, ends) - np.maximum(begin, starts), 0.0, None)
    spans = np.where(working[..., None], spans, 0.0)
    rest = np.where(state.mode == FAULTED, 0.0, world.dt_s - spans.sum(axis=-1))
    running = working & (state.status[env, state.job] == RUNNING)
    done, home = np.moveaxis(_within(ends[..., 1:] - begin, world.dt_s), -1, 0)
    return Timeline(
        spans_s=np.concatenate([spans, rest[..., None]], axis=-1),
        plan=plan,
        starts_s=starts,
        done_s=np.where(running, done, np.inf),
        home_s=np.where(working, home, np.inf),
    )


def _within(time_s: Array, dt_s: float) -> Array:
    """Moments of a step, inf where later; what rounding puts a hair behind its end counts as its end."""
    return np.where(time_s <= dt_s + ROUNDING_S, np.clip(time_s, 0.0, dt_s), np.inf)


def step(
    world: World,
    before: State,
    actions: Array,
    scores: Array,
    plant: Plant,
    log: list[Event] | None = None,
    board: Board | None = None,
) -> Step:
    """One decision interval: the state after it, and how it went.

    Args:
        actions: 0 waits or goes on, k claims slot k, int [env, arm].
        scores: Shared difficulty by which two claims for one job are settled, [env, arm, slot].
        log: Takes an `Event` for everything that happens, if given.
        board: `claims.board(world, before)`, if it is at hand.
    """
    state = before.copy()
    _award(world, state, claims.resolve(world, state, board or claims.board(world, state), actions, scores), log)
    path, began = timeline(world, state), state.copy()
    heat_w = heat_of(world, state, plant.drive(world, state, path))
    heating = faults.brake(world, state, warm(world, state, heat_w))
    faults.account(world, state, heating, log)
    state.busy_s[:] += np.minimum(path.spans_s[..., :3].sum(axis=-1), heating.cut_s)
    state.temp_c[:] = heating.end_c
    _finish(world, state, path, heating.cut_s, log)
    faults.fault(world, state, heating, path.starts_s[..., 1], world.plans.times_s[path.plan, 1], log)
    faults.recover(world, state, heating, log)
    _log_releases(world, state, log)
    state.tick[:] += 1
    return Step(state=state, began=began, path=path, heating=heating)


def warm(world: World, state: State, heat_w: Array) -> Heating:
    """Temperatures after the step if nothing cuts it short."""
    ambient_c = world.ambient_c[np.minimum(state.tick, world.ticks - 1)]
    load = heat_w + world.thermal.to_ambient * ambient_c[..., None]
    # einsum, not matmul: a row's result must not depend on how many rows there are.
    end_c = np.einsum("aij,eaj->eai", world.phi, state.temp_c) + np.einsum("aij,eaj->eai", world.gamma, load)
    whole = np.full(state.mode.shape, world.dt_s)
    return Heating(start_c=state.temp_c.copy(), heat_w=heat_w, ambient_c=ambient_c, end_c=end_c, cut_s=whole)


def heat_of(world: World, state: State, drive: Drive) -> Array:
    """Heat into every node, W, [env, arm, node], from what the motors do and their temperatures now."""
    heat_w = drive_heat(state.temp_c, drive.current_sq, drive.friction_w, world.motors)
    if world.limits.power_off_on_fault:
        heat_w[..., HOUSING] -= np.where((state.mode == FAULTED)[..., None], world.motors.idle_w, 0.0)
    return heat_w


def _award(world: World, state: State, outcome: claims.Claims, log: list[Event] | None) -> None:
    env, arm = np.nonzero(outcome.won >= 0)
    job = outcome.won[env, arm]
    state.mode[env, arm] = WORKING
    state.job[env, arm] = job
    state.progress_s[env, arm] = 0.0
    state.todo[env, arm] = world.jobs.repetitions[env, job] - state.cycles[env, job]
    state.status[env, job] = RUNNING
    state.illegal[:] += outcome.illegal
    claimed = outcome.wanted >= 0
    state.last_award[:] = np.where(claimed, np.where(outcome.won >= 0, 1, -1), 0)
    if log is None:
        return
    for e, a in zip(env.tolist(), arm.tolist(), strict=True):
        j = int(outcome.won[e, a])
        score = float(world.offers.difficulty[e, a, j])
        log.append(event(world, state, e, a, 0.0, "award", j, value=score))
        _warn_of_torque(world, state, e, a, j, log)
    for e, a in np.argwhere(outcome.lost).tolist():
        j = int(outcome.wanted[e, a])
        log.append(event(world, state, e, a, 0.0, "lost", j, reason="another arm claimed it or its station"))
    for e, a in np.argwhere(outcome.illegal).tolist():
        log.append(event(world, state, e, a, 0.0, "illegal", reason="action outside the mask: a wait"))


def _warn_of_torque(world: World, state: State, e: int, a: int, j: int, log: list[Event]) -> None:
    peak = world.plans.peak_tau[world.offers.plan[e, a, j]]
    over = peak - world.torque_warning
    if (over > 0).any():
        k = int(over.argmax())
        text = f"joint {k + 1} reaches {peak[k]:.1f} N·m, warning at {world.torque_warning[k]:.1f}"
        log.append(event(world, state, e, a, 0.0, "torque_warning", j, joint=k + 1, value=float(peak[k]), reason=text))


def _finish(world: World, state: State, path: Timeline, cut_s: Array, log: list[Event] | None) -> None:
    for e, a in np.argwhere(path.done_s <= cut_s).tolist():
        j, at = int(state.job[e, a]), float(path.done_s[e, a])
        state.status[e, j] = DONE
        state.cycles[e, j] = world.jobs.repetitions[e, j]
        state.finished_s[e, j] = state.tick[e] * world.dt_s + at
        if log is not None:
            late = max(0.0, float(state.finished_s[e, j] - world.jobs.due_s[e, j]))
            text = f"late by {late:.0f} s" if late else "on time"
            log.append(event(world, state, e, a, at, "finish", j, value=late, reason=text))
    state.progress_s[:] += np.where(state.mode == WORKING, cut_s, 0.0)
    for e, a in np.argwhere(path.home_s <= cut_s).tolist():
        if log is not None:
            log.append(event(world, state, e, a, float(path.home_s[e, a]), "home", int(state.job[e, a])))
        state.mode[e, a], state.job[e, a], state.progress_s[e, a], state.todo[e, a] = IDLE, -1, 0.0, 0


def _log_releases(world: World, state: State, log: list[Event] | None) -> None:
    if log is None:
        return
    start = (state.tick * world.dt_s)[:, None]
    release = world.jobs.release_s
    # The first step also takes what was there from the beginning.
    fresh = world.jobs.exists & (release <= start + world.dt_s) & ((release > start) | ((start == 0) & (release == 0)))
    for e, j in np.argwhere(fresh).tolist():
        log.append(event(world, state, e, -1, float(release[e, j] - start[e, 0]), "release", j))
