"""Claims on jobs: what may be claimed, and one winner per job, station and space.

A job can be claimed once it is released, all jobs before it are done, and nobody works on it. Waiting jobs queue by
release; a job that a fault returned queues again at the end, so it does not block the others. Of two claims for one
job or station, or by two arms whose plans would touch, the lower shared difficulty wins, then the lower arm index.

An arm takes the space of its whole plan from the award until it is home again, all at once: so nothing can deadlock.
"""

import numpy as np

from fleet.engine.state import DONE, EXPIRED, GIVEN_UP, RUNNING, WAITING, State
from fleet.engine.tables import (
    AWARD,
    EXPIRE,
    ILLEGAL,
    LOST,
    EventBuffer,
    Jobs,
    OpenJobs,
    Simulation,
    Tables,
    record_event,
)
from fleet.jit import jit, jit_inline, nonnegative
from fleet.telemetry import IDLE, WORKING

Array = np.ndarray

ROUNDING = 1e-9
"""A cycle counts as begun when more than this share of it is over."""
LARGEST = float(np.finfo(float).max)
"""Claims without a difficulty are ordered behind all others."""


@jit_inline
def update_offers(t: Tables, d: Jobs, s: State, o: OpenJobs, events: EventBuffer, rows: Array) -> None:
    """Fill the slots of some envs, oldest job in the queue first, and their action masks; late jobs expire.

    Args:
        rows: Envs, int [row].
    """
    fleets, kinds, count, release_s, after = d.fleet, d.kind, d.number, d.release_s, d.after
    due_s, expires = d.due_s, d.expires
    pending, times_s, away, progress_s, todo = o.pending, t.times_s, s.plan, s.progress_s, s.todo
    tick, modes, status = s.tick, s.mode, s.status
    slot_job, mask, queue, head, current = o.slot_job, o.mask, o.queue, o.head, o.current_kind
    stations, work, closed, excluded, station_free = t.stations, t.work, o.closed, t.excluded, o.station_free
    options = nonnegative(work.shape[3])
    arms, slots = nonnegative(modes.shape[1]), nonnegative(slot_job.shape[1])
    waits, words, last = nonnegative(after.shape[2]), nonnegative(stations.shape[2]), nonnegative(mask.shape[2] - 1)
    busy, slot_kind = np.empty(words, np.uint64), np.empty(slots, np.int64)
    for row in rows:
        e = nonnegative(row)
        fleet, now_s, filled = nonnegative(fleets[e]), tick[e] * t.dt_s, 0
        mark_busy_stations(fleet, e, current, stations, busy)
        mark_closed_space(away, excluded, closed, e)
        place = nonnegative(head[e])
        while place < count[e]:
            j = nonnegative(queue[e, place])
            place += 1
            if release_s[e, j] > now_s:
                break
            if expires[e, j] and due_s[e, j] < now_s:
                remove_from_queue(queue, head, e, j)
                give_up(d, s, o, e, j, EXPIRED)
                if len(events.what) > 0:
                    record_event(events, EXPIRE, e, -1, j, -1, 0.0, 0.0)
                place, filled = nonnegative(head[e]), 0  # jobs in the queue have moved
                continue
            if filled == slots:  # of the jobs behind, only the late ones matter
                continue
            ready = True
            for n in range(waits):
                before = after[e, j, n]
                if before >= 0 and status[e, before] != DONE:
                    ready = False
            if not ready:
                continue
            kind, free = nonnegative(kinds[e, j]), True
            for w in range(words):
                free = free and (stations[fleet, kind, w] & busy[w]) == 0
            slot_job[e, filled], station_free[e, filled], slot_kind[filled] = j, free, kind
            filled += 1
        for k in range(filled, slots):
            slot_job[e, k], station_free[e, k] = -1, False
        for a in range(arms):
            for action in range(1, last):
                mask[e, a, action] = 0
            mask[e, a, last] = (
                modes[e, a] == WORKING
                and pending[e, a]
                and cycles_begun(times_s, away, progress_s, todo, e, a) < todo[e, a]
            )
            if modes[e, a] == IDLE:
                for k in range(filled):
                    for n in range(options):
                        own = work[fleet, a, slot_kind[k], n]
                        taken = is_closed(closed, e, nonnegative(own["volume"]))
                        mask[e, a, 1 + k * options + n] = station_free[e, k] & (own["plan"] >= 0) & (not taken)


@jit_inline
def mark_busy_stations(fleet: int, e: int, current: Array, stations: Array, busy: Array) -> None:
    """Put the stations of an env with an arm at work into `busy`, one bit each, uint64 [word]."""
    for w in range(len(busy)):
        busy[w] = 0
        for a in range(current.shape[1]):
            busy[w] |= stations[fleet, nonnegative(current[e, a]), w]


@jit_inline
def mark_closed_space(plans: Array, excluded: Array, closed: Array, e: int) -> None:
    """Put the volumes that the arms of an env exclude into `closed`; none excludes a volume of the same arm."""
    for w in range(closed.shape[1]):
        closed[e, w] = 0
    for a in range(plans.shape[1]):
        plan = plans[e, a]
        if plan >= 0:
            for w in range(closed.shape[1]):
                closed[e, w] |= excluded[plan, w]


@jit_inline
def cycles_begun(times_s: Array, plans: Array, progress_s: Array, todo: Array, e: int, a: int) -> int:
    """Cycles of its plan that an arm at work has begun."""
    plan = nonnegative(plans[e, a])
    into_s = progress_s[e, a] - times_s[plan, 0]
    return 0 if into_s <= 0.0 else min(int(np.ceil(into_s / times_s[plan, 1] - ROUNDING)), todo[e, a])


