"""The simulated plant against the laws of motion, and what it refuses."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.arm.model import ArmModel, build_cell, gen3_xml, set_payload_balls
from fleet.arm.plant import STRIDE, TIMESTEP_S, MujocoPlant, control, load_hands, reference, still
from fleet.engine.profile_plant import sample
from fleet.engine.shift import step
from fleet.engine.state import initial
from fleet.errors import FleetError
from fleet.job import KINDS
from fleet.motion import RATE_HZ, Phase, Plan
from fleet.robot import GEN3
from fleet.telemetry import FAULTED, WORKING

SAMPLE_S = STRIDE * TIMESTEP_S


# The scene


@settings(max_examples=20)
@given(payload_kg=st.floats(0.01, 6.0), seed=st.integers(0, 2**31))
def test_a_loaded_hand_is_a_model_compiled_with_the_load(payload_kg, seed):
    spec = mujoco.MjSpec.from_string(gen3_xml().decode())
    loaded = spec.compile()
    load_hands(loaded, mujoco.MjData(loaded), np.array([loaded.body("payload").id]), np.array([payload_kg]))
    spec.body("payload").mass = payload_kg
    fresh = spec.compile()
    rng = np.random.default_rng(seed)
    q, qd, ctrl = rng.uniform(-2.0, 2.0, (3, 7))
    results = []
    for model in (loaded, fresh):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, qd, ctrl
        mujoco.mj_step(model, data, 10)
        results.append(data.qpos.copy())
    np.testing.assert_allclose(*results, rtol=1e-12, atol=1e-12)
    for name in dir(fresh):
        value = getattr(fresh, name)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            np.testing.assert_allclose(getattr(loaded, name), value, rtol=1e-9, atol=1e-12, err_msg=name)


def test_a_load_taken_off_leaves_no_trace(cell):
    model = build_cell(cell.robots)
    before = {name: np.copy(getattr(model, name)) for name in ("body_subtreemass", "dof_invweight0", "dof_M0")}
    bodies = np.array([model.body(f"{robot.name}/payload").id for robot in cell.robots])
    for payload_kg in ((2.0, 0.5), (0.0, 0.0)):
        load_hands(model, mujoco.MjData(model), bodies, np.array(payload_kg))
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(model, name), value, err_msg=name)


# Motion in the scene


@pytest.mark.parametrize("arm", [0, 1])
@pytest.mark.parametrize("kind", KINDS)
def test_arms_follow_their_plan_and_need_its_torque(cell, kind, arm):
    """Tracking in joint space; the torque of the plan is inverse dynamics of the arm alone, with Jᵀf of a press."""
    repetitions = 2
    world, plants = cell.shift(cell.job(kind, repetitions=repetitions))
    plan = cell.plans[arm][cell.works[kind]][0]
    offsets = np.arange(1, 501) / RATE_HZ
    parts, _ = cell.recorded(world, plants["mujoco"], offsets, first=(1, 0) if arm == 0 else (0, 1))
    count = round(plan.duration_s(repetitions) * RATE_HZ) - 1
    motion = np.stack([np.concatenate([getattr(p, n)[:, arm] for p in parts]) for n in ("q", "qd", "tau")], axis=1)
    planned = sample(plan, np.arange(1, count + 1) / RATE_HZ, repetitions)
    error = motion[:count] - planned
    told, _ = cell.recorded(world, plants["profile"], offsets, first=(1, 0) if arm == 0 else (0, 1))
    np.testing.assert_array_equal(np.concatenate([p.q[:, arm] for p in told])[:count], planned[:, 0])
    np.testing.assert_array_equal(np.concatenate([p.tau[:, arm] for p in told])[:count], planned[:, 2])
    rms = np.sqrt((error**2).mean(axis=0))
    assert rms[0].max() < 1e-4
    assert rms[1].max() < 0.01
    # A switch of the load shows one sample early or late.
    steady = np.abs(np.diff(planned[:, 2], axis=0, prepend=planned[:1, 2])).max(axis=1) < 2.0
    assert np.mean(steady) > 0.9
    assert np.sqrt((error[steady, 2] ** 2).mean(axis=0)).max() < 0.2
    np.testing.assert_allclose(
        motion[count + 1 :, 0], np.tile(cell.robots[arm].home_q(), (3000 - count - 1, 1)), atol=1e-3
    )


def heavy_plan(cell, payload_kg):
    """A made-up hold at home whose payload the plan's torque knows nothing of."""
    robot = cell.robots[0]
    q, tau = robot.home_q(), ArmModel(robot).gravity_torque(robot.home_q())
    profile = np.broadcast_to(np.stack([q, np.zeros(7), tau]), (100, 3, 7)).astype(np.float32)
    none = Phase(np.zeros((0, 3, 7), np.float32), np.zeros(0, np.float32))
    cycle = Phase(profile, np.full(100, payload_kg, np.float32))
    return Plan(robot.name, cell.works["hold"], 0, 1.0, none, cycle, none)


