"""Paths against fixtures and floor: distances in closed form, finer steps, and the contacts of MuJoCo."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from fleet.arm.cell import ContactFinder
from fleet.arm.kinematics import InverseKinematics, Pose
from fleet.arm.model import ArmModel, build_cell, links_of
from fleet.arm.planner import Planner
from fleet.arm.trajectory import GAP_M, CollisionChecker, straight_line
from fleet.errors import InfeasibleJob
from fleet.job import KINDS, Fixture, Place, Work, payload_radius_m
from fleet.motion import RATE_HZ
from fleet.robot import POSTURES, Robot, rotation

ROBOT = Robot(name="arm")
HOME = ROBOT.home_q()
NEAR = Place(name="near", position_m=(0.45, 0.15, 0.25))
FAR = Place(name="far", position_m=(0.40, -0.30, 0.30))
WORKS = {
    "pick_place": Work(kind="pick_place", places=(NEAR, FAR), payload_kg=2.0),
    "sort": Work(kind="sort", places=(NEAR, FAR), payload_kg=0.5),
    "hold": Work(kind="hold", places=(NEAR,), payload_kg=3.0, dwell_s=1.0),
    "press": Work(kind="press", places=(NEAR,), payload_kg=1.0, force_n=20.0, dwell_s=1.0),
}


def table(top_m: float) -> Fixture:
    """A table under the places."""
    return Fixture(name="table", position_m=(0.45, 0.0, top_m / 2), size_m=(0.3, 1.0, top_m))


@pytest.mark.parametrize("payload_kg", [0.1, 2.0, 4.0])
@pytest.mark.parametrize("top_m", [0.0, 0.1])
def test_a_payload_is_a_ball_below_the_flange(payload_kg, top_m):
    """A hand that points down, 7 mm lower above the floor or a table than the diameter of its payload."""
    radius_m = (payload_kg / 2700.0 / (4 / 3 * np.pi)) ** (1 / 3)
    assert payload_radius_m(payload_kg) == pytest.approx(radius_m)
    arm = ArmModel(ROBOT, [table(top_m)] if top_m else ())
    hand = Pose(np.array([0.45, 0.0, top_m + 2 * radius_m - 0.007]), rotation((180.0, 0.0, 0.0)))
    q = InverseKinematics(arm).solve(hand, 0.0, HOME)[None]
    obstacle = "fixture 'table'" if top_m else "floor"
    checker = CollisionChecker(arm)
    assert checker.deepest_collision(q, payload_kg) == f"payload would be 7 mm inside the {obstacle}"
    assert checker.deepest_collision(q) is None


def test_a_mass_beyond_the_largest_ball_has_its_size():
    assert payload_radius_m(1e3) == 0.1
    assert payload_radius_m(0.0) == 0.0


@pytest.mark.parametrize("seed", range(12))
def test_a_clear_path_stays_clear_of_thin_fixtures_between_the_checked_postures(seed):
    """Second method: a tenth of the step, with every link against a sheet of 5 mm in a random place."""
    rng = np.random.default_rng(seed)
    fixtures = [
        Fixture(
            name=f"sheet {i}",
            position_m=tuple(rng.uniform((0.15, -0.6, 0.1), (0.8, 0.6, 0.9))),
            size_m=(0.005, *rng.uniform(0.02, 0.3, 2)),
            tilt_deg=tuple(rng.uniform(-180, 180, 3)),
        )
        for i in range(3)
    ]
    arm = ArmModel(ROBOT, fixtures)
    checker, clear, blocked = CollisionChecker(arm), 0, 0
    for _ in range(40):
        start, end = (HOME + rng.uniform(-0.9, 0.9, 7) for _ in range(2))
        if checker.on_path(start, end):
            blocked += 1
            continue
        clear += 1
        assert closest_m(arm, fixtures, straight_line(start, end, 0.002)) > 0.0
    assert clear > 0
    assert blocked > 0


def closest_m(arm: ArmModel, fixtures: list[Fixture], q: np.ndarray) -> float:
    """Smallest distance between a link and a fixture over postures."""
    links = [arm.model.geom(f"arm/{link}").id for link in links_of(arm.model, "arm")]
    boxes = [arm.model.geom(f"fixture/{fixture.name}").id for fixture in fixtures]
    closest = np.inf
    for posture in q:
        arm.tool_pose(posture)
        for link in links:
            for box in boxes:
                closest = min(closest, mujoco.mj_geomDistance(arm.model, arm.data, link, box, 1.0, None))
    return closest


def test_a_path_through_a_fixture_is_infeasible_with_the_reason():
    oven = Fixture(name="oven", position_m=(0.45, 0.15, 0.4), size_m=(0.1, 0.1, 0.1))
    with pytest.raises(InfeasibleJob) as error:
        Planner(ROBOT, [oven], elbows=1).plan(WORKS["hold"])
    assert error.value.place == "near"
    assert "mm inside the fixture 'oven' on the way" in error.value.reason
    assert Planner(ROBOT, [replace(oven, position_m=(0.45, 0.15, 3.0))], elbows=1).plan(WORKS["hold"])


def test_a_payload_that_does_not_fit_under_the_hand_is_infeasible():
    low = table(0.25 - 2 * payload_radius_m(1.0) - 2 * GAP_M)
    planner = Planner(ROBOT, [low], elbows=1)
    assert planner.plan(replace(WORKS["hold"], payload_kg=1.0))
    with pytest.raises(InfeasibleJob, match=r"payload would be .* inside the fixture 'table'"):
        planner.plan(replace(WORKS["hold"], payload_kg=3.0))


@pytest.mark.parametrize("kind", KINDS)
def test_planned_motion_has_no_contact_in_mujoco(kind):
    work = WORKS[kind]
    fixtures = [
        table(0.25 - 2 * payload_radius_m(work.payload_kg) - 0.01),
        Fixture(name="post", position_m=(0.66, -0.05, 0.5), size_m=(0.05, 0.05, 0.4)),
    ]
    finder = ContactFinder(build_cell([ROBOT], fixtures=fixtures), [ROBOT])
    plans = Planner(ROBOT, fixtures, elbows=3, speeds=(1.0,)).plan(work)
    for plan in plans:
        q = np.concatenate([phase.profile[:, 0] for phase in plan.phases]).astype(float)[:, None]
        payload_kg = np.concatenate([phase.payload_kg for phase in plan.phases])[:, None]
        assert finder.events(np.arange(len(q)) / RATE_HZ, q, payload_kg) == []
        finder.reset()


def test_a_base_may_stand_on_a_fixture_and_not_in_it():
    robot = replace(ROBOT, mount=replace(ROBOT.mount, position_m=(0.0, 0.0, 0.5)))
    stand = Fixture(name="stand", position_m=(0.0, 0.0, 0.25), size_m=(0.2, 0.2, 0.5))
    home = np.array([POSTURES["home"]])
    assert CollisionChecker(ArmModel(robot, [stand])).deepest_collision(home) is None
    high = replace(stand, size_m=(0.2, 0.2, 0.54))
    assert CollisionChecker(ArmModel(robot, [high])).deepest_collision(home) == (
        "base would be 20 mm inside the fixture 'stand'"
    )
