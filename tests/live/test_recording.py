"""Recording, replay and report of a live fleet: every message once and in order, despite failures."""

import dataclasses
import json
import re
import threading
import time
from functools import partial
from itertools import pairwise
from unittest.mock import MagicMock

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs
from msgspec.structs import replace

from docs.bus_contract import EXAMPLES
from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, JobStatus, Result
from fleet.bus.protocol.cell import Cell, CellRequest
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import (
    Alarm,
    Cancel,
    Change,
    Clear,
    ControlRequest,
    Operation,
    Pause,
    Resume,
    Settle,
)
from fleet.bus.router import Router
from fleet.errors import FleetError
from fleet.events import EVENTS_PER_BOOT, Event
from fleet.live.job_rules import EXPIRED
from fleet.robot import ThermalLimits
from scenarios.live.recorder import SWEEP_S, GapFetcher, Recorder, record
from scenarios.live.recording import CARD, SOURCES, alarms_of, open_messages, read_card, read_parts, replay
from scenarios.live.recording_report import NO_STATES, epochs_of, heat_use, open_recording, order_events
from scenarios.result_folder import lock_folder
from scenarios.run.records import JobRecord, ShiftLog, schedule
from scenarios.show.late_jobs import late_jobs, lateness_text
from scenarios.show.run_page import report_html, verdict
from tests.commands import call
from tests.profiles import examples
from tests.waiting import PATIENCE_S, serve_until, wait_until


@pytest.fixture(autouse=True)
def quick_disk(monkeypatch):
    """No test here cuts the power."""
    monkeypatch.setattr("os.fsync", lambda _: None)


def state(arm, tick, time_s=None):
    """A message with float32 readings, which are read back exactly."""
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


def recorded(folder, *messages, fleet="f", status="recording"):
    """The recorder of these messages, which are written."""
    recorder = Recorder.open(folder, fleet)
    for message in messages:
        recorder.add("", message)
    recorder.write(status=status)
    return recorder


def stub():
    """A client of a fleet in which no arm is present."""
    link = MagicMock(fleet="f")
    link.tokens.return_value = set()
    link.__enter__.return_value = link
    return link


@examples(40)
@given(st.lists(st.tuples(st.integers(0, 15), st.sampled_from(["", "write", "crash"])), min_size=1, max_size=20))
def test_every_message_is_kept_once_and_gaps_are_known(tmp_path_factory, steps):
    """Whatever the order of messages, and wherever the recorder crashes after a part."""
    folder = tmp_path_factory.mktemp("r")
    recorder = Recorder.open(folder, "f")
    first, kept = steps[0][0], set()
    for tick, then in steps:
        recorder.add("a", state("a", tick))
        if tick >= first:  # messages from before it joined are unknown to it
            kept.add(tick)
        if then:
            recorder.write()
        if then == "crash":
            recorder = Recorder.open(folder, "f")
    recorder.write()
    assert read_parts(folder, "telemetry")["tick"].to_pylist() == sorted(kept)
    missing = {tick for gap in recorder.missing for tick in range(gap.first, gap.last + 1)}
    assert missing == set(range(first, max(kept) + 1)) - kept
    count = recorder.counts["telemetry of a"]
    assert (count.kept, count.missed) == (len(kept), len(missing))
    recorder.write(status="finished")
    gaps = read_parts(folder, "gaps").to_pylist()
    assert {tick for gap in gaps for tick in range(gap["first"], gap["last"] + 1)} == missing
    assert all("the recording ended" in gap["reason"] for gap in gaps)


def test_events_are_sought_of_an_arm_that_is_known_by_its_states_alone(tmp_path):
    """The only event of an arm may have been missed; nothing later shows that there was one."""
    recorder, asked = recorded(tmp_path, state("a", 1)), list[str]()
    link = MagicMock(fleet="f", subscribe=lambda key, *_, **__: asked.append(key))
    GapFetcher(recorder, lambda: link).step(time.monotonic() + SWEEP_S)
    unknown = [keys.of_every("f", *each) for each in (("auction", "result"), ("auction", "operation"))]
    assert asked[:3] == [*unknown, keys.of_every("f", "arm", "operation")]
    assert [key for key in asked[3:] if "/arm/" in key] == [
        keys.of_arm("f", "a", each) for each in ("event", "operation")
    ]


def test_the_requests_that_arms_publish_without_an_auctioneer_are_kept_once(tmp_path):
    """They have no number: caches repeat them after a later one, and after a restart of the recorder."""
    sent = [
        Operation(arm, time_s, ControlRequest(name, Pause(), "ann"))
        for arm, time_s, name in (("a", 5.0, "1"), ("a", 5.0, "2"), ("b", 4.0, "1"), ("a", 9.0, "3"))
    ]
    link = MagicMock(fleet="f")
    for _ in range(2):
        recorder = Recorder.open(tmp_path, "f")
        for source in SOURCES:
            recorder.subscribe(link, source)
        handle = next(call.args[2] for call in link.subscribe.mock_calls if call.args[0].endswith("/arm/*/operation"))
        for operation in (*sent, *sent[:2]):
            handle(operation.auctioneer, operation)
        recorder.write()
    assert sorted(map(repr, open_messages(tmp_path))) == sorted(map(repr, sent))
    count = recorder.counts["operations of a"]
    assert (count.kept, count.missed, recorder.missing) == (3, 0, [])