@pytest.mark.parametrize("clips", [False, True])
def test_torque_is_what_changes_the_momentum(cell, clips):
    """Second method: a plain loop of `mj_step`, and M (v⁺ − v)/h + c − Jᵀf from its states."""
    plan = heavy_plan(cell, 60.0) if clips else cell.plans[0][cell.works["press"]][0]
    world, _ = cell.shift(cell.job("press"), robots=cell.robots[:1], dt_s=2.0)
    rest_tau = ArmModel(cell.robots[0]).gravity_torque(cell.robots[0].home_q())
    plant = MujocoPlant(cell.robots[:1], [plan], rest_tau[None])
    state = initial(world)
    state.mode[:], state.job[:], state.plan[:], state.todo[:] = WORKING, 0, 0, 5
    states = [state]
    for _ in range(2):  # The second tick is looked at: the press begins in it.
        done = step(world, states[-1], np.zeros((1, 1), int), plant)
        read = cell.read(world, plant, done, np.arange(1, 201) * SAMPLE_S)
        states.append(done.state)
    model = build_cell(cell.robots[:1])
    data, scratch = mujoco.MjData(model), mujoco.MjData(model)
    kp, kv = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]
    body = np.array([model.body("floor/payload").id])
    data.qpos[:] = cell.robots[0].home_q()
    tau, q, inertia, jacobian = [], [], np.empty((7, 7)), np.empty((3, 7))
    for tick in range(2):
        home = still(cell.robots[0].home_q(), rest_tau, 100)
        told = reference(plan, 5, 2.0 * tick, 100, home)
        for i, ctrl in enumerate(control([told], 10, kp, kv)):
            set_payload_balls(model, body, told.payload_kg[[i // 10]])
            load_hands(model, scratch, body, told.payload_kg[[i // 10]])
            data.ctrl[:] = ctrl
            data.xfrc_applied[body, :3] = told.force_n[i // 10]
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, inertia)
            mujoco.mj_jacBody(model, data, jacobian, None, body[0])
            before, bias = data.qvel.copy(), data.qfrc_bias - jacobian.T @ told.force_n[i // 10]
            mujoco.mj_step(model, data)
            if tick == 1 and i % STRIDE == STRIDE - 1:
                tau.append(inertia @ (data.qvel - before) / TIMESTEP_S + bias - data.qfrc_constraint)
                q.append(data.qpos.copy())
    np.testing.assert_allclose(read.q[:, 0], q, atol=1e-9)
    np.testing.assert_allclose(read.tau[:, 0], tau, atol=1e-6)
    limit = np.array(GEN3.torque_clip)
    # Damping taken at the end of a step may add a little to a force just below the clip.
    assert np.all(np.abs(read.tau[:, 0]) <= 1.1 * limit)
    assert np.any(np.isclose(np.abs(read.tau[:, 0]), limit)) == clips


def test_torque_goes_straight_but_jumps_with_the_load():
    """At rest with no stiffness to speak of, ctrl · kp − kp · q is the torque alone."""
    home = still(np.zeros(7), np.zeros(7), 3)
    motion = home.motion.copy()
    motion[2:, 2] = 6.0  # from sample 2 on
    kp, kv = np.full(7, 1000.0), np.full(7, 10.0)
    straight = control([replace(home, motion=motion)], 3, kp, kv) * kp
    np.testing.assert_allclose(straight[:, 0], [0, 0, 0, 0, 2, 4, 6, 6, 6], atol=1e-12)
    jumps = [0, 0, 0, 0, 0, 0, 6, 6, 6]
    payload_kg, force_n = np.array([0.0, 0.0, 1.0, 1.0]), np.zeros((4, 3))
    grasped = control([replace(home, motion=motion, payload_kg=payload_kg)], 3, kp, kv) * kp
    np.testing.assert_allclose(grasped[:, 0], jumps, atol=1e-12)
    force_n[2:, 1] = -3.0
    pressed = control([replace(home, motion=motion, force_n=force_n)], 3, kp, kv) * kp
    np.testing.assert_allclose(pressed[:, 0], jumps, atol=1e-12)


# Faults and readings


def test_only_faulted_arms_heat_nothing(cell):
    world, plants = cell.shift(cell.job("hold", repetitions=20), ticks=40, limits=cell.HOT)
    drives = []
    plant = plants["mujoco"]
    inner = plant.drive

    def spy(world, state):
        drives.append((state.mode[0].copy(), inner(world, state)))
        return drives[-1][1]

    plant.drive = spy
    cell.work_through(world, plant)
    modes = np.array([mode for mode, _ in drives])
    heats = np.array([drive.current_sq[0].any(axis=-1) for _, drive in drives])
    rubs = np.array([drive.friction_w[0].any(axis=-1) for _, drive in drives])
    assert (modes == FAULTED).any()
    np.testing.assert_array_equal(heats, modes != FAULTED)
    assert not rubs[modes == FAULTED].any()


def test_looking_at_the_sensors_changes_nothing(cell):
    seen, unseen = [], []
    for states, watched in ((seen, True), (unseen, False)):
        world, plants = cell.shift(cell.job("hold", repetitions=20), ticks=40, limits=cell.HOT)
        plant = plants["mujoco"]

        def watch(done, world=world, plant=plant):
            cell.read(world, plant, done, np.array([5.0]))

        states += cell.work_through(world, plant, watch=watch if watched else None)
        states.append(plant.data.qpos.copy())
    np.testing.assert_array_equal(seen[-1], unseen[-1])
    np.testing.assert_array_equal(seen[-2].temp_c, unseen[-2].temp_c)


def test_tick_zero_starts_afresh(cell):
    world, plants = cell.shift(cell.job("sort", repetitions=90), cell.job("hold"), ticks=4)
    first, second = (cell.work_through(world, plants["mujoco"])[-1].temp_c for _ in range(2))
    np.testing.assert_array_equal(first, second)


# Errors


def test_many_envs_are_refused(cell):
    world, plants = cell.shift(cell.job("sort"), shifts=2)
    with pytest.raises(ValueError, match=r"simulates one env \(got 2\)"):
        step(world, initial(world), np.zeros((2, 2), int), plants["mujoco"])


def test_ticks_must_come_in_order(cell):
    world, plants = cell.shift(cell.job("sort"))
    done = step(world, initial(world), np.zeros((1, 2), int), plants["mujoco"])
    later = done.state._replace(tick=done.state.tick + 1)
    with pytest.raises(ValueError, match=r"1 is next \(got 2\)"):
        step(world, later, np.zeros((1, 2), int), plants["mujoco"])


def test_only_the_last_tick_can_be_read(cell):
    world, plants = cell.shift(cell.job("sort"))
    done = step(world, initial(world), np.zeros((1, 2), int), plants["mujoco"])
    step(world, done.state, np.zeros((1, 2), int), plants["mujoco"])
    with pytest.raises(ValueError, match=r"tick 1 only \(got 0\)"):
        plants["mujoco"].motion(world, done.record, np.array([1.0]))


def test_a_simulation_that_diverges_is_an_error(cell, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning into a file.
    plan = cell.plans[0][cell.works["press"]][0]
    world, _ = cell.shift(cell.job("press"), robots=cell.robots[:1])
    work = replace(plan.work)
    object.__setattr__(work, "force_n", 1e12)  # beyond the bounds of a work
    plant = MujocoPlant(cell.robots[:1], [replace(plan, work=work)], np.zeros((1, 7)))
    with pytest.raises(FleetError, match="diverged in tick 0"):
        step(world, initial(world), np.ones((1, 1), int), plant)


def test_a_step_must_be_whole_samples(cell):
    world, plants = cell.shift(cell.job("sort"), dt_s=1.01)
    with pytest.raises(ValueError, match=r"whole 0.02 s \(got 1.01 s\)"):
        step(world, initial(world), np.zeros((1, 2), int), plants["mujoco"])


@pytest.mark.parametrize("timestep_s", [0.003, 0.02, 0.005])
def test_a_timestep_must_fit_into_a_sample(cell, timestep_s):
    with pytest.raises(ValueError, match="must be 4, 2, 1"):
        MujocoPlant(cell.robots, [], np.zeros((2, 7)), timestep_s=timestep_s)
