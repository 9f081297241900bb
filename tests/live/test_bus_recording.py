"""Recording and replay: every message once and in order, despite repeated messages and failures."""

import threading
import time
from contextlib import ExitStack

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.bus.client.client import BusClient
from fleet.bus.client.router import Router
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, JobStatus, Result
from fleet.bus.protocol.messages import State
from fleet.errors import FleetError
from scenarios.cli.live.record import lock_folder, record
from scenarios.live.recorder import CARD, Recorder, part_files, read_card, read_parts, states
from scenarios.live.replayer import Replay

PATIENCE_S = 20.0


def state(arm, tick, time_s=None):
    """A word with float32 readings, which come back exactly."""
    temps = tuple(float(np.float32(20.0 + tick + j / 8)) for j in range(7))
    return State(
        arm=arm,
        tick=tick,
        time_s=float(tick if time_s is None else time_s),
        mode="working",
        temp_c=temps,
        headroom_k=60.0 - temps[-1],
        q=temps,
        current_a=temps,
    )


def event(arm, number):
    return ArmEvent(arm=arm, number=number, time_s=number / 2, kind="finish", job=f"job {number}", value=1.5)


def result(number):
    status = JobStatus(job=f"job {number}", state="finished", arm="a", award="x", cycles=3, finished_s=number / 2)
    return Result(auctioneer="boss", number=number, time_s=number / 2, status=status, difficulty=0.5)


def test_recorded_messages_are_read_back(tmp_path):
    recorder = Recorder.open(tmp_path, "f")
    said = [state(arm, tick) for tick in range(5) for arm in ("a", "b")]
    for word in said:
        recorder.add(word.arm, word)
    for number in range(3):
        recorder.add("a", event("a", number))
        recorder.add("boss", result(number))
    recorder.write(status="finished")
    read = list(states(read_parts(tmp_path, "telemetry")))
    assert sorted(read, key=lambda w: (w.tick, w.arm)) == sorted(said, key=lambda w: (w.tick, w.arm))
    told = Replay.of(tmp_path)
    assert [w for w in told.messages() if isinstance(w, ArmEvent)] == [event("a", n) for n in range(3)]
    assert [w for w in told.messages() if isinstance(w, Result)] == [result(n) for n in range(3)]
    assert read_card(tmp_path).status == "finished"


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 30), min_size=1, max_size=60))
def test_every_message_is_kept_once_and_gaps_are_counted(tmp_path_factory, ticks):
    recorder = Recorder.open(tmp_path_factory.mktemp("r"), "f")
    kept = []
    for tick in ticks:  # a word is new if it is later than all before
        if not kept or tick > kept[-1]:
            kept.append(tick)
        recorder.add("a", state("a", tick))
    count = recorder.counts["state of a"]
    assert count.kept == len(kept)
    assert count.twice == len(ticks) - len(kept)
    assert count.missed == kept[-1] - kept[0] + 1 - len(kept)


def test_messages_of_a_restarted_arm_are_kept(tmp_path):
    recorder = Recorder.open(tmp_path, "f")
    for word in (state("a", 7, 70.0), state("a", 0, 80.0), state("a", 1, 81.0), state("a", 0, 80.0)):
        recorder.add("a", word)
    assert (recorder.counts["state of a"].kept, recorder.counts["state of a"].missed) == (3, 0)


def test_a_recording_is_readable_meanwhile_and_can_be_continued(tmp_path):
    first = Recorder.open(tmp_path, "f")
    first.add("a", state("a", 0))
    first.write()
    assert read_parts(tmp_path, "telemetry").num_rows == 1
    first.add("a", state("a", 1))  # never written: the process died
    again = Recorder.open(tmp_path, "f")
    again.add("a", state("a", 0))  # from a cache
    again.add("a", state("a", 1))
    again.write()
    assert read_parts(tmp_path, "telemetry")["tick"].to_pylist() == [0, 1]
    assert [path.name for path in part_files(tmp_path, "telemetry")] == [
        "telemetry-000001.parquet",
        "telemetry-000002.parquet",
    ]
    assert read_card(tmp_path).status == "recording"


