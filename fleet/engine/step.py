"""One step of many envs: claims, then motion, heat, limits and the end of jobs of their arms, then what they observe.

Heat is constant over a step (the mean of what the motors do in it, with losses from the temperatures at its start) and
the thermal step is exact for it, so the moments at which a limit is crossed are exact too. A row's result does not
depend on how many rows there are.

Temperatures are float32 (8·10⁻⁶ K at 75 °C); moments, progress and totals are float64.
"""

from typing import NamedTuple

import numpy as np

from fleet.engine.claims import (
    cycles_begun,
    give_up,
    pass_over,
    resolve_claims,
    return_to_queue,
    set_phase,
    update_offers,
)
from fleet.engine.corrections import compare, line_of
from fleet.engine.crossings import Crossed, hottest, step_with_crossing
from fleet.engine.observe import observe
from fleet.engine.state import BROKEN, DONE, FINISH_CYCLE, GIVEN_UP, LANES, WAITING, State
from fleet.engine.tables import (
    BREAK,
    BREAK_END,
    FAILURE,
    FAULT,
    FINISH,
    GIVE_BACK,
    GIVE_UP,
    HOME,
    MOVED,
    RECOVER,
    RETURN,
    WARNING,
    WIDE,
    Simulation,
    Tables,
    record_event,
)
from fleet.heat.motor import magnet_factor, winding_heat
from fleet.heat.thermal import NODES
from fleet.jit import Real, jit, jit_inline, jit_lean, kernel, nonnegative
from fleet.job import MOST_FAULTS
from fleet.robot import JOINTS
from fleet.telemetry import FAULTED, IDLE, WORKING

Array = np.ndarray

TOTAL, FINISHED, JOBS_DONE, TICK, OUTCOME = range(5, 10)
"""Columns of an outcome after the five reward terms: their sum, whether all jobs are done, how many, and decision
intervals that are over; and the number of all columns."""
ROUNDING_S = 1e-9
"""Sums of phases may be off by this much; a whole step must not be lost to it."""
NEVER = np.iinfo(np.int32).max
_HALF, _ZERO = np.float32(0.5), np.float32(0.0)


class Spent(NamedTuple):
    """What an arm does in a step, unless a fault stops it."""

    away_s: Real
    """Seconds away from home."""
    done_s: float
    """When its job is done; inf if not in this step."""
    home_s: float
    """When it is home; inf if not in this step."""


