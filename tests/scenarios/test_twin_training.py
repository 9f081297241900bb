"""Twins of a scenario: rehearsed, calibrated, and trained on what stays cool."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fleet.difficulty import Blind
from fleet.errors import FleetError
from fleet.motion import drive
from fleet.robot import ThermalLimits
from scenarios.evaluate.sources import PlannedFleet
from scenarios.motion.recover import known_arm
from scenarios.prepare.arms import PlannedArm, air_offsets, hardware_of, plan_arms
from scenarios.prepare.calibrate import calibrate_networks, simulate_past
from scenarios.prepare.twins import cold_peaks, quality, train_arms, train_twin, train_twins
from scenarios.progress import quiet
from scenarios.run.log import provenance
from scenarios.spec.jobs import rehearsal_works
from scenarios.spec.load import load
from scenarios.spec.parse import override
from scenarios.spec.schema import Scenario
from twin.thermal.identify import nominal_heat_model
from twin.vae.config import TwinConfig
from twin.vae.measures import PARTS, Features
from twin.vae.twin import Twin

TINY = TwinConfig(max_windows=64, epochs=2, restarts=1, hidden=4, allow_collapse=True)


@pytest.fixture
def scenario(small_toml) -> Scenario:
    return override(load(small_toml), twin={"size": "quick", "exploration": 9}, spread={"seed": 4})


@pytest.fixture
def fleet(scenario, monkeypatch, plans) -> list[Twin]:
    """The twins with which the scenario's fleet works."""
    monkeypatch.setattr(TwinConfig, "quick", classmethod(lambda cls: TINY))
    monkeypatch.setattr("joblib.cpu_count", lambda: 1)
    planned = plan_arms(scenario, range(2), rehearsal_works(scenario), plans, quiet)
    return train_twins(scenario, planned, plans, quiet)


def test_a_twin_trained_by_hand_is_that_of_the_fleet(scenario, fleet, plans, tmp_path, monkeypatch):
    shutil.copytree(plans / "plans", tmp_path / "plans")  # and no twins: it is trained anew
    monkeypatch.setenv("THERMOFLEET_CACHE", str(tmp_path))
    told = []
    (right,) = train_arms(scenario, [1], TINY, progress=lambda *tell: told.append(tell))
    assert right.arm == "right"
    assert [twin.version for twin in fleet][1] == right.version
    assert (right.data_hash, right.seed) == (fleet[1].data_hash, fleet[1].seed)
    assert 9 < quality(right)["calibrated_on"] <= 18  # nine fresh motions, and at most as much of its own work
    assert [stage for stage, _ in told] == sorted(stage for stage, _ in told)
    assert told[-1] == ("training", 1.0)


def test_what_is_trained_by_hand_is_kept_by_its_seed_and_that_of_its_exploration(scenario, fleet, monkeypatch):
    (first,) = train_arms(scenario, [1], TINY, seed=6)
    trained = []

    def counted(*args, **more):
        trained.append(more["arm"].index)
        return train_twin(*args, **more)

    monkeypatch.setattr("scenarios.prepare.twins.train_twin", counted)
    (again,) = train_arms(scenario, [1], TINY, seed=6)
    assert (again.version, trained) == (first.version, [])
    (other,) = train_arms(scenario, [1], TINY, seed=7)
    assert (other.version != first.version, trained) == (True, [1])
    # Arms of one body and one plan, but other exploration: weights of seed 6 are not those of scenario 6.
    even = override(scenario, spread={"seed": 4, "scale": 0.0})
    (of_hand,) = train_arms(even, [1], TINY, seed=6)
    (of_fleet,) = train_arms(override(even, spread={"seed": 6, "scale": 0.0}), [1], TINY)
    assert trained == [1, 1, 1]
    assert of_hand.seed == of_fleet.seed
    assert of_hand.data_hash != of_fleet.data_hash


def test_another_seed_is_another_twin_of_the_same_data_and_the_name_of_the_scenario_does_not_matter(scenario, fleet):
    (other,) = train_arms(scenario, [0], TINY, seed=5)
    assert other.data_hash == fleet[0].data_hash
    assert other.version != fleet[0].version
    (same,) = train_arms(replace(scenario, name="renamed"), [0], TINY, seed=scenario.spread.seed)
    assert same.version == fleet[0].version


def test_an_arm_that_generates_and_recovers_knows_itself_by_the_twin_of_the_fleet(scenario, fleet, plans, tmp_path):
    shutil.copytree(plans / "plans", tmp_path / "plans")  # and no twins: it has to train its own
    assert known_arm(scenario, "right", cache=tmp_path).twin.version == fleet[1].version


@dataclass(frozen=True)
class Seer:
    """Stands in for a twin: reports the squared current of each joint."""

    motors: object
    version: str = "seer"
    joints: int = 7

    def features(self, plans, repetitions) -> Features:
        heat = np.array([drive(plan.cycle.profile, self.motors).current_sq for plan in plans])
        return Features(np.repeat(heat[..., None], PARTS, axis=-1))


def calibrate(scenario, hardware, twin, folder: Path, *, jobs=40):
    planned = PlannedFleet(scenario, folder)
    vars(planned)["arms"] = [PlannedArm(0, hardware, {})]
    (learned,) = planned.with_regressions([twin], jobs=jobs)
    return learned


@pytest.fixture(scope="module")
def quickstart():
    return load("quickstart")


