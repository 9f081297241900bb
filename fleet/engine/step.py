"""One step of many envs: claims, then motion, heat, limits and the end of jobs of their arms, then what they observe.

Heat is constant over a step (the mean of what the motors do in it, with losses from the temperatures at its start) and
the thermal step is exact for it, so the moments at which a limit is crossed are exact too. A row's result does not
depend on how many rows there are.
"""

import numpy as np

from fleet.engine.claims import give_up, resolve_claims, return_to_queue, update_offers
from fleet.engine.crossings import hottest, step_with_crossing
from fleet.engine.observe import observe
from fleet.engine.state import DONE, GIVEN_UP, WAITING
from fleet.engine.tables import (
    FAULT,
    FINISH,
    GIVE_BACK,
    GIVE_UP,
    HOME,
    LANES,
    MOVED,
    RECOVER,
    RETURN,
    WARNING,
    WIDE,
    Simulation,
    record_event,
)
from fleet.heat.motor import magnet_factor, winding_heat
from fleet.heat.thermal import NODES
from fleet.jit import jit, jit_inline, kernel, nonnegative
from fleet.job import MOST_FAULTS
from fleet.robot import JOINTS
from fleet.telemetry import FAULTED, IDLE, WORKING

Array = np.ndarray

ROUNDING_S = 1e-9
"""Sums of phases may be off by this much; a whole step must not be lost to it."""


