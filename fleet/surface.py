"""Surfaces of solids as plain values: triangles to draw, and convex parts that stand for them in distances."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Triangles between points, in the frame of a solid; arrays are base64 of little-endian values."""

    points: str
    """Coordinates, m, float32 [point, 3]."""
    triangles: str
    """Points of each triangle, uint32 [triangle, 3]."""
    parts: tuple[str, ...] = ()
    """Corners of each convex part, m, float32 [corner, 3]."""

    @property
    def points_m(self) -> Array:
        """Coordinates, m, [point, 3]."""
        return _decoded(self.points, "<f4")

    @property
    def corners(self) -> Array:
        """Points of each triangle, int [triangle, 3]."""
        return _decoded(self.triangles, "<u4")

    @property
    def parts_m(self) -> tuple[Array, ...]:
        """Corners of each convex part, m, [corner, 3]."""
        return tuple(_decoded(part, "<f4") for part in self.parts)


def surface_of(points_m: Array, triangles: Array, parts_m: Sequence[Array] = ()) -> Surface:
    """The surface with these arrays, as `Surface` has them."""
    points, *parts = (_encoded(each, "<f4") for each in (points_m, *parts_m))
    return Surface(points=points, triangles=_encoded(triangles, "<u4"), parts=tuple(parts))


def _encoded(values: Array, kind: str) -> str:
    return base64.b64encode(values.astype(kind).tobytes()).decode("ascii")


def _decoded(text: str, kind: str) -> Array:
    return np.frombuffer(base64.b64decode(text), kind).reshape(-1, 3)
