"""Learning the probability of saturation: against scikit-learn, against a world whose probabilities are known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score

from fleet.difficulty import KNOWN
from tests.profiles import examples
from twin.p_saturation import (
    LEAST_JOBS,
    LEAST_OF_EACH,
    Experience,
    NotEnoughExperience,
    brier,
    fit_saturation,
    logistic,
    monotone_curve,
    reliability,
)
from twin.vae.measures import PARTS, Features


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
    for other in (
        replace(past, known_c=warmer),
        replace(past, features=Features(heavier)),
    ):
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
        (
            np.ones(LEAST_JOBS - 1, bool),
            r"needs 30 past jobs.*\(got 29; passed in 29\)",
        ),
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
