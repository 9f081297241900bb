"""Insulation ageing, drift of the tool point, burns and housings: closed forms, sources, geometry of MuJoCo."""

from itertools import pairwise
from math import fsum

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.integrate import simpson, solve_ivp

from fleet.arm.cell import cell_model
from fleet.arm.model import ArmModel
from fleet.engine.shift import initial, step
from fleet.heat.effects import (
    ACTIVATION_K,
    ALUMINIUM_PER_K,
    GEN3_SEGMENTS_M,
    HALVING_K,
    RATED_C,
    RATED_LIFE_H,
    SEGMENTS,
    arrhenius_rate,
    burn_threshold_c,
    life_used,
    most_drift_m,
    seconds_above,
    segment_temperatures,
    surface_c,
)
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import HOUSING, NODES, WINDING, gen3_network, housing_observer, thermal_model
from fleet.robot import JOINTS, Mount, Robot
from scenarios.run.metrics import HeatUse

ARM = Robot(name="arm", mount=Mount())


def test_a_winding_at_the_temperature_of_its_class_lasts_its_rated_life() -> None:
    rate = arrhenius_rate(RATED_C)
    assert life_used(rate, rate, 3600.0 * RATED_LIFE_H) == pytest.approx(1.0)
    assert arrhenius_rate(RATED_C + HALVING_K) == pytest.approx(2.0)


def test_far_below_the_class_ageing_is_slower_than_by_the_rule_of_ten_kelvin() -> None:
    """Montsinger's rule: the life halves with every 10 K. The interval of Arrhenius is about E⁻¹ k T² ln 2: 6 K."""
    cool_c = np.linspace(20.0, 150.0, 14)
    assert (arrhenius_rate(cool_c) < np.exp2((cool_c - RATED_C) / HALVING_K)).all()
    interval_k = np.log(2) * 333.15**2 / ACTIVATION_K
    assert arrhenius_rate(60.0 + interval_k) / arrhenius_rate(60.0) == pytest.approx(2.0, rel=0.02)


def test_an_exponential_rise_of_the_rate_is_integrated_to_the_closed_form() -> None:
    """A rate that doubles every 10 K along a linear rise of 1 K/min from 60 to 120 °C: ∫ 2^((T − T₀)/10) dt."""
    time_s = np.arange(0.0, 3601.0, 10.0)
    rate = np.exp2((60.0 + time_s / 60.0 - RATED_C) / 10.0)
    used = sum(life_used(one, two, 10.0) for one, two in pairwise(rate))
    exact_s = 600.0 / np.log(2) * (rate[-1] - rate[0])
    assert used * 3600.0 * RATED_LIFE_H == pytest.approx(exact_s, rel=1e-4)


def anchors_m(arm: ArmModel, q: np.ndarray) -> np.ndarray:
    """Base, joints 1..7 and flange in the world, from MuJoCo, m, [point, 3]."""
    arm.tool_pose(q)  # puts the model into this posture
    flange = arm.data.body("arm/payload").xpos
    return np.vstack([np.zeros(3), [arm.data.body(arm.model.jnt_bodyid[j]).xpos for j in range(JOINTS)], flange]).copy()


def test_the_segments_have_the_lengths_of_the_model() -> None:
    model = cell_model([ARM])
    offsets = [link["position"] for link in model["links"] if link["turns"]] + [model["hand"]["position"]]
    assert np.linalg.norm(offsets, axis=1) == pytest.approx(GEN3_SEGMENTS_M, abs=1e-5)


