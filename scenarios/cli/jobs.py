"""Commands that steer a live fleet: `thermofleet job` and `thermofleet arm pause | resume | reset | clear`."""

from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fleet.errors import FleetError
from fleet.job import BOUNDS, DWELL_S
from scenarios.cli.options import ENDPOINT, EndpointOption, FleetOption, JsonOption, check_name, number
from scenarios.cli.terminal import out_console, print_json
from scenarios.show.table import Table

if TYPE_CHECKING:  # slow to import
    from fleet.bus.protocol.operator import Action

_RANGES = {name: (bounds.low, bounds.high) for name, bounds in BOUNDS.items()}
_ONE = "One job instead of a file"
LISTEN_S = 1.0
"""Real seconds of listening for the list of jobs."""
JobArg = Annotated[str, typer.Argument(help="Name of the job.")]
ArmArg = Annotated[str, typer.Argument(help="Name of the arm.", callback=check_name)]
ArmOrAll = Annotated[str, typer.Argument(help="Name of the arm. Default: all arms.")]
ByOption = Annotated[str, typer.Option(help="Who requests it, for journal and status. Default: the name of the user.")]


def submit_command(
    file: Annotated[
        str, typer.Argument(help="Jobs as JSON: a list, or one job per line; - reads standard input.")
    ] = "",
    wait: Annotated[
        bool, typer.Option("--wait", help="Follow the jobs to their end; exit code 1 if one stays unfinished.")
    ] = False,
    quote: Annotated[
        bool,
        typer.Option("--quote", help="Submit nothing: print the cost of each plan of every arm, or why it cannot."),
    ] = False,
    timeout: Annotated[float, number("--quote: real seconds to wait for arms.", 0, 600, above=True)] = 5.0,
    as_json: Annotated[bool, typer.Option("--json", help="--quote: print JSON.")] = False,
    by: Annotated[str, typer.Option(help="Name of the submitter, for the records.")] = "",
    kind: Annotated[str, typer.Option(help="pick_place, hold, press or sort.", rich_help_panel=_ONE)] = "",
    name: Annotated[str, typer.Option(help="Name of the job. Default: its kind.", rich_help_panel=_ONE)] = "",
    place: Annotated[
        list[str] | None, typer.Option(help="Place of the cell; twice for pick_place and sort.", rich_help_panel=_ONE)
    ] = None,
    payload: Annotated[float, number("Payload, kg.", *_RANGES["payload_kg"], rich_help_panel=_ONE)] = 0.0,
    repetitions: Annotated[int, number("Number of cycles.", *_RANGES["repetitions"], rich_help_panel=_ONE)] = 1,
    dwell: Annotated[
        float,
        number(
            "hold, press: duration of a cycle, s. Others: time to close or open the hand, s.",
            *_RANGES["dwell_s"],
            rich_help_panel=_ONE,
        ),
    ] = DWELL_S,
    force: Annotated[float, number("Force of a press, N.", *_RANGES["force_n"], rich_help_panel=_ONE)] = 0.0,
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
) -> None:
    """Submit jobs to a fleet; accepted jobs are durable. With --quote, only ask what they would cost.

    A quote has the fastest plan first. Columns:
    peak: predicted temperature of the hottest motor
    gained: peak minus the hottest motor now
    P: probability that a motor passes the warning limit
    d: thermal difficulty, to compare arms on one job
    duration: from home to home
    finish in: time until the last cycle is done, after the arm's current jobs
    Exit code 1: a job was refused or stays unfinished; with --quote, no arm can do it.
    """
    if bool(file) == bool(kind):
        raise FleetError("Give either a FILE of jobs or one job by --kind and --place.")
    if wait and quote:
        raise FleetError("--quote submits nothing: leave --wait out.")
    if as_json and not quote:
        raise FleetError("--json is for --quote: leave it out.")
    from scenarios.live.requests import one_job, quote_jobs, read_jobs, submit_jobs

    jobs = read_jobs(file) if file else [one_job(name or kind, kind, place or [], payload, repetitions, dwell, force)]
    if quote:
        done = quote_jobs(jobs, endpoint, fleet, timeout_s=timeout, as_json=as_json)
    else:
        done = submit_jobs(jobs, endpoint, fleet, by=by, wait=wait)
    if not done:
        raise typer.Exit(1)


