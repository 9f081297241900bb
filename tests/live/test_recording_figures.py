"""Report of a recording: its figures contradict neither each other nor what was recorded."""

import base64

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol.auction import ArmEvent, JobStatus, Result
from fleet.bus.protocol.messages import State
from fleet.readings import TemperatureFilter, all_possible
from fleet.telemetry import WORKING
from scenarios.live.recorder import Recorder
from scenarios.live.recording_report import open_recording
from scenarios.show.late_jobs import late_jobs
from scenarios.show.run_page import verdict
from scenarios.show.timeline import UNKNOWN, shift_charts


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


def test_a_late_job_of_an_arm_without_events_is_late_everywhere_and_drawn_as_its_work(tmp_path):
    """Accepted at 10 s, due at 5 s, awarded at 20 s and finished at 80 s: 75 s late, and 60 s of work.

    The award of another one, 30 s late, is not recorded.
    """
    times = {"accepted_s": 10.0, "due_s": 5.0}
    changes = [
        result(1, 20.0, to="awarded", cycles=0, **times),
        result(2, 80.0, finished_s=80.0, **times),
        result(3, 90.0, job="k", finished_s=90.0, due_s=60.0),
    ]
    log = shown(tmp_path, *(state("a", tick) for tick in range(1, 101)), *changes)
    outcome, metrics = verdict(log), log.card["metrics"]
    assert [(each.job, each.late_s) for each in late_jobs(log)] == [("j", 75.0), ("k", 30.0)]
    assert (outcome.badge, outcome.good) == ("2 late jobs", False)
    assert "2 of 2 jobs finished, 0 of them on time." in outcome.sentences
    assert (metrics["on_time"], metrics["tardiness_min"]) == (0, 105.0 / 60.0)
    assert [(a.arm, a.job, a.start_s, a.end_s, a.late_s) for a in log.plan.assignments] == [
        ("a", "j", 20.0, 80.0, 75.0)
    ]
    assert "No begin is recorded of 1 of 2 finished jobs: they are in no arm's work." in log.remarks


def test_work_that_an_arm_has_reported_is_not_drawn_twice(tmp_path):
    """Its own times count; only what it did not report, the award, is that of the auctioneer."""
    own = [ArmEvent("a", 1, 79.0, "finish", "j", epoch="now"), ArmEvent("a", 2, 85.0, "home", "j", epoch="now")]
    changes = [result(1, 20.0, to="awarded", cycles=0), result(2, 80.0, finished_s=80.0)]
    log = shown(tmp_path, *(state("a", tick) for tick in range(1, 101)), *own, *changes)
    assert [(a.start_s, a.finished_s, a.end_s) for a in log.plan.assignments] == [(20.0, 79.0, 85.0)]


def test_impossible_temperatures_are_left_out_and_named_and_the_arm_is_not_absent(tmp_path):
    """31 °C in °F on all motors of b; a has 40 °C, and one motor that jumps by 60 K in a second for 20 s."""
    jump = {tick: (100.0, *(40.0,) * 6) for tick in range(50, 70)}
    own = [state("a", tick, temp_c=jump.get(tick, (40.0,) * 7)) for tick in range(1, 101)]
    wrong = [state("b", tick, temp_c=(87.8,) * 7, mode="working") for tick in range(1, 101)]
    log = shown(tmp_path, *own, *wrong)
    metrics = log.card["metrics"]
    assert metrics["peak_c"] == {"a": 40.0}
    assert (metrics["above_warning_min"], metrics["utilisation"]) == (0.0, pytest.approx(0.5, abs=0.01))
    assert "No motor reached its error limit; the hottest, in a, reached 40 °C." in verdict(log).sentences
    assert "Impossible temperatures of a and b are left out (a, joint 1 reads 100.0 °C" in " ".join(log.remarks)
    assert "b" not in metrics["insulation_ppb"]
    assert (log.readings.mode[:, 1] == WORKING).all()


@given(
    st.lists(
        st.tuples(
            st.floats(0.1, 100.0),
            st.lists(st.sampled_from((-50.0, 0.0, 30.0, 31.0, 45.0, 66.0, 90.0, 250.0)), min_size=3, max_size=3),
        ),
        min_size=1,
        max_size=6,
    )
)
def test_all_temperatures_are_possible_if_the_filter_of_a_live_arm_rejects_none(rows):
    time_s, temp_c = np.cumsum([step_s for step_s, _ in rows]), np.array([temps for _, temps in rows])
    sensors, rejected = TemperatureFilter(), False
    for at_s, temps in zip(time_s, temp_c, strict=True):
        sensors.update(float(at_s), dict(enumerate(temps.tolist())))
        rejected |= bool(sensors.bad)
    assert all_possible(time_s, temp_c) == (not rejected)


def test_an_arm_that_was_not_there_is_grey_in_the_heat_map(tmp_path):
    """20 arms for 100 s; the last one only after 60 s."""
    arms = [f"arm_{number:02d}" for number in range(20)]
    states = [state(arm, tick) for arm in arms for tick in range(61 if arm == arms[-1] else 1, 101)]
    log = shown(tmp_path, *states)
    heat = shift_charts(log)["Hottest motor of each arm"].figure["data"][0]
    rows, columns = map(int, heat["z"]["shape"].split(","))
    cells = np.frombuffer(base64.b64decode(heat["z"]["bdata"]), np.uint8).reshape(rows, columns)
    assert (cells[:-1] == 1 + 2 * (30 - 20)).all()
    assert 20 < (cells[-1] == 0).sum() < 40
    assert {*log.readings.mode[:20, -1]} == {-1}
    assert heat["colorscale"][0] == [0.0, UNKNOWN]
    assert heat["colorscale"][1][0] * heat["zmax"] == 0.5
    assert "grey: no reading" in heat["colorbar"]["title"]["text"]
