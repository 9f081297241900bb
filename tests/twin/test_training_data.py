"""Cool is what stays cool: the rest of the recording decides, not the moment."""

import numpy as np
import pytest

from twin.logs.recording import NothingCool, Recording, cool_stretches

JOINTS = 7


def warmed(temp_2_c: np.ndarray, others_c: float = 30.0, name: str = "a") -> Recording:
    """A recording at 1 Hz in which only the temperature of joint 2 changes."""
    time_s = np.arange(float(len(temp_2_c)))
    still = np.zeros((len(time_s), JOINTS))
    temp_c = np.full_like(still, others_c)
    temp_c[:, 1] = temp_2_c
    return Recording(name=name, time_s=time_s, q=still, qd=still, tau=still, temp_c=temp_c)


def test_what_comes_later_counts():
    temp_c = np.full(300, 35.0)
    temp_c[150] = 41.0
    recordings = [warmed(temp_c), warmed(temp_c + 10, name="b"), warmed(np.full(100, 39.0), name="c")]
    found = cool_stretches(recordings, 1.0, cool_c=40.0, joints=range(JOINTS))
    assert [s.recording for s in found] == ["a", "c"]
    assert [(s.time_s[0], s.time_s[-1]) for s in found] == [(151.0, 299.0), (0.0, 99.0)]
    long = cool_stretches(recordings, 1.0, cool_c=40.0, joints=range(JOINTS), least_s=140.0)
    assert [s.recording for s in long] == ["a"]


def test_motors_that_do_not_count_may_be_warm():
    idle = warmed(np.full(100, 33.0), others_c=42.0)
    with pytest.raises(NothingCool, match=r"Always above: 1 \(42.0 °C\), 3 .*Raise the limit"):
        cool_stretches([idle], 1.0, cool_c=40.0, joints=range(JOINTS))
    assert [len(s.time_s) for s in cool_stretches([idle], 1.0, cool_c=40.0, joints=[1])] == [100]


def test_hot_recordings_are_refused_with_advice():
    hot = [warmed(np.full(100, 50.0))]
    words = r"^At no moment of 2 recording.*motors 2, 3 stay below 40 °C for the rest.*2 \(50.0 °C\).*Raise the limit"
    with pytest.raises(NothingCool, match=words):
        cool_stretches(hot * 2, 1.0, cool_c=40.0, joints=[1, 2])
    with pytest.raises(ValueError, match="at least one recording"):
        cool_stretches([], 1.0, cool_c=40.0, joints=[1])


def test_a_short_recording_is_not_reported_as_hot():
    with pytest.raises(NothingCool, match=r"^The recording is shorter .* 25 s are needed, the longest .* has 10 s\."):
        cool_stretches([warmed(np.full(10, 30.0))] * 2, 1.0, cool_c=40.0, joints=[1], least_s=25.0)
    temp_c = np.full(100, 35.0)
    temp_c[87] = 50.0
    words = r"^The part that stays cool is shorter .* 25 s are needed, the longest .* has 12 s\."
    with pytest.raises(NothingCool, match=words):
        cool_stretches([warmed(temp_c)], 1.0, cool_c=40.0, joints=[1], least_s=25.0)


def test_bad_arguments_are_named():
    recording = warmed(np.full(10, 30.0))
    with pytest.raises(ValueError, match="some of 0 … 6"):
        cool_stretches([recording], 1.0, cool_c=40.0, joints=[7])
    still = recording.q
    blind = Recording(name="blind", time_s=recording.time_s, q=still, qd=still, tau=still)
    with pytest.raises(ValueError, match="'blind' has no motor temperatures"):
        cool_stretches([blind], 1.0, cool_c=40.0, joints=[1])
