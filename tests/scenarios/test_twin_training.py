"""Twins trained by hand: the very ones with which a fleet works, whoever is trained beside them."""

import shutil
from dataclasses import replace

import pytest

from scenarios.motion.recover import known_arm
from scenarios.prepare.arms import plan_arms
from scenarios.prepare.twins import quality, train_arms, train_twin, train_twins
from scenarios.progress import quiet
from scenarios.spec.jobs import rehearsal_works
from scenarios.spec.load import load
from scenarios.spec.parse import override
from scenarios.spec.schema import Scenario
from twin.vae.config import TwinConfig
from twin.vae.twin import Twin

TINY = TwinConfig(max_windows=64, epochs=2, restarts=1, hidden=4, allow_collapse=True)


@pytest.fixture
def scenario(small_toml, plans, monkeypatch) -> Scenario:
    monkeypatch.setenv("THERMOFLEET_CACHE", str(plans))
    return override(load(small_toml), twin={"size": "quick", "exploration": 9}, spread={"seed": 4})


@pytest.fixture
def fleet(scenario, monkeypatch, plans) -> list[Twin]:
    """The twins with which the scenario's fleet works."""
    monkeypatch.setattr(TwinConfig, "quick", classmethod(lambda cls: TINY))
    monkeypatch.setattr("scenarios.prepare.twins.cpu_count", lambda: 1)
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


def test_the_twins_of_the_fleet_are_not_trained_again(scenario, fleet, monkeypatch):
    def never(*_args, **_more):
        raise AssertionError("trained again")

    monkeypatch.setattr("scenarios.prepare.twins.train_twin", never)
    kept = train_arms(scenario, [0, 1], TINY)
    assert [quality(twin) for twin in kept] == [quality(twin) for twin in fleet]
    with pytest.raises(AssertionError, match="trained again"):
        train_arms(scenario, [1], replace(TINY, epochs=3))


def test_what_is_trained_by_hand_is_kept_by_its_seed_and_that_of_its_exploration(scenario, fleet, monkeypatch):
    (first,) = train_arms(scenario, [1], TINY, seed=6)
    trained = []

    def counted(*args, **more):
        trained.append(more["arm"].index)
        return train_twin(*args, **more)

    monkeypatch.setattr("scenarios.prepare.twins.train_twin", counted)
    (again,) = train_arms(scenario, [1], TINY, seed=6)
    assert (again.version, trained) == (first.version, [])
    # Arms of one body and one plan, but other exploration: weights of seed 6 are not those of scenario 6.
    even = override(scenario, spread={"seed": 4, "scale": 0.0})
    (of_hand,) = train_arms(even, [1], TINY, seed=6)
    (of_fleet,) = train_arms(override(even, spread={"seed": 6, "scale": 0.0}), [1], TINY)
    assert trained == [1, 1]
    assert of_hand.seed == of_fleet.seed
    assert of_hand.data_hash != of_fleet.data_hash


def test_who_is_trained_beside_it_does_not_matter_and_another_seed_does(scenario, fleet, tmp_path, monkeypatch, plans):
    shutil.copytree(plans / "plans", tmp_path / "plans")  # and no twins: all are trained anew
    monkeypatch.setenv("THERMOFLEET_CACHE", str(tmp_path))
    assert [twin.version for twin in train_arms(scenario, [0, 1], TINY)] == [twin.version for twin in fleet]
    (other,) = train_arms(scenario, [0], TINY, seed=5)
    assert other.data_hash == fleet[0].data_hash
    assert other.version != fleet[0].version
    (same,) = train_arms(replace(scenario, name="renamed"), [0], TINY, seed=scenario.spread.seed)
    assert same.version == fleet[0].version


def test_an_arm_that_generates_and_recovers_knows_itself_by_the_twin_of_the_fleet(scenario, fleet, plans, tmp_path):
    shutil.copytree(plans / "plans", tmp_path / "plans")  # and no twins: it has to train its own
    assert known_arm(scenario, "right", cache=tmp_path).twin.version == fleet[1].version
