"""Claims on jobs: what may be claimed, and one winner per job, station and space.

A job can be claimed once it is released, all jobs before it are done, and nobody works on it. Waiting jobs queue by
release; a job that a fault returned queues again at the end, so it does not block the others. Nor does one that nobody
takes: if others wait for a slot, it is put behind them after `MOST_PASSES` decisions. Of two claims for one job or
station, or by two arms whose plans would touch, the lower shared difficulty wins, then the lower arm index.

An arm takes the space of its whole plan from the award until it is home again, all at once: so nothing can deadlock.
"""

from typing import Any

import numpy as np

from fleet.engine.state import DONE, EXPIRED, GIVEN_UP, RUNNING, WAITING, State
from fleet.engine.tables import (
    AWARD,
    EXPIRE,
    FOLLOWS,
    GIVE_UP,
    ILLEGAL,
    LOST,
    EventBuffer,
    Room,
    Simulation,
    Tables,
    record_event,
)
from fleet.jit import jit, jit_inline, nonnegative
from fleet.telemetry import IDLE, WORKING

Array = np.ndarray

ROUNDING = 1e-9
"""A cycle counts as begun when more than this share of it is over."""
MOST_PASSES = 12
"""Decisions in which a job keeps a slot that others wait for, while an arm is idle and does not take it."""
FOR_PASSED = 4
"""One in this number of slots is kept for jobs that were passed over, even if others wait."""
LARGEST = float(np.finfo(np.float32).max)
"""Claims without a difficulty are ordered behind all others."""


@jit_inline
def update_offers(sim: Simulation, rows: Array) -> None:
    """Fill the slots of some envs, oldest job in the queue first, and their action masks; late jobs expire.

    Args:
        rows: Envs, int [row].
    """
    t, s, mask = sim.tables, sim.state, sim.offers.mask
    arms, last = nonnegative(s.arms.shape[1]), nonnegative(mask.shape[2] - 1)
    busy, slot_kind = sim.room.busy, sim.room.slot_kind
    for row in rows:
        e = nonnegative(row)
        env = s.env[e]
        if env["changed"] or env["next_s"] <= env["tick"] * t.dt_s:
            filled = fill_slots(t, s, sim.offers.slot_job, sim.events, e, sim.room)
            group_slots(t.stations[nonnegative(env["fleet"])], slot_kind, filled, sim.offers.group[e])
            fill_masks(sim, e, filled, slot_kind, busy)
            env["changed"] = False
        for a in range(arms):
            arm = s.arms[e, a]
            mask[e, a, last] = arm["pending"] and cycles_begun(t.plans, arm) < arm["todo"]


