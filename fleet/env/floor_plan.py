"""Where everything stands in a picture of the cell: pixels from metres, with room made for what would overlap."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fleet.env.lettering import fitted, width
from fleet.env.scene import Cell
from fleet.robot import JOINTS

Array = np.ndarray

Pixel = tuple[int, int]
Box = tuple[int, int, int, int]
"""Left, top, right, bottom, px."""

NORMAL = (960, 640)
SMALLEST, LARGEST = (320, 240), (3840, 2160)
MOVES = 150
"""Rounds in which arms that would overlap are pushed apart."""

MOST_APART = 12
"""In a cell of more stations no name stands apart from its station."""


@dataclass(frozen=True)
class Label:
    """A name, whose station it is, the left end of its middle line, and the end of a line to it if it stands apart."""

    text: str
    station: int
    at: Pixel
    tail: Pixel | None


@dataclass(frozen=True)
class FloorPlan:
    """Of one cell in one size of picture, all in px."""

    size: Pixel
    scale: float
    """1 for the normal size."""
    text: int
    """Height of letters."""
    header: int
    """Height of the header."""
    floor: Box
    legend: Box
    side: Box
    bases: tuple[Pixel, ...]
    """Where each arm really stands."""
    rings: tuple[Pixel, ...]
    """Centre of each arm's ring of motors."""
    ring: int
    """Radius on which the centres of the motors lie."""
    motor: int
    """Radius of a motor."""
    reach: int
    """Radius of a whole ring, with the arc of the work done around it."""
    rows: int
    """Lines of text below a ring."""
    rooms: tuple[int, ...]
    """Width of that text, per arm."""
    stations: tuple[Pixel, ...]
    station: int
    """Half the side of a station's square."""
    labels: tuple[Label, ...]
    """Names of the stations that found room."""

    def motors(self, arm: int) -> tuple[Pixel, ...]:
        """Centres of an arm's motors, base to tool: clockwise, with a gap at the bottom."""
        x, y = self.rings[arm]
        return tuple((round(x + self.ring * dx), round(y + self.ring * dy)) for dx, dy in _DIRECTIONS)


_DIRECTIONS = tuple(
    (-math.sin(2 * math.pi * (j + 1) / (JOINTS + 1)), math.cos(2 * math.pi * (j + 1) / (JOINTS + 1)))
    for j in range(JOINTS)
)


@lru_cache(maxsize=32)
def floor_plan(cell: Cell, size: Pixel = NORMAL) -> FloorPlan:
    """The plan of a cell.

    Raises:
        ValueError: a size too small to read or too large to draw.
    """
    if not all(low <= asked <= high for low, asked, high in zip(SMALLEST, size, LARGEST, strict=True)):
        raise ValueError(
            f"A picture must be from {SMALLEST[0]}x{SMALLEST[1]} to {LARGEST[0]}x{LARGEST[1]} px "
            f"(got {size[0]}x{size[1]})."
        )
    scale = min(size[0] / NORMAL[0], size[1] / NORMAL[1])
    text = max(9, round(13 * scale))
    header, strip, aside = round(3.4 * text), round(3.2 * text), max(round(0.27 * size[0]), 9 * text)
    floor = (0, header, size[0] - aside, size[1] - strip)
    rows = 2 if len(cell.arms) <= 16 else 1
    below = rows * (text + 2)
    reach = _reach(cell, floor, below, scale)
    arc = max(3, round(5 * scale))
    ring = max(5, round((reach - arc) / 1.34))
    motor = max(2, round(0.34 * ring))
    reach = ring + motor + arc
    bases, stations = _placed(cell, floor, reach, below)
    station = max(3, round(6 * scale))
    rings = _apart(bases, stations, floor, reach, below, station)
    return FloorPlan(
        size=size,
        scale=scale,
        text=text,
        header=header,
        floor=floor,
        legend=(0, floor[3], floor[2], size[1]),
        side=(floor[2], header, size[0], size[1]),
        bases=bases,
        rings=rings,
        ring=ring,
        motor=motor,
        reach=reach,
        rows=rows,
        rooms=_rooms(rings, floor, reach, below, text),
        stations=stations,
        station=station,
        labels=_labelled(cell, rings, stations, floor, reach, below, station, text),
    )


def _reach(cell: Cell, floor: Box, below: int, scale: float) -> int:
    """Radius of a ring: as the floor has room for all of them, less where they stand close in it."""
    area = (floor[2] - floor[0]) * (floor[3] - floor[1]) / len(cell.arms)
    most = max(9.0, min(60 * scale, 0.40 * math.sqrt(area) - below / 2))
    if len(cell.arms) == 1:
        return round(most)
    at = np.array(_placed(cell, floor, round(most), below)[0])
    gaps = np.linalg.norm(at[:, None] - at[None], axis=-1) + np.diag([np.inf] * len(at))
    close = float(np.median(gaps.min(axis=1)))
    return round(min(most, max(0.62 * most, (close - below) / 2 - 2)))


def _rooms(rings: tuple[Pixel, ...], floor: Box, reach: int, below: int, text: int) -> tuple[int, ...]:
    """Width that the text below each ring may take without touching the edge, another ring or the text of one."""
    rooms = []
    for i, (x, y) in enumerate(rings):
        room = min(2 * reach + 5 * text, 2 * min(x - floor[0], floor[2] - x) - 4)
        for u, v in (*rings[:i], *rings[i + 1 :]):
            off = max(y + reach - v, v - (y + reach + below), 0)  # from the text to the middle of the other ring
            if off < reach:
                room = min(room, 2 * (abs(x - u) - math.isqrt(reach**2 - off**2)) - 4)
            if abs(y - v) < below:
                room = min(room, abs(x - u) - 4)
        rooms.append(max(2 * text, room))
    return tuple(rooms)


