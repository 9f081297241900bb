"""Plans against their limits, their own derivatives, independent kinematics, and those of the cache."""

import logging
import os
import re
import threading
import warnings
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from fleet.arm.gen3 import ELBOW_ANGLES_DEG
from fleet.arm.kinematics import InverseKinematics, Pose, Unreachable, angle_between, nearest_turn
from fleet.arm.model import ArmModel
from fleet.arm.plan_cache import CachedPlanner, LoadedPlans
from fleet.arm.planner import Planner
from fleet.arm.time_limit import PlanningTimeout, check_time, time_limit
from fleet.arm.trajectory import CollisionChecker
from fleet.errors import InfeasibleJob
from fleet.job import KINDS, Fixture, Place, Work
from fleet.motion import RATE_HZ, Plan
from fleet.robot import GEN3, POSTURES, Mount, Robot, rotation
from tests.profiles import examples

DOWN = rotation((180.0, 0.0, 0.0))
ROUNDING_M = 1e-13
"""More than the numeric libraries of two processors differ in."""


@pytest.mark.parametrize(("home", "tilt_deg"), [("home", (0.0, 0.0, 0.0)), ("retract", (180.0, 0.0, 0.0))])
def test_the_last_digit_chooses_no_posture(home, tilt_deg):
    """Straight ahead, where the arm can turn to either side, and on a grid like that of stations."""
    robot = Robot(name="a", home=home, mount=Mount(position_m=(0.0, 0.0, 0.9 if tilt_deg[0] else 0.0)))
    arm = ArmModel(replace(robot, mount=replace(robot.mount, tilt_deg=tilt_deg)))
    inverse, rng, compared = InverseKinematics(arm), np.random.default_rng(0), 0
    for x in (-0.45, 0.3, 0.45):
        for y in (-0.3, 0.0, 0.3):
            for elbow_deg in ELBOW_ANGLES_DEG:
                pose = Pose(np.array([x, y, 0.25]), DOWN)
                try:
                    q = inverse.solve(pose, elbow_deg, robot.home_q())
                except Unreachable:
                    continue
                moved = Pose(pose.position_m + ROUNDING_M * rng.standard_normal(3), DOWN)
                np.testing.assert_allclose(inverse.solve(moved, elbow_deg, robot.home_q()), q, atol=1e-6)
                compared += 1
    assert compared > 50


DT_S = 1.0 / RATE_HZ
ROBOTS = {
    "floor": Robot(name="floor"),
    "wall": Robot(name="wall", mount=Mount(position_m=(-0.3, 0.0, 0.7), tilt_deg=(0.0, 90.0, 0.0)), tool_kg=0.5),
    "ceiling": Robot(name="ceiling", mount=Mount(position_m=(0.1, 0.0, 1.2), tilt_deg=(180.0, 0.0, 0.0))),
}

ARMS = {name: ArmModel(robot) for name, robot in ROBOTS.items()}
PLANNERS = {name: Planner(robot, elbows=2) for name, robot in ROBOTS.items()}
NEAR = Place(name="near", position_m=(0.45, 0.15, 0.25))
FAR = Place(name="far", position_m=(0.40, -0.30, 0.30))
FACE = Place(name="face", position_m=(0.55, 0.0, 0.45), tool_deg=(0.0, 90.0, 0.0))


WORKS = {
    "pick_place": Work(kind="pick_place", places=(NEAR, FAR), payload_kg=2.0),
    "sort": Work(kind="sort", places=(NEAR, FAR), payload_kg=0.2, dwell_s=0.2),
    "hold": Work(kind="hold", places=(FACE,), payload_kg=3.0, dwell_s=4.0),
    "press": Work(kind="press", places=(NEAR,), force_n=40.0, dwell_s=2.0),
}


def work(kind: str, **changes) -> Work:
    return replace(WORKS[kind], **changes)


def samples(plan: Plan) -> np.ndarray:
    return np.concatenate([phase.profile for phase in plan.phases]).astype(float)


