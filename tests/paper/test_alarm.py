"""The alarm keeps its promise on exchangeable jobs, and says when it cannot give one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from benchmarks.paper.subjects import TooFewJobs, alarm_threshold, raised
from twin.vae.measures import p_value, rate_interval


@pytest.mark.parametrize("draw", ["normal", "exponential", "coarse"])
@pytest.mark.parametrize(("alpha", "n"), [(0.05, 19), (0.05, 150), (0.2, 37)])
def test_false_alarms_stay_below_alpha_whatever_the_scores_are_like(draw, alpha, n) -> None:
    rng = np.random.default_rng([n, round(100 * alpha)])
    trials = 1500
    scores = rng.integers(0, 9, (trials, n + 1)) if draw == "coarse" else getattr(rng, draw)(size=(trials, n + 1))
    false = sum(row[-1] > alarm_threshold(row[:-1], alpha) for row in scores)
    # Exactly floor(alpha (n + 1))/(n + 1) without ties, and less with them.
    exact = np.floor(alpha * (n + 1) + 1e-9) / (n + 1)
    assert exact <= alpha + 1e-9
    assert false <= binom.ppf(0.9999, trials, exact)
    if draw != "coarse":
        assert false >= binom.ppf(0.0001, trials, exact)


@given(
    scores=st.lists(st.floats(-5, 5), min_size=9, max_size=60),
    alpha=st.floats(0.1, 0.9),
    asked=st.lists(st.floats(-6, 6), min_size=1),
)
def test_the_alarm_is_a_small_p_value(scores, alpha, asked) -> None:
    threshold = alarm_threshold(scores, alpha)
    new = np.array([*asked, *scores])
    counted = np.array([(1 + sum(s >= x for s in scores)) / (len(scores) + 1) for x in new])
    np.testing.assert_allclose(p_value(np.sort(scores), new), counted)
    np.testing.assert_array_equal(new > threshold, counted <= alpha + 1e-9 / (len(scores) + 1))


def test_the_spread_holds_nine_calibrations_of_ten() -> None:
    rng = np.random.default_rng(5)
    rng.random(100)
    low, high = rate_interval(100, 0.05, 0.9)
    # Uniform scores: the true rate of an alarm is one minus its threshold.
    rates = np.array([1 - alarm_threshold(rng.random(100), 0.05) for _ in range(1000)])
    inside = ((rates >= low) & (rates <= high)).sum()
    assert binom.ppf(0.0001, 1000, 0.9) <= inside <= binom.ppf(0.9999, 1000, 0.9)


def test_too_few_jobs_promise_nothing() -> None:
    assert alarm_threshold(np.arange(19), 0.05) == 18
    with pytest.raises(TooFewJobs, match=r"0\.05 needs 19 or more jobs without the event \(got 18\)"):
        alarm_threshold(np.arange(18), 0.05)


def test_what_has_no_score_is_warned_of() -> None:
    assert raised(np.array([np.nan, 18.0, 18.5]), alarm_threshold(np.arange(19))) == 2 / 3


def test_what_makes_no_alarm_is_refused() -> None:
    with pytest.raises(ValueError, match="between 0 and 1"):
        alarm_threshold([1.0, 2.0], 0.0)
    with pytest.raises(ValueError, match="finite"):
        alarm_threshold([1.0, np.nan], 0.5)
