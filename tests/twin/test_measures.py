import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.distance import mahalanobis

from fleet.errors import CheckpointError
from fleet.motion import Phase
from twin.vae.measures import (
    LEAST_VARIANCE,
    PARTS,
    READINGS,
    TIE,
    Calibration,
    Features,
    latent_moments,
    measures_of,
)
from twin.vae.twin import CARD, load, save
from twin.vae.window import cut, cut_jobs, resample

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
    with pytest.raises(ValueError, match="No reading 'lod'; did you mean 'load'"):
        both.p_value(new, weight, "lod")


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


def test_cool_jobs_raise_false_alarms_as_often_as_asked():
    """Split conformal: over many calibrations, P(p ≤ α) ≤ α for exchangeable jobs."""
    rng = np.random.default_rng(2)
    alarms = np.concatenate([calibrated(packed(39, rng)).p_value(packed(20, rng), np.ones(7)) for _ in range(300)])
    for alpha in (0.05, 0.1, 0.25):
        assert np.mean(alarms <= alpha) == pytest.approx(alpha, abs=0.012)


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
    with pytest.raises(ValueError, match="one job"):
        together.why()
    with pytest.raises(ValueError, match="one job"):
        own.of_job(0)


def test_without_a_calibration_there_is_no_opinion_on_what_is_usual(twin, jobs):
    measures = twin.measure(*jobs[0])
    assert measures.calibrated is None
    assert measures.p_value is None
    errors = twin.features(*([each] for each in jobs[0])).errors[0]
    np.testing.assert_allclose(measures.shares, errors / errors.sum())
    assert measures.total == pytest.approx(twin.score(*jobs[0]).total)


def test_windows_have_measures_too(known, jobs):
    windows = cut(resample(jobs[0][0].cycle.profile, 50.0, 12.5), known.config.window, known.config.window)
    measures = known.measures_of(known.window_features(windows))
    assert measures.calibrated.shape == (len(windows), 7)
    assert np.all((measures.p_value > 0) & (measures.p_value <= 1))


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
