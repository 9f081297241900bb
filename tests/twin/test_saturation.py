"""The probability of saturation as a value: what it computes, how it is carried, kept and refused."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.difficulty import KNOWN
from fleet.errors import CheckpointError
from twin.p_saturation import FILE, SaturationModel, evidence_of, load_saturation, save_saturation
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


def test_a_saved_model_is_the_same_model(tmp_path: Path, twin) -> None:
    model = replace(MODEL, twin=twin.version, curve=((0.1 + 0.2, 0.1), (1e300, 0.9)), horizon_s=1800.0)
    save_saturation(model, tmp_path)
    assert load_saturation(tmp_path) == model
    assert load_saturation(tmp_path).version == model.version


def test_another_version_means_another_content() -> None:
    assert replace(MODEL, offset=-10.000001).version != MODEL.version
    assert replace(MODEL, data_hash="e").version != MODEL.version


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda card: b"{", "truncated"),
        (lambda card: card | {"format": 1}, "format 1 is not supported, only 2"),
        (lambda card: card | {"model": card["model"] | {"offset": -9.0}}, "content has changed"),
        (lambda card: card | {"model": card["model"] | {"of_start": "warm"}}, "of_start"),
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
