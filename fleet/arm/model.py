"""MuJoCo models: the cell with all its arms, with primitives or Kinova's shells, and the dynamics of a single arm."""

from collections.abc import Iterator, Sequence
from importlib import import_module
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np

from fleet.arm.gen3 import GRAVITY_M_S2, gen3_xml
from fleet.errors import FleetError, install
from fleet.job import MOST_PAYLOAD_M, Fixture, Place, payload_radius_m
from fleet.robot import GEN3, JOINTS, Robot, rotation

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false


MESH_OF_GEOM = {
    "base": "base_link",
    "shoulder": "shoulder_link",
    "half_arm_1": "half_arm_1_link",
    "half_arm_2": "half_arm_2_link",
    "forearm": "forearm_link",
    "wrist_1": "spherical_wrist_1_link",
    "wrist_2": "spherical_wrist_2_link",
    "bracelet": "bracelet_with_vision_link",
}
"""Mesh file, without `.stl`, by the primitive that it replaces, in the frame of the primitive's body."""


def use_meshes(spec: mujoco.MjSpec) -> None:
    """Render a Gen3 with meshes: adds meshes without mass and moves the primitives to the hidden geom group 3.

    Raises:
        FleetError: the package `mujoco-menagerie` or its files are missing.
    """
    folder = mesh_folder()
    for geom_name, mesh in MESH_OF_GEOM.items():
        spec.add_mesh(name=mesh, file=str(folder / f"{mesh}.stl"))
        geom = spec.geom(geom_name)
        geom.parent.add_geom(
            name=f"{geom_name}_mesh",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh,
            rgba=geom.rgba,
            contype=0,
            conaffinity=0,
            group=2,
            mass=0.0,
        )
        geom.group = 3
    spec.geom("camera").group = 3


def mesh_folder() -> Path:
    """Folder of the Gen3 meshes; the package downloads them or reads $MENAGERIE_ROOT.

    Raises:
        FleetError: the package, its files or its server are not available.
    """
    try:
        menagerie = import_module("mujoco_menagerie")
    except ModuleNotFoundError as error:
        raise FleetError(f"Meshes need the optional package: {install('meshes')}.") from error
    try:
        folder = Path(menagerie.get("kinova_gen3").path(progress=None)) / "assets"
    except (menagerie.MenagerieError, OSError) as error:
        raise FleetError(
            f"The meshes of the Gen3 could not be fetched ({error}). Without a network, set MENAGERIE_ROOT to a "
            "checkout of mujoco_menagerie that has kinova_gen3/."
        ) from error
    missing = [mesh for mesh in MESH_OF_GEOM.values() if not (folder / f"{mesh}.stl").is_file()]
    if missing:
        raise FleetError(f"Meshes missing in {folder}: {', '.join(missing)}.")
    return folder


Array = np.ndarray

SAME_PLACE_M = 0.01
"""Bases closer than this count as one position."""
BELOW_FLOOR_M = 0.005
"""With a base deeper than this below z = 0, the height of the floor is unknown, and nothing touches it."""


RGB = {"place": (0.48, 0.36, 0.65), "fixture": (0.55, 0.50, 0.43), "payload": (0.36, 0.52, 0.70)}
"""Colours unlike that of any motor."""
PLACE_M = 0.03
"""Size of the mark at a place."""


