"""The simulated plants against each other, the laws of motion and all pairs of links."""

from dataclasses import replace
from functools import cache
from itertools import product

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.arm.cell import APART_S, ContactFinder
from fleet.arm.gen3 import gen3_xml
from fleet.arm.model import ArmModel, build_cell, links_of, set_payload_balls
from fleet.arm.planner import Planner
from fleet.arm.plant import STRIDE, TIMESTEP_S, MujocoPlant, control, load_hands, reference, still
from fleet.difficulty import Blind
from fleet.engine.profile_plant import ProfilePlant, recorded_noise, sample, sample_row, telemetry_of
from fleet.engine.shift import initial, step
from fleet.engine.tables import drive_of
from fleet.engine.world import Arm, build_world
from fleet.errors import FleetError
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import gen3_network, thermal_model
from fleet.job import KINDS, Fixture, Job, Place, Work, payload_radius_m
from fleet.motion import RATE_HZ, Phase, Plan
from fleet.offered_plans import PLANS
from fleet.robot import GEN3, POSTURES, Mount, Robot, ThermalLimits
from fleet.telemetry import FAULTED, IDLE, WORKING

SAMPLE_S = STRIDE * TIMESTEP_S

# A small cell of two arms, planned once: whatever they do, both plants move them

ROBOTS = (
    Robot(name="floor"),
    Robot(name="wall", mount=Mount(position_m=(-0.3, 0.0, 0.7), tilt_deg=(0.0, 90.0, 0.0)), tool_kg=0.5),
)
NEAR = Place(name="near", position_m=(0.45, 0.15, 0.25))
FAR = Place(name="far", position_m=(0.40, -0.30, 0.30))
FACE = Place(name="face", position_m=(0.55, 0.0, 0.45), tool_deg=(0.0, 90.0, 0.0))
WORKS = {
    "pick_place": Work(kind="pick_place", places=(NEAR, FAR), payload_kg=2.0),
    "sort": Work(kind="sort", places=(NEAR, FAR), payload_kg=0.2, dwell_s=0.2),
    "hold": Work(kind="hold", places=(FACE,), payload_kg=3.0, dwell_s=20.0),
    "press": Work(kind="press", places=(NEAR,), force_n=40.0, payload_kg=0.5, dwell_s=4.0),
}
HOT = ThermalLimits(error_c=26.0, warning_c=25.8, restart_c=25.6, clear_s=5.0)
"""A working arm passes this from 25 °C within a minute, and is back soon."""


@cache
def plans_of_arms():
    """What each arm would do for each work."""
    planners = [Planner(robot, elbows=1, speeds=(1.0,)) for robot in ROBOTS]
    return [{work: planner.plan(work) for work in WORKS.values()} for planner in planners]


def shift(*jobs, ticks=6, dt_s=10.0, limits=None, robots=ROBOTS, shifts=1):
    """World of a small cell at 25 °C, and its two plants by name."""
    arms = [
        Arm(
            robot=robot,
            motors=gen3_motors(),
            thermal=thermal_model(gen3_network()),
            rest_tau=ArmModel(robot).gravity_torque(robot.home_q()),
            model=Blind(),
            plans=plans_of_arms()[ROBOTS.index(robot)],
        )
        for robot in robots
    ]
    world = build_world(
        arms,
        [jobs] * shifts,
        limits=limits or ThermalLimits(),
        dt_s=dt_s,
        ticks=ticks,
        slots=8,
        ambient_c=np.full((ticks, len(arms)), 25.0),
        start_warm=False,
    )
    plans = world.plans
    rest_tau = np.stack([arm.rest_tau for arm in arms])
    home = np.stack([robot.home_q() for robot in robots])
    simulated = MujocoPlant(robots, plans, rest_tau)
    # The arms of this cell pass through each other, so that both can do all works at any time.
    simulated.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return world, {"profile": ProfilePlant(plans, home, rest_tau), "mujoco": simulated}


def job(kind, name=None, repetitions=10, after=()):
    return Job(
        name=name or kind, work=WORKS[kind], repetitions=repetitions, release_s=0.0, due_s=9e3, value=1.0, after=after
    )