@st.composite
def places(draw):
    azimuth, radius = draw(st.floats(-1.5, 1.5)), draw(st.floats(0.35, 0.6))
    position_m = (radius * np.cos(azimuth), radius * np.sin(azimuth), draw(st.floats(0.1, 0.5)))
    tool_deg = draw(st.sampled_from([(180.0, 0.0, 0.0), (180.0, 0.0, 90.0), (180.0, -30.0, 0.0), (0.0, 90.0, 0.0)]))
    return Place(name=f"at {azimuth:.2f}", position_m=position_m, tool_deg=tool_deg)


@st.composite
def works(draw):
    kind = draw(st.sampled_from(KINDS))
    wanted = 2 if kind in ("pick_place", "sort") else 1
    return Work(
        kind=kind,
        places=tuple(draw(st.lists(places(), min_size=wanted, max_size=wanted, unique_by=lambda p: p.name))),
        payload_kg=draw(st.floats(0.0, 4.0)),
        dwell_s=draw(st.floats(0.1, 2.0)),
        force_n=draw(st.floats(0.0, 60.0)) if kind == "press" else 0.0,
    )


@pytest.mark.parametrize("name", ROBOTS)
@given(what=works())
@settings(max_examples=10, suppress_health_check=[HealthCheck.filter_too_much])
def test_every_sample_keeps_the_limits(name, what):
    try:
        plans = PLANNERS[name].plan(what)
    except InfeasibleJob:
        assume(False)
        return
    low, high = ARMS[name].position_range.T
    for plan in plans:
        profile = samples(plan)
        q, qd, tau = profile.transpose(1, 0, 2)
        mean_qdd = np.diff(qd, axis=0) / DT_S
        assert np.isfinite(profile).all()
        assert (q >= low - 1e-6).all()
        assert (q <= high + 1e-6).all()
        assert (np.abs(qd) <= plan.speed * np.array(GEN3.velocity) + 1e-5).all()
        assert (np.abs(mean_qdd) <= plan.speed * np.array(GEN3.acceleration) + 1e-3).all()
        assert (np.abs(np.diff(mean_qdd, axis=0)) <= plan.speed * np.array(GEN3.jerk) * DT_S + 1e-3).all()
        assert (np.abs(tau) <= np.array(GEN3.torque_clip) + 1e-4).all()
        # Trapezoidal rule; its error is at most jerk · dt³ / 12 on either side of a kink.
        np.testing.assert_allclose(np.diff(q, axis=0), DT_S * (qd[:-1] + qd[1:]) / 2, atol=1e-4)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("kind", KINDS)
def test_phases_join_at_rest_and_start_and_end_at_home(name, kind):
    for plan in PLANNERS[name].plan(work(kind)):
        home = ROBOTS[name].home_q()
        approach, cycle, retreat = (phase.profile.astype(float) for phase in plan.phases)
        for first in (approach, cycle, retreat):
            np.testing.assert_allclose(first[0, 1], 0.0, atol=1e-6)
        np.testing.assert_allclose(approach[0, 0], home, atol=1e-6)
        # The sample after the last of a cycle is its first: half a sample of the last speed away, at most.
        for last, then in ((approach, cycle[0, 0]), (cycle, cycle[0, 0]), (cycle, retreat[0, 0]), (retreat, home)):
            np.testing.assert_allclose(last[-1, 0] + last[-1, 1] * DT_S / 2, then, atol=1e-4)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_tool_stands_at_the_places_while_it_dwells(name, kind):
    what = work(kind)
    for plan in PLANNERS[name].plan(what):
        q, qd, _ = plan.cycle.profile.astype(float).transpose(1, 0, 2)
        still = q[(qd == 0).all(axis=1)]
        for place in what.places:
            misses = []
            for posture in still:
                position, turn = ARMS[name].tool_pose(posture)
                angle_deg = np.rad2deg(angle_between(turn, rotation(place.tool_deg)))
                misses.append((np.linalg.norm(position - place.position_m) < 1e-3) and angle_deg < 0.5)
            assert sum(misses) >= round(what.dwell_s * RATE_HZ)


