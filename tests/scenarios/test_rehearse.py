"""Rehearsal: the twin learns from what stayed cool over the whole horizon, and is trained once per input."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fleet.errors import FleetError
from fleet.motion import drive
from fleet.motor import gen3_motors
from fleet.robot import JOINTS, Robot
from fleet.thermal import NODES, WINDING, drive_heat, gen3_network, thermal_model
from scenarios import rehearse
from scenarios.load import library, load
from twin.model import TwinConfig

TINY = TwinConfig(max_windows=64, epochs=2, restarts=1, hidden=4, allow_collapse=True)


@pytest.fixture
def scenario():
    return load(library()["quickstart"])


@pytest.fixture
def plans(small):
    """One arm's plans: a light, a warm and a hot work."""
    works = [small.work(f"place_{i}", payload_kg=kg) for i, kg in enumerate((small.LIGHT, small.WARM, small.HOT))]
    return small.arm(0, works).plans


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setattr(TwinConfig, "quick", classmethod(lambda cls: TINY))


def bodies(count):
    return [(Robot(name=f"arm_{i}"), gen3_motors(), thermal_model(gen3_network())) for i in range(count)]


def test_what_gets_hot_within_the_horizon_is_left_out_although_it_begins_cool(plans, scenario):
    """Second method: integrate each plan's heat over the horizon."""
    _, motors, thermal = bodies(1)[0]
    spec = scenario.twin
    cool = 0
    for variants in plans.values():
        load_ = drive(variants[0].cycle.profile, motors)

        def slope(_t, temp, load_=load_):
            heat = drive_heat(temp, load_.current_sq, load_.friction_w, motors)
            return (heat + thermal.to_ambient * spec.ambient_c - thermal.laplacian @ temp) / thermal.capacity

        run = solve_ivp(slope, (0.0, spec.horizon_s), np.full(NODES, spec.ambient_c), rtol=1e-8, atol=1e-8)
        assert run.y[WINDING, 0].max() < spec.cool_c  # every one of them begins cool
        cool += run.y[WINDING].max() <= spec.cool_c
    assert 0 < cool < len(plans)
    records = rehearse.cool_records(plans, motors, thermal, scenario)
    assert len(records) == 3 * cool  # approach, cycle, retreat
    assert all(record.shape[1:] == (3, JOINTS) for record in records)


def test_a_fleet_that_gets_hot_at_everything_is_told_what_to_change(plans, scenario, tmp_path):
    strict = replace(scenario, twin=replace(scenario.twin, cool_c=22.5))
    with pytest.raises(FleetError, match=r"arm 'arm_0' has no motion that stays below 22.5 °C .* Raise twin.cool_c"):
        rehearse.twins(strict, bodies(1), [plans], tmp_path, lambda stage, share: None)


def test_twins_are_trained_once_and_then_taken_from_the_cache(plans, scenario, tmp_path, tiny, monkeypatch):
    told = []
    first = rehearse.twins(scenario, bodies(2), [plans, plans], tmp_path, lambda *tell: told.append(tell))
    assert told[-1] == ("training", 1.0)
    assert first[0].version != first[1].version  # each arm has a seed of its own

    def never(*_args, **_more):
        raise AssertionError("trained again")

    monkeypatch.setattr(rehearse, "Parallel", never)
    again = rehearse.twins(scenario, bodies(2), [plans, plans], tmp_path, lambda *tell: None)
    assert [t.version for t in again] == [t.version for t in first]
    other = replace(scenario, twin=replace(scenario.twin, cool_c=200.0))  # hot motion is in the records as well
    with pytest.raises(AssertionError, match="trained again"):
        rehearse.twins(other, bodies(2), [plans, plans], tmp_path, lambda *tell: None)


def test_twins_do_not_depend_on_how_many_work(plans, scenario, tmp_path, tiny, monkeypatch):
    both = rehearse.twins(scenario, bodies(2), [plans, plans], tmp_path / "two", lambda *tell: None)
    monkeypatch.setattr(rehearse, "_cores", lambda: 1)
    alone = rehearse.twins(scenario, bodies(2), [plans, plans], tmp_path / "one", lambda *tell: None)
    assert [t.version for t in both] == [t.version for t in alone]


def test_a_spoilt_checkpoint_is_trained_anew_with_a_word(plans, scenario, tmp_path, tiny, caplog):
    (twin,) = rehearse.twins(scenario, bodies(1), [plans], tmp_path, lambda *tell: None)
    (stored,) = (tmp_path / "twins").iterdir()
    (stored / "twin.json").write_text("{", encoding="utf-8")
    with caplog.at_level(logging.WARNING):
        (anew,) = rehearse.twins(scenario, bodies(1), [plans], tmp_path, lambda *tell: None)
    assert "training anew" in caplog.text
    assert anew.version == twin.version
