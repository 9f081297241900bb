"""Recording and replay: every message once and in order, despite repeated messages and failures."""

import threading
import time
from contextlib import ExitStack
from functools import partial

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, JobStatus, Result
from fleet.bus.protocol.cell import Cell, CellRequest
from fleet.bus.protocol.contract import EXAMPLES
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import Cancel, ControlRequest, Operation
from fleet.bus.router import Router
from fleet.errors import FleetError
from scenarios.live.recorder import Recorder, lock_folder, record
from scenarios.live.recording import CARD, JOURNAL, part_files, read_card, read_parts, states
from scenarios.live.replayer import Replay
from tests.profiles import examples
from tests.waiting import PATIENCE_S


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


def operation(number):
    request = ControlRequest(f"request {number}", Cancel(f"job {number}"), "ann")
    return Operation("boss", number / 2, request, number)


def test_recorded_messages_are_read_back(tmp_path):
    recorder = Recorder.open(tmp_path, "f")
    said = [state(arm, tick) for tick in range(5) for arm in ("a", "b")]
    for word in said:
        recorder.add(word.arm, word)
    for number in range(3):
        recorder.add("a", event("a", number))
        recorder.add("boss", result(number))
        recorder.add("boss", operation(number))
    recorder.write(status="finished")
    read = list(states(read_parts(tmp_path, "telemetry")))
    assert sorted(read, key=lambda w: (w.tick, w.arm)) == sorted(said, key=lambda w: (w.tick, w.arm))
    told = Replay.of(tmp_path)
    assert [w for w in told.messages() if isinstance(w, ArmEvent)] == [event("a", n) for n in range(3)]
    assert [w for w in told.messages() if isinstance(w, Result)] == [result(n) for n in range(3)]
    assert [w for w in told.messages() if isinstance(w, Operation)] == [operation(n) for n in range(3)]
    assert read_card(tmp_path).status == "finished"


@examples(50)
@given(
    st.lists(st.tuples(st.integers(0, 30), st.sampled_from(["", "save", "write", "crash"])), min_size=1, max_size=60)
)
def test_every_message_is_kept_once_and_gaps_are_known(tmp_path_factory, steps):
    """Whatever the order of messages, and wherever the recorder crashes after a save."""
    folder = tmp_path_factory.mktemp("r")
    recorder = Recorder.open(folder, "f")
    first, kept = steps[0][0], set()
    for tick, then in steps:
        recorder.add("a", state("a", tick))
        if tick >= first:  # what was sent before it joined is unknown to it
            kept.add(tick)
        if then == "write":
            recorder.write()
        elif then:
            recorder.save()
        if then == "crash":
            recorder.close()
            recorder = Recorder.open(folder, "f")
    recorder.save()
    assert read_parts(folder, "telemetry")["tick"].to_pylist() == sorted(kept)
    sought = {tick for gap in recorder.sought for tick in range(gap.first, gap.last + 1)}
    assert sought == set(range(first, max(kept) + 1)) - kept
    count = recorder.counts["state of a"]
    assert (count.kept, count.missed) == (len(kept), len(sought))
    recorder.write(status="finished")
    gaps = read_parts(folder, "gaps").to_pylist()
    assert {tick for gap in gaps for tick in range(gap["first"], gap["last"] + 1)} == sought
    assert all("the recording ended" in gap["reason"] for gap in gaps)


