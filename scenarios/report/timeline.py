"""Plotly figure of a shift: Gantt chart above, motor temperatures below.

The figure is a plain dict in Plotly's schema, because Plotly's own objects take longer than the rest of a report.
"""

import base64
from collections.abc import Sequence
from typing import Any  # values of Plotly's schema

import numpy as np

from fleet.events import Event
from fleet.robot import JOINTS
from fleet.telemetry import Telemetry
from scenarios.report.gantt import FAULT, INK, WARNING, Trace, gantt, plain
from scenarios.report.schedule import Schedule

Array = np.ndarray

POINTS_PER_TRACE = 2000
POINTS_IN_ALL = 250_000
"""Browsers are slow above this; large fleets get fewer points per trace."""
FEWEST_POINTS = 200

GRID, FRAME = "#e6e6e6", "#bbbbbb"
JOINT_COLOURS = ("#332288", "#cc6677", "#117733", "#88ccee", "#aa4499", "#999933", "#44aa99")

MARGIN = {"l": 90, "r": 84, "b": 52}
NARROW_PX = 860
"""Width of the plotting area on a small laptop; a legend wraps at this width."""
LEGEND_ROW_PX = 20.0
NAME_PX = 20.0
"""Height of the name of an arm above its lane."""
GAP_PX = 150.0
"""Height between the two blocks, for an axis, a title and a legend."""
BETWEEN_LANES_PX = 28.0

LAYOUT = {
    "template": "none",
    "modebar": {"orientation": "v"},
    "font": {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 12, "color": INK},
    "paper_bgcolor": "white",
    "plot_bgcolor": "white",
    "barmode": "overlay",
    "hovermode": "closest",
    "dragmode": "zoom",
    "hoverlabel": {"align": "left", "bgcolor": "white", "bordercolor": FRAME, "font": {"color": INK}},
}
AXIS = {"showgrid": True, "gridcolor": GRID, "zeroline": False, "linecolor": FRAME, "ticks": "outside"}
LEGEND = {
    "orientation": "h",
    "x": 0,
    "xanchor": "left",
    "yanchor": "bottom",
    "bgcolor": "rgba(255,255,255,0)",
    "tracegroupgap": 0,
}
TEXT = {"xref": "paper", "xanchor": "left", "showarrow": False}


def figure(
    plan: Schedule,
    telemetry: Telemetry,
    events: Sequence[Event],
    arms: Sequence[str],
    *,
    warning_c: float,
    error_c: float,
) -> dict[str, Any]:
    """The figure: `data` and `layout` in Plotly's schema.

    Args:
        telemetry: Temperatures [sample, arm, joint], arms in the order of `arms`; may be empty.
    """
    unit, unit_s = time_unit(plan.horizon_s)
    bars = gantt(plan, events, arms, unit_s)
    time = AXIS | {
        "range": [0, max(plan.horizon_s / unit_s, 1e-3)],
        "title": {"text": f"time ({unit})", "standoff": 6},
        "domain": [0, 1],
    }
    limits = (("error", error_c, FAULT, "bottom", "solid"), ("warning", warning_c, WARNING, "top", "dash"))
    layout = LAYOUT | _blocks(arms, _legend_height(bars))
    layout["xaxis"] = time | {"anchor": "y"}
    layout["xaxis2"] = time | {"anchor": f"y{len(arms) + 1}", "matches": "x"}
    temperature = AXIS | {
        "range": _temperature_range(telemetry.temp_c, warning_c, error_c),
        "title": {"text": "°C", "standoff": 8},
        "anchor": "x2",
        "nticks": 6,
    }
    for a in range(len(arms)):
        layout[f"yaxis{a + 2}"] = temperature | layout[f"yaxis{a + 2}"] | ({"matches": "y2"} if a else {})
        layout["annotations"] += [_limit_label(a, *limit[:4]) for limit in limits]
    layout["shapes"] = [
        *(
            {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "yref": f"y{a + 2}", "y0": limit, "y1": limit}
            | {"line": {"color": colour, "width": 1, "dash": dash}}
            for a in range(len(arms))
            for _, limit, colour, _, dash in reversed(limits)
        ),
        *_outages(plan, arms, unit_s),
    ]
    return {"data": [*bars, *_temperatures(telemetry, arms, unit, unit_s)], "layout": layout}


def time_unit(horizon_s: float) -> tuple[str, float]:
    """Time unit of the axes and its length in s: minutes up to three hours, else hours."""
    return ("min", 60.0) if horizon_s <= 3 * 3600 else ("h", 3600.0)


