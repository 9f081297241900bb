"""`thermofleet record`, `replay` and `report`: from the bus to Parquet, back to the bus, and to a page."""

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Annotated

import typer

from fleet.bus.client.client import BusClient
from fleet.errors import FleetError
from fleet.files import atomic_path
from scenarios.cli.live.options import MAX_SPEED
from scenarios.cli.options import ENDPOINT, EndpointOption, check_name, number
from scenarios.cli.signals import until_stopped
from scenarios.cli.terminal import echo, out_console, say
from scenarios.live.recorder import Recorder, RecorderNode
from scenarios.live.replayer import Replay
from scenarios.result_folder import disk_errors

BACKLOG = 200_000
"""Messages that may wait: joining a fleet of a hundred arms brings a hundred thousand at once."""
CONNECT_S = 0.5
"""Real seconds that the router has to accept the session that fetches missed messages."""


def record(
    link: BusClient, folder: Path, *, rotate_s: float, stopped: Callable[[], bool], connect: Callable[[], BusClient]
) -> Recorder:
    """Record until stopped; return the recorder, everything written.

    Args:
        rotate_s: Real seconds between two Parquet parts; rows are in the journal before.
        connect: Makes another client of the fleet, which fetches missed messages.

    Raises:
        FleetError: the disk refuses at the beginning or at the end; in between it is tried again.
    """
    with (
        lock_folder(folder),
        closing(Recorder.open(folder, link.fleet)) as recorder,
        closing(RecorderNode(link, recorder, connect, rotate_s=rotate_s)) as node,
    ):
        while not stopped():
            node.serve()
        node.end()
    return recorder


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Create the folder if it is missing, and lock it until the end of the block or of the process.

    Raises:
        FleetError: another process has locked it, or it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)  # the folder itself: no lock file is left in it
    except OSError as error:
        raise FleetError(f"Cannot write to '{folder}': {error.strerror}.") from error
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise FleetError(f"Another process records in '{folder}'. Stop it, or choose another --out.") from error
    finally:
        os.close(handle)


def record_command(
    fleet: Annotated[
        str, typer.Argument(help="Name of the fleet; `up` uses the name of the scenario.", callback=check_name)
    ],
    out: Annotated[Path, typer.Option(help="Folder of the recording; an interrupted one is continued.")],
    endpoint: EndpointOption = ENDPOINT,
    rotate: Annotated[
        float, number("Real seconds between two parts; a message is on disk within a second.", 0.1, 86_400)
    ] = 60.0,
) -> None:
    """Record what arms and auctioneer publish: a journal, then Parquet parts; readable at once."""
    with until_stopped() as stop, BusClient(endpoint, fleet, backlog=BACKLOG, stopped=stop.is_set) as link:
        echo(f"ready record {endpoint}")

        def connect() -> BusClient:
            return BusClient(endpoint, fleet, timeout_s=CONNECT_S, backlog=BACKLOG)

        recorder = record(link, out, rotate_s=rotate, stopped=stop.is_set, connect=connect)
    missed = sum(count.missed for count in recorder.counts.values())
    kept = sum(count.kept for count in recorder.counts.values())
    say(f"Recorded {kept} messages in {out}, {missed} missed.", out_console)
    stop.leave("The recording is complete up to now; the same command continues it.")


def replay_command(
    path: Annotated[Path, typer.Argument(help="Folder of a run or of a recording.")],
    endpoint: EndpointOption = ENDPOINT,
    fleet: Annotated[str | None, typer.Option(help="Name of the fleet. Default: that of the recording.")] = None,
    speed: Annotated[float, number("Recorded seconds per real second.", 0, MAX_SPEED, above=True)] = 1.0,
) -> None:
    """Publish a run or a recording on the bus, in real time or at --speed."""
    replay = Replay.of(path)
    if not len(replay):
        raise FleetError(f"'{path}' holds no messages.")
    with until_stopped() as stop, BusClient(endpoint, fleet or replay.fleet) as link:
        echo(f"ready replay {endpoint}")
        count = replay.play(link, speed=speed, stopped=stop.is_set)
    say(f"Published {count} of {len(replay)} messages.", out_console)
    stop.leave("The replay was interrupted.")


def report_command(
    folder: Annotated[Path, typer.Argument(help="Folder of `thermofleet run`, or of a recording, finished or not.")],
    out: Annotated[
        Path | None, typer.Option(help="The HTML file. Default: in the folder of a run, beside that of a recording.")
    ] = None,
    scenario: Annotated[
        str | None, typer.Option(help="Of a recording: the scenario of the fleet, if no auctioneer described its cell.")
    ] = None,
    meshes: Annotated[
        bool, typer.Option("--meshes", help="Of a run: Kinova's shells; needs the extra `meshes`.")
    ] = False,
) -> None:
    """Write the report of a live recording, as `run` writes one of a simulated shift, or that of a run anew."""
    from scenarios.live.recording_report import recording_html
    from scenarios.load import load
    from scenarios.run.run_folder import run_html
    from scenarios.run.stored_run import read_run

    if (folder / "run.json").exists():
        path, run = out or folder / "report.html", read_run(folder)
        html = run_html(run.card, run.scenario, run.telemetry, run.events, run.jobs, run.offers, meshes=meshes)
    else:
        path = out or folder.parent / "report.html"
        html = recording_html(folder, None if scenario is None else load(scenario))
    with disk_errors(path), atomic_path(path) as draft:
        draft.write_text(html, encoding="utf-8")
    say(f"Open {path} in a browser.", out_console)
