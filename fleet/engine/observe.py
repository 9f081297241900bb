"""What every arm knows at a moment: what all arms of an env know alike, and what each knows of itself.

`fleet.observation` says what the fields mean. What arms share is that of this moment; where messages take time or get
lost, `fleet.engine.shift` replaces it by what was delivered.
"""

import numpy as np

from fleet.difficulty import KNOWN, probability_of
from fleet.engine.claims import is_closed
from fleet.engine.corrections import line_of
from fleet.engine.crossings import hottest
from fleet.engine.state import LANES
from fleet.engine.tables import Simulation, Tables
from fleet.jit import Real, jit_inline, nonnegative
from fleet.observation import FIELDS, LONG_S
from fleet.robot import JOINTS
from fleet.seeding import random_normal
from fleet.telemetry import FAULTED, WORKING

Array = np.ndarray

_LOW, _HIGH = ({f.name: np.float32(each) for f, each in zip(FIELDS, bounds, strict=True)} for bounds in (
    [f.low for f in FIELDS], [f.high for f in FIELDS],
))  # fmt: skip
LOW_C, HIGH_C, LOW_K, HIGH_K = _LOW["temp_c"], _HIGH["temp_c"], _LOW["headroom_k"], _HIGH["headroom_k"]
PEAK_LOW_C, PEAK_HIGH_C = _LOW["peak_c"], _HIGH["peak_c"]
MOST_KG, MOST_VALUE, MOST_RETURNS = _HIGH["payload_kg"], _HIGH["value"], _HIGH["returns"]
_LONG_S, _ZERO, _ONE, _HALF = np.float32(LONG_S), np.float32(0.0), np.float32(1.0), np.float32(0.5)
NEVER = np.float32(-np.inf)
assert LANES == 8, "the largest of the lanes is found by halves"


@jit_inline
def observe(sim: Simulation, rows: Array, shared: Array, own: Array) -> None:
    """Put what the arms of some envs know into arrays.

    Args:
        rows: Envs, int [row].
        shared: What all arms know alike, float32 [env, shared].
        own: What each arm knows of itself, float32 [env, arm, own].
    """
    t, s, form = sim.tables, sim.state, sim.form
    arms, room = nonnegative(s.arms.shape[1]), sim.room
    measured_c, hottest_c, busy_s, known_c = room.measured_c, room.hottest_c, room.busy_s, room.known_c
    slot_kind, left, values_c = room.slot_kind, room.left, room.lanes[0]
    alike, forecasts = form.alike[0] != 0, len(t.forecast_curve) > 0
    for row in rows:
        e = nonnegative(row)
        filled = show_jobs(sim, e, shared[e], slot_kind, left)
        measure(sim, e, measured_c, hottest_c, busy_s)
        average_excess(sim, e, room.excess)
        if alike:
            show_members(sim, e, 0, shared[e], slot_kind, filled, hottest_c, busy_s)
        for a in range(arms):
            mine, arm = own[e, a], s.arms[e, a]
            for i in range(len(mine)):
                mine[i] = _ZERO
            if not alike:
                show_members(sim, e, a, mine, slot_kind, filled, hottest_c, busy_s)
            show_arm(sim, e, a, mine, measured_c[a], hottest_c[a], busy_s[a])
            shown = busy_s[a] <= form.ahead_s[0]
            ratio, offset_k = line_of(sim.moments[e, a]) if t.learns else (_ONE, _ZERO)
            for k in range(JOINTS):
                known_c[k], known_c[JOINTS + k] = measured_c[a, k] - offset_k, arm["housing_c"][k]
            known_c[2 * JOINTS] = air_at(t, s.env[e], a)
            if arm["mode"] == WORKING and arm["pending"]:
                show_job(sim, e, a, mine, hottest_c[a] - offset_k, busy_s[a], known_c, ratio, values_c)
            if shown:
                show_options(sim, e, a, mine, slot_kind, left, filled)
                if forecasts:
                    show_forecasts(sim, e, a, mine, slot_kind, filled, known_c, ratio, values_c)
        if form.bids[0] != 0:
            if alike:
                show_bids(sim, 0, shared[e], own[e], filled)
            else:
                for a in range(arms):
                    show_bids(sim, a, own[e, a], own[e], filled)


