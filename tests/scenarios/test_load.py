"""A scenario file is read, or refused with one sentence that says where and why."""

import datetime
import json
import math
import tomllib
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.errors import ScenarioError
from scenarios.spec.load import library, load, own_seed
from scenarios.spec.parse import override, parse_scenario

FILE = Path("heat.toml")


def small() -> dict[str, Any]:
    """The parsed small scenario, fresh each time."""
    text = (Path(__file__).parent / "conftest.py").read_text(encoding="utf-8")
    return {"name": "heat", **tomllib.loads(text.split('SMALL = """')[1].split('"""')[0])}


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


def told(edit: Callable[[dict[str, Any]], None]) -> str:
    raw = small()
    edit(raw)
    with pytest.raises(ScenarioError) as error:
        parse_scenario(raw, FILE)
    return str(error.value)


WRONG = [
    (put("ambint", 3), "heat.toml: unknown key 'ambint'; did you mean 'ambient'? Allowed: ambient, arms,"),
    (put("arms", 0, "tool", 1), "heat.toml: arms[0]: unknown key 'tool'; did you mean 'tool_kg'? Allowed: "),
    (put("twin", "siz", "quick"), "heat.toml: twin: unknown key 'siz'; did you mean 'size'? Allowed: air_c,"),
    (put("arms", 0, "tool_kg", "heavy"), "heat.toml: arms[0].tool_kg: expected a number, got a text ('heavy')."),
    (put("arms", 1, "tool_kg", -1), "heat.toml: arms[1].tool_kg must be >= 0 and finite (got -1.0)."),
    (put("arms", 0, "position_m", [0, 0]), "heat.toml: arms[0].position_m: expected 3 values, got 2."),
    (put("arms", 0, "position_m", [0, "a", 0]), "arms[0].position_m[1]: expected a number, got a text ('a')."),
    (put("arms", 0, "cooling", "stil_air"), "arms[0].cooling: 'stil_air' is not allowed; did you mean 'still_air'?"),
    (put("arms", 0, "home", "hom"), "heat.toml: arms[0].home 'hom' is no posture; did you mean 'home'? Allowed: home,"),
    (put("arms", 0, "name", "a b"), "heat.toml: arms[0].name must be non-empty, without any of / * $ ? # @ or space"),
    (put("arms", 0, "name", 3), "heat.toml: arms[0].name: expected a text, got a whole number (3)."),
    (drop("arms", 0, "name"), "heat.toml: arms[0]: 'name' is missing."),
    (put("arms", 1, "name", "left"), "heat.toml: arms[1].name: 'left' is given twice; names must be unique."),
    (
        put("arms", 1, "position_m", [-0.45, 0.0, 0.05]),
        "arms[1].position_m: 'right' is 0.05 m from 'left' (arms[0]); bases must be at least 0.2 m apart.",
    ),
    (put("arms", []), "heat.toml: arms: there are no arms; give at least one [[arms]]."),
    (drop("arms"), "heat.toml: arms: there are no arms; give at least one [[arms]]."),
    (put("arms", {"name": "x"}), "heat.toml: arms: expected a list, got a table."),
    (drop("jobs"), "heat.toml: jobs: there are no jobs; give at least one [[jobs]]."),
    (drop("horizon_s"), "heat.toml: 'horizon_s' is missing."),
    (put("horizon_s", -1), "heat.toml: horizon_s must be > 0 and finite (got -1.0)."),
    (put("horizon_s", True), "heat.toml: horizon_s: expected a number, got true or false (true)."),
    (put("horizon_s", datetime.date(2020, 1, 1)), "heat.toml: horizon_s: expected a number, got a date."),
    (put("horizon_s", math.nan), "heat.toml: horizon_s: expected a finite number, got nan."),
    (put("horizon_s", 1e9), "heat.toml: horizon_s must be at most 1000000 times telemetry_interval_s"),
    (put("telemetry_interval_s", 100), "heat.toml: telemetry_interval_s must not exceed decision_interval_s"),
    (put("decision_interval_s", 1e6), "heat.toml: decision_interval_s must not exceed horizon_s (got 1000000.0, "),
    (put("slots", 2.5), "heat.toml: slots: expected a whole number, got a number (2.5)."),
    (put("slots", 0), "heat.toml: slots must be between 1 and 256 (got 0)."),
    (
        put("name", "../up"),
        "heat.toml: name must have 1 to 128 printable characters without / \\ [ ], and no dot or space at the start "
        "(got '../up').",
    ),
    (
        put("places", 0, "position_m", [0.0, math.nan, 0.0]),
        "places[0].position_m[1]: expected a finite number, got nan",
    ),
    (put("places", 1, "name", "bench"), "heat.toml: places[1].name: 'bench' is given twice; names must be unique."),
    (
        put("jobs", 0, "payload_kg", [-1.0]),
        "heat.toml: jobs[0].payload_kg must be between 0 and 10 kg (got -1.0).",
    ),
    (put("jobs", 0, "payload_kg", 1.0), "heat.toml: jobs[0].payload_kg: expected a list, got a number (1.0)."),
    (put("jobs", 0, "value", math.inf), "heat.toml: jobs[0].value: expected a finite number, got inf."),
    (put("jobs", 0, "kind", "hol"), "jobs[0].kind: 'hol' is not allowed; did you mean 'hold'? Allowed: hold, pick_"),
    (
        put("jobs", 0, "places", ["bnch"]),
        "jobs[0].places: no place 'bnch'; did you mean 'bench'? Allowed: bench, shelf.",
    ),
    (
        put("jobs", 1, "places", ["bench"]),
        "jobs[1].places must be two different places, from and to, for a sort (g",
    ),
    (put("jobs", 0, "force_n", 3), "heat.toml: jobs[0].force_n: only a press has a contact force (got 3.0 N)."),
    (put("jobs", 0, "repetitions", [5, 2]), "jobs[0].repetitions must be [fewest, most] (got 5, 2)."),
    (put("jobs", 0, "repetitions", [1, 10**30]), "jobs[0].repetitions must be between 1 and 100000 (got 1"),
    (put("jobs", 0, "dwell_s", 1e7), "jobs[0].dwell_s must be between 0.02 and 3600 s (got 10000000.0)."),
    (
        put("jobs", 0, "due_s", 1e9),
        "heat.toml: jobs: horizon_s plus the longest due_s must be at most 1000000000 s (got",
    ),
    (put("jobs", 0, "after", ["hold"]), "jobs[0].after: there is no stream 'hold' above this one."),
    (put("jobs", 1, "after", ["hol"]), "jobs[1].after: there is no stream 'hol' above this one; did you mean 'hold'?"),
    (drop("jobs", 0, "arrivals"), "heat.toml: jobs[0]: 'arrivals' is missing."),
    (put("jobs", 0, "arrivals", []), "heat.toml: jobs[0].arrivals: expected a table, got a list."),
    (put("jobs", 0, "arrivals", {"kind": "poisson"}), "jobs[0].arrivals: arrivals of kind 'poisson' need 'every_s'."),
    (put("jobs", 0, "arrivals", "count", 0), "heat.toml: jobs[0].arrivals.count must be >= 1 (got 0)."),
    (
        put("jobs", 1, "arrivals", "every_s", 1e-6),
        "heat.toml: jobs: about 1.8e+08 jobs would arrive in a shift; at most 100000 are",
    ),
    (put("jobs", 1, "arrivals", "count", 3), "arrivals of kind 'poisson' take no 'count'; they take every_s, start_s,"),
    (put("jobs", 0, "arrivals", {"kind": "trace"}), "arrivals of kind 'trace' need either 'times_s' or 'file'."),
    (
        put("limits", "warning_c", 90),
        "heat.toml: limits need lower_c < restart_c < warning_c < error_c (got 0.0, 50.0, 90.0, 75.0).",
    ),
    (put("limits", "error_c", 1e308), "heat.toml: limits.error_c must be between -60 and 1000 (got 1e+308)."),
    (put("people", {"contact_s": 0.5}), "heat.toml: people.contact_s must be between 1 and 28800 (got 0.5)."),
    (put("limits", "clear_s", 1e308), "heat.toml: limits.clear_s must be between 0 and 604800 (got 1e+308)."),
    (put("spread", "scale", 1e308), "heat.toml: spread.scale must be between 0 and 10 (got 1e+308)."),
    (put("arms", 0, "tilt_deg", [0, 0, 1e9]), "arms[0].tilt_deg must be between -360 and 360 (got [0.0, 0.0, 1"),
    (put("arms", 0, "wear", 1e9), "heat.toml: arms[0].wear must be between 0 and 10 (got 1000000000.0)."),
    (put("arms", 0, "cooling_factor", 0), "heat.toml: arms[0].cooling_factor must be between 0.01 and 100 (got 0.0)."),
    (
        put("arms", 0, "ambient_offset_k", 1e9),
        "arms[0].ambient_offset_k must be between -50 and 50 (got 1000000000.0).",
    ),
    (
        put("reward", "energy", -1e308),
        "heat.toml: reward.energy must be between -1000000000 and 1000000000 (got -1e+308).",
    ),
    (put("ambient", "points", [[0]]), "heat.toml: ambient.points[0]: expected 2 values, got 1."),
    (put("ambient", "points", [[0, 400]]), "heat.toml: ambient.points must be between -40 and 60 °C (got [400.0])."),
    (put("reward", "faullts", 1), "heat.toml: reward: unknown key 'faullts'; did you mean 'faults'?"),
    (
        put("planning", "speeds", []),
        "heat.toml: planning.speeds must be a non-empty list of shares between 0.05 and 1 (got []).",
    ),
    (
        put("twin", "size", "ful"),
        "heat.toml: twin.size: 'ful' is not allowed; did you mean 'full'? Allowed: full, quick.",
    ),
    (
        put("fixtures", [{"name": "oven", "position_m": [0, 0, 0], "size_m": [1, 0, 1]}]),
        "heat.toml: fixtures[0].size_m must be three lengths between 0.001 and 10 m (got [1.0, 0.0, 1.0]).",
    ),
    (
        put("fixtures", [{"name": "oven", "position_m": [0, 0, 1e9], "size_m": [1, 1, 1]}]),
        "heat.toml: fixtures[0].position_m must be coordinates between -10 and 10 m (got 0.0, 0.0, 1000000000.0); were "
        "millimetres meant?",
    ),
    (
        put("fixtures", [{"name": "oven", "position_m": [0, 0, 1], "size_m": [1, 1, 1], "tilt_deg": [0, 400, 0]}]),
        "heat.toml: fixtures[0].tilt_deg must be between -360 and 360 (got [0.0, 400.0, 0.0]).",
    ),
    (
        put("fixtures", [{"name": "oven", "position_m": [0, 0, i / 10], "size_m": [1, 1, 1]} for i in (1, 3)]),
        "heat.toml: fixtures[1].name: 'oven' is given twice; names must be unique.",
    ),
    (put("fixtures", [{"name": "", "position_m": [0, 0, 1], "size_m": [1, 1, 1]}]), "fixtures[0].name must not be"),
    (put("fixtures", [{"name": "x", "size": 1}]), "heat.toml: fixtures[0]: unknown key 'size'; did you mean 'size_m'?"),
    (
        put("fixtures", [{"name": f"f{i}", "position_m": [0, 0, i / 10], "size_m": [1, 1, 1]} for i in range(65)]),
        "heat.toml: fixtures must be at most 64 (got 65).",
    ),
    (put("spread", "seed", 1.5), "heat.toml: spread.seed: expected a whole number, got a number (1.5)."),
]


