"""`thermofleet trace`: one event, and everything that led to it, on one screen."""

from pathlib import Path
from typing import Annotated

import typer

from fleet.errors import FleetError
from scenarios.cli.options import JsonOption
from scenarios.cli.terminal import out_console, print_json
from scenarios.show.trace import thread_of, thread_table

RUNS = Path("runs")


def trace_command(
    event: Annotated[
        str,
        typer.Argument(
            help="A row of the event log from 0; a kind such as fault, also with an arm or a job as fault@arm_1; or a "
            "job, for its award. Of several events, the first one."
        ),
    ],
    folder: Annotated[
        Path | None,
        typer.Option("--in", help="Folder of a run or a recording; default: the last of runs/.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Follow an event to its job, plan, offers, twin, training data, configuration and code."""
    thread = thread_of(folder or last_folder(RUNS), event)
    if as_json:
        print_json(thread.as_json())
    else:
        out_console.print(thread_table(thread))


def last_folder(runs: Path) -> Path:
    """The folder of the run or recording that was written last.

    Raises:
        FleetError: there is none.
    """
    cards = [*runs.glob("*/run.json"), *runs.glob("*/recording.json")] if runs.is_dir() else []
    if not cards:
        raise FleetError(f"There is no run in '{runs}'; name the folder of a run or a recording with --in.")
    return max(cards, key=lambda card: card.stat().st_mtime_ns).parent
