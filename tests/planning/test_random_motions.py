"""Plans through postures, random motions, and the payload rating of an arm."""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fleet.arm import random_motions as module
from fleet.arm.model import ArmModel
from fleet.arm.plan_cache import CachedPlanner
from fleet.arm.planner import Planner
from fleet.arm.random_motions import light_jobs, plan_motion, random_jobs
from fleet.errors import FleetError, InfeasibleJob
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import NODES, gen3_network, thermal_model
from fleet.job import Place, Work
from fleet.motion import RATE_HZ
from fleet.robot import GEN3, JOINTS, POSTURES, RATING, Mount, Robot, angles_deg, rotation
from scenarios.motion.hold import hold
from scenarios.prepare.oracle import peaks

NEAR = np.array([0.3, 0.1, np.pi, -2.1, 0.1, 0.9, 1.5])
FAR = np.array([-0.3, 1.0, np.pi, -0.7, 0.0, 0.9, 1.5])
ROBOT = Robot(name="arm", tool_kg=0.925)


@pytest.fixture(scope="module")
def arm():
    return ArmModel(ROBOT)


@pytest.fixture(scope="module")
def typical():
    return random_jobs(ROBOT, 150, np.random.default_rng(5))


@pytest.fixture(scope="module")
def light():
    return light_jobs(ROBOT, 80, np.random.default_rng(6))


def peaks_c(plans, ambient_c=23.0):
    return peaks(
        plans,
        [1800.0] * len(plans),
        motors=gen3_motors(),
        thermal=thermal_model(gen3_network()),
        start_c=np.full(NODES, ambient_c),
        ambient_c=ambient_c,
    )


def test_it_leaves_home_carries_between_its_places_and_comes_home_without_a_jump(arm):
    """Second method for the places: MuJoCo's own kinematics against the rotation rebuilt from the place's angles."""
    plan = plan_motion(arm, np.stack([NEAR, FAR]), dwell_s=[0.4, 1.0], payload_kg=2.0, speed=0.6)
    approach, cycle, retreat = (phase.profile for phase in plan.phases)
    q = np.concatenate([part[:, 0] for part in (approach, cycle, cycle, retreat)])
    step = np.abs(np.diff(q, axis=0)).max(axis=0)
    assert (step <= 0.6 * np.array(GEN3.velocity) / RATE_HZ + 1e-6).all()
    moved, qd = cycle[:, 0], cycle[:, 1]
    assert np.diff(moved, axis=0) * RATE_HZ == pytest.approx((qd[1:] + qd[:-1]) / 2, abs=0.01)
    assert approach[0, 0] == pytest.approx(ROBOT.home_q(), abs=1e-6)
    assert cycle[0, 0] == pytest.approx(NEAR, abs=1e-6)
    assert retreat[0, 0] == pytest.approx(NEAR, abs=1e-6)
    carried = plan.cycle.payload_kg  # from the first dwell to the last
    assert (carried[:20] == 0).all()
    assert carried[20] == 2.0
    changes = np.flatnonzero(np.diff(carried)) + 1
    assert len(changes) == 2
    assert cycle[changes[1], 0] == pytest.approx(FAR, abs=1e-6)
    assert not plan.approach.payload_kg.any()
    assert not plan.retreat.payload_kg.any()
    for place, posture in zip(plan.work.places, (NEAR, FAR), strict=True):
        position, turned = arm.tool_pose(posture)
        assert place.position_m == pytest.approx(position, abs=1e-9)
        assert rotation(place.tool_deg) == pytest.approx(turned, abs=1e-9)


