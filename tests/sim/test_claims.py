"""Who may claim what, and who gets it: against a slow referee, and in cases told by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.sim.claims import board, resolve
from fleet.sim.kernel import step
from fleet.sim.state import initial
from fleet.telemetry import IDLE, WORKING


def shop_of(small, places, arms=3, slots=4, **more):
    """One job per place (or pair of places); every arm can do all."""
    jobs = [small.job(f"j{i}", small.work(*(p if isinstance(p, tuple) else (p,)))) for i, p in enumerate(places)]
    return small.shop([jobs], arms=arms, slots=slots, **more)


def referee(on_offer, mask, stations, actions, scores, occupied):
    """The rule told slowly: claims in order of (score, index); a job and its stations go to the first."""
    arms = len(actions)
    legal = [0 <= a < mask.shape[1] and bool(mask[i, a]) for i, a in enumerate(actions)]
    claims = []
    for i, action in enumerate(actions):
        if legal[i] and action > 0:
            score = scores[i, action - 1]
            claims.append((np.inf if np.isnan(score) else score, i, on_offer[action - 1]))
    won, taken, busy = [-1] * arms, set(), set(occupied)
    for _, i, job in sorted(claims):
        if job not in taken and not stations[job] & busy:
            won[i] = job
            taken.add(job)
            busy |= stations[job]
    return won, [not ok for ok in legal]


PLACES = ["bench", "rack", ("bench", "rack"), ("rack", "press"), "press", "shelf"]


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_awards_are_those_of_a_slow_referee(small, data) -> None:
    places = data.draw(st.lists(st.sampled_from(PLACES), min_size=1, max_size=6))
    arms = data.draw(st.integers(1, 4))
    stations = {j: set(p if isinstance(p, tuple) else (p,)) for j, p in enumerate(places)}
    pairs = [(p[0], 0.0, p[1]) if isinstance(p, tuple) else (p,) for p in places]
    world, plant = shop_of(small, pairs, arms=arms)
    state = initial(world)
    score = st.sampled_from([0.1, 0.5, 0.5, 2.0, float("nan")])
    for _ in range(3):
        actions = np.array(data.draw(st.lists(st.integers(-2, 6), min_size=arms, max_size=arms)))
        scores = np.array(data.draw(st.lists(st.lists(score, min_size=4, max_size=4), min_size=arms, max_size=arms)))
        now = board(world, state)
        held = [j for j in state.job[0].tolist() if j >= 0]
        busy = set().union(*(stations[j] for j in held))
        for slot, j in enumerate(now.on_offer[0].tolist()):
            for a in range(arms):
                may = j >= 0 and state.mode[0, a] == IDLE and not stations[j] & busy
                assert now.mask[0, a, slot + 1] == may
        found = resolve(world, state, now, actions[None], scores[None])
        won, illegal = referee(now.on_offer[0], now.mask[0], stations, actions, scores, busy)
        assert found.won[0].tolist() == won
        assert found.illegal[0].tolist() == illegal
        assert found.lost[0].tolist() == [w >= 0 and g < 0 for w, g in zip(found.wanted[0], won, strict=True)]
        expected = [h if h >= 0 else w for h, w in zip(state.job[0].tolist(), won, strict=True)]
        state = step(world, state, actions[None], scores[None], plant).state
        assert state.job[0].tolist() == expected  # three steps are too short to be home again


def test_a_number_beats_no_number_and_the_lower_index_a_tie(small) -> None:
    world, plant = shop_of(small, ["bench"])
    for scores, winner in (([np.nan, 3.0, 3.0], 1), ([0.5, 0.2, 0.2], 1), ([np.nan] * 3, 0), ([6.9, np.nan, 7.0], 0)):
        table = np.array(scores)[None, :, None].repeat(4, axis=2)
        state = step(world, initial(world), np.ones((1, 3), int), table, plant).state
        assert (state.mode[0] == WORKING).nonzero()[0].tolist() == [winner]
        expected = [-1, -1, -1]
        expected[winner] = 1
        assert state.last_award[0].tolist() == expected


def test_two_jobs_of_one_station_are_not_worked_at_once(small) -> None:
    world, plant = shop_of(small, ["bench", "bench", "rack"], arms=2)
    both = step(world, initial(world), np.array([[1, 2]]), np.array([[[2.0] * 4, [1.0] * 4]]), plant).state
    assert both.job[0].tolist() == [-1, 1]
    assert board(world, both).mask[0, 0].tolist() == [True, False, True, False, False]
    # The station is free again when the arm is home: 3 + 3 · 10 + 2 s.
    state = both
    for _ in range(3):
        assert not board(world, state).mask[0, 0, 1]
        state = step(world, state, np.zeros((1, 2), int), np.zeros((1, 2, 4)), plant).state
    assert state.mode[0, 1] == IDLE
    assert board(world, state).mask[0, 0, 1]


def test_an_arm_that_cannot_do_a_job_may_not_claim_it(small) -> None:
    bench, rack = small.work("bench"), small.work("rack")
    arms = [small.arm(0, [bench]), small.arm(1, [bench, rack])]
    world, plant = small.shop([[small.job("a", rack), small.job("b", bench)]], arms=arms)
    assert board(world, initial(world)).mask[0].tolist() == [
        [True, False, True, False, False],
        [True, True, True, False, False],
    ]
    after = step(world, initial(world), np.array([[1, 0]]), np.zeros((1, 2, 4)), plant).state
    assert after.illegal.tolist() == [[1, 0]]
    assert after.job.tolist() == [[-1, -1]]


@pytest.mark.parametrize("slots", [1, 3, 9])
def test_slots_hold_the_oldest_jobs_first(small, slots) -> None:
    jobs = [small.job(f"j{i}", release_s=r) for i, r in enumerate([0.0, 25.0, 5.0, 5.0, 5000.0])]
    world, plant = small.shop([jobs], slots=slots)
    state = initial(world)
    for _ in range(3):
        state = step(world, state, np.zeros((1, 2), int), np.zeros((1, 2, slots)), plant).state
    assert board(world, state).on_offer[0].tolist() == ([0, 2, 3, 1] + [-1] * 9)[:slots]
