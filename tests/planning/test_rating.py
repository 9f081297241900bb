"""Payload rating of an arm: the masses of the Gen3 user guide, by reach, by time, with tool and own limit."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.arm.model import ArmModel
from fleet.arm.plan_cache import CachedPlanner
from fleet.arm.planner import Planner
from fleet.errors import InfeasibleJob
from fleet.job import Place, Work
from fleet.robot import JOINTS, POSTURES, RATING, Robot
from scenarios.motion.hold import hold

SHOULDER_M = np.array([0.0, 0.0, 0.15643 + 0.12838])
"""Joint 2 of an upright arm, from the lengths of its first two links (5 mm beside the base axis)."""
LONG_S = 600.0


def place(reach_m: float) -> Place:
    """A place at the shoulder's height, in front of the arm."""
    x, y, z = SHOULDER_M + np.array([reach_m, 0.0, 0.0])
    return Place(name=f"{reach_m:g} m", position_m=(x, y, z), tool_deg=(0.0, 90.0, 0.0))


def hold_at(reach_m: float, payload_kg: float, dwell_s: float = LONG_S) -> Work:
    return Work(kind="hold", places=(place(reach_m),), payload_kg=payload_kg, dwell_s=dwell_s)


@pytest.fixture(scope="module")
def planner():
    return Planner(Robot(name="a"), elbows=1, speeds=(1.0,))


def test_reach_of_the_outstretched_arm_is_that_of_the_data_sheet():
    arm = ArmModel(Robot(name="a"))
    assert arm.reach_m(np.array(POSTURES["outstretched"])) == pytest.approx(0.902, abs=0.001)
    assert arm.reach_m(np.array(POSTURES["vertical"])) == pytest.approx(0.902, abs=0.001)
    q = np.random.default_rng(0).uniform(-1.5, 1.5, JOINTS)
    assert arm.reach_m(q) == pytest.approx(np.linalg.norm(arm.tool_pose(q)[0] - SHOULDER_M), abs=0.006)


def test_masses_of_the_user_guide():
    assert RATING.allowed_kg(0.3, LONG_S) == 4.0
    assert RATING.allowed_kg(0.451, LONG_S) == 4.0
    assert RATING.allowed_kg(0.902, LONG_S) == pytest.approx(1.1)
    assert RATING.allowed_kg(0.902, 60.0) == 4.5


def test_the_temporary_time_keeps_an_idle_warm_arm_below_the_warning():
    worst = hold(4.5, "outstretched", 25.0)
    assert worst.idle_warm.t60_min[1] * 60.0 > RATING.temporary_s
    assert worst.idle_warm.t60_min[1] * 60.0 < RATING.temporary_s + 15.0


@given(st.floats(0.0, 1.2), st.floats(0.0, 1.2), st.floats(0.0, 1e4), st.floats(0.0, 1e4))
def test_more_reach_and_more_time_never_allow_more(near_m, far_m, short_s, long_s):
    near_m, far_m = sorted((near_m, far_m))
    short_s, long_s = sorted((short_s, long_s))
    assert RATING.allowed_kg(far_m, long_s) <= RATING.allowed_kg(near_m, short_s)


@pytest.mark.parametrize("reach_m", [0.5, 0.6, 0.7])
def test_a_long_hold_is_feasible_up_to_the_rating_at_its_reach(planner, reach_m):
    rated_kg = 4.0 - (4.0 - 1.1) * (reach_m - 0.451) / 0.451  # a line through the two masses of the guide
    assert planner.plan(hold_at(reach_m, rated_kg - 0.05))
    with pytest.raises(InfeasibleJob) as error:
        planner.plan(hold_at(reach_m, rated_kg + 0.05))
    assert error.value.place == f"{reach_m:g} m"
    assert f"kg at {reach_m:.2f} m reach is beyond the rating of {rated_kg:.1f} kg" in error.value.reason
    assert "for more than 120 s at a time" in error.value.reason


def test_a_load_that_can_be_put_down_in_time_has_the_temporary_rating(planner):
    assert planner.plan(hold_at(0.7, 4.0, dwell_s=60.0))
    with pytest.raises(InfeasibleJob, match=r"is beyond the rating of 4\.5 kg\.$"):
        planner.plan(hold_at(0.7, 4.6, dwell_s=60.0))


def test_the_tool_counts_and_an_arm_may_have_a_lower_limit():
    tool = Planner(Robot(name="a", tool_kg=1.0), elbows=1, speeds=(1.0,))
    with pytest.raises(InfeasibleJob, match=r"rating of 3\.5 kg beside a tool of 1 kg"):
        tool.plan(hold_at(0.5, 4.0, dwell_s=60.0))
    weak = Planner(Robot(name="a", payload_limit_kg=1.5), elbows=1, speeds=(1.0,))
    assert weak.plan(hold_at(0.5, 1.5))
    with pytest.raises(InfeasibleJob, match=r"2 kg is beyond this arm's limit of 1\.5 kg"):
        weak.plan(hold_at(0.5, 2.0))


def test_a_load_that_is_carried_far_out_between_two_near_places_counts_there(planner):
    """The rating holds along the way, not only at the places: from 30° left to 30° right the tool stays as far out."""
    near = place(0.6)
    turned = tuple(
        Place(name=n, position_m=_turned(near.position_m, a), tool_deg=(0.0, 90.0, a))
        for n, a in (("left", 30.0), ("right", -30.0))
    )
    slow = Work(kind="pick_place", places=turned, payload_kg=3.5, dwell_s=130.0)
    with pytest.raises(InfeasibleJob, match="beyond the rating of 3"):
        planner.plan(slow)
    assert planner.plan(replace(slow, dwell_s=1.0))


def test_a_cached_plan_does_not_outlive_a_lower_limit(tmp_path):
    arm, work = Robot(name="a"), hold_at(0.5, 2.0)
    assert CachedPlanner(arm, elbows=1, cache_dir=tmp_path).plan(work)
    with pytest.raises(InfeasibleJob, match="this arm's limit"):
        CachedPlanner(replace(arm, payload_limit_kg=1.0), elbows=1, cache_dir=tmp_path).plan(work)


def test_a_heavier_tool_than_the_rating_is_refused():
    with pytest.raises(ValueError, match=r"Robot\.tool_kg must be at most 4\.5"):
        Robot(name="a", tool_kg=4.6)


def _turned(position_m, degrees):
    x, y, z = position_m
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return (c * x - s * y, s * x + c * y, z)
