"""`thermofleet submit`: submit jobs from a file, and follow them."""

import re
import sys
import time
from collections.abc import Iterator, Sequence
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
import typer

from fleet.bus.client.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    SETTLED,
    Admission,
    JobSpec,
    JobStatus,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.errors import BusError, FleetError, nearest
from fleet.job import BOUNDS, KINDS
from fleet.live.monitor.snapshot import describe_status
from scenarios.cli.options import ENDPOINT, EndpointOption, FleetOption, the_fleet
from scenarios.cli.signals import Stop, until_stopped
from scenarios.cli.terminal import echo

REPLY_S, ATTEMPTS = 5.0, 3
"""Real seconds to wait for a reply, and number of attempts: a job that is submitted twice is one job."""
JOBS_PER_MESSAGE = 64
"""A router may drop messages of more than 64 KiB."""
POLL_S = 0.5
"""Real seconds between two status requests."""
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
        admissions = [admission for batch in batches(jobs) for admission in submit(link, batch, by)]
        for admission in admissions:
            decision = "accepted" if admission.accepted else "refused"
            echo(f"{admission.job}: {decision}{f': {admission.reason}' if admission.reason else ''}")
        accepted = [admission.job for admission in admissions if admission.accepted]
        unfinished = follow(link, accepted, stop) if wait and accepted else []
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


def batches(jobs: Sequence[JobSpec]) -> Iterator[tuple[JobSpec, ...]]:
    """Split jobs into messages, each job after those that it waits for."""
    ordered = in_order(jobs)
    for start in range(0, len(ordered), JOBS_PER_MESSAGE):
        yield tuple(ordered[start : start + JOBS_PER_MESSAGE])


def in_order(jobs: Sequence[JobSpec]) -> Sequence[JobSpec]:
    """Sort jobs so that each comes after those that it waits for; leave them as they are if that is impossible."""
    try:
        order = list(TopologicalSorter({job.name: job.after for job in jobs}).static_order())
    except CycleError:
        return jobs  # the auctioneer names the cycle
    place = {name: i for i, name in enumerate(order)}
    return sorted(jobs, key=lambda job: place[job.name])


def submit(link: BusClient, jobs: tuple[JobSpec, ...], by: str) -> tuple[Admission, ...]:
    """Submit jobs and return the auctioneer's decision on each.

    Raises:
        FleetError: it refused, or there is none.
    """
    key = keys.of_jobs(link.fleet, "submit")
    for _ in range(ATTEMPTS):
        answers = link.query_and_wait(key, Submission(jobs, by), SubmissionReply, timeout_s=REPLY_S)
        for reply in answers.messages.values():
            return reply.jobs
        for reason in filter(None, answers.refused.values()):
            raise FleetError(f"The auctioneer refused the submission: {reason}")
    raise BusError(
        f"No auctioneer of fleet '{link.fleet}' replied. Is `thermofleet auction` running? Arms that allocate by "
        "consensus reply once all are present, or a majority has been for 20 s."
    )


def follow(link: BusClient, names: Sequence[str], stop: Stop) -> list[str]:
    """Print every change until all jobs have ended, or until stopped; return the names of those not finished.

    Raises:
        BusError: the auctioneer is gone, and does not come back.
    """
    states: dict[str, str] = {}
    heard_s = time.monotonic()
    while not stop.is_set():
        for status in request_status(link, names):
            heard_s = time.monotonic()
            if states.get(status.job) != status.state:
                states[status.job] = status.state
                echo(describe_status(status))
        if all(states.get(name) in SETTLED for name in names):
            break
        if time.monotonic() > heard_s + PATIENCE_S:
            raise BusError(
                f"No reply from an auctioneer of fleet '{link.fleet}' for {PATIENCE_S:.0f} s; "
                "accepted jobs are on its disk."
            )
        stop.wait(POLL_S)
    return [name for name in names if states.get(name) != "finished"]


def request_status(link: BusClient, names: Sequence[str]) -> list[JobStatus]:
    """Request the status of jobs; empty without a reply."""
    key = keys.of_jobs(link.fleet, "status")
    statuses: list[JobStatus] = []
    for start in range(0, len(names), JOBS_PER_MESSAGE):
        request = StatusRequest(tuple(names[start : start + JOBS_PER_MESSAGE]))
        replies = link.query_and_wait(key, request, Status, timeout_s=REPLY_S).messages.values()
        statuses += [status for reply in replies for status in reply.jobs]
    return statuses