def _placed(cell: Cell, floor: Box, reach: int, below: int) -> tuple[tuple[Pixel, ...], tuple[Pixel, ...]]:
    """Mounts and stations from above, x to the right and y up, as large as the floor allows."""
    points = np.array([p[:2] for p in cell.mounts_m] + [p[:2] for _, p in cell.stations])
    low, high = points.min(axis=0), points.max(axis=0)
    edge = reach + 8
    left, top, right, bottom = floor[0] + edge, floor[1] + edge, floor[2] - edge, floor[3] - edge - below
    span_px = np.maximum([right - left, bottom - top], 1)
    per_m = float(np.min(span_px / np.maximum(high - low, 0.2)))
    middle = np.array([(left + right) / 2, (top + bottom) / 2])
    pixels = middle + (points - (low + high) / 2) * per_m * np.array([1.0, -1.0])
    placed = [(int(x), int(y)) for x, y in np.rint(pixels)]
    return tuple(placed[: len(cell.arms)]), tuple(placed[len(cell.arms) :])


def _apart(
    bases: tuple[Pixel, ...], stations: tuple[Pixel, ...], floor: Box, reach: int, below: int, station: int
) -> tuple[Pixel, ...]:
    """Rings near their bases that cover neither each other nor, where there is room, a station."""
    home = np.array(bases, dtype=float)
    # Arms at one place part in different directions.
    turn = 2.399963 * np.arange(len(home))
    at = home + 0.5 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    low = np.array([floor[0] + reach + 2, floor[1] + reach + 2])
    high = np.maximum(low, [floor[2] - reach - 2, floor[3] - reach - below - 2])
    fixed = np.array(stations, dtype=float).reshape(-1, 2)
    text = np.array([0.0, below / 2])  # Stations keep clear of ring and text together.
    clear_station = np.array([reach + 2.0 * station, reach + below / 2 + 2.0 * station])
    clear_ring = np.array([2 * reach + 4, 2 * reach + below + 2])
    for i in range(MOVES):
        at += 0.08 * (1 - i / MOVES) * (home - at)
        at += _push(at + text, fixed, clear_station, 0.4, 4)
        at += _push(at, at, clear_ring, 0.5, 2)
        at = np.clip(at, low, high)
    return tuple((int(x), int(y)) for x, y in np.rint(at))


def _push(at: Array, others: Array, clear: Array, share: float, corners: int) -> Array:
    """Moves [point, 2] away from others by a share of what they are too near.

    Args:
        clear: Half width and height of the room around a point.
        corners: 2 for an ellipse; the more, the nearer the room is to a rectangle.
    """
    if not len(others):
        return np.zeros_like(at)
    gap = at[:, None] - others[None]  # [point, other, 2]
    near = np.linalg.norm(gap / clear, ord=corners, axis=-1, keepdims=True)
    inside = (near < 1.0) & (near > 0.0)
    away = gap / np.maximum(near, 1e-6) * (1.0 - near)
    return share * np.where(inside, np.clip(away, -clear, clear), 0.0).sum(axis=1)


def _labelled(
    cell: Cell,
    rings: tuple[Pixel, ...],
    stations: tuple[Pixel, ...],
    floor: Box,
    reach: int,
    below: int,
    station: int,
    text: int,
) -> tuple[Label, ...]:
    """Names of stations, each where it covers nothing; those without such a place are left out."""
    line = text // 2 + 1
    taken: list[Box] = [(x - reach, y - reach, x + reach, y + reach + below) for x, y in rings]
    taken += [(x - station, y - station, x + station, y + station) for x, y in stations]
    names = [fitted(name, text, floor[2] - floor[0]) for name, _ in cell.stations]
    left, labels = list(range(len(names))), []
    # First those that can stand at their stations; in a large cell no others, since the lines would be a tangle.
    for apart in (False, True) if len(names) <= MOST_APART else (False,):
        for i in tuple(left):
            long = width(names[i], text)
            for x, y, tail in _around(stations[i], long, station, line, apart):
                box = (x - 1, y - line, x + long + 1, y + line)
                if _within(box, floor) and not any(_meet(box, other) for other in taken):
                    labels.append(Label(names[i], i, (x, y), tail))
                    taken.append(box)
                    left.remove(i)
                    break
    return tuple(labels)


def _around(at: Pixel, long: int, half: int, line: int, apart: bool) -> Iterator[tuple[int, int, Pixel | None]]:
    """Places for a name at its station or, apart from it, with the end of the line that leads there."""
    x, y = at
    gap = half + 3
    if not apart:
        above, under = y - gap - line, y + gap + line
        yield from ((x + gap, y, None), (x - gap - long, y, None))
        yield from ((x - long // 2, above, None), (x - long // 2, under, None))
        yield from ((x + shift, row, None) for row in (above, under) for shift in (-half, half - long))
        return
    for far in (2, 3, 4, 5):
        for dy in (-far, far):
            row = y + dy * 2 * line
            for dx in (0, line * far, -line * far, 3 * line * far, -3 * line * far):
                tail = (x + dx, row - line if dy > 0 else row + line)
                yield from ((x + dx - long // 2, row, tail), (x + dx - 4, row, tail), (x + dx + 4 - long, row, tail))


def _within(box: Box, frame: Box) -> bool:
    return frame[0] < box[0] and frame[1] < box[1] and box[2] < frame[2] and box[3] < frame[3]


def _meet(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
