"""Requests to a live fleet: submit and follow jobs, request quotes, steer jobs and arms."""

import getpass
import re
import secrets
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import msgspec

from fleet.bus.client import BusClient, NoReply, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    MOST_QUOTED,
    NOT_PLANNED,
    JobEstimate,
    JobSpec,
    JobStatus,
    PlanQuote,
    Quote,
    QuoteRequest,
)
from fleet.bus.protocol.cell import Cell, CellRequest
from fleet.bus.protocol.messages import unknown_field
from fleet.bus.protocol.operator import (
    ALL_ARMS,
    Action,
    Change,
    Clear,
    Cleared,
    ClearRequest,
    Controlled,
    ControlRequest,
    Pause,
    ResetReply,
    ResetRequest,
    Resume,
    without_reset,
)
from fleet.bus.security.tls import unknown_certificate_hint
from fleet.errors import JOB_RULE, BusError, FleetError, Refused, is_name, nearest, printable, visible
from fleet.job import BOUNDS, KINDS
from fleet.live.job_client import JobClient
from fleet.live.monitor.snapshot import describe_status
from scenarios.cli.options import the_fleet
from scenarios.show.words import clock
from scenarios.signals import until_stopped
from scenarios.spec.job_table import SUFFIXES, read_job_table, shift_begin, with_cell
from scenarios.table import Column, Table
from scenarios.terminal import echo, print_either, say

REPLY_S, ATTEMPTS = 5.0, 3
"""Real seconds to wait for a reply, and number of attempts: a repeated request is carried out once."""
TURN_S = 0.2
"""Real seconds between two checks for a stop request, and before a request for quotes is repeated."""
PATIENCE_S = 30.0
"""Real seconds without a reply after which following ends."""
_NEEDS_ROLE = (
    "With TLS, use a certificate of the role operator that the router knows: it reads its roster when it starts."
)
STOPPED = "Stopped following; the auctioneer has the jobs."
_UNKNOWN_KIND = re.compile(r"Invalid enum value '(.*)'", re.DOTALL)
"""Message of msgspec; of all fields of a job, only its kind is an enumeration."""
Decoded = TypeVar("Decoded")


def submit_jobs(
    jobs: Mapping[int, JobSpec],
    endpoint: str,
    fleet: str,
    *,
    by: str = "",
    wait: bool = False,
    table: str = "",
) -> bool:
    """Submit jobs and print the decision on each; return whether all are accepted and, after a wait, finished.

    Args:
        jobs: By number, as from `read_jobs`.
        wait: Follow the accepted jobs to their end.
        table: The job table that has them, to name its rows.

    Raises:
        FleetError: the submission is refused, there is no auctioneer, or it disappears while jobs are followed.
    """
    states = dict[str, str]()
    rows = {job.name: (f"{table}, row {number}", job) for number, job in jobs.items() if table}

    def show_change(status: JobStatus) -> None:
        if states.get(status.job) != status.state:
            states[status.job] = status.state
            echo(describe_status(with_cell(status, rows)))

    with until_stopped() as stop, BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        client = JobClient(link, by, show_change)
        try:
            admissions = [with_cell(each, rows) for each in client.submit_and_wait(tuple(jobs.values()))]
        except Refused as error:
            raise FleetError(f"The auctioneer refused the submission: {error}") from error
        except NoReply as error:
            raise BusError(
                f"No auctioneer of fleet '{link.fleet}' replied. Is `thermofleet bus auctioneer` running? Arms that "
                "allocate by consensus reply once all are present, or a majority has been for 20 s."
                f"{unknown_certificate_hint(endpoint)}"
            ) from error
        for admission in admissions:
            decision = "accepted" if admission.accepted else "refused"
            echo(f"{admission.job}: {decision}{f': {admission.reason}' if admission.reason else ''}")
        while wait and client.open and not stop.is_set():
            client.step()
            link.serve(time.monotonic() + TURN_S)
            if time.monotonic() > client.heard_s + PATIENCE_S:
                raise BusError(
                    f"No reply from an auctioneer of fleet '{link.fleet}' for {PATIENCE_S:.0f} s; its journal has the "
                    "accepted jobs."
                )
        stop.leave(STOPPED)
        if stop.is_set():
            say(STOPPED)
    ended = not wait or all(status and status.state == "finished" for status in client.statuses.values())
    return ended and all(admission.accepted for admission in admissions)


