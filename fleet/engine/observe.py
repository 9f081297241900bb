"""What every arm knows at a moment: one observation vector per arm of many envs.

`fleet.observation` says what the fields mean. Peers are those of this moment; where messages take time or get lost,
`fleet.engine.peers` replaces the peers' fields by what was delivered.
"""

from typing import NamedTuple

import numpy as np

from fleet.difficulty import KNOWN, probability_of
from fleet.engine.claims import is_closed
from fleet.engine.crossings import hottest
from fleet.engine.tables import LANES, Simulation
from fleet.jit import jit_inline, nonnegative
from fleet.observation import LONG_S
from fleet.robot import JOINTS
from fleet.seeding import random_normal
from fleet.telemetry import FAULTED, IDLE, WORKING

Array = np.ndarray


class ForecastTables(NamedTuple):
    """The forecasts of the tables by themselves: passing all tables to a function takes longer than the function."""

    offset: Array
    weight: Array
    time_s: Array
    curve: Array


PEAK_LOW_C, PEAK_HIGH_C = -60.0, 300.0
"""Bounds of predicted temperatures in the vector."""

assert (IDLE, WORKING, FAULTED) == (0, 1, 2), "the mode fields of the observation are in this order"


@jit_inline
def observe(sim: Simulation, rows: Array, out: Array) -> None:
    """Put the vectors of the arms of some envs into `out`.

    Args:
        rows: Envs, int [row].
        out: float32 [env, arm, size].
    """
    t, d, s, o, form = sim.tables, sim.jobs, sim.state, sim.offers, sim.form
    fleets, kinds, keys, repetitions, due_s = d.fleet, d.kind, d.noise_key, d.repetitions, d.due_s
    ticks, temp_c, modes, progress_s, todo = s.tick, s.temp_c, s.mode, s.progress_s, s.todo
    last, queued_s, cycles, returns = s.last_award, s.queued_s, s.cycles, s.returns
    slot_job, station_free, plans, times_s = o.slot_job, o.station_free, s.plan, t.times_s
    plan_of, volume, excluded, closed = t.plan, t.volume, t.excluded, o.closed
    noise_k, payload_kg, values, work = t.sensor_noise_k, t.payload_kg, t.value, t.work
    arms, slots, options = nonnegative(modes.shape[1]), nonnegative(slot_job.shape[1]), nonnegative(plan_of.shape[3])
    at, low, high, first, change = form.offsets, form.low, form.high, form.first_change, form.change
    size = nonnegative(out.shape[2])
    jobs, pending, who = s.job, o.pending, form.who
    peers = nonnegative((size - at.peer_heard) // (6 + 3 * slots))
    low_c, high_c, low_k, high_k = low[at.temp_c], high[at.temp_c], low[at.headroom_k], high[at.headroom_k]
    most_kg, most_value, most_returns = high[at.payload_kg], high[at.value], high[at.returns]
    true_c, measured_c, headroom_k = np.empty(LANES), np.empty((arms, LANES)), np.empty(arms, np.float32)
    left, slack_s, slot_kind = np.empty(slots), np.empty(slots), np.empty(slots, np.int64)
    known, shared = np.zeros((arms, slots), np.float32), np.zeros((arms, slots), np.float32)
    tables = ForecastTables(t.forecast_offset, t.forecast_weight, t.forecast_time_s, t.forecast_curve)
    warning_c = t.warning_c
    known_c, values_c, left_s = np.zeros(KNOWN), np.empty(t.forecast_offset.shape[1]), np.zeros(arms)
    housing_c, ambient, offsets_k = s.housing_c, t.ambient_c, d.ambient_offset_k
    too_heavy, expires = t.too_heavy, d.expires
    # The vector of an arm but for its own fields: filled slots and peers.
    frame = np.zeros(size, np.float32)
    for k in range(slots * options):
        frame[at.p_saturation + k] = 0.5
    for peer in range(peers):
        frame[at.peer_heard + peer] = 1.0
    filled_before = 0
    for row in rows:
        e = nonnegative(row)
        fleet, now_s, key = nonnegative(fleets[e]), ticks[e] * t.dt_s, keys[e]
        count = np.uint64(nonnegative(ticks[e]) * arms * JOINTS)
        frame[at.clock] = now_s / (t.ticks * t.dt_s)
        filled = 0
        while filled < slots and slot_job[e, filled] >= 0:
            j = nonnegative(slot_job[e, filled])
            kind = nonnegative(kinds[e, j])
            slot_kind[filled] = kind
            left[filled], slack_s[filled] = repetitions[e, j] - cycles[e, j], due_s[e, j] - now_s
            frame[at.offered + filled], frame[at.station_free + filled] = 1.0, station_free[e, filled]
            frame[at.age_s + filled] = min(max(now_s - queued_s[e, j], 0.0), LONG_S)
            frame[at.payload_kg + filled] = min(payload_kg[fleet, kind], most_kg)
            frame[at.value + filled] = min(max(values[fleet, kind], 0.0), most_value)
            frame[at.returns + filled] = min(returns[e, j], most_returns)
            frame[at.expires + filled] = expires[e, j]
            filled += 1
        for k in range(filled, filled_before):
            frame[at.offered + k] = frame[at.age_s + k] = frame[at.payload_kg + k] = 0.0
            frame[at.value + k] = frame[at.returns + k] = frame[at.station_free + k] = frame[at.expires + k] = 0.0
            for peer in range(peers):
                frame[at.peer_known + peer * slots + k] = frame[at.peer_difficulty + peer * slots + k] = 0.0
        filled_before = filled
        for a in range(arms):
            for k in range(LANES):
                true_c[k] = temp_c[e, a, k] + noise_k[fleet, a, k] * random_normal(key, count + np.uint64(k + 1))
                measured_c[a, k] = true_c[k]
            count += np.uint64(JOINTS)
            headroom_k[a] = min(max(t.warning_c - hottest(true_c), low_k), high_k)
            left_s[a] = 0.0
            if modes[e, a] == WORKING:
                plan = nonnegative(plans[e, a])
                busy_s = times_s[plan, 0] + times_s[plan, 2] + todo[e, a] * times_s[plan, 1] - progress_s[e, a]
                left_s[a] = min(max(busy_s, 0.0), LONG_S)
            for k in range(filled):
                known[a, k] = shared[a, k] = 0.0
                for n in range(options):
                    score = work[fleet, a, slot_kind[k], n]["difficulty"]
                    if not np.isnan(score) and (known[a, k] == 0.0 or score < shared[a, k]):
                        known[a, k], shared[a, k] = 1.0, score
        for a in range(arms):
            for n in range(first[a], first[a + 1]):
                peer, b = nonnegative(change[n, 0]), nonnegative(change[n, 1])
                frame[at.peer_working + peer] = modes[e, b] == WORKING
                frame[at.peer_faulted + peer] = modes[e, b] == FAULTED
                frame[at.peer_headroom_k + peer], frame[at.peer_busy_s + peer] = headroom_k[b], left_s[b]
                for k in range(filled):
                    frame[at.peer_known + peer * slots + k] = known[b, k]
                    frame[at.peer_difficulty + peer * slots + k] = shared[b, k]
            for i in range(size):
                out[e, a, i] = frame[i]
            mode = nonnegative(modes[e, a])
            out[e, a, at.idle + mode] = 1.0
            out[e, a, at.busy_s], out[e, a, at.last_award] = left_s[a], last[e, a]
            air_c = ambient[fleet, min(ticks[e], t.ticks - 1), a] + offsets_k[e]
            for k in range(JOINTS):
                out[e, a, at.temp_c + k] = min(max(measured_c[a, k], low_c), high_c)
                out[e, a, at.housing_c + k] = min(max(housing_c[e, a, k], low_c), high_c)
                known_c[k], known_c[JOINTS + k] = measured_c[a, k], housing_c[e, a, k]
            known_c[2 * JOINTS] = air_c
            out[e, a, at.headroom_k], out[e, a, at.ambient_c] = headroom_k[a], min(max(air_c, low_c), high_c)
            if mode == WORKING and pending[e, a]:
                j = nonnegative(jobs[e, a])
                kind, plan = nonnegative(kinds[e, j]), nonnegative(plans[e, a])
                out[e, a, at.job_value] = min(max(values[fleet, kind], 0.0), most_value)
                over_s = max(progress_s[e, a] - times_s[plan, 0], 0.0)
                cycles_over = min(int(over_s / max(times_s[plan, 1], 1e-9) + 1e-9), todo[e, a])
                out[e, a, at.job_cycles] = min(repetitions[e, j] - cycles[e, j] - cycles_over, LONG_S)
                for n in range(options):
                    if plan_of[fleet, a, kind, n] == plan:
                        own = work[fleet, a, kind, n]
                        p, risk, peak, peak_c = own["p_saturation"], own["risk"], own["peak"], 0.0
                        if risk >= 0 or peak >= 0:
                            p, peak_c = predict(p, risk, peak, tables, known_c, left_s[a], values_c)
                            if peak >= 0:
                                peak_c = max(peak_c, warning_c - headroom_k[a])
                        out[e, a, at.job_p] = 0.5 if np.isnan(p) else p
                        out[e, a, at.job_peak_c] = min(max(peak_c, PEAK_LOW_C), PEAK_HIGH_C)
            for k in range(filled):
                kind = nonnegative(slot_kind[k])
                out[e, a, at.too_heavy + k] = too_heavy[fleet, kind, a]
                for n in range(options):
                    plan, option = plan_of[fleet, a, kind, n], k * options + n
                    if plan < 0:
                        continue
                    own = work[fleet, a, kind, n]
                    duration_s, score = own["travel_s"] + left[k] * own["cycle_s"], own["difficulty"]
                    space_free = not is_closed(closed, e, nonnegative(volume[plan]))
                    out[e, a, at.feasible + option], out[e, a, at.space_free + option] = 1.0, space_free
                    if n == 0 and not space_free:
                        for peer in range(peers):
                            other = plans[e, who[a, peer]]
                            if other >= 0 and is_closed(excluded, nonnegative(other), nonnegative(volume[plan])):
                                out[e, a, at.peer_blocks + peer * slots + k] = 1.0
                    out[e, a, at.duration_s + option] = min(duration_s, LONG_S)
                    out[e, a, at.slack_s + option] = min(max(slack_s[k] - duration_s, -LONG_S), LONG_S)
                    if not np.isnan(score):
                        out[e, a, at.known + option], out[e, a, at.difficulty + option] = 1.0, score
                    p, risk, peak = own["p_saturation"], own["risk"], own["peak"]
                    if risk >= 0 or peak >= 0:
                        p, peak_c = predict(p, risk, peak, tables, known_c, np.inf, values_c)
                        out[e, a, at.peak_c + option] = min(max(peak_c, PEAK_LOW_C), PEAK_HIGH_C)
                    if not np.isnan(p):
                        out[e, a, at.p_saturation + option] = p


@jit_inline
def predict(
    p: float, risk: int, peak: int, tables: ForecastTables, known_c: Array, left_s: float, values: Array
) -> tuple[float, float]:
    """P(saturation), NaN if unknown, and predicted peak temperature, °C, 0 if unknown, of a plan.

    Args:
        p: From a model that ignores the temperatures; NaN if there is none.
        risk: Row of the forecast of P, −1 for none.
        peak: Row of the forecast of the peak temperature, −1 for none.
        known_c: [KNOWN].
        left_s: Pieces of later moments do not count.
        values: Room for the values of the pieces, [piece].
    """
    curve, peak_c = tables.curve, 0.0
    if peak >= 0:
        peak_c = largest_piece(tables, peak, known_c, left_s, values)
        if curve.shape[1] > 0 and risk < 0 and np.isnan(p) and not np.isnan(curve[peak, 0, 0]):
            p = probability_of(peak_c, curve[peak])
    if risk >= 0:
        p = probability_of(largest_piece(tables, risk, known_c, left_s, values), curve[risk])
    return p, peak_c


@jit_inline
def largest_piece(tables: ForecastTables, row: int, known_c: Array, left_s: float, values: Array) -> float:
    """Value of a forecast without the pieces of moments later than `left_s`, −inf if none is left."""
    offset, weight, time_s, most = tables.offset, tables.weight, tables.time_s, -np.inf
    for piece in range(len(values)):
        values[piece] = offset[row, piece]
    for i in range(KNOWN):
        for piece in range(len(values)):
            values[piece] += weight[row, i, piece] * known_c[i]
    for piece in range(len(values)):
        if time_s[row, piece] <= left_s:
            most = max(most, values[piece])
    return most