@examples(60)
@given(st.data())
def test_a_torn_journal_loses_only_what_was_not_saved(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("r")
    recorder = Recorder.open(folder, "f")
    sizes = []
    for tick in range(4):
        recorder.add("a", state("a", tick))
        recorder.save()
        sizes.append((folder / JOURNAL).stat().st_size)
    recorder.close()
    size = data.draw(st.integers(0, sizes[-1]))
    (folder / JOURNAL).write_bytes((folder / JOURNAL).read_bytes()[:size])
    again = Recorder.open(folder, "f")
    again.write()
    expected = [tick for tick, end in enumerate(sizes) if end <= size]
    assert read_parts(folder, "telemetry")["tick"].to_pylist() == expected


def test_a_damaged_journal_is_put_aside_and_the_recording_says_so(tmp_path):
    recorder = Recorder.open(tmp_path, "f")
    for tick in range(2):
        recorder.add("a", state("a", tick))
        recorder.save()
    recorder.close()
    damaged = (tmp_path / JOURNAL).read_bytes().replace(b'"tick":0', b'"tick":7')
    (tmp_path / JOURNAL).write_bytes(damaged)
    again = Recorder.open(tmp_path, "f")
    again.write()
    (gap,) = read_parts(tmp_path, "gaps").to_pylist()
    assert "the journal was damaged: damaged-after-000000.journal" in gap["reason"]
    assert (tmp_path / "damaged-after-000000.journal").read_bytes() == damaged


def test_messages_of_a_restarted_arm_are_kept(tmp_path):
    recorder = Recorder.open(tmp_path, "f")
    for word in (state("a", 7, 70.0), state("a", 0, 80.0), state("a", 1, 81.0), state("a", 0, 80.0)):
        recorder.add("a", word)
    assert (recorder.counts["state of a"].kept, recorder.counts["state of a"].missed) == (3, 0)


def test_a_new_epoch_in_the_same_folder_is_no_repetition(tmp_path):
    """A second shift begins its numbers and its time again; caches repeat messages of both."""
    recorder = Recorder.open(tmp_path, "f")
    sent = [
        replace(message, epoch=epoch)
        for epoch in ("one", "two")
        for number in range(1, 6)
        for message in (state("a", number), event("a", number + 10**9), result(number - 1), operation(number - 1))
    ]
    for message in (*sent, *sent[-12:]):
        recorder.add("", message)
    recorder.save()
    recorder.close()
    again = Recorder.open(tmp_path, "f")
    for message in sent[-12:]:
        again.add("", message)
    again.write(status="finished")
    read = list(Replay.of(tmp_path).messages())
    assert sorted(map(repr, read)) == sorted(map(repr, sent))
    assert read_parts(tmp_path, "gaps").num_rows == 0


def test_a_result_of_an_earlier_time_is_no_restart(tmp_path):
    """An auctioneer numbers a late report after results of later times, and repeats all after a restart."""
    recorder = Recorder.open(tmp_path, "f")
    sent = [replace(result(number), time_s=time_s) for number, time_s in enumerate((10.0, 30.0, 20.0, 40.0))]
    for message in (*sent[:3], *sent, sent[1]):
        recorder.add("boss", message)
    recorder.write(status="finished")
    assert read_parts(tmp_path, "results")["number"].to_pylist() == [0, 2, 1, 3]
    assert read_parts(tmp_path, "gaps").num_rows == 0


def test_a_full_disk_at_the_start_puts_no_journal_aside(tmp_path, monkeypatch):
    recorder = Recorder.open(tmp_path, "f")
    recorder.add("a", state("a", 0))
    recorder.save()
    recorder.close()

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr("fleet.live.journal.os.open", full)
        with pytest.raises(FleetError, match="No space left on device"):
            Recorder.open(tmp_path, "f")
    Recorder.open(tmp_path, "f").write()
    assert read_parts(tmp_path, "telemetry").num_rows == 1


def test_a_recording_is_readable_meanwhile_and_can_be_continued(tmp_path):
    first = Recorder.open(tmp_path, "f")
    first.add("a", state("a", 0))
    first.write()
    assert read_parts(tmp_path, "telemetry").num_rows == 1
    first.add("a", state("a", 1))  # never saved: the process died
    first.close()
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

    def full(*_, **__):
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
            connect = partial(BusClient, endpoint, "f", timeout_s=0.5)
            self.recorder = record(link, folder, rotate_s=2.0, stopped=self._stop.is_set, connect=connect)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *exc):
        self._stop.set()
        self._thread.join(PATIENCE_S)


def wait_for(condition, link=None, patience_s=PATIENCE_S):
    deadline_s = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline_s, "waited in vain"
        if link is not None:
            link.serve(time.monotonic() + 0.05)
        else:
            threading.Event().wait(0.05)


def rows(folder, kind="telemetry"):
    return read_parts(folder, kind).num_rows if (folder / CARD).exists() else 0


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


def test_gaps_are_fetched_from_the_publishers_cache_or_become_rows(tmp_path):
    """A publisher sends numbers 0 and 3 live; its cache has 1, and nobody has 2."""
    with Router() as router, BusClient(router.endpoint, "f") as boss, Recording(router.endpoint, tmp_path) as recording:
        wait_for(lambda: (tmp_path / CARD).exists())
        live = [keys.of_auction("f", "boss", "result"), Result]
        boss.publish(*live[:1], result(0))
        wait_for(lambda: rows(tmp_path, "results") == 1)
        boss.publish(*live[:1], result(3))
        wait_for(lambda: rows(tmp_path, "results") == 2)
        with BusClient(router.endpoint, "f") as again:
            again.publisher(*live)(result(1))
            wait_for(lambda: rows(tmp_path, "results") == 3)
            wait_for(lambda: rows(tmp_path, "gaps") == 1, patience_s=40.0)
    assert read_parts(tmp_path, "results")["number"].to_pylist() == [0, 1, 3]
    (gap,) = read_parts(tmp_path, "gaps").to_pylist()
    assert (gap["sender"], gap["first"], gap["last"]) == ("results of boss", 2, 2)
    assert "not in the cache of its publisher" in gap["reason"]
    assert recording.recorder.counts["results of boss"].missed == 1


def test_the_cell_of_the_auctioneer_is_kept_and_asked_for_once(tmp_path):
    cell, asked = EXAMPLES[Cell], []

    def describe(request):
        asked.append(request)
        return cell

    with Router() as router, BusClient(router.endpoint, "f") as boss:
        boss.reply_to(keys.of_jobs("f", "cell"), CellRequest, describe)
        for _ in range(2):  # the second continues the recording
            with Recording(router.endpoint, tmp_path):
                wait_for(lambda: (tmp_path / CARD).exists() and read_card(tmp_path).cell, boss)
    kept = read_card(tmp_path).cell
    assert len(asked) == 1
    assert (kept.places, kept.fixtures, kept.warning_c) == (cell.places, cell.fixtures, cell.warning_c)
    assert [(arm.name, arm.position_m, arm.works) for arm in kept.arms] == [("arm_0", (0.0, 0.0, 0.0), ())]


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