def test_the_torque_is_that_of_the_motion_with_its_payload(arm):
    """Second method: run the equations of motion forwards under that torque; the acceleration is the motion's."""
    plan = plan_motion(arm, np.stack([NEAR, FAR]), dwell_s=0.3, payload_kg=2.0, speed=1.0)
    cycle = plan.cycle
    body = arm.model.body("arm/payload").id
    try:
        for i in (5, 30, 60, len(cycle.profile) - 20):
            q, qd, tau = cycle.profile[i].astype(float)
            arm.model.body_mass[body] = cycle.payload_kg[i]
            mujoco.mj_setConst(arm.model, arm.data)
            arm.data.qpos[:], arm.data.qvel[:], arm.data.qfrc_applied[:] = q, qd, tau
            mujoco.mj_forward(arm.model, arm.data)
            ahead, behind = cycle.profile[i + 1, 1], cycle.profile[i - 1, 1]
            assert arm.data.qacc == pytest.approx((ahead - behind) * RATE_HZ / 2, abs=0.6)
    finally:
        arm.model.body_mass[body] = 0.0
        arm.data.qfrc_applied[:] = 0.0
        mujoco.mj_setConst(arm.model, arm.data)


def test_one_stop_is_a_hold_under_the_gravity_of_its_load(arm):
    plan = plan_motion(arm, FAR[None], dwell_s=20.0, payload_kg=3.0, speed=1.0, name="wait")
    assert plan.work.kind == "hold"
    assert plan.cycle.duration_s == 20.0
    assert not plan.cycle.profile[:, 1].any()
    assert plan.cycle.profile[0, 2] == pytest.approx(arm.gravity_torque(FAR, 3.0), abs=1e-4)
    assert plan.work.places[0].name == "wait/stop_1"


@given(st.tuples(st.floats(-180, 180), st.floats(-180, 180) | st.sampled_from([90.0, -90.0]), st.floats(-180, 180)))
def test_angles_give_back_their_rotation(angles):
    """Peer: scipy's fixed-axes Euler angles; at a pitch of 90° roll and yaw turn about one axis."""
    turned = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    assert rotation(angles_deg(turned)) == pytest.approx(turned, abs=1e-6)


def test_what_an_arm_cannot_reach_stand_or_lift_is_refused_with_the_place(arm):
    below = np.array([0.0, 2.1, np.pi, -0.3, 0.0, 0.5, 1.5])
    with pytest.raises(InfeasibleJob, match=r"'low/stop_2': collision: .* inside the floor"):
        plan_motion(arm, np.stack([NEAR, below]), dwell_s=0.5, payload_kg=0.0, speed=1.0, name="low")
    beyond = NEAR.copy()
    beyond[3] = -2.7
    with pytest.raises(InfeasibleJob, match=r"joint limit: joint_4 would stand at -2.70 rad"):
        plan_motion(arm, beyond[None], dwell_s=5.0, payload_kg=0.0, speed=1.0)
    with pytest.raises(InfeasibleJob, match=r"torque: joint_2 needs .* with 10 kg"):
        plan_motion(arm, FAR[None], dwell_s=5.0, payload_kg=10.0, speed=1.0)


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"dwell_s": 0.0}, "dwell_s"),
        ({"dwell_s": [1.0, 1.0, 1.0]}, "dwell_s"),
        ({"speed": 0.0}, "speed"),
        ({"speed": 1.5}, "speed"),
        ({"payload_kg": -1.0}, "payload"),
        ({"payload_kg": np.nan}, "payload"),
        ({"stops": np.zeros((0, JOINTS))}, "stops"),
        ({"stops": np.full((1, JOINTS), np.nan)}, "stops"),
        ({"stops": np.zeros(JOINTS)}, "stops"),
    ],
)
def test_bad_arguments_are_named(arm, wrong, word):
    asked = {"stops": np.stack([NEAR, FAR]), "dwell_s": 1.0, "payload_kg": 0.0, "speed": 1.0} | wrong
    with pytest.raises(ValueError, match=word):
        plan_motion(arm, **asked)