@pytest.mark.parametrize(("edit", "sentence"), WRONG, ids=[sentence[:60] for _, sentence in WRONG])
def test_a_wrong_entry_is_told_by_file_place_value_and_what_is_allowed(edit, sentence):
    message = told(edit)
    assert message.startswith("heat.toml: ")
    assert sentence in message
    assert message[-1] in ".?"
    assert not message.endswith("?.")
    assert "`" not in message
    assert "\n" not in message


def test_the_small_scenario_itself_is_right():
    scenario = parse_scenario(small(), FILE)
    assert [arm.name for arm in scenario.arms] == ["left", "right"]
    assert scenario.jobs[0].arrivals.count == 2
    assert scenario.name == "heat"


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


TRACES = [
    (None, "heat.toml: jobs[0].arrivals.file: there is no file '"),
    (b"", "'times.txt' holds no times; give one arrival time in seconds per line."),
    (b"0\n5 s\n", "heat.toml: jobs[0].arrivals.file: line 2 of 'times.txt' is not a number of seconds: '5 s'."),
    (b"0\n5\n3\n", "the times in 'times.txt' must be >= 0 and in order (3.0 s is not)."),
    (b"-1\n", "must be >= 0 and in order (-1.0 s is not)."),
    (b"0\nnan\n5\n", "must be >= 0 and in order (nan s is not)."),
    (b"0\ninf\n", "must be >= 0 and in order (inf s is not)."),
    (b"\xff\xfe\x00", "'times.txt' is not a UTF-8 text file."),
]