def test_messages_of_a_restarted_arm_are_kept(tmp_path):
    sent = (state("a", 7, 70.0), state("a", 0, 80.0), state("a", 1, 81.0), state("a", 0, 80.0))
    count = recorded(tmp_path, *sent).counts["telemetry of a"]
    assert (count.kept, count.missed) == (3, 0)


def test_a_new_epoch_in_the_same_folder_is_no_repetition(tmp_path):
    """A second shift begins its numbers and its time again; caches repeat messages of both."""
    sent = [
        replace(message, epoch=epoch)
        for epoch in ("one", "two")
        for number in range(1, 6)
        for message in (state("a", number), event("a", number + 10**9), result(number - 1), operation(number - 1))
    ]
    recorded(tmp_path, *sent, *sent[-12:])
    recorded(tmp_path, *sent[-12:], status="finished")
    assert sorted(map(repr, open_messages(tmp_path))) == sorted(map(repr, sent))
    assert read_parts(tmp_path, "gaps").num_rows == 0
    assert read_card(tmp_path).status == "finished"


@pytest.mark.parametrize(("make", "table"), [(partial(event, "a"), "events"), (result, "results")])
def test_a_repeated_message_of_another_time_is_no_restart(tmp_path, make, table):
    """An arm numbers its arrival at home before the finish, an auctioneer a late report after later results.

    Both repeat all after a restart.
    """
    sent = [replace(make(number), time_s=time_s) for number, time_s in enumerate((10.0, 30.0, 20.0, 40.0))]
    recorded(tmp_path, *sent[:3], *sent, sent[1], status="finished")
    assert read_parts(tmp_path, table)["number"].to_pylist() == [0, 2, 1, 3]
    assert read_parts(tmp_path, "gaps").num_rows == 0


def test_a_fetched_result_that_is_later_than_the_next_one_is_recorded_once(tmp_path):
    """The next one is a late report; all are repeated after a restart."""
    sent = [replace(result(number), time_s=time_s) for number, time_s in enumerate((10.0, 30.0, 20.0))]
    recorded(tmp_path, sent[0], sent[2], sent[1], *sent, status="finished")
    assert sorted(read_parts(tmp_path, "results")["number"].to_pylist()) == [0, 1, 2]
    assert read_parts(tmp_path, "gaps").num_rows == 0


def test_the_first_event_of_a_start_is_recorded_though_the_clock_of_its_arm_was_not_set_yet(tmp_path):
    """It is fetched after the ones that follow it."""
    start = 2 * EVENTS_PER_BOOT
    times_s = {1: 50.0, start + 1: 9.5, start + 2: 60.0, start + 3: 70.0}
    sent = {number: replace(event("arm_0", number), time_s=time_s) for number, time_s in times_s.items()}
    order = (1, start + 3, start + 1, start + 2, start + 1)
    recorded(tmp_path, *(sent[number] for number in order), status="finished")
    assert sorted(read_parts(tmp_path, "events")["number"].to_pylist()) == sorted(times_s)
    assert read_parts(tmp_path, "gaps").num_rows == 0


@pytest.mark.parametrize("make", [result, operation])
def test_numbers_that_an_older_copy_of_the_journal_uses_again_are_kept_and_named(tmp_path, make):
    """The sender repeats first what the copy has."""
    before, again = [make(number) for number in range(5)], [replace(make(n), time_s=20.0 + n) for n in (3, 4, 5)]
    recorder = recorded(tmp_path, *before, before[1], before[2], *again, *again, status="finished")
    assert sorted(map(repr, open_messages(tmp_path))) == sorted(map(repr, [*before, *again]))
    (gap,) = read_parts(tmp_path, "gaps").to_pylist()
    assert (gap["first"], gap["last"], gap["time_s"], "older copy" in gap["reason"]) == (3, 4, 23.0, True)
    assert recorder.missing == []


def test_a_part_that_a_crash_left_without_its_card_is_not_read_later(tmp_path):
    """The next part of the same number has no operations; the message then comes again."""
    before = Recorder.open(tmp_path, "f")
    before.add("boss", operation(0))
    card = (tmp_path / CARD).read_bytes()
    before.write()
    (tmp_path / CARD).write_bytes(card)  # as if it had crashed before it wrote this one
    again = recorded(tmp_path, state("a", 1))
    again.add("boss", operation(0))
    again.write()
    assert len(read_parts(tmp_path, "operations").to_pylist()) == 1


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
    with pytest.raises(FleetError, match="neither the folder of a run"):
        open_messages(tmp_path)
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
            self.recorder = record(link, folder, rotate_s=0.2, stopped=self._stop.is_set, connect=connect)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *exc):
        self._stop.set()
        self._thread.join(PATIENCE_S)


def rows(folder, kind="telemetry"):
    return read_parts(folder, kind).num_rows if (folder / CARD).exists() else 0


@pytest.mark.ci_slow
def test_gaps_are_fetched_from_the_publishers_cache_or_become_rows(tmp_path):
    """A publisher sends numbers 0 and 3 live; its cache has 1, and nobody has 2."""
    with Router() as router, BusClient(router.endpoint, "f") as boss, Recording(router.endpoint, tmp_path) as recording:
        wait_until(lambda: (tmp_path / CARD).exists())
        live = [keys.of_auction("f", "boss", "result"), Result]
        # Repeated, as the subscription may follow the card by some time.
        wait_until(lambda: rows(tmp_path, "results") == 1, lambda: boss.publish(*live[:1], result(0)))
        boss.publish(*live[:1], result(3))
        wait_until(lambda: rows(tmp_path, "results") == 2)
        with BusClient(router.endpoint, "f") as again:
            again.publisher(*live)(result(1))
            wait_until(lambda: rows(tmp_path, "results") == 3)
            wait_until(lambda: rows(tmp_path, "gaps") == 1)
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
                serve_until(lambda: (tmp_path / CARD).exists() and read_card(tmp_path).cell, boss)
    kept = read_card(tmp_path).cell
    assert len(asked) == 1
    assert (kept.places, kept.fixtures, kept.warning_c) == (cell.places, cell.fixtures, cell.warning_c)
    assert [(arm.name, arm.position_m, arm.works) for arm in kept.arms] == [("arm_0", (0.0, 0.0, 0.0), ())]


