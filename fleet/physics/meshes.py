"""Kinova's shells for rendering: replaces the primitives of `gen3.xml` by the meshes of MuJoCo Menagerie."""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

from importlib import import_module
from pathlib import Path

import mujoco

from fleet.errors import FleetError, install

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
