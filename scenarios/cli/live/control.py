"""`thermofleet cancel`, `settle`, `change`, `pause` and `resume`: steer a fleet."""

import secrets
from typing import Annotated

import typer
from msgspec import UNSET

from fleet.bus.client.client import BusClient
from fleet.bus.client.replies import NoReply
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import JobStatus
from fleet.bus.protocol.operator import (
    ALL_ARMS,
    Action,
    Cancel,
    Change,
    Controlled,
    ControlRequest,
    Pause,
    ResetReply,
    ResetRequest,
    Resume,
)
from fleet.bus.protocol.operator import Settle as SettleJob
from fleet.errors import BusError, FleetError
from fleet.job import BOUNDS
from scenarios.cli.live.clear import REPLY_S, check_person, user_name
from scenarios.cli.options import ENDPOINT, EndpointOption, FleetOption, check_name, number, the_fleet
from scenarios.cli.terminal import echo

ATTEMPTS = 3
"""The same request again is carried out once."""
JobArg = Annotated[str, typer.Argument(help="Name of the job.")]
ArmArg = Annotated[str, typer.Argument(help="Name of the arm. Default: all arms.")]
ByOption = Annotated[str, typer.Option(help="Who requests it, for journal and status. Default: the name of the user.")]


def cancel_command(
    jobs: Annotated[list[str], typer.Argument(help="Names of the jobs.")],
    by: ByOption = "",
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
) -> None:
    """Cancel jobs.

    An arm at work ends the cycle in progress and goes home. A job in its last
    cycle is finished.
    """
    request([Cancel(job) for job in jobs], by, endpoint, fleet)


def settle_command(
    job: JobArg,
    outcome: Annotated[str, typer.Argument(help="done, or redo: its last cycle is done again.")],
    by: ByOption = "",
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
) -> None:
    """Say what became of an unfinished job; look at the cell first."""
    if outcome not in ("done", "redo"):
        raise FleetError(f"OUTCOME must be done or redo (got '{outcome}').")
    request([SettleJob(job, "done" if outcome == "done" else "redo")], by, endpoint, fleet)


def change_command(
    job: JobArg,
    due: Annotated[
        float | None, number("Due date, s of fleet time.", BOUNDS["due_s"].low, BOUNDS["due_s"].high)
    ] = None,
    no_due: Annotated[bool, typer.Option("--no-due", help="Remove the due date.")] = False,
    value: Annotated[float | None, number("Value.", BOUNDS["value"].low, BOUNDS["value"].high)] = None,
    by: ByOption = "",
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
) -> None:
    """Change due date and value of a job that is not settled."""
    if (due is not None and no_due) or (due is None and not no_due and value is None):
        raise FleetError("Give --due or --no-due, --value, or both a due date and a value.")
    due_s = None if no_due else UNSET if due is None else due
    request([Change(job, due_s, UNSET if value is None else value)], by, endpoint, fleet)


def pause_command(
    arm: ArmArg = ALL_ARMS, by: ByOption = "", endpoint: EndpointOption = ENDPOINT, fleet: FleetOption = ""
) -> None:
    """Give an arm, or all, no more jobs.

    An arm at work ends the cycle in progress and goes home; its job goes to
    another arm. A job in its last cycle is finished.
    """
    request([Pause(arm)], by, endpoint, fleet)


def resume_command(
    arm: ArmArg = ALL_ARMS, by: ByOption = "", endpoint: EndpointOption = ENDPOINT, fleet: FleetOption = ""
) -> None:
    """End a pause."""
    request([Resume(arm)], by, endpoint, fleet)


def reset_command(
    arm: Annotated[str, typer.Argument(help="Name of the arm.", callback=check_name)],
    by: ByOption = "",
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
) -> None:
    """Clear the fault of an arm now.

    The arm ends its cycle and goes home by itself: nobody may be in its way.
    An arm that is too hot refuses.
    """
    check_person(by)
    with BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        key, message = keys.of_arm(link.fleet, arm, "reset"), ResetRequest(by or user_name())
        try:
            reply = link.ask(key, message, ResetReply, timeout_s=REPLY_S)
        except NoReply as error:
            raise BusError(
                f"The arm '{arm}' did not reply. With TLS, use a certificate of the role operator."
            ) from error
    echo(f"{arm}: its fault is cleared." if reply.changed else f"{arm}: it has no fault.")


def request(actions: list[Action], by: str, endpoint: str, fleet: str) -> None:
    """Request actions, one after another, and print what became of them.

    Raises:
        Refused: one is refused.
        BusError: nobody replies.
    """
    check_person(by)
    with BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        for action in actions:
            echo(describe(action, _request(link, ControlRequest(secrets.token_hex(8), action, by or user_name()))))


def _request(link: BusClient, control: ControlRequest) -> Controlled:
    key = keys.of_jobs(link.fleet, "control")
    try:
        return link.ask(key, control, Controlled, timeout_s=REPLY_S, attempts=ATTEMPTS)
    except NoReply as error:
        raise BusError(
            f"Neither an auctioneer nor an arm of fleet '{link.fleet}' replied within {ATTEMPTS * REPLY_S:g} s. With "
            "TLS, use a certificate of the role operator."
        ) from error


def describe(action: Action, reply: Controlled) -> str:
    """One line about the outcome of an action."""
    note = f" {reply.note}" if reply.note else ""
    if isinstance(action, Pause | Resume):
        arms = ", ".join("all arms" if arm == ALL_ARMS else arm for arm in sorted(reply.paused))
        return f"Paused: {arms or 'none'}.{note}"
    return f"{action.job}: {_state(reply.job)}{note}"


def _state(job: JobStatus | None) -> str:
    return "settled." if job is None else f"{job.state}, {job.cycles} of {job.repetitions} cycles."