def quote_jobs(jobs: Sequence[JobSpec], endpoint: str, fleet: str, *, timeout_s: float, as_json: bool) -> bool:
    """Print the quotes of all arms without submitting a job; return whether an arm can do each job.

    Args:
        timeout_s: Real seconds to wait for arms.

    Raises:
        FleetError: there are too many jobs, or no arm replies.
    """
    if len(jobs) > MOST_QUOTED:
        raise FleetError(f"A request for quotes can name at most {MOST_QUOTED} jobs (got {len(jobs)}).")
    with BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        key, request = keys.of_every_arm(link.fleet, "quote"), QuoteRequest("dry run", tuple(jobs), dry_run=True)
        answers = link.query_and_wait(key, request, Quote, timeout_s=timeout_s)
        until_s = time.monotonic() + timeout_s
        while _is_unplanned(answers) and time.monotonic() < until_s:
            link.serve(time.monotonic() + TURN_S)
            answers = link.query_and_wait(key, request, Quote, timeout_s=timeout_s)
        name = link.fleet
    quotes = {quote.arm: quote for quote in sorted(answers.messages.values(), key=lambda quote: quote.arm)}
    if not quotes and not answers.refused:
        hint = unknown_certificate_hint(endpoint)
        raise BusError(f"No arm of fleet '{name}' replied. Is `thermofleet arm run` running?{hint}")
    print_either(as_json, list(quotes.values()), quote_table(jobs, quotes))
    for reason in answers.refused.values():
        say(f"Refused: {reason}" if reason else f"An arm did not reply within {timeout_s:g} s.")
    feasible = {estimate.job for quote in quotes.values() for estimate in quote.estimates if estimate.feasible}
    return feasible.issuperset(job.name for job in jobs)


def _is_unplanned(answers: Replies[Quote]) -> bool:
    """Whether an arm is still planning a job."""
    estimates = (estimate for quote in answers.messages.values() for estimate in quote.estimates)
    return any(estimate.reason == NOT_PLANNED for estimate in estimates)


def places_of_cell(endpoint: str, fleet: str) -> list[str] | None:
    """Names of the places in the cell of a fleet; None if no participant replies with them."""
    with suppress(FleetError), BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        cell = link.ask(keys.of_jobs(link.fleet, "cell"), CellRequest(), Cell, timeout_s=REPLY_S)
        return [place.name for place in cell.places]
    return None


def read_jobs(file: str, begin: str = "") -> dict[int, JobSpec]:
    """Read the jobs of a file of JSON, or of standard input for `-`, or of a job table by its suffix.

    They are numbered by the lines or rows of the file, or by their places in a list.

    Args:
        begin: Date, time and zone of fleet time 0, for the dates in a job table.

    Raises:
        FleetError: a job is invalid; names the line, or the index in the list. Of a job table all errors are named.
    """
    shift = shift_begin(begin, "--shift-begin")
    if file.lower().endswith(SUFFIXES):
        return read_job_table(Path(file), begin=shift)
    if shift:
        raise FleetError(f"--shift-begin is for a job table, a file that ends in {', '.join(SUFFIXES)} (got {file}).")
    name = "standard input" if file == "-" else file
    try:
        raw = sys.stdin.buffer.read() if file == "-" else Path(file).read_bytes()
    except OSError as error:
        raise FleetError(f"Cannot read '{file}': {error.strerror}.") from error
    whole = None
    with suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):  # else a job on each line
        whole = msgspec.json.decode(raw)
    if isinstance(whole, dict) and "jobs" in whole:
        raise FleetError(f"{name} is a Submission, the body of an HTTP request: give its list of jobs alone, and --by.")
    if raw.lstrip().startswith(b"["):
        jobs = dict(enumerate(_decode(raw, list[JobSpec], name)))
    elif isinstance(whole, dict) and b"\n" in raw.strip():
        jobs = {1: _decode(raw, JobSpec, name)}
    else:
        lines = enumerate(raw.splitlines(), start=1)
        jobs = {number: _decode(line, JobSpec, f"{name}, line {number}") for number, line in lines if line.strip()}
    if not jobs:
        raise FleetError(f"{name} contains no jobs.")
    return jobs


def _decode(raw: bytes, kind: type[Decoded], where: str) -> Decoded:
    try:
        decoded = msgspec.json.decode(raw, type=kind)
        if unknown := unknown_field(kind, raw):
            raise FleetError(f"{where}: {unknown}")
        return decoded
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FleetError(f"{where}: {explain(error)}") from error


_FIELD = re.compile(r"JobSpec\.(\w+)")
_OPTIONS = {
    "name": "--name",
    "places": "--place",
    "payload_kg": "--payload",
    "repetitions": "--repetitions",
    "dwell_s": "--dwell",
    "force_n": "--force",
}


def job_of(fields: Mapping[str, object]) -> JobSpec:
    """The job with these fields, which are options of the command line.

    Raises:
        FleetError: a field is invalid.
    """
    try:
        msgspec.json.encode(fields)
        return msgspec.convert(fields, JobSpec)
    except msgspec.ValidationError as error:
        named = _FIELD.sub(lambda field: _OPTIONS.get(field[1], field[0]), explain(error))
        raise FleetError(f"Invalid job: {named}") from error
    except UnicodeEncodeError as error:
        raise FleetError(f"--kind and --place must be UTF-8 text (got {error.object!a}).") from error


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


