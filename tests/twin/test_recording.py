"""A recording refuses what is no recording, and says what moved between its samples."""

import numpy as np
import pytest

from twin.logs.recording import READINGS, Recording, interval_current_sq, interval_speed


def recording(time_s: list[float], joints: int = 7, **channels: np.ndarray) -> Recording:
    still = np.zeros((len(time_s), joints))
    return Recording(name="a", time_s=np.array(time_s), **{"q": still, "qd": still, "tau": still, **channels})


@pytest.mark.parametrize("channel", READINGS)
def test_channels_must_fit_the_time_and_be_finite(channel: str):
    with pytest.raises(ValueError, match=r"\(2, 7\)" if channel != "q" else "must be"):
        recording([0.0, 1.0], **{channel: np.zeros((3, 7))})
    hole = np.zeros((2, 7))
    hole[1, 4] = np.nan
    with pytest.raises(ValueError, match=f"{channel} of joint 5 is not finite"):
        recording([0.0, 1.0], **{channel: hole})


@pytest.mark.parametrize("times", [[0.0, 1.0, 1.0], [0.0, 2.0, 1.0]])
def test_time_must_grow(times: list[float]):
    with pytest.raises(ValueError, match=f"from {times[1]} s to {times[2]} s"):
        recording(times)
    with pytest.raises(ValueError, match="time_s is not finite"):
        recording([0.0, np.inf])


def test_joint_axes_must_agree():
    with pytest.raises(ValueError, match="tau must be"):
        recording([0.0], tau=np.zeros((1, 6)))
    with pytest.raises(ValueError, match=r"q \[time, joint\]"):
        recording([0.0], q=np.zeros(7))


def test_a_part_holds_the_same_samples():
    whole = recording([0.0, 1.0, 2.0], temp_c=np.arange(21.0).reshape(3, 7))
    part = whole.part(np.array([True, False, True]))
    assert part.time_s.tolist() == [0.0, 2.0]
    assert part.temp_c is not None
    assert part.temp_c[:, 0].tolist() == [0.0, 14.0]
    assert part.current_a is None
    assert (whole.duration_s, whole.part(slice(0, 0)).duration_s, whole.joints) == (2.0, 0.0, 7)


def test_angles_wrap_and_short_moves_count():
    # Half a degree on either side of zero in half a second is 2°/s, by whatever turn it is written.
    q = np.deg2rad([[359.5] * 7, [0.5] * 7])
    np.testing.assert_allclose(interval_speed(recording([0.0, 0.5], q=q)), np.deg2rad(2.0))
    # There and back between two samples: positions see nothing, the velocities do.
    qd = np.array([[0.3] * 7, [-0.1] * 7])
    np.testing.assert_allclose(interval_speed(recording([0.0, 0.5], qd=qd)), 0.2)


def test_heat_follows_the_mean_square_of_the_current():
    amps = np.array([[1.0] * 7, [3.0] * 7])
    np.testing.assert_allclose(interval_current_sq(recording([0.0, 0.5], current_a=amps)), 5.0)
    with pytest.raises(ValueError, match="no motor currents"):
        interval_current_sq(recording([0.0, 0.5]))