def _blocks(arms: Sequence[str], legend_px: float) -> dict[str, Any]:
    """Heights, titles and legends of the Gantt chart and of a lane of temperatures for each arm."""
    gantt_px = max(90.0, len(arms) * (40.0 if len(arms) <= 8 else 26.0))
    lane_px = 120.0 if len(arms) <= 8 else 84.0
    tops = [gantt_px + GAP_PX + a * (lane_px + BETWEEN_LANES_PX) for a in range(len(arms))]
    total_px = tops[-1] + lane_px

    def paper(from_top_px: float) -> float:
        """Plotly's coordinate: 1 at the top, 0 at the bottom."""
        return 1.0 - from_top_px / total_px

    def title(text: str, from_top_px: float, size: int = 15) -> dict[str, Any]:
        place = {"x": 0, "y": paper(from_top_px), "yref": "paper", "yanchor": "bottom"}
        return TEXT | place | {"text": f"<b>{text}</b>", "font": {"size": size}}

    rows = {
        "domain": [paper(gantt_px), 1.0],
        "range": [len(arms) - 0.4, -0.65],
        "tickvals": list(range(len(arms))),
        "ticktext": [plain(arm) for arm in arms],
        "showgrid": False,
        "fixedrange": True,
        "automargin": True,
    }
    return {
        "height": round(total_px + legend_px + 44.0 + MARGIN["b"]),
        "margin": MARGIN | {"t": round(legend_px + 44.0)},
        "yaxis": AXIS | rows,
        **{f"yaxis{a + 2}": {"domain": [max(0.0, paper(y + lane_px)), paper(y)]} for a, y in enumerate(tops)},
        "legend": LEGEND | {"y": paper(-6.0), "itemclick": "toggle"},
        "legend2": LEGEND | {"y": paper(tops[0] - NAME_PX - 6.0), "itemdoubleclick": "toggleothers"},
        "annotations": [
            title("Work of each arm", -legend_px - 14.0),
            title("Motor temperatures", tops[0] - NAME_PX - 34.0),
            *(title(plain(arm), y - 2.0, size=12) for arm, y in zip(arms, tops, strict=True)),
        ],
    }


def _legend_height(bars: Sequence[Trace]) -> float:
    """Height of the legend of the work, px; on a narrow page it has several lines, with columns of equal width."""
    wide = [45.0 + 6.5 * len(trace["name"]) for trace in bars]
    if sum(wide) <= NARROW_PX:
        return LEGEND_ROW_PX
    per_row = max(1, int(NARROW_PX // max(wide)))
    return LEGEND_ROW_PX * -(-len(wide) // per_row)


def _temperature_range(temp_c: Array, warning_c: float, error_c: float) -> list[float]:
    finite = temp_c[np.isfinite(temp_c)]
    low, high = float(finite.min(initial=warning_c - 20.0)), float(finite.max(initial=error_c))
    room = 0.06 * (high - low)
    return [low - room, high + room]


def _limit_label(arm: int, name: str, limit: float, colour: str, anchor: str) -> dict[str, Any]:
    """Name of a limit at the right of an arm's lane."""
    return TEXT | {
        "text": f"{name} {limit:g} °C",
        "x": 1,
        "xshift": 4,
        "y": limit,
        "yref": f"y{arm + 2}",
        "yanchor": anchor,
        "yshift": -5 if anchor == "bottom" else 5,
        "font": {"size": 10, "color": colour},
    }


def _outages(plan: Schedule, arms: Sequence[str], unit_s: float) -> list[dict[str, Any]]:
    """Faults as vertical lines and outages as shade in the lane of their arm."""
    shapes = []
    for o in plan.outages:
        lane = {"xref": "x2", "yref": f"y{arms.index(o.arm) + 2} domain", "y0": 0, "y1": 1}
        start, end = round(o.start_s / unit_s, 5), round(o.end_s / unit_s, 5)
        shapes += [
            lane | {"type": "rect", "x0": start, "x1": end, "fillcolor": FAULT, "opacity": 0.10, "line": {"width": 0}},
            lane | {"type": "line", "x0": start, "x1": start, "line": {"color": FAULT, "width": 1.5}},
        ]
    return shapes


def _temperatures(telemetry: Telemetry, arms: Sequence[str], unit: str, unit_s: float) -> list[Trace]:
    points = int(np.clip(POINTS_IN_ALL // max(1, JOINTS * len(arms)), FEWEST_POINTS, POINTS_PER_TRACE))
    traces = []
    for a, arm in enumerate(arms):
        for j, colour in enumerate(JOINT_COLOURS):
            value, name = telemetry.temp_c[:, a, j], f"joint {j + 1}"
            kept = decimate(value, points)
            traces.append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "name": name,
                    "legendgroup": name,
                    "legend": "legend2",
                    "showlegend": a == 0,
                    "x": _packed(telemetry.time_s[kept] / unit_s),
                    "y": _packed(value[kept]),
                    "xaxis": "x2",
                    "yaxis": f"y{a + 2}",
                    "line": {"color": colour, "width": 1.3},
                    "hovertemplate": f"{plain(arm)} {name}<br>%{{y:.1f}} °C at %{{x:.2f}} {unit}<extra></extra>",
                }
            )
    return traces


def decimate(value: Array, limit: int) -> Array:
    """Samples that keep the look of a long line: lowest and highest of each bin.

    Args:
        value: [sample].
        limit: Most samples to keep, at least 4.

    Returns:
        Indices in order, with the first, the last and both extremes among them, int [kept <= limit].
    """
    if limit < 4:
        raise ValueError(f"limit must be >= 4 (got {limit}).")
    if len(value) <= limit:
        return np.arange(len(value))
    edges = np.linspace(0, len(value), (limit - 2) // 2 + 1).astype(int)
    keep = [0, len(value) - 1]
    for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        piece = value[low:high]
        keep += [low + int(piece.argmin()), low + int(piece.argmax())]
    return np.unique(keep)


def _packed(values: Array) -> dict[str, str]:
    """Numbers in Plotly's packed format, a third of the length of decimals."""
    raw = np.ascontiguousarray(values, dtype="<f4").tobytes()
    return {"dtype": "f4", "bdata": base64.b64encode(raw).decode("ascii")}