def build_cell(
    robots: Sequence[Robot],
    places: Sequence[Place] = (),
    fixtures: Sequence[Fixture] = (),
    *,
    timestep_s: float = 0.002,
    meshes: bool = False,
    drawn: bool = False,
) -> mujoco.MjModel:
    """Model of all arms on their mounts above one floor, with the places as sites and the fixtures as boxes or hulls.

    Names: all elements of an arm have the prefix `{robot.name}/` (`joint_1`..`joint_7` for joints and their
    position servos, sites `motor_1`..`motor_7` and `tool`, bodies `hand` and `payload`, camera `wrist`); a place is
    the site `station/{place.name}`, a box the geom `fixture/{fixture.name}`, and part i of a mesh the geom
    `fixture/{fixture.name}/{i}`. Servos clip at `GEN3.torque_clip`.

    Links and payloads collide with those of other arms, the floor and the fixtures, not within an arm. All hands are
    empty; `set_payload_balls` gives them payloads.

    Args:
        meshes: Render Kinova's shells instead of primitives (optional package `mujoco-menagerie`).
        drawn: For pictures only: with `supports`, and the surfaces of meshes in place of their hulls.

    Raises:
        ValueError: no arms, two arms, places or fixtures with one name, or two arms at the same place.
        FleetError: the meshes are not available.
    """
    _check(robots, places, fixtures)
    spec = mujoco.MjSpec()
    spec.modelname = "cell"
    spec.option.timestep = timestep_s
    spec.option.gravity = (0.0, 0.0, -GRAVITY_M_S2)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.compiler.degree = False
    spec.compiler.autolimits = False
    world = spec.worldbody
    world.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(5.0, 5.0, 0.1),
        rgba=(0.30, 0.33, 0.36, 1.0),
    )
    if min(robot.mount.position_m[2] for robot in robots) < -BELOW_FLOOR_M:
        spec.geom("floor").contype = spec.geom("floor").conaffinity = 0
    world.add_light(name="sun", pos=(0.0, 0.0, 4.0), dir=(0.0, 0.0, -1.0), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    for robot in robots:
        mount = world.add_frame(pos=robot.mount.position_m, quat=quaternion(robot.mount.rotation()))
        spec.attach(_arm_spec(robot, meshes=meshes), prefix=f"{robot.name}/", frame=mount)
    for place in places:
        world.add_site(
            name=f"station/{place.name}",
            pos=place.position_m,
            quat=quaternion(rotation(place.tool_deg)),
            size=[PLACE_M / 2] * 3,
            rgba=(*RGB["place"], 1.0),
        )
    for fixture in fixtures:
        _add_fixture(spec, fixture, drawn=drawn)
    for position_m, turn, size_m, rgba in supports(robots) if drawn else ():
        box = mujoco.mjtGeom.mjGEOM_BOX
        world.add_geom(type=box, pos=position_m, quat=quaternion(turn), size=size_m / 2, rgba=rgba)
    model = spec.compile()
    set_payload_balls(model, payload_bodies(model, robots), np.zeros(len(robots)))
    return model


def _add_fixture(spec: mujoco.MjSpec, fixture: Fixture, *, drawn: bool) -> None:
    """Add a box, or the hulls of a mesh, or its surface if it is `drawn`."""
    name, surface = f"fixture/{fixture.name}", fixture.surface
    look = {"pos": fixture.position_m, "quat": quaternion(rotation(fixture.tilt_deg)), "rgba": (*RGB["fixture"], 1.0)}
    if surface is None:
        half_m = [length / 2 for length in fixture.size_m]
        spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=half_m, **look)
        return
    shapes = [(surface.points_m, surface.corners)] if drawn else [(part, np.empty(0)) for part in surface.parts_m]
    for i, (points, corners) in enumerate(shapes):
        part, open_too = f"{name}/{i}", mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        spec.add_mesh(name=part, uservert=points.ravel(), userface=corners.ravel(), inertia=open_too)
        spec.worldbody.add_geom(name=part, meshname=part, type=mujoco.mjtGeom.mjGEOM_MESH, **look)


UPRIGHT = 0.5
"""Sine of the elevation from which a base stands or hangs; between, a wall holds it."""
PLATE_RGBA, POST_RGBA, WALL_RGBA = (0.60, 0.63, 0.65, 1.0), (0.73, 0.74, 0.76, 1.0), (0.73, 0.74, 0.76, 0.35)
PLATE_M, RISE_M, WALL_M = 0.02, 0.006, 0.06
"""Thickness of the plate under a base, its height above the floor or wall, and thickness of a wall or ceiling."""


