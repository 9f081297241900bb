"""Space of an arm along a plan: its links as capsules at closely spaced postures."""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from fleet.job import payload_radius_m
from fleet.motion import Plan, distinct
from fleet.physics.models import ArmModel, links_of

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
