"""The store, the table, the command line and the sweeps that all studies of the paper share."""

import json
from argparse import ArgumentParser
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from benchmarks.paper import harness, sweep
from benchmarks.paper.__main__ import main
from benchmarks.paper.harness import (
    Experiment,
    Unit,
    compute,
    mean_by_group,
    mean_share,
    one_row,
    seeded,
    table_of,
    wholes,
)
from benchmarks.paper.sweep import OURS, PARSIMONY, sweep_tables, train_regressor
from fleet.errors import FleetError
from scenarios.evaluate.statistics import interval
from scenarios.json_rows import Rows
from twin.vae.config import TwinConfig


def squares(numbers, missing):
    for key in missing:
        assert int(key) in numbers
        yield key, {"square": int(key) ** 2, "unknown": float("nan"), "array": np.arange(2)}


UNITS = [Unit(("1", "2"), partial(squares, (1, 2))), Unit(("3",), partial(squares, (3,)))]


def test_a_stopped_study_continues_with_the_missing_rows(tmp_path, capsys) -> None:
    file = tmp_path / "rows.jsonl"
    compute(UNITS[:1], Rows(file))
    file.write_text(file.read_text().splitlines()[0] + '\n{"key": "2", "squ')
    kept = file.read_text().splitlines()[0]
    compute(UNITS, Rows(file))
    rows = Rows(file)
    assert [rows.by_key[str(n)]["square"] for n in (1, 2, 3)] == [1, 4, 9]
    assert rows.by_key["3"]["unknown"] is None
    assert rows.by_key["3"]["array"] == [0, 1]
    assert file.read_text().splitlines()[0] == kept
    capsys.readouterr()
    compute(UNITS, rows)
    assert capsys.readouterr().err == ""


def test_values_and_files_that_hold_no_rows_are_refused(tmp_path) -> None:
    with pytest.raises(NotImplementedError, match="A row cannot hold a object"):
        harness.plain({"value": object()})
    (tmp_path / "rows.jsonl").write_text(json.dumps({"key": "a"}) + "\n")
    experiment = Experiment(
        help="Nothing.", units=lambda given: [one_row("a", dict)], tables=lambda rows: {"t": rows[0]["missing"]}
    )
    with pytest.raises(FleetError, match="has a missing or odd value"):
        harness.run("nothing", experiment, ["--show", "--out", str(tmp_path / "rows.jsonl")])


@dataclass(frozen=True)
class Size:
    jobs: tuple[int, ...] = (5, 10)
    steps: int = 7
    rate: float = 0.5


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
    assert run(tmp_path, capsys, "--seeds", "1", "--steps", "3") == [["x", "45"], ["y", "45"]]
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


def test_groups_are_the_sample_if_there_are_several() -> None:
    values = [("a", 1.0), ("a", 3.0), ("b", 5.0), ("c", 5.0), ("c", 6.0)]
    assert mean_by_group(values) == interval([2.0, 5.0, 5.5])
    assert mean_by_group(values[:2]) == interval([1.0, 3.0])


def test_an_interval_of_shares_or_ranks_has_possible_values_only():
    values = [("a", 0.99), ("b", 0.9), ("c", 0.2)]
    free, share, rank = (
        function(values) for function in (mean_by_group, mean_share, partial(mean_share, measure="spearman"))
    )
    assert free.low < 0 < 1 < free.high
    assert (share.low, share.high) == (0.0, 1.0)
    assert (rank.low, rank.high) == (max(free.low, -1.0), 1.0)


def made_up(configuration: str, subject: str, auroc: float) -> dict:
    quality = dict.fromkeys(("auroc", "auprc", "spearman"), auroc)
    scores = dict.fromkeys(sweep.HOT, quality)
    card = {"configuration": configuration, "subject": subject, "epochs": 60, "cpu_s": 20.0}
    return {**card, **scores, "kl": 2.0, "active_units": 2}


def test_differences_are_paired_by_arm():
    """Arms that differ much among themselves, and a configuration that is better on each by as much."""
    values = {f"scenario/arm_{i}/1": v for i, v in enumerate((0.5, 0.7, 0.9))}
    rows = [made_up(OURS, name, v) for name, v in values.items()]
    rows += [made_up("latent_4", name, v + 0.05 + 0.001 * i) for i, (name, v) in enumerate(values.items())]
    ours, better = sweep_tables(rows)["sweep"].rows
    assert "(" not in ours[2]
    assert better[2] == ".751 (+.051 ± .002*)"
    again = [{**row, "subject": row["subject"][:-1] + seed} for row in rows for seed in "12"]
    assert sweep_tables(again)["sweep"].rows[1][2] == better[2]  # seeds of one arm are no further arms


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("sweep --only beta", "No configuration 'beta'"),
        ("sweep --arms 0,4", "--arms must be 0 to 3"),
        ("sweep --train 0", "--train: must be a whole number from 1 (got '0')"),
        ("parsimony --train 2", "--train must be 3 or more (got 2)."),
        ("readings --train 30", "--exploration must be at most --train (got 64 and 30)."),
        ("forms --train 30", "--exploration must be at most --train (got 64 and 30)."),
        ("readings --reference 0", "--reference: must be a whole number from 1 (got '0')"),
        ("readings --train 0 --exploration 0", "--train: must be a whole number from 1 (got '0')"),
        ("sides --train 30", "--exploration must be at most --train (got 64 and 30)."),
        ("sides --s nan", "--s: must be a number from 0 (got 'nan')"),
        ("sides --s=-1", "--s: must be a number from 0 (got '-1')"),
        ("features --train 0", "--train: must be a whole number from 1 (got '0')"),
        ("features --labels 9", "--labels must be 10 or more for a cross-validation (got 9)."),
        ("transfer --jobs 40 5", "--jobs must be ascending (got 40, 5)."),
        ("drift --days 28", "something changes (got 14, 28 and 28)."),
        ("drift --reference 1", "something changes (got 1, 28 and 84)."),
        ("drift --period 0", "--period: must be a whole number from 1 (got '0')"),
        ("drift --jobs 50", "--jobs must be at most --pool (got 50 and 40)."),
    ],
)
def test_options_are_checked_before_any_work(line, says, tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        main([*line.split(), "--out", str(tmp_path / "rows.jsonl")])
    assert end.value.code == 2
    assert says in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "rows.jsonl").exists()