@jit_inline
def fill_slots(t: Tables, s: State, slot_job: Array, events: EventBuffer, e: int, room: Room) -> int:
    """Fill the slots of an env, with jobs that were passed over last; late jobs expire.

    Args:
        room: Its `slot_kind` receives the kinds of the jobs.

    Returns:
        The number of filled slots.
    """
    env, jobs, queue, slots = s.env[e], s.jobs[e], s.queue[e], nonnegative(slot_job.shape[1])
    now_s, filled, behind, place, next_s = env["tick"] * t.dt_s, 0, 0, nonnegative(env["head"]), np.inf
    env["overfull"] = False
    while place < env["number"]:
        j = nonnegative(queue[place])
        job = jobs[j]
        place += 1
        if job["release_s"] > now_s:
            next_s = min(next_s, job["release_s"])
            break
        if job["expires"] and job["due_s"] < now_s:
            remove_from_queue(s, e, j)
            if len(events.what) > 0:
                record_event(events, EXPIRE, e, -1, j, -1, t.dt_s, 0.0)
            give_up(s, events, e, j, EXPIRED, t.dt_s)
            place, filled, behind = nonnegative(env["head"]), 0, 0  # jobs in the queue have moved
            env["overfull"] = False
            continue
        if job["expires"]:
            next_s = min(next_s, job["due_s"])
        passed = job["passes"] < 0
        if filled == slots and env["overfull"] and not passed:
            continue
        ready = True
        for n in range(s.after.shape[2]):
            before = s.after[e, j, n]
            if before >= 0 and jobs[before]["status"] != DONE:
                ready = False
        if ready and passed and behind < slots:
            room.behind[behind] = j
            behind += 1
        elif ready and not passed and filled < slots:
            slot_job[e, filled] = j
            filled += 1
        elif ready:
            env["overfull"] = True
    if filled + behind > slots:
        env["overfull"] = True
        filled = min(filled, slots - min(behind, slots // FOR_PASSED))
    for n in range(min(behind, slots - filled)):
        slot_job[e, filled] = room.behind[n]
        filled += 1
    for k in range(slots):
        if k < filled:
            room.slot_kind[k] = jobs[nonnegative(slot_job[e, k])]["kind"]
        else:
            slot_job[e, k] = -1
    env["next_s"] = next_s
    return filled


@jit_inline
def pass_over(sim: Simulation, rows: Array) -> None:
    """Count that an idle arm has not taken the jobs in the slots of envs in which others wait; put some of them last.

    Args:
        rows: Envs, int [row].
    """
    for row in rows:
        if sim.state.env[row]["overfull"]:
            _pass_over(sim.tables, sim.state, sim.offers.slot_job[row], nonnegative(row))


@jit
def _pass_over(t: Tables, s: State, slot_job: Array, e: int) -> None:
    env, idle = s.env[e], False
    for a in range(s.arms.shape[1]):
        idle = idle or (s.arms[e, a]["mode"] == IDLE and not s.arms[e, a]["absent"])
    if not idle:
        return
    now_s = env["tick"] * t.dt_s
    for k in range(len(slot_job)):
        j = nonnegative(slot_job[k])
        job = s.jobs[e, j]
        if job["status"] == WAITING:
            job["passes"] += 1
            if job["passes"] in (0, MOST_PASSES):
                remove_from_queue(s, e, j)
                job["passes"], job["queued_s"] = -MOST_PASSES, now_s
                return_to_queue(s, e, j, now_s)
                env["changed"] = True


@jit_inline
def group_slots(stations: Array, slot_kind: Array, filled: int, group: Array) -> None:
    """Number the jobs in the slots, those that share a station with the first of them alike; 0 for an empty slot.

    Args:
        stations: Of each kind of job, uint64 [kind, word].
    """
    for k in range(len(group)):
        group[k] = k + 1 if k < filled else 0
        for before in range(k if k < filled else 0):
            if not are_free(stations[slot_kind[k]], stations[slot_kind[before]]):
                group[k] = group[before]
                break


@jit_inline
def fill_masks(sim: Simulation, e: int, filled: int, slot_kind: Array, busy: Array) -> None:
    """Find out which stations of an env are free, and which options its idle arms may claim.

    Args:
        filled: Number of filled slots.
        slot_kind: Kinds of their jobs, int [slot].
        busy: Room for the stations that are taken, uint64 [word].
    """
    t, s, o = sim.tables, sim.state, sim.offers
    fleet, arms = nonnegative(s.env[e]["fleet"]), nonnegative(s.arms.shape[1])
    mark_busy_stations(t, s.arms[e], fleet, busy)
    mark_closed_space(t, s.arms[e], o.closed[e])
    for k in range(o.slot_job.shape[1]):
        o.station_free[e, k] = k < filled and are_free(t.stations[fleet, slot_kind[k]], busy)
    for a in range(arms):
        mask = o.mask[e, a]
        for action in range(1, len(mask) - 1):
            mask[action] = 0
        if s.arms[e, a]["mode"] != IDLE or s.arms[e, a]["absent"]:
            continue
        action = 1
        for k in range(filled):
            free, offered = o.station_free[e, k], t.work[fleet, slot_kind[k], a]
            for n in range(len(offered)):
                can = offered[n]["plan"] >= 0
                mask[action] = free & can & (not is_closed(o.closed[e], offered[n]["volume"]))
                action += 1


@jit_inline
def mark_busy_stations(t: Tables, arms: Array, fleet: int, busy: Array) -> None:
    """Put the stations with an arm of an env at work into `busy`, one bit each, uint64 [word]."""
    for w in range(len(busy)):
        busy[w] = 0
    for a in range(len(arms)):
        for w in range(len(busy)):
            busy[w] |= t.stations[fleet, nonnegative(arms[a]["kind"]), w]


@jit_inline
def mark_closed_space(t: Tables, arms: Array, closed: Array) -> None:
    """Put the volumes that the arms of an env exclude into `closed`; none excludes a volume of the same arm."""
    for w in range(len(closed)):
        closed[w] = 0
    for a in range(len(arms)):
        plan = arms[a]["plan"]
        if plan >= 0:
            for w in range(len(closed)):
                closed[w] |= t.excluded[plan, w]


@jit_inline
def are_free(stations: Array, busy: Array) -> bool:
    """Whether none of the stations is busy, both uint64 [word]."""
    free = True
    for w in range(len(busy)):
        free = free and (stations[w] & busy[w]) == 0
    return free


@jit_inline
def cycles_begun(plans: Array, arm: Array) -> Any:  # an integer
    """Cycles of its plan that an arm at work has begun."""
    plan = plans[nonnegative(arm["plan"])]
    into_s = arm["progress_s"] - plan["times_s"][0]
    return 0 if into_s <= 0.0 else min(int(np.ceil(into_s / plan["times_s"][1] - ROUNDING)), arm["todo"])


@jit_inline
def is_closed(bits: Array, volume: int) -> bool:
    """Whether a volume is among the bits, uint64 [word]."""
    place = nonnegative(volume)
    return (bits[place >> 6] >> np.uint64(place & 63)) & np.uint64(1) != 0


@jit_inline
def resolve_claims(sim: Simulation, actions: Array, rows: Array) -> None:
    """Award every claimed job to one arm, and note who gives a job back; an illegal action is counted and waits.

    Args:
        actions: int [env, arm].
        rows: Envs, int [row].
    """
    t, s, mask, events = sim.tables, sim.state, sim.offers.mask, sim.events
    arms, options = nonnegative(s.arms.shape[1]), nonnegative(t.work.shape[3])
    give_back, recording = mask.shape[2] - 1, len(events.what) > 0
    busy, key, order = sim.room.busy, sim.room.key, sim.room.order
    for row in rows:
        e = nonnegative(row)
        fleet, claims = nonnegative(s.env[e]["fleet"]), 0
        for a in range(arms):
            arm, action = s.arms[e, a], actions[e, a]
            arm["last_award"] = 0
            if action == 0:
                continue
            if action < 0 or action > give_back or mask[e, a, action] == 0:
                arm["illegal"] += 1
                if recording:
                    record_event(events, ILLEGAL, e, a, -1, -1, 0.0, 0.0)
                continue
            if action == give_back:
                arm["todo"] = cycles_begun(t.plans, arm)
                set_phase(t.plans, arm)
                continue
            slot, option = divmod(action - 1, options)
            score = t.work[fleet, s.jobs[e, sim.offers.slot_job[e, slot]]["kind"], a, option]["difficulty"]
            if not score < np.inf:
                score = LARGEST
            place = claims
            while place > 0 and key[place - 1] > score:
                key[place], order[place] = key[place - 1], order[place - 1]
                place -= 1
            key[place], order[place] = score, a
            claims += 1
        if claims > 0:
            mark_busy_stations(t, s.arms[e], fleet, busy)
            for rank in range(claims):
                award(sim, e, order[rank], actions[e, order[rank]], busy)


@jit_inline
def award(sim: Simulation, e: int, a: int, action: Any, busy: Array) -> None:
    """Award a claimed job to an arm, unless the job, a station or the space was awarded before.

    Args:
        busy: Stations that are taken, uint64 [word]; gets those of the job.
    """
    t, s, o, events = sim.tables, sim.state, sim.offers, sim.events
    recording = len(events.what) > 0
    slot, option = divmod(action - 1, t.work.shape[3])
    j = nonnegative(o.slot_job[e, slot])
    env, arm, job = s.env[e], s.arms[e, a], s.jobs[e, j]
    fleet, kind = nonnegative(env["fleet"]), nonnegative(job["kind"])
    own, stations = t.work[fleet, kind, a, nonnegative(option)], t.stations[fleet, kind]
    if job["status"] != WAITING or is_closed(o.closed[e], own["volume"]) or not are_free(stations, busy):
        arm["last_award"] = -1
        if recording:
            record_event(events, LOST, e, a, j, -1, 0.0, 0.0)
        return
    for w in range(len(busy)):
        busy[w] |= stations[w]
    for w in range(o.closed.shape[1]):
        o.closed[e, w] |= t.excluded[own["plan"], w]
    remove_from_queue(s, e, j)
    env["changed"] = True
    job["status"], job["passes"] = RUNNING, 0
    arm["last_award"], arm["mode"], arm["job"], arm["kind"], arm["pending"] = 1, WORKING, j, kind, True
    arm["plan"], arm["progress_s"], arm["todo"] = own["plan"], 0.0, job["repetitions"] - job["cycles"]
    set_phase(t.plans, arm)
    if recording:
        record_event(events, AWARD, e, a, j, own["plan"], 0.0, float(own["difficulty"]))


@jit_inline
def set_phase(plans: Array, arm: Array) -> None:
    """Give an arm at work the heat drive of the phase that begins or goes on now, and note when it ends."""
    plan = plans[nonnegative(arm["plan"])]
    first_s = plan["times_s"][0]
    last_s = first_s + plan["times_s"][1] * arm["todo"]
    phase, end_s = 2, last_s + plan["times_s"][2]
    if arm["progress_s"] < first_s:
        phase, end_s = 0, first_s
    elif arm["progress_s"] < last_s:
        phase, end_s = 1, last_s
    arm["phase_end_s"] = end_s
    for k in range(len(arm["current_sq"])):
        arm["current_sq"][k], arm["friction_w"][k] = plan["current_sq"][phase, k], plan["friction_w"][phase, k]


@jit
def remove_from_queue(s: State, e: int, j: int) -> None:
    """Remove a job from the queue: those before it move up."""
    queue, place = s.queue[e], s.env[e]["head"]
    ahead = queue[place]
    while ahead != j:
        place += 1
        ahead, queue[place] = queue[place], ahead
    s.env[e]["head"] += 1


@jit
def return_to_queue(s: State, e: int, j: int, until_s: float) -> None:
    """Put a job back into the queue, behind all that were released or returned before it.

    Args:
        until_s: End of the step: what is released later comes later.
    """
    env, queue, jobs = s.env[e], s.queue[e], s.jobs[e]
    since_s, place = jobs[j]["queued_s"], env["head"] - 1
    env["head"] = place
    while place + 1 < env["number"]:
        ahead = queue[place + 1]
        came_s = jobs[ahead]["queued_s"]
        if jobs[ahead]["release_s"] > until_s or came_s > since_s or (came_s == since_s and ahead > j):
            break
        queue[place] = ahead
        place += 1
    queue[place] = j


@jit
def give_up(s: State, events: EventBuffer, e: int, j: int, why: int, at_s: float) -> None:
    """Give a job up that is not in the queue, and with it all that wait for it.

    Args:
        why: Its status from now on, GIVEN_UP or EXPIRED.
        at_s: When, seconds into the step.
    """
    env, jobs, after = s.env[e], s.jobs[e], s.after[e]
    jobs[j]["status"] = why
    env["unfinished"] -= 1
    env["given_up"] += 1
    found = after.shape[1] > 0
    while found:
        found = False
        for i in range(env["number"]):
            for n in range(after.shape[1]):
                before = after[i, n]
                if jobs[i]["status"] == WAITING and before >= 0 and jobs[before]["status"] > DONE:
                    jobs[i]["status"], found = GIVEN_UP, True
                    if len(events.what) > 0:
                        record_event(events, GIVE_UP, e, -1, i, -1, at_s, FOLLOWS)
                    remove_from_queue(s, e, i)
                    env["unfinished"] -= 1
                    env["given_up"] += 1
