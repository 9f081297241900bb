"""`thermofleet submit`: hand in jobs from a file, and follow what becomes of them."""

import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

from fleet.errors import BusError, FleetError, nearest
from fleet.job import KINDS
from scenarios.live_options import ENDPOINT, EndpointOption, FleetOption, the_fleet

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from fleet.bus.link import Link
    from fleet.bus.trade import Admission, JobStatus, JobWord
    from scenarios.stopping import Stop

ANSWER_S, ATTEMPTS = 5.0, 3
"""Real seconds to wait for an answer, and how often to ask: the same job twice is one job."""
AT_ONCE = 64
"""Jobs in one word: a router may drop words of more than 64 KiB."""
LOOK_S = 0.5
"""Real seconds between two looks at how jobs stand."""
PATIENCE_S = 30.0
"""Real seconds without an auctioneer before the following ends."""
_NO_KIND = re.compile(r"Invalid enum value '(.*)'", re.DOTALL)
"""So msgspec complains; nothing of a job but its kind is one of a few words."""
FileArg = Annotated[str, typer.Argument(help="Jobs as JSON: a list, or one job a line; - reads standard input.")]


def submit_command(
    file: FileArg,
    wait: Annotated[
        bool, typer.Option("--wait", help="Follow the jobs to their end; exit code 1 if any stays unfinished.")
    ] = False,
    by: Annotated[str, typer.Option(help="Who asks, for the records.")] = "",
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
) -> None:
    """Hand in jobs to the fleet's auctioneer; what is accepted is on its disk."""
    from fleet.bus.link import Link
    from scenarios.stopping import until_stopped

    words = read_jobs(file)
    with until_stopped() as stop, Link(endpoint, the_fleet(fleet, endpoint)) as link:
        said = [admission for part in parts(words) for admission in submitted(link, part, by)]
        for admission in said:
            typer.echo(f"{admission.job}: {'accepted' if admission.accepted else f'refused: {admission.reason}'}")
        accepted = [admission.job for admission in said if admission.accepted]
        undone = follow(link, accepted, stop) if wait and accepted else []
        stop.leave("Stopped following; the jobs are with the auctioneer.")
    if len(accepted) < len(said) or undone:
        raise typer.Exit(1)


def read_jobs(file: str) -> "list[JobWord]":
    """The jobs of a file, or of standard input for `-`.

    Raises:
        FleetError: names the line (or the place in the list) and what is wrong there.
    """
    from fleet.bus.trade import JobWord

    name = "standard input" if file == "-" else file
    try:
        raw = sys.stdin.buffer.read() if file == "-" else Path(file).read_bytes()
    except OSError as error:
        raise FleetError(f"Cannot read '{file}': {error.strerror}.") from error
    if raw.lstrip().startswith(b"["):
        words = _decoded(raw, list[JobWord], name)
    else:
        lines = enumerate(raw.splitlines(), start=1)
        words = [_decoded(line, JobWord, f"{name}, line {number}") for number, line in lines if line.strip()]
    if not words:
        raise FleetError(f"{name}: there are no jobs in it.")
    return words


def _decoded(raw: bytes, kind: Any, where: str) -> Any:
    try:
        return msgspec.json.decode(raw, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FleetError(f"{where}: {plain(error)}") from error


def plain(error: Exception) -> str:
    """What msgspec complains of as a sentence, with the place in the words of the file."""
    what, _, where = str(error).rstrip(".").partition(" - at `$")
    if found := _NO_KIND.fullmatch(what):
        what = f"No kind of job '{found[1]}'{nearest(found[1], KINDS)}".rstrip(".")
    where = where.rstrip("`").lstrip(".")
    return f"{what}{f' (at {where})' if where else ''}."


def parts(words: "Sequence[JobWord]") -> "Iterator[tuple[JobWord, ...]]":
    """The jobs in as many words as they need."""
    ordered = in_order(words)
    for start in range(0, len(ordered), AT_ONCE):
        yield tuple(ordered[start : start + AT_ONCE])


def in_order(words: "Sequence[JobWord]") -> "Sequence[JobWord]":
    """The jobs, every one after those that it waits for; as they are where they wait for each other in a ring."""
    from graphlib import CycleError, TopologicalSorter

    try:
        order = list(TopologicalSorter({word.name: word.after for word in words}).static_order())
    except CycleError:
        return words  # the auctioneer says which
    place = {name: i for i, name in enumerate(order)}
    return sorted(words, key=lambda word: place[word.name])


def submitted(link: "Link", words: "tuple[JobWord, ...]", by: str) -> "tuple[Admission, ...]":
    """What the auctioneer says to jobs.

    Raises:
        FleetError: it refused, or there is none.
    """
    from fleet.bus import keys
    from fleet.bus.trade import Submission, Submitted

    key = keys.of_jobs(link.fleet, "submit")
    for _ in range(ATTEMPTS):
        answers = link.ask_and_wait(key, Submission(words, by), Submitted, timeout_s=ANSWER_S)
        for answer in answers.words.values():
            return answer.jobs
        for reason in filter(None, answers.refused.values()):
            raise FleetError(f"The auctioneer takes no jobs: {reason}")
    raise BusError(
        f"No auctioneer of fleet '{link.fleet}' answered; is `thermofleet auction` running? Arms that share the jobs "
        "out themselves answer when all are there, or a majority has been for 20 s."
    )


def follow(link: "Link", names: "Sequence[str]", stop: "Stop") -> "list[str]":
    """Tell every change until all jobs are settled, or until told to stop; returns those not finished.

    Raises:
        BusError: the auctioneer is gone, and does not come back.
    """
    states: dict[str, str] = {}
    heard_s = time.monotonic()
    while not stop.is_set():
        for status in stand(link, names):
            heard_s = time.monotonic()
            if states.get(status.job) != status.state:
                states[status.job] = status.state
                typer.echo(_line(status))
        if all(states.get(name) in ("finished", "unfinished") for name in names):
            break
        if time.monotonic() > heard_s + PATIENCE_S:
            raise BusError(f"No auctioneer of fleet '{link.fleet}' for {PATIENCE_S:.0f} s; the jobs are on its disk.")
        stop.wait(LOOK_S)
    return [name for name in names if states.get(name) != "finished"]


def stand(link: "Link", names: "Sequence[str]") -> "list[JobStatus]":
    """Where jobs stand; nothing where nobody answers."""
    from fleet.bus import keys
    from fleet.bus.trade import Status, StatusRequest

    key = keys.of_jobs(link.fleet, "status")
    out: list[JobStatus] = []
    for start in range(0, len(names), AT_ONCE):
        request = StatusRequest(tuple(names[start : start + AT_ONCE]))
        words: dict[str, Status] = link.ask_and_wait(key, request, Status, timeout_s=ANSWER_S).words
        out += [status for answer in words.values() for status in answer.jobs]
    return out


def _line(status: "JobStatus") -> str:
    at = f" {'to' if status.state == 'awarded' else 'by'} {status.arm}" if status.arm else ""
    when = f" at {status.finished_s:.0f} s" if status.finished_s is not None else ""
    return f"{status.job}: {status.state}{at}{when}{f': {status.reason}' if status.reason else ''}"