@jit_inline
def air_at(t: Tables, env: Array, a: int) -> Real:
    """Ambient temperature at an arm, °C."""
    moment = nonnegative(min(env["tick"], t.ticks - 1))
    return np.float32(t.ambient_c[nonnegative(env["fleet"]), moment, a] + env["ambient_offset_k"])


@jit_inline
def show_jobs(sim: Simulation, e: int, to: Array, slot_kind: Array, left: Array) -> int:
    """Put the jobs in the slots of an env into its shared part; return their number.

    Args:
        slot_kind: Receives their kinds, int [slot].
        left: Receives the repetitions that are left, [slot].
    """
    t, s, o, at, unit = sim.tables, sim.state, sim.offers, sim.form.offsets, sim.form.inverse
    env, jobs, slots = s.env[e], s.jobs[e], nonnegative(o.slot_job.shape[1])
    fleet, now_s = nonnegative(env["fleet"]), np.float32(env["tick"] * t.dt_s)
    for i in range(len(to)):
        to[i] = _ZERO
    to[at.left_s] = min(np.float32((t.ticks - env["tick"]) * t.dt_s), _LONG_S) * unit.left_s
    filled = 0
    while filled < slots and o.slot_job[e, filled] >= 0:
        k, job = filled, jobs[nonnegative(o.slot_job[e, filled])]
        kind = nonnegative(job["kind"])
        slot_kind[k], left[k] = kind, np.float32(job["repetitions"] - job["cycles"])
        to[at.group + k] = np.float32(o.group[e, k]) * unit.group
        to[at.station_free + k] = _ONE if o.station_free[e, k] else _ZERO
        to[at.age_s + k] = min(max(now_s - job["queued_s"], _ZERO), _LONG_S) * unit.age_s
        to[at.due_in_s + k] = min(max(job["due_s"] - now_s, -_LONG_S), _LONG_S) * unit.due_in_s
        to[at.payload_kg + k] = min(np.float32(t.payload_kg[fleet, kind]), MOST_KG) * unit.payload_kg
        to[at.value + k] = min(max(np.float32(t.value[fleet, kind]), _ZERO), MOST_VALUE) * unit.value
        to[at.returns + k] = min(np.float32(job["returns"]), MOST_RETURNS)
        to[at.expires + k] = _ONE if job["expires"] else _ZERO
        filled += 1
    return filled


@jit_inline
def measure(sim: Simulation, e: int, measured_c: Array, hottest_c: Array, busy_s: Array) -> None:
    """Read the sensors of all arms of an env.

    Args:
        measured_c: Receives their motor temperatures, [arm, lane].
        hottest_c: Receives the hottest of them, [arm].
        busy_s: Receives the time until each is home, [arm].
    """
    t, s = sim.tables, sim.state
    env, arms = s.env[e], nonnegative(s.arms.shape[1])
    fleet, key, count = nonnegative(env["fleet"]), env["noise_key"], np.uint64(env["tick"] * arms * JOINTS)
    for a in range(arms):
        arm, noise_k = s.arms[e, a], t.law[fleet, a]["sensor_noise_k"]
        drift_k = t.law[fleet, a]["drift_k_per_s"] * np.float32(env["tick"] * t.dt_s)
        for k in range(JOINTS):
            measured_c[a, k] = arm["temp_c"][k] + drift_k + noise_k[k] * random_normal(key, count + np.uint64(k + 1))
        count += np.uint64(JOINTS)
        hottest_c[a] = hottest(measured_c[a])
        busy_s[a] = _ZERO
        if arm["mode"] == WORKING:
            times_s = t.plans[nonnegative(arm["plan"])]["times_s"]
            home_s = times_s[0] + times_s[2] + arm["todo"] * times_s[1] - arm["progress_s"]
            busy_s[a] = min(max(np.float32(home_s), _ZERO), _LONG_S)


