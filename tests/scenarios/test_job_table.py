"""A job table gives the jobs of its rows, in any common file format, or all its errors with row and column."""

import csv
import io
import re
import time
import tomllib
from datetime import UTC, datetime, timedelta, timezone
from datetime import time as clock
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.errors import FleetError, ScenarioError
from fleet.job import Job
from scenarios.extras import MissingExtra
from scenarios.live.auctioneer import job_spec
from scenarios.live.requests import read_jobs
from scenarios.prepare.fleet import prepare
from scenarios.run.shift import run
from scenarios.spec.job_table import read_job_table
from scenarios.spec.jobs import draw_jobs
from scenarios.spec.load import library, load
from scenarios.spec.parse import parse_scenario, scenario_hash
from scenarios.spec.schema import Scenario
from tests.scenarios.conftest import SMALL

SHORT = "name,kind,places,payload,repetitions,release,due,hard,value,after"
HEAD = (*SHORT.split(","), "dwell", "force")
ROWS = ["load 1,sort,shelf > bench,0.2,3,0,60,yes,2,", "hold 1,hold,bench | shelf,2,1,0:01,,,,load 1"]


DOCS = Path(__file__).parents[2] / "docs"


def cells_of(job: Job) -> tuple[str, ...]:
    """The row of a job, as a person would write it."""
    works = " | ".join(" > ".join(place.name for place in work.places) for work in job.works)
    work, hard = job.work, "yes" if job.expires else "no"
    numbers = (work.payload_kg, job.repetitions, job.release_s, job.due_s)
    rest = (hard, repr(job.value), " | ".join(job.after), repr(work.dwell_s), repr(work.force_n))
    return (job.name, work.kind, works, *map(repr, numbers), *rest)


def write(path: Path, rows: list[tuple[str, ...]], delimiter: str = ",", encoding: str = "utf-8") -> None:
    if delimiter != ",":
        rows = [tuple(cell.replace(".", ",") if cell[:1].isdigit() else cell for cell in row) for row in rows]
    text = io.StringIO()
    csv.writer(text, delimiter=delimiter).writerows([HEAD, *rows])
    path.write_bytes(text.getvalue().encode(encoding))


def with_table(path: Path, scenario: str, table: str, more: str = "") -> Scenario:
    """The scenario of a text, with a table instead of its streams."""
    streams = scenario.split("[[jobs]]")
    tail = "\n[planning]" + scenario.split("[planning]")[1] if "[planning]" in scenario else ""
    path.write_text(f'{more}\n{streams[0]}\n[[jobs]]\ntable = "{table}"\n{tail}', encoding="utf-8")
    return load(path)


def small_table(folder: Path, text: str, more: str = "") -> Scenario:
    (folder / "jobs.csv").write_text(text, encoding="utf-8")
    return with_table(folder / "cell.toml", SMALL, "jobs.csv", more)


def drawn(scenario: Scenario, seed: int) -> tuple[Job, ...]:
    return draw_jobs(scenario, np.random.SeedSequence(seed))


def errors_of(folder: Path, text: str, more: str = "") -> str:
    with pytest.raises(ScenarioError) as error:
        small_table(folder, text, more)
    return str(error.value)


FORMATS = [(",", "utf-8"), (";", "utf-8-sig"), ("\t", "utf-16"), ("|", "utf-16"), (";", "cp1252")]


@given(seed=st.integers(0, 2**32), name=st.sampled_from(["quickstart", "assembly"]), form=st.sampled_from(FORMATS))
def test_a_table_written_from_the_jobs_of_streams_gives_the_same_jobs(tmp_path_factory, seed, name, form):
    folder = tmp_path_factory.mktemp("table")
    jobs = drawn(load(name), seed)
    if form[0] == "|" and any("|" in cell for job in jobs for cell in cells_of(job)):
        form = FORMATS[0]
    write(folder / "jobs.csv", [cells_of(job) for job in jobs], *form)
    text = library()[name].read_text(encoding="utf-8")
    assert drawn(with_table(folder / "cell.toml", text, "jobs.csv"), seed + 1) == jobs


BEGIN = datetime(2026, 11, 23, 6, 0, tzinfo=timezone(timedelta(hours=1)))


@given(seconds=st.integers(0, 86_399), hours=st.integers(-12, 12))
def test_seconds_clock_times_and_dates_in_any_zone_name_one_moment(tmp_path_factory, seconds, hours):
    folder = tmp_path_factory.mktemp("times")
    moment = BEGIN + timedelta(seconds=seconds)
    forms = [
        str(seconds),
        moment.strftime("%H:%M:%S"),
        moment.replace(tzinfo=None).isoformat(),
        moment.astimezone(timezone(timedelta(hours=hours))).isoformat(),
        moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
    ]
    rows = [f"job {i},hold,here,,,{form},,,," for i, form in enumerate(forms)]
    (folder / "jobs.csv").write_text("\n".join([SHORT, *rows]), encoding="utf-8")
    assert {job.release_s for job in read_job_table(folder / "jobs.csv", begin=BEGIN).values()} == {float(seconds)}


