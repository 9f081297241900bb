"""The paper's pictures of a twin: data, latent map, reconstruction, difficulty, error against epochs.

Every function takes plain arrays and gives a matplotlib Figure; none uses pyplot, so nothing is kept or shown.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from scenarios.twin_style import (
    BASE_PT,
    BETWEEN,
    CHANNEL_LABELS,
    CHANNEL_NAMES,
    CRITICAL,
    INK,
    NORMAL,
    legend_below,
    named,
    sheet,
)

Array = np.ndarray

MOST_POINTS = 500
"""Of each kind in a scatter; more would cover one another."""
ELLIPSES = 60


def data_figure(normal: Array, hot: Array, rate_hz: float, *, joint: int, title: str) -> Figure:
    """A normal and a critical record side by side, one row per channel, `joint` (0-based) before the others.

    Args:
        normal, hot: [time, 3, joint] at `rate_hz`.
    """
    figure, grid = sheet(3, 2, width=10, height=6.4, title=title, sharex="col", sharey="row")
    columns = ((normal, NORMAL, "normal: stays cool"), (hot, CRITICAL, "critical: gets hot"))
    for column, (record, colour, name) in enumerate(columns):
        time_s = np.arange(len(record)) / rate_hz
        for channel, row in enumerate(grid):
            axes = row[column]
            others = np.delete(record[:, channel], joint, axis=1)
            lines = axes.plot(time_s, others, color="#bbbbbb", linewidth=0.8)
            lines[0].set_label("other joints")
            axes.plot(time_s, record[:, channel, joint], color=colour, linewidth=2.0, label=f"joint {joint + 1}")
            named(axes, y="" if column else CHANNEL_LABELS[channel], title="" if channel else name)
            widened(axes, LEAST_SPAN[channel])
        named(grid[2][column], x="time (s)")
    legend_of_both(figure, grid[0][0], grid[0][1], joint)
    return figure


LEAST_SPAN = (0.1, 0.1, 2.0)
"""Of an axis of q (rad), qd (rad/s), tau (N·m): less is noise of a joint that holds still."""


def widened(axes: Axes, least: float) -> None:
    """Let the y axis span so much at least, around its middle."""
    low, high = axes.get_ylim()
    if high - low < least:
        middle = (low + high) / 2
        axes.set_ylim(middle - least / 2, middle + least / 2)


def legend_of_both(figure: Figure, left: Axes, right: Axes, joint: int) -> None:
    """One legend for a normal and a critical column."""
    pairs = dict(zip(*reversed(left.get_legend_handles_labels()), strict=True))
    right_pairs = dict(zip(*reversed(right.get_legend_handles_labels()), strict=True))
    name = f"joint {joint + 1}"
    handles = {f"{name}, normal": pairs.pop(name), f"{name}, critical": right_pairs.pop(name), **pairs}
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=4, frameon=False, fontsize=BASE_PT - 0.5
    )


def reconstruction_figure(
    normal: Array, normal_hat: Array, hot: Array, hot_hat: Array, rate_hz: float, *, joint: int, title: str
) -> Figure:
    """What a window was and what the twin makes of it, normal and critical, one joint.

    Args:
        normal, normal_hat, hot, hot_hat: [time, 3], SI.
    """
    figure, grid = sheet(3, 2, width=10, height=6.4, title=title, sharex="col", sharey="row")
    columns = ((normal, normal_hat, NORMAL, "normal"), (hot, hot_hat, CRITICAL, "critical"))
    for column, (seen, made, colour, name) in enumerate(columns):
        time_s = np.arange(len(seen)) / rate_hz
        for channel, row in enumerate(grid):
            axes = row[column]
            axes.fill_between(time_s, seen[:, channel], made[:, channel], color=colour, alpha=0.18, linewidth=0)
            axes.plot(time_s, seen[:, channel], color=colour, linewidth=2.0, label=f"joint {joint + 1}")
            axes.plot(time_s, made[:, channel], color=INK, linewidth=1.3, linestyle="--", label="reconstruction")
            named(axes, y="" if column else CHANNEL_LABELS[channel], title="" if channel else name)
            widened(axes, LEAST_SPAN[channel])
        named(grid[2][column], x="time (s)")
    legend_of_both(figure, grid[0][0], grid[0][1], joint)
    return figure


def density(mu: Array, sigma: Array, x: Array, y: Array) -> Array:
    """Mean of the posteriors' densities, [y, x]: the map as superposed Gaussians.

    Args:
        mu, sigma: [window, 2].
    """
    along = [
        np.exp(-0.5 * ((at[:, None] - mu[:, k]) / sigma[:, k]) ** 2) / (np.sqrt(2 * np.pi) * sigma[:, k])
        for k, at in enumerate((x, y))
    ]
    return along[1] @ along[0].T / len(mu)


def latent_map_figure(normal: tuple[Array, Array], critical: tuple[Array, Array], *, joint: int, title: str) -> Figure:
    """The latent plane of a joint as superposed Gaussians: density at the left, single posteriors at the right.

    Args:
        normal, critical: Posterior (mu, sigma), each [window, latent]; the first two units are shown.
    """
    figure, ((left, right),) = sheet(1, 2, width=10, height=4.8, title=title, sharex=True, sharey=True)
    both = np.concatenate([normal[0][:, :2], critical[0][:, :2]])
    wide = np.concatenate([normal[1][:, :2], critical[1][:, :2]])
    low, high = np.percentile(both, [0.5, 99.5], axis=0)
    room = 0.12 * np.maximum(high - low, 0.5) + 1.5 * np.median(wide, axis=0)
    x, y = (np.linspace(low[k] - room[k], high[k] + room[k], 140) for k in range(2))
    for (mu, sigma), colour, name in ((normal, NORMAL, "normal"), (critical, CRITICAL, "critical")):
        height = density(mu[:, :2], sigma[:, :2], x, y)
        levels = height.max() * np.array([0.05, 0.15, 0.35, 0.65])
        left.contour(x, y, height, levels=levels, colors=colour, linewidths=(0.8, 1.2, 1.6, 2.0))
        left.plot([], [], color=colour, label=f"{name} windows")
        for m, s in _some(mu, sigma, ELLIPSES):
            right.add_patch(_ellipse(m, s, colour))
    named(left, x=f"z₁ of joint {joint + 1}", y=f"z₂ of joint {joint + 1}", title="density of all posteriors")
    named(right, x=f"z₁ of joint {joint + 1}", title=f"single posteriors, 1 σ ({ELLIPSES} of each kind at most)")
    left.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    legend_below(figure, left)
    return figure


def _ellipse(mu: Array, sigma: Array, colour: str) -> Ellipse:
    return Ellipse((mu[0], mu[1]), 2 * sigma[0], 2 * sigma[1], edgecolor=colour, fill=False, alpha=0.6)


def _some(mu: Array, sigma: Array, most: int) -> list[tuple[Array, Array]]:
    index = np.linspace(0, len(mu) - 1, min(most, len(mu))).astype(int)
    return [(mu[i], sigma[i]) for i in index]


def latent_scatter_figure(mu: Array, temp_c: Array, *, limit_c: float, joint: int, title: str) -> Figure:
    """Posterior means in the latent plane of a joint, by temperature: which are low and high, and how high.

    Args:
        mu: [window, latent]; the first two units are shown.
        temp_c: Temperature that belongs to each window, [window].
        limit_c: Above is high.
    """
    figure, ((left, right),) = sheet(1, 2, width=10.4, height=4.8, title=title, sharex=True, sharey=True)
    rng = np.random.default_rng(0)
    high = temp_c >= limit_c
    for chosen, colour, name, mark in (
        (~high, NORMAL, f"below {limit_c:g} °C", "o"),
        (high, CRITICAL, f"{limit_c:g} °C and above", "^"),
    ):
        index = np.flatnonzero(chosen)
        index = rng.permutation(index)[:MOST_POINTS]
        left.scatter(*mu[index, :2].T, s=18, color=colour, marker=mark, alpha=0.7, linewidths=0, label=name)
    index = rng.permutation(len(mu))[: 2 * MOST_POINTS]
    dots = right.scatter(*mu[index, :2].T, s=14, c=temp_c[index], cmap="viridis", linewidths=0, alpha=0.85)
    figure.colorbar(dots, ax=right, label="temperature (°C)")
    named(left, x=f"μ₁ of joint {joint + 1}", y=f"μ₂ of joint {joint + 1}", title="low and high temperature")
    named(right, x=f"μ₁ of joint {joint + 1}", title="the same windows, by temperature")
    legend_below(figure, left)
    return figure


def difficulty_figure(groups: dict[str, Array], *, title: str, unit: str = "jobs") -> Figure:
    """Difficulty of jobs, or of windows, by kind: per joint at the left, the sum over the joints at the right.

    Args:
        groups: [job, joint] by name, from normal to critical; at most three.
    """
    colours = [NORMAL, BETWEEN, CRITICAL] if len(groups) == 3 else [NORMAL, CRITICAL]
    figure, ((left, right),) = sheet(1, 2, width=11, height=4.6, title=title, widths=(1.7, 1))
    joints = next(iter(groups.values())).shape[1]
    room = 0.8 / len(groups)
    for g, ((name, values), colour) in enumerate(zip(groups.items(), colours, strict=True)):
        at = np.arange(joints) + 1 + (g - (len(groups) - 1) / 2) * room
        boxes(left, list(values.T), at, colour, 0.85 * room)
        left.plot([], [], color=colour, linewidth=7, label=f"{name} ({len(values)} {unit})")
    total = {name: values.sum(axis=1) for name, values in groups.items()}
    every = np.concatenate(list(total.values()))
    edges = np.linspace(every.min(), every.max() + 1e-9, 28)
    for (_, values), colour in zip(total.items(), colours, strict=True):
        right.hist(values, edges, density=True, color=colour, alpha=0.25)
        right.hist(values, edges, density=True, histtype="step", color=colour, linewidth=1.8)
    left.set_xticks(np.arange(joints) + 1)
    named(left, x="joint", y="d of the joint", title="box: quartiles, whiskers: 5 % and 95 %")
    named(right, x="d, sum over the joints", y=f"share of {unit} (density)", title="sum over the joints")
    legend_below(figure, left)
    return figure


def boxes(axes: Axes, values: list[Array], at: Array, colour: str, width: float) -> None:
    """Boxes of quartiles with whiskers from 5 to 95 %, in one colour."""
    drawn = axes.boxplot(
        values, positions=list(at), widths=width, whis=(5, 95), showfliers=False, patch_artist=True, manage_ticks=False
    )
    for box in drawn["boxes"]:
        box.set(facecolor=colour, alpha=0.45, edgecolor=colour)
    for part in ("whiskers", "caps", "medians"):
        for line in drawn[part]:
            line.set(color=colour if part != "medians" else INK, linewidth=1.3)


def epochs_figure(epochs: Array, known: Array, held_out: Array, *, title: str) -> Figure:
    """Reconstruction error against epochs per channel: mean and range over the seeds.

    Args:
        epochs: [point].
        known, held_out: Mean absolute error in z units, [seed, point, channel].
    """
    figure, (row,) = sheet(1, 3, width=11, height=4.0, title=title, sharey=True)
    for axes, channel in zip(row, (2, 0, 1), strict=True):
        for errors, colour, name, mark in (
            (known, NORMAL, "trained on", "o"),
            (held_out, INK, "held out", "s"),
        ):
            of_seeds = errors[:, :, channel]
            axes.fill_between(epochs, of_seeds.min(axis=0), of_seeds.max(axis=0), color=colour, alpha=0.15, linewidth=0)
            axes.plot(epochs, of_seeds.mean(axis=0), color=colour, marker=mark, markersize=4.5, label=name)
        axes.set_xscale("log")
        axes.set_xticks(list(epochs), [f"{n:g}" for n in epochs])
        axes.minorticks_off()
        named(axes, x="epochs", title=CHANNEL_NAMES[channel])
    named(row[0], y="mean |error| (σ of the training data)")
    row[0].set_ylim(bottom=0)
    legend_below(figure, row[0])
    return figure