def test_a_payload_hangs_from_grasp_to_release():
    plan = PLANNERS["floor"].plan(work("pick_place"))[0]
    carried = plan.cycle.payload_kg
    assert set(np.unique(carried)) == {0.0, 2.0}
    assert not plan.approach.payload_kg.any()
    assert not plan.retreat.payload_kg.any()
    changes = np.flatnonzero(np.diff(carried)) + 1
    assert len(changes) == 2
    for change, place in zip(changes, (NEAR, FAR), strict=True):
        dwell = plan.cycle.profile[change - 25 : change + 1]
        assert not dwell[:, 1].any()
        position, _ = ARMS["floor"].tool_pose(dwell[-1, 0].astype(float))
        np.testing.assert_allclose(position, place.position_m, atol=1e-3)


def test_a_hold_carries_all_the_time_and_lasts_its_dwell():
    plan = PLANNERS["floor"].plan(work("hold"))[0]
    assert plan.cycle.duration_s == 4.0
    assert (plan.cycle.payload_kg == 3.0).all()
    expected = ARMS["floor"].gravity_torque(plan.cycle.profile[0, 0].astype(float), 3.0)
    np.testing.assert_allclose(plan.cycle.profile[:, 2], np.tile(expected, (200, 1)), atol=1e-4)


@given(heavy=st.floats(1.0, 4.0), share=st.floats(0.0, 1.0))
@settings(max_examples=4)
def test_torque_is_affine_in_the_payload(heavy, share):
    planner = PLANNERS["floor"]
    none, some, all_ = (planner.plan(work("pick_place", payload_kg=kg))[0] for kg in (0.0, share * heavy, heavy))
    for a, b, c in zip(none.phases, some.phases, all_.phases, strict=True):
        between = (1 - share) * a.profile[:, 2].astype(float) + share * c.profile[:, 2].astype(float)
        np.testing.assert_allclose(b.profile[:, 2], between, atol=1e-4)


def test_a_press_is_a_hold_plus_the_force_through_the_jacobian():
    place = replace(FACE, tool_deg=(150.0, 20.0, 10.0))
    pressed = PLANNERS["wall"].plan(work("press", places=(place,)))[0].cycle.profile
    held = PLANNERS["wall"].plan(work("hold", places=(place,), payload_kg=0.0))[0].cycle.profile
    q = pressed[0, 0].astype(float)
    step = 1e-6
    jacobian = np.stack(
        [
            (ARMS["wall"].tool_pose(q + step * e)[0] - ARMS["wall"].tool_pose(q - step * e)[0]) / (2 * step)
            for e in np.eye(7)
        ],
        axis=1,
    )
    push = 40.0 * rotation(place.tool_deg)[:, 2]
    np.testing.assert_allclose(pressed[0, 0], held[0, 0])
    np.testing.assert_allclose(pressed[0, 2] - held[0, 2], jacobian.T @ push, atol=1e-3)


def test_variants_are_numbered_from_the_quickest_and_differ():
    plans = Planner(ROBOTS["floor"], elbows=3, speeds=(0.6, 1.0)).plan(work("pick_place"))
    assert [(plan.elbow, plan.speed) for plan in plans] == [(e, s) for e in range(3) for s in (1.0, 0.6)]
    fastest = [plan.duration_s(1) for plan in plans[::2]]
    assert fastest == sorted(fastest)
    elbows = [ARMS["floor"].elbow_position(plan.cycle.profile[0, 0].astype(float)) for plan in plans[::2]]
    assert all(np.linalg.norm(a - b) > 0.05 for a, b in combinations(elbows, 2))


