"""A scenario file is read, laid out and loaded with jobs, or refused with one sentence that says where and why."""

import json
import logging
import math
import re
import tomllib
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from fleet.arm.cell import ContactFinder
from fleet.arrivals import Arrivals
from fleet.errors import FleetError, ScenarioError
from fleet.events import Event
from fleet.job import Fixture, Work
from scenarios.prepare.fleet import prepare, prepare_arm
from scenarios.run.shift import run
from scenarios.show.layout import LayoutReport, Reach, describe, layout_parts, layout_report
from scenarios.show.plan import draw_plan
from scenarios.show.run_page import figure_table
from scenarios.spec.jobs import all_works, draw_jobs, rehearsal_works, works_of
from scenarios.spec.load import library, load
from scenarios.spec.options import RunSpec
from scenarios.spec.parse import override, parse_scenario
from scenarios.spec.schema import Ambient, Scenario
from scenarios.table import Table
from tests.scenarios.conftest import SMALL

FILE = Path("heat.toml")


def small() -> dict[str, Any]:
    """The parsed small scenario, fresh each time."""
    return {"name": "heat", **tomllib.loads(SMALL)}


def put(*path_and_value: Any) -> Callable[[dict[str, Any]], None]:
    """An edit: `put("arms", 0, "tool_kg", -1)`."""
    *path, last, value = path_and_value

    def edit(raw: Any) -> None:
        for step in path:
            raw = raw.setdefault(step, {}) if isinstance(raw, dict) else raw[step]
        raw[last] = value

    return edit


def drop(*path: Any) -> Callable[[dict[str, Any]], None]:
    """An edit that takes something out."""

    def edit(raw: Any) -> None:
        for step in path[:-1]:
            raw = raw[step]
        del raw[path[-1]]

    return edit


def oven(**changes: Any) -> list[dict[str, Any]]:
    """A list of one fixture."""
    return [{"name": "oven", "position_m": [0, 0, 1], "size_m": [1, 1, 1], **changes}]


def told(edit: Callable[[dict[str, Any]], None]) -> str:
    raw = small()
    edit(raw)
    with pytest.raises(ScenarioError) as error:
        parse_scenario(raw, FILE)
    return str(error.value)