@pytest.mark.parametrize(("content", "sentence"), TRACES)
def test_a_missing_or_broken_trace_is_told(tmp_path, content, sentence):
    if content is not None:
        (tmp_path / "times.txt").write_bytes(content)
    raw = small()
    raw["jobs"][0]["arrivals"] = {"kind": "trace", "file": "times.txt"}
    with pytest.raises(ScenarioError) as error:
        parse_scenario(raw, tmp_path / "heat.toml")
    assert sentence in str(error.value)


def test_a_trace_file_lies_beside_its_scenario(tmp_path):
    (tmp_path / "times.txt").write_text("# shift of Monday\n0\n\n12.5\n", encoding="utf-8")
    raw = small()
    raw["jobs"][0]["arrivals"] = {"kind": "trace", "file": "times.txt"}
    assert parse_scenario(raw, tmp_path / "heat.toml").jobs[0].arrivals.times_s == (0.0, 12.5)


def test_an_override_changes_that_field_and_no_other():
    base = parse_scenario(small(), FILE)
    changed = override(base, horizon_s=60, ambient={"points": [(0, 30)]})
    assert changed.horizon_s == 60
    assert changed.ambient.points == ((0.0, 30.0),)
    assert override(changed, horizon_s=base.horizon_s, ambient=base.ambient) == base
    assert override(base) == base


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"horizn_s": 3}, "heat with overrides: unknown key 'horizn_s'; did you mean 'horizon_s'? Allowed: ambient,"),
        ({"horizon_s": -1}, "heat with overrides: horizon_s must be > 0 and finite (got -1.0)."),
        ({"horizon_s": math.inf}, "heat with overrides: horizon_s: expected a finite number, got inf."),
        ({"slots": "a"}, "heat with overrides: slots: expected a whole number, got a text ('a')."),
        ({"slots": object()}, "heat with overrides: expected numbers, texts, lists and tables, got <object object"),
        ({"arms": []}, "heat with overrides: arms: there are no arms; give at least one [[arms]]."),
    ],
)
def test_a_wrong_override_is_told(changes, sentence):
    with pytest.raises(ScenarioError) as error:
        override(parse_scenario(small(), FILE), **changes)
    assert sentence in str(error.value)


def test_the_library_is_what_lies_in_its_folder():
    folder = Path(library()["quickstart"]).parent
    assert set(library()) == {path.stem for path in folder.glob("*.toml")} >= {"quickstart", "heat_wave"}


def test_an_instance_of_the_suite_has_a_seed_of_its_own():
    line = json.loads(resources.files("scenarios.suite").joinpath("test.jsonl").read_text().splitlines()[3])
    assert line["name"] == "test/0003"
    assert own_seed("test/0003") == line["seed"]
    assert own_seed("heat_wave") == own_seed("some/cell.toml") == 0
