"""The picture of a fleet: its colours, its places, and what it must never hide."""

import logging
import pickle
import subprocess
import sys
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.env.floor_plan import LARGEST, SMALLEST, FloorPlan, floor_plan
from fleet.env.heat_colours import heat_colour
from fleet.env.lettering import fitted, width
from fleet.env.picture import draw, legend_x, legend_y, picture
from fleet.env.queue_column import due
from fleet.env.scene import Cell, MountKind, Offer, Scene, mount_kind, plain_cell, scene_of
from fleet.env.window import Window
from fleet.robot import JOINTS, Mount
from fleet.sim.kernel import step
from fleet.sim.state import initial
from fleet.telemetry import FAULTED, IDLE, WORKING

FAULT = (0xCC, 0x22, 0x22)
"""The report's red."""
BENCHES = (("bench", (0.5, 0.5, 0.2)), ("rack", (-0.5, 0.5, 0.2)))


def row(arms: int) -> Cell:
    """Arms a metre apart on the floor."""
    return Cell(
        arms=tuple(f"arm_{i}" for i in range(arms)),
        mounts_m=tuple((float(i), 0.0, 0.0) for i in range(arms)),
        kinds=("floor",) * arms,
        stations=BENCHES,
    )


def scene(cell: Cell, temp_c: float = 30.0, mode: int = IDLE, **changes: Any) -> Scene:
    """Nothing happens, everything has one temperature."""
    arms = len(cell.arms)
    quiet = Scene(
        cell=cell,
        time_s=600.0,
        horizon_s=3600.0,
        temp_c=np.full((arms, JOINTS), temp_c),
        warning_c=60.0,
        error_c=75.0,
        mode=(mode,) * arms,
        job=("",) * arms,
        share=(0.0,) * arms,
        at=((),) * arms,
        offers=(),
        waiting=0,
        finished=0,
        faults=0,
    )
    return replace(quiet, **changes)


def luminance(colour: Any) -> np.ndarray:
    """Relative luminance of sRGB [..., 3], by WCAG 2.1: how bright it looks, whatever the hue."""
    srgb = np.asarray(colour) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return linear @ np.array([0.2126, 0.7152, 0.0722])


def on_motor(frame: np.ndarray, plan: FloorPlan, arm: int, joint: int) -> tuple[int, ...]:
    """The colour of a motor, above its number."""
    x, y = plan.motors(arm)[joint]
    return tuple(frame[y - plan.motor + 3, x].tolist())


def around(frame: np.ndarray, plan: FloorPlan, arm: int) -> np.ndarray:
    """What is drawn of an arm."""
    x, y = plan.rings[arm]
    return frame[y - plan.reach : y + plan.reach + 1, x - plan.reach : x + plan.reach + 1]


# Colours


@given(st.floats(-20, 150), st.floats(-20, 150))
def test_hotter_is_never_brighter(one_c, other_c) -> None:
    low, high = heat_colour(np.sort([one_c, other_c]), 60.0, 75.0)
    assert luminance(high) <= luminance(low) + 2e-3  # eight bits a channel


@given(st.floats(20, 79))
def test_five_kelvin_more_are_darker_to_see(temp_c) -> None:
    cool, hot = heat_colour(np.array([temp_c, temp_c + 5.0]), 60.0, 75.0)
    assert luminance(hot) < luminance(cool) - 0.009


@given(st.floats(-30, 100), st.floats(1, 50))
def test_the_limits_have_the_report_s_colours_whatever_they_are(warning_c, apart_k) -> None:
    at_limits = heat_colour(np.array([warning_c, warning_c + apart_k]), warning_c, warning_c + apart_k)
    assert at_limits.tolist() == [[0xE0, 0x8A, 0x00], list(FAULT)]


@pytest.mark.parametrize("temp_c", [20.0, 40.0, 60.0, 67.0, 75.0, 85.0])
@pytest.mark.parametrize("size", [(960, 640), (480, 320)])
def test_a_motor_has_the_legend_s_colour_at_its_temperature(temp_c, size) -> None:
    cell = row(3)
    temps = np.full((3, JOINTS), 30.0)
    temps[1, 4] = temp_c
    frame, plan = picture(scene(cell, temp_c=30.0), size), floor_plan(cell, size)
    hot = picture(replace(scene(cell), temp_c=temps), size)
    legend = hot[legend_y(plan), legend_x(plan, temp_c, 60.0, 75.0)]
    np.testing.assert_allclose(on_motor(hot, plan, 1, 4), legend, atol=4)  # half a pixel is 0.2 K
    assert on_motor(hot, plan, 1, 3) == on_motor(frame, plan, 1, 3)