@jit_inline
def step_arms(sim: Simulation, terms: Array, rows: Array) -> None:
    """Take every arm of some envs through one step.

    Args:
        terms: Outcomes, [env, OUTCOME], to whose reward terms those of the step are added.
        rows: Envs, int [row].
    """
    t, s, dt_s = sim.tables, sim.state, sim.tables.dt_s
    tracing, measured = len(sim.trace) > 0, len(sim.drive) > 0
    current_sq, friction_w, load_w = sim.room.lanes[0], sim.room.lanes[1], sim.room.lanes[2]
    begin, end, modal = sim.room.begin, sim.room.end, sim.room.modal
    for row in rows:
        e = nonnegative(row)
        env = s.env[e]
        fleet, moment = nonnegative(env["fleet"]), nonnegative(min(env["tick"], t.ticks - 1))
        above_s = energy_j = 0.0
        env["alarm"] = False
        for a in range(nonnegative(s.arms.shape[1])):
            arm, law, mode = s.arms[e, a], t.law[fleet, a], s.arms[e, a]["mode"]
            ambient_c = np.float32(t.ambient_c[fleet, moment, a] + env["ambient_offset_k"])
            powered = mode != FAULTED or not t.power_off
            spent = Spent(dt_s if mode == WORKING else 0.0, np.inf, np.inf)
            for k in range(LANES):
                current_sq[k], friction_w[k] = arm["current_sq"][k], arm["friction_w"][k]
            next_phase = arm["progress_s"] + dt_s >= arm["phase_end_s"] - ROUNDING_S
            if next_phase:
                spent = mix_phases(t.plans, t.start[fleet, a], arm, dt_s, current_sq, friction_w)
            if measured:
                for k in range(LANES):
                    current_sq[k], friction_w[k] = sim.drive[e, a]["current_sq"][k], sim.drive[e, a]["friction_w"][k]
            heat_w = load_nodes(t, law, arm["temp_c"], current_sq, friction_w, powered, ambient_c, begin)
            advance(law, begin, end)
            first_c, last_c = hottest(begin), hottest(end)
            hot = first_c >= t.warning_c
            crossed = Crossed(dt_s, dt_s if hot else 0.0, heat_w * dt_s, np.float64(last_c), np.inf, np.inf, -1, -1)
            if tracing:
                trace_arm(t, sim.trace[e, a], law, arm, current_sq, friction_w, powered, spent.home_s)
            at_limit = mode == FAULTED or last_c >= t.error_c or hot != (last_c >= t.warning_c)
            if at_limit:
                crossed = step_with_crossing(t, t.modal[fleet, a], mode, begin, heat_w, ambient_c, end, modal)
                env["alarm"] = env["alarm"] or (mode == WORKING and not hot and hottest(end) >= t.warning_c)
            for n in range(NODES):
                arm["temp_c"][n] = end[n]
            drift_k = law["drift_k_per_s"] * np.float32(env["tick"] * dt_s)
            offset_k = line_of(sim.moments[e, a])[1] if t.learns else _ZERO
            follow_housings(law, arm, begin, end, friction_w, powered, ambient_c, drift_k - offset_k, load_w)
            if t.learns:
                compare_temperatures(sim, e, a, current_sq, friction_w, powered, ambient_c, drift_k, begin, end)
            arm["energy_j"] += crossed.energy_j
            arm["above_warning_s"] += crossed.above_s
            arm["peak_c"] = max(arm["peak_c"], np.float32(crossed.peak_c))
            above_s += crossed.above_s
            energy_j += crossed.energy_j
            if mode == WORKING:
                arm["busy_s"] += min(spent.away_s, crossed.cut_s)
            if next_phase or at_limit:
                settle(sim, terms, e, a, spent, crossed)
            elif mode == WORKING:
                arm["progress_s"] += dt_s
        terms[e, 2] += above_s * sim.weights[2]
        terms[e, 4] += energy_j * sim.weights[4]
        terms[e, TOTAL] = terms[e, 0] + terms[e, 1] + terms[e, 2] + terms[e, 3] + terms[e, 4]
        env["tick"] += 1


@jit
def mix_phases(plans: Array, home: Array, arm: Array, dt_s: float, current_sq: Array, friction_w: Array) -> Spent:
    """Find the mean heat drive of an arm at work that changes phases within a step.

    Args:
        home: The arm at home, with the drive of standing there.
        current_sq: Receives the mean squared current, A², [lane].
        friction_w: Receives the mean friction heat, W, [lane].
    """
    plan, begin_s = plans[nonnegative(arm["plan"])], arm["progress_s"]
    until_s, first_s = begin_s + dt_s, plan["times_s"][0]
    last_s = first_s + plan["times_s"][1] * arm["todo"]
    back_s = last_s + plan["times_s"][2]
    span_0 = max(min(until_s, first_s) - begin_s, 0.0)
    span_1 = max(min(until_s, last_s) - max(begin_s, first_s), 0.0)
    span_2 = max(min(until_s, back_s) - max(begin_s, last_s), 0.0)
    away_s, done_s, home_s = span_0 + span_1 + span_2, np.inf, np.inf
    if arm["pending"] and last_s - begin_s <= dt_s + ROUNDING_S:
        done_s = min(max(last_s - begin_s, 0.0), dt_s)
    if back_s - begin_s <= dt_s + ROUNDING_S:
        home_s = min(max(back_s - begin_s, 0.0), dt_s)
    share_0, share_1, share_2, rest = span_0 / dt_s, span_1 / dt_s, span_2 / dt_s, (dt_s - away_s) / dt_s
    sq, w = plan["current_sq"], plan["friction_w"]
    for k in range(LANES):
        current_sq[k] = (share_0 * sq[0, k] + share_1 * sq[1, k]) + (share_2 * sq[2, k] + rest * home["current_sq"][k])
        friction_w[k] = (share_0 * w[0, k] + share_1 * w[1, k]) + (share_2 * w[2, k] + rest * home["friction_w"][k])
    return Spent(away_s, done_s, home_s)