def list_command(endpoint: EndpointOption = ENDPOINT, fleet: FleetOption = "", as_json: JsonOption = False) -> None:
    """List the jobs of a fleet by name: state, arm, cycles and reason."""
    import time

    from fleet.bus.client import BusClient
    from fleet.live.monitor.snapshot import FleetListener
    from scenarios.cli.options import the_fleet

    with BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        listener = FleetListener(link)
        listener.serve(time.monotonic() + LISTEN_S)
        jobs = sorted(listener.view.snapshot(time.monotonic()).jobs, key=lambda status: status.job)
    if as_json:
        print_json(jobs)
        return
    rows = tuple(
        (each.job, each.state.replace("_", " "), each.arm, f"{each.cycles} of {each.repetitions}", each.reason)
        for each in jobs
    )
    out_console.print(Table(head=("job", "state", "arm", "cycles", "reason"), rows=rows, numbers=False))


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
    from fleet.bus.protocol.operator import Cancel

    _control([Cancel(job) for job in jobs], by, endpoint, fleet)


def settle_command(
    job: JobArg,
    outcome: Annotated[str, typer.Argument(help="done, or redo: its last cycle is done again.")],
    by: ByOption = "",
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
) -> None:
    """Resolve a job with unknown outcome, after inspecting the cell."""
    from fleet.bus.protocol.operator import Settle
    from scenarios.spec.parse import choose

    _control([Settle(job, choose("outcome", outcome, Literal["done", "redo"]))], by, endpoint, fleet)


def change_command(
    job: JobArg,
    due: Annotated[float | None, number("Due date, s of fleet time.", *_RANGES["due_s"])] = None,
    no_due: Annotated[bool, typer.Option("--no-due", help="Remove the due date.")] = False,
    value: Annotated[float | None, number("Value.", *_RANGES["value"])] = None,
    by: ByOption = "",
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
) -> None:
    """Change due date and value of a job that is not settled."""
    if (due is not None and no_due) or (due is None and not no_due and value is None):
        raise FleetError("Give --due or --no-due, --value, or both a due date and a value.")
    from msgspec import UNSET

    from fleet.bus.protocol.operator import Change

    due_s = None if no_due else UNSET if due is None else due
    _control([Change(job, due_s, UNSET if value is None else value)], by, endpoint, fleet)


def pause_command(
    arm: ArmOrAll = "*", by: ByOption = "", endpoint: EndpointOption = ENDPOINT, fleet: FleetOption = ""
) -> None:
    """Give an arm, or all, no more jobs.

    An arm at work ends the cycle in progress and goes home; its job goes to
    another arm. A job in its last cycle is finished.
    """
    from fleet.bus.protocol.operator import Pause

    _control([Pause(arm)], by, endpoint, fleet)


def resume_command(
    arm: ArmOrAll = "*", by: ByOption = "", endpoint: EndpointOption = ENDPOINT, fleet: FleetOption = ""
) -> None:
    """End a pause."""
    from fleet.bus.protocol.operator import Resume

    _control([Resume(arm)], by, endpoint, fleet)


def reset_command(arm: ArmArg, by: ByOption = "", endpoint: EndpointOption = ENDPOINT, fleet: FleetOption = "") -> None:
    """Clear the fault of an arm now.

    The arm ends its cycle and goes home by itself: nobody may be in its way.
    An arm that is too hot refuses.
    """
    from scenarios.live.requests import reset_arm

    reset_arm(arm, by, endpoint, fleet)


def clear_command(arm: ArmArg, by: ByOption = "", endpoint: EndpointOption = ENDPOINT, fleet: FleetOption = "") -> None:
    """Free the space that an absent arm takes, so that other arms can use it.

    First stop the process of the arm, and make sure that the arm is at home
    or removed, and switched off. Start the process again only when the arm is
    at home. The request is refused for an arm that is present, because its own
    quotes report its space.
    """
    from scenarios.live.requests import clear_space

    clear_space(arm, by, endpoint, fleet)


def _control(actions: "list[Action]", by: str, endpoint: str, fleet: str) -> None:
    from scenarios.live.requests import control

    control(actions, by, endpoint, fleet)
