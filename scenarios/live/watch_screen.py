"""A fleet as a table on the terminal, and as plain lines without a terminal."""

from collections.abc import Iterable, Sequence
from math import inf
from typing import get_args

from rich.console import Group
from rich.table import Table
from rich.text import Text

from fleet.bus.protocol.auction import JobState
from fleet.live.monitor.snapshot import FRESH_S, ArmSnapshot, FleetSnapshot, JobScore
from fleet.live.space import ANYWHERE

HOT_K, WARM_K = 5.0, 10.0
"""Headroom below which an arm is shown in red, in yellow."""
FRAME, EVENTS = 7, 6
"""Lines of the screen that are neither arms nor events; events shown."""
_MODE_STYLES = {"faulted": "bold red", "working": "green"}


def screen(fleet: FleetSnapshot, events: Sequence[str], height: int) -> Group:
    """The whole screen in at most `height` lines: if there are too many arms, those with the least headroom stay."""
    room = max(1, height - FRAME - min(len(events), EVENTS))
    arms = fleet.arms
    if len(arms) > room:
        urgent = sorted(arms, key=lambda arm: (not arm.token, 1e9 if arm.headroom_k is None else arm.headroom_k))
        shown = {arm.arm for arm in urgent[: room - 1]}
        arms = tuple(arm for arm in arms if arm.arm in shown)
    parts: list[Table | Text] = [heading(fleet), arm_table(arms)]
    if len(arms) < len(fleet.arms):
        parts.append(Text(f"… and {len(fleet.arms) - len(arms)} more with more headroom", style="dim"))
    parts += [jobs_line(fleet), space_line(fleet)]
    parts += [Text(event, style="dim", no_wrap=True, overflow="ellipsis") for event in events[-EVENTS:]]
    return Group(*parts)


def heading(fleet: FleetSnapshot) -> Text:
    """Fleet, fleet time, number of arms present, auctioneer."""
    times = [arm.time_s for arm in fleet.arms if arm.time_s is not None and arm.present]
    present = sum(arm.present for arm in fleet.arms)
    auctioneers = ", ".join(each.auctioneer for each in fleet.auctioneers if each.token)
    text = Text(no_wrap=True, overflow="ellipsis")
    text.append(fleet.fleet, style="bold")
    text.append(f"   {format_time(max(times))}" if times else "   no time yet")
    text.append(f"   {present} of {len(fleet.arms)} arms present", style="" if present == len(fleet.arms) else "yellow")
    text.append(f"   auctioneer {auctioneers}" if auctioneers else "   no auctioneer")
    return text


def arm_table(arms: Iterable[ArmSnapshot]) -> Table:
    """One row per arm."""
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), expand=True, header_style="dim")
    table.add_column("arm", min_width=5, no_wrap=True)
    table.add_column("mode", min_width=7, no_wrap=True)
    table.add_column("hot °C", min_width=7, no_wrap=True, justify="right")
    table.add_column("room K", min_width=6, no_wrap=True, justify="right")
    table.add_column("current job", no_wrap=True, overflow="ellipsis", ratio=2)
    table.add_column("open jobs: predicted peak, P, d", no_wrap=True, overflow="ellipsis", ratio=4)
    for name in ("state", "diff.", "token"):
        table.add_column(name, justify="right", min_width=5, no_wrap=True)
    for arm in arms:
        table.add_row(
            arm.arm,
            Text(arm.mode or "—", style=_MODE_STYLES.get(arm.mode or "", "")),
            "—" if arm.hottest_c is None else f"{arm.hottest_c:.1f} J{arm.joint}",
            Text("—" if arm.headroom_k is None else f"{arm.headroom_k:.1f}", style=_headroom_style(arm.headroom_k)),
            arm.job,
            format_scores(arm),
            Text(format_age(arm.state_age_s), style="" if (arm.state_age_s or 0.0) <= FRESH_S else "red"),
            format_age(arm.difficulty_age_s),
            Text("yes") if arm.token else Text("no", style="red"),
            style="" if arm.present else "dim",
        )
    return table


def jobs_line(fleet: FleetSnapshot) -> Text:
    """Number of jobs in each state."""
    counts = ", ".join(f"{fleet.counts[state]} {state}" for state in get_args(JobState) if fleet.counts.get(state))
    return Text(f"jobs: {counts or 'none'}", no_wrap=True, overflow="ellipsis")


def space_line(fleet: FleetSnapshot) -> Text:
    """The arms whose space is closed to others, and why."""
    arms = {arm.arm: arm for arm in fleet.arms}
    parts: list[str] = []
    for name, spaces in fleet.space.items():
        arm = arms.get(name)
        where = "not present" if arm is None or not arm.present else "away from home" if arm.away else "has a job"
        parts.append(f"{name} ({where}{', may be anywhere' if ANYWHERE in spaces else ''})")
    return Text(f"space closed by: {', '.join(parts) or 'none'}", no_wrap=True, overflow="ellipsis")


def arm_line(arm: ArmSnapshot) -> str:
    """An arm on one line."""
    scores = format_scores(arm)
    parts = [
        f"{arm.arm:<10}",
        f"{arm.mode or 'unknown':<8}",
        "" if arm.hottest_c is None else f"{arm.hottest_c:.1f} °C J{arm.joint}",
        "" if arm.headroom_k is None else f"headroom {arm.headroom_k:.1f} K",
        f"job {arm.job}" if arm.job else "",
        f"open jobs: {scores}" if scores else "",
        f"state {format_age(arm.state_age_s)}",
        "" if arm.token else "no token",
    ]
    return "  ".join(filter(None, parts))


def format_scores(arm: ArmSnapshot) -> str:
    """Predicted peak, P and difficulty of the open jobs, coolest first; a dash for what the arm does not know."""

    def figure(value: float | None, form: str) -> str:
        return "—" if value is None else format(value, form)

    def heat(item: tuple[str, JobScore]) -> tuple[float, float, str]:
        name, score = item
        peak_c, difficulty = (inf if each is None else each for each in (score.peak_c, score.difficulty))
        return peak_c, difficulty, name

    parts: list[str] = []
    for job, score in sorted(arm.scores.items(), key=heat):
        p, d = figure(score.p_saturation, ".2f"), figure(score.difficulty, ".2f")
        parts.append(f"{job} {figure(score.peak_c, '.0f')} °C, P {p} (d {d})")
    return "; ".join(parts)


def format_age(seconds: float | None) -> str:
    """A short age: `0.1 s`, `12 s`, `5 min`."""
    if seconds is None:
        return "—"
    if seconds < 10:
        return f"{max(0.0, seconds):.1f} s"
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def format_time(time_s: float) -> str:
    """Fleet time: `1:02:03`."""
    minutes, seconds = divmod(int(time_s), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"


def _headroom_style(headroom_k: float | None) -> str:
    if headroom_k is None or headroom_k >= WARM_K:
        return ""
    return "bold red" if headroom_k < HOT_K else "yellow"
