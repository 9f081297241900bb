"""Fixtures from files, compared with boxes of the same shape and with shapes whose hulls are known."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from fleet.arm.cell import CellPlayer, ContactFinder, cell_model
from fleet.arm.model import ArmModel, build_cell, supports
from fleet.env.render.picture import outlines
from fleet.errors import ScenarioError
from fleet.robot import Mount, Robot, rotation
from fleet.surface import Surface
from scenarios.prepare.fleet import prepare
from scenarios.spec.load import load
from scenarios.spec.parse import override, scenario_hash
from scenarios.spec.schema import Scenario

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
"""Corners of each side of a box, counted in binary."""


def triangles_of(low: tuple[float, ...], high: tuple[float, ...]) -> list[list[tuple[float, ...]]]:
    """The 12 triangles of a box."""
    corner = list(product(*zip(low, high, strict=True)))
    return [[corner[a], corner[b], corner[c]] for a, b, c, d in SIDES for a, b, c in ((a, b, c), (a, c, d))]


def write_stl(file: Path, *boxes: tuple[tuple[float, ...], tuple[float, ...]]) -> None:
    lines = ["solid fixture"]
    for triangle in (each for box in boxes for each in triangles_of(*box)):
        corners = ["vertex {} {} {}".format(*corner) for corner in triangle]
        lines += ["facet normal 0 0 0", "outer loop", *corners, "endloop", "endfacet"]
    file.write_text("\n".join([*lines, "endsolid fixture"]), encoding="ascii")


def with_fixture(small_toml: Path, **fields: object) -> Scenario:
    lines = [f"{key} = {value!r}" for key, value in {"name": "oven", "position_m": [0, 0, 0], **fields}.items()]
    file = small_toml.with_name("cell.toml")
    file.write_text(small_toml.read_text() + "\n[[fixtures]]\n" + "\n".join(lines), encoding="utf-8")
    return load(file)


LOW, HIGH = (-40.0, 10.0, 0.0), (60.0, 90.0, 130.0)
CENTRE_M, TILT_DEG = (-0.2, 0.1, 0.35), (0.0, 20.0, 70.0)


@pytest.fixture
def pair(small_toml: Path) -> tuple[Scenario, Scenario]:
    """A cell with a fixture from a file in mm, and the same cell with the box that this is."""
    write_stl(small_toml.with_name("oven.stl"), (LOW, HIGH))
    low, high = np.array(LOW) / 1000, np.array(HIGH) / 1000
    origin = CENTRE_M - rotation(TILT_DEG) @ ((low + high) / 2)
    pose = {"position_m": origin.tolist(), "tilt_deg": [*TILT_DEG]}
    from_file = with_fixture(small_toml, mesh="oven.stl", unit="mm", **pose)
    box = {"name": "oven", "size_m": high - low, "position_m": CENTRE_M, "tilt_deg": TILT_DEG}
    return from_file, override(load(small_toml), fixtures=[box])


@pytest.mark.parametrize(("unit", "unit_mm"), [("m", 1000.0), ("mm", 1.0), ("cm", 10.0), ("in", 25.4)])
def test_a_file_may_be_in_any_unit(small_toml: Path, unit: str, unit_mm: float) -> None:
    low, high = (tuple(each / unit_mm for each in corner) for corner in (LOW, HIGH))
    write_stl(small_toml.with_name("oven.stl"), (low, high))
    (fixture,) = with_fixture(small_toml, mesh="oven.stl", unit=unit, position_m=[-0.2, 0.1, 0.3]).fixtures
    assert fixture.size_m == pytest.approx((np.array(HIGH) - LOW) / 1000, abs=1e-5)


def distances_m(scenario: Scenario, postures: np.ndarray) -> np.ndarray:
    """From each link of the left arm to the first fixture, at most 1 m."""
    robot = scenario.arms[0].robot()
    arm = ArmModel(robot, scenario.fixtures)
    names = [arm.model.geom(g).name for g in range(arm.model.ngeom)]
    links = [g for g, name in enumerate(names) if name.startswith("left/") and name != "left/payload"]
    parts = [g for g, name in enumerate(names) if name.startswith("fixture/")]
    found = []
    for q in postures:
        arm.data.qpos[:] = q
        mujoco.mj_kinematics(arm.model, arm.data)
        found.append([min(mujoco.mj_geomDistance(arm.model, arm.data, a, b, 1.0, None) for b in parts) for a in links])
    return np.array(found)


def test_a_box_from_a_file_is_as_far_from_every_link_as_the_box(pair) -> None:
    postures = np.random.default_rng(2).uniform(-2.0, 2.0, (200, 7))
    from_file, box = (distances_m(scenario, postures) for scenario in pair)
    apart = box > 0
    assert (~apart).sum() > 10
    assert from_file[apart] == pytest.approx(box[apart], abs=1e-5)
    assert (from_file[~apart] < 1e-5).all()


def test_a_box_from_a_file_gives_the_plans_and_exclusions_of_the_box(pair, tmp_path) -> None:
    cells = (*pair, replace(pair[0], fixtures=()))
    fleets = [prepare(scenario, difficulty="blind", cache=tmp_path) for scenario in cells]
    plans, same, free = ([p for arm in f.arms for made in arm.plans.values() for p in made] for f in fleets)
    assert [plan.work for plan in plans] == [plan.work for plan in same]
    for one, other in zip(plans, same, strict=True):
        for phase, like in zip(one.phases, other.phases, strict=True):
            np.testing.assert_array_equal(phase.profile, like.profile)
    np.testing.assert_array_equal(fleets[0].space.conflicts, fleets[1].space.conflicts)
    assert [plan.cycle.profile.tobytes() for plan in plans] != [plan.cycle.profile.tobytes() for plan in free]


L_SHAPE = (((0, 0, 0), (0.4, 0.2, 0.2)), ((0, 0, 0.2), (0.1, 0.2, 0.6)))
"""Two boxes, one on the other; their corners touch. The notch is where x > 0.1 and z > 0.2."""


def test_an_l_of_two_boxes_has_two_hulls_and_an_arm_reaches_into_its_notch(small_toml) -> None:
    write_stl(small_toml.with_name("l.stl"), *L_SHAPE)
    (fixture,) = with_fixture(small_toml, mesh="l.stl").fixtures
    boxes = sorted((part + fixture.position_m).round(6).tolist() for part in fixture.parts_m)
    expected = sorted(sorted(product(*zip(*box, strict=True))) for box in L_SHAPE)
    assert [sorted(map(tuple, box)) for box in boxes] == [[tuple(map(float, c)) for c in box] for box in expected]
    arm = Robot(name="left", mount=Mount(position_m=(0.9, 0.1, 0.0), tilt_deg=(0.0, 0.0, 180.0)))
    model = build_cell([arm], fixtures=[fixture])
    data, probe = mujoco.MjData(model), model.geom("left/payload").id
    model.geom_size[probe], model.geom_type[probe] = 0.05, mujoco.mjtGeom.mjGEOM_SPHERE
    mujoco.mj_kinematics(model, data)
    data.geom_xpos[probe] = (0.25, 0.1, 0.35)  # inside the hull of all corners, 0.15 m from either box
    parts = [g for g in range(model.ngeom) if model.geom(g).name.startswith("fixture/")]
    away_m = [mujoco.mj_geomDistance(model, data, g, probe, 1.0, None) for g in parts]
    assert away_m == pytest.approx([0.10, 0.10], abs=1e-6)
    shadows = [sorted(map(tuple, outline.round(6).tolist())) for outline in outlines(fixture)]
    assert sorted(max(x for x, _ in each) for each in shadows) == pytest.approx([0.1, 0.4])


def test_a_changed_file_makes_new_plans(small_toml, tmp_path) -> None:
    """The same name, place and box around it: only the content differs."""
    cache, hashes, files = tmp_path / "cache", set[str](), list[int]()
    for boxes in (L_SHAPE, L_SHAPE, (L_SHAPE[0], ((0.3, 0, 0.2), (0.4, 0.2, 0.6)))):
        write_stl(small_toml.with_name("l.stl"), *boxes)
        scenario = with_fixture(small_toml, mesh="l.stl", position_m=[-0.2, 0.7, 0.0])
        hashes.add(scenario_hash(scenario))
        prepare(scenario, difficulty="blind", cache=cache)
        files.append(len([*(cache / "plans").iterdir()]))
    assert len(hashes) == 2
    assert files[0] == files[1] < files[2]
    assert override(scenario, horizon_s=200).fixtures == scenario.fixtures


def test_every_kind_of_file_gives_the_same_box(small_toml) -> None:
    """0.4 m along x, 0.2 along y and 0.6 along z, from z = 0 up; trimesh and MuJoCo write or describe it."""
    folder = small_toml.parent
    box = trimesh.creation.box(extents=(0.4, 0.2, 0.6)).apply_translation((0, 0, 0.3))
    box.export(folder / "a.stl")
    box.export(folder / "a.obj")
    y_up = box.copy().apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    y_up.export(folder / "a.glb")
    part = '<geom type="box" size=".2 .1 .3"/>'
    decoration = '<geom type="sphere" size="1" contype="0" conaffinity="0"/><geom type="plane" size="1 1 1"/>'
    (folder / "a.xml").write_text(
        f'<mujoco><worldbody>{decoration}<body pos="0 0 .3">{part}</body></worldbody></mujoco>'
    )
    (folder / "a.urdf").write_text(
        '<robot name="a"><link name="a"><collision><origin xyz="0 0 .3"/><geometry><box size=".4 .2 .6"/></geometry>'
        "</collision></link></robot>"
    )
    for ending in ("stl", "obj", "glb", "xml", "urdf"):
        (fixture,) = with_fixture(small_toml, mesh=f"a.{ending}", position_m=[1, 0.5, 0]).fixtures
        assert fixture.size_m == pytest.approx((0.4, 0.2, 0.6)), ending
        assert fixture.position_m == pytest.approx((1.0, 0.5, 0.3)), ending
        assert [len(part) for part in fixture.parts_m] == [8], ending


def test_small_parts_inside_others_are_left_out(small_toml) -> None:
    screws = [((x, 0.05, 0.05), (x + 0.002, 0.06, 0.06)) for x in np.linspace(0.01, 0.09, 100).tolist()]
    write_stl(small_toml.with_name("a.stl"), ((0, 0, 0), (0.1, 0.1, 0.1)), *screws)
    (fixture,) = with_fixture(small_toml, mesh="a.stl").fixtures
    assert len(fixture.parts_m) == 1
    write_stl(small_toml.with_name("a.stl"), *screws)
    with pytest.raises(ScenarioError, match=r"'a.stl' has more than 64 separate parts. Leave out small ones"):
        with_fixture(small_toml, mesh="a.stl")


UNIT = {"mesh": "big.stl"}
WRONG = [
    (UNIT, r"'big.stl' is 800 × 600 × 20 m large; .* Is this in mm \(0.8 × 0.6 × 0.02 m\)\? Give unit = \"mm\"\."),
    ({"mesh": "small.stl", "unit": "mm"}, r"is 0.8 × 0.6 × 0.02 mm large; .* Is this in m \(0.8 × 0.6 × 0.02 m\)\?"),
    (
        UNIT | {"unit": "dm"},
        r"fixtures\[0\].unit: 'dm' is not allowed. Allowed: m, mm, cm, in. Export the file in one of",
    ),
    (UNIT | {"size_m": [1, 1, 1]}, r"fixtures\[0\].size_m must be left out beside `mesh`"),
    ({"mesh": "none.stl"}, r"fixtures\[0\].mesh: 'none.stl': there is no such file\. Paths are relative to"),
    ({"mesh": "big.step"}, r"'big.step' must end in .stl, .obj, .glb, .xml, .mjcf, .urdf"),
    ({"mesh": "text.stl"}, r"'text.stl' has 0 triangles; allowed are 1 to 100000. Export the shape as a surface"),
    ({"mesh": "text.glb"}, r"'text.glb' cannot be read as GLB: "),
    ({"mesh": "text.urdf"}, r"'text.urdf' cannot be read as URDF: XML parse error"),
    ({"mesh": "seen.urdf"}, r"'seen.urdf' has 0 triangles; .* Only shapes that collide count"),
    ({"mesh": "flat.obj"}, r"'flat.obj' is 1 × 1 × 0 m large; each length must be between 0.001 and 10 m"),
    ({"mesh": "tilted.obj"}, r"'tilted.obj' has a flat part of 1 × 1 × 1 m. Give it a thickness, or leave it out"),
    ({"mesh": "fine.stl"}, r"'fine.stl' has 327680 triangles; allowed are 1 to 100000. Export it more coarsely"),
    ({"mesh": "huge.stl"}, r"'huge.stl' has 64.000001 MB; at most 64 are allowed"),
    ({"mesh": "many.xml"}, r"'many.xml' has <replicate>, which makes shapes"),
    ({"mesh": "polygon.obj"}, r"'polygon.obj' has a line of 12001 bytes; at most 10000 are allowed\. Use triangles"),
    ({"mesh": "nodes.glb"}, r"'nodes.glb' describes its parts in 4000001 bytes; at most 4000000 are allowed"),
    ({}, r"fixtures\[0\].size_m must be three lengths"),
]


@pytest.mark.parametrize(("fields", "sentence"), WRONG)
def test_a_file_that_cannot_be_used_is_refused_in_words(small_toml, fields, sentence) -> None:
    folder = small_toml.parent
    write_stl(folder / "big.stl", ((0, 0, 0), (800, 600, 20)))
    write_stl(folder / "small.stl", ((0, 0, 0), (0.8, 0.6, 0.02)))
    for ending in ("stl", "glb", "urdf"):
        (folder / f"text.{ending}").write_text("a text")
    seen = '<visual><geometry><box size="1 1 1"/></geometry></visual>'
    (folder / "seen.urdf").write_text(f'<robot name="a"><link name="a">{seen}</link></robot>')
    (folder / "many.xml").write_text('<mujoco><worldbody><replicate count="1000000000"/></worldbody></mujoco>')
    (folder / "polygon.obj").write_text("f" + 6000 * " 1" + "\n")
    (folder / "nodes.glb").write_bytes(b"glTF" + bytes(8) + (4_000_001).to_bytes(4, "little"))
    for name, height in (("flat", 0), ("tilted", 1)):
        (folder / f"{name}.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 1 1 {height}\nv 0 1 {height}\nf 1 2 3 4\n")
    if fields.get("mesh") == "fine.stl":
        trimesh.creation.icosphere(subdivisions=7).export(folder / "fine.stl")
    if fields.get("mesh") == "huge.stl":
        with (folder / "huge.stl").open("wb") as file:
            file.truncate(64_000_001)
    with pytest.raises(ScenarioError, match=sentence):
        with_fixture(small_toml, **fields)


def test_pictures_get_the_whole_surface_and_no_arm_floats(small_toml) -> None:
    write_stl(small_toml.with_name("l.stl"), *L_SHAPE)
    (fixture,) = with_fixture(small_toml, mesh="l.stl").fixtures
    high = {"floor": (0.0, 0.0, 0.0), "wall": (90.0, 0.0, 30.0), "ceiling": (180.0, 0.0, 0.0)}
    arms = [
        Robot(name=kind, mount=Mount(position_m=(float(i), 0.0, 1.0), tilt_deg=tilt_deg))
        for i, (kind, tilt_deg) in enumerate(high.items())
    ]
    model = cell_model(arms, fixtures=[fixture])
    surface = Surface(**model["meshes"][model["fixtures"][0]["mesh"]])
    areas = trimesh.Trimesh(surface.points_m, surface.corners).area
    assert areas == pytest.approx(sum(2 * (x * y + y * z + z * x) for x, y, z in ((0.4, 0.2, 0.2), (0.1, 0.2, 0.4))))
    plates, others = zip(*zip(*[iter(supports(arms))] * 2, strict=True), strict=True)
    for arm, (centre, turn, size, _) in zip(arms, plates, strict=True):
        touched = turn.T @ (np.array(arm.mount.position_m) - centre) / (size / 2)
        assert touched[:2] == pytest.approx((0, 0))
        assert 0 < touched[2] <= 1  # the base is in the plate
    reach_floor = [abs(centre[2] - size[2] / 2) < 1e-9 for centre, _, size, _ in others]
    assert reach_floor == [True, True, False]
    for (centre, turn, size, _), (other, _, _, _) in zip(others, plates, strict=True):
        behind = turn.T @ (other - centre) / (size / 2)
        assert np.abs(behind).max() < 1.5


def test_contact_with_a_fixture_of_two_parts_is_one_event(small_toml) -> None:
    write_stl(small_toml.with_name("l.stl"), *L_SHAPE)
    arm = Robot(name="left", home="retract")
    q = arm.home_q()[None, None].repeat(2, axis=0)
    player = CellPlayer([arm])
    player.show(q[0], np.zeros((1, 7, 3)), np.zeros((1, 7)), np.zeros(1))
    forearm = player.data.geom("left/forearm").xpos
    origin = forearm - (0.05, 0.1, 0.2)  # where the two boxes meet
    model = build_cell([arm], fixtures=with_fixture(small_toml, mesh="l.stl", position_m=origin.tolist()).fixtures)
    events = ContactFinder(model, [arm]).events(np.array([0.0, 0.1]), q, np.zeros((2, 1)))
    pairs = [event.reason.rsplit(",", 1)[0] for event in events]
    assert any(pair.startswith("forearm of left") for pair in pairs)
    assert len(pairs) == len(set(pairs))
    assert all(pair.endswith("the fixture 'oven'") for pair in pairs)
