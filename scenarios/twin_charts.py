"""Pictures of measured figures: methods side by side, calibration, courses over time, generated motion."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from scenarios.twin_style import (
    ACCENT,
    BASE_PT,
    BETWEEN,
    CRITICAL,
    INK,
    NORMAL,
    SECOND,
    THIRD,
    legend_below,
    named,
    sheet,
)

Array = np.ndarray

LINES = (NORMAL, ACCENT, THIRD, SECOND, INK, BETWEEN)
MARKS = ("o", "s", "^", "D", "v", "x")


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
        ours: The methods that are the twin's, drawn in blue.
        targets: A dashed line per measure, where one was set.
    """
    measures = list(next(iter(values.values())))
    order = ranked(values)
    height = 1.7 + 0.3 * len(order)
    figure, (row,) = sheet(1, len(measures), width=11, height=height, title=title, sharey=True)
    at = np.arange(len(order))
    for axes, measure in zip(row, measures, strict=True):
        means = np.array([float(np.mean(values[name][measure])) for name in order])
        colours = [NORMAL if name in ours else BETWEEN for name in order]
        axes.barh(at, means, color=colours, height=0.66, alpha=0.75)
        for y, name in enumerate(order):
            seeds = np.atleast_1d(values[name][measure])
            axes.plot(seeds, np.full(len(seeds), y), "o", color=INK, markersize=3.2)
        if targets and measure in targets:
            axes.axvline(targets[measure], color=CRITICAL, linestyle="--", linewidth=1.3)
        lowest = min(float(np.min(v[measure])) for v in values.values())
        axes.set_xlim(min(0.0, lowest), max(1.0, float(means.max())) * 1.02)
        axes.grid(False, axis="y")
        named(axes, title=measure)
    row[0].set_yticks(at, order)
    row[0].plot([], [], color=NORMAL, linewidth=7, label="the twin")
    row[0].plot([], [], color=BETWEEN, linewidth=7, label="rivals")
    row[0].plot([], [], "o", color=INK, markersize=3.2, label="single seeds")
    if targets:
        row[0].plot([], [], color=CRITICAL, linestyle="--", label="target")
    legend_below(figure, row[0])
    return figure


def ranked(values: Mapping[str, Mapping[str, Array]]) -> list[str]:
    """Methods from worst to best by the mean of the first measure; who shows the same there, by the next."""
    return sorted(values, key=lambda name: [round(float(np.mean(seeds)), 3) for seeds in values[name].values()])


def reliability_figure(tables: Mapping[str, tuple[Array, Array, Array]], *, title: str) -> Figure:
    """Said against seen: how often jobs saturate that were given a probability, and how many there were of each.

    Args:
        tables: By method: mean predicted probability, observed share, count; each [bin], empty bins left out.
    """
    figure, ((left, right),) = sheet(1, 2, width=10, height=4.6, title=title, widths=(1.25, 1))
    left.plot([0, 1], [0, 1], color="#999999", linestyle="--", linewidth=1, label="perfect")
    room, edges = 0.08 / max(len(tables), 1), np.linspace(0.0, 1.0, 11)
    for i, (name, (said, seen, count)) in enumerate(tables.items()):
        left.plot(said, seen, color=LINES[i % 6], marker=MARKS[i % 6], markersize=5, label=name)
        # Bins of equal mass all have the same count; tenths show how sure a method is.
        jobs, _ = np.histogram(said, edges, weights=count)
        at = edges[:-1] + 0.05 + (i - (len(tables) - 1) / 2) * room
        right.bar(at, jobs, width=room, color=LINES[i % 6], alpha=0.8)
    left.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    named(left, x="predicted probability", y="share that really passed the limit", title="reliability")
    named(right, x="predicted probability", y="jobs", title="how many jobs were told so")
    right.set_xlim(-0.02, 1.02)
    legend_below(figure, left)
    return figure


def curves_figure(
    x: Array,
    curves: Mapping[str, Array],
    *,
    title: str,
    x_label: str,
    y_label: str,
    log: bool = False,
    level: tuple[float, str] | None = None,
    from_zero: bool = True,
) -> Figure:
    """Lines over x: mean and range over the seeds.

    Args:
        x: [point].
        curves: By name, [seed, point] (or [point] for one seed).
        level: A horizontal line, and what it is.
    """
    figure, ((axes,),) = sheet(width=8.4, height=4.6, title=title)
    for i, (name, values) in enumerate(curves.items()):
        of_seeds = np.atleast_2d(values)
        colour = LINES[i % 6]
        if len(of_seeds) > 1:
            axes.fill_between(x, of_seeds.min(axis=0), of_seeds.max(axis=0), color=colour, alpha=0.15, linewidth=0)
        axes.plot(x, of_seeds.mean(axis=0), color=colour, marker=MARKS[i % 6], markersize=5, label=name)
    if level is not None:
        axes.axhline(level[0], color=CRITICAL, linestyle="--", linewidth=1.2, label=level[1])
    if log:
        axes.set_xscale("log")
        axes.minorticks_off()
    if len(x) <= 8:
        axes.set_xticks(list(x), [f"{value:g}" for value in x])
    if from_zero:
        axes.set_ylim(bottom=0)
    named(axes, x=x_label, y=y_label)
    legend_below(figure, axes)
    return figure


