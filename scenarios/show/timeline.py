"""Figures of shifts: Gantt chart above and motor temperatures below, or the hottest motors of several shifts."""

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
from scenarios.show.charts import AXIS, FAULT, INK, LAYOUT, WARNING, Trace, plain
from scenarios.show.words import clock, duration, event_text

Array = np.ndarray
Span = TypeVar("Span", JobSpan, Outage)

STREAM_COLOURS = ("#4477aa", "#ddaa33", "#228833", "#aa4499", "#66ccee", "#997755", "#999933", "#555566")
FAILURE, BREAK = "#444444", "#8a8a8a"
BAR = {"type": "bar", "orientation": "h", "legend": "legend"}
BAR_HEIGHT, BREAK_HEIGHT = 0.62, 0.24
"""In rows; an arm may work in a break."""
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

MARGIN = {"l": 90, "r": charts.LIMITS_PX, "b": 52}
TOP_PX = 64.0
"""Room for the upper legend on one line; the page makes more where it has several."""
NAME_PX = 20.0
"""Height of the name of an arm above its lane."""
MAP_GAP_PX, MAP_ROW_PX = 90.0, 8.0
GAP_PX = 172.0
"""Height between the two blocks, for an axis, a title and a legend."""
BETWEEN_LANES_PX = 28.0

SHIFT_LAYOUT = LAYOUT | {"modebar": {"orientation": "v"}, "barmode": "overlay", "dragmode": "zoom"}
LEGEND = {
    "orientation": "h",
    "x": 0,
    "xanchor": "left",
    "yanchor": "bottom",
    "bgcolor": "rgba(255,255,255,0)",
    "tracegroupgap": 0,
}
TEXT = {"xref": "paper", "xanchor": "left", "showarrow": False}


def figure(log: ShiftLog) -> dict[str, Any]:
    """The figure: `data` and `layout` in Plotly's schema."""
    plan, telemetry, arms = log.plan, log.readings, log.arms
    unit, unit_s = time_unit(plan.horizon_s)
    bars = _gantt(log, unit_s)
    lanes = _lanes(telemetry, len(arms))
    overview = len(lanes) < len(arms)
    time = AXIS | {
        "range": [0, max(plan.horizon_s / unit_s, 1e-3)],
        "title": {"text": _time_title(log, unit), "standoff": 6},
        "domain": [0, 1],
    }
    layout = SHIFT_LAYOUT | _blocks(arms, lanes)
    layout["xaxis"] = time | {"anchor": "y"}
    layout["xaxis2"] = time | {"anchor": f"y{len(lanes) + 1}", "matches": "x"}
    shown_c = charts.range_c(telemetry.temp_c, log.limits)
    temperature = charts.axis("°C", range=shown_c, anchor="x2", nticks=6)
    layout["shapes"] = []
    for lane in range(len(lanes)):
        key = f"yaxis{lane + 2}"
        layout[key] = temperature | layout[key] | ({"matches": "y2"} if lane else {})
        shapes, labels = charts.limit_lines(log.limits, f"y{lane + 2}")
        layout["shapes"] += shapes
        layout["annotations"] += labels
    layout["shapes"] += _outages(plan.outages, [arms[a] for a in lanes], unit_s)
    data = [*bars, *_temperatures(telemetry, arms, lanes, unit, unit_s)]
    if overview:
        number = len(lanes) + 2
        layout["xaxis3"] = time | {"anchor": f"y{number}", "matches": "x"}
        # The page may show any other arm in the last lane.
        title = len(lanes)  # annotations: the title of the heat map, then those of the lanes
        layout["meta"] = {"lane_traces": list(range(len(data) - JOINTS, len(data))), "lane_title": title}
        heat = _heat_map(log, number, unit, unit_s)
        data.append(heat | {"colorbar": heat["colorbar"] | {"y": layout[f"yaxis{number}"]["domain"][1]}})
    return {"data": data, "layout": layout}


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
    for name, spans, colour, shape in (
        ("out after a fault", [each for each in outages if each.kind == "fault"], FAULT, "x"),
        ("failed, not by heat", [each for each in outages if each.kind == "failure"], FAILURE, "x"),
        ("break", log.plan.breaks, BREAK, "\\"),
    ):
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
            trace = {"type": "scatter", "mode": "markers", "name": kind, "marker": look, "legend": "legend"}
            traces.append(
                trace
                | at
                | _hover(
                    [f"<b>{plain(e.arm)}</b> at {clock(e.time_s, log.begin)}<br>{plain(event_text(e))}" for e in marked]
                )
            )
    return traces