@jit_inline
def load_nodes(
    t: Tables,
    law: Array,
    temp_c: Array,
    current_sq: Array,
    friction_w: Array,
    powered: bool,
    ambient_c: Real,
    begin: Array,
) -> float:
    """Put temperatures of nodes and the loads at them into `begin`; return the heat, W.

    The load of a node is its heat plus its conductance to ambient times the ambient temperature.
    """
    heat_w = 0.0
    for k in range(JOINTS):
        copper_w, housing_w = heat_of(t, law, temp_c, k, current_sq[k], friction_w[k], powered)
        begin[k], begin[JOINTS + k] = temp_c[k], temp_c[JOINTS + k]
        begin[NODES + k] = np.float32(copper_w) + law["to_ambient"][k] * ambient_c
        begin[NODES + JOINTS + k] = np.float32(housing_w) + law["to_ambient"][JOINTS + k] * ambient_c
        heat_w += copper_w + housing_w
    return heat_w


@jit_inline
def heat_of(
    t: Tables, law: Array, temp_c: Array, k: int, current_sq: float, friction_w: float, powered: bool
) -> tuple[float, float]:
    """Heat in the winding and in the housing of a joint, W; see `fleet.heat.thermal.drive_heat`."""
    factor = magnet_factor(np.float64(temp_c[JOINTS + k]), t)
    warm_sq, winding_c = np.float64(current_sq) / (factor * factor), np.float64(temp_c[k])
    copper_w = winding_heat(np.float64(law["copper_w_per_a2"][k]), warm_sq, winding_c, t)
    return copper_w, np.float64(friction_w) + (np.float64(law["idle_w"][k]) if powered else 0.0)


@jit_inline
def advance(law: Array, begin: Array, end: Array) -> None:
    """Exact step of the thermal network under constant loads: T + (Φ − 1) T + Γ load; see `fleet.heat.thermal.advance`.

    The change is summed, not the temperature, so that rounding to float32 is of the change.
    """
    for m in range(WIDE):
        total = _ZERO
        for n in range(2 * NODES):
            total += law["step"][n, m] * begin[n]
        end[m] = begin[m] + total


@jit_inline
def follow_housings(
    law: Array,
    arm: Array,
    begin: Array,
    end: Array,
    friction_w: Array,
    powered: bool,
    ambient_c: Real,
    drift_k: Real,
    load_w: Array,
) -> None:
    """Step the arm's own estimate of its housings, from its motor temperatures; see `HousingObserver`.

    The noise of the sensors is left out: over the time constants of housings it averages out to a tenth.

    Args:
        begin, end: Temperatures of the network, which are overwritten.
        drift_k: By which readings of the motors have drifted, less the offset that the arm has found.
        load_w: Room for the loads of the housings, [lane].
    """
    for k in range(JOINTS):
        winding_c = _HALF * (begin[k] + end[k]) + drift_k
        warmed_w = winding_c * law["housing_winding"][k] + law["housing_ambient"][k] * ambient_c
        load_w[k] = warmed_w + (friction_w[k] + (law["housing_idle_w"][k] if powered else _ZERO))
        begin[k] = arm["housing_c"][k]
    for m in range(len(load_w)):  # a number that the compiler does not know, so that it does not unroll
        total = _ZERO
        for k in range(JOINTS):
            total += law["housing_keep"][k, m] * begin[k] + law["housing_gain"][k, m] * load_w[k]
        end[m] = total
    for m in range(JOINTS):
        arm["housing_c"][m] = end[m]


