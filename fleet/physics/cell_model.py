"""The cell in three dimensions, as plain values that every way to show it shares."""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

import base64
from collections.abc import Sequence
from typing import Any  # plain values of JSON

import mujoco
import numpy as np

from fleet.job import MOST_PAYLOAD_M, PAYLOAD_KG_PER_M3, Fixture, Place
from fleet.physics.models import build_cell, quaternion
from fleet.robot import Mount, Robot, rotation

SHAPES = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}
"""Shapes of links; sizes are MuJoCo's: radius, half length along z, or half lengths along x, y and z."""
HIDDEN = 3
"""MuJoCo's geom group of the primitives that meshes replace."""
DIGITS = 5


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
        and its shapes. `hand`: pose of the flange in the last link's frame. `arms`, `places`, `fixtures`: names and
        poses in the world. `meshes`: the surfaces that shapes of the kind "mesh" name. Positions and sizes are in m,
        quaternions w, x, y, z.

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
    hand = {"position": _rounded(model.body_pos[payload]), "quaternion": _rounded(model.body_quat[payload])}
    return {
        "links": links,
        "hand": hand,
        "arms": [{"name": robot.name, **_pose(robot.mount.position_m, robot.mount.rotation())} for robot in robots],
        "places": [{"name": place.name, **_pose(place.position_m, rotation(place.tool_deg))} for place in places],
        "fixtures": [
            {"name": box.name, "size": list(box.size_m), **_pose(box.position_m, rotation(box.tilt_deg))}
            for box in fixtures
        ],
        "meshes": [_mesh(model, mesh) for mesh in range(model.nmesh)],
        "load": {"most_m": MOST_PAYLOAD_M, "kg_per_m3": PAYLOAD_KG_PER_M3},
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


def _mesh(model: mujoco.MjModel, mesh: int) -> dict[str, Any]:
    """A surface: coordinates of its points as int16 in `unit_m`, points of its triangles as uint32; base64."""
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    points = model.mesh_vert[first : first + count]
    unit_m = float(np.abs(points).max()) / np.iinfo(np.int16).max
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    triangles = model.mesh_face[first : first + count].astype("<u4")
    encoded = (np.rint(points / unit_m).astype("<i2"), triangles)
    coordinates, corners = (base64.b64encode(values.tobytes()).decode("ascii") for values in encoded)
    return {"unit_m": unit_m, "points": coordinates, "triangles": corners}


def _pose(position_m: Sequence[float], matrix: np.ndarray) -> dict[str, Any]:
    return {"position": _rounded(position_m), "quaternion": _rounded(quaternion(matrix))}


def _rounded(values: Sequence[float] | np.ndarray) -> list[float]:
    return [round(float(value), DIGITS) for value in values]