def test_a_rehearsal_holds_both_outcomes_and_repeats(quickstart) -> None:
    def rehearse(index: int):
        arm = PlannedArm(index, hardware_of(quickstart, index), {})
        return simulate_past(quickstart, arm, nominal_heat_model(), jobs=40)

    past = rehearse(0)
    assert 3 <= past.passed.sum() <= 30
    assert len(past) == 40
    assert past.known_c.min() > 10.0
    assert past.known_c.max() < 80.0
    np.testing.assert_array_equal(rehearse(0).known_c, past.known_c)
    assert not np.array_equal(rehearse(1).known_c, past.known_c)


def test_a_rehearsal_has_the_air_of_the_hall() -> None:
    heat_wave = load("heat_wave")
    arm = PlannedArm(0, hardware_of(heat_wave, 0), {})
    air_c = simulate_past(heat_wave, arm, nominal_heat_model(), jobs=40).known_c[:, -1]
    offset_k = float(air_offsets(heat_wave)[0])
    assert 17.0 < air_c.min() - offset_k < 22.0 < 36.0 < air_c.max() - offset_k < 41.0


def test_a_regression_is_kept_for_the_same_arm_only(quickstart, tmp_path: Path, caplog) -> None:
    hardware = hardware_of(quickstart, 0)
    seer = Seer(hardware.motors)
    first = calibrate(quickstart, hardware, seer, tmp_path)
    (home,) = (tmp_path / "saturation").iterdir()
    (home / "saturation.json").touch()
    stamp = (home / "saturation.json").stat().st_mtime_ns
    assert calibrate(quickstart, hardware, seer, tmp_path).regression == first.regression
    assert (home / "saturation.json").stat().st_mtime_ns == stamp
    other = hardware_of(quickstart, 1)
    calibrate(quickstart, other, Seer(other.motors), tmp_path)
    assert len(list((tmp_path / "saturation").iterdir())) == 2
    (home / "saturation.json").write_text("{")
    assert calibrate(quickstart, hardware, seer, tmp_path).regression == first.regression
    assert "making it again" in caplog.text


def test_an_arm_that_nothing_heats_keeps_its_twin_and_says_why(quickstart, tmp_path: Path, caplog) -> None:
    hardware, twin = hardware_of(quickstart, 0), Seer(hardware_of(quickstart, 0).motors)
    lax = replace(quickstart, limits=ThermalLimits(warning_c=500.0, error_c=600.0))
    kept = calibrate(lax, hardware, twin, tmp_path, jobs=40)
    assert kept.twin is twin
    assert kept.regression is None
    assert f"quickstart: arm '{hardware.robot.name}' gets no probability of saturation" in caplog.text
    assert "(got 40; passed in 0)" in caplog.text
    assert not (tmp_path / "saturation").exists()


def test_a_curve_is_kept_for_the_same_arm_only(quickstart, tmp_path: Path) -> None:
    def network(index: int):
        arm = PlannedArm(index, hardware_of(quickstart, index), {})
        return calibrate_networks(quickstart, [arm], tmp_path, quiet, risk="rc-nominal", jobs=40)[0]

    first = network(0)
    assert first.curve is not None
    assert network(0).version == first.version
    assert network(1).version != first.version
    assert len(list((tmp_path / "saturation").iterdir())) == 2


LEFT: Any = SimpleNamespace(arm="left")


def test_an_arm_begins_from_what_it_found_to_stay_cool(small_toml, plans):
    known = known_arm(load(small_toml), twin=LEFT, cache=plans)
    assert known.arm.robot.name == "left"
    assert len(known.sources) > 2
    asked = known.verification
    assert (asked.ambient_c, asked.cool_c, asked.horizon_s) == (22.0, 40.0, 1800.0)
    for plan in known.sources:
        assert plan.arm == "left"
        true = replace(asked, motors=known.arm.motors, thermal=known.arm.thermal)
        assert np.all(true.peak_c(plan) <= 40.0)
    model = nominal_heat_model("immersion")
    network: Any = SimpleNamespace(heat_model=model)
    own = known_arm(load(small_toml), twin=LEFT, network=network, cache=plans)
    law = {"motors": model.motors, "thermal": model.thermal(), "ambient_c": 22.0}
    (peak_c,) = cold_peaks(own.sources[:1], **law, horizon_s=1800.0)
    np.testing.assert_array_equal(own.verification.peak_c(own.sources[0]), peak_c)


def test_an_unknown_arm_and_anothers_twin_are_refused(small_toml, plans):
    scenario = load(small_toml)
    for arm, said in (
        ("lefd", r"No arm 'lefd' in heat; did you mean 'left'\? Allowed: left, right"),
        ("right", "twin of arm 'left', not of 'right'"),
    ):
        with pytest.raises(FleetError, match=said):
            known_arm(scenario, arm, twin=LEFT, cache=plans)


TWIN = SimpleNamespace(version="ab12", data_hash="cd34", seed="[0, 1]/")


def test_a_model_names_its_data_and_seed_and_a_calibrated_one_those_of_its_twin():
    assert provenance(Blind()) == {"version": "blind"}
    twin = {"version": "ab12", "data_hash": "cd34", "seed": "[0, 1]/"}
    assert provenance(TWIN) == {"version": "ab12", "twin": twin}
    model = SimpleNamespace(version="ab12+ef56", twin=TWIN)
    assert provenance(model) == {"version": "ab12+ef56", "twin": twin}