def test_a_replay_publishes_the_same_messages_and_refuses_names_of_present_arms(tmp_path):
    (tmp_path / "first").mkdir()
    recorded(tmp_path / "first", *(m for tick in range(20) for m in (state("a", tick), event("a", tick), result(tick))))
    messages = open_messages(tmp_path / "first")
    with Router() as router, Recording(router.endpoint, tmp_path / "second"), BusClient(router.endpoint, "f") as link:
        # The subscription may follow the card by some time.
        begin = partial(link.publish, keys.of_auction("f", "boss", "operation"), operation(0))
        wait_until(lambda: rows(tmp_path / "second", "operations"), begin)
        connect = partial(BusClient, router.endpoint, "f")
        assert replay(messages, link, connect=connect, speed=40.0, stopped=lambda: False) == (60, 0, 0)
        serve_until(lambda: rows(tmp_path / "second", "results") == 20, link)
        link.declare_token(keys.of_arm("f", "a", "alive"))
        with connect() as other, pytest.raises(FleetError, match="on the bus already"):
            replay(messages, other, connect=connect, speed=40.0, stopped=lambda: False)
    for kind in ("telemetry", "events", "results"):
        assert read_parts(tmp_path / "second", kind).equals(read_parts(tmp_path / "first", kind)), kind


def test_a_replay_begins_with_the_first_state(tmp_path):
    """A recorder of a running fleet gets events and results of long ago from caches."""
    recorded(tmp_path, *map(result, range(3)), *(state("a", tick) for tick in range(1200, 1205)))
    began_s = time.monotonic()
    count = replay(open_messages(tmp_path), stub(), connect=stub, speed=10.0, stopped=lambda: False)
    assert count == (8, 0, 3)
    assert 0.4 <= time.monotonic() - began_s < 60.0


def test_a_replay_publishes_a_request_under_the_key_of_its_arm_or_auctioneer(tmp_path):
    recorder = recorded(tmp_path, state("a", 1), operation(1))
    recorder.add("a", Operation("a", 2.0, ControlRequest("pause", Pause(), "ann")), numbered=False)
    recorder.write()
    link, arm = stub(), stub()
    messages = open_messages(tmp_path)
    assert replay(messages, link, connect=lambda: arm, speed=100.0, stopped=lambda: False) == (3, 0, 1)
    link.publisher.assert_called_once_with(keys.of_auction("f", "boss", "operation"), Operation)
    arm.publisher.assert_any_call(keys.of_arm("f", "a", "operation"), Operation)


def test_a_replay_shows_every_arm_to_a_subscriber_without_history_and_counts_states_that_come_too_soon(tmp_path):
    arms = "abcd"
    recorded(tmp_path, *(state(arm, tick) for tick in range(20) for arm in arms))
    messages, seen = open_messages(tmp_path), []
    with Router(state_hz=keys.CHANNEL["arm", "state"].limit_hz) as router:
        connect = partial(BusClient, router.endpoint, "f")
        with connect() as link, connect() as other:
            other.subscribe(keys.of_every_arm("f", "state"), State, lambda name, _: seen.append(name))
            assert replay(messages, link, connect=connect, speed=40.0, stopped=lambda: False) == (80, 0, 0)
            serve_until(lambda: all(seen.count(arm) >= 10 for arm in arms), other)
    assert replay(messages, stub(), connect=stub, speed=80.0, stopped=lambda: False) == (40, 40, 0)


def test_two_recorders_cannot_share_a_folder(tmp_path):
    with lock_folder(tmp_path), pytest.raises(FleetError, match="Another process writes to"):
        record(None, tmp_path, rotate_s=1.0, stopped=lambda: True, connect=lambda: None)


ARMS = ("arm_0", "arm_1")


def figure_of(html):
    """The traces of the page's figure."""
    return re.findall(r'"type":"bar".*?"hovertemplate"', html)


LOG = (
    Event(time_s=0.0, kind="award", arm="arm_0", job="a-1", value=0.4),
    Event(time_s=0.0, kind="award", arm="arm_1", job="b-1", value=0.2),
    Event(time_s=30.0, kind="finish", arm="arm_1", job="b-1", value=12.0),
    Event(time_s=31.0, kind="home", arm="arm_1", job="b-1"),
    Event(time_s=40.0, kind="warning", arm="arm_0", job="a-1", joint=2, reason="joint 2 passed 60 °C"),
    Event(time_s=50.0, kind="fault", arm="arm_0", job="a-1", joint=2, reason="joint 2 passed 75 °C"),
    Event(time_s=50.0, kind="return", arm="arm_0", job="a-1", value=3.0, reason="3 of 9 cycles kept"),
    Event(time_s=90.0, kind="recover", arm="arm_0", reason="cool again"),
    Event(time_s=95.0, kind="award", arm="arm_1", job="a-1", value=0.3),
)


