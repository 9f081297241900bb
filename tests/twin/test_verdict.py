"""Verdicts, measures and simpler scores against closed forms and second methods."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.distance import mahalanobis
from scipy.stats import beta, binom, kstest

from fleet.errors import CheckpointError, FleetError
from fleet.motion import Phase
from twin.baselines import known_torque, torque_ratio
from twin.log_windows import log_windows
from twin.logs.recording import Recording
from twin.vae.config import TwinConfig
from twin.vae.measures import (
    LEAST_VARIANCE,
    PARTS,
    READINGS,
    TIE,
    Calibration,
    Features,
    fewest,
    latent_moments,
    measures_of,
    p_value,
)
from twin.vae.twin import CARD, load, save
from twin.vae.window import cut, cut_jobs, resample
from twin.verdict import LogStretches, NoGuarantee, Rule, log_features


@pytest.mark.parametrize(("count", "alpha"), [(64, 0.05), (100, 0.05), (39, 0.2)])
def test_the_rate_of_false_alarms_of_a_calibration_is_a_beta_variable(count, alpha):
    """Vovk 2012: given the calibration the rate is Beta(m, n + 1 − m), so its mean is m / (n + 1) <= alpha.

    Uniform scores: the rate of one calibration is one minus the largest score that raises no alarm, exactly.
    """
    rng = np.random.default_rng(5)
    grid = np.linspace(0.0, 1.0, 20_001)
    rates = [(p_value(np.sort(rng.random(count)), grid) <= alpha).mean() for _ in range(600)]
    m = int(np.floor(alpha * (count + 1) + 1e-9))
    assert np.mean(rates) == pytest.approx(m / (count + 1), abs=4 * np.std(rates) / np.sqrt(600))
    assert m / (count + 1) <= alpha
    assert kstest(rates, beta(m, count + 1 - m).cdf).pvalue > 0.01


@pytest.mark.parametrize("alpha", [0.01, 0.05, 0.2, 0.5])
def test_fewest_is_enough_and_one_less_is_not(alpha):
    assert p_value(np.zeros(fewest(alpha)), np.ones(1))[0] <= alpha + 1e-12
    assert p_value(np.zeros(fewest(alpha) - 1), np.ones(1))[0] > alpha


def test_no_verdict_without_a_guarantee(twin, make_plan, motion):
    jobs = [(make_plan(*(motion(np.random.default_rng(n), s) for s in (2.0, 6.0, 2.0))), 1) for n in range(4)]
    with pytest.raises(NoGuarantee, match="has no held-out cool jobs"):
        Rule(twin=twin)
    known = twin.with_calibration(jobs, jobs[:3])
    with pytest.raises(
        NoGuarantee, match=r"needs 19 held-out cool jobs of each kind .* has 3\). Choose --alpha >= 0.25"
    ):
        Rule(twin=known)
    with pytest.raises(NoGuarantee) as refused:
        Rule(twin=twin.with_calibration(jobs * 14, jobs * 6 + jobs[:3]), alpha=0.03)
    least = float(re.search(r"--alpha >= (\S+),", str(refused.value))[1])
    assert 1 / 28 <= least < 0.036, "the given rate is not refused itself"
    with pytest.raises(FleetError, match="alpha must be between 0 and 1"):
        Rule(twin=known, alpha=1.0)
    with pytest.raises(FleetError, match="No reading 'lod'; did you mean 'load'"):
        Rule(twin=known, alpha=0.5, reading="lod")
    rule = Rule(twin=known, alpha=0.25)
    features = known.features(*zip(*jobs, strict=True))
    assert not rule.anomalous(features)[np.argmin(features.one_sided @ known.joint_weight)]
    heavy = Features(features.packed * 10)
    assert rule.anomalous(heavy).all()
    np.testing.assert_array_equal(rule.p_value(heavy), 0.25)  # the larger of 1/5 and 1/4
    assert rule.guarantee.startswith("At most 0.25 of new cool jobs")
    assert "7 jobs of 2 kinds" in rule.guarantee
    assert replace(rule, reading="latent").guarantee.startswith("About 0.25 of new cool jobs")


def test_a_recording_is_judged_by_its_worst_stretches(twin, recording_of, monkeypatch):
    """Second method: every stretch in a loop."""
    monkeypatch.setattr("twin.verdict.STRETCH_S", 10 * 0.96)
    recording, w = recording_of(60.0), twin.joint_weight
    ((_, _, features),) = log_windows(twin, recording)
    stretches = [features.packed[i : i + 10].mean(axis=0) for i in range(len(features.packed) - 9)]
    judged = log_features(twin, recording)
    assert judged.one_sided @ w == pytest.approx(max(Features(each).one_sided @ w for each in stretches))
    assert judged.difficulty @ w == pytest.approx(max(Features(each).difficulty @ w for each in stretches))
    np.testing.assert_allclose(judged.packed[:, PARTS:], features.packed[..., PARTS:].mean(axis=0))
    short = recording.part(slice(0, 300))  # shorter than a stretch: one stretch
    (window,) = (each.packed.mean(axis=0) for _, _, each in log_windows(twin, short))
    np.testing.assert_allclose(log_features(twin, short).packed, window)
    with pytest.raises(FleetError, match=r"no stretch of 0\.96 s without a gap"):
        log_features(twin, recording_of(0.5))


def swinging(motion, seed, seconds, load=1.0):
    """A log of smooth motion at 12.5 Hz; load [time] scales the torque."""
    q, qd, tau = motion(np.random.default_rng(seed), seconds).astype(float)[::4].swapaxes(0, 1)
    return Recording(name=f"log_{seed}", time_s=np.arange(len(q)) / 12.5, q=q, qd=qd, tau=tau * load)


@pytest.fixture(scope="module")
def cool_logs(twin, motion):
    """Judged features of cool recordings, 20 to 60 s long."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twin.verdict.STRETCH_S", 10.0)
        lengths = np.random.default_rng(8).uniform(20.0, 60.0, 120)
        return np.stack([log_features(twin, swinging(motion, i, s)).packed for i, s in enumerate(lengths)])


