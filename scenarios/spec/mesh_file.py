"""Fixtures of a scenario file whose shape is in a file of its own: STL, OBJ, GLB, MJCF or URDF."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any  # a mesh of trimesh

import numpy as np

from fleet.errors import ScenarioError, distinguish, printable
from fleet.job import LEAST_FIXTURE_M, MOST_FIXTURE_M, Fixture
from fleet.robot import rotation
from fleet.surface import surface_of
from scenarios.spec.schema import Scenario

UNITS = {"m": 1.0, "mm": 0.001, "cm": 0.01, "in": 0.0254}
"""Metres of each unit, in the order in which a question names them."""
MESHES, MODELS = (".stl", ".obj", ".glb"), (".xml", ".mjcf", ".urdf")
MOST_BYTES, MOST_TRIANGLES, MOST_PARTS = 64_000_000, 100_000, 64
MOST_LINE, MOST_HEAD = 10_000, 4_000_000
"""Bytes of a line of OBJ, which holds one polygon, and of the description at the begin of a GLB file."""
MADE = re.compile(rb"<\s*(replicate|composite|flexcomp)\b")
"""Elements of MJCF that make any number of shapes."""
DIGITS = 6
"""Decimal places of points, m; equal ones are one point, as the triangles of an STL file do not share theirs."""
FLAT_M = 1e-4
"""A part with less volume than this times half of its surface is flat."""
INSIDE_M = 1e-5
"""Tolerance within which a part counts as inside another."""


def with_meshes(scenario: Scenario, path: Path) -> Scenario:
    """The scenario with the surfaces in the mesh files of its fixtures; `path` locates them.

    Raises:
        ScenarioError: a file cannot be read or used, with the reason.
    """
    fixtures = list(scenario.fixtures)
    for i, each in enumerate(fixtures):
        if each.mesh is not None:
            where = f"{path.name}: fixtures[{i}].mesh: '{printable(each.mesh)}'"
            fixtures[i] = _with_surface(each, path.parent / each.mesh, where)
    return replace(scenario, fixtures=tuple(fixtures))


def _with_surface(fixture: Fixture, file: Path, where: str) -> Fixture:
    mesh = _read(file, where)
    if not 0 < len(mesh.faces) <= MOST_TRIANGLES:
        none = "Only shapes that collide count" if file.suffix.lower() in MODELS else "Export the shape as a surface"
        advice = "Export it more coarsely" if len(mesh.faces) else none
        raise ScenarioError(f"{where} has {len(mesh.faces)} triangles; allowed are 1 to {MOST_TRIANGLES}. {advice}.")
    low, high = mesh.extents.min(), mesh.extents.max()
    fits = [unit for unit, m in UNITS.items() if m * low >= LEAST_FIXTURE_M and m * high <= MOST_FIXTURE_M]
    if fixture.unit not in fits:
        size, meant = (_size(k * mesh.extents) for k in (1.0, UNITS[fits[0]] if fits else 1.0))
        ask = f' Is this in {fits[0]} ({meant} m)? Give unit = "{fits[0]}".' if fits else ""
        allowed = f"between {LEAST_FIXTURE_M:g} and {MOST_FIXTURE_M:g} m"
        raise ScenarioError(f"{where} is {size} {fixture.unit} large; each length must be {allowed}.{ask}")
    mesh.apply_scale(UNITS[fixture.unit])
    mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=DIGITS)
    centre_m = mesh.bounds.mean(axis=0)
    mesh.apply_translation(-centre_m)
    x, y, z = (rotation(fixture.tilt_deg) @ centre_m + fixture.position_m).round(DIGITS).tolist()
    surface = surface_of(mesh.vertices, mesh.faces, _convex_parts(mesh, where))
    try:
        return Fixture(
            name=fixture.name,
            position_m=(x, y, z),
            size_m=tuple(mesh.extents.round(DIGITS).tolist()),
            tilt_deg=fixture.tilt_deg,
            surface=surface,
        )
    except ValueError as error:
        raise ScenarioError(f"{where} lies far from its origin: {error} Move the shape in the file.") from error


def _read(file: Path, where: str) -> Any:
    """The shape in a file as a trimesh, in its unit, z up."""
    import trimesh  # optional

    from fleet.arm.cell import model_solid

    ending = file.suffix.lower()
    if ending not in (*MESHES, *MODELS):
        raise ScenarioError(f"{where} must end in {', '.join((*MESHES, *MODELS))}.")
    if not file.is_file():
        raise ScenarioError(f"{where}: there is no such file. Paths are relative to the scenario file.")
    if (size := file.stat().st_size) > MOST_BYTES:
        given, most = distinguish(size / 1e6, MOST_BYTES / 1e6)
        raise ScenarioError(f"{where} has {given} MB; at most {most} are allowed.")
    _check_content(file.read_bytes(), ending, where)
    try:
        mesh: Any = model_solid(file) if ending in MODELS else trimesh.load_scene(file, process=False).to_mesh()
    except Exception as error:  # readers of damaged files raise errors of many kinds
        reason = printable(" ".join(str(error).split()).rstrip(".:"), 200)
        raise ScenarioError(f"{where} cannot be read as {ending[1:].upper()}: {reason}.") from error
    if not np.isfinite(mesh.vertices).all():
        raise ScenarioError(f"{where} has corners that are no finite numbers; export the shape again.")
    if ending in MESHES:
        mesh.process(validate=False)  # joins corners that are the same
    if ending == ".glb":  # there y points up
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    return mesh


def _check_content(content: bytes, ending: str, where: str) -> None:
    """Refuse what takes a reader minutes or gigabytes though the file is small."""
    if ending in MODELS and (made := MADE.search(content)):
        raise ScenarioError(f"{where} has <{made[1].decode()}>, which makes shapes. Write them out, or give a mesh.")
    if ending == ".obj" and (longest := max(map(len, content.split(b"\n")))) > MOST_LINE:
        raise ScenarioError(f"{where} has a line of {longest} bytes; at most {MOST_LINE} are allowed. Use triangles.")
    if ending == ".glb" and (head := int.from_bytes(content[12:16], "little")) > MOST_HEAD:
        raise ScenarioError(f"{where} describes its parts in {head} bytes; at most {MOST_HEAD} are allowed. Join them.")


def _convex_parts(mesh: Any, where: str) -> list[np.ndarray]:
    """Corners of the convex hull of each connected part, m, [corner, 3]; none of them lies inside another.

    Triangles are connected if they alone share an edge, so solids that touch stay apart.
    """
    import trimesh
    from scipy.spatial import ConvexHull, QhullError  # slow to import

    solids: list[Any] = []
    flat: list[np.ndarray] = []
    for faces in trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(mesh.faces))):
        points = mesh.vertices[np.unique(mesh.faces[faces])]
        try:
            hull = ConvexHull(points)
        except QhullError:
            hull = None
        if hull is None or 2 * hull.volume < FLAT_M * hull.area:
            flat.append(points)
        else:
            solids.append(hull)
    kept: list[Any] = []
    for hull in sorted(solids, key=lambda hull: -hull.volume):
        if not _is_inside(hull.points[hull.vertices], kept):
            kept.append(hull)
        if len(kept) > MOST_PARTS:
            raise ScenarioError(f"{where} has more than {MOST_PARTS} separate parts. Leave out small ones.")
    for points in flat:
        if not _is_inside(points, kept):
            size = _size(np.ptp(points, axis=0))
            raise ScenarioError(f"{where} has a flat part of {size} m. Give it a thickness, or leave it out.")
    return [hull.points[hull.vertices] for hull in kept]


def _size(lengths: np.ndarray) -> str:
    """Lengths as 0.3 × 0.2 × 0.4."""
    return " × ".join(f"{length:.4g}" for length in lengths)


def _is_inside(points: np.ndarray, hulls: list[Any]) -> bool:
    """Whether points are all inside one of some convex hulls."""
    return any(
        (points > hull.min_bound - INSIDE_M).all()
        and (points < hull.max_bound + INSIDE_M).all()
        and all((points @ side[:3]).max() + side[3] < INSIDE_M for side in hull.equations)
        for hull in hulls
    )