def test_an_outstretched_arm_has_one_elbow():
    far_out = Place(name="far out", position_m=(0.902, 0.0, 0.285), tool_deg=(0.0, 90.0, 0.0), retreat_m=0.0)
    plans = Planner(ROBOTS["floor"], speeds=(1.0,)).plan(work("hold", places=(far_out,), payload_kg=1.0))
    assert [plan.elbow for plan in plans] == [0]


def assert_same(plans: tuple[Plan, ...], others: tuple[Plan, ...]) -> None:
    assert len(plans) == len(others)
    for plan, other in zip(plans, others, strict=True):
        assert (plan.arm, plan.work, plan.elbow, plan.speed) == (other.arm, other.work, other.elbow, other.speed)
        for a, b in zip(plan.phases, other.phases, strict=True):
            np.testing.assert_array_equal(a.profile, b.profile)
            np.testing.assert_array_equal(a.payload_kg, b.payload_kg)


@pytest.mark.parametrize(
    ("what", "place", "reason"),
    [
        (work("pick_place", places=(NEAR, replace(FAR, position_m=(1.5, 0.0, 0.3)))), "far", r"^reach: 1\.\d+ m"),
        (
            work("press", places=(replace(FACE, position_m=(0.6, 0.0, 0.3), tool_deg=(0.0, 0.0, 0.0)),), force_n=200.0),
            "face",
            r"^torque: joint_\d needs \d+\.\d N·m, allowed \d+ N·m, with 0 kg pressing 200 N",
        ),
        (work("hold", payload_kg=5.0), "face", r"^5 kg at 0\.\d\d m reach is beyond the rating of 4\.5 kg$"),
        (work("hold", places=(replace(FACE, position_m=(0.167, 0.0, 0.4)),)), "face", "joint limit: joint_4 would"),
        (work("hold", places=(replace(NEAR, position_m=(0.5, 0.0, -0.1)),)), "near", "collision: .* inside the floor"),
    ],
)
def test_an_infeasible_job_names_the_arm_the_place_and_the_reason(what, place, reason):
    with pytest.raises(InfeasibleJob, match=f"'floor' cannot work at '{place}'") as error:
        PLANNERS["floor"].plan(what)
    assert error.value.place == place
    assert re.search(reason, error.value.reason), error.value.reason


def test_continuous_joints_take_the_short_way():
    """No joint without stops turns further than half a turn on the way to the first place."""
    for azimuth in np.linspace(-3.0, 3.0, 7):
        place = replace(NEAR, position_m=(0.5 * np.cos(azimuth), 0.5 * np.sin(azimuth), 0.3))
        for plan in PLANNERS["floor"].plan(work("hold", places=(place,))):
            turned = plan.cycle.profile[0, 0] - plan.approach.profile[0, 0]
            assert np.abs(turned[::2]).max() <= np.pi + 0.3  # the place is a little further than the stop above it


@given(q=st.tuples(*[st.floats(-1.8, 1.8)] * 7).map(np.array), elbow_deg=st.sampled_from([0.0, 60.0, -60.0]))
@examples(60)
def test_inverse_kinematics_finds_poses_that_exist(q, elbow_deg):
    robot = ROBOTS["wall"]
    inverse = InverseKinematics(ARMS["wall"])
    pose = Pose(*ARMS["wall"].tool_pose(q))
    found, reason = None, ""
    try:
        found = inverse.solve(pose, elbow_deg, robot.home_q())
    except Unreachable as error:
        reason = str(error)
    if found is None:
        # Some elbow turns need a joint beyond its stop, and none is left to an outstretched arm.
        assert reason.startswith("joint limit") or (abs(q[3]) < 0.2 and reason.startswith("reach"))
        return
    distance_m, angle_rad = inverse.error(pose, found)
    assert distance_m < 1e-3
    assert np.rad2deg(angle_rad) < 0.5


