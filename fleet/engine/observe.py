"""What every arm knows at a moment: one observation vector per arm of many envs.

`fleet.observation` says what the fields mean. Peers are those of this moment; where messages take time or get lost,
`fleet.engine.peers` replaces the peers' fields by what was delivered.
"""

import numpy as np

from fleet.difficulty import passing_probability
from fleet.engine.claims import is_free
from fleet.engine.crossings import hottest
from fleet.engine.tables import LANES, Simulation
from fleet.jit import jit_inline, nonnegative
from fleet.observation import LONG_S
from fleet.robot import JOINTS
from fleet.seeding import random_normal
from fleet.telemetry import FAULTED, IDLE, WORKING

Array = np.ndarray

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
    plan_of, own_space, excluded, taken = t.plan, t.own_space, t.excluded, o.taken
    noise_k, payload_kg, values, work = t.sensor_noise_k, t.payload_kg, t.value, t.work
    forecast_offset, forecast_weight, forecast_curve = t.forecast_offset, t.forecast_weight, t.forecast_curve
    arms, slots, options = nonnegative(modes.shape[1]), nonnegative(slot_job.shape[1]), nonnegative(plan_of.shape[3])
    at, low, high, first, change = form.offsets, form.low, form.high, form.first_change, form.change
    size = nonnegative(out.shape[2])
    peers = nonnegative((size - at.peer_heard) // (5 + 2 * slots))
    low_c, high_c, low_k, high_k = low[at.temp_c], high[at.temp_c], low[at.headroom_k], high[at.headroom_k]
    most_kg, most_value, most_returns = high[at.payload_kg], high[at.value], high[at.returns]
    true_c, measured_c, headroom_k = np.empty(LANES), np.empty((arms, LANES)), np.empty(arms, np.float32)
    left, slack_s, slot_kind = np.empty(slots), np.empty(slots), np.empty(slots, np.int64)
    known, shared = np.zeros((arms, slots), np.float32), np.zeros((arms, slots), np.float32)
    away = np.zeros(taken.shape[1], np.uint64)  # space that other arms take
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
            filled += 1
        for k in range(filled, filled_before):
            frame[at.offered + k] = frame[at.age_s + k] = frame[at.payload_kg + k] = 0.0
            frame[at.value + k] = frame[at.returns + k] = frame[at.station_free + k] = 0.0
            for peer in range(peers):
                frame[at.peer_known + peer * slots + k] = frame[at.peer_difficulty + peer * slots + k] = 0.0
        filled_before = filled
        for a in range(arms):
            for k in range(LANES):
                true_c[k] = temp_c[e, a, k] + noise_k[fleet, a, k] * random_normal(key, count + np.uint64(k + 1))
                measured_c[a, k] = true_c[k]
            count += np.uint64(JOINTS)
            headroom_k[a] = min(max(t.warning_c - hottest(true_c), low_k), high_k)
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
                frame[at.peer_headroom_k + peer] = headroom_k[b]
                for k in range(filled):
                    frame[at.peer_known + peer * slots + k] = known[b, k]
                    frame[at.peer_difficulty + peer * slots + k] = shared[b, k]
            for i in range(size):
                out[e, a, i] = frame[i]
            mode = nonnegative(modes[e, a])
            out[e, a, at.idle + mode] = 1.0
            if mode == WORKING:
                plan = nonnegative(plans[e, a])
                busy_s = times_s[plan, 0] + times_s[plan, 2] + todo[e, a] * times_s[plan, 1] - progress_s[e, a]
                out[e, a, at.busy_s] = min(max(busy_s, 0.0), LONG_S)
            out[e, a, at.last_award] = last[e, a]
            for k in range(JOINTS):
                out[e, a, at.temp_c + k] = min(max(measured_c[a, k], low_c), high_c)
            out[e, a, at.headroom_k] = headroom_k[a]
            for w in range(len(away)):
                away[w] = taken[e, w] & ~own_space[plans[e, a], w] if plans[e, a] >= 0 else taken[e, w]
            for k in range(filled):
                kind = nonnegative(slot_kind[k])
                for n in range(options):
                    plan, option = plan_of[fleet, a, kind, n], k * options + n
                    if plan < 0:
                        continue
                    own = work[fleet, a, kind, n]
                    duration_s, score = own["travel_s"] + left[k] * own["cycle_s"], own["difficulty"]
                    out[e, a, at.feasible + option], out[e, a, at.space_free + option] = (
                        1.0,
                        is_free(excluded, plan, away),
                    )
                    out[e, a, at.duration_s + option] = min(duration_s, LONG_S)
                    out[e, a, at.slack_s + option] = min(max(slack_s[k] - duration_s, -LONG_S), LONG_S)
                    if not np.isnan(score):
                        out[e, a, at.known + option], out[e, a, at.difficulty + option] = 1.0, score
                    p, r = own["p_saturation"], own["risk"]
                    if r >= 0:
                        p = passing_probability(forecast_offset[r], forecast_weight[r], forecast_curve[r], measured_c[a])
                    if not np.isnan(p):
                        out[e, a, at.p_saturation + option] = p