def record_events(folder, events, samples=100):
    """A recording of these events, and of one state a second per arm."""
    folder.mkdir()
    recorder = Recorder.open(folder, "shop")
    for tick in range(samples):
        for arm in ARMS:
            temps = tuple((np.linspace(30.0, 40.0, 7) + tick / 8).tolist())
            recorder.add(arm, State(arm=arm, tick=tick, time_s=float(tick), mode="idle", temp_c=temps, headroom_k=1.0))
    for number, event in enumerate(events, start=1):
        value = event.value if np.isfinite(event.value) else None
        fields = {name: getattr(event, name) for name in ("arm", "time_s", "kind", "job", "joint", "reason")}
        recorder.add(event.arm, ArmEvent(number=number, value=value, **fields))
    return recorder


def test_the_work_and_events_of_a_recording_are_those_of_a_run(tmp_path):
    """Second method: the page of the same events, written as that of a run."""
    record_events(tmp_path / "r", LOG).write(status="finished")
    recording = open_recording(tmp_path / "r")
    live, telemetry = recording.page(), recording.readings
    assert telemetry.temp_c[:, 0, 0].tolist() == pytest.approx([30.0 + tick / 8 for tick in range(100)])
    run = {"status": "finished", "scenario": {"name": "shop"}, "policy": "p", "seed": 1}
    limits = ThermalLimits(warning_c=60.0, error_c=75.0)
    page = report_html(ShiftLog(card=run, arms=ARMS, limits=limits, readings=telemetry, events=LOG))
    bars = figure_of(live)
    assert bars == figure_of(page)
    assert len(bars) >= 2
    rows = r"<tr class=.*?</tr>|<td>.*?</td>"
    assert re.findall(rows, live.split("<h2>Events")[1].split("<details")[0]) == re.findall(
        rows, page.split("<h2>Events")[1].split("<details")[0]
    )


def test_the_heat_of_a_recording_has_the_closed_forms_of_its_laws(tmp_path):
    """An hour at the temperature of the insulation class uses 1/20,000 of its life; the links warm by 20 K."""
    states = list[State]()
    for tick in range(61):
        housing_c = (25.0 + 20.0 * tick / 60.0,) * 7
        states.append(State("hot", tick, 60.0 * tick, "idle", (155.0,) * 7, 1.0, housing_c=housing_c))
        states.append(State("bare", tick, 60.0 * tick, "idle", (), 1.0))
    recorded(tmp_path, *states)
    found = heat_use(read_parts(tmp_path, "telemetry"), ["hot", "bare"])
    assert found["insulation_ppb"] == {"hot": pytest.approx(1e9 / 20_000.0)}
    assert found["tool_drift_mm"] == {"hot": pytest.approx(1e3 * 23.6e-6 * 20.0 * 1.1878, rel=1e-3)}


def test_a_report_names_missing_messages_and_returned_jobs(tmp_path):
    recorder = record_events(tmp_path / "r", LOG[:2])
    for number, (state, arm) in enumerate((("awarded", "arm_1"), ("waiting", ""), ("finished", "arm_0"))):
        recorder.add("boss", Result("boss", 2 * number, 20.0 + number, JobStatus("b-1", state, arm, cycles=2)))
    recorder.write(status="finished")
    html = open_recording(tmp_path / "r").page()
    assert "returned to the queue, 2 cycles kept" in html
    assert "results of boss, numbers 1 to 1" in html
    assert "3 recorded, 2 missing" in html


def listed_events(html):
    """Cells of the list of events."""
    rows = re.findall(r"<tr class=.*?</tr>", html.split("<h2>Events")[1].split("</table>")[0])
    return [re.findall(r"<td>(.*?)</td>", row) for row in rows]


def test_a_report_lists_alarms_and_requests_among_the_events_and_names_who(tmp_path):
    recorder = record_events(tmp_path / "r", LOG[:5])
    recorder.add("boss", Result("boss", 0, 0.0, JobStatus("a-1", "waiting"), by="bob"))
    actions = (Change("a-1", due_s=900.0, value=2.0), Cancel("b-1"), Pause(), Settle("c-1", "redo"), Resume("arm_0"))
    for number, action in enumerate(actions):
        recorder.add("boss", Operation("boss", 30.0 * number, ControlRequest(str(number), action, "<ann>"), number))
    hot = Alarm("m", 1, 45.0, "7d1f", "fault", "arm_0 is faulted.", "arm_0", began_s=44.0)
    seen = replace(hot, number=2, time_s=70.0, by="cleo", acknowledged="2026-01-31T09:00:00Z")
    over = replace(seen, number=3, time_s=95.0, ended_s=88.0)
    for alarm in (hot, seen, over, replace(hot, number=4, time_s=131.0, began_s=130.0)):
        recorder.add("m", alarm)
    recorder.write(status="finished")
    html = open_recording(tmp_path / "r").page()
    assert listed_events(html) == [
        ["0:00:00", "change", "", "a-1", "due at 0:15:00, value 2, by &lt;ann&gt;"],
        ["0:00:30", "cancel", "", "b-1", "by &lt;ann&gt;"],
        ["0:00:40", "warning", "arm_0", "a-1", "joint 2 passed 60 °C"],
        ["0:00:44", "alarm", "arm_0", "", "arm_0 is faulted."],
        ["0:01:00", "pause", "all arms", "", "by &lt;ann&gt;"],
        ["0:01:10", "alarm acknowledged", "arm_0", "", "by cleo: arm_0 is faulted."],
        ["0:01:28", "alarm ended", "arm_0", "", "arm_0 is faulted."],
        ["0:01:30", "settle", "", "c-1", "as redo, by &lt;ann&gt;"],
        ["0:02:00", "resume", "arm_0", "", "by &lt;ann&gt;"],
        ["0:02:10", "alarm", "arm_0", "", "arm_0 is faulted."],
    ]
    assert "<td>jobs submitted by bob</td><td>1</td>" in html


