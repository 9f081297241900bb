"""A cell in MuJoCo: plain values for every way to show it, pictures and viewer of recorded postures, and contacts."""

import threading
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any  # plain values of JSON

import mujoco
import numpy as np

from fleet.arm.model import PLACE_M, RGB, build_cell, payload_bodies, quaternion, set_payload_balls, supports
from fleet.errors import FleetError
from fleet.events import Event
from fleet.job import MOST_PAYLOAD_M, PAYLOAD_KG_PER_M3, Fixture, Place
from fleet.robot import JOINTS, Mount, Robot, rotation
from fleet.surface import Surface, surface_of

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false


SHAPES = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}
"""Kinds of shapes; sizes as in MuJoCo: radius, half length along z, or half lengths along x, y and z."""
HIDDEN = 3
"""MuJoCo's geom group of the primitives that meshes replace."""
DIGITS = 5
Points = Sequence[float] | np.ndarray
MOTOR_M, HOT_MOTOR_M = 0.052, 0.074
"""Radius of the drum of a cool motor and of one at the error limit: a hotter motor is also larger."""
DRUM = 0.8
"""Half length of a drum along the axis of its joint, in radii."""


def cell_model(
    robots: Sequence[Robot],
    places: Sequence[Place] = (),
    fixtures: Sequence[Fixture] = (),
    *,
    meshes: bool = False,
) -> dict[str, Any]:
    """Arms, places and fixtures, with the movement of the links.

    Args:
        meshes: Kinova's shells instead of primitives.

    Returns:
        `links`: the bodies of one arm in the order of the chain, each with the index of its parent (-1 for the
        mount), its pose in the parent's frame, whether it turns about its z axis (joints in the order of the links),
        and its shapes. `motor`: radii of the drum round a joint, and its half length. `hand`: pose of the flange in the
        last link's frame. `arms`: names and poses of bases in the world. `places`, `fixtures`, and the `supports` that
        carry the arms: names, poses, full lengths, colours, and the `mesh` of a fixture that has one. `meshes`: the
        surfaces that shapes and fixtures name by index, fields of `fleet.surface.Surface`. `load`: of payloads.
        Positions and sizes are in m, quaternions w, x, y, z.

    Raises:
        FleetError: the meshes are not available.
    """
    model = build_cell([Robot(name="arm", mount=Mount())], meshes=meshes)
    first, payload = model.body("arm/base").id, model.body("arm/payload").id
    links: list[dict[str, Any]] = []
    for body in range(first, model.nbody):
        geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_group[g] != HIDDEN]
        shapes = [_shape(model, g) for g in geoms]
        if body == payload or (not shapes and not model.body_jntnum[body]):
            continue
        links.append(
            {
                "parent": int(model.body_parentid[body]) - first if body > first else -1,
                "position": _rounded(model.body_pos[body]),
                "quaternion": _rounded(model.body_quat[body]),
                "turns": bool(model.body_jntnum[body]),
                "shapes": shapes,
            }
        )
    surfaces = [vars(_asset(model, mesh)) for mesh in range(model.nmesh)]
    solids: list[dict[str, Any]] = []
    for each in fixtures:
        solids.append(_solid(each.name, each.position_m, rotation(each.tilt_deg), each.size_m, RGB["fixture"]))
        if each.surface is not None:
            solids[-1]["mesh"] = len(surfaces)
            surfaces.append(vars(replace(each.surface, parts=())))
    hand = {"position": _rounded(model.body_pos[payload]), "quaternion": _rounded(model.body_quat[payload])}
    return {
        "links": links,
        "hand": hand,
        "arms": [{"name": robot.name, **_pose(robot.mount.position_m, robot.mount.rotation())} for robot in robots],
        "places": [_solid(p.name, p.position_m, rotation(p.tool_deg), [PLACE_M] * 3, RGB["place"]) for p in places],
        "fixtures": solids,
        "supports": [_solid(str(number), *each) for number, each in enumerate(supports(robots))],
        "meshes": surfaces,
        "motor": {"cool_m": MOTOR_M, "hot_m": HOT_MOTOR_M, "half_length": DRUM},
        "load": {"most_m": MOST_PAYLOAD_M, "kg_per_m3": PAYLOAD_KG_PER_M3, "colour": RGB["payload"]},
    }


def _shape(model: mujoco.MjModel, geom: int) -> dict[str, Any]:
    kind = SHAPES[mujoco.mjtGeom(model.geom_type[geom])]
    return {
        "kind": kind,
        **({"mesh": int(model.geom_dataid[geom])} if kind == "mesh" else {"size": _rounded(model.geom_size[geom])}),
        "position": _rounded(model.geom_pos[geom]),
        "quaternion": _rounded(model.geom_quat[geom]),
        "colour": _rounded(model.geom_rgba[geom][:3]),
    }


