"""Who did what when: the event log of a shift, read back as assignments and outages."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from fleet.errors import nearest
from fleet.events import Event

Outcome = Literal["finished", "returned", "running"]

_ORDER = ("recover", "finish", "home", "award", "fault", "return")
"""The kinds that shape a schedule, in the order they can follow one another at one moment."""

SAME_MOMENT_DIGITS = 6
"""Events are ordered on the microsecond: a tick's end and the next one's beginning may differ in the last bit."""


@dataclass(frozen=True, kw_only=True)
class Assignment:
    """One arm at one job, from the award until it is home again or faults."""

    arm: str
    job: str
    start_s: float
    end_s: float
    """Home again, faulted, or the horizon."""
    finished_s: float | None = None
    """When the last cycle was done; None if it was not."""
    outcome: Outcome
    """finished: the work was done, even if the arm was not home yet; returned: a fault sent it back to the queue."""
    late_s: float | None = None
    """Tardiness of a finished job, 0 if on time."""
    cycles_kept: int | None = None
    """Of a returned job: cycles this arm did that need not be done again."""
    difficulty: float = float("nan")
    """Score of the award."""


@dataclass(frozen=True, kw_only=True)
class Outage:
    """One arm lost to a fault."""

    arm: str
    start_s: float
    end_s: float
    """Recovered, or the horizon."""
    joint: int
    """Motor that caused it, 1..7."""
    recovered: bool
    reason: str = ""


@dataclass(frozen=True)
class Schedule:
    """What happened to the arms up to a horizon; in order of the arms, then of time."""

    assignments: tuple[Assignment, ...]
    outages: tuple[Outage, ...]
    horizon_s: float


def schedule(events: Sequence[Event], arms: Sequence[str], horizon_s: float, *, env: int = 0) -> Schedule:
    """The schedule that an event log tells of; the order of events within the log does not matter.

    Args:
        horizon_s: Where the log ends; whatever is still open runs until here.
        env: Which of several parallel shifts.

    Raises:
        ValueError: the log names an arm that is not in the fleet, or tells what cannot be (an award to a busy arm,
            an arm home from nowhere).
    """
    own: dict[str, list[Event]] = {arm: [] for arm in arms}
    for event in events:
        if event.env != env or event.kind not in _ORDER:
            continue
        if event.arm not in own:
            raise ValueError(f"No arm '{event.arm}' in this fleet{nearest(event.arm, own)}")
        own[event.arm].append(event)
    assignments: list[Assignment] = []
    outages: list[Outage] = []
    for arm, log in own.items():
        log.sort(key=lambda e: (round(e.time_s, SAME_MOMENT_DIGITS), _ORDER.index(e.kind)))
        assignments += _assignments(arm, log, horizon_s)
        outages += _outages(arm, log, horizon_s)
    return Schedule(tuple(assignments), tuple(outages), horizon_s)


def _assignments(arm: str, log: Sequence[Event], horizon_s: float) -> list[Assignment]:
    """Of one arm, from its events in order."""
    out: list[Assignment] = []
    award: Event | None = None
    finish: Event | None = None
    for i, event in enumerate(log):
        if event.kind == "award":
            if award is not None:
                raise ValueError(f"{_at(event)}: '{arm}' is awarded '{event.job}' while at '{award.job}'.")
            award, finish = event, None
        elif event.kind == "finish":
            if award is None or award.job != event.job:
                raise ValueError(f"{_at(event)}: '{arm}' finishes '{event.job}', which it was not awarded.")
            finish = event
        elif event.kind == "home":
            if award is None or finish is None:
                raise ValueError(f"{_at(event)}: '{arm}' is home from '{event.job}', which it did not finish.")
            out.append(_assignment(award, finish, event.time_s))
            award = None
        elif event.kind == "fault" and award is not None:
            returned = (e for e in log[i + 1 :] if e.kind == "return" and e.job == award.job)
            out.append(_assignment(award, finish, event.time_s, None if finish else next(returned, None)))
            award = None
    if award is not None:
        out.append(_assignment(award, finish, max(horizon_s, award.time_s), running=True))
    return out


def _assignment(
    award: Event, finish: Event | None, end_s: float, returned: Event | None = None, *, running: bool = False
) -> Assignment:
    outcome: Outcome = "finished" if finish else "running" if running else "returned"
    return Assignment(
        arm=award.arm,
        job=award.job,
        start_s=award.time_s,
        end_s=end_s,
        finished_s=finish.time_s if finish else None,
        outcome=outcome,
        late_s=finish.value if finish else None,
        cycles_kept=round(returned.value) if returned else None,
        difficulty=award.value,
    )


def _outages(arm: str, log: Sequence[Event], horizon_s: float) -> list[Outage]:
    """Of one arm, from its events in order."""
    out: list[Outage] = []
    fault: Event | None = None
    for event in log:
        if event.kind == "fault":
            if fault is not None:
                raise ValueError(f"{_at(event)}: '{arm}' faults while it is faulted.")
            fault = event
        elif event.kind == "recover":
            if fault is None:
                raise ValueError(f"{_at(event)}: '{arm}' recovers without a fault.")
            out.append(_outage(fault, event.time_s, recovered=True))
            fault = None
    if fault is not None:
        out.append(_outage(fault, max(horizon_s, fault.time_s), recovered=False))
    return out


def _outage(fault: Event, end_s: float, *, recovered: bool) -> Outage:
    return Outage(
        arm=fault.arm,
        start_s=fault.time_s,
        end_s=end_s,
        joint=fault.joint,
        recovered=recovered,
        reason=fault.reason,
    )


def _at(event: Event) -> str:
    return f"Event log at {event.time_s:g} s"
