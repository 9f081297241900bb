"""The arm's model against Kinova's numbers, against MuJoCo's forward dynamics, and against energy."""

import base64
import importlib.util
import struct
import sys
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fleet.arm.cell import cell_model
from fleet.arm.model import MESH_OF_GEOM, ArmModel, build_cell
from fleet.errors import FleetError
from fleet.job import Place
from fleet.robot import GEN3, POSTURES, Mount, Robot, rotation
from tests.profiles import examples

FLOOR = ArmModel(Robot(name="arm_0"))
MOUNTS = {
    "floor": Mount(),
    "wall": Mount(position_m=(0.3, -0.2, 1.1), tilt_deg=(0.0, 90.0, 0.0)),
    "ceiling": Mount(position_m=(0.0, 1.0, 2.0), tilt_deg=(180.0, 0.0, 0.0)),
    "tilted": Mount(position_m=(1.0, 0.0, 0.5), tilt_deg=(20.0, -35.0, 70.0)),
}
joints = arrays(float, 7, elements=st.floats(-2.0, 2.0))


def test_masses_ranges_lengths_and_rotors_are_those_of_kinova():
    """By the URDF: 8.188 kg; 0.28481 m to joint 2 and 0.42076 m on to joint 4; by the data sheet: a reach of 902 mm,
    gear ratio 100, rotors of 0.40e-4 and 0.22e-4 kg·m². Friction is the motor law's business."""
    assert FLOOR.model.body_mass.sum() == pytest.approx(8.188, abs=1e-3)
    expected = np.full((7, 2), (-np.inf, np.inf))
    expected[[1, 3, 5], 1] = 2.24, 2.57, 2.09
    expected[[1, 3, 5], 0] = -2.24, -2.57, -2.09
    np.testing.assert_array_equal(FLOOR.position_range, expected)
    position, turn = FLOOR.tool_pose(np.array(POSTURES["outstretched"]))
    shoulder = FLOOR.data.xpos[FLOOR.model.body("arm_0/half_arm_1").id]
    assert np.linalg.norm(position - shoulder) == pytest.approx(0.902, abs=1.5e-3)
    np.testing.assert_allclose(turn[:, 2], (1.0, 0.0, 0.0), atol=1e-7)
    assert FLOOR.elbow_position(np.zeros(7))[2] == pytest.approx(0.70557, abs=1e-4)
    np.testing.assert_allclose(FLOOR.model.dof_armature, [100**2 * 0.40e-4] * 4 + [100**2 * 0.22e-4] * 3)
    assert not FLOOR.model.dof_damping.any()
    assert not FLOOR.model.dof_frictionloss.any()


# |tau| of J2, J4, J6, N·m, with the payload as a point mass at the flange; computed from Kinova's masses.
GRAVITY_TABLE = {
    ("outstretched", 0.0): (23.5, 7.1, 1.0),
    ("outstretched", 1.1): (33.2, 12.3, 2.8),
    ("outstretched", 2.0): (41.2, 16.6, 4.3),
    ("outstretched", 3.0): (50.1, 21.3, 5.9),
    ("outstretched", 4.0): (58.9, 26.0, 7.5),
    ("home", 0.0): (8.7, 4.5, 1.0),
    ("home", 1.1): (13.7, 8.2, 2.8),
    ("home", 2.0): (17.7, 11.3, 4.3),
    ("home", 3.0): (22.2, 14.7, 5.9),
    ("home", 4.0): (26.7, 18.1, 7.5),
    ("raised", 0.0): (20.3, 6.2, 0.8),
    ("raised", 2.0): (35.7, 14.3, 3.7),
    ("raised", 4.0): (51.0, 22.5, 6.5),
    ("retract", 0.0): (0.6, 5.0, 0.0),
    ("retract", 4.0): (4.2, 15.4, 0.5),
}


@pytest.mark.parametrize(("posture", "payload_kg"), GRAVITY_TABLE)
def test_gravity_torque_is_that_of_the_published_masses(posture, payload_kg):
    tau = FLOOR.gravity_torque(np.array(POSTURES[posture]), payload_kg)
    # The table has one decimal: half of it, and rounding.
    np.testing.assert_allclose(np.abs(tau[[1, 3, 5]]), GRAVITY_TABLE[posture, payload_kg], atol=0.055)