@pytest.mark.parametrize("reading", ["load", "d"])
def test_few_cool_recordings_are_called_anomalous(twin, cool_logs, reading):
    """Each recording against 19 others: the rate is 1 in 20, within the 99.9 % bound of a binomial variable."""
    rng, alarms = np.random.default_rng(3), 0
    for i in range(len(cool_logs)):
        others = rng.permutation(np.delete(np.arange(len(cool_logs)), i))[:19]
        known = twin.calibrated_on(Features(cool_logs[others]), np.zeros(19, int))
        alarms += int(Rule(twin=known, reading=reading).anomalous(Features(cool_logs[i])))
    assert 0 < alarms <= binom.ppf(0.999, len(cool_logs), 0.05)


def test_a_load_is_found_in_a_long_rest(twin, motion, cool_logs, monkeypatch):
    """150 s of load before 20 min of rest; the mean over the whole recording is that of a cool one."""
    monkeypatch.setattr("twin.verdict.STRETCH_S", 10.0)
    rule = Rule(twin=twin.calibrated_on(Features(cool_logs), np.zeros(len(cool_logs), int)))
    log = swinging(motion, 999, 1350.0)
    load = np.where(log.time_s < 150.0, 3.0, 0.1)[:, None]
    stretches = LogStretches.of(twin, replace(log, tau=log.tau * load))
    worst, mean = stretches.worst(twin.joint_weight), Features(stretches.windows.packed.mean(axis=0))
    assert rule.anomalous(worst)
    assert not rule.anomalous(mean)
    assert stretches.share(rule.anomalous(stretches.stretches)) == pytest.approx(150 / 1350, abs=0.02)
    assert stretches.share(np.array([True] + [False] * (len(stretches.stretches.packed) - 1))) == pytest.approx(
        stretches.length / len(stretches.windows.packed)
    )


errors = st.floats(0.0, 20.0)


def packed(count, rng):
    return Features(rng.gamma(3.0, 0.2, (count, 7, PARTS)))


def calibrated(reference, *counts):
    """A calibration on kinds of so many jobs; all of one kind by default."""
    return Calibration(reference, np.repeat(np.arange(max(len(counts), 1)), counts or len(reference.packed)))


