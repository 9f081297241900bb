"""`thermofleet ask`: request quotes of all arms without submitting anything."""

import time
from collections.abc import Mapping, Sequence
from typing import Annotated

import msgspec
import typer
from rich.table import Table

from fleet.bus.client.client import BusClient
from fleet.bus.client.replies import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    MOST_QUOTED,
    NOT_PLANNED,
    JobEstimate,
    JobSpec,
    PlanQuote,
    Quote,
    QuoteRequest,
)
from fleet.errors import BusError, FleetError
from fleet.job import BOUNDS, DWELL_S
from scenarios.cli.live.submit import JOBS_HELP, explain, read_jobs
from scenarios.cli.options import ENDPOINT, EndpointOption, FleetOption, number, the_fleet
from scenarios.cli.terminal import echo, out_console, say

REPLY_S, PAUSE_S = 5.0, 0.2
"""Real seconds to wait for arms, as planning a new motion takes a while; and before a request is repeated."""
_RANGES = {name: (bounds.low, bounds.high) for name, bounds in BOUNDS.items()}


def ask_command(
    file: Annotated[str, typer.Argument(help=JOBS_HELP)] = "",
    kind: Annotated[str, typer.Option(help="One job instead of a file: pick_place, hold, press, sort.")] = "",
    place: Annotated[list[str] | None, typer.Option(help="Place of the cell; twice for pick_place and sort.")] = None,
    payload: Annotated[float, number("Payload, kg.", *_RANGES["payload_kg"])] = 0.0,
    repetitions: Annotated[int, number("Number of cycles.", *_RANGES["repetitions"])] = 1,
    dwell: Annotated[
        float,
        number("hold, press: duration of a cycle, s. Others: time to close or open the hand, s.", *_RANGES["dwell_s"]),
    ] = DWELL_S,
    force: Annotated[float, number("Force of a press, N.", *_RANGES["force_n"])] = 0.0,
    timeout: Annotated[float, number("Real seconds to wait for arms.", 0, 600, above=True)] = REPLY_S,
    as_json: Annotated[bool, typer.Option("--json", help="Print the quotes as JSON.")] = False,
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
) -> None:
    """Request quotes from all arms: the cost of each plan of a job, or why the arm cannot do the job.

    This submits no job. The fastest plan comes first. Columns:
    peak: predicted temperature of the hottest motor
    gained: peak minus the hottest motor now
    P: probability that a motor passes the warning limit
    d: thermal difficulty, to compare arms on one job
    duration: from home to home
    finish in: time until the last cycle is done, after the arm's current jobs
    Exit code 1: there is a job that no arm can do.
    """
    if bool(file) == bool(kind):
        raise FleetError("Give either a FILE of jobs or one job by --kind and --place.")
    jobs = read_jobs(file) if file else [one_job(kind, place or [], payload, repetitions, dwell, force)]
    if len(jobs) > MOST_QUOTED:
        raise FleetError(f"A request can name at most {MOST_QUOTED} jobs (got {len(jobs)}).")
    with BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        request = QuoteRequest("dry run", tuple(jobs), dry_run=True)
        answers, until_s = query(link, request, timeout), time.monotonic() + timeout
        while _is_unplanned(answers) and time.monotonic() < until_s:
            link.serve(time.monotonic() + PAUSE_S)
            answers = query(link, request, timeout)
        name = link.fleet
    quotes = {quote.arm: quote for quote in sorted(answers.messages.values(), key=lambda quote: quote.arm)}
    if not quotes and not answers.refused:
        raise BusError(f"No arm of fleet '{name}' replied. Is `thermofleet arm` running?")
    if as_json:
        echo(msgspec.json.format(msgspec.json.encode(list(quotes.values())), indent=1).decode())
    else:
        out_console.print(quote_table(jobs, quotes))
    for reason in answers.refused.values():
        say(f"Refused: {reason}" if reason else f"An arm did not reply within {timeout:g} s.")
    feasible = {estimate.job for quote in quotes.values() for estimate in quote.estimates if estimate.feasible}
    if not feasible.issuperset(job.name for job in jobs):
        raise typer.Exit(1)


def query(link: BusClient, request: QuoteRequest, timeout_s: float) -> Replies[Quote]:
    """Request the quotes of every arm."""
    return link.query_and_wait(keys.of_every_arm(link.fleet, "quote"), request, Quote, timeout_s=timeout_s)


def _is_unplanned(answers: Replies[Quote]) -> bool:
    """Whether an arm is still planning a job."""
    estimates = (estimate for quote in answers.messages.values() for estimate in quote.estimates)
    return any(estimate.reason == NOT_PLANNED for estimate in estimates)


def one_job(
    kind: str, places: Sequence[str], payload_kg: float, repetitions: int, dwell_s: float, force_n: float
) -> JobSpec:
    """Make the job that the options describe.

    Raises:
        FleetError: there is no such job.
    """
    fields = {
        "name": kind,
        "kind": kind,
        "places": list(places),
        "payload_kg": payload_kg,
        "repetitions": repetitions,
        "dwell_s": dwell_s,
        "force_n": force_n,
    }
    try:
        msgspec.json.encode(fields)
        return msgspec.convert(fields, JobSpec)
    except msgspec.ValidationError as error:
        raise FleetError(f"Invalid job: {explain(error)}") from error
    except UnicodeEncodeError as error:
        raise FleetError(f"--kind and --place must be UTF-8 text (got {error.object!a}).") from error


def quote_table(jobs: Sequence[JobSpec], quotes: Mapping[str, Quote]) -> Table:
    """All estimates: jobs in the given order, and under each job the arms."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("job")
    table.add_column("arm")
    for column in ("plan", "peak °C", "gained K", "P", "d", "duration s", "finish in s"):
        table.add_column(column, justify="right")
    table.add_column("")
    for index, job in enumerate(jobs):
        estimates = [(arm, each) for arm, quote in quotes.items() for each in quote.estimates if each.job == job.name]
        rows = [(arm, row) for arm, estimate in estimates for row in rows_of(estimate)]
        for line, (arm, row) in enumerate(rows):
            again = line > 0 and rows[line - 1][0] == arm
            last = line == len(rows) - 1 and index > 0
            table.add_row("" if line else job.name, "" if again else arm, *row, end_section=last)
    return table


def rows_of(estimate: JobEstimate) -> list[list[str]]:
    """Cells of each plan of an estimate; a dash for what the arm does not know."""
    if not estimate.feasible:
        return [["–"] * 7 + [f"cannot: {estimate.reason}"]]
    return [_cells(plan) for plan in estimate.plans]


def _cells(plan: PlanQuote) -> list[str]:
    figures = (
        (plan.peak_c, ".1f"),
        (plan.gained_k, "+.1f"),
        (plan.p_saturation, ".2f"),
        (plan.difficulty, ".2f"),
        (plan.duration_s, ".0f"),
        (plan.finish_in_s, ".0f"),
    )
    return [str(plan.plan), *("–" if value is None else format(value, form) for value, form in figures), ""]
