"""`thermofleet cooling`: published figures, one joint, and a fleet that must be no worse for better cooling."""

import json

import numpy as np
import pytest

from scenarios.evaluate.rollout import outcomes
from scenarios.load import load
from scenarios.prepare.fleet import prepare
from scenarios.studies.heat.cooling import STRATEGIES, fleet_rows, joint_rows, motor_rows


def test_every_published_figure_is_met_within_ten_percent():
    rows = motor_rows()
    assert [row.published for row in rows] == [3.6, 10.69, 11.59, 85.0, 3.7]
    assert max(abs(row.deviation) for row in rows) < 0.1


def test_a_joint_settles_lower_with_every_active_cooling_and_later_with_every_passive_one():
    rows = {row.cooling: row for row in joint_rows()}
    assert tuple(rows) == STRATEGIES
    settles = [rows[name].steady_c or 1e3 for name in ("still_air", "heat_sink", "forced_air", "liquid", "immersion")]
    assert settles == sorted(settles, reverse=True)
    for name in ("heat_sink", "heat_spreader"):
        assert (rows[name].error_min or 0) > (rows["still_air"].error_min or 0)
    assert rows["immersion"].whole_w_per_k / rows["liquid"].whole_w_per_k == pytest.approx(3.7)


def test_an_immersed_fleet_is_cooler_on_the_same_seeds(small_toml, plans):
    rows = fleet_rows(
        load(small_toml), seeds=[3, 4], policies=["round_robin"], strategies=("still_air", "immersion"), cache_dir=plans
    )
    still, immersed = (row.figures for row in rows)
    assert still["peak_c"].difference == 0.0
    assert immersed["peak_c"].difference_high < 0.0
    assert immersed["above_warning_min"].mean <= still["above_warning_min"].mean
    assert immersed["value"].mean >= still["value"].mean


def test_where_people_are_near_a_careful_policy_keeps_the_surfaces_touchable(plans):
    """Margins from seeds 100 to 119: 4 minutes a shift under `thermometer`, 23 under `round_robin`, equal value."""
    fleet, seeds = prepare(load("people_near"), difficulty="blind", cache=plans), range(8)
    careful, blind = (outcomes(fleet, policy, seeds) for policy in ("thermometer", "round_robin"))
    assert np.mean([each.hot_surface_min for each in careful]) < np.mean([each.hot_surface_min for each in blind]) / 2
    assert np.mean([each.value for each in careful]) > 0.95 * np.mean([each.value for each in blind])


def test_the_command_prints_the_tables_or_json(thermofleet):
    said = thermofleet("cooling", "--no-fleet", "--fit")
    assert said.code == 0
    assert all(word in said.out for word in ("motor of Zhu et al.", "11.59", "immersion", "relative sd", "core"))
    data = json.loads(thermofleet("cooling", "--no-fleet", "--json").out)
    assert data["limits"]["core"] == {"lower_c": 0.0, "warning_c": 80.0, "error_c": 90.0, "upper_c": 100.0}
    assert [row["cooling"] for row in data["joint"]] == list(STRATEGIES)
    assert data["fleet"] == []
