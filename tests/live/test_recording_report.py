"""The report of a live recording: equal to that of a run where both know the same, and never impossible."""

import json
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from fleet.bus.protocol.auction import ArmEvent, JobStatus, Result
from fleet.bus.protocol.cell import Cell
from fleet.bus.protocol.contract import EXAMPLES
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import Cancel, Change, ControlRequest, Operation, Pause, Settle
from fleet.errors import FleetError
from fleet.events import Event
from fleet.robot import ThermalLimits
from scenarios.cli.main import main
from scenarios.live.recorder import Recorder
from scenarios.live.recording import read_parts
from scenarios.live.recording_report import heat_use, open_recording, order_events
from scenarios.live.replayer import Replay
from scenarios.run.records import ShiftLog
from scenarios.run.schedule import schedule
from scenarios.show.run_page import report_html
from tests.profiles import examples

ARMS = ("arm_0", "arm_1")


def figure_of(html):
    """The traces of the page's figure."""
    return re.findall(r'"type":"bar".*?"hovertemplate"', html)


LOG = (
    Event(time_s=0.0, kind="award", arm="arm_0", job="a-1", value=0.4),
    Event(time_s=0.0, kind="award", arm="arm_1", job="b-1", value=0.2),
    Event(time_s=30.0, kind="finish", arm="arm_1", job="b-1", value=12.0),
    Event(time_s=31.0, kind="home", arm="arm_1", job="b-1"),
    Event(time_s=40.0, kind="warning", arm="arm_0", job="a-1", joint=2, reason="motor 2 passed 60 °C"),
    Event(time_s=50.0, kind="fault", arm="arm_0", job="a-1", joint=2, reason="motor 2 passed 75 °C"),
    Event(time_s=50.0, kind="return", arm="arm_0", job="a-1", value=3.0, reason="3 of 9 cycles kept"),
    Event(time_s=90.0, kind="recover", arm="arm_0", reason="cool again"),
    Event(time_s=95.0, kind="award", arm="arm_1", job="a-1", value=0.3),
)


def record(folder, events, samples=100):
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
    record(tmp_path / "r", LOG).write(status="finished")
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
    recorder = Recorder.open(tmp_path, "shop")
    for tick in range(61):
        housing = (25.0 + 20.0 * tick / 60.0,) * 7
        state = State(
            arm="hot",
            tick=tick,
            time_s=60.0 * tick,
            mode="idle",
            temp_c=(155.0,) * 7,
            headroom_k=1.0,
            housing_c=housing,
        )
        recorder.add("hot", state)
        recorder.add("bare", State(arm="bare", tick=tick, time_s=60.0 * tick, mode="idle", temp_c=(), headroom_k=1.0))
    recorder.write(status="finished")
    recorder.close()
    found = heat_use(read_parts(tmp_path, "telemetry"), ["hot", "bare"])
    assert found["insulation_ppb"] == {"hot": pytest.approx(1e9 / 20_000.0)}
    assert found["tool_drift_mm"] == {"hot": pytest.approx(1e3 * 23.6e-6 * 20.0 * 1.1878, rel=1e-3)}


def test_a_report_names_missing_messages_and_returned_jobs(tmp_path):
    recorder = record(tmp_path / "r", LOG[:2])
    for number, status in enumerate(
        (("b-1", "awarded", "arm_1"), ("b-1", "waiting", ""), ("b-1", "finished", "arm_0"))
    ):
        job, state, arm = status
        told = JobStatus(job=job, state=state, arm=arm, cycles=2)
        recorder.add("boss", Result(auctioneer="boss", number=2 * number, time_s=20.0 + number, status=told))
    recorder.write(status="finished")
    html = open_recording(tmp_path / "r").page()
    assert "returned to the queue, 2 cycles kept" in html
    assert "results of boss, numbers 1 to 1" in html
    assert "3 recorded, 2 missing" in html


def test_a_report_names_who_asked_for_what(tmp_path):
    recorder = record(tmp_path / "r", LOG[:1])
    recorder.add("boss", Result("boss", 0, 0.0, JobStatus("a-1", "waiting"), by="bob"))
    actions = (Change("a-1", due_s=900.0), Cancel("b-1"), Pause(), Settle("c-1", "redo"))
    for number, action in enumerate(actions):
        recorder.add("boss", Operation("boss", 60.0 * number, ControlRequest(str(number), action, "<ann>"), number))
    recorder.write(status="finished")
    html = open_recording(tmp_path / "r").page()
    rows = re.findall(r"<tr>(.*?)</tr>", html.split("Requests of people</h2>")[1].split("</table>")[0])
    assert [re.findall(r"<td>(.*?)</td>", row) for row in rows[1:]] == [
        ["0:00:00", "change due 900.0", "a-1", "&lt;ann&gt;"],
        ["0:01:00", "cancel", "b-1", "&lt;ann&gt;"],
        ["0:02:00", "pause", "all arms", "&lt;ann&gt;"],
        ["0:03:00", "settle redo", "c-1", "&lt;ann&gt;"],
    ]
    assert "<td>jobs submitted by bob</td><td>1</td>" in html