def test_the_begin_of_the_shift_is_a_date_of_toml_or_a_text(tmp_path):
    text = f"{SHORT}\na,hold,bench,,,2026-11-23T05:01Z,,,,\n"
    for begin in ("2026-11-23T06:00:00+01:00", '"2026-11-23T06:00+01:00"'):
        assert drawn(small_table(tmp_path, text, f"shift_begin = {begin}"), 0)[0].release_s == 60.0
    for begin in ("2026-11-23T06:00:00", '"Monday"', "6"):
        told = errors_of(tmp_path, text, f"shift_begin = {begin}")
        assert "cell.toml: shift_begin must be a date with time and zone, as 2026-11-23T06:00+01:00 (got" in told


@pytest.mark.parametrize(
    ("rows", "jobs"),
    [
        (["a,hold,bench,,,0:02,,,,", "b,hold,bench,,,0:01:30.5,,,,"], [("b", (), 90.5), ("a", (), 120.0)]),
        (["[A] 1/2,hold,bench,,,,,,,", "b,hold,shelf,,,,,,,[A] 1/2"], [("[A] 1/2", (), 0.0), ("b", ("[A] 1/2",), 0.0)]),
        (["4711,hold,bench,,,,,,,", "4711-100,hold,bench,,,,,,,"], [("4711", (), 0.0), ("4711-100", (), 0.0)]),
        (['"A,2",hold,bench,,,,,,,', 'b,hold,shelf,,,1,,,,"A,2"'], [("A,2", (), 0.0), ("b", ("A,2",), 1.0)]),
        (
            ["a,hold,bench,,,,,,,", '"c;d",hold,bench,,,1,,,,', 'b,hold,shelf,,,2,,,,"c;d | a"'],
            [("a", (), 0.0), ("c;d", (), 1.0), ("b", ("c;d", "a"), 2.0)],
        ),
        (
            ["a,hold,bench,,,,,,,", "c,hold,bench,,,1,,,,", 'b,hold,shelf,,,2,,,,"c, a"'],
            [("a", (), 0.0), ("c", (), 1.0), ("b", ("c", "a"), 2.0)],
        ),
        (["a,hold,bench,,,0,,,,b", "b,hold,shelf,,,5,,,,"], [("a", ("b",), 0.0), ("b", (), 5.0)]),
    ],
    ids=[
        "clock times without a date",
        "odd names",
        "a name that continues another",
        "a comma in a name",
        "a semicolon in a name",
        "names with commas between",
        "waiting for a row below",
    ],
)
def test_rows_give_jobs_in_order_of_release(tmp_path, rows, jobs):
    scenario = small_table(tmp_path, "\n".join([SHORT, *rows]))
    assert [(job.name, job.after, job.release_s) for job in drawn(scenario, 0)] == jobs


def test_a_row_without_due_date_is_due_at_the_end_of_the_shift_and_defaults_are_those_of_a_job(tmp_path):
    (job,) = drawn(small_table(tmp_path, "name,kind,places\na,hold,bench\n"), 0)
    assert (job.due_s, job.value, job.repetitions, job.release_s, job.expires) == (180.0, 1.0, 1, 0.0, False)


@pytest.mark.parametrize("line", ["horizon_s = 1_0E999", "horizon_s = nan", 'horizon_s = "x"', "places = 3"])
def test_a_wrong_scenario_around_a_table_is_told(tmp_path, line):
    text = (
        SMALL.replace("horizon_s = 180", line) if "horizon" in line else f"{line}\n{SMALL.replace('places]]', 'x]]')}"
    )
    (tmp_path / "jobs.csv").write_text("name,kind,places\na,hold,bench\n", encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"^cell\.toml: "):
        with_table(tmp_path / "cell.toml", text, "jobs.csv")