def test_late_jobs_of_a_recording_and_of_a_run_are_counted_alike(tmp_path):
    """Second method: the same jobs as records of a run. What was due after the end of the shift is not late."""
    states = {"a-1": "awarded", "b-1": "finished", **dict.fromkeys(("open-1", "after-1"), "unfinished")}
    states["gone-1"] = "given_up"
    due_s = {"a-1": 70.0, "b-1": 18.0, "open-1": 60.0, "after-1": 95.0, "gone-1": 50.0, "stop-1": 40.0}
    recorder = record_events(tmp_path / "r", LOG)
    for number, (job, state) in enumerate((states | {"stop-1": "cancelled"}).items()):
        reason = EXPIRED if job == "gone-1" else ""
        more = {"reason": reason, "due_s": due_s[job], "release_s": 5.0, "shift_ended": state == "unfinished"}
        recorder.add("boss", Result("boss", number, 90.0, JobStatus(job, state, **more)))
    recorder.write(status="finished")
    live = open_recording(tmp_path / "r")
    more = {"release_s": 5.0, "finished_s": None, "value": 1.0, "payload_kg": 0.0, "cycles": 1}
    alike = {"awarded": "running", "unfinished": "waiting", "given_up": "expired"}
    jobs = [
        JobRecord(job=job, state=alike.get(state, state), due_s=due_s[job], **more) for job, state in states.items()
    ]
    run = ShiftLog(card={}, arms=ARMS, limits=live.limits, readings=live.readings, events=LOG, jobs=tuple(jobs))
    both = (late_jobs(live), late_jobs(dataclasses.replace(run, ended_s=90.0)))
    assert [[(late.job, late.late_s) for late in each] for each in both] == 2 * [
        [("open-1", 30.0), ("a-1", 20.0), ("b-1", 12.0), ("gone-1", 40.0)]
    ]
    assert (live.card["metrics"]["expired"], live.card["metrics"]["given_up"]) == (1, 0)


def record_wait(folder, late_s, alarms=(), actions=(), before=()):
    """A recording of a job that is due at 50 s, waits for its only arm from 10 s to 80 s, and is finished at 90 s."""
    log = (Event(time_s=80.0, kind="award", arm="arm_0", job="a-1"),
           Event(time_s=90.0, kind="finish", arm="arm_0", job="a-1", value=late_s))  # fmt: skip
    recorder = record_events(folder, (*before, *log))
    offer = structs.replace(EXAMPLES[Result].offers[0], arm="arm_0")
    award = JobStatus("a-1", "awarded", arm="arm_0", due_s=50.0, release_s=10.0)
    recorder.add("boss", Result("boss", 0, 80.0, award, offers=(offer,)))
    for alarm in alarms:
        recorder.add("m", alarm)
    for number, (time_s, action) in enumerate(actions):
        recorder.add("boss", Operation("boss", time_s, ControlRequest(str(number), action, "ann"), number))
    recorder.write(status="finished")
    log = open_recording(folder)
    return lateness_text(log, late_jobs(log))


def test_a_job_that_waits_while_nobody_replies_is_late_by_that_and_not_by_its_arm(tmp_path):
    silent = Alarm("m", 1, 35.0, "7d1f", "silent", "boss does not reply.", "boss", began_s=20.0, ended_s=75.0)
    waits = "a-1 finished 40 s late: "
    assert record_wait(tmp_path / "1", 40.0, [silent]) == f"{waits}boss did not reply from 0:00:20 to 0:01:15."
    assert record_wait(tmp_path / "2", 40.0, [replace(silent, ended_s=None)]) == (
        f"{waits}boss did not reply from 0:00:20 to 0:01:20."  # a result; the gateway had exited
    )
    busy = [
        Event(time_s=time_s, kind=kind, arm="arm_0", job="x-1", value=0.0)
        for time_s, kind in ((5.0, "award"), (79.0, "finish"), (79.5, "home"))
    ]
    assert record_wait(tmp_path / "6", 40.0, [silent], before=busy).startswith(f"{waits}boss did not reply")
    later = replace(silent, number=2, time_s=95.0, began_s=85.0, ended_s=95.0)
    assert record_wait(tmp_path / "7", 40.0, [silent, later]) == f"{waits}boss did not reply from 0:00:20 to 0:01:15."
    assert record_wait(tmp_path / "8", 0.0, [silent]).startswith(waits)  # the due date was changed after the award
    short = replace(silent, began_s=45.0, ended_s=60.0)
    assert record_wait(tmp_path / "3", 40.0, [short]).startswith(f"{waits}arm_0 was idle")
    paused = [(15.0, Pause("arm_0")), (78.0, Resume())]
    assert record_wait(tmp_path / "4", 40.0, actions=paused) == (
        f"{waits}arm_0 was paused by ann from 0:00:15 to 0:01:18."
    )
    other = [(15.0, Pause("arm_1")), (78.0, Resume())]
    assert record_wait(tmp_path / "5", 40.0, actions=other).startswith(f"{waits}arm_0 was idle")