def supports(robots: Sequence[Robot]) -> Iterator[tuple[Array, Array, Array, tuple[float, ...]]]:
    """A plate under each base, and what holds it in pictures: a post on the floor, a piece of wall, or of a ceiling.

    Each is a box: centre, m, rotation to the world [3, 3], full lengths, m, and RGBA.
    """
    for robot in robots:
        base, turn = np.array(robot.mount.position_m), robot.mount.rotation()
        axis, behind = turn[:, 2], base - (PLATE_M - RISE_M + WALL_M / 2) * turn[:, 2]
        yield base - (PLATE_M / 2 - RISE_M) * axis, turn, np.array((0.16, 0.16, PLATE_M)), PLATE_RGBA
        if axis[2] <= -UPRIGHT:
            yield behind, turn, np.array((0.5, 0.5, WALL_M)), WALL_RGBA
        elif behind[2] > 0:
            is_wall, yaw_deg = axis[2] < UPRIGHT, float(np.degrees(np.arctan2(axis[1], axis[0])))
            high_m = base[2] + 0.15 if is_wall else behind[2]
            size = np.array((WALL_M, 0.5, high_m) if is_wall else (0.1, 0.1, high_m))
            upright = rotation((0.0, 0.0, yaw_deg if is_wall else 0.0))
            yield np.array((*behind[:2], high_m / 2)), upright, size, WALL_RGBA if is_wall else POST_RGBA


def payload_bodies(model: mujoco.MjModel, robots: Sequence[Robot]) -> Array:
    """Ids of the payload bodies, int [arm]."""
    return np.array([model.body(f"{robot.name}/payload").id for robot in robots])


def links_of(model: mujoco.MjModel, arm: str) -> tuple[str, ...]:
    """Names of the geoms of an arm's links, from base to camera; the payload is none of them."""
    names = [model.geom(g).name for g in range(model.ngeom)]
    own = [name.removeprefix(f"{arm}/") for name in names if name.startswith(f"{arm}/")]
    return tuple(link for link in own if link != "payload" and not link.endswith("_mesh"))


def set_payload_balls(model: mujoco.MjModel, bodies: Array, payload_kg: Array) -> None:
    """Set the sizes of payload balls by their mass; a mass of 0 hides the ball. Masses are not changed.

    Args:
        bodies: Ids of payload bodies, int [arm].
        payload_kg: [arm].
    """
    balls = model.body_geomadr[bodies]
    radius_m = np.array([payload_radius_m(kg) for kg in payload_kg])
    # Bounding boxes stay those of the largest ball: it contains all smaller ones, as all touch the flange.
    model.geom_size[balls, 0] = model.geom_rbound[balls] = np.maximum(radius_m, 1e-6)
    model.geom_pos[balls, 2] = radius_m
    model.geom_contype[balls] = model.geom_conaffinity[balls] = np.asarray(payload_kg) > 0


