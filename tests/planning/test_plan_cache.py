"""Cached plans: equal to computed ones, one file per question, damaged files replaced."""

import logging
import os
import threading
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.arm.model import ArmModel
from fleet.arm.plan_cache import CachedPlanner, LoadedPlans
from fleet.arm.planner import Planner
from fleet.arm.trajectory import PlanningTimeout, check_time, time_limit
from fleet.errors import InfeasibleJob
from fleet.job import KINDS, Fixture, Place, Work
from fleet.motion import Plan
from fleet.robot import Mount, Robot, rotation

ROBOT = Robot(name="floor")
NEAR = Place(name="near", position_m=(0.45, 0.15, 0.25))
FAR = Place(name="far", position_m=(0.40, -0.30, 0.30))
FACE = Place(name="face", position_m=(0.55, 0.0, 0.45), tool_deg=(0.0, 90.0, 0.0))
WORKS = {
    "pick_place": Work(kind="pick_place", places=(NEAR, FAR), payload_kg=2.0),
    "sort": Work(kind="sort", places=(NEAR, FAR), payload_kg=0.2, dwell_s=0.2),
    "hold": Work(kind="hold", places=(FACE,), payload_kg=3.0, dwell_s=4.0),
    "press": Work(kind="press", places=(NEAR,), force_n=40.0, dwell_s=2.0),
}


def assert_same(plans: tuple[Plan, ...], others: tuple[Plan, ...]) -> None:
    assert len(plans) == len(others)
    for plan, other in zip(plans, others, strict=True):
        assert (plan.arm, plan.work, plan.elbow, plan.speed) == (other.arm, other.work, other.elbow, other.speed)
        for a, b in zip(plan.phases, other.phases, strict=True):
            np.testing.assert_array_equal(a.profile, b.profile)
            np.testing.assert_array_equal(a.payload_kg, b.payload_kg)


@pytest.fixture
def no_planning(monkeypatch):
    """Call it, and planning fails the test."""
    return lambda: monkeypatch.setattr(Planner, "plan", lambda *_: pytest.fail("planned although it was cached"))


@pytest.mark.parametrize("kind", KINDS)
def test_cached_plans_equal_computed_ones(kind, tmp_path, no_planning):
    fresh = Planner(ROBOT, elbows=2).plan(WORKS[kind])
    folder = tmp_path / "plans"
    assert_same(CachedPlanner(ROBOT, elbows=2, cache_dir=folder).plan(WORKS[kind]), fresh)
    assert [path.suffix for path in folder.iterdir()] == [".npz"]
    no_planning()
    cached = CachedPlanner(replace(ROBOT, name="other"), elbows=2, cache_dir=folder).plan(WORKS[kind])
    assert {plan.arm for plan in cached} == {"other"}
    assert_same(tuple(replace(plan, arm="floor") for plan in cached), fresh)


OVEN = Fixture(name="oven", position_m=(0.9, 0.0, 0.3), size_m=(0.2, 0.4, 0.6), tilt_deg=(0.0, 0.0, 20.0))


def moved(by_m: tuple[float, float], turn_deg: float) -> tuple[Robot, Fixture, Work]:
    """The arm, the oven and the work at another place of the hall, all turned about the vertical."""
    turn = rotation((0.0, 0.0, turn_deg))

    def at(position_m: tuple[float, ...]) -> tuple[float, float, float]:
        x, y, z = (turn @ position_m + (*by_m, 0.0)).tolist()
        return x, y, z

    def turned(angles_deg: tuple[float, float, float]) -> tuple[float, float, float]:
        return (*angles_deg[:2], angles_deg[2] + turn_deg)

    places = tuple(
        replace(place, name=f"there_{place.name}", position_m=at(place.position_m), tool_deg=turned(place.tool_deg))
        for place in WORKS["pick_place"].places
    )
    return (
        Robot(name="there", mount=Mount(position_m=at((0.0, 0.0, 0.0)), tilt_deg=(0.0, 0.0, turn_deg))),
        replace(OVEN, position_m=at(OVEN.position_m), tilt_deg=turned(OVEN.tilt_deg)),
        replace(WORKS["pick_place"], places=places),
    )


