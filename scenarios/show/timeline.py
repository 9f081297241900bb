"""Charts of shifts: work of each arm, motor temperatures, and the hottest motors of several shifts."""

import base64
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Any, TypeVar  # Any: values of Plotly's schema

import numpy as np

from fleet.env.render.heat import HEAT, heat_marks
from fleet.robot import JOINTS
from fleet.telemetry import Telemetry
from scenarios.run.records import JobSpan, Outage, ShiftLog
from scenarios.show import charts
from scenarios.show.charts import AXIS, FAULT, INK, WARNING, Trace, plain
from scenarios.show.page import Chart
from scenarios.show.words import clock, duration, event_text
from scenarios.spec.calendar import moment_text

Array = np.ndarray
Span = TypeVar("Span", JobSpan, Outage)

STREAM_COLOURS = ("#4477aa", "#ddaa33", "#228833", "#aa4499", "#66ccee", "#997755", "#999933", "#555566")
FAILURE, BREAK, UNKNOWN = "#444444", "#8a8a8a", "#9a9a9a"
OUTAGES = (("fault", "out after a fault", FAULT), ("failure", "failed, not by heat", FAILURE))
"""Kinds of outages that are no breaks, with their names and colours in legends."""
BAR = {"type": "bar", "orientation": "h"}
BAR_HEIGHT, BREAK_HEIGHT = 0.62, 0.24
"""In rows; a fault may last into a break."""
LATE = {"color": INK, "width": 1.6}
HATCH = {"fillmode": "overlay", "fgcolor": "white", "fgopacity": 1.0, "size": 7, "solidity": 0.35}
ARM_NAME, STREAM_NAME = 16, 30
"""Most characters of a name beside an axis and in a legend, which take their place from the figure."""
UNFINISHED = 0.55
"""Opacity of work that was returned or is still running."""
MARKS = (("fault", "x", FAULT), ("warning", "triangle-up", WARNING))

POINTS_PER_TRACE = 2000
POINTS_IN_ALL = 250_000
"""Browsers are slow above this; large fleets get fewer points per trace."""
FEWEST_POINTS = 200
MOST_LANES, HOTTEST = 16, 5
"""Fleets of more arms than `MOST_LANES` get a heat map, and lanes of their `HOTTEST` arms."""
HEAT_BINS = 1440
"""Columns of the heat map."""

MAP_ROW_PX = 8.0
BETWEEN_LANES_PX = 28.0
AROUND_PX = 100.0
"""Height of the axis of time and the legend; the page makes more where a legend has several lines."""
TEXT = {"xref": "paper", "xanchor": "left", "yanchor": "bottom", "showarrow": False, "font": {"size": 12}}
LAYOUT = charts.WITH_LEGEND | {"margin": charts.MARGIN | {"l": 90, "r": charts.LIMITS_PX, "b": 52}, "dragmode": "zoom"}