@pytest.mark.parametrize(
    "beyond",
    [
        (0.0, 2.25, 3.14, -1.87, 0.0, 0.96, 1.57),
        (0.0, 0.40, 3.14, -2.62, 0.0, 0.96, 1.57),
        (0.0, 0.40, 3.14, -2.09, 0.0, 2.14, 1.57),
    ],
)
def test_inverse_kinematics_stays_within_the_stops(beyond):
    """Poses that an arm without stops would take with joint 2, 4 or 6 a little beyond them."""
    arm, q = ARMS["floor"], np.array(beyond)
    try:
        found = InverseKinematics(arm).solve(Pose(*arm.tool_pose(q)), 0.0, q)
    except Unreachable as error:
        found = np.zeros(7) if "at its stop" in str(error) else np.full(7, np.nan)
    assert (np.abs(found) <= arm.position_range[:, 1] + 1e-9).all()


@given(q=st.tuples(*[st.floats(-20.0, 20.0)] * 7).map(np.array), near=st.tuples(*[st.floats(-9.0, 9.0)] * 7))
def test_the_nearest_turn_is_within_half_a_turn(q, near):
    turned = nearest_turn(q, np.array(near))
    assert np.abs(turned - near)[::2].max() <= np.pi + 1e-9
    np.testing.assert_array_equal(turned[1::2], q[1::2])
    np.testing.assert_allclose(np.cos(turned), np.cos(q), atol=1e-9)


def test_named_postures_are_clear_and_a_folded_arm_is_not():
    checker = CollisionChecker(ARMS["floor"])
    assert checker.deepest_collision(np.array(list(POSTURES.values()))) is None
    assert "inside the floor" in str(checker.deepest_collision(np.array([[0.0, 2.2, 0.0, 0.0, 0.0, 0.0, 0.0]])))
    assert "inside the base" in str(checker.deepest_collision(np.array([[0.0, 2.1, 0.0, 2.5, 0.0, 0.0, 0.0]])))


@pytest.mark.parametrize("wrong", [{"elbows": 0}, {"speeds": ()}, {"speeds": (1.2,)}, {"speeds": (0.0,)}])
def test_a_planner_refuses_senseless_variants(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Planner(ROBOTS["floor"], **wrong)


def test_planning_is_quiet(capfd):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        PLANNERS["floor"].plan(work("pick_place"))
    assert capfd.readouterr() == ("", "")


ROBOT = ROBOTS["floor"]


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


@settings(max_examples=10)
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


def test_the_plan_of_a_moved_arm_brings_its_tool_to_the_place(tmp_path):
    """By the kinematics of the arm where it stands, which know nothing of its own frame."""
    there, oven, work = moved((3.0, -2.0), 37.0)
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


def test_another_arm_work_or_fixture_is_another_file(tmp_path, no_planning):
    far, farther = (Fixture(name="oven", position_m=(x, 0.0, 0.5), size_m=(0.5, 0.5, 1.0)) for x in (3.0, 4.0))
    hold = WORKS["hold"]
    questions = [
        (ROBOT, (), hold),
        (ROBOT, (far,), hold),
        (ROBOT, (farther,), hold),
        (ROBOT, (far, replace(farther, name="table")), hold),
        (replace(ROBOT, tool_kg=0.1), (), hold),
        (replace(ROBOT, home="retract"), (), hold),
        (replace(ROBOT, mount=Mount(position_m=(0.0, 0.01, 0.0))), (), hold),
        (ROBOT, (), replace(hold, payload_kg=3.1)),
    ]
    # An arm that stands elsewhere in the hall has the same plans, see below.
    for count, (robot, fixtures, work) in enumerate(questions, start=1):
        CachedPlanner(robot, fixtures, elbows=1, cache_dir=tmp_path).plan(work)
        assert len(list(tmp_path.iterdir())) == count
    no_planning()
    CachedPlanner(ROBOT, (far,), elbows=1, cache_dir=tmp_path).plan(hold)


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

    monkeypatch.setattr("fleet.arm.time_limit.thread_time", tick)
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
