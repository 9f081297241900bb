"""Random legal actions."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.stats import chisquare

from fleet.env.random_actions import random_legal

masks = npst.arrays(
    np.int8, st.tuples(st.integers(1, 4), st.integers(1, 5), st.integers(1, 9)), elements=st.integers(0, 1)
)


@given(mask=masks, seed=st.integers(0, 2**32))
def test_every_action_is_legal_if_one_is(mask, seed) -> None:
    actions = random_legal(mask, np.random.default_rng(seed))
    assert actions.shape == mask.shape[:-1]
    assert actions.dtype == np.int64
    chosen = np.take_along_axis(mask, actions[..., None], axis=-1)[..., 0]
    np.testing.assert_array_equal(chosen == 1, mask.any(axis=-1))
    assert (actions[~mask.any(axis=-1)] == 0).all()


def test_legal_actions_are_equally_likely() -> None:
    mask = np.zeros((60_000, 9), np.int8)
    legal = [0, 3, 4, 8]
    mask[:, legal] = 1
    counts = np.bincount(random_legal(mask, np.random.default_rng(3)), minlength=9)
    assert counts.sum() == counts[legal].sum() == len(mask)
    assert chisquare(counts[legal]).pvalue > 0.001


def test_masks_may_be_boolean_and_a_seed_repeats() -> None:
    mask = np.random.default_rng(0).random((7, 3, 5)) < 0.5
    one, other = (random_legal(each, np.random.default_rng(1)) for each in (mask, mask.astype(np.int8)))
    np.testing.assert_array_equal(one, other)
