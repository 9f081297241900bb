"""Verdicts: rate of false alarms against its closed form, for each kind of cool job, and what has no guarantee."""

import numpy as np
import pytest
from scipy.stats import beta, kstest

from benchmarks.paper.subjects import allowed
from fleet.errors import FleetError
from twin.vae.measures import Features, fewest, largest_p_value, p_value
from twin.verdict import NoGuarantee, Rule, log_features, log_windows


@pytest.mark.parametrize(("count", "alpha"), [(64, 0.05), (100, 0.05), (39, 0.2)])
def test_the_rate_of_false_alarms_of_a_calibration_is_a_beta_variable(count, alpha):
    """Vovk 2012: given the calibration the rate is Beta(m, n + 1 − m), so its mean is m / (n + 1) <= alpha.

    Uniform scores: the rate of one calibration is one minus the largest score that raises no alarm, exactly.
    """
    rng = np.random.default_rng(5)
    grid = np.linspace(0.0, 1.0, 20_001)
    rates = [(p_value(np.sort(rng.random(count)), grid) <= alpha).mean() for _ in range(600)]
    m = allowed(count, alpha)
    assert np.mean(rates) == pytest.approx(m / (count + 1), abs=4 * np.std(rates) / np.sqrt(600))
    assert m / (count + 1) <= alpha
    assert kstest(rates, beta(m, count + 1 - m).cdf).pvalue > 0.01


@pytest.mark.parametrize("shift", [-1.0, 0.0, 1.0])
def test_each_kind_of_cool_job_has_its_guarantee(shift):
    """Pooled, one kind takes the false alarms of the other; the largest p-value bounds each."""
    rng, alpha = np.random.default_rng(6), 0.1
    group = np.repeat([0, 1], 49)
    false, pooled = [], []
    for _ in range(400):
        reference = np.concatenate([rng.normal(size=49), rng.normal(shift, 1.0, 49)])
        kinds = rng.normal(size=20), rng.normal(shift, 1.0, 20)
        false.append([(largest_p_value(reference, group, kind) <= alpha).mean() for kind in kinds])
        pooled.append([(p_value(np.sort(reference), kind) <= alpha).mean() for kind in kinds])
    assert np.max(np.mean(false, axis=0)) <= alpha + 0.01
    if shift:
        assert np.max(np.mean(pooled, axis=0)) > alpha + 0.03


def test_jobs_that_were_trained_on_make_new_ones_look_anomalous():
    """Why the calibration is held out: scores of trained-on jobs are lower than those of new ones."""
    rng = np.random.default_rng(7)
    false = [
        (p_value(np.sort(0.7 * rng.gamma(4.0, size=64)), rng.gamma(4.0, size=50)) <= 0.05).mean() for _ in range(200)
    ]
    assert np.mean(false) > 0.12


@pytest.mark.parametrize("alpha", [0.01, 0.05, 0.2, 0.5])
def test_fewest_is_enough_and_one_less_is_not(alpha):
    assert allowed(fewest(alpha), alpha) == 1
    assert allowed(fewest(alpha) - 1, alpha) == 0


def test_no_verdict_without_a_guarantee(twin, make_plan, motion):
    jobs = [(make_plan(*(motion(np.random.default_rng(n), s) for s in (2.0, 6.0, 2.0))), 1) for n in range(4)]
    with pytest.raises(NoGuarantee, match="has no held-out cool jobs"):
        Rule(twin=twin)
    known = twin.with_calibration(jobs, jobs[:3])
    with pytest.raises(NoGuarantee, match=r"needs 19 held-out cool jobs of each kind .* has 3\). Choose alpha >= 0.25"):
        Rule(twin=known)
    with pytest.raises(FleetError, match="alpha must be between 0 and 1"):
        Rule(twin=known, alpha=1.0)
    with pytest.raises(FleetError, match="No reading 'lod'"):
        Rule(twin=known, alpha=0.5, reading="lod")
    rule = Rule(twin=known, alpha=0.25)
    features = known.features(*zip(*jobs, strict=True))
    assert not rule.anomalous(features)[np.argmin(features.one_sided @ known.joint_weight)]
    heavy = Features(features.packed * 10)
    assert rule.anomalous(heavy).all()
    np.testing.assert_array_equal(rule.p_value(heavy), 0.25)  # the larger of 1/5 and 1/4
    assert "7 jobs of 2 kinds" in rule.guarantee


def test_a_recording_has_the_mean_of_its_windows(twin, recording_of):
    recording = recording_of(60.0)
    parts = log_windows(twin, recording)
    packed = np.concatenate([features.packed for _, _, features in parts])
    np.testing.assert_allclose(log_features(twin, recording).packed, packed.mean(axis=0))
    with pytest.raises(FleetError, match=r"no stretch of 0\.96 s without a gap"):
        log_features(twin, recording_of(0.5))
