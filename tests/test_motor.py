"""The motor law against numbers worked by hand, published ratios and its own symmetries."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.heat.motor import (
    copper_loss,
    current,
    friction_heat,
    friction_torque,
    gen3_motors,
    magnet_factor,
    reference_current,
    stack_motors,
)
from fleet.robot import JOINTS

REST = np.zeros(JOINTS)
MOTORS = gen3_motors()

torques = st.floats(-100.0, 100.0)
speeds = st.floats(-2.5, 2.5)
temperatures = st.floats(-20.0, 120.0)


def test_published_torque_per_amp_is_11_and_7_6():
    # N·Kt of the large and small actuators, Kinova's values as quoted by HBRS-SDP/joint-friction-model.
    np.testing.assert_allclose(MOTORS.torque_per_amp, [11.0] * 4 + [7.6] * 3, rtol=1e-12)


@pytest.mark.parametrize(
    ("tau_nm", "amps"), [(23.5, 2.30), (33.2, 3.25), (41.2, 4.03), (50.1, 4.89), (58.9, 5.76), (8.7, 0.85)]
)
def test_holding_current_of_joint_2_as_published(tau_nm, amps):
    # Scenario check of the identification report: holding torque and current of joint 2 at 25 °C.
    held = current(np.full(JOINTS, tau_nm), REST, np.full(JOINTS, 25.0), MOTORS)
    assert held[1] == pytest.approx(amps, abs=0.01)


def test_moving_a_load_against_friction_by_hand():
    # Joint 1: (20/0.93 + 4.4·tanh(50) + 2.2·1.0) / 11 A, and 4.4 W + 2.2 W of friction at 1 rad/s.
    speed = np.ones(JOINTS)
    assert reference_current(np.full(JOINTS, 20.0), speed, MOTORS)[0] == pytest.approx((20 / 0.93 + 6.6) / 11)
    assert friction_heat(speed, MOTORS)[0] == pytest.approx(6.6)
    assert friction_heat(speed, MOTORS)[6] == pytest.approx(1.3 + 0.9)


def test_no_friction_at_rest():
    np.testing.assert_array_equal(friction_torque(REST, MOTORS), REST)


@given(speeds)
def test_friction_is_odd_and_its_heat_never_negative(qd):
    speed = np.full(JOINTS, qd)
    np.testing.assert_allclose(friction_torque(-speed, MOTORS), -friction_torque(speed, MOTORS))
    assert np.all(friction_heat(speed, MOTORS) >= 0)


@given(torques, speeds, temperatures)
def test_current_turns_sign_with_torque_and_speed(tau, qd, housing_c):
    load, speed, warm = np.full(JOINTS, tau), np.full(JOINTS, qd), np.full(JOINTS, housing_c)
    np.testing.assert_allclose(current(-load, -speed, warm, MOTORS), -current(load, speed, warm, MOTORS))


@given(temperatures, st.floats(0.1, 50.0))
def test_hotter_magnets_need_more_current(housing_c, by_k):
    load, warm = np.full(JOINTS, 30.0), np.full(JOINTS, housing_c)
    assert np.all(current(load, REST, warm + by_k, MOTORS) > current(load, REST, warm, MOTORS))


def test_magnets_lose_one_percent_in_nine_kelvin():
    # -0.11 %/K, the usual figure for neodymium.
    np.testing.assert_allclose(magnet_factor(np.full(JOINTS, 25.0 + 1 / 0.11), MOTORS), 0.99, rtol=1e-12)


def test_copper_resistance_rises_39_percent_in_100_kelvin():
    amps_sq = np.full(JOINTS, 4.0)
    hot, cold = (copper_loss(amps_sq, np.full(JOINTS, c), MOTORS) for c in (125.0, 25.0))
    np.testing.assert_allclose(cold, [1.64] * 4 + [1.36] * 3)
    np.testing.assert_allclose(hot / cold, 1.393)


@given(st.floats(0.01, 2.0), st.floats(0.001, 2.0))
def test_wear_increases_friction(wear, qd):
    speed = np.full(JOINTS, qd)
    worn = gen3_motors(wear=wear)
    np.testing.assert_allclose(friction_heat(speed, worn), (1 + wear) * friction_heat(speed, MOTORS))
    assert np.all(reference_current(REST, speed, worn) > reference_current(REST, speed, MOTORS))


def test_stacked_arms_keep_their_own_numbers():
    worn = gen3_motors(wear=0.5)
    both = stack_motors([MOTORS, worn])
    speed = np.full((2, JOINTS), 0.7)
    np.testing.assert_array_equal(friction_torque(speed, both)[0], friction_torque(speed[0], MOTORS))
    np.testing.assert_array_equal(friction_torque(speed, both)[1], friction_torque(speed[1], worn))


def test_stacking_refuses_arms_with_different_constants():
    with pytest.raises(ValueError, match="alpha_cu_per_k"):
        stack_motors([MOTORS, replace(MOTORS, alpha_cu_per_k=0.004)])
    with pytest.raises(ValueError, match="at least one arm"):
        stack_motors([])


@pytest.mark.parametrize(
    ("name", "value"),
    [("torque_per_amp", REST), ("eta", np.full(JOINTS, np.nan)), ("v0_rad_s", 0.0), ("idle_w", np.full(JOINTS, -1.0))],
)
def test_impossible_motors_are_refused(name, value):
    with pytest.raises(ValueError, match=f"Motors.{name}"):
        replace(MOTORS, **{name: value})
