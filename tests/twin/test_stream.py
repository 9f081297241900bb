from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.recording import Recording
from twin.stream import Stream
from twin.stretches import stretches
from twin.window import cut


def batch_packed(twin, time_s, samples, stride, gap_s=2.0):
    """Second way: the finished recording on the twin's clock, all windows at once."""
    recording = Recording(name="all", time_s=time_s, q=samples[:, 0], qd=samples[:, 1], tau=samples[:, 2])
    window, found = twin.config.window, []
    for stretch in stretches(recording, twin.config.rate_hz, gap_s=gap_s):
        count = max(0, (len(stretch.profile) - window) // stride + 1)
        whole = [stretch.profile[i * stride : i * stride + window] for i in range(count)]
        found += [twin.window_features(cut(part, window, window)).packed for part in whole]
    return np.concatenate(found) if found else np.zeros((0, twin.joints, 5))


@pytest.fixture(scope="module")
def live(motion):
    """40 s at about 50 Hz, unevenly, angles wrapped as sensors give them."""
    rng = np.random.default_rng(3)
    samples = motion(rng, 40.0).astype(float)
    samples[:, 0, ::2] = np.angle(np.exp(1j * (samples[:, 0, ::2] + 3.0)))
    time_s = 1e4 + np.cumsum(rng.uniform(0.01, 0.03, len(samples)))
    return time_s, samples


@settings(max_examples=12, deadline=None)
@given(cuts=st.lists(st.integers(0, 2000), max_size=12), stride=st.sampled_from([10, 25, 50]))
def test_chunks_of_any_size_score_like_the_whole_recording(twin, live, cuts, stride):
    time_s, samples = live
    stream, got = Stream(twin, 50.0, stride=stride), []
    for part in np.split(np.arange(len(time_s)), sorted(cuts)):
        got += stream.push(time_s[part], samples[part])
        assert stream.waiting < twin.config.window
    want = batch_packed(twin, time_s, samples, stride)
    assert len(want) > 5
    np.testing.assert_allclose([score.features.packed for score in got], want, rtol=2e-4, atol=1e-5)


@settings(max_examples=8, deadline=None)
@given(holes=st.lists(st.integers(1, 1999), max_size=3, unique=True), cuts=st.lists(st.integers(0, 2000), max_size=6))
def test_after_a_hole_it_begins_anew(twin, live, holes, cuts):
    time_s, samples = live
    late = time_s + 5.0 * (np.arange(len(time_s))[:, None] >= holes).sum(axis=1) if holes else time_s
    stream, got = Stream(twin, 50.0), []
    for part in np.split(np.arange(len(late)), sorted(cuts)):
        got += stream.push(late[part], samples[part])
    want = batch_packed(twin, late, samples, twin.config.score_stride)
    assert len(got) == len(want)
    if len(want):
        np.testing.assert_allclose([score.features.packed for score in got], want, rtol=2e-4, atol=1e-5)


def test_a_slow_logger_gives_values_at_moments(twin, live):
    time_s, samples = live[0][::25], live[1][::25]
    stream = Stream(twin, 2.0)
    got = [score for i in range(len(time_s)) for score in stream.push(time_s[i : i + 1], samples[i : i + 1])]
    want = batch_packed(twin, time_s, samples, twin.config.score_stride)
    assert len(want) >= 8
    np.testing.assert_allclose([score.features.packed for score in got], want, rtol=2e-4, atol=1e-5)


def test_windows_follow_each_other_in_the_time_of_the_samples(twin, live):
    scores = Stream(twin, 50.0).push(*live)
    assert scores[0].start_s == pytest.approx(live[0][0])
    for before, after in pairwise(scores):
        assert before.end_s - before.start_s == pytest.approx(4.0)
        assert after.start_s == pytest.approx(before.end_s)
    assert scores[0].measures.difficulty.shape == (7,)
    assert scores[0].measures.version == twin.version


def test_a_heavy_load_shows_within_a_window(twin, live):
    time_s, samples = live
    heavy = samples.copy()
    heavy[1000:, 2, 1] *= 4
    known, loaded = (Stream(twin, 50.0).push(time_s, data) for data in (samples, heavy))
    half = time_s[1000]
    for a, b in zip(known, loaded, strict=True):
        if a.end_s < half:
            np.testing.assert_array_equal(a.features.packed, b.features.packed)
        if a.start_s > half:
            assert b.features.errors[1, 2] > a.features.errors[1, 2]


def test_bad_samples_are_refused_and_leave_no_trace(twin, live):
    time_s, samples = live
    stream = Stream(twin, 50.0)
    stream.push(time_s[:300], samples[:300])
    broken = samples[300:310].copy()
    broken[4, 1, 2] = np.nan
    with pytest.raises(ValueError, match="leave out what a sensor did not say"):
        stream.push(time_s[300:310], broken)
    with pytest.raises(ValueError, match="Times must increase, also from one push"):
        stream.push(time_s[299:310], samples[299:310])
    with pytest.raises(ValueError, match=r"samples \[time, 3, 7\]"):
        stream.push(time_s[300:310], samples[300:310, :, :6])
    assert stream.push(time_s[:0], samples[:0]) == []
    got = stream.push(time_s[300:], samples[300:])
    whole = Stream(twin, 50.0).push(time_s, samples)
    np.testing.assert_allclose(got[-1].features.packed, whole[-1].features.packed, rtol=1e-4)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"stride": 0}, "stride must be 1 to window = 50"),
        ({"stride": 51}, "stride must be 1 to window = 50"),
        ({"sample_hz": 0.0}, "sample_hz must be > 0"),
        ({"gap_s": 0.01}, "gap_s must be > 1 / sample_hz = 0.02"),
    ],
)
def test_a_stream_that_cannot_be_is_refused(twin, change, words):
    with pytest.raises(ValueError, match=words):
        Stream(twin, **{"sample_hz": 50.0, **change})
