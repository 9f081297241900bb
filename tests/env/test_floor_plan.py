"""Floor plan: drawn to scale, without overlaps."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.env.render.floor_plan import SMALLEST, Cell, MountKind, floor_plan, grid_cell, text_width
from fleet.job import Fixture
from fleet.robot import JOINTS, rotation
from tests.profiles import examples

metres = st.floats(-50, 50)
points = st.tuples(metres, metres, metres)
sizes = st.tuples(st.integers(SMALLEST[0], 1300), st.integers(SMALLEST[1], 1000))
kinds = st.sampled_from(get_args(MountKind))


@st.composite
def cells(draw: st.DrawFn) -> Cell:
    arms, stations = draw(st.integers(1, 64)), draw(st.integers(0, 30))
    return Cell(
        arms=tuple(f"arm_{i}" for i in range(arms)),
        mounts_m=tuple(draw(st.lists(points, min_size=arms, max_size=arms))),
        kinds=tuple(draw(st.lists(kinds, min_size=arms, max_size=arms))),
        stations=tuple((f"s{i}", p) for i, p in enumerate(draw(st.lists(points, max_size=stations)))),
    )


def inside(x: float, y: float, box: tuple[int, int, int, int], margin: float = 0.0) -> bool:
    left, top, right, bottom = box
    return left + margin <= x <= right - margin and top + margin <= y <= bottom - margin


@examples(40)
@given(cells(), sizes)
def test_every_arm_and_station_is_on_the_floor(cell, size) -> None:
    plan = floor_plan(cell, size)
    floor = plan.floor
    assert inside(floor[0], floor[1], (0, 0, *size))
    assert inside(floor[2], floor[3], (0, 0, *size))
    assert len(plan.centres) == len(cell.arms)
    for a, (x, y) in enumerate(plan.centres.tolist()):
        assert inside(x, y, floor, plan.reach)
        assert y + plan.reach + plan.rows * plan.text <= floor[3]
        assert len(np.unique(plan.motors[a], axis=0)) == JOINTS
        assert all(inside(u, v, floor, plan.motor) for u, v in plan.motors[a])
    assert all(inside(x, y, floor, plan.station) for x, y in (*plan.stations, *plan.bases))


@given(
    st.tuples(*[st.floats(-5, 5)] * 3), st.tuples(*[st.floats(0.001, 10)] * 3), st.tuples(*[st.floats(-180, 180)] * 3)
)
def test_a_fixture_is_drawn_around_its_centre_and_as_large_as_its_shadow(position_m, size_m, tilt_deg) -> None:
    """By Cauchy, the shadow of a box is the sum of its faces' areas times the cosines of their tilts."""
    box = Fixture(name="box", position_m=position_m, size_m=size_m, tilt_deg=tilt_deg)
    cell = Cell(
        arms=("a",), mounts_m=((0.0, 0.0, 0.0),), kinds=("floor",), stations=(("s", (2.0, 1.0, 0.0)),), fixtures=(box,)
    )
    plan = floor_plan(cell)
    (outline,) = plan.fixtures
    px_per_m = (plan.stations[0, 0] - plan.bases[0, 0]) / 2.0
    centre = (outline.min(axis=0) + outline.max(axis=0)) / 2
    np.testing.assert_allclose((centre - plan.bases[0]) / px_per_m, [position_m[0], -position_m[1]], atol=0.05)
    x, y = outline.T
    area = abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2
    faces = np.array([size_m[1] * size_m[2], size_m[0] * size_m[2], size_m[0] * size_m[1]])
    assert area / px_per_m**2 == pytest.approx(faces @ np.abs(rotation(tilt_deg)[2]), rel=0.02, abs=1e-6)


@given(st.lists(points, min_size=1, max_size=6))
def test_distances_on_the_floor_plan_are_to_scale(stations) -> None:
    """One scale for both directions, x to the right and y up."""
    cell = replace(grid_cell(("arm_0",), ()), stations=tuple((f"s{i}", p) for i, p in enumerate(stations)))
    plan = floor_plan(cell)
    apart_px = np.array(plan.stations) - plan.bases[0]
    apart_m = np.array(stations)[:, :2] * [1.0, -1.0]
    farthest = np.unravel_index(np.abs(apart_m).argmax(), apart_m.shape)
    if abs(apart_m[farthest]) > 0.2:
        per_m = apart_px[farthest] / apart_m[farthest]
        assert per_m > 0
        np.testing.assert_allclose(apart_px, per_m * apart_m, atol=2.5)  # whole pixels


@pytest.mark.parametrize("arms", [2, 3, 4, 7, 16])
@pytest.mark.parametrize("size", [(960, 640), (480, 320)])
def test_arms_at_one_place_do_not_cover_each_other(arms, size) -> None:
    """An arm on the ceiling above one on the floor."""
    names = tuple(f"arm_{i}" for i in range(arms))
    cell = replace(grid_cell(names, ("bench", "rack")), mounts_m=((0.0, 0.0, 0.0),) * arms)
    plan = floor_plan(cell, size)
    rings = plan.centres
    gaps = np.linalg.norm(rings[:, None] - rings[None], axis=-1)[~np.eye(arms, dtype=bool)]
    assert gaps.min() >= 1.82 * plan.reach  # motors; the arcs of the work done may touch


@examples(40)
@given(cells(), sizes)
def test_names_of_stations_cover_no_arm_and_no_other_name(cell, size) -> None:
    plan = floor_plan(cell, size)
    boxes = [(*at, text_width(text, plan.text)) for text, at, _ in plan.labels]
    for i, (x, y, long) in enumerate(boxes):
        assert inside(x, y, plan.floor)
        assert inside(x + long, y, plan.floor)
        for u, v in plan.centres:
            nearest = min(max(u, x), x + long)
            assert np.hypot(nearest - u, y - v) >= plan.reach
        assert all(abs(y - v) >= plan.text or x + long < u or u + other < x for u, v, other in boxes[:i])