WRONG = [
    (put("ambint", 3), "unknown key 'ambint'; did you mean 'ambient'? Allowed: ambient, arms,"),
    (put("arms", 0, "tool", 1), "arms[0]: unknown key 'tool'; did you mean 'tool_kg'? Allowed: "),
    (put("arms", 0, "tool_kg", "heavy"), "arms[0].tool_kg: expected a number, got a text ('heavy')."),
    (put("arms", 1, "tool_kg", -1), "arms[1].tool_kg must be >= 0 and finite (got -1.0)."),
    (put("arms", 0, "position_m", [0, 0]), "arms[0].position_m: expected 3 values, got 2."),
    (put("arms", 0, "position_m", [0, "a", 0]), "arms[0].position_m[1]: expected a number, got a text ('a')."),
    (put("arms", 0, "cooling", "stil_air"), "arms[0].cooling: 'stil_air' is not allowed; did you mean 'still_air'?"),
    (put("arms", 0, "home", "hom"), "arms[0].home 'hom' is no posture; did you mean 'home'? Allowed: home,"),
    (put("arms", 0, "name", "a b"), "arms[0].name must be non-empty, without any of / * $ ? # @ or space"),
    (drop("arms", 0, "name"), "arms[0]: 'name' is missing."),
    (put("arms", 1, "name", "left"), "arms[1].name: 'left' is given twice, as in arms[0].name; names must be unique."),
    (put("arms", 1, "position_m", [-0.45, 0.0, 0.05]), "(arms[0]); bases must be at least 0.2 m apart."),
    (drop("arms"), "arms: there are no arms; give at least one [[arms]]."),
    (put("arms", {"name": "x"}), "arms: expected a list, got a table."),
    (drop("jobs"), "jobs: there are no jobs; give at least one [[jobs]]."),
    (drop("horizon_s"), "'horizon_s' is missing."),
    (put("horizon_s", True), "horizon_s: expected a number, got true or false (true)."),
    (put("horizon_s", math.nan), "horizon_s: expected a finite number, got nan."),
    (put("horizon_s", 1e9), "horizon_s must be at most 1000000 times telemetry_interval_s"),
    (put("telemetry_interval_s", 100), "telemetry_interval_s must not exceed decision_interval_s"),
    (
        put("horizon_s", 187.5),
        "horizon_s must be a multiple of decision_interval_s (got 187.5, 10): give 180 or 190.",
    ),
    (put("decision_interval_s", 1e6), "decision_interval_s must not exceed horizon_s (got 1000000.0, "),
    (put("slots", 2.5), "slots: expected a whole number, got a number (2.5)."),
    (put("slots", 0), "slots must be between 1 and 256 (got 0)."),
    (put("name", "../up"), "name must have 1 to 128 printable characters without / \\ [ ], and no dot or space at the"),
    (put("jobs", 0, "places", ["bnch"]), "jobs[0].places: no place 'bnch'; did you mean 'bench'? Allowed: bench,"),
    (put("jobs", 1, "places", ["bench"]), "jobs[1].places must be two different places, from and to, for a sort (g"),
    (put("places", 1, "position_m", [0.0, 0.2, 0.25]), "jobs[1].places: shelf and bench are at one point."),
    (put("jobs", 0, "places", ["bench", ["shelf"]]), "jobs[0].places must be names, or lists of names (got ['bench', "),
    (put("jobs", 0, "places", [["bench"], ["bench"]]), "jobs[0].places must name each alternative once (got [('bench"),
    (put("jobs", 0, "places", [["bench"], ["shlf"]]), "jobs[0].places: no place 'shlf'; did you mean 'shelf'?"),
    (put("jobs", 1, "places", [["bench", "shelf"], []]), "two different places, from and to, for a sort (got none)."),
    (put("jobs", 0, "force_n", 3), "jobs[0].force_n must be 0 or left out: only a press has a contact force (got 3 N"),
    (put("jobs", 0, "repetitions", [5, 2]), "jobs[0].repetitions must be [fewest, most] (got 5, 2)."),
    (put("jobs", 0, "repetitions", [1, 10**30]), "jobs[0].repetitions must be between 1 and 100000 (got 1"),
    (put("jobs", 0, "after", ["hold"]), "jobs[0].after: there is no stream 'hold' above this one."),
    (put("jobs", 1, "after", ["hol"]), "jobs[1].after: there is no stream 'hol' above this one; did you mean 'hold'?"),
    (put("jobs", 0, "arrivals", {"kind": "poisson"}), "jobs[0].arrivals: arrivals of kind 'poisson' need 'every_s'."),
    (put("jobs", 0, "arrivals", "count", 0), "jobs[0].arrivals.count must be >= 1 (got 0)."),
    (put("jobs", 1, "arrivals", "every_s", 1e-6), "jobs: about 1.8e+08 jobs would arrive in a shift; at most 100000"),
    (put("jobs", 1, "arrivals", "count", 3), "arrivals of kind 'poisson' take no 'count'; they take every_s, start_s,"),
    (put("jobs", 0, "arrivals", {"kind": "trace"}), "arrivals of kind 'trace' need either 'times_s' or 'file'."),
    (put("limits", "warning_c", 90), "limits need lower_c < restart_c < warning_c < error_c (got 0.0, 50.0, 90.0, 75."),
    (put("limits", "error_c", 1e308), "limits.error_c must be between -60 and 1000 (got 1e+308)."),
    (put("people", {"contact_s": 0.5}), "people.contact_s must be between 1 and 28800 (got 0.5)."),
    (put("limits", "clear_s", 1e308), "limits.clear_s must be between 0 and 604800 (got 1e+308)."),
    (put("spread", "scale", 1e308), "spread.scale must be between 0 and 10 (got 1e+308)."),
    (put("arms", 0, "tilt_deg", [0, 0, 1e9]), "arms[0].tilt_deg must be between -360 and 360 (got [0.0, 0.0, 1"),
    (put("arms", 0, "wear", 1e9), "arms[0].wear must be between 0 and 10 (got 1000000000.0)."),
    (put("arms", 0, "cooling_factor", 0), "arms[0].cooling_factor must be between 0.01 and 100 (got 0.0)."),
    (put("arms", 0, "ambient_offset_k", 1e9), "arms[0].ambient_offset_k must be between -50 and 50 (got 1000000000.0)"),
    (put("reward", "energy", -1e308), "reward.energy must be between -1000000000 and 1000000000 (got -1e+308)."),
    (put("reward", "faults", 5.0), "reward.faults must be <= 0, as costs are negative (got 5)."),
    (put("ambient", "points", [[0]]), "ambient.points[0]: expected 2 values, got 1."),
    (put("ambient", "points", [[0, 400]]), "ambient.points must be between -40 and 60 °C (got [400.0])."),
    (put("planning", "speeds", []), "planning.speeds must have at least one share of the speed limits (got [])."),
    (put("fixtures", oven(size_m=[1, 0, 1])), "fixtures[0].size_m must be three lengths between 0.001 and 10 m (got"),
    (put("fixtures", oven(position_m=[0, 0, 1e9])), "fixtures[0].position_m must be coordinates between -10 and 10 m"),
    (put("fixtures", oven(tilt_deg=[0, 400, 0])), "fixtures[0].tilt_deg must be between -360 and 360 (got [0.0, 400.0"),
    (put("fixtures", oven(name="")), "fixtures[0].name must not be"),
    (
        put("fixtures", [{"name": f"f{i}", "position_m": [0, 0, i / 10], "size_m": [1, 1, 1]} for i in range(65)]),
        "fixtures must be at most 64 (got 65).",
    ),
]


