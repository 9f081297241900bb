"""What every arm knows at a moment: one observation vector per arm of many envs.

`fleet.observation` says what the fields mean. Peers are those of this moment; where messages take time or get lost,
`fleet.engine.shift` replaces the peers' fields by what was delivered.
"""

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
    t, s, o, form = sim.tables, sim.state, sim.offers, sim.form
    slot_job, station_free, work = o.slot_job, o.station_free, t.work
    arms, slots, options = nonnegative(s.arms.shape[1]), nonnegative(slot_job.shape[1]), nonnegative(work.shape[3])
    at, low, high, first, change = form.offsets, form.low, form.high, form.first_change, form.change
    size, who = nonnegative(out.shape[2]), form.who
    peers = nonnegative((size - at.peer_heard) // (6 + 3 * slots))
    low_c, high_c, low_k, high_k = low[at.temp_c], high[at.temp_c], low[at.headroom_k], high[at.headroom_k]
    most_kg, most_value, most_returns = high[at.payload_kg], high[at.value], high[at.returns]
    true_c, measured_c, hottest_c = np.empty(LANES, np.float32), np.empty((arms, LANES), np.float32), np.empty(arms)
    headroom_k = np.empty(arms, np.float32)
    left, slack_s, slot_kind = np.empty(slots), np.empty(slots), np.empty(slots, np.int64)
    fast_volume, fast_can = np.empty(slots, np.int64), np.empty(slots, np.bool_)
    known, shared = np.zeros((arms, slots), np.float32), np.zeros((arms, slots), np.float32)
    first_block, block, curve = t.forecast_first, t.forecast_block, t.forecast_curve
    warning_c, error_c, forecasts = t.warning_c, t.error_c, len(curve) > 0
    known_c, values_c, left_s = np.zeros(KNOWN, np.float32), np.empty(LANES, np.float32), np.zeros(arms)
    # The vector of an arm but for its own fields: filled slots and peers.
    frame = np.zeros(size, np.float32)
    for k in range(slots * options):
        frame[at.p_saturation + k] = 0.5
    for peer in range(peers):
        frame[at.peer_heard + peer] = 1.0
    filled_before = 0
    for row in rows:
        e = nonnegative(row)
        env, closed = s.env[e], o.closed[e]
        fleet, tick, key = nonnegative(env["fleet"]), nonnegative(env["tick"]), env["noise_key"]
        now_s, count = tick * t.dt_s, np.uint64(tick * arms * JOINTS)
        frame[at.clock] = now_s / (t.ticks * t.dt_s)
        frame[at.left_s] = min((t.ticks - tick) * t.dt_s, LONG_S)
        filled = 0
        while filled < slots and slot_job[e, filled] >= 0:
            j = nonnegative(slot_job[e, filled])
            job = s.jobs[e, j]
            kind = nonnegative(job["kind"])
            slot_kind[filled] = kind
            left[filled], slack_s[filled] = job["repetitions"] - job["cycles"], job["due_s"] - now_s
            frame[at.offered + filled], frame[at.station_free + filled] = 1.0, station_free[e, filled]
            frame[at.age_s + filled] = min(max(now_s - job["queued_s"], 0.0), LONG_S)
            frame[at.payload_kg + filled] = min(t.payload_kg[fleet, kind], most_kg)
            frame[at.value + filled] = min(max(t.value[fleet, kind], 0.0), most_value)
            frame[at.returns + filled] = min(job["returns"], most_returns)
            frame[at.expires + filled] = job["expires"]
            filled += 1
        for k in range(filled, filled_before):
            frame[at.offered + k] = frame[at.age_s + k] = frame[at.payload_kg + k] = 0.0
            frame[at.value + k] = frame[at.returns + k] = frame[at.station_free + k] = frame[at.expires + k] = 0.0
            for peer in range(peers):
                frame[at.peer_known + peer * slots + k] = frame[at.peer_difficulty + peer * slots + k] = 0.0
        filled_before = filled
        for a in range(arms):
            arm, noise_k = s.arms[e, a], t.law[fleet, a]["sensor_noise_k"]
            for k in range(JOINTS):
                true_c[k] = arm["temp_c"][k] + noise_k[k] * random_normal(key, count + np.uint64(k + 1))
                measured_c[a, k] = true_c[k]
            count += np.uint64(JOINTS)
            hottest_c[a] = hottest(true_c)
            headroom_k[a] = min(max(warning_c - hottest_c[a], low_k), high_k)
            left_s[a] = 0.0
            if arm["mode"] == WORKING:
                times_s = t.plans[nonnegative(arm["plan"])]["times_s"]
                busy_s = times_s[0] + times_s[2] + arm["todo"] * times_s[1] - arm["progress_s"]
                left_s[a] = min(max(busy_s, 0.0), LONG_S)
            for k in range(filled):
                known[a, k] = shared[a, k] = 0.0
                for n in range(options):
                    score = work[fleet, slot_kind[k], a, n]["difficulty"]
                    if not np.isnan(score) and (known[a, k] == 0.0 or score < shared[a, k]):
                        known[a, k], shared[a, k] = 1.0, score
        for a in range(arms):
            for n in range(first[a], first[a + 1]):
                peer, b = nonnegative(change[n, 0]), nonnegative(change[n, 1])
                frame[at.peer_working + peer] = s.arms[e, b]["mode"] == WORKING
                frame[at.peer_faulted + peer] = s.arms[e, b]["mode"] == FAULTED
                frame[at.peer_headroom_k + peer], frame[at.peer_busy_s + peer] = headroom_k[b], left_s[b]
                for k in range(filled):
                    frame[at.peer_known + peer * slots + k] = known[b, k]
                    frame[at.peer_difficulty + peer * slots + k] = shared[b, k]
            for i in range(size):
                out[e, a, i] = frame[i]
            arm = s.arms[e, a]
            mode = nonnegative(arm["mode"])
            out[e, a, at.idle + mode] = 1.0
            out[e, a, at.busy_s], out[e, a, at.last_award] = left_s[a], arm["last_award"]
            air_c = t.ambient_c[fleet, min(tick, t.ticks - 1), a] + env["ambient_offset_k"]
            for k in range(JOINTS):
                out[e, a, at.temp_c + k] = min(max(measured_c[a, k], low_c), high_c)
                out[e, a, at.housing_c + k] = min(max(arm["housing_c"][k], low_c), high_c)
                known_c[k], known_c[JOINTS + k] = measured_c[a, k], arm["housing_c"][k]
            known_c[2 * JOINTS] = air_c
            out[e, a, at.headroom_k], out[e, a, at.ambient_c] = headroom_k[a], min(max(air_c, low_c), high_c)
            out[e, a, at.error_headroom_k] = min(max(error_c - hottest_c[a], low_k), high_k)
            if mode == WORKING and arm["pending"]:
                job, plan = s.jobs[e, nonnegative(arm["job"])], nonnegative(arm["plan"])
                kind, times_s = nonnegative(job["kind"]), t.plans[plan]["times_s"]
                out[e, a, at.job_value] = min(max(t.value[fleet, kind], 0.0), most_value)
                over_s = max(arm["progress_s"] - times_s[0], 0.0)
                cycles_over = min(int(over_s / max(times_s[1], 1e-9) + 1e-9), arm["todo"])
                out[e, a, at.job_cycles] = min(job["repetitions"] - job["cycles"] - cycles_over, LONG_S)
                for n in range(options):
                    own = work[fleet, kind, a, n]
                    if own["plan"] == plan:
                        p, risk, peak, peak_c = own["p_saturation"], own["risk"], own["peak"], 0.0
                        if risk >= 0 or peak >= 0:
                            p, peak_c = predict(p, risk, peak, first_block, block, curve, known_c, left_s[a], values_c)
                            if peak >= 0:
                                peak_c = max(peak_c, warning_c - headroom_k[a])
                        out[e, a, at.job_p] = 0.5 if np.isnan(p) else p
                        out[e, a, at.job_peak_c] = min(max(peak_c, PEAK_LOW_C), PEAK_HIGH_C)
            for k in range(filled):
                kind = nonnegative(slot_kind[k])
                out[e, a, at.too_heavy + k] = t.too_heavy[fleet, kind, a]
                for n in range(options):  # without branches: few of these conditions can be guessed
                    own, option = work[fleet, kind, a, n], k * options + n
                    can, open_space = own["plan"] >= 0, not is_closed(closed, own["volume"])
                    duration_s, score, p = (
                        own["travel_s"] + left[k] * own["cycle_s"],
                        own["difficulty"],
                        own["p_saturation"],
                    )
                    late_s, is_known = min(max(slack_s[k] - duration_s, -LONG_S), LONG_S), can & (score == score)
                    out[e, a, at.feasible + option], out[e, a, at.space_free + option] = can, can & open_space
                    out[e, a, at.duration_s + option] = min(duration_s, LONG_S)
                    out[e, a, at.slack_s + option] = late_s if can else 0.0
                    out[e, a, at.known + option], out[e, a, at.difficulty + option] = (
                        is_known,
                        score if is_known else 0.0,
                    )
                    out[e, a, at.p_saturation + option] = p if p == p else 0.5
            for k in range(filled):
                own = work[fleet, slot_kind[k], a, 0]
                fast_volume[k], fast_can[k] = nonnegative(own["volume"]), own["plan"] >= 0
            for peer in range(peers):
                other = s.arms[e, who[a, peer]]["plan"]
                if other >= 0:
                    for k in range(filled):
                        blocked = is_closed(t.excluded[other], fast_volume[k]) & fast_can[k]
                        out[e, a, at.peer_blocks + peer * slots + k] = blocked
            if forecasts:
                for k in range(filled):
                    for n in range(options):
                        own, option = work[fleet, slot_kind[k], a, n], k * options + n
                        p, risk, peak = own["p_saturation"], own["risk"], own["peak"]
                        if risk >= 0 or peak >= 0:
                            # All cycles, also of a job that came back: moments in between are not predicted.
                            p, peak_c = predict(p, risk, peak, first_block, block, curve, known_c, np.inf, values_c)
                            out[e, a, at.peak_c + option] = min(max(peak_c, PEAK_LOW_C), PEAK_HIGH_C)
                            if not np.isnan(p):
                                out[e, a, at.p_saturation + option] = p


@jit_inline
def predict(
    p: float, risk: int, peak: int, first: Array, block: Array, curve: Array, known_c: Array, left_s: float, room: Array
) -> tuple[float, float]:
    """P(saturation), NaN if unknown, and predicted peak temperature, °C, 0 if unknown, of a plan.

    Arrays of forecasts are arguments of their own: to pass a tuple of them takes longer than to use it.

    Args:
        p: From a model that ignores the temperatures; NaN if there is none.
        risk: Row of the forecast of P, −1 for none.
        peak: Row of the forecast of the peak temperature, −1 for none.
        first, block, curve: Forecasts; see `fleet.engine.tables.Tables`.
        known_c: [KNOWN].
        left_s: Pieces of later moments do not count.
        room: For the values of some pieces, [lane].
    """
    peak_c = 0.0
    if peak >= 0:
        peak_c = largest_piece(first, block, peak, known_c, left_s, room)
        if curve.shape[1] > 0 and risk < 0 and np.isnan(p) and not np.isnan(curve[peak, 0, 0]):
            p = probability_of(peak_c, curve[peak])
    if risk >= 0:
        p = probability_of(largest_piece(first, block, risk, known_c, left_s, room), curve[risk])
    return p, peak_c


@jit_inline
def largest_piece(first: Array, block: Array, row: int, known_c: Array, left_s: float, room: Array) -> float:
    """Value of a forecast without the pieces of moments later than `left_s`, −inf if none is left."""
    most = -np.inf
    for b in range(nonnegative(first[row]), nonnegative(first[row + 1])):
        for lane in range(LANES):
            total = block[b, 0, lane]
            for i in range(KNOWN):
                total += block[b, 2 + i, lane] * known_c[i]
            room[lane] = total
        for lane in range(LANES):
            if block[b, 1, lane] <= left_s:
                most = max(most, room[lane])
    return most
