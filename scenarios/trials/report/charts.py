"""Charts as SVG elements of a page, in the colours of its style sheet."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from scenarios.show.page import escape

Array = np.ndarray

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a8a8a", "#7a5195")
"""Of lines (Okabe & Ito, who are for colour-blind readers, and two more)."""
DASHES = ("", "7 3", "2 3", "9 3 2 3")
WIDTH, ROW, LEFT, RIGHT, TOP, BOTTOM = 720, 22, 190, 20, 8, 44
"""Of a chart, px."""
LETTER = 7.0
"""Width of a letter, px."""
Range = tuple[float, float, float]
"""A value with its lower and upper bound."""


@dataclass(frozen=True)
class Axis:
    """A scale from values to px."""

    low: float
    high: float
    from_px: float
    to_px: float

    def at(self, value: float) -> float:
        """Place of a value; beyond the ends it is at the end."""
        share = (min(max(value, self.low), self.high) - self.low) / (self.high - self.low)
        return round(self.from_px + share * (self.to_px - self.from_px), 1)

    @property
    def ticks(self) -> list[float]:
        """Some round values."""
        rough = (self.high - self.low) / 6
        power = 10.0 ** np.floor(np.log10(rough))
        step = next(power * n for n in (1, 2, 5, 10) if power * n >= rough)
        first, last = np.ceil(self.low / step - 1e-9), np.floor(self.high / step + 1e-9)
        return [float(step * n) for n in np.arange(first, last + 1)]


def spans(rows: Sequence[tuple[str, float, float, float]], title: str, *, least: float, marked: str = "") -> str:
    """A row for each name: a point and its interval.

    Args:
        rows: Name, value, low and high.
        title: Of the axis.
        least: Intervals that reach below this are cut there, so that one bad row does not squeeze the others.
        marked: A name in bold.
    """
    ends = [end for _, value, low, high in rows for end in (value, low, high) if np.isfinite(end)]
    low, high = max(least, min(ends)), max(ends)
    room = 0.04 * (high - low or 1.0)
    height = TOP + ROW * len(rows) + BOTTOM
    x = Axis(low - room, high + room, LEFT, WIDTH - RIGHT)
    parts = [_ticks(x, TOP, height - BOTTOM, title)]
    for n, (name, value, lower, upper) in enumerate(rows):
        y = TOP + ROW * (n + 0.5)
        style = ' font-weight="700"' if name == marked else ""
        parts.append(f'<text x="{LEFT - 10}" y="{y + 4:g}" text-anchor="end"{style}>{escape(_short(name))}</text>')
        if value >= x.low and np.isfinite(lower + upper):
            parts.append(
                f'<line x1="{x.at(lower)}" x2="{x.at(upper)}" y1="{y:g}" y2="{y:g}" stroke="{COLOURS[0]}" '
                'stroke-width="3" stroke-linecap="round" opacity=".55"/>'
            )
        if value < x.low:
            parts.append(f'<text x="{LEFT + 2}" y="{y + 4:g}" class="soft">◂ {value:.2f}</text>')
        else:
            parts.append(f'<circle cx="{x.at(value)}" cy="{y:g}" r="4.5" fill="{COLOURS[0]}"/>')
    return _svg(height, parts, f"{title}: " + ", ".join(f"{name} {value:.2f}" for name, value, _, _ in rows))


def lines(
    x_values: Array,
    by_name: Mapping[str, tuple[Array, Array, Array]],
    banded: Collection[str],
    x_title: str,
    y_title: str,
    height: int = 400,
) -> str:
    """Curves of shares, some with bands.

    Args:
        x_values: [point].
        by_name: Value, low and high of each curve, [point].
        banded: Curves whose low and high are shown.
    """
    columns = 3
    legend = ROW * -(-len(by_name) // columns) + 8
    x = Axis(float(x_values[0]), float(x_values[-1]), 60, WIDTH - RIGHT)
    y = Axis(0.0, 1.0, height - BOTTOM, TOP + legend)
    parts = [_ticks(x, TOP + legend, height - BOTTOM, x_title), _y_ticks(y, 60, y_title)]
    at = [x.at(value) for value in x_values.tolist()]
    for n, (name, (value, low, high)) in enumerate(by_name.items()):
        colour, dash = COLOURS[n % len(COLOURS)], DASHES[n // len(COLOURS) % len(DASHES)]
        band = [f"{a},{y.at(v)}" for a, v in zip(at, high.tolist(), strict=True)]
        band += [f"{a},{y.at(v)}" for a, v in zip(at[::-1], low.tolist()[::-1], strict=True)]
        curve = " ".join(f"{a},{y.at(v)}" for a, v in zip(at, value.tolist(), strict=True))
        if name in banded:
            parts.append(f'<polygon points="{" ".join(band)}" fill="{colour}" opacity=".12"/>')
        parts.append(f'<polyline points="{curve}" fill="none" stroke="{colour}" stroke-width="2" {_dash(dash)}/>')
        left, top = 60 + (n % columns) * 220, TOP + ROW * (n // columns) + 10
        parts.append(
            f'<line x1="{left}" x2="{left + 24}" y1="{top}" y2="{top}" stroke="{colour}" stroke-width="3" '
            f'{_dash(dash)}/><text x="{left + 30}" y="{top + 4}">{escape(_short(name))}</text>'
        )
    return _svg(height, parts, f"{y_title} against {x_title} of {', '.join(by_name)}")


def points(rows: Sequence[tuple[str, Range, Range]], x_title: str, y_title: str, height: int = 400) -> str:
    """A point for each name with its intervals, and its name beside it where there is room.

    Args:
        rows: Name, x and y; each of the two with its lower and upper bound.
    """
    ranges = np.array([row[1:] for row in rows])  # [name, axis, value and bounds]
    xs, ys = np.moveaxis(np.where(np.isfinite(ranges), ranges, ranges[..., :1]), 1, 0)
    room_x, room_y = 0.06 * (np.ptp(xs) or 1.0), 0.08 * (np.ptp(ys) or 1.0)
    x = Axis(float(xs.min() - room_x), float(xs.max() + room_x), 60, WIDTH - RIGHT)
    y = Axis(float(ys.min() - room_y), float(ys.max() + room_y), height - BOTTOM, TOP)
    parts, taken = [_ticks(x, TOP, height - BOTTOM, x_title), _y_ticks(y, 60, y_title)], list[tuple[float, ...]]()
    dots = [(x.at(a), y.at(b)) for _, (a, *_), (b, *_) in rows]
    for (a, b), (_, *x_ends), (_, *y_ends) in zip(dots, xs, ys, strict=True):
        (left, right), (low, high) = map(x.at, x_ends), map(y.at, y_ends)
        parts.append(f'<path d="M{left} {b}H{right}M{a} {low}V{high}" stroke="{COLOURS[0]}" stroke-opacity=".4"/>')
    taken += [(a - 5, b - 5, a + 5, b + 5) for a, b in dots]
    for (name, *_), (a, b) in zip(rows, dots, strict=True):
        parts.append(f'<circle cx="{a}" cy="{b}" r="4.5" fill="{COLOURS[0]}"><title>{escape(name)}</title></circle>')
        text, wide = _short(name), LETTER * len(_short(name))
        for left, below in ((a + 8, b + 4), (a - 8 - wide, b + 4), (a + 4, b - 8), (a - wide, b - 8), (a + 4, b + 16)):
            box = (left, below - 11, left + wide, below + 3)
            inside = box[0] >= 62 and box[2] <= WIDTH - 2 and box[1] >= 2 and box[3] <= height - BOTTOM
            if inside and not any(_overlap(box, other) for other in taken):
                taken.append(box)
                parts.append(f'<text x="{left:.1f}" y="{below:.1f}">{escape(text)}</text>')
                break
    return _svg(height, parts, f"{y_title} against {x_title} of {', '.join(row[0] for row in rows)}")


def _overlap(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _short(name: str, most: int = 28) -> str:
    return name if len(name) <= most else f"{name[: most - 1]}…"


def _dash(dash: str) -> str:
    return f'stroke-dasharray="{dash}"' if dash else ""


def _ticks(x: Axis, top: float, bottom: float, title: str) -> str:
    parts = [
        f'<line x1="{x.at(v)}" x2="{x.at(v)}" y1="{top}" y2="{bottom}" class="grid"/>'
        f'<text x="{x.at(v)}" y="{bottom + 16}" text-anchor="middle" class="soft">{_number(v)}</text>'
        for v in x.ticks
    ]
    middle = (x.from_px + x.to_px) / 2
    return "".join(parts) + f'<text x="{middle:g}" y="{bottom + 36}" text-anchor="middle">{escape(title)}</text>'


def _y_ticks(y: Axis, left: float, title: str) -> str:
    parts = [
        f'<line x1="{left}" x2="{WIDTH - RIGHT}" y1="{y.at(v)}" y2="{y.at(v)}" class="grid"/>'
        f'<text x="{left - 6}" y="{y.at(v) + 4}" text-anchor="end" class="soft">{_number(v)}</text>'
        for v in y.ticks
    ]
    middle = (y.from_px + y.to_px) / 2
    turned = f'transform="rotate(-90 14 {middle:g})"'
    return "".join(parts) + f'<text x="14" y="{middle:g}" text-anchor="middle" {turned}>{escape(title)}</text>'


def _number(value: float) -> str:
    return f"{value:z.6g}".replace("-", "−")


def _svg(height: float, parts: Sequence[str], text: str) -> str:
    return (
        f'<div class="wide"><svg class="chart" viewBox="0 0 {WIDTH} {height:g}" role="img" '
        f'aria-label="{escape(text)}">{"".join(parts)}</svg></div>'
    )
