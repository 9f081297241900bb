"""Surprises: what the simulator does differs from what the arms believe, and nothing tells them."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.freeze_suite import SURPRISE_EVERY
from fleet.arm.model import ArmModel
from fleet.env.vector import BatchEnv, Obs
from fleet.errors import ScenarioError
from fleet.heat.thermal import gen3_network, thermal_model
from fleet.robot import JOINTS
from scenarios.prepare.batch import library_of
from scenarios.prepare.fleet import Fleet, as_known, prepare, with_surprises
from scenarios.spec.load import load
from scenarios.spec.parse import override
from scenarios.spec.schema import SPLITS, Scenario
from scenarios.suite.instances import CELLS
from scenarios.suite.splits import manifest


@pytest.fixture(scope="module")
def cell() -> Scenario:
    """`quickstart` with exact sensors, and a fan at its first arm."""
    base = load("quickstart")
    arms = [replace(arm, sensor_noise_k=0.0) for arm in base.arms]
    arms[0] = replace(arms[0], cooling="forced_air")
    return override(base, arms=arms, spread={"scale": 0.0})


@pytest.fixture(scope="module")
def fleet(cell) -> Fleet:
    return prepare(cell, difficulty="blind")


def surprised(fleet: Fleet, **surprise) -> Fleet:
    return with_surprises(replace(fleet, scenario=override(fleet.scenario, surprises=[surprise])))


def test_a_heavier_load_needs_the_torque_of_its_true_mass(fleet) -> None:
    changed = surprised(fleet, kind="payload", jobs="hold_part", size=1.25)
    found = 0
    for arm in changed.arms:
        model = ArmModel(arm.robot)
        for plan, executed in arm.executed.items():
            held = executed.cycle.profile
            assert plan.work.payload_kg == pytest.approx(executed.cycle.payload_kg.max() / 1.25)
            still = np.abs(held[:, 1]).max(axis=1) < 1e-6
            carried = still & (executed.cycle.payload_kg > 0)
            for sample in np.flatnonzero(carried)[:3]:
                needed = model.gravity_torque(held[sample, 0].astype(float), 1.25 * plan.work.payload_kg)
                assert held[sample, 2] == pytest.approx(needed, abs=0.05)
                found += 1
            assert executed.cycle.profile[:, :2] == pytest.approx(plan.cycle.profile[:, :2])
    assert found


def test_a_load_of_the_declared_mass_changes_nothing(fleet) -> None:
    changed = surprised(fleet, kind="payload", jobs="hold_part", size=1.0)
    for arm in changed.arms:
        for plan, executed in arm.executed.items():
            assert executed.phases == plan.phases


def test_friction_grows_by_its_share(fleet) -> None:
    changed = surprised(fleet, kind="friction", arm="arm_1", size=1.5)
    before, now = fleet.arms[1].motors, changed.arms[1].motors
    assert now.coulomb_nm == pytest.approx(2.5 * before.coulomb_nm)
    assert now.copper_w_per_a2 == pytest.approx(before.copper_w_per_a2)
    assert changed.arms[0] is fleet.arms[0]


def shift_of(fleet: Fleet, seed: int = 5) -> tuple[BatchEnv, Obs]:
    """An env at the beginning of a shift, and what its arms know, in SI units."""
    env = BatchEnv(library_of(fleet), 1, seed=[seed], scaled=False)
    return env, env.reset()[0]


def test_without_its_fan_an_arm_has_the_network_of_still_air_and_starts_as_with_it(fleet) -> None:
    changed = surprised(fleet, kind="fan", arm="arm_0")
    assert changed.arms[0].thermal.to_ambient == pytest.approx(thermal_model(gen3_network()).to_ambient)
    (with_fan, _), (without, _) = shift_of(fleet), shift_of(changed)
    assert without.state.temp_c == pytest.approx(with_fan.state.temp_c)
    still = np.zeros((1, len(fleet.arms)), int)
    for env in (with_fan, without):
        for _ in range(30):
            env.step(still)
    assert (without.state.temp_c[0, 0] > with_fan.state.temp_c[0, 0]).all()
    assert without.state.temp_c[0, 1:] == pytest.approx(with_fan.state.temp_c[0, 1:])


def test_readings_drift_by_the_rate_times_the_time(fleet) -> None:
    env, obs = shift_of(surprised(fleet, kind="sensor", arm="arm_2", size=-6.0))
    for tick in range(7):
        seen = env.layout.read_parts(obs["shared"], obs["own"], obs["action_mask"])
        drift_k = np.array([0.0, 0.0, -6.0, 0.0])[:, None] * tick * fleet.scenario.decision_interval_s / 3600.0
        assert seen.temp_c[0] == pytest.approx(env.state.temp_c[0, :, :JOINTS] + drift_k, abs=1e-3)
        obs = env.step(np.zeros((1, 4), int))[0]


SURPRISES = [
    {"kind": "payload", "jobs": "hold_part", "size": 1.5},
    {"kind": "friction", "arm": "arm_1", "size": 2.0},
    {"kind": "fan", "arm": "arm_0"},
    {"kind": "sensor", "arm": "arm_2", "size": 9.0},
]


@pytest.mark.parametrize("surprise", SURPRISES, ids=lambda each: each["kind"])
def test_arms_are_not_told(fleet, surprise) -> None:
    """At the start all of the observation is as without the surprise, and so is the simulator of planners."""
    changed = surprised(fleet, **surprise)
    (_, plain), (_, other) = shift_of(fleet), shift_of(changed)
    for name, values in plain.items():
        assert np.array_equal(values, other[name]), name
    for one, other in zip(as_known(fleet).arms, as_known(changed).arms, strict=True):
        assert one.thermal is other.thermal or np.array_equal(one.thermal.to_ambient, other.thermal.to_ambient)
        assert np.array_equal(one.motors.coulomb_nm, other.motors.coulomb_nm)
        assert not other.executed
        assert not other.drift_k_per_s


@pytest.mark.parametrize("surprise", SURPRISES, ids=lambda each: each["kind"])
def test_the_source_oracle_knows(cell, fleet, surprise) -> None:
    exact = prepare(override(cell, surprises=[surprise]), difficulty="oracle", like=fleet)
    changed = surprised(fleet, **surprise)
    for one, other in zip(exact.arms, changed.arms, strict=True):
        assert one.beliefs[0].to_ambient == pytest.approx(other.thermal.to_ambient)
        assert one.beliefs[1].coulomb_nm == pytest.approx(other.motors.coulomb_nm)
        assert set(one.executed) == set(other.executed)
        assert not one.drift_k_per_s


def test_a_surprised_fleet_can_be_prepared_again_for_other_surprises(cell, fleet) -> None:
    once = surprised(fleet, **SURPRISES[1])
    again = prepare(override(cell, surprises=[SURPRISES[3]]), difficulty="blind", like=once)
    assert again.arms[1] is fleet.arms[1]
    assert again.arms[2].drift_k_per_s == 9.0 / 3600.0
    assert with_surprises(replace(again, scenario=cell)).arms == fleet.arms


@pytest.mark.parametrize(
    ("surprise", "message"),
    [
        ({"kind": "fan", "arm": "arm_1"}, "surprises[0].arm: 'arm_1' has no fan; its cooling must be forced_air"),
        ({"kind": "friction", "arm": "arm_9", "size": 1.0}, "surprises[0].arm: there is no 'arm_9'"),
        ({"kind": "payload", "jobs": "holds", "size": 1.0}, "surprises[0].jobs: there is no 'holds'"),
        ({"kind": "payload", "arm": "arm_1", "size": 1.0}, "kind payload needs `jobs` and no `arm`"),
        ({"kind": "sensor", "jobs": "sort_parts"}, "kind sensor needs `arm` and no `jobs`"),
        ({"kind": "payload", "jobs": "sort_parts", "size": 9.0}, "size must be between 0.1 and 5 (got 9.0)"),
        ({"kind": "sensor", "arm": "arm_1", "size": -51.0}, "size must be between -50 and 50 (got -51.0)"),
        ({"kind": "rust", "arm": "arm_1"}, "'rust' is not allowed"),
    ],
)
def test_a_wrong_surprise_is_refused(cell, surprise, message) -> None:
    with pytest.raises(ScenarioError) as error:
        override(cell, surprises=[surprise])
    assert message in str(error.value)


@pytest.mark.parametrize("split", SPLITS)
def test_a_third_of_the_instances_of_a_split_has_a_surprise(split) -> None:
    rows = manifest(split)
    kinds = Counter(row.axes.surprise for row in rows)
    assert kinds.pop("nothing") == pytest.approx(len(rows) * (1 - 1 / SURPRISE_EVERY), rel=0.02)
    assert set(kinds) == {"payload", "friction", "fan", "sensor"}
    cells = {cell.name: cell for cell in CELLS}
    for row in rows:
        assert row.axes.surprise != "fan" or cells[row.cell].asks != "equal_arms"
