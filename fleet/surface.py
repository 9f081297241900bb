"""Surfaces of fixtures as plain text, and the convex parts that stand for them in distances."""

import base64
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

Array = np.ndarray

MOST_PARTS = 64
"""Convex parts of one surface."""
FLAT_M = 1e-4
"""A part that is thinner than this in some direction has no inside."""
INSIDE_M = 1e-6
"""Tolerance within which a part counts as inside another."""
CHUNK = 32
"""Corners compared with the sides of a part at once."""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Triangles between points, in the frame of their fixture; see `surface_of`."""

    points: str
    """Coordinates, m, float32 [point, 3], little-endian, as base64."""
    triangles: str
    """Points of each triangle, uint32 [triangle, 3], little-endian, as base64."""


def surface_of(points_m: Array, triangles: Array) -> Surface:
    """The surface of triangles, int [triangle, 3], between points, m, [point, 3]."""
    encoded = (np.asarray(points_m, "<f4"), np.asarray(triangles, "<u4"))
    points, corners = (base64.b64encode(values.tobytes()).decode("ascii") for values in encoded)
    return Surface(points=points, triangles=corners)


@lru_cache(maxsize=64)
def arrays_of(surface: Surface) -> tuple[Array, Array]:
    """Points, m, [point, 3], and triangles, int [triangle, 3].

    Raises:
        ValueError: the text holds no such arrays.
    """
    points_m = np.frombuffer(base64.b64decode(surface.points), "<f4").reshape(-1, 3).astype(float)
    triangles = np.frombuffer(base64.b64decode(surface.triangles), "<u4").reshape(-1, 3).astype(int)
    if not (len(triangles) and np.isfinite(points_m).all() and triangles.max() < len(points_m)):
        raise ValueError("it has no triangles, or a triangle without a point")
    return points_m, triangles


@lru_cache(maxsize=64)
def convex_parts(surface: Surface) -> tuple[Array, ...]:
    """Corners of the convex hull of each connected part, m, [corner, 3], the largest part first.

    Two triangles are connected if they alone share an edge, so bodies that touch stay apart. Parts inside the hull of
    another are left out.

    Raises:
        ValueError: a part is flat, or there are more than `MOST_PARTS`.
    """
    from scipy.spatial import ConvexHull

    points_m, triangles = arrays_of(surface)
    hulls, flat = [], list[Array]()
    label = _connected(triangles)
    order = np.argsort(label, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        corners = points_m[np.unique(triangles[members])]
        if _thickness_m(corners) < FLAT_M:
            flat.append(corners)
        else:
            hulls.append(ConvexHull(corners))
    hulls.sort(key=lambda hull: -hull.volume)
    kept: list[tuple[Array, Array]] = []
    for hull in hulls:
        corners = hull.points[hull.vertices]
        if not _inside(corners, kept):
            kept.append((corners, hull.equations))
        if len(kept) > MOST_PARTS:
            raise ValueError(f"it has more than {MOST_PARTS} separate parts; leave out small ones")
    for corners in flat:
        if not _inside(corners, kept):
            size = " × ".join(f"{length:.3g}" for length in np.ptp(corners, axis=0))
            raise ValueError(f"a part of {size} m is flat; give it a thickness, or leave it out")
    return tuple(corners for corners, _ in kept)


def _connected(triangles: Array) -> Array:
    """Number of the connected part of each triangle, [triangle]."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, edge, uses = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    pairs = np.argsort(edge, kind="stable")[np.repeat(uses == 2, uses)].reshape(-1, 2) // 3
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(triangles),) * 2)
    return connected_components(graph, directed=False)[1]


def _thickness_m(corners: Array) -> float:
    """Extent of points along the direction in which they extend least."""
    centred = corners - corners.mean(axis=0)
    return float(np.ptp(centred @ np.linalg.eigh(centred.T @ centred)[1], axis=0).min())


def _inside(corners: Array, hulls: list[tuple[Array, Array]]) -> bool:
    """Whether points are all inside one of some hulls, each with its corners and the equations of its sides."""
    low, high = corners.min(axis=0) + INSIDE_M, corners.max(axis=0) - INSIDE_M
    chunks = [corners[i : i + CHUNK] for i in range(0, len(corners), CHUNK)]
    return any(
        (others.min(axis=0) <= low).all()
        and (high <= others.max(axis=0)).all()
        and all((chunk @ sides[:, :3].T + sides[:, 3] <= INSIDE_M).all() for chunk in chunks)
        for others, sides in hulls
    )