def test_a_full_disk_loses_nothing(tmp_path, monkeypatch):
    recorder = Recorder.open(tmp_path, "f")
    recorder.add("a", state("a", 0))

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(pq, "write_table", full)
        with pytest.raises(FleetError, match="No space left on device"):
            recorder.write()
    recorder.write()
    assert read_parts(tmp_path, "telemetry").num_rows == 1


def test_a_folder_without_a_recording_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(FleetError, match="holds other files"):
        Recorder.open(tmp_path, "f")
    with pytest.raises(FleetError, match="neither a run"):
        Replay.of(tmp_path)
    (tmp_path / "new").mkdir()
    Recorder.open(tmp_path / "new", "f")
    with pytest.raises(FleetError, match="of fleet 'f', not of 'g'"):
        Recorder.open(tmp_path / "new", "g")
    (tmp_path / "new" / CARD).write_text("{")
    with pytest.raises(FleetError, match="missing or damaged"):
        Recorder.open(tmp_path / "new", "f")


class Recording:
    """`record` on a thread of its own, until the end of the block."""

    def __init__(self, endpoint, folder):
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(endpoint, folder))
        self.recorder = None

    def _run(self, endpoint, folder):
        with BusClient(endpoint, "f") as link:
            self.recorder = record(link, folder, rotate_s=0.2, stopped=self._stop.is_set)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *exc):
        self._stop.set()
        self._thread.join(PATIENCE_S)


def wait_for(condition, link=None):
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, "waited in vain"
        if link is not None:
            link.serve(time.monotonic() + 0.05)
        else:
            threading.Event().wait(0.05)


def rows(folder, kind="telemetry"):
    return read_parts(folder, kind).num_rows if folder.exists() else 0


def test_no_message_is_lost_when_the_router_restarts(tmp_path):
    with ExitStack() as stack:
        router = Router().open()
        port = int(router.endpoint.rpartition(":")[2])
        arm = stack.enter_context(BusClient(router.endpoint, "f"))
        say = arm.publisher(keys.of_arm("f", "a", "state"), State)
        recording = stack.enter_context(Recording(router.endpoint, tmp_path))
        for tick in range(50):
            say(state("a", tick))
        wait_for(lambda: rows(tmp_path) == 50)
        router.close()
        for tick in range(50, 250):
            say(state("a", tick))
        with Router(port):
            said = 250

            def goes_on():
                nonlocal said
                say(state("a", said))
                said += 1
                return rows(tmp_path) > 260

            wait_for(goes_on)
            wait_for(lambda: rows(tmp_path) == said)
            recording.__exit__()
    assert read_parts(tmp_path, "telemetry")["tick"].to_pylist() == list(range(said))
    assert recording.recorder.counts["state of a"].missed == 0


def test_a_replay_publishes_the_same_messages_and_refuses_names_of_present_arms(tmp_path):
    (tmp_path / "first").mkdir()
    first = Recorder.open(tmp_path / "first", "f")
    for tick in range(20):
        first.add("a", state("a", tick))
        first.add("a", event("a", tick))
        first.add("boss", result(tick))
    first.write()
    told = Replay.of(tmp_path / "first")
    with Router() as router, Recording(router.endpoint, tmp_path / "second"), BusClient(router.endpoint, "f") as link:
        wait_for(lambda: (tmp_path / "second" / CARD).exists(), link)
        assert told.play(link, speed=100.0, stopped=lambda: False) == 60
        wait_for(lambda: rows(tmp_path / "second", "results") == 20, link)
        with BusClient(router.endpoint, "f") as other, pytest.raises(FleetError, match="on the bus already"):
            told.play(other, speed=100.0, stopped=lambda: False)
    for kind in ("telemetry", "events", "results"):
        assert read_parts(tmp_path / "second", kind).equals(read_parts(tmp_path / "first", kind)), kind


def test_two_recorders_cannot_share_a_folder(tmp_path):
    rec = tmp_path / "rec"
    with lock_folder(rec), pytest.raises(FleetError, match="Another process records"), lock_folder(rec):
        pass
    with lock_folder(rec):  # the first has ended
        pass