def work_through(world, plant, first=(1, 0), watch=None):
    """States after each tick; free arms then take turns at the first job on offer."""
    state, states = initial(world), []
    for tick in range(world.ticks):
        actions = np.array([first]) if tick == 0 else (np.arange(len(world.arms)) == tick % len(world.arms))[None]
        done = step(world, state, actions.astype(int), plant)
        if watch is not None:
            watch(done)
        state = done.state
        states.append(state)
    return states


def read_sensors(world, plant, done, offsets_s):
    """Readings of a step, `Telemetry` [sample, arm, ...]."""
    record = done.record
    noise = recorded_noise(0, record, offsets_s, world.dt_s, len(world.arms))
    return telemetry_of(world, record, offsets_s, plant.motion(world, record, offsets_s), noise)


def recorded(world, plant, offsets_s, **options):
    """Readings of a shift, one `Telemetry` per tick, and its steps."""
    parts, steps = [], []

    def watch(done):
        parts.append(read_sensors(world, plant, done, offsets_s))
        steps.append(done)

    work_through(world, plant, watch=watch, **options)
    return parts, steps


# The scene


@settings(max_examples=8)
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


def test_a_load_taken_off_leaves_no_trace():
    model = build_cell(ROBOTS)
    before = {name: np.copy(getattr(model, name)) for name in ("body_subtreemass", "dof_invweight0", "dof_M0")}
    bodies = np.array([model.body(f"{robot.name}/payload").id for robot in ROBOTS])
    for payload_kg in ((2.0, 0.5), (0.0, 0.0)):
        load_hands(model, mujoco.MjData(model), bodies, np.array(payload_kg))
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(model, name), value, err_msg=name)


# Motion in the scene


@pytest.mark.parametrize(("kind", "arm"), [("pick_place", 0), ("sort", 1), ("hold", 1), ("press", 0)])
def test_arms_follow_their_plan_and_need_its_torque(kind, arm):
    """Tracking in joint space; the torque of the plan is inverse dynamics of the arm alone, with Jᵀf of a press."""
    repetitions = 2
    world, plants = shift(job(kind, repetitions=repetitions))
    plan = plans_of_arms()[arm][WORKS[kind]][0]
    offsets = np.arange(1, 501) / RATE_HZ
    parts, _ = recorded(world, plants["mujoco"], offsets, first=(1, 0) if arm == 0 else (0, 1))
    count = round(plan.duration_s(repetitions) * RATE_HZ) - 1
    motion = np.stack([np.concatenate([getattr(p, n)[:, arm] for p in parts]) for n in ("q", "qd", "tau")], axis=1)
    planned = sample(plan, np.arange(1, count + 1) / RATE_HZ, repetitions)
    error = motion[:count] - planned
    told, _ = recorded(world, plants["profile"], offsets, first=(1, 0) if arm == 0 else (0, 1))
    np.testing.assert_array_equal(np.concatenate([p.q[:, arm] for p in told])[:count], planned[:, 0])
    np.testing.assert_array_equal(np.concatenate([p.tau[:, arm] for p in told])[:count], planned[:, 2])
    rms = np.sqrt((error**2).mean(axis=0))
    assert rms[0].max() < 1e-4
    assert rms[1].max() < 0.01
    # A switch of the load shows one sample early or late.
    steady = np.abs(np.diff(planned[:, 2], axis=0, prepend=planned[:1, 2])).max(axis=1) < 2.0
    assert np.mean(steady) > 0.9
    assert np.sqrt((error[steady, 2] ** 2).mean(axis=0)).max() < 0.2
    np.testing.assert_allclose(motion[count + 1 :, 0], np.tile(ROBOTS[arm].home_q(), (3000 - count - 1, 1)), atol=1e-3)


def heavy_plan(payload_kg):
    """A made-up hold at home whose payload the plan's torque knows nothing of."""
    robot = ROBOTS[0]
    q, tau = robot.home_q(), ArmModel(robot).gravity_torque(robot.home_q())
    profile = np.broadcast_to(np.stack([q, np.zeros(7), tau]), (100, 3, 7)).astype(np.float32)
    none = Phase(np.zeros((0, 3, 7), np.float32), np.zeros(0, np.float32))
    cycle = Phase(profile, np.full(100, payload_kg, np.float32))
    return Plan(robot.name, WORKS["hold"], 0, 1.0, none, cycle, none)