def test_a_returned_job_is_late_by_the_reason_of_its_return(tmp_path):
    recorder = record_events(tmp_path / "r", LOG[:1])
    steps = (("awarded", "arm_0", ""), ("waiting", "", "Its arm was paused by 'ann'."))
    for number, (state, arm, reason) in enumerate(steps):
        status = JobStatus("a-1", state, arm=arm, reason=reason, due_s=30.0, release_s=0.0)
        recorder.add("boss", Result("boss", number, 70.0 * number, status))
    recorder.add("m", Alarm("m", 1, 35.0, "7d1f", "silent", "boss does not reply.", "boss", began_s=20.0, ended_s=65.0))
    recorder.write(status="finished")
    log = open_recording(tmp_path / "r")
    assert "boss did not reply from 0:00:20 to 0:01:05: no job was awarded." in verdict(log).sentences
    assert lateness_text(log, late_jobs(log)).endswith("arm_0 returned it at 0:01:10: its arm was paused by 'ann'.")


@pytest.mark.parametrize(("first", "last"), [("one", "two"), ("two", "one")])
def test_the_report_of_two_epochs_shows_the_last_one(tmp_path, first, last):
    """Whatever their names are, and although the recorder was restarted since."""
    recorder = record_events(tmp_path / "r", ())
    for epoch, time_s in ((first, 5.0), (last, 0.0)):
        for number, job in enumerate(("x", "y") if epoch == first else ("z",)):
            status = JobStatus(job, "finished", arm="arm_0")
            recorder.add("boss", Result("boss", number, time_s, status, epoch=epoch))
        recorder.write()
        recorder = Recorder.open(tmp_path / "r", "shop")
    recorder.write(status="finished")
    html = open_recording(tmp_path / "r").page()
    assert f"2 epochs are recorded; this page shows the last one, {last}, without alarms" in html
    assert "<dt>jobs finished</dt><dd>1 of 1</dd>" in html


def test_an_epoch_without_a_result_has_begun_when_most_arms_have_it(tmp_path):
    """After a lost journal an auctioneer publishes nothing before the first job."""
    recorder = record_events(tmp_path / "r", ())
    status = JobStatus("x", "finished", arm="arm_0")
    recorder.add("boss", Result("boss", 0, 5.0, status, epoch="two"))
    for arm, shown in zip(ARMS, ("two", "one"), strict=True):
        add_states(recorder, arm, [""] * 9, epoch="one", first_s=200.0)
        recorder.write()
        assert epochs_of(read_card(tmp_path / "r").senders)[-1] == shown
    log = open_recording(tmp_path / "r")
    assert log.remarks[0].startswith("2 epochs are recorded; this page shows the last one, one,")
    assert log.card["metrics"]["finished"] == 0


def add_states(recorder, arm, jobs, *, epoch="now", first_s=0.0):
    """A state a second of one start of an arm, with these jobs."""
    for tick, job in enumerate(jobs):
        message = State(arm, tick, first_s + tick, "idle", (30.0,) * 7, 30.0, job=job, epoch=epoch)
        recorder.add(arm, message)


@pytest.mark.parametrize("central", [True, False])
def test_one_arm_with_states_of_another_epoch_does_not_empty_the_report(tmp_path, central):
    recorder = Recorder.open(tmp_path, "shop")
    for arm, epoch in (("arm_0", "zzz"), ("arm_1", "now"), ("arm_2", "now")):
        add_states(recorder, arm, [""] * 50, epoch=epoch)
    recorder.add("arm_1", ArmEvent("arm_1", 10**9 + 1, 3.0, "award", "x", epoch="now"))
    recorder.add("arm_1", ArmEvent("arm_1", 10**9 + 2, 9.0, "finish", "x", value=0.0, epoch="now"))
    if central:
        recorder.add("boss", Result("boss", 0, 9.0, JobStatus("x", "finished", arm="arm_1"), epoch="now"))
    recorder.write(status="finished")
    log = open_recording(tmp_path)
    assert log.arms == ("arm_1", "arm_2")
    assert log.card["metrics"]["finished"] == 1
    assert verdict(log).sentences[0] == "arm_0 published states of another epoch, zzz: this page leaves them out."


def test_most_arms_tell_the_last_epoch_without_an_auctioneer(tmp_path):
    """The names of the epochs and the time since their begin do not; an arm is absent since the first one."""
    recorder = Recorder.open(tmp_path, "shop")
    for arm in ("arm_0", "arm_1", "arm_2"):
        add_states(recorder, arm, [""] * 50, epoch="two", first_s=100.0)
    for arm in ("arm_1", "arm_2"):
        add_states(recorder, arm, [""] * 5, epoch="one")
    recorder.write(status="finished")
    log = open_recording(tmp_path)
    assert log.arms == ("arm_1", "arm_2")
    assert log.remarks == (
        "2 epochs are recorded; this page shows the last one, one, without alarms and requests that name no epoch.",
        NO_STATES,
    )


def record_peers(folder, jobs, events=(), actions=()):
    """A log of arms without an auctioneer: states of arm_0 with these jobs, in a list for each of its starts."""
    recorder = Recorder.open(folder, "shop")
    begun_s = 0.0
    for names in jobs:
        add_states(recorder, "arm_0", names, first_s=begun_s)
        begun_s += len(names) + 5.0
    add_states(recorder, "arm_1", [""] * 100)
    for number, (time_s, kind, job, *reason) in enumerate(events, start=1):
        fields = {"value": 0.0} if kind in ("award", "finish") else {"reason": "".join(reason)}
        recorder.add("arm_0", ArmEvent("arm_0", number, time_s, kind, job, epoch="now", **fields))
    for time_s, action in actions:
        operation = Operation("arm_1", time_s, ControlRequest(str(time_s), action, "ann"))
        recorder.add("arm_1", operation, numbered=False)
    recorder.write(status="finished")
    return open_recording(folder)


