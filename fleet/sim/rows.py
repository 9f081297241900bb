"""One step of many shifts, compiled: what `fleet.sim.kernel` does, env by env and arm by arm, without an event log.

For the plant that follows the plan. `fleet.sim.kernel` is the plain form, and says what is done and why; a test holds
the two together. A row's result does not depend on how many rows there are.
"""

from typing import Any

import numpy as np

from fleet.robot import JOINTS
from fleet.sim.boiling import above_s, at, braked_load, crossing_s, hottest, into_modes
from fleet.sim.jit import inner, natural, rare
from fleet.sim.kernel import ROUNDING_S
from fleet.sim.state import DONE, RUNNING, WAITING
from fleet.sim.tables import LANES, WIDE, Drawn, Offer, Rows, Tables
from fleet.telemetry import FAULTED, IDLE, WORKING
from fleet.thermal import NODES

Array = np.ndarray

LARGEST = float(np.finfo(float).max)


@inner
def hang_out(t: Tables, d: Drawn, s: Rows, o: Offer, rows: Array) -> None:
    """The jobs on offer in some envs, oldest in the queue first, and who may claim them.

    Args:
        rows: Which envs, int [row].
    """
    lots, kinds, count, release_s, after = d.lot, d.kind, d.jobs, d.release_s, d.after
    tick, modes, status = s.tick, s.mode, s.status
    on_offer, mask, queue, head, hand = o.on_offer, o.mask, o.queue, o.head, o.hand
    places, able = t.places, t.able
    arms, slots = natural(modes.shape[1]), natural(on_offer.shape[1])
    waits, words = natural(after.shape[2]), natural(places.shape[2])
    busy = np.empty(words, np.uint64)
    for row in rows:
        e = natural(row)
        lot, now_s, found = natural(lots[e]), tick[e] * t.dt_s, 0
        occupied(lot, e, hand, places, busy)
        for place in range(natural(head[e]), count[e]):
            j = natural(queue[e, place])
            if found == slots or release_s[e, j] > now_s:
                break
            ready = True
            for n in range(waits):
                before = after[e, j, n]
                if before >= 0 and status[e, before] != DONE:
                    ready = False
            if not ready:
                continue
            kind, free = natural(kinds[e, j]), True
            for w in range(words):
                free = free and (places[lot, kind, w] & busy[w]) == 0
            on_offer[e, found] = j
            found += 1
            for a in range(arms):
                mask[e, a, found] = free & (modes[e, a] == IDLE) & able[lot, kind, a]
        while found < slots and on_offer[e, found] >= 0:  # what hung out there before
            on_offer[e, found] = -1
            found += 1
            for a in range(arms):
                mask[e, a, found] = 0


@inner
def occupied(lot: Any, e: int, hand: Array, places: Array, busy: Array) -> None:
    """Which stations of an env have an arm at work, a bit each, uint64 [word]."""
    for w in range(len(busy)):
        busy[w] = 0
        for a in range(hand.shape[1]):
            busy[w] |= places[lot, natural(hand[e, a]), w]


