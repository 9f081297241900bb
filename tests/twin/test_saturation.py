"""The probability of saturation as a value: what it computes, how it is carried, kept and refused."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.errors import CheckpointError
from twin.saturation.model import (
    FILE,
    CalibratedTwin,
    SaturationModel,
    evidence_of,
    load_calibrated,
    load_saturation,
    save_saturation,
)
from twin.vae.measures import Features

MODEL = SaturationModel(
    twin="t",
    evidence="load",
    method="logistic",
    horizon_s=None,
    offset=-10.0,
    at_once=((0.0,), (1.5,), (0.0,), (1.0,), (0.0,), (0.0,), (0.0,)),
    later=((0.0,), (1.0,), (0.0,), (0.0,), (0.0,), (0.0,), (0.0,)),
    of_log_duration=0.5,
    of_temp=(0.0, 0.1, 0.0, 0.05, 0.0, 0.0, 0.0),
    curve=None,
    data_hash="d",
    jobs=200,
    passed=40,
    strength=1.0,
    log_loss=0.1,
)


def features(**load: float) -> Features:
    """One-sided torque errors by joint, all else 9."""
    packed = np.full((7, 5), 9.0)
    packed[:, 3] = [load.get(f"joint_{k + 1}", 0.0) for k in range(7)]
    return Features(packed)


def test_a_probability_by_hand() -> None:
    temp_c = np.array([99.0, 40.0, 99.0, 20.0, 99.0, 99.0, 99.0])
    # Half warmed: −10 + (1.5 + 0.5) · 1.5 + 1 · 0.5 + 0.1 · 40 + 0.05 · 20 + 0.5 · ln t
    half_s = 1500.0 * np.log(2.0)
    expected = -1.5 + 0.5 * np.log(half_s)
    risk = MODEL.risk(features(joint_2=1.5, joint_4=0.5), half_s)
    assert risk.at(temp_c) == pytest.approx(1 / (1 + np.exp(-expected)))
    assert MODEL.score(features(joint_2=1.5, joint_4=0.5), half_s, temp_c) == pytest.approx(expected)


def test_what_comes_after_the_horizon_does_not_count() -> None:
    temp_c = np.full(7, 30.0)
    near = replace(MODEL, horizon_s=600.0)
    assert near.score(features(), 3000.0, temp_c) == MODEL.score(features(), 600.0, temp_c)
    assert near.score(features(), 300.0, temp_c) == MODEL.score(features(), 300.0, temp_c)


@given(seed=st.integers(0, 999), count=st.integers(1, 5))
def test_many_jobs_are_each_job(seed, count) -> None:
    rng = np.random.default_rng(seed)
    packed, duration, temp = rng.random((count, 7, 5)), rng.uniform(1, 1e4, count), rng.uniform(10, 70, (count, 7))
    curve = ((-5.0, 0.01), (0.0, 0.3), (4.0, 0.99))
    for model in (MODEL, replace(MODEL, curve=curve)):
        p = model.risk(Features(packed), duration).at(temp)
        each = [float(model.risk(Features(f), d).at(t)) for f, d, t in zip(packed, duration, temp, strict=True)]
        assert p == pytest.approx(each)
    scores = MODEL.score(Features(packed), duration, temp)
    assert 1 / (1 + np.exp(-scores)) == pytest.approx(MODEL.risk(Features(packed), duration).at(temp))
    assert p == pytest.approx(np.interp(scores, *np.array(curve).T))


def test_evidence_names_what_is_read() -> None:
    packed = np.arange(35.0).reshape(7, 5)
    assert evidence_of(Features(packed), "errors").tolist() == packed[:, :3].tolist()
    assert evidence_of(Features(packed), "load").tolist() == packed[:, 3:4].tolist()
    assert evidence_of(Features(packed), "excess").tolist() == packed[:, 4:].tolist()
    with pytest.raises(ValueError, match="No evidence 'lod'; did you mean 'load'"):
        evidence_of(Features(packed), "lod")


@pytest.mark.parametrize("duration_s", [0.0, -1.0, np.nan, np.inf])
def test_a_job_without_duration_is_refused(duration_s) -> None:
    with pytest.raises(ValueError, match="lasts > 0 s"):
        MODEL.risk(features(), duration_s)


def test_a_job_of_another_arm_is_refused() -> None:
    with pytest.raises(ValueError, match=r"needs \(7, 1\) numbers \[joint, column\] of a job \(got \(6, 1\)\)"):
        MODEL.risk(Features(np.zeros((6, 5))), 10.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"offset": np.nan},
        {"of_log_duration": -0.1},
        {"of_temp": (-0.1,) * 7},
        {"of_temp": (0.1,) * 6},
        {"evidence": "x"},
    ],
)
def test_a_model_that_makes_no_sense_is_refused(changes) -> None:
    with pytest.raises(ValueError, match="SaturationModel"):
        replace(MODEL, **changes)


def test_a_calibrated_twin_scores_with_its_risk(twin, plan) -> None:
    model = replace(MODEL, twin=twin.version)
    known = CalibratedTwin(twin, model)
    told = known.score(plan, 40)
    np.testing.assert_array_equal(told.per_joint, twin.score(plan, 40).per_joint)
    found = twin.features([plan], [40])
    temp_c = np.linspace(20.0, 50.0, 7)
    expected = model.risk(found, np.array([plan.duration_s(40)])).at(temp_c)[0]
    assert told.p_at(temp_c) == pytest.approx(expected)
    assert known.version == f"{twin.version}+{model.version}"
    with pytest.raises(ValueError, match="fitted on twin t, this is"):
        CalibratedTwin(twin, MODEL)


def test_a_saved_model_is_the_same_model(tmp_path: Path, twin) -> None:
    model = replace(MODEL, twin=twin.version, curve=((0.1 + 0.2, 0.1), (1e300, 0.9)), horizon_s=1800.0)
    save_saturation(model, tmp_path)
    assert load_saturation(tmp_path) == model
    assert load_saturation(tmp_path).version == model.version
    assert load_calibrated(twin, tmp_path, data_hash="d").saturation == model


def test_another_version_means_another_content() -> None:
    assert replace(MODEL, offset=-10.000001).version != MODEL.version
    assert replace(MODEL, data_hash="e").version != MODEL.version


def test_a_model_of_other_data_or_another_twin_is_refused_by_name(tmp_path: Path, twin) -> None:
    save_saturation(MODEL, tmp_path)
    with pytest.raises(CheckpointError, match=f"twin is t, wanted {twin.version}"):
        load_calibrated(twin, tmp_path)
    save_saturation(replace(MODEL, twin=twin.version), tmp_path)
    with pytest.raises(CheckpointError, match="data_hash is d, wanted other"):
        load_calibrated(twin, tmp_path, data_hash="other")
    few = replace(MODEL, twin=twin.version, of_temp=(0.1,), at_once=((1.0,),), later=((1.0,),))
    save_saturation(few, tmp_path)
    with pytest.raises(CheckpointError, match="joints is 1, wanted 7"):
        load_calibrated(twin, tmp_path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda card: b"{", "truncated"),
        (lambda card: card | {"format": 2}, "format 2 is not supported, only 1"),
        (lambda card: card | {"model": card["model"] | {"offset": -9.0}}, "content has changed"),
        (lambda card: card | {"model": card["model"] | {"of_temp": "warm"}}, "of_temp"),
        (lambda card: card | {"model": card["model"] | {"of_log_duration": -1.0}}, "slope"),
        (lambda card: card | {"extra": 1}, "extra"),
    ],
)
def test_a_damaged_file_is_refused(tmp_path: Path, change, says) -> None:
    save_saturation(MODEL, tmp_path)
    changed = change(msgspec.json.decode((tmp_path / FILE).read_bytes()))
    (tmp_path / FILE).write_bytes(changed if isinstance(changed, bytes) else msgspec.json.encode(changed))
    with pytest.raises(CheckpointError, match=says):
        load_saturation(tmp_path)


def test_no_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"saturation\.json is missing"):
        load_saturation(tmp_path)
