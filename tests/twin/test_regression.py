"""P(saturation) by a regression: in a world whose probabilities are known, by hand, and as a file."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.difficulty import KNOWN
from fleet.errors import CheckpointError
from tests.profiles import examples
from twin.baselines import (
    FILE,
    LEAST_OF_EACH,
    LoadRegression,
    fit_regression,
    load_regression,
    logistic,
    save_regression,
)
from twin.thermal.thermal_twin import LEAST_JOBS, NotEnoughExperience
from twin.vae.measures import PARTS, Features

MODEL = LoadRegression(
    evidence="excess",
    offset=-10.0,
    at_once=(0.0, 1.5, 0.0, 1.0, 0.0, 0.0, 0.0),
    later=(0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    of_log_duration=0.5,
    of_start=tuple(0.2 if k == 1 else 0.0 for k in range(KNOWN)),
    of_start_later=tuple({3: 0.1, 14: 0.2}.get(k, 0.0) for k in range(KNOWN)),
)
Past = dict[str, np.ndarray]
"""Load [job, joint], and the other arguments of `fit_regression` by name."""


def features_of(load: np.ndarray) -> Features:
    """Excess torque² by joint, [..., joint]; all else 9."""
    packed = np.full((*load.shape, PARTS), 9.0)
    packed[..., 4] = load
    return Features(packed)


def fitted(past: Past, **changes: np.ndarray) -> LoadRegression:
    load, *rest = (past | changes).values()
    return fit_regression(features_of(load), *rest)


def p_of(model: LoadRegression, past: Past) -> np.ndarray:
    return model.risk(features_of(past["load"]), past["duration_s"]).at(past["known_c"])


def true_score(load: np.ndarray, duration_s: np.ndarray, temp_c: np.ndarray) -> np.ndarray:
    """Joint 2, the more the longer, and a little of joint 4 decide, with the duration and their temperatures."""
    late = 1.0 - np.exp(-duration_s / 1500.0)
    return (
        -19.0
        + (1.0 + 3.0 * late) * load[:, 1]
        + load[:, 3]
        + 1.2 * np.log(duration_s)
        + 0.2 * temp_c[:, 1]
        + 0.05 * temp_c[:, 3]
    )


def world(jobs: int, seed: int) -> tuple[Past, np.ndarray]:
    """Past jobs, and the probability with which each passed the limit."""
    rng = np.random.default_rng(seed)
    load = rng.exponential(0.8, (jobs, 7, PARTS))[..., 3]
    duration, temp = np.exp(rng.uniform(np.log(180), np.log(2700), jobs)), rng.uniform(20, 50, (jobs, KNOWN))
    p = 1 / (1 + np.exp(-true_score(load, duration, temp)))
    return {"load": load, "duration_s": duration, "known_c": temp, "passed": rng.random(jobs) < p}, p


@examples(25)
@given(seed=st.integers(0, 9999))
def test_bounded_slopes_are_the_best_of_those_allowed(seed) -> None:
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(80, 6))
    passed = rng.random(80) < 1 / (1 + np.exp(-z @ rng.normal(size=6)))
    slope, offset = logistic(z, passed, 1.0)
    pull = z.T @ (1 / (1 + np.exp(-(z @ slope + offset))) - passed) + slope  # gradient of the cost
    assert (slope >= 0).all()
    # Karush-Kuhn-Tucker: no slope that is free to move could lower the cost, none at its bound wants back up.
    free = slope > 1e-6
    assert pull[free] == pytest.approx(0.0, abs=2e-3)
    assert (pull[~free] >= -2e-3).all()


def test_many_jobs_teach_the_true_law() -> None:
    past, _ = world(20_000, 1)
    model = fitted(past)
    assert model.at_once == pytest.approx([0, 1, 0, 1, 0, 0, 0], abs=0.25)
    assert model.later == pytest.approx([0, 3, 0, 0, 0, 0, 0], abs=0.4)
    for slopes in (model.of_start, model.of_start_later):
        assert slopes == pytest.approx([0, 0.2, 0, 0.05] + [0] * (KNOWN - 4), abs=0.025)
    assert model.of_log_duration == pytest.approx(1.2, abs=0.12)
    new, p = world(5_000, 2)
    assert np.abs(p_of(model, new) - p).mean() < 0.01


@settings(max_examples=2)
@given(seed=st.integers(0, 99), joint=st.integers(0, 6), more=st.floats(0.1, 20))
def test_neither_warmth_nor_load_makes_a_job_safer(seed, joint, more) -> None:
    past, _ = world(60, seed)
    model = fitted(past)
    for name in ("known_c", "load"):
        changed = past[name].copy()
        changed[:, joint] += more
        assert (p_of(model, past | {name: changed}) >= p_of(model, past) - 1e-12).all()


def test_the_same_jobs_give_the_same_model_in_any_units_and_what_never_varied_teaches_nothing() -> None:
    past, _ = world(150, 8)
    assert fitted(past).version == fitted(world(150, 8)[0]).version != fitted(world(150, 7)[0]).version
    past["load"][:, 5] = 2.0
    model, scaled = fitted(past), fitted(past, load=1e4 * past["load"])
    assert np.array(scaled.at_once)[:5] * 1e4 == pytest.approx(np.array(model.at_once)[:5], abs=1e-3)
    assert model.at_once[5] == 0.0


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
        fitted(past, passed=passed)


def test_as_few_jobs_as_may_be_are_enough() -> None:
    past, _ = world(LEAST_JOBS, 10)
    for passed in (np.arange(LEAST_JOBS) < LEAST_OF_EACH, np.arange(LEAST_JOBS) >= LEAST_OF_EACH):
        assert np.isfinite(fitted(past, passed=passed).offset)


def test_a_probability_by_hand() -> None:
    known_c, load = np.full(KNOWN, 99.0), np.zeros(7)
    known_c[[1, 3, 14]] = 40.0, 20.0, 10.0
    load[[1, 3]] = 1.5, 0.5
    # Half warmed: −10 + (1.5 + 0.5) · 1.5 + 1 · 0.5 + ½ (0.2 · 40 + 0.1 · 20 + 0.2 · 10) + 0.5 · ln t
    half_s = np.array(1500.0 * np.log(2.0))
    expected = -0.5 + 0.5 * np.log(half_s)
    risk = MODEL.risk(features_of(load), half_s)
    assert risk.value(known_c) == pytest.approx(expected)
    assert risk.at(known_c) == pytest.approx(1 / (1 + np.exp(-expected)))


def test_evidence_names_what_is_read() -> None:
    packed = np.full((7, PARTS), 9.0)
    packed[:, 4], packed[:, 5] = 0.0, np.arange(7.0)
    excess, torque = (
        replace(MODEL, evidence=name).risk(Features(packed), np.array(600.0)) for name in ("excess", "torque")
    )
    slope = np.array(MODEL.at_once) + (1 - np.exp(-0.4)) * np.array(MODEL.later)
    assert torque.offset - excess.offset == pytest.approx(slope @ np.arange(7.0))


@given(seed=st.integers(0, 999), count=st.integers(1, 5))
def test_many_jobs_are_each_job(seed, count) -> None:
    rng = np.random.default_rng(seed)
    packed, duration, temp = (
        rng.random((count, 7, PARTS)),
        rng.uniform(1, 1e4, count),
        rng.uniform(10, 70, (count, KNOWN)),
    )
    p = MODEL.risk(Features(packed), duration).at(temp)
    each = [float(MODEL.risk(Features(f), d).at(t)) for f, d, t in zip(packed, duration, temp, strict=True)]
    assert p == pytest.approx(each)


def test_a_saved_model_is_the_same_model(tmp_path: Path) -> None:
    model = replace(MODEL, offset=0.1 + 0.2)
    save_regression(model, tmp_path)
    assert load_regression(tmp_path) == model


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda card: b"{", "truncated"),
        (lambda card: card | {"format": 2}, "format 2 is not supported, only 3"),
        (lambda card: card | {"format": "3.1"}, "format '3.1' is not supported, only 3"),
        (lambda card: [], "Expected `object`, got `array`"),
        (lambda card: card | {"model": card["model"] | {"offset": -9.0}}, "content has changed"),
        (lambda card: card | {"model": card["model"] | {"of_start": "warm"}}, "of_start"),
        (lambda card: card | {"extra": 1}, "extra"),
    ],
)
def test_a_damaged_file_is_refused(tmp_path: Path, change, says) -> None:
    save_regression(MODEL, tmp_path)
    changed = change(msgspec.json.decode((tmp_path / FILE).read_bytes()))
    (tmp_path / FILE).write_bytes(changed if isinstance(changed, bytes) else msgspec.json.encode(changed))
    with pytest.raises(CheckpointError, match=says):
        load_regression(tmp_path)
    (tmp_path / FILE).unlink()
    with pytest.raises(CheckpointError, match=r"saturation\.json is missing"):
        load_regression(tmp_path)
