"""A live fleet on the terminal, until the end of its shift."""

import math
import os
import select
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import msgspec
from rich.live import Live

from fleet.bus.client import BusClient
from fleet.bus.protocol.auction import SETTLED, ArmEvent, JobState, Result
from fleet.bus.router import fleets_at
from fleet.errors import NoRouter
from fleet.live.monitor.snapshot import FleetListener, FleetSnapshot, describe_status
from scenarios.cli.options import the_fleet
from scenarios.show.watch import (
    JobBars,
    arm_line,
    format_time,
    jobs_line,
    plain_event,
    screen,
    space_line,
    time_line,
)
from scenarios.signals import StopRequest, until_stopped
from scenarios.terminal import echo, err_console, out_console, say

WAIT_S, GONE_S = 0.5, 3.0
"""Real seconds between two searches for a fleet, and without participants until a settled shift counts as ended."""
OPEN: tuple[JobState, ...] = ("waiting", "awarded", "finishing")
FRAME_S, LINE_S, SNAPSHOT_S = 0.25, 5.0, 1.0
"""Real seconds between two frames, between two lines about an arm, and of listening for one snapshot."""


def watch(
    endpoint: str, fleet: str, *, as_json: bool = False, joints: bool = False, end_s: float | None = None
) -> None:
    """Show a fleet until its shift has ended, or Ctrl-C; or print one snapshot as JSON.

    Args:
        fleet: Its name; "" for the only one at the endpoint, and to wait for it.
        joints: Show every joint.
        end_s: End of the shift, s of fleet time, if it is known.

    Raises:
        FleetError: there is no such fleet, or there are several.
    """
    news: deque[str] = deque(maxlen=100)

    def on_message(_: str, name: str, message: msgspec.Struct) -> None:
        if line := describe(name, message):
            news.append(line)

    def on_presence(role: str, name: str, present: bool) -> None:
        news.append(f"{name if role == 'arm' else f'auctioneer {name}'} {'joined' if present else 'left'}")

    with until_stopped() as stop, ExitStack() as resources:
        name = the_fleet(fleet, endpoint) if as_json or fleet else wait_for_fleet(endpoint, stop)
        link = resources.enter_context(BusClient(endpoint, name, stopped=None if as_json else stop.is_set))
        listener = FleetListener(link, on_message=on_message, on_presence=on_presence)
        if as_json:
            listener.serve(time.monotonic() + SNAPSHOT_S)
            echo(msgspec.json.encode(listener.view.snapshot(time.monotonic())).decode())
        else:
            end = ShiftEnd()

            def ended(fleet: FleetSnapshot) -> bool:
                return stop.is_set() or bool(end.check(fleet, time.monotonic()))

            if out_console.is_terminal:
                draw(listener, news, ended, joints=joints, end_s=end_s)
            else:
                print_lines(listener, news, ended, joints=joints, end_s=end_s)
            if end.sentence:
                say(end.sentence, out_console)
        stop.leave("Stopped watching.")


def wait_for_fleet(endpoint: str, stop: StopRequest) -> str:
    """Name of the only fleet at the router, once there is one.

    Raises:
        FleetError: there are several, or stopped meanwhile.
    """
    waits = False
    while True:
        try:
            fleets = fleets_at(endpoint, timeout_s=1.0)
        except NoRouter:
            fleets = ()
        if len(fleets) == 1:
            return fleets[0]
        if fleets:
            return the_fleet("", endpoint)
        if not waits:
            say(f"Waiting for a fleet at {endpoint} …", err_console)
        waits = True
        if stop.wait(WAIT_S):
            stop.leave("Stopped before there was a fleet.")
            raise NoRouter(f"Stopped while waiting for a fleet at {endpoint}.")