@settings(max_examples=20)
@given(st.tuples(*[st.floats(-8.0, 8.0)] * 2), st.floats(-180.0, 180.0))
def test_an_arm_that_stands_alike_elsewhere_has_the_same_plans(by_m, turn_deg):
    """The physics know no place and no compass: gravity and floor are the same after a move and a turn."""
    there, oven, work = moved(by_m, turn_deg)
    with TemporaryDirectory() as folder:
        options = {"elbows": 2, "speeds": (1.0,), "cache_dir": Path(folder)}
        here = CachedPlanner(ROBOT, [OVEN], **options).plan(WORKS["pick_place"])
        plans = CachedPlanner(there, [oven], **options).plan(work)
        assert len(list(Path(folder).iterdir())) == 1
    assert {(plan.arm, plan.work) for plan in plans} == {("there", work)}
    assert_same(tuple(replace(plan, arm="floor", work=WORKS["pick_place"]) for plan in plans), here)


@pytest.mark.parametrize("turn_deg", [37.0, 180.0])
def test_the_plan_of_a_moved_arm_brings_its_tool_to_the_place(turn_deg, tmp_path):
    """By the kinematics of the arm where it stands, which know nothing of its own frame."""
    there, oven, work = moved((3.0, -2.0), turn_deg)
    plan = CachedPlanner(there, [oven], elbows=1, speeds=(1.0,), cache_dir=tmp_path).plan(work)[0]
    still = plan.cycle.profile[(plan.cycle.profile[:, 1] == 0).all(axis=1), 0].astype(float)
    model = ArmModel(there)
    for place in work.places:
        errors_m = [np.linalg.norm(model.tool_pose(q)[0] - place.position_m) for q in still]
        turn = model.tool_pose(still[int(np.argmin(errors_m))])[1]
        assert min(errors_m) < 1e-3
        np.testing.assert_allclose(turn, rotation(place.tool_deg), atol=0.01)


def test_an_error_names_the_place_of_the_moved_arm(tmp_path):
    there, _, work = moved((3.0, -2.0), 90.0)
    far = replace(work.places[1], position_m=(3.0, 0.0, 0.3))
    for _ in range(2):
        with pytest.raises(InfeasibleJob, match="Arm 'there' cannot work at 'there_far': reach"):
            CachedPlanner(there, elbows=1, cache_dir=tmp_path).plan(replace(work, places=(work.places[0], far)))


def test_like_arms_share_the_memory_of_their_plans(tmp_path):
    loaded, (there, _, work) = LoadedPlans(), moved((1.5, 0.0), 180.0)
    options = {"elbows": 1, "speeds": (1.0,), "cache_dir": tmp_path}
    (here,) = CachedPlanner(ROBOT, **options, loaded=loaded).plan(WORKS["pick_place"])
    (plan,) = CachedPlanner(there, **options, loaded=loaded).plan(work)
    assert all(one.profile is other.profile for one, other in zip(plan.phases, here.phases, strict=True))


def test_other_fixtures_are_another_file(tmp_path, no_planning):
    far, farther = (Fixture(name="oven", position_m=(x, 0.0, 0.5), size_m=(0.5, 0.5, 1.0)) for x in (3.0, 4.0))
    for fixtures in ((), (far,), (farther,), (far, replace(farther, name="table"))):
        CachedPlanner(ROBOT, fixtures, elbows=1, cache_dir=tmp_path).plan(WORKS["hold"])
    assert len(list(tmp_path.iterdir())) == 4
    no_planning()
    CachedPlanner(ROBOT, (far,), elbows=1, cache_dir=tmp_path).plan(WORKS["hold"])


@pytest.mark.parametrize(
    ("robot", "work"),
    [
        (replace(ROBOT, tool_kg=0.1), WORKS["hold"]),
        (replace(ROBOT, home="retract"), WORKS["hold"]),
        (replace(ROBOT, mount=Mount(position_m=(0.0, 0.01, 0.0))), WORKS["hold"]),
        (ROBOT, replace(WORKS["hold"], payload_kg=3.1)),
    ],
)
def test_another_question_is_another_file(robot, work, tmp_path):
    CachedPlanner(ROBOT, elbows=1, cache_dir=tmp_path).plan(WORKS["hold"])
    CachedPlanner(robot, elbows=1, cache_dir=tmp_path).plan(work)
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("damage", [b"", b"not a plan", None])
def test_a_damaged_file_is_replaced_with_a_warning(damage, tmp_path, caplog):
    planner = CachedPlanner(ROBOT, elbows=1, cache_dir=tmp_path)
    plans = planner.plan(WORKS["sort"])
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:5000] if damage is None else damage)
    with caplog.at_level(logging.WARNING):
        assert_same(planner.plan(WORKS["sort"]), plans)
    assert "planning again" in caplog.text
    caplog.clear()
    assert_same(planner.plan(WORKS["sort"]), plans)
    assert not caplog.records