@jit_inline
def average_excess(sim: Simulation, e: int, mean: Array) -> None:
    """Average the excess of heat over the arms of an env that have measured it.

    Args:
        mean: Receives it, NaN where none has, float32 [work].
    """
    for work in range(len(mean)):
        total, count = _ZERO, 0
        for a in range(nonnegative(sim.excess.shape[1])):
            if sim.excess[e, a, work] == sim.excess[e, a, work]:
                total += sim.excess[e, a, work]
                count += 1
        mean[work] = total / np.float32(count) if count > 0 else np.float32(np.nan)


@jit_inline
def excess_of(sim: Simulation, e: int, a: int, kind: int, ratio: Real) -> Real:
    """Excess of heat that an arm assumes for a kind of job.

    It is its own measurement, else the mean of its peers if messages take no time, else 0; scaled by the `ratio` of
    `line_of`.
    """
    if not sim.tables.learns:
        return _ZERO
    work = nonnegative(sim.tables.alike[nonnegative(sim.state.env[e]["fleet"]), nonnegative(kind)])
    own, mean = sim.excess[e, a, work], sim.room.excess[work]
    if own != own:
        own = mean if sim.form.shares_heat[0] != 0 and mean == mean else _ZERO
    return (_ONE + own) * ratio - _ONE


@jit_inline
def show_members(
    sim: Simulation, e: int, a: int, to: Array, slot_kind: Array, filled: int, hottest_c: Array, busy_s: Array
) -> None:
    """Put what the members of an arm share into a part of the observation."""
    t, s, at, unit, members = sim.tables, sim.state, sim.form.offsets, sim.form.inverse, sim.form.members
    fleet, slots = nonnegative(s.env[e]["fleet"]), nonnegative(sim.offers.slot_job.shape[1])
    for m in range(members.shape[1]):
        b = nonnegative(members[a, m])
        mode = FAULTED if s.arms[e, b]["absent"] else s.arms[e, b]["mode"]
        to[at.fleet_working + m] = _ONE if mode == WORKING else _ZERO
        to[at.fleet_faulted + m] = _ONE if mode == FAULTED else _ZERO
        to[at.fleet_busy_s + m] = busy_s[b] * unit.fleet_busy_s
        headroom_k = min(max(np.float32(t.warning_c) - hottest_c[b], LOW_K), HIGH_K)
        to[at.fleet_headroom_k + m] = headroom_k * unit.fleet_headroom_k
        for k in range(filled):
            to[at.fleet_difficulty + m * slots + k] = t.least[fleet, slot_kind[k], b]


@jit_inline
def show_arm(sim: Simulation, e: int, a: int, mine: Array, measured_c: Array, hottest_c: Real, busy_s: Real) -> None:
    """Put what an arm knows of itself into its part."""
    t, arm, at, unit = sim.tables, sim.state.arms[e, a], sim.form.offsets, sim.form.inverse
    mine[at.working] = _ONE if arm["mode"] == WORKING else _ZERO
    mine[at.faulted] = _ONE if arm["mode"] == FAULTED else _ZERO
    mine[at.busy_s], mine[at.last_award] = busy_s * unit.busy_s, np.float32(arm["last_award"])
    break_in_s = np.float32((arm["break_tick"] - sim.state.env[e]["tick"]) * t.dt_s)  # failures are not known before
    mine[at.break_in_s] = min(max(break_in_s, _ZERO), _LONG_S) * unit.break_in_s
    for k in range(JOINTS):
        mine[at.temp_c + k] = min(max(measured_c[k], LOW_C), HIGH_C) * unit.temp_c
        mine[at.housing_c + k] = min(max(arm["housing_c"][k], LOW_C), HIGH_C) * unit.housing_c
    mine[at.ambient_c] = min(max(air_at(t, sim.state.env[e], a), LOW_C), HIGH_C) * unit.ambient_c
    mine[at.headroom_k] = min(max(np.float32(t.warning_c) - hottest_c, LOW_K), HIGH_K) * unit.headroom_k
    error_k = min(max(np.float32(t.error_c) - hottest_c, LOW_K), HIGH_K)
    mine[at.error_headroom_k] = error_k * unit.error_headroom_k


