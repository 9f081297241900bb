"""`thermofleet bus watch`: a live fleet as a screen on the terminal, and as tables now and then without a terminal."""

import math
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from textwrap import wrap
from typing import get_args

import msgspec
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from fleet.bus.client import BusClient
from fleet.bus.protocol.auction import SETTLED, ArmEvent, JobState, Result
from fleet.bus.protocol.operator import Alarm
from fleet.bus.router import fleets_at
from fleet.errors import NoRouter, StoppedWaiting, visible
from fleet.live.monitor.health import check_pauses
from fleet.live.monitor.snapshot import FRESH_S, ArmSnapshot, FleetListener, FleetSnapshot, JobScore, describe_status
from fleet.live.space import ANYWHERE
from scenarios.cli.options import the_fleet
from scenarios.progress import brief
from scenarios.show.words import clock, event_text
from scenarios.signals import StopRequest, until_stopped
from scenarios.terminal import echo, err_console, out_console, print_wide, say

WAIT_S, GONE_S = 0.5, 3.0
"""Real seconds between two searches for a fleet, and without participants until a settled shift counts as ended."""
LEFT_S, RESTORED_S = 1.0, 10.0
"""Real seconds without participants after which a lost connection is no reason for it, and after a connection was
restored until they are back."""
OPEN: tuple[JobState, ...] = ("waiting", "awarded", "finishing")
FRAME_S, LINE_S, SNAPSHOT_S = 0.25, 5.0, 1.0
"""Real seconds between two frames on a terminal, between two tables without one, and of listening for one snapshot."""
HOT_K, WARM_K = 5.0, 10.0
"""Headroom below which an arm is shown in red, in yellow."""
COOL_C = 20.0
"""A bar begins at this temperature and is full at the warning limit."""
HEAT_CELLS = 10
"""Characters of a bar."""
FRAME, NOTICES, EVENTS = 7, 6, 6
"""Lines of the screen that are neither arms nor notices nor events; lines of notices, and events, shown at most."""
WIDE = 120
"""Columns from which the scores of open jobs and the ages of messages are shown."""
_MODE_STYLES = {"faulted": "bold red", "working": "green"}


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
        if line := visible(describe(name, message)):
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

            def frames() -> Iterator[FleetSnapshot]:
                lost = False
                while not stop.is_set():
                    fleet = listener.view.snapshot(time.monotonic(), jobs=0)
                    if lost != (fleet.lost_s is not None):
                        lost = not lost
                        news.append(f"the connection to the router is {'lost' if lost else 'restored'}")
                    if end.check(fleet, time.monotonic()):
                        return
                    listener.serve(time.monotonic() + FRAME_S)
                    yield fleet

            follow(frames(), news, joints=joints, end_s=end_s)
            if end.sentence:
                say(end.sentence, out_console)
        stop.leave("Stopped watching.")


def wait_for_fleet(endpoint: str, stop: StopRequest) -> str:
    """Name of the only fleet at the router, once there is one.

    Raises:
        FleetError: there are several.
        StoppedWaiting: stopped meanwhile.
    """
    waits = False
    while True:
        try:
            fleets = fleets_at(endpoint, timeout_s=1.0)
        except NoRouter:
            fleets = ()
        if len(fleets) == 1:
            return fleets[0]
        if fleets or endpoint.startswith("tls/"):  # several, or none that a certificate may list
            return the_fleet("", endpoint)
        if not waits:
            say(f"Waiting for a fleet at {endpoint} …", err_console)
        waits = True
        if stop.wait(WAIT_S):
            raise StoppedWaiting(f"Stopped while waiting for a fleet at {endpoint}.")


class ShiftEnd:
    """Whether the shift has ended: all participants have left, and every job is settled.

    Without a connection it is unknown who is present: only participants that left before have left.

    Attributes:
        sentence: How it ended; "" before.
    """

    def __init__(self) -> None:
        self.sentence = ""
        self._seen, self._gone_s, self._back_s = False, math.inf, -math.inf

    def check(self, fleet: FleetSnapshot, real_s: float) -> str:
        """Return how the shift ended; "" if it goes on."""
        present = any(each.token for each in (*fleet.arms, *fleet.auctioneers))
        if fleet.lost_s is None:
            self._seen |= present
            self._gone_s = math.inf if present or not self._seen else min(self._gone_s, real_s)
        elif real_s - fleet.lost_s < self._gone_s + LEFT_S:
            self._gone_s, self._back_s = math.inf, real_s + RESTORED_S
        total, open_jobs = sum(fleet.counts.values()), sum(fleet.counts.get(state, 0) for state in OPEN)
        if real_s >= max(self._gone_s + GONE_S, self._back_s) and total and not open_jobs:
            counts = {state.replace("_", " "): fleet.counts.get(state, 0) for state in SETTLED[1:]}
            rest = [f"{count} {state}" for state, count in counts.items() if count]
            finished = f"{fleet.counts.get('finished', 0)} of {total} jobs finished"
            self.sentence = f"The shift has ended: {', '.join([finished, *rest])}."
        return self.sentence


