"""One event, and everything that led to it, on one screen."""

import re
from bisect import bisect
from collections.abc import Mapping
from pathlib import Path
from typing import Any  # values of run.json

from rich.console import Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from fleet.errors import FleetError, visible
from fleet.events import MEANINGS, Event
from scenarios.report.gantt import clock
from scenarios.shift_records import Offer
from scenarios.trace.thread import NOT_RECORDED, Thread

RUNS = Path("runs")
MOST_OFFERS, MOST_HISTORY = 8, 8


def last_folder(runs: Path) -> Path:
    """The folder of the run or recording that was written last.

    Raises:
        FleetError: there is none.
    """
    cards = [*runs.glob("*/run.json"), *runs.glob("*/recording.json")] if runs.is_dir() else []
    if not cards:
        raise FleetError(f"There is no run in '{runs}'; name the folder of a run or a recording with --in.")
    return max(cards, key=lambda card: card.stat().st_mtime_ns).parent


def thread_screen(thread: Thread) -> Group:
    """The thread as text, about 30 lines."""
    event = thread.event
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column("", style="bold")
    table.add_column("", overflow="fold")

    def row(name: str, *parts: object) -> None:
        if text := ", ".join(str(part) for part in parts if part not in ("", None)):
            table.add_row(name, escape(visible(text)))

    row("event", f"row {thread.row} of {thread.folder}", _alike(thread))
    row("", *_words(event), MEANINGS[event.kind].text)
    if thread.job:
        row("job", *_pairs(thread.job))
    if thread.award is not None:
        award = thread.award
        row("award", f"{clock(award.time_s)} to {award.arm}", *_number("d", award.value), award.reason)
        row("plan", *_plan(thread.offers, award))
    shown = sorted(thread.offers, key=lambda o: (not o.awarded, not o.free, o.arm))
    for i, offer in enumerate(shown[:MOST_OFFERS]):
        row("" if i else "offers", *_offer(offer))
    if len(shown) > MOST_OFFERS:
        row("", f"and {len(shown) - MOST_OFFERS} more; offers.parquet has all of them")
    if thread.award is not None and not shown:
        row("offers", NOT_RECORDED)
    if thread.twin:
        row("twin", *_pairs({k: v for k, v in thread.twin.items() if not isinstance(v, Mapping)}))
        for name in ("twin", "saturation"):
            if name in thread.twin:
                row({"twin": "trained on", "saturation": "calibrated on"}[name], *_pairs(thread.twin[name]))
    row("configuration", *_pairs({k: v for k, v in thread.configuration.items() if k != "channel"}))
    if isinstance(channel := thread.configuration.get("channel"), Mapping):
        row("channel", *_pairs(channel))
    row("code", *_pairs(thread.code))
    for i, one in enumerate(_around(thread)):
        row("" if i else "history", *_words(one))
    return Group(Text(f"{event.kind.replace('_', ' ')} at {clock(event.time_s)}", style="bold"), table)


def _around(thread: Thread) -> tuple[Event, ...]:
    """Events of the job, the shown one among them."""
    times_s = [event.time_s for event in thread.history]
    begin = bisect(times_s, thread.event.time_s) - MOST_HISTORY // 2
    begin = max(0, min(begin, len(times_s) - MOST_HISTORY))
    return thread.history[begin : begin + MOST_HISTORY]


def _alike(thread: Thread) -> str:
    others = [row for row in thread.alike if row != thread.row]
    more = ", …" if len(others) > 5 else ""
    return f"the first of {len(thread.alike)}, others in rows {', '.join(map(str, others[:5]))}{more}" if others else ""


def _words(event: Event) -> list[str]:
    joint = f"joint {event.joint}" if event.joint else ""
    value = f"{MEANINGS[event.kind].value or 'value'} {event.value:.4g}" if event.value == event.value else ""
    return [clock(event.time_s), event.kind.replace("_", " "), event.arm, event.job, joint, value, event.reason]


def _number(name: str, value: float) -> list[str]:
    return [f"{name} {value:.2f}"] if value == value else []


def _plan(offers: tuple[Offer, ...], award: Event) -> list[str]:
    chosen = next((offer for offer in offers if offer.awarded), None)
    duration = f"{chosen.duration_s:.0f} s" if chosen is not None and chosen.duration_s is not None else ""
    stated = re.match(r"plan (\d+), twin ", award.reason)  # by a live arm
    number = int(stated[1]) if stated else None if chosen is None else chosen.plan
    if number is None:
        return [NOT_RECORDED, duration]
    return [f"plan {number}, the {'coolest' if number else 'fastest'} that was offered", duration]


def _offer(offer: Offer) -> list[str]:
    if not offer.feasible:
        return [offer.arm, "cannot do it"]
    known = {"d": (offer.difficulty, ".2f"), "P": (offer.p_saturation, ".2f"), "peak °C": (offer.peak_c, ".1f")}
    parts = [f"{name} {value:{form}}" for name, (value, form) in known.items() if value is not None]
    duration = [f"{offer.duration_s:.0f} s"] if offer.duration_s is not None else []
    reason = "" if offer.free else f"not free ({offer.state})"
    return [offer.arm + (" (awarded)" if offer.awarded else ""), *parts, *duration, reason]


def _pairs(values: Mapping[str, Any]) -> list[str]:
    return [f"{key.replace('_', ' ')} {_text(value)}" for key, value in values.items() if value is not None]


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
