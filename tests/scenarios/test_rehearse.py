"""Rehearsal: the twin learns from what stayed cool over the whole horizon, and is trained once per input."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fleet.arm.model import ArmModel
from fleet.arm.random_motions import light_jobs
from fleet.errors import FleetError
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import NODES, WINDING, drive_heat, gen3_network, thermal_model
from fleet.motion import drive
from fleet.robot import Mount, Robot
from scenarios.prepare import twins as rehearse
from scenarios.prepare.arms import ArmHardware, PlannedArm
from scenarios.prepare.twins import cold_peaks, cool_plans, records, require_cool_plans
from scenarios.spec.load import library, load
from twin.vae.config import TwinConfig
from twin.vae.train import train

TINY = TwinConfig(max_windows=64, epochs=2, restarts=1, hidden=4, allow_collapse=True)


@pytest.fixture
def scenario():
    quickstart = load(library()["quickstart"])
    return replace(quickstart, twin=replace(quickstart.twin, exploration=3))


@pytest.fixture
def plans(small):
    """One arm's plans: a light, a warm and a hot work."""
    works = [small.work(f"place_{i}", payload_kg=kg) for i, kg in enumerate((small.LIGHT, small.WARM, small.HOT))]
    return small.arm(0, works).plans


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setattr(TwinConfig, "quick", classmethod(lambda cls: TINY))


def hardware(index=0):
    return ArmHardware(Robot(name=f"arm_{index}"), gen3_motors(), thermal_model(gen3_network()))


def arms(count, plans=None):
    return [PlannedArm(i, hardware(i), plans or {}) for i in range(count)]


def silent(stage, fraction):
    pass


def test_a_fleet_that_gets_hot_at_everything_is_told_what_to_change(plans, scenario, tmp_path):
    strict = replace(scenario, twin=replace(scenario.twin, cool_c=22.5))
    with pytest.raises(FleetError, match=r"arm 'arm_0' has no motion that stays below 22.5 °C .* Raise twin.cool_c"):
        rehearse.train_twins(strict, arms(1, plans), tmp_path, silent)


def test_twins_are_trained_once_and_then_taken_from_the_cache(plans, scenario, tmp_path, tiny, monkeypatch):
    monkeypatch.setattr("joblib.cpu_count", lambda: 1)
    told = []
    first = rehearse.train_twins(scenario, arms(2, plans), tmp_path, lambda *tell: told.append(tell))
    assert told[-1] == ("training", 1.0)
    assert first[0].version != first[1].version  # each arm has a seed of its own

    def never(*_args, **_more):
        raise AssertionError("trained again")

    monkeypatch.setattr("scenarios.processes.worker_processes", never)
    again = rehearse.train_twins(scenario, arms(2, plans), tmp_path, silent)
    assert [t.version for t in again] == [t.version for t in first]
    other = replace(scenario, twin=replace(scenario.twin, cool_c=200.0))  # hot motion is in the records as well
    with pytest.raises(AssertionError, match="trained again"):
        rehearse.train_twins(other, arms(2, plans), tmp_path, silent)


@pytest.mark.slow
def test_twins_do_not_depend_on_how_many_work(plans, scenario, tmp_path, tiny, monkeypatch):
    both = rehearse.train_twins(scenario, arms(2, plans), tmp_path / "two", silent)
    monkeypatch.setattr("joblib.cpu_count", lambda: 1)
    alone = rehearse.train_twins(scenario, arms(2, plans), tmp_path / "one", silent)
    assert [t.version for t in both] == [t.version for t in alone]


def test_a_spoilt_checkpoint_is_trained_anew_with_a_word(plans, scenario, tmp_path, tiny, caplog):
    (twin,) = rehearse.train_twins(scenario, arms(1, plans), tmp_path, silent)
    (stored,) = (tmp_path / "twins").iterdir()
    (stored / "twin.json").write_text("{", encoding="utf-8")
    with caplog.at_level(logging.WARNING):
        (anew,) = rehearse.train_twins(scenario, arms(1, plans), tmp_path, silent)
    assert "making it again" in caplog.text
    assert anew.version == twin.version