def quote_table(jobs: Sequence[JobSpec], quotes: Mapping[str, Quote]) -> Table:
    """All estimates: jobs in the given order, and under each job the arms."""
    rows = list[tuple[str, ...]]()
    for job in jobs:
        name = job.name
        for arm, quote in quotes.items():
            plans = [cells for each in quote.estimates if each.job == job.name for cells in _cells(each)]
            for number, cells in enumerate(plans):
                rows.append((name, "" if number else arm, *cells))
                name = ""
    figures = ("plan", "peak °C", "gained K", "P", "d", "duration s", "finish in s")
    head = ("job", Column("arm", words=True), *figures, Column("", words=True))
    return Table(head=head, rows=tuple(rows))


_FIGURES = {
    "peak_c": ".1f",
    "gained_k": "+.1f",
    "p_saturation": ".2f",
    "difficulty": ".2f",
    "duration_s": ".0f",
    "finish_in_s": ".0f",
}
"""Fields of a plan in a table of quotes, and their formats."""


def _cells(estimate: JobEstimate) -> list[list[str]]:
    """Cells of each plan of an estimate; a dash for an unknown figure."""
    if not estimate.feasible:
        return [["–"] * 7 + [f"cannot: {estimate.reason}"]]
    return [[str(plan.plan), *(_figure(plan, *each) for each in _FIGURES.items()), ""] for plan in estimate.plans]


def _figure(plan: PlanQuote, name: str, form: str) -> str:
    value = getattr(plan, name)
    return "–" if value is None else format(value, form)


def control(actions: Sequence[Action], by: str, endpoint: str, fleet: str) -> None:
    """Request actions, one after another, and print the outcome of each.

    Raises:
        Refused: one is refused.
        BusError: no reply.
    """
    by = _person(by)
    with BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        key = keys.of_jobs(link.fleet, "control")
        for action in actions:
            request = ControlRequest(secrets.token_hex(8), action, by)
            try:
                reply = link.ask(key, request, Controlled, timeout_s=REPLY_S, attempts=ATTEMPTS)
            except NoReply as error:
                wait_s = f"{ATTEMPTS * REPLY_S:g} s"
                raise BusError(
                    f"No auctioneer or arm of fleet '{link.fleet}' replied within {wait_s}. {_NEEDS_ROLE}"
                ) from error
            echo(visible(_describe(action, reply)))


def _describe(action: Action, reply: Controlled) -> str:
    """One line about the outcome of an action."""
    note = f" {reply.note}" if reply.note else ""
    if isinstance(action, Pause | Resume | Clear):
        arms = ", ".join("all arms" if arm == ALL_ARMS else arm for arm in sorted(reply.paused))
        return f"Paused: {arms or 'none'}.{note}"
    job = reply.job
    state = "settled" if job is None else f"{job.state}, {job.cycles} of {job.repetitions} cycles"
    if isinstance(action, Change) and job is not None:
        state += ", no due date" if job.due_s is None else f", due at {clock(job.due_s)}"
        state += "" if job.value is None else f", value {job.value:g}"
    return f"{action.job}: {state}.{note}"


def clear_space(arm: str, by: str, endpoint: str, fleet: str) -> None:
    """Free the space of an absent arm.

    Raises:
        BusError: the request is refused, or there is no reply.
    """
    request = ClearRequest(arm, _person(by))
    with BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        replies = link.query_and_wait(keys.of_jobs(link.fleet, "clear"), request, Cleared, timeout_s=REPLY_S)
        name = link.fleet
    for reason in replies.refusals:
        where = " by all arms" if replies.messages else ""
        raise BusError(f"The space of '{arm}' was not freed{where}: {reason}")
    if not replies.messages:
        raise BusError(f"No auctioneer or arm of fleet '{name}' replied within {REPLY_S:g} s. {_NEEDS_ROLE}")
    echo(f"{arm}: its space is free until the arm reports its space again.")


def reset_arm(arm: str, by: str, endpoint: str, fleet: str) -> None:
    """Clear the fault of an arm.

    Raises:
        Refused: the arm refuses.
        BusError: it does not reply.
    """
    with BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        key = keys.of_arm(link.fleet, arm, "reset")
        try:
            reply = link.ask(key, ResetRequest(_person(by)), ResetReply, timeout_s=REPLY_S)
        except NoReply as error:
            if not error.late and link.tokens(keys.of_arm(link.fleet, arm, "alive")):
                raise Refused(without_reset(arm)) from error
            raise BusError(f"The arm '{arm}' did not reply. {_NEEDS_ROLE}") from error
    echo(f"{arm}: its fault is cleared." if reply.changed else f"{arm}: it has no fault.")


def _person(by: str) -> str:
    """Name of the requester: the given one, or the user of this process, "" if it has no name.

    Raises:
        FleetError: it is no name.
    """
    if by and not is_name(by, of_job=True):
        raise FleetError(f"--by must have {JOB_RULE} (got '{printable(by)}').")
    try:
        return by or getpass.getuser()
    except (KeyError, OSError):
        return ""