KELVIN = {"warning_c": 333, "error_c": 348, "restart_c": 323}
WRONG += [
    (put("limits", {"warning_c": 140, "error_c": 167}), "limits.warning_c = 140: is this °F? 140 °F is 60.0 °C. Give"),
    (put("limits", KELVIN), "limits.warning_c = 333: is this kelvin? 333 K is 59.9 °C. Give °C."),
    (put("ambient", "points", [[0, 298.15]]), "ambient.points = 298.15: is this kelvin? 298.15 K is 25.0 °C."),
    (put("twin", "air_c", [293, 303]), "twin.air_c = [293, 303]: is this kelvin? 303 K is 29.9 °C."),
    (put("arms", 1, "tilt_deg", [0, 0, -3.14]), "arms[1].tilt_deg = [0, 0, -3.14]: is this radians? 3.14 rad is 180°."),
    (put("places", 0, "tool_deg", [math.pi, 0, 0]), "places[0].tool_deg = [3.14159, 0, 0]: is this radians?"),
    (put("jobs", 0, "payload_kg", [500, 1500]), "jobs[0].payload_kg = [500, 1500]: is this grams? 1500 g is 1.5 kg."),
    (put("arms", 0, "tool_kg", 900), "arms[0].tool_kg = 900: is this grams? 900 g is 0.9 kg. Give kg."),
    (
        put("fixtures", oven(size_m=[800, 600, 20])),
        "fixtures[0].size_m = [800, 600, 20]: is this millimetres? 800 mm is 0.8 m.",
    ),
    (put("places", 0, "position_m", [400, 50, 200]), "(got 400.0, 50.0, 200.0); were millimetres meant?"),
    (put("clearance_m", -0.01), "clearance_m must be between 0 and 0.2 (got -0.01)."),
    (put("clearance_m", 20), "clearance_m = 20: is this millimetres? 20 mm is 0.02 m."),
    (put("horizon_s", 8), "(got 10.0, 8.0); is horizon_s in hours? 8 h is 28800 s."),
    (put("jobs", [{"tabel": "monday.csv"}]), "jobs[0]: unknown key 'tabel'; did you mean 'table'? Allowed: after,"),
    (put("jobs", 1, "dwell_s", 500), "jobs[1].dwell_s of a sort must be at most 180 s, the time to open or close the "),
    (put("jobs", 0, "numbered", False), "jobs[0].numbered = false is for streams of one job: arrivals with one time"),
    (put("planning", "speeds", [60]), "planning.speeds must be between 0.05 and 1 (got [60.0])."),
    (put("bus", {"loss": 5}), "bus.loss must be 0 to 1 (got 5)."),
]


@pytest.mark.parametrize(("edit", "sentence"), WRONG, ids=[sentence[:50] for _, sentence in WRONG])
def test_a_wrong_entry_is_told_by_file_place_value_and_what_is_allowed(edit, sentence):
    message = told(edit)
    assert message.startswith("heat.toml: ")
    assert sentence in message
    assert message[-1] in ".?"
    assert not message.endswith("?.")
    assert "`" not in message
    assert "\n" not in message


LEAVES = [
    ("horizon_s",),
    ("arms", 0, "position_m"),
    ("jobs", 1, "payload_kg"),
    ("places", 0, "name"),
    ("planning", "elbows"),
]


@given(
    where=st.sampled_from(LEAVES),
    value=st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.lists(st.integers()), st.just({"a": 1})
    ),
)
def test_whatever_stands_in_a_field_gives_a_scenario_or_a_sentence(where, value):
    raw = small()
    put(*where, value)(raw)
    said = "heat.toml: fine"
    try:
        parse_scenario(raw, FILE)
    except ScenarioError as error:
        said = str(error)
    assert said.startswith("heat.toml: ")


BROKEN = [
    (b"horizon_s = ", "bad.toml: not valid TOML: Invalid value (at end of document)."),
    (b"a = 1\na = 2\n", "bad.toml: not valid TOML: Cannot overwrite a value (at line 2"),
    (b"\xff\xfe", "bad.toml: not a UTF-8 text file."),
    (b"", "bad.toml: 'description' is missing."),
]


@pytest.mark.parametrize(("content", "sentence"), BROKEN)
def test_a_file_that_cannot_be_read_is_told(tmp_path, content, sentence):
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(ScenarioError) as error:
        load(path)
    assert sentence in str(error.value)


def test_a_missing_file_and_a_missing_name_are_told_apart(tmp_path):
    with pytest.raises(ScenarioError, match=r"There is no scenario file 'nothing\.toml'\."):
        load("nothing.toml")
    with pytest.raises(ScenarioError, match=r"No scenario 'quikstart'; did you mean 'quickstart'\? Allowed: "):
        load("quikstart")
    with pytest.raises(ScenarioError, match="No scenario"):
        load(tmp_path)
    with pytest.raises(ScenarioError, match="File name too long"):
        load("x" * 5000 + ".toml")


def test_a_byte_order_mark_does_no_harm(tmp_path, small_toml):
    marked = tmp_path / "marked.toml"
    marked.write_bytes(b"\xef\xbb\xbf" + small_toml.read_bytes())
    assert load(marked).arms == load(small_toml).arms


def with_trace(folder: Path, content: bytes, horizon_s: float = 7200.0) -> Scenario:
    """The small scenario with a second stream that arrives as a file says."""
    (folder / "times.txt").write_bytes(content)
    text = SMALL.replace('kind = "poisson", every_s = 30', 'kind = "trace", file = "times.txt"')
    (folder / "cell.toml").write_text(text.replace("horizon_s = 180", f"horizon_s = {horizon_s}"), encoding="utf-8")
    return load(folder / "cell.toml")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_trace_file_lies_beside_its_scenario_and_may_have_a_byte_order_mark(tmp_path, encoding):
    assert with_trace(tmp_path, "# shift of Monday\n0\n\n12.5\n".encode(encoding)).jobs[1].arrivals.times_s == (
        0.0,
        12.5,
    )