def test_parquet_and_xlsx_have_the_jobs_of_the_csv(tmp_path, caplog):
    csv_file = tmp_path / "jobs.csv"
    csv_file.write_text("\n".join([SHORT, *ROWS]), encoding="utf-8")
    jobs = list(read_job_table(csv_file).values())
    columns = {
        "name": ["load 1", "hold 1"], "kind": ["sort", "hold"],
        "places": [[["shelf", "bench"]], [["bench"], ["shelf"]]],
        "payload": [0.2, 2.0], "repetitions": [3, 1], "release_min": [0.0, 1.0], "due_s": [60, None],
        "hard": [True, None], "value": [2.0, None], "after": [[], ["load 1"]], "# customer": ["x", "y"],
    }  # fmt: skip
    pq.write_table(pa.table(columns), tmp_path / "jobs.parquet")
    assert list(read_job_table(tmp_path / "jobs.parquet").values()) == jobs
    try:
        from openpyxl import Workbook
    except ModuleNotFoundError:
        (tmp_path / "jobs.xlsx").touch()
        with pytest.raises(MissingExtra, match=r"'openpyxl', which is not installed: .*\[xlsx\]"):
            read_job_table(tmp_path / "jobs.xlsx")
        return
    book = Workbook()
    for row in csv.reader([SHORT, *ROWS]):
        book.active.append([time_of(cell) if ":" in cell else cell for cell in row])
    book.save(tmp_path / "jobs.xlsx")
    assert list(read_job_table(tmp_path / "jobs.xlsx").values()) == jobs
    name = book.active["A2"]
    name.value = datetime(2026, 10, 11)  # as a sheet reads 11/10
    book.save(tmp_path / "jobs.xlsx")
    with pytest.raises(ScenarioError, match="row 2, column name: is a date: give its cell the format of a text"):
        read_job_table(tmp_path / "jobs.xlsx")
    name.value, name.number_format = 12, "0000"  # as a sheet shows 0012
    book.active["J3"].value = None  # which waited for the row before
    book.save(tmp_path / "jobs.xlsx")
    book.create_sheet("old", 0).append(["x"])
    book.worksheets[0].sheet_state = "hidden"
    book.create_sheet("other").append(["x"])
    book["other"].append(["y"])
    book["Sheet"].row_dimensions[3].hidden = True
    book["Sheet"]["F3"].value, book["Sheet"]["F3"].number_format = datetime(2026, 11, 24), "dd/mm/yyyy"
    book.save(tmp_path / "jobs.xlsx")
    with pytest.raises(ScenarioError, match="row 3, column release: a date needs a time, as 2026-11-24T14:00"):
        read_job_table(tmp_path / "jobs.xlsx", begin=BEGIN)
    book["Sheet"]["F3"].value = None
    book.save(tmp_path / "jobs.xlsx")
    assert [job.name for job in read_job_table(tmp_path / "jobs.xlsx").values()] == ["0012", "hold 1"]
    assert "hidden cells count, too: row 3." in caplog.text
    assert "the first sheet, 'Sheet', is read, and not other." in caplog.text


def time_of(cell: str) -> clock:
    return clock.fromisoformat(cell.zfill(5))


def test_a_submitted_table_gives_the_jobs_of_the_scenario(tmp_path):
    scenario = small_table(
        tmp_path, "\n".join([SHORT, "a,sort,shelf > bench,0.2,3,0:01,90,yes,2,", "b,hold,bench,2,,,99,,,a"])
    )
    jobs = {job.name: job for job in read_jobs(str(tmp_path / "jobs.csv")).values()}
    assert jobs == {job.name: job_spec(job) for job in drawn(scenario, 0)}
    with pytest.raises(FleetError, match=r"--shift-begin is for a job table, a file that ends in \.csv, .*got x\.json"):
        read_jobs("x.json", "2026-11-23T06:00Z")


GOOD = "good,hold,bench,2,1,0,60,no,1,"
ERRORS = {
    "x,hold,bnch,,,,,,,": "column places: no place 'bnch'; did you mean 'bench'? Allowed: bench, shelf.",
    "x,hld,bench,,,,,,,": "column kind: 'hld' is no kind of job; did you mean 'hold'? Allowed: hold, pick_place, ",
    "x,hold,bench > shelf,,,,,,,": "column places: must be one place for a hold (got bench, shelf).",
    "x,sort,bench,,,,,,,": "column places: must be two different places, from and to, for a sort (got bench).",
    "x,hold,,,,,,,,": "column places: is empty; every job needs one.",
    ",hold,bench,,,,,,,": "column name: is empty; every job needs one.",
    "good,hold,bench,,,,,,,": "column name: 'good' is the name of row 2, too; names are unique.",
    "x,hold,bench,500,,,,,,": "column payload: must be between 0 and 10 kg (got 500.0); is this grams? 500 g is",
    "x,hold,bench,heavy,,,,,,": "column payload: expected a number (got 'heavy').",
    "x,hold,bench,nan,,,,,,": "column payload: expected a number (got 'nan').",
    "x,hold,bench,,2.5,,,,,": "column repetitions: expected a whole number (got '2.5').",
    "x,hold,bench,,0,,,,,": "column repetitions: must be between 1 and 100000 (got 0).",
    "x,hold,bench,,,-1,,,,": "column release: must be between 0 and 1000000000 s (got -1.0).",
    "x,hold,bench,,,6:75,,,,": "column release: expected seconds, h:mm, h:mm:ss, or a date with time and",
    "x,hold,bench,,,0600,,,,": "column release: is this 06:00? Give times as h:mm, or a number as 600.",
    "x,hold,bench;shelf,,,,,,,": "column places: give > between from and to, and | between alternatives, no comma or",
    "x,hold,bench,,,2026-11-23,,,,": "column release: a date needs shift_begin, the begin of the shift, or --shift-",
    "x,hold,bench,,,60,30,,,": "column due: must not be before the release at 60 s (got 30 s).",
    "x,hold,bench,,,4:50,4:10,,,": "column due: must not be before the release at 4:50 (got 4:10).",
    "x,hold,bench,,,0:01:30,60,,,": "column due: must not be before the release at 0:01:30 (got 60 s).",
    "x,hold,bench,,,,,yes,,": "column due: is missing: a hard due date needs a time.",
    "x,hold,bench,,,,,maybe,,": "column hard: expected yes or no (got 'maybe').",
    "x,hold,bench,,,,,,,y": "column after: there is no job 'y' in this table.",
    'x,hold,bench,,,,,,,"y;g"': "column after: there is no job 'y;g' in this table; give | between names.",
    "x,hold,bench,,,,,,,x": "column after: jobs wait for each other in a cycle: x → x.",
    "x,hold,bench,,,,,,,,,9": ": 12 cells, but the head has 10; quote cells with separators.",
}