@pytest.mark.parametrize("name", MOUNTS)
@given(q=joints, payload_kg=st.floats(0.0, 5.0))
@settings(max_examples=20)
def test_a_turned_mount_is_a_turned_gravity(name, q, payload_kg):
    mounted = ArmModel(Robot(name="arm_0", mount=MOUNTS[name]))
    floor = ArmModel(Robot(name="arm_0"))
    floor.model.opt.gravity[:] = rotation(MOUNTS[name].tilt_deg).T @ (0.0, 0.0, -9.81)
    np.testing.assert_allclose(mounted.gravity_torque(q, payload_kg), floor.gravity_torque(q, payload_kg), atol=1e-9)


@given(q=joints, payload_kg=st.floats(0.0, 5.0))
@settings(max_examples=20)
def test_gravity_torque_is_the_slope_of_the_potential_energy(q, payload_kg):
    arm = ArmModel(Robot(name="arm_0", mount=MOUNTS["tilted"], tool_kg=0.7))

    def energy_j(q):
        arm.tool_pose(q)
        height_m = arm.data.xipos[:, 2]
        tool_m = arm.data.site("arm_0/tool").xpos[2]
        return 9.81 * (arm.model.body_mass @ height_m + payload_kg * tool_m)

    step = 1e-5
    slope = [(energy_j(q + step * e) - energy_j(q - step * e)) / (2 * step) for e in np.eye(7)]
    np.testing.assert_allclose(arm.gravity_torque(q, payload_kg), slope, atol=1e-5)


@given(q=joints, qd=joints, qdd=joints, payload_kg=st.floats(0.0, 5.0))
@examples(30)
def test_inverse_dynamics_undoes_forward_dynamics(q, qd, qdd, payload_kg):
    robot = Robot(name="arm_0", mount=MOUNTS["wall"], tool_kg=0.4)
    tau = ArmModel(robot).inverse_dynamics(q[None], qd[None], qdd[None], payload_kg)[0]
    model = build_cell([robot])
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.body("arm_0/payload").mass = payload_kg
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, qd, tau
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc, qdd, atol=1e-7)


@given(q=joints, force=arrays(float, 3, elements=st.floats(-60.0, 60.0)))
@settings(max_examples=20)
def test_a_force_on_the_tool_enters_through_the_jacobian(q, force):
    still = np.zeros((1, 7))
    step = 1e-6
    jacobian = np.stack(
        [(FLOOR.tool_pose(q + step * e)[0] - FLOOR.tool_pose(q - step * e)[0]) / (2 * step) for e in np.eye(7)], axis=1
    )
    pushed = FLOOR.inverse_dynamics(q[None], still, still, 0.0, force)[0]
    np.testing.assert_allclose(pushed - FLOOR.gravity_torque(q), -jacobian.T @ force, atol=1e-5)


def test_payload_may_change_from_sample_to_sample():
    q = np.tile(POSTURES["outstretched"], (3, 1))
    still = np.zeros_like(q)
    tau = FLOOR.inverse_dynamics(q, still, still, np.array([0.0, 3.0, 0.0]))
    np.testing.assert_allclose(tau[0], tau[2])
    np.testing.assert_allclose(np.abs(tau[1, 1] - tau[0, 1]), 3.0 * 9.81 * 0.902, atol=0.05)
    np.testing.assert_array_equal(FLOOR.gravity_torque(q[0]), tau[0])
    FLOOR.gravity_torque(q[0], 5.0)
    assert FLOOR.model.body_mass.sum() == pytest.approx(8.188, abs=1e-3)


def test_a_cell_holds_all_arms_stations_and_servos():
    robots = [Robot(name="left"), Robot(name="right", mount=MOUNTS["wall"], tool_kg=0.5)]
    place = Place(name="press/1", position_m=(0.5, 0.1, 0.3), tool_deg=(0.0, 90.0, 0.0))
    model = build_cell(robots, [place], timestep_s=0.001)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    assert (model.nq, model.nu, model.opt.timestep) == (14, 14, 0.001)
    assert model.body_mass.sum() == pytest.approx(2 * 8.188 + 0.5, abs=1e-2)
    np.testing.assert_allclose(data.site("station/press/1").xpos, place.position_m)
    np.testing.assert_allclose(data.site("station/press/1").xmat.reshape(3, 3)[:, 2], (1.0, 0.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(data.body("right/base").xpos, robots[1].mount.position_m)
    for robot in robots:
        for i, clip in enumerate(GEN3.torque_clip, start=1):
            np.testing.assert_array_equal(model.actuator(f"{robot.name}/joint_{i}").forcerange, (-clip, clip))
            assert model.site(f"{robot.name}/motor_{i}").bodyid == model.joint(f"{robot.name}/joint_{i}").bodyid
        assert model.camera(f"{robot.name}/wrist").id >= 0


def test_a_servo_with_feedforward_gives_the_asked_torque():
    model = build_cell([Robot(name="arm_0")])
    data = mujoco.MjData(model)
    q, qd, tau = np.array(POSTURES["home"]), np.full(7, 0.3), np.linspace(-20.0, 20.0, 7)
    kp, kv = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]
    data.qpos[:], data.qvel[:], data.ctrl[:] = q, qd, q + (tau + kv * qd) / kp
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_actuator, tau, atol=1e-9)


