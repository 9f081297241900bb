"""Figures of a twin report.

Every function takes plain arrays and returns a matplotlib Figure; none uses pyplot, so no global state is kept.
"""

import io
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from scenarios.show.page import Picture

Array = np.ndarray
Pair = Sequence[Array]
"""The same of a normal and of a critical record, or (mu, sigma) of a posterior."""

NORMAL, CRITICAL, BETWEEN = "#0072B2", "#D55E00", "#8A8A8A"
"""Stays cool, passes the warning limit, neither. Blue and vermilion of Okabe & Ito suit colour-blind readers."""
INK, FAINT, ACCENT = "#222222", "#dddddd", "#009E73"
LINES = (NORMAL, ACCENT, "#E69F00", "#CC79A7", INK, BETWEEN)
MARKS = ("o", "s", "^", "D", "v", "x")
CHANNEL_NAMES = ("position", "velocity", "torque")
CHANNEL_LABELS = ("q (rad)", "dq/dt (rad/s)", "τ (N·m)")
LEAST_SPAN = (0.1, 0.1, 2.0)
"""Smallest range of an axis of q, qd, tau: less is noise of a joint at rest."""
DPI = 110
BASE_PT = 10.5
TITLE_PER_INCH = 8.4
"""Characters of a title in one line."""
MOST_POINTS = 500
"""Per kind in a scatter plot; more would cover one another."""
ELLIPSES = 60


@dataclass(frozen=True, eq=False)
class Line:
    """One curve."""

    x: Array
    """[point]."""
    y: Array
    """[point], or [seed, point] for the mean with the range over the seeds."""
    colour: str
    mark: str = ""
    width: float = 2.0


def sheet(
    rows: int = 1,
    columns: int = 1,
    *,
    width: float = 9.0,
    height: float = 4.0,
    title: str = "",
    sharex: bool | Literal["col"] = False,
    sharey: bool | Literal["row"] = False,
    widths: Sequence[float] | None = None,
) -> tuple[Figure, list[list[Axes]]]:
    """A figure of `width` × `height` inches and its axes [row][column]; the title states the finding."""
    figure = Figure(figsize=(width, height), layout="constrained", dpi=DPI)
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey, width_ratios=widths)
    for axes in grid.ravel():
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color("#999999")
        axes.tick_params(labelsize=BASE_PT - 1, colors=INK)
        axes.grid(True, color=FAINT, linewidth=0.6)
        axes.set_axisbelow(True)
    if title:
        title = textwrap.fill(title, int(TITLE_PER_INCH * width))
        figure.suptitle(title, fontsize=BASE_PT + 2, fontweight="bold", color=INK, x=0.01, ha="left")
    return figure, [list(row) for row in grid]


