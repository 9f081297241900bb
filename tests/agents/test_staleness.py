"""Old words count for less: exactly nothing changes at age 0, and nothing old wins or loses a job for long."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents import staleness
from agents.rules import LeastDifficulty
from agents.staleness import advantage
from fleet.observation import Observation
from tests.agents.observations import observation, with_peers


def heard(own: list[float], peers: list[list[float]], ages_s: list[float]) -> Observation:
    """What the first arm knows that finds the slots so difficult, and was told so much, so long ago; NaN not told."""
    told = np.array(peers, dtype=float).reshape(len(ages_s), len(own))
    return observation(
        len(own),
        peers=len(ages_s),
        difficulty=np.nan_to_num(np.array(own), nan=-1.0),
        peer_age_s=np.array(ages_s),
        peer_difficulty=np.nan_to_num(told, nan=-1.0),
    )


@contextmanager
def scales(**seconds: float) -> Iterator[None]:
    """Other time scales, by the names of the constants."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in seconds.items():
            patch.setattr(staleness, name, value)
        yield


def choice(observation: Observation) -> int:
    return LeastDifficulty().choose(observation, 0)


def test_advantage_is_against_the_average_by_weight_and_fades_with_it():
    """Own 1, a peer 4 told an e-folding ago: the average is (1 + 4/e) / (1 + 1/e)."""
    found = advantage(heard([1.0], [[4.0]], [60.0]), 0, np.array([True]))
    average = (1 + 4 / math.e) / (1 + 1 / math.e)
    np.testing.assert_allclose(found[:, 0], [1.0 - average, (4.0 - average) / math.e])


@given(st.lists(st.floats(0, 7) | st.just(np.nan), min_size=4, max_size=4), st.floats(1, 1e6))
def test_at_age_zero_every_trust_is_the_same_to_the_last_bit(told, fading_s):
    seen = heard(told[:2], [told[2:]], [0.0])
    slots = np.array([True, True])
    plain = np.array(told).reshape(2, 2)
    known = ~np.isnan(plain)
    average = np.where(known, plain, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    with scales(FADING_S=fading_s):
        np.testing.assert_array_equal(advantage(seen, 0, slots), plain - average)


@given(st.floats(0, 7), st.floats(0, 7), st.floats(0, 1e4), st.floats(0, 1e4))
def test_an_old_word_is_nearer_to_nothing(own, told, age_s, more_s):
    at = [abs(advantage(heard([own], [[told]], [age]), 0, np.array([True]))) for age in (age_s, age_s + more_s)]
    assert (at[1] <= at[0] + 1e-9).all()


def test_a_job_is_left_to_a_better_peer_only_as_long_as_it_may_be_free():
    with scales(EXPIRY_S=45.0):
        assert choice(heard([2.0], [[1.0]], [0.0])) == 0
        assert choice(heard([2.0], [[1.0]], [40.0])) == 0
        assert choice(heard([2.0], [[1.0]], [45.0])) == 1


@pytest.mark.parametrize("state", ["peer_working", "peer_faulted"])
def test_nothing_is_left_to_a_peer_that_is_not_free(state):
    assert choice(with_peers(heard([2.0], [[1.0]], [0.0]), **{state: np.ones(1)})) == 1


def test_a_peer_with_an_old_claim_gives_way_to_one_with_a_fresh_one():
    """Two jobs; the peer told that it finds the second easier by 2, ages ago, this arm by 1 now."""
    with scales(FADING_S=10.0, EXPIRY_S=1e9):
        assert choice(heard([1.0, 1.0], [[4.0, 1.0]], [0.0])) == 1
        assert choice(heard([3.0, 2.0], [[3.0, 1.8]], [0.0])) == 1
        # Now its claim on the second counts for e^-8: this arm takes what it finds easiest against the average.
        assert choice(heard([3.0, 1.9], [[2.9, 2.0]], [80.0])) == 2