@jit
def compare_temperatures(
    sim: Simulation,
    e: int,
    a: int,
    current_sq: Array,
    friction_w: Array,
    powered: bool,
    ambient_c: Real,
    drift_k: Real,
    begin: Array,
    end: Array,
) -> None:
    """Step the temperatures that an arm assumes, and compare those of its motors with what it measures.

    The noise of the sensors is left out, as in `follow_housings`.

    Args:
        begin, end: Room for temperatures and loads of the network.
    """
    t, assumed_c, temp_c = sim.tables, sim.assumed_c[e, a], sim.state.arms[e, a]["temp_c"]
    law = t.believed[nonnegative(sim.state.env[e]["fleet"]), a]
    load_nodes(t, law, assumed_c, current_sq, friction_w, powered, ambient_c, begin)
    advance(law, begin, end)
    for n in range(NODES):
        assumed_c[n] = end[n]
    compare(sim.moments[e, a], end, temp_c, drift_k, ambient_c, t.dt_s)


@jit
def trace_arm(
    t: Tables,
    trace: Array,
    law: Array,
    arm: Array,
    current_sq: Array,
    friction_w: Array,
    powered: bool,
    home_s: float,
) -> None:
    """Record how an arm begins a step, and that no fault stops it; see `TRACE`."""
    trace["mode"], trace["plan"], trace["todo"] = arm["mode"], arm["plan"], arm["todo"]
    trace["progress_s"], trace["home_s"], trace["cut_s"] = arm["progress_s"], home_s, t.dt_s
    for n in range(NODES):
        trace["start_c"][n] = arm["temp_c"][n]
    for k in range(JOINTS):
        heat_w = heat_of(t, law, arm["temp_c"], k, current_sq[k], friction_w[k], powered)
        trace["heat_w"][k], trace["heat_w"][JOINTS + k] = heat_w


@jit_inline
def settle(sim: Simulation, terms: Array, e: int, a: int, spent: Spent, crossed: Crossed) -> None:
    """Let an arm end its job, come home, fault and recover, where that happens in this step."""
    t, s, events, recording = sim.tables, sim.state, sim.events, len(sim.events.what) > 0
    arm, mode, cut_s = s.arms[e, a], s.arms[e, a]["mode"], crossed.cut_s
    if len(sim.trace) > 0:
        sim.trace[e, a]["cut_s"] = cut_s
    if recording and crossed.warned_s < np.inf:
        record_event(events, WARNING, e, a, arm["job"], crossed.warned_joint, crossed.warned_s, t.warning_c)
    if mode == WORKING:
        if spent.done_s <= cut_s:
            end_job(sim, terms, e, a, spent.done_s)
        arm["progress_s"] += cut_s
        if t.learns and arm["job"] >= 0:
            keep_excess(sim, e, a)
        if spent.home_s <= cut_s:
            if recording:
                record_event(events, HOME, e, a, arm["job"], -1, spent.home_s, 0.0)
            stand_at_home(s, arm, t.start[s.env[e]["fleet"], a], e, IDLE)
            arm["job"], arm["kind"] = -1, t.start[s.env[e]["fleet"], a]["kind"]
    if mode == FAULTED:
        arm["lost_s"] += t.dt_s
    if cut_s < t.dt_s:
        stop(sim, e, a, cut_s, crossed.fault_joint)
        terms[e, 3] += sim.weights[3]
    if arm["mode"] == FAULTED:
        recover(sim, e, a, crossed.cool_s)
    if arm["mode"] == WORKING:
        set_phase(t.plans, arm)


@jit
def keep_excess(sim: Simulation, e: int, a: int) -> None:
    """Keep what an arm measures of its job's heat, once its cycles have begun."""
    t, arm = sim.tables, sim.state.arms[e, a]
    plan = t.plans[nonnegative(arm["plan"])]
    if arm["progress_s"] >= plan["times_s"][0]:
        work = t.alike[nonnegative(sim.state.env[e]["fleet"]), nonnegative(arm["kind"])]
        sim.excess[e, a, nonnegative(work)] = plan["excess"]