@pytest.mark.parametrize(("row", "sentence"), ERRORS.items(), ids=ERRORS)
def test_an_error_is_told_with_row_column_value_and_what_is_allowed(tmp_path, row, sentence):
    told = errors_of(tmp_path, "\n".join([SHORT, GOOD, row]))
    assert told.startswith("cell.toml: jobs[0].table: 'jobs.csv' has 1 error:\n  row 3")
    assert sentence in told


def test_all_errors_are_told_at_once_and_equal_ones_together(tmp_path):
    planted = [row for row in ERRORS if row[0] == "x" and row[-1] not in "xy"]
    rows = [row.replace("x", f"x{i}", 1) for i, row in enumerate(planted)]
    told = errors_of(tmp_path, "\n".join([SHORT, GOOD, *rows, "z,hold,bnch,,,,,,,"]))
    assert f"has {len(rows) + 1} errors:" in told
    assert "rows 3, " in told
    for i, row in enumerate(planted):
        assert ERRORS[row] in told, row
        assert f"row {i + 3}" in told or not i


def test_what_a_german_spreadsheet_writes_is_read_or_asked_about(tmp_path):
    begin = "shift_begin = 2026-11-23T06:00:00+01:00"
    text = SHORT.replace(",", ";") + "\na;hold;bench;0,5;2;23.11.2026 06:01;6:02;WAHR;;\nb;hold;bench;;;;;nein;;\n"
    first, second = drawn(small_table(tmp_path, text, begin), 0)[::-1]
    assert (first.release_s, first.due_s, first.expires, first.work.payload_kg) == (60.0, 120.0, True, 0.5)
    assert not second.expires
    for row, sentence in (
        ("a;hold;bench;;1.000;;;;;", "column repetitions: is this 1000? Give numbers without separators of thousands"),
        (
            "a;hold;bench;;;22.11.2026 6:00;;;;",
            "column release: 22 Nov 2026 06:00 is before the shift, which begins on 23 ",
        ),
        ("a;hold;bench;;;;46349,27;;;", "column due: is this 23 Nov 2026 06:28, in days as a spreadsheet counts? Give"),
        ("a;hold;bench;;;;46349,9930555;;;", "column due: is this 23 Nov 2026 23:50, in days"),
        ("a;hold;bench;;;;2026-11-24;;;", "column due: a date needs a time, as 2026-11-24T14:00 (got '2026-11-24')"),
        (
            "a;hold;bench;;;6:01;5:00;;;",
            "column due: '5:00' is outside the shift, which begins at 06:00 and ends at 06:03.",
        ),
    ):
        assert sentence in errors_of(tmp_path, f"{SHORT.replace(',', ';')}\n{row}\n", begin)


def test_a_time_of_day_that_summer_time_leaves_out_is_told(tmp_path):
    begin = 'time_zone = "Europe/Berlin"\nshift_begin = 2026-03-29T01:59:00'
    for release, exists in (("2:30", False), ("2026-03-29T02:30", False), ("3:00", True)):
        text = f"{SHORT}\na,hold,bench,,,{release},,,,\n"
        if exists:
            assert drawn(small_table(tmp_path, text, begin), 0)[0].release_s == 60.0
        else:
            errors = errors_of(tmp_path, text, begin)
            assert f"column release: '{release}' does not exist: summer time leaves out this hour" in errors


