"""The sweep of configurations: resumable rows, and what the table says of them."""

import json
from dataclasses import replace

import pytest

from fleet.errors import FleetError
from scenarios.json_rows import Rows
from scenarios.load import load
from scenarios.studies.sweep import measure
from scenarios.studies.sweep.configurations import CONFIGURATIONS, OURS, Configuration
from scenarios.studies.sweep.subjects import Sizes, subjects_of
from scenarios.studies.sweep.table import lines_of, table_of

TINY = {"hidden": 4, "max_windows": 32, "epochs": 1, "batch": 32}
ARM = {"arm": Configuration("scope", "one network", {**TINY, "scope": "arm"})}
TWO = {OURS: Configuration("ours", "tiny", TINY), "short": Configuration("window", "1 s", {**TINY, "window": 12})}


@pytest.fixture(scope="module")
def subjects():
    return list(subjects_of([load("heat_wave")], arms=[0], seeds=[1, 2], sizes=Sizes(train=10, reference=25, test=60)))


def test_a_stopped_sweep_goes_on_where_it_was(subjects, tmp_path, monkeypatch):
    file = tmp_path / "rows.jsonl"
    trained = []
    monkeypatch.setattr(
        measure, "train_all", lambda motions, config: trained.append(len(motions)) or train_all(motions, config)
    )
    first = measure.sweep(subjects[:1], {OURS: TWO[OURS]}, Rows(file))
    with file.open("a", encoding="utf-8") as stream:
        stream.write('{"key": "half a r')
    rows = measure.sweep(subjects, TWO, Rows(file))
    assert trained == [1, 1, 2]
    assert rows[0] == first[0]
    assert len(rows) == len(file.read_text(encoding="utf-8").splitlines()) == 4
    assert measure.sweep(subjects, TWO, Rows(file)) == rows
    assert trained == [1, 1, 2]
    # Side by side or alone: the same row but for the seconds.
    (alone,) = measure.sweep(subjects[1:], {OURS: TWO[OURS]}, Rows(tmp_path / "alone.jsonl"))
    for label in measure.LABELS:
        for score, values in alone[label].items():
            assert values == pytest.approx(rows[1][label][score], abs=0.02)


train_all = measure.train_all


def test_networks_up_to_the_carrier_only(subjects, tmp_path):
    """Joint 2 of a standing arm carries, so two networks are trained, and d of that joint is all there is."""
    alone = replace(subjects[0], carrier_only=True)
    (row,) = measure.sweep([alone], {OURS: TWO[OURS]}, Rows(tmp_path / "rows.jsonl"))
    assert row["carrier"] == 2
    assert len(row["kl"]) == 1 + 2
    assert [list(row[label]) for label in measure.LABELS] == [["carrier"]] * 3
    heads, (cells,) = table_of(lines_of([row], TWO))
    assert len(heads) == len(cells) == 12
    assert not any("any joint" in head for head in heads)
    assert measure.key_of(OURS, TWO[OURS].config, alone) != measure.key_of(OURS, TWO[OURS].config, subjects[0])


def test_a_file_of_something_else_is_refused(tmp_path):
    (tmp_path / "notes.jsonl").write_text("hello\n", encoding="utf-8")
    with pytest.raises(FleetError, match="line 1: not a row of this study"):
        Rows(tmp_path / "notes.jsonl")


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


def test_show_without_such_rows_is_an_error(thermofleet, tmp_path):
    show = ("--show", "--out", tmp_path / "rows.jsonl")
    for command in ("sweep", "parsimony"):
        said = thermofleet("twin", command, *show)
        assert said.code == 2
        assert "has no such row" in said.err
        assert "--arms must be 0 to 3" in thermofleet("twin", command, *show, "--arms", "0,4").err
    assert not (tmp_path / "rows.jsonl").exists()
    (tmp_path / "rows.jsonl").write_text(
        json.dumps({"key": key_of_first(), "configuration": OURS, "subject": "s"}) + "\n", encoding="utf-8"
    )
    said = thermofleet("twin", "sweep", *show, "--scenarios", "heat_wave", "--arms", "0,0")
    assert said.code == 2
    assert "has a missing or odd value" in said.err


def key_of_first() -> str:
    (subject,) = subjects_of([load("heat_wave")], arms=[0], seeds=[1], sizes=Sizes())
    return measure.key_of(OURS, CONFIGURATIONS[OURS].config, subject)


def made_up(configuration: str, subject: str, auroc: float) -> dict:
    quality = {measure_: auroc for measure_ in ("auroc", "auprc", "spearman")}
    scores = {label: dict.fromkeys(measure.SCORES, quality) for label in measure.LABELS}
    card = {"configuration": configuration, "subject": subject, "epochs": 60, "cpu_s": 20.0}
    return {**card, **scores, "kl": [2.0], "active_units": [2], "mse": [0.4]}


def test_differences_are_paired_by_arm():
    """Arms that differ much among themselves, and a configuration that is better on each by as much."""
    rows = [made_up(OURS, f"arm_{i}", v) for i, v in enumerate((0.5, 0.7, 0.9))]
    rows += [made_up("latent_4", f"arm_{i}", v + 0.05 + 0.001 * i) for i, v in enumerate((0.5, 0.7, 0.9))]
    ours, better = lines_of(rows, CONFIGURATIONS)
    assert ours.measures["AUROC"].lead is None
    cell = better.measures["AUROC"]
    assert cell.own.margin > 0.4
    assert cell.lead is not None
    assert cell.lead.mean == pytest.approx(0.051)
    assert str(cell) == ".751 (+.051 ± .002*)"
    again = [{**row, "subject": f"{row['subject']}/{seed}"} for row in rows for seed in (1, 2)]
    assert lines_of(again, CONFIGURATIONS)[1].measures["AUROC"] == cell  # seeds of one arm are no further arms


def test_every_configuration_can_be_and_the_base_is_ours():
    configs = {name: each.config for name, each in CONFIGURATIONS.items()}
    assert configs[OURS] == configs["moment"]
    assert len({json.dumps(vars(config), sort_keys=True) for config in configs.values()}) == len(configs) - 2


def test_the_command_prints_the_table_of_what_is_there(thermofleet, tmp_path, monkeypatch):
    monkeypatch.setattr("scenarios.studies.sweep.configurations.CONFIGURATIONS", TWO | ARM)
    sizes = ("--scenarios", "heat_wave", "--arms", "0", "--test", 100, "--out", tmp_path / "rows.jsonl")
    said = thermofleet("twin", "sweep", *sizes, "--only", OURS, "--format", "markdown")
    assert said.code == 0, said.err
    assert said.out.splitlines()[2].startswith("| ours | tiny |")
    assert "No configuration 'beta'" in thermofleet("twin", "sweep", *sizes, "--only", "beta").err
    assert "leave out --carrier-only" in thermofleet("twin", "sweep", *sizes, "--carrier-only", "--only", "arm").err
    assert "--arms must be whole numbers" in thermofleet("twin", "sweep", "--arms", "x").err