def test_each_motor_shows_its_own_temperature() -> None:
    cell = row(2)
    temps = np.linspace(21.0, 84.0, 2 * JOINTS).reshape(2, JOINTS)
    frame, plan = picture(replace(scene(cell), temp_c=temps)), floor_plan(cell)
    shown = [luminance(on_motor(frame, plan, a, j)) for a in range(2) for j in range(JOINTS)]
    assert shown == sorted(shown, reverse=True)
    assert len(set(shown)) == 2 * JOINTS


# What must be seen


@pytest.mark.parametrize("size", [(960, 640), (480, 320)])
@pytest.mark.parametrize("arms", [1, 4, 16, 64])
def test_a_faulted_arm_stands_out(arms, size) -> None:
    cell = plain_cell(tuple(f"arm_{i}" for i in range(arms)), ())
    well = picture(scene(cell), size)
    for last in (WORKING, FAULTED):
        plan, lost = floor_plan(cell, size), picture(scene(cell, mode=last), size)
        red = [(around(frame, plan, arms - 1) == FAULT).all(axis=-1).sum() for frame in (well, lost)]
        assert red[0] == 0
        assert (red[1] >= 20) == (last == FAULTED)


def test_an_arm_at_work_is_joined_to_its_station() -> None:
    cell = row(2)
    plan = floor_plan(cell)
    idle = picture(scene(cell))
    busy = picture(scene(cell, at=(("rack",), ()), mode=IDLE))
    (x, y), (u, v) = plan.rings[0], plan.stations[1]
    for part in (0.6, 0.8, 1.0):
        at = round(y + part * (v - y)), round(x + part * (u - x))
        assert (idle[at] != busy[at]).any()
    assert (around(idle, plan, 1) == around(busy, plan, 1)).all()


def test_work_done_closes_the_arc() -> None:
    cell = row(1)
    blue = []
    for share in (0.0, 0.25, 0.5, 1.0):
        frame = picture(scene(cell, mode=WORKING, share=(share,)))
        blue.append(int((around(frame, floor_plan(cell), 0) == (0x44, 0x77, 0xAA)).all(axis=-1).sum()))
    assert blue[0] == 0
    assert blue[1] == pytest.approx(blue[3] / 4, rel=0.15)
    assert blue[2] == pytest.approx(blue[3] / 2, rel=0.15)


def test_every_word_of_a_scene_changes_the_picture() -> None:
    cell = row(2)
    offer = Offer(job="sort-001", payload_kg=0.5, due_in_s=300.0, able=(True, True), free=(True, False))
    base = scene(cell, offers=(offer,), waiting=1, title="one")
    others = [
        replace(base, time_s=700.0),
        replace(base, finished=1),
        replace(base, faults=1),
        replace(base, waiting=2),
        replace(base, title="two"),
        replace(base, job=("hold-001", "")),
        replace(base, mode=(WORKING, IDLE)),
        replace(base, offers=(replace(offer, job="sort-002"),)),
        replace(base, offers=(replace(offer, payload_kg=1.0),)),
        replace(base, offers=(replace(offer, due_in_s=-300.0),)),
        replace(base, offers=(replace(offer, able=(True, False)),)),
        replace(base, offers=(replace(offer, free=(True, True)),)),
    ]
    frames = [picture(each, (480, 320)).tobytes() for each in (base, *others)]
    assert len(set(frames)) == len(frames)


@pytest.mark.parametrize(
    ("due_in_s", "words"), [(0.0, "0 min left"), (720.0, "12 min left"), (-180.0, "3 min late"), (9000.0, "2.5 h left")]
)
def test_slack_in_words(due_in_s, words) -> None:
    assert due(due_in_s) == words


# Places

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


@settings(max_examples=40)
@given(cells(), sizes)
def test_every_arm_and_station_is_on_the_floor(cell, size) -> None:
    plan = floor_plan(cell, size)
    floor = plan.floor
    assert inside(floor[0], floor[1], (0, 0, *size))
    assert inside(floor[2], floor[3], (0, 0, *size))
    assert len(plan.rings) == len(cell.arms)
    for a, (x, y) in enumerate(plan.rings):
        assert inside(x, y, floor, plan.reach)
        assert y + plan.reach + plan.rows * plan.text <= floor[3]
        assert len(set(plan.motors(a))) == JOINTS
        assert all(inside(u, v, floor, plan.motor) for u, v in plan.motors(a))
    assert all(inside(x, y, floor, plan.station) for x, y in (*plan.stations, *plan.bases))


