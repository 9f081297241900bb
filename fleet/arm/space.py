"""Space of a cell: which plans of two arms exclude each other, and which plans come too close to an arm at home.

The space of a plan is the volume through which the links and the payload move, from home to home: capsules at closely
spaced postures. Plans of one arm through the same postures share one volume, with the heaviest payload; speed and dwell
have no effect. A table numbers the volumes of a cell.

A search through trees of bounding boxes finds the closest capsules of two arms. The distance of two capsules is that of
their axes, which are segments, minus the radii (C. Ericson, Real-Time Collision Detection, 2005, section 5.1.9).
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np

from fleet.arm.model import ArmModel, gen3_xml, links_of
from fleet.arm.plan_cache import cached_arrays
from fleet.arm.trajectory import check_time
from fleet.job import Work, payload_radius_m
from fleet.motion import Plan, distinct
from fleet.robot import Robot

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

Array = np.ndarray
PlanKey = tuple[str, Work, int, float]
"""Arm, task, elbow and speed of a plan; equal in all processes."""

SPACE_VERSION = 1
"""Increment it whenever the space of the same plans changes."""
FARTHEST_M = 1.5
"""Upper bound of the distance from the base to any part of an arm and its payload: 0.29 m to joint 2, 0.91 m to the
flange, a payload of 0.2 m, and the radius of a link."""


@dataclass(frozen=True, eq=False)
class SpaceTable:
    """Volume of each plan of a cell, and which volumes exclude each other."""

    volume: Mapping[PlanKey, int]
    """Number of the volume of each plan."""
    conflicts: Array
    """Whether two volumes come closer than the margin, bool [volume, volume]; True for any two volumes of one arm."""

    def rows(self, plans: Sequence[Plan]) -> tuple[Array, Array]:
        """Number of the volume of each plan, int [plan], and `conflicts`.

        Raises:
            ValueError: a plan is not in the table.
        """
        missing = [plan for plan in plans if plan_key(plan) not in self.volume]
        if missing:
            raise ValueError(
                f"No space is known for a {missing[0].work.kind} of arm '{missing[0].arm}' at "
                f"'{missing[0].work.places[0].name}'; compute the table with all plans of the cell."
            )
        return np.array([self.volume[plan_key(plan)] for plan in plans], dtype=int), self.conflicts


def plan_key(plan: Plan) -> PlanKey:
    """Key of a plan in a `SpaceTable`."""
    return plan.arm, plan.work, plan.elbow, plan.speed


def space_name(key: PlanKey) -> str:
    """Name of the space of a plan on the bus: a hash of the key, so it is the same in all processes."""
    arm, work, elbow, speed = key
    places = [[place.name, *map(float, (*place.position_m, *place.tool_deg, place.retreat_m))] for place in work.places]
    numbers = [float(value) for value in (work.payload_kg, work.dwell_s, work.force_n, elbow, speed)]
    content = json.dumps([arm, work.kind, places, numbers])
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def arms_in_reach(robots: Sequence[Robot], margin_m: float) -> frozenset[frozenset[str]]:
    """Pairs of arms, by name, that could come closer to each other than a margin in some posture."""
    pairs = combinations(robots, 2)
    return frozenset(frozenset((one.name, other.name)) for one, other in pairs if _in_reach(one, other, margin_m))


def space_table(
    robots: Sequence[Robot],
    plans: Sequence[Plan],
    margin_m: float,
    cache_dir: Path,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> SpaceTable:
    """The volumes of the plans of a cell and their conflicts; cached for each pair of arms.

    Args:
        robots: The arms of the cell.
        plans: All plans of these arms that `SpaceTable.rows` will look up.
        margin_m: Two volumes that come closer than this exclude each other.
        report: Called with the number of pairs of arms that are done, and of all.
    """
    paths = [_Paths(robot, plans) for robot in robots]
    ends = np.cumsum([0, *(len(own.heaviest) for own in paths)])
    conflicts = np.zeros((ends[-1], ends[-1]), dtype=bool)
    volume: dict[PlanKey, int] = {}
    for i, own in enumerate(paths):
        conflicts[ends[i] : ends[i + 1], ends[i] : ends[i + 1]] = True
        volume.update({key: int(ends[i] + row) for key, row in own.row.items()})
    pairs = [
        (one, other)
        for one, other in combinations(enumerate(paths), 2)
        if _in_reach(one[1].robot, other[1].robot, margin_m)
    ]
    for done, ((i, one), (j, other)) in enumerate(pairs):
        report(done, len(pairs))
        key = {"what": "conflicts", "margin_m": margin_m, "arms": [one.content(), other.content()]}
        block = cached_arrays(cache_dir, key, _comparison(one, other, margin_m))["conflicts"]
        conflicts[ends[i] : ends[i + 1], ends[j] : ends[j + 1]] = block
        conflicts[ends[j] : ends[j + 1], ends[i] : ends[i + 1]] = block.T
    return SpaceTable(volume, conflicts)


def conflicts_with_homes(
    robot: Robot, others: Sequence[Robot], plans: Sequence[Plan], margin_m: float, cache_dir: Path
) -> list[str | None]:
    """Reason why each plan comes too close to other arms at home, or None.

    Args:
        plans: Plans of `robot`; the result for one plan does not depend on the other plans.
    """
    paths = _Paths(robot, plans)
    near = [other for other in others if _in_reach(robot, other, margin_m)]

    def compute() -> dict[str, Array]:
        homes = [(other.name, _home(other)) for other in near]
        reasons: list[str] = []
        for load in paths.loads:
            check_time()
            reasons.append(_home_reason(paths.sweep(*load), homes, margin_m))
        return {"reasons": np.array(reasons, dtype=str)}

    if not near or not paths.loads:
        return [None] * len(plans)
    arms = [(other.name, _geometry(other)) for other in near]
    key = {
        "what": "homes beside plans",
        "margin_m": margin_m,
        "arms": arms,
        "plans": paths.content(),
        "loads": paths.loads,
    }
    reasons = dict(zip(paths.loads, cached_arrays(cache_dir, key, compute)["reasons"].tolist(), strict=True))
    return [reasons[paths.row[plan_key(plan)], plan.work.payload_kg] or None for plan in plans]


def collisions_of_homes(robots: Sequence[Robot], margin_m: float, cache_dir: Path) -> list[str]:
    """One sentence for each pair of arms that are closer to each other than a margin while both are at home."""

    def compute() -> dict[str, Array]:

        sentences = []
        for one, other in combinations(robots, 2):
            if _in_reach(one, other, margin_m) and (near := clearance(_home(one), _home(other), margin_m)):
                where = f"{_distance(near, margin_m)} '{other.name}' ({near.other_link})"
                sentences.append(f"at home '{one.name}' ({near.link}) {where}")
        return {"sentences": np.array(sentences, dtype=str)}

    key = {"what": "homes", "margin_m": margin_m, "arms": [(robot.name, _geometry(robot)) for robot in robots]}
    return cached_arrays(cache_dir, key, compute)["sentences"].tolist()


class _Paths:
    """The distinct paths of one arm's plans, numbered."""

    def __init__(self, robot: Robot, plans: Sequence[Plan]) -> None:
        self.robot = robot
        self.row: dict[PlanKey, int] = {}
        """Number of the path of each plan."""
        rows: dict[bytes, int] = {}
        self.plan: list[Plan] = []
        """One plan for each path."""
        self.heaviest: list[float] = []
        """Heaviest payload on each path, kg."""
        for plan in plans:
            if plan.arm != robot.name:
                continue
            row = rows.setdefault(_stops(plan).tobytes(), len(rows))
            if row == len(self.plan):
                self.plan.append(plan)
                self.heaviest.append(0.0)
            self.row[plan_key(plan)] = row
            self.heaviest[row] = max(self.heaviest[row], plan.work.payload_kg)
        self.loads = sorted({(row, work.payload_kg) for (_, work, _, _), row in self.row.items()})
        """Each path with each payload that is carried along it: (path, kg)."""
        self.sweeps: Callable[[], list[Sweep]] = cache(
            lambda: [self.sweep(row, payload_kg) for row, payload_kg in enumerate(self.heaviest)]
        )
        """Space of each path with its heaviest payload."""
        self._capsules: Callable[[], Capsules] = cache(lambda: _capsules(robot))

    def sweep(self, row: int, payload_kg: float) -> "Sweep":
        """Space of a path with a payload."""
        return self._capsules().of_plan(self.plan[row], payload_kg)

    def content(self) -> dict[str, object]:
        """All that determines the space of the paths, for cache keys."""
        paths = hashlib.sha256(b"".join(_stops(plan).tobytes() for plan in self.plan)).hexdigest()
        return {**_geometry(self.robot), "paths": paths, "payload_kg": self.heaviest}