TRACES = [
    (b"", "cell.toml: jobs[1].arrivals.file: 'times.txt' holds no times; give one arrival time in seconds per line."),
    (b"0\n5 s\n", "jobs[1].arrivals.file: line 2 of 'times.txt' is not a number of seconds: '5 s'."),
    (b"0\n5\n3\n", "the times in 'times.txt' must be >= 0 and in order (3.0 s is not)."),
    (b"0\nnan\n5\n", "must be >= 0 and in order (nan s is not)."),
    (b"\xff\xfe\x00", "line 1 of 'times.txt' is not a number of seconds"),
    (b"1790000000\n1790000060", "jobs[1].arrivals of 'sort' gives no job: all 2 times are outside the shift"),
    (b"1790000000", "Are these seconds since 1970? The first is 2026-09-21 14:13:20 UTC. Subtract"),
    (b"1790000000000", "its only time is outside the shift, which ends at horizon_s = 7200 (got 1790000000000 to"),
    (b"1790000000000", "Are these milliseconds since 1970? The first is 2026-09-21 14:13:20 UTC."),
    (b"90000\n900000", "Are these milliseconds? 900000 ms is 900 s. Give seconds."),
    (b"7200\n7300", "all 2 times are outside the shift, which ends at horizon_s = 7200 (got 7200 to 7300 s). Give"),
]


@pytest.mark.parametrize(("content", "sentence"), TRACES)
def test_a_trace_that_cannot_be_is_refused_with_what_is_probably_meant(tmp_path, content, sentence):
    with pytest.raises(ScenarioError) as error:
        with_trace(tmp_path, content)
    assert sentence in str(error.value)
    (tmp_path / "times.txt").unlink()
    with pytest.raises(ScenarioError, match=r"jobs\[1\]\.arrivals\.file: there is no file '"):
        load(tmp_path / "cell.toml")


@given(inside=st.lists(st.floats(0, 7199), min_size=3), outside=st.lists(st.floats(7200, 9000)))
def test_the_warning_counts_the_times_that_lie_outside(tmp_path_factory, inside, outside):
    times = sorted([0.0, *inside, 7199.0, *outside])
    with StringIO() as text:
        handler = logging.StreamHandler(text)
        logging.getLogger("scenarios.spec").addHandler(handler)
        with_trace(tmp_path_factory.mktemp("trace"), "\n".join(map(repr, times)).encode())
        logging.getLogger("scenarios.spec").removeHandler(handler)
        expected = f"{len(outside)} of {len(times)} times are outside the shift" if outside else ""
        assert text.getvalue().partition(": ")[2].partition(": ")[2].startswith(expected)
        assert bool(text.getvalue()) == bool(outside)


def test_a_trace_in_minutes_or_partly_in_milliseconds_is_asked_about(tmp_path, caplog):
    ambient = "[ambient]\npoints = [[0, 20], [1, 55], [3, 22]]\n"
    (tmp_path / "cell.toml").write_text(f"{SMALL}\n{ambient}", encoding="utf-8")
    load(tmp_path / "cell.toml")
    assert "cell.toml: ambient.points: the last time is 3. Are these minutes? 3 min is 180 s. Give" in caplog.text
    assert "cell.toml: ambient.points: 55 °C: is this °F? 55 °F is 12.8 °C. Give °C." in caplog.text
    with_trace(tmp_path, b"0\n0.5\n1.9\n")
    assert "Are these hours? 1.9 h is 6840 s. Give seconds." in caplog.text
    with_trace(tmp_path, b"0\n60\n118\n")
    assert "all 3 times are within 118 s of a shift of 7200 s. Are these minutes? 118 min is 7080 s." in caplog.text
    with_trace(tmp_path, b"0\n60000\n118000\n")
    assert "2 of 3 times are outside the shift" in caplog.text
    assert "Are these milliseconds? 118000 ms is 118 s." in caplog.text


@pytest.mark.parametrize(("last", "asked"), [(1, True), (3600, False), (5, False)])
def test_two_ambient_temperatures_in_hours_are_asked_about(tmp_path, caplog, last, asked):
    text = SMALL.replace("horizon_s = 180", "horizon_s = 3600")
    (tmp_path / "cell.toml").write_text(f"{text}\n[ambient]\npoints = [[0, 22], [{last}, 28]]\n", encoding="utf-8")
    load(tmp_path / "cell.toml")
    sentence = "cell.toml: ambient.points: the last time is 1. Are these hours? 1 h is 3600 s. Give seconds."
    assert caplog.messages == ([sentence] if asked else [])


def test_a_run_without_a_job_ends_with_the_reason(thermofleet, small_toml, tmp_path):
    text = small_toml.read_text(encoding="utf-8").replace("every_s = 30", "every_s = 1e6")
    small_toml.write_text(text.replace("count = 2", "count = 2, start_s = 200"), encoding="utf-8")
    assert thermofleet("run", small_toml, "--out", tmp_path / "run").refused(
        "Error: heat, seed 0: no job arrives in this shift of 180 s. Expected numbers: 'hold' 0, 'sort'"
    )
    assert not (tmp_path / "run").exists()


def test_an_override_changes_that_field_and_no_other():
    base = parse_scenario(small(), FILE)
    changed = override(base, horizon_s=60, ambient={"points": [(0, 30)]})
    assert changed.horizon_s == 60
    assert changed.ambient.points == ((0.0, 30.0),)
    assert override(changed, horizon_s=base.horizon_s, ambient=base.ambient) == base
    assert override(base) == base


