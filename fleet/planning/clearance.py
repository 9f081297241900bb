"""Smallest distance between two arms over all pairs of positions on their paths.

A search through trees of bounding boxes finds the closest capsules. The distance of two capsules is that of their axes,
which are segments, minus the radii (C. Ericson, Real-Time Collision Detection, 2005, section 5.1.9).
"""

from dataclasses import dataclass

import numpy as np

from fleet.planning.sweep import LEAF, Sweep

Array = np.ndarray

CHUNK = 512
"""Pairs of nodes that are looked at together."""


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
    """Smallest distance below the cutoff, and the indices of its two capsules (−1 for none).

    The search takes up to `CHUNK` pairs of nodes at a time, the last ones first, so that memory stays bounded.

    Args:
        enough_m: The search ends when it has found a distance below this.
    """
    best, at_a, at_b = cutoff_m, -1, -1
    leaves_a, leaves_b = one.boxes_m.shape[1] // 2, other.boxes_m.shape[1] // 2
    i, j = np.divmod(np.arange(len(one.radius_m) * len(other.radius_m)), len(other.radius_m))
    stack = [np.stack([i, np.ones_like(i), j, np.ones_like(j)], axis=1)]  # [pair, (capsule, node, capsule, node)]
    while stack:
        pairs = stack.pop()
        if len(pairs) > CHUNK:
            stack.append(pairs[:-CHUNK])
            pairs = pairs[-CHUNK:]
        i, a, j, b = pairs.T
        pairs = pairs[_box_distance(one.boxes_m[i, a], other.boxes_m[j, b]) < best]
        i, a, j, b = pairs.T
        at_leaf = (a >= leaves_a) & (b >= leaves_b)
        split_a = (a < leaves_a) & ((b >= leaves_b) | (a <= b))
        children = np.repeat(pairs[~at_leaf], 2, axis=0)
        rows, column = np.arange(len(children)), np.repeat(np.where(split_a, 1, 3)[~at_leaf], 2)
        children[rows, column] = 2 * children[rows, column] + rows % 2
        if len(children):
            stack.append(children)
        i, a, j, b = pairs[at_leaf].T
        if len(i):
            ends_a, ends_b = _leaf_ends(one, i, a - leaves_a), _leaf_ends(other, j, b - leaves_b)
            apart_m = segment_distance(ends_a[:, :, None], ends_b[:, None]).min(axis=(1, 2))
            apart_m -= one.radius_m[i] + other.radius_m[j]
            closest = int(apart_m.argmin())
            if apart_m[closest] < best:
                best, at_a, at_b = float(apart_m[closest]), int(i[closest]), int(j[closest])
                if best < enough_m:
                    break
    return best, at_a, at_b


def _leaf_ends(sweep: Sweep, capsule: Array, leaf: Array) -> Array:
    """Ends of the axes of each capsule at the postures of a leaf, [pair, posture, end, 3]; the last leaf is padded."""
    postures = np.minimum(leaf[:, None] * LEAF + np.arange(LEAF), sweep.ends_m.shape[1] - 1)
    return sweep.ends_m[capsule[:, None], postures].astype(float)


def _box_distance(a: Array, b: Array) -> Array:
    """Distance of boxes [pair, (low, high), 3], m, [pair]; −inf for boxes that touch."""
    gap_m = np.maximum(np.maximum(a[:, 0] - b[:, 1], b[:, 0] - a[:, 1]), 0.0)
    return np.where(gap_m.any(axis=1), np.linalg.norm(gap_m, axis=1), -np.inf)


def segment_distance(a: Array, b: Array) -> Array:
    """Distance of segments [..., end, 3], m."""
    u, v, r = a[..., 1, :] - a[..., 0, :], b[..., 1, :] - b[..., 0, :], a[..., 0, :] - b[..., 0, :]
    aa, bb, ab, ar, br = ((x * y).sum(axis=-1) for x, y in ((u, u), (v, v), (u, v), (u, r), (v, r)))
    determinant = aa * bb - ab * ab
    is_point_a, is_point_b = aa <= 1e-12, bb <= 1e-12
    # Nearest point on each segment, 0 to 1.
    skew = determinant > 1e-12
    s = np.where(skew, np.clip((ab * br - ar * bb) / np.where(skew, determinant, 1.0), 0.0, 1.0), 0.0)
    t = np.where(is_point_b, 0.0, (ab * s + br) / np.where(is_point_b, 1.0, bb))
    at_end = (t < 0.0) | (t > 1.0) | is_point_b
    t = np.clip(t, 0.0, 1.0)
    nearest = np.where(is_point_a, 0.0, np.clip((ab * t - ar) / np.where(is_point_a, 1.0, aa), 0.0, 1.0))
    s = np.where(at_end, nearest, s)
    return np.linalg.norm(r + s[..., None] * u - t[..., None] * v, axis=-1)