def follow(frames: Iterator[FleetSnapshot], news: deque[str], *, joints: bool, end_s: float | None) -> None:
    """Show a fleet until the frames end: on a terminal as a screen; else news as they come, and tables now and then."""
    due_s = time.monotonic() + SNAPSHOT_S
    with ExitStack() as resources:
        live = None
        if out_console.is_terminal:
            live = resources.enter_context(Live(console=out_console, screen=True, auto_refresh=False))
        for fleet in frames:
            if live is not None:
                size = out_console.size
                how = {"width": size.width, "joints": joints, "end_s": end_s}
                live.update(screen(fleet, list(news), size.height, **how), refresh=True)
                continue
            while news:
                echo(news.popleft())
            if time.monotonic() >= due_s:
                due_s = time.monotonic() + LINE_S
                print_wide(screen(fleet, (), math.inf, width=WIDE, joints=joints, end_s=end_s))


def describe(name: str, message: msgspec.Struct) -> str:
    """Line about an event or a result; "" for other messages."""
    if isinstance(message, ArmEvent):
        return f"{clock(message.time_s)}  {name} {event_text(message)}"
    if isinstance(message, Result):
        return f"{clock(message.time_s)}  job {describe_status(message.status)}"
    if isinstance(message, Alarm):
        seen = f"{message.by} has seen the alarm" if message.by else ""
        change = "alarm has ended" if message.ended_s is not None else seen or "alarm"
        return f"{clock(message.time_s)}  {change}: {message.what}"
    return ""


def screen(
    fleet: FleetSnapshot,
    events: Sequence[str],
    height: float,
    *,
    width: int = 80,
    joints: bool = False,
    end_s: float | None = None,
) -> Group:
    """The whole screen in at most `height` lines: if there are too many arms, those with the least headroom stay.

    Args:
        joints: Show every motor in place of jobs.
        end_s: Fleet time at which the shift ends.
    """
    texts = [(fleet.expiry, "red")] if fleet.lost_s is not None else []
    texts += [(finding.what, "yellow") for finding in check_pauses(fleet)]
    notices = [(line, style) for text, style in texts for line in wrap(text, width)]
    height -= FRAME
    notices = notices[: int(max(0, min(NOTICES, height - 1)))]
    height -= len(notices)
    events = events[max(0, len(events) - int(min(EVENTS, height - 1))) :]
    room = max(1, height - len(events))
    arms = fleet.arms
    if len(arms) > room:
        urgent = sorted(arms, key=lambda arm: (not arm.token, 1e9 if arm.headroom_k is None else arm.headroom_k))
        shown = {arm.arm for arm in urgent[: int(room) - 1]}
        arms = tuple(arm for arm in arms if arm.arm in shown)
    parts: list[Table | Text] = [heading(fleet), *map(_line, notices), time_line(fleet, end_s)]
    parts.append(joint_table(arms) if joints else arm_table(arms, wide=width >= WIDE))
    if len(arms) < len(fleet.arms):
        parts.append(Text(f"… and {len(fleet.arms) - len(arms)} more with more headroom", style="dim"))
    parts += [jobs_line(fleet), space_line(fleet), alarm_line(fleet)]
    return Group(*parts, *(_line((text, "dim")) for text in events))


def _line(*parts: str | tuple[str, str]) -> Text:
    """One line of texts, some with a style; its end is cut off on a narrow terminal."""
    shown = (visible(part) if isinstance(part, str) else (visible(part[0]), part[1]) for part in parts)
    return Text.assemble(*shown, no_wrap=True, overflow="ellipsis")


