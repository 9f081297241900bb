"""`thermofleet record` and `thermofleet replay`: the bus to Parquet, and Parquet to the bus."""

import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fleet.errors import FleetError
from scenarios.live_options import ENDPOINT, EndpointOption
from scenarios.terminal import out_console, say

if TYPE_CHECKING:
    from fleet.bus.link import Link

BACKLOG = 200_000
"""Who comes to a fleet of a hundred arms hears a hundred thousand words at once."""
LOOK_S = 0.5
"""How often it is looked whether to stop, real seconds."""


def record(link: "Link", folder: Path, *, rotate_s: float, stopped: Callable[[], bool]) -> Any:
    """Record until told to stop; returns the `Recorder`, everything written."""
    from fleet.bus import keys
    from fleet.bus.link import REMEMBERED
    from fleet.bus.messages import State
    from fleet.bus.trade import ArmEvent, Result
    from scenarios.bus_recording import Recorder

    with alone(folder):
        recorder = Recorder.open(folder, link.fleet)
        link.listen(keys.of_every_arm(link.fleet, "state"), State, recorder.state, remembered=REMEMBERED)
        link.listen(keys.of_every_arm(link.fleet, "event"), ArmEvent, recorder.event, remembered=REMEMBERED)
        link.listen(keys.of_every_auction(link.fleet, "result"), Result, recorder.result, remembered=REMEMBERED)
        due_s = time.monotonic() + rotate_s
        while not stopped():
            link.serve(min(due_s, time.monotonic() + LOOK_S))
            if time.monotonic() >= due_s:
                recorder.write()
                due_s = time.monotonic() + rotate_s
        link.serve()
        recorder.write(status="finished")
    return recorder


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Nobody else records in the folder, made if it is missing, until the end of the block or of the process.

    Raises:
        FleetError: somebody does, or there can be no such folder.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)  # locked itself: it needs no file more
    except OSError as error:
        raise FleetError(f"Cannot write to '{folder}': {error.strerror}.") from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            told = f"Another process records in '{folder}'; two would write over each other's parts."
            raise FleetError(told) from error
        yield
    finally:
        os.close(handle)


def record_command(
    fleet: Annotated[str, typer.Argument(help="Name of the fleet, as a rule that of its scenario.")],
    out: Annotated[Path, typer.Option(help="Folder of the recording; one that was broken off goes on.")],
    endpoint: EndpointOption = ENDPOINT,
    rotate: Annotated[float, typer.Option(help="Real seconds after which a part is written.")] = 60.0,
) -> None:
    """Write what the arms and the auctioneer say to Parquet, in parts that can be read while it goes on."""
    from fleet.bus.link import Link
    from scenarios.stopping import until_stopped

    if not rotate > 0:
        raise FleetError(f"--rotate must be > 0 s (got {rotate:g}).")
    with until_stopped() as stop, Link(endpoint, fleet, backlog=BACKLOG) as link:
        typer.echo(f"ready record {endpoint}")
        recorder = record(link, out, rotate_s=rotate, stopped=stop.is_set)
    missed = sum(count.missed for count in recorder.counts.values())
    kept = sum(count.kept for count in recorder.counts.values())
    say(f"Recorded {kept} words in {out}, {missed} missed.", out_console)
    stop.leave("The recording is whole; the same command goes on with it.")


def replay_command(
    path: Annotated[Path, typer.Argument(help="Folder of a run or of a recording.")],
    endpoint: EndpointOption = ENDPOINT,
    fleet: Annotated[str | None, typer.Option(help="Under which name; default that of the recording.")] = None,
    speed: Annotated[float, typer.Option(help="Recorded seconds per real second.")] = 1.0,
) -> None:
    """Put a run or a recording back on the bus: its arms speak again, at their own pace."""
    from fleet.bus.link import Link
    from scenarios.bus_replay import Replay
    from scenarios.stopping import until_stopped

    if not speed > 0:
        raise FleetError(f"--speed must be > 0 (got {speed:g}).")
    told = Replay.of(path)
    if not len(told):
        raise FleetError(f"'{path}' holds no words yet; a recording is written every --rotate seconds and at its end.")
    with until_stopped() as stop, Link(endpoint, fleet or told.fleet) as link:
        typer.echo(f"ready replay {endpoint}")
        words = told.play(link, speed=speed, stopped=stop.is_set)
    say(f"Said {words} of {len(told)} words again.", out_console)
    stop.leave("The replay was interrupted.")