def test_amounts_beyond_the_jobs_are_no_rows():
    parser = ArgumentParser()
    PARSIMONY.options(parser)
    (unit,) = PARSIMONY.units(parser.parse_args(["--scenarios", "quickstart", "--arms", "0", "--train", "30"]))
    assert {int(key.split("/")[1]) for key in unit.keys} == {3, 5, 10, 20}


def test_rows_of_another_study_and_a_folder_are_no_file_to_continue(tmp_path, capsys):
    run(tmp_path, capsys)
    others = Experiment(help="", units=lambda given: [one_row("a", dict)], tables=lambda rows: {})
    for out, says in ((tmp_path / "rows.jsonl", "has rows of the study totals"), (tmp_path, "Is a directory")):
        before = (tmp_path / "rows.jsonl").read_bytes()
        with pytest.raises(FleetError, match=says):
            harness.run("others", others, ["--out", str(out)])
        assert (tmp_path / "rows.jsonl").read_bytes() == before


def test_reading_leaves_a_file_as_it_is_and_a_row_replaces_an_unfinished_line(tmp_path):
    file = tmp_path / "rows.jsonl"
    for text in ("hello", '{"key": "a"}\nhello', "\udcff"):
        file.write_bytes(text.encode(errors="surrogateescape"))
        with pytest.raises(FleetError, match="not a row of this study"):
            Rows(file)
        assert file.read_bytes() == text.encode(errors="surrogateescape")
    file.write_text('{"key": "a"}\n{"key": "b", "kl', encoding="utf-8")
    first, second = Rows(file), Rows(file)
    assert "kl" in file.read_text(encoding="utf-8")
    first.append("c", {})
    second.append("d", {})  # of another process, which must not remove the first one's row
    assert list(Rows(file).by_key) == ["a", "c", "d"]


@pytest.mark.parametrize(
    ("quality", "jobs"),
    [
        ({5: 0.70, 10: 0.895, 20: 0.90, 40: 0.91}, 10),
        ({5: 0.95, 10: 0.85, 20: 0.94, 40: 0.95}, 20),  # by chance as good before: not yet the knee
        ({5: 0.5}, 5),
    ],
)
def test_the_knee_is_where_more_data_stops_to_help(quality, jobs):
    assert sweep.knee(quality) == jobs


def test_the_regressor_learns_heat_from_torque(make_heat_jobs):
    """The rise of joint 2 is its mean squared torque: a rule that the network can find, and a mean cannot."""
    plans, rise_k = make_heat_jobs(200)
    model = train_regressor(plans[:160], [1] * 160, rise_k[:160], TwinConfig(), 0, steps=150)
    error = model.predict(plans[160:], [1] * 40) - rise_k[160:]
    assert np.sqrt((error[:, 1] ** 2).mean()) < 0.6 * rise_k[160:, 1].std()
    with pytest.raises(ValueError, match="40 plans, 3 rows"):
        train_regressor(plans[:40], [1] * 40, rise_k[:3], TwinConfig(), 0, steps=1)


@pytest.fixture
def make_heat_jobs():
    from fleet.job import Place, Work
    from fleet.motion import Phase, Plan

    work = Work(kind="hold", places=(Place(name="bench", position_m=(0.4, 0.0, 0.3)),))
    empty = Phase(np.zeros((0, 3, 7), np.float32), np.zeros(0, np.float32))

    def make(count: int):
        rng = np.random.default_rng(0)
        plans, rises = [], []
        for _ in range(count):
            time = np.arange(400)[:, None] / 50.0
            size = rng.uniform(1.0, 20.0)
            tau = size * np.sin(2 * np.pi * (0.25 * time + rng.uniform(size=7)))
            profile = np.stack([0 * tau, 0 * tau, tau], axis=1).astype(np.float32)
            plans.append(Plan("arm", work, 0, 1.0, empty, Phase(profile, np.zeros(400, np.float32)), empty))
            rises.append(0.2 * (tau**2).mean(axis=0))
        return plans, np.array(rises)

    return make
