"""What every arm knows, compiled: the observation of many shifts in which every word is heard at once.

`fleet.env.observation` is the plain form, says what every field means, and holds the layout; a test holds the two
together.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from fleet.env.observation import FIELDS, LONG_S, Layout
from fleet.robot import JOINTS
from fleet.sim.boiling import hottest
from fleet.sim.jit import entry, inner, natural
from fleet.sim.noise import FIRST, GOLDEN, LEVELS, QUANTILES, SECOND
from fleet.sim.rows import award, hang_out, live
from fleet.sim.tables import LANES, RISK, Drawn, Offer, Rows, Tables
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


class Form(NamedTuple):
    """A `Layout` as compiled code wants it."""

    start: Array
    """Where each field begins in the vector, int [field]."""
    low: Array
    high: Array
    """Bounds of the vector, float32 [size]."""
    first: Array
    """Where the changes of each arm begin and end below, int [arm + 1]."""
    change: Array
    """Who is told of otherwise in an arm's vector than in that of the arm before: place and arm, int [change, 2]."""


def form_of(layout: Layout) -> Form:
    """Of the first arm every peer is a change; of a fleet that hears all, of any other just one."""
    changes, first, shown = [], [0], [-1] * layout.peers
    for peers in layout.who.tolist():
        changes += [(place, arm) for place, arm in enumerate(peers) if shown[place] != arm]
        first.append(len(changes))
        shown = peers
    low, high = layout.bounds
    return Form(np.array(layout.starts), low, high, np.array(first), np.array(changes, dtype=int).reshape(-1, 2))


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
def at_risk(scores: Array, curve: Array, row: int, temp_c: Array, a: int) -> float:
    """Probability to pass the warning limit from motor temperatures [arm, joint, then 1]; see `Risk.at`."""
    score = -np.inf
    for piece in range(scores.shape[1]):
        near = scores[row, piece, 0] * temp_c[a, 0] + scores[row, piece, 1] * temp_c[a, 1]
        near += scores[row, piece, 2] * temp_c[a, 2] + scores[row, piece, 3] * temp_c[a, 3]
        far = scores[row, piece, 4] * temp_c[a, 4] + scores[row, piece, 5] * temp_c[a, 5]
        far += scores[row, piece, 6] * temp_c[a, 6] + scores[row, piece, 7] * temp_c[a, 7]
        score = max(score, near + far)
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
    form: Form,
    out: Array,
) -> None:
    """The vectors of the arms of some envs; arguments as in `look`."""
    lots, kinds, keys, repetitions, due_s = d.lot, d.kind, d.key, d.repetitions, d.due_s
    ticks, temp_c, modes, progress_s, todo = s.tick, s.temp_c, s.mode, s.progress_s, s.todo
    last, queued_s, cycles, returns = s.last_award, s.queued_s, s.cycles, s.returns
    on_offer, hand = o.on_offer, o.hand
    noise_k, words, payload_kg, values = t.noise_k, t.word, t.payload_kg, t.value
    scores, curve = t.score, t.curve
    arms, slots = natural(modes.shape[1]), natural(on_offer.shape[1])
    start, low, high, first, change = form.start, form.low, form.high, form.first, form.change
    size = natural(out.shape[2])
    c_clock, c_mode = natural(start[CLOCK]), natural(start[MODE])
    c_busy, c_last = natural(start[BUSY]), natural(start[LAST_AWARD])
    c_temp, c_headroom = natural(start[TEMP]), natural(start[HEADROOM])
    c_slots, c_peers = natural(start[OFFERED]), natural(start[PEER_HEARD])
    c_offered, c_feasible, c_known, c_difficulty, c_p, c_duration, c_slack, c_age, c_payload, c_value, c_returns = (
        c_slots, c_slots + slots, c_slots + 2 * slots, c_slots + 3 * slots, c_slots + 4 * slots, c_slots + 5 * slots,
        c_slots + 6 * slots, c_slots + 7 * slots, c_slots + 8 * slots, c_slots + 9 * slots, c_slots + 10 * slots,
    )  # fmt: skip
    peers = natural((size - c_peers) // (5 + 2 * slots))
    c_working = c_peers + 2 * peers
    c_peer_known, c_told = c_peers + 5 * peers, c_peers + 5 * peers + peers * slots
    low_c, high_c, low_k, high_k = low[c_temp], high[c_temp], low[c_headroom], high[c_headroom]
    most_kg, most_value, most_returns = high[c_payload], high[c_value], high[c_returns]
    one, measured, hot_k = np.empty(LANES), np.empty((arms, LANES)), np.empty(arms, np.float32)
    left, slack_s, kind_of = np.empty(slots), np.empty(slots), np.empty(slots, np.int64)
    known, told = np.zeros((arms, slots), np.float32), np.zeros((arms, slots), np.float32)
    # The vector of the arm at hand, but for what is its own: with no job on offer, and all peers heard now.
    frame = np.zeros(size, np.float32)
    for k in range(slots):
        frame[c_p + k] = 0.5
    for peer in range(peers):
        frame[c_peers + peer] = 1.0
    before = 0  # jobs on offer in the env before: what is to be wiped away
    for row in rows:
        e = natural(row)
        lot, now_s, key = natural(lots[e]), ticks[e] * t.dt_s, keys[e]
        count = natural(ticks[e]) * arms * JOINTS
        frame[c_clock] = now_s / (t.ticks * t.dt_s)
        found = 0
        while found < slots and on_offer[e, found] >= 0:
            j = natural(on_offer[e, found])
            kind = natural(kinds[e, j])
            kind_of[found] = kind
            left[found], slack_s[found] = repetitions[e, j] - cycles[e, j], due_s[e, j] - now_s
            frame[c_offered + found] = 1.0
            frame[c_age + found] = min(max(now_s - queued_s[e, j], 0.0), LONG_S)
            frame[c_payload + found] = min(payload_kg[lot, kind], most_kg)
            frame[c_value + found] = min(max(values[lot, kind], 0.0), most_value)
            frame[c_returns + found] = min(returns[e, j], most_returns)
            found += 1
        for k in range(found, before):
            frame[c_offered + k] = frame[c_age + k] = frame[c_payload + k] = 0.0
            frame[c_value + k] = frame[c_returns + k] = 0.0
            for peer in range(peers):
                frame[c_peer_known + peer * slots + k] = frame[c_told + peer * slots + k] = 0.0
        before = found
        for a in range(arms):
            for k in range(LANES):
                one[k] = temp_c[e, a, k] + noise_k[lot, a, k] * noise(key, count + k + 1)
                measured[a, k] = one[k]
            count += JOINTS
            measured[a, JOINTS] = 1.0
            hot_k[a] = min(max(t.warning_c - hottest(one), low_k), high_k)
            for k in range(found):
                known[a, k], told[a, k] = words[lot, a, kind_of[k], 2], words[lot, a, kind_of[k], 3]
        for a in range(arms):
            for n in range(first[a], first[a + 1]):
                peer, b = natural(change[n, 0]), natural(change[n, 1])
                place = c_working + peer
                frame[place], frame[place + peers] = modes[e, b] == WORKING, modes[e, b] == FAULTED
                frame[place + 2 * peers] = hot_k[b]
                place = c_peer_known + peer * slots
                for k in range(found):
                    frame[place + k] = known[b, k]
                    frame[place + peers * slots + k] = told[b, k]
            for i in range(size):
                out[e, a, i] = frame[i]
            mode = natural(modes[e, a])
            out[e, a, c_mode + mode] = 1.0
            if mode == WORKING:
                kind = natural(hand[e, a])
                busy_s = words[lot, a, kind, 0] + todo[e, a] * words[lot, a, kind, 1] - progress_s[e, a]
                out[e, a, c_busy] = min(max(busy_s, 0.0), LONG_S)
            out[e, a, c_last] = last[e, a]
            for k in range(JOINTS):
                out[e, a, c_temp + k] = min(max(measured[a, k], low_c), high_c)
            out[e, a, c_headroom] = hot_k[a]
            for k in range(found):
                kind = natural(kind_of[k])
                duration_s = words[lot, a, kind, 0] + left[k] * words[lot, a, kind, 1]
                out[e, a, c_feasible + k] = duration_s > 0
                out[e, a, c_duration + k] = min(duration_s, LONG_S)
                out[e, a, c_slack + k] = min(max(slack_s[k] - duration_s, -LONG_S), LONG_S)
                out[e, a, c_known + k], out[e, a, c_difficulty + k] = known[a, k], told[a, k]
                p, risk = words[lot, a, kind, 4], int(words[lot, a, kind, RISK])
                if risk >= 0:
                    p = at_risk(scores, curve, natural(risk), measured, a)
                out[e, a, c_p + k] = p


@entry
def look(
    t: Tables,
    d: Drawn,
    s: Rows,
    o: Offer,
    rows: Array,
    form: Form,
    out: Array,
) -> None:
    """What the arms of some envs know, and what hangs out there.

    Args:
        rows: Which envs, int [row].
        form: Of the vectors.
        out: Takes the vectors, float32 [env, arm, size].
    """
    hang_out(t, d, s, o, rows)
    perceive(t, d, s, o, rows, form, out)


@entry
def turn(
    t: Tables,
    d: Drawn,
    s: Rows,
    o: Offer,
    actions: Array,
    worth: Array,
    terms: Array,
    rows: Array,
    form: Form,
    out: Array,
) -> None:
    """One step of all envs, and what their arms know thereafter.

    Args:
        actions: int64 [env, arm].
        worth: Of a unit of each reward term, [term].
        terms: Takes the reward terms and their sum, [env, term + 1].
        rows: All envs, int [env].
        form, out: As in `look`.
    """
    for first in range(0, len(rows), BLOCK):
        some = rows[first : first + BLOCK]
        award(t, d, s, o, actions, some)
        live(t, d, s, o, worth, terms, some)
        hang_out(t, d, s, o, some)
        perceive(t, d, s, o, some, form, out)