@given(st.lists(points, min_size=1, max_size=6))
def test_it_is_a_map(stations) -> None:
    """One scale for both directions, x to the right and y up."""
    cell = replace(row(1), stations=tuple((f"s{i}", p) for i, p in enumerate(stations)))
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
    """Floor and ceiling above each other, seen from above."""
    cell = replace(row(arms), mounts_m=((0.0, 0.0, 0.0),) * arms)
    plan = floor_plan(cell, size)
    rings = np.array(plan.rings)
    gaps = np.linalg.norm(rings[:, None] - rings[None], axis=-1)[~np.eye(arms, dtype=bool)]
    assert gaps.min() >= 2 * (plan.ring + plan.motor)


@pytest.mark.parametrize("size", [(960, 640), (480, 320)])
@pytest.mark.parametrize("arms", [2, 4, 6])
def test_what_an_arm_does_is_not_written_over_another_arm(arms, size) -> None:
    cell = replace(row(arms), mounts_m=((0.0, 0.0, 0.0),) * arms)
    plan = floor_plan(cell, size)
    idle = picture(scene(cell), size)
    for a in range(arms):
        job = ["" for _ in range(arms)]
        job[a] = "hold_at_the_fixture_in_the_middle-001"
        busy = picture(scene(cell, job=tuple(job)), size)
        assert (busy != idle).any()
        for other in range(arms):
            for x, y in plan.motors(other) if other != a else ():
                near = (slice(y - plan.motor, y + plan.motor + 1), slice(x - plan.motor, x + plan.motor + 1))
                assert (busy[near] == idle[near]).all()


@settings(max_examples=40)
@given(cells(), sizes)
def test_names_of_stations_cover_no_arm_and_no_other_name(cell, size) -> None:
    plan = floor_plan(cell, size)
    boxes = [(*label.at, width(label.text, plan.text)) for label in plan.labels]
    for i, (x, y, long) in enumerate(boxes):
        assert inside(x, y, plan.floor)
        assert inside(x + long, y, plan.floor)
        for u, v in plan.rings:
            nearest = min(max(u, x), x + long)
            assert np.hypot(nearest - u, y - v) >= plan.reach
        assert all(abs(y - v) >= plan.text or x + long < u or u + other < x for u, v, other in boxes[:i])


@pytest.mark.parametrize("size", [(319, 240), (320, 239), (LARGEST[0] + 1, 640), (-5, 640), (0, 0)])
def test_a_size_nobody_can_read_is_refused(size) -> None:
    with pytest.raises(ValueError, match=rf"from 320x240 to 3840x2160 px \(got {size[0]}x{size[1]}\)"):
        picture(scene(row(2)), size)


# The array


@pytest.mark.parametrize("size", [(320, 240), (480, 320), (961, 641)])
@pytest.mark.parametrize("arms", [1, 2, 64])
def test_it_is_an_image_of_the_size_asked_for_and_repeats(arms, size) -> None:
    busy = scene(row(arms), temp_c=61.0, mode=WORKING)
    frame = picture(busy, size)
    assert frame.shape == (size[1], size[0], 3)
    assert frame.dtype == np.uint8
    before = frame.copy()
    frame[:] = 0  # what is kept between frames is nobody's to change
    assert (picture(busy, size) == before).all()


words = st.text(max_size=60)


@given(words, words, words, words)
def test_any_name_can_be_drawn(arm, station, job, title) -> None:
    cell = replace(row(1), arms=(arm,), stations=((station, (0.0, 1.0, 0.0)),))
    offer = Offer(job=job, payload_kg=1.0, due_in_s=-1e6, able=(True,), free=(False,))
    frame = picture(scene(cell, job=(job,), at=((station,),), offers=(offer,), title=title), (320, 240))
    assert frame.shape == (240, 320, 3)


@given(words, st.integers(0, 200))
def test_a_name_is_cut_to_its_room_and_keeps_both_ends(name, room_px) -> None:
    short = fitted(name, 12, room_px)
    assert short.isprintable()
    assert width(short, 12) <= room_px or not short
    if name.isprintable() and width(name, 12) <= room_px:
        assert short == name
    elif name.isprintable() and len(short) > 2:
        head, _, tail = short.partition("…")
        assert name.startswith(head)
        assert name.endswith(tail)


def test_what_does_not_belong_together_is_refused() -> None:
    with pytest.raises(ValueError, match=r"Scene\.mode must be of the cell's 2 arms \(got 1\)"):
        replace(scene(row(2)), mode=(IDLE,))
    with pytest.raises(ValueError, match="warning_c < error_c"):
        scene(row(2), warning_c=80.0)
    with pytest.raises(ValueError, match="a mount and a kind per arm"):
        replace(row(2), kinds=("floor",))
    with pytest.raises(ValueError, match="at least one arm"):
        row(0)
    with pytest.raises(ValueError, match="must be finite"):
        replace(row(1), mounts_m=((0.0, np.nan, 0.0),))


# From the simulator


