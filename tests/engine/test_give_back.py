"""Giving a job back after the present cycle, and jobs that expire."""

import numpy as np
import pytest

from fleet.engine.shift import open_jobs, step
from fleet.engine.state import DONE, EXPIRED, GIVEN_UP, WAITING, initial
from fleet.telemetry import IDLE

GIVE_BACK = 1 + 4 + 1 - 1
"""The last action of a world with four slots and one plan a job."""


def play(world, plant, actions, log):
    """Step through one action of arm 0 each; the other arms wait."""
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
    state = play(world, plant, [1, *[0] * (worked - 1), GIVE_BACK, 0], log)
    back, home = (next(e for e in log if e.kind == kind) for kind in ("give_back", "home"))
    assert (back.time_s, back.value) == (3.0 + 10.0 * worked, worked)
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
    play(world, plant, [1, 0, GIVE_BACK, *[0] * 6], log)
    back = next(e for e in log if e.kind == "give_back")
    assert (back.time_s, back.value) == (3.0, 0)


def test_it_is_legal_only_while_a_cycle_is_left_to_give_back(small) -> None:
    world, plant = small.shop([[small.job("a", repetitions=2)]], arms=1)
    log, legal = [], []
    state = initial(world)
    for tick in range(4):
        legal.append(int(open_jobs(world, state)[1][0, 0, -1]))
        state = step(world, state, np.array([[int(tick == 0)]]), plant, log).state
    # At 10 s it is in the first of two cycles, at 20 s in the last one.
    assert legal == [0, 1, 0, 0]
    state = step(world, initial(world), np.array([[GIVE_BACK]]), plant).state
    assert state.illegal[0, 0] == 1


def test_a_job_expires_at_a_hard_due_date_with_all_that_wait_for_it(small) -> None:
    jobs = [
        small.job("soft", due_s=15.0),
        small.job("hard", due_s=15.0, expires=True),
        small.job("next", after=("hard",)),
        small.job("begun", due_s=15.0, expires=True, repetitions=3),
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
    assert state.status[0].tolist() == [WAITING, EXPIRED, GIVEN_UP, DONE]
    assert [(e.kind, e.job, e.arm) for e in log if e.kind == "expire"] == [("expire", "hard", "")]


def test_a_job_behind_a_full_window_expires_too(small) -> None:
    jobs = [small.job("soft", due_s=15.0), small.job("hard", due_s=15.0, expires=True), small.job("last", due_s=15.0)]
    world, plant = small.shop([jobs], arms=1, slots=1)
    state = initial(world)
    for _ in range(2):
        state = step(world, state, np.array([[0]]), plant).state
    assert open_jobs(world, state)[0][0].tolist() == [0]
    state = step(world, state, np.array([[0]]), plant).state
    assert state.status[0].tolist() == [WAITING, EXPIRED, WAITING]
