"""The scene, picture, floor plan and window of a fleet."""

import logging
import pickle
import subprocess
import sys
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fleet.engine.shift import initial, step
from fleet.env.render.heat import heat_colour
from fleet.env.render.picture import (
    FLOOR,
    HEIGHT,
    LETTER,
    LINE,
    STATION,
    TEXT,
    WIDTH,
    FloorPlan,
    draw,
    floor_plan,
    shorten,
    time_left,
)  # fmt: skip
from fleet.env.render.renderer import Renderer
from fleet.env.render.scene import CellMap, MountKind, QueuedJob, Scene, grid_cell, mount_kind, scene_of
from fleet.errors import FleetError, visible
from fleet.job import Fixture
from fleet.robot import JOINTS, Mount, rotation
from fleet.telemetry import FAULTED, IDLE, WORKING
from tests.profiles import examples


@pytest.mark.parametrize(
    ("tilt_deg", "kind"),
    [
        ((0, 0, 180), "floor"),
        ((180, 0, 0), "ceiling"),
        ((90, 0, 0), "wall"),
        ((0, -90, 30), "wall"),
        ((0, 140, 0), "tilted"),
    ],
)
def test_mounts_are_named(tilt_deg, kind) -> None:
    assert mount_kind(Mount(tilt_deg=tilt_deg)) == kind


def test_a_scene_equals_the_state_of_its_world(small) -> None:
    work, heavy = small.work("bench"), small.work("rack", payload_kg=2.5)
    jobs = [
        small.job("now", work, repetitions=1),
        small.job("next", heavy, due_s=5.0),
        small.job("late", work, release_s=500.0),
    ]
    arms = [small.arm(0, [work]), small.arm(1, [work, heavy])]
    world, plant = small.shop([jobs], arms=arms)
    state = step(world, initial(world), np.array([[1, 0]]), plant).state
    observed = scene_of(world, state)
    assert (observed.time_s, observed.horizon_s) == (10.0, 600.0)
    assert (observed.finished, observed.waiting, observed.faults) == (0, 1, 0)
    assert (observed.mode, observed.job, observed.at) == ((WORKING, IDLE), ("now", ""), (("bench",), ()))
    assert observed.progress == (pytest.approx(10.0 / (3.0 + 10.0 + 2.0)), 0.0)
    assert observed.queue == (
        QueuedJob(job="next", payload_kg=2.5, due_in_s=-5.0, able=(False, True), free=(False, True)),
    )
    np.testing.assert_array_equal(observed.temp_c, state.temp_c[0, :, :JOINTS])
    state = step(world, step(world, state, np.zeros((1, 2), int), plant).state, np.zeros((1, 2), int), plant).state
    state.faults[0, 1] = 2
    later = scene_of(world, state)
    assert (later.finished, later.waiting, later.faults, later.job) == (1, 1, 2, ("", ""))
    with pytest.raises(ValueError, match=r"The cell has the arms arm_0; the world has arm_0, arm_1\."):
        scene_of(world, state, grid_cell(("arm_0",), ()))


FAULT = (0xCC, 0x22, 0x22)
"""Red of the report."""

BENCHES = (("bench", (0.5, 0.5, 0.2)), ("rack", (-0.5, 0.5, 0.2)))


def row(arms: int) -> CellMap:
    """Return a cell with arms one metre apart on the floor."""
    return CellMap(
        arms=tuple(f"arm_{i}" for i in range(arms)),
        mounts_m=tuple((float(i), 0.0, 0.0) for i in range(arms)),
        kinds=("floor",) * arms,
        stations=BENCHES,
    )


def scene(cell: CellMap, **changes: Any) -> Scene:
    """Return a scene of an idle fleet at 30 °C."""
    arms = len(cell.arms)
    quiet = Scene(
        cell=cell,
        time_s=600.0,
        horizon_s=3600.0,
        temp_c=np.full((arms, JOINTS), 30.0),
        warning_c=60.0,
        error_c=75.0,
        mode=(IDLE,) * arms,
        job=("",) * arms,
        progress=(0.0,) * arms,
        at=((),) * arms,
        queue=(),
        waiting=0,
        finished=0,
        faults=0,
    )
    return replace(quiet, **changes)


def luminance(colour: Any) -> np.ndarray:
    """Relative luminance of sRGB [..., 3], by WCAG 2.1."""
    srgb = np.asarray(colour)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return linear @ np.array([0.2126, 0.7152, 0.0722])


def around(frame: np.ndarray, plan: FloorPlan, arm: int) -> np.ndarray:
    x, y = plan.centres[arm].round().astype(int)
    return frame[y - plan.reach : y + plan.reach + 1, x - plan.reach : x + plan.reach + 1]


