"""A fleet as a table on the terminal, and as plain lines where there is none."""

from collections.abc import Iterable, Sequence
from typing import get_args

from rich.console import Group
from rich.table import Table
from rich.text import Text

from fleet.bus.trade import JobState
from fleet.live.overview import FRESH_S, ArmNow, FleetNow

STATES: tuple[str, ...] = get_args(JobState)
HOT_K, WARM_K = 5.0, 10.0
"""Headroom below which an arm is shown in red, in yellow."""
FRAME = 6
"""Lines of the screen that are not arms or events."""
_MODES = {"faulted": "bold red", "working": "green"}


def screen(now: FleetNow, events: Sequence[str], height: int) -> Group:
    """The whole picture, cut to so many lines: the arms with the least headroom stay."""
    room = max(1, height - FRAME - min(len(events), 6))
    arms = now.arms
    if len(arms) > room:
        room -= 1
        pressing = sorted(arms, key=lambda arm: (not arm.token, arm.headroom_k if arm.headroom_k is not None else 1e9))
        kept = {arm.arm for arm in pressing[:room]}
        arms = tuple(arm for arm in arms if arm.arm in kept)
    parts: list[Table | Text] = [heading(now), table(arms)]
    if len(arms) < len(now.arms):
        parts.append(Text(f"… and {len(now.arms) - len(arms)} more with more headroom", style="dim"))
    parts.append(jobs_line(now))
    parts += [Text(event, style="dim", no_wrap=True, overflow="ellipsis") for event in events[-6:]]
    return Group(*parts)


def heading(now: FleetNow) -> Text:
    """Fleet, its time, how many arms are present, who allocates."""
    times = [arm.time_s for arm in now.arms if arm.time_s is not None and arm.present]
    present = sum(arm.present for arm in now.arms)
    auctioneers = [seen.auctioneer for seen in now.auctioneers if seen.token]
    text = Text(no_wrap=True, overflow="ellipsis")
    text.append(now.fleet, style="bold")
    text.append(f"   {clock(max(times))}" if times else "   no time yet")
    text.append(f"   {present} of {len(now.arms)} arms present", style="" if present == len(now.arms) else "yellow")
    text.append("   auctioneer " + ", ".join(auctioneers) if auctioneers else "   no auctioneer", style="")
    return text


def table(arms: Iterable[ArmNow]) -> Table:
    """One line per arm."""
    made = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), expand=True, header_style="dim")
    made.add_column("arm", min_width=5, no_wrap=True)
    made.add_column("mode", min_width=7, no_wrap=True)
    made.add_column("hot °C", min_width=7, no_wrap=True, justify="right")
    made.add_column("room K", min_width=6, no_wrap=True, justify="right")
    made.add_column("job in hand", no_wrap=True, overflow="ellipsis", ratio=2)
    made.add_column("finds jobs on offer", no_wrap=True, overflow="ellipsis", ratio=4)
    for name in ("state", "diff.", "token"):
        made.add_column(name, justify="right", min_width=5, no_wrap=True)
    for arm in arms:
        made.add_row(
            arm.arm,
            Text(arm.mode or "—", style=_MODES.get(arm.mode or "", "")),
            "—" if arm.hottest_c is None else f"{arm.hottest_c:.1f} J{arm.joint}",
            Text("—" if arm.headroom_k is None else f"{arm.headroom_k:.1f}", style=_warmth(arm.headroom_k)),
            arm.job,
            scores(arm),
            Text(age(arm.state_age_s), style="" if (arm.state_age_s or 0.0) <= FRESH_S else "red"),
            age(arm.difficulty_age_s),
            Text("yes") if arm.token else Text("no", style="red"),
            style="" if arm.present else "dim",
        )
    return made


def jobs_line(now: FleetNow) -> Text:
    """How many jobs are in which state."""
    counts = ", ".join(f"{now.counts[state]} {state}" for state in STATES if now.counts.get(state))
    return Text(f"jobs: {counts or 'none'}", no_wrap=True, overflow="ellipsis")


def line(arm: ArmNow) -> str:
    """An arm on one line."""
    parts = [
        f"{arm.arm:<10}",
        f"{arm.mode or 'unknown':<8}",
        "" if arm.hottest_c is None else f"{arm.hottest_c:.1f} °C J{arm.joint}",
        "" if arm.headroom_k is None else f"headroom {arm.headroom_k:.1f} K",
        f"does {arm.job}" if arm.job else "",
        f"finds {told}" if (told := scores(arm)) else "",
        f"state {age(arm.state_age_s)}",
        "" if arm.token else "no token",
    ]
    return "  ".join(filter(None, parts))


def scores(arm: ArmNow) -> str:
    """Difficulties of the jobs on offer, easiest first; a dash where the arm has no score."""
    known = sorted((d, job) for job, d in arm.difficulty.items() if d is not None)
    unknown = [job for job, d in arm.difficulty.items() if d is None]
    return ", ".join([*(f"{job} {d:.2f}" for d, job in known), *(f"{job} —" for job in sorted(unknown))])


def age(seconds: float | None) -> str:
    """A short age: `0.1 s`, `12 s`, `5 min`."""
    if seconds is None:
        return "—"
    if seconds < 10:
        return f"{max(0.0, seconds):.1f} s"
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def clock(time_s: float) -> str:
    """The fleet's time: `1:02:03`."""
    minutes, seconds = divmod(int(time_s), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"


def _warmth(headroom_k: float | None) -> str:
    if headroom_k is None:
        return ""
    return "bold red" if headroom_k < HOT_K else "yellow" if headroom_k < WARM_K else ""
