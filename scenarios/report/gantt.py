"""Gantt chart as Plotly traces: bars of work and outages, marks of faults and warnings, one row per arm."""

import html
from collections.abc import Sequence
from typing import Any  # values of Plotly's schema

import numpy as np

from fleet.events import Event
from fleet.schedule import Assignment, Schedule

Trace = dict[str, Any]

STREAM_COLOURS = ("#4477aa", "#ddaa33", "#228833", "#aa4499", "#66ccee", "#997755", "#999933", "#555566")
FAULT, WARNING, INK = "#cc2222", "#e08a00", "#222222"
BAR = 0.62
"""Height of a bar, in rows."""
HATCH = {"fillmode": "overlay", "fgcolor": "white", "fgopacity": 1.0, "size": 7, "solidity": 0.35}


def gantt(plan: Schedule, events: Sequence[Event], arms: Sequence[str], unit_s: float) -> list[Trace]:
    """All traces; the row of an arm is its index, times are in units of `unit_s`."""
    return [*_work_bars(plan, events, arms, unit_s), *_outage_bars(plan, arms, unit_s), *_marks(events, arms, unit_s)]


def stream_of(job: str) -> str:
    """Stream of a job: its name without the part after the last dash."""
    return job.rpartition("-")[0] or job


def plain(text: str) -> str:
    """Text escaped for Plotly, which interprets some HTML."""
    return html.escape(text, quote=False)


def clock(time_s: float) -> str:
    """A time of the shift as h:mm:ss."""
    seconds = round(time_s)
    return f"{seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"


def _work_bars(plan: Schedule, events: Sequence[Event], arms: Sequence[str], unit_s: float) -> list[Trace]:
    # Streams of all jobs, done or not, so that a stream has the same colour in every policy's report.
    streams = sorted({stream_of(event.job) for event in events if event.job})
    traces = []
    for i, stream in enumerate(streams):
        own = [a for a in plan.assignments if stream_of(a.job) == stream]
        if not own:
            continue
        colour = STREAM_COLOURS[i % len(STREAM_COLOURS)]
        traces.append(
            _bars(
                plain(stream),
                [(arms.index(a.arm), a.start_s, a.end_s, _assignment_text(a)) for a in own],
                unit_s,
                color=colour,
                opacity=[1.0 if a.outcome == "finished" else 0.55 for a in own],
                line={
                    "color": [INK if a.late_s else "white" for a in own],
                    "width": [1.6 if a.late_s else 0.6 for a in own],
                },
                pattern=HATCH | {"shape": ["/" if a.outcome == "returned" else "" for a in own]},
            )
        )
    keys = (
        ("late", any(a.late_s for a in plan.assignments), {"color": "white", "line": {"color": INK, "width": 1.6}}),
        (
            "returned",
            any(a.outcome == "returned" for a in plan.assignments),
            {"color": "#888888", "pattern": HATCH | {"shape": "/"}},
        ),
        ("still running", any(a.outcome == "running" for a in plan.assignments), {"color": "#888888", "opacity": 0.55}),
    )
    return traces + [
        {
            "type": "bar",
            "orientation": "h",
            "name": name,
            "x": [None],
            "y": [None],
            "marker": marker,
            "legend": "legend",
        }
        for name, used, marker in keys
        if used
    ]


def _bars(name: str, spans: Sequence[tuple[int, float, float, str]], unit_s: float, **marker: object) -> Trace:
    """Horizontal bars from (row, start_s, end_s, hover text)."""
    return {
        "type": "bar",
        "orientation": "h",
        "name": name,
        "y": [row for row, *_ in spans],
        "base": [round(start / unit_s, 5) for _, start, _, _ in spans],
        "x": [round((end - start) / unit_s, 5) for _, start, end, _ in spans],
        "width": BAR,
        "marker": marker,
        "customdata": [text for *_, text in spans],
        "hovertemplate": "%{customdata}<extra></extra>",
        "legend": "legend",
    }


def _assignment_text(a: Assignment) -> str:
    """Hover text of one assignment."""
    if a.outcome == "finished":
        end = "on time" if not a.late_s else f"late by {clock(a.late_s)}"
        end = f"finished at {clock(a.finished_s or 0.0)}, {end}"
    elif a.outcome == "returned":
        kept = "" if a.cycles_kept is None else f", {a.cycles_kept} cycles kept"
        end = f"returned to the queue after a fault{kept}"
    else:
        end = "still running at the end"
    score = f"<br>difficulty {a.difficulty:.3g}" if np.isfinite(a.difficulty) else ""
    return f"<b>{plain(a.job)}</b> on {plain(a.arm)}<br>{clock(a.start_s)} – {clock(a.end_s)}<br>{end}{score}"


def _outage_bars(plan: Schedule, arms: Sequence[str], unit_s: float) -> list[Trace]:
    if not plan.outages:
        return []
    spans = []
    for o in plan.outages:
        end = "recovered" if o.recovered else "not recovered"
        text = f"<b>{plain(o.arm)} lost</b><br>{clock(o.start_s)} – {clock(o.end_s)}, {end}<br>{plain(o.reason)}"
        spans.append((arms.index(o.arm), o.start_s, o.end_s, text))
    return [_bars("out after a fault", spans, unit_s, color=FAULT, opacity=0.8, line={"width": 0})]


def _marks(events: Sequence[Event], arms: Sequence[str], unit_s: float) -> list[Trace]:
    """Faults and warnings, above the bars of their arm."""
    looks = (("fault", "x", FAULT), ("warning", "triangle-up", WARNING))
    traces = []
    for kind, symbol, colour in looks:
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
                    "customdata": [_event_text(e) for e in own],
                    "hovertemplate": "%{customdata}<extra></extra>",
                    "legend": "legend",
                }
            )
    return traces


def _event_text(e: Event) -> str:
    """Hover text of one event."""
    job = f"<br>{plain(e.job)}" if e.job else ""
    return f"<b>{e.kind}</b> of {plain(e.arm)} at {clock(e.time_s)}<br>{plain(e.reason)}{job}"
