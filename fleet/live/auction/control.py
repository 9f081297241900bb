"""Requests of people who steer a fleet: which are possible, and what happens next; the same without an auctioneer."""

from collections.abc import Container, Mapping, Set
from typing import Protocol

from fleet.bus.protocol.auction import SETTLED, JobSpec, JobState
from fleet.bus.protocol.operator import ALL_ARMS, Cancel, Change, ControlRequest, Pause, Resume, Settle
from fleet.errors import Refused
from fleet.live.auction.job_rules import changed_spec
from fleet.live.auction.past_jobs import content_hash

ALREADY_DONE = "This request was carried out before."
NO_CHANGE = "Nothing changed: it is so already."


class SteeredJob(Protocol):
    """What the rules need to know about a job."""

    @property
    def spec(self) -> JobSpec: ...
    @property
    def state(self) -> JobState: ...
    @property
    def cancelled(self) -> bool: ...


class SteeredFleet(Protocol):
    """What the rules need to know about a fleet: the ledger of an auctioneer, or what an arm without one knows."""

    @property
    def jobs(self) -> Mapping[str, SteeredJob]: ...
    @property
    def past(self) -> Container[str]: ...
    @property
    def paused(self) -> Mapping[str, str]: ...
    @property
    def space(self) -> Mapping[str, frozenset[str]]: ...
    @property
    def aside(self) -> Container[str]: ...
    @property
    def requests(self) -> Mapping[str, int]: ...
    @property
    def ended(self) -> bool: ...

    def at_work(self) -> Mapping[str, tuple[str, bool]]:
        """Return the arm that has a job, and whether it has permission to commit, by job."""
        ...


def was_carried_out(fleet: SteeredFleet, request: ControlRequest) -> bool:
    """Return whether this request was carried out before.

    Raises:
        Refused: another request of this name was.
    """
    before = fleet.requests.get(request.request)
    if before not in (None, 0, content_hash(request)):
        raise Refused(
            f"Another request of the name '{request.request}' was carried out before, so this one is not "
            f"({request.action}). Give each request a name of its own, for example a UUID."
        )
    return before is not None


def job_of(request: ControlRequest) -> str:
    """Return the name of the job of a request; "" if it is for arms."""
    return "" if isinstance(request.action, Pause | Resume) else request.action.job


def objection(fleet: SteeredFleet, request: ControlRequest, arms: Set[str]) -> str:
    """Return why a request changes nothing; "" if it changes something.

    Args:
        arms: Those that are present, and those of the cell.

    Raises:
        Refused: it is not possible now.
    """
    match request.action:
        case Pause(arm):
            _check_arm(fleet, arm, arms)
            return NO_CHANGE if arm in fleet.paused else ""
        case Resume(arm):
            _check_arm(fleet, arm, arms)
            if arm != ALL_ARMS and ALL_ARMS in fleet.paused:
                raise Refused("All arms are paused. Resume all; then pause those that must stay paused.")
            paused = fleet.paused if arm == ALL_ARMS else arm in fleet.paused
            return "" if paused else NO_CHANGE
        case Cancel() | Settle() | Change() as action:
            return _objection_to_job(fleet, action)


def _check_arm(fleet: SteeredFleet, arm: str, arms: Set[str]) -> None:
    if arm != ALL_ARMS and not any(arm in names for names in (arms, fleet.space, fleet.paused)):
        raise Refused(f"There is no arm '{arm}'. Arms: {', '.join(sorted(arms)) or 'none'}; '*' for all.")


def _objection_to_job(fleet: SteeredFleet, action: Cancel | Settle | Change) -> str:
    entry = fleet.jobs.get(action.job)
    if entry is None:
        if action.job in fleet.past:
            return "It was settled long ago."
        if action.job in fleet.aside:
            if isinstance(action, Settle):
                return ""
            raise Refused(f"'{action.job}' is put aside, and its description is lost: settle it as done or redo.")
        raise Refused(f"There is no job '{action.job}'.")
    state = entry.state
    match action:
        case Cancel():
            if state == "unfinished":
                raise Refused(f"'{action.job}' is unfinished: settle it as done, or redo it and then cancel it.")
            return f"It is {state}." if state == "finished" or entry.cancelled else ""
        case Settle(_, outcome):
            if state != "unfinished":
                if state in ("finished", "waiting") and (state == "finished") == (outcome == "done"):
                    return NO_CHANGE
                raise Refused(f"'{action.job}' is {state}; only an unfinished job can be settled.")
            if outcome == "redo" and fleet.ended:
                raise Refused("The shift is over: nothing is redone.")
            if outcome == "redo" and action.job in (at_work := fleet.at_work()):
                arm = at_work[action.job][0]
                raise Refused(
                    f"'{arm}' may still do the last cycle of '{action.job}'. Stop it and free its space "
                    f"(jobs/clear, or thermofleet arm clear {arm}) first."
                )
            return ""
        case Change():
            if state in SETTLED:
                raise Refused(f"'{action.job}' is {state}; only a job that is not settled can be changed.")
            try:
                changed = changed_spec(entry.spec, action)
            except ValueError as error:
                raise Refused(str(error)) from error
            return NO_CHANGE if changed == entry.spec else ""


def next_step(fleet: SteeredFleet, request: ControlRequest) -> str:
    """Return what happens next; "" if nothing does."""
    match request.action:
        case Pause(arm):
            jobs = [job for job, (has, _) in fleet.at_work().items() if arm in (ALL_ARMS, has)]
            return f"{len(jobs)} job(s) end or go back after the cycle in progress." if jobs else ""
        case Cancel(job) if job in (at_work := fleet.at_work()):
            if at_work[job][1]:
                return "It is in its last cycle: it is cancelled only if the arm returns it."
            return "The arm ends the cycle in progress and returns it."
        case _:
            return ""