def _asset(model: mujoco.MjModel, mesh: int) -> Surface:
    """A mesh of a model."""
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    points = model.mesh_vert[first : first + count]
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return surface_of(points, model.mesh_face[first : first + count])


def model_solid(file: Path) -> Any:
    """The shapes in a file of MJCF or URDF as one trimesh, in the first posture of the model.

    The shapes are those that collide, or all if none does, without planes and terrain.

    Raises:
        ValueError: MuJoCo cannot read the file, or a shape is none of `SHAPES`.
    """
    import trimesh

    model = mujoco.MjSpec.from_file(str(file)).compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solids: list[Any] = []
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    for geom in np.flatnonzero(collides if collides.any() else ~collides).tolist():
        kind = mujoco.mjtGeom(model.geom_type[geom])
        if kind in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD):
            continue
        if kind not in SHAPES:
            raise ValueError(f"it has an {kind.name.removeprefix('mjGEOM_').lower()}; give its mesh instead")
        if SHAPES[kind] == "mesh":
            surface = _asset(model, model.geom_dataid[geom])
            solids.append(trimesh.Trimesh(surface.points_m, surface.corners))
        else:
            solids.append(solid_of(SHAPES[kind], model.geom_size[geom]))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
        solids[-1].apply_transform(pose)
    return trimesh.util.concatenate(solids)


def solid_of(kind: str, size: Points) -> Any:
    """A trimesh of one of `SHAPES` other than a mesh, in its own frame; flat sides do not share points."""
    from trimesh import creation

    if kind == "sphere":
        return creation.icosphere(subdivisions=2, radius=size[0])
    if kind == "capsule":
        return creation.capsule(radius=size[0], height=2 * size[1], count=[24, 12])
    if kind == "box":
        solid = creation.box(extents=[2 * length for length in size])
    else:
        solid = creation.cylinder(radius=size[0], height=2 * size[1], sections=32)
    solid.unmerge_vertices()  # edges stay sharp
    return solid


def _solid(name: str, position_m: Points, turn: np.ndarray, size_m: Points, colour: Sequence[float]) -> dict[str, Any]:
    return {"name": name, "size": _rounded(size_m), "colour": list(colour), **_pose(position_m, turn)}


def _pose(position_m: Points, matrix: np.ndarray) -> dict[str, Any]:
    return {"position": _rounded(position_m), "quaternion": _rounded(quaternion(matrix))}


def _rounded(values: Points) -> list[float]:
    return [round(float(value), DIGITS) for value in values]


Array = np.ndarray

NO_OPENGL = (
    "No OpenGL without a display could be had ({error}). Install EGL or OSMesa (on Debian: libegl1 and "
    "libgl1-mesa-dri, or libosmesa6), or choose one with MUJOCO_GL=egl or MUJOCO_GL=osmesa."
)
FRAME_S = 1 / 30
AZIMUTH_DEG, ELEVATION_DEG = 128.0, -36.0
"""Viewing direction of the camera."""
ROOM_M = 0.12
"""Margin of the view around the middle of a link."""
LABEL_M = 0.08
"""Distance of the name of an arm from its base."""


