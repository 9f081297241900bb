"""Cool is what stays cool: the horizon decides, not the moment."""

import numpy as np
import pytest

from twin.logs.recording import Recording
from twin.training_data import NothingCool, cool_moments, cool_stretches

JOINTS = 7


def warmed(temp_2_c: np.ndarray, others_c: float = 30.0, name: str = "a") -> Recording:
    """A recording at 1 Hz in which only the temperature of joint 2 changes."""
    time_s = np.arange(float(len(temp_2_c)))
    still = np.zeros((len(time_s), JOINTS))
    temp_c = np.full_like(still, others_c)
    temp_c[:, 1] = temp_2_c
    return Recording(name=name, time_s=time_s, q=still, qd=still, tau=still, temp_c=temp_c)


def limit(value: float) -> np.ndarray:
    return np.full(JOINTS, value)


def test_what_comes_within_the_horizon_counts():
    # 35 °C but for one second at 41 °C: the hundred seconds before it are no cool work either.
    temp_c = np.full(1000, 35.0)
    temp_c[600] = 41.0
    cool = cool_moments(warmed(temp_c), limit(40.0), 100.0)
    expected = np.ones(1000, dtype=bool)
    expected[500:601] = False
    np.testing.assert_array_equal(cool, expected)
    assert cool_moments(warmed(temp_c), limit(40.0), np.inf).tolist() == [False] * 601 + [True] * 399
    assert (~cool_moments(warmed(temp_c), limit(40.0), 0.0)).nonzero()[0].tolist() == [600]


def test_a_heavy_job_that_begins_cool_is_not_cool():
    # Warms by 1.2 K a minute and ends at 36 °C: in 200 s it would stand at 40 °C, an idle arm would not.
    heavy = warmed(30 + 0.02 * np.arange(300.0))
    at_end_s = 299 + (40.0 - (30 + 0.02 * 299)) / 0.02
    np.testing.assert_array_equal(cool_moments(heavy, limit(40.0), 300.0), heavy.time_s + 300.0 < at_end_s)
    assert not cool_moments(heavy, limit(40.0), 600.0).any()
    assert cool_moments(heavy, limit(40.0), np.inf).all()
    assert cool_moments(warmed(np.full(300, 36.0)), limit(40.0), 1800.0).all()
    assert cool_moments(warmed(39 - 0.02 * np.arange(300.0)), limit(40.0), 1800.0).all()


def test_idle_wrists_need_limits_of_their_own():
    idle = warmed(np.full(100, 33.0), others_c=42.0)
    with pytest.raises(NothingCool, match=r"Always above: 1 \(42.0 °C\), 3 .*may differ by joint, idle wrists"):
        cool_stretches([idle], 1.0, cool_c=40.0, horizon_s=60.0)
    per_joint = [45.0, 40.0, *[45.0] * 5]
    for chosen in (
        cool_stretches([idle], 1.0, cool_c=per_joint, horizon_s=60.0),
        cool_stretches([idle], 1.0, cool_c=40.0, horizon_s=60.0, joints=[1]),
    ):
        assert [len(s.time_s) for s in chosen] == [100]


def test_stretches_come_from_the_cool_parts_alone():
    temp_c = np.full(300, 35.0)
    temp_c[150] = 41.0
    found = cool_stretches([warmed(temp_c), warmed(temp_c + 10, name="b")], 1.0, cool_c=40.0, horizon_s=20.0)
    assert [s.recording for s in found] == ["a", "a"]
    assert [(s.time_s[0], s.time_s[-1]) for s in found] == [(0.0, 129.0), (151.0, 299.0)]
    long = cool_stretches([warmed(temp_c)], 1.0, cool_c=40.0, horizon_s=20.0, least_s=140.0)
    assert [s.time_s[0] for s in long] == [151.0]


def test_hot_recordings_are_refused_with_advice():
    hot = [warmed(np.full(100, 50.0))]
    words = r"1 recording.* motors 1, 2, .* below 40 °C for 60 s\..*2 \(50.0 °C\).*Raise the limit"
    with pytest.raises(NothingCool, match=words):
        cool_stretches(hot, 1.0, cool_c=40.0, horizon_s=60.0)
    words = r"^At no moment of 2 recording.*motors 2, 3 stay below its 40 to 45 °C for the rest of its recording\."
    with pytest.raises(NothingCool, match=words):
        cool_stretches(hot * 2, 1.0, cool_c=[40, 40, 45, 40, 40, 40, 40], horizon_s=np.inf, joints=[1, 2])
    with pytest.raises(ValueError, match="at least one recording"):
        cool_stretches([], 1.0, cool_c=40.0, horizon_s=60.0)


def test_a_short_recording_is_not_reported_as_hot():
    with pytest.raises(NothingCool, match=r"^The recording is shorter .* 25 s are needed, the longest .* has 10 s\."):
        cool_stretches([warmed(np.full(10, 30.0))] * 2, 1.0, cool_c=40.0, horizon_s=60.0, least_s=25.0)
    temp_c = np.full(100, 35.0)
    temp_c[12::13] = 50.0
    with pytest.raises(
        NothingCool, match=r"^The part that stays cool is shorter .* 25 s are needed, the longest .* has 12 s\."
    ):
        cool_stretches([warmed(temp_c)], 1.0, cool_c=40.0, horizon_s=0.0, least_s=25.0)


def test_bad_arguments_are_named():
    recording = warmed(np.full(10, 30.0))
    with pytest.raises(ValueError, match="one limit or 7"):
        cool_stretches([recording], 1.0, cool_c=[40.0, 41.0], horizon_s=60.0)
    with pytest.raises(ValueError, match="some of 0 … 6"):
        cool_stretches([recording], 1.0, cool_c=40.0, horizon_s=60.0, joints=[7])
    with pytest.raises(ValueError, match="horizon_s must be >= 0"):
        cool_stretches([recording], 1.0, cool_c=40.0, horizon_s=-1.0)
    still = recording.q
    blind = Recording(name="blind", time_s=recording.time_s, q=still, qd=still, tau=still)
    with pytest.raises(ValueError, match="'blind' has no motor temperatures"):
        cool_stretches([blind], 1.0, cool_c=40.0, horizon_s=60.0)
