"""The picture of a fleet: colours, visibility, the array."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fleet.env.render.floor_plan import (
    LARGEST,
    NORMAL,
    Cell,
    FloorPlan,
    Pixel,
    QueuedJob,
    Scene,
    floor_plan,
    grid_cell,
    shortened,
    text_width,
)
from fleet.env.render.picture import Picture, heat_colour, legend_ends, legend_row, time_left
from fleet.job import Fixture
from fleet.robot import JOINTS
from fleet.telemetry import FAULTED, IDLE, WORKING

FAULT = (0xCC, 0x22, 0x22)
"""Red of the report."""
BENCHES = (("bench", (0.5, 0.5, 0.2)), ("rack", (-0.5, 0.5, 0.2)))


def picture(scene: Scene, size: Pixel = NORMAL) -> np.ndarray:
    return Picture(size).frame(scene)


def row(arms: int) -> Cell:
    """Return a cell with arms one metre apart on the floor."""
    return Cell(
        arms=tuple(f"arm_{i}" for i in range(arms)),
        mounts_m=tuple((float(i), 0.0, 0.0) for i in range(arms)),
        kinds=("floor",) * arms,
        stations=BENCHES,
    )


def scene(cell: Cell, temp_c: float = 30.0, mode: int = IDLE, **changes: Any) -> Scene:
    """Return a scene of an idle fleet at one temperature."""
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


def on_motor(frame: np.ndarray, plan: FloorPlan, arm: int, joint: int) -> tuple[int, ...]:
    """Return the colour of a motor, above its number."""
    x, y = plan.motors[arm, joint].round().astype(int)
    return tuple(frame[y - plan.motor + 3, x].tolist())


def around(frame: np.ndarray, plan: FloorPlan, arm: int) -> np.ndarray:
    """Return the part of a picture around an arm."""
    x, y = plan.centres[arm]
    return frame[y - plan.reach : y + plan.reach + 1, x - plan.reach : x + plan.reach + 1]


# Colours


@given(st.floats(-20, 150), st.floats(-20, 150))
def test_hotter_colours_are_never_brighter(one_c, other_c) -> None:
    low, high = heat_colour(np.sort([one_c, other_c]), 60.0, 75.0)
    assert luminance(high) <= luminance(low) + 1e-9


@given(st.floats(20, 79))
def test_five_kelvin_are_a_visible_difference(temp_c) -> None:
    cool, hot = heat_colour(np.array([temp_c, temp_c + 5.0]), 60.0, 75.0)
    assert luminance(hot) < luminance(cool) - 0.009


@given(st.floats(-30, 100), st.floats(1, 50))
def test_limits_have_the_colours_of_the_report(warning_c, apart_k) -> None:
    at_limits = heat_colour(np.array([warning_c, warning_c + apart_k]), warning_c, warning_c + apart_k)
    np.testing.assert_allclose(255 * at_limits, [[0xE0, 0x8A, 0x00], FAULT])


@pytest.mark.parametrize("temp_c", [20.0, 40.0, 60.0, 67.0, 75.0, 85.0])
@pytest.mark.parametrize("size", [(960, 640), (480, 320)])
def test_motors_have_the_colour_of_the_legend(temp_c, size) -> None:
    cell = row(3)
    temps = np.full((3, JOINTS), 30.0)
    temps[1, 4] = temp_c
    frame, plan = picture(scene(cell, temp_c=30.0), size), floor_plan(cell, size)
    hot = picture(replace(scene(cell), temp_c=temps), size)
    begin, end = legend_ends(plan)
    legend = hot[legend_row(plan), round(np.interp(temp_c, [20.0, 85.0], [begin, end]))]
    np.testing.assert_allclose(on_motor(hot, plan, 1, 4), legend, atol=4)  # half a pixel is 0.2 K
    assert on_motor(hot, plan, 1, 3) == on_motor(frame, plan, 1, 3)


def test_each_motor_shows_its_own_temperature() -> None:
    cell = row(2)
    temps = np.linspace(21.0, 84.0, 2 * JOINTS).reshape(2, JOINTS)
    frame, plan = picture(replace(scene(cell), temp_c=temps)), floor_plan(cell)
    shown = [luminance(np.array(on_motor(frame, plan, a, j)) / 255) for a in range(2) for j in range(JOINTS)]
    assert shown == sorted(shown, reverse=True)
    assert len(set(shown)) == 2 * JOINTS


# Visibility


@pytest.mark.parametrize("size", [(960, 640), (480, 320)])
@pytest.mark.parametrize("arms", [1, 4, 16, 64])
def test_a_faulted_arm_stands_out(arms, size) -> None:
    cell = grid_cell(tuple(f"arm_{i}" for i in range(arms)), ())
    well = picture(scene(cell), size)
    for last in (WORKING, FAULTED):
        plan, lost = floor_plan(cell, size), picture(scene(cell, mode=last), size)
        red = [(around(frame, plan, arms - 1) == FAULT).all(axis=-1).sum() for frame in (well, lost)]
        assert red[0] == 0
        assert (red[1] >= 20) == (last == FAULTED)


def test_a_line_connects_a_working_arm_to_its_station() -> None:
    cell = row(2)
    plan = floor_plan(cell)
    idle = picture(scene(cell))
    busy = picture(scene(cell, at=(("rack",), ()), mode=IDLE))
    (x, y), (u, v) = plan.centres[0], plan.stations[1]
    for part in (0.6, 0.8, 1.0):
        at = round(y + part * (v - y)), round(x + part * (u - x))
        assert (idle[at] != busy[at]).any()
    assert (around(idle, plan, 1) == around(busy, plan, 1)).all()


def test_the_arc_shows_the_progress_of_a_job() -> None:
    cell = row(1)
    blue = []
    for share in (0.0, 0.25, 0.5, 1.0):
        frame = picture(scene(cell, mode=WORKING, progress=(share,)))
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
    frames = [picture(each, (480, 320)).tobytes() for each in (base, *others)]
    assert len(set(frames)) == len(frames)


@pytest.mark.parametrize(
    ("due_in_s", "words"), [(0.0, "0 min left"), (720.0, "12 min left"), (-180.0, "3 min late"), (9000.0, "2.5 h left")]
)
def test_slack_is_formatted(due_in_s, words) -> None:
    assert time_left(due_in_s) == words


@pytest.mark.parametrize("size", [(960, 640), (480, 320)])
@pytest.mark.parametrize("arms", [2, 4, 6])
def test_labels_of_arms_do_not_cover_other_arms(arms, size) -> None:
    cell = replace(row(arms), mounts_m=((0.0, 0.0, 0.0),) * arms)
    plan = floor_plan(cell, size)
    idle = picture(scene(cell), size)
    for a in range(arms):
        job = ["" for _ in range(arms)]
        job[a] = "hold_at_the_fixture_in_the_middle-001"
        busy = picture(scene(cell, job=tuple(job)), size)
        assert (busy != idle).any()
        for other in range(arms):
            for x, y in plan.motors[other].round().astype(int) if other != a else ():
                near = (slice(y - plan.motor, y + plan.motor + 1), slice(x - plan.motor, x + plan.motor + 1))
                assert (busy[near] == idle[near]).all()


@pytest.mark.parametrize("size", [(319, 240), (320, 239), (LARGEST[0] + 1, 640), (-5, 640), (0, 0)])
def test_too_small_pictures_are_refused(size) -> None:
    with pytest.raises(ValueError, match=rf"from 320x240 to 3840x2160 px \(got {size[0]}x{size[1]}\)"):
        picture(scene(row(2)), size)


# The array


@pytest.mark.parametrize("size", [(320, 240), (480, 320), (961, 641)])
@pytest.mark.parametrize("arms", [1, 2, 64])
def test_pictures_have_the_requested_size_and_repeat(arms, size) -> None:
    busy = scene(row(arms), temp_c=61.0, mode=WORKING)
    frame = picture(busy, size)
    assert frame.shape == (size[1], size[0], 3)
    assert frame.dtype == np.uint8
    before = frame.copy()
    frame[:] = 0  # cached parts must not change
    assert (picture(busy, size) == before).all()


words = st.text(max_size=60)


@example("\U000e0000", "press", "crate", "")  # a name without any outline
@given(words, words, words, words)
def test_any_name_can_be_drawn(arm, station, job, title) -> None:
    cell = replace(row(1), arms=(arm,), stations=((station, (0.0, 1.0, 0.0)),))
    offer = QueuedJob(job=job, payload_kg=1.0, due_in_s=-1e6, able=(True,), free=(False,))
    frame = picture(scene(cell, job=(job,), at=((station,),), queue=(offer,), title=title), (320, 240))
    assert frame.shape == (240, 320, 3)


@given(words, st.integers(0, 200))
def test_long_names_are_shortened_in_the_middle(name, room_px) -> None:
    short = shortened(name, 12, room_px)
    assert short.isprintable()
    assert text_width(short, 12) <= room_px or not short
    known = name.isprintable() and "□" not in shortened(name, 12, 1e6)  # the font has every letter
    if known and text_width(name, 12) <= room_px:
        assert short == name
    elif known and len(short) > 2:
        head, _, tail = short.partition("…")
        assert name.startswith(head)
        assert name.endswith(tail)


def test_inconsistent_scenes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"Scene\.mode needs one entry per arm, 2 \(got 1\)"):
        replace(scene(row(2)), mode=(IDLE,))
    with pytest.raises(ValueError, match="warning_c < error_c"):
        scene(row(2), warning_c=80.0)
    with pytest.raises(ValueError, match="a mount and a kind per arm"):
        replace(row(2), kinds=("floor",))
    with pytest.raises(ValueError, match="at least one arm"):
        row(0)
    with pytest.raises(ValueError, match="must be finite"):
        replace(row(1), mounts_m=((0.0, np.nan, 0.0),))
