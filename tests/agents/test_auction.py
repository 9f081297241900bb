"""The auction algorithm against the Hungarian method of scipy, and its bound."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from agents.auction import auction
from tests.profiles import examples


def total(benefit: np.ndarray, pairs) -> float:
    return float(sum(benefit[arm, job] for arm, job in pairs))


@examples(150)
@given(st.integers(1, 8), st.integers(1, 12), st.integers(0, 2**32), st.sampled_from([0.3, 0.05, 0.01]))
def test_the_total_is_within_arms_times_epsilon_of_the_optimum(arms, jobs, seed, epsilon) -> None:
    rng = np.random.default_rng(seed)
    benefit = np.where(rng.random((arms, jobs)) < 0.7, rng.random((arms, jobs)), 0.0)
    pairs = auction(benefit, epsilon)
    assert len({arm for arm, _ in pairs}) == len({job for _, job in pairs}) == len(pairs)
    assert all(benefit[pair] > 0 for pair in pairs)
    best = benefit[linear_sum_assignment(benefit, maximize=True)].sum()
    assert best - arms * epsilon - 1e-9 <= total(benefit, pairs) <= best + 1e-9


@examples(100)
@given(st.integers(1, 6), st.integers(1, 6), st.integers(0, 2**32))
def test_whole_numbers_with_a_small_epsilon_give_the_optimum(arms, jobs, seed) -> None:
    """Bertsekas 1988: with whole benefits and ε < 1/n the outcome is optimal."""
    benefit = np.random.default_rng(seed).integers(0, 20, (arms, jobs)).astype(float)
    best = benefit[linear_sum_assignment(benefit, maximize=True)].sum()
    assert total(benefit, auction(benefit, 0.9 / arms)) == best


def test_nothing_is_given_where_nothing_gains_and_epsilon_must_be_positive() -> None:
    assert auction(np.zeros((2, 3)), 0.1) == auction(np.full((2, 1), -1.0), 0.1) == auction(np.zeros((2, 0)), 0.1) == []
    with pytest.raises(ValueError, match="epsilon must be > 0"):
        auction(np.ones((1, 1)), 0.0)
