"""The two plants against each other, and what a fault must do in both."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.arm.plant import MujocoPlant
from fleet.arrivals import Arrivals
from fleet.engine.profile_plant import sample, sample_row
from fleet.heat.motor import gen3_motors
from fleet.job import KINDS
from fleet.motion import RATE_HZ
from fleet.telemetry import FAULTED, IDLE
from scenarios.prepare.fleet import make_env
from scenarios.spec.schema import ArmSpec, JobStream, Planning, Scenario

# The profile plant


@given(kind=st.sampled_from(KINDS), arm=st.integers(0, 1), cycle=st.integers(0, 4), more=st.integers(1, 5))
def test_every_cycle_is_the_cycle(cell, kind, arm, cycle, more):
    plan = cell.plans[arm][cell.works[kind]][0]
    samples = np.arange(len(plan.cycle.profile))
    time_s = plan.approach.duration_s + cycle * plan.cycle.duration_s + samples / RATE_HZ
    np.testing.assert_array_equal(sample(plan, time_s, cycle + more), plan.cycle.profile)


def test_rows_of_a_job_are_approach_cycles_and_retreat(cell):
    plan = cell.plans[0][cell.works["sort"]][0]
    a, c, r = (len(phase.profile) for phase in plan.phases)
    rows = sample_row(np.array([a, c, r]), np.arange(a + 2 * c + r + 5) / RATE_HZ, 2)
    expected = [*range(a + c), *range(a, a + c), *range(a + c, a + c + r)]
    np.testing.assert_array_equal(rows[: len(expected)], expected)
    np.testing.assert_array_equal(rows[len(expected) :], a + c + r - 1)


@pytest.mark.parametrize("kind", KINDS)
def test_heat_of_a_job_adds_up_to_that_of_its_motion(cell, kind):
    """Heat of all steps, taken back through the motor law, against the motion sampled from end to end."""
    repetitions = 3
    world, plants = cell.shift(cell.job(kind, repetitions=repetitions), ticks=10)
    steps = []
    states = cell.work_through(world, plants["profile"], watch=steps.append)
    assert states[-1].mode[0, 0] == IDLE
    plan = cell.plans[0][cell.works[kind]][0]
    length_s = plan.duration_s(repetitions)
    whole = sample(plan, np.arange(round(length_s * RATE_HZ)) / RATE_HZ, repetitions).astype(float)
    motors = gen3_motors()
    friction = motors.coulomb_nm * np.tanh(whole[:, 1] / motors.v0_rad_s) + motors.viscous_nms_per_rad * whole[:, 1]
    amps = (whole[:, 2] / motors.eta + friction) / motors.torque_per_amp
    rest_s, current_sq, friction_w = world.horizon_s - length_s, 0.0, 0.0
    for done in steps:
        winding_c, housing_c = done.record.start_c[0, 0, :7], done.record.start_c[0, 0, 7:]
        copper = motors.copper_w_per_a2 * (1 + motors.alpha_cu_per_k * (winding_c - motors.reference_c))
        magnets = 1 + motors.alpha_kt_per_k * (housing_c - motors.reference_c)
        current_sq += done.record.heat_w[0, 0, :7] / copper * magnets**2 * world.dt_s
        friction_w += (done.record.heat_w[0, 0, 7:] - motors.idle_w) * world.dt_s
    expected = (amps**2).sum(axis=0) / RATE_HZ + rest_s * world.rest.current_sq[0]
    np.testing.assert_allclose(current_sq, expected, rtol=1e-6)
    expected = (friction * whole[:, 1]).sum(axis=0) / RATE_HZ + rest_s * world.rest.friction_w[0]
    np.testing.assert_allclose(friction_w, expected, rtol=1e-6, atol=1e-9)


# Both plants


def mixed_jobs(cell):
    """Long enough for twenty minutes of two arms."""
    return (
        cell.job("hold", repetitions=50),
        cell.job("pick_place", repetitions=60),
        cell.job("press", repetitions=60, after=("pick_place",)),
        cell.job("sort", repetitions=200, after=("press",)),
    )


def twenty_minutes(cell, ticks):
    world, plants = cell.shift(*mixed_jobs(cell), ticks=ticks)
    return world, [cell.work_through(world, plant, first=(2, 1)) for plant in plants.values()]


def test_motor_temperatures_of_both_plants_agree_after_twenty_minutes(cell):
    _, (profile, simulated) = twenty_minutes(cell, 120)
    assert (profile[-1].status[0, :3] == 2).all()
    assert profile[-1].peak_c.max() > 40.0
    for one, other in zip(profile, simulated, strict=True):
        np.testing.assert_allclose(one.temp_c, other.temp_c, atol=0.05)
        np.testing.assert_array_equal(one.status, other.status)
        np.testing.assert_array_equal(one.finished_s, other.finished_s)


@pytest.mark.slow
def test_motor_temperatures_of_both_plants_agree_after_two_hours(cell):
    world, plants = cell.shift(
        *mixed_jobs(cell), *(cell.job("hold", name=f"more {i}", repetitions=60) for i in range(9)), ticks=720
    )
    profile, simulated = (cell.work_through(world, plant, first=(2, 1)) for plant in plants.values())
    for one, other in zip(profile, simulated, strict=True):
        np.testing.assert_allclose(one.temp_c, other.temp_c, atol=0.5)


@pytest.mark.parametrize("kind", ["hold", "pick_place"])
@pytest.mark.parametrize("name", ["profile", "mujoco"])
def test_a_fault_cuts_the_tick_and_the_brakes_hold_until_the_arm_goes_home(cell, name, kind):
    world, plants = cell.shift(cell.job(kind, repetitions=60), ticks=90, limits=cell.HOT)
    offsets = np.arange(1, 501) / RATE_HZ
    parts, steps = cell.recorded(world, plants[name], offsets)
    cuts = [i for i, done in enumerate(steps) if done.record.cut_s[0, 0] < world.dt_s]
    assert len(cuts) >= 2
    for cut in cuts[:-1]:
        recovered = next(i for i in range(cut + 1, len(steps)) if steps[i].state.mode[0, 0] != FAULTED)
        assert recovered > cut + 2
        braked = offsets >= steps[cut].record.cut_s[0, 0]
        assert 0 < braked.sum() < len(offsets)
        stood = parts[cut].q[braked, 0]
        np.testing.assert_array_equal(stood, np.tile(stood[0], (len(stood), 1)))
        last = parts[cut].q[~braked, 0][-1]
        np.testing.assert_allclose(stood[0], last, atol=1.4 / RATE_HZ)
        for part, rows in [(parts[cut], braked), *((parts[i], slice(None)) for i in range(cut + 1, recovered + 1))]:
            assert np.all(part.mode[rows, 0] == FAULTED)
            for quiet in (part.qd, part.tau, part.current_a):
                assert np.all(quiet[rows, 0] == 0.0)
            np.testing.assert_allclose(part.q[rows, 0], np.tile(stood[0], (len(part.q[rows]), 1)), atol=1e-5)
        assert np.linalg.norm(stood[0] - cell.robots[0].home_q()) > 0.1
        # It goes on from there, along its path.
        np.testing.assert_allclose(parts[recovered + 1].q[0, 0], stood[0], atol=2.8 / RATE_HZ)
    path = np.concatenate([part.q[:, 0] for part in parts])
    assert np.abs(np.diff(path, axis=0)).max() < 1.4 / RATE_HZ
    np.testing.assert_allclose(path[0], cell.robots[0].home_q(), atol=0.05)


def test_a_scenario_chooses_its_plant(cell, tmp_path):
    scenario = Scenario(
        name="two",
        description="",
        horizon_s=60.0,
        arms=(ArmSpec(name="one"), ArmSpec(name="two", position_m=(2.0, 0.0, 0.0))),
        places=cell.places,
        jobs=(
            JobStream(
                name="sort", kind="sort", places=("near", "far"), arrivals=Arrivals(kind="trace", times_s=(0.0,))
            ),
        ),
        planning=Planning(elbows=1, speeds=(1.0,)),
    )
    peaks = {}
    for name in ("profile", "mujoco"):
        env = make_env(scenario, difficulty="blind", plant=name, cache=tmp_path)
        env.reset(seed=0)
        while env.agents:
            env.step(dict.fromkeys(env.agents, 1))
        assert isinstance(env.episode.plant, MujocoPlant) == (name == "mujoco")
        assert (env.truth.status == 2).all()
        peaks[name] = env.truth.temp_c
        env.close()
    np.testing.assert_allclose(peaks["profile"], peaks["mujoco"], atol=0.1)
