"""Gini's coefficient: closed forms and properties."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.run.metrics import gini

shares = st.lists(st.floats(0.0, 1e6), min_size=1, max_size=12)


@pytest.mark.parametrize("arms", [1, 2, 5, 64])
def test_one_arm_with_everything_among_n_is_1_minus_1_over_n(arms) -> None:
    assert gini(np.eye(arms)[0]) == pytest.approx(1 - 1 / arms)


@pytest.mark.parametrize("arms", [1, 2, 7])
def test_all_alike_is_zero(arms) -> None:
    assert gini(np.full(arms, 3.7)) == pytest.approx(0.0)
    assert gini(np.zeros(arms)) == 0.0


def test_shares_1_to_n_have_the_closed_form() -> None:
    # Σ|i − j| = n (n² − 1)/3 and mean (n + 1)/2, so G = (n − 1)/(3 n).
    for n in (2, 10, 101):
        assert gini(np.arange(1, n + 1)) == pytest.approx((n - 1) / (3 * n))


def test_an_exponential_fleet_is_near_a_half() -> None:
    # The Gini coefficient of the exponential distribution is 1/2; its estimate has deviation about 0.29/√n.
    drawn = np.random.default_rng(1).exponential(size=2000)
    assert gini(drawn) == pytest.approx(0.5, abs=4 * 0.29 / np.sqrt(2000))


@given(shares, st.floats(1e-3, 1e3), st.randoms())
def test_it_knows_neither_unit_nor_order(values, scale, random) -> None:
    g = gini(np.array(values))
    assert 0.0 <= g < 1.0
    mixed = [scale * v for v in values]
    random.shuffle(mixed)
    assert gini(np.array(mixed)) == pytest.approx(g, abs=1e-9)


@given(shares, st.floats(1.0, 1e6))
def test_a_gift_to_all_makes_it_less(values, gift) -> None:
    assert gini(np.array(values) + gift) <= gini(np.array(values)) + 1e-12


@pytest.mark.parametrize(("values", "says"), [([1.0, -0.1], "must be >= 0"), ([], "at least one")])
def test_shares_that_cannot_be_are_refused(values, says) -> None:
    with pytest.raises(ValueError, match=says):
        gini(np.array(values))