def test_the_drift_is_that_of_a_model_with_longer_links() -> None:
    """Second method: MuJoCo with the position of every body scaled by its expansion; the bound holds in any posture."""
    rng = np.random.default_rng(3)
    cold, warm = ArmModel(ARM), ArmModel(ARM)
    rise_k = rng.uniform(0.0, 40.0, SEGMENTS)
    bodies = [*warm.model.jnt_bodyid, warm.model.body("arm/payload").id]
    for body, rise in zip(bodies, rise_k, strict=True):
        warm.model.body_pos[body] *= 1.0 + ALUMINIUM_PER_K * rise
    for q in rng.uniform(-np.pi, np.pi, (20, JOINTS)):
        before = anchors_m(cold, q)
        moved = anchors_m(warm, q)[-1] - before[-1]
        assert ALUMINIUM_PER_K * rise_k @ np.diff(before, axis=0) == pytest.approx(moved, abs=1e-9)
        assert np.linalg.norm(moved) <= most_drift_m(rise_k) + 1e-9
    stretched = anchors_m(warm, np.zeros(JOINTS))[-1] - anchors_m(cold, np.zeros(JOINTS))[-1]
    assert np.linalg.norm(stretched) == pytest.approx(most_drift_m(rise_k), rel=0.01)


def test_a_segment_has_the_mean_temperature_of_its_ends_and_a_warm_arm_grows_like_a_rod() -> None:
    segments_c = segment_temperatures(np.full((5, JOINTS), 45.0))
    assert segments_c.shape == (5, SEGMENTS)
    assert most_drift_m(segments_c - 25.0) == pytest.approx(23.6e-6 * 20.0 * sum(GEN3_SEGMENTS_M))
    segments_c = segment_temperatures(np.arange(20.0, 90.0, 10.0))
    assert segments_c.tolist() == [20.0, 25.0, 35.0, 45.0, 55.0, 65.0, 75.0, 80.0]


