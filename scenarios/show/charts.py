"""Plotly charts as plain dicts, in the look of our pages: colours, axes, lines, bands and limits.

Plain dicts in Plotly's schema, because Plotly's own objects take longer than a report.
"""

import base64
import html
from collections.abc import Mapping, Sequence
from typing import Any  # values of Plotly's schema

import numpy as np

from fleet.errors import visible
from fleet.robot import ThermalLimits

Array = np.ndarray
Trace = dict[str, Any]
Figure = Mapping[str, Any]
"""`data` and `layout` in Plotly's schema."""

INK, GRID, FRAME = "#222222", "#e6e6e6", "#bbbbbb"
FAULT, WARNING = "#cc2222", "#e08a00"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#a07800", "#7a5195", "#56b4e9", "#8a8a8a")
DASHES, SYMBOLS = ("solid", "dash", "dot", "longdash", "dashdot"), ("circle", "square", "diamond", "x")
"""Colours of lines (Okabe and Ito, who are for colour-blind readers, and two more), and dashes and symbols, which tell
similar colours apart."""
JOINT_LINES = (
    ("#4a6fd0", "longdashdot"),
    ("#cc6677", "solid"),
    ("#228a44", "dash"),
    ("#2f8fb5", "dot"),
    ("#b554a8", "longdash"),
    ("#8a8a2a", "1px,5px"),
    ("#2f9488", "dashdot"),
)
"""Colour and dash of each joint. Each colour has a contrast above 3 on light and dark pages; the dashes tell apart what
looks alike to people who see few colours."""

LAYOUT = {
    "template": "none",
    "font": {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 12, "color": INK},
    "paper_bgcolor": "white",
    "plot_bgcolor": "white",
    "hovermode": "closest",
    "hoverlabel": {"align": "left", "bgcolor": "white", "bordercolor": FRAME, "font": {"color": INK}},
}
"""Of every figure; a dark page changes its colours."""
AXIS = {"showgrid": True, "gridcolor": GRID, "zeroline": False, "linecolor": FRAME, "ticks": "outside"}
LEGEND_ABOVE = {"orientation": "h", "x": 0, "y": 1.02, "xanchor": "left", "yanchor": "bottom"}
MARGIN = {"l": 60, "r": 20, "t": 40, "b": 48}
WITH_LEGEND = LAYOUT | {"height": 428, "margin": MARGIN, "legend": LEGEND_ABOVE, "showlegend": True}
LIMITS_PX = 84
"""Right margin that the labels of limits need."""


def axis(title: str, **more: Any) -> Trace:
    """An axis with a title; `more` in Plotly's schema."""
    return AXIS | {"title": {"text": title}} | more


def named_rows(names: Sequence[str], **more: Any) -> Trace:
    """A y axis of rows with names, the first at the top; `more` in Plotly's schema."""
    ticks = {"tickvals": list(range(len(names))), "ticktext": list(names), "range": [len(names) - 0.5, -0.5]}
    return AXIS | ticks | {"automargin": True, "showgrid": False} | more


def shortened(text: str, most: int) -> str:
    """Text with its start and end if it has more than `most` characters."""
    return f"{text[: most - most // 2 - 1]}…{text[-(most // 2) :]}" if len(text) > most else text


def plain(text: str, most: int | None = None) -> str:
    """Text escaped for Plotly, which interprets some HTML and `%{…}`; with `most`, its start and end are kept."""
    shown = visible(text)
    if most is not None:
        shown = shortened(shown, most)
    return html.escape(shown, quote=False).replace("%{", "%&#123;")


def look_of(number: int) -> Trace:
    """Colour and dash of one of several lines."""
    return {"color": COLOURS[number % len(COLOURS)], "dash": DASHES[number % len(DASHES)], "width": 2}


def curve(name: str, x: Array, y: Array, line: Trace, *, most: int = 0, **more: Any) -> Trace:
    """A line through points [point]; NaN is a gap.

    Args:
        most: Points to draw, see `decimate`; 0 for all.
        more: In Plotly's schema.
    """
    kept = decimate(y, most) if most else slice(None)
    values = {"x": packed_numbers(x[kept]), "y": packed_numbers(y[kept])}
    return {"type": "scatter", "mode": "lines", "name": name, "line": line} | values | more


def band(x: Array, low: Array, high: Array, colour: str, **more: Any) -> Trace:
    """A shaded interval along x, each [point]; `more` in Plotly's schema."""
    around = {"x": packed_numbers(np.append(x, x[::-1])), "y": packed_numbers(np.append(high, low[::-1]))}
    look = {"fill": "toself", "fillcolor": colour, "opacity": 0.15, "line": {"width": 0}, "hoverinfo": "skip"}
    return {"type": "scatter", "mode": "lines"} | around | look | more


def limit_lines(limits: ThermalLimits, y: str = "y") -> tuple[list[Trace], list[Trace]]:
    """Lines of the limits over the whole width of a y axis, and their labels in the right margin."""
    lines, labels = list[Trace](), list[Trace]()
    for name, limit_c, colour, anchor, dash in (
        ("error", limits.error_c, FAULT, "bottom", "solid"),
        ("warning", limits.warning_c, WARNING, "top", "longdash"),
    ):
        at = {"yref": y, "y0": limit_c, "y1": limit_c, "xref": "paper", "x0": 0, "x1": 1}
        lines.append(at | {"type": "line", "line": {"color": colour, "width": 1, "dash": dash}})
        aside = {"x": 1, "xshift": 4, "xref": "paper", "xanchor": "left", "y": limit_c, "yref": y, "yanchor": anchor}
        look = {"yshift": -5 if anchor == "bottom" else 5, "font": {"size": 10}, "showarrow": False}
        labels.append({"text": f"{name} {limit_c:g} °C"} | aside | look)
    return lines, labels


def range_c(temp_c: Array, limits: ThermalLimits) -> list[float]:
    """Range of an axis with these temperatures (NaN of absent arms) and both limits, °C."""
    low_c = float(np.fmin.reduce(temp_c, axis=None, initial=limits.warning_c - 20.0))
    high_c = float(np.fmax.reduce(temp_c, axis=None, initial=limits.error_c))
    room_k = 0.06 * (high_c - low_c)
    return [low_c - room_k, high_c + room_k]


def decimate(value: Array, limit: int) -> Array:
    """Samples that keep the look of a long line: lowest and highest of each bin, and its gap if it has one.

    Args:
        value: [sample]; NaN is a gap.
        limit: Most samples to keep, at least 5.

    Returns:
        Indices in order, with the first, the last and both extremes among them, int [kept <= limit].
    """
    if limit < 5:
        raise ValueError(f"limit must be >= 5 (got {limit}).")
    if len(value) <= limit:
        return np.arange(len(value))
    gap = np.isnan(value)
    picks = [np.where(gap, np.inf, value), np.where(gap, np.inf, -value), *([~gap] if gap.any() else [])]
    edges = np.linspace(0, len(value), (limit - 2) // len(picks) + 1).astype(int)
    keep = [0, len(value) - 1]
    for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        keep += [low + int(pick[low:high].argmin()) for pick in picks]
    return np.unique(keep)


def packed_numbers(values: Array) -> dict[str, str]:
    """Numbers in Plotly's packed format, a third of the length of decimals."""
    raw = np.ascontiguousarray(values, dtype="<f4").tobytes()
    return {"dtype": "f4", "bdata": base64.b64encode(raw).decode("ascii")}