def test_a_time_of_day_that_occurs_twice_is_told(tmp_path, caplog):
    for shift_begin, release, warned in (
        ("2026-10-25T01:59:00", "2:00", True),
        ("2026-10-25T01:59:00", "2026-10-25T02:00", True),
        ("2026-10-25T01:59:00", "2026-10-25T02:00+02:00", False),
        ("2026-10-25T02:29:00+01:00", "2:30", False),  # begins between both
    ):
        caplog.clear()
        begin, text = (
            f'time_zone = "Europe/Berlin"\nshift_begin = {shift_begin}',
            f"{SHORT}\na,hold,bench,,,{release},,,,\n",
        )
        assert drawn(small_table(tmp_path, text, begin), 0)[0].release_s == 60.0
        sentence = f"row 2, column release: '{release}' occurs twice, as summer time ends: 2026-10-25T02:00+02:00 is"
        assert (sentence in caplog.text) == warned
    small_table(tmp_path, f"{SHORT}\na,hold,bench,,,,,,,\n", begin.removesuffix("+01:00"))
    assert "shift_begin = 2026-10-25 02:29:00 occurs twice, as summer time ends" in caplog.text


def test_only_plain_numbers_are_scaled_to_the_unit_of_a_heading(tmp_path):
    text = "name,kind,places,release_min,due_min\na,hold,bench,1,6:02\nb,hold,bench,0,2026-11-23T06:02:30+01:00\n"
    jobs = drawn(small_table(tmp_path, text, "shift_begin = 2026-11-23T06:00:00+01:00"), 0)
    assert {job.name: (job.release_s, job.due_s) for job in jobs} == {"a": (60.0, 120.0), "b": (0.0, 150.0)}


def test_hours_among_clock_times_are_asked_about(tmp_path, caplog):
    begin = "shift_begin = 2026-11-23T22:00:00+01:00"
    for heading, time_, sentence in (
        ("release", "23,5", "column release: is this 23:30 or 23:50? Give times as h:mm, or seconds in a column "),
        ("release", "23.5", "column release: is this 23:30 or 23:50? Give times as h:mm, or seconds in a column "),
        ("release", "23,0", "column release: is this 23:00? Give times as h:mm, or seconds in a column release_s (got"),
        (
            "release",
            "23,30",
            "column release: is this 23:30? Give times as h:mm, or seconds in a column release_s (got",
        ),
        (
            "release",
            "9,75",
            "column release: is this 9:45? Give times as h:mm, or seconds in a column release_s (got '9",
        ),
        ("release", "10,150", "column release: is this 10:09 or 10:15? Give times as h:mm, or seconds in a column rel"),
        ("release", "0.999", "column release: is this 1:00? Give times as h:mm, or seconds in a column release_s (got"),
        ("release", "23", ""),
        ("release_s", "23,5", ""),
        ("release_s", "23,30", ""),
        ("release", "24,5", ""),
    ):
        text = f"name;kind;places;{heading};due\na;hold;bench;{time_};\nb;hold;bench;;22:02\n"
        caplog.clear()
        if sentence:
            assert sentence in errors_of(tmp_path, text, begin)
        else:
            last = drawn(small_table(tmp_path, text, begin), 0)[-1]
            assert last.release_s == float(time_.replace(",", "."))
        warned = "row 2, column release: '23' counts as 23 s; is this 23:00? Give times as h:mm" in caplog.text
        assert warned == (time_ == "23")
    seconds = "name;kind;places;release;due\na;hold;bench;23,5;60\n"
    assert drawn(small_table(tmp_path, seconds, begin), 0)[0].release_s == 23.5


def test_a_due_date_before_the_jobs_that_must_finish_first_is_told(tmp_path, caplog):
    begin = "shift_begin = 2026-11-23T22:00:00+01:00\nhorizon_s = 36000"
    rows = "a1,hold,bench,,3,5:00,5:30,,,,20\na2,hold,bench,,,22:30,{},,,a1,\na3,hold,bench,,,,{},,,a2,"
    sentence = "before it, 'a1' must finish, which has its release at 5:00; that takes at least "
    short = SMALL.replace("horizon_s = 180", "")
    for second, third, told in (
        (
            "23:40",
            "5:00:30",
            f"row 3, column due: {sentence}60 s, so the job cannot be on time (got 23:40).",
        ),
        (
            "5:40",
            "5:01",
            f"row 4, column due: {sentence}60.5 s, so the job cannot be on time (got 5:01).",
        ),
        ("5:01", "5:01:01", ""),
    ):
        caplog.clear()
        (tmp_path / "jobs.csv").write_text(f"{SHORT},dwell\n{rows.format(second, third)}\n", encoding="utf-8")
        with_table(tmp_path / "cell.toml", short, "jobs.csv", begin)
        assert told in caplog.text
        assert ("cannot be on time" in caplog.text) == bool(told)
    many = [f"b{i},hold,bench,,,,22:{i + 10},,,a1," for i in range(12)]
    table = "\n".join([f"{SHORT},dwell", *many, "a1,hold,bench,,3,5:00,5:30,,,,20"])
    caplog.clear()
    (tmp_path / "jobs.csv").write_text(table, encoding="utf-8")
    with_table(tmp_path / "cell.toml", short, "jobs.csv", begin)
    assert caplog.text.count("so the job cannot be on time") == 5
    rest = "rows 7, 8, 9, 10, 11 and 2 more, column due: the jobs in column after cannot finish before it, either."
    assert rest in caplog.text


