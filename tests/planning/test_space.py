"""Space of a cell, distances of paths, fixtures and floor, against MuJoCo and closed forms."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from fleet.arm import space
from fleet.arm.cell import ContactFinder
from fleet.arm.clearance import Capsules, clearance, conflict, segment_distance
from fleet.arm.kinematics import InverseKinematics, Pose
from fleet.arm.model import ArmModel, build_cell, links_of
from fleet.arm.planner import Planner
from fleet.arm.space import collisions_of_homes, conflicts_with_homes, space_table
from fleet.arm.trajectory import GAP_M, CollisionChecker, straight_line
from fleet.errors import InfeasibleJob
from fleet.job import KINDS, Fixture, Place, Work, payload_radius_m
from fleet.motion import RATE_HZ
from fleet.robot import POSTURES, Mount, Robot, rotation

MARGIN_M = 0.02
WEST = Robot(name="west", mount=Mount(position_m=(-0.62, -0.42, 0.0), tilt_deg=(0.0, 0.0, 34.0)))
EAST = Robot(name="east", mount=Mount(position_m=(0.62, -0.42, 0.0), tilt_deg=(0.0, 0.0, 146.0)))
FAR = Robot(name="far", mount=Mount(position_m=(9.0, 0.0, 0.0)))
SHARED = Place(name="shared", position_m=(0.0, -0.48, 0.2))
PLACES = {
    "west": (SHARED, Place(name="left", position_m=(-0.45, 0.0, 0.2))),
    "east": (SHARED, Place(name="right", position_m=(0.45, 0.0, 0.2))),
    "far": (Place(name="away", position_m=(9.5, 0.0, 0.2)),),
}


def hold(place, payload_kg=1.0, dwell_s=1.0):
    return Work(kind="hold", places=(place,), payload_kg=payload_kg, dwell_s=dwell_s)


@pytest.fixture(scope="module")
def plans():
    """Holds with two payloads and two durations of every arm."""
    made = []
    for robot in (WEST, EAST, FAR):
        planner = Planner(robot, elbows=2)
        for place in PLACES[robot.name]:
            for payload_kg, dwell_s in ((0.5, 1.0), (2.0, 2.0)):
                made += planner.plan(hold(place, payload_kg, dwell_s))
    return made


@pytest.fixture(scope="module")
def table(plans, tmp_path_factory):
    return space_table([WEST, EAST, FAR], plans, MARGIN_M, tmp_path_factory.mktemp("plans"))


def least_distance_m(one, other):
    """Smallest distance of any two links over pairs of postures of two plans, by MuJoCo; links only, no payload."""
    model = build_cell([WEST, EAST])
    data = mujoco.MjData(model)
    geoms = [[g for g in range(model.ngeom) if model.geom(g).name.startswith(f"{n}/")] for n in ("west", "east")]
    paths = [np.concatenate([phase.profile[:, 0] for phase in plan.phases]) for plan in (one, other)]
    least = np.inf
    for q in paths[0][:: len(paths[0]) // 15]:
        for other_q in paths[1][:: len(paths[1]) // 15]:
            data.qpos[:] = np.concatenate([q, other_q])
            mujoco.mj_kinematics(model, data)
            for a in geoms[0]:
                for b in geoms[1]:
                    least = min(least, mujoco.mj_geomDistance(model, data, a, b, 0.5, None))
    return least


def test_plans_that_mujoco_sees_too_close_exclude_each_other(plans, table):
    volumes, conflicts = table.rows(plans)
    seen = set()
    for one, i in zip(plans, volumes, strict=True):
        for other, j in zip(plans, volumes, strict=True):
            if one.arm == "west" and other.arm == "east" and (i, j) not in seen:
                seen.add((i, j))
                if not conflicts[i, j]:
                    assert least_distance_m(one, other) >= MARGIN_M
                elif one.work.places == other.work.places:
                    assert least_distance_m(one, other) < MARGIN_M
    assert {bool(conflicts[pair]) for pair in seen} == {True, False}


def test_two_plans_of_one_arm_always_exclude_each_other_and_those_out_of_reach_never_do(plans, table):
    volumes, conflicts = table.rows(plans)
    assert conflicts.dtype == bool
    np.testing.assert_array_equal(conflicts, conflicts.T)
    arms = np.array([plan.arm for plan in plans])
    for name in ("west", "east", "far"):
        own = volumes[arms == name]
        assert conflicts[np.ix_(own, own)].all()
    assert not conflicts[np.ix_(volumes[arms == "far"], volumes[arms != "far"])].any()


def test_speed_duration_and_payload_share_a_volume_and_places_do_not(plans, table):
    volumes, _ = table.rows(plans)
    groups = {}
    for plan, volume in zip(plans, volumes, strict=True):
        groups.setdefault(volume, set()).add((plan.arm, plan.work.places[0].name))
    assert all(len(group) == 1 for group in groups.values())
    assert len(groups) <= len(plans) / 4  # two speeds, two payloads
    assert sorted(groups) == list(range(len(table.conflicts)))


def test_an_unknown_plan_is_an_error(plans, table):
    with pytest.raises(ValueError, match=r"No space is known for a hold of arm 'west' at 'shared'"):
        table.rows([replace(plans[0], speed=0.123)])


def test_the_cached_table_is_the_computed_one(plans, table, tmp_path, monkeypatch):
    robots = [WEST, EAST, FAR]
    space_table(robots, plans, MARGIN_M, tmp_path)
    files = set(tmp_path.iterdir())
    with monkeypatch.context() as patch:
        patch.setattr(space, "_capsules", lambda _: pytest.fail("computed although it was cached"))
        again = space_table(robots, plans, MARGIN_M, tmp_path)
        np.testing.assert_array_equal(again.conflicts, table.conflicts)
        assert again.volume == table.volume
        with pytest.raises(pytest.fail.Exception):
            space_table(robots, plans, 0.05, tmp_path)
    wider = space_table(robots, plans, 0.3, tmp_path)
    assert set(tmp_path.iterdir()) > files
    assert wider.conflicts.sum() > table.conflicts.sum()
    assert (wider.conflicts | ~table.conflicts).all()


def test_a_plan_that_comes_too_close_to_a_home_says_so(plans, tmp_path):
    own = [plan for plan in plans if plan.arm == "west"]
    assert conflicts_with_homes(WEST, [EAST, FAR], own, MARGIN_M, tmp_path) == [None] * len(own)
    # An arm whose base stands under the shared place.
    beside = Robot(name="beside", mount=Mount(position_m=(0.0, -0.55, 0.0)))
    reasons = conflicts_with_homes(WEST, [EAST, beside], own, MARGIN_M, tmp_path)
    assert reasons == conflicts_with_homes(WEST, [EAST, beside], own, MARGIN_M, tmp_path)
    for plan, reason in zip(own, reasons, strict=True):
        if plan.work.places == (SHARED,):
            assert "of beside (" in reason or "with beside (" in reason
            assert reason.endswith(") at home")
        else:
            assert reason is None


def test_the_result_for_a_plan_does_not_depend_on_the_other_plans(plans, tmp_path):
    """A heavy payload comes closer to a home than a light one on the same path."""
    own = [plan for plan in plans if plan.arm == "west" and plan.work.places == (SHARED,) and plan.elbow == 0]
    for distance_m in np.arange(0.05, 0.3, 0.002):  # a margin between the distances of the two payloads
        together = conflicts_with_homes(WEST, [EAST], own, distance_m, tmp_path)
        light = [reason for plan, reason in zip(own, together, strict=True) if plan.work.payload_kg == 0.5]
        if None in light and None in together and any(together):
            break
    else:
        pytest.fail("no margin between the distances")
    for plan, reason in zip(own, together, strict=True):
        assert conflicts_with_homes(WEST, [EAST], [plan], distance_m, tmp_path) == [reason]


def test_colliding_homes_are_all_named(tmp_path):
    near = replace(EAST, name="near", mount=Mount(position_m=(-0.1, -0.3, 0.0), tilt_deg=(0.0, 0.0, 180.0)))
    assert collisions_of_homes([WEST, EAST, FAR], MARGIN_M, tmp_path) == []
    for _ in range(2):  # computed, cached
        (sentence,) = collisions_of_homes([WEST, EAST, FAR, near], MARGIN_M, tmp_path)
        assert sentence.startswith("at home 'west' (")
        assert "'near' (" in sentence


ROUND = ("shoulder", "half_arm_1", "half_arm_2", "forearm", "wrist_1", "wrist_2")
"""Links that are capsules in the MuJoCo model, too."""


@pytest.fixture(scope="module")
def robots():
    return [Robot(name="a"), Robot(name="b", mount=Mount(position_m=(0.5, 0.3, 0.0), tilt_deg=(0.0, 0.0, 70.0)))]


@pytest.fixture(scope="module")
def capsules(robots):
    return [Capsules(ArmModel(robot)) for robot in robots]


def path(seed, postures=30):
    """A smooth random path, rad, [posture, joint]."""
    draw = np.random.default_rng(seed)
    ends = draw.uniform(-2.0, 2.0, (2, 7))
    return ends[0] + np.linspace(0, 1, postures)[:, None] * (ends[1] - ends[0])


def test_links_are_as_far_apart_as_mujoco_says(robots, capsules):
    model = build_cell(robots)
    data = mujoco.MjData(model)
    for seed in range(20):
        q = np.random.default_rng(seed).uniform(-2.0, 2.0, (2, 7))
        data.qpos[:] = q.ravel()
        mujoco.mj_kinematics(model, data)
        one, other = (c.sweep(joints[None]) for c, joints in zip(capsules, q, strict=True))
        for i, link in enumerate(one.links):
            for j, other_link in enumerate(other.links):
                geoms = model.geom(f"a/{link}").id, model.geom(f"b/{other_link}").id
                true_m = mujoco.mj_geomDistance(model, data, *geoms, 5.0, None)
                ours_m = segment_distance(one.ends_m[i, 0], other.ends_m[j, 0]) - one.radius_m[i] - other.radius_m[j]
                if link in ROUND and other_link in ROUND:
                    assert ours_m == pytest.approx(true_m, abs=1e-5)
                else:
                    assert ours_m <= true_m + 1e-5  # a capsule around a cylinder or box


@pytest.mark.parametrize("seed", range(3))
def test_the_tree_finds_the_closest_of_all_pairs_of_postures(capsules, seed):
    one, other = (c.sweep(path(2 * seed + n, 50), payload_kg=2.0) for n, c in enumerate(capsules))
    closest = min(
        segment_distance(one.ends_m[i, p], other.ends_m[j, q]) - one.radius_m[i] - other.radius_m[j]
        for i in range(len(one.links))
        for j in range(len(other.links))
        for p in range(0, 50, 7)
        for q in range(0, 50, 7)
    )
    found = clearance(one, other)
    assert found is not None
    assert found.distance_m <= closest + 1e-6  # float32
    assert clearance(other, one).distance_m == pytest.approx(found.distance_m, abs=1e-6)
    assert conflict(one, other, found.distance_m + 1e-4)
    assert not conflict(one, other, found.distance_m - 1e-4)
    assert clearance(one, other, found.distance_m - 1e-4) is None


coordinate = st.floats(-2, 2, width=32)
segment = st.tuples(st.tuples(*[coordinate] * 3), st.tuples(*[coordinate] * 3)).map(np.array)


@given(segment, segment)
def test_segments_are_as_far_apart_as_a_search_finds(a, b):
    def apart(st):
        return float(np.sum((a[0] + st[0] * (a[1] - a[0]) - b[0] - st[1] * (b[1] - b[0])) ** 2))

    starts = [(s, t) for s in (0.0, 0.5, 1.0) for t in (0.0, 0.5, 1.0)]
    best = min(minimize(apart, start, bounds=[(0, 1), (0, 1)]).fun for start in starts)
    assert segment_distance(a, b) <= np.sqrt(best) + 1e-4
    assert segment_distance(a, b) >= np.sqrt(best) - 1e-4


ROBOT = Robot(name="arm")
HOME = ROBOT.home_q()
NEAR = Place(name="near", position_m=(0.45, 0.15, 0.25))
FAR_PLACE = Place(name="far", position_m=(0.40, -0.30, 0.30))
WORKS = {
    "pick_place": Work(kind="pick_place", places=(NEAR, FAR_PLACE), payload_kg=2.0),
    "sort": Work(kind="sort", places=(NEAR, FAR_PLACE), payload_kg=0.5),
    "hold": Work(kind="hold", places=(NEAR,), payload_kg=3.0, dwell_s=1.0),
    "press": Work(kind="press", places=(NEAR,), payload_kg=1.0, force_n=20.0, dwell_s=1.0),
}


def table_of(top_m: float) -> Fixture:
    return Fixture(name="table", position_m=(0.45, 0.0, top_m / 2), size_m=(0.3, 1.0, top_m))


@pytest.mark.parametrize("payload_kg", [0.1, 2.0, 4.0])
@pytest.mark.parametrize("top_m", [0.0, 0.1])
def test_a_payload_is_a_ball_below_the_flange(payload_kg, top_m):
    """A hand that points down, 7 mm lower above the floor or a table than the diameter of its payload."""
    radius_m = (payload_kg / 2700.0 / (4 / 3 * np.pi)) ** (1 / 3)
    assert payload_radius_m(payload_kg) == pytest.approx(radius_m)
    arm = ArmModel(ROBOT, [table_of(top_m)] if top_m else ())
    hand = Pose(np.array([0.45, 0.0, top_m + 2 * radius_m - 0.007]), rotation((180.0, 0.0, 0.0)))
    q = InverseKinematics(arm).solve(hand, 0.0, HOME)[None]
    obstacle = "fixture 'table'" if top_m else "floor"
    checker = CollisionChecker(arm)
    assert checker.deepest_collision(q, payload_kg) == f"payload would be 7 mm inside the {obstacle}"
    assert checker.deepest_collision(q) is None


def test_a_mass_beyond_the_largest_ball_has_its_size():
    assert payload_radius_m(1e3) == 0.1
    assert payload_radius_m(0.0) == 0.0


@pytest.mark.parametrize("seed", range(5))
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
    low = table_of(0.25 - 2 * payload_radius_m(1.0) - 2 * GAP_M)
    planner = Planner(ROBOT, [low], elbows=1)
    assert planner.plan(replace(WORKS["hold"], payload_kg=1.0))
    with pytest.raises(InfeasibleJob, match=r"payload would be .* inside the fixture 'table'"):
        planner.plan(replace(WORKS["hold"], payload_kg=3.0))


@pytest.mark.parametrize("kind", KINDS)
def test_planned_motion_has_no_contact_in_mujoco(kind):
    work = WORKS[kind]
    fixtures = [
        table_of(0.25 - 2 * payload_radius_m(work.payload_kg) - 0.01),
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