def test_an_arm_explores_with_light_motion_that_stays_cool_on_its_own_mount(scenario):
    """Second method: the torque at the first sample is the arm's own gravity torque, wherever it hangs."""
    ceiling = Robot(name="arm_1", mount=Mount(position_m=(0.0, 0.0, 1.2), tilt_deg=(180.0, 0.0, 0.0)))
    explored = rehearse.exploration_records(scenario, PlannedArm(1, hardware(1)._replace(robot=ceiling), {}))
    assert len(explored) == 3 * scenario.twin.exploration
    arm = ArmModel(ceiling)
    for approach in explored[::3]:
        q, _, tau = approach[0]
        assert tau == pytest.approx(arm.gravity_torque(q), abs=8.0)  # the rest accelerates the rotors
    assert max(np.abs(record[:, 2, 1]).max() for record in explored) < 25.0  # light: no outstretched load


def test_an_arm_that_does_not_explore_learns_from_its_work_alone(plans, scenario, tmp_path, tiny):
    (arm,) = arms(1)
    none, strict = (replace(scenario, twin=replace(scenario.twin, **n)) for n in ({"exploration": 0}, {"cool_c": 22.5}))
    assert rehearse.exploration_records(none, arm) == rehearse.exploration_records(strict, arm) == []
    (twin,) = rehearse.train_twins(none, arms(1, plans), tmp_path, silent)
    (explorer,) = rehearse.train_twins(scenario, arms(1, plans), tmp_path, silent)
    own = records(require_cool_plans(arms(1, plans)[0].all_plans, hardware(), none))
    seed = np.random.SeedSequence([none.spread.seed, 0])
    assert twin.data_hash == train(own, TINY, seed, arm="arm_0").data_hash
    both = [*own, *rehearse.exploration_records(scenario, arm)]
    assert explorer.data_hash == train(both, TINY, seed, arm="arm_0").data_hash


def test_every_arm_explores_in_its_own_way_and_the_same_every_time(scenario):
    first, other = arms(2)
    one = rehearse.exploration_records(scenario, first)
    again = rehearse.exploration_records(scenario, first)
    assert all(np.array_equal(a, b) for a, b in zip(one, again, strict=True))
    elsewhere = rehearse.exploration_records(scenario, other)
    assert not np.array_equal(one[0][-1], elsewhere[0][-1])


def test_other_motors_are_another_twin_since_other_exploration_stays_cool(plans, scenario, tmp_path, tiny):
    (arm,) = arms(1)
    rehearse.train_twins(scenario, arms(1, plans), tmp_path, silent)
    motors = arm.hardware.motors
    warmer = arm.hardware._replace(motors=replace(motors, idle_w=motors.idle_w * 1.001))
    rehearse.train_twins(scenario, [PlannedArm(0, warmer, plans)], tmp_path, silent)
    assert len(list((tmp_path / "twins").iterdir())) == 2


def test_a_twin_is_calibrated_on_two_kinds_of_cool_motion_that_it_was_not_trained_on(plans, scenario, monkeypatch):
    """Second method: train on what was handed to the training, and calibrate by hand."""
    explores = replace(scenario, twin=replace(scenario.twin, exploration=9))
    (arm,) = arms(1)
    drawn = []
    monkeypatch.setattr(
        "fleet.arm.random_motions.light_jobs", lambda *some: drawn.append(light_jobs(*some)) or drawn[-1]
    )
    seed = rehearse.arm_seed(0, 0)
    own = [plan for variants in plans.values() for plan in variants]
    twin = rehearse.train_twin(own, TINY, seed, scenario=explores, arm=arm)
    learned, light = drawn
    light, work = rehearse.held_out(explores, arm)
    assert (len(light), len(work)) == (9, 9)
    motions = [{plan.cycle.profile.tobytes() for plan in some} for some in (own, learned, light, work)]
    assert len(set.union(*motions)) == sum(map(len, motions))  # no motion is in two of them
    untold = train([*records(own), *records(learned)], TINY, seed, arm="arm_0")
    assert untold.calibration is None
    by_hand = untold.features([*light, *work], [1] * 18).packed
    assert np.allclose(twin.calibration.reference.packed, by_hand, rtol=1e-4, atol=1e-5)
    assert twin.calibration.group.tolist() == [0] * 9 + [1] * 9