@pytest.mark.parametrize(
    ("robots", "places", "words"),
    [
        ([], [], "at least one arm"),
        ([Robot(name="a"), Robot(name="a", mount=MOUNTS["wall"])], [], "a"),
        ([Robot(name="a"), Robot(name="b", mount=Mount(position_m=(0.0, 0.005, 0.0)))], [], "'a' and 'b'"),
        ([Robot(name="a")], [Place(name="bin", position_m=(0.4, 0.0, 0.2))] * 2, "bin"),
    ],
)
def test_an_impossible_cell_is_named(robots, places, words):
    with pytest.raises(ValueError, match=words):
        build_cell(robots, places)


def _tetrahedron_stl() -> bytes:
    corners = np.array([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)], dtype=float)
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces)
    return bytes(80) + struct.pack("<I", len(faces)) + body


@pytest.fixture
def menagerie(monkeypatch, tmp_path):
    """A package of meshes in this folder, which has none yet."""
    robot = SimpleNamespace(path=lambda progress=None: tmp_path)
    fake = SimpleNamespace(get=lambda name: robot, MenagerieError=RuntimeError)
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", fake)
    return tmp_path


@pytest.fixture
def meshes(menagerie):
    """A tetrahedron for every mesh."""
    (menagerie / "assets").mkdir()
    for mesh in MESH_OF_GEOM.values():
        (menagerie / "assets" / f"{mesh}.stl").write_bytes(_tetrahedron_stl())


@pytest.mark.usefixtures("meshes")
def test_meshes_change_the_looks_and_nothing_else():
    robots = [Robot(name="a"), Robot(name="b", mount=MOUNTS["wall"])]
    plain, dressed = build_cell(robots), build_cell(robots, meshes=True)
    assert (dressed.geom_type == mujoco.mjtGeom.mjGEOM_MESH).sum() == 2 * len(MESH_OF_GEOM)
    np.testing.assert_array_equal(dressed.body_mass, plain.body_mass)
    np.testing.assert_array_equal(dressed.body_inertia, plain.body_inertia)


@pytest.mark.usefixtures("meshes")
def test_a_page_gets_the_surfaces_of_the_meshes():
    """Second method: MuJoCo's own position of a corner of the tetrahedron, from the file."""
    shown, plain = (cell_model([Robot(name="a")], meshes=meshes) for meshes in (True, False))
    assert not plain["meshes"]
    assert {shape["kind"] for link in shown["links"] for shape in link["shapes"]} == {"mesh"}
    shape = shown["links"][0]["shapes"][0]
    mesh = shown["meshes"][shape["mesh"]]
    points = np.frombuffer(base64.b64decode(mesh["points"]), "<f4").reshape(-1, 3)
    triangles = np.frombuffer(base64.b64decode(mesh["triangles"]), "<u4")
    turned = np.empty(9)
    mujoco.mju_quat2Mat(turned, np.array(shape["quaternion"]))
    corners = points @ turned.reshape(3, 3).T + shape["position"]
    expected = [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)]
    assert np.abs(corners[:, None] - np.array(expected)).max(-1).min(0).max() < 2e-5
    assert (len(points), len(triangles)) == (4, 12)


@pytest.mark.usefixtures("menagerie")
def test_missing_mesh_files_are_named():
    with pytest.raises(FleetError, match="base_link"):
        build_cell([Robot(name="a")], meshes=True)


@pytest.mark.skipif(importlib.util.find_spec("mujoco_menagerie") is not None, reason="mujoco-menagerie is installed")
def test_meshes_without_the_package_say_how_to_get_it():
    with pytest.raises(FleetError, match=r"pip install -e '\.\[meshes\]'"):
        build_cell([Robot(name="a")], meshes=True)


def test_the_real_package_finds_no_meshes_where_none_are(monkeypatch, tmp_path):
    pytest.importorskip("mujoco_menagerie")
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    with pytest.raises(FleetError, match="MENAGERIE_ROOT"):
        build_cell([Robot(name="a")], meshes=True)