def picture(name: str, figure: Figure, alt: str) -> Picture:
    """The figure as PNG of a section; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return Picture(name=name, png=buffer.getvalue(), alt=alt)


def signals_figure(
    signals: Pair, rate_hz: float, *, joint: int, title: str, others: Pair | None = None, made: Pair | None = None
) -> Figure:
    """A joint's position, velocity and torque over time in a normal and in a critical record, side by side.

    Args:
        signals: [time, 3] each, at `rate_hz`.
        joint: Its index from 0, for the legend.
        others: The same of other joints, [time, 3, joint] each.
        made: Reconstructions, [time, 3] each.
    """
    figure, grid = sheet(3, 2, width=10, height=6.4, title=title, sharex="col", sharey="row")
    handles = {}
    for column, (kind, colour) in enumerate((("normal", NORMAL), ("critical", CRITICAL))):
        record = signals[column]
        time_s = np.arange(len(record)) / rate_hz
        for channel, row in enumerate(grid):
            axes = row[column]
            if others is not None:
                handles["other joints"], *_ = axes.plot(
                    time_s, others[column][:, channel], color="#bbbbbb", linewidth=0.8, label="other joints"
                )
            (line,) = axes.plot(time_s, record[:, channel], color=colour, linewidth=2.0, label=f"joint {joint + 1}")
            handles = {f"joint {joint + 1}, {kind}": line} | handles
            if made is not None:
                between = record[:, channel], made[column][:, channel]
                axes.fill_between(time_s, *between, color=colour, alpha=0.18, linewidth=0)
                (dashed,) = axes.plot(time_s, between[1], color=INK, linewidth=1.3, linestyle="--")
                dashed.set_label("reconstruction")
                handles["reconstruction"] = dashed
            _label(axes, y="" if column else CHANNEL_LABELS[channel], title="" if channel else kind)
        _label(grid[2][column], x="time (s)")
    for row, least in zip(grid, LEAST_SPAN, strict=True):
        low, high = row[0].get_ylim()  # shared by both columns
        if high - low < least:
            row[0].set_ylim((low + high - least) / 2, (low + high + least) / 2)
    names = sorted(handles, key=lambda name: (not name.startswith("joint"), "critical" in name))
    _legend(figure, {name: handles[name] for name in names})
    return figure


def density(mu: Array, sigma: Array, x: Array, y: Array) -> Array:
    """Mean of the densities of Gaussian posteriors, [y, x].

    Args:
        mu, sigma: [window, 2].
    """
    along = [
        np.exp(-0.5 * ((at[:, None] - mu[:, k]) / sigma[:, k]) ** 2) / (np.sqrt(2 * np.pi) * sigma[:, k])
        for k, at in enumerate((x, y))
    ]
    return along[1] @ along[0].T / len(mu)


def latent_map_figure(normal: Pair, critical: Pair, *, joint: int, title: str) -> Figure:
    """The latent plane of a joint as superposed Gaussians: density at the left, single posteriors at the right.

    Args:
        normal, critical: Posterior (mu, sigma), each [window, latent]; the first two units are shown.
    """
    figure, ((left, right),) = sheet(1, 2, width=10, height=4.8, title=title, sharex=True, sharey=True)
    low, high = np.percentile(np.concatenate([normal[0], critical[0]])[:, :2], [0.5, 99.5], axis=0)
    margin = 0.12 * np.maximum(high - low, 0.5)
    margin += 1.5 * np.median(np.concatenate([normal[1], critical[1]])[:, :2], axis=0)
    x, y = (np.linspace(low[k] - margin[k], high[k] + margin[k], 140) for k in range(2))
    for (mu, sigma), colour, name in ((normal, NORMAL, "normal"), (critical, CRITICAL, "critical")):
        height = density(mu[:, :2], sigma[:, :2], x, y)
        levels = height.max() * np.array([0.05, 0.15, 0.35, 0.65])
        left.contour(x, y, height, levels=levels, colors=colour, linewidths=(0.8, 1.2, 1.6, 2.0))
        left.plot([], [], color=colour, label=f"{name} windows")
        for i in np.linspace(0, len(mu) - 1, min(ELLIPSES, len(mu))).astype(int):
            at, (wide, tall) = tuple(mu[i, :2].tolist()), 2 * sigma[i, :2]
            right.add_patch(Ellipse(at, wide, tall, edgecolor=colour, fill=False, alpha=0.6))  # pyright: ignore[reportArgumentType]
    _label(left, x=f"z₁ of joint {joint + 1}", y=f"z₂ of joint {joint + 1}", title="density of all posteriors")
    _label(right, x=f"z₁ of joint {joint + 1}", title=f"single posteriors, 1 σ ({ELLIPSES} of each kind at most)")
    left.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    _legend(figure, left)
    return figure


def latent_scatter_figure(mu: Array, temp_c: Array, *, limit_c: float, joint: int, title: str) -> Figure:
    """Posterior means in the latent plane of a joint: low and high temperatures at the left, all at the right.

    Args:
        mu: [window, latent]; the first two units are shown.
        temp_c: Temperature of each window, [window].
        limit_c: High from here on.
    """
    figure, ((left, right),) = sheet(1, 2, width=10.4, height=4.8, title=title, sharex=True, sharey=True)
    rng, high = np.random.default_rng(0), temp_c >= limit_c
    kinds = ((~high, NORMAL, f"below {limit_c:g} °C", "o"), (high, CRITICAL, f"{limit_c:g} °C and above", "^"))
    for kind, colour, name, mark in kinds:
        some = rng.permutation(np.flatnonzero(kind))[:MOST_POINTS]
        left.scatter(*mu[some, :2].T, s=18, color=colour, marker=mark, alpha=0.7, linewidths=0, label=name)
    some = rng.permutation(len(mu))[: 2 * MOST_POINTS]
    dots = right.scatter(*mu[some, :2].T, s=14, c=temp_c[some], cmap="viridis", linewidths=0, alpha=0.85)
    figure.colorbar(dots, ax=right, label="temperature (°C)")
    _label(left, x=f"μ₁ of joint {joint + 1}", y=f"μ₂ of joint {joint + 1}", title="low and high temperature")
    _label(right, x=f"μ₁ of joint {joint + 1}", title="the same windows, by temperature")
    _legend(figure, left)
    return figure


def difficulty_figure(groups: Mapping[str, Array], *, title: str, unit: str = "jobs") -> Figure:
    """Difficulty of jobs or windows by kind: boxes per joint at the left, the sum over the joints at the right.

    Args:
        groups: [job, joint] by name, from normal to critical; two or three.
    """
    colours = [NORMAL, BETWEEN, CRITICAL] if len(groups) == 3 else [NORMAL, CRITICAL]
    figure, ((left, right),) = sheet(1, 2, width=11, height=4.6, title=title, widths=(1.7, 1))
    totals = [values.sum(axis=1) for values in groups.values()]
    edges = np.linspace(min(map(np.min, totals)), max(map(np.max, totals)) + 1e-9, 28)
    joints, room = np.arange(next(iter(groups.values())).shape[1]) + 1, 0.8 / len(groups)
    for g, ((name, values), total, colour) in enumerate(zip(groups.items(), totals, colours, strict=True)):
        drawn = left.boxplot(
            list(values.T),
            positions=joints + (g - (len(groups) - 1) / 2) * room,  # pyright: ignore[reportArgumentType]
            widths=0.85 * room,
            whis=(5, 95),
            showfliers=False,
            patch_artist=True,
            manage_ticks=False,
            boxprops={"facecolor": colour, "alpha": 0.45, "edgecolor": colour},
            medianprops={"color": INK, "linewidth": 1.3},
            whiskerprops={"color": colour, "linewidth": 1.3},
            capprops={"color": colour, "linewidth": 1.3},
        )
        drawn["boxes"][0].set_label(f"{name} ({len(values)} {unit})")
        right.hist(total, edges.tolist(), density=True, color=colour, alpha=0.25)
        right.hist(total, edges.tolist(), density=True, histtype="step", color=colour, linewidth=1.8)
    left.set_xticks(joints)
    _label(left, x="joint", y="d of the joint", title="box: quartiles, whiskers: 5 % and 95 %")
    _label(right, x="d, sum over the joints", y=f"share of {unit} (density)", title="sum over the joints")
    _legend(figure, left)
    return figure


def lines_figure(
    panels: Mapping[str, Mapping[str, Line]],
    *,
    title: str,
    x_label: str,
    y_label: str,
    height: float = 4.4,
    log: bool = False,
    ticks: Array | None = None,
    level: tuple[float, str] | None = None,
    from_zero: bool = False,
    diagonal: bool = False,
) -> Figure:
    """Curves in one panel or in several side by side; curves of several seeds as their mean and range.

    Args:
        panels: By title and by name in the legend; names that begin with `_` are not in the legend.
        ticks: Values marked on the x axis.
        level: A horizontal line and its name.
        diagonal: Draw the diagonal of the unit square, and show just that.
    """
    several = len(panels) > 1
    width = 11.0 if several else 8.4
    figure, (row,) = sheet(1, len(panels), width=width, height=height, title=title, sharey=several and from_zero)
    for axes, (name, lines) in zip(row, panels.items(), strict=True):
        for label, line in lines.items():
            seeds = np.atleast_2d(line.y)
            if len(seeds) > 1:
                bounds = seeds.min(axis=0), seeds.max(axis=0)
                axes.fill_between(line.x, *bounds, color=line.colour, alpha=0.15, linewidth=0)
            style = {"marker": line.mark, "markersize": 4.8, "linewidth": line.width, "label": label}
            axes.plot(line.x, seeds.mean(axis=0), color=line.colour, **style)
        if level is not None:
            axes.axhline(level[0], color=CRITICAL, linestyle="--", linewidth=1.2, label=level[1])
        if diagonal:
            axes.plot([0, 1], [0, 1], color="#999999", linestyle="--", linewidth=1)
            axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
        if log:
            axes.set_xscale("log")
            axes.minorticks_off()
        if ticks is not None:
            axes.set_xticks(ticks, [f"{value:g}" for value in ticks])
        _label(axes, x=x_label, title=name)
    _label(row[0], y=y_label)
    if from_zero:
        row[0].set_ylim(bottom=0)
    _legend(figure, row[0])
    return figure


def ranked(values: Mapping[str, Mapping[str, Array]]) -> list[str]:
    """Methods from worst to best by the mean of the first measure, to three digits; ties by the next measure."""
    return sorted(values, key=lambda name: [round(float(np.mean(seeds)), 3) for seeds in values[name].values()])


def ranking_figure(
    values: Mapping[str, Mapping[str, Array]],
    *,
    ours: Sequence[str],
    title: str,
    targets: Mapping[str, float] | None = None,
) -> Figure:
    """Methods from best to worst, one panel per measure: every seed as a dot, the mean as a bar.

    Args:
        values: [method][measure] → one value per seed, [seed].
        ours: Methods of the twin, drawn in blue.
        targets: A dashed line by measure.
    """
    order, measures = ranked(values), list(next(iter(values.values())))
    figure, (row,) = sheet(1, len(measures), width=11, height=1.7 + 0.3 * len(order), title=title, sharey=True)
    for axes, measure in zip(row, measures, strict=True):
        means = np.array([np.mean(values[name][measure]) for name in order])
        axes.barh(order, means, color=[NORMAL if n in ours else BETWEEN for n in order], height=0.66, alpha=0.75)
        for name in order:
            seeds = np.atleast_1d(values[name][measure])
            axes.plot(seeds, [name] * len(seeds), "o", color=INK, markersize=3.2)
        if targets and measure in targets:
            axes.axvline(targets[measure], color=CRITICAL, linestyle="--", linewidth=1.3)
        lowest = min(float(np.min(v[measure])) for v in values.values())
        axes.set_xlim(min(0.0, lowest), max(1.0, float(means.max())) * 1.02)
        axes.grid(False, axis="y")
        _label(axes, title=measure)
    row[0].plot([], [], color=NORMAL, linewidth=7, label="the twin")
    row[0].plot([], [], color=BETWEEN, linewidth=7, label="baselines")
    row[0].plot([], [], "o", color=INK, markersize=3.2, label="single seeds")
    if targets:
        row[0].plot([], [], color=CRITICAL, linestyle="--", label="target")
    _legend(figure, row[0])
    return figure


def bars_figure(
    groups: Mapping[str, Mapping[str, Array]], *, title: str, y_label: str, colours: Sequence[str] = (NORMAL, CRITICAL)
) -> Figure:
    """Bars side by side: mean over the seeds, each seed a dot.

    Args:
        groups: [group along x][bar within the group] → one value per seed, [seed].
    """
    figure, ((axes,),) = sheet(width=8.4, height=4.4, title=title)
    bars = list(next(iter(groups.values())))
    room, palette = 0.8 / len(bars), colours if len(colours) >= len(bars) else LINES
    for b, bar in enumerate(bars):
        seeds = [np.atleast_1d(values[bar]) for values in groups.values()]
        at = np.arange(len(groups)) + (b - (len(bars) - 1) / 2) * room
        axes.bar(at, [float(v.mean()) for v in seeds], width=0.9 * room, color=palette[b], alpha=0.75, label=bar)
        for x, values in zip(at, seeds, strict=True):
            axes.plot(np.full(len(values), x), values, "o", color=INK, markersize=3)
            place = {"xytext": (0, 6), "textcoords": "offset points", "ha": "center", "fontsize": BASE_PT - 2}
            axes.annotate(f"{values.mean():.2g}", (x, max(float(values.max()), 0.0)), **place)
    axes.set_xticks(np.arange(len(groups)), list(groups))
    axes.grid(False, axis="x")
    axes.margins(y=0.15)
    if all(np.min(values) >= 0 for group in groups.values() for values in group.values()):
        axes.set_ylim(bottom=0)
    _label(axes, y=y_label)
    _legend(figure, axes)
    return figure


def reliability_figure(tables: Mapping[str, tuple[Array, Array, Array]], *, title: str) -> Figure:
    """Predicted against observed: share of jobs with saturation by predicted probability, and their number.

    Args:
        tables: By method: mean predicted probability, observed share, count; each [bin], empty bins left out.
    """
    figure, ((left, right),) = sheet(1, 2, width=10, height=4.6, title=title, widths=(1.25, 1))
    left.plot([0, 1], [0, 1], color="#999999", linestyle="--", linewidth=1, label="perfect")
    room, edges = 0.08 / max(len(tables), 1), np.linspace(0.0, 1.0, 11)
    for i, (name, (predicted, observed, count)) in enumerate(tables.items()):
        left.plot(predicted, observed, color=LINES[i % 6], marker=MARKS[i % 6], markersize=5, label=name)
        # Bins of equal mass all have the same count; tenths show how sure a method is.
        jobs, _ = np.histogram(predicted, edges, weights=count)
        at = edges[:-1] + 0.05 + (i - (len(tables) - 1) / 2) * room
        right.bar(at, jobs, width=room, color=LINES[i % 6], alpha=0.8)
    left.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    right.set_xlim(-0.02, 1.02)
    _label(left, x="predicted probability", y="share that passed the limit", title="reliability")
    _label(right, x="predicted probability", y="jobs", title="jobs by predicted probability")
    _legend(figure, left)
    return figure


def _label(axes: Axes, *, x: str = "", y: str = "", title: str = "") -> None:
    if x:
        axes.set_xlabel(x, fontsize=BASE_PT)
    if y:
        axes.set_ylabel(y, fontsize=BASE_PT)
    if title:
        axes.set_title(title, fontsize=BASE_PT, loc="left", color=INK)


def _legend(figure: Figure, of: Axes | Mapping[str, Artist]) -> None:
    """One legend for the figure, below all axes."""
    if isinstance(of, Axes):
        of = dict(zip(*reversed(of.get_legend_handles_labels()), strict=True))
    style = {"loc": "outside lower center", "ncols": 4, "frameon": False, "fontsize": BASE_PT - 0.5}
    figure.legend(of.values(), of.keys(), **style)