class CellPlayer:
    """A model of a cell in any posture.

    Args:
        meshes: Kinova's shells instead of primitives, see `fleet.arm.model.build_cell`.

    Raises:
        FleetError: the meshes are not available.
    """

    def __init__(
        self,
        robots: Sequence[Robot],
        places: Sequence[Place] = (),
        fixtures: Sequence[Fixture] = (),
        *,
        meshes: bool = False,
    ) -> None:
        self.model = build_cell(robots, places, fixtures, meshes=meshes, drawn=True)
        self.data = mujoco.MjData(self.model)
        self._payloads = payload_bodies(self.model, robots)
        self._mounts_m = np.array([robot.mount.position_m for robot in robots])
        self.labels_m = self._mounts_m - LABEL_M * np.array([robot.mount.rotation()[:, 2] for robot in robots])
        """Positions of the names of the arms, m, [arm, 3]."""
        self._fixed_m = np.array([thing.position_m for thing in (*places, *fixtures)]).reshape(-1, 3)
        self.model.geom("floor").size[:2] = 0.0  # drawn without an edge
        sites = [f"{robot.name}/motor_{joint + 1}" for robot in robots for joint in range(JOINTS)]
        self._motors = np.array([self.model.site(name).id for name in sites])
        self.model.site_group[self._motors] = 0
        self.model.site_type[self._motors] = mujoco.mjtGeom.mjGEOM_CYLINDER

    def show(self, q: Array, motor_rgb: Array, motor_m: Array, payload_kg: Array) -> None:
        """Set postures [arm, joint] in rad and payloads [arm] in kg, with a drum at each motor.

        Args:
            motor_rgb: Colours of the drums, 0 to 1, [arm, joint, 3].
            motor_m: Their radius, m, [arm, joint].
        """
        self.data.qpos[:] = q.ravel()
        self.model.site_rgba[self._motors, :3] = motor_rgb.reshape(-1, 3)
        self.model.site_size[self._motors, 0] = motor_m.ravel()
        self.model.site_size[self._motors, 1] = DRUM * motor_m.ravel()
        set_payload_balls(self.model, self._payloads, payload_kg)
        mujoco.mj_forward(self.model, self.data)

    def extent(self, q: Array) -> Array:
        """Points in view, m, [point, 3]: links in postures [sample, arm, joint] in rad, mounts, places and fixtures."""
        points = [self._mounts_m, self._fixed_m]
        for posture in q:
            self.data.qpos[:] = posture.ravel()
            mujoco.mj_kinematics(self.model, self.data)
            points.append(self.data.xpos[1:].copy())
        return np.concatenate(points)

    def open_viewer(self, update: Callable[[], object]) -> None:
        """Show the cell in MuJoCo's viewer until its window is closed; `update` runs before every frame."""
        import mujoco.viewer

        pause = threading.Event()
        with mujoco.viewer.launch_passive(self.model, self.data, show_left_ui=False, show_right_ui=False) as viewer:
            low, high = self._mounts_m.min(axis=0), self._mounts_m.max(axis=0)
            viewer.cam.azimuth, viewer.cam.elevation = AZIMUTH_DEG, ELEVATION_DEG
            viewer.cam.lookat[:] = (low + high) / 2 + (0.0, 0.0, ROOM_M)
            viewer.cam.distance = 2.0 + float(np.ptp(self._mounts_m, axis=0).max())
            while viewer.is_running():
                with viewer.lock():
                    update()
                viewer.sync()
                pause.wait(FRAME_S)


class CellCamera:
    """Renders pictures of a cell without a display; a context manager.

    Args:
        points_m: Points in view, [point, 3], as from `CellPlayer.extent`.
        top, bottom: Shares of the picture's height that stay free at its edges.

    Raises:
        FleetError: OpenGL is not available.
    """

    def __init__(
        self, player: CellPlayer, width: int, height: int, points_m: Array, *, top: float = 0.0, bottom: float = 0.0
    ) -> None:
        model = player.model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.quality.offsamples = 0
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # each OpenGL backend has errors of its own
            raise FleetError(NO_OPENGL.format(error=error or type(error).__name__)) from error
        self._player, self._size = player, np.array((width, height))
        self._tangent = np.tan(np.radians(model.vis.global_.fovy) / 2)
        azimuth, elevation = np.radians((AZIMUTH_DEG, ELEVATION_DEG))
        ahead = np.array((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)))
        right = np.array((np.sin(azimuth), -np.cos(azimuth), 0.0))
        self._axes = np.stack((right, np.cross(right, ahead), ahead))
        x, y, depth = self._axes @ points_m.T
        across = self._tangent * width / height
        sides, heights = _slopes(across, 0.0, 0.0), _slopes(self._tangent, bottom, top)
        # The nearest camera whose picture holds every point: each edge of the picture is a plane through the camera.
        distance = max(_least(x, depth, *sides), _least(y, depth, *heights))
        at = [_middle(v, depth + distance, *slopes) for v, slopes in ((x, sides), (y, heights))]
        self._eye = np.array((*at, -distance))
        self._camera = mujoco.MjvCamera()
        self._camera.azimuth, self._camera.elevation, self._camera.distance = AZIMUTH_DEG, ELEVATION_DEG, 1.0
        self._camera.lookat[:] = self._eye @ self._axes + ahead

    def pixels(self, points_m: Array) -> Array:
        """Pixel positions of points [point, 3] in m, from the left and the upper edge, [point, 2]."""
        x, y, depth = self._axes @ points_m.T - self._eye[:, None]
        return (np.stack((x, -y)) / (depth * self._tangent) * self._size[1] / 2 + self._size[:, None] / 2).T

    def __enter__(self) -> "CellCamera":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._renderer.close()

    def picture(self) -> Array:
        """A picture of the current posture, uint8 [height, width, 3]."""
        self._renderer.update_scene(self._player.data, self._camera)
        for slow in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._renderer.scene.flags[slow] = 0
        return self._renderer.render()


