"""Two runs of the same jobs side by side: their verdicts, key figures and reports, as one HTML page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any  # values of run.json
from urllib.parse import quote

from fleet.events import Event
from scenarios.report.gantt import clock
from scenarios.report.page import escape, html_page, paragraph
from scenarios.report.run_page import key_figures
from scenarios.report.schedule import schedule
from scenarios.report.verdict import Verdict, verdict
from scenarios.shift_records import Offer


@dataclass(frozen=True, kw_only=True)
class Side:
    """One of the runs."""

    run: Mapping[str, Any]
    """Content of its run.json."""
    events: Sequence[Event]
    arms: Sequence[str]
    time_s: float
    """Simulated time at its end."""
    report: str
    """Path of its report, relative to the page."""
    offers: Sequence[Offer] = field(default=())

    @property
    def name(self) -> str:
        """Name of its policy."""
        return str(self.run.get("policy", "unknown policy"))

    @property
    def faults(self) -> list[Event]:
        """Its faults, in order of time."""
        return sorted((event for event in self.events if event.kind == "fault"), key=lambda event: event.time_s)

    @property
    def verdict(self) -> Verdict:
        """What happened, in words."""
        return verdict(self.run, self.events, schedule(self.events, self.arms, self.time_s), self.offers)


def pair_page(title: str, description: str, sides: tuple[Side, Side]) -> str:
    """The page; it links the two reports. The same input gives the same text."""
    columns = [
        f"<section>{_head(side, other)}{key_figures(side.run.get('metrics') or {})}"
        f'<p><a href="{escape(quote(side.report))}">Open its report</a>: 3-D, temperatures, awards.</p></section>'
        for side, other in (sides, sides[::-1])
    ]
    return html_page(title, [paragraph(description, "faint"), f'<div class="pair">{"".join(columns)}</div>'])


def _head(side: Side, other: Side) -> str:
    told = side.verdict
    badge = paragraph(told.badge, "status good" if told.good else "status bad")
    lines = [*told.sentences, *other_choices(side, other)]
    return f"<h2>{escape(side.name)}</h2>{badge}{''.join(paragraph(line, 'verdict') for line in lines)}"


def other_choices(side: Side, other: Side) -> list[str]:
    """Of the job of each fault, what became of it in the other run."""
    lines: list[str] = []
    for job in dict.fromkeys(fault.job for fault in side.faults if fault.job):
        own = [event for event in other.events if event.job == job]
        faults = [event for event in own if event.kind == "fault"]
        finish = next((event for event in own if event.kind == "finish"), None)
        if finish is not None:
            after = f", after {len(faults)} fault{'s' * (len(faults) > 1)}" if faults else " without a fault"
            lines.append(f"Under {other.name}, {finish.arm} finished {job} at {clock(finish.time_s)}{after}.")
        else:
            began = any(event.kind == "award" for event in own)
            lines.append(f"Under {other.name}, {job} was not {'finished' if began else 'begun'}.")
    return lines
