"""Arms that a fault stops, and jobs that are given back or expire."""

import math

import numpy as np
import pytest

from fleet.engine.shift import initial, open_jobs, step
from fleet.engine.state import DONE, EXPIRED, GIVEN_UP, WAITING
from fleet.robot import ThermalLimits
from fleet.telemetry import FAULTED, IDLE, WORKING
from tests.shifts import with_conflicts

DT_S = 10.0


def crossing(small, *, limits, ticks=400, repetitions=200):
    """Two arms whose plans touch: arm 0 overheats at the press, arm 1 could use the rack."""
    hot, light = small.work("press", 8.0), small.work("rack", small.LIGHT)
    jobs = [small.job("hot", hot, repetitions=repetitions), small.job("light", light, repetitions=2)]
    fleet = [small.arm(0, [hot]), small.arm(1, [light])]
    world, plant = small.shop([jobs], arms=fleet, limits=limits, ticks=ticks, slots=2)
    touching = np.ones((2, 2), bool) ^ np.eye(2, dtype=bool)
    return with_conflicts(world, touching), plant


def until_the_fault(world, plant, log):
    """Play until arm 0 faults, and return the states before and after that step."""
    state, action = initial(world), np.array([[1, 0]])
    for _ in range(world.ticks):
        before, state = state, step(world, state, action, plant, log).state
        action = np.zeros((1, 2), int)
        if state.mode[0, 0] == FAULTED:
            return before, state
    raise AssertionError("no fault")


def test_a_stopped_arm_keeps_its_space_until_it_is_home(small) -> None:
    """It ends the cycle in which it stopped and goes home; spans are 3 s, 10 s a cycle and 2 s."""
    world, plant = crossing(small, limits=ThermalLimits(move_home_s=6e5))
    log = []
    _, state = until_the_fault(world, plant, log)
    fault = next(e for e in log if e.kind == "fault")
    cycles = math.floor((fault.time_s - 3.0) / 10.0)
    left_s = 3.0 + 10.0 * (cycles + 1) + 2.0 - fault.time_s
    wait = np.zeros((1, 2), int)
    while not any(e.kind == "home" for e in log):
        assert state.plan[0, 0] >= 0
        slot_job, mask = open_jobs(world, state)
        assert slot_job[0].tolist() == [1, 0]  # the hot one came back, and queues behind
        assert not mask[0, 1, 1:].any()
        state = step(world, state, wait, plant, log).state
    recover, home = (next(e for e in log if e.kind == kind) for kind in ("recover", "home"))
    begin_s = math.ceil(recover.time_s / DT_S) * DT_S
    assert home.time_s == pytest.approx(begin_s + left_s, abs=1e-6)
    assert (state.mode[0, 0], state.plan[0, 0], state.job[0, 0]) == (IDLE, -1, -1)
    assert open_jobs(world, state)[1][0, 1].tolist() == [1, 1, 0, 0]
    assert state.cycles[0, 0] == cycles


@pytest.mark.parametrize("move_home_s", [0.0, 33.0, 250.0])
def test_a_person_moves_a_stopped_arm_home(small, move_home_s) -> None:
    world, plant = crossing(small, limits=ThermalLimits(move_home_s=move_home_s, clear_s=600.0))
    log = []
    _, state = until_the_fault(world, plant, log)
    while not any(e.kind == "moved" for e in log):
        assert not open_jobs(world, state)[1][0, 1, 1:].any()
        state = step(world, state, np.zeros((1, 2), int), plant, log).state
    fault, moved = (next(e for e in log if e.kind == kind) for kind in ("fault", "moved"))
    assert moved.time_s == pytest.approx(fault.time_s + move_home_s)
    assert (state.mode[0, 0], state.plan[0, 0]) == (FAULTED, -1)
    assert open_jobs(world, state)[1][0, 1, 1]
    while not any(e.kind == "recover" for e in log):
        state = step(world, state, np.zeros((1, 2), int), plant, log).state
    assert state.mode[0, 0] == IDLE
    assert not any(e.kind == "home" for e in log)


def test_a_job_that_faults_three_arms_is_given_up(small) -> None:
    hot = small.work("press", 8.0)
    world, plant = small.shop([[small.job("hot", hot, repetitions=400)]], arms=4, ticks=600)
    log, state, tried = [], initial(world), 0
    while not any(e.kind == "give_up" for e in log):
        action = np.zeros((1, 4), int)
        if open_jobs(world, state)[1][0, tried, 1]:
            action[0, tried], tried = 1, tried + 1
        state = step(world, state, action, plant, log).state
    assert tried == 3
    assert [e.arm for e in log if e.kind == "fault"] == list(world.arms[:3])
    assert state.status[0, 0] == GIVEN_UP
    assert WORKING not in state.mode[0]