def test_light_payloads_in_grams_are_asked_about(tmp_path):
    for grams, refused in (("0.5", True), ("200", False)):
        path = tmp_path / "jobs.csv"
        path.write_text(f"name,kind,places,payload_g\na,hold,bench,{grams}\nb,hold,bench,2\n", encoding="utf-8")
        if refused:
            with pytest.raises(
                ScenarioError, match=r"row 1, column payload_g: are these kg\? The heaviest is 2. Give kg"
            ):
                read_job_table(path)
        else:
            assert [job.payload_kg for job in read_job_table(path).values()] == [0.2, 0.002]


def test_times_of_a_sheet_are_those_that_it_shows(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    begin, path = datetime(2026, 11, 23, 6, tzinfo=UTC), tmp_path / "jobs.xlsx"
    for format_, day_fraction, release in (
        ("[h]:mm", 0.25, 0.0),
        ("[h]:mm", 0.5, 21600.0),
        ("General", 0.25, "06:00"),
        ("General", 0.9930555, "23:50"),  # 5 ms less
        ("General", 0.9999999, "24:00"),
    ):
        book = openpyxl.Workbook()
        book.active.append(["name", "kind", "places", "release"])
        book.active.append(["a", "hold", "bench", day_fraction])
        book.active["D2"].number_format = format_
        book.save(path)
        if isinstance(release, str):
            with pytest.raises(
                ScenarioError, match=rf"is this {release}\? Give its cell a format of time, or a number as a text"
            ):
                read_job_table(path, begin=begin)
        else:
            assert [job.release_s for job in read_job_table(path, begin=begin).values()] == [release]


def test_a_quote_that_is_never_closed_is_told_and_no_row_is_lost(tmp_path):
    text = 'name,kind,places,#note\na,hold,bench,"5 inch\nb,hold,bench,x\n'
    with pytest.raises(ScenarioError, match=r"'jobs.csv', after row 1: not CSV .*A quoted cell must end with a quote"):
        small_table(tmp_path, text)


def test_what_a_workbook_hides_is_told(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    for change, sentence in (
        (lambda sheet: sheet.__setitem__("D2", "=1+1"), "cell D2: a formula without a stored value"),
        (lambda sheet: sheet.merge_cells("D2:D3"), r"has merged cells \(D2:D3\): unmerge them"),
        (lambda sheet: sheet.__setitem__("XFD1048576", 1), "has 1048576 rows and 16384 columns; a job table has at"),
    ):
        book = openpyxl.Workbook()
        for row in csv.reader([SHORT, *ROWS]):
            book.active.append(row)
        change(book.active)
        book.save(tmp_path / "jobs.xlsx")
        with pytest.raises(ScenarioError, match=sentence):
            read_job_table(tmp_path / "jobs.xlsx")


HEADS = {
    "name,kind,places,dwell (min)": "column dwell (min): unknown unit of 'dwell'. Convert its numbers; allowed ",
    "name,kind,places,paylod": "column paylod: unknown; did you mean 'payload'? Allowed: name, kind, places",
    "name,kind": "row 1: no column places; every job needs name, kind, places.",
    "name,kind,places,due,due_s": "column due_s: there is another column 'due'; keep one.",
    "": "has 1 error:\n  row 1: no column name and no column kind and no column places",
    "name,kind,places": "'jobs.csv' has no jobs; give a row of headings, then one row for each job.",
}


@pytest.mark.parametrize(("head", "sentence"), HEADS.items(), ids=HEADS)
def test_a_wrong_head_is_told(tmp_path, head, sentence):
    assert sentence in errors_of(tmp_path, head + "\n")


def test_a_file_that_is_no_table_is_told(tmp_path):
    for name, content, sentence in (
        ("jobs.parquet", b"PAR1", "'jobs.parquet' is not a Parquet file ("),
        ("jobs.xls", b"\xd0\xcf\x11\xe0\x00", "'jobs.xls' is a workbook or an archive. Save its sheet as CSV"),
        ("jobs.csv", b"\x00\x01", "'jobs.csv' is not a text file in UTF-8: it has NUL bytes. Save it as UTF-8."),
        ("none.csv", None, "'none.csv': there is no file '"),
    ):
        if content:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(ScenarioError) as error:
            with_table(tmp_path / "cell.toml", SMALL, name)
        assert sentence in str(error.value)
    with pytest.raises(ScenarioError, match=r'jobs\[0\]: a job table is table = "FILE", without other keys'):
        with_table(tmp_path / "cell.toml", SMALL, 'x"\nname = "y')


def test_excel_may_name_its_separator_in_the_first_row(tmp_path):
    text = "sep=;\nName;Kind;Places;Payload (kg);Release [min]\nä;hold;bench;1,5;0,5\n"
    (tmp_path / "jobs.csv").write_bytes(text.encode("cp1252"))
    (job,) = read_job_table(tmp_path / "jobs.csv").values()
    assert (job.name, job.payload_kg, job.release_s) == ("ä", 1.5, 30.0)


def test_rows_of_several_programs_may_have_several_encodings(tmp_path):
    rows = [f"{name},hold,bench".encode(code) for name, code in (("Öl", "utf-8"), ("Maß", "cp1252"), ("€", "cp1252"))]
    (tmp_path / "jobs.csv").write_bytes(b"\n".join([b"name,kind,places", *rows, b"\x81,hold,bench"]))
    assert [job.name for job in read_job_table(tmp_path / "jobs.csv").values()] == ["Öl", "Maß", "€", "\ufffd"]


SOON_S = 2.0
"""Of the processor, also of a slow one; with a fast one it takes a tenth."""


def test_a_thousand_rows_are_read_and_all_their_errors_told_soon(tmp_path):
    kinds = [f"j{i},hld,bnch{i},{20 + i},0.5,soon,-1,maybe,-2,k{i}" for i in range(1000)]
    began_s = time.process_time()
    told = errors_of(tmp_path, "\n".join([SHORT, *kinds]))
    assert time.process_time() - began_s < SOON_S
    assert f"has {9 * 1000} errors" in told
    rows = [f"j{i},hold,bench | shelf,2,1,{i % 180},{i + 1000},yes,1,{f'j{i - 1}' * (i > 0)}" for i in range(1000)]
    began_s = time.process_time()
    assert len(small_table(tmp_path, "\n".join([SHORT, *rows])).jobs) == 1000
    assert time.process_time() - began_s < SOON_S


def test_clock_times_are_not_asked_to_be_minutes(tmp_path, caplog):
    for times, asked in ((("1", "2", "3"), True), (("0:01", "0:02", "0:03"), False), (("0:00:01", "2", "3"), False)):
        caplog.clear()
        rows = [f"j{i},hold,bench,,,{time_},,,," for i, time_ in enumerate(times)]
        small_table(tmp_path, "\n".join([SHORT, *rows]))
        assert ("all 3 times are within 3 s of a shift of 180 s. Are these minutes?" in caplog.text) == asked, times
    rows = [f"j{i},hold,bench,,,{time_},,,," for i, time_ in enumerate(("0:01", "1", "2", "3"))]
    small_table(tmp_path, "\n".join([SHORT, *rows]))
    assert "all 3 of 4 times that are numbers are within 3 s of a shift of 180 s. Are these minutes?" in caplog.text


def test_jobs_that_cannot_finish_in_time_are_told(tmp_path, caplog, plans):
    table = small_table(tmp_path, f"{SHORT}\na,hold,bench,,,,1,,,\nb,hold,bench,,,,1,yes,,\nc,hold,bench,,,179,,,,\n")
    clock_times = small_table(tmp_path, f"{SHORT}\na,hold,bench,,200,0:01,0:02,,,\n")
    raw = tomllib.loads(SMALL) | {"name": "heat", "horizon_s": 10}
    raw["jobs"][1]["due_s"] = 0.5
    late = raw | {
        "name": "late",
        "jobs": [raw["jobs"][0] | {"arrivals": {"kind": "batch", "count": 1, "start_s": 11.0}}],
    }
    for scenario in (table, clock_times, parse_scenario(raw, tmp_path), parse_scenario(late, tmp_path)):
        prepare(scenario, difficulty="blind", cache=plans)
    assert [re.sub(r"[\d.]+ s \(", "… s (", each.message) for each in caplog.records] == [
        "cell.toml: 'jobs.csv', row 2, column due: 'a' takes at least … s (1 cycle), but has 1 s until it is due. Are "
        "its times minutes? Give seconds.",
        "cell.toml: 'jobs.csv', row 4, column release: 'c' takes at least … s (1 cycle), but has 1 s until the shift "
        "ends. Are its times minutes? Give seconds.",
        "cell.toml: 'jobs.csv', row 2, column due: 'a' takes at least … s (200 cycles), but has 60 s until it is due.",
        "heat.toml: horizon_s: 'hold' takes at least … s (1 cycle), but has 10 s until the shift ends. Are its times "
        "minutes? Give seconds.",
        "heat.toml: jobs[1].due_s: 'sort' takes at least … s (1 cycle), but has 0.5 s until it is due. Are its times "
        "minutes? Give seconds.",
        "late.toml: horizon_s: 'hold' takes at least … s (1 cycle), but has 0 s until the shift ends.",
    ]


def test_rows_outside_the_shift_are_counted(tmp_path, caplog, plans):
    rows = [f"j{i},hold,bench,,,{i * 60},,,," for i in range(5)]
    scenario = small_table(tmp_path, "\n".join([SHORT, *rows]))
    log = run(prepare(scenario, difficulty="blind", cache=plans), policy="edd", difficulty="blind")
    assert "2 of 5 jobs of tables and traces never arrived: their times are outside the shift." in log.page()
    assert "'jobs.csv': 2 of 5 times are outside the shift, which ends at horizon_s = 180" in caplog.text
    assert "gives no job: its only time is outside" in errors_of(tmp_path, f"{SHORT}\na,hold,bench,,,180,,,,\n")


def test_errors_found_after_reading_name_file_row_and_column_all_at_once(tmp_path, plans):
    for name, rows in {
        "a.csv": ["x,hold,bench", "sort,hold,bench"],
        "b.csv": ["x,hold,bench", "y,hold,bench", "sort-001,hold,bench"],
    }.items():
        (tmp_path / name).write_text("\n".join(["name,kind,places", *rows]), encoding="utf-8")
    tables = '[[jobs]]\ntable = "a.csv"\n[[jobs]]\ntable = "b.csv"\n'
    both = SMALL.replace("[[jobs]]", f"{tables}[[jobs]]", 1)
    (tmp_path / "both.toml").write_text(both, encoding="utf-8")
    with pytest.raises(ScenarioError) as error:
        load(tmp_path / "both.toml")
    assert str(error.value).splitlines() == [
        "both.toml: 'b.csv', row 2, column name: 'x' is given twice, as in 'a.csv', row 2, column name; names must be "
        "unique.",
        "both.toml: 'a.csv', row 3, column name: 'sort' is given twice, as in jobs[3].name; names must be unique.",
        "both.toml: 'b.csv', row 4, column name: 'sort-001' is also a job of the stream 'sort'; rename one of them.",
    ]
    (tmp_path / "both.toml").write_text(both.replace("[2.0]", "[-2.0]"), encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"jobs\[2\]\.payload_kg must be between 0 and 10 kg \(got -2\.0\)"):
        load(tmp_path / "both.toml")
    far = SMALL.replace("position_m = [0.0, -0.2, 0.25]", "position_m = [9.0, 0.0, 0.25]")
    (tmp_path / "jobs.csv").write_text(
        "name,kind,places,payload\n\na,hold,bench,2\nb,hold,shelf,2\nc,hold,bench,9\nd,hold,shelf,0\n", encoding="utf-8"
    )
    with pytest.raises(ScenarioError) as error:
        prepare(with_table(tmp_path / "cell.toml", far, "jobs.csv"), difficulty="blind", cache=plans)
    assert [line.partition(" (")[0] for line in str(error.value).splitlines()] == [
        "cell.toml: 'jobs.csv', row 4, column places: no arm can do 'b' with 2 kg",
        "cell.toml: 'jobs.csv', row 5, column payload: no arm can do 'c' with 9 kg",
    ]
    assert str(error.value).splitlines()[0].endswith(" The same holds for 'd' ('jobs.csv', row 6, column places).")
    rows = [f"part_{number},hold,shelf,{number / 10}" for number in range(8)]
    (tmp_path / "jobs.csv").write_text("\n".join(["name,kind,places,payload", *rows]), encoding="utf-8")
    with pytest.raises(ScenarioError) as error:
        prepare(with_table(tmp_path / "cell.toml", far, "jobs.csv"), difficulty="blind", cache=plans)
    (line,) = str(error.value).splitlines()
    assert line.startswith("cell.toml: 'jobs.csv', row 2, column places: no arm can do 'part_0' with 0 kg (")
    assert line.endswith(
        "The same holds for 7 other jobs, 'part_1' ('jobs.csv', row 3, column places) to 'part_7' ('jobs.csv', row 9, "
        "column places)."
    )


def test_the_name_of_a_table_and_blank_rows_change_no_hash(tmp_path):
    text = "name,kind,places\na,hold,bench\n"
    first = small_table(tmp_path, text)
    (tmp_path / "other.csv").write_text(f"\n{text}", encoding="utf-8")
    other = with_table(tmp_path / "cell.toml", SMALL, "other.csv")
    assert first.jobs[0].row != other.jobs[0].row
    assert scenario_hash(first) == scenario_hash(other)


def test_command_and_http_of_the_documentation_read_times_of_day_in_one_zone():
    text = "".join((DOCS / page).read_text(encoding="utf-8") for page in ("how_to/job_table.md", "bus/client.md"))
    begins = re.findall(r"shift[-_]begin[ =](2026[^\s'`]*)", text)
    assert [*map(unquote, begins)] == 3 * ["2026-11-23T06:00+01:00"]