def test_the_heat_of_a_shift_is_that_of_its_most_aged_winding_and_of_the_largest_drift() -> None:
    """An arm that warms up and cools down again along a line; the integral by a second method, Simpson's rule."""
    shape, steps, dt_s = np.array([1.0, 0.5]), 360, 10.0
    course = 30.0 * np.interp(np.arange(steps + 1), (0, steps // 2, steps), (0.0, 1.0, 0.0))
    temp_c = np.empty((steps + 1, 2, NODES))  # two arms, the second one half as warm
    temp_c[..., WINDING] = 40.0 + 1.5 * course[:, None, None] * shape[:, None] * np.linspace(0.2, 1.0, JOINTS)
    temp_c[..., HOUSING] = 40.0 + course[:, None, None] * shape[:, None]
    heat = HeatUse(temp_c[0], burn_c=65.0)
    heat.add(temp_c[1:100], dt_s)
    heat.add(temp_c[100:], dt_s)
    used_h = simpson(arrhenius_rate(temp_c[..., JOINTS - 1]), dx=dt_s, axis=0) / 3600.0
    assert heat.insulation_ppb == pytest.approx(1e9 * used_h / RATED_LIFE_H, rel=1e-3)
    assert heat.tool_drift_mm == pytest.approx(1e3 * 23.6e-6 * 30.0 * shape * sum(GEN3_SEGMENTS_M))


TEMPERATURES = st.floats(20.0, 80.0)


@pytest.mark.parametrize(("contact_s", "burn_c"), [(1.0, 65.0), (60.0, 51.0), (600.0, 48.0), (28800.0, 43.0)])
def test_uncoated_metal_has_the_thresholds_of_the_standard(contact_s, burn_c):
    """DIN EN 563, quoted in BGV D34 § 12: 1 s 65 to 70 °C, 1 min 51, 10 min 48, 8 h 43."""
    assert burn_threshold_c(contact_s) == pytest.approx(burn_c)


@given(st.floats(1.0, 28800.0), st.floats(1.0, 28800.0))
def test_a_longer_contact_burns_at_a_lower_temperature(one, other):
    assert burn_threshold_c(min(one, other)) >= burn_threshold_c(max(one, other))


@pytest.mark.parametrize("contact_s", [0.5, 28801.0, float("nan")])
def test_other_contact_times_have_no_value(contact_s):
    with pytest.raises(ValueError, match=r"between 1 and 28800 s \(got"):
        burn_threshold_c(contact_s)


@given(TEMPERATURES, TEMPERATURES, TEMPERATURES)
def test_the_time_above_a_limit_is_that_of_a_straight_line(before_c, after_c, limit_c):
    assume(before_c == after_c or abs(before_c - after_c) > 1e-6)  # else rounding moves the points of the line
    course = np.linspace(before_c, after_c, 20_001)
    wanted = 10.0 * np.mean(course > limit_c)
    assert seconds_above(np.array(before_c), np.array(after_c), limit_c, 10.0) == pytest.approx(wanted, abs=0.01)


def test_surfaces_are_housings_and_their_hot_minutes_add_up():
    """A housing that rises by 1 K a minute from 40 °C to 60 °C is above 48 °C for 12 minutes."""
    temp_c = np.full((2, 2 * JOINTS), 40.0)
    temp_c[:, :JOINTS] = 90.0  # windings, which nobody can touch
    heat = HeatUse(temp_c, 48.0)
    for minute in range(1, 21):
        temp_c = temp_c.copy()
        temp_c[1, JOINTS + 2] = 40.0 + minute
        heat.add(temp_c[None], 60.0)
    np.testing.assert_allclose(heat.hot_surface_min, [0.0, 12.0])
    np.testing.assert_allclose(heat.surface_c, [40.0, 60.0])
    np.testing.assert_allclose(surface_c(temp_c), [40.0, 60.0])


def test_hot_minutes_add_up_in_float64_also_of_temperatures_in_float32():
    """720 times through the limit; the sum by a second method, of exact sums."""
    course_c = np.random.default_rng(1).uniform(46.0, 50.0, 721).astype(np.float32)
    heat = HeatUse(np.full((1, 2 * JOINTS), course_c[0], np.float32), 48.0)
    heat.add(np.broadcast_to(course_c[1:, None, None], (720, 1, 2 * JOINTS)), 10.0)
    each_s = seconds_above(course_c[:-1].astype(float), course_c[1:].astype(float), 48.0, 10.0)
    np.testing.assert_allclose(heat.hot_surface_min, fsum(each_s) / 60.0, rtol=1e-13)


MOTORS, THERMAL = gen3_motors(), thermal_model(gen3_network())


@pytest.mark.parametrize("dt_s", [1.0, 10.0, 400.0])
def test_a_step_solves_the_heat_balance_of_the_housings(dt_s) -> None:
    rng = np.random.default_rng(0)
    motor_c, housing_c, friction_w = rng.uniform(30, 60, 7), rng.uniform(25, 45, 7), rng.uniform(0, 3, 7)

    def slope(_, temp_c):
        heat = -THERMAL.laplacian[HOUSING, HOUSING] @ temp_c - THERMAL.laplacian[HOUSING, WINDING] @ motor_c
        return (heat + THERMAL.to_ambient[HOUSING] * 22.0 + MOTORS.idle_w + friction_w) / THERMAL.capacity[HOUSING]

    exact = solve_ivp(slope, (0.0, dt_s), housing_c, rtol=1e-10, atol=1e-10).y[:, -1]
    estimate = housing_observer(THERMAL, MOTORS, dt_s).step(housing_c, motor_c, 22.0, friction_w)
    assert estimate == pytest.approx(exact, abs=1e-6)


def test_an_arm_that_knows_itself_estimates_its_housings(small) -> None:
    """The true network, from a start that is 8 K wrong; the error decays with the time constants of the housings."""
    content = small.work(payload_kg=3.0)
    world, plant = small.shop([[small.job("a", content, repetitions=900)]], arms=1, ticks=1000)
    state = initial(world)
    state.housing_c[:] += 8.0
    errors = []
    for tick in range(world.ticks):
        state = step(world, state, np.array([[int(tick == 0)]]), plant).state
        errors.append(np.abs(state.housing_c[0, 0] - state.temp_c[0, 0, HOUSING]).max())
    assert errors[0] > 7.0
    assert errors[-1] < 0.3
    assert state.temp_c[0, 0, HOUSING].max() > 27.0  # they warmed meanwhile
