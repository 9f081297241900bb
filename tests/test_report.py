"""The report and the page of two runs: files that fetch nothing and cannot be broken by a name."""

import base64
import copy
import gzip
import json
import math
import re
from dataclasses import fields, replace
from html.parser import HTMLParser
from itertools import pairwise
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from plotly.offline import get_plotlyjs

from fleet.events import Event
from fleet.telemetry import Telemetry
from scenarios.run.records import Halt, ShiftLog
from scenarios.show.charts import decimate
from scenarios.show.run_page import (
    LONG_SETTINGS,
    ROWS,
    SETTINGS,
    figure_table,
    other_choices,
    report_html,
    runs_page,
    verdict,
)
from scenarios.show.timeline import shift_charts, stream_of
from scenarios.show.words import duration, offer_text, value_text
from scenarios.spec.options import RunSpec
from tests.recorded_shifts import done, event, log_of, offered, record, shift, telemetry

ARMS = ("arm_0", "arm_1")

HOSTILE = '</script><img src="https://evil.example/x"><b>-001'

RUN: dict[str, Any] = {
    "format": 1,
    "status": "finished",
    "scenario": {"name": "two_arms", "description": "Two arms at work.", "horizon_s": 7200.0},
    "policy": "coolest_first",
    "seed": 3,
    "plant": "profile",
    "bus": "memory",
    "difficulty": "blind",
    "twins": {"arm_0": "blind", "arm_1": "blind"},
    "versions": {"thermofleet": "0.1.0"},
    "metrics": {"jobs": 4, "finished": 2, "value": 3.5, "faults": 1, "peak_c": {"arm_0": 76.5, "arm_1": 41.0}},
}

EVENTS = (
    Event(time_s=0.0, kind="award", arm="arm_0", job="hold-001", value=0.4),
    Event(time_s=0.0, kind="award", arm="arm_1", job=HOSTILE),
    Event(time_s=0.0, kind="lost", arm="arm_1", job="hold-001", reason="another arm claimed it"),
    Event(time_s=300.0, kind="finish", arm="arm_1", job=HOSTILE, value=12.0),
    Event(time_s=310.0, kind="home", arm="arm_1", job=HOSTILE),
    Event(time_s=600.0, kind="warning", arm="arm_0", job="hold-001", joint=2, reason="joint 2 passed 60 °C"),
    Event(time_s=650.0, kind="warning", arm="arm_1", joint=7, reason="joint 7 passed 60 °C"),
    Event(time_s=1200.0, kind="fault", arm="arm_0", job="hold-001", joint=2, reason="joint 2 passed 75 °C"),
    Event(time_s=1200.0, kind="return", arm="arm_0", job="hold-001", value=3.0, reason="3 of 9 cycles kept"),
    Event(time_s=3000.0, kind="recover", arm="arm_0", reason="cool again"),
    Event(time_s=7000.0, kind="award", arm="arm_1", job="hold-001"),
)


def page(
    run: dict[str, Any] = RUN,
    events: tuple[Event, ...] = EVENTS,
    arms: tuple[str, ...] = ARMS,
    readings: Telemetry | None = None,
) -> str:
    readings = telemetry(arms=len(arms)) if readings is None else readings
    return report_html(log_of(readings, arms, events, run))


def held(text: str, key: str) -> str:
    """The text of an element that a script reads."""
    (found,) = re.findall(rf'<script type="text/plain" id="{key}">([^<]*)</script>', text)
    return found


def drawn(text: str, chart: int = 0) -> dict[str, Any]:
    """A chart as the browser would read it from the page: 0 is the work, 1 the temperatures."""
    return json.loads(held(text, f"chart-{chart}"))


def own(text: str) -> str:
    """The page without Plotly's own code, which must be in it once."""
    packed = held(text, "plotly")
    assert gzip.decompress(base64.b64decode(packed)).decode() == get_plotlyjs()
    return text.replace(packed, "")