def test_an_infeasible_job_is_cached_too(tmp_path, no_planning):
    planner = CachedPlanner(ROBOT, cache_dir=tmp_path)
    heavy = replace(WORKS["hold"], payload_kg=9.0)
    with pytest.raises(InfeasibleJob, match="'floor' cannot work at 'face': 9 kg at") as first:
        planner.plan(heavy)
    no_planning()
    with pytest.raises(InfeasibleJob) as second:
        planner.plan(heavy)
    assert str(second.value) == str(first.value)


def test_the_least_recently_used_plans_leave_a_full_cache(tmp_path, monkeypatch):
    """Four works in a cache with room for three: the one that was neither made nor read last is planned anew."""
    planned = []
    plan = Planner.plan
    monkeypatch.setattr(Planner, "plan", lambda self, work: (planned.append(work), plan(self, work))[1])

    def use(payload_kg: float) -> None:
        planner = CachedPlanner(ROBOT, elbows=1, speeds=(1.0,), cache_dir=tmp_path)
        before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
        planner.plan(replace(WORKS["hold"], payload_kg=payload_kg))
        for path, at_ns in before.items():  # every use is a second after the one before
            if path.exists() and path.stat().st_mtime_ns == at_ns:
                os.utime(path, ns=(at_ns, at_ns - 10**9))

    use(1.0)
    size = sum(path.stat().st_size for path in tmp_path.iterdir())
    monkeypatch.setattr("fleet.arm.plan_cache.MAX_CACHE_BYTES", int(3.5 * size))
    for payload_kg in (1.1, 1.2, 1.0, 1.3):
        use(payload_kg)
        assert sum(path.stat().st_size for path in tmp_path.glob("*.npz")) <= 3.5 * size
    planned.clear()
    for payload_kg in (1.0, 1.2, 1.3, 1.1):
        use(payload_kg)
    assert [work.payload_kg for work in planned] == [1.1]


def test_a_plan_that_takes_too_long_is_given_up_in_its_own_thread_alone(tmp_path):
    """No file is written for it; another thread has no limit meanwhile; without a limit it is planned."""
    planner = CachedPlanner(ROBOT, elbows=2, cache_dir=tmp_path / "a")
    other = CachedPlanner(ROBOT, elbows=1, cache_dir=tmp_path / "b")
    with ThreadPoolExecutor(1) as pool, time_limit(0.0):
        with pytest.raises(PlanningTimeout, match="more than 0 s"):
            planner.plan(WORKS["pick_place"])
        assert pool.submit(other.plan, WORKS["hold"]).result(300.0)
    assert not list(tmp_path.glob("a/*.npz"))
    assert planner.plan(WORKS["pick_place"])


def test_only_processor_time_counts():
    """A process that was stopped, or had no processor, goes on planning."""
    with time_limit(0.05):
        threading.Event().wait(0.3)
        check_time()
        with pytest.raises(PlanningTimeout):
            deque(iter(check_time, True), maxlen=0)  # without end


def test_the_time_is_checked_in_every_part_of_a_plan(monkeypatch):
    """Wherever the time ends, planning ends at the next check."""
    clock, pieces = [0.0], []

    def tick() -> float:
        clock[0] += 1.0
        return clock[0]

    monkeypatch.setattr("fleet.arm.trajectory.thread_time", tick)
    planner = Planner(ROBOT, elbows=2)
    with time_limit(1e6):
        planner.plan(WORKS["pick_place"])
    checks = int(clock[0]) - 1
    assert checks > 20
    for end in range(0, checks - 1, 5):
        clock[0] = 0.0
        with time_limit(float(end)), pytest.raises(PlanningTimeout):
            planner.plan(WORKS["pick_place"])
        pieces.append(clock[0])
    assert pieces == [end + 2.0 for end in range(0, checks - 1, 5)]