@pytest.mark.parametrize("clips", [False, True])
def test_torque_is_what_changes_the_momentum(clips):
    """Second method: a plain loop of `mj_step`, and M (v⁺ − v)/h + c − Jᵀf from its states."""
    plan = heavy_plan(60.0) if clips else plans_of_arms()[0][WORKS["press"]][0]
    world, _ = shift(job("press"), robots=ROBOTS[:1], dt_s=2.0)
    rest_tau = ArmModel(ROBOTS[0]).gravity_torque(ROBOTS[0].home_q())
    plant = MujocoPlant(ROBOTS[:1], [plan], rest_tau[None])
    state = initial(world)
    state.mode[:], state.job[:], state.plan[:], state.todo[:] = WORKING, 0, 0, 5
    states = [state]
    for _ in range(2):  # The second tick is looked at: the press begins in it.
        done = step(world, states[-1], np.zeros((1, 1), int), plant)
        read = read_sensors(world, plant, done, np.arange(1, 201) * SAMPLE_S)
        states.append(done.state)
    model = build_cell(ROBOTS[:1])
    data, scratch = mujoco.MjData(model), mujoco.MjData(model)
    kp, kv = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]
    body = np.array([model.body("floor/payload").id])
    data.qpos[:] = ROBOTS[0].home_q()
    tau, q, inertia, jacobian = [], [], np.empty((7, 7)), np.empty((3, 7))
    for tick in range(2):
        home = still(ROBOTS[0].home_q(), rest_tau, 100)
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


def test_only_faulted_arms_heat_nothing():
    world, plants = shift(job("hold"), ticks=1)
    state = initial(world)
    state.mode[:] = FAULTED, IDLE
    drive = plants["mujoco"].drive(world, state)
    assert drive.current_sq[0].any(axis=-1).tolist() == [False, True]
    assert not drive.friction_w[0, 0].any()


def test_tick_zero_starts_afresh_and_looking_at_the_sensors_changes_nothing():
    world, plants = shift(job("sort", repetitions=90), job("hold"), ticks=3)
    plant, ends = plants["mujoco"], []

    def look(done):
        read_sensors(world, plant, done, np.array([5.0]))

    for watch in (None, look):
        states = work_through(world, plant, watch=watch)
        ends.append((plant.data.qpos.copy(), states[-1].temp_c))
    np.testing.assert_equal(*ends)


# Errors


def test_many_envs_and_parts_of_samples_are_refused_and_ticks_come_in_order():
    for (world, plants), nobody, said in (
        (shift(job("sort"), shifts=2), np.zeros((2, 2), int), r"simulates one env \(got 2\)"),
        (shift(job("sort"), dt_s=1.01), np.zeros((1, 2), int), r"whole 0.02 s \(got 1.01 s\)"),
    ):
        with pytest.raises(ValueError, match=said):
            step(world, initial(world), nobody, plants["mujoco"])
    world, plants = shift(job("sort"))
    done = step(world, initial(world), np.zeros((1, 2), int), plants["mujoco"])
    later = done.state.changed(tick=done.state.tick + 1)
    with pytest.raises(ValueError, match=r"1 is next \(got 2\)"):
        step(world, later, np.zeros((1, 2), int), plants["mujoco"])
    step(world, done.state, np.zeros((1, 2), int), plants["mujoco"])
    with pytest.raises(ValueError, match=r"tick 1 only \(got 0\)"):
        plants["mujoco"].motion(world, done.record, np.array([1.0]))


def test_a_simulation_that_diverges_is_an_error(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning into a file.
    plan = plans_of_arms()[0][WORKS["press"]][0]
    world, _ = shift(job("press"), robots=ROBOTS[:1])
    work = replace(plan.work)
    object.__setattr__(work, "force_n", 1e12)  # beyond the bounds of a work
    plant = MujocoPlant(ROBOTS[:1], [replace(plan, work=work)], np.zeros((1, 7)))
    with pytest.raises(FleetError, match="diverged in tick 0"):
        step(world, initial(world), np.ones((1, 1), int), plant)


def test_a_timestep_must_fit_into_a_sample():
    with pytest.raises(ValueError, match="must be 4, 2, 1"):
        MujocoPlant(ROBOTS, [], np.zeros((2, 7)), timestep_s=0.003)


ONE = Robot(name="one")
FACING = Robot(name="two", mount=Mount(position_m=(1.3, 0.0, 0.0), tilt_deg=(0.0, 0.0, 180.0)))


def towards(robot, seconds=2.0):
    """A path from home to outstretched and back, rad, [sample, joint]."""
    share = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(0.0, seconds, SAMPLE_S) / seconds)
    return robot.home_q() + share[:, None] * (np.array(POSTURES["outstretched"]) - robot.home_q())