@given(st.floats(-20, 150), st.floats(-20, 150), st.floats(20, 79))
def test_hotter_colours_are_never_brighter_and_five_kelvin_are_a_visible_difference(one_c, other_c, temp_c) -> None:
    low, high = heat_colour(np.sort([one_c, other_c]), 60.0, 75.0)
    assert luminance(high) <= luminance(low) + 1e-9
    cool, hot = heat_colour(np.array([temp_c, temp_c + 5.0]), 60.0, 75.0)
    assert luminance(hot) < luminance(cool) - 0.009


@given(st.floats(-30, 100), st.floats(1, 50))
def test_limits_have_the_colours_of_the_report(warning_c, apart_k) -> None:
    at_limits = heat_colour(np.array([warning_c, warning_c + apart_k]), warning_c, warning_c + apart_k)
    np.testing.assert_allclose(255 * at_limits, [[0xE0, 0x8A, 0x00], FAULT])


def test_each_motor_has_the_colour_of_its_own_temperature() -> None:
    cell = row(2)
    temps = np.linspace(20.0, 85.0, 2 * JOINTS).reshape(2, JOINTS)
    frame, plan = draw(scene(cell, temp_c=temps)), floor_plan(cell)
    x, y = plan.motors.round().astype(int).transpose(2, 0, 1)
    np.testing.assert_allclose(frame[y, x], 255 * heat_colour(temps, 60.0, 75.0), atol=1.0)


@pytest.mark.parametrize("arms", [1, 64])
def test_a_faulted_arm_stands_out(arms) -> None:
    cell = grid_cell(tuple(f"arm_{i}" for i in range(arms)), ())
    plan = floor_plan(cell)
    for mode in (IDLE, WORKING, FAULTED):
        red = (around(draw(scene(cell, mode=(mode,) * arms)), plan, arms - 1) == FAULT).all(axis=-1).sum()
        assert (red >= 20) == (mode == FAULTED)
        assert red == 0 or mode == FAULTED


def test_a_line_connects_a_working_arm_to_its_station() -> None:
    cell = row(2)
    plan = floor_plan(cell)
    idle = draw(scene(cell))
    busy = draw(scene(cell, at=(("rack",), ())))
    (x, y), (u, v) = plan.centres[0], plan.stations[1]
    for part in (0.6, 0.8, 1.0):
        at = round(y + part * (v - y)), round(x + part * (u - x))
        assert (idle[at] != busy[at]).any()
    assert (around(idle, plan, 1) == around(busy, plan, 1)).all()


def test_the_arc_shows_the_progress_of_a_job() -> None:
    cell = row(1)
    blue = []
    for share in (0.0, 0.25, 0.5, 1.0):
        frame = draw(scene(cell, mode=(WORKING,), progress=(share,)))
        blue.append(int((around(frame, floor_plan(cell), 0) == (0x44, 0x77, 0xAA)).all(axis=-1).sum()))
    assert blue[0] == 0
    assert blue[1] == pytest.approx(blue[3] / 4, rel=0.15)
    assert blue[2] == pytest.approx(blue[3] / 2, rel=0.15)


def test_every_field_of_a_scene_changes_the_picture() -> None:
    cell, oven = row(2), Fixture(name="oven", position_m=(0.5, 0.25, 0.3), size_m=(0.3, 0.3, 0.6))
    offer = QueuedJob(job="sort-001", payload_kg=0.5, due_in_s=300.0, able=(True, True), free=(True, False))
    base = scene(cell, queue=(offer,), waiting=1, title="one")
    others = [
        replace(base, time_s=700.0),
        replace(base, finished=1),
        replace(base, faults=1),
        replace(base, waiting=2),
        replace(base, title="two"),
        replace(base, job=("hold-001", "")),
        replace(base, mode=(WORKING, IDLE)),
        replace(base, queue=(replace(offer, job="sort-002"),)),
        replace(base, queue=(replace(offer, payload_kg=1.0),)),
        replace(base, queue=(replace(offer, due_in_s=-300.0),)),
        replace(base, queue=(replace(offer, able=(True, False)),)),
        replace(base, queue=(replace(offer, free=(True, True)),)),
        replace(base, cell=replace(cell, fixtures=(oven,))),
        replace(base, cell=replace(cell, fixtures=(replace(oven, name="table"),))),
        replace(base, cell=replace(cell, fixtures=(replace(oven, tilt_deg=(0.0, 0.0, 20.0)),))),
    ]
    frames = [draw(each).tobytes() for each in (base, *others)]
    assert len(set(frames)) == len(frames)
    assert draw(base).tobytes() == frames[0]