def test_held_out_work_stays_cool(scenario):
    explores = replace(scenario, twin=replace(scenario.twin, exploration=9))
    (arm,) = arms(1)
    _, work = rehearse.held_out(explores, arm)
    assert cool_plans(work, arm.hardware, explores.twin) == work
    other = rehearse.held_out(explores, arm, 1)[1]
    assert not {plan.cycle.profile.tobytes() for plan in work} & {plan.cycle.profile.tobytes() for plan in other}


def test_too_few_held_out_motions_leave_a_twin_uncalibrated(scenario):
    (arm,) = arms(1)
    twin = rehearse.train_twin([], TINY, rehearse.arm_seed(0, 0), scenario=scenario, arm=arm)
    assert scenario.twin.exploration == 3
    assert twin.calibration is None


HARDWARE = ArmHardware(Robot(name="arm_0"), gen3_motors(), thermal_model(gen3_network()))
PAYLOADS_KG = (0.0, 1.0, 2.0, 3.0, 4.0)


@pytest.fixture
def plain():
    return load(library()["quickstart"])


@pytest.fixture
def holds(small):
    """Holds with more and more in the hand; all of them begin cool."""
    works = [small.work(f"place_{i}", payload_kg=kg) for i, kg in enumerate(PAYLOADS_KG)]
    return [variants[0] for variants in small.arm(0, works).plans.values()]


@pytest.fixture
def courses(holds, plain):
    """Second method: Runge-Kutta over the horizon, winding temperatures [joint, time] of each plan."""
    _, motors, thermal = HARDWARE
    spec = plain.twin
    found = []
    for plan in holds:
        load_ = drive(plan.cycle.profile, motors)

        def slope(_t, temp, load_=load_):
            heat = drive_heat(temp, load_.current_sq, load_.friction_w, motors)
            return (heat + thermal.to_ambient * spec.ambient_c - thermal.laplacian @ temp) / thermal.capacity

        cold_c = np.full(NODES, spec.ambient_c)
        run = solve_ivp(slope, (0.0, spec.horizon_s), cold_c, rtol=1e-8, atol=1e-8, max_step=60.0)
        found.append(run.y[WINDING])
    return found


def test_peaks_from_a_cold_start_are_those_of_an_independent_integration(holds, courses, plain):
    spec = plain.twin
    found = cold_peaks(holds, *HARDWARE[1:], ambient_c=spec.ambient_c, horizon_s=spec.horizon_s)
    assert found == pytest.approx(np.array([course.max(axis=1) for course in courses]), abs=0.1)


def test_what_gets_hot_within_the_horizon_is_left_out_although_it_begins_cool(holds, courses, plain):
    spec = plain.twin
    assert all(course[:, 0].max() < spec.cool_c for course in courses)
    stays = [bool(course.max() <= spec.cool_c) for course in courses]
    assert 0 < sum(stays) < len(holds)
    kept = cool_plans(holds, HARDWARE, spec)
    assert list(kept) == [plan for plan, cool in zip(holds, stays, strict=True) if cool]
    assert require_cool_plans(holds, HARDWARE, plain) == kept


def test_a_shorter_horizon_lets_more_pass_and_none_of_nothing_is_cool(holds, plain):
    brief = replace(plain.twin, horizon_s=10.0)
    assert cool_plans(holds, HARDWARE, brief) == tuple(holds)
    assert cool_plans([], HARDWARE, brief) == ()