def found(robots, q, payload_kg=None, fixtures=()):
    """Events of recorded postures [sample, arm, joint]."""
    payload_kg = np.zeros(q.shape[:2]) if payload_kg is None else payload_kg
    finder = ContactFinder(build_cell(robots, fixtures=fixtures), robots)
    return finder.events(np.arange(len(q)) * SAMPLE_S, q, payload_kg)


def distances_m(robots, q):
    """Distance of every pair of links of the two arms, by reason of an event, [sample]."""
    model = build_cell(robots)
    data = mujoco.MjData(model)
    pairs = {
        f"{a} of {robots[0].name} and {b} of {robots[1].name}": [
            model.geom(f"{robot.name}/{link}").id for robot, link in zip(robots, (a, b), strict=True)
        ]
        for a, b in product(*(links_of(model, robot.name) for robot in robots))
    }
    out = {names: np.empty(len(q)) for names in pairs}
    for i, postures in enumerate(q):
        data.qpos[:] = postures.ravel()
        mujoco.mj_kinematics(model, data)
        for names, geoms in pairs.items():
            out[names][i] = mujoco.mj_geomDistance(model, data, *geoms, 5.0, None)
    return out


def check_against_distances(events, robots, q, tolerance_m=1e-4):
    """Every pair is reported when its distance first becomes negative, with its greatest depth, and no other."""
    reported = {event.reason.rpartition(",")[0]: event for event in events}
    assert len(reported) == len(events)
    assert {event.arm for event in events} <= {robots[0].name}
    for names, apart_m in distances_m(robots, q).items():
        inside = np.flatnonzero(apart_m < 0)
        if apart_m.min() < -tolerance_m:
            event = reported.pop(names)
            assert event.kind == "contact"
            assert event.time_s == pytest.approx(inside[0] * SAMPLE_S, abs=SAMPLE_S + 1e-9)
            # The depth of boxes and cylinders is that of one of their contact points.
            assert event.value == pytest.approx(-1e3 * apart_m.min(), rel=0.02, abs=0.5)
            assert event.reason.endswith(f", {event.value:.1f} mm deep")
        elif apart_m.min() > tolerance_m:
            assert names not in reported


def test_arms_that_reach_for_one_another_are_reported_link_by_link():
    q = np.stack([towards(ONE), towards(FACING)], axis=1)
    events = found([ONE, FACING], q)
    assert 1 < len(events) < 30
    assert [event.time_s for event in events] == sorted(event.time_s for event in events)
    check_against_distances(events, [ONE, FACING], q, tolerance_m=2e-3)


def test_arms_apart_an_arm_in_itself_and_bases_on_the_floor_give_none():
    folded = np.tile([0.0, 2.1, 0.0, 2.5, 0.0, 0.0, 0.0], (10, 1))
    high = Robot(name="high", mount=Mount(position_m=(3.0, 0.0, 1.0)))
    assert found([ONE, FACING], np.tile(ONE.home_q(), (10, 2, 1))) == []
    assert found([high], folded[:, None]) == []


@pytest.mark.parametrize(("pause_s", "count"), [(APART_S / 2, 1), (2 * APART_S, 2)])
@pytest.mark.parametrize("cut", [None, 30, 130])
def test_a_contact_is_one_event_until_the_links_were_apart(pause_s, count, cut):
    """The arm's hand is in the floor for a second, out of it, and in it again."""
    low, pause = np.array([0.0, 1.9, 0.0, 0.0, 0.0, 0.0, 0.0]), round(pause_s / SAMPLE_S)
    q = np.concatenate(
        [np.tile(ONE.home_q(), (n, 1)) if n == pause else np.tile(low, (n, 1)) for n in (100, pause, 99)]
    )
    whole = found([ONE], q[:, None])
    assert {event.reason.split(" and ")[1].split(",")[0] for event in whole} == {"the floor"}
    hand = [event for event in whole if event.reason.startswith("bracelet of one and the floor")]
    assert [event.time_s for event in hand] == pytest.approx([0.0, 1.0 + pause_s][:count])
    if cut is not None:  # the same in two stretches
        finder, times = ContactFinder(build_cell([ONE]), [ONE]), np.arange(len(q)) * SAMPLE_S
        parts = [(slice(cut),), (slice(cut, None),)]
        events = [
            e for (part,) in parts for e in finder.events(times[part], q[part, None], np.zeros((len(q[part]), 1)))
        ]
        assert [(e.time_s, e.reason) for e in events] == [(e.time_s, e.reason) for e in whole]


