"""Cooling: the motor of Zhu et al. by integration and closed forms, one joint, and a fleet."""

import math
from dataclasses import astuple, replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks.paper.cooling import (
    ARRANGEMENTS,
    COOLANT_C,
    LIMIT_C,
    PUBLISHED,
    STRATEGIES,
    ZHU_MOTOR,
    Arrangement,
    fit_motor,
    fleet_rows,
    joint_row,
)
from scenarios.evaluate.rollout import outcomes
from scenarios.prepare.fleet import prepare
from scenarios.spec.load import load, override

ALPHA = 0.00393
FROM_STILL_AIR = {"no_interface": 1.0, "forced_air": 2.5, "forced_water": 6.0, "immersion": 6.0}


def integrated(arrangement: Arrangement, until_s: float) -> tuple[float, float]:
    """Moment at which the winding passes 125 °C (inf if it does not), and its last temperature, by Runge-Kutta."""
    m = ZHU_MOTOR
    inner = m.bare_per_s if arrangement == "no_interface" else m.interface_per_s
    outer, direct = m.water_per_s * FROM_STILL_AIR[arrangement] / 6.0, m.direct_per_s * (arrangement == "immersion")

    def rate(_t: float, temp_c: np.ndarray) -> list[float]:
        winding, housing = temp_c
        heat = m.heating_k_per_s * (1 + ALPHA * (winding - COOLANT_C)) - direct * (winding - COOLANT_C)
        flow = inner * (winding - housing)
        return [heat - flow, (flow - outer * (housing - COOLANT_C)) / m.housing_capacity]

    def hot(_t: float, temp_c: np.ndarray) -> float:
        return temp_c[0] - LIMIT_C

    course = solve_ivp(rate, (0.0, until_s), [COOLANT_C] * 2, events=hot, rtol=1e-9, atol=1e-9)
    moments = course.t_events[0]
    return float(moments[0]) if len(moments) else math.inf, float(course.y[0, -1])


@pytest.mark.parametrize("arrangement", ARRANGEMENTS)
def test_each_way_of_cooling_is_within_ten_percent_of_the_published_figure(arrangement):
    moment_s, last_c = integrated(arrangement, 200.0)
    assert ZHU_MOTOR.limit_s(arrangement) == pytest.approx(moment_s, rel=1e-6)
    if arrangement == "immersion":
        assert moment_s == math.inf
        assert last_c == pytest.approx(PUBLISHED["immersed_c"], rel=0.1)
        assert ZHU_MOTOR.steady_c(arrangement) == pytest.approx(last_c, abs=1e-3)
    else:
        assert moment_s == pytest.approx(PUBLISHED[f"{arrangement}_s"], rel=0.1)


def test_immersion_conducts_3_7_times_what_forced_water_does():
    """The whole conductance is the copper loss at rest over the rise."""
    rise = ZHU_MOTOR.steady_c("immersion") - COOLANT_C
    immersed = ZHU_MOTOR.heating_k_per_s * (1 + ALPHA * rise) / rise
    water = 1 / (1 / ZHU_MOTOR.interface_per_s + 1 / ZHU_MOTOR.water_per_s)
    assert immersed / water == pytest.approx(3.7, rel=0.1)
    assert ZHU_MOTOR.figures() == pytest.approx(PUBLISHED, rel=0.1)


def test_without_any_conduction_the_winding_warms_exponentially():
    """Tw' = p (1 + a θ) from θ = 0 has θ = (exp(a p t) − 1)/a."""
    insulated = replace(ZHU_MOTOR, bare_per_s=1e-12)
    wanted = math.log1p(ALPHA * (LIMIT_C - COOLANT_C)) / (ALPHA * ZHU_MOTOR.heating_k_per_s)
    assert insulated.limit_s("no_interface") == pytest.approx(wanted, rel=1e-6)


def test_a_resting_motor_has_the_series_conductance():
    """At rest all heat passes interface and water: θ = p/(G − a p) with G = 1/(1/g + 1/w)."""
    series = 1 / (1 / ZHU_MOTOR.interface_per_s + 1 / ZHU_MOTOR.water_per_s)
    p = ZHU_MOTOR.heating_k_per_s
    assert ZHU_MOTOR.steady_c("forced_water") == pytest.approx(COOLANT_C + p / (series - ALPHA * p))
    assert ZHU_MOTOR.steady_c("forced_air") == math.inf  # copper loss grows faster than air carries it away


def test_the_fit_gives_the_stored_motor_and_says_what_the_figures_leave_open():
    fit = fit_motor()
    np.testing.assert_allclose(astuple(fit.motor), astuple(ZHU_MOTOR), rtol=1e-3)
    assert max(fit.relative_sd, key=lambda name: fit.relative_sd[name]) == "bare_per_s"
    assert fit.relative_sd["bare_per_s"] > 1.0 > 0.3 > fit.relative_sd["water_per_s"]


def test_a_joint_settles_lower_with_every_active_cooling_and_later_with_every_passive_one():
    rows = {each: joint_row(each) for each in STRATEGIES}
    settles = [
        rows[name]["steady_c"] or 1e3 for name in ("still_air", "heat_sink", "forced_air", "liquid", "immersion")
    ]
    assert settles == sorted(settles, reverse=True)
    for name in ("heat_sink", "heat_spreader"):
        assert (rows[name]["error_min"] or 0) > (rows["still_air"]["error_min"] or 0)
    assert rows["immersion"]["whole_w_per_k"] / rows["liquid"]["whole_w_per_k"] == pytest.approx(3.7)


@pytest.mark.ci_slow
def test_an_immersed_fleet_is_cooler_on_the_same_seeds(plans):
    rows = fleet_rows(
        override(load("active_waiting"), horizon_s=1800.0),
        [3, 4],
        policies=["round_robin"],
        strategies=("still_air", "immersion"),
        cache_dir=plans,
    )
    still, immersed = (row["figures"] for row in rows)
    assert still["peak_c"]["difference"] == 0.0
    assert immersed["peak_c"]["difference_high"] < 0.0
    assert immersed["above_warning_min"]["mean"] <= still["above_warning_min"]["mean"]
    assert immersed["value"]["mean"] >= still["value"]["mean"]


@pytest.mark.ci_slow
def test_where_people_are_near_a_careful_policy_keeps_the_surfaces_touchable(plans):
    """Margins from seeds 100 to 119: 4 minutes a shift under `thermometer`, 23 under `round_robin`, equal value."""
    fleet, seeds = prepare(load("people_near"), difficulty="blind", cache=plans), range(8)
    careful, blind = (outcomes(fleet, policy, seeds) for policy in ("thermometer", "round_robin"))
    assert np.mean([each.hot_surface_min for each in careful]) < np.mean([each.hot_surface_min for each in blind]) / 2
    assert np.mean([each.value for each in careful]) > 0.95 * np.mean([each.value for each in blind])
