"""What every arm knows, compiled: the observation of many shifts in which every word is heard at once.

`fleet.env.observation` is the plain form, says what every field means, and holds the layout; a test holds the two
together.
"""

import math
from typing import Any

import numpy as np

from fleet.env.observation import FIELDS, LONG_S
from fleet.robot import JOINTS
from fleet.sim.boiling import hottest
from fleet.sim.jit import entry, inner, natural
from fleet.sim.noise import FIRST, GOLDEN, LEVELS, QUANTILES, SECOND
from fleet.sim.rows import award, hang_out, live
from fleet.sim.tables import LANES, Drawn, Offer, Rows, Tables
from fleet.telemetry import FAULTED, IDLE, WORKING

Array = np.ndarray

_PLACE = {field.name: place for place, field in enumerate(FIELDS)}
CLOCK, MODE, BUSY, LAST_AWARD = (_PLACE[name] for name in ("clock", "idle", "busy_s", "last_award"))
TEMP, HEADROOM = _PLACE["temp_c"], _PLACE["headroom_k"]
OFFERED, PEER_HEARD = _PLACE["offered"], _PLACE["peer_heard"]
assert [_PLACE[name] - MODE for name in ("idle", "working", "faulted")] == [IDLE, WORKING, FAULTED]
assert [field.name for field in FIELDS[OFFERED:]] == [
    "offered", "feasible", "known", "difficulty", "p_saturation", "duration_s", "slack_s", "age_s", "payload_kg",
    "value", "returns", "peer_heard", "peer_age_s", "peer_working", "peer_faulted", "peer_headroom_k", "peer_known",
    "peer_difficulty",
]  # fmt: skip


