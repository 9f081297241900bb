"""Plotly figure of a shift: Gantt chart above, motor temperatures below.

The figure is a plain dict in Plotly's schema, because Plotly's own objects take longer than the rest of a report.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any  # values of Plotly's schema

import numpy as np

from fleet.events import Event
from fleet.robot import JOINTS
from fleet.schedule import Schedule
from fleet.telemetry import Telemetry
from scenarios.report.gantt import FAULT, INK, WARNING, Trace, gantt, plain

Array = np.ndarray

POINTS_PER_TRACE = 2000
POINTS_IN_ALL = 250_000
"""Browsers are slow above this; large fleets get fewer points per trace."""
FEWEST_POINTS = 200

FAINT = "#e6e6e6"
JOINT_COLOURS = ("#332288", "#cc6677", "#117733", "#88ccee", "#aa4499", "#999933", "#44aa99")

MARGIN = {"l": 90, "r": 84, "b": 52}
NARROW_PX = 860
"""Width of the plotting area on a small laptop; a legend wraps at this width."""
LEGEND_ROW_PX = 20.0
NAME = 20.0
"""Height of the name of an arm above its lane, px."""


@dataclass(frozen=True)
class _Rows:
    """Vertical layout in pixels from the top of the plotting area."""

    arms: int

    @property
    def gantt(self) -> float:
        return max(90.0, self.arms * (40.0 if self.arms <= 8 else 26.0))

    @property
    def gap(self) -> float:
        """Height between the two blocks, for an axis, a title and a legend."""
        return 150.0

    @property
    def lane(self) -> float:
        return 120.0 if self.arms <= 8 else 84.0

    @property
    def between(self) -> float:
        return 28.0

    @property
    def total(self) -> float:
        return self.gantt + self.gap + self.arms * self.lane + (self.arms - 1) * self.between

    def lane_top(self, a: int) -> float:
        return self.gantt + self.gap + a * (self.lane + self.between)

    def share(self, from_top_px: float) -> float:
        """Paper coordinate: 1 at the top, 0 at the bottom."""
        return 1.0 - from_top_px / self.total

    def domain(self, top: float, height: float) -> list[float]:
        return [max(0.0, self.share(top + height)), self.share(top)]


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
    rows = _Rows(len(arms))
    data = [
        *gantt(plan, events, arms, unit_s),
        *_temperatures(telemetry, arms, unit, unit_s),
    ]
    return {
        "data": data,
        "layout": _layout(
            plan, telemetry, arms, rows, _legend_height(data), unit, unit_s, warning_c=warning_c, error_c=error_c
        ),
    }


def time_unit(horizon_s: float) -> tuple[str, float]:
    """Time unit of the axes and its length in s: minutes up to three hours, else hours."""
    return ("min", 60.0) if horizon_s <= 3 * 3600 else ("h", 3600.0)


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


def _temperatures(telemetry: Telemetry, arms: Sequence[str], unit: str, unit_s: float) -> list[Trace]:
    points = int(np.clip(POINTS_IN_ALL // max(1, JOINTS * len(arms)), FEWEST_POINTS, POINTS_PER_TRACE))
    traces = []
    for a, arm in enumerate(arms):
        for j in range(JOINTS):
            value = telemetry.temp_c[:, a, j]
            kept = decimate(value, points)
            traces.append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "name": f"joint {j + 1}",
                    "legendgroup": f"joint {j + 1}",
                    "legend": "legend2",
                    "showlegend": a == 0,
                    "x": _packed(telemetry.time_s[kept] / unit_s),
                    "y": _packed(value[kept]),
                    "xaxis": "x2",
                    "yaxis": f"y{a + 2}",
                    "line": {"color": JOINT_COLOURS[j], "width": 1.3},
                    "hovertemplate": (
                        f"{plain(arm)} joint {j + 1}<br>%{{y:.1f}} °C at %{{x:.2f}} {unit}<extra></extra>"
                    ),
                }
            )
    return traces


def _layout(
    plan: Schedule,
    telemetry: Telemetry,
    arms: Sequence[str],
    rows: _Rows,
    legend_px: float,
    unit: str,
    unit_s: float,
    *,
    warning_c: float,
    error_c: float,
) -> dict[str, Any]:
    end = max(plan.horizon_s / unit_s, 1e-3)
    axis = {"showgrid": True, "gridcolor": FAINT, "zeroline": False, "linecolor": "#bbbbbb", "ticks": "outside"}
    time = axis | {"range": [0, end], "title": {"text": f"time ({unit})", "standoff": 6}, "domain": [0, 1]}
    known = telemetry.temp_c[np.isfinite(telemetry.temp_c)]
    low = float(known.min(initial=warning_c - 20.0))
    high = float(known.max(initial=error_c))
    room = 0.06 * (high - low)
    lanes = {
        f"yaxis{a + 2}": axis
        | {
            "domain": rows.domain(rows.lane_top(a), rows.lane),
            "anchor": "x2",
            "range": [low - room, high + room],
            "title": {"text": "°C", "standoff": 8},
            "nticks": 6,
            **({"matches": "y2"} if a else {}),
        }
        for a in range(len(arms))
    }
    return {
        "template": "none",
        "height": round(rows.total + legend_px + 44.0 + MARGIN["b"]),
        "margin": MARGIN | {"t": round(legend_px + 44.0)},
        "modebar": {"orientation": "v"},
        "font": {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 12, "color": INK},
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "barmode": "overlay",
        "hovermode": "closest",
        "dragmode": "zoom",
        "hoverlabel": {"align": "left", "bgcolor": "white", "bordercolor": "#bbbbbb", "font": {"color": INK}},
        "xaxis": time | {"anchor": "y"},
        "xaxis2": time | {"anchor": f"y{len(arms) + 1}", "matches": "x"},
        "yaxis": axis
        | {
            "domain": rows.domain(0.0, rows.gantt),
            "range": [len(arms) - 0.4, -0.65],
            "tickvals": list(range(len(arms))),
            "ticktext": [plain(arm) for arm in arms],
            "showgrid": False,
            "fixedrange": True,
            "automargin": True,
        },
        **lanes,
        "legend": _legend(rows.share(0.0), rows) | {"itemclick": "toggle"},
        "legend2": _legend(rows.share(rows.lane_top(0) - NAME), rows) | {"itemdoubleclick": "toggleothers"},
        "annotations": [
            _title("Work of each arm", rows.share(-legend_px - 14.0)),
            _title("Motor temperatures", rows.share(rows.lane_top(0) - NAME - 34.0)),
            *(_title(plain(arm), rows.share(rows.lane_top(a) - 2.0), size=12) for a, arm in enumerate(arms)),
            *_limit_labels(len(arms), warning_c, error_c),
        ],
        "shapes": _shapes(plan, arms, unit_s, warning_c, error_c),
    }


def _legend_height(data: Sequence[Trace]) -> float:
    """Height of the legend of the work, px; on a narrow page it has several lines, with columns of equal width."""
    wide = [45.0 + 6.5 * len(trace["name"]) for trace in data if trace["legend"] == "legend"]
    if sum(wide) <= NARROW_PX:
        return LEGEND_ROW_PX
    per_row = max(1, int(NARROW_PX // max(wide)))
    return LEGEND_ROW_PX * -(-len(wide) // per_row)


def _legend(top: float, rows: _Rows) -> dict[str, Any]:
    """One line above the block that begins at `top`."""
    return {
        "orientation": "h",
        "x": 0,
        "xanchor": "left",
        "y": top + 6.0 / rows.total,
        "yanchor": "bottom",
        "bgcolor": "rgba(255,255,255,0)",
        "tracegroupgap": 0,
    }


def _title(text: str, y: float, *, size: int = 15) -> dict[str, Any]:
    return {
        "text": f"<b>{text}</b>",
        "x": 0,
        "xref": "paper",
        "xanchor": "left",
        "y": y,
        "yref": "paper",
        "yanchor": "bottom",
        "showarrow": False,
        "font": {"size": size},
    }


def _limit_labels(arms: int, warning_c: float, error_c: float) -> list[dict[str, Any]]:
    labels = (("error", error_c, FAULT, "bottom"), ("warning", warning_c, WARNING, "top"))
    return [
        {
            "text": f"{word} {limit:g} °C",
            "x": 1,
            "xref": "paper",
            "xanchor": "left",
            "xshift": 4,
            "y": limit,
            "yref": f"y{a + 2}",
            "yanchor": anchor,
            "yshift": -5 if anchor == "bottom" else 5,
            "showarrow": False,
            "font": {"size": 10, "color": colour},
        }
        for a in range(arms)
        for word, limit, colour, anchor in labels
    ]


def _shapes(
    plan: Schedule, arms: Sequence[str], unit_s: float, warning_c: float, error_c: float
) -> list[dict[str, Any]]:
    """Limits as lines across the lanes, faults as vertical lines and outages as shade in the lane of their arm."""
    limits = [
        {
            "type": "line",
            "xref": "paper",
            "x0": 0,
            "x1": 1,
            "yref": f"y{a + 2}",
            "y0": limit,
            "y1": limit,
            "line": {"color": colour, "width": 1, "dash": dash},
        }
        for a in range(len(arms))
        for limit, colour, dash in ((warning_c, WARNING, "dash"), (error_c, FAULT, "solid"))
    ]
    outages = []
    for o in plan.outages:
        lane = {"xref": "x2", "yref": f"y{arms.index(o.arm) + 2} domain", "y0": 0, "y1": 1}
        start, end = round(o.start_s / unit_s, 5), round(o.end_s / unit_s, 5)
        outages += [
            lane | {"type": "rect", "x0": start, "x1": end, "fillcolor": FAULT, "opacity": 0.10, "line": {"width": 0}},
            lane | {"type": "line", "x0": start, "x1": start, "line": {"color": FAULT, "width": 1.5}},
        ]
    return limits + outages
