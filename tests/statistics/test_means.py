"""Intervals of means against closed forms, SciPy's tests and the laws that they must obey."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from scenarios.evaluate.statistics import FARTHEST, SKEW_BIAS, holm, interval, mean_bounds, paired, unit

SYMMETRIC = np.array([-4.0, -1.0, 0.0, 1.0, 4.0]) + 2.0


def student(values: np.ndarray) -> tuple[float, float]:
    low, high = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    return float(low), float(high)


def test_without_skewness_the_interval_and_the_test_are_student_s() -> None:
    found = interval(SYMMETRIC)
    assert (found.low, found.high) == pytest.approx(student(SYMMETRIC))
    assert found.p == pytest.approx(stats.ttest_1samp(SYMMETRIC, 0.0).pvalue)
    base = SYMMETRIC[::-1] ** 2
    assert paired(base + SYMMETRIC, base).p == pytest.approx(stats.ttest_rel(base + SYMMETRIC, base).pvalue)


def test_a_skewed_sample_reaches_as_far_as_hall_s_transformation() -> None:
    """Hall, JRSS B 54 (1992): g(T) = T + a (2 T² + 1) + 4/3 a² T³, a = skewness / (6 √n), is nearly Student's t."""
    x = np.random.default_rng(5).exponential(size=12) ** 0.7
    found, (_, high) = interval(x), student(x)
    t = (x.mean() - found.high) / stats.sem(x)
    a = (1 + SKEW_BIAS / 12) * stats.skew(x) / 6 / np.sqrt(12)
    assert t + a * (2 * t**2 + 1) + 4 / 3 * a**2 * t**3 == pytest.approx(stats.t.ppf(0.025, 11))
    assert found.high > high
    assert found.low == pytest.approx(student(x)[0])  # the other bound is Student's
    far, (_, high) = interval(x**3), student(x**3)
    assert far.high - far.mean == pytest.approx(FARTHEST * (high - far.mean))


def test_without_differences_between_fleets_the_interval_is_that_of_seeds() -> None:
    values = np.tile(SYMMETRIC, (200, 2, 1))  # [fleet, training, seed]
    found = interval(values)
    assert (found.low, found.high) == pytest.approx(student(SYMMETRIC), rel=0.01)


def test_without_differences_between_seeds_the_interval_is_that_of_fleets() -> None:
    fleets = np.array([1.0, 4.0, 7.0])
    found = interval(np.tile(fleets[:, None, None], (1, 2, 500)))
    assert (found.low, found.high) == pytest.approx(student(fleets), rel=0.01)


def test_fleets_and_seeds_that_differ_as_much_add_their_variances() -> None:
    effect = np.linspace(-1.0, 1.0, 41)
    found = interval(effect[:, None, None] + effect)
    variance = 2 * effect.var(ddof=1) / 41
    assert found.margin == pytest.approx(stats.t.ppf(0.975, 40) * np.sqrt(variance), rel=0.02)


def test_trainings_are_the_sample_within_a_single_fleet_unless_they_change_nothing() -> None:
    trainings = np.array([1.0, 4.0, 7.0])
    found = interval(np.tile(trainings[None, :, None], (1, 1, 500)))
    assert (found.low, found.high) == pytest.approx(student(trainings), rel=0.01)
    assert interval(np.tile(SYMMETRIC, (1, 3, 1))) == interval(SYMMETRIC)


@given(
    st.lists(st.integers(-50, 50), min_size=2, max_size=12).filter(lambda x: len(set(x)) > 1),
    st.floats(0.5, 0.999),
)
def test_the_test_rejects_exactly_when_the_interval_excludes_zero(values: list[int], level: float) -> None:
    found = interval(values, level=level)
    if abs(found.p - (1 - level)) > 1e-9:
        assert found.excludes_zero == (found.p < 1 - level)
    assert found.low < found.mean < found.high
    mirrored = interval([-x for x in values], level=level)
    assert (-mirrored.high, -mirrored.low) == pytest.approx((found.low, found.high), abs=1e-8)
    scaled = interval([3.0 * x + 7.0 for x in values], level=level)
    assert (scaled.low, scaled.high) == pytest.approx((3 * found.low + 7, 3 * found.high + 7), abs=1e-8)


def test_many_means_at_once_are_those_one_by_one() -> None:
    x = np.random.default_rng(0).exponential(size=(4, 5, 3, 2, 6))
    many = mean_bounds(x)
    one = interval(x[2, 3])
    assert (many.low[2, 3], many.high[2, 3], many.p[2, 3]) == pytest.approx((one.low, one.high, one.p))


def test_no_variation_is_not_certainty() -> None:
    assert np.isnan(interval(np.full(5, 4.0)).low)
    assert interval(np.full(5, 4.0)).note == "no variation in 5"
    assert interval([4.0]).note == "one value"
    assert interval(np.full((3, 2, 20), 1.0)).note == "no variation in 3"
    # At the end of a range there is a bound: of a probability by Clopper & Pearson.
    certain = interval(np.ones(10), least=0.0, most=1.0)
    assert (certain.low, certain.high) == pytest.approx(tuple(stats.binomtest(10, 10).proportion_ci()))
    assert interval([0.0, 0.0, 0.0, 3.0], least=0.0).low == 0.0


def test_what_has_a_single_fleet_stands_for_all_in_a_difference() -> None:
    rng = np.random.default_rng(0)
    several, single = rng.normal(1.0, 1.0, (3, 1, 20)), rng.normal(size=(1, 1, 20))
    assert paired(several, single) == paired(several, np.tile(single, (3, 1, 1)))
    assert paired(several, single).mean == -paired(single, several).mean


def test_the_unit_says_what_is_fixed() -> None:
    assert unit((8, 2, 20)) == "8 fleets × 2 trainings × 20 seeds"
    assert unit((1, 1, 10)) == "10 seeds, this fleet only"
    assert unit((4, 1, 1)) == "4 fleets, this seed only"


def test_bad_values_are_refused() -> None:
    for values in ([], [1.0, np.nan], [[1.0, 2.0]]):
        with pytest.raises(ValueError, match="Values must be"):
            interval(values)
    with pytest.raises(ValueError, match="equal shapes"):
        paired([1.0, 2.0], [1.0])


def test_holm_rejects_what_the_procedure_of_the_paper_rejects() -> None:
    """Step down (Holm 1979): the least p is compared with α / m, the next with α / (m − 1), until one is not below."""
    rng, alpha = np.random.default_rng(0), 0.05
    for _ in range(200):
        p = rng.uniform(0, 0.05, 6)
        rejected, left = set[int](), list(np.argsort(p))
        while left and p[left[0]] < alpha / len(left):
            rejected.add(int(left.pop(0)))
        assert set(np.flatnonzero(holm(p) < alpha)) == rejected
    found = holm([[0.01, np.nan], [0.04, 0.03]])
    np.testing.assert_allclose(found, [[0.03, np.nan], [0.06, 0.06]])