@pytest.mark.parametrize(
    ("due_in_s", "words"), [(0.0, "0 min left"), (720.0, "12 min left"), (-180.0, "3 min late"), (9000.0, "2.5 h left")]
)
def test_slack_is_formatted(due_in_s, words) -> None:
    assert time_left(due_in_s) == words


def test_a_name_covers_no_motor_of_another_arm() -> None:
    cell = replace(row(6), mounts_m=((0.0, 0.0, 0.0),) * 6)
    plan, idle = floor_plan(cell), draw(scene(cell))
    busy = draw(scene(cell, job=("hold_at_the_fixture_in_the_middle-001",) * 6))
    assert (busy != idle).any()
    for a in range(6):
        for x, y in plan.motors[a].round().astype(int):
            near = (slice(y - plan.motor + 1, y + plan.motor), slice(x - plan.motor + 1, x + plan.motor))
            assert (busy[near] == idle[near]).all()


words = st.text(max_size=60)


@pytest.mark.ci_slow
@example("\U000e0000", "press", "crate", "")  # a name without any outline
@given(words, words, words, words)
def test_any_name_can_be_drawn(arm, station, job, title) -> None:
    cell = replace(row(1), arms=(arm,), stations=((station, (0.0, 1.0, 0.0)),))
    offer = QueuedJob(job=job, payload_kg=1.0, due_in_s=-1e6, able=(True,), free=(False,))
    frame = draw(scene(cell, job=(job,), at=((station,),), queue=(offer,), title=title))
    assert (frame.shape, frame.dtype) == ((HEIGHT, WIDTH, 3), np.uint8)


@given(words, st.integers(0, 200))
def test_long_names_are_shortened_in_the_middle(name, room_px) -> None:
    short = shorten(name, room_px)
    assert short.isprintable()
    assert LETTER * len(short) <= room_px
    if LETTER * len(visible(name)) <= room_px:
        assert short == visible(name)
    elif len(short) > 2:
        head, _, tail = short.partition("…")
        assert visible(name).startswith(head)
        assert visible(name).endswith(tail)


metres = st.floats(-50, 50)
points = st.tuples(metres, metres, metres)
kinds = st.sampled_from(get_args(MountKind))


@st.composite
def cells(draw: st.DrawFn) -> CellMap:
    arms, stations = draw(st.integers(1, 64)), draw(st.integers(0, 30))
    return CellMap(
        arms=tuple(f"arm_{i}" for i in range(arms)),
        mounts_m=tuple(draw(st.lists(points, min_size=arms, max_size=arms))),
        kinds=tuple(draw(st.lists(kinds, min_size=arms, max_size=arms))),
        stations=tuple((f"s{i}", p) for i, p in enumerate(draw(st.lists(points, max_size=stations)))),
    )


def inside(x: float, y: float, margin: float = 0.0) -> bool:
    left, top, right, bottom = FLOOR
    return left + margin <= x <= right - margin and top + margin <= y <= bottom - margin


@examples(40)
@given(cells())
def test_arms_stations_and_names_are_on_the_floor_and_names_cover_no_arm_and_no_other_name(cell) -> None:
    plan = floor_plan(cell)
    assert len(plan.centres) == len(cell.arms)
    for a, (x, y) in enumerate(plan.centres.tolist()):
        assert inside(x, y, plan.reach)
        assert y + plan.reach + LINE <= FLOOR[3]
        assert len(np.unique(plan.motors[a], axis=0)) == JOINTS
        assert all(inside(u, v, plan.motor) for u, v in plan.motors[a])
    assert all(inside(x, y, STATION) for x, y in (*plan.stations, *plan.bases))
    boxes = [(x, y, LETTER * len(text)) for text, x, y in plan.labels]
    for i, (x, y, long) in enumerate(boxes):
        assert inside(x, y)
        assert inside(x + long, y)
        for u, v in plan.centres:
            nearest = min(max(u, x), x + long)
            assert np.hypot(nearest - u, y - v) >= plan.reach
        assert all(abs(y - v) >= TEXT or x + long < u or u + other < x for u, v, other in boxes[:i])