def heading(fleet: FleetSnapshot) -> Text:
    """Fleet, numbers of arms present and left, auctioneer; or since when there is no connection."""
    if fleet.lost_s is not None:
        return _line((fleet.fleet, "bold"), (f"   no connection to the router for {fleet.lost_s:.0f} s", "red"))
    present = sum(arm.present for arm in fleet.arms)
    auctioneers = ", ".join(each.auctioneer for each in fleet.auctioneers if each.token)
    left = f", {len(fleet.left)} left" if fleet.left else ""
    arms = (f"   {present} of {len(fleet.arms)} arms present{left}", "" if present == len(fleet.arms) else "yellow")
    return _line((fleet.fleet, "bold"), arms, f"   auctioneer {auctioneers}" if auctioneers else "   no auctioneer")


def time_line(fleet: FleetSnapshot, end_s: float | None = None) -> Text:
    """Fleet time, its speed, and what is left of the shift."""
    there = any(each.token for each in (*fleet.arms, *fleet.auctioneers))
    if (now_s := fleet.time_s) is None or not there:
        return _line("no time yet")
    if end_s is None:
        return _line(clock(now_s))
    left_s, so_far = max(0.0, end_s - now_s), bar(now_s / end_s, 2 * HEAT_CELLS)
    speed = fleet.speed or 1.0
    real = f" ({brief(left_s / speed)} at {speed:g} ×)" if speed != 1.0 else ""
    return _line(f"{so_far} {clock(now_s)} of {clock(end_s)}, {clock(left_s)} left{real}")


def arm_table(arms: Iterable[ArmSnapshot], *, wide: bool = False) -> Table:
    """One row per arm; `wide` adds scores of open jobs and ages of messages."""
    table = _table_of_arms()
    table.add_column("to warning", min_width=HEAT_CELLS + 1, no_wrap=True)
    table.add_column("hot °C", min_width=7, no_wrap=True, justify="right")
    table.add_column("room K", min_width=6, no_wrap=True, justify="right")
    table.add_column("current job", no_wrap=True, overflow="ellipsis", ratio=2, min_width=8)
    table.add_column("left", no_wrap=True, min_width=6)
    if wide:
        table.add_column("open jobs: predicted peak, P, d", no_wrap=True, overflow="ellipsis", ratio=4)
        table.add_column("diff.", justify="right", min_width=5, no_wrap=True)
        table.add_column("token", justify="right", min_width=5, no_wrap=True)
    table.add_column("state", justify="right", min_width=5, no_wrap=True)
    for arm in arms:
        cells = [
            *_name_and_mode(arm),
            heat_bar(arm),
            "—" if arm.hottest_c is None else f"{arm.hottest_c:.1f} J{arm.joint}{'?' * bool(arm.bad_sensor)}",
            Text("—" if arm.headroom_k is None else f"{arm.headroom_k:.1f}", style=_headroom_style(arm.headroom_k)),
            format_work(arm),
            brief(arm.busy_s) if arm.job and arm.busy_s else "",
        ]
        if wide:
            token = Text("yes") if arm.token else Text("no", style="red")
            cells += [format_scores(arm), format_age(arm.difficulty_age_s), token]
        old = (arm.state_age_s or 0.0) > FRESH_S
        cells.append(Text(format_age(arm.state_age_s), "red" if old else ""))
        table.add_row(*cells, style="" if arm.present else "dim")
    return table


def joint_table(arms: Iterable[ArmSnapshot]) -> Table:
    """One row per arm with the temperature of every motor; ! marks little headroom, !! none."""
    arms = tuple(arms)
    table = _table_of_arms()
    joints = max((len(arm.temp_c) for arm in arms), default=0)
    for joint in range(joints):
        table.add_column(f"J{joint + 1} °C", justify="right", min_width=6, no_wrap=True)
    for arm in arms:
        cells: list[str | Text] = []
        for temp_c in arm.temp_c:
            room_k = (
                None if arm.headroom_k is None or arm.hottest_c is None else arm.headroom_k + arm.hottest_c - temp_c
            )
            cells.append(Text(f"{temp_c:.1f}{_mark(room_k)}", style=_headroom_style(room_k)))
        cells += [""] * (joints - len(cells))
        table.add_row(*_name_and_mode(arm), *cells, style="" if arm.present else "dim")
    return table


def bar(share: float, cells: int) -> str:
    """A bar of text."""
    full = round(min(1.0, max(0.0, share)) * cells)
    return "█" * full + "·" * (cells - full)


