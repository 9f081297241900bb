"""`thermofleet watch`: a fleet live on the terminal."""

import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from scenarios.live_options import ENDPOINT, EndpointOption, FleetOption, the_fleet
from scenarios.terminal import out_console

if TYPE_CHECKING:
    from fleet.live.onlooker import Onlooker

FRAME_S, LINE_S, SNAPSHOT_S = 0.25, 5.0, 1.0
"""Real seconds: between two pictures; between two lines about every arm; of listening for one snapshot."""


def watch_command(
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
    as_json: Annotated[bool, typer.Option("--json", help="One snapshot as JSON.")] = False,
) -> None:
    """Watch a fleet until Ctrl-C: temperatures, difficulty, jobs, and the age of every word."""
    from fleet.bus.link import Link
    from fleet.live.onlooker import Onlooker
    from scenarios.stopping import until_stopped

    news: deque[str] = deque(maxlen=100)
    with until_stopped() as stop, Link(endpoint, the_fleet(fleet, endpoint)) as link:
        onlooker = Onlooker(link, heard=lambda *said: tell(news, *said), came=lambda *who: came(news, *who))
        if as_json:
            onlooker.serve(time.monotonic() + SNAPSHOT_S)
            typer.echo(msgspec.json.encode(onlooker.overview.now(time.monotonic())).decode())
        elif out_console.is_terminal:
            draw(onlooker, news, stop.is_set)
        else:
            print_lines(onlooker, news, stop.is_set)
        stop.leave("Stopped watching.")


def draw(onlooker: "Onlooker", news: "deque[str]", stopped: Callable[[], bool]) -> None:
    """A table that fills the terminal, drawn anew until told to stop."""
    from rich.live import Live

    from scenarios.watch_screen import screen

    with Live(console=out_console, screen=True, auto_refresh=False) as live:
        while not stopped():
            onlooker.serve(time.monotonic() + FRAME_S)
            now = onlooker.overview.now(time.monotonic(), jobs=0)
            live.update(screen(now, list(news), out_console.height), refresh=True)


def print_lines(onlooker: "Onlooker", news: "deque[str]", stopped: Callable[[], bool]) -> None:
    """News as they come, and now and then a line about every arm, until told to stop."""
    from scenarios.watch_screen import jobs_line, line

    due_s = time.monotonic() + SNAPSHOT_S
    while not stopped():
        onlooker.serve(time.monotonic() + FRAME_S)
        while news:
            typer.echo(news.popleft())
        if time.monotonic() >= due_s:
            due_s = time.monotonic() + LINE_S
            now = onlooker.overview.now(time.monotonic(), jobs=0)
            for arm in now.arms:
                typer.echo(line(arm))
            typer.echo(jobs_line(now).plain)


def tell(news: "deque[str]", topic: str, name: str, word: msgspec.Struct) -> None:
    """Events and results in words."""
    from fleet.bus.trade import ArmEvent, Result
    from fleet.live.overview import described
    from scenarios.watch_screen import clock

    if isinstance(word, ArmEvent):
        news.append(f"{clock(word.time_s)}  {name}: {described(word)}")
    elif isinstance(word, Result):
        job = word.status
        by = f" {'to' if job.state == 'awarded' else 'by'} {job.arm}" if job.arm else ""
        why = f": {job.reason}" if job.reason else ""
        news.append(f"{clock(word.time_s)}  job {job.job}: {job.state}{by}{why}")


def came(news: "deque[str]", role: str, name: str, there: bool) -> None:
    """Who came and went."""
    who = name if role == "arm" else f"auctioneer {name}"
    news.append(f"{who} {'came' if there else 'went'}")
