import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from twin.vae.config import TwinConfig
from twin.vae.window import STD_FLOOR, Scaler, cover, cut, resample, starts, windows_of

lengths = st.integers(1, 300)
windows = st.integers(2, 60)
rates = st.sampled_from([2.0, 10.0, 12.5, 33.0, 50.0, 120.0])


@given(lengths, windows, st.data())
def test_windows_cover_every_sample_and_nothing_beyond(length, window, data):
    stride = data.draw(st.integers(1, window))
    first = starts(length, window, stride)
    seen = {i for s in first for i in range(s, s + window)}
    assert set(range(length)) <= seen
    assert len(set(first)) == len(first)
    assert first[-1] == max(length - window, 0)


@given(lengths, windows, st.data())
def test_cover_makes_the_window_mean_the_plain_time_mean(length, window, data):
    stride = data.draw(st.integers(1, window))
    values = data.draw(arrays(float, (length, 3, 2), elements=st.floats(-9, 9)))
    weights = cover(length, window, stride)
    pieces = cut(values, window, stride)
    mean = np.einsum("bt,btjc->cj", weights, pieces)
    np.testing.assert_allclose(mean, values.mean(axis=0), atol=1e-9)


def test_short_motion_is_padded_by_holding_its_last_sample():
    samples = np.arange(3 * 3 * 1, dtype=float).reshape(3, 3, 1)
    (window,) = cut(samples, 5, 5)
    np.testing.assert_array_equal(window[:, 0, 0], [0, 3, 6, 6, 6])
    np.testing.assert_allclose(cover(3, 5, 5), [[1 / 3, 1 / 3, 1 / 3, 0, 0]])


def test_no_samples_give_no_windows():
    assert cut(np.zeros((0, 3, 7)), 50, 10).shape == (0, 50, 7, 3)
    assert cover(0, 50, 10).shape == (0, 50)
    assert resample(np.zeros((0, 3, 7)), 50.0, 12.5).shape == (0, 3, 7)


@given(st.integers(1, 200), rates, rates)
def test_resampling_keeps_the_integral_over_time(length, from_hz, to_hz):
    rng = np.random.default_rng(length)
    profile = rng.uniform(-1, 1, (length, 3, 2))
    new = resample(profile, from_hz, to_hz)
    span = np.full(len(new), 1 / to_hz)
    span[-1] = length / from_hz - (len(new) - 1) / to_hz
    assert span[-1] > 0
    np.testing.assert_allclose((new * span[:, None, None]).sum(0), profile.sum(0) / from_hz, atol=1e-9)


def test_resampling_by_a_whole_factor_averages_blocks():
    profile = np.arange(8.0)[:, None, None] * np.ones((1, 3, 1)) * 0.1
    np.testing.assert_allclose(resample(profile, 50.0, 12.5)[:, 0, 0], [0.15, 0.55])


def test_a_wrap_of_a_continuous_joint_never_shows(rng, motion):
    spun = (0, 2, 4, 6)
    profile = motion(rng, 12.0).astype(float)
    profile[:, 0, spun] += 3.0
    wrapped = profile.copy()
    wrapped[:, 0, spun] = np.angle(np.exp(1j * profile[:, 0, spun]))
    assert np.abs(np.diff(wrapped[:, 0, spun], axis=0)).max() > 6
    turned = profile.copy()
    turned[:, 0, spun] += 6 * np.pi
    scaler = Scaler.fit(cut(resample(profile, 50, 12.5), 50, 10))
    want = scaler.to_z(cut(resample(profile, 50, 12.5), 50, 10))
    for other in (wrapped, turned):
        np.testing.assert_allclose(scaler.to_z(cut(resample(other, 50, 12.5), 50, 10)), want, atol=1e-4)


def test_a_limited_joint_is_not_moved_by_turns():
    at = np.zeros((1, 5, 7, 3))
    far = at.copy()
    far[:, :, 1, 0] = 4.0
    z = Scaler.fit(at).to_z(far)
    assert z[0, 0, 1, 0] == pytest.approx(4.0 / STD_FLOOR[0])


def test_z_scores_of_training_have_mean_zero_and_deviation_one(records):
    cool = windows_of(records, TwinConfig())
    z = Scaler.fit(cool).to_z(cool)
    np.testing.assert_allclose(z.mean(axis=(0, 1)), 0, atol=1e-4)
    np.testing.assert_allclose(z.std(axis=(0, 1)), 1, atol=1e-3)


def test_the_scaler_does_not_learn_from_what_it_scales(records):
    cool = windows_of(records, TwinConfig())
    scaler = Scaler.fit(cool)
    heavy = cool.copy()
    heavy[..., 2] *= 3
    assert scaler.to_z(heavy)[..., 2].std() > 2.5


def test_a_still_joint_is_scaled_by_the_floor_and_called_still(records):
    cool = windows_of(records, TwinConfig())
    cool[:, :, 4] = 1.0
    scaler = Scaler.fit(cool)
    np.testing.assert_array_equal(scaler.std[4], STD_FLOOR)
    np.testing.assert_array_equal(scaler.still, np.arange(7) == 4)
    assert np.all(np.isfinite(scaler.to_z(cool)))


def test_z_scores_go_back_to_si(records):
    cool = windows_of(records[:3], TwinConfig())
    scaler = Scaler.fit(cool)
    np.testing.assert_allclose(scaler.to_si(scaler.to_z(cool)), cool, atol=1e-5)


@pytest.mark.parametrize("shape", [(5, 7), (5, 2, 7)])
def test_a_misshapen_record_is_named(shape):
    with pytest.raises(ValueError, match=r"Record 0 must be \[time, 3, joint\]"):
        windows_of([np.zeros(shape)], TwinConfig())


def test_a_record_with_nan_says_where(rng, motion):
    bad = motion(rng, 2.0)
    bad[4, 2, 1] = np.nan
    with pytest.raises(ValueError, match="Record 1 is not finite: tau of joint 2 at sample 4"):
        windows_of([motion(rng, 2.0), bad], TwinConfig())


@pytest.mark.parametrize("nothing", [[], [np.zeros((0, 3, 7))]])
def test_no_records_are_refused(nothing):
    with pytest.raises(ValueError, match="at least one record"):
        windows_of(nothing, TwinConfig())
