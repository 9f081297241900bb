"""The store, the table and the command line that all studies of the paper share."""

import json
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from benchmarks.paper import harness
from benchmarks.paper.__main__ import STUDIES, main
from benchmarks.paper.harness import Experiment, Unit, compute, mean_by_group, one_row, seeded, table_of, wholes
from fleet.errors import FleetError
from scenarios.evaluate.statistics import interval
from scenarios.json_rows import Rows


def squares(numbers, missing):
    for key in missing:
        assert int(key) in numbers
        yield key, {"square": int(key) ** 2, "unknown": float("nan"), "array": np.arange(2)}


UNITS = [Unit(("1", "2"), partial(squares, (1, 2))), Unit(("3",), partial(squares, (3,)))]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_stopped_study_continues_with_the_missing_rows(tmp_path, workers, capsys) -> None:
    file = tmp_path / "rows.jsonl"
    compute(UNITS[:1], Rows(file), workers=workers)
    file.write_text(file.read_text().splitlines()[0] + '\n{"key": "2", "squ')
    kept = file.read_text().splitlines()[0]
    compute(UNITS, Rows(file), workers=workers)
    rows = Rows(file)
    assert [rows.by_key[str(n)]["square"] for n in (1, 2, 3)] == [1, 4, 9]
    assert rows.by_key["3"]["unknown"] is None
    assert rows.by_key["3"]["array"] == [0, 1]
    assert file.read_text().splitlines()[0] == kept
    capsys.readouterr()
    compute(UNITS, rows, workers=workers)
    assert capsys.readouterr().err == ""


def test_rows_are_kept_one_by_one(tmp_path) -> None:
    def stops(missing):
        yield "a", {"value": 1}
        raise FleetError("no more")

    with pytest.raises(FleetError):
        compute([Unit(("a", "b"), stops)], Rows(tmp_path / "rows.jsonl"))
    assert list(Rows(tmp_path / "rows.jsonl").by_key) == ["a"]


def test_a_value_that_json_has_not_is_refused() -> None:
    with pytest.raises(NotImplementedError, match="A row cannot hold a object"):
        harness.plain({"value": object()})


def test_tables_are_printed_with_their_captions(tmp_path, capsys) -> None:
    tables = {name: table_of(("name", "n"), [(name, "10"), ("longer", "2")], "Numbers") for name in ("a", "b")}
    study = Experiment(help="", units=lambda given: [one_row("a", dict)], tables=lambda rows: tables)
    harness.run("numbers", study, ["--out", str(tmp_path / "rows.jsonl")])
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    first = [["Numbers"], ["name", "n"], ["a", "10"], ["longer", "2"]]
    assert lines == [*first, [], *first[:2], ["b", "10"], first[3]]


@dataclass(frozen=True)
class Size:
    jobs: tuple[int, ...] = (5, 10)
    steps: int = 7
    rate: float = 0.5

    @classmethod
    def quick(cls) -> "Size":
        return cls(jobs=(2,))


def per_seed(seed, size, wanted):
    for part in wanted:
        yield part, {"part": part, "seed": seed, "total": sum(size.jobs) * size.steps}


def totals(rows):
    return {"totals": table_of(("part", "total"), [(row["part"], str(row["total"])) for row in rows])}


SEEDED = seeded("Totals.", Size, 2, per_seed, totals, parts=("x", "y"))


def run(tmp_path, capsys, *words: str) -> list[list[str]]:
    harness.run("totals", SEEDED, [*words, "--out", str(tmp_path / "rows.jsonl")])
    return [line.split() for line in capsys.readouterr().out.splitlines()[1:]]


def test_the_options_of_a_size_are_its_numbers(tmp_path, capsys) -> None:
    assert run(tmp_path, capsys) == [["x", "105"], ["y", "105"]] * 2
    assert run(tmp_path, capsys, "--seeds", "1", "--quick", "--steps", "3") == [["x", "6"], ["y", "6"]]
    assert run(tmp_path, capsys, "--seeds", "1", "--jobs", "1", "2")[0] == ["x", "21"]
    rows = Rows(tmp_path / "rows.jsonl")
    assert len(rows.by_key) == 4 + 2 + 2
    assert run(tmp_path, capsys, "--show", "--first-seed", "2", "--seeds", "1") == [["x", "105"], ["y", "105"]]
    with pytest.raises(FleetError, match="has no such row"):
        run(tmp_path, capsys, "--show", "--first-seed", "9")


def test_numbers_are_checked(capsys) -> None:
    assert wholes("0, 2,0") == [0, 2]
    for words in (["--seeds", "0"], ["--seeds", "x"], ["--jobs", "-1"]):
        with pytest.raises(SystemExit):
            harness.run("totals", SEEDED, words)
        assert "must be a whole number from" in capsys.readouterr().err


def test_errors_are_a_sentence(tmp_path, capsys) -> None:
    (tmp_path / "notes.jsonl").write_text("hello\n")
    experiment = Experiment(help="Nothing.", units=lambda given: [one_row("a", dict)], tables=lambda rows: {})
    for words, code, text in (
        (["nothing", "--out", str(tmp_path / "notes.jsonl")], 2, "line 1: not a row of this study"),
        (["others"], 2, "Error: no study 'others'"),
        ([], 0, ""),
    ):
        with pytest.raises(SystemExit) as end:
            harness.main({"nothing": lambda: experiment}, words)
        assert end.value.code == code
        assert text in capsys.readouterr().err


def test_odd_rows_name_the_file(tmp_path) -> None:
    (tmp_path / "rows.jsonl").write_text(json.dumps({"key": "a"}) + "\n")
    experiment = Experiment(
        help="Nothing.", units=lambda given: [one_row("a", dict)], tables=lambda rows: {"t": rows[0]["missing"]}
    )
    with pytest.raises(FleetError, match="has a missing or odd value"):
        harness.run("nothing", experiment, ["--show", "--out", str(tmp_path / "rows.jsonl")])


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_has_help(name, capsys) -> None:
    with pytest.raises(SystemExit) as end:
        main([name, "--help"])
    assert end.value.code == 0
    assert STUDIES[name]().help.splitlines()[0][:40] in capsys.readouterr().out.replace("\n", " ")


def test_groups_are_the_sample_if_there_are_several() -> None:
    values = [("a", 1.0), ("a", 3.0), ("b", 5.0), ("c", 5.0), ("c", 6.0)]
    assert mean_by_group(values) == interval([2.0, 5.0, 5.5])
    assert mean_by_group(values[:2]) == interval([1.0, 3.0])
