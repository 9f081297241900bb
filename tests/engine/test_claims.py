"""Claims on jobs: action masks and awards, against a reference in plain Python and in examples."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.engine.claims import FOR_PASSED, MOST_PASSES
from fleet.engine.shift import initial, open_jobs, step
from fleet.engine.state import DONE, State
from fleet.engine.world import World
from fleet.telemetry import IDLE
from tests.profiles import examples
from tests.shifts import with_conflicts, with_tables, with_work


def world_of(small, places, arms=3, slots=4, **more):
    """Return a shift with one job per place or pair of places; every arm can do all."""
    jobs = [small.job(f"j{i}", small.work(*(p if isinstance(p, tuple) else (p,)))) for i, p in enumerate(places)]
    return small.shop([jobs], arms=arms, slots=slots, **more)


def with_difficulty(world: World, difficulty) -> World:
    """Return the world with other difficulties, broadcast to [arm, job, plan], which decide between claims."""
    return with_work(world, difficulty=np.broadcast_to(np.swapaxes(difficulty, -3, -2), world.tables.work.shape))


def with_two_plans(world: World) -> World:
    """Return the world in which each arm has a second plan for each job, with rows of its own."""
    tables, second = world.tables, world.tables.work.copy()
    second["plan"] += len(tables.plans)
    return with_tables(
        replace(world, plans=world.plans * 2),
        plans=np.concatenate([tables.plans] * 2),
        excluded=np.concatenate([tables.excluded] * 2),
        work=np.concatenate([tables.work, second], axis=-1),
    )


def referee(slot_job, mask, stations, actions, difficulty, occupied, touches, away):
    """Award claims in order of (difficulty, arm); return jobs, losers, illegal.

    Every job has two options. `difficulty` is [arm, job, option]. `touches(arm, job, option, other)` tells whether a
    plan touches that of another (arm, job, option); `away` are those of arms that are away from home.
    """
    arms = len(actions)
    legal = [0 <= a < mask.shape[1] and bool(mask[i, a]) for i, a in enumerate(actions)]
    claims = []
    for i, action in enumerate(actions):
        if legal[i] and action > 0:
            slot, option = divmod(action - 1, 2)
            score = difficulty[i, slot_job[slot], option]
            claims.append((np.inf if np.isnan(score) else score, i, slot_job[slot], option))
    won, taken, busy, away = [-1] * arms, set(), set(occupied), list(away)
    for _, i, job, option in sorted(claims):
        if job not in taken and not stations[job] & busy and not any(touches(i, job, option, other) for other in away):
            won[i] = (job, option)
            taken.add(job)
            away.append((i, job, option))
            busy |= stations[job]
    return won, [won[i] == -1 and i in {c[1] for c in claims} for i in range(arms)], [not ok for ok in legal]


PLACES = ["bench", "rack", ("bench", "rack"), ("rack", "press"), "press", "shelf"]


@examples(150)
@given(st.data())
def test_awards_equal_the_reference(small, data) -> None:
    places = data.draw(st.lists(st.sampled_from(PLACES), min_size=1, max_size=6))
    arms = data.draw(st.integers(1, 4))
    stations = {j: set(p if isinstance(p, tuple) else (p,)) for j, p in enumerate(places)}
    pairs = [(p[0], 0.0, p[1]) if isinstance(p, tuple) else (p,) for p in places]
    world, plant = world_of(small, pairs, arms=arms)
    world = with_two_plans(world)
    state, count = initial(world), len(places)
    plan = world.tables.work["plan"][0].swapaxes(0, 1)
    size = int(plan.max()) + 1
    pairs = st.lists(st.tuples(st.integers(0, size - 1), st.integers(0, size - 1)), max_size=8)
    conflicts = np.zeros((size, size), bool)
    for one, other in data.draw(pairs):
        conflicts[one, other] = conflicts[other, one] = True
    world = with_conflicts(world, conflicts)

    def touches(arm, job, option, other):
        return conflicts[plan[arm, job, option], plan[other]]

    chosen = [0] * arms  # option of each arm's job

    value = st.sampled_from([0.1, 0.5, 0.5, 2.0, float("nan")])
    for _ in range(3):
        # 9 gives the current job back, see tests/engine/test_stopped.py.
        action = st.integers(-2, 10).filter(lambda action: action != 9)
        actions = np.array(data.draw(st.lists(action, min_size=arms, max_size=arms)))
        row = st.lists(value, min_size=2 * count, max_size=2 * count)
        difficulty = np.array(data.draw(st.lists(row, min_size=arms, max_size=arms))).reshape(arms, count, 2)
        world = with_difficulty(world, difficulty)
        slot_job, mask = open_jobs(world, state, compiled=False)
        held = [j for j in state.job[0].tolist() if j >= 0]
        busy = set().union(*(stations[j] for j in held))
        away = [(a, j, chosen[a]) for a, j in enumerate(state.job[0].tolist()) if j >= 0]
        for slot, j in enumerate(slot_job[0].tolist()):
            for a in range(arms):
                may = j >= 0 and state.mode[0, a] == IDLE and not stations[j] & busy
                for option in (0, 1):
                    clear = may and not any(touches(a, j, option, other) for other in away)
                    assert mask[0, a, 1 + 2 * slot + option] == clear
        won, lost, illegal = referee(slot_job[0], mask[0], stations, actions, difficulty, busy, touches, away)
        before = state.copy()
        after = step(world, state, actions[None], plant, compiled=False).state
        for name, values in before.named().items():
            np.testing.assert_array_equal(getattr(state, name), values, err_msg=f"{name} of the state before")
        assert (after.illegal - state.illegal)[0].tolist() == illegal
        assert (after.last_award[0] == -1).tolist() == lost
        assert (after.last_award[0] == 1).tolist() == [job != -1 for job in won]
        chosen = [chosen[a] if w == -1 else w[1] for a, w in enumerate(won)]
        # After three steps no arm is home again.
        expected = [h if h >= 0 else w if w == -1 else w[0] for h, w in zip(state.job[0].tolist(), won, strict=True)]
        assert after.plan[0].tolist() == [-1 if j < 0 else plan[a, j, chosen[a]] for a, j in enumerate(expected)]
        assert after.job[0].tolist() == expected
        state = after


@pytest.mark.parametrize("stations", [64, 65])
def test_more_than_64_stations_are_distinguished(small, stations) -> None:
    """Stations are bits of 64-bit integers."""
    world, plant = world_of(small, [f"place_{i}" for i in range(stations)], arms=2, slots=stations)
    state = step(world, initial(world), np.array([[stations, 0]]), plant).state
    mask = open_jobs(world, state)[1][0, 1]
    assert mask[:-1].tolist() == [1] * stations + [0]  # the current job is no longer in a slot
    jobs = [small.job(f"again_{i}", small.work(f"place_{i}")) for i in range(stations)]
    jobs += [small.job(f"more_{i}", small.work(f"place_{i}")) for i in (0, stations - 1)]
    world, plant = small.shop([jobs], arms=2, slots=len(jobs))
    state = step(world, initial(world), np.array([[stations, 0]]), plant).state
    assert open_jobs(world, state)[1][0, 1, 1:-1].tolist() == [1] * stations + [0, 0]


def play_one(world: World, plant, claims) -> tuple[list[list[int]], State]:
    """Jobs in the slots at each decision of one arm, which claims the first job of `claims`, else waits; last state."""
    state, slots = initial(world), []
    for _ in range(world.ticks):
        slot_job, mask = open_jobs(world, state)
        slots.append(slot_job[0].tolist())
        legal = mask[0, 0, 1:-1].astype(bool) & np.isin(slot_job[0], list(claims))
        state = step(world, state, np.array([[1 + legal.argmax() if legal.any() else 0]]), plant).state
    return slots, state


def test_jobs_that_nobody_takes_are_put_behind_those_that_wait_for_a_slot(small) -> None:
    """All of nine jobs come into the four slots, one of which is for jobs that were passed over."""
    world, plant = world_of(small, [f"place_{i}" for i in range(9)], arms=1, ticks=4 * MOST_PASSES)
    slots, _ = play_one(world, plant, ())
    for begin, jobs in enumerate(([0, 1, 2, 3], [4, 5, 6, 0], [7, 8, 1, 2], [3, 0, 4, 5])):
        assert slots[begin * MOST_PASSES : (begin + 1) * MOST_PASSES] == [jobs] * MOST_PASSES


def test_jobs_keep_their_slots_if_no_other_waits_or_no_arm_is_idle(small) -> None:
    places = [f"place_{i}" for i in range(5)]
    world, plant = world_of(small, places[:4], arms=1, ticks=3 * MOST_PASSES)
    assert play_one(world, plant, ())[0] == [[0, 1, 2, 3]] * world.ticks
    jobs = [small.job("long", small.work("bench"), repetitions=1000), *(small.job(p, small.work(p)) for p in places)]
    world, plant = small.shop([jobs], arms=1, slots=4, ticks=3 * MOST_PASSES)
    assert play_one(world, plant, (0,))[0] == [[0, 1, 2, 3]] + [[1, 2, 3, 4]] * (world.ticks - 1)


@examples(25)
@given(st.lists(st.booleans(), min_size=1, max_size=24), st.integers(1, 5))
def test_no_number_of_jobs_that_nobody_takes_stops_the_others(small, wanted, slots) -> None:
    """Each group of jobs that fills the slots costs at most `MOST_PASSES` decisions, and each that is done three."""
    jobs = [small.job(f"j{i}", small.work("bench")) for i in range(len(wanted))]
    claims, count = [j for j, each in enumerate(wanted) if each], len(wanted)
    ticks = (MOST_PASSES + 1) * (count // max(1, slots - slots // FOR_PASSED) + 1) + 3 * count
    world, plant = small.shop([jobs], arms=1, slots=slots, ticks=ticks)
    _, state = play_one(world, plant, claims)
    assert (state.status[0, :count] == DONE).tolist() == wanted


def test_a_new_job_has_a_slot_at_once_beside_jobs_that_were_passed_over(small) -> None:
    new_s = 5 * MOST_PASSES * 10.0
    jobs = [small.job(f"old_{i}", small.work("bench")) for i in range(9)]
    world, plant = small.shop(
        [[*jobs, small.job("new", small.work("bench"), release_s=new_s)]], arms=1, slots=4, ticks=6 * MOST_PASSES
    )
    slots, _ = play_one(world, plant, ())
    shown = [9 in each for each in slots]
    assert shown[5 * MOST_PASSES : 6 * MOST_PASSES] == [True] * MOST_PASSES
    assert not any(shown[: 5 * MOST_PASSES])