def test_the_same_seed_draws_the_same_jobs_and_a_longer_draw_begins_alike(typical):
    again = random_jobs(ROBOT, 10, np.random.default_rng(5))
    for one, other in zip(typical[:10], again, strict=True):
        assert np.array_equal(one.cycle.profile, other.cycle.profile)
        assert one.work == other.work
    assert len({plan.work.places[0].name for plan in typical}) == len(typical)


def test_the_natural_mix_is_as_hot_as_the_papers(typical):
    """The mix of facts: about 36 % stay below 40 °C over 30 min, 44 % reach 40 to 60, 20 % pass 60, first joint 2."""
    highest = peaks_c(typical)
    top = highest.max(axis=1)
    # Three standard deviations of a share of 150 jobs are about 0.12.
    assert np.mean(top < 40) == pytest.approx(0.36, abs=0.12)
    assert np.mean(top >= 60) == pytest.approx(0.20, abs=0.10)
    assert (highest[top >= 60].argmax(axis=1) == 1).mean() > 0.9


def test_the_natural_mix_covers_its_payloads_and_kinds(typical):
    payload = np.array([plan.work.payload_kg for plan in typical])
    assert payload.min() < 0.3
    assert 3.7 < payload.max() <= 4.0
    assert np.mean([plan.work.kind == "hold" for plan in typical]) == pytest.approx(0.3, abs=0.12)
    speeds = np.array([plan.speed for plan in typical])
    assert 0.3 <= speeds.min() < 0.4 < 0.9 < speeds.max() <= 1.0


def test_light_motion_stays_cool_and_lies_outside_the_mix(typical, light):
    assert peaks_c(light).max() < 40.0
    assert max(plan.work.payload_kg for plan in light) <= 0.5

    def posture(plans):
        return np.array([np.median(plan.cycle.profile[:, 0], axis=0) for plan in plans])

    low, high = np.quantile(posture(typical), (0.01, 0.99), axis=0)
    outside = ((posture(light) < low) | (posture(light) > high)).any(axis=1)
    assert outside.mean() > 0.6


@settings(max_examples=5)
@given(st.sampled_from([(0.0, 0.0, 0.0), (180.0, 0.0, 0.0), (90.0, 0.0, 0.0), (0.0, 45.0, 30.0)]), st.integers(0, 99))
def test_draws_succeed_on_any_mount(tilt_deg, seed):
    robot = Robot(name="arm", mount=Mount(position_m=(0.0, 0.0, 1.0), tilt_deg=tilt_deg))
    for plan in (
        *random_jobs(robot, 2, np.random.default_rng(seed)),
        *light_jobs(robot, 2, np.random.default_rng(seed)),
    ):
        for phase in plan.phases:
            q, qd, tau = np.abs(phase.profile).max(axis=0)
            assert (tau <= np.array(GEN3.torque_clip) * (1 + 1e-6)).all()
            assert (qd <= np.array(GEN3.velocity) * (1 + 1e-6)).all()
            assert (q[[1, 3, 5]] <= (2.24, 2.57, 2.09)).all()


def test_an_arm_without_room_says_so_instead_of_drawing_for_ever(monkeypatch):
    def never(*_args, **_more):
        raise InfeasibleJob("arm", "somewhere", "collision: forearm would be 9 mm inside the floor")

    monkeypatch.setattr(module, "plan_motion", never)
    with pytest.raises(FleetError, match=r"can do 0 of \d+ random motions \(collision \d+\)"):
        random_jobs(ROBOT, 3, np.random.default_rng(0))


def test_a_negative_number_of_jobs_is_refused():
    with pytest.raises(ValueError, match=">= 0"):
        light_jobs(ROBOT, -1, np.random.default_rng(0))
    assert light_jobs(ROBOT, 0, np.random.default_rng(0)) == ()


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
    turned = tuple(
        replace(place(0.6), name=name, position_m=tuple(rotation((0.0, 0.0, deg)) @ place(0.6).position_m),
                tool_deg=(0.0, 90.0, deg))
        for name, deg in (("left", 30.0), ("right", -30.0))
    )  # fmt: skip
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
