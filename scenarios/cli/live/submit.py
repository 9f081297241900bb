"""`thermofleet submit`: submit jobs from a file, and follow them."""

import re
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
import typer

from fleet.bus.client.client import BusClient
from fleet.bus.client.replies import NoReply
from fleet.bus.protocol.auction import Admission, JobSpec, JobStatus
from fleet.errors import BusError, FleetError, Refused, nearest
from fleet.job import BOUNDS, KINDS
from fleet.live.job_client import JobClient
from fleet.live.monitor.snapshot import describe_status
from scenarios.cli.options import ENDPOINT, EndpointOption, FleetOption, the_fleet
from scenarios.cli.signals import Stop, until_stopped
from scenarios.cli.terminal import echo

TURN_S = 0.2
"""Real seconds between two checks for a stop request."""
PATIENCE_S = 30.0
"""Real seconds without a reply after which following ends."""
_UNKNOWN_KIND = re.compile(r"Invalid enum value '(.*)'", re.DOTALL)
"""Message of msgspec; of all fields of a job, only its kind is an enumeration."""
Decoded = TypeVar("Decoded")
JOBS_HELP = "Jobs as JSON: a list, or one job per line; - reads standard input."


def submit_command(
    file: Annotated[str, typer.Argument(help=JOBS_HELP)],
    wait: Annotated[
        bool, typer.Option("--wait", help="Follow the jobs to their end; exit code 1 if one stays unfinished.")
    ] = False,
    by: Annotated[str, typer.Option(help="Name of the submitter, for the records.")] = "",
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
) -> None:
    """Submit jobs to the fleet's auctioneer; accepted jobs are on its disk."""
    jobs = read_jobs(file)
    with until_stopped() as stop, BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        client = JobClient(link, by, print_changes())
        admissions = submit(client, jobs, link.fleet)
        for admission in admissions:
            decision = "accepted" if admission.accepted else "refused"
            echo(f"{admission.job}: {decision}{f': {admission.reason}' if admission.reason else ''}")
        accepted = [admission.job for admission in admissions if admission.accepted]
        unfinished = follow(link, client, stop) if wait else []
        stop.leave("Stopped following; the auctioneer has the jobs.")
    if len(accepted) < len(admissions) or unfinished:
        raise typer.Exit(1)


def read_jobs(file: str) -> list[JobSpec]:
    """Read the jobs of a file, or of standard input for `-`.

    Raises:
        FleetError: names the line (or the place in the list) and what is wrong there.
    """
    name = "standard input" if file == "-" else file
    try:
        raw = sys.stdin.buffer.read() if file == "-" else Path(file).read_bytes()
    except OSError as error:
        raise FleetError(f"Cannot read '{file}': {error.strerror}.") from error
    if raw.lstrip().startswith(b"["):
        jobs = _decode(raw, list[JobSpec], name)
    else:
        lines = enumerate(raw.splitlines(), start=1)
        jobs = [_decode(line, JobSpec, f"{name}, line {number}") for number, line in lines if line.strip()]
    if not jobs:
        raise FleetError(f"{name} contains no jobs.")
    return jobs


def _decode(raw: bytes, kind: type[Decoded], where: str) -> Decoded:
    try:
        return msgspec.json.decode(raw, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FleetError(f"{where}: {explain(error)}") from error


def explain(error: Exception) -> str:
    """Sentence for an error of msgspec, with the field as the file names it."""
    problem, _, path = str(error).partition(" - at `$")
    problem = problem.rstrip(".")
    if unknown := _UNKNOWN_KIND.fullmatch(problem):
        problem = f"No kind of job '{unknown[1]}'{nearest(unknown[1], KINDS)}".rstrip(".")
    path = path.rstrip("`").lstrip(".")
    bounds = BOUNDS.get(path.rpartition(".")[2])
    if problem == "Number out of range" and bounds is not None:
        problem = f"The number is too large; it must be {bounds}"
    return f"{problem}{f' (at {path})' if path else ''}."


def submit(client: JobClient, jobs: Sequence[JobSpec], fleet: str) -> list[Admission]:
    """Submit jobs and return the auctioneer's decision on each.

    Raises:
        FleetError: it refused, or there is none.
    """
    try:
        return client.submit_and_wait(jobs)
    except Refused as error:
        raise FleetError(f"The auctioneer refused the submission: {error}") from error
    except NoReply as error:
        raise BusError(
            f"No auctioneer of fleet '{fleet}' replied. Is `thermofleet auction` running? Arms that allocate by "
            "consensus reply once all are present, or a majority has been for 20 s."
        ) from error


def follow(link: BusClient, client: JobClient, stop: Stop) -> list[str]:
    """Serve until all followed jobs have ended, or until stopped; return the names of those not finished.

    Raises:
        BusError: the auctioneer is gone, and does not come back.
    """
    while client.open and not stop.is_set():
        client.step()
        link.serve(time.monotonic() + TURN_S)
        if time.monotonic() > client.heard_s + PATIENCE_S:
            raise BusError(
                f"No reply from an auctioneer of fleet '{link.fleet}' for {PATIENCE_S:.0f} s; "
                "accepted jobs are on its disk."
            )
    return [name for name, status in client.statuses.items() if status is None or status.state != "finished"]


def print_changes() -> Callable[[JobStatus], None]:
    """A function that prints a status of a job if its state is another one than before."""
    states: dict[str, str] = {}

    def show(status: JobStatus) -> None:
        if states.get(status.job) != status.state:
            states[status.job] = status.state
            echo(describe_status(status))

    return show