def test_the_report_of_two_epochs_shows_the_last_one(tmp_path):
    recorder = record(tmp_path / "r", ())
    for epoch, time_s in (("one", 0.0), ("two", 5.0)):
        for number, job in enumerate(("x", "y") if epoch == "one" else ("z",)):
            status = JobStatus(job, "finished", arm="arm_0")
            recorder.add("boss", Result("boss", number, time_s, status, epoch=epoch))
    recorder.write(status="finished")
    html = open_recording(tmp_path / "r").page()
    assert "this page shows the last one, two" in html
    assert "<dt>jobs finished</dt><dd>1<small> of 1</small>" in html


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
@given(st.lists(events, max_size=30), st.lists(events.map(lambda event: replace(event, kind="return")), max_size=6))
def test_whatever_was_lost_there_is_a_schedule(log, returns):
    plan = schedule(order_events(log, returns), ARMS, 20.0)
    for arm in ARMS:
        own = [each for each in plan.assignments if each.arm == arm]
        assert all(one.end_s <= two.start_s for one, two in pairwise(own))


def test_a_possible_log_is_left_as_it_is():
    assert schedule(order_events(LOG, ()), ARMS, 100.0) == schedule(LOG, ARMS, 100.0)


def test_the_command_writes_the_page_beside_the_recording(tmp_path, capsys):
    recorder = record(tmp_path / "r", LOG)
    recorder.save()  # still going on
    with pytest.raises(SystemExit) as code:
        main(["report", str(tmp_path / "r")])
    assert code.value.code == 0
    assert "live recording" in (tmp_path / "report.html").read_text(encoding="utf-8")
    (tmp_path / "empty").mkdir()
    Recorder.open(tmp_path / "empty", "f")
    with pytest.raises(FleetError, match="no state of an arm"):
        open_recording(tmp_path / "empty").page()


def test_the_offers_behind_an_award_are_kept_listed_and_replayed(tmp_path):
    recorder, result = record(tmp_path / "r", LOG), EXAMPLES[Result]
    for name, place in (("a-1", 0), ("b-1", 1)):
        status = structs.replace(result.status, job=name, arm=ARMS[place])
        offers = tuple(structs.replace(offer, arm=arm) for offer, arm in zip(result.offers, ARMS, strict=False))
        offers = offers if place == 0 else (offers[1], structs.replace(offers[0], plan=None))
        recorder.add("boss", structs.replace(result, auctioneer="boss", number=place, status=status, offers=offers))
    recorder.write()
    html = open_recording(tmp_path / "r").page()
    assert "the offers behind 2 awards" in html
    assert "<td>a-1</td><td>arm_0</td><td>P 0.04, 52 °C, d 0.53, 4 min</td>" in html
    assert "<td>b-1</td><td>arm_1</td><td>cannot do it</td>" in html
    replayed = [message for message in Replay.of(tmp_path / "r").messages() if isinstance(message, Result)]
    assert [len(message.offers) for message in replayed] == [2, 2]
    assert replayed[0].offers[0].plan == result.offers[0].plan


def test_the_cell_of_a_recording_is_shown_in_three_dimensions(tmp_path):
    """As the auctioneer described it; not for an arm that it does not know, nor with limits that cannot be."""
    recorder = record(tmp_path / "r", LOG)
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


def test_a_part_that_was_cut_is_named(tmp_path):
    record(tmp_path / "r", LOG).write()
    part = next((tmp_path / "r").glob("events-*.parquet"))
    part.write_bytes(part.read_bytes()[:50])
    with pytest.raises(FleetError, match=re.escape(str(part))):
        open_recording(tmp_path / "r").page()


def test_a_changed_byte_in_a_part_is_an_error_that_names_it(tmp_path):
    """Without a checksum the other word would be read."""
    record(tmp_path / "r", LOG).write()
    part = next((tmp_path / "r").glob("events-*.parquet"))
    content = part.read_bytes()
    assert b"cool again" in content
    part.write_bytes(content.replace(b"cool again", b"cold again", 1))
    with pytest.raises(FleetError, match=re.escape(str(part))):
        open_recording(tmp_path / "r").page()


def test_the_rows_of_a_removed_part_are_counted_as_missing(tmp_path):
    """Also in a recording that goes on in another process."""
    first = record(tmp_path / "r", LOG)
    first.write()
    first.close()
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