def shift_charts(log: ShiftLog) -> dict[str, Chart]:
    """Charts of a shift by heading; their axes show the same times."""
    arms, lanes = log.arms, _lanes(log.readings, len(log.arms))
    unit, unit_s = time_unit(log.plan.horizon_s)
    title = {"text": _time_title(log, unit), "standoff": 6}
    time = AXIS | {"range": [0, max(log.plan.horizon_s / unit_s, 1e-3)], "title": title}
    rows = charts.named_rows([plain(arm, ARM_NAME) for arm in arms], fixedrange=True)
    heat_map, which = {}, ""
    if len(lanes) < len(arms):
        every, which = -(-len(arms) // 50), " of the hottest arms"
        rows |= {"tickfont": {"size": 8}, **{name: rows[name][::every] for name in ("tickvals", "ticktext")}}
        heat_map = {"Hottest motor of each arm": _heat_map(log, time, rows, unit, unit_s)}
    figures = {
        "Work of each arm": _work(log, time, rows, unit_s),
        **heat_map,
        f"Motor temperatures{which}": _temperatures(log, lanes, time, unit, unit_s),
    }
    return {
        heading: Chart(key=f"chart-{number}", figure=figure, alt=f"{heading} over the shift")
        for number, (heading, figure) in enumerate(figures.items())
    }


def _work(log: ShiftLog, time: Trace, rows: Trace, unit_s: float) -> Trace:
    """The Gantt chart."""
    count = len(log.arms)
    height_px = max(90.0, count * (40.0 if count <= 8 else 26.0 if count <= MOST_LANES else 12.0))
    rows = rows | {"range": [count - 0.4, -0.65]}
    own = {"height": height_px + AROUND_PX, "barmode": "overlay", "xaxis": time, "yaxis": rows}
    return {"data": _gantt(log, unit_s), "layout": LAYOUT | own}


def hottest_motors(logs: Mapping[str, ShiftLog]) -> dict[str, Any]:
    """The hottest motor of the fleet over time in shifts with equal limits, by name: `data` and `layout`."""
    first = next(iter(logs.values()))
    unit, unit_s = time_unit(first.plan.horizon_s)
    traces, values = list[Trace](), list[Array]()
    for number, (name, log) in enumerate(logs.items()):
        temp_c = log.readings.temp_c.reshape(len(log.readings.time_s), -1)  # NaN of an absent arm
        motor = np.nan_to_num(temp_c, nan=-np.inf).argmax(axis=1)
        values.append(temp_c[np.arange(len(motor)), motor])
        kept = charts.decimate(values[-1], POINTS_PER_TRACE)
        texts = [plain(f"{log.arms[m // JOINTS]}, joint {m % JOINTS + 1}") for m in motor[kept].tolist()]
        hover = f"{plain(name)}: %{{y:.1f}} °C at %{{x:.1f}} {unit}<br>%{{customdata}}<extra></extra>"
        x, more = log.readings.time_s[kept] / unit_s, {"customdata": texts, "hovertemplate": hover}
        traces.append(charts.curve(plain(name, STREAM_NAME), x, values[-1][kept], charts.look_of(number), **more))
    shapes, labels = charts.limit_lines(first.limits)
    time = charts.axis(_time_title(first, unit), range=[0, first.plan.horizon_s / unit_s])
    temperature = charts.axis("hottest motor, °C", range=charts.range_c(np.concatenate(values), first.limits))
    margin = charts.MARGIN | {"r": charts.LIMITS_PX}
    own = {"margin": margin, "xaxis": time, "yaxis": temperature, "shapes": shapes, "annotations": labels}
    return {"data": traces, "layout": charts.WITH_LEGEND | own}


def _gantt(log: ShiftLog, unit_s: float) -> list[Trace]:
    """Work, outages and marks; the row of an arm is its index, times are in units of `unit_s`."""
    outages, arms = log.plan.outages, log.arms
    traces = _work_bars(log, unit_s)
    out = [(name, [each for each in outages if each.kind == kind], colour, "x") for kind, name, colour in OUTAGES]
    for name, spans, colour, shape in (*out, ("break", log.plan.breaks, BREAK, "\\")):
        if spans:
            look = {"color": colour, "opacity": 0.8, "line": {"width": 0}, "pattern": HATCH | {"shape": shape}}
            bars = _bars(name, spans, _outage_text, log, unit_s, look)
            traces.append(bars | ({"width": BREAK_HEIGHT} if name == "break" else {}))
    if not traces:  # without a trace Plotly draws no rows
        traces.append(_legend_entry("no job was begun", {}) | {"showlegend": True})
    for kind, symbol, colour in MARKS:  # above the bars of their arm
        marked = [e for e in log.events if e.kind == kind and e.arm in arms]
        if marked:
            look = {"symbol": symbol, "color": colour, "size": 9, "line": {"color": "white", "width": 1}}
            at = {
                "x": [round(e.time_s / unit_s, 5) for e in marked],
                "y": [arms.index(e.arm) - 0.42 for e in marked],
            }
            trace = {"type": "scatter", "mode": "markers", "name": kind, "marker": look}
            texts = [f"<b>{plain(e.arm)}</b> at {clock(e.time_s, log.begin)}<br>{plain(event_text(e))}" for e in marked]
            traces.append(trace | at | _hover(texts))
    return traces


def stream_of(job: str) -> str:
    """Stream of a job: its name without the part after the last dash."""
    return job.rpartition("-")[0] or job


def _groups(log: ShiftLog) -> dict[str, str]:
    """What the bar of each job is called and coloured by: its stream, or its kind if there are more streams than
    colours. Of all jobs, done or not, so that a stream has the same colour in every policy's report."""
    groups = {event.job: stream_of(event.job) for event in log.events if event.job}
    if len(set(groups.values())) <= len(STREAM_COLOURS):
        return groups
    kinds = {stream["name"]: stream["kind"] for stream in log.card.get("scenario", {}).get("jobs", ())}
    return {job: kinds.get(job, kinds.get(stream, "other jobs")) for job, stream in groups.items()}


def _work_bars(log: ShiftLog, unit_s: float) -> list[Trace]:
    """Bars of every group of jobs, then samples of the looks for the legend."""
    assignments, groups = log.plan.assignments, _groups(log)
    traces = []
    for i, group in enumerate(sorted(set(groups.values()))):
        # The legend shows the look of the first one: not that of a late or unfinished job.
        own = sorted(
            (a for a in assignments if groups[a.job] == group),
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
            # For people who see no colours and for dark pages, which show no dark outline.
            "pattern": HATCH | {"shape": ["/" if a.outcome == "returned" else "." if a.late_s else "" for a in own]},
        }
        traces.append(_bars(plain(group, STREAM_NAME), own, _assignment_text, log, unit_s, look))
    outcomes = {a.outcome for a in assignments}
    samples = (
        ("late", any(a.late_s for a in assignments), {"line": LATE, "pattern": HATCH | {"shape": "."}}),
        ("returned", "returned" in outcomes, {"pattern": HATCH | {"shape": "/"}}),
        ("still running", "running" in outcomes, {"opacity": UNFINISHED}),
    )
    return traces + [_legend_entry(name, look) for name, used, look in samples if used]


def _legend_entry(name: str, look: Trace) -> Trace:
    """A grey bar in the legend alone."""
    return BAR | {"name": name, "x": [None], "y": [None], "marker": {"color": "#888888"} | look}


def _bars(
    name: str,
    spans: Sequence[Span],
    text: Callable[[Span, datetime | None], str],
    log: ShiftLog,
    unit_s: float,
    look: Trace,
) -> Trace:
    """Horizontal bars of assignments or outages."""
    return BAR | {
        "name": name,
        "y": [log.arms.index(span.arm) for span in spans],
        "base": [round(span.start_s / unit_s, 5) for span in spans],
        "x": [round((span.end_s - span.start_s) / unit_s, 5) for span in spans],
        "width": BAR_HEIGHT,
        "marker": look,
        **_hover([text(span, log.begin) for span in spans]),
    }


def _hover(texts: list[str]) -> Trace:
    return {"customdata": texts, "hovertemplate": "%{customdata}<extra></extra>"}


def _assignment_text(a: JobSpan, begin: datetime | None) -> str:
    """Hover text of one assignment."""
    if a.outcome == "finished":
        end = "on time" if not a.late_s else f"late by {duration(a.late_s)}"
        end = f"finished at {clock(a.finished_s or 0.0, begin)}, {end}"
    elif a.outcome == "returned":
        kept = "" if a.cycles_kept is None else f", {a.cycles_kept} cycles kept"
        end = f"returned to the queue{' after a fault' if a.faulted else ''}{kept}"
    else:
        end = "still running at the end"
    scores = [a.prediction] if a.prediction else []
    scores += [f"difficulty {a.difficulty:.3g}"] if np.isfinite(a.difficulty) else []
    lines = [
        f"<b>{plain(a.job)}</b> on {plain(a.arm)}",
        f"{clock(a.start_s, begin)} – {clock(a.end_s, begin)}",
        end,
        *scores,
    ]
    return "<br>".join(lines)


def _outage_text(o: Outage, begin: datetime | None) -> str:
    """Hover text of one outage or break."""
    if o.kind == "break":
        return f"<b>{plain(o.arm)} has a break</b><br>{clock(o.start_s, begin)} – {clock(o.end_s, begin)}"
    end = "recovered" if o.recovered else "not recovered"
    return (
        f"<b>{plain(o.arm)} lost</b><br>{clock(o.start_s, begin)} – {clock(o.end_s, begin)}, {end}<br>{plain(o.reason)}"
    )


def _lanes(telemetry: Telemetry, arms: int) -> list[int]:
    """Indices of the arms with a lane of temperatures: all of a small fleet, the hottest of a large one."""
    if arms <= MOST_LANES:
        return list(range(arms))
    peak_c = np.fmax.reduce(telemetry.temp_c, axis=(0, 2), initial=-np.inf)
    return np.argsort(-peak_c, kind="stable")[:HOTTEST].tolist()


def _heat_map(log: ShiftLog, time: Trace, rows: Trace, unit: str, unit_s: float) -> Trace:
    """The hottest motor of each arm over time, one row per arm."""
    telemetry, arms, warning_c, error_c = log.readings, log.arms, log.limits.warning_c, log.limits.error_c
    samples = len(telemetry.time_s)
    edges = np.unique(np.linspace(0, samples, min(samples, HEAT_BINS) + 1).astype(int))[:-1]
    peak_c = np.zeros((len(arms), len(edges)))
    if samples:
        peak_c = np.fmax.reduce(np.fmax.reduceat(telemetry.temp_c, edges, axis=0), axis=2, initial=-np.inf).T
    unknown = np.isneginf(peak_c)
    marks = heat_marks(warning_c, error_c)
    low, high = float(marks[0]), float(marks[-1])
    zero, most = (1, round(2 * (high - low)) + 1) if unknown.any() else (0, round(2 * (high - low)))
    kelvin = np.where(unknown, 0, np.clip(np.round((peak_c - low) * 2) + zero, zero, 255)).astype(np.uint8)
    shares = (zero + 2 * (marks - low)) / most
    scale = [[0.0, UNKNOWN], [0.5 / most, UNKNOWN], [0.5 / most, HEAT[0]]] if zero else []
    names = [plain(arm) for arm in arms]
    heat = {
        "type": "heatmap",
        "z": {
            "dtype": "u1",
            "bdata": base64.b64encode(kelvin.tobytes()).decode(),
            "shape": f"{len(arms)},{len(edges)}",
        },
        "x": charts.packed_numbers(telemetry.time_s[edges] / unit_s),
        "y": list(range(len(arms))),
        "zmin": 0,
        "zmax": most,
        "colorscale": [*scale, *([float(share), colour] for share, colour in zip(shares, HEAT, strict=True))],
        "colorbar": {
            "title": {"text": "°C; grey: no reading" if zero else "°C"},
            "tickvals": [zero, zero + 2 * (warning_c - low), zero + 2 * (error_c - low)],
            "ticktext": [f"{low:g}", f"{warning_c:g}", f"{error_c:g}"],
            "thickness": 12,
            "lenmode": "pixels",
            "len": min(200, MAP_ROW_PX * len(arms)),
            "y": 1,
            "yanchor": "top",
        },
        "customdata": names,
        "hovertemplate": f"%{{y}}<br>%{{x:.2f}} {unit}<extra></extra>",
    }
    height_px = len(arms) * MAP_ROW_PX + AROUND_PX
    return {"data": [heat], "layout": LAYOUT | {"height": height_px, "xaxis": time, "yaxis": rows}}


def time_unit(horizon_s: float) -> tuple[str, float]:
    """Time unit of the axes and its length in s: minutes up to three hours, else hours."""
    return ("min", 60.0) if horizon_s <= 3 * 3600 else ("h", 3600.0)


def _time_title(log: ShiftLog, unit: str) -> str:
    """Title of an axis of time, which counts from the begin of the shift."""
    return f"time ({unit})" if log.begin is None else f"time since {moment_text(log.begin, '%a %d %b %H:%M')} ({unit})"


def _outages(outages: Sequence[Outage], arms: Sequence[str], unit_s: float) -> list[dict[str, Any]]:
    """Begins of outages as vertical lines and outages as shade in the lane of their arm, of faults in another colour
    than of failures; arms without a lane are left out."""
    shapes = []
    for o in outages:
        if o.arm not in arms:
            continue
        lane = {"xref": "x", "yref": f"y{arms.index(o.arm) + 1} domain", "y0": 0, "y1": 1}
        colour = FAULT if o.kind == "fault" else FAILURE
        start, end = round(o.start_s / unit_s, 5), round(o.end_s / unit_s, 5)
        shapes += [
            lane | {"type": "rect", "x0": start, "x1": end, "fillcolor": colour, "opacity": 0.10, "line": {"width": 0}},
            lane | {"type": "line", "x0": start, "x1": start, "line": {"color": colour, "width": 1.5}},
        ]
    return shapes


def _temperatures(log: ShiftLog, lanes: Sequence[int], time: Trace, unit: str, unit_s: float) -> Trace:
    """All motors of some arms, a lane for each arm."""
    telemetry, arms, count = log.readings, [log.arms[a] for a in lanes], len(lanes)
    lane_px = 120.0 if count <= 8 else 84.0
    total_px = count * (lane_px + BETWEEN_LANES_PX)
    points = int(np.clip(POINTS_IN_ALL // max(1, JOINTS * count), FEWEST_POINTS, POINTS_PER_TRACE))
    shown_c = charts.range_c(telemetry.temp_c, log.limits)
    layout, traces = LAYOUT | {"height": total_px + AROUND_PX, "xaxis": time | {"anchor": f"y{count}"}}, list[Trace]()
    layout |= {"shapes": _outages(log.plan.outages, arms, unit_s), "annotations": []}
    for lane, arm in enumerate(arms):
        bottom, y = 1.0 - (lane + 1) / count, f"y{lane + 1}"
        own = {"domain": [bottom, bottom + lane_px / total_px], **({"matches": "y"} if lane else {})}
        layout[f"yaxis{lane + 1 if lane else ''}"] = charts.axis("°C", range=shown_c, nticks=6, **own)
        lines, labels = charts.limit_lines(log.limits, y)
        layout["shapes"] += lines
        text = {"text": f"<b>{plain(arm, STREAM_NAME)}</b>", "x": 0, "y": own["domain"][1], "yref": "paper"}
        layout["annotations"] += [*labels, TEXT | text]
        for j, (colour, dash) in enumerate(charts.JOINT_LINES):
            value, name = telemetry.temp_c[:, lanes[lane], j], f"joint {j + 1}"
            hover = f"{plain(arm)} {name}<br>%{{y:.1f}} °C at %{{x:.2f}} {unit}<extra></extra>"
            line = {"color": colour, "width": 1.5, "dash": dash}
            place = {"legendgroup": name, "showlegend": lane == 0, "hovertemplate": hover, "yaxis": y}
            traces.append(charts.curve(name, telemetry.time_s / unit_s, value, line, most=points, **place))
    if count < len(log.arms):  # the page may show any other arm in the last lane: its traces, and its title
        layout["meta"] = {"lane_traces": list(range(len(traces) - JOINTS, len(traces))), "lane_title": 3 * count - 1}
    for kind, name, colour in OUTAGES:
        if any(each.kind == kind and each.arm in arms for each in log.plan.outages):
            look = {"symbol": "square", "size": 10, "color": colour, "opacity": 0.5}
            entry = {"type": "scatter", "mode": "markers", "name": name, "x": [None], "y": [None], "marker": look}
            traces.append(entry | {"showlegend": True})
    return {"data": traces, "layout": layout}