@pytest.fixture(scope="module")
def calibration():
    return calibrated(packed(200, np.random.default_rng(0)))


@pytest.fixture(scope="module")
def jobs(make_plan, motion):
    rng = np.random.default_rng(4)
    return [(make_plan(*(motion(rng, s) for s in (2.0, 6.0, 2.0))), 1 + i) for i in range(12)]


@pytest.fixture(scope="module")
def known(twin, jobs):
    return twin.with_calibration(jobs)


def heavier(plan, joint, factor):
    def load_of(phase):
        profile = phase.profile.copy()
        profile[:, 2, joint] *= factor
        return Phase(profile, phase.payload_kg)

    return replace(plan, **{name: load_of(getattr(plan, name)) for name in ("approach", "cycle", "retreat")})


@given(arrays(float, (4, 7, PARTS), elements=errors))
def test_difficulty_is_one_minus_exp_of_the_summed_error(values):
    features = Features(values)
    want = 1 - np.exp(-values[..., :3].sum(axis=-1))
    np.testing.assert_allclose(features.difficulty, np.minimum(want, 1 - 1e-13), atol=1e-12)
    assert np.all(features.difficulty < 1)
    np.testing.assert_allclose(features.load, 1 - np.exp(-values[..., 3]), atol=1e-12)


def test_calibrated_difficulty_is_zero_at_the_median_half_at_the_95th_percentile_and_rises_to_one(calibration):
    usual = calibration.reference.errors.sum(axis=-1)
    for level, want in ((0.0, 0.0), (50.0, 0.0), (95.0, 0.5), (100.0, None)):
        values = np.zeros((7, PARTS))
        values[:, 0] = np.percentile(usual, level, axis=0)
        got = calibration.difficulty(Features(values))
        if want is None:
            assert np.all(got > 0.5)
        else:
            np.testing.assert_allclose(got, want, atol=1e-12)
    far = np.zeros((7, PARTS))
    far[:, 2] = 20.0
    assert np.all(calibration.difficulty(Features(far)) > 0.99)


def test_joints_that_never_differ_have_a_least_spread():
    calibration = calibrated(Features(np.full((5, 7, PARTS), 0.2)))
    np.testing.assert_allclose(calibration.spread, 0.01)
    assert np.all(np.isfinite(calibration.difficulty(Features(np.full((7, PARTS), 0.3)))))


@given(st.integers(2, 60), st.integers(0, 2**32 - 1))
def test_the_p_value_counts_cool_jobs_that_score_as_high(count, seed):
    rng = np.random.default_rng(seed)
    calibration, weight = calibrated(packed(count, rng)), rng.uniform(0.1, 2.0, 7)
    new = Features(np.concatenate([packed(6, rng).packed, calibration.reference.packed[:2]]))  # the last two are ties
    reference = calibration.reference.one_sided @ weight
    for s, p in zip(new.one_sided @ weight, calibration.p_value(new, weight), strict=True):
        assert p == (1 + sum(r >= s - TIE * abs(s) for r in reference)) / (count + 1)  # what is nearly as high counts


def test_the_p_value_is_the_largest_over_the_kinds_of_cool_jobs(rng):
    light, heavy = packed(30, rng), Features(packed(50, rng).packed * 1.5)
    both, weight, new = (
        calibrated(Features(np.concatenate([light.packed, heavy.packed])), 30, 50),
        np.ones(7),
        packed(20, rng),
    )
    for reading in READINGS:
        if reading != "latent":  # its cluster is that of all jobs
            each = [calibrated(kind).p_value(new, weight, reading) for kind in (light, heavy)]
            np.testing.assert_array_equal(both.p_value(new, weight, reading), np.maximum(*each))