GIVE_BACK = 1 + 4 + 1 - 1
"""The last action of a world with four slots and one plan a job."""


def play_out(world, plant, actions, log):
    state = initial(world)
    for action in actions:
        row = np.zeros((1, len(world.arms)), int)
        row[0, 0] = action
        state = step(world, state, row, plant, log).state
    return state


@pytest.mark.parametrize("worked", [1, 2, 4])
def test_an_arm_ends_its_cycle_and_goes_home(small, worked) -> None:
    """Approach 3 s, 6 cycles of 10 s, retreat 2 s; told after `worked` steps of 10 s, in cycle `worked`."""
    world, plant = small.shop([[small.job("a", repetitions=6)]], arms=2)
    log = []
    state = play_out(world, plant, [1, *[0] * (worked - 1), GIVE_BACK, 0], log)
    back, home = (next(e for e in log if e.kind == kind) for kind in ("give_back", "home"))
    assert (back.time_s, back.value) == (3.0 + 10.0 * worked, worked)
    assert back.reason == f"{worked} of 6 cycles kept"
    assert home.time_s == back.time_s + 2.0
    assert state.mode[0, 0] == IDLE
    assert (state.status[0, 0], state.cycles[0, 0], state.returns[0, 0]) == (WAITING, worked, 0)
    assert open_jobs(world, state)[0][0, 0] == 0
    # The other arm does the rest.
    while state.status[0, 0] != DONE:
        action = int(open_jobs(world, state)[1][0, 1, 1])
        state = step(world, state, np.array([[0, action]]), plant, log).state
    awards, finish = [e for e in log if e.kind == "award"], next(e for e in log if e.kind == "finish")
    assert finish.time_s == awards[-1].time_s + 3.0 + 10.0 * (6 - worked)


def test_on_the_approach_no_cycle_is_done(small) -> None:
    world, plant = small.shop([[small.job("a", repetitions=6)]], arms=1, dt_s=1.0)
    log = []
    play_out(world, plant, [1, 0, GIVE_BACK, *[0] * 6], log)
    back = next(e for e in log if e.kind == "give_back")
    assert (back.time_s, back.value) == (3.0, 0)


def test_a_job_expires_at_a_hard_due_date_with_all_that_wait_for_it(small) -> None:
    jobs = [
        small.job("soft", due_s=15.0),
        small.job("hard", due_s=15.0, expires=True),
        small.job("next", after=("begun", "hard")),
        small.job("begun", due_s=15.0, expires=True, repetitions=3),
        small.job("last", after=("next",)),
    ]
    world, plant = small.shop([jobs], arms=1, slots=3)
    log, state = [], initial(world)
    assert open_jobs(world, state)[0][0].tolist() == [0, 1, 3]
    state = step(world, state, np.array([[3]]), plant, log).state
    assert open_jobs(world, state)[0][0].tolist() == [0, 1, -1]  # now at 10 s
    for _ in range(4):
        state = step(world, state, np.array([[0]]), plant, log).state
    assert open_jobs(world, state)[0][0].tolist() == [0, -1, -1]
    state = step(world, state, np.array([[0]]), plant, log).state
    assert state.status[0].tolist() == [WAITING, EXPIRED, GIVEN_UP, DONE, GIVEN_UP]
    assert [(e.time_s, e.job, e.arm) for e in log if e.kind == "expire"] == [(20.0, "hard", "")]
    assert [(e.job, e.arm, e.time_s, e.reason) for e in log if e.kind == "give_up"] == [
        ("next", "", 20.0, "it waited for hard, which expired"),
        ("last", "", 20.0, "it waited for next, which was given up"),
    ]


def test_a_job_behind_a_full_window_expires_too(small) -> None:
    jobs = [small.job("soft", due_s=15.0), small.job("hard", due_s=15.0, expires=True), small.job("last", due_s=15.0)]
    world, plant = small.shop([jobs], arms=1, slots=1)
    state = initial(world)
    for _ in range(2):
        state = step(world, state, np.array([[0]]), plant).state
    assert open_jobs(world, state)[0][0].tolist() == [0]
    state = step(world, state, np.array([[0]]), plant).state
    assert state.status[0].tolist() == [WAITING, EXPIRED, WAITING]
