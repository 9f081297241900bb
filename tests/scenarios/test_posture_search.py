"""The parts of the search, each against the true law: heat while holding, the hidden housings, and the ranking."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import spearmanr

from fleet.arm.model import ArmModel
from fleet.heat.motor import gen3_motors, reference_current
from fleet.heat.thermal import (
    HOUSING,
    WINDING,
    advance,
    drive_heat,
    gen3_network,
    simulate_temperatures,
    steady_state,
    thermal_model,
)
from fleet.motion import static_drive
from scenarios.motion.recover import Nearby, holding, housing_estimate

MOTORS, THERMAL = gen3_motors(), thermal_model(gen3_network())
Q = np.deg2rad([0.0, 60.0, 180.0, -60.0, 0.0, 55.0, 90.0])


def simulated(start_c, tau, motors, thermal, seconds):
    """Winding temperatures after holding a torque in 23 °C."""
    drive = static_drive(tau, motors)
    done = simulate_temperatures(drive, [seconds], motors=motors, thermal=thermal, start_c=start_c, ambient_c=23.0)
    return done.end_c[0, WINDING]


def test_a_long_hold_ends_where_it_settles():
    tau = np.array([0.0, -30.0, 0.0, 15.0, 0.0, 5.0, 0.0])
    temps = simulated(np.full(14, 23.0), tau, MOTORS, THERMAL, 40 * 3600.0)
    end_c = steady_state(THERMAL, reference_current(tau, np.zeros(7), MOTORS) ** 2, np.zeros(7), MOTORS, 23.0)
    assert end_c is not None
    np.testing.assert_allclose(temps, end_c[WINDING], atol=0.05)


def held(temp_c, tau, seconds):
    """The true temperatures of all nodes after holding so long."""
    steps = max(1, round(seconds))
    phi, gamma = THERMAL.step_matrices(seconds / steps)
    current_sq = reference_current(tau, np.zeros(7), MOTORS) ** 2
    for _ in range(steps):
        heat_w = drive_heat(temp_c, current_sq, np.zeros(7), MOTORS)
        temp_c = advance(temp_c, heat_w, 23.0, phi, gamma, THERMAL.to_ambient)
    return temp_c


@settings(max_examples=10)
@given(st.floats(0.0, 2400.0), st.floats(15.0, 45.0))
def test_hidden_housings_follow_from_how_fast_windings_warm(seconds, load_nm):
    tau = np.array([1.0, -load_nm, 1.0, 0.4 * load_nm, 0.5, 4.0, 0.0])
    before = held(np.full(14, 23.0), tau, seconds)
    now = held(before, tau, 30.0)
    guess_c = housing_estimate(before[WINDING], now[WINDING], 30.0, tau, MOTORS, THERMAL, 23.0)
    middle_c = 0.5 * (before[HOUSING] + now[HOUSING])
    # Over 30 s the mean of an exponential with 70 s lies 3.6 % of its rise above the mean of its ends.
    rise_k = np.abs(now[WINDING] - before[WINDING]).max()
    np.testing.assert_allclose(guess_c, middle_c, atol=0.04 * rise_k + 0.1)


def test_without_the_rate_housings_would_come_out_too_cold():
    """What the watching is for: the same formula with windings that do not warm."""
    tau = np.array([1.0, -30.0, 1.0, 12.0, 0.5, 4.0, 0.0])
    before = held(np.full(14, 23.0), tau, 300.0)
    now = held(before, tau, 30.0)
    blind_c, seen_c = (
        housing_estimate(first, now[WINDING], 30.0, tau, MOTORS, THERMAL, 23.0)
        for first in (now[WINDING], before[WINDING])
    )
    true_c = now[HOUSING][1]
    assert blind_c[1] == pytest.approx(23.0)
    assert seen_c[1] == pytest.approx(true_c, abs=0.5)
    assert true_c > 24.5


def test_the_hottest_motors_torque_error_ranks_postures_as_their_heat_does(subject):
    rng = np.random.default_rng(0)
    model = ArmModel(subject.arm.robot)
    near = Q + rng.uniform(-0.6, 0.6, (60, 7))
    error = holding(subject.twin, model, near, 3.0).one_sided[:, 1]
    start_c = np.full(14, 50.0)
    arm = subject.arm
    end_c = [simulated(start_c, model.gravity_torque(q, 3.0), arm.motors, arm.thermal, 600.0)[1] for q in near]
    assert spearmanr(error, end_c).statistic > 0.9


def test_more_payload_is_never_easier_for_the_shoulder(subject):
    model = ArmModel(subject.arm.robot)
    loads = [float(holding(subject.twin, model, Q[None], kg).one_sided[0, 1]) for kg in (1.0, 2.0, 3.0, 4.0)]
    assert np.all(np.diff(loads) > 0)


@pytest.mark.parametrize("changes", [{"joint_rad": 0.0}, {"tool_m": -1.0}, {"candidates": 0}, {"speed": 1.5}])
def test_nearby_is_somewhere(changes):
    with pytest.raises(ValueError, match=rf"Nearby.{next(iter(changes))} must be"):
        Nearby(**changes)
