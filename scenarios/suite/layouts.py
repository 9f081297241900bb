"""Layouts of cells of any number of arms, with groups of stations that two neighbours reach.

A group lies between two neighbours. Its station `a` is nearer to the one, `b` to the other, `c` to neither. The
dimensions keep arms at home apart, and let each arm work in a group while its neighbour works in the next one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, cos, degrees, pi, sin
from typing import Literal

from fleet.job import Place
from fleet.robot import rotation
from scenarios.schema import ArmSpec

LayoutName = Literal["bench", "line", "ring", "gantry", "wall_ceiling"]
HOME = "retract"
DIGITS = 4
MOST_IN_ROW = 16
APART_M = 2.6
"""Distance between two rows of a line, out of each other's reach."""
SIDE_M = 0.15
"""Distance of the stations a and b from the middle of their group."""


@dataclass(frozen=True)
class Layout:
    """Mounted arms, and stations in groups."""

    arms: tuple[ArmSpec, ...]
    groups: tuple[tuple[Place, ...], ...]
    """The stations of each group: a, b, and c if there are three."""

    @property
    def places(self) -> tuple[Place, ...]:
        """All stations."""
        return tuple(place for group in self.groups for place in group)


def layout_of(name: LayoutName, arms: int, stations: int = 2, *, pitch_m: float = 0.8, front_m: float = 0.4) -> Layout:
    """The layout of this name.

    Args:
        arms: At least 2; a bench and a ring have at least 4, and a bench an even number.
        stations: In each group, 2 or 3.
        pitch_m: Distance between neighbours.
        front_m: Distance of the stations in front of the line between two neighbours.

    Raises:
        ValueError: the layout cannot have so many arms or stations.
    """
    least = 4 if name in ("bench", "ring") else 2
    if arms < least or (name == "bench" and arms % 2):
        even = ", an even number" if name == "bench" else ""
        raise ValueError(f"A {name} has at least {least} arms{even} (got {arms}).")
    if stations not in (2, 3):
        raise ValueError(f"stations must be 2 or 3 (got {stations}).")
    return _LAYOUTS[name](arms, stations, pitch_m, front_m)


def _line(arms: int, stations: int, pitch_m: float, front_m: float) -> Layout:
    """Arms on the floor in rows; the stations are in front of them."""
    rows = ceil(arms / MOST_IN_ROW)
    lengths = [arms // rows + (row < arms % rows) for row in range(rows)]
    spots = [(x, APART_M * (row - (rows - 1) / 2)) for row, n in enumerate(lengths) for x in _along(n, pitch_m)]
    mounted = tuple(_arm(i, (x, y, 0.0), (0.0, 0.0, 90.0)) for i, (x, y) in enumerate(spots))
    middles = [((x + next_x) / 2, y + front_m) for (x, y), (next_x, next_y) in pairwise(spots) if y == next_y]
    return Layout(mounted, tuple(_group(i, at, 0.0, 0.25, stations) for i, at in enumerate(middles)))


def _bench(arms: int, stations: int, pitch_m: float, front_m: float) -> Layout:
    """Two rows of arms that face each other across a bench; each group has stations on both sides of its middle."""
    across_m, columns = front_m + 0.15, arms // 2
    mounted = [
        _arm(2 * i + row, (x, side * across_m, 0.0), (0.0, 0.0, -90.0 * side))
        for i, x in enumerate(_along(columns, pitch_m))
        for row, side in enumerate((-1.0, 1.0))
    ]
    groups = [
        _group(2 * i + row, ((x + next_x) / 2, side * 0.15), 0.0, 0.25, stations)
        for i, (x, next_x) in enumerate(pairwise(_along(columns, pitch_m)))
        for row, side in enumerate((-1.0, 1.0))
    ]
    return Layout(tuple(mounted), tuple(groups))


def _ring(arms: int, stations: int, pitch_m: float, front_m: float) -> Layout:
    """Arms in a circle that face outwards; the stations are around it."""
    radius_m = pitch_m / 2 / sin(pi / arms)
    around = [2 * pi * i / arms for i in range(arms)]
    bases = [(radius_m * cos(a), radius_m * sin(a), 0.0) for a in around]
    mounted = [_arm(i, base, (0.0, 0.0, degrees(a))) for i, (base, a) in enumerate(zip(bases, around, strict=True))]
    out_m = radius_m * cos(pi / arms) + front_m
    between = [a + pi / arms for a in around]
    groups = [_group(i, (out_m * cos(a), out_m * sin(a)), a - pi / 2, 0.25, stations) for i, a in enumerate(between)]
    return Layout(tuple(mounted), tuple(groups))


def _gantry(arms: int, stations: int, pitch_m: float, front_m: float) -> Layout:
    """Arms that hang from a beam in a row; the stations are in front of it, below."""
    along = _along(arms, pitch_m)
    mounted = tuple(_arm(i, (x, 0.0, 1.2), (180.0, 0.0, 90.0)) for i, x in enumerate(along))
    middles = [((x + next_x) / 2, front_m - 0.08) for x, next_x in pairwise(along)]
    return Layout(mounted, tuple(_group(i, at, 0.0, 0.45, stations) for i, at in enumerate(middles)))


def _wall_ceiling(arms: int, stations: int, pitch_m: float, front_m: float) -> Layout:
    """Arms in turns on a wall and on the ceiling; the stations are between wall and beam."""
    wall, ceiling = ((1.0, 0.5), (90.0, 0.0, 0.0)), ((0.1, 1.2), (180.0, 0.0, 90.0))
    along = _along(arms, pitch_m)
    mounts = [(x, *(wall, ceiling)[i % 2]) for i, x in enumerate(along)]
    mounted = tuple(_arm(i, (x, y, z), tilt) for i, (x, (y, z), tilt) in enumerate(mounts))
    middles = [((x + next_x) / 2, front_m) for x, next_x in pairwise(along)]
    return Layout(mounted, tuple(_group(i, at, 0.0, 0.45, stations) for i, at in enumerate(middles)))


_LAYOUTS: dict[LayoutName, Callable[[int, int, float, float], Layout]] = {
    "bench": _bench,
    "line": _line,
    "ring": _ring,
    "gantry": _gantry,
    "wall_ceiling": _wall_ceiling,
}


def _along(arms: int, pitch_m: float) -> list[float]:
    """Coordinates of a row of arms about its middle, m."""
    return [(i - (arms - 1) / 2) * pitch_m for i in range(arms)]


def _arm(number: int, at: tuple[float, float, float], tilt: tuple[float, float, float]) -> ArmSpec:
    return ArmSpec(name=f"arm_{number:02d}", position_m=_rounded(*at), tilt_deg=_rounded(*tilt), home=HOME)


def _group(number: int, middle: tuple[float, float], turn: float, height_m: float, stations: int) -> tuple[Place, ...]:
    """The stations around a middle; `turn` is the direction from a to b, rad."""
    turned = rotation((0.0, 0.0, degrees(turn)))
    spots = ((-SIDE_M, 0.0, 0.0), (SIDE_M, 0.0, 0.0), (0.0, 0.06, 0.1))[:stations]
    ends = [(middle[0], middle[1], height_m) + turned @ spot for spot in spots]
    return tuple(
        Place(name=f"{letter}_{number:02d}", position_m=_rounded(*map(float, end)))
        for letter, end in zip("abc", ends, strict=False)
    )


def _rounded(x: float, y: float, z: float) -> tuple[float, float, float]:
    return (round(x, DIGITS) + 0.0, round(y, DIGITS) + 0.0, round(z, DIGITS) + 0.0)