@inner
def award(t: Tables, d: Drawn, s: Rows, o: Offer, actions: Array, rows: Array) -> None:
    """Every claimed job to one arm: the lower difficulty wins, then the lower index.

    Args:
        actions: int [env, arm].
        rows: Which envs, int [row].
    """
    lots, kinds, repetitions = d.lot, d.kind, d.repetitions
    modes, in_hand, status, last, illegal = s.mode, s.job, s.status, s.last_award, s.illegal
    progress_s, todo, cycles = s.progress_s, s.todo, s.cycles
    on_offer, mask, queue, head, hand, owed = o.on_offer, o.mask, o.queue, o.head, o.hand, o.owed
    places, difficulty = t.places, t.difficulty
    arms, slots, words = natural(modes.shape[1]), natural(on_offer.shape[1]), natural(places.shape[2])
    busy, key, order = np.empty(words, np.uint64), np.empty(arms), np.empty(arms, np.int64)
    for row in rows:
        e = natural(row)
        lot, claims = natural(lots[e]), 0
        for a in range(arms):
            action = actions[e, a]
            last[e, a] = 0
            if action == 0:
                continue
            if action < 0 or action > slots or mask[e, a, action] == 0:
                illegal[e, a] += 1
                continue
            score = difficulty[lot, a, kinds[e, on_offer[e, action - 1]]]
            if not score < np.inf:
                score = LARGEST
            place = claims
            while place > 0 and key[place - 1] > score:
                key[place], order[place] = key[place - 1], order[place - 1]
                place -= 1
            key[place], order[place] = score, a
            claims += 1
        if claims == 0:
            continue
        occupied(lot, e, hand, places, busy)
        for rank in range(claims):
            a = order[rank]
            j = natural(on_offer[e, actions[e, a] - 1])
            kind, free = natural(kinds[e, j]), status[e, j] == WAITING
            for w in range(words):
                free = free and (places[lot, kind, w] & busy[w]) == 0
            if not free:
                last[e, a] = -1
                continue
            for w in range(words):
                busy[w] |= places[lot, kind, w]
            take_out(queue, head, e, j)
            last[e, a], status[e, j] = 1, RUNNING
            modes[e, a], in_hand[e, a], progress_s[e, a] = WORKING, j, 0.0
            hand[e, a], owed[e, a] = kind, True
            todo[e, a] = repetitions[e, j] - cycles[e, j]


@inner
def take_out(queue: Array, head: Array, e: int, j: int) -> None:
    """A job leaves the queue: those before it move up."""
    place = head[e]
    ahead = queue[e, place]
    while ahead != j:
        place += 1
        ahead, queue[e, place] = queue[e, place], ahead
    head[e] += 1


@rare
def put_back(d: Drawn, s: Rows, o: Offer, e: int, j: int, until_s: float) -> None:
    """A job comes back into the queue, behind all that were released or came back before it.

    Args:
        until_s: End of the step: what is released later comes later.
    """
    queue, queued_s = o.queue, s.queued_s
    since_s, place = queued_s[e, j], o.head[e] - 1
    o.head[e] = place
    while place + 1 < d.jobs[e]:
        ahead = queue[e, place + 1]
        came_s = queued_s[e, ahead]
        if d.release_s[e, ahead] > until_s or came_s > since_s or (came_s == since_s and ahead > j):
            break
        queue[e, place] = ahead
        place += 1
    queue[e, place] = j


