"""Whatever the rate, the gaps and the wraps of a recording: the motion on the new clock is the motion that was."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from twin.logs.recording import CONTINUOUS, Recording, at_rate, stretches

JOINTS = 7
rates = st.floats(0.2, 60.0)
steps = st.lists(st.floats(0.02, 1.9), min_size=2, max_size=60)


def recorded(time_s: np.ndarray, q: np.ndarray, qd: np.ndarray | None = None, **channels: np.ndarray) -> Recording:
    """A recording of motion [time, joint] that is right up to the turns in which angles are written."""
    qd = np.gradient(q, time_s, axis=0) if qd is None else qd
    return Recording(name="a", time_s=time_s, q=q, qd=qd, tau=np.cos(q), **channels)


def times(steps_s: list[float]) -> np.ndarray:
    return 3.0 + np.concatenate([[0.0], np.cumsum(steps_s)])


@given(steps, rates, st.floats(-3, 3), st.floats(-1, 1))
def test_constants_and_ramps_are_kept_whatever_the_clocks(steps_s, rate_hz, level, slope):
    time_s = times(steps_s)
    moments, values = at_rate(time_s, np.stack([np.full_like(time_s, level), slope * time_s], axis=1), rate_hz)
    np.testing.assert_allclose(values, np.stack([np.full_like(moments, level), slope * moments], axis=1), atol=1e-9)
    np.testing.assert_allclose(np.diff(moments), 1 / rate_hz, rtol=1e-6)
    assert len(moments) >= np.floor((time_s[-1] - time_s[0]) * rate_hz)


@given(steps, st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_a_slower_clock_keeps_means(steps_s, seed, samples):
    time_s = times(steps_s)
    values = np.random.default_rng(seed).normal(size=len(time_s))
    whole_s = time_s[-1] - time_s[0]
    assume(np.median(steps_s) < whole_s / samples * 0.999)
    moments, means = at_rate(time_s, values, samples / whole_s)
    assert len(moments) == samples
    # Trapezoidal rule: the time mean of the polygon through the readings.
    np.testing.assert_allclose(means.mean(), np.trapezoid(values, time_s) / whole_s, atol=1e-9)


def test_the_same_clock_changes_nothing():
    time_s = 7.0 + np.arange(40) / 2.0
    values = np.random.default_rng(0).normal(size=(40, 3, JOINTS))
    moments, same = at_rate(time_s, values, 2.0)
    np.testing.assert_allclose(moments, time_s)
    np.testing.assert_allclose(same, values, atol=1e-9)


@given(st.lists(st.floats(0.02, 9.0), min_size=2, max_size=60), rates, st.floats(-1.3, 1.3), st.floats(-20, 20))
def test_a_wrap_never_shows(steps_s, rate_hz, speed, start):
    # At constant speed every joint that turns without end goes on straight, though its angle is written within a turn
    # and more than a whole turn may lie between two samples.
    time_s = times(steps_s)
    assume((time_s[-1] - time_s[0]) * rate_hz > 1)
    angle = start + speed * (time_s - time_s[0])
    q = np.zeros((len(time_s), JOINTS))
    q[:, CONTINUOUS] = ((angle + np.pi) % (2 * np.pi) - np.pi)[:, None]
    qd = np.zeros_like(q)
    qd[:, CONTINUOUS] = speed
    (stretch,) = stretches(recorded(time_s, q, qd), rate_hz, gap_s=9.5)
    found = stretch.profile[:, 0][:, CONTINUOUS]
    straight = found[0] + speed * (stretch.time_s - stretch.time_s[0])[:, None]
    np.testing.assert_allclose(found, straight, atol=1e-6)
    assert not stretch.profile[:, 0, 1].any()


def test_joints_with_stops_are_never_turned():
    # Sampled velocities may say anything at a slow rate; a joint that cannot turn past its stop did not.
    time_s = np.arange(4.0)
    q = np.tile(np.array([-2.0, 2.0, -2.0, 2.0])[:, None], JOINTS)
    (stretch,) = stretches(recorded(time_s, q, np.full_like(q, 6.0)), 1.0)
    np.testing.assert_allclose(stretch.profile[:, 0, [1, 3, 5]], q[:, [1, 3, 5]])


def test_a_gap_parts_and_a_lone_sample_is_left_out():
    time_s = np.array([0.0, 0.5, 1.0, 9.0, 20.0, 20.5, 21.5])
    q = np.tile(time_s[:, None], JOINTS) / 100
    temp_c = 30 + np.tile(time_s[:, None], JOINTS)
    first, second = stretches(recorded(time_s, q, temp_c=temp_c), 2.0)
    np.testing.assert_allclose(first.time_s, [0.0, 0.5, 1.0])
    np.testing.assert_allclose(second.time_s, [20.0, 20.5, 21.0, 21.5])
    assert second.temp_c is not None
    np.testing.assert_allclose(second.temp_c, 30 + np.tile(second.time_s[:, None], JOINTS))
    assert (first.recording, first.profile.shape) == ("a", (3, 3, JOINTS))
    (whole,) = stretches(recorded(time_s, q), 2.0, gap_s=11.0)
    np.testing.assert_allclose(whole.profile[:, 0, 1], whole.time_s / 100)


def test_arguments_that_leave_nothing_are_refused():
    slow = recorded(np.arange(5.0) * 6.0, np.zeros((5, JOINTS)))
    with pytest.raises(ValueError, match="a sample every 6 s"):
        stretches(slow, 2.0)
    with pytest.raises(ValueError, match="rate_hz must be > 0"):
        stretches(slow, 0.0, gap_s=10.0)
    with pytest.raises(ValueError, match="gap_s must be > 0"):
        stretches(slow, 1.0, gap_s=0.0)
    assert stretches(slow.part(slice(0, 1)), 2.0) == []
    assert stretches(slow, 0.01, gap_s=10.0) == []
