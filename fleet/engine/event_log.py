"""Events of a step: recorded by the kernels as numbers, turned into `Event`s for reports."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from fleet.engine.state import State, World
from fleet.events import Event, EventKind
from fleet.jit import jit

Array = np.ndarray

AWARD, LOST, ILLEGAL, WARNING, FINISH, HOME, FAULT, RETURN, GIVE_UP, RECOVER, MOVED, GIVE_BACK, EXPIRE = range(13)
"""Kinds of recorded events, in the order in which those of one step are reported."""
PER_ARM = 10
"""Most events of one arm in one step; besides, every job may expire."""


class EventBuffer(NamedTuple):
    """Events of one step; a buffer without rows records nothing."""

    used: Array
    """Rows in use, int [1]."""
    what: Array
    """Kind (see `fleet.engine.event_log`), env, arm, job, joint, int [row, 5]; −1 for none."""
    numbers: Array
    """Seconds into the step, value, [row, 2]."""


def event_buffer(rows: int) -> EventBuffer:
    """An empty buffer; without rows it records nothing."""
    return EventBuffer(np.zeros(1, int), np.zeros((rows, 5), int), np.zeros((rows, 2)))


@jit
def record_event(
    events: EventBuffer, kind: int, e: int, a: int, job: int, joint: int, offset_s: float, value: float
) -> None:
    """Append an event of the present step; an award has the row of its plan in place of a joint."""
    row = events.used[0]
    events.what[row, 0], events.what[row, 1], events.what[row, 2] = kind, e, a
    events.what[row, 3], events.what[row, 4] = job, joint
    events.numbers[row, 0], events.numbers[row, 1] = offset_s, value
    events.used[0] = row + 1


def events_of(world: World, state: State, buffer: EventBuffer) -> Iterator[Event]:
    """The events of the step that led to `state`; releases of jobs come last.

    Args:
        state: After the step.
    """
    count = int(buffer.used[0])
    what, numbers = buffer.what[:count], buffer.numbers[:count]
    began_s = (state.tick - 1) * world.dt_s
    # What becomes of the job follows the fault of its arm.
    phase = np.where((what[:, 0] == RETURN) | (what[:, 0] == GIVE_UP), FAULT, what[:, 0])
    for row in np.lexsort((what[:, 2], what[:, 1], phase)).tolist():
        kind, e, a, j, joint = what[row].tolist()
        offset_s, value = numbers[row].tolist()
        plan, joint = (joint, -1) if kind == AWARD else (-1, joint)
        name, measured, reason = _described(world, state, kind, e, j, joint, value)
        common = {"time_s": float(began_s[e] + offset_s), "env": e, "arm": world.arms[a] if a >= 0 else ""}
        common["job"] = world.jobs.names[e][j] if j >= 0 else ""
        yield Event(kind=name, joint=joint + 1, value=measured, reason=reason, **common)
        if kind == AWARD:
            peak = world.plans.peak_tau[plan]
            over = peak - world.torque_warning
            if (over > 0).any():
                k = int(over.argmax())
                text = f"joint {k + 1} reaches {peak[k]:.1f} N·m, warning at {world.torque_warning[k]:.1f}"
                yield Event(kind="torque_warning", joint=k + 1, value=float(peak[k]), reason=text, **common)
    yield from _releases(world, state)


def _described(
    world: World, state: State, kind: int, e: int, j: int, joint: int, value: float
) -> tuple[EventKind, float, str]:
    """Name, value and reason of an event."""
    limits = world.limits
    match kind:
        case 0:
            return "award", value, ""
        case 1:
            return "lost", math.nan, "another arm claimed it, its station or the space"
        case 2:
            return "illegal", math.nan, "action outside the mask: a wait"
        case 3:
            return "warning", limits.warning_c, f"motor {joint + 1} passed {limits.warning_c:g} °C"
        case 4:
            late_s = max(0.0, float(state.finished_s[e, j] - world.jobs.due_s[e, j]))
            return "finish", late_s, f"late by {late_s:.0f} s" if late_s else "on time"
        case 5:
            return "home", math.nan, ""
        case 6:
            return "fault", limits.error_c, f"motor {joint + 1} passed {limits.error_c:g} °C"
        case 7:
            return "return", value, f"{state.cycles[e, j]} of {world.jobs.repetitions[e, j]} cycles kept"
        case 8:
            return "give_up", value, f"{state.returns[e, j]} faults; {state.cycles[e, j]} cycles done"
        case 10:
            return "moved", math.nan, "moved home by a person"
        case 11:
            return "give_back", value, f"{state.cycles[e, j]} of {world.jobs.repetitions[e, j]} cycles kept"
        case 12:
            return "expire", math.nan, "its due date passed before an arm began it"
        case _:
            return "recover", math.nan, f"every motor below {limits.restart_c:g} °C and the fault cleared"


def _releases(world: World, state: State) -> Iterator[Event]:
    start_s = ((state.tick - 1) * world.dt_s)[:, None]
    release_s = world.jobs.release_s
    # The first step also takes the jobs that are there from the beginning.
    new = world.jobs.exists & (release_s <= start_s + world.dt_s)
    new &= (release_s > start_s) | ((start_s == 0) & (release_s == 0))
    for e, j in np.argwhere(new).tolist():
        at_s = float(start_s[e, 0]) + (float(release_s[e, j]) - float(start_s[e, 0]))
        yield Event(time_s=at_s, kind="release", env=e, arm="", job=world.jobs.names[e][j])