class ArmModel:
    """Rigid-body kinematics and dynamics of a single arm on its mount; torques include the reflected rotor inertia.

    Args:
        fixtures: Solids in the cell; they matter for distances only.
    """

    def __init__(self, robot: Robot, fixtures: Sequence[Fixture] = ()) -> None:
        self.robot = robot
        self.model = build_cell([robot], fixtures=fixtures)
        # Exclude motors, joint stops and contacts from the torque that a motion needs.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_ACTUATION
        self.data = mujoco.MjData(self.model)
        self._tool = self.model.site(f"{robot.name}/tool").id
        self._elbow = self.model.body(f"{robot.name}/forearm").id
        self._payload = self.model.body(f"{robot.name}/payload").id
        self.position_range: Array = np.where(
            self.model.jnt_limited[:, None].astype(bool), self.model.jnt_range, (-np.inf, np.inf)
        )
        """Lowest and highest joint position, rad, [joint, 2]; infinite for continuous joints."""

    def tool_pose(self, q: Array) -> tuple[Array, Array]:
        """Tool point in the world, m, [3], and rotation from tool frame to world, [3, 3]."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        return self.data.site_xpos[self._tool].copy(), self.data.site_xmat[self._tool].reshape(3, 3).copy()

    def reach_m(self, q: Array) -> float:
        """Distance from joint 2 to the tool point, m."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        return float(np.linalg.norm(self.data.site_xpos[self._tool] - self.data.xanchor[1]))

    def elbow_position(self, q: Array) -> Array:
        """Position of joint 4 in the world, m, [3]."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        return self.data.xpos[self._elbow].copy()

    def gravity_torque(self, q: Array, payload_kg: float = 0.0) -> Array:
        """Torque that holds the arm at q with a point mass at the flange, N·m, [joint]."""
        rest = np.zeros((1, JOINTS))
        return self.inverse_dynamics(np.reshape(q, (1, JOINTS)), rest, rest, payload_kg)[0]

    def inverse_dynamics(
        self, q: Array, qd: Array, qdd: Array, payload_kg: Array | float = 0.0, force_world: Array | None = None
    ) -> Array:
        """Joint torque that a motion needs: M qdd + c + g − Jᵀ f, N·m, [time, joint].

        Args:
            q, qd, qdd: Motion, [time, joint].
            payload_kg: Point mass at the flange, scalar or [time].
            force_world: Force of the environment on the tool point, N, world frame, [3] or [time, 3].
        """
        samples = len(q)
        mass_kg = np.broadcast_to(np.asarray(payload_kg, dtype=float), (samples,))
        force_n = np.broadcast_to(np.zeros(3) if force_world is None else force_world, (samples, 3))
        tau = np.empty((samples, JOINTS))
        model, data = self.model, self.data
        jacobian = np.empty((3, JOINTS))
        try:
            for i in range(samples):
                # Only the spatial inertias use this mass; each call computes them again.
                model.body_mass[self._payload] = mass_kg[i]
                data.qpos[:], data.qvel[:], data.qacc[:] = q[i], qd[i], qdd[i]
                mujoco.mj_inverse(model, data)
                tau[i] = data.qfrc_inverse
                if force_n[i].any():
                    mujoco.mj_jacSite(model, data, jacobian, None, self._tool)
                    tau[i] -= jacobian.T @ force_n[i]
        finally:
            model.body_mass[self._payload] = 0.0
        return tau


def _check(robots: Sequence[Robot], places: Sequence[Place], fixtures: Sequence[Fixture]) -> None:
    if not robots:
        raise ValueError("A cell needs at least one arm.")
    for what, items in (("arms", robots), ("places", places), ("fixtures", fixtures)):
        names = [item.name for item in items]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"Names of {what} must be unique; given more than once: {', '.join(twice)}.")
    for a, b in combinations(robots, 2):
        apart_m = float(np.linalg.norm(np.subtract(a.mount.position_m, b.mount.position_m)))
        if apart_m < SAME_PLACE_M:
            raise ValueError(f"Arms '{a.name}' and '{b.name}' are at the same place: {a.mount.position_m} m.")


def _arm_spec(robot: Robot, *, meshes: bool) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_string(gen3_xml().decode())
    spec.body("hand").mass = robot.tool_kg
    for actuator, clip in zip(spec.actuators, GEN3.torque_clip, strict=True):
        actuator.forcerange = (-clip, clip)
        actuator.forcelimited = True
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 1
    spec.body("payload").add_geom(
        name="payload",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=(MOST_PAYLOAD_M, 0.0, 0.0),
        pos=(0.0, 0.0, MOST_PAYLOAD_M),
        rgba=(*RGB["payload"], 1.0),
        contype=1,
        conaffinity=1,
        mass=0.0,
    )
    for one, other in combinations([body.name for body in spec.bodies if body.name != "world"], 2):
        spec.add_exclude(bodyname1=one, bodyname2=other)
    if meshes:
        use_meshes(spec)
    return spec


def quaternion(matrix: Array) -> Array:
    """Rotation matrix [3, 3] as a unit quaternion w, x, y, z."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(matrix).ravel())
    return quat