NEXT_JOB = [(1.0, "award", "x"), (40.0, "award", "y"), (60.0, "finish", "y"), (62.0, "home", "y")]
AT_WORK = [""] + ["x"] * 19
"""States until 20 s."""


@pytest.mark.parametrize(
    ("jobs", "events", "actions", "end_s", "reason"),
    [
        ([AT_WORK + [""] * 80], [], [(12.0, Pause()), (35.0, Resume())], 20.0, "all arms were paused by ann"),
        ([AT_WORK + [""] * 80], [], [(12.0, Cancel("x"))], 20.0, "it was cancelled by 'ann'"),
        ([AT_WORK + [""] * 80], [(15.0, "break", "", "lunch")], [], 20.0, "a break, 'lunch'"),
        ([AT_WORK, [""] * 75], [], [], 19.0, "the arm was restarted"),
        ([AT_WORK], [], [], 19.0, "no later state of the arm is recorded"),
        ([AT_WORK + [""] * 80], [], [(2.0, Cancel("z")), (30.0, Pause())], 20.0, "the reason is not recorded"),
    ],
)
def test_without_an_auctioneer_a_job_is_returned_when_and_why_the_records_tell(
    tmp_path, jobs, events, actions, end_s, reason
):
    """The arm goes on with another job long after that, if it is there."""
    later = NEXT_JOB if len(jobs[-1]) > 20 else NEXT_JOB[:1]
    log = record_peers(tmp_path, jobs, sorted([*later, *events]), actions)
    (back,) = [event for event in log.events if event.kind == "return"]
    assert (back.job, back.time_s, back.reason) == ("x", end_s, reason)
    spans = [(span.job, span.start_s, span.end_s, span.outcome) for span in log.plan.assignments]
    assert spans == [("x", 1.0, end_s, "returned"), ("y", 40.0, 62.0, "finished")][: len(later)]


def test_without_an_auctioneer_a_report_does_not_promise_that_all_went_well(tmp_path):
    """Jobs that no arm began are not recorded; without any job there is none that was in time."""
    log = record_peers(tmp_path, [[""] * 100], NEXT_JOB)
    first = verdict(log)
    assert (first.badge, first.good) == ("No fault, no late job; unknown: jobs that no arm finished", False)
    assert NO_STATES in first.sentences
    card = {"status": "finished", "metrics": {"jobs": 0}}
    assert verdict(dataclasses.replace(log, card=card, unknown="")).badge == "No fault, no job"


@pytest.mark.parametrize("central", [True, False])
def test_jobs_that_were_given_up_are_counted_only_where_their_states_are_published(tmp_path, central):
    recorder = record_events(tmp_path / "r", ())
    if central:
        recorder.add("boss", Result("boss", 0, 5.0, JobStatus("x", "given_up")))
    recorder.write(status="finished")
    log = open_recording(tmp_path / "r")
    counts = {"given_up": 1, "expired": 0, "unfinished": 0}
    html = log.page()
    for state, count in counts.items():
        assert log.card["metrics"][state] == (count if central else None)
        assert f"<td>metrics {state}</td><td>{count if central else ''}</td>" in html


def test_an_end_that_no_state_shows_is_at_the_next_award_and_its_reason_unknown(tmp_path):
    log = record_peers(tmp_path, [[""] * 100], NEXT_JOB)
    assert [(e.time_s, e.reason) for e in log.events if e.kind == "return"] == [(40.0, "the reason is not recorded")]


def test_without_an_auctioneer_a_report_has_what_people_requested(tmp_path):
    """A job that was settled as done is finished, a cancelled one in the report; a changed due date counts."""
    actions = [
        (5.0, Change("y", due_s=50.0)),
        (6.0, Cancel("gone")),
        (7.0, Pause("arm_0")),
        (8.0, Clear("arm_2")),
        (9.0, Settle("x", "done")),
        (10.0, Cancel("y")),
        (11.0, Settle("again", "done")),
        (12.0, Settle("again", "redo")),
    ]
    log = record_peers(tmp_path, [AT_WORK + [""] * 80], NEXT_JOB, actions)
    metrics = log.card["metrics"]
    assert {job.job: job.state for job in log.jobs} == {"gone": "cancelled", "x": "finished", "again": "waiting"}
    assert (metrics["jobs"], metrics["finished"], metrics["tardiness_min"]) == (4, 2, 10.0 / 60.0)
    assert [(late.job, late.late_s) for late in late_jobs(log)] == [("y", 10.0)]
    kinds = [row[1] for row in listed_events(log.page()) if row[4].endswith(", by ann") or row[4] == "by ann"]
    assert kinds == ["change", "cancel", "pause", "clear", "settle", "cancel", "settle", "settle"]


kinds = st.sampled_from(["award", "finish", "home", "fault", "recover", "return", "warning", "moved"])
events = st.builds(
    Event,
    time_s=st.integers(0, 20).map(float),
    kind=kinds,
    arm=st.sampled_from(ARMS),
    job=st.sampled_from(["a", "b", "c"]),
    value=st.sampled_from([0.0, 2.0, float("nan")]),
)


@examples(500)
@given(
    st.lists(events, max_size=30),
    st.lists(events.map(lambda event: dataclasses.replace(event, kind="return")), max_size=6),
)
def test_whatever_was_lost_there_is_a_schedule(log, returns):
    plan = schedule(order_events(log, returns), ARMS, 20.0)
    for arm in ARMS:
        own = [each for each in plan.assignments if each.arm == arm]
        assert all(one.end_s <= two.start_s for one, two in pairwise(own))


