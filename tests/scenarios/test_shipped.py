"""Plans and models that come with the package: made by the present code, complete, and the same when made anew."""

import json
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleet.difficulty import KNOWN, Difficulty
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import gen3_network, thermal_model
from fleet.robot import Robot
from scenarios.prepare.arms import ArmHardware
from scenarios.prepare.fleet import Fleet, prepare
from scenarios.prepare.shipped import FOLDER, SCENARIOS, archive_of, unpack_shipped

AGAIN = "the code that makes plans and models has changed; run: python -m benchmarks.ship_prepared"


def test_the_archives_are_of_the_present_code() -> None:
    assert {path.name for path in FOLDER.iterdir()} == {archive_of(name).name for name in SCENARIOS}, AGAIN


def fail(*_: object) -> None:
    raise AssertionError(AGAIN)


def prepare_shipped(cache: Path, monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """The fleet of quickstart from an empty cache; whatever would be computed fails."""
    with monkeypatch.context() as without:
        without.setattr("fleet.arm.plan_cache._write", fail)
        without.setattr("scenarios.prepare.twins.require_extra", fail)
        return prepare("quickstart", cache=cache)


def test_nothing_of_quickstart_is_computed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where another scenario of these arms was planned before."""
    with tarfile.open(archive_of("quickstart")) as packed:
        plan = next(name for name in packed.getnames() if name.startswith("plans/"))
    (tmp_path / "plans").mkdir()
    (tmp_path / plan).write_bytes(b"with other last digits")
    fleet = prepare_shipped(tmp_path, monkeypatch)
    assert [arm.robot.name for arm in fleet.arms] == ["arm_0", "arm_1", "arm_2", "arm_3"]
    assert {path.name for path in tmp_path.iterdir()} == {"identified", "plans", "saturation", "shipped", "twins"}


def test_keys_do_not_depend_on_the_rounding_of_eigenvectors() -> None:
    """LAPACK gives others on other processors."""
    hardware = ArmHardware(Robot(name="a"), gen3_motors(), thermal_model(gen3_network()))
    other = hardware.thermal.modes * (1.0 - 1e-15)
    assert hardware._replace(thermal=replace(hardware.thermal, modes=other)).key([1]) == hardware.key([1])
    warmer = replace(hardware.motors, idle_w=hardware.motors.idle_w + 1e-15)
    assert hardware._replace(motors=warmer).key([1]) != hardware.key([1])


def test_another_scenario_gets_nothing(tmp_path: Path) -> None:
    unpack_shipped("rush_hour", tmp_path)
    assert list(tmp_path.iterdir()) == []


def texts(value: object) -> list[str]:
    """All texts in a value of JSON."""
    if isinstance(value, str):
        return [value]
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [text for part in parts for text in texts(part)]


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_no_file_names_a_machine_or_a_time(scenario: str) -> None:
    with tarfile.open(archive_of(scenario)) as packed:
        for member in packed:
            assert (member.uid, member.uname, member.gname, member.mtime) == (0, "", "", 0)
            content = packed.extractfile(member)
            if content is not None and member.name.endswith(".json"):
                assert not [text for text in texts(json.load(content)) if text.startswith("/")]


@pytest.mark.slow
def test_made_anew_they_are_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On this machine to the last digit; elsewhere training amplifies the rounding of another processor."""
    shipped = prepare_shipped(tmp_path / "shipped", monkeypatch)
    monkeypatch.setattr("scenarios.prepare.arms.unpack_shipped", lambda *_: None)
    anew = prepare("quickstart", cache=tmp_path / "anew")
    assert (anew.space.conflicts == shipped.space.conflicts).all()
    for one, other in zip(anew.arms, shipped.arms, strict=True):
        np.testing.assert_allclose(one.rest_tau, other.rest_tau, atol=1e-9)
        assert list(one.plans) == list(other.plans)
        for task, variants in one.plans.items():
            for plan, same in zip(variants, other.plans[task], strict=True):
                np.testing.assert_allclose(plan.cycle.profile, same.cycle.profile, atol=1e-4)
                agree(one.model.score(plan, 10), other.model.score(same, 10))


def agree(one: Difficulty | None, other: Difficulty | None) -> None:
    """Assert that two scores of a plan are nearly equal, for an arm at 45 °C."""
    assert one is not None
    assert other is not None
    known_c = np.full(KNOWN, 45.0)
    np.testing.assert_allclose(one.per_joint, other.per_joint, atol=0.02)
    assert one.peak_at(known_c) == pytest.approx(other.peak_at(known_c), abs=0.1)
    assert one.p_at(known_c) == pytest.approx(other.p_at(known_c), abs=0.02)