@jit
def end_job(sim: Simulation, terms: Array, e: int, a: int, done_s: float) -> None:
    """Finish the job of an arm, or return it to the queue where the arm gives it back.

    Args:
        done_s: When, seconds into the step.
    """
    t, s, events, recording = sim.tables, sim.state, sim.events, len(sim.events.what) > 0
    env, arm, j = s.env[e], s.arms[e, a], nonnegative(s.arms[e, a]["job"])
    job, now_s = s.jobs[e, j], s.env[e]["tick"] * t.dt_s
    arm["pending"], env["changed"] = False, True
    if job["cycles"] + arm["todo"] < job["repetitions"]:
        job["cycles"] += arm["todo"]
        job["status"], job["queued_s"] = WAITING, now_s + done_s
        return_to_queue(s, e, j, now_s + t.dt_s)
        if recording:
            record_event(events, GIVE_BACK, e, a, j, -1, done_s, float(arm["todo"]))
        return
    job["status"], job["cycles"], job["finished_s"] = DONE, job["repetitions"], now_s + done_s
    env["unfinished"] -= 1
    gained = t.value[env["fleet"], nonnegative(arm["kind"])]
    terms[e, 0] += gained * sim.weights[0]
    terms[e, 1] += gained * (max(now_s + done_s - job["due_s"], 0.0) / 60.0) * sim.weights[1]
    if recording:
        record_event(events, FINISH, e, a, j, -1, done_s, 0.0)


@jit
def stand_at_home(s: State, arm: Array, home: Array, e: int, mode: int) -> None:
    """Put an arm that is at home into a mode."""
    arm["mode"], arm["plan"], arm["progress_s"], arm["phase_end_s"], arm["todo"] = mode, -1, 0.0, np.inf, 0
    for k in range(LANES):
        arm["current_sq"][k] = home["current_sq"][k] if mode == IDLE else _ZERO
        arm["friction_w"][k] = home["friction_w"][k] if mode == IDLE else _ZERO
    s.env[e]["changed"] = True


@jit
def stop(sim: Simulation, e: int, a: int, cut_s: float, joint: int) -> None:
    """Stop an arm whose motor has passed the error limit; its job returns to the queue, or is given up.

    Args:
        cut_s: When, seconds into the step.
        joint: The motor.
    """
    arm = sim.state.arms[e, a]
    if len(sim.events.what) > 0:
        record_event(sim.events, FAULT, e, a, arm["job"], joint, cut_s, sim.tables.error_c)
    halt(sim, e, a, cut_s, cut_s, True)
    arm["faults"] += 1
    arm["lost_s"] += sim.tables.dt_s - cut_s