def test_a_possible_log_is_left_as_it_is():
    assert schedule(order_events(LOG, ()), ARMS, 100.0) == schedule(LOG, ARMS, 100.0)


def test_the_command_writes_the_page_into_the_recording_which_continues(tmp_path):
    for name in ("r", "s"):
        recorder = record_events(tmp_path / name, LOG)
        recorder.write()  # still going on
        assert call("report", tmp_path / name) == 0
        assert "live recording" in (tmp_path / name / "report.html").read_text(encoding="utf-8")
        assert Recorder.open(tmp_path / name, recorder.fleet).parts == recorder.parts
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r", "s"]
    (tmp_path / "empty").mkdir()
    Recorder.open(tmp_path / "empty", "f")
    with pytest.raises(FleetError, match="no state of an arm"):
        open_recording(tmp_path / "empty").page()


def test_the_offers_behind_an_award_are_kept_listed_and_replayed(tmp_path):
    recorder, result = record_events(tmp_path / "r", LOG), EXAMPLES[Result]
    for name, place in (("a-1", 0), ("b-1", 1)):
        status = structs.replace(result.status, job=name, arm=ARMS[place])
        offers = tuple(structs.replace(offer, arm=arm) for offer, arm in zip(result.offers, ARMS, strict=False))
        offers = offers if place == 0 else (offers[1], structs.replace(offers[0], plan=None))
        recorder.add("boss", structs.replace(result, auctioneer="boss", number=place, status=status, offers=offers))
    recorder.write()
    html = open_recording(tmp_path / "r").page()
    assert "The offers behind 2 awards" in html
    assert "<td>a-1</td><td>arm_0</td><td>P 0.04, 52 °C, d 0.53, 4 min</td>" in html
    assert "<td>arm_0: cannot do it</td>" in html
    replayed = [message for message in open_messages(tmp_path / "r") if isinstance(message, Result)]
    assert [len(message.offers) for message in replayed] == [2, 2]
    assert replayed[0].offers[0].plan == result.offers[0].plan


def test_the_cell_of_a_recording_is_shown_in_three_dimensions(tmp_path):
    """As the auctioneer described it; not for an arm that it does not know, nor with limits that cannot be."""
    recorder = record_events(tmp_path / "r", LOG)
    cell = EXAMPLES[Cell]
    mounts = tuple(structs.replace(cell.arms[0], name=arm, position_m=(0.0, i, 0.0)) for i, arm in enumerate(ARMS))
    for described, shown in (
        (structs.replace(cell, arms=mounts, warning_c=51.0), True),
        (structs.replace(cell, arms=mounts[:1]), False),
        (structs.replace(cell, arms=mounts, warning_c=90.0), False),
    ):
        recorder.cell = described
        recorder.write()
        html = open_recording(tmp_path / "r").page()
        assert ('id="cell-model"' in html) is shown
        if shown:
            model = json.loads(re.search(r'id="cell-model">(.*?)</script>', html)[1])
            assert [(arm["name"], arm["position"]) for arm in model["arms"]] == [
                (arm, [0.0, float(i), 0.0]) for i, arm in enumerate(ARMS)
            ]
            assert [box["name"] for box in model["fixtures"]] == ["table"]
            assert model["heat"]["warning_c"] == 51.0


@pytest.mark.parametrize(
    "damage",
    [lambda content: content[:50], lambda content: content.replace(b"cool again", b"cold again", 1)],
    ids=["cut", "changed"],
)
def test_a_damaged_part_is_an_error_that_names_it(tmp_path, damage):
    """Without a checksum a changed text would be read."""
    record_events(tmp_path / "r", LOG).write()
    part = next((tmp_path / "r").glob("events-*.parquet"))
    content = part.read_bytes()
    part.write_bytes(damage(content))
    assert part.read_bytes() != content
    with pytest.raises(FleetError, match=re.escape(str(part))):
        open_recording(tmp_path / "r").page()


def test_the_rows_of_a_removed_part_are_counted_as_missing(tmp_path):
    """Also in a recording that goes on in another process."""
    first = record_events(tmp_path / "r", LOG)
    first.write()
    again = Recorder.open(tmp_path / "r", "shop")
    again.add("boss", Result("boss", 0, 0.0, JobStatus("x", "waiting")))
    again.write(status="finished")
    assert "parts of the recording were removed" not in open_recording(tmp_path / "r").page()
    part = next((tmp_path / "r").glob("events-*.parquet"))
    number = pq.read_metadata(part).num_rows
    part.unlink()
    assert re.search(
        f"{number} rows of events.*parts of the recording were removed", open_recording(tmp_path / "r").page()
    )


def test_alarms_are_kept_once_in_order_also_of_a_gateway_that_starts_again(tmp_path):
    assert alarms_of(tmp_path) == []
    began = Alarm("gateway", 1, 5.0, "7d1f", "fault", "a is faulted.", "a", 5.0)
    seen = replace(began, number=2, time_s=6.0, by="ann", acknowledged="2026-01-31T09:00:00Z")
    again = Alarm("gateway", 1, 9.0, "8e2a", "sensor", "b has impossible temperatures.", "b", 9.0)
    recorded(tmp_path, began, seen, seen, again, began)  # repeated ones: that the next gateway publishes again
    assert alarms_of(tmp_path) == list(open_messages(tmp_path)) == [began, seen, again]