def test_a_shift_of_many_intervals_that_no_float_holds_exactly_is_accepted():
    scenario = parse_scenario(
        small() | {"horizon_s": 1800.3, "decision_interval_s": 0.3, "telemetry_interval_s": 0.3}, FILE
    )
    assert scenario.ticks == 6001


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"horizn_s": 3}, "heat with overrides: unknown key 'horizn_s'; did you mean 'horizon_s'? Allowed: ambient,"),
        ({"horizon_s": -1}, "heat with overrides: horizon_s must be > 0 and finite (got -1.0)."),
        ({"slots": object()}, "heat with overrides: expected numbers, texts, lists and tables, got <object object"),
        ({"arms": []}, "heat with overrides: arms: there are no arms; give at least one [[arms]]."),
    ],
)
def test_a_wrong_override_is_told(changes, sentence):
    with pytest.raises(ScenarioError) as error:
        override(parse_scenario(small(), FILE), **changes)
    assert sentence in str(error.value)


def cell(*arms, places, clearance_m=0.02, **more):
    jobs = [
        {"name": f"hold_{name}", "kind": "hold", "places": [name], "payload_kg": [1.0], "dwell_s": 2.0, **more}
        | {"arrivals": {"kind": "batch", "count": 1}}
        for name in places
    ]
    raw = {"name": "cell", "description": "A cell.", "horizon_s": 600.0, "arms": list(arms), "jobs": jobs}
    raw |= {"places": [{"name": name, "position_m": list(at)} for name, at in places.items()]}
    return parse_scenario({**raw, "clearance_m": clearance_m, "planning": {"elbows": 1}}, Path("cell.toml"))


def arm(name, x, y, yaw=0.0, **more):
    return {"name": name, "position_m": [x, y, 0.0], "tilt_deg": [0.0, 0.0, yaw], **more}


APART = (arm("west", -0.6, 0.0, home="retract"), arm("east", 0.6, 0.0, 180.0, home="retract"))
TOGETHER = (arm("west", -0.45, 0.0), arm("east", 0.45, 0.0, 180.0), arm("north", 0.0, 0.45, 270.0))
CELLS = [pytest.param(name, marks=() if name == "mixed_fleet" else pytest.mark.slow) for name in sorted(library())]
BESIDE = {"left": (-0.9, 0.3, 0.25), "right": (0.9, 0.3, 0.25)}
PLACES = {"middle": (0.0, 0.0, 0.25), "left": (-0.9, 0.3, 0.25), "moon": (9.0, 0.0, 0.2)}


@pytest.mark.parametrize("name", CELLS)
def test_three_arms_of_every_library_cell_can_work_at_once(name):
    report = layout_report(load(name))
    assert report.problems == ()
    assert len(report.at_once) >= 3
    assert report.excluded_share < 0.3


def test_a_layout_after_a_run_compares_no_motions_and_makes_the_tasks_once(monkeypatch) -> None:
    scenario = cell(*APART, places={**BESIDE, "middle": PLACES["middle"]})
    prepare(scenario, difficulty="blind")
    made = list[Scenario]()

    def works(scenario: Scenario) -> tuple[Work, ...]:
        made.append(scenario)
        return all_works(scenario)

    def compare(*_: object) -> bool:
        raise AssertionError("compared anew")

    monkeypatch.setattr("scenarios.show.layout.all_works", works)
    monkeypatch.setattr("fleet.arm.clearance.conflict", compare)
    assert len(layout_report(scenario).reach) == 2 * 3
    assert len(made) == 1


def test_a_large_layout_names_the_first_reasons_and_counts_the_others() -> None:
    scenario = load("quickstart")
    names = [place.name for place in scenario.places]
    reach = [
        Reach(arm=arm.name, place=name, payload_kg=None, lacks_m=0.0, reason="too far")
        for arm in scenario.arms
        for name in names
    ] * 9
    report = LayoutReport(
        scenario=scenario.name,
        clearance_m=0.1,
        reach=tuple(reach),
        exclusions=(),
        excluded_share=0.0,
        at_once=(),
        largest=True,
        problems=(),
    )
    places, reasons, *_ = layout_parts(scenario, report)
    assert isinstance(places, Table)
    assert isinstance(reasons, Table)
    assert places.rows == tuple((name, "none") for name in names)
    assert len(reasons.rows) == 12
    assert reasons.notes == (f"… and {len(reach) - 12} more; --json has all.",)


def test_a_description_has_the_streams_before_the_first_rows_of_a_job_table(tmp_path) -> None:
    """Of the jobs: one stream and 300 rows of a table, which is named before the stream. And 30 breaks."""
    lines = ["name,kind,places,payload,repetitions,release,due"]
    lines += [f"part_{number},hold,bench,0.5,1,0,900" for number in range(300)]
    (tmp_path / "parts.csv").write_text("\n".join(lines), encoding="utf-8")
    raw = small()
    raw["jobs"] = [{"table": "parts.csv"}, {**raw["jobs"][0], "name": "stream"}]
    raw["breaks"] = [{"name": f"break_{n}", "begin_s": 1.0 * n, "end_s": n + 90.0} for n in range(30)]
    head, _, jobs, _ = describe(parse_scenario(raw, tmp_path / "heat.toml"))
    assert isinstance(jobs, Table)
    assert [name for name, _ in jobs.rows] == ["stream", *(f"part_{number}" for number in range(11))]
    assert jobs.notes == ("… and 289 more; --json has all.",)
    assert str(head).count("\nbreak 'break_") == 12
    assert str(head).endswith("\n… and 18 more; --json has all.")