@jit
def halt(sim: Simulation, e: int, a: int, cut_s: float, at_s: float, by_heat: bool) -> None:
    """Make an arm faulted where it is; its job returns to the queue, or is given up after too many faults by heat.

    Args:
        cut_s: When, seconds after the present tick.
        at_s: The same as seconds into the step, which may have ended at this tick.
    """
    t, s, events, recording = sim.tables, sim.state, sim.events, len(sim.events.what) > 0
    env, arm, now_s = s.env[e], s.arms[e, a], s.env[e]["tick"] * t.dt_s
    if arm["mode"] == WORKING and arm["pending"]:
        j = nonnegative(arm["job"])
        job, times_s = s.jobs[e, j], t.plans[nonnegative(arm["plan"])]["times_s"]
        kept = int((arm["progress_s"] - times_s[0]) // times_s[1])
        kept = min(max(kept, 0), arm["todo"])
        job["cycles"] += kept
        # Once it may move again the arm ends the cycle in which it stopped, which does not count.
        arm["todo"] = min(kept + 1, arm["todo"]) if arm["progress_s"] > times_s[0] else 0
        before, again = nonnegative(job["returns"]), False
        if by_heat:
            for n in range(before):
                again = again or s.failed_arm[e, j, n] == a
            job["returns"] += 1
            again = again or before + 1 == MOST_FAULTS
        if again:
            give_up(s, events, e, j, GIVEN_UP, at_s)
        else:
            if by_heat:
                s.failed_arm[e, j, before] = a
            job["status"], job["queued_s"] = WAITING, now_s + cut_s
            return_to_queue(s, e, j, now_s + t.dt_s)
        arm["pending"] = False
        if recording:
            record_event(events, GIVE_UP if again else RETURN, e, a, j, -1, at_s, float(kept))
    arm["broke"] = not by_heat
    arm["mode"], arm["job"], arm["kind"], arm["phase_end_s"] = FAULTED, -1, t.start[env["fleet"], a]["kind"], np.inf
    for k in range(LANES):
        arm["current_sq"][k] = arm["friction_w"][k] = 0.0
    if arm["plan"] >= 0:
        arm["moved_at_s"] = now_s + cut_s + t.move_home_s
    env["changed"] = True


@jit
def recover(sim: Simulation, e: int, a: int, cool_s: float) -> None:
    """Clear the fault of an arm that has cooled down for long enough or is repaired; move it home when that is due.

    Args:
        cool_s: When every motor is below the restart limit, seconds into the step; inf if not in it.
    """
    t, s, events, recording = sim.tables, sim.state, sim.events, len(sim.events.what) > 0
    env, arm, home = s.env[e], s.arms[e, a], t.start[s.env[e]["fleet"], a]
    now_s, end_s = env["tick"] * t.dt_s, (env["tick"] + 1) * t.dt_s
    if arm["clear_at_s"] == np.inf and cool_s < np.inf:
        arm["clear_at_s"] = now_s + cool_s + t.clear_s
    if arm["clear_at_s"] <= end_s and arm["absent"] != BROKEN:
        recovered_s = max(arm["clear_at_s"] - now_s, 0.0)  # the repair of a failure may take longer
        arm["lost_s"] -= t.dt_s - recovered_s
        arm["clear_at_s"] = np.inf
        if arm["plan"] < 0:
            stand_at_home(s, arm, home, e, IDLE)
        arm["mode"] = IDLE if arm["plan"] < 0 else WORKING
        if arm["moved_at_s"] > now_s + recovered_s:
            arm["moved_at_s"] = np.inf
        env["changed"] = True
        if recording:
            record_event(events, RECOVER, e, a, -1, -1, recovered_s, np.nan if arm["broke"] else t.restart_c)
    if arm["moved_at_s"] <= end_s:
        if recording:
            record_event(events, MOVED, e, a, -1, -1, arm["moved_at_s"] - now_s, 0.0)
        arm["moved_at_s"] = np.inf
        stand_at_home(s, arm, home, e, IDLE if arm["mode"] == WORKING else FAULTED)


@jit_inline
def update_absences(sim: Simulation, rows: Array) -> None:
    """Begin and end the absences of some envs that do so now."""
    for row in rows:
        e = nonnegative(row)
        if sim.state.env[e]["turn"] <= sim.state.env[e]["tick"]:
            turn_absences(sim, e)


@jit
def turn_absences(sim: Simulation, e: int) -> None:
    """Find out which arms of an env are absent now, and when that changes next."""
    t, s, events, recording = sim.tables, sim.state, sim.events, len(sim.events.what) > 0
    env = s.env[e]
    env["turn"], env["changed"] = NEVER, True
    for n in range(s.absences.shape[1]):
        each = s.absences[e, n]
        if each["kind"] > 0 and each["begin"] > env["tick"]:
            env["turn"] = min(env["turn"], each["begin"])
        elif each["kind"] > 0 and each["end"] > env["tick"]:
            env["turn"] = min(env["turn"], each["end"])
    for a in range(nonnegative(s.arms.shape[1])):
        arm, kind, end = s.arms[e, a], 0, 0
        arm["break_tick"] = NEVER
        for n in range(s.absences.shape[1]):
            each = s.absences[e, n]
            if each["arm"] == a and 0 < each["kind"] < BROKEN and each["end"] > env["tick"]:
                arm["break_tick"] = min(arm["break_tick"], each["begin"])
            if each["arm"] == a and each["begin"] <= env["tick"] < each["end"] and each["kind"] > kind:
                kind, end = each["kind"], each["end"]
        before, left_s = arm["absent"], (end - env["tick"]) * t.dt_s
        arm["absent"] = kind
        if kind == before:
            continue
        if recording and kind != BROKEN and (kind > 0) != (0 < before < BROKEN):
            record_event(events, BREAK if kind else BREAK_END, e, a, -1, -1, t.dt_s, left_s)
        if kind == BROKEN:
            if arm["mode"] != FAULTED:
                if recording:
                    record_event(events, FAILURE, e, a, arm["job"], -1, t.dt_s, left_s)
                halt(sim, e, a, 0.0, t.dt_s, False)
                arm["clear_at_s"] = end * t.dt_s
        elif kind == FINISH_CYCLE and arm["mode"] == WORKING and arm["pending"]:
            arm["todo"] = cycles_begun(t.plans, arm)
            set_phase(t.plans, arm)


BLOCK = 128
"""Envs that go through a whole step together, few enough to stay in the processor's cache."""
CLAIM, MOVE, OFFER, OBSERVE, PLAY = 1, 2, 4, 8, 16
"""Parts of a step, to be added up."""


@jit_lean
def take_steps(
    sim: Simulation,
    parts: int,
    actions: Array,
    terms: Array,
    until: Array,
    rows: Array,
    shared: Array,
    own: Array,
) -> None:
    """Take some envs through parts of one step, or of several; see `step_rows`."""
    room, block = sim.room.rows, len(sim.room.rows)
    for first in range(0, len(rows), block):
        some = rows[first : first + block]
        count, now = len(some), parts
        for n in range(count):
            room[n] = some[n]
            for term in range(terms.shape[1]):
                terms[some[n], term] = 0.0
        while count > 0:
            going = room[:count]
            if now & PLAY:
                choose_claims(sim, going, actions)
            if now & CLAIM:
                resolve_claims(sim, actions, going)
            if now & PLAY:
                note_awards(sim, going, actions)
            if now & MOVE:
                pass_over(sim, going)
                step_arms(sim, terms, going)
                if len(sim.path_c) > 0:
                    keep_path(sim, going)
            if now & OFFER:
                update_absences(sim, going)
                update_offers(sim, going)
            if now & PLAY:
                collect_rewards(sim, going, terms)
            else:
                now &= ~CLAIM  # of the first step only
            count = keep_going(sim, until, now & PLAY != 0, going)
        if terms.shape[1] > 0:
            sum_up(sim, some, terms)
        if parts & OBSERVE:
            observe(sim, some, shared, own)


@kernel
def step_rows(
    sim: Simulation,
    parts: int,
    actions: Array,
    terms: Array,
    until: Array,
    rows: Array,
    shared: Array,
    own: Array,
) -> None:
    """Take some envs through parts of one step, or of several.

    Args:
        parts: CLAIM resolves claims, MOVE steps the arms, OFFER updates the offers, OBSERVE fills `out`, and PLAY takes
            the claims from the script.
        actions: int64 [env, arm].
        terms: Receives the outcomes, [env, OUTCOME]; without columns, nothing.
        until: Tick until which each env goes on while no arm has a choice, or while it plays, int [env]; not at all if
            empty.
        rows: int [row].
        shared: Receives what all arms of an env know alike, float32 [env, shared].
        own: Receives what each arm knows of itself, float32 [env, arm, own].
    """
    s = sim
    whole = Simulation(
        s.tables,
        s.state,
        s.offers,
        s.events,
        s.trace,
        s.drive,
        s.infos,
        s.path_c,
        s.excess,
        s.assumed_c,
        s.moments,
        s.form,
        s.room,
        s.weights,
        s.script,
    )
    take_steps(whole, parts, actions, terms, until, rows, shared, own)


@jit_inline
def keep_path(sim: Simulation, rows: Array) -> None:
    """Keep the temperatures of some envs at the end of a step."""
    for row in rows:
        e = nonnegative(row)
        tick = nonnegative(sim.state.env[e]["tick"] - 1)
        for a in range(nonnegative(sim.state.arms.shape[1])):
            for n in range(NODES):
                sim.path_c[e, tick, a, n] = sim.state.arms[e, a]["temp_c"][n]


@jit_inline
def sum_up(sim: Simulation, rows: Array, terms: Array) -> None:
    """Put what has become of some envs so far into the outcomes and `infos`."""
    s, infos = sim.state, sim.infos
    for row in rows:
        e = nonnegative(row)
        env = s.env[e]
        terms[e, FINISHED] = 1.0 if env["unfinished"] == 0 and env["number"] > 0 else 0.0
        terms[e, JOBS_DONE] = env["number"] - env["unfinished"] - env["given_up"]
        terms[e, TICK] = env["tick"]
        for a in range(nonnegative(s.arms.shape[1])):
            arm, info = s.arms[e, a], infos[e, a]
            info["faults"], info["illegal"] = arm["faults"], arm["illegal"]
            info["peak_c"], info["above_warning_s"] = arm["peak_c"], arm["above_warning_s"]


@jit_inline
def keep_going(sim: Simulation, until: Array, plays: bool, rows: Array) -> int:
    """Put the envs that make another step first in `rows`; return their number."""
    count = 0
    if len(until) > 0:
        for row in rows:
            e = nonnegative(row)
            env = sim.state.env[e]
            if env["tick"] >= until[e] or (env["unfinished"] == 0 and env["number"] > 0):
                continue
            if plays or not (env["alarm"] or sim.offers.mask[e, :, 1:-1].any()):
                rows[count] = e
                count += 1
    return count


@jit_inline
def choose_claims(sim: Simulation, rows: Array, actions: Array) -> None:
    """Let each arm claim, of its jobs that it may claim, the one that comes first in its script."""
    t, o, script, arms = sim.tables, sim.offers, sim.script, nonnegative(actions.shape[1])
    options, first = t.work.shape[3], sim.room.key
    for row in rows:
        e = nonnegative(row)
        for a in range(arms):
            first[a], actions[e, a] = np.inf, 0
        for k in range(o.slot_job.shape[1]):
            j = o.slot_job[e, k]
            if j < 0 or script.not_before_s[e, j] > sim.state.env[e]["tick"] * t.dt_s:
                continue
            a, action = script.arm[e, j], 1 + k * options + script.option[e, j]
            if script.order[e, j] < first[a] and o.mask[e, a, action] != 0:
                first[a], actions[e, a] = script.order[e, j], action


@jit_inline
def note_awards(sim: Simulation, rows: Array, actions: Array) -> None:
    """Note which claims were won, and when."""
    script = sim.script
    for row in rows:
        e = nonnegative(row)
        tick = sim.state.env[e]["tick"]
        for a in range(nonnegative(actions.shape[1])):
            arm = sim.state.arms[e, a]
            if actions[e, a] > 0 and arm["last_award"] == 1:
                script.start_s[e, nonnegative(arm["job"])] = tick * sim.tables.dt_s
                n = script.won[e]
                if n < script.claims.shape[1]:
                    script.claims[e, n, 0], script.claims[e, n, 1], script.claims[e, n, 2] = tick, a, actions[e, a]
                    script.won[e] += 1


@jit_inline
def collect_rewards(sim: Simulation, rows: Array, terms: Array) -> None:
    """Add the discounted rewards of a step to those of the script."""
    script = sim.script
    for row in rows:
        e = nonnegative(row)
        tick = nonnegative(sim.state.env[e]["tick"] - 1)
        script.reward[e] += script.discount[tick] * terms[e, TOTAL]
        for term in range(terms.shape[1]):
            terms[e, term] = 0.0