def test_the_latent_distance_is_that_of_mahalanobis_averaged_over_time(rng):
    """Second method: scipy, window by window. Over the calibration its mean square is the number of latent units."""
    mu = rng.normal(size=(60, 7, 2)) @ rng.normal(size=(2, 2)) + 3.0  # [window, joint, latent]
    windows = Features(np.concatenate([np.zeros((60, 7, PARTS)), latent_moments(mu)], axis=-1))
    jobs = Features(windows.packed.reshape(20, 3, 7, -1).mean(axis=1))  # three windows each
    known = calibrated(jobs)
    np.testing.assert_allclose((known.latent(jobs) ** 2).mean(axis=0), 2.0, rtol=1e-2)
    for j in range(7):
        inverse = np.linalg.inv(np.cov(mu[:, j].T, bias=True) + LEAST_VARIANCE * np.eye(2))
        want = [mahalanobis(each, mu[:, j].mean(axis=0), inverse) for each in mu[:, j]]
        np.testing.assert_allclose(known.latent(windows)[:, j], want, rtol=1e-9)
        np.testing.assert_allclose(
            known.latent(jobs)[:, j] ** 2, np.square(want).reshape(20, 3).mean(axis=1), rtol=1e-9
        )


def test_a_twin_places_motion_in_its_latent_space(known, jobs):
    """Second method: the posterior of each window."""
    plan, times = jobs[3]
    reading = cut_jobs([plan], [times], known.config)
    mu, _ = known.posterior(reading.windows)
    weight = reading.weight.sum(axis=1)
    mean, square = known.features([plan], [times]).latent_moments
    np.testing.assert_allclose(mean[0], np.einsum("b,bjl->jl", weight, mu), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(square[0], np.einsum("b,bjl,bjm->jlm", weight, mu, mu), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 7, PARTS), (7, PARTS)])
def test_a_calibration_needs_some_jobs(shape):
    with pytest.raises(ValueError, match="two or more held-out cool jobs"):
        Calibration(Features(np.zeros(shape)), np.zeros(shape[0], int))
    with pytest.raises(ValueError, match="one group per job"):
        Calibration(Features(np.zeros((4, 7, PARTS))), np.zeros(3, int))
    with pytest.raises(ValueError, match="must be"):
        Features(np.zeros((7, 3)))


@pytest.mark.parametrize(
    ("channel", "one_sided", "word"),
    [(0, 0.0, "a new place"), (1, 0.0, "a new speed"), (2, 1.0, "more load"), (2, 0.1, "another load")],
)
def test_the_reason_is_named_in_words(calibration, channel, one_sided, word):
    values = np.zeros((7, PARTS))
    values[:, :3] = calibration.usual
    values[3, channel] += 2.0
    values[3, 3] = one_sided * values[3, 2]
    measures = measures_of(Features(values), calibration, weight=np.ones(7), version="v")
    assert measures.why() == f"joint 4: {word} (100 %)"
    assert measures.shares.sum() == pytest.approx(1.0)


def test_nothing_beyond_the_usual_says_so(calibration):
    values = np.zeros((7, PARTS))
    measures = measures_of(Features(values), calibration, weight=np.ones(7), version="v")
    assert measures.why() == "nothing beyond the usual"
    assert measures.shares.sum() == 0
    assert measures.p_value == 1.0


