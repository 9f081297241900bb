"""How the pictures of a twin report look: colours that mean the same in each of them, and a PNG of a figure."""

import io
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

NORMAL, CRITICAL, BETWEEN = "#0072B2", "#D55E00", "#8A8A8A"
"""Stays cool, passes the warning limit, neither. Blue and vermilion of Okabe & Ito, told apart by every eye."""
INK, FAINT = "#222222", "#dddddd"
ACCENT, SECOND, THIRD = "#009E73", "#CC79A7", "#E69F00"
"""For what is neither normal nor critical: methods, channels, seeds."""
CHANNEL_NAMES = ("position", "velocity", "torque")
CHANNEL_LABELS = ("q (rad)", "dq/dt (rad/s)", "τ (N·m)")
DPI = 110
BASE_PT = 10.5


def sheet(
    rows: int = 1,
    columns: int = 1,
    *,
    width: float = 9.0,
    height: float = 4.0,
    title: str = "",
    sharex: bool | str = False,
    sharey: bool | str = False,
    widths: Sequence[float] | None = None,
) -> tuple[Figure, list[list[Axes]]]:
    """A figure of `width` × `height` inches and its axes [row][column]; the title says what is to be seen."""
    figure = Figure(figsize=(width, height), layout="constrained", dpi=DPI)
    FigureCanvasAgg(figure)
    share = {"sharex": sharex, "sharey": sharey, "width_ratios": widths}
    grid = figure.subplots(rows, columns, squeeze=False, **share)  # pyright: ignore[reportArgumentType]
    for axes in grid.ravel():
        plain(axes)
    if title:
        figure.suptitle(title, fontsize=BASE_PT + 2, fontweight="bold", color=INK, x=0.01, ha="left")
    return figure, [list(row) for row in grid]


def plain(axes: Axes) -> None:
    """Nothing drawn that says nothing."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#999999")
    axes.tick_params(labelsize=BASE_PT - 1, colors=INK)
    axes.grid(True, color=FAINT, linewidth=0.6)
    axes.set_axisbelow(True)


def named(axes: Axes, *, x: str = "", y: str = "", title: str = "") -> None:
    """Labels with units, and a title at the left."""
    if x:
        axes.set_xlabel(x, fontsize=BASE_PT)
    if y:
        axes.set_ylabel(y, fontsize=BASE_PT)
    if title:
        axes.set_title(title, fontsize=BASE_PT, loc="left", color=INK)


def legend_below(figure: Figure, axes: Axes, columns: int = 4) -> None:
    """One legend for the figure, below it and outside of every axis, so that it covers nothing."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=BASE_PT - 0.5)


def png(figure: Figure) -> bytes:
    """The figure as PNG; the same figure gives the same bytes."""
    held = io.BytesIO()
    figure.savefig(held, format="png", dpi=DPI, metadata={"Software": None})
    return held.getvalue()
