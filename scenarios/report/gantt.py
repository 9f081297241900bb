"""Gantt chart as Plotly traces: bars of work and outages, marks of faults and warnings, one row per arm."""

import html
from collections.abc import Callable, Sequence
from typing import Any, TypeVar  # Any: values of Plotly's schema

import numpy as np

from fleet.errors import visible
from fleet.events import Event
from scenarios.report.schedule import Assignment, Outage, Schedule

Trace = dict[str, Any]
Span = TypeVar("Span", Assignment, Outage)

STREAM_COLOURS = ("#4477aa", "#ddaa33", "#228833", "#aa4499", "#66ccee", "#997755", "#999933", "#555566")
FAULT, WARNING, INK = "#cc2222", "#e08a00", "#222222"
BAR = {"type": "bar", "orientation": "h", "legend": "legend"}
BAR_HEIGHT = 0.62
"""In rows."""
LATE = {"color": INK, "width": 1.6}
HATCH = {"fillmode": "overlay", "fgcolor": "white", "fgopacity": 1.0, "size": 7, "solidity": 0.35}
ARM_NAME, STREAM_NAME = 16, 30
"""Most characters of a name beside an axis and in a legend, which take their place from the figure."""
UNFINISHED = 0.55
"""Opacity of work that was returned or is still running."""
MARKS = (("fault", "x", FAULT), ("warning", "triangle-up", WARNING))


def gantt(plan: Schedule, events: Sequence[Event], arms: Sequence[str], unit_s: float) -> list[Trace]:
    """All traces; the row of an arm is its index, times are in units of `unit_s`."""
    traces = _work_bars(plan, events, arms, unit_s)
    if plan.outages:
        look = {"color": FAULT, "opacity": 0.8, "line": {"width": 0}, "pattern": HATCH | {"shape": "x"}}
        traces.append(_bars("out after a fault", plan.outages, _outage_text, arms, unit_s, look))
    if not traces:  # without a trace Plotly draws no rows
        traces.append(
            BAR
            | {"name": "no job was begun", "showlegend": True, "x": [None], "y": [None], "marker": {"color": "#888888"}}
        )
    for kind, symbol, colour in MARKS:  # above the bars of their arm
        own = [e for e in events if e.kind == kind and e.arm in arms]
        if own:
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": kind,
                    "x": [round(e.time_s / unit_s, 5) for e in own],
                    "y": [arms.index(e.arm) - 0.42 for e in own],
                    "marker": {"symbol": symbol, "color": colour, "size": 9, "line": {"color": "white", "width": 1}},
                    **_hover([_event_text(e) for e in own]),
                    "legend": "legend",
                }
            )
    return traces


def stream_of(job: str) -> str:
    """Stream of a job: its name without the part after the last dash."""
    return job.rpartition("-")[0] or job


def plain(text: str, most: int | None = None) -> str:
    """Text escaped for Plotly, which interprets some HTML and `%{…}`; with `most`, its start and end are kept."""
    shown = visible(text)
    if most is not None and len(shown) > most:
        shown = f"{shown[: most - most // 2 - 1]}…{shown[-(most // 2) :]}"
    return html.escape(shown, quote=False).replace("%{", "%&#123;")


def clock(time_s: float) -> str:
    """A time of the shift as h:mm:ss."""
    seconds = round(time_s)
    return f"{seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"


def _work_bars(plan: Schedule, events: Sequence[Event], arms: Sequence[str], unit_s: float) -> list[Trace]:
    """Bars of every stream, then samples of the looks for the legend."""
    # Streams of all jobs, done or not, so that a stream has the same colour in every policy's report.
    streams = sorted({stream_of(event.job) for event in events if event.job})
    traces = []
    for i, stream in enumerate(streams):
        # The legend shows the look of the first one: not that of a late or unfinished job.
        own = sorted(
            (a for a in plan.assignments if stream_of(a.job) == stream),
            key=lambda a: (bool(a.late_s), a.outcome != "finished"),
        )
        if not own:
            continue
        look = {
            "color": STREAM_COLOURS[i % len(STREAM_COLOURS)],
            "opacity": [1.0 if a.outcome == "finished" else UNFINISHED for a in own],
            "line": {
                "color": [LATE["color"] if a.late_s else "white" for a in own],
                "width": [LATE["width"] if a.late_s else 0.6 for a in own],
            },
            "pattern": HATCH | {"shape": [_shape(a) for a in own]},
        }
        traces.append(_bars(plain(stream, STREAM_NAME), own, _assignment_text, arms, unit_s, look))
    outcomes = {a.outcome for a in plan.assignments}
    samples = (
        (
            "late",
            any(a.late_s for a in plan.assignments),
            {"color": "#888888", "line": LATE, "pattern": HATCH | {"shape": "."}},
        ),
        ("returned", "returned" in outcomes, {"color": "#888888", "pattern": HATCH | {"shape": "/"}}),
        ("still running", "running" in outcomes, {"color": "#888888", "opacity": UNFINISHED}),
    )
    return traces + [
        BAR | {"name": name, "x": [None], "y": [None], "marker": look} for name, used, look in samples if used
    ]


def _shape(a: Assignment) -> str:
    """Pattern of a bar, for people who see no colours and for dark pages, which show no dark outline."""
    return "/" if a.outcome == "returned" else "." if a.late_s else ""


def _bars(
    name: str, spans: Sequence[Span], text: Callable[[Span], str], arms: Sequence[str], unit_s: float, look: Trace
) -> Trace:
    """Horizontal bars of assignments or outages."""
    return BAR | {
        "name": name,
        "y": [arms.index(span.arm) for span in spans],
        "base": [round(span.start_s / unit_s, 5) for span in spans],
        "x": [round((span.end_s - span.start_s) / unit_s, 5) for span in spans],
        "width": BAR_HEIGHT,
        "marker": look,
        **_hover([text(span) for span in spans]),
    }


def _hover(texts: list[str]) -> Trace:
    return {"customdata": texts, "hovertemplate": "%{customdata}<extra></extra>"}


def _assignment_text(a: Assignment) -> str:
    """Hover text of one assignment."""
    if a.outcome == "finished":
        end = "on time" if not a.late_s else f"late by {clock(a.late_s)}"
        end = f"finished at {clock(a.finished_s or 0.0)}, {end}"
    elif a.outcome == "returned":
        kept = "" if a.cycles_kept is None else f", {a.cycles_kept} cycles kept"
        end = f"returned to the queue{' after a fault' if a.faulted else ''}{kept}"
    else:
        end = "still running at the end"
    scores = [a.prediction] if a.prediction else []
    scores += [f"difficulty {a.difficulty:.3g}"] if np.isfinite(a.difficulty) else []
    lines = [f"<b>{plain(a.job)}</b> on {plain(a.arm)}", f"{clock(a.start_s)} – {clock(a.end_s)}", end, *scores]
    return "<br>".join(lines)


def _outage_text(o: Outage) -> str:
    """Hover text of one outage."""
    end = "recovered" if o.recovered else "not recovered"
    return f"<b>{plain(o.arm)} lost</b><br>{clock(o.start_s)} – {clock(o.end_s)}, {end}<br>{plain(o.reason)}"


def _event_text(e: Event) -> str:
    """Hover text of one event."""
    job = f"<br>{plain(e.job)}" if e.job else ""
    return f"<b>{e.kind}</b> of {plain(e.arm)} at {clock(e.time_s)}<br>{plain(e.reason)}{job}"
