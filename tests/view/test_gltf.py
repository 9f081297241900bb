"""A recorded shift as glTF, read back from the specification alone and by trimesh, and compared with MuJoCo."""

import json
import struct
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation, Slerp

from scenarios.run.log import RunLog
from scenarios.show.gltf import LONGEST_TURN_RAD, Z_UP, divided
from scenarios.show.moments import motor_drums
from tests.commands import call

SPEED = 60.0
NEAR_M = 1e-4


@pytest.fixture(scope="module")
def file(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gltf") / "shift.glb"
    assert call("view", run_folder, "--out", path, "--speed", SPEED) == 0
    return path


class Reader:
    """Nodes of a GLB file at a time of its animation, from the specification alone."""

    def __init__(self, path: Path) -> None:
        raw = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", raw)
        assert (magic, version, length) == (b"glTF", 2, len(raw))
        size, kind = struct.unpack_from("<I4s", raw, 12)
        assert (size % 4, kind) == (0, b"JSON")
        self.json: dict[str, Any] = json.loads(raw[20 : 20 + size])
        (held, kind), self._bin = struct.unpack_from("<I4s", raw, 20 + size), raw[28 + size :]
        assert (held, kind) == (len(self._bin), b"BIN\0")
        assert self.json["buffers"] == [{"byteLength": held}]
        self.parent = {c: i for i, node in enumerate(self.json["nodes"]) for c in node.get("children", ())}
        self.index = {node["name"]: i for i, node in enumerate(self.json["nodes"])}

    def array(self, accessor: int) -> np.ndarray:
        about = self.json["accessors"][accessor]
        view = self.json["bufferViews"][about["bufferView"]]
        columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[about["type"]]
        kind = {5126: "<f4", 5123: "<u2"}[about["componentType"]]
        flat = np.frombuffer(self._bin, kind, about["count"] * columns, view["byteOffset"])
        return flat.reshape(-1, columns)[:, 0] if columns == 1 else flat.reshape(-1, columns)

    def at(self, time_s: float) -> list[dict[str, np.ndarray]]:
        """Translation, rotation (x, y, z, w) and scale of each node."""
        unit = {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]}
        nodes = [{k: np.array(node.get(k, v), float) for k, v in unit.items()} for node in self.json["nodes"]]
        (animation,) = self.json["animations"]
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            times, values = self.array(sampler["input"]), self.array(sampler["output"])
            assert (np.diff(times) > 0).all()
            after = int(np.clip(np.searchsorted(times, time_s, side="right"), 1, len(times)))
            before = values[after - 1].astype(float)
            if sampler["interpolation"] == "LINEAR" and after < len(times):
                share = np.clip((time_s - times[after - 1]) / (times[after] - times[after - 1]), 0.0, 1.0)
                before = Slerp([0.0, 1.0], Rotation.from_quat([before, values[after]]))(share).as_quat()
            nodes[channel["target"]["node"]][channel["target"]["path"]] = before
        return nodes

    def place(self, nodes: list[dict[str, np.ndarray]], name: str) -> np.ndarray:
        """Origin of a node in the coordinates of the cell."""
        point, i = np.zeros(3), self.index[name]
        while i in self.parent:
            x, y, z, w = nodes[i]["rotation"]
            turned = np.empty(3)
            mujoco.mju_rotVecQuat(turned, point * nodes[i]["scale"], np.array([w, x, y, z]))  # pyright: ignore[reportAttributeAccessIssue]
            point, i = turned + nodes[i]["translation"], self.parent[i]
        assert nodes[i]["rotation"] == pytest.approx(Z_UP)
        return point


def test_the_motors_are_where_mujoco_has_them(file: Path, run: RunLog, motors_in_mujoco) -> None:
    reader, begin_s = Reader(file), float(run.readings.time_s[0])
    moving = np.abs(run.readings.qd).max(axis=(1, 2)) > 0.2
    for time_s in np.random.default_rng(5).choice(run.readings.time_s[moving], 5, replace=False):
        nodes = reader.at((time_s - begin_s) / SPEED)
        found = np.array([[reader.place(nodes, f"{arm}/link_{j + 1}") for j in range(7)] for arm in run.arms])
        assert np.abs(found - motors_in_mujoco(float(time_s))).max() < NEAR_M


def test_each_motor_shows_one_drum_of_the_colour_of_its_temperature(file: Path, run: RunLog) -> None:
    reader, readings = Reader(file), run.readings
    hottest = readings.temp_c.max(axis=(1, 2)).argmax()
    for sample in (0, hottest // 10 * 10, len(readings.time_s) // 20 * 10):
        nodes = reader.at((readings.time_s[sample] - readings.time_s[0]) / SPEED + 1e-9)
        for a, arm in enumerate(run.arms):
            for joint in range(7):
                start = f"{arm}/motor_{joint + 1}/"
                shown = [n for n in reader.index if n.startswith(start) and nodes[reader.index[n]]["scale"].any()]
                assert len(shown) == 1
                band_c = float(shown[0].removeprefix(start))
                temp_c = np.clip(readings.temp_c[sample, a, joint], 17.6, 87.4)
                assert abs(band_c - temp_c) <= 2.5 + 1e-6
                node = reader.json["nodes"][reader.index[shown[0]]]
                primitive = reader.json["meshes"][node["mesh"]]["primitives"][0]
                # The scale is the radius, and z the axis of the joint.
                extent = np.ptp(reader.array(primitive["attributes"]["POSITION"]), axis=0)
                assert extent == pytest.approx(
                    (2.0, 2.0, 1.6), abs=0.02
                )  # its radius is the scale, its axis the joint's
                colour = reader.json["materials"][primitive["material"]]["pbrMetallicRoughness"]["baseColorFactor"][:3]
                rgb, radius_m = motor_drums(np.array(band_c), run.scenario.limits)
                assert np.power(colour, 1 / 2.2) == pytest.approx(rgb, abs=0.03)  # sRGB is nearly a power of 2.2
                assert nodes[reader.index[shown[0]]]["scale"] == pytest.approx([float(radius_m)] * 3)


def test_trimesh_reads_the_shapes(file: Path, run: RunLog) -> None:
    scene = trimesh.load_scene(file)
    assert np.isfinite(scene.bounds).all()
    assert scene.extents.max() < 5.0
    assert all(f"{arm}/link_7" in scene.graph.nodes for arm in run.arms)
    assert all(mesh.is_winding_consistent for mesh in scene.geometry.values())


def test_a_long_turn_goes_the_right_way() -> None:
    finer_s, angle_rad = divided(np.array([0.0, 1.0, 2.0]), np.array([0.0, 5.0, 5.0]))
    assert np.abs(np.diff(angle_rad)).max() <= LONGEST_TURN_RAD
    assert angle_rad == pytest.approx(np.interp(finer_s, [0.0, 1.0, 2.0], [0.0, 5.0, 5.0]))