def _stops(plan: Plan) -> Array:
    """Postures at which the arm stops along a plan, float32 [stop, joint]; joint paths between them are straight."""
    profiles = [distinct(phase.profile) for phase in plan.phases]
    stops = np.concatenate([profile[(profile[:, 1] == 0).all(axis=1), 0] for profile in profiles])
    return stops[np.append(True, (np.diff(stops, axis=0) != 0).any(axis=1))]


def _geometry(robot: Robot) -> dict[str, object]:
    """All that determines the space of an arm in a posture, and its home."""
    return {
        "space": SPACE_VERSION,
        "model": hashlib.sha256(gen3_xml()).hexdigest(),
        "position_m": robot.mount.position_m,
        "tilt_deg": robot.mount.tilt_deg,
        "home": robot.home_q().tolist(),
    }


def _in_reach(one: Robot, other: Robot, margin_m: float) -> bool:
    apart_m = np.linalg.norm(np.subtract(one.mount.position_m, other.mount.position_m))
    return bool(apart_m < 2 * FARTHEST_M + margin_m)


def _comparison(one: _Paths, other: _Paths, margin_m: float) -> Callable[[], dict[str, Array]]:
    def compute() -> dict[str, Array]:

        boxes, others = _boxes(one.sweeps()), _boxes(other.sweeps())
        gap_m = np.maximum(boxes[:, None, 0] - others[None, :, 1], others[None, :, 0] - boxes[:, None, 1])
        block = np.linalg.norm(np.maximum(gap_m, 0.0), axis=-1) < margin_m
        for i, j in np.argwhere(block):
            block[i, j] = conflict(one.sweeps()[i], other.sweeps()[j], margin_m)
        return {"conflicts": block}

    return compute


def _boxes(sweeps: Sequence["Sweep"]) -> Array:
    """Bounding box of each sweep, m, [sweep, (low, high), 3]."""
    roots = [sweep.boxes_m[:, 1] for sweep in sweeps]
    return np.array([(root[:, 0].min(axis=0), root[:, 1].max(axis=0)) for root in roots]).reshape(-1, 2, 3)


def _capsules(robot: Robot) -> "Capsules":
    from fleet.arm.model import ArmModel

    return Capsules(ArmModel(robot))


@lru_cache(maxsize=256)
def _home(robot: Robot) -> "Sweep":
    return _capsules(robot).sweep(robot.home_q()[None])


def _home_reason(sweep: "Sweep", homes: Sequence[tuple[str, "Sweep"]], margin_m: float) -> str:
    """A sentence with the arms at home to which a sweep comes too close; empty if none."""

    near = [(name, clearance(sweep, home, margin_m)) for name, home in homes]
    return " and ".join(
        f"{found.link} {_distance(found, margin_m)} {name} ({found.other_link}) at home"
        for name, found in near
        if found
    )


def _distance(near: "Clearance", margin_m: float) -> str:
    return "collides with" if near.distance_m <= 0 else f"comes within {margin_m * 1e3:g} mm of"


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
