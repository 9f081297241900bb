"""Space of a cell: conflicts of plans against MuJoCo's distances, plans against homes, and the cache."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from fleet.arm import space
from fleet.arm.model import build_cell
from fleet.arm.planner import Planner
from fleet.arm.space import collisions_of_homes, conflicts_with_homes, space_table
from fleet.job import Place, Work
from fleet.robot import Mount, Robot

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