class ShiftEnd:
    """Whether the shift has ended: all participants have left, and every job is settled.

    Attributes:
        sentence: How it ended; "" before.
    """

    def __init__(self) -> None:
        self.sentence = ""
        self._seen, self._gone_s = False, math.inf

    def check(self, fleet: FleetSnapshot, real_s: float) -> str:
        """Return how the shift ended; "" if it goes on."""
        present = any(each.token for each in (*fleet.arms, *fleet.auctioneers))
        self._seen |= present
        self._gone_s = math.inf if present or not self._seen else min(self._gone_s, real_s)
        total, open_jobs = sum(fleet.counts.values()), sum(fleet.counts.get(state, 0) for state in OPEN)
        if real_s >= self._gone_s + GONE_S and total and not open_jobs:
            counts = {state.replace("_", " "): fleet.counts.get(state, 0) for state in SETTLED[1:]}
            rest = [f"{count} {state}" for state, count in counts.items() if count]
            finished = f"{fleet.counts.get('finished', 0)} of {total} jobs finished"
            self.sentence = f"The shift has ended: {', '.join([finished, *rest])}."
        return self.sentence


def draw(
    listener: FleetListener,
    news: deque[str],
    ended: Callable[[FleetSnapshot], bool],
    *,
    joints: bool,
    end_s: float | None,
) -> None:
    """Draw a screen that fills the terminal, again and again until the end or the key q."""
    bars = JobBars()
    with pressed_keys() as pressed, Live(console=out_console, screen=True, auto_refresh=False) as live:
        while not ended(fleet := listener.view.snapshot(time.monotonic(), jobs=0)):
            listener.serve(time.monotonic() + FRAME_S)
            keys = pressed()
            if "q" in keys:
                break
            joints ^= keys.count("j") % 2 == 1
            size = out_console.size
            how = {"width": size.width, "joints": joints, "done": bars.update(fleet), "end_s": end_s}
            live.update(screen(fleet, list(news), size.height, **how), refresh=True)


@contextmanager
def pressed_keys() -> Iterator[Callable[[], str]]:
    """A function that returns the keys pressed since it was last called, in lower case; none without a terminal."""
    try:
        import termios
        import tty

    except ModuleNotFoundError:  # Windows
        yield lambda: ""
        return
    try:
        before = termios.tcgetattr(sys.stdin.fileno())
    except (OSError, ValueError, termios.error):  # no terminal, or closed
        yield lambda: ""
        return

    def pressed() -> str:
        keys = ""
        while select.select([sys.stdin], [], [], 0.0)[0] and (more := os.read(sys.stdin.fileno(), 64)):
            keys += more.decode("ascii", "ignore").lower()
        return keys

    try:
        tty.setcbreak(sys.stdin.fileno())
        yield pressed
    finally:
        termios.tcsetattr(sys.stdin.fileno(), termios.TCSADRAIN, before)


def print_lines(
    listener: FleetListener,
    news: deque[str],
    ended: Callable[[FleetSnapshot], bool],
    *,
    joints: bool,
    end_s: float | None,
) -> None:
    """Print news as they come, and a line about every arm from time to time, until the end."""
    due_s = time.monotonic() + SNAPSHOT_S
    while not ended(fleet := listener.view.snapshot(time.monotonic(), jobs=0)):
        listener.serve(time.monotonic() + FRAME_S)
        while news:
            echo(news.popleft())
        if time.monotonic() >= due_s:
            due_s = time.monotonic() + LINE_S
            for arm in fleet.arms:
                echo(arm_line(arm, joints=joints))
            echo(jobs_line(fleet).plain)
            echo(space_line(fleet).plain)
            if end_s is not None:
                echo(time_line(fleet, end_s).plain)


def describe(name: str, message: msgspec.Struct) -> str:
    """Line about an event or a result; "" for other messages."""
    if isinstance(message, ArmEvent):
        return f"{format_time(message.time_s)}  {name} {plain_event(message)}"
    if isinstance(message, Result):
        return f"{format_time(message.time_s)}  job {describe_status(message.status)}"
    return ""
