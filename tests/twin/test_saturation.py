"""The probability of saturation: computed, learnt, carried and judged, against scikit-learn and a known world."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.calibration import calibration_curve
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import brier_score_loss, roc_auc_score

from fleet.difficulty import KNOWN
from fleet.errors import CheckpointError
from tests.profiles import examples
from twin.p_saturation import (
    FILE,
    LEAST_JOBS,
    LEAST_OF_EACH,
    Experience,
    NotEnoughExperience,
    SaturationModel,
    brier,
    evidence_of,
    fit_saturation,
    load_saturation,
    logistic,
    monotone_curve,
    reliability,
    save_saturation,
    wilson,
)
from twin.thermal.thermal_twin import CalibratedTwin, PeakCurve, RcTwin
from twin.vae.measures import PARTS, Features

MODEL = SaturationModel(
    twin="t",
    evidence="load",
    method="logistic",
    horizon_s=None,
    offset=-10.0,
    at_once=((0.0,), (1.5,), (0.0,), (1.0,), (0.0,), (0.0,), (0.0,)),
    later=((0.0,), (1.0,), (0.0,), (0.0,), (0.0,), (0.0,), (0.0,)),
    of_log_duration=0.5,
    of_start=tuple(0.2 if k == 1 else 0.0 for k in range(KNOWN)),
    of_start_later=tuple({3: 0.1, 14: 0.2}.get(k, 0.0) for k in range(KNOWN)),
    curve=None,
    data_hash="d",
    jobs=200,
    passed=40,
    strength=1.0,
    log_loss=0.1,
)


def features(**load: float) -> Features:
    """One-sided torque errors by joint, all else 9."""
    packed = np.full((7, PARTS), 9.0)
    packed[:, 3] = [load.get(f"joint_{k + 1}", 0.0) for k in range(7)]
    return Features(packed)


def test_a_probability_by_hand() -> None:
    known_c = np.full(KNOWN, 99.0)
    known_c[[1, 3, 14]] = 40.0, 20.0, 10.0
    # Half warmed: −10 + (1.5 + 0.5) · 1.5 + 1 · 0.5 + ½ (0.2 · 40 + 0.1 · 20 + 0.2 · 10) + 0.5 · ln t
    half_s = 1500.0 * np.log(2.0)
    expected = -0.5 + 0.5 * np.log(half_s)
    risk = MODEL.risk(features(joint_2=1.5, joint_4=0.5), half_s)
    assert risk.at(known_c) == pytest.approx(1 / (1 + np.exp(-expected)))
    assert MODEL.score(features(joint_2=1.5, joint_4=0.5), half_s, known_c) == pytest.approx(expected)


def test_what_comes_after_the_horizon_does_not_count() -> None:
    known_c = np.full(KNOWN, 30.0)
    near = replace(MODEL, horizon_s=600.0)
    assert near.score(features(), 3000.0, known_c) == MODEL.score(features(), 600.0, known_c)
    assert near.score(features(), 300.0, known_c) == MODEL.score(features(), 300.0, known_c)


@given(seed=st.integers(0, 999), count=st.integers(1, 5))
def test_many_jobs_are_each_job(seed, count) -> None:
    rng = np.random.default_rng(seed)
    packed, duration, temp = (
        rng.random((count, 7, PARTS)),
        rng.uniform(1, 1e4, count),
        rng.uniform(10, 70, (count, KNOWN)),
    )
    curve = ((-5.0, 0.01), (0.0, 0.3), (4.0, 0.99))
    for model in (MODEL, replace(MODEL, curve=curve)):
        p = model.risk(Features(packed), duration).at(temp)
        each = [float(model.risk(Features(f), d).at(t)) for f, d, t in zip(packed, duration, temp, strict=True)]
        assert p == pytest.approx(each)
    scores = MODEL.score(Features(packed), duration, temp)
    assert 1 / (1 + np.exp(-scores)) == pytest.approx(MODEL.risk(Features(packed), duration).at(temp))
    assert p == pytest.approx(np.interp(scores, *np.array(curve).T))


def test_evidence_names_what_is_read() -> None:
    packed = np.arange(7.0 * PARTS).reshape(7, PARTS)
    assert evidence_of(Features(packed), "errors").tolist() == packed[:, :3].tolist()
    assert evidence_of(Features(packed), "load").tolist() == packed[:, 3:4].tolist()
    assert evidence_of(Features(packed), "excess").tolist() == packed[:, 4:5].tolist()
    assert evidence_of(Features(packed), "torque").tolist() == packed[:, 5:].tolist()
    with pytest.raises(ValueError, match="No evidence 'lod'; did you mean 'load'"):
        evidence_of(Features(packed), "lod")


@pytest.mark.parametrize("duration_s", [0.0, -1.0, np.nan, np.inf])
def test_a_job_without_duration_is_refused(duration_s) -> None:
    with pytest.raises(ValueError, match="lasts > 0 s"):
        MODEL.risk(features(), duration_s)


def test_a_job_of_another_arm_is_refused() -> None:
    with pytest.raises(ValueError, match=r"needs \(7, 1\) numbers \[joint, column\] of a job \(got \(6, 1\)\)"):
        MODEL.risk(Features(np.zeros((6, PARTS))), 10.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"offset": np.nan},
        {"of_log_duration": -0.1},
        {"of_start": (-0.1,) * KNOWN},
        {"of_start_later": (0.1,) * 7},
        {"evidence": "x"},
    ],
)
def test_a_model_that_makes_no_sense_is_refused(changes) -> None:
    with pytest.raises(ValueError, match="SaturationModel"):
        replace(MODEL, **changes)


def test_a_calibrated_twin_says_what_each_model_says(twin, plan) -> None:
    model, heat = replace(MODEL, twin=twin.version), RcTwin.nominal()
    known = CalibratedTwin(twin, heat, model)
    told = known.score(plan, 40)
    np.testing.assert_array_equal(told.per_joint, twin.score(plan, 40).per_joint)
    known_c = np.linspace(20.0, 50.0, KNOWN)
    expected = model.risk(twin.features([plan], [40]), np.array([plan.duration_s(40)])).at(known_c)[0]
    assert told.p_at(known_c) == pytest.approx(expected)
    assert told.peak_at(known_c) == heat.peak(plan, 40).value(known_c)
    assert known.version == f"d:{twin.version}+peak:{heat.version}+p:load-{model.version}"
    by_peak = CalibratedTwin(twin, replace(heat, curve=PeakCurve(knots=((0.0, 0.25), (200.0, 0.25)), jobs=30)))
    assert by_peak.score(plan, 40).p_at(known_c) == 0.25
    with pytest.raises(ValueError, match="fitted on twin t, this is"):
        CalibratedTwin(twin, heat, MODEL)


def test_a_saved_model_is_the_same_model_and_other_content_another_version(tmp_path: Path, twin) -> None:
    model = replace(MODEL, twin=twin.version, curve=((0.1 + 0.2, 0.1), (1e300, 0.9)), horizon_s=1800.0)
    save_saturation(model, tmp_path)
    assert load_saturation(tmp_path) == model
    assert load_saturation(tmp_path).version == model.version
    assert len({MODEL.version, replace(MODEL, offset=-10.000001).version, replace(MODEL, data_hash="e").version}) == 3


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (None, r"saturation\.json is missing"),
        (lambda card: b"{", "truncated"),
        (lambda card: card | {"format": 1}, "format 1 is not supported, only 2"),
        (lambda card: card | {"model": card["model"] | {"offset": -9.0}}, "content has changed"),
        (lambda card: card | {"model": card["model"] | {"of_start": "warm"}}, "of_start"),
        (lambda card: card | {"model": card["model"] | {"of_log_duration": -1.0}}, "slope"),
        (lambda card: card | {"extra": 1}, "extra"),
    ],
)
def test_a_missing_or_damaged_file_is_refused(tmp_path: Path, change, says) -> None:
    if change is not None:
        save_saturation(MODEL, tmp_path)
        changed = change(msgspec.json.decode((tmp_path / FILE).read_bytes()))
        (tmp_path / FILE).write_bytes(changed if isinstance(changed, bytes) else msgspec.json.encode(changed))
    with pytest.raises(CheckpointError, match=says):
        load_saturation(tmp_path)


def true_score(packed: np.ndarray, duration_s: np.ndarray, temp_c: np.ndarray) -> np.ndarray:
    """Joint 2, the more the longer, and a little of joint 4 decide, with the duration and their temperatures."""
    load, late = packed[..., 3], 1.0 - np.exp(-duration_s / 1500.0)
    return (
        -19.0
        + (1.0 + 3.0 * late) * load[:, 1]
        + load[:, 3]
        + 1.2 * np.log(duration_s)
        + 0.2 * temp_c[:, 1]
        + 0.05 * temp_c[:, 3]
    )


def world(jobs: int, seed: int, link=lambda score: 1 / (1 + np.exp(-score))) -> tuple[Experience, np.ndarray]:
    """Past jobs, and the probability with which each passed the limit."""
    rng = np.random.default_rng(seed)
    packed = rng.exponential(0.8, (jobs, 7, PARTS))
    packed[..., 2] += packed[..., 3]
    packed[..., 4] = np.square(packed[..., 3])
    duration, temp = np.exp(rng.uniform(np.log(180), np.log(2700), jobs)), rng.uniform(20, 50, (jobs, KNOWN))
    p = link(true_score(packed, duration, temp))
    past = Experience(
        twin="t", features=Features(packed), duration_s=duration, known_c=temp, passed=rng.random(jobs) < p
    )
    return past, p


def told(model, past: Experience) -> np.ndarray:
    return model.risk(past.features, past.duration_s).at(past.known_c)


@examples(25)
@given(seed=st.integers(0, 9999), strength=st.sampled_from([0.01, 1.0, 100.0]))
def test_without_bounds_it_is_scikit_learn_s(seed, strength) -> None:
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(80, 6))
    passed = rng.random(80) < 1 / (1 + np.exp(-z @ rng.normal(size=6)))
    slope, offset = logistic(z, passed, np.zeros(6, bool), strength)
    theirs = LogisticRegression(C=strength, tol=1e-10, max_iter=10_000).fit(z, passed)
    assert slope == pytest.approx(theirs.coef_[0], abs=2e-4)
    assert offset == pytest.approx(theirs.intercept_[0], abs=2e-4)


@examples(25)
@given(seed=st.integers(0, 9999))
def test_bounded_slopes_are_the_best_of_those_allowed(seed) -> None:
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(80, 6))
    passed = rng.random(80) < 1 / (1 + np.exp(-z @ rng.normal(size=6)))
    rising = rng.random(6) < 0.5
    slope, offset = logistic(z, passed, rising, 1.0)
    pull = z.T @ (1 / (1 + np.exp(-(z @ slope + offset))) - passed) + slope  # gradient of the cost
    assert (slope[rising] >= 0).all()
    # Karush-Kuhn-Tucker: no slope that is free to move could lower the cost, none at its bound wants back up.
    free = ~rising | (slope > 1e-6)
    assert pull[free] == pytest.approx(0.0, abs=2e-3)
    assert (pull[~free] >= -2e-3).all()


def test_many_jobs_teach_the_true_law() -> None:
    past, _ = world(20_000, 1)
    model = fit_saturation(past, evidence="load")
    assert np.array(model.at_once)[:, 0] == pytest.approx([0, 1, 0, 1, 0, 0, 0], abs=0.25)
    assert np.array(model.later)[:, 0] == pytest.approx([0, 3, 0, 0, 0, 0, 0], abs=0.4)
    for slopes in (model.of_start, model.of_start_later):
        assert slopes == pytest.approx([0, 0.2, 0, 0.05] + [0] * (KNOWN - 4), abs=0.025)
    assert model.of_log_duration == pytest.approx(1.2, abs=0.12)
    new, p = world(5_000, 2)
    assert np.abs(told(model, new) - p).mean() < 0.01
    assert (model.jobs, model.passed, model.data_hash) == (20_000, int(past.passed.sum()), past.data_hash)


@pytest.mark.parametrize("evidence", ["errors", "load", "excess"])
@pytest.mark.parametrize("method", ["logistic", "isotonic"])
def test_two_hundred_jobs_tell_more_than_their_share(evidence, method) -> None:
    past, _ = world(200, 3)
    new, _ = world(3_000, 4)
    model = fit_saturation(past, evidence=evidence, method=method)
    p = told(model, new)
    assert ((p >= 0) & (p <= 1)).all()
    assert roc_auc_score(new.passed, p) > 0.75
    share = past.passed.mean()
    assert brier(p, new.passed) < 0.9 * share * (1 - share)
    assert reliability(p, new.passed).error < 0.1
    # What was said of the fit is what new jobs find.
    if method == "logistic":
        q = np.clip(p, 1e-9, 1 - 1e-9)
        loss = -np.log(np.where(new.passed, q, 1 - q))
        assert loss.mean() == pytest.approx(model.log_loss, abs=0.12)


def test_a_curve_mends_a_link_that_is_not_logistic() -> None:
    def steps(score):
        return np.select([score < -2, score < 2], [0.02, 0.5], 0.98)

    past, _ = world(4_000, 5, steps)
    new, p = world(4_000, 6, steps)
    straight, curved = fit_saturation(past, evidence="load"), fit_saturation(past, evidence="load", method="isotonic")
    assert np.abs(told(curved, new) - p).mean() < 0.7 * np.abs(told(straight, new) - p).mean()
    assert reliability(told(curved, new), new.passed).error < 0.03
    # The ranking is that of the logistic scores.
    assert curved.score(new.features, new.duration_s, new.known_c) == pytest.approx(
        straight.score(new.features, new.duration_s, new.known_c)
    )


@given(seed=st.integers(0, 999), jobs=st.integers(2, 80))
def test_a_curve_never_falls_and_never_promises(seed, jobs) -> None:
    rng = np.random.default_rng(seed)
    score = np.round(rng.normal(size=jobs), 1)
    knots, p = np.array(monotone_curve(score, rng.random(jobs) < 0.3)).T
    assert (np.diff(knots) >= 0).all()
    assert (np.diff(p) >= -1e-12).all()
    assert p.min() >= 1 / (jobs + 2)
    assert p.max() <= 1 - 1 / (jobs + 2)


@settings(max_examples=5)
@given(seed=st.integers(0, 99), joint=st.integers(0, 6), more=st.floats(0.1, 20))
def test_neither_warmth_nor_load_makes_a_job_safer(seed, joint, more) -> None:
    past, _ = world(60, seed)
    model = fit_saturation(past, evidence="load")
    p = told(model, past)
    warmer, heavier = past.known_c.copy(), past.features.packed.copy()
    warmer[:, joint] += more
    heavier[:, joint, 3] += more
    for other in (replace(past, known_c=warmer), replace(past, features=Features(heavier))):
        assert (told(model, other) >= p - 1e-12).all()


def test_the_same_jobs_give_the_same_model_and_others_another() -> None:
    past, _ = world(100, 7)
    assert fit_saturation(past).version == fit_saturation(past.part(np.arange(100))).version
    fewer = past.part(np.arange(99))
    assert fit_saturation(fewer).data_hash != fit_saturation(past).data_hash


def test_units_do_not_matter_and_what_never_varied_teaches_nothing() -> None:
    past, _ = world(150, 8)
    scaled = past.features.packed.copy()
    scaled[..., 4] = 1e4 * scaled[..., 3]
    scaled[:, 5, 3:] = 2.0
    same = replace(past, features=Features(scaled))
    load, excess = fit_saturation(same, evidence="load"), fit_saturation(same, evidence="excess")
    assert np.array(excess.at_once)[:5] * 1e4 == pytest.approx(np.array(load.at_once)[:5], abs=1e-3)
    assert load.at_once[5] == (0.0,)


@pytest.mark.parametrize(
    ("passed", "says"),
    [
        (np.ones(LEAST_JOBS - 1, bool), r"needs 30 past jobs.*\(got 29; passed in 29\)"),
        (np.zeros(200, bool), r"\(got 200; passed in 0\).*simulate"),
        (np.arange(200) < LEAST_OF_EACH - 1, r"\(got 200; passed in 4\)"),
        (np.ones(200, bool), r"\(got 200; passed in 200\)"),
    ],
)
def test_jobs_that_teach_nothing_are_refused_with_advice(passed, says) -> None:
    past, _ = world(len(passed), 9)
    with pytest.raises(NotEnoughExperience, match=says):
        fit_saturation(replace(past, passed=passed))


def test_as_few_jobs_as_may_be_are_enough() -> None:
    past, _ = world(LEAST_JOBS, 10)
    for passed in (np.arange(LEAST_JOBS) < LEAST_OF_EACH, np.arange(LEAST_JOBS) >= LEAST_OF_EACH):
        assert np.isfinite(fit_saturation(replace(past, passed=passed)).log_loss)


def test_what_is_not_finite_or_misshapen_is_refused_by_job() -> None:
    past, _ = world(50, 11)
    for name in ("duration_s", "known_c"):
        values = getattr(past, name).copy()
        values[7] = np.nan
        with pytest.raises(ValueError, match=f"{name} must be finite; it is not for 1 of 50 jobs, first job 7"):
            replace(past, **{name: values})
    with pytest.raises(ValueError, match="passed must be bool"):
        replace(past, passed=past.passed.astype(int))
    with pytest.raises(ValueError, match=r"known_c must be \(50, 15\) \(got \(50, 7\)\)"):
        replace(past, known_c=past.known_c[:, :7])
    with pytest.raises(ValueError, match="No method 'isotone'"):
        fit_saturation(past, method="isotone")
    with pytest.raises(ValueError, match="lasts > 0 s"):
        fit_saturation(replace(past, duration_s=-past.duration_s))


def test_past_jobs_are_seen_through_the_twin(twin, make_plan, motion, rng) -> None:
    plans = [make_plan(motion(rng, 2.0), motion(rng, 5.0, load), motion(rng, 2.0)) for load in (1.0, 3.0)]
    past = Experience.of_jobs(twin, plans, [3, 40], known_c=np.full((2, KNOWN), 25.0), passed=np.array([False, True]))
    assert past.twin == twin.version
    assert past.duration_s.tolist() == [plans[0].duration_s(3), plans[1].duration_s(40)]
    np.testing.assert_array_equal(past.features.packed, twin.features(plans, [3, 40]).packed)
    assert len(past.part(np.array([1]))) == 1


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
    ("p", "event", "bins", "says"),
    [
        ([], [], 10, "at least one"),
        ([0.0] * 3, [False] * 2, 10, "must be"),
        ([1.2], [True], 10, r"\[0, 1\]"),
        ([np.nan], [True], 10, r"\[0, 1\]"),
        ([1.0] * 3, [True] * 3, 0, "at least one bin"),
    ],
)
def test_what_is_no_probability_is_refused(p, event, bins, says) -> None:
    with pytest.raises(ValueError, match=says):
        reliability(np.array(p, float), np.array(event, bool), bins=bins)
