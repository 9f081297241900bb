"""Whether stated probabilities are judged as scikit-learn and the textbook judge them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.calibration import calibration_curve
from sklearn.metrics import brier_score_loss

from benchmarks.paper.saturation import brier, reliability, wilson

jobs = st.builds(
    lambda seed, n, steps: (
        np.round(np.random.default_rng(seed).random(n) * steps) / steps,
        np.random.default_rng(seed + 1).random(n) < 0.4,
    ),
    st.integers(0, 9999),
    st.integers(1, 200),
    st.sampled_from([4, 50, 10**6]),
)


@given(jobs=jobs, bins=st.integers(1, 12))
def test_the_table_is_scikit_learn_s(jobs, bins) -> None:
    p, event = jobs
    table = reliability(p, event, bins=bins)
    share, mean_p = calibration_curve(event, p, n_bins=bins, strategy="quantile", pos_label=True)
    np.testing.assert_allclose(table.share, share)
    np.testing.assert_allclose(table.mean_p, mean_p)
    assert table.count.sum() == len(p)
    assert (table.low <= table.share + 1e-12).all()
    assert (table.share <= table.high + 1e-12).all()


@given(jobs=jobs)
def test_brier_is_scikit_learn_s(jobs) -> None:
    p, event = jobs
    assert brier(p, event) == pytest.approx(brier_score_loss(event, p, pos_label=True))


def test_the_error_of_two_bins_by_hand() -> None:
    p = np.array([0.1, 0.2, 0.3, 0.9, 0.9, 1.0])
    event = np.array([0, 0, 1, 1, 1, 0], bool)
    # Means 0.2 and 2.8/3, shares 1/3 and 2/3, three jobs each.
    assert reliability(p, event, bins=2).error == pytest.approx(0.5 * (1 / 3 - 0.2) + 0.5 * (2.8 / 3 - 2 / 3))


def test_a_true_probability_has_little_error_and_a_boast_has_much() -> None:
    rng = np.random.default_rng(0)
    p = rng.random(20_000)
    event = rng.random(20_000) < p
    assert reliability(p, event).error < 0.01
    # A forecast pushed to the ends errs by the mean distance between what it says and what it knew.
    share = np.square(p) / (np.square(p) + np.square(1 - p))
    grid = np.linspace(0, 1, 100_001)
    expected = np.mean(np.abs(np.square(grid) / (np.square(grid) + np.square(1 - grid)) - grid))
    assert reliability(share, event).error == pytest.approx(expected, abs=0.012)


def test_the_interval_is_wilson_s() -> None:
    # Newcombe, Statistics in Medicine 17 (1998), table I, method 3: 81/263, 15/148, 0/20, 1/29.
    low, high = wilson(np.array([81 / 263, 15 / 148, 0.0, 1 / 29]), np.array([263, 148, 20, 29]))
    assert low == pytest.approx([0.2553, 0.0624, 0.0, 0.0061], abs=5e-5)
    assert high == pytest.approx([0.3662, 0.1605, 0.1611, 0.1718], abs=5e-5)


@pytest.mark.parametrize(
    ("p", "event", "says"),
    [
        (np.zeros(0), np.zeros(0, bool), "at least one"),
        (np.zeros(3), np.zeros(2, bool), "must be"),
        (np.array([1.2]), np.array([True]), r"\[0, 1\]"),
        (np.array([np.nan]), np.array([True]), r"\[0, 1\]"),
    ],
)
def test_what_is_no_probability_is_refused(p, event, says) -> None:
    with pytest.raises(ValueError, match=says):
        reliability(p, event)


def test_no_bins_make_no_table() -> None:
    with pytest.raises(ValueError, match="at least one bin"):
        reliability(np.ones(3), np.ones(3, bool), bins=0)
