"""The rehearsal that calibrates a scenario's twins: enough of both outcomes, kept, and the same in every run."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from fleet.motion import drive
from fleet.robot import ThermalLimits
from scenarios.load import load
from scenarios.prepare.calibrate_twins import calibrate_twins, simulate_experience
from scenarios.prepare.planned_arm import PlannedArm, hardware_of
from scenarios.progress import quiet
from twin.vae.measures import Features


@dataclass(frozen=True)
class Seer:
    """Stands in for a twin: reports the squared current of each joint."""

    motors: object
    version: str = "seer"
    joints: int = 7

    def features(self, plans, repetitions) -> Features:
        heat = np.array([drive(plan.cycle.profile, self.motors).current_sq for plan in plans])
        return Features(np.repeat(heat[..., None], 5, axis=-1))


@pytest.fixture(scope="module")
def scenario():
    return load("quickstart")


def test_a_rehearsal_holds_both_outcomes_and_repeats(scenario) -> None:
    hardware = hardware_of(scenario, 0)
    past = simulate_experience(scenario, PlannedArm(0, hardware, {}), Seer(hardware.motors), jobs=60)
    assert 5 <= past.passed.sum() <= 40
    assert len(past) == 60
    assert past.temp_c.min() > 15.0
    assert past.temp_c.max() < 60.5
    assert (
        simulate_experience(scenario, PlannedArm(0, hardware, {}), Seer(hardware.motors), jobs=60).data_hash
        == past.data_hash
    )
    assert (
        simulate_experience(scenario, PlannedArm(1, hardware, {}), Seer(hardware.motors), jobs=60).data_hash
        != past.data_hash
    )


def test_a_calibrated_twin_is_kept_for_the_same_arm_only(scenario, tmp_path: Path, caplog) -> None:
    hardware = hardware_of(scenario, 0)
    first = calibrate_twins(scenario, [PlannedArm(0, hardware, {})], [Seer(hardware.motors)], tmp_path, quiet, jobs=60)
    (home,) = (tmp_path / "saturation").iterdir()
    (home / "saturation.json").touch()
    stamp = (home / "saturation.json").stat().st_mtime_ns
    again = calibrate_twins(scenario, [PlannedArm(0, hardware, {})], [Seer(hardware.motors)], tmp_path, quiet, jobs=60)
    assert again[0].saturation == first[0].saturation
    assert (home / "saturation.json").stat().st_mtime_ns == stamp
    other = hardware_of(scenario, 1)
    calibrate_twins(scenario, [PlannedArm(0, other, {})], [Seer(other.motors)], tmp_path, quiet, jobs=60)
    assert len(list((tmp_path / "saturation").iterdir())) == 2
    (home / "saturation.json").write_text("{")
    mended = calibrate_twins(scenario, [PlannedArm(0, hardware, {})], [Seer(hardware.motors)], tmp_path, quiet, jobs=60)
    assert mended[0].saturation == first[0].saturation
    assert "making it again" in caplog.text


def test_an_arm_that_nothing_heats_keeps_its_twin_and_says_why(scenario, tmp_path: Path, caplog) -> None:
    hardware, twin = hardware_of(scenario, 0), Seer(hardware_of(scenario, 0).motors)
    lax = replace(scenario, limits=ThermalLimits(warning_c=500.0, error_c=600.0))
    assert calibrate_twins(lax, [PlannedArm(0, hardware, {})], [twin], tmp_path, quiet, jobs=40) == [twin]
    assert f"quickstart: arm '{hardware.robot.name}' gets no probability of saturation" in caplog.text
    assert "(got 40; passed in 0)" in caplog.text
    assert not (tmp_path / "saturation").exists()
