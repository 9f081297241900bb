"""The rehearsal that calibrates a scenario's twins: enough of both outcomes, kept, and the same in every run."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from fleet.motion import drive
from fleet.robot import ThermalLimits
from scenarios.evaluate.sources import PlannedFleet
from scenarios.prepare.arms import PlannedArm, air_offsets, hardware_of
from scenarios.prepare.calibrate import calibrate_networks, simulate_past
from scenarios.progress import quiet
from scenarios.spec.load import load
from twin.thermal.identify import nominal_heat_model
from twin.vae.measures import PARTS, Features


@dataclass(frozen=True)
class Seer:
    """Stands in for a twin: reports the squared current of each joint."""

    motors: object
    version: str = "seer"
    joints: int = 7

    def features(self, plans, repetitions) -> Features:
        heat = np.array([drive(plan.cycle.profile, self.motors).current_sq for plan in plans])
        return Features(np.repeat(heat[..., None], PARTS, axis=-1))


def calibrate(scenario, hardware, twin, folder: Path, *, jobs=60):
    planned = PlannedFleet(scenario, folder)
    vars(planned)["arms"] = [PlannedArm(0, hardware, {})]
    (learned,) = planned.with_regressions([twin], jobs=jobs)
    return learned


@pytest.fixture(scope="module")
def scenario():
    return load("quickstart")


def test_a_rehearsal_holds_both_outcomes_and_repeats(scenario) -> None:
    def rehearse(index: int):
        arm = PlannedArm(index, hardware_of(scenario, index), {})
        return simulate_past(scenario, arm, nominal_heat_model(), jobs=60)

    past = rehearse(0)
    assert 5 <= past.passed.sum() <= 40
    assert len(past) == 60
    assert past.known_c.min() > 10.0
    assert past.known_c.max() < 80.0
    np.testing.assert_array_equal(rehearse(0).known_c, past.known_c)
    assert not np.array_equal(rehearse(1).known_c, past.known_c)


def test_a_rehearsal_has_the_air_of_the_hall() -> None:
    heat_wave = load("heat_wave")
    arm = PlannedArm(0, hardware_of(heat_wave, 0), {})
    air_c = simulate_past(heat_wave, arm, nominal_heat_model(), jobs=60).known_c[:, -1]
    offset_k = float(air_offsets(heat_wave)[0])
    assert 17.0 < air_c.min() - offset_k < 22.0 < 36.0 < air_c.max() - offset_k < 41.0


def test_a_regression_is_kept_for_the_same_arm_only(scenario, tmp_path: Path, caplog) -> None:
    hardware = hardware_of(scenario, 0)
    seer = Seer(hardware.motors)
    first = calibrate(scenario, hardware, seer, tmp_path)
    (home,) = (tmp_path / "saturation").iterdir()
    (home / "saturation.json").touch()
    stamp = (home / "saturation.json").stat().st_mtime_ns
    assert calibrate(scenario, hardware, seer, tmp_path).regression == first.regression
    assert (home / "saturation.json").stat().st_mtime_ns == stamp
    other = hardware_of(scenario, 1)
    calibrate(scenario, other, Seer(other.motors), tmp_path)
    assert len(list((tmp_path / "saturation").iterdir())) == 2
    (home / "saturation.json").write_text("{")
    assert calibrate(scenario, hardware, seer, tmp_path).regression == first.regression
    assert "making it again" in caplog.text


def test_an_arm_that_nothing_heats_keeps_its_twin_and_says_why(scenario, tmp_path: Path, caplog) -> None:
    hardware, twin = hardware_of(scenario, 0), Seer(hardware_of(scenario, 0).motors)
    lax = replace(scenario, limits=ThermalLimits(warning_c=500.0, error_c=600.0))
    kept = calibrate(lax, hardware, twin, tmp_path, jobs=40)
    assert kept.twin is twin
    assert kept.regression is None
    assert f"quickstart: arm '{hardware.robot.name}' gets no probability of saturation" in caplog.text
    assert "(got 40; passed in 0)" in caplog.text
    assert not (tmp_path / "saturation").exists()


def test_a_curve_is_kept_for_the_same_arm_only(scenario, tmp_path: Path) -> None:
    def network(index: int):
        arm = PlannedArm(index, hardware_of(scenario, index), {})
        return calibrate_networks(scenario, [arm], tmp_path, quiet, risk="rc-nominal", jobs=60)[0]

    first = network(0)
    assert first.curve is not None
    assert network(0).version == first.version
    assert network(1).version != first.version
    assert len(list((tmp_path / "saturation").iterdir())) == 2