@given(
    st.tuples(*[st.floats(-5, 5)] * 3), st.tuples(*[st.floats(0.001, 10)] * 3), st.tuples(*[st.floats(-180, 180)] * 3)
)
def test_a_fixture_is_drawn_around_its_centre_and_as_large_as_its_shadow(position_m, size_m, tilt_deg) -> None:
    """By Cauchy, the shadow of a box is the sum of its faces' areas times the cosines of their tilts."""
    box = Fixture(name="box", position_m=position_m, size_m=size_m, tilt_deg=tilt_deg)
    cell = CellMap(
        arms=("a",), mounts_m=((0.0, 0.0, 0.0),), kinds=("floor",), stations=(("s", (2.0, 1.0, 0.0)),), fixtures=(box,)
    )
    plan = floor_plan(cell)
    ((outline,),) = plan.fixtures
    px_per_m = (plan.stations[0, 0] - plan.bases[0, 0]) / 2.0
    centre = (outline.min(axis=0) + outline.max(axis=0)) / 2
    np.testing.assert_allclose((centre - plan.bases[0]) / px_per_m, [position_m[0], -position_m[1]], atol=0.05)
    x, y = outline.T
    area = abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2
    faces = np.array([size_m[1] * size_m[2], size_m[0] * size_m[2], size_m[0] * size_m[1]])
    assert area / px_per_m**2 == pytest.approx(faces @ np.abs(rotation(tilt_deg)[2]), rel=0.02, abs=1e-6)


def test_a_fixture_beyond_the_floor_covers_nothing_beside_it() -> None:
    cell, wide = row(2), Fixture(name="hall", position_m=(0.5, 0.25, 0.3), size_m=(9.0, 9.0, 0.6))
    with_hall, without = (draw(scene(each)).copy() for each in (replace(cell, fixtures=(wide,)), cell))
    left, top, right, bottom = map(int, FLOOR)
    assert not np.array_equal(with_hall, without)
    for frame in (with_hall, without):
        frame[top - 1 : bottom + 1, left : right + 1] = 0
    np.testing.assert_array_equal(with_hall, without)


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
        np.testing.assert_allclose(apart_px, per_m * apart_m, atol=1e-6)


@pytest.mark.parametrize("arms", [2, 3, 16])
def test_arms_at_one_place_do_not_cover_each_other(arms) -> None:
    """An arm on the ceiling above one on the floor."""
    names = tuple(f"arm_{i}" for i in range(arms))
    cell = replace(grid_cell(names, ("bench", "rack")), mounts_m=((0.0, 0.0, 0.0),) * arms)
    plan = floor_plan(cell)
    rings = plan.centres
    gaps = np.linalg.norm(rings[:, None] - rings[None], axis=-1)[~np.eye(arms, dtype=bool)]
    assert gaps.min() >= 1.82 * plan.reach  # motors; the arcs of the work done may touch


BLACK = np.zeros((240, 320, 3), np.uint8)


def test_without_a_display_it_warns_once_and_continues(monkeypatch, caplog) -> None:
    monkeypatch.setattr("matplotlib.get_backend", lambda: "agg")
    window = Renderer()
    with caplog.at_level(logging.WARNING):
        assert [window.show(BLACK) for _ in range(3)] == [False] * 3
        assert window.show(BLACK + 255) is False
    assert len(caplog.messages) == 1
    assert "render_mode='rgb_array'" in caplog.messages[0]
    assert "thermofleet view" in caplog.messages[0]
    window.close()
    pickle.loads(pickle.dumps(window))


def test_a_window_follows_the_frames_until_it_is_closed(monkeypatch) -> None:
    """Use matplotlib's canvas in place of a window."""
    import matplotlib.pyplot as plt
    from matplotlib.backend_bases import FigureManagerBase

    monkeypatch.setattr("matplotlib.get_backend", lambda: "TkAgg")
    monkeypatch.setattr(FigureManagerBase, "show", lambda self: None)
    plt.switch_backend("agg")
    window = Renderer()
    assert window.show(BLACK)
    assert window.show(BLACK + 255)
    (figure,) = map(plt.figure, plt.get_fignums())
    assert (figure.axes[0].images[0].get_array() == 255).all()
    assert figure.get_size_inches().tolist() == [3.2, 2.4]
    copied = pickle.loads(pickle.dumps(window))
    plt.close(figure)  # as a user does
    assert not window.show(BLACK)
    assert plt.get_fignums() == []
    window.close()
    assert window.show(BLACK)
    window.close()
    copied.close()
    assert plt.get_fignums() == []


def test_matplotlib_is_loaded_for_frames_alone() -> None:
    code = (
        "import sys; import fleet.env.allocation_v2, fleet.env.render.renderer; "
        "print([m for m in ('matplotlib', 'PIL', 'torch', 'mujoco', 'zenoh', 'tkinter') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout.strip() == "[]"


def test_without_matplotlib_the_error_names_the_extra(monkeypatch, small) -> None:
    world, _ = small.shop([[small.job("a", small.work("bench"))]])
    monkeypatch.setitem(sys.modules, "fleet.env.render.picture", None)
    with pytest.raises(FleetError, match=r"pip install -e '\.\[report\]'"):
        Renderer().frame(world, initial(world))
