"""Fixtures of a scenario file whose shape is in a file of its own: STL, OBJ, GLB, MJCF or URDF."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any  # a mesh of trimesh

import numpy as np

from fleet.errors import ScenarioError, install, nearest, printable
from fleet.job import LEAST_FIXTURE_M, MOST_FIXTURE_M
from fleet.robot import rotation
from fleet.surface import convex_parts, surface_of

Array = np.ndarray

MESH_KEYS = ("mesh", "unit")
"""Keys of a fixture in place of `size_m`."""
UNITS = {"m": 1.0, "mm": 0.001}
MESHES, MODELS = (".stl", ".obj", ".glb"), (".xml", ".mjcf", ".urdf")
MOST_BYTES, MOST_TRIANGLES = 64_000_000, 100_000
SAME_M = 1e-6
"""Points closer than this are one point: the triangles of an STL file do not share theirs."""

DIGITS = 9
"""Decimal places of sizes and positions, m."""


def with_meshes(raw: Mapping[str, object], path: Path) -> Mapping[str, object]:
    """The parsed file with the surfaces of its fixtures in place of the files, which `path` locates.

    The origin of the file is at `position_m`, turned by `tilt_deg`.

    Raises:
        ScenarioError: a file cannot be read or used, with the reason.
    """
    fixtures = raw.get("fixtures")
    if not isinstance(fixtures, list | tuple):
        return raw
    read = [
        _with_mesh(each, path.parent, f"{path.name}: fixtures[{i}]")
        if isinstance(each, Mapping) and not each.keys().isdisjoint(MESH_KEYS)
        else each
        for i, each in enumerate(fixtures)
    ]
    return {**raw, "fixtures": read}


def _with_mesh(fixture: Mapping[str, object], folder: Path, place: str) -> dict[str, object]:
    name, unit = fixture.get("mesh"), fixture.get("unit", "m")
    if not isinstance(name, str) or "size_m" in fixture or "surface" in fixture:
        raise ScenarioError(f'{place}: a fixture has either `size_m`, of a box, or mesh = "FILE" with its `unit`.')
    if unit not in UNITS:
        raise ScenarioError(f"{place}.unit: no unit {unit!r}{nearest(str(unit), UNITS)}")
    where = f"{place}.mesh: '{printable(name)}'"
    points, triangles = _read(folder / name, where)
    points_m, triangles = _joined(points * UNITS[str(unit)], triangles)
    if len(triangles) == 0:
        raise ScenarioError(f"{where} has no triangles. Export the shape as a surface.")
    if len(triangles) > MOST_TRIANGLES:
        raise ScenarioError(
            f"{where} has {len(triangles)} triangles; at most {MOST_TRIANGLES} are allowed. Export it more coarsely."
        )
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    _check_size(high - low, str(unit), where)
    surface = surface_of(points_m - (low + high) / 2, triangles)
    try:
        convex_parts(surface)
    except ValueError as error:
        raise ScenarioError(f"{where} cannot be used: {error}.") from error
    fields = {key: value for key, value in fixture.items() if key not in MESH_KEYS}
    fields |= {"size_m": (high - low).round(DIGITS).tolist(), "surface": vars(surface)}
    position_m, tilt_deg = _triple(fields.get("position_m")), _triple(fields.get("tilt_deg", (0.0, 0.0, 0.0)))
    if position_m and tilt_deg:  # faults of either are reported when the scenario is made
        fields["position_m"] = (rotation(tilt_deg) @ ((low + high) / 2) + position_m).round(DIGITS).tolist()
    return fields


def _triple(value: object) -> tuple[float, float, float] | None:
    if not isinstance(value, list | tuple) or not all(isinstance(each, int | float) for each in value):
        return None
    return (float(value[0]), float(value[1]), float(value[2])) if len(value) == 3 else None


def _check_size(size: Array, unit: str, where: str) -> None:
    """Check that every length is one of a fixture, and ask about the unit if it would be one in the other unit."""
    shown = " × ".join(f"{length / UNITS[unit]:.4g}" for length in size)
    if size.min() >= LEAST_FIXTURE_M and size.max() <= MOST_FIXTURE_M:
        return
    other = next(each for each in UNITS if each != unit)
    meant = size / UNITS[unit] * UNITS[other]
    if meant.min() >= LEAST_FIXTURE_M and meant.max() <= MOST_FIXTURE_M:
        words = {"m": "metres", "mm": "millimetres"}
        raise ScenarioError(f'{where} is {shown} {unit} large: is it in {words[other]}? Give unit = "{other}".')
    raise ScenarioError(
        f"{where} is {shown} {unit} large; each length must be between {LEAST_FIXTURE_M:g} and {MOST_FIXTURE_M:g} m."
    )


def _read(file: Path, where: str) -> tuple[Array, Array]:
    """Points [point, 3] and triangles [triangle, 3] of a file, in its unit, z up."""
    ending = file.suffix.lower()
    if ending not in (*MESHES, *MODELS):
        raise ScenarioError(f"{where} must end in {', '.join((*MESHES, *MODELS))}.")
    try:
        size = file.stat().st_size
    except OSError as error:
        raise ScenarioError(f"{where} cannot be read: {error.strerror}. Paths are relative to the scenario.") from error
    if size > MOST_BYTES:
        raise ScenarioError(f"{where} has {size / 1e6:.0f} MB; at most {MOST_BYTES / 1e6:.0f} are allowed.")
    try:
        from fleet.arm.cell import model_solids

        solids = list(model_solids(file) if ending in MODELS else _mesh_solids(file))
    except ModuleNotFoundError as error:
        raise ScenarioError(f"{where} needs trimesh: {install('report')}.") from error
    except Exception as error:  # readers of damaged files raise errors of many kinds
        reason = printable(" ".join(str(error).split()).rstrip(".:"), 200) or type(error).__name__
        raise ScenarioError(f"{where} is no file of its kind ({ending[1:].upper()}): {reason}.") from error
    shift = np.cumsum([0, *(len(points) for points, _ in solids)])
    points = [points for points, _ in solids]
    triangles = [corners + first for first, (_, corners) in zip(shift, solids, strict=False)]
    return np.concatenate([np.empty((0, 3)), *points]), np.concatenate([np.empty((0, 3), int), *triangles])


def _mesh_solids(file: Path) -> Iterator[tuple[Array, Array]]:
    import trimesh

    solid: Any = trimesh.load_scene(file).to_mesh()
    points = np.asarray(solid.vertices, float)
    # In glTF y points up.
    yield points[:, [0, 2, 1]] * (1, -1, 1) if file.suffix.lower() == ".glb" else points, np.asarray(solid.faces)


def _joined(points_m: Array, triangles: Array) -> tuple[Array, Array]:
    """Points and triangles without repeated points, and without triangles that have become lines."""
    distinct, row = np.unique(np.rint(points_m / SAME_M), axis=0, return_inverse=True)
    corners = row.reshape(-1)[triangles]
    proper = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    used, corners = np.unique(corners[proper], return_inverse=True)
    return distinct[used] * SAME_M, corners.reshape(-1, 3)