def heat_bar(arm: ArmSnapshot) -> Text:
    """The hottest motor between cool and the warning limit, with a mark of little headroom for people and terminals
    without colours."""
    if arm.hottest_c is None or arm.headroom_k is None:
        return Text("")
    warning_c = arm.hottest_c + arm.headroom_k
    share = (arm.hottest_c - COOL_C) / max(1.0, warning_c - COOL_C)
    return Text(bar(share, HEAT_CELLS) + _mark(arm.headroom_k), style=_headroom_style(arm.headroom_k))


def jobs_line(fleet: FleetSnapshot) -> Text:
    """Number of jobs in each state."""
    counts = ", ".join(f"{fleet.counts[state]} {state}" for state in get_args(JobState) if fleet.counts.get(state))
    return _line(f"jobs: {counts or _none(fleet)}")


def _none(fleet: FleetSnapshot) -> str:
    """Of what nothing is known: none, if anybody has replied about the jobs."""
    return "none" if any(each.heard_age_s is not None for each in fleet.auctioneers) else "unknown"


def space_line(fleet: FleetSnapshot) -> Text:
    """The arms whose space is closed to others, and why."""
    arms = {arm.arm: arm for arm in fleet.arms}
    parts: list[str] = []
    for name, spaces in fleet.space.items():
        arm = arms.get(name)
        where = "not present"
        if arm is not None and arm.present:
            where = "away from home" if arm.away else "has a job" if arm.job else "has no job"
        parts.append(f"{name} ({where}{', may be anywhere' if ANYWHERE in spaces else ''})")
    return _line(f"space closed by: {', '.join(parts) or _none(fleet)}")


def alarm_line(fleet: FleetSnapshot) -> Text:
    """Number of alarms that last, and the last one that nobody has seen, of those that a gateway raises."""
    lasting = [alarm for alarm in fleet.alarms if alarm.ended_s is None]
    unseen = [alarm for alarm in fleet.alarms if not alarm.by]
    last = f", not seen: {len(unseen)}, the last: {unseen[-1].what}" if unseen else ""
    return _line((f"alarms: {len(lasting) or 'none'}{last}", "bold red" if unseen else ""))


def format_scores(arm: ArmSnapshot) -> str:
    """Predicted peak, P and difficulty of the open jobs, coolest first; a dash for what the arm does not know."""

    def figure(value: float | None, form: str) -> str:
        return "—" if value is None else format(value, form)

    def heat(item: tuple[str, JobScore]) -> tuple[float, float, str]:
        name, score = item
        peak_c, difficulty = (math.inf if each is None else each for each in (score.peak_c, score.difficulty))
        return peak_c, difficulty, name

    parts: list[str] = []
    for job, score in sorted(arm.scores.items(), key=heat):
        p, d = figure(score.p_saturation, ".2f"), figure(score.difficulty, ".2f")
        parts.append(f"{job} {figure(score.peak_c, '.0f')} °C, P {p} (d {d})")
    return "; ".join(parts)


def format_work(arm: ArmSnapshot) -> str:
    """Job, or difficulty of the executed motion and the temperature that the hottest motor should have; bad sensor."""
    parts = [arm.job] if arm.job else []
    if not arm.job and arm.motion_difficulty is not None:
        parts.append(f"motion d {arm.motion_difficulty:.2f}")
    if not arm.job and arm.expected_c and arm.joint:
        parts.append(f"joint {arm.joint} expected {arm.expected_c[arm.joint - 1]:.1f} °C")
    return ", ".join([*parts, *([f"bad sensor: {arm.bad_sensor}"] if arm.bad_sensor else [])])


def format_age(seconds: float | None) -> str:
    """A short age: `0.1 s`, `12 s`, `5 min`."""
    if seconds is None:
        return "—"
    if seconds < 10:
        return f"{max(0.0, seconds):.1f} s"
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def _headroom_style(headroom_k: float | None) -> str:
    if headroom_k is None or headroom_k >= WARM_K:
        return ""
    return "bold red" if headroom_k < HOT_K else "yellow"


def _mark(headroom_k: float | None) -> str:
    if headroom_k is None or headroom_k >= HOT_K:
        return ""
    return "!!" if headroom_k < 0 else "!"


def _name_and_mode(arm: ArmSnapshot) -> tuple[str, Text]:
    mode = (arm.mode or "—") if arm.token else "left" if arm.left else "gone"
    return arm.arm, Text(mode, style=_MODE_STYLES.get(mode, ""))


def _table_of_arms() -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), expand=True, header_style="dim")
    table.add_column("arm", min_width=5, no_wrap=True)
    table.add_column("mode", min_width=7, no_wrap=True)
    return table
