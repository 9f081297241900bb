"""The content of a picture of the fleet: the cell, one moment of a shift, and pixel positions without overlap."""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.path import Path
from matplotlib.textpath import TextPath
from scipy.spatial import ConvexHull

from fleet.env.render.scene import Cell
from fleet.job import Fixture
from fleet.robot import JOINTS, rotation

Array = np.ndarray


Pixel = tuple[int, int]
Box = tuple[int, int, int, int]
"""Left, top, right, bottom, px."""

NORMAL: Pixel = (960, 640)
SMALLEST, LARGEST = (320, 240), (3840, 2160)
FONT = "DejaVu Sans"
"""Shipped with matplotlib."""
ROUNDS = 150
"""Iterations of moving overlapping arms apart."""


def drawable(text: str) -> str:
    """The text with □ for characters missing in the font and a space for unprintable ones."""
    glyphs = get_font(findfont(FontProperties(family=FONT))).get_charmap()
    return "".join((c if ord(c) in glyphs else "□") if c.isprintable() else " " for c in text)


@lru_cache(maxsize=4096)
def text_path(text: str, size_px: int, bold: bool = False) -> Path:
    """Outline of a line of text that begins at the origin, px, y up."""
    font = FontProperties(family=FONT, weight="bold" if bold else "normal")
    line = drawable(text)
    return TextPath((0, 0), line, size_px, prop=font, usetex=False) if line.strip() else Path(np.empty((0, 2)))


@lru_cache(maxsize=4096)
def text_width(text: str, size_px: int, bold: bool = False) -> int:
    """Width of a line of text, px."""
    ends = np.asarray(text_path(text, size_px, bold).vertices)[:, 0]
    return math.ceil(ends.max(initial=0.0))