@pytest.mark.parametrize("name", [cell for cell in CELLS if cell.values != ("scale_64",)])
def test_the_largest_set_is_the_one_that_trying_all_finds(name):
    scenario = load(name)
    fleet = prepare(scenario, difficulty="blind")
    choices = []
    for each in fleet.arms:
        plans = [variants[0] for variants in each.plans.values()] + [v[-1] for v in each.plans.values()]
        volumes, conflicts = fleet.space.rows(plans)
        choices.append([None, *dict.fromkeys(zip(volumes.tolist(), (p.work.stations for p in plans), strict=True))])
    most = 0
    for chosen in product(*choices):
        work = [c for c in chosen if c is not None]
        if len(work) > most and not any(
            conflicts[a, b] or set(one) & set(other) for (a, one), (b, other) in combinations(work, 2)
        ):
            most = len(work)
    assert len(layout_report(scenario).at_once) == most


def test_a_work_that_comes_too_close_to_a_home_is_infeasible_and_says_so():
    beside = arm("beside", 0.05, -0.5, 90.0)
    places = {"middle": PLACES["middle"], "left": PLACES["left"]}
    fleet = prepare(cell(APART[0], beside, places=places), difficulty="blind")
    (error,) = (each for each in fleet.infeasible if each.arm == "west")
    assert error.place == "middle"
    assert "beside (" in error.reason
    assert error.reason.endswith(") at home")
    alone = prepare(cell(APART[0], places=places), difficulty="blind")
    assert alone.infeasible == ()


@pytest.mark.ci_slow
def test_clearance_changes_the_space():
    scenario = load("quickstart")
    shares = []
    for clearance_m in (0.0, 0.02, 0.06):
        fleet = prepare(replace(scenario, clearance_m=clearance_m), difficulty="blind")
        plans = [variants[0] for each in fleet.arms for variants in each.plans.values()]
        volumes, conflicts = fleet.space.rows(plans)
        shares.append(conflicts[np.ix_(volumes, volumes)].mean())
    assert shares == sorted(shares)
    assert shares[0] < shares[-1]


def test_problems_are_reported_all_at_once_and_drawn_with_the_distance_that_lacks(tmp_path):
    scenario = cell(*TOGETHER, places=PLACES)
    with pytest.raises(ScenarioError) as error:
        prepare(scenario, difficulty="blind")
    lines = str(error.value).splitlines()
    assert [line for line in lines if "at home 'west' (" in line and "'east' (" in line]
    assert [line for line in lines if "at home 'west' (" in line and "'north' (" in line]
    assert [line for line in lines if "no arm can do 'hold_moon'" in line]
    with pytest.raises(FleetError, match="at home 'west'"):
        prepare_arm(scenario, "west", difficulty="blind")
    report = layout_report(scenario)
    assert list(report.problems) == lines
    lacks_m = {(each.arm, each.place): each.lacks_m for each in report.reach}
    assert lacks_m["east", "moon"] == pytest.approx(np.hypot(9.0 - 0.45, 0.2 - 0.28481) - 0.902575)
    reasons = {(each.arm, each.place): each.reason for each in report.reach if each.lacks_m is None}
    assert "at home" in reasons["west", "middle"]
    assert not any(reason.startswith("reach") and "wrist" not in reason for reason in reasons.values())
    draw_plan(tmp_path / "cell.png", scenario, report)
    assert (tmp_path / "cell.png").read_bytes().startswith(b"\x89PNG")


def test_a_scenario_in_which_no_job_arrives_says_so():
    scenario = cell(APART[0], places={"left": BESIDE["left"]})
    (stream,) = scenario.jobs
    rare = replace(scenario, jobs=(replace(stream, arrivals=Arrivals(kind="poisson", every_s=1e9)),))
    assert "of the arms can do a job" in str(describe(scenario)[0])
    assert "\nNo job arrives in the shifts of 5 seeds: " in str(describe(rare)[0])
    assert "of the arms can do a job" not in str(describe(rare)[0])


def test_the_hour_that_occurs_twice_has_its_zone():
    scenario = cell(APART[0], places={"left": BESIDE["left"]})
    (stream,) = scenario.jobs
    begin = {"shift_begin": "2026-10-25T01:00+02:00", "time_zone": "Europe/Berlin", "horizon_s": 14_400.0}
    night = replace(
        scenario, **begin, jobs=(replace(stream, arrivals=Arrivals(kind="trace", times_s=(4500.0, 8100.0, 11_700.0))),)
    )
    told = " ".join(map(str, describe(night)))
    assert "3 at Sun 25 Oct 02:15 CEST, Sun 25 Oct 02:15 CET, Sun 25 Oct 03:15" in told