def stream_of(job: str) -> str:
    """Stream of a job: its name without the part after the last dash."""
    return job.rpartition("-")[0] or job


def _work_bars(log: ShiftLog, unit_s: float) -> list[Trace]:
    """Bars of every stream, then samples of the looks for the legend."""
    assignments = log.plan.assignments
    # Streams of all jobs, done or not, so that a stream has the same colour in every policy's report.
    streams = sorted({stream_of(event.job) for event in log.events if event.job})
    traces = []
    for i, stream in enumerate(streams):
        # The legend shows the look of the first one: not that of a late or unfinished job.
        own = sorted(
            (a for a in assignments if stream_of(a.job) == stream),
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
        traces.append(_bars(plain(stream, STREAM_NAME), own, _assignment_text, log, unit_s, look))
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


def _heat_map(log: ShiftLog, lane: int, unit: str, unit_s: float) -> Trace:
    """The hottest motor of each arm over time, one row per arm; y axis `lane`, x axis 3."""
    telemetry, arms, warning_c, error_c = log.readings, log.arms, log.limits.warning_c, log.limits.error_c
    samples = len(telemetry.time_s)
    edges = np.unique(np.linspace(0, samples, min(samples, HEAT_BINS) + 1).astype(int))[:-1]
    peak_c = np.zeros((len(arms), len(edges)))
    if samples:
        peak_c = np.fmax.reduce(np.fmax.reduceat(telemetry.temp_c, edges, axis=0), axis=2, initial=-np.inf).T
    marks = heat_marks(warning_c, error_c)
    low, high = float(marks[0]), float(marks[-1])
    kelvin = np.clip(np.round((peak_c - low) * 2), 0, 255).astype(np.uint8)
    shares = (marks - low) / (high - low)
    names = [plain(arm) for arm in arms]
    return {
        "type": "heatmap",
        "z": {
            "dtype": "u1",
            "bdata": base64.b64encode(kelvin.tobytes()).decode(),
            "shape": f"{len(arms)},{len(edges)}",
        },
        "x": charts.packed_numbers(telemetry.time_s[edges] / unit_s),
        "y": list(range(len(arms))),
        "xaxis": "x3",
        "yaxis": f"y{lane}",
        "zmin": 0,
        "zmax": 2 * (high - low),
        "colorscale": [[float(share), colour] for share, colour in zip(shares, HEAT, strict=True)],
        "colorbar": {
            "title": {"text": "°C"},
            "tickvals": [0, 2 * (warning_c - low), 2 * (error_c - low)],
            "ticktext": [f"{low:g}", f"{warning_c:g}", f"{error_c:g}"],
            "thickness": 12,
            "lenmode": "pixels",
            "len": min(200, MAP_ROW_PX * len(arms)),
            "yanchor": "top",
        },
        "customdata": names,
        "hovertemplate": f"%{{y}}<br>%{{x:.2f}} {unit}<extra></extra>",
        "showlegend": False,
    }


def time_unit(horizon_s: float) -> tuple[str, float]:
    """Time unit of the axes and its length in s: minutes up to three hours, else hours."""
    return ("min", 60.0) if horizon_s <= 3 * 3600 else ("h", 3600.0)


def _time_title(log: ShiftLog, unit: str) -> str:
    """Title of an axis of time, which counts from the begin of the shift."""
    return f"time ({unit})" if log.begin is None else f"time since {log.begin:%a %d %b %H:%M} ({unit})"


def _blocks(arms: Sequence[str], lanes: Sequence[int]) -> dict[str, Any]:
    """Heights, titles and legends of the Gantt chart, of the heat map of a large fleet, and of the lanes."""
    overview = len(lanes) < len(arms)
    gantt_px = max(90.0, len(arms) * (40.0 if len(arms) <= 8 else 26.0 if not overview else 12.0))
    lane_px = 120.0 if len(lanes) <= 8 else 84.0
    heat_maps = [(MAP_GAP_PX, len(arms) * MAP_ROW_PX)] * overview
    gaps_px, heights_px = np.array(
        [(0.0, gantt_px), *heat_maps, (GAP_PX, lane_px), *[(BETWEEN_LANES_PX, lane_px)] * (len(lanes) - 1)]
    ).T
    ends_px = np.cumsum(gaps_px + heights_px)
    total_px = float(ends_px[-1])
    tops = (1.0 - (ends_px - heights_px) / total_px).tolist()  # in Plotly's coordinate: 1 at the top, 0 at the bottom
    domains = [[max(0.0, end), top] for end, top in zip((1.0 - ends_px / total_px).tolist(), tops, strict=True)]
    first = 1 + overview

    def title(text: str, top: float, above_px: float, size: int = 15) -> dict[str, Any]:
        place = {"x": 0, "y": top + above_px / total_px, "yref": "paper", "yanchor": "bottom"}
        return TEXT | place | {"text": f"<b>{text}</b>", "font": {"size": size}}

    names = [plain(arm, ARM_NAME) for arm in arms]
    rows = charts.named_rows(names, domain=domains[0], range=[len(arms) - 0.4, -0.65], fixedrange=True)
    heat: Trace = {}
    if overview:
        rows["tickfont"] = {"size": 8}
        every = -(-len(arms) // 50)
        marks = {name: rows[name][::every] for name in ("tickvals", "ticktext")}
        place = {"domain": domains[1], "anchor": "x3", "range": [len(arms) - 0.5, -0.5]}
        heat = {f"yaxis{len(lanes) + 2}": rows | place | marks}
    temperatures = _heading(f"Motor temperatures{' of the hottest arms' if overview else ''}")
    above = tops[first] + (NAME_PX + 6.0) / total_px
    return {
        "height": round(total_px + TOP_PX + MARGIN["b"]),
        "margin": MARGIN | {"t": TOP_PX},
        "yaxis": rows,
        **heat,
        **{f"yaxis{lane + 2}": {"domain": domain} for lane, domain in enumerate(domains[first:])},
        "legend": LEGEND | {"y": 1.0 + 6.0 / total_px, "itemclick": "toggle", "title": _heading("Work of each arm")},
        "legend2": LEGEND | {"y": above, "itemdoubleclick": "toggleothers", "title": temperatures},
        "annotations": [
            *([title("Hottest motor of each arm", tops[1], 8.0)] if overview else []),
            *(title(plain(arms[a], STREAM_NAME), top, 2.0, 12) for a, top in zip(lanes, tops[first:], strict=True)),
        ],
    }


def _heading(text: str) -> dict[str, Any]:
    """Title of a legend, above its entries; so the two cannot overlap."""
    return {"text": f"<b>{text}</b>", "side": "top", "font": {"size": 15}}


def _outages(outages: Sequence[Outage], arms: Sequence[str], unit_s: float) -> list[dict[str, Any]]:
    """Faults as vertical lines and outages as shade in the lane of their arm; arms without a lane are left out."""
    shapes = []
    for o in outages:
        if o.arm not in arms:
            continue
        lane = {"xref": "x2", "yref": f"y{arms.index(o.arm) + 2} domain", "y0": 0, "y1": 1}
        start, end = round(o.start_s / unit_s, 5), round(o.end_s / unit_s, 5)
        shapes += [
            lane | {"type": "rect", "x0": start, "x1": end, "fillcolor": FAULT, "opacity": 0.10, "line": {"width": 0}},
            lane | {"type": "line", "x0": start, "x1": start, "line": {"color": FAULT, "width": 1.5}},
        ]
    return shapes


def _temperatures(
    telemetry: Telemetry, arms: Sequence[str], lanes: Sequence[int], unit: str, unit_s: float
) -> list[Trace]:
    points = int(np.clip(POINTS_IN_ALL // max(1, JOINTS * len(lanes)), FEWEST_POINTS, POINTS_PER_TRACE))
    traces = []
    for lane, a in enumerate(lanes):
        arm = arms[a]
        for j, (colour, dash) in enumerate(charts.JOINT_LINES):
            value, name = telemetry.temp_c[:, a, j], f"joint {j + 1}"
            hover = f"{plain(arm)} {name}<br>%{{y:.1f}} °C at %{{x:.2f}} {unit}<extra></extra>"
            line = {"color": colour, "width": 1.5, "dash": dash}
            place = {"legendgroup": name, "legend": "legend2", "showlegend": lane == 0, "hovertemplate": hover}
            place |= {"xaxis": "x2", "yaxis": f"y{lane + 2}"}
            traces.append(charts.curve(name, telemetry.time_s / unit_s, value, line, most=points, **place))
    return traces
