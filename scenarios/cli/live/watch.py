"""`thermofleet watch`: show a fleet live on the terminal."""

import time
from collections import deque
from collections.abc import Callable
from typing import Annotated

import msgspec
import typer
from rich.live import Live

from fleet.bus.client.client import BusClient
from fleet.bus.protocol.auction import ArmEvent, Result
from fleet.live.monitor.listener import FleetListener
from fleet.live.monitor.snapshot import describe_event, describe_status
from scenarios.cli.options import ENDPOINT, EndpointOption, FleetOption, the_fleet
from scenarios.cli.signals import until_stopped
from scenarios.cli.terminal import echo, out_console
from scenarios.live.watch_screen import arm_line, format_time, jobs_line, screen, space_line

FRAME_S, LINE_S, SNAPSHOT_S = 0.25, 5.0, 1.0
"""Real seconds: between two frames; between two lines about every arm; of listening for one snapshot."""


def watch_command(
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print one snapshot as JSON.")] = False,
) -> None:
    """Watch a fleet until Ctrl-C: temperatures, difficulty, jobs, and the age of every message."""
    news: deque[str] = deque(maxlen=100)

    def on_message(_: str, name: str, message: msgspec.Struct) -> None:
        if line := describe(name, message):
            news.append(line)

    def on_presence(role: str, name: str, present: bool) -> None:
        news.append(f"{name if role == 'arm' else f'auctioneer {name}'} {'joined' if present else 'left'}")

    with until_stopped() as stop, BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        listener = FleetListener(link, on_message=on_message, on_presence=on_presence)
        if as_json:
            listener.serve(time.monotonic() + SNAPSHOT_S)
            echo(msgspec.json.encode(listener.view.snapshot(time.monotonic())).decode())
        elif out_console.is_terminal:
            draw(listener, news, stop.is_set)
        else:
            print_lines(listener, news, stop.is_set)
        stop.leave("Stopped watching.")


def draw(listener: FleetListener, news: deque[str], stopped: Callable[[], bool]) -> None:
    """Draw a screen that fills the terminal, again and again until stopped."""
    with Live(console=out_console, screen=True, auto_refresh=False) as live:
        while not stopped():
            listener.serve(time.monotonic() + FRAME_S)
            fleet = listener.view.snapshot(time.monotonic(), jobs=0)
            live.update(screen(fleet, list(news), out_console.height), refresh=True)


def print_lines(listener: FleetListener, news: deque[str], stopped: Callable[[], bool]) -> None:
    """Print news as they come, and a line about every arm from time to time, until stopped."""
    due_s = time.monotonic() + SNAPSHOT_S
    while not stopped():
        listener.serve(time.monotonic() + FRAME_S)
        while news:
            echo(news.popleft())
        if time.monotonic() >= due_s:
            due_s = time.monotonic() + LINE_S
            fleet = listener.view.snapshot(time.monotonic(), jobs=0)
            for arm in fleet.arms:
                echo(arm_line(arm))
            echo(jobs_line(fleet).plain)
            echo(space_line(fleet).plain)


def describe(name: str, message: msgspec.Struct) -> str:
    """Line about an event or a result; "" for other messages."""
    if isinstance(message, ArmEvent):
        return f"{format_time(message.time_s)}  {name}: {describe_event(message)}"
    if isinstance(message, Result):
        return f"{format_time(message.time_s)}  job {describe_status(message.status)}"
    return ""
