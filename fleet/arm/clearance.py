"""Clearance of two motions: links and payload as capsules in a tree of boxes, searched for the least distance.

A search through trees of bounding boxes finds the closest capsules. The distance of two capsules is that of their axes,
which are segments, minus the radii (C. Ericson, Real-Time Collision Detection, 2005, section 5.1.9).
"""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from fleet.arm.model import ArmModel, links_of
from fleet.job import payload_radius_m
from fleet.motion import Plan, distinct

Array = np.ndarray

STEP_RAD = 0.02
"""Largest joint step between two postures of a sweep: 18 mm at the end of an outstretched arm."""
LEAF = 8
"""Number of postures in one leaf of the tree of boxes."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """Capsules of one arm at the postures of a path."""

    links: tuple[str, ...]
    """Name of each capsule."""
    ends_m: Array
    """Ends of the capsules' axes in the world, float32 [capsule, posture, end, 3]."""
    radius_m: Array
    """Radius, [capsule]: that of the capsule plus half of its largest displacement between two postures, so that the
    capsules cover the motion between them."""

    @cached_property
    def boxes_m(self) -> Array:
        """Bounding boxes as one binary tree for each capsule, float32 [capsule, node, (low, high), 3].

        Node 1 is the root, 2 n and 2 n + 1 are the children of n, and the last half of the nodes are the leaves, each
        of `LEAF` postures.
        """
        capsules, postures = self.ends_m.shape[:2]
        leaves = 1 << max(0, int(np.ceil(np.log2(postures / LEAF))))
        ends = np.pad(self.ends_m, ((0, 0), (0, leaves * LEAF - postures), (0, 0), (0, 0)), mode="edge")
        ends = ends.reshape(capsules, leaves, 2 * LEAF, 3)
        boxes = np.empty((capsules, 2 * leaves, 2, 3), np.float32)
        radius = self.radius_m[:, None, None]
        boxes[:, leaves:, 0], boxes[:, leaves:, 1] = ends.min(axis=2) - radius, ends.max(axis=2) + radius
        while leaves > 1:
            leaves //= 2
            children = boxes[:, 2 * leaves : 4 * leaves].reshape(capsules, leaves, 2, 2, 3)
            boxes[:, leaves : 2 * leaves, 0] = children[:, :, :, 0].min(axis=2)
            boxes[:, leaves : 2 * leaves, 1] = children[:, :, :, 1].max(axis=2)
        return boxes


class Capsules:
    """The links of one arm as capsules.

    A cylinder becomes a capsule with the same axis and radius; a box becomes a capsule along its longest axis.
    """

    def __init__(self, arm: ArmModel) -> None:
        self._arm = arm
        model = arm.model
        self.links = (*links_of(model, arm.robot.name), "payload")
        geoms = [model.geom(f"{arm.robot.name}/{link}").id for link in self.links[:-1]]
        self._geoms = np.array(geoms)
        axis, half_m, radius_m = zip(*(_capsule_of(model, g) for g in geoms), strict=True)
        self._axis, self._half_m, self._radius_m = np.array(axis), np.array(half_m), np.array(radius_m)
        self._tool = model.site(f"{arm.robot.name}/tool").id

    def at(self, q: Array) -> Array:
        """Ends of the capsules' axes, m, [capsule, posture, end, 3]: the links, then position and axis of the tool.

        Args:
            q: rad, [posture, joint].
        """
        model, data = self._arm.model, self._arm.data
        ends = np.empty((len(q), len(self._geoms) + 1, 2, 3))
        for posture, joints in enumerate(q):
            data.qpos[:] = joints
            mujoco.mj_kinematics(model, data)
            frames = data.geom_xmat[self._geoms].reshape(-1, 3, 3)
            along = self._half_m[:, None] * np.take_along_axis(frames, self._axis[:, None, None], axis=2)[..., 0]
            centre = data.geom_xpos[self._geoms]
            ends[posture, :-1, 0], ends[posture, :-1, 1] = centre - along, centre + along
            ends[posture, -1, 0] = data.site_xpos[self._tool]
            ends[posture, -1, 1] = data.site_xmat[self._tool].reshape(3, 3)[:, 2]
        return ends.swapaxes(0, 1)

    def sweep(self, q: Array, payload_kg: float = 0.0) -> Sweep:
        """Space of the arm along a path.

        Args:
            q: rad, [posture, joint]; between two postures every joint moves less than `STEP_RAD`.
            payload_kg: Heaviest payload on the path; the whole path counts as loaded.
        """
        ends = self.at(q)
        ball_m = payload_radius_m(payload_kg)
        tool, direction = ends[-1, :, 0].copy(), ends[-1, :, 1].copy()
        ends[-1] = (tool + ball_m * direction)[:, None]
        moved_m = np.linalg.norm(np.diff(ends, axis=1), axis=-1).max(axis=(1, 2), initial=0.0)
        radius_m = np.append(self._radius_m, ball_m) + moved_m / 2
        kept = len(radius_m) - (payload_kg <= 0)
        return Sweep(self.links[:kept], ends[:kept].astype(np.float32), radius_m[:kept])

    def of_plan(self, plan: Plan, payload_kg: float | None = None) -> Sweep:
        """Space of the arm along a plan, from home to home.

        Args:
            payload_kg: Payload; default: that of the plan.
        """
        q = np.concatenate([distinct(phase.profile)[:, 0] for phase in plan.phases]).astype(float)
        travelled = np.concatenate([[0.0], np.abs(np.diff(q, axis=0)).max(axis=1).cumsum()])
        # Takes the last sample before each step, so no joint moves more than a step plus one sample between postures.
        wanted = np.arange(0.0, travelled[-1] + STEP_RAD, STEP_RAD)
        rows = np.unique(np.append(np.searchsorted(travelled, wanted, side="right") - 1, len(q) - 1))
        return self.sweep(q[rows], plan.work.payload_kg if payload_kg is None else payload_kg)


def _capsule_of(model: mujoco.MjModel, geom: int) -> tuple[int, float, float]:
    """Axis (0 to 2 of the geom's frame), half length and radius of a capsule around a geom, m."""
    size = model.geom_size[geom]
    if int(model.geom_type[geom]) in map(int, (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER)):
        return 2, float(size[1]), float(size[0])
    axis = int(np.argmax(size))
    return axis, float(size[axis]), float(np.hypot(*np.delete(size, axis)))


CHUNK = 512
"""Number of pairs of nodes compared at once."""


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
    # Closest point on each segment, 0 to 1.
    skew = determinant > 1e-12
    s = np.where(skew, np.clip((ab * br - ar * bb) / np.where(skew, determinant, 1.0), 0.0, 1.0), 0.0)
    t = np.where(is_point_b, 0.0, (ab * s + br) / np.where(is_point_b, 1.0, bb))
    at_end = (t < 0.0) | (t > 1.0) | is_point_b
    t = np.clip(t, 0.0, 1.0)
    nearest = np.where(is_point_a, 0.0, np.clip((ab * t - ar) / np.where(is_point_a, 1.0, aa), 0.0, 1.0))
    s = np.where(at_end, nearest, s)
    return np.linalg.norm(r + s[..., None] * u - t[..., None] * v, axis=-1)