def pairs_figure(
    groups: Mapping[str, Mapping[str, Array]], *, title: str, y_label: str, colours: Sequence[str] = (NORMAL, CRITICAL)
) -> Figure:
    """Bars side by side: mean over the seeds, each seed a dot.

    Args:
        groups: [group along x][bar within the group] → one value per seed, [seed].
    """
    figure, ((axes,),) = sheet(width=8.4, height=4.4, title=title)
    bars = list(next(iter(groups.values())))
    room = 0.8 / len(bars)
    palette = list(colours) if len(colours) >= len(bars) else list(LINES)
    for b, bar in enumerate(bars):
        at = np.arange(len(groups)) + (b - (len(bars) - 1) / 2) * room
        means = [float(np.mean(values[bar])) for values in groups.values()]
        axes.bar(at, means, width=0.9 * room, color=palette[b], alpha=0.75, label=bar)
        for x, values in zip(at, groups.values(), strict=True):
            seeds = np.atleast_1d(values[bar])
            axes.plot(np.full(len(seeds), x), seeds, "o", color=INK, markersize=3)
        tops = [max(float(np.max(values[bar])), 0.0) for values in groups.values()]
        for x, mean, top in zip(at, means, tops, strict=True):
            axes.annotate(
                f"{mean:.2g}", (x, top), (0, 6), textcoords="offset points", ha="center", fontsize=BASE_PT - 2
            )
    axes.set_xticks(np.arange(len(groups)), list(groups))
    axes.grid(False, axis="x")
    axes.margins(y=0.15)
    named(axes, y=y_label)
    legend_below(figure, axes)
    return figure


def courses_figure(
    time_min: Array, courses: Mapping[str, tuple[Array, str]], *, title: str, limit_c: float | None = None
) -> Figure:
    """Temperatures over time, each with its colour.

    Args:
        time_min: [time].
        courses: By name, °C [time] and colour.
    """
    figure, ((axes,),) = sheet(width=8.8, height=4.4, title=title)
    for name, (temp_c, colour) in courses.items():
        axes.plot(time_min, temp_c, color=colour, linewidth=2, label=name)
    if limit_c is not None:
        axes.axhline(limit_c, color=CRITICAL, linestyle="--", linewidth=1.1, label=f"warning limit, {limit_c:g} °C")
    named(axes, x="time (min)", y="motor temperature (°C)")
    legend_below(figure, axes)
    return figure


def motions_figure(
    original: Array, made: Sequence[Array], rate_hz: float, *, joints: Sequence[int], title: str
) -> Figure:
    """Joint angles of a motion and of what was generated from it.

    Args:
        original: q rad, [time, joint]; made: the same for each generated motion, of its own length.
        joints: Which to show, 0-based.
    """
    figure, (row,) = sheet(1, len(joints), width=11, height=3.9, title=title)
    for axes, joint in zip(row, joints, strict=True):
        for i, q in enumerate(made):
            axes.plot(
                np.arange(len(q)) / rate_hz,
                q[:, joint],
                color=ACCENT,
                linewidth=1,
                alpha=0.7,
                label="" if i else "generated",
            )
        time_s = np.arange(len(original)) / rate_hz
        axes.plot(time_s, original[:, joint], color=NORMAL, linewidth=2.2, label="original")
        named(axes, x="time (s)", title=f"joint {joint + 1}")
    named(row[0], y="q (rad)")
    legend_below(figure, row[0])
    return figure


def roc_figure(curves: Mapping[str, tuple[Array, Array, float]], *, title: str) -> Figure:
    """Hits against false alarms, the area named in the legend.

    Args:
        curves: By method: false alarm rate, hit rate [point], and the area under the curve.
    """
    figure, ((axes,),) = sheet(width=6.4, height=5.6, title=title)
    axes.plot([0, 1], [0, 1], color="#999999", linestyle="--", linewidth=1)
    for i, (name, (false_alarms, hits, area)) in enumerate(curves.items()):
        axes.plot(false_alarms, hits, color=LINES[i % 6], linewidth=2, label=f"{name}: AUROC {area:.3f}")
    axes.set(xlim=(-0.01, 1.01), ylim=(-0.01, 1.01))
    named(axes, x="false alarms (share of cool windows)", y="hits (share of hot windows)")
    axes.legend(loc="lower right", frameon=False, fontsize=BASE_PT)
    return figure
