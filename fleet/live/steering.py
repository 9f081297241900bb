"""Requests of people who steer a fleet: which are possible, what they change, and what happens next."""

import logging
import math
from collections.abc import Mapping, Set

from msgspec.structs import replace

from fleet.bus.protocol.auction import SETTLED, JobStatus
from fleet.bus.protocol.messages import State, encode
from fleet.bus.protocol.operator import (
    ALL_ARMS,
    Cancel,
    Change,
    Clear,
    Controlled,
    ControlRequest,
    Operation,
    Pause,
    Resume,
    Settle,
    by_whom,
)
from fleet.errors import Refused, listed
from fleet.live.book import JobBook
from fleet.live.job_rules import changed_spec, content_hash
from fleet.live.leases import progress
from fleet.live.records import NO_AWARD, Requested, requested_job

_LOG = logging.getLogger(__name__)

MAX_REDONE = 16
"""Awards of one job that were redone, in one request."""
ALREADY_DONE = "This request was carried out before."
NO_CHANGE = "Nothing changed: it is so already."


def carry_out(
    book: JobBook, request: ControlRequest, arms: Set[str], states: Mapping[str, State], time_s: float
) -> tuple[Operation | None, str]:
    """Carry out a request of a person, once; it is durable when this returns.

    Args:
        arms: Those that are present, and those of the cell.
        states: Last states of the present arms.

    Returns:
        The operation, None if it was carried out before; and why nothing changes, "" if something does.

    Raises:
        Refused: it is not possible now.
    """
    if (known := book.operations.names.get(request.request)) is not None:
        if known != content_hash(request):
            raise Refused(
                f"Another request of the name '{request.request}' was carried out before, so this one is not: its "
                f"action or `by` differs (got {encode(request).decode()}). Give each request a name of its own, for "
                "example a UUID."
            )
        return None, ALREADY_DONE
    note = objection(book, request, arms, states)
    operation = replace(operation_of(book, request, time_s), note=note)
    book.record(*progress(book, [requested_job(request)]), Requested(operation))
    _LOG.warning("'%s' requested: %s", request.by, encode(request.action).decode())
    return operation, note


def operation_of(book: JobBook, request: ControlRequest, time_s: float) -> Operation:
    """Return a request as this participant carries it out, later than all others."""
    time_s = max(time_s, math.nextafter(book.operations.last_s, math.inf))
    awards: tuple[str, ...] = ()
    match request.action:
        case Settle(job, "redo") if (entry := book.jobs.get(job)) is not None:
            last = (entry.award,) if entry.state == "unfinished" and entry.award not in ("", NO_AWARD) else ()
            awards = (*book.operations.redone(job), *last)[-MAX_REDONE:]
        case _:
            pass
    epoch = book.epoch if book.is_central else ""
    return Operation(book.name, time_s, request, epoch=epoch, awards=awards)


def objection(book: JobBook, request: ControlRequest, arms: Set[str], states: Mapping[str, State]) -> str:
    """Return why a request changes nothing; "" if it changes something.

    Raises:
        Refused: it is not possible now.
    """
    paused = book.operations.paused
    match request.action:
        case Pause(arm):
            _check_arm(book, arm, arms)
            if arm not in paused:
                return ""
            before = f"paused{by_whom(paused[arm])}"
            if book.is_central or paused[arm] == request.by:
                return f"Nothing changed: it is {before} already."
            return f"It was {before} before; the latest request counts."  # peers agree on it whatever they have heard
        case Resume(arm):
            _check_arm(book, arm, arms)
            if arm != ALL_ARMS and ALL_ARMS in paused:
                raise Refused("All arms are paused. Resume all; then pause those that must stay paused.")
            return "" if (paused if arm == ALL_ARMS else arm in paused) else NO_CHANGE
        case Clear():
            raise Refused("Space is freed by a request to jobs/clear, or by thermofleet arm clear.")
        case Cancel() | Settle() | Change() as action:
            return _objection_to_job(book, action, states)


def _check_arm(book: JobBook, arm: str, arms: Set[str]) -> None:
    if arm != ALL_ARMS and not any(arm in names for names in (arms, book.space, book.operations.paused)):
        raise Refused(f"There is no arm '{arm}'. Arms: {listed(sorted(arms))}; '*' for all.")


def _objection_to_job(book: JobBook, action: Cancel | Settle | Change, states: Mapping[str, State]) -> str:
    entry = book.jobs.get(action.job)
    if entry is None or (entry.spec is None and not entry.is_settled):
        if action.job in book.past:
            return "It was settled long ago."
        raise Refused(f"There is no job '{action.job}'.")
    state = entry.state
    match action:
        case Cancel():
            if state == "unfinished":
                raise Refused(f"'{action.job}' is unfinished: settle it as done, or redo it and then cancel it.")
            return f"It is {state}." if state == "finished" or book.operations.cancelled(action.job) else ""
        case Settle(_, outcome):
            if state != "unfinished":
                if state in ("finished", "waiting") and (state == "finished") == (outcome == "done"):
                    return NO_CHANGE
                raise Refused(f"'{action.job}' is {state}; only an unfinished job can be settled.")
            if outcome == "redo" and book.ended:
                raise Refused("The shift is over: nothing is redone.")
            at_work = [arm for arm, state in states.items() if state.job == action.job]  # also after it was cleared
            at_work += [grant.record.arm for grant in book.open.values() if grant.record.job == action.job]
            if outcome == "redo" and at_work:
                arm = at_work[0]
                raise Refused(
                    f"'{arm}' may still do the last cycle of '{action.job}'. Stop it and free its space "
                    f"(jobs/clear, or thermofleet arm clear {arm}) first."
                )
            return ""
        case Change():
            if state in SETTLED or entry.spec is None:
                raise Refused(f"'{action.job}' is {state}; only a job that is not settled can be changed.")
            try:
                changed = changed_spec(entry.spec, action)
            except ValueError as error:
                raise Refused(str(error)) from error
            return NO_CHANGE if changed == entry.spec else ""


def controlled(book: JobBook, request: ControlRequest, note: str, job: JobStatus | None) -> Controlled:
    """Return the reply to a request that was carried out.

    Args:
        note: Why it changed nothing; "" if it did.
        job: Status of its job.
    """
    step, paused = note or next_step(book, request), dict(book.operations.paused)
    return Controlled(book.name, request.request, not note, step, job, paused)


def next_step(book: JobBook, request: ControlRequest) -> str:
    """Return what happens next; "" if nothing does."""
    match request.action:
        case Pause(arm):
            jobs = [job for job, (has, _) in book.at_work().items() if arm in (ALL_ARMS, has)]
            return f"{len(jobs)} job(s) end or go back after the cycle in progress." if jobs else ""
        case Cancel(job) if job in (at_work := book.at_work()):
            if at_work[job][1]:
                return "It is in its last cycle: it is cancelled only if the arm returns it."
            return "The arm ends the cycle in progress and returns it."
        case _:
            return ""
