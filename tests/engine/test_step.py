"""One step of a shift: moments of events, rows and arms."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.engine.shift import open_jobs, step
from fleet.engine.state import State, initial
from fleet.events import Event
from fleet.telemetry import IDLE
from tests.engine.play import DT_S, play, times, with_random_difficulty
from tests.profiles import examples


@examples(30)
@given(
    approach=st.integers(1, 800),
    cycle=st.integers(5, 1500),
    retreat=st.integers(1, 800),
    repetitions=st.integers(1, 9),
    award_tick=st.integers(0, 5),
)
def test_a_job_is_finished_and_its_arm_home_at_the_planned_moment(
    small, approach, cycle, retreat, repetitions, award_tick
) -> None:
    spans = small.Times(approach / 50, cycle / 50, retreat / 50)
    content = small.work()
    jobs = [small.job("a", content, repetitions=repetitions, due_s=150.0)]
    world, plant = small.shop([jobs], arms=[small.arm(0, [content], times=spans)], ticks=40)
    log: list[Event] = []
    last = play(world, plant, [[0]] * award_tick + [[1]], log)[-1].state
    done = award_tick * DT_S + (approach + repetitions * cycle) / 50
    assert times(log, "finish") == pytest.approx([done] if done <= world.horizon_s else [])
    assert last.finished_s[0, 0] == pytest.approx(done if done <= world.horizon_s else np.nan, nan_ok=True)
    assert [e.value for e in log if e.kind == "finish"] == pytest.approx(
        [max(0.0, done - 150.0)] * len(times(log, "finish"))
    )
    home = done + retreat / 50
    assert times(log, "home") == pytest.approx([home] if home <= world.horizon_s else [])


def test_an_arm_that_is_home_at_the_end_of_a_step_is_free_in_the_next(small) -> None:
    content = small.work()
    # 0.1 + 3 · 0.1 + 9.6 s is a whole step, but not in floating point.
    spans = small.Times(0.1, 0.1, 9.6)
    world, plant = small.shop([[small.job("a", content)]], arms=[small.arm(0, [content], times=spans)], ticks=2)
    assert play(world, plant, [[1]])[0].state.mode[0, 0] == IDLE


def test_a_job_waits_for_its_release_and_its_predecessors(small) -> None:
    first, second = small.work("bench"), small.work("rack")
    jobs = [
        small.job("late", second, release_s=31.0),
        small.job("next", second, after=("first",)),
        small.job("first", first),
    ]
    world, plant = small.shop([jobs], ticks=12)
    log: list[Event] = []
    state = initial(world)
    offered: list[set[str]] = []
    for _ in range(world.ticks):
        now = open_jobs(world, state)[0][0]
        offered.append({world.jobs.names[0][j] for j in now.tolist() if j >= 0})
        claim = now.tolist().index(2) + 1 if 2 in now.tolist() else 0
        state = step(world, state, np.array([[claim, 0]]), plant, log).state
    # first: 3 s approach and three cycles of 10 s; ticks begin every 10 s.
    assert [("late" in o, "next" in o, "first" in o) for o in offered[:6]] == [
        (False, False, True),
        (False, False, False),
        (False, False, False),
        (False, False, False),
        (True, True, False),
        (True, True, False),
    ]
    assert times(log, "finish") == [33.0]
    assert sorted((e.job, e.time_s) for e in log if e.kind == "release") == [("first", 0), ("late", 31), ("next", 0)]


def test_arms_stay_idle_in_a_shift_without_jobs(small) -> None:
    content = small.work()
    world, plant = small.shop([[]], arms=[small.arm(0, [content]), small.arm(1, [content])], ticks=30)
    last = play(world, plant, [[1, 2]])[-1].state
    assert (last.mode == IDLE).all()
    assert (last.busy_s == 0).all()
    assert last.illegal.tolist() == [[1, 1]]


# Rows and arms


@pytest.mark.parametrize("envs", [2, 5])
def test_a_row_does_not_depend_on_the_number_of_rows(small, envs) -> None:
    works = [small.work(p, kg) for p in ("bench", "rack") for kg in (small.LIGHT, small.HOT)]
    shifts = [
        [small.job(f"j{i}", works[(i + e) % 4], repetitions=50 + i, release_s=20.0 * i) for i in range(3 + e)]
        for e in range(envs)
    ]
    arms = [small.arm(i, works) for i in range(3)]
    together, plant = small.shop(shifts, arms=arms, ticks=120)
    rng = np.random.default_rng(3)
    actions = rng.integers(0, 5, (120, envs, 3))
    together = with_random_difficulty(together, rng)
    many = initial(together)
    ones = []
    for e, jobs in enumerate(shifts):
        world, own = small.shop([jobs], arms=arms, ticks=120)
        difficulty = together.offers.difficulty[e : e + 1, :, : len(jobs)]
        ones.append((replace(world, offers=replace(world.offers, difficulty=difficulty)), own))
    states = [initial(world) for world, _ in ones]
    for tick in range(120):
        many = step(together, many, actions[tick], plant).state
        for e, (world, own) in enumerate(ones):
            states[e] = step(world, states[e], actions[tick, e : e + 1], own).state
    assert many.faults.sum() > 0
    for e, state in enumerate(states):
        for name in State._fields:
            if name == "plan":
                continue  # rows of other tables
            row, one = getattr(many, name)[e], getattr(state, name)[0]
            np.testing.assert_array_equal(row[: len(one)] if one.shape else row, one, err_msg=name)


def test_relabelling_the_arms_relabels_the_shift(small) -> None:
    works = [small.work(p, kg) for p in ("bench", "rack", "press") for kg in (small.LIGHT, small.HOT)]
    jobs = [small.job(f"j{i}", works[i], repetitions=20) for i in range(6)]
    # Two different motors, so that the arms differ.
    kinds = [small.arm(i, works, times=small.Times(3, 8 + i, 2)) for i in range(3)]
    order = [2, 0, 1]
    straight, plant = small.shop([jobs], arms=kinds)
    turned, turned_plant = small.shop([jobs], arms=[kinds[i] for i in order])
    rng = np.random.default_rng(8)
    straight = with_random_difficulty(straight, rng)
    turned = replace(turned, offers=replace(turned.offers, difficulty=straight.offers.difficulty[:, order]))
    one, other = initial(straight), initial(turned)
    for _ in range(straight.ticks):
        actions = rng.integers(0, 5, (1, 3))
        one = step(straight, one, actions, plant).state
        other = step(turned, other, actions[:, order], turned_plant).state
    assert one.faults.sum() > 0
    for name in State._fields:
        mine, theirs = getattr(one, name), getattr(other, name)
        if name in ("plan", "failed_arm"):
            continue  # rows and arms by other numbers
        per_arm = mine.shape[:2] == (1, 3) and name not in ("status", "queued_s", "cycles", "returns", "finished_s")
        np.testing.assert_allclose(mine[:, order] if per_arm else mine, theirs, rtol=1e-12, err_msg=name)
