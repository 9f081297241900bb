"""Commands that steer a live fleet: `thermofleet job` and `thermofleet arm pause | reset | clear`."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from fleet.errors import FleetError, Refused, listed, nearest
from fleet.fields import argument, option
from fleet.job import BOUNDS, DWELL_S
from scenarios.cli import options
from scenarios.table import Table
from scenarios.terminal import err_console, print_json, print_lines, say

if TYPE_CHECKING:  # the bus, which other commands do not load
    from fleet.bus.protocol.auction import JobStatus

_RANGES = {name: {"low": bounds.low, "high": bounds.high} for name, bounds in BOUNDS.items()}
_ONE = "One job instead of a file"
LISTEN_S = 1.0
"""Real seconds of listening for the list of jobs."""
JOB = argument("Name of the job.")
ARM = argument("Name of the arm.", is_name=True)
BY = option("Name of the requester, kept in the journal. Default: the user's name.", "")


def submit_command(
    file: str = argument("Jobs: a table as .csv, .tsv, .parquet or .xlsx, or JSON; - reads JSON from stdin.", ""),
    wait: bool = option("Follow the jobs to their end; exit code 1 if one stays unfinished.", False),
    quote: bool = option("Submit nothing; print every arm's quote for each of its plans, or why it has none.", False),
    timeout: float = option("--quote: real seconds to wait for arms.", 5.0, low=0, high=600, above=True),
    as_json: bool = option("--quote: print JSON.", False, flag="--json"),
    by: str = option("Name of the submitter, kept in the journal.", ""),
    shift_begin: str = option("Date, time and zone of fleet time 0, for a table, as 2026-11-23T06:00+01:00.", ""),
    kind: str = option("pick_place, hold, press or sort.", "", panel=_ONE),
    name: str = option("Name of the job. Default: its kind.", "", panel=_ONE),
    place: list[str] | None = option("Place of the cell; twice for pick_place and sort.", None, panel=_ONE),
    payload: float = option("Payload, kg.", 0.0, **_RANGES["payload_kg"], panel=_ONE),
    repetitions: int = option("Number of cycles.", 1, **_RANGES["repetitions"], panel=_ONE),
    dwell: float = option(
        "hold, press: duration of a cycle, s. Others: time to close or open the hand, s.",
        DWELL_S,
        **_RANGES["dwell_s"],
        panel=_ONE,
    ),
    force: float = option("Force of a press, N.", 0.0, **_RANGES["force_n"], panel=_ONE),
    endpoint: str = options.ENDPOINT,
    fleet: str = options.FLEET,
) -> None:
    """Submit jobs to a fleet; accepted jobs are durable. With --quote, print quotes and submit nothing.

    A quote has the fastest plan first. Columns:
    peak: predicted temperature of the hottest motor
    gained: peak minus the hottest motor now
    P: probability that a motor passes the warning limit
    d: difficulty, to compare arms on one job
    duration: from home to home
    finish in: time until the last cycle is done, after the arm's current jobs
    Exit code 1: a job was refused or stays unfinished; with --quote, no arm can do it.
    """
    if bool(file) == bool(kind):
        given = "both" if file else "neither"
        raise FleetError(f"Give either a FILE of jobs or one job by --kind and --place (got {given}).")
    if shift_begin and not file:
        raise FleetError("--shift-begin is for a FILE of jobs: leave it out.")
    if wait and quote:
        raise FleetError("--quote submits nothing: leave --wait out.")
    if as_json and not quote:
        raise FleetError("--json is for --quote: leave it out.")
    from scenarios.live.requests import job_of, places_of_cell, quote_jobs, read_jobs, submit_jobs
    from scenarios.show.words import clock
    from scenarios.spec.job_table import SUFFIXES, check_places

    table = file if file.lower().endswith(SUFFIXES) else ""
    if file:
        jobs = read_jobs(file, shift_begin)
        if table and not quote and (places := places_of_cell(endpoint, fleet)):  # waits for a router
            check_places(jobs, places, str(Path(file)))
        first_s = min((job.release_s for job in jobs.values()), default=0.0)
        if first_s > 0 and not shift_begin:
            say(f"Times count from fleet time 0: the first job is released at {clock(first_s)}. See --shift-begin.")
    else:
        fields = {"name": name or kind, "kind": kind, "places": place or [], "repetitions": repetitions}
        jobs = {1: job_of({**fields, "payload_kg": payload, "dwell_s": dwell, "force_n": force})}
    if quote:
        done = quote_jobs(tuple(jobs.values()), endpoint, fleet, timeout_s=timeout, as_json=as_json)
    else:
        done = submit_jobs(jobs, endpoint, fleet, by=by, wait=wait, table=table)
    if not done:
        raise typer.Exit(1)


def list_command(
    names: list[str] | None = argument("Names of jobs; by default all.", None),
    endpoint: str = options.ENDPOINT,
    fleet: str = options.FLEET,
    as_json: bool = options.JSON,
) -> None:
    """List jobs of a fleet by name: state, arm, cycles, age, due date, end and reason.

    The age counts from the release, or from the acceptance if that is later.
    The end is the predicted one of a job that an arm has, and the true one of a
    finished job. A job is late if it ends after its due date, or waits beyond
    it. A terminal that is too narrow for all columns shows some of them, and a
    very narrow one a sentence for each job.
    """
    import time

    from fleet.bus.client import BusClient, NoReply
    from fleet.bus.protocol import keys
    from fleet.bus.protocol.auction import ABANDONED, SETTLED
    from fleet.bus.security.tls import unknown_certificate_hint
    from fleet.live.job_client import REPLY_S, query_statuses
    from fleet.live.job_rules import waits_since_s
    from fleet.live.monitor.snapshot import FleetListener
    from scenarios.cli.options import the_fleet
    from scenarios.show.words import clock, duration

    with BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        listener = FleetListener(link)
        listener.serve(time.monotonic() + LISTEN_S)
        snapshot = listener.view.snapshot(time.monotonic())
        known = {job.job: job for job in snapshot.jobs if not names or job.job in names}
        now_s = snapshot.time_s or 0.0
        try:  # results tell neither predicted ends nor why jobs wait
            query = partial(query_statuses, link, names=names or (), timeout_s=REPLY_S)
            now = link.wait(query, REPLY_S).first(keys.of_jobs(link.fleet, "status"))
            known |= {job.job: job for job in now.jobs}
            now_s = now.time_s
            if now.next:
                wanted = len(names or ()) or sum(now.counts.values())
                say(f"Only {len(now.jobs)} of {wanted} jobs arrived in time.", err_console)
        except (NoReply, Refused) as error:
            if not known:
                hint = unknown_certificate_hint(endpoint) if isinstance(error, NoReply) else ""
                raise FleetError(f"Nobody tells of jobs: {error}{hint}") from error
            say(f"These are the last known changes: {error}", err_console)
    jobs = sorted(known.values(), key=lambda status: status.job)
    unknown = sorted({*(names or ())} - {job.job for job in jobs})
    if unknown and not jobs:
        near = nearest(unknown[0], [job.job for job in snapshot.jobs])
        raise FleetError(f"The fleet knows no job '{unknown[0]}'{near}")

    def row(job: "JobStatus") -> tuple[str, ...]:
        end_s = job.finish_s if job.finished_s is None else job.finished_s
        since_s = waits_since_s(job)
        is_open = since_s is not None and job.state not in SETTLED and now_s > since_s
        age = duration(now_s - (since_s or 0.0)) if is_open else ""
        cycles, end = f"{job.cycles} of {job.repetitions}", "" if end_s is None else clock(end_s)
        due = "" if job.due_s is None else clock(job.due_s)
        late_s = 0.0 if job.due_s is None or job.state in ABANDONED else (now_s if end_s is None else end_s) - job.due_s
        due += f", {duration(late_s)} late" if late_s > 0 else ""
        return job.job, job.state.replace("_", " "), job.arm, cycles, age, due, end, job.reason

    head = ("job", "state", "arm", "cycles", "age", "due", "end", "reason")
    table = Table(head=head, rows=tuple(map(row, jobs)), numbers=False)
    if as_json:
        print_json(jobs)
    else:
        print_lines(table, ("cycles", "end", "age", "due"))
    if unknown:
        raise FleetError(f"The fleet knows no job {listed(map(repr, unknown))}.")


def cancel_command(
    jobs: list[str] = argument("Names of the jobs."),
    by: str = BY,
    endpoint: str = options.ENDPOINT,
    fleet: str = options.FLEET,
) -> None:
    """Cancel jobs.

    A working arm completes its cycle and goes home. A job in its last cycle is
    finished.
    """
    from fleet.bus.protocol.operator import Cancel
    from scenarios.live.requests import control

    control([Cancel(job) for job in jobs], by, endpoint, fleet)


def settle_command(
    job: str = JOB,
    outcome: Literal["done", "redo"] = argument("done, or redo to do the cycles that its status does not count."),
    by: str = BY,
    endpoint: str = options.ENDPOINT,
    fleet: str = options.FLEET,
) -> None:
    """Resolve a job with unknown outcome, after inspecting the cell."""
    from fleet.bus.protocol.operator import Settle
    from scenarios.live.requests import control

    control([Settle(job, outcome)], by, endpoint, fleet)


def change_command(
    job: str = JOB,
    due: float | None = option("Due date, s of fleet time.", None, **_RANGES["due_s"]),
    no_due: bool = option("Remove the due date.", False),
    value: float | None = option("Value.", None, **_RANGES["value"]),
    by: str = BY,
    endpoint: str = options.ENDPOINT,
    fleet: str = options.FLEET,
) -> None:
    """Change the due date or the value of an unsettled job."""
    if due is not None and no_due:
        raise FleetError(f"--due and --no-due exclude each other (got --due {due:g}). Leave one out.")
    if due is None and not no_due and value is None:
        raise FleetError("There is nothing to change. Give --due, --no-due or --value.")
    from msgspec import UNSET

    from fleet.bus.protocol.operator import Change
    from scenarios.live.requests import control

    due_s = None if no_due else UNSET if due is None else due
    control([Change(job, due_s, UNSET if value is None else value)], by, endpoint, fleet)


def pause_command(
    arm: str = argument("Name of the arm. Default: all arms.", "*"),
    end: bool = option("Resume.", False),
    by: str = BY,
    endpoint: str = options.ENDPOINT,
    fleet: str = options.FLEET,
) -> None:
    """Pause one arm or all arms: no more jobs are awarded to them. With --end, resume.

    A working arm completes its cycle and goes home; its job goes to another arm.
    A job in its last cycle is finished.
    """
    from fleet.bus.protocol.operator import Pause, Resume
    from scenarios.live.requests import control

    control([Resume(arm) if end else Pause(arm)], by, endpoint, fleet)


def reset_command(arm: str = ARM, by: str = BY, endpoint: str = options.ENDPOINT, fleet: str = options.FLEET) -> None:
    """Clear the fault of an arm now.

    The arm completes its cycle and moves home: keep people away from it. The
    request is refused while a motor is too hot.
    """
    from scenarios.live.requests import reset_arm

    reset_arm(arm, by, endpoint, fleet)


def clear_command(arm: str = ARM, by: str = BY, endpoint: str = options.ENDPOINT, fleet: str = options.FLEET) -> None:
    """Free the space of an offline arm for other arms.

    First stop the process of the arm, and make sure that the arm is at home or
    removed, and switched off. Start the process again only when the arm is at
    home. The request is refused for a present arm: its quotes report its space.
    """
    from scenarios.live.requests import clear_space

    clear_space(arm, by, endpoint, fleet)