def test_names_in_the_picture_of_a_long_row_cover_no_other_name_or_have_numbers(tmp_path, monkeypatch) -> None:
    """30 arms and 60 places in a row of 19 m: all arms have their names, and the places names or numbers."""
    xs_m = np.linspace(-9.5, 9.5, 30).tolist()
    arms = [arm(f"arm_{n}", x, 0.0, 90.0) for n, x in enumerate(xs_m)]
    places = {f"left_{n}": (x - 0.12, 0.45, 0.25) for n, x in enumerate(xs_m)}
    scenario = cell(*arms, places={**places, **{f"right_{n}": (x + 0.12, 0.45, 0.25) for n, x in enumerate(xs_m)}})
    reach = tuple(
        Reach(arm=one.name, place=at.name, payload_kg=1.0, lacks_m=0.0)
        for one in scenario.arms
        for at in scenario.places
    )
    empty = {"exclusions": (), "at_once": (), "problems": ()}
    report = LayoutReport(scenario="a", clearance_m=0.0, reach=reach, excluded_share=0.0, largest=True, **empty)
    figures = list[Figure]()
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    draw_plan(tmp_path / "row.png", scenario, report)
    notes = [text for text in figures[0].axes[0].texts if text.get_text()]
    boxes = [note.get_window_extent() for note in notes]
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    names = [note.get_text() for note in notes]
    assert {each.name for each in scenario.arms} <= {*names}
    (key,) = (text.get_text() for text in figures[0].texts if text.get_text())
    below = dict(reversed(each.split(" ")) for each in key.replace("\n", " ").split(", "))
    at_m = {place.name: place.position_m[:2] for place in scenario.places}
    assert {*names} == {*at_m, *(each.name for each in scenario.arms)} - {*below} | {*below.values()}
    assert 0 < len(below) < 60
    assert all(note.xy == at_m[name] for note in notes for name, number in below.items() if note.get_text() == number)


@pytest.mark.filterwarnings("error")  # matplotlib's, that the names leave no room for the figure
def test_the_picture_of_a_cell_has_room_for_long_names(tmp_path):
    arms = [dict(each, name=f"{each['name']}{'_' * 50}") for each in APART]
    scenario = cell(*arms, places={"a" * 54: (0.0, 0.0, 0.25), "b" * 54: (0.0, 0.12, 0.25)})
    report = layout_report(scenario)
    assert report.exclusions
    draw_plan(tmp_path / "cell.png", scenario, report)


@pytest.mark.ci_slow
def test_the_command_shows_the_cell_and_fails_if_there_are_problems(tmp_path, thermofleet):
    picture = tmp_path / "new" / "cell.png"
    code, out, _ = thermofleet("layout", "quickstart", "--out", picture)
    assert code == 0
    assert "At most 4 of 4 arms can work at once" in out
    assert "Table(" not in out
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert thermofleet("layout", "quickstart", "--out", picture).refused("overwrite")
    code, out, _ = thermofleet("layout", "quickstart", "--json")
    shown = json.loads(out)
    assert (code, shown["problems"], len(shown["at_once"])) == (0, [], 4)
    text = Path(library()["quickstart"]).read_text(encoding="utf-8").replace('home = "retract"', "")
    file = tmp_path / "near.toml"
    file.write_text(text.replace("[-0.58, -0.42", "[-0.4, -0.42").replace("[0.58, -0.42", "[0.4, -0.42"))
    assert thermofleet("layout", file).refused("Error: near.toml: arms: at home 'arm_0' (")


def test_the_layout_of_a_file_with_wrong_jobs_shows_its_cell(small_toml, tmp_path, thermofleet):
    file, picture = tmp_path / "typo.toml", tmp_path / "cell.png"
    text = small_toml.read_text(encoding="utf-8")
    file.write_text(re.sub(r"^places = \[.*\]$", 'places = ["nowhere"]', text, count=1, flags=re.MULTILINE))
    said = thermofleet("layout", file, "--out", picture)
    assert (said.code, picture.exists()) == (2, True)
    (line,) = said.err.split("Error: ")[1:]
    assert "no place 'nowhere'" in line
    assert line.rstrip().endswith("Only arms, places and fixtures are shown, with a hold at each place.")
    file.write_text(re.sub(r"^position_m = .*$", 'position_m = "x"', text, count=1, flags=re.MULTILINE))
    assert "position_m: expected a list" in thermofleet("layout", file).err


def test_stations_side_by_side_are_for_one_arm_at_a_time():
    close = {"middle": (0.0, 0.0, 0.25), "beside": (0.0, 0.12, 0.25)}
    report = layout_report(cell(*APART, places=close))
    assert len(report.at_once) == 1
    (pair, *_) = [pair for pair in report.exclusions if not pair.same_place]
    assert (set(pair.jobs), pair.share) == ({"hold_middle", "hold_beside"}, 1.0)
    apart = layout_report(cell(*APART, places=BESIDE))
    assert (len(apart.at_once), apart.excluded_share, apart.exclusions) == (2, 0.0, ())


def test_an_arm_that_never_settles_at_home_is_a_problem_of_the_cell():
    unventilated = cell(APART[0] | {"cooling_factor": 0.01}, APART[1], places=BESIDE)
    (problem,) = layout_report(unventilated).problems
    assert problem.startswith("cell.toml: arms[0]: Arm 'west' has no steady state when idle at home")
    assert layout_report(replace(unventilated, start="cold")).problems == ()


def test_an_arm_that_can_do_no_job_is_a_problem_with_its_reasons():
    alone = cell(*APART, places={"left": BESIDE["left"]})
    problem = (
        "cell.toml: arms[1]: 'east' can do no job (left: reach: 1.55 m from the base of the arm); move the arm or the "
        "places, give it jobs, or leave it out."
    )
    assert layout_report(alone).problems == (problem,)
    with pytest.raises(ScenarioError) as error:
        prepare(alone, difficulty="blind")
    assert str(error.value) == problem


