"""A performed plan against the stiffness of the servos, the plan itself, and the heat of another plant."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.arm.model import ArmModel
from fleet.arm.random_motions import plan_motion, random_jobs
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import NODES, gen3_network, thermal_model
from fleet.motion import RATE_HZ, Phase
from fleet.robot import Robot
from scenarios.motion.generate import bare_arm, perform
from scenarios.prepare.arms import peaks

ROBOT = Robot(name="arm", tool_kg=0.9)
ARM = bare_arm(ROBOT, gen3_motors(), thermal_model(gen3_network()))
MODEL = ArmModel(ROBOT)
STIFFNESS = np.array([2000.0] * 4 + [500.0] * 3)
"""Of the servos, N·m/rad (fleet/arm/assets/gen3.xml)."""
COLD_C = np.full(NODES, 23.0)
REACHING = np.array([0.3, 0.8, np.pi, -1.2, 0.0, 0.9, 1.57])


def hold(seconds=8.0, payload_kg=0.0):
    return plan_motion(MODEL, REACHING[None], dwell_s=seconds, payload_kg=payload_kg, speed=0.6)


def test_what_is_measured_is_what_was_planned():
    plan = random_jobs(ROBOT, 1, np.random.default_rng(4))[0]
    done = perform(ARM, plan, start_c=COLD_C, ambient_c=23.0)
    assert done.error_rad < 1e-3
    assert not done.clipped
    measured = done.as_plan()
    for phase, planned in zip(measured.phases, plan.phases, strict=True):
        np.testing.assert_allclose(phase.profile[:, 0], planned.profile[:, 0], atol=1e-3)
        np.testing.assert_array_equal(phase.payload_kg, planned.payload_kg)


def test_an_arm_sags_by_the_torque_it_does_not_know_of_over_its_stiffness():
    plan = hold()
    hidden_kg = 0.4
    loaded = replace(plan, cycle=Phase(plan.cycle.profile, np.full_like(plan.cycle.payload_kg, hidden_kg)))
    done = perform(ARM, loaded, start_c=COLD_C, ambient_c=23.0)
    settled = round((plan.approach.duration_s + 6.0) * RATE_HZ)
    sag = done.profile[settled, 0] - done.planned[settled, 0]
    missing = MODEL.gravity_torque(REACHING, hidden_kg) - MODEL.gravity_torque(REACHING)
    np.testing.assert_allclose(sag, -missing / STIFFNESS, atol=2e-4)
    assert done.error_rad > 1e-3


def test_more_than_a_servo_has_is_seen():
    plan = hold()
    crushed = replace(plan, cycle=Phase(plan.cycle.profile, np.full_like(plan.cycle.payload_kg, 40.0)))
    assert perform(ARM, crushed, start_c=COLD_C, ambient_c=23.0).clipped


def test_motors_heat_as_the_law_says_of_the_planned_torque():
    plan = hold(120.0, payload_kg=3.0)
    done = perform(ARM, plan, start_c=COLD_C, ambient_c=23.0, tick_s=2.0)
    np.testing.assert_array_equal(done.temp_c[0], COLD_C[:7])
    np.testing.assert_allclose(np.diff(done.time_s), 2.0)
    arrived = round(plan.approach.duration_s / 2.0)
    held = peaks([plan], [120.0], motors=ARM.motors, thermal=ARM.thermal, start_c=COLD_C, ambient_c=23.0)[0]
    np.testing.assert_allclose(done.temp_c[arrived + 60], held, atol=0.4)
    assert held[1] - 23.0 > 10.0


def test_no_limit_stops_an_arm_that_is_watched():
    hot_c = np.full(NODES, 90.0)
    done = perform(ARM, hold(3.0), start_c=hot_c, ambient_c=23.0)
    assert done.error_rad < 1e-3
    assert done.temp_c[-1].max() == pytest.approx(90.0, abs=2.0)