@pytest.mark.parametrize(
    ("tilt_deg", "kind"),
    [
        ((0, 0, 0), "floor"),
        ((0, 0, 180), "floor"),
        ((180, 0, 0), "ceiling"),
        ((0, 90, 0), "wall"),
        ((90, 0, 0), "wall"),
        ((0, -90, 30), "wall"),
        ((45, 0, 0), "tilted"),
        ((0, 140, 0), "tilted"),
    ],
)
def test_what_an_arm_is_fixed_to(tilt_deg, kind) -> None:
    assert mount_kind(Mount(tilt_deg=tilt_deg)) == kind


def test_a_scene_tells_the_truth_about_a_world(small) -> None:
    work, heavy = small.work("bench"), small.work("rack", payload_kg=2.5)
    jobs = [small.job("now", work), small.job("next", heavy, due_s=5.0), small.job("late", work, release_s=500.0)]
    arms = [small.arm(0, [work]), small.arm(1, [work, heavy])]
    world, plant = small.shop([jobs], arms=arms)
    state = step(world, initial(world), np.array([[1, 0]]), np.zeros((1, 2, 4)), plant).state
    seen = scene_of(world, state, title="two arms")
    assert (seen.time_s, seen.horizon_s, seen.finished, seen.waiting, seen.faults) == (10.0, 600.0, 0, 1, 0)
    assert (seen.mode, seen.job, seen.at) == ((WORKING, IDLE), ("now", ""), (("bench",), ()))
    assert seen.share == (pytest.approx(10.0 / (3.0 + 3 * 10.0 + 2.0)), 0.0)
    assert seen.offers == (Offer(job="next", payload_kg=2.5, due_in_s=-5.0, able=(False, True), free=(False, True)),)
    np.testing.assert_array_equal(seen.temp_c, state.temp_c[0, :, :JOINTS])
    assert (draw(world, state, title="two arms") == picture(seen)).all()
    with pytest.raises(ValueError, match=r"The cell is of the arms arm_0; the world's are arm_0, arm_1\."):
        scene_of(world, state, row(1))


def test_a_finished_job_and_a_fault_are_counted(small) -> None:
    world, plant = small.shop([[small.job("a", small.work("bench"), repetitions=1)]])
    state = initial(world)
    for action in (1, 0):
        state = step(world, state, np.array([[action, 0]]), np.zeros((1, 2, 4)), plant).state
    state.faults[0, 1] = 2
    seen = scene_of(world, state)
    assert (seen.finished, seen.waiting, seen.faults, seen.job) == (1, 0, 2, ("", ""))


# The window


def test_without_a_display_it_says_so_once_and_goes_on(monkeypatch, caplog) -> None:
    monkeypatch.setattr("matplotlib.get_backend", lambda: "agg")
    window = Window()
    with caplog.at_level(logging.WARNING):
        assert [window.show(picture(scene(row(1)), (320, 240))) for _ in range(3)] == [False] * 3
        assert window.show(np.zeros((240, 320, 3), np.uint8)) is False
    assert len(caplog.messages) == 1
    assert "render_mode='rgb_array'" in caplog.messages[0]
    assert "thermofleet animate" in caplog.messages[0]
    window.close()
    pickle.loads(pickle.dumps(window))


def test_a_window_follows_the_frames_until_it_is_closed(monkeypatch) -> None:
    """As if matplotlib's own canvas were a window."""
    import matplotlib.pyplot as plt
    from matplotlib.backend_bases import FigureManagerBase

    monkeypatch.setattr("matplotlib.get_backend", lambda: "TkAgg")
    monkeypatch.setattr(FigureManagerBase, "show", lambda self: None)
    plt.switch_backend("agg")
    window, black = Window("test"), np.zeros((240, 320, 3), np.uint8)
    assert window.show(black)
    assert window.show(black + 255)
    (figure,) = map(plt.figure, plt.get_fignums())
    assert (figure.axes[0].images[0].get_array() == 255).all()
    assert figure.get_size_inches().tolist() == [3.2, 2.4]
    copied = pickle.loads(pickle.dumps(window))
    plt.close(figure)  # as a person would
    assert not window.show(black)
    assert plt.get_fignums() == []
    window.close()
    assert window.show(black)
    window.close()
    copied.close()
    assert plt.get_fignums() == []


def test_matplotlib_is_loaded_for_a_window_alone() -> None:
    code = (
        "import sys, numpy as np; import fleet.env.window, fleet.env.picture as p; "
        "from fleet.env.lettering import width; width('a', 12); "
        "print([m for m in ('matplotlib', 'torch', 'mujoco', 'zenoh', 'tkinter') if m in sys.modules])"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert said.stdout.strip() == "[]"
