"""Fixtures of a scenario, from the file to plans, homes, contacts and the figures of a run."""

from dataclasses import replace

import pytest

from fleet.arm.cell import ContactFinder
from fleet.errors import ScenarioError
from fleet.events import Event
from fleet.job import Fixture
from scenarios.cell_layout import cell_of
from scenarios.cli.run import metrics_table
from scenarios.prepare.fleet import prepare
from scenarios.run.shift import run
from scenarios.spec.load import load
from scenarios.spec.options import RunSpec
from scenarios.spec.parse import override
from scenarios.spec.schema import Scenario


@pytest.fixture
def small(small_toml) -> Scenario:
    return load(small_toml)


def test_a_fixture_of_the_file_is_in_the_cell(small):
    written = {"name": "oven", "position_m": (0.0, 1.0, 0.5), "size_m": (0.4, 0.4, 1.0)}
    scenario = override(small, fixtures=(written,))
    assert scenario.fixtures == (Fixture(name="oven", position_m=(0.0, 1.0, 0.5), size_m=(0.4, 0.4, 1.0)),)
    assert cell_of(scenario).fixtures == scenario.fixtures


def test_all_arms_whose_home_is_inside_a_fixture_are_named(small, tmp_path):
    beam = Fixture(name="beam", position_m=(0.0, 0.0, 0.4), size_m=(2.0, 0.1, 0.3))
    with pytest.raises(ScenarioError) as error:
        prepare(replace(small, fixtures=(beam,)), difficulty="blind", cache=tmp_path)
    said = str(error.value).splitlines()
    for arm, line in zip(("arms[0] 'left'", "arms[1] 'right'"), said, strict=False):
        assert f"{arm} at home: " in line
        assert "mm inside the fixture 'beam'; move the arm or the fixture" in line


def test_work_that_no_arm_can_do_for_a_fixture_is_refused_with_the_reason(small, tmp_path):
    crate = Fixture(name="crate", position_m=(0.0, 0.2, 0.2), size_m=(0.1, 0.1, 0.1))
    with pytest.raises(ScenarioError, match=r"left at 'bench': collision: .* inside the fixture 'crate' on the way"):
        prepare(replace(small, fixtures=(crate,)), difficulty="blind", cache=tmp_path)


@pytest.mark.parametrize("plant", ["profile", "mujoco"])
def test_contacts_are_counted_by_the_plant_that_finds_them(small, plans, plant, monkeypatch):
    """One contact in every step, made up."""
    touch = Event(time_s=1.0, kind="contact", arm="left", value=3.0)
    monkeypatch.setattr(ContactFinder, "events", lambda *_: [touch])
    fleet = prepare(override(small, horizon_s=60.0), difficulty="blind", cache=plans)
    result = run(fleet, RunSpec(policy="round_robin", plant=plant, bus="memory", difficulty="blind"), record=False)
    steps = 6 if plant == "mujoco" else 0
    assert result.metrics.contacts == (steps or None)
    assert result.events.count(touch) == steps
    figures = [row[0] for row in metrics_table({"round_robin": result.metrics}).rows]
    assert ("contacts" in figures) == (plant == "mujoco")
