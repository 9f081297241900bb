"""A small cell of two arms, planned once: whatever they do, both plants move them."""

from functools import cache
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from fleet.arm.model import ArmModel
from fleet.arm.planner import Planner
from fleet.arm.plant import MujocoPlant
from fleet.difficulty import Blind
from fleet.engine.profile_plant import ProfilePlant, recorded_noise, telemetry_of
from fleet.engine.shift import initial, step
from fleet.engine.world import Arm, build_world
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import gen3_network, thermal_model
from fleet.job import Job, Place, Work
from fleet.robot import Mount, Robot, ThermalLimits

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
def planned():
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
            plans=planned()[ROBOTS.index(robot)],
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


def read(world, plant, done, offsets_s):
    """Readings of a step, `Telemetry` [sample, arm, ...]."""
    record = done.record
    noise = recorded_noise(0, record, offsets_s, world.dt_s, len(world.arms))
    return telemetry_of(world, record, offsets_s, plant.motion(world, record, offsets_s), noise)


def recorded(world, plant, offsets_s, **options):
    """Readings of a shift, one `Telemetry` per tick, and its steps."""
    parts, steps = [], []

    def watch(done):
        parts.append(read(world, plant, done, offsets_s))
        steps.append(done)

    work_through(world, plant, watch=watch, **options)
    return parts, steps


@pytest.fixture(scope="session")
def cell() -> SimpleNamespace:
    """The cell, and how its shifts are worked and recorded."""
    return SimpleNamespace(
        robots=ROBOTS, works=WORKS, plans=planned(), HOT=HOT,
        shift=shift, job=job, work_through=work_through, recorded=recorded, read=read,
    )  # fmt: skip
