"""Rules of the requests of people, checked on everything that an auctioneer has published.

A request is carried out once. A paused arm gets no job. A cancelled job goes to no arm, unless a person has it redone,
and ends as cancelled or finished, or unfinished after a crash in its last cycle. A job that is settled as done is
finished. A job has the value of its last change.
"""

from collections import Counter
from collections.abc import Mapping
from typing import Any

from benchmarks.simulation.recording import Sent
from benchmarks.simulation.world import Violation
from fleet.bus.protocol.auction import Result
from fleet.bus.protocol.operator import ALL_ARMS, Cancel, Change, Clear, Operation, Pause, Resume, Settle


def check_steering(sent: Sent, states: Mapping[str, str], jobs: Mapping[str, Any]) -> None:
    """Check the end of a shift.

    Args:
        states: State of every job at the end.
        jobs: Entries of the job book.

    Raises:
        Violation: a rule is broken.
    """
    messages = [message for _, message in sorted(sent.messages.items(), key=lambda item: item[0])]
    operations = [message for message in messages if isinstance(message, Operation)]
    results = [each for each in messages if isinstance(each, Result) and each.status.state == "awarded"]
    # Later results of an award tell that a person has changed or cancelled its job.
    awards = list({each.status.award: each for each in reversed(results)}.values())
    for name, count in Counter(each.request.request for each in operations).items():
        if count > 1:
            raise Violation(f"The request '{name}' was carried out {count} times.")
    for number, operation in enumerate(operations):
        later, action = operations[number + 1 :], operation.request.action
        if isinstance(action, Pause):
            _check_pause(operation, action, later, awards)
        elif not isinstance(action, Resume | Clear):
            _check_job(operation, [each for each in later if _job(each) == action.job], awards, states, jobs)


def _job(operation: Operation) -> str:
    return getattr(operation.request.action, "job", "")


def _check_pause(pause: Operation, action: Pause, later: list[Operation], awards: list[Result]) -> None:
    actions = ((each.time_s, each.request.action) for each in later)
    ends = (time_s for time_s, each in actions if isinstance(each, Resume) and each.arm in (ALL_ARMS, action.arm))
    end_s = next(ends, float("inf"))
    for award in awards:
        if action.arm in (ALL_ARMS, award.status.arm) and pause.time_s < award.time_s < end_s:
            raise Violation(f"'{award.status.arm}' gets '{award.status.job}' while it is paused.")


def _check_job(
    operation: Operation,
    later: list[Operation],
    awards: list[Result],
    states: Mapping[str, str],
    jobs: Mapping[str, Any],
) -> None:
    action, state = operation.request.action, states.get(_job(operation))
    settled = [each for each in later if isinstance(each.request.action, Settle)]
    match action:
        case Cancel(job):
            end_s = next((each.time_s for each in settled), float("inf"))
            if any(each.status.job == job and operation.time_s < each.time_s < end_s for each in awards):
                raise Violation(f"'{job}' is cancelled, and awarded after that.")
            if not settled and job in jobs and state not in ("cancelled", "finished", "unfinished"):
                raise Violation(f"'{job}' was cancelled, and is called {state}.")
        case Settle(job, "done") if state != "finished":
            raise Violation(f"'{job}' was settled as done, and is called {state}.")
        case Change(job, value=float() as value) if job in jobs:
            changed = any(isinstance(each.request.action, Change) for each in later)
            if not changed and jobs[job].spec.value != value:
                raise Violation(f"'{job}' was changed to the value {value}, and has {jobs[job].spec.value}.")
        case _:
            pass