@jit_inline
def show_job(
    sim: Simulation,
    e: int,
    a: int,
    mine: Array,
    hottest_c: Real,
    busy_s: Real,
    known_c: Array,
    ratio: Real,
    room: Array,
) -> None:
    """Put an arm's current job into its part."""
    t, s, at, unit = sim.tables, sim.state, sim.form.offsets, sim.form.inverse
    arm, fleet = s.arms[e, a], nonnegative(s.env[e]["fleet"])
    job, plan = s.jobs[e, nonnegative(arm["job"])], nonnegative(arm["plan"])
    kind, times_s = nonnegative(job["kind"]), t.plans[plan]["times_s"]
    mine[at.job_value] = min(max(np.float32(t.value[fleet, kind]), _ZERO), MOST_VALUE) * unit.job_value
    over_s = max(arm["progress_s"] - times_s[0], 0.0)
    cycles_over = min(int(over_s / max(times_s[1], 1e-9) + 1e-9), arm["todo"])
    cycles = np.float32(job["repetitions"] - job["cycles"] - cycles_over)
    mine[at.job_cycles] = min(cycles, _LONG_S) * unit.job_cycles
    for n in range(t.work.shape[3]):
        work = t.work[fleet, kind, a, n]
        if work["plan"] == plan:
            p, peak_c = work["p_saturation"], _ZERO
            if work["risk"] >= 0 or work["peak"] >= 0:
                p, peak_c = predict(
                    p, work["risk"], work["peak"], t.forecast_first, t.forecast_block, t.forecast_curve, known_c,
                    busy_s, excess_of(sim, e, a, kind, ratio), room,
                )  # fmt: skip
                if work["peak"] >= 0:
                    peak_c = max(peak_c, min(max(hottest_c, LOW_C), HIGH_C))
            mine[at.job_p] = p if p == p else _HALF
            mine[at.job_peak_c] = min(max(peak_c, PEAK_LOW_C), PEAK_HIGH_C) * unit.job_peak_c


@jit_inline
def show_options(sim: Simulation, e: int, a: int, mine: Array, slot_kind: Array, left: Array, filled: int) -> None:
    """Put an arm's plans for the jobs in the slots into its part."""
    t, closed, at, unit = sim.tables, sim.offers.closed[e], sim.form.offsets, sim.form.inverse
    fleet, options = nonnegative(sim.state.env[e]["fleet"]), nonnegative(t.work.shape[3])
    for k in range(filled):
        works = t.work[fleet, nonnegative(slot_kind[k]), a]
        mine[at.blocked + k] = _ONE if (works[0]["plan"] >= 0) & is_closed(closed, works[0]["volume"]) else _ZERO
        for n in range(options):
            work, option = works[n], k * options + n
            can, score, p = work["plan"] >= 0, work["difficulty"], work["p_saturation"]
            duration_s = work["travel_s"] + left[k] * work["cycle_s"]
            mine[at.duration_s + option] = min(duration_s, _LONG_S) * unit.duration_s
            mine[at.difficulty + option] = (score if score == score else -_ONE) if can else _ZERO
            mine[at.p_saturation + option] = (p if p == p else _HALF) if can else _ZERO


