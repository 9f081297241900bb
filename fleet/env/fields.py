"""What every arm knows, compiled: the observation of many shifts in which every word is heard at once.

`fleet.env.observation` is the plain form, says what every field means, and holds the layout; a test holds the two
together.
"""

import math
from typing import Any

import numpy as np

from fleet.env.observation import FIELDS, LONG_S
from fleet.robot import JOINTS
from fleet.sim.jit import entry, inner
from fleet.sim.noise import FIRST, GOLDEN, LEVELS, QUANTILES, SECOND
from fleet.sim.rows import award, hang_out, live
from fleet.sim.tables import Drawn, Offer, Rows, Tables
from fleet.telemetry import FAULTED, IDLE, WORKING

Array = np.ndarray

_PLACE = {field.name: place for place, field in enumerate(FIELDS)}
CLOCK, MODE, BUSY, LAST_AWARD = (_PLACE[name] for name in ("clock", "idle", "busy_s", "last_award"))
TEMP, HEADROOM = _PLACE["temp_c"], _PLACE["headroom_k"]
OFFERED, FEASIBLE, KNOWN = (_PLACE[name] for name in ("offered", "feasible", "known"))
DIFFICULTY, P_SATURATION = _PLACE["difficulty"], _PLACE["p_saturation"]
DURATION, SLACK, AGE = (_PLACE[name] for name in ("duration_s", "slack_s", "age_s"))
PAYLOAD, VALUE, RETURNS = (_PLACE[name] for name in ("payload_kg", "value", "returns"))
PEER_HEARD, PEER_AGE = _PLACE["peer_heard"], _PLACE["peer_age_s"]
PEER_WORKING, PEER_FAULTED = _PLACE["peer_working"], _PLACE["peer_faulted"]
PEER_HEADROOM = _PLACE["peer_headroom_k"]
PEER_KNOWN, PEER_DIFFICULTY = _PLACE["peer_known"], _PLACE["peer_difficulty"]
assert [_PLACE[name] - MODE for name in ("idle", "working", "faulted")] == [IDLE, WORKING, FAULTED]


_GOLDEN, _FIRST, _SECOND = np.uint64(GOLDEN), np.uint64(FIRST), np.uint64(SECOND)
_30, _27, _31, _32, _LEVELS = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(32), np.uint64(LEVELS - 1)


@inner
def noise(key: Any, count: int) -> Any:
    """One value of `fleet.sim.noise.standard_normal`."""
    word = key + np.uint64(count) * _GOLDEN
    word = (word ^ (word >> _30)) * _FIRST
    word = (word ^ (word >> _27)) * _SECOND
    word ^= word >> _31
    first, second = word & _LEVELS, (word >> _32) & _LEVELS
    return QUANTILES[first] + QUANTILES[second]


@inner
def at_risk(offset: Array, weight: Array, curve: Array, row: int, temp_c: Array) -> float:
    """Probability to pass the warning limit from motor temperatures [joint]; see `Risk.at`."""
    score = -np.inf
    for piece in range(offset.shape[1]):
        here = offset[row, piece]
        if here == -np.inf:
            continue
        for k in range(JOINTS):
            here += weight[row, piece, k] * temp_c[k]
        score = max(score, here)
    knots = curve.shape[1]
    if knots == 0 or math.isnan(curve[row, 0, 0]):
        return 1.0 / (1.0 + math.exp(np.float32(-score)))
    right = 0
    while right < knots and score >= curve[row, right, 0]:
        right += 1
    below, above = max(right - 1, 0), min(right, knots - 1)
    x0, p0 = curve[row, below, 0], curve[row, below, 1]
    x1, p1 = curve[row, above, 0], curve[row, above, 1]
    if not (math.isfinite(x1) and x1 > x0):
        return p0
    return p0 + min(max((score - x0) / (x1 - x0), 0.0), 1.0) * (p1 - p0)


