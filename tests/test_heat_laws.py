"""Insulation ageing and drift of the tool point: closed forms, bounds, and the geometry of MuJoCo."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import simpson

from fleet.arm.cell import cell_model
from fleet.arm.model import ArmModel
from fleet.heat.effects import (
    ACTIVATION_K,
    ALUMINIUM_PER_K,
    GEN3_SEGMENTS_M,
    HALVING_K,
    RATED_C,
    RATED_LIFE_H,
    SEGMENTS,
    arrhenius_rate,
    life_used,
    most_drift_m,
    segment_temperatures,
)
from fleet.heat.thermal import HOUSING, NODES, WINDING
from fleet.robot import JOINTS, Mount, Robot
from scenarios.run.metrics import HeatUse

ARM = Robot(name="arm", mount=Mount())


def test_a_winding_at_the_temperature_of_its_class_lasts_its_rated_life() -> None:
    rate = arrhenius_rate(RATED_C)
    assert life_used(rate, rate, 3600.0 * RATED_LIFE_H) == pytest.approx(1.0)
    assert arrhenius_rate(RATED_C + HALVING_K) == pytest.approx(2.0)


def test_the_activation_energy_is_in_the_range_of_insulating_materials() -> None:
    """0.8 to 1.3 eV for enamels and resins (Dakin 1948 gives 1.0 eV for class A); k = 8.617e-5 eV/K."""
    activation_ev = ACTIVATION_K * 8.617333262e-5
    assert activation_ev == pytest.approx(1.12, abs=0.01)


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


def test_a_uniformly_warm_arm_grows_like_a_rod() -> None:
    segments_c = segment_temperatures(np.full((5, JOINTS), 45.0))
    assert segments_c.shape == (5, SEGMENTS)
    assert most_drift_m(segments_c - 25.0) == pytest.approx(23.6e-6 * 20.0 * sum(GEN3_SEGMENTS_M))


def test_a_segment_has_the_mean_temperature_of_its_ends() -> None:
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
    for after_c in temp_c[1:]:
        heat.add(after_c, dt_s)
    used_h = simpson(arrhenius_rate(temp_c[..., JOINTS - 1]), dx=dt_s, axis=0) / 3600.0
    assert heat.insulation_ppb == pytest.approx(1e9 * used_h / RATED_LIFE_H, rel=1e-3)
    assert heat.tool_drift_mm == pytest.approx(1e3 * 23.6e-6 * 30.0 * shape * sum(GEN3_SEGMENTS_M))
