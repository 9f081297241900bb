"""Exact intervals of counts and shares against SciPy and published tables."""

import numpy as np
import pytest
from scipy import stats

from scenarios.evaluate.statistics import count_interval, interval, paired, paired_counts, rate_bounds, share_bounds


@pytest.mark.parametrize(("hits", "count"), [(0, 10), (3, 10), (10, 10), (1, 1)])
def test_a_share_has_the_exact_interval(hits, count):
    expected = stats.binomtest(hits, count).proportion_ci(method="exact")
    assert share_bounds(hits, count) == pytest.approx((expected.low, expected.high))


def test_a_rate_has_the_exact_interval():
    """Garwood 1936, table 1: 0 events 0 to 3.69, 1 event 0.0253 to 5.57, 10 events 4.80 to 18.39."""
    table = {0: (0.0, 3.69), 1: (0.0253, 5.57), 10: (4.80, 18.39)}
    for events, bounds in table.items():
        assert rate_bounds(events, 1) == pytest.approx(bounds, abs=0.005)
    low, high = rate_bounds(7, 4)
    assert stats.poisson.sf(6, 4 * low) == pytest.approx(0.025)
    assert stats.poisson.cdf(7, 4 * high) == pytest.approx(0.025)


def test_no_fault_in_ten_shifts_is_not_no_fault():
    none = count_interval(np.zeros(10))
    assert (none.mean, none.low, none.high) == (0.0, 0.0, pytest.approx(0.369, abs=0.001))
    assert none.note == "none in 10, Poisson"
    both = paired_counts(np.zeros(10), np.zeros(10))
    assert (both.low, both.high, both.p) == (-none.high, none.high, 1.0)
    assert count_interval(np.zeros((3, 2, 20))).high == pytest.approx(3.689 / 3, abs=0.001)
    some = np.array([0.0, 1.0, 0.0, 3.0])
    assert count_interval(some) == interval(some, least=0.0)
    assert paired_counts(some, np.zeros(4)) == paired(some, np.zeros(4))


@pytest.mark.parametrize("mean", [0.02, 0.1, 0.3, 1.0, 5.0])
def test_counts_are_covered(mean):
    rng = np.random.default_rng(1)
    found = [count_interval(rng.poisson(mean, 10)) for _ in range(300)]
    assert np.mean([each.low <= mean <= each.high for each in found if not np.isnan(each.low)]) >= 0.94


def test_nonsense_is_refused():
    for hits, count in ((3, 2), (-1, 2), (0, 0)):
        with pytest.raises(ValueError, match="Hits must be 0"):
            share_bounds(hits, count)
    with pytest.raises(ValueError, match="Events must be"):
        rate_bounds(-1, 2)