def test_a_payload_in_a_table_is_reported_while_it_is_carried():
    """The plan does not know the table, whose top is 10 mm above the lower end of the payload."""
    work = Work(kind="hold", places=(Place(name="at", position_m=(0.45, 0.0, 0.25)),), payload_kg=2.0, dwell_s=2.0)
    plan = Planner(ONE, elbows=1, speeds=(1.0,)).plan(work)[0]
    top_m = 0.25 - 2 * payload_radius_m(2.0) + 0.01
    table = Fixture(name="table", position_m=(0.45, 0.0, top_m / 2), size_m=(0.3, 0.3, top_m))
    q = np.concatenate([phase.profile[:, 0] for phase in plan.phases]).astype(float)[:, None]
    payload_kg = np.concatenate([phase.payload_kg for phase in plan.phases])[:, None]
    (event,) = found([ONE], q, payload_kg, [table])
    assert event.reason == "payload of one and the fixture 'table', 10.0 mm deep"
    assert event.time_s == pytest.approx(np.flatnonzero(payload_kg)[0] * SAMPLE_S)
    assert found([ONE], q, fixtures=[table]) == []


# In the plant


def driven(robots, *, contacts):
    """Postures and events of ten seconds in which both arms of the small cell work, their mounts moved to `robots`."""
    world, plants = shift(job("sort"), job("hold"), ticks=2)
    plant = MujocoPlant(robots, plants["mujoco"]._plans, plants["mujoco"]._home_tau)
    if not contacts:
        plant.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    state, motion, events = initial(world), [], []
    for tick in range(world.ticks):
        done = step(world, state, np.array([[1, 1 + PLANS]]) * (tick == 0), plant)
        motion.append(plant.motion(world, done.record, np.arange(1, round(world.dt_s / SAMPLE_S) + 1) * SAMPLE_S)[0])
        events += plant.contacts(world, done.record)
        state = done.state
    return np.concatenate(motion), events


def test_arms_apart_move_bit_for_bit_as_without_contacts():
    robots = [ROBOTS[0], Robot(name="wall", mount=Mount(position_m=(-2.0, 0.0, 0.7), tilt_deg=(0.0, 90.0, 0.0)))]
    with_contacts, events = driven(robots, contacts=True)
    without, _ = driven(robots, contacts=False)
    assert events == []
    assert np.abs(np.diff(with_contacts[:, :, 0], axis=0)).max(axis=(0, 2)).min() > 0.001  # both move
    np.testing.assert_array_equal(with_contacts, without)


def test_crossing_arms_push_one_another_and_are_reported():
    robots = [ROBOTS[0], Robot(name="wall", mount=Mount(position_m=(-0.75, 0.0, 0.7), tilt_deg=(0.0, 90.0, 0.0)))]
    motion, events = driven(robots, contacts=True)
    free, unpushed = driven(robots, contacts=False)
    assert events
    first = events[0].time_s
    before = round(first / SAMPLE_S) - 1
    assert before > 10
    np.testing.assert_array_equal(motion[:before], free[:before])
    assert not np.array_equal(motion, free)
    assert events[0].value < 0.1 * unpushed[0].value
    inside = {names: m for names, m in distances_m(robots, motion[:, :, 0]).items() if m.min() < -1e-3}
    apart = min((np.flatnonzero(m < 0)[0] + 1) * SAMPLE_S for m in inside.values())
    assert first == pytest.approx(apart, abs=SAMPLE_S + 1e-9)
    assert set(inside) <= {event.reason.rpartition(",")[0] for event in events}