class Elements(HTMLParser):
    """Every element of a page with its attributes, and the text outside scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.words += data


def test_nothing_is_fetched_and_nothing_is_offered_to_a_server() -> None:
    text = page()
    elements = Elements(own(text))
    for tag, attributes in elements.tags:
        assert tag not in ("link", "iframe", "img", "object")
        assert not {"src", "href", "srcset", "action"} & set(attributes)
    assert "@import" not in own(text)
    (policy,) = [a["content"] for _, a in elements.tags if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy is not None
    assert "default-src 'none'" in policy
    assert "http" not in policy
    assert '"showSendToCloud": false' in text
    assert '"plotlyServerURL": ""' in text


def test_same_input_same_bytes_in_any_order_of_the_log() -> None:
    assert page() == page(copy.deepcopy(RUN), EVENTS[::-1])


@pytest.mark.parametrize("count", [1, 16])
def test_every_arm_has_a_row_and_a_lane_of_seven_motors(count: int) -> None:
    arms = tuple(f"arm_{i}" for i in range(count))
    text = page(events=(), arms=arms, readings=telemetry(50, count))
    assert tuple(drawn(text)["layout"]["yaxis"]["ticktext"]) == arms
    shown = drawn(text, 1)
    names = [note["text"] for note in shown["layout"]["annotations"]]
    for a, arm in enumerate(arms):
        assert f"<b>{arm}</b>" in names
        lane = [t for t in shown["data"] if t.get("yaxis") == f"y{a + 1}"]
        assert [t["legendgroup"] for t in lane] == [f"joint {j}" for j in range(1, 8)]
        assert all(t["showlegend"] == (a == 0) for t in lane)
    domains = [shown["layout"][f"yaxis{i if i > 1 else ''}"]["domain"] for i in range(1, count + 1)]
    assert all(0 <= low < high <= 1 for low, high in domains)
    assert all(upper[0] > lower[1] for upper, lower in pairwise(domains))
    for chart in range(2):
        go.Figure(drawn(text, chart))  # raises on any property or value that Plotly does not know


def test_every_fault_is_marked_in_gantt_lane_and_table() -> None:
    text = page()
    shown = drawn(text)
    go.Figure(shown)
    (marks,) = [t for t in shown["data"] if t.get("name") == "fault"]
    assert marks["x"] == [20.0]  # 1200 s in minutes
    assert "joint 2 passed 75" in marks["customdata"][0]
    lines = [s for s in drawn(text, 1)["layout"]["shapes"] if s.get("xref") == "x" and s["type"] == "line"]
    assert [(s["x0"], s["x1"], s["yref"]) for s in lines] == [(20.0, 20.0, "y1 domain")]
    (block,) = [t for t in shown["data"] if t.get("name") == "out after a fault"]
    assert (block["base"], block["x"], block["y"]) == ([20.0], [30.0], [0])
    assert own(text).count('<tr class="fault"') == 1


def test_the_gantt_shows_each_assignment_where_and_how_it_went() -> None:
    bars = {t["name"]: t for t in drawn(page())["data"] if t["type"] == "bar" and t["x"] != [None]}
    hold = bars["hold"]
    assert (hold["y"], hold["base"]) == ([0, 1], [0.0, round(7000 / 60, 5)])
    assert hold["marker"]["pattern"]["shape"] == ["/", ""]
    assert "returned to the queue after a fault, 3 cycles kept" in hold["customdata"][0]
    assert "still running" in hold["customdata"][1]
    (other,) = [t for name, t in bars.items() if name not in ("hold", "out after a fault")]
    assert "late by 12 s" in other["customdata"][0]


def test_a_hostile_name_stays_text() -> None:
    run = copy.deepcopy(RUN)
    run["scenario"]["name"] = run["scenario"]["description"] = run["policy"] = HOSTILE
    lost = Event(time_s=5.0, kind="lost", arm="arm_1", job=HOSTILE, reason=HOSTILE)
    text = own(page(run, (*EVENTS, lost)))
    elements = Elements(text)
    assert not [tag for tag, _ in elements.tags if tag in ("img", "b")]
    assert elements.words.count(HOSTILE) >= 4  # title, heading, description, table
    assert text.count("<script") == text.count("</script>") == 4
    assert "<" not in held(text, "chart-0") + held(text, "chart-1")
    bars = [t for t in drawn(text)["data"] if t["type"] == "bar"]
    assert not any("<img" in t["name"] or "<img" in "".join(t.get("customdata", [])) for t in bars)


def test_an_interrupted_run_says_so_and_ends_where_it_stopped() -> None:
    events = tuple(e for e in EVENTS if e.time_s < 5000)
    text = page({**RUN, "status": "interrupted"}, events, readings=telemetry(5400))
    assert "Interrupted after 1 h 30 min" in Elements(own(text)).words
    assert drawn(text)["layout"]["xaxis"]["range"] == [0, 90.0]
    assert "Interrupted" not in own(page())


def test_a_run_without_figures_readings_or_events_still_has_a_report() -> None:
    run = {"status": "interrupted", "metrics": {"value": None, "availability": float("nan"), "peak_c": {}}}
    text = page(run, (), readings=telemetry(0))
    assert "unnamed scenario" in text
    assert "No motor reached its error limit" in text
    assert "nan%" not in text
    go.Figure(drawn(text))


def test_figures_at_the_head_come_from_the_metrics() -> None:
    words = re.sub(r"\s+", " ", Elements(own(page())).words)
    for shown in ("jobs finished2 of 4", "value3.5", "faults1", "hottest motor76.5 °C arm_0"):
        assert shown in words
    assert "tardiness" not in words


def test_contacts_are_shown_only_where_there_are_some() -> None:
    reason = "forearm of arm_0 and the floor, 3.0 mm deep"
    touch = Event(time_s=5.0, kind="contact", arm="arm_0", value=3.0, reason=reason)
    hit, clear = (RUN | {"metrics": RUN["metrics"] | {"contacts": count}} for count in (2, 0))
    text = own(page(hit, (*EVENTS, touch)))
    assert '<div class="bad"><dt>contacts</dt><dd>2' in text
    assert '<tr class="contact"' in text
    assert reason in text
    assert "<dt>contacts" not in own(page(clear))


def test_a_long_log_is_cut_from_the_least_serious_end_and_says_by_how_much() -> None:
    lost = tuple(Event(time_s=float(t), kind="lost", arm="arm_1", job="hold-001") for t in range(1000))
    text = own(page(events=(*lost, *EVENTS)))
    assert text.count('<tr class="') == ROWS
    assert (text.count('<tr class="fault"'), text.count('<tr class="warning"')) == (1, 2)
    assert f"{ROWS} of 1006 are listed; left out: {1006 - ROWS} × claim lost" in text
    assert 'class="award"' not in text


def test_breaks_of_many_arms_at_once_are_one_event_with_their_number() -> None:
    arms = tuple(f"arm_{number}" for number in range(30))
    breaks = [
        event(time_s, kind, arm, job="", reason=reason)
        for arm in arms
        for time_s, kind, reason in ((600.0, "break", "for 3 min"), (780.0, "break_end", ""), (900.0, "break", ""))
    ]
    breaks.append(Event(time_s=600.0, kind="break", arm="arm_31", reason="for 5 min"))
    text = own(page(events=tuple(breaks), arms=(*arms, "arm_31")))
    first = "arm_0, arm_1, arm_2, arm_3, arm_4, arm_5 and 24 more"
    rows = re.findall(r'<tr class="break(?:_end)?"[^>]*>(.*?)</tr>', text)
    assert [re.findall("<td>(.*?)</td>", row) for row in rows] == [
        ["0:10:00", "break", first, "", "for 3 min"],
        ["0:10:00", "break", "arm_31", "", "for 5 min"],
        ["0:13:00", "break end", first, "", ""],
        ["0:15:00", "break", first, "", ""],
    ]
    assert "3 × break, 1 × break end." in text


@given(arrays(np.float64, st.integers(1, 400), elements=st.floats(-50, 150) | st.just(np.nan)), st.integers(5, 60))
def test_decimation_keeps_both_extremes_the_ends_a_gap_and_the_limit(value: np.ndarray, limit: int) -> None:
    kept = decimate(value, limit)
    assert len(kept) <= max(limit, 0)
    assert (np.diff(kept) > 0).all()
    assert (kept[0], kept[-1]) == (0, len(value) - 1)
    assert np.isnan(value[kept]).any() == np.isnan(value).any()
    if np.isfinite(value).any():
        assert (np.nanmin(value[kept]), np.nanmax(value[kept])) == (np.nanmin(value), np.nanmax(value))


@pytest.mark.parametrize(("count", "names"), [(8, [f"s{n}" for n in range(8)]), (9, ["hold", "sort"])])
def test_more_streams_than_colours_are_told_apart_by_kind(count: int, names: list[str]) -> None:
    arrivals = {"start_s": 0.0, "times_s": None}
    jobs = [{"name": f"s{n}", "kind": "hold" if n % 2 else "sort", "arrivals": arrivals} for n in range(count)]
    run = RUN | {"scenario": RUN["scenario"] | {"jobs": jobs}}
    arms = tuple(f"arm_{n}" for n in range(count))
    events = tuple(Event(time_s=0.0, kind="award", arm=arm, job=f"s{n}-001") for n, arm in enumerate(arms))
    bars = [trace for trace in drawn(page(run, events, arms=arms))["data"] if trace["x"] != [None]]
    assert [trace["name"] for trace in bars] == names
    assert len({trace["marker"]["color"] for trace in bars}) == len(names)


def test_a_long_name_leaves_room_for_the_figure_and_is_no_template() -> None:
    arms = ("left_" + "W" * 120 + "_1", "%{meta.lane_title}")
    events = (Event(time_s=0.0, kind="award", arm=arms[0], job="q" * 120 + "-001"),)
    shown = drawn(page(events=events, arms=arms))
    assert max(map(len, shown["layout"]["yaxis"]["ticktext"])) < 30
    assert shown["layout"]["yaxis"]["ticktext"][0].startswith("left_WW")
    assert shown["layout"]["yaxis"]["ticktext"][0].endswith("WW_1")
    assert max(len(trace.get("name", "")) for trace in shown["data"]) <= 30
    assert any("q" * 120 in str(trace.get("customdata")) for trace in shown["data"])
    assert "%{meta" not in json.dumps(shown)


def test_a_short_spike_of_a_long_shift_is_drawn() -> None:
    readings = telemetry(28_800, 1)
    readings.temp_c[12_345, 0, 1] = 99.0
    shown = [*shift_charts(log_of(readings, ("a",))).values()][1].figure
    (lane,) = [t for t in shown["data"] if t["name"] == "joint 2"]
    x, y = (np.frombuffer(base64.b64decode(lane[axis]["bdata"]), dtype="<f4") for axis in "xy")
    assert len(x) == len(y) <= 2000
    assert y.max() == 99.0
    assert x[y.argmax()] == pytest.approx(readings.time_s[12_345] / 3600)


def test_a_large_fleet_gets_a_heat_map_and_lanes_of_its_hottest_arms() -> None:
    arms = tuple(f"arm_{i}" for i in range(64))
    readings = telemetry(7200, 64)
    readings.temp_c[:] = np.minimum(readings.temp_c, 79.0)
    readings.temp_c[3000, 41, 5] = 88.0
    _, overview, shown = (chart.figure for chart in shift_charts(log_of(readings, arms)).values())
    lines = [t for t in shown["data"] if t["type"] == "scatter"]
    assert len(lines) == 5 * 7
    assert "arm_41 joint 1" in lines[0]["hovertemplate"]
    (heat,) = overview["data"]
    rows, columns = map(int, heat["z"]["shape"].split(","))
    cells = np.frombuffer(base64.b64decode(heat["z"]["bdata"]), np.uint8).reshape(rows, columns)
    assert rows == len(arms)
    assert np.unravel_index(cells.argmax(), cells.shape)[0] == 41
    assert 20.0 + cells.max() / 2 == pytest.approx(85.0, abs=3.1)  # the scale ends 10 K above the limit
    go.Figure(overview)
    go.Figure(shown)


@pytest.mark.parametrize(
    ("time_s", "text"),
    [
        (0, "0 s"),
        (59.7, "1 min"),
        (90, "1 min 30 s"),
        (150, "2 min 30 s"),
        (3240, "54 min"),
        (3599.8, "1 h"),
        (5430, "1 h 30 min"),
    ],
)
def test_a_duration_below_an_hour_has_its_seconds(time_s: float, text: str) -> None:
    assert duration(time_s) == text


@pytest.mark.parametrize(("job", "stream"), [("sort_parts-001", "sort_parts"), ("a-b-2", "a-b"), ("lonely", "lonely")])
def test_the_stream_of_a_job_stands_before_its_last_dash(job: str, stream: str) -> None:
    assert stream_of(job) == stream


def side(policy, *events, **run):
    card = {"policy": policy, "status": "finished", "time_s": 1000.0, **run}
    return log_of(Telemetry.empty(2), ("arm_a", "arm_b"), events, card)


def page_of(*sides, title="two", sentence="a shift"):
    reports = {each.policy: f"{each.policy}/report.html" for each in sides}
    return runs_page({each.policy: each for each in sides}, title=title, lead=[sentence], reports=reports)


BURNED = side(
    "round_robin",
    event(10.0, "award"),
    event(100.0, "fault", joint=2, reason="joint 2 passed 75 °C"),
    event(100.0, "return", value=1.0),
    event(900.0, "recover", job=""),
)

SPARED = side(
    "wsept", event(20.0, "award", "arm_b"), event(300.0, "finish", "arm_b", value=0.0), event(310.0, "home", "arm_b")
)


def test_each_side_says_what_happened_and_what_became_of_the_job_on_the_other():
    page = page_of(BURNED, SPARED)
    burned, spared = re.findall(r'<section id="run-\d">(.*?)</section>', page, re.S)
    assert re.findall(r'class="status (\w+)"[^>]*>([^<]*)<', page) == [
        ("bad", "round_robin: 1 fault"),
        ("good", "wsept: No fault, no late job"),
    ]
    assert "arm_a stopped during crate, out for 13 min 20 s: the motor of joint 2 passed 75 °C" in burned
    assert "Under wsept, arm_b finished crate at 0:05:00 without a fault." in burned
    assert 'href="round_robin/report.html"' in page
    assert "Under" not in spared
    assert other_choices(BURNED, replace(BURNED)) == ["Under round_robin, crate was not finished."]


def metrics(**changed):
    peaks = {"arm_a": 50.0, "arm_b": 75.0}
    return {
        "finished": 71,
        "value": 150.0,
        "on_time": 69,
        "faults": 1,
        "above_warning_min": 78.55,
        "peak_c": peaks,
    } | changed


def test_two_shifts_are_compared_by_six_figures_and_their_differences():
    better = metrics(finished=79, value=150.5, faults=0, above_warning_min=56.4, peak_c={"arm_a": 69.3, "arm_b": 60.0})
    rows = figure_table({"one": metrics(), "other": better}).rows
    assert [row[1:] for row in rows] == [
        ("71", "79", "+8"),
        ("150", "150.5", "+0.5"),
        ("69", "69", "0"),
        ("1", "0", "−1"),
        ("78.5", "56.4", "−22.1"),
        ("75.0", "69.3", "−5.7"),
    ]
    assert figure_table({"one": {}, "other": {}}).rows == ()
    assert figure_table({"one": {"availability": 0.9734}, "other": {}}).rows == (("availability, %", "97.3", "", ""),)


def test_the_chart_of_two_shifts_has_the_hottest_motor_of_each_and_both_limits():
    readings = [telemetry(samples=60), telemetry(samples=60)]
    readings[1].temp_c[30, 1, 4] = 99.0
    shifts = {
        name: log_of(each, ("a", "b"), (), {"policy": name})
        for name, each in zip(("one", "other"), readings, strict=True)
    }
    page = runs_page(shifts)
    figure = json.loads(held(page, "hottest"))
    for trace, each in zip(figure["data"], readings, strict=True):
        value = np.frombuffer(base64.b64decode(trace["y"]["bdata"]), "<f4")
        np.testing.assert_allclose(value, each.temp_c.max(axis=(1, 2)), atol=1e-4)
    assert figure["data"][1]["customdata"][30] == "b, joint 5"
    assert {shape["y0"] for shape in figure["layout"]["shapes"]} == {60.0, 75.0}
    assert figure["layout"]["yaxis"]["range"][1] > 99.0


def test_names_stay_text():
    odd = '<img src=x onerror="a()">\x1b[2J'
    page = page_of(side(odd, event(1.0, "fault", job=odd, reason=odd)), SPARED, title=odd, sentence=odd)
    assert "<img" not in page
    assert 'onerror="' not in page
    assert "\x1b" not in page
    assert len(re.findall(r'href="[^"<> ]+"', page)) == page.count("href=") == 2


def test_an_empty_list_of_a_card_is_none() -> None:
    assert value_text({"loss": 0.0, "partitions": []}) == "loss 0, partitions none"


def test_the_settings_give_the_seed_of_a_twin_without_a_separator_at_its_end() -> None:
    twin = {"version": "ab12", "seed": "[0, 1]/"}
    text = report_html(shift(card={"twins": {"arm_a": {"version": "d:ab12", "twin": twin}}}))
    assert "version d:ab12, twin version ab12, seed [0, 1]<" in text


def test_the_event_table_has_jobs_that_were_given_up() -> None:
    why = "it waited for hold-000, which expired"
    text = page(events=(Event(time_s=9.0, kind="give_up", arm="", job="hold-001", reason=why),))
    assert f"<td>job given up</td><td></td><td>hold-001</td><td>{why}</td>" in text
    assert "1 × job given up" in text


def test_a_shift_that_ended_with_its_last_job_says_so() -> None:
    for time_s, count in ((670.0, 1), (7200.0, 0)):
        card = {"status": "finished", "time_s": time_s, "scenario": {"horizon_s": 7200.0}}
        sentences = verdict(shift(samples=670, card=card)).sentences
        early = "The shift of 2 h ended after 11 min 10 s, with its last job: all figures are of that time."
        assert sentences.count(early) == count


@pytest.mark.parametrize(("at_s", "why"), [(250.0, "place or space taken"), (350.0, "break"), (950.0, "paused")])
def test_an_offer_names_the_break_or_the_pause_of_its_arm(at_s: float, why: str) -> None:
    events = (event(300.0, "break", job="", value=600.0), event(900.0, "break_end", job=""), *done("a-1", 0.0, 200.0))
    barred = replace(offered("b-1", at_s, 60.0), awarded=False, free=False, p_saturation=0.25)
    offers = (replace(offered("b-1", at_s, 60.0), arm="arm_b"), barred)
    halt = Halt(arm="arm_a", start_s=920.0, end_s=math.inf, reason="arm_a was paused by ann")
    log = shift(*events, event(at_s, "award", "arm_b", "b-1"), offers=offers, halts=(halt,))
    assert f"<td>arm_a: P 0.25, 1 min ({why})</td>" in report_html(log)
    assert offer_text(log.offers_behind("b-1", "arm_b", at_s)[1]).endswith(f"({why})")  # as a trace has it


def test_other_offers_are_ordered_by_what_the_arms_predicted() -> None:
    arms = ("arm_a", "b", "c", "d", "e", "f")
    values = ((True, 0.5, 80.0), (True, 0.25, 60.0), (True, 0.25, 50.0), (True, None, None), (False, None, None))
    others = [
        replace(offered("b-1", 10.0, 60.0), arm=arm, awarded=False, feasible=feasible, p_saturation=p, peak_c=peak_c)
        for arm, (feasible, p, peak_c) in zip(arms[1:], values, strict=True)
    ]
    offers = (offered("b-1", 10.0, 60.0), *others)
    log = shift(event(10.0, "award", "arm_a", "b-1"), samples=100, arms=arms, offers=offers)
    (cell,) = re.findall(r"<td>([^<]*cannot do it)</td>", report_html(log))
    assert [part.partition(":")[0] for part in cell.split("; ")] == ["d", "c", "b", "e", "f"]


def test_the_temperatures_tell_a_failure_from_a_fault() -> None:
    times = ((10.0, "fault"), (99.0, "recover"), (400.0, "failure"), (600.0, "recover"))
    shown = drawn(report_html(shift(*(event(time_s, kind, job="") for time_s, kind in times))), 1)
    lines = [shape for shape in shown["layout"]["shapes"] if shape.get("xref") == "x" and shape["type"] == "line"]
    legend = {trace["name"]: trace["marker"]["color"] for trace in shown["data"] if trace["mode"] == "markers"}
    assert legend == {"out after a fault": lines[0]["line"]["color"], "failed, not by heat": lines[1]["line"]["color"]}
    assert len(set(legend.values())) == 2


def of_card(log: ShiftLog, **card: Any) -> ShiftLog:
    """A shift with changes to its card."""
    return replace(log, card={**log.card, **card})


PLAIN = shift(card={"scenario": {"name": "busy"}, "scenario_hash": "1a", "seed": 3}, jobs=(record("a", 840.0),))


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (PLAIN, "nothing. All have the same jobs."),
        (of_card(PLAIN, scenario_hash="2b"), "content of the scenario. All have the same jobs."),
        (
            of_card(replace(PLAIN, jobs=(record("a", 900.0),)), scenario_hash="2b"),
            "content of the scenario and jobs. They have other jobs: their figures compare no policies.",
        ),
        (
            of_card(PLAIN, scenario={"name": "copy"}, scenario_hash="2b", policy="edd"),
            "scenario and policy. All have the same jobs.",
        ),
        (
            of_card(replace(PLAIN, jobs=(record("a", 840.0), record("b", 840.0))), seed=4),
            "seed and jobs. They have other jobs: their figures compare no policies.",
        ),
        (of_card(PLAIN, code_hash="3c"), "code. All have the same jobs."),
        (of_card(PLAIN, plant="mujoco", bus="zenoh", risk="none"), "risk, plant and bus. All have the same jobs."),
        (of_card(PLAIN, channel={"loss": 0.1}), "channel between the arms. All have the same jobs."),
        (of_card(PLAIN, twins={"arm_a": {"version": "2"}}), "twins. All have the same jobs."),
        (of_card(PLAIN, difficulty="blind", twins={"arm_a": {}}), "predictions. All have the same jobs."),
    ],
    ids=["equal", "an arm was moved", "another table", "another file", "another seed", "another version",
         "another plant", "messages are lost", "other twins", "no twins"],
)  # fmt: skip
def test_runs_have_the_same_jobs_by_their_jobs_and_the_same_scenario_by_its_content(other: ShiftLog, said: str) -> None:
    page = runs_page({"one": replace(PLAIN), "other": replace(other)})
    assert f"The runs differ in {said}" in page


def test_no_setting_of_a_run_is_left_out_of_the_comparison() -> None:
    assert {field.name for field in fields(RunSpec)} <= {*SETTINGS, *LONG_SETTINGS}


def test_jobs_that_finished_at_other_times_are_the_same_jobs() -> None:
    later = replace(PLAIN, jobs=(replace(PLAIN.jobs[0], finished_s=None, state="waiting"),))
    assert "All have the same jobs." in runs_page({"one": PLAIN, "other": later})