def test_a_shift_that_begins_below_the_lower_limit_is_a_problem_of_the_cell():
    cold = replace(cell(*APART, places=BESIDE), ambient=Ambient(points=((0.0, -5.0),)))
    first, second = layout_report(replace(cold, start="cold")).problems
    assert first.startswith("cell.toml: arms[0]: a motor of 'west' begins at -")
    assert "°C, below limits.lower_c (0 °C); give it warmer air, or begin with" in first
    assert second.startswith("cell.toml: arms[1]")
    assert layout_report(cold).problems == ()  # powered for hours, its idle heat keeps every motor above 0 °C


def drawn(scenario: Scenario, seed: int):
    return draw_jobs(scenario, np.random.SeedSequence(seed))


def with_stream(scenario: Scenario, index: int, **changes) -> Scenario:
    streams = list(scenario.jobs)
    streams[index] = replace(streams[index], **changes)
    return replace(scenario, jobs=tuple(streams))


def test_jobs_come_in_order_of_release_and_every_one_is_one_its_stream_asks_for(scenario):
    streams = {stream.name: stream for stream in scenario.jobs}
    for seed in range(20):
        jobs = drawn(scenario, seed)
        times = [job.release_s for job in jobs]
        assert times == sorted(times)
        assert 0 <= times[0] <= times[-1] < scenario.horizon_s
        assert len({job.name for job in jobs}) == len(jobs)
        for job in jobs:
            stream = streams[job.name.rsplit("-", 1)[0]]
            low, high = stream.repetitions
            assert low <= job.repetitions <= high
            assert job.work in works_of(scenario, stream)
            assert job.due_s == job.release_s + stream.due_s
            assert job.value == stream.value


def test_payloads_and_repetitions_are_drawn_evenly(scenario):
    """Against the binomial and uniform laws at four standard deviations."""
    many = with_stream(scenario, 1, arrivals=Arrivals(kind="batch", count=3000))
    jobs = [job for job in drawn(many, 0) if job.name.startswith("sort")]
    light = sum(job.work.payload_kg == 0.2 for job in jobs)
    assert abs(light - 1500) < 4 * np.sqrt(3000 / 4)
    for repetitions in (1, 2, 3):
        count = sum(job.repetitions == repetitions for job in jobs)
        assert abs(count - 1000) < 4 * np.sqrt(3000 * (1 / 3) * (2 / 3))


def test_a_further_stream_disturbs_none_of_the_others(scenario):
    further = replace(scenario, jobs=(*scenario.jobs, replace(scenario.jobs[1], name="more")))
    before, after = drawn(scenario, 5), drawn(further, 5)
    assert set(before) == {job for job in after if not job.name.startswith("more")}
    assert before != drawn(scenario, 4)


def test_a_stream_after_another_waits_for_the_job_of_the_same_number(scenario):
    chained = with_stream(scenario, 1, after=("hold",), arrivals=Arrivals(kind="batch", count=3))
    after = {job.name: job.after for job in drawn(chained, 0)}
    assert after["sort-001"] == ("hold-001",)
    assert after["sort-002"] == ("hold-002",)
    assert after["sort-003"] == ()  # there are only two holds


def test_works_are_one_per_payload_and_all_are_rehearsed_with_light_payloads_too(scenario):
    assert [(work.kind, work.payload_kg) for work in all_works(scenario)] == [
        ("hold", 2.0),
        ("sort", 0.2),
        ("sort", 0.5),
    ]
    doubled = with_stream(scenario, 0, payload_kg=(2.0, 2.0))
    assert all_works(doubled) == all_works(scenario)
    rehearsed = {(work.kind, work.payload_kg) for work in rehearsal_works(scenario)}
    light = {(kind, kg) for kind in ("hold", "sort") for kg in scenario.twin.payload_kg}
    assert rehearsed == light | {(work.kind, work.payload_kg) for work in all_works(scenario)}


def test_all_arms_whose_home_is_inside_a_fixture_are_named(scenario, tmp_path):
    beam = Fixture(name="beam", position_m=(0.0, 0.0, 0.4), size_m=(2.0, 0.1, 0.3))
    with pytest.raises(ScenarioError) as error:
        prepare(replace(scenario, fixtures=(beam,)), difficulty="blind", cache=tmp_path)
    said = str(error.value).splitlines()
    for arm, line in zip(("arms[0] 'left'", "arms[1] 'right'"), said, strict=False):
        assert f"{arm} at home: " in line
        assert "mm inside the fixture 'beam'; move the arm or the fixture" in line


@pytest.mark.parametrize("plant", ["profile", "mujoco"])
def test_contacts_are_counted_by_the_plant_that_finds_them(scenario, plans, plant, monkeypatch):
    """One contact in every step, made up."""
    touch = Event(time_s=1.0, kind="contact", arm="left", value=3.0)
    monkeypatch.setattr(ContactFinder, "events", lambda *_: [touch])
    fleet = prepare(override(scenario, horizon_s=60.0), difficulty="blind", cache=plans)
    result = run(fleet, RunSpec(policy="round_robin", plant=plant, bus="memory", difficulty="blind"), record=False)
    steps = 6 if plant == "mujoco" else 0
    assert result.metrics.contacts == (steps or None)
    assert result.events.count(touch) == steps
    figures = [row[0] for row in figure_table({"round_robin": result.card["metrics"]}).rows]
    assert ("contacts" in figures) == (plant == "mujoco")
