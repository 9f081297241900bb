"""Space of a cell: which plans of two arms exclude each other, and which plans come too close to an arm at home.

The space of a plan is the volume through which the links and the payload move, from home to home: capsules at closely
spaced postures. Plans of one arm through the same postures share one volume, with the heaviest payload; speed and dwell
have no effect. A table numbers the volumes of a cell.
"""

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fleet.arm.gen3 import gen3_xml
from fleet.arm.plan_cache import cached_arrays
from fleet.arm.time_limit import check_time
from fleet.job import Work
from fleet.motion import Plan
from fleet.robot import Robot

if TYPE_CHECKING:
    from fleet.arm.clearance import Capsules, Clearance, Sweep

Array = np.ndarray
PlanKey = tuple[str, Work, int, float]
"""Arm, task, elbow and speed of a plan; equal in all processes."""

SPACE_VERSION = 1
"""Increment it whenever the space of the same plans changes."""
FARTHEST_M = 1.5
"""Upper bound of the distance from the base to any part of an arm and its payload: 0.29 m to joint 2, 0.91 m to the
flange, a payload of 0.2 m, and the radius of a link."""


class Sphere(NamedTuple):
    """A sphere in the frame of the cell, m."""

    x: float
    y: float
    z: float
    radius: float

    def gap_m(self, other: "Sphere") -> float:
        """Distance to another sphere, negative if they overlap."""
        return math.dist(self[:3], other[:3]) - self.radius - other.radius


def workspace(robot: Robot) -> Sphere:
    """Sphere that contains all that an arm can reach."""
    return Sphere(*robot.mount.position_m, FARTHEST_M)


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

    def by_path(self, plans: Sequence[Plan]) -> dict[str, tuple[int, float]]:
        """Number of the volume of each path that these plans follow, and its heaviest payload, kg; see `path_of`."""
        volumes: dict[str, tuple[int, float]] = {}
        for plan, row in zip(plans, self.rows(plans)[0].tolist(), strict=True):
            path, payload_kg = path_of(space_name(plan))
            volumes[path] = row, max(payload_kg, volumes.get(path, (row, 0.0))[1])
        return volumes


def plan_key(plan: Plan) -> PlanKey:
    """Key of a plan in a `SpaceTable`."""
    return plan.arm, plan.work, plan.elbow, plan.speed


def space_name(plan: Plan) -> str:
    """Name of the space of a plan on the bus, the same in all processes: a hash of arm and postures, and the payload.

    So a job has the space of another one with the same motion, whatever its speed and dwell.
    """
    path = hashlib.sha256(plan.arm.encode() + plan.stops.tobytes()).hexdigest()[:16]
    return f"{path}@{float(plan.work.payload_kg)!r}"


def path_of(space: str) -> tuple[str, float]:
    """Path and payload, kg, of the name of a space; payload inf if the name states none."""
    path, _, payload_kg = space.partition("@")
    try:
        return path, float(payload_kg)
    except ValueError:
        return space, math.inf


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
        from fleet.arm.clearance import clearance

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
            row = rows.setdefault(plan.stops.tobytes(), len(rows))
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
        paths = hashlib.sha256(b"".join(plan.stops.tobytes() for plan in self.plan)).hexdigest()
        return {**_geometry(self.robot), "paths": paths, "payload_kg": self.heaviest}


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
    return workspace(one).gap_m(workspace(other)) < margin_m


def _comparison(one: _Paths, other: _Paths, margin_m: float) -> Callable[[], dict[str, Array]]:
    def compute() -> dict[str, Array]:
        from fleet.arm.clearance import conflict

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
    from fleet.arm.clearance import Capsules
    from fleet.arm.model import ArmModel

    return Capsules(ArmModel(robot))


@lru_cache(maxsize=256)
def _home(robot: Robot) -> "Sweep":
    return _capsules(robot).sweep(robot.home_q()[None])


def _home_reason(sweep: "Sweep", homes: Sequence[tuple[str, "Sweep"]], margin_m: float) -> str:
    """A sentence with the arms at home to which a sweep comes too close; empty if none."""
    from fleet.arm.clearance import clearance

    near = [(name, clearance(sweep, home, margin_m)) for name, home in homes]
    return " and ".join(
        f"{found.link} {_distance(found, margin_m)} {name} ({found.other_link}) at home"
        for name, found in near
        if found
    )


def _distance(near: "Clearance", margin_m: float) -> str:
    return "collides with" if near.distance_m <= 0 else f"comes within {margin_m * 1e3:g} mm of"