@inner
def live(t: Tables, d: Drawn, s: Rows, o: Offer, worth: Array, terms: Array, rows: Array) -> None:
    """Every arm through one step: motion, heat, limits, the end of its job.

    Args:
        worth: Of a unit of each reward term, [term], in the order of `fleet.env.reward.RewardWeights`.
        terms: Takes the reward terms and their sum, [env, term + 1].
        rows: Which envs, int [row].
    """
    # The arrays by names of their own: a field of a tuple is counted at every use.
    lots, airs_k, repetitions, due_s = d.lot, d.air_k, d.repetitions, d.due_s
    ticks, temp_c, modes, in_hand, progress_s, todo = s.tick, s.temp_c, s.mode, s.job, s.progress_s, s.todo
    clear_at_s, faults, peak_c, above_warning_s = s.clear_at_s, s.faults, s.peak_c, s.above_warning_s
    busy_s, lost_s, energy_j, status, queued_s = s.busy_s, s.lost_s, s.energy_j, s.status, s.queued_s
    cycles, returns, finished_s, left, hand, owed = s.cycles, s.returns, s.finished_s, o.open, o.hand, o.owed
    ambient_c, steps, to_ambient = t.ambient_c, t.step, t.to_ambient
    motor, drive, times_s, plans, values = t.motor, t.drive, t.times_s, t.plan, t.value
    dt_s, alpha_kt, alpha_cu, reference_c = t.dt_s, t.alpha_kt, t.alpha_cu, t.reference_c
    warning_c, error_c, restart_c = t.warning_c, t.error_c, t.restart_c
    power, fold = np.empty((2, LANES)), np.empty(4)  # W of windings, of friction and electronics
    begin, end = np.zeros(2 * NODES + LANES), np.empty(WIDE)  # the temperatures, the loads, and what pads them
    arms, nothing = natural(modes.shape[1]), natural(t.able.shape[1])
    for row in rows:
        e = natural(row)
        lot, tick = natural(lots[e]), natural(ticks[e])
        now_s, moment = tick * dt_s, min(tick, t.ticks - 1)
        value = late = above_s = count = energy = 0.0
        for a in range(arms):
            mode = modes[e, a]
            plan, spent_s, done_s, home_s = 0, 0.0, np.inf, np.inf
            first_s = cycle_s = share_0 = share_1 = share_2 = 0.0
            if mode == WORKING:
                plan = natural(plans[lot, a, natural(hand[e, a])])
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
                if owed[e, a] and last_s - begin_s <= dt_s + ROUNDING_S:
                    done_s = min(max(last_s - begin_s, 0.0), dt_s)
                if back_s - begin_s <= dt_s + ROUNDING_S:
                    home_s = min(max(back_s - begin_s, 0.0), dt_s)
            rest = 0.0 if mode == FAULTED else (dt_s - spent_s) / dt_s
            powered = 0.0 if t.power_off and mode == FAULTED else 1.0
            air_c = ambient_c[lot, moment, a] + airs_k[e]
            for n in range(NODES):
                begin[n] = temp_c[e, a, n]
            for k in range(LANES):
                amps_sq = share_0 * drive[plan, 0, 0, k] + share_1 * drive[plan, 1, 0, k]
                amps_sq += share_2 * drive[plan, 2, 0, k] + rest * motor[lot, a, 2, k]
                factor = 1.0 + alpha_kt * (begin[JOINTS + k] - reference_c)
                warmer = 1.0 + alpha_cu * (begin[k] - reference_c)
                power[0, k] = motor[lot, a, 0, k] * warmer * (amps_sq / (factor * factor))
            for k in range(LANES):
                rubbed_w = share_0 * drive[plan, 0, 1, k] + share_1 * drive[plan, 1, 1, k]
                rubbed_w += share_2 * drive[plan, 2, 1, k] + rest * motor[lot, a, 3, k]
                power[1, k] = rubbed_w + powered * motor[lot, a, 1, k]
            for k in range(4):
                fold[k] = (power[0, k] + power[1, k]) + (power[0, 4 + k] + power[1, 4 + k])
            heat_w = (fold[0] + fold[1]) + (fold[2] + fold[3])
            for k in range(JOINTS):
                begin[NODES + k] = power[0, k] + to_ambient[lot, a, k] * air_c
                begin[NODES + JOINTS + k] = power[1, k] + to_ambient[lot, a, JOINTS + k] * air_c
            for m in range(WIDE):
                into = 0.0
                for n in range(2 * NODES):
                    into += steps[lot, a, n, m] * begin[n]
                end[m] = into
            first_c, last_c = hottest(begin), hottest(end)
            cut_s, here_s, here_j, top_c, cool_s = dt_s, 0.0, heat_w * dt_s, last_c, np.inf
            hot, same = first_c >= warning_c, (first_c >= warning_c) == (last_c >= warning_c)
            if same and (first_c < restart_c or last_c >= restart_c if mode == FAULTED else last_c < error_c):
                here_s = dt_s if hot else 0.0
                if mode == FAULTED and last_c < restart_c:
                    cool_s = 0.0
            else:
                cut_s, here_s, here_j, top_c, cool_s = boil(t, lot, a, mode, begin, heat_w, air_c, end)
            energy_j[e, a] += here_j
            above_warning_s[e, a] += here_s
            peak_c[e, a] = max(peak_c[e, a], top_c)
            busy_s[e, a] += min(spent_s, cut_s)
            above_s += here_s
            energy += here_j
            for n in range(NODES):
                temp_c[e, a, n] = end[n]
            if mode == WORKING:
                if done_s <= cut_s:
                    j, owed[e, a] = natural(in_hand[e, a]), False
                    status[e, j], cycles[e, j], finished_s[e, j] = DONE, repetitions[e, j], now_s + done_s
                    left[e] -= 1
                    gained = values[lot, natural(hand[e, a])]
                    value += gained
                    late += gained * (max(finished_s[e, j] - due_s[e, j], 0.0) / 60.0)
                progress_s[e, a] += cut_s
                if home_s <= cut_s:
                    modes[e, a], in_hand[e, a], progress_s[e, a], todo[e, a] = IDLE, -1, 0.0, 0
                    hand[e, a] = nothing
            if mode == FAULTED:
                lost_s[e, a] += dt_s
            if cut_s < dt_s:
                if mode == WORKING and owed[e, a]:
                    j = natural(in_hand[e, a])
                    kept = int((progress_s[e, a] - first_s) // cycle_s)
                    cycles[e, j] += min(max(kept, 0), todo[e, a])
                    status[e, j], queued_s[e, j] = WAITING, now_s + cut_s
                    returns[e, j] += 1
                    put_back(d, s, o, e, j, now_s + dt_s)
                count += 1.0
                faults[e, a] += 1
                lost_s[e, a] += dt_s - cut_s
                modes[e, a], in_hand[e, a], progress_s[e, a], todo[e, a] = FAULTED, -1, 0.0, 0
                hand[e, a] = nothing
            if modes[e, a] == FAULTED:
                if clear_at_s[e, a] == np.inf and cool_s < np.inf:
                    clear_at_s[e, a] = now_s + cool_s + t.clear_s
                if clear_at_s[e, a] <= (tick + 1) * dt_s:
                    lost_s[e, a] -= dt_s - (clear_at_s[e, a] - now_s)
                    modes[e, a], clear_at_s[e, a] = IDLE, np.inf
        terms[e, 0], terms[e, 1], terms[e, 2] = value * worth[0], late * worth[1], above_s * worth[2]
        terms[e, 3], terms[e, 4] = count * worth[3], energy * worth[4]
        terms[e, 5] = terms[e, 0] + terms[e, 1] + terms[e, 2] + terms[e, 3] + terms[e, 4]
        ticks[e] += 1


@rare
def boil(
    t: Tables, lot: int, a: int, mode: int, begin: Array, heat_w: float, air_c: float, end: Array
) -> tuple[float, float, float, float, float]:
    """The rare step of an arm that passes a limit or is faulted; `end` becomes what it really ends at.

    Args:
        begin: Temperatures, then loads (heat and what the air gives), [from].

    Returns:
        Seconds until a fault stops it (the whole step if none does), seconds above the warning limit, energy in J,
        the hottest that counts, and the moment from which every motor is below the restart limit (inf if none).
    """
    dt_s, modal, faulted = t.dt_s, np.empty((2, NODES)), mode == FAULTED
    into_modes(t, lot, a, begin, begin[NODES:], modal)
    first_c, last_c = hottest(begin), hottest(end)
    if faulted or last_c < t.error_c:
        cool_s = np.inf
        if faulted and last_c < t.restart_c:
            cool_s = 0.0
            if first_c >= t.restart_c:
                cool_s = crossing_s(t, lot, a, modal, dt_s, t.restart_c, first_c, last_c)
        return dt_s, above_s(t, lot, a, modal, dt_s, first_c, last_c), heat_w * dt_s, last_c, cool_s
    cut_s = 0.0
    if first_c < t.error_c:
        cut_s = crossing_s(t, lot, a, modal, dt_s, t.error_c, first_c, last_c)
    stopped, brakes = np.empty(NODES), np.empty(NODES)
    at(t, lot, a, modal, cut_s, stopped)
    stopped_c = hottest(stopped)
    above = above_s(t, lot, a, modal, cut_s, first_c, stopped_c)
    brakes_w = braked_load(t, lot, a, air_c, brakes)
    into_modes(t, lot, a, stopped, brakes, modal)
    left_s = dt_s - cut_s
    at(t, lot, a, modal, left_s, end)
    last_c = hottest(end)
    above += above_s(t, lot, a, modal, left_s, stopped_c, last_c)
    peak, cool_s = max(stopped_c, last_c), np.inf
    if last_c < t.restart_c:
        cool_s = cut_s
        if peak >= t.restart_c:
            cool_s = cut_s + crossing_s(t, lot, a, modal, left_s, t.restart_c, stopped_c, last_c)
    return cut_s, above, heat_w * cut_s + brakes_w * left_s, peak, cool_s