@jit_inline
def step_arms(sim: Simulation, weights: Array, terms: Array, rows: Array) -> None:
    """Take every arm of some envs through one step.

    Args:
        weights: Reward per unit of each term, [term], in the order of `fleet.engine.batch.TERMS`.
        terms: Receives the reward terms and their sum, [env, term + 1].
        rows: Envs, int [row].
    """
    t, d, s, o, events, trace, measured = sim.tables, sim.jobs, sim.state, sim.offers, sim.events, sim.trace, sim.drive
    # Arrays under local names: the compiler then loads their addresses once.
    fleets, offsets_k, repetitions, due_s = d.fleet, d.ambient_offset_k, d.repetitions, d.due_s
    ticks, temp_c, modes, jobs, progress_s, todo = s.tick, s.temp_c, s.mode, s.job, s.progress_s, s.todo
    clear_at_s, faults, peak_c, above_warning_s = s.clear_at_s, s.faults, s.peak_c, s.above_warning_s
    busy_s, lost_s, energy_j, status, queued_s = s.busy_s, s.lost_s, s.energy_j, s.status, s.queued_s
    cycles, returns, finished_s = s.cycles, s.returns, s.finished_s
    housing_c, alarm = s.housing_c, o.alarm
    keep, gain, from_winding = t.housing_keep, t.housing_gain, t.housing_winding
    from_ambient, known_idle_w = t.housing_ambient, t.housing_idle_w
    unfinished, current, pending = o.unfinished, o.current_kind, o.pending
    ambient, thermal_step, to_ambient = t.ambient_c, t.thermal_step, t.to_ambient
    copper, idle_w, rest_sq, rest_w = t.copper_w_per_a2, t.idle_w, t.rest_current_sq, t.rest_friction_w
    plan_sq, plan_w, times_s, values = t.current_sq, t.friction_w, t.times_s, t.value
    plans, moved_at_s, failed_arm = s.plan, s.moved_at_s, s.failed_arm
    dt_s, warning_c, error_c, restart_c = t.dt_s, t.warning_c, t.error_c, t.restart_c
    recording, tracing, driven = len(events.what) > 0, len(trace.plan) > 0, len(measured.current_sq) > 0
    copper_w, other_w, fold = np.empty(LANES), np.empty(LANES), np.empty(4)
    begin, end = np.zeros(2 * NODES + LANES), np.empty(WIDE)  # temperatures, loads, padding
    friction_w, estimate_c = np.empty(LANES), np.empty(LANES)
    arms, no_kind = nonnegative(modes.shape[1]), nonnegative(t.feasible.shape[1])
    for row in rows:
        e = nonnegative(row)
        fleet, tick = nonnegative(fleets[e]), nonnegative(ticks[e])
        now_s, moment = tick * dt_s, min(tick, t.ticks - 1)
        value = late = above_s = count = energy = 0.0
        alarm[e] = False
        for a in range(arms):
            mode = modes[e, a]
            plan, spent_s, done_s, home_s = 0, 0.0, np.inf, np.inf
            first_s = cycle_s = share_0 = share_1 = share_2 = 0.0
            if mode == WORKING:
                plan = nonnegative(plans[e, a])
                begin_s = progress_s[e, a]
                until_s = begin_s + dt_s
                first_s, cycle_s = times_s[plan, 0], times_s[plan, 1]
                last_s = first_s + cycle_s * todo[e, a]
                back_s = last_s + times_s[plan, 2]
                span_0 = max(min(until_s, first_s) - begin_s, 0.0)
                span_1 = max(min(until_s, last_s) - max(begin_s, first_s), 0.0)
                span_2 = max(min(until_s, back_s) - max(begin_s, last_s), 0.0)
                spent_s = span_0 + span_1 + span_2
                share_0, share_1, share_2 = span_0 / dt_s, span_1 / dt_s, span_2 / dt_s
                if pending[e, a] and last_s - begin_s <= dt_s + ROUNDING_S:
                    done_s = min(max(last_s - begin_s, 0.0), dt_s)
                if back_s - begin_s <= dt_s + ROUNDING_S:
                    home_s = min(max(back_s - begin_s, 0.0), dt_s)
            rest = 0.0 if mode == FAULTED else (dt_s - spent_s) / dt_s
            powered = 0.0 if t.power_off and mode == FAULTED else 1.0
            ambient_c = ambient[fleet, moment, a] + offsets_k[e]
            for n in range(NODES):
                begin[n] = temp_c[e, a, n]
            for k in range(LANES):
                amps_sq = share_0 * plan_sq[plan, 0, k] + share_1 * plan_sq[plan, 1, k]
                copper_w[k] = amps_sq + (share_2 * plan_sq[plan, 2, k] + rest * rest_sq[fleet, a, k])
                moving_w = share_0 * plan_w[plan, 0, k] + share_1 * plan_w[plan, 1, k]
                other_w[k] = moving_w + (share_2 * plan_w[plan, 2, k] + rest * rest_w[fleet, a, k])
            if driven:
                for k in range(LANES):
                    copper_w[k], other_w[k] = measured.current_sq[e, a, k], measured.friction_w[e, a, k]
            for k in range(LANES):
                friction_w[k] = other_w[k]
                factor = magnet_factor(begin[JOINTS + k], t)
                copper_w[k] = winding_heat(copper[fleet, a, k], copper_w[k] / (factor * factor), begin[k], t)
                other_w[k] += powered * idle_w[fleet, a, k]
            for k in range(4):
                fold[k] = (copper_w[k] + other_w[k]) + (copper_w[4 + k] + other_w[4 + k])
            heat_w = (fold[0] + fold[1]) + (fold[2] + fold[3])
            for k in range(JOINTS):
                begin[NODES + k] = copper_w[k] + to_ambient[fleet, a, k] * ambient_c
                begin[NODES + JOINTS + k] = other_w[k] + to_ambient[fleet, a, JOINTS + k] * ambient_c
            for m in range(WIDE):
                total = 0.0
                for n in range(2 * NODES):
                    total += thermal_step[fleet, a, n, m] * begin[n]
                end[m] = total
            first_c, last_c = hottest(begin), hottest(end)
            cut_s, here_s, here_j, top_c, cool_s = dt_s, 0.0, heat_w * dt_s, last_c, np.inf
            fault_joint = -1
            if tracing:
                trace.mode[e, a], trace.plan[e, a], trace.progress_s[e, a] = mode, plans[e, a], progress_s[e, a]
                trace.todo[e, a], trace.home_s[e, a] = todo[e, a], home_s
                for n in range(NODES):
                    trace.start_c[e, a, n] = begin[n]
                    trace.heat_w[e, a, n] = copper_w[n] if n < JOINTS else other_w[n - JOINTS]
            hot, same = first_c >= warning_c, (first_c >= warning_c) == (last_c >= warning_c)
            if same and (first_c < restart_c or last_c >= restart_c if mode == FAULTED else last_c < error_c):
                here_s = dt_s if hot else 0.0
                if mode == FAULTED and last_c < restart_c:
                    cool_s = 0.0
            else:
                crossed = step_with_crossing(t, fleet, a, mode, begin, heat_w, ambient_c, end)
                cut_s, here_s, here_j = crossed.cut_s, crossed.above_s, crossed.energy_j
                top_c, cool_s, fault_joint = crossed.peak_c, crossed.cool_s, crossed.fault_joint
                if recording and crossed.warned_s < np.inf:
                    j = jobs[e, a]
                    record_event(events, WARNING, e, a, j, crossed.warned_joint, crossed.warned_s, warning_c)
            if tracing:
                trace.cut_s[e, a] = cut_s
            energy_j[e, a] += here_j
            above_warning_s[e, a] += here_s
            peak_c[e, a] = max(peak_c[e, a], top_c)
            busy_s[e, a] += min(spent_s, cut_s)
            above_s += here_s
            energy += here_j
            for n in range(NODES):
                temp_c[e, a, n] = end[n]
            # The arm's own estimate of its housings, from its motor temperatures. Their noise is left out: over the
            # time constants of housings it averages out to a tenth.
            for m in range(LANES):
                estimate_c[m] = 0.0
            for k in range(JOINTS):
                load_w = 0.5 * from_winding[fleet, a, k] * (begin[k] + end[k]) + from_ambient[fleet, a, k] * ambient_c
                load_w += friction_w[k] + powered * known_idle_w[fleet, a, k]
                before_c = housing_c[e, a, k]
                for m in range(LANES):
                    estimate_c[m] += keep[fleet, a, k, m] * before_c + gain[fleet, a, k, m] * load_w
            for k in range(JOINTS):
                housing_c[e, a, k] = estimate_c[k]
            if mode == WORKING:
                alarm[e] = alarm[e] or (first_c < warning_c and last_c >= warning_c)
                if done_s <= cut_s:
                    j, pending[e, a] = nonnegative(jobs[e, a]), False
                    if cycles[e, j] + todo[e, a] < repetitions[e, j]:
                        cycles[e, j] += todo[e, a]
                        status[e, j], queued_s[e, j] = WAITING, now_s + done_s
                        return_to_queue(d, s, o, e, j, now_s + dt_s)
                        if recording:
                            record_event(events, GIVE_BACK, e, a, j, -1, done_s, todo[e, a])
                    else:
                        status[e, j], cycles[e, j], finished_s[e, j] = DONE, repetitions[e, j], now_s + done_s
                        unfinished[e] -= 1
                        gained = values[fleet, nonnegative(current[e, a])]
                        value += gained
                        late += gained * (max(finished_s[e, j] - due_s[e, j], 0.0) / 60.0)
                        if recording:
                            record_event(events, FINISH, e, a, j, -1, done_s, 0.0)
                progress_s[e, a] += cut_s
                if home_s <= cut_s:
                    if recording:
                        record_event(events, HOME, e, a, jobs[e, a], -1, home_s, 0.0)
                    modes[e, a], jobs[e, a], plans[e, a], progress_s[e, a], todo[e, a] = IDLE, -1, -1, 0.0, 0
                    current[e, a] = no_kind
            if mode == FAULTED:
                lost_s[e, a] += dt_s
            if cut_s < dt_s:
                if recording:
                    record_event(events, FAULT, e, a, jobs[e, a], fault_joint, cut_s, error_c)
                if mode == WORKING and pending[e, a]:
                    j = nonnegative(jobs[e, a])
                    kept = int((progress_s[e, a] - first_s) // cycle_s)
                    kept = min(max(kept, 0), todo[e, a])
                    cycles[e, j] += kept
                    # Once it may move again the arm ends the cycle in which it stopped, which does not count.
                    todo[e, a] = min(kept + 1, todo[e, a]) if progress_s[e, a] > first_s else 0
                    before, again = nonnegative(returns[e, j]), False
                    for n in range(before):
                        again = again or failed_arm[e, j, n] == a
                    returns[e, j] += 1
                    again = again or before + 1 == MOST_FAULTS
                    if again:
                        give_up(d, s, o, e, j, GIVEN_UP)
                    else:
                        failed_arm[e, j, before] = a
                        status[e, j], queued_s[e, j] = WAITING, now_s + cut_s
                        return_to_queue(d, s, o, e, j, now_s + dt_s)
                    pending[e, a] = False
                    if recording:
                        record_event(events, GIVE_UP if again else RETURN, e, a, j, -1, cut_s, kept)
                count += 1.0
                faults[e, a] += 1
                lost_s[e, a] += dt_s - cut_s
                modes[e, a], jobs[e, a], current[e, a] = FAULTED, -1, no_kind
                if plans[e, a] >= 0:
                    moved_at_s[e, a] = now_s + cut_s + t.move_home_s
            if modes[e, a] == FAULTED:
                if clear_at_s[e, a] == np.inf and cool_s < np.inf:
                    clear_at_s[e, a] = now_s + cool_s + t.clear_s
                if clear_at_s[e, a] <= (tick + 1) * dt_s:
                    recovered_s = clear_at_s[e, a] - now_s
                    lost_s[e, a] -= dt_s - recovered_s
                    modes[e, a], clear_at_s[e, a] = IDLE if plans[e, a] < 0 else WORKING, np.inf
                    if moved_at_s[e, a] > now_s + recovered_s:
                        moved_at_s[e, a] = np.inf
                    if recording:
                        record_event(events, RECOVER, e, a, -1, -1, recovered_s, restart_c)
                if moved_at_s[e, a] <= (tick + 1) * dt_s:
                    if recording:
                        record_event(events, MOVED, e, a, -1, -1, moved_at_s[e, a] - now_s, 0.0)
                    plans[e, a], progress_s[e, a], todo[e, a], moved_at_s[e, a] = -1, 0.0, 0, np.inf
                    modes[e, a] = IDLE if modes[e, a] == WORKING else FAULTED
        terms[e, 0], terms[e, 1], terms[e, 2] = value * weights[0], late * weights[1], above_s * weights[2]
        terms[e, 3], terms[e, 4] = count * weights[3], energy * weights[4]
        terms[e, 5] = terms[e, 0] + terms[e, 1] + terms[e, 2] + terms[e, 3] + terms[e, 4]
        ticks[e] += 1


BLOCK = 128
"""Envs that go through a whole step together, few enough to stay in the processor's cache."""
CLAIM, MOVE, OBSERVE = 1, 2, 4
"""Parts of a step, to be added up."""


@kernel
def step_rows(
    sim: Simulation, parts: int, actions: Array, weights: Array, terms: Array, until: Array, rows: Array, out: Array
) -> None:
    """Take some envs through parts of a step.

    Args:
        parts: CLAIM resolves claims, MOVE steps the arms, OBSERVE updates the offers and fills `out`.
        actions: int64 [env, arm].
        weights: Reward per unit of each term, [term].
        terms: Receives the reward terms and their sum, [env, term + 1].
        until: Tick until which each env goes on while no arm has a choice, int [env]; not at all if empty.
        rows: int [row].
        out: Receives the observation vectors, float32 [env, arm, size].
    """
    for first in range(0, len(rows), BLOCK):
        some = rows[first : first + BLOCK]
        if parts & CLAIM:
            resolve_claims(sim, actions, some)
        if parts & MOVE:
            step_arms(sim, weights, terms, some)
        if parts & OBSERVE:
            update_offers(sim.tables, sim.jobs, sim.state, sim.offers, sim.events, some)
            if len(until) > 0:
                go_on(sim, weights, terms, until, some)
            observe(sim, some, out)


@jit
def go_on(sim: Simulation, weights: Array, terms: Array, until: Array, rows: Array) -> None:
    """Step some envs until an arm has a choice, all jobs are done, or their last tick; adds to the reward terms."""
    one, earned = np.empty(1, np.int64), np.empty(terms.shape[1])
    for row in rows:
        e = nonnegative(row)
        one[0] = e
        earned[:] = terms[e]
        while (
            sim.state.tick[e] < until[e]
            and (sim.offers.unfinished[e] > 0 or sim.jobs.number[e] == 0)
            and not sim.offers.alarm[e]
            and not sim.offers.mask[e, :, 1:-1].any()
        ):
            step_arms(sim, weights, terms, one)
            update_offers(sim.tables, sim.jobs, sim.state, sim.offers, sim.events, one)
            earned += terms[e]
        terms[e] = earned
