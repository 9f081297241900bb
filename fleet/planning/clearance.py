"""Smallest distance between two arms over all pairs of positions on their paths.

A search through trees of bounding boxes finds the closest capsules. The distance of two capsules is that of their axes,
which are segments, minus the radii (C. Ericson, Real-Time Collision Detection, 2005, section 5.1.9).
"""

from dataclasses import dataclass

import numpy as np

from fleet.jit import jit_inline, kernel
from fleet.planning.sweep import LEAF, Sweep

Array = np.ndarray


@dataclass(frozen=True)
class Clearance:
    """Smallest distance between two sweeps."""

    distance_m: float
    """Negative if they intersect."""
    link: str
    """Link of the first sweep at the smallest distance, or its payload."""
    other_link: str
    """The same of the second sweep."""


def clearance(one: Sweep, other: Sweep, cutoff_m: float = np.inf) -> Clearance | None:
    """Smallest distance between two sweeps; None if it is not less than the cutoff."""
    distance_m, i, j = _search(one, other, cutoff_m, -np.inf)
    return None if i < 0 else Clearance(distance_m, one.links[i], other.links[j])


def conflict(one: Sweep, other: Sweep, margin_m: float) -> bool:
    """Whether two sweeps come closer than a margin."""
    return _search(one, other, margin_m, margin_m)[1] >= 0


def _search(one: Sweep, other: Sweep, cutoff_m: float, enough_m: float) -> tuple[float, int, int]:
    return search.chosen()(
        one.ends_m, one.radius_m, one.boxes_m, other.ends_m, other.radius_m, other.boxes_m, cutoff_m, enough_m
    )


@kernel
def search(
    ends_a: Array, radius_a: Array, boxes_a: Array, ends_b: Array, radius_b: Array, boxes_b: Array,
    cutoff_m: float, enough_m: float,
) -> tuple[float, int, int]:  # fmt: skip
    """Smallest distance below the cutoff, and the indices of its two capsules (−1 for none).

    Args:
        ends_a, radius_a, boxes_a: As in `Sweep`; `…_b` are those of the other sweep.
        enough_m: The search ends at the first distance below this.
    """
    best, at_a, at_b = cutoff_m, -1, -1
    leaves_a, leaves_b = boxes_a.shape[1] // 2, boxes_b.shape[1] // 2
    stack = np.empty((128, 2), np.int64)
    for i in range(len(radius_a)):
        for j in range(len(radius_b)):
            both_m = radius_a[i] + radius_b[j]
            used = 1
            stack[0, 0], stack[0, 1] = 1, 1
            while used > 0:
                used -= 1
                a, b = stack[used, 0], stack[used, 1]
                if box_distance(boxes_a[i, a], boxes_b[j, b]) >= best:
                    continue
                if a < leaves_a and (b >= leaves_b or a <= b):
                    stack[used, 0], stack[used, 1] = 2 * a, b
                    stack[used + 1, 0], stack[used + 1, 1] = 2 * a + 1, b
                    used += 2
                elif b < leaves_b:
                    stack[used, 0], stack[used, 1] = a, 2 * b
                    stack[used + 1, 0], stack[used + 1, 1] = a, 2 * b + 1
                    used += 2
                else:
                    first_a, first_b = (a - leaves_a) * LEAF, (b - leaves_b) * LEAF
                    for p in range(first_a, min(first_a + LEAF, ends_a.shape[1])):
                        for q in range(first_b, min(first_b + LEAF, ends_b.shape[1])):
                            apart_m = segment_distance(ends_a[i, p], ends_b[j, q]) - both_m
                            if apart_m < best:
                                best, at_a, at_b = apart_m, i, j
                                if best < enough_m:
                                    return best, at_a, at_b
    return best, at_a, at_b


@jit_inline
def box_distance(a: Array, b: Array) -> float:
    """Distance of two boxes [(low, high), 3], m; −inf if they touch."""
    square = 0.0
    for k in range(3):
        gap = max(a[0, k] - b[1, k], b[0, k] - a[1, k])
        if gap > 0.0:
            square += gap * gap
    return np.sqrt(square) if square > 0.0 else -np.inf


@jit_inline
def segment_distance(a: Array, b: Array) -> float:
    """Distance of two segments [end, 3], m."""
    aa = bb = ab = ar = br = 0.0
    for k in range(3):
        u, v, r = float(a[1, k] - a[0, k]), float(b[1, k] - b[0, k]), float(a[0, k] - b[0, k])
        aa, bb, ab, ar, br = aa + u * u, bb + v * v, ab + u * v, ar + u * r, br + v * r
    s = t = 0.0  # nearest point on each segment, 0 to 1
    determinant = aa * bb - ab * ab
    if determinant > 1e-12:
        s = min(max((ab * br - ar * bb) / determinant, 0.0), 1.0)
    if bb > 1e-12:
        t = (ab * s + br) / bb
    if t < 0.0 or t > 1.0 or bb <= 1e-12:
        t = min(max(t, 0.0), 1.0)
        s = min(max((ab * t - ar) / aa, 0.0), 1.0) if aa > 1e-12 else 0.0
    square = 0.0
    for k in range(3):
        gap = (a[0, k] - b[0, k]) + s * (a[1, k] - a[0, k]) - t * (b[1, k] - b[0, k])
        square += gap * gap
    return np.sqrt(square)