# The profile plant


@given(kind=st.sampled_from(KINDS), arm=st.integers(0, 1), cycle=st.integers(0, 4), more=st.integers(1, 5))
def test_every_cycle_is_the_cycle(kind, arm, cycle, more):
    plan = plans_of_arms()[arm][WORKS[kind]][0]
    samples = np.arange(len(plan.cycle.profile))
    time_s = plan.approach.duration_s + cycle * plan.cycle.duration_s + samples / RATE_HZ
    np.testing.assert_array_equal(sample(plan, time_s, cycle + more), plan.cycle.profile)


def test_rows_of_a_job_are_approach_cycles_and_retreat():
    plan = plans_of_arms()[0][WORKS["sort"]][0]
    a, c, r = (len(phase.profile) for phase in plan.phases)
    rows = sample_row(np.array([a, c, r]), np.arange(a + 2 * c + r + 5) / RATE_HZ, 2)
    expected = [*range(a + c), *range(a, a + c), *range(a + c, a + c + r)]
    np.testing.assert_array_equal(rows[: len(expected)], expected)
    np.testing.assert_array_equal(rows[len(expected) :], a + c + r - 1)


@pytest.mark.parametrize("kind", KINDS)
def test_heat_of_a_job_adds_up_to_that_of_its_motion(kind):
    """Heat of all steps, taken back through the motor law, against the motion sampled from end to end."""
    repetitions = 3
    world, plants = shift(job(kind, repetitions=repetitions), ticks=10)
    steps = []
    states = work_through(world, plants["profile"], watch=steps.append)
    assert states[-1].mode[0, 0] == IDLE
    plan = plans_of_arms()[0][WORKS[kind]][0]
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
    expected = (amps**2).sum(axis=0) / RATE_HZ + rest_s * drive_of(world.tables.start[0])[0][0]
    np.testing.assert_allclose(current_sq, expected, rtol=1e-6)
    expected = (friction * whole[:, 1]).sum(axis=0) / RATE_HZ + rest_s * drive_of(world.tables.start[0])[1][0]
    heat_w = max(float(done.record.heat_w[0, 0, 7:].max()) for done in steps)
    rounding_j = 0.5 * world.horizon_s * float(np.spacing(np.float32(heat_w)))  # the engine has heat in float32
    np.testing.assert_allclose(friction_w, expected, rtol=1e-6, atol=rounding_j)


# Both plants


@pytest.mark.ci_slow
def test_motor_temperatures_of_both_plants_agree_after_twenty_minutes():
    jobs = (
        job("hold", repetitions=50),
        job("pick_place", repetitions=60),
        job("press", repetitions=60, after=("pick_place",)),
        job("sort", repetitions=200, after=("press",)),
    )
    world, plants = shift(*jobs, ticks=120)
    profile, simulated = (work_through(world, plant, first=(2, 1)) for plant in plants.values())
    assert (profile[-1].status[0, :3] == 2).all()
    assert profile[-1].peak_c.max() > 40.0
    for one, other in zip(profile, simulated, strict=True):
        np.testing.assert_allclose(one.temp_c, other.temp_c, atol=0.05)
        np.testing.assert_array_equal(one.status, other.status)
        np.testing.assert_array_equal(one.finished_s, other.finished_s)


@pytest.mark.ci_slow
@pytest.mark.parametrize(("name", "kind"), [("profile", "hold"), ("mujoco", "pick_place")])
def test_a_fault_cuts_the_tick_and_the_brakes_hold_until_the_arm_goes_home(name, kind):
    world, plants = shift(job(kind, repetitions=60), ticks=90, limits=HOT)
    offsets = np.arange(1, 501) / RATE_HZ
    parts, steps = recorded(world, plants[name], offsets)
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
        assert np.linalg.norm(stood[0] - ROBOTS[0].home_q()) > 0.1
        # It goes on from there, along its path.
        np.testing.assert_allclose(parts[recovered + 1].q[0, 0], stood[0], atol=2.8 / RATE_HZ)
    path = np.concatenate([part.q[:, 0] for part in parts])
    assert np.abs(np.diff(path, axis=0)).max() < 1.4 / RATE_HZ
    np.testing.assert_allclose(path[0], ROBOTS[0].home_q(), atol=0.05)
