"""MuJoCo models: the cell with all its arms, and the rigid-body dynamics of a single arm."""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from itertools import combinations

import mujoco
import numpy as np

from fleet.job import Place
from fleet.physics.gen3 import GRAVITY_M_S2, gen3_xml
from fleet.physics.meshes import use_meshes
from fleet.robot import GEN3, JOINTS, Robot, rotation

Array = np.ndarray

SAME_PLACE_M = 0.01
"""Bases closer than this count as the same place."""


def build_cell(
    robots: Sequence[Robot], places: Sequence[Place] = (), *, timestep_s: float = 0.002, meshes: bool = False
) -> mujoco.MjModel:
    """Model of all arms on their mounts above one floor, with the places as sites.

    Names: all elements of an arm have the prefix `{robot.name}/` (`joint_1`..`joint_7` for joints and their
    position servos, sites `motor_1`..`motor_7` and `tool`, bodies `hand` and `payload`, camera `wrist`); a place is
    the site `station/{place.name}`. Servos clip at `GEN3.torque_clip`. Collisions are disabled.

    Args:
        meshes: Render Kinova's shells instead of primitives (optional package `mujoco-menagerie`).

    Raises:
        ValueError: no arms, two arms or two places with one name, or two arms at the same place.
        FleetError: the meshes are not available.
    """
    _check(robots, places)
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
        contype=0,
        conaffinity=0,
    )
    world.add_light(name="sun", pos=(0.0, 0.0, 4.0), dir=(0.0, 0.0, -1.0), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    for robot in robots:
        mount = world.add_frame(pos=robot.mount.position_m, quat=_quat(robot.mount.rotation()))
        spec.attach(_arm_spec(robot, meshes=meshes), prefix=f"{robot.name}/", frame=mount)
    for place in places:
        world.add_site(
            name=f"station/{place.name}",
            pos=place.position_m,
            quat=_quat(rotation(place.tool_deg)),
            size=(0.015, 0.015, 0.015),
            rgba=(0.95, 0.55, 0.10, 1.0),
        )
    return spec.compile()


class ArmModel:
    """Rigid-body kinematics and dynamics of a single arm on its mount; torques include the reflected rotor inertia."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.model = build_cell([robot])
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
                # Only the spatial inertias use this mass, and each call computes them again.
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


def _check(robots: Sequence[Robot], places: Sequence[Place]) -> None:
    if not robots:
        raise ValueError("A cell needs at least one arm.")
    for what, names in (("arms", [r.name for r in robots]), ("places", [p.name for p in places])):
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
    if meshes:
        use_meshes(spec)
    return spec


def _quat(matrix: Array) -> Array:
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(matrix).ravel())
    return quat
