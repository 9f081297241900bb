"""Report of a recording: its figures contradict neither each other nor what was recorded."""

import pytest

from fleet.bus.protocol.auction import JobStatus, Result
from fleet.bus.protocol.messages import State
from scenarios.live.recorder import Recorder
from scenarios.live.recording_report import open_recording


@pytest.fixture(autouse=True)
def quick_disk(monkeypatch):
    """No test here cuts the power."""
    monkeypatch.setattr("os.fsync", lambda _: None)


def state(arm, tick, **change):
    """A state each second; temperatures stay far below the limits."""
    words = {"time_s": float(tick), "mode": "idle", "temp_c": (30.0,) * 7, "headroom_k": 30.0, **change}
    return State(arm=arm, tick=tick, **words)


def result(number, time_s, job="j", to="finished", **change):
    status = JobStatus(job, to, **{"arm": "a", "cycles": 3, "repetitions": 3, "accepted_s": 0.0, **change})
    return Result("boss", number, time_s, status, epoch="now")


def shown(folder, *messages):
    recorder = Recorder.open(folder, "f")
    for message in messages:
        recorder.add("", message)
    recorder.write(status="finished")
    return open_recording(folder)


@pytest.mark.parametrize("away", [1, 40])
def test_an_arm_whose_clock_is_ahead_does_not_stretch_the_report(tmp_path, away):
    """Three arms for 100 s; of one without an epoch, that joins or leaves, the clock is 5000 s ahead."""
    own = [state(arm, tick, epoch="now") for arm in "ab" for tick in range(1, 101)]
    ahead = [state("c", tick, time_s=5000.0 + tick) for tick in range(1, 101, away)]
    log = shown(tmp_path, *own, *ahead, result(1, 50.0, finished_s=50.0))
    assert float(log.readings.time_s[-1]) <= 101.0
    assert log.arms == ("a", "b")
    assert "The clock of c was ahead" in " ".join(log.remarks)
    assert "The clock of c was ahead" in log.page()