@jit_inline
def is_closed(bits: Array, row: int, volume: int) -> bool:
    """Whether a volume is among the bits, uint64 [row, word]."""
    return (bits[row, volume >> 6] >> np.uint64(volume & 63)) & np.uint64(1) != 0


@jit_inline
def resolve_claims(sim: Simulation, actions: Array, rows: Array) -> None:
    """Award every claimed job to one arm, and note who gives a job back; an illegal action is counted and waits.

    Args:
        actions: int [env, arm].
        rows: Envs, int [row].
    """
    t, d, s, o, events = sim.tables, sim.jobs, sim.state, sim.offers, sim.events
    fleets, kinds, repetitions = d.fleet, d.kind, d.repetitions
    modes, jobs, status, last, illegal = s.mode, s.job, s.status, s.last_award, s.illegal
    progress_s, todo, cycles = s.progress_s, s.todo, s.cycles
    slot_job, mask, queue, head, current, pending = o.slot_job, o.mask, o.queue, o.head, o.current_kind, o.pending
    stations, work, recording = t.stations, t.work, len(events.what) > 0
    plans, excluded, closed = s.plan, t.excluded, o.closed
    arms, options, words = nonnegative(modes.shape[1]), nonnegative(work.shape[3]), nonnegative(stations.shape[2])
    give_back = mask.shape[2] - 1
    busy, key, order = np.empty(words, np.uint64), np.empty(arms), np.empty(arms, np.int64)
    for row in rows:
        e = nonnegative(row)
        fleet, claims = nonnegative(fleets[e]), 0
        for a in range(arms):
            action = actions[e, a]
            last[e, a] = 0
            if action == 0:
                continue
            if action < 0 or action > give_back or mask[e, a, action] == 0:
                illegal[e, a] += 1
                if recording:
                    record_event(events, ILLEGAL, e, a, -1, -1, 0.0, 0.0)
                continue
            if action == give_back:
                todo[e, a] = cycles_begun(t.times_s, plans, progress_s, todo, e, a)
                continue
            slot, option = divmod(action - 1, options)
            score = work[fleet, a, kinds[e, slot_job[e, slot]], option]["difficulty"]
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
        mark_busy_stations(fleet, e, current, stations, busy)
        for rank in range(claims):
            a = order[rank]
            slot, option = divmod(actions[e, a] - 1, options)
            j, option = nonnegative(slot_job[e, slot]), nonnegative(option)
            kind, free = nonnegative(kinds[e, j]), status[e, j] == WAITING
            own = work[fleet, a, kind, option]
            plan = nonnegative(own["plan"])
            free = free and not is_closed(closed, e, nonnegative(own["volume"]))
            for w in range(words):
                free = free and (stations[fleet, kind, w] & busy[w]) == 0
            if not free:
                last[e, a] = -1
                if recording:
                    record_event(events, LOST, e, a, j, -1, 0.0, 0.0)
                continue
            for w in range(words):
                busy[w] |= stations[fleet, kind, w]
            remove_from_queue(queue, head, e, j)
            last[e, a], status[e, j] = 1, RUNNING
            modes[e, a], jobs[e, a], plans[e, a], progress_s[e, a] = WORKING, j, plan, 0.0
            for w in range(closed.shape[1]):
                closed[e, w] |= excluded[plan, w]
            current[e, a], pending[e, a] = kind, True
            todo[e, a] = repetitions[e, j] - cycles[e, j]
            if recording:
                record_event(events, AWARD, e, a, j, plan, 0.0, float(own["difficulty"]))


@jit_inline
def remove_from_queue(queue: Array, head: Array, e: int, j: int) -> None:
    """Remove a job from the queue: those before it move up."""
    place = head[e]
    ahead = queue[e, place]
    while ahead != j:
        place += 1
        ahead, queue[e, place] = queue[e, place], ahead
    head[e] += 1


@jit
def return_to_queue(d: Jobs, s: State, o: OpenJobs, e: int, j: int, until_s: float) -> None:
    """Put a job back into the queue, behind all that were released or returned before it.

    Args:
        until_s: End of the step: what is released later comes later.
    """
    queue, queued_s = o.queue, s.queued_s
    since_s, place = queued_s[e, j], o.head[e] - 1
    o.head[e] = place
    while place + 1 < d.number[e]:
        ahead = queue[e, place + 1]
        came_s = queued_s[e, ahead]
        if d.release_s[e, ahead] > until_s or came_s > since_s or (came_s == since_s and ahead > j):
            break
        queue[e, place] = ahead
        place += 1
    queue[e, place] = j


@jit
def give_up(d: Jobs, s: State, o: OpenJobs, e: int, j: int, why: int) -> None:
    """Give a job up that is not in the queue, and with it all that wait for it.

    Args:
        why: Its status from now on, GIVEN_UP or EXPIRED.
    """
    status, after = s.status, d.after
    status[e, j] = why
    o.unfinished[e] -= 1
    o.given_up[e] += 1
    found = after.shape[2] > 0
    while found:
        found = False
        for i in range(d.number[e]):
            for n in range(after.shape[2]):
                before = after[e, i, n]
                if status[e, i] == WAITING and before >= 0 and status[e, before] > DONE:
                    status[e, i], found = GIVEN_UP, True
                    remove_from_queue(o.queue, o.head, e, i)
                    o.unfinished[e] -= 1
                    o.given_up[e] += 1
