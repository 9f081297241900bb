"""`thermofleet record` and `thermofleet replay`: from the bus to Parquet, and from Parquet to the bus."""

import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from fleet.bus.client.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, Result
from fleet.bus.protocol.messages import State
from fleet.errors import FleetError
from scenarios.cli.live.options import MAX_SPEED
from scenarios.cli.options import ENDPOINT, EndpointOption, check_name, number
from scenarios.cli.signals import until_stopped
from scenarios.cli.terminal import echo, out_console, say
from scenarios.live.recorder import Recorder
from scenarios.live.replayer import Replay

BACKLOG = 200_000
"""Messages that may wait: joining a fleet of a hundred arms brings a hundred thousand at once."""
TURN_S = 0.5
"""Real seconds between two checks whether to stop."""


def record(link: BusClient, folder: Path, *, rotate_s: float, stopped: Callable[[], bool]) -> Recorder:
    """Record until stopped; return the recorder, everything written."""
    with lock_folder(folder):
        recorder = Recorder.open(folder, link.fleet)
        link.subscribe(keys.of_every_arm(link.fleet, "state"), State, recorder.add, history=True)
        link.subscribe(keys.of_every_arm(link.fleet, "event"), ArmEvent, recorder.add, history=True)
        link.subscribe(keys.of_every_auction(link.fleet, "result"), Result, recorder.add, history=True)
        due_s = time.monotonic() + rotate_s
        while not stopped():
            link.serve(min(due_s, time.monotonic() + TURN_S))
            if time.monotonic() >= due_s:
                recorder.write()
                due_s = time.monotonic() + rotate_s
        link.serve()
        recorder.write(status="finished")
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
    rotate: Annotated[float, number("Real seconds between two parts.", 0.1, 86_400)] = 60.0,
) -> None:
    """Record what arms and auctioneer publish, as Parquet parts that are readable at once."""
    with until_stopped() as stop, BusClient(endpoint, fleet, backlog=BACKLOG, stopped=stop.is_set) as link:
        echo(f"ready record {endpoint}")
        recorder = record(link, out, rotate_s=rotate, stopped=stop.is_set)
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
        raise FleetError(f"'{path}' holds no messages yet; parts are written every --rotate seconds and at the end.")
    with until_stopped() as stop, BusClient(endpoint, fleet or replay.fleet) as link:
        echo(f"ready replay {endpoint}")
        count = replay.play(link, speed=speed, stopped=stop.is_set)
    say(f"Published {count} of {len(replay)} messages.", out_console)
    stop.leave("The replay was interrupted.")