def test_one_sided_torque_counts_only_more_load_than_the_twin_makes_of_it(twin, jobs, known):
    """Second way: from the reconstruction in SI units."""
    windows = cut(resample(heavier(jobs[0][0], 1, 2.0).cycle.profile, 50.0, 12.5), twin.config.window, 6)
    tau, tau_hat = windows[..., 2], twin.reconstruct(windows)[..., 2]
    features = twin.window_features(windows)
    more = np.maximum(np.abs(tau) - np.abs(tau_hat), 0) / twin.scaler.std[:, 2]
    np.testing.assert_allclose(features.one_sided, more.mean(axis=1), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(
        features.excess_sq, np.maximum(tau**2 - tau_hat**2, 0).mean(axis=1), rtol=1e-3, atol=1e-4
    )
    assert np.all(features.one_sided <= features.errors[..., 2] + 1e-6)


def test_a_heavier_job_is_told_from_cool_ones_and_why(known, jobs):
    cool = known.measures([plan for plan, _ in jobs], [times for _, times in jobs])
    hot = known.measure(heavier(jobs[0][0], 1, 10.0), 5)
    assert np.median(cool.calibrated) < 0.05
    assert hot.calibrated[1] > 0.9
    assert hot.calibrated[1] > cool.calibrated[:, 1].max()
    assert hot.load[1] > cool.load[:, 1].max()
    assert hot.p_value == pytest.approx(1 / 13)
    assert hot.why(1).startswith("joint 2: more load")
    assert hot.version == known.version


def test_measures_of_many_jobs_are_those_of_each(known, jobs):
    together = known.measures([plan for plan, _ in jobs], [times for _, times in jobs])
    for i, (plan, times) in enumerate(jobs):
        one, own = together.of_job(i), known.measure(plan, times)
        np.testing.assert_array_equal(one.difficulty, own.difficulty)
        np.testing.assert_array_equal(own.difficulty, known.score(plan, times).per_joint)
        assert (one.p_value, one.why()) == (own.p_value, own.why())


def test_without_a_calibration_there_is_no_opinion_on_what_is_usual(twin, jobs):
    measures = twin.measure(*jobs[0])
    assert measures.calibrated is None
    assert measures.p_value is None
    errors = twin.features(*([each] for each in jobs[0])).errors[0]
    np.testing.assert_allclose(measures.shares, errors / errors.sum())
    assert measures.total == pytest.approx(twin.score(*jobs[0]).total)


def test_a_calibration_is_kept_in_the_checkpoint_and_in_the_version(twin, known, jobs, tmp_path):
    save(known, tmp_path / "a")
    back = load(tmp_path / "a")
    assert back.version == known.version != twin.version
    assert (back.measure(*jobs[1]).p_value, back.arm) == (known.measure(*jobs[1]).p_value, known.arm)
    np.testing.assert_array_equal(back.calibration.reference.packed, known.calibration.reference.packed)
    save(twin, tmp_path / "b")
    assert load(tmp_path / "b").calibration is None


def test_a_checkpoint_with_and_without_calibration_cannot_be_mixed(twin, known, tmp_path):
    for model, claims, words in ((twin, True, "missing tensor 'calibration"), (known, False, "unknown tensors")):
        folder = tmp_path / str(claims)
        save(model, folder)
        card = json.loads((folder / CARD).read_text())
        (folder / CARD).write_text(json.dumps({**card, "calibrated": claims}))
        with pytest.raises(CheckpointError, match=words):
            load(folder)


def test_rms_torque_by_hand(make_plan):
    def at(seconds, torque):
        profile = np.zeros((round(50 * seconds), 3, 7), np.float32)
        profile[:, 2] = torque
        return profile

    plan = make_plan(at(1.0, 2.0), at(2.0, -4.0), at(1.0, 0.0))
    # 3 cycles: 1 s at 2, 6 s at 4, 1 s at 0.
    rms = np.sqrt((4.0 + 6 * 16.0) / 8)
    nominal = np.array([10.0, 5.0, 10, 10, 10, 10, 10])
    np.testing.assert_allclose(torque_ratio(plan, 3, nominal), rms / nominal)


def test_the_known_torque_is_the_rms_of_the_records(records):
    squares = np.concatenate([record[:, 2].astype(float) ** 2 for record in records[:12]])
    np.testing.assert_allclose(known_torque(records[:12]), np.sqrt(squares.mean(axis=0)))


def test_what_cannot_be_scored_says_so(records, jobs, make_plan, motion, rng):
    nothing = make_plan(*(np.zeros((0, 3, 7), np.float32) for _ in range(3)))
    three = make_plan(*(motion(rng, 2.0)[..., :3] for _ in range(3)))
    known_nm = known_torque(records[:12])
    for plan, times, words in (
        (jobs[0][0], 0, "at least one repetition"),
        (nothing, 1, "no motion"),
        (three, 1, "7 joints, the plan 3"),
    ):
        with pytest.raises(ValueError, match=words):
            torque_ratio(plan, times, known_nm)
    for plans, times, words in (([], [], "no job"), ([plan for plan, _ in jobs[:2]], [1], "2 plans, 1 repetitions")):
        with pytest.raises(ValueError, match=words):
            cut_jobs(plans, times, TwinConfig())
    with pytest.raises(ValueError, match="at least one record"):
        known_torque([])