@inner
def perceive(
    t: Tables,
    d: Drawn,
    s: Rows,
    o: Offer,
    rows: Array,
    start: Array,
    low: Array,
    high: Array,
    out: Array,
) -> None:
    """The vectors of the arms of some envs; arguments as in `look`."""
    lots, kinds, keys, repetitions, due_s = d.lot, d.kind, d.key, d.repetitions, d.due_s
    ticks, temp_c, modes, in_hand, progress_s, todo = s.tick, s.temp_c, s.mode, s.job, s.progress_s, s.todo
    last, queued_s, cycles, returns, on_offer = s.last_award, s.queued_s, s.cycles, s.returns, o.on_offer
    noise_k, plans, times_s, difficulties = t.noise_k, t.plan, t.times_s, t.difficulty
    payload_kg, values, risks, p_saturation = t.payload_kg, t.value, t.risk, t.p_saturation
    offset, weight, curve = t.offset, t.weight, t.curve
    arms, slots = modes.shape[1], on_offer.shape[1]
    measured, headroom, scored = np.empty(JOINTS), np.empty(arms), np.empty((arms, slots), np.float32)
    known = np.empty((arms, slots), np.float32)
    c_clock, c_mode, c_busy, c_last = start[CLOCK], start[MODE], start[BUSY], start[LAST_AWARD]
    c_temp, c_headroom, c_offered, c_feasible = start[TEMP], start[HEADROOM], start[OFFERED], start[FEASIBLE]
    c_known, c_difficulty, c_p, c_duration = start[KNOWN], start[DIFFICULTY], start[P_SATURATION], start[DURATION]
    c_slack, c_age, c_payload, c_value = start[SLACK], start[AGE], start[PAYLOAD], start[VALUE]
    c_returns, c_heard, c_working, c_faulted = (
        start[RETURNS],
        start[PEER_HEARD],
        start[PEER_WORKING],
        start[PEER_FAULTED],
    )
    c_heard_age, c_peer_headroom, c_peer_known, c_told = (
        start[PEER_AGE],
        start[PEER_HEADROOM],
        start[PEER_KNOWN],
        start[PEER_DIFFICULTY],
    )
    low_c, high_c, low_k, high_k = low[c_temp], high[c_temp], low[c_headroom], high[c_headroom]
    for e in rows:
        lot, now_s, count = lots[e], ticks[e] * t.dt_s, ticks[e] * arms * JOINTS
        for a in range(arms):
            mode = modes[e, a]
            out[e, a, c_clock] = now_s / (t.ticks * t.dt_s)
            for m in range(3):
                out[e, a, c_mode + m] = m == mode
            out[e, a, c_busy] = 0.0
            if mode == WORKING:
                plan = plans[lot, a, kinds[e, in_hand[e, a]]]
                whole_s = times_s[plan, 0] + todo[e, a] * times_s[plan, 1] + times_s[plan, 2]
                out[e, a, c_busy] = min(max(whole_s - progress_s[e, a], 0.0), LONG_S)
            out[e, a, c_last] = last[e, a]
            top_c = -np.inf
            for k in range(JOINTS):
                count += 1
                measured[k] = temp_c[e, a, k] + noise_k[lot, a, k] * noise(keys[e], count)
                out[e, a, c_temp + k] = min(max(measured[k], low_c), high_c)
                top_c = max(top_c, measured[k])
            headroom[a] = t.warning_c - top_c
            out[e, a, c_headroom] = min(max(headroom[a], low_k), high_k)
            for k in range(slots):
                j = on_offer[e, k]
                scored[a, k], known[a, k] = 0.0, 0.0
                if j < 0:
                    for c in (c_offered, c_feasible, c_known, c_difficulty, c_duration, c_slack):
                        out[e, a, c + k] = 0.0
                    for c in (c_age, c_payload, c_value, c_returns):
                        out[e, a, c + k] = 0.0
                    out[e, a, c_p + k] = 0.5
                    continue
                kind = kinds[e, j]
                out[e, a, c_offered + k] = 1.0
                out[e, a, c_age + k] = min(max(now_s - queued_s[e, j], 0.0), LONG_S)
                out[e, a, c_payload + k] = min(payload_kg[lot, kind], high[c_payload])
                out[e, a, c_value + k] = min(max(values[lot, kind], 0.0), high[c_value])
                out[e, a, c_returns + k] = min(returns[e, j], high[c_returns])
                plan, duration_s = plans[lot, a, kind], 0.0
                if plan >= 0:
                    left = repetitions[e, j] - cycles[e, j]
                    duration_s = times_s[plan, 0] + left * times_s[plan, 1] + times_s[plan, 2]
                out[e, a, c_feasible + k] = duration_s > 0
                out[e, a, c_duration + k] = min(duration_s, LONG_S)
                out[e, a, c_slack + k] = min(max(due_s[e, j] - now_s - duration_s, -LONG_S), LONG_S)
                difficulty = difficulties[lot, a, kind]
                if not math.isnan(difficulty):
                    scored[a, k], known[a, k] = difficulty, 1.0
                out[e, a, c_known + k] = known[a, k]
                out[e, a, c_difficulty + k] = scored[a, k]
                risk = risks[lot, a, kind]
                p = p_saturation[lot, a, kind] if risk < 0 else at_risk(offset, weight, curve, risk, measured)
                out[e, a, c_p + k] = 0.5 if math.isnan(p) else p
        for a in range(arms):
            peer = 0
            for b in range(arms):
                if b == a:
                    continue
                out[e, a, c_heard + peer], out[e, a, c_heard_age + peer] = 1.0, 0.0
                out[e, a, c_working + peer] = modes[e, b] == WORKING
                out[e, a, c_faulted + peer] = modes[e, b] == FAULTED
                out[e, a, c_peer_headroom + peer] = min(max(headroom[b], low_k), high_k)
                first_known, first_told = c_peer_known + peer * slots, c_told + peer * slots
                for k in range(slots):
                    out[e, a, first_known + k] = known[b, k]
                    out[e, a, first_told + k] = scored[b, k]
                peer += 1


@entry
def look(
    t: Tables,
    d: Drawn,
    s: Rows,
    o: Offer,
    rows: Array,
    start: Array,
    low: Array,
    high: Array,
    out: Array,
) -> None:
    """What the arms of some envs know, and what hangs out there.

    Args:
        rows: Which envs, int [row].
        start: Where each field begins in the vector, int [field].
        low, high: Bounds of the vector, float32 [size].
        out: Takes the vectors, float32 [env, arm, size].
    """
    hang_out(t, d, s, o, rows)
    perceive(t, d, s, o, rows, start, low, high, out)


@entry
def turn(
    t: Tables,
    d: Drawn,
    s: Rows,
    o: Offer,
    actions: Array,
    raw: Array,
    rows: Array,
    start: Array,
    low: Array,
    high: Array,
    out: Array,
) -> None:
    """One step of all envs, and what their arms know thereafter.

    Args:
        actions: int64 [env, arm].
        raw: Takes the reward terms, not weighted, [env, term].
        rows: All envs, int [env].
        start, low, high, out: As in `look`.
    """
    award(t, d, s, o, actions)
    live(t, d, s, o, raw)
    hang_out(t, d, s, o, rows)
    perceive(t, d, s, o, rows, start, low, high, out)