@lru_cache(maxsize=4096)
def shortened(text: str, size_px: int, room_px: float, bold: bool = False) -> str:
    """The text on one line, with … in the middle if it is too wide; empty if nothing fits."""
    line = drawable(text)
    if text_width(line, size_px, bold) <= room_px:
        return line
    cuts = (line[: n // 2] + "…" + line[len(line) - (n - n // 2) :] for n in range(min(len(line) - 1, 200), 1, -1))
    return next((cut for cut in cuts if text_width(cut, size_px, bold) <= room_px), "")


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """Layout of one cell in one size of picture, px from the upper left corner."""

    size: Pixel
    text: int
    """Font size."""
    floor: Box
    reach: int
    """Outer radius of an arm."""
    rows: int
    """Lines of text below an arm."""
    bases: Array
    """Position of each arm, [arm, 2]."""
    centres: Array
    """Position of the drawing of each arm, moved where arms overlap, [arm, 2]."""
    room: Array
    """Width of the text below each arm, [arm]."""
    stations: Array
    """[station, 2]."""
    fixtures: tuple[Array, ...]
    """Outline of each fixture from above, [corner, 2]; it may reach beyond the floor."""
    labels: tuple[tuple[str, Pixel, Pixel], ...]
    """Station names with enough room: text, left end of its middle line, position of the station."""

    @property
    def motor(self) -> int:
        """Radius of a motor."""
        return max(2, round(0.23 * self.reach))

    @property
    def station(self) -> int:
        """Half the side of a station's square."""
        return self.text // 2

    @property
    def motors(self) -> Array:
        """Centres of the motors, base to tool clockwise with a gap at the bottom, [arm, joint, 2]."""
        angle = 2 * np.pi * np.arange(1, JOINTS + 1) / (JOINTS + 1)
        ring = 0.91 * self.reach - self.motor
        return self.centres[:, None] + ring * np.stack([-np.sin(angle), np.cos(angle)], axis=1)


@lru_cache(maxsize=32)
def floor_plan(cell: Cell, size: Pixel = NORMAL) -> FloorPlan:
    """Layout of a cell: a map, x to the right and y up, as large as the floor allows.

    Raises:
        ValueError: the size is too small to read or too large to draw.
    """
    if not all(low <= px <= high for low, px, high in zip(SMALLEST, size, LARGEST, strict=True)):
        limits = " to ".join(f"{width}x{height}" for width, height in (SMALLEST, LARGEST))
        raise ValueError(f"A picture must be from {limits} px (got {size[0]}x{size[1]}).")
    arms, scale = len(cell.arms), min(size[0] / NORMAL[0], size[1] / NORMAL[1])
    text, rows = max(9, round(13 * scale)), 2 if arms <= 16 else 1
    below, strip = rows * (text + 2), round(3.4 * text)
    floor = (0, strip, size[0] - max(round(0.27 * size[0]), 9 * text), size[1] - strip)
    each = math.sqrt((floor[2] - floor[0]) * (floor[3] - floor[1]) / arms)
    reach = round(max(9.0, min(60 * scale, 0.38 * each - below / 2)))
    points = np.array([p[:2] for p in cell.mounts_m] + [p[:2] for _, p in cell.stations])
    low, high = points.min(axis=0), points.max(axis=0)
    corner = np.array([floor[0] + reach + 8, floor[1] + reach + 8])
    other = np.array([floor[2] - reach - 8, floor[3] - reach - 8 - below])
    px_per_m = np.min(np.maximum(other - corner, 1) / np.maximum(high - low, 0.2))

    def on_floor(points_m: Array) -> Array:
        return (corner + other) / 2 + (points_m - (low + high) / 2) * px_per_m * [1.0, -1.0]

    at = np.rint(on_floor(points)).astype(int)
    bases, stations = at[:arms], at[arms:]
    centres = _apart(bases, stations, (corner - 6, np.maximum(corner - 6, other + 6)), reach, below)
    x, y = centres.T
    # A text overlaps neither the edges, nor arms beside or below it, nor their texts.
    room = np.minimum(2 * reach + 5 * text, 2 * np.minimum(x - floor[0], floor[2] - x) - 4)
    apart, down = np.abs(x[:, None] - x), y - y[:, None]
    crossed = (down > -reach - below) & (down < 2 * reach + below) & ~np.eye(arms, dtype=bool)
    room = np.minimum(
        room, np.where(crossed, np.where(np.abs(down) < below, apart, 2 * (apart - reach)) - 4, 1e6).min(1)
    )
    return FloorPlan(
        size=size,
        text=text,
        floor=floor,
        reach=reach,
        rows=rows,
        bases=bases,
        centres=centres,
        room=np.maximum(2 * text, room),
        stations=stations,
        fixtures=tuple(on_floor(_outline(fixture)) for fixture in cell.fixtures),
        labels=_labels([name for name, _ in cell.stations], centres, stations, floor, reach, below, text),
    )


def _outline(fixture: Fixture) -> Array:
    """Corners of a fixture's shadow on the floor, m, [corner, 2]."""
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * fixture.size_m @ rotation(fixture.tilt_deg).T
    shadow = (corners + fixture.position_m)[:, :2]
    return shadow[ConvexHull(shadow).vertices]


def _apart(bases: Array, stations: Array, corners: tuple[Array, Array], reach: int, below: int) -> Array:
    """Positions near the bases at which arms cover neither each other nor, where possible, a station, int [arm, 2]."""
    turn = 2.399963 * np.arange(len(bases))  # arms at one position move apart in different directions
    at = home = bases + 0.5 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    for i in range(ROUNDS):
        at = at + 0.08 * (1 - i / ROUNDS) * (home - at)
        for others, shift, clear, norm, share in (  # a station overlaps no text either: nearly a rectangle
            (stations, below / 2, [reach + 14.0, reach + below / 2 + 14.0], 4, 0.4),
            (at, 0.0, [2.0 * reach + 4, 2.0 * reach + below + 2], 2, 0.5),
        ):
            gap = at[:, None] + [0.0, shift] - others  # [arm, other, 2]
            near = np.linalg.norm(gap / clear, ord=norm, axis=-1, keepdims=True)
            away = np.where((near < 1) & (near > 0), gap / np.maximum(near, 1e-6) * (1 - near), 0.0)
            at = at + share * np.clip(away, -np.array(clear), clear).sum(axis=1)
        at = np.clip(at, *corners)
    return np.rint(at).astype(int)


def _labels(
    names: list[str], centres: Array, stations: Array, floor: Box, reach: int, below: int, text: int
) -> tuple[tuple[str, Pixel, Pixel], ...]:
    """Names of stations, each at the nearest free position; a name without one is left out."""
    half, line, labels = text // 2, text // 2 + 1, []
    taken = [(x - reach, y - reach, x + reach, y + reach + below) for x, y in centres.tolist()]
    taken += [(x - half, y - half, x + half, y + half) for x, y in stations.tolist()]
    for name, (x, y) in zip(names, stations.tolist(), strict=True):
        short = shortened(name, text, floor[2] - floor[0])
        wide = text_width(short, text)
        rows = [way * (half + 3 + far * line) for far in (1, 3, 5, 7) for way in (-1, 1)]
        for dy, dx in ((0, half + 3), (0, -half - 3 - wide), *product(rows, (-wide // 2, -half, half - wide))):
            box = (x + dx - 1, y + dy - line, x + dx + wide + 1, y + dy + line)
            inside = floor[0] < box[0] and floor[1] < box[1] and box[2] < floor[2] and box[3] < floor[3]
            if inside and all(box[2] <= a or c <= box[0] or box[3] <= b or d <= box[1] for a, b, c, d in taken):
                labels.append((short, (x + dx, y + dy), (x, y)))
                taken.append(box)
                break
    return tuple(labels)
