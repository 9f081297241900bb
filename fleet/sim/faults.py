"""Limits of heat: the exact moments of warnings, faults and recoveries, and what follows from them."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fleet.events import Event, EventKind
from fleet.sim.state import RUNNING, WAITING, State, World
from fleet.telemetry import FAULTED, IDLE
from fleet.thermal import WINDING, ThermalModel, node_heat

Array = np.ndarray

TOLERANCE_S = 1e-10
"""How closely the moment of a crossing is found."""


@dataclass(frozen=True, eq=False)
class Leg:
    """A stretch of a step in which the heat of one arm is constant; times are seconds into the step."""

    model: ThermalModel
    temp_c: Array
    """At its beginning, [node]."""
    heat_w: Array
    """[node]."""
    ambient_c: float
    begin_s: float
    end_s: float

    def at(self, time_s: float) -> Array:
        """Temperatures at a moment of the leg, °C, [node]."""
        return self.model.step(self.temp_c, self.heat_w, self.ambient_c, time_s - self.begin_s)

    def crossing_s(self, limit_c: float) -> float:
        """When the hottest winding passes a limit that lies between its temperatures at both ends."""
        from scipy.optimize import root_scalar  # an arm's own process follows its plans and should start without it

        sign = 1.0 if hottest(self.temp_c) < limit_c else -1.0

        def past(moment_s: float) -> float:
            return sign * (float(hottest(self.at(moment_s))) - limit_c)

        if past(self.begin_s) >= 0.0:  # by rounding
            return self.begin_s
        found = root_scalar(past, bracket=(self.begin_s, self.end_s), method="brentq", xtol=TOLERANCE_S)
        return min(found.root + TOLERANCE_S, self.end_s)  # the limit is passed there


@dataclass(frozen=True, eq=False)
class Heating:
    """One thermal step of every arm: constant heat, and after a fault the brakes."""

    start_c: Array
    """[env, arm, node]."""
    heat_w: Array
    """Until the fault, [env, arm, node]."""
    ambient_c: Array
    """[env, arm]."""
    end_c: Array
    """[env, arm, node]."""
    cut_s: Array
    """Seconds each arm moved before a fault stopped it, [env, arm]; the whole interval if none did."""

    def legs(self, world: World, e: int, a: int) -> tuple[Leg, ...]:
        """The step of one arm: one leg, or one until the fault and one after it."""
        model, ambient_c, at = arm_model(world, a), float(self.ambient_c[e, a]), float(self.cut_s[e, a])
        moving = Leg(model, self.start_c[e, a], self.heat_w[e, a], ambient_c, 0.0, at)
        if at == world.dt_s:
            return (moving,)
        return moving, Leg(model, moving.at(at), braked_heat(world, a), ambient_c, at, world.dt_s)


def arm_model(world: World, arm: int) -> ThermalModel:
    """Thermal model of one arm, without leading axes."""
    m = world.thermal
    return ThermalModel(m.capacity[arm], m.laplacian[arm], m.to_ambient[arm], m.rates[arm], m.modes[arm])


def braked_heat(world: World, arm: int) -> Array:
    """Heat of an arm that stands faulted on its brakes, W, [node]: none if the drives are off."""
    idle_w = world.motors.idle_w[arm]
    return node_heat(np.zeros_like(idle_w), np.zeros_like(idle_w) if world.limits.power_off_on_fault else idle_w)


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


def brake(world: World, state: State, heating: Heating) -> Heating:
    """The same step with the brakes on, and the drives off if they go off, in arms that pass the error limit."""
    cut_s, end_c = heating.cut_s.copy(), heating.end_c.copy()
    too_hot = (hottest(heating.end_c) >= world.limits.error_c) & (state.mode != FAULTED)
    for e, a in np.argwhere(too_hot).tolist():
        (moving,) = heating.legs(world, e, a)
        hot_from_the_start = hottest(moving.temp_c) >= world.limits.error_c
        cut_s[e, a] = 0.0 if hot_from_the_start else moving.crossing_s(world.limits.error_c)
    heating = replace(heating, cut_s=cut_s, end_c=end_c)
    for e, a in np.argwhere(cut_s < world.dt_s).tolist():
        end_c[e, a] = heating.legs(world, e, a)[-1].at(world.dt_s)
    return heating


def account(world: World, state: State, heating: Heating, log: list[Event] | None) -> None:
    """Peaks, time above the warning limit, lost time, energy, and the warnings themselves."""
    limit, dt_s = world.limits.warning_c, world.dt_s
    first, last = hottest(heating.start_c), hottest(heating.end_c)
    above_s = np.where((first >= limit) & (last >= limit), dt_s, 0.0)
    state.energy_j[:] += heating.heat_w.sum(axis=-1) * heating.cut_s
    state.peak_c[:] = np.maximum(state.peak_c, last)
    state.lost_s[:] += np.where(state.mode == FAULTED, dt_s, 0.0)
    for e, a in np.argwhere(((first >= limit) != (last >= limit)) | (heating.cut_s < dt_s)).tolist():
        legs = heating.legs(world, e, a)
        above_s[e, a] = 0.0
        for leg in legs:
            begins, ends = bool(hottest(leg.temp_c) >= limit), bool(hottest(leg.at(leg.end_s)) >= limit)
            if begins == ends:
                above_s[e, a] += begins * (leg.end_s - leg.begin_s)
                continue
            at = leg.crossing_s(limit)
            above_s[e, a] += at - leg.begin_s if begins else leg.end_s - at
            if log is not None and ends:
                log.append(_passed(world, state, e, a, leg, at, "warning", limit))
        if len(legs) == 2:
            braked = legs[1]
            state.energy_j[e, a] += braked.heat_w.sum() * (braked.end_s - braked.begin_s)
            state.peak_c[e, a] = max(state.peak_c[e, a], float(hottest(braked.temp_c)))
    state.above_warning_s[:] += above_s


def _passed(world: World, state: State, e: int, a: int, leg: Leg, at: float, kind: EventKind, limit_c: float) -> Event:
    k = int(leg.at(at)[WINDING].argmax())
    text = f"motor {k + 1} passed {limit_c:g} °C"
    return event(world, state, e, a, at, kind, int(state.job[e, a]), joint=k + 1, value=limit_c, reason=text)


def fault(
    world: World,
    state: State,
    heating: Heating,
    cycle_starts_s: Array,
    cycle_s: Array,
    log: list[Event] | None,
) -> None:
    """Arms cut short fault: their job goes back to the queue with the cycles done kept, and they are lost.

    Args:
        cycle_starts_s: Time since leaving home at which the first cycle began, [env, arm].
        cycle_s: Length of one cycle, [env, arm].
    """
    for e, a in np.argwhere(heating.cut_s < world.dt_s).tolist():
        at, j = float(heating.cut_s[e, a]), int(state.job[e, a])
        if log is not None:
            moving = heating.legs(world, e, a)[0]
            log.append(_passed(world, state, e, a, moving, at, "fault", world.limits.error_c))
        if j >= 0 and state.status[e, j] == RUNNING:
            cycles = (state.progress_s[e, a] - cycle_starts_s[e, a]) // cycle_s[e, a]
            _return_job(world, state, e, a, j, int(np.clip(cycles, 0, state.todo[e, a])), at, log)
        state.faults[e, a] += 1
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
        cooling = heating.legs(world, e, a)[-1]
        at = cooling.begin_s if hottest(cooling.temp_c) < limit else cooling.crossing_s(limit)
        state.clear_at_s[e, a] = state.tick[e] * world.dt_s + at + world.limits.clear_s
    end_s = ((state.tick + 1) * world.dt_s)[:, None]
    for e, a in np.argwhere(faulted & (state.clear_at_s <= end_s)).tolist():
        offset_s = float(state.clear_at_s[e, a] - state.tick[e] * world.dt_s)
        state.lost_s[e, a] -= world.dt_s - offset_s
        if log is not None:
            text = f"every motor below {limit:g} °C and the fault cleared"
            log.append(event(world, state, e, a, offset_s, "recover", reason=text))
        state.mode[e, a], state.clear_at_s[e, a] = IDLE, np.inf