BLOCK = 128
"""Envs that go through a whole step together, few enough to stay in the cache."""
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
    noise_k, words, payload_kg, values, risks = t.noise_k, t.word, t.payload_kg, t.value, t.risk
    offset, weight, curve = t.offset, t.weight, t.curve
    arms, slots = natural(modes.shape[1]), natural(on_offer.shape[1])
    measured, headroom = np.empty(LANES), np.empty(arms, np.float32)
    said = np.empty((2, arms * slots), np.float32)  # whether an arm knows a difficulty for a slot, and which
    left, slack_s = np.empty(slots), np.empty(slots)
    shared = np.zeros(5 * slots, np.float32)  # what all arms see alike of the slots, field by field
    c_clock, c_mode = natural(start[CLOCK]), natural(start[MODE])
    c_busy, c_last = natural(start[BUSY]), natural(start[LAST_AWARD])
    c_temp, c_headroom = natural(start[TEMP]), natural(start[HEADROOM])
    c_slots, c_peers = natural(start[OFFERED]), natural(start[PEER_HEARD])
    c_offered, c_feasible, c_known, c_difficulty, c_p, c_duration, c_slack, c_age, c_payload, c_value, c_returns = (
        c_slots, c_slots + slots, c_slots + 2 * slots, c_slots + 3 * slots, c_slots + 4 * slots, c_slots + 5 * slots,
        c_slots + 6 * slots, c_slots + 7 * slots, c_slots + 8 * slots, c_slots + 9 * slots, c_slots + 10 * slots,
    )  # fmt: skip
    peers = arms - 1
    c_heard_age, c_working, c_faulted, c_room = (
        c_peers + peers,
        c_peers + 2 * peers,
        c_peers + 3 * peers,
        c_peers + 4 * peers,
    )
    c_peer_known, c_told = c_peers + 5 * peers, c_peers + 5 * peers + peers * slots
    low_c, high_c, low_k, high_k = low[c_temp], high[c_temp], low[c_headroom], high[c_headroom]
    most_kg, most_value, most_returns = high[c_payload], high[c_value], high[c_returns]
    for row in rows:
        e = natural(row)
        lot, now_s, key = natural(lots[e]), ticks[e] * t.dt_s, keys[e]
        count = natural(ticks[e]) * arms * JOINTS
        clock = now_s / (t.ticks * t.dt_s)
        found = 0
        while found < slots and on_offer[e, found] >= 0:
            j = natural(on_offer[e, found])
            kind = natural(kinds[e, j])
            left[found], slack_s[found] = repetitions[e, j] - cycles[e, j], due_s[e, j] - now_s
            shared[found] = 1.0
            shared[slots + found] = min(max(now_s - queued_s[e, j], 0.0), LONG_S)
            shared[2 * slots + found] = min(payload_kg[lot, kind], most_kg)
            shared[3 * slots + found] = min(max(values[lot, kind], 0.0), most_value)
            shared[4 * slots + found] = min(returns[e, j], most_returns)
            found += 1
        for m in range(5):
            for k in range(found, slots):
                shared[m * slots + k] = 0.0
        for a in range(arms):
            mode = modes[e, a]
            out[e, a, c_clock] = clock
            for m in range(3):
                out[e, a, c_mode + m] = m == mode
            busy_s = 0.0
            if mode == WORKING:
                kind = natural(kinds[e, natural(in_hand[e, a])])
                busy_s = words[lot, a, kind, 0] + todo[e, a] * words[lot, a, kind, 1] - progress_s[e, a]
            out[e, a, c_busy] = min(max(busy_s, 0.0), LONG_S)
            out[e, a, c_last] = last[e, a]
            for k in range(LANES):
                measured[k] = temp_c[e, a, k] + noise_k[lot, a, k] * noise(key, count + k + 1)
            for k in range(JOINTS):
                out[e, a, c_temp + k] = min(max(measured[k], low_c), high_c)
            count += JOINTS
            headroom[a] = min(max(t.warning_c - hottest(measured), low_k), high_k)
            out[e, a, c_headroom] = headroom[a]
            for k in range(slots):
                out[e, a, c_offered + k] = shared[k]
            for i in range(4 * slots):
                out[e, a, c_age + i] = shared[slots + i]
            for k in range(found):
                kind = natural(kinds[e, natural(on_offer[e, k])])
                duration_s = words[lot, a, kind, 0] + left[k] * words[lot, a, kind, 1]
                out[e, a, c_feasible + k] = duration_s > 0
                out[e, a, c_duration + k] = min(duration_s, LONG_S)
                out[e, a, c_slack + k] = min(max(slack_s[k] - duration_s, -LONG_S), LONG_S)
                said[0, a * slots + k], said[1, a * slots + k] = words[lot, a, kind, 2], words[lot, a, kind, 3]
                p, risk = words[lot, a, kind, 4], risks[lot, a, kind]
                if risk >= 0:
                    p = at_risk(offset, weight, curve, natural(risk), measured)
                out[e, a, c_p + k] = p
            for k in range(found, slots):
                out[e, a, c_feasible + k] = out[e, a, c_duration + k] = out[e, a, c_slack + k] = 0.0
                out[e, a, c_p + k] = 0.5
                said[0, a * slots + k] = said[1, a * slots + k] = 0.0
            for k in range(slots):
                out[e, a, c_known + k] = said[0, a * slots + k]
            for k in range(slots):
                out[e, a, c_difficulty + k] = said[1, a * slots + k]
        for a in range(arms):
            peer = 0
            for b in range(arms):
                if b != a:
                    out[e, a, c_peers + peer], out[e, a, c_heard_age + peer] = 1.0, 0.0
                    out[e, a, c_working + peer] = modes[e, b] == WORKING
                    out[e, a, c_faulted + peer] = modes[e, b] == FAULTED
                    out[e, a, c_room + peer] = headroom[b]
                    peer += 1
            before, behind = a * slots, (arms - 1 - a) * slots
            for m in range(2):
                place = c_told if m else c_peer_known
                for i in range(before):
                    out[e, a, place + i] = said[m, i]
                for i in range(behind):
                    out[e, a, place + before + i] = said[m, before + slots + i]


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
        raw: Takes the reward terms, not weighted, [term, env].
        rows: All envs, int [env].
        start, low, high, out: As in `look`.
    """
    for first in range(0, len(rows), BLOCK):
        some = rows[first : first + BLOCK]
        award(t, d, s, o, actions, some)
        live(t, d, s, o, raw, some)
        hang_out(t, d, s, o, some)
        perceive(t, d, s, o, some, start, low, high, out)