def _slopes(tangent: float, low: float, high: float) -> tuple[float, float]:
    """Slopes of the lower and upper edge of a view, with shares `low` and `high` of the picture left free."""
    return tangent * (2.0 * low - 1.0), tangent * (1.0 - 2.0 * high)


def _least(across: Array, depth: Array, low: float, high: float) -> float:
    """Least distance at which all points are between two slopes, for any position of the camera across."""
    room = max(0.0, float((across + ROOM_M - depth * high).max() - (across - ROOM_M - depth * low).min()))
    return max(0.3, room / (high - low), ROOM_M * 2 - float(depth.min()))


def _middle(across: Array, ahead: Array, low: float, high: float) -> float:
    """Position of the camera across, with equal margins on both sides."""
    return float((across + ROOM_M - ahead * high).max() + (across - ROOM_M - ahead * low).min()) / 2


Pair = tuple[int, int]
"""Ids of two geoms, the lower first."""

APART_S = 1.0
"""Two links apart for longer than this begin a new contact event."""


class ContactFinder:
    """Finds the contacts of a shift, from one stretch of recorded postures to the next.

    Args:
        model: Of the cell; see `fleet.arm.model.build_cell`. It is not changed.
        robots: The arms in the order of the model.
    """

    def __init__(self, model: mujoco.MjModel, robots: Sequence[Robot]) -> None:
        self._model = copy(model)
        self._data = mujoco.MjData(self._model)
        self._payloads = payload_bodies(model, robots)
        self._names = [_described(model.geom(g).name) for g in range(model.ngeom)]
        first = {name: g for g, name in reversed([*enumerate(self._names)])}
        self._solid = [first[name] for name in self._names]
        """The first geom of the solid of which each geom is a part."""
        self.reset()

    def reset(self) -> None:
        """Delete all contacts, for a new shift."""
        self._latest_s: dict[Pair, float] = {}
        """Time of the last contact of two geoms."""

    def events(self, time_s: Array, q: Array, payload_kg: Array) -> list[Event]:
        """Contacts that begin in a part of a shift, each with its greatest depth in this part.

        Args:
            time_s: Rising, from the end of the previous part, [sample].
            q: rad, [sample, arm, joint].
            payload_kg: Payload in the hand of each arm, [sample, arm].

        Returns:
            One event for each pair of links or obstacles and each episode of contact, in order of time. Its arm is the
            first of the two; its value is the depth in mm.
        """
        depth_m: dict[tuple[Pair, float], float] = {}
        """By pair and beginning."""
        began_s: dict[Pair, float] = {}
        regrasped = np.append(True, (np.diff(payload_kg, axis=0) != 0).any(axis=1))
        for i, now_s in enumerate(time_s.tolist()):
            if regrasped[i]:
                set_payload_balls(self._model, self._payloads, payload_kg[i])
            for pair, deep_m in self._in_contact(q[i]).items():
                if now_s - self._latest_s.get(pair, -np.inf) > APART_S:
                    began_s[pair] = now_s
                self._latest_s[pair] = now_s
                if pair in began_s:  # not one that began in an earlier part
                    episode = (pair, began_s[pair])
                    depth_m[episode] = max(depth_m.get(episode, 0.0), deep_m)
        return [self._event(pair, at_s, deep_m) for (pair, at_s), deep_m in depth_m.items()]

    def _in_contact(self, q: Array) -> dict[Pair, float]:
        """Penetration depth of overlapping geoms in one posture, m."""
        model, data = self._model, self._data
        data.qpos[:] = q.ravel()
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        depth_m: dict[Pair, float] = {}
        if not data.ncon:
            return depth_m
        for (a, b), distance_m in zip(data.contact.geom.tolist(), data.contact.dist.tolist(), strict=True):
            a, b = self._solid[a], self._solid[b]
            pair = (min(a, b), max(a, b))
            if distance_m < 0:
                depth_m[pair] = max(depth_m.get(pair, 0.0), -distance_m)
        return depth_m

    def _event(self, pair: Pair, time_s: float, depth_m: float) -> Event:
        (one, arm), (other, other_arm) = (self._names[g] for g in pair)
        if not arm:  # an obstacle; world bodies come first in the model
            one, other, arm = other, one, other_arm
        reason = f"{one} and {other}, {depth_m * 1e3:.1f} mm deep"
        return Event(time_s=time_s, kind="contact", arm=arm, value=depth_m * 1e3, reason=reason)


def _described(geom: str) -> tuple[str, str]:
    """Name of a geom for an event, and its arm, if any."""
    owner, name, *_ = [*geom.split("/"), ""]
    if not name:
        return f"the {geom}", ""
    return (f"the fixture '{name}'", "") if owner == "fixture" else (f"{name} of {owner}", owner)
