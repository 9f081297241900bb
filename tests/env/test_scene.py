"""Scenes: mounts, jobs and temperatures of a world."""

import numpy as np
import pytest

from fleet.engine.shift import step
from fleet.engine.state import initial
from fleet.env.render.floor_plan import QueuedJob, grid_cell, mount_kind, scene_of
from fleet.robot import JOINTS, Mount
from fleet.telemetry import IDLE, WORKING


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
def test_mounts_are_named(tilt_deg, kind) -> None:
    assert mount_kind(Mount(tilt_deg=tilt_deg)) == kind


def test_a_scene_equals_the_state_of_its_world(small) -> None:
    work, heavy = small.work("bench"), small.work("rack", payload_kg=2.5)
    jobs = [small.job("now", work), small.job("next", heavy, due_s=5.0), small.job("late", work, release_s=500.0)]
    arms = [small.arm(0, [work]), small.arm(1, [work, heavy])]
    world, plant = small.shop([jobs], arms=arms)
    state = step(world, initial(world), np.array([[1, 0]]), plant).state
    observed = scene_of(world, state, title="two arms")
    assert (observed.time_s, observed.horizon_s, observed.finished, observed.waiting, observed.faults) == (
        10.0,
        600.0,
        0,
        1,
        0,
    )
    assert (observed.mode, observed.job, observed.at) == ((WORKING, IDLE), ("now", ""), (("bench",), ()))
    assert observed.progress == (pytest.approx(10.0 / (3.0 + 3 * 10.0 + 2.0)), 0.0)
    assert observed.queue == (
        QueuedJob(job="next", payload_kg=2.5, due_in_s=-5.0, able=(False, True), free=(False, True)),
    )
    np.testing.assert_array_equal(observed.temp_c, state.temp_c[0, :, :JOINTS])
    with pytest.raises(ValueError, match=r"The cell has the arms arm_0; the world has arm_0, arm_1\."):
        scene_of(world, state, grid_cell(("arm_0",), ()))


def test_a_finished_job_and_a_fault_are_counted(small) -> None:
    world, plant = small.shop([[small.job("a", small.work("bench"), repetitions=1)]])
    state = initial(world)
    for action in (1, 0):
        state = step(world, state, np.array([[action, 0]]), plant).state
    state.faults[0, 1] = 2
    observed = scene_of(world, state)
    assert (observed.finished, observed.waiting, observed.faults, observed.job) == (1, 0, 2, ("", ""))
