"""Limits of heat: the exact moments of warnings, faults and recoveries, and what follows from them."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from fleet.events import Event, EventKind
from fleet.sim.state import FAULTED, IDLE, RUNNING, WAITING, State, World
from fleet.thermal import HOUSING, WINDING, ThermalModel, node_heat

Array = np.ndarray

BISECTIONS = 40
"""Halvings of a step to find a crossing: 10 s · 2⁻⁴⁰ ≈ 10 ps."""


@dataclass(frozen=True, eq=False)
class Heating:
    """One thermal step of every arm under constant heat."""

    start_c: Array
    """[env, arm, node]."""
    heat_w: Array
    """[env, arm, node]."""
    ambient_c: Array
    """[env, arm]."""
    end_c: Array
    """[env, arm, node]; rows of arms that fault are rewritten with the brakes on since then."""

    def crossing_s(self, world: World, e: int, a: int, limit_c: float) -> float:
        """When the hottest motor of one arm passes a limit within the step, s."""
        model = arm_model(world, a)
        return crossing_s(
            model, self.start_c[e, a], self.heat_w[e, a], float(self.ambient_c[e, a]), limit_c, world.dt_s
        )


def arm_model(world: World, arm: int) -> ThermalModel:
    """Thermal model of one arm, without leading axes."""
    m = world.thermal
    return ThermalModel(m.capacity[arm], m.laplacian[arm], m.to_ambient[arm], m.rates[arm], m.modes[arm])


def crossing_s(
    model: ThermalModel, temp_c: Array, heat_w: Array, ambient_c: float, limit_c: float, dt_s: float
) -> float:
    """When, within `dt_s`, the hottest winding of one arm passes a limit in the direction it is going, s.

    Args:
        model: One arm, no leading axes.
        temp_c, heat_w: [node].
    """
    rising = temp_c[WINDING].max() < limit_c
    low, high = 0.0, dt_s
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        above = model.step(temp_c, heat_w, ambient_c, middle)[WINDING].max() >= limit_c
        low, high = (low, middle) if above == rising else (middle, high)
    return high


def hottest(temp_c: Array) -> Array:
    """Temperature of the hottest motor, [...], from [..., node]."""
    return temp_c[..., WINDING].max(axis=-1)


def event(
    world: World, state: State, e: int, a: int, offset_s: float, kind: EventKind, job: int = -1, **more: Any
) -> Event:
    """An event `offset_s` into the step that the state is in; `a` and `job` −1 for none."""
    return Event(
        time_s=float(state.tick[e] * world.dt_s + offset_s),
        kind=kind,
        env=e,
        arm=world.arms[a] if a >= 0 else "",
        job=world.jobs.names[e][job] if job >= 0 else "",
        **more,
    )


def cut(world: World, state: State, heating: Heating) -> Array:
    """Seconds of the step each arm gets to move before a fault stops it, [env, arm]; the whole step if none does.

    Rewrites the end temperatures of the arms that fault: no motion, and no idle heat if the drives go off.
    """
    cut_s = np.full(state.mode.shape, world.dt_s)
    too_hot = (hottest(heating.end_c) >= world.limits.error_c) & (state.mode != FAULTED)
    for e, a in np.argwhere(too_hot).tolist():
        at = heating.crossing_s(world, e, a, world.limits.error_c)
        model, ambient_c = arm_model(world, a), float(heating.ambient_c[e, a])
        there = model.step(heating.start_c[e, a], heating.heat_w[e, a], ambient_c, at)
        idle_w = np.zeros(there[HOUSING].shape) if world.limits.power_off_on_fault else world.motors.idle_w[a]
        braked = node_heat(np.zeros_like(idle_w), idle_w)
        heating.end_c[e, a] = model.step(there, braked, ambient_c, world.dt_s - at)
        state.energy_j[e, a] += (braked - heating.heat_w[e, a]).sum() * (world.dt_s - at)
        cut_s[e, a] = at
    return cut_s


def account(world: World, state: State, heating: Heating, log: list[Event] | None) -> None:
    """Peaks, time above the warning limit, lost time, energy, and the warnings themselves."""
    limit = world.limits.warning_c
    first, last = hottest(heating.start_c), hottest(heating.end_c)
    above_s = np.where((first >= limit) & (last >= limit), world.dt_s, 0.0)
    for e, a in np.argwhere((first >= limit) != (last >= limit)).tolist():
        at = heating.crossing_s(world, e, a, limit)
        above_s[e, a] = at if first[e, a] >= limit else world.dt_s - at
        if log is not None and last[e, a] >= limit:
            k = int(heating.end_c[e, a, WINDING].argmax())
            text = f"motor {k + 1} passed {limit:g} °C"
            job = int(state.job[e, a])
            log.append(event(world, state, e, a, at, "warning", job, joint=k + 1, value=limit, reason=text))
    state.above_warning_s[:] += above_s
    state.peak_c[:] = np.maximum(state.peak_c, last)
    state.lost_s[:] += np.where(state.mode == FAULTED, world.dt_s, 0.0)
    state.energy_j[:] += heating.heat_w.sum(axis=-1) * world.dt_s


def fault(
    world: World,
    state: State,
    heating: Heating,
    cut_s: Array,
    cycle_starts_s: Array,
    cycle_s: Array,
    log: list[Event] | None,
) -> None:
    """Arms cut short fault: their job goes back to the queue with the cycles done kept, and they are lost.

    Args:
        cut_s: Of `cut`, [env, arm].
        cycle_starts_s: Time since leaving home at which the first cycle began, [env, arm].
        cycle_s: Length of one cycle, [env, arm].
    """
    limit = world.limits.error_c
    for e, a in np.argwhere(cut_s < world.dt_s).tolist():
        at, j = float(cut_s[e, a]), int(state.job[e, a])
        if log is not None:
            ambient_c = float(heating.ambient_c[e, a])
            there = arm_model(world, a).step(heating.start_c[e, a], heating.heat_w[e, a], ambient_c, at)
            k = int(there[WINDING].argmax())
            text = f"motor {k + 1} passed {limit:g} °C"
            log.append(event(world, state, e, a, at, "fault", j, joint=k + 1, value=limit, reason=text))
        if j >= 0 and state.status[e, j] == RUNNING:
            cycles = (state.progress_s[e, a] - cycle_starts_s[e, a]) // cycle_s[e, a]
            _return_job(world, state, e, a, j, int(np.clip(cycles, 0, state.todo[e, a])), at, log)
        state.faults[e, a] += 1
        state.peak_c[e, a] = max(state.peak_c[e, a], limit)
        state.lost_s[e, a] += world.dt_s - at
        state.mode[e, a], state.job[e, a], state.progress_s[e, a], state.todo[e, a] = FAULTED, -1, 0.0, 0


def _return_job(
    world: World, state: State, e: int, a: int, j: int, kept: int, at: float, log: list[Event] | None
) -> None:
    state.cycles[e, j] += kept
    state.status[e, j] = WAITING
    state.queued_s[e, j] = state.tick[e] * world.dt_s + at
    state.returns[e, j] += 1
    if log is not None:
        text = f"{state.cycles[e, j]} of {world.jobs.repetitions[e, j]} cycles kept"
        log.append(event(world, state, e, a, at, "return", j, value=float(kept), reason=text))


def recover(world: World, state: State, heating: Heating, log: list[Event] | None) -> None:
    """Faulted arms start again `clear_s` after every motor fell below the restart limit."""
    faulted = state.mode == FAULTED
    limit = world.limits.restart_c
    waiting = faulted & np.isinf(state.clear_at_s) & (hottest(heating.end_c) < limit)
    for e, a in np.argwhere(waiting).tolist():
        below = hottest(heating.start_c[e, a]) < limit
        at = 0.0 if below else heating.crossing_s(world, e, a, limit)
        state.clear_at_s[e, a] = state.tick[e] * world.dt_s + at + world.limits.clear_s
    end_s = ((state.tick + 1) * world.dt_s)[:, None]
    for e, a in np.argwhere(faulted & (state.clear_at_s <= end_s)).tolist():
        offset_s = float(state.clear_at_s[e, a] - state.tick[e] * world.dt_s)
        state.lost_s[e, a] -= world.dt_s - offset_s
        if log is not None:
            text = f"every motor below {limit:g} °C and the fault cleared"
            log.append(event(world, state, e, a, offset_s, "recover", reason=text))
        state.mode[e, a], state.clear_at_s[e, a] = IDLE, np.inf