@jit_inline
def show_forecasts(
    sim: Simulation,
    e: int,
    a: int,
    mine: Array,
    slot_kind: Array,
    filled: int,
    known_c: Array,
    ratio: Real,
    room: Array,
) -> None:
    """Put the predictions of an arm's plans from its present temperatures into its part."""
    t, form, fleet = sim.tables, sim.form, nonnegative(sim.state.env[e]["fleet"])
    at, options = form.offsets, nonnegative(t.work.shape[3])
    first, block, curve = t.forecast_first, t.forecast_block, t.forecast_curve
    for k in range(filled):
        works, excess = t.work[fleet, nonnegative(slot_kind[k]), a], excess_of(sim, e, a, slot_kind[k], ratio)
        for n in range(options):
            work, option = works[n], k * options + n
            if work["risk"] >= 0 or work["peak"] >= 0:
                # All cycles, also of a job that came back: moments in between are not predicted.
                p, peak_c = predict(
                    work["p_saturation"], work["risk"], work["peak"], first, block, curve, known_c, np.float32(np.inf),
                    excess, room,
                )  # fmt: skip
                mine[at.peak_c + option] = min(max(peak_c, PEAK_LOW_C), PEAK_HIGH_C) * form.inverse.peak_c
                if p == p:
                    mine[at.p_saturation + option] = p


@jit_inline
def show_bids(sim: Simulation, a: int, to: Array, own: Array, filled: int) -> None:
    """Copy what the members of an arm know of their plans into a part of the observation.

    Args:
        own: What each arm knows of itself, float32 [arm, own].
    """
    at, members, plans = sim.form.offsets, sim.form.members, nonnegative(sim.tables.work.shape[3])
    options = nonnegative(sim.offers.slot_job.shape[1]) * plans
    for m in range(members.shape[1]):
        theirs, row = own[nonnegative(members[a, m])], m * options
        for i in range(filled * plans):
            to[at.fleet_duration_s + row + i] = theirs[at.duration_s + i]
            to[at.fleet_peak_c + row + i] = theirs[at.peak_c + i]
            to[at.fleet_p_saturation + row + i] = theirs[at.p_saturation + i]


@jit_inline
def predict(
    p: Real,
    risk: int,
    peak: int,
    first: Array,
    block: Array,
    curve: Array,
    known_c: Array,
    left_s: Real,
    excess: Real,
    room: Array,
) -> tuple[Real, Real]:
    """P(saturation), NaN if unknown, and predicted peak temperature, °C, 0 if unknown, of a plan.

    Arrays of forecasts are arguments of their own: to pass a tuple of them takes longer than to use it.

    Args:
        p: From a model that ignores the temperatures; NaN if there is none.
        risk: Row of the forecast of P, −1 for none.
        peak: Row of the forecast of the peak temperature, −1 for none.
        first, block, curve: Forecasts; see `fleet.engine.tables.Tables`.
        known_c: [KNOWN].
        left_s: Pieces of later moments do not count.
        excess: Heat of the load over that which the forecasts assume, less 1.
        room: For the values of some pieces, [lane].
    """
    chance, peak_c = np.float32(p), _ZERO
    if peak >= 0:
        peak_c = np.float32(largest_piece(first, block, peak, known_c, left_s, excess, room))
        if curve.shape[1] > 0 and risk < 0 and np.isnan(p) and not np.isnan(curve[peak, 0, 0]):
            chance = np.float32(probability_of(peak_c, curve[peak]))
    if risk >= 0:
        value = largest_piece(first, block, risk, known_c, left_s, excess, room)
        chance = np.float32(probability_of(value, curve[risk]))
    return chance, peak_c


@jit_inline
def largest_piece(
    first: Array, block: Array, row: int, known_c: Array, left_s: Real, excess: Real, room: Array
) -> Real:
    """Value of a forecast without the pieces of moments later than `left_s`, −inf if none is left."""
    most = NEVER
    for b in range(nonnegative(first[row]), nonnegative(first[row + 1])):
        for lane in range(len(room)):  # a number that the compiler does not know, so that it does not unroll
            total = block[b, 0, lane] + excess * block[b, 2, lane]
            for i in range(KNOWN):
                total += block[b, 3 + i, lane] * known_c[i]
            room[lane] = total if block[b, 1, lane] <= left_s else NEVER
        for half in (4, 2, 1):
            for lane in range(half):
                room[lane] = max(room[lane], room[lane + half])
        most = max(most, room[0])
    return most
