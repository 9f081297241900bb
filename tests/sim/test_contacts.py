"""Contacts that the MuJoCo plant reports, against distances of all pairs of links and against what is built in."""

from itertools import product

import mujoco
import numpy as np
import pytest

from fleet.arm.cell import APART_S, ContactFinder
from fleet.arm.model import build_cell, links_of
from fleet.arm.planner import Planner
from fleet.arm.plant import STRIDE, TIMESTEP_S, MujocoPlant
from fleet.engine.shift import step
from fleet.engine.state import initial
from fleet.job import Fixture, Place, Work, payload_radius_m
from fleet.offered_plans import PLANS
from fleet.robot import POSTURES, Mount, Robot

ONE = Robot(name="one")
FACING = Robot(name="two", mount=Mount(position_m=(1.3, 0.0, 0.0), tilt_deg=(0.0, 0.0, 180.0)))
SAMPLE_S = STRIDE * TIMESTEP_S


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


def driven(cell, robots, *, contacts):
    """Postures and events of ten seconds in which both arms of the small cell work, their mounts moved to `robots`."""
    world, plants = cell.shift(cell.job("sort"), cell.job("hold"), ticks=2)
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


def test_arms_apart_move_bit_for_bit_as_without_contacts(cell):
    robots = [cell.robots[0], Robot(name="wall", mount=Mount(position_m=(-2.0, 0.0, 0.7), tilt_deg=(0.0, 90.0, 0.0)))]
    with_contacts, events = driven(cell, robots, contacts=True)
    without, _ = driven(cell, robots, contacts=False)
    assert events == []
    assert np.abs(np.diff(with_contacts[:, :, 0], axis=0)).max(axis=(0, 2)).min() > 0.001  # both move
    np.testing.assert_array_equal(with_contacts, without)


def test_crossing_arms_push_one_another_and_are_reported(cell):
    robots = [cell.robots[0], Robot(name="wall", mount=Mount(position_m=(-0.75, 0.0, 0.7), tilt_deg=(0.0, 90.0, 0.0)))]
    motion, events = driven(cell, robots, contacts=True)
    free, unpushed = driven(cell, robots, contacts=False)
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
