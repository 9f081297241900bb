"""The sweep of configurations, and quality by amount of data: resumable rows, and what their tables say."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.paper import harness, sweep
from benchmarks.paper.subjects import Sizes, subjects_of
from benchmarks.paper.sweep import (
    CONFIGURATIONS,
    OURS,
    PARSIMONY,
    SWEEP,
    Configuration,
    key_of,
    parsimony_rows,
    sweep_rows,
    sweep_tables,
    train_regressor,
)
from fleet.errors import FleetError
from scenarios.json_rows import Rows
from twin.vae.config import TwinConfig

TINY = {"hidden": 4, "max_windows": 32, "epochs": 1, "batch": 32}
TWO = {OURS: Configuration("ours", "tiny", TINY), "short": Configuration("window", "1 s", {**TINY, "window": 12})}


@pytest.fixture(scope="module")
def subjects():
    return subjects_of(["heat_wave"], arms=[0], seeds=[1, 2], sizes=Sizes(train=10, reference=25, test=60))


def rows_of(subject, configurations):
    keys = [key_of(name, each.config, subject) for name, each in configurations.items()]
    return [row for _, row in sweep_rows(subject, configurations, keys)]


def test_only_the_asked_rows_are_trained(subjects, monkeypatch):
    trained = []
    monkeypatch.setattr(sweep, "train", lambda *args, **names: trained.append(1) or train(*args, **names))
    both = rows_of(subjects[0], TWO)
    assert len(trained) == len(both) == 2
    ((key, alone),) = sweep_rows(subjects[0], TWO, [key_of("short", TWO["short"].config, subjects[0])])
    assert len(trained) == 3
    assert key.startswith("short/heat_wave/arm_0/1/")
    assert {**alone, "cpu_s": 0} == {**both[1], "cpu_s": 0}


train = sweep.train


def test_networks_up_to_the_carrier_only(subjects):
    """Joint 2 of a standing arm carries, so two networks are trained, and d of that joint is all there is."""
    alone = replace(subjects[0], carrier_only=True)
    (row,) = rows_of(alone, {OURS: TWO[OURS]})
    assert row["carrier"] == 2
    assert len(row["kl"]) == 1 + 2
    assert [list(row[label]) for label in sweep.HOT] == [["carrier"]] * 3
    table = sweep_tables([row])["sweep"]
    assert len(table.head) == len(table.rows[0]) == 12
    assert not any("any joint" in head for head in table.head)
    assert key_of(OURS, TWO[OURS].config, alone) != key_of(OURS, TWO[OURS].config, subjects[0])


def made_up(configuration: str, subject: str, auroc: float) -> dict:
    quality = dict.fromkeys(("auroc", "auprc", "spearman"), auroc)
    scores = {label: dict.fromkeys(sweep.SCORES, quality) for label in sweep.HOT}
    card = {"configuration": configuration, "subject": subject, "epochs": 60, "cpu_s": 20.0}
    return {**card, **scores, "kl": [2.0], "active_units": [2], "mse": [0.4]}


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


def test_every_configuration_can_be_and_the_base_is_ours():
    configs = {name: each.config for name, each in CONFIGURATIONS.items()}
    assert configs[OURS] == configs["moment"]
    assert len({json.dumps(vars(config), sort_keys=True) for config in configs.values()}) == len(configs) - 2


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--only", "beta"), "No configuration 'beta'"),
        (("--carrier-only", "--only", "whole_arm"), "leave out --carrier-only"),
        (("--arms", "0,4"), "--arms must be 0 to 3"),
    ],
)
def test_options_are_checked(words, says, tmp_path):
    with pytest.raises(FleetError, match=says):
        harness.run("sweep", SWEEP, [*words, "--out", str(tmp_path / "rows.jsonl")])
    assert not (tmp_path / "rows.jsonl").exists()


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


def test_rows_of_each_model_and_amount(monkeypatch, subjects):
    monkeypatch.setattr(sweep, "JOBS", (3, 6))
    monkeypatch.setattr(sweep, "STEPS", 3)
    subject = replace(subjects[0], carrier_only=True)
    keys = [sweep.parsimony_key(model, jobs, subject) for jobs in (3, 6) for model in sweep.MODELS]
    found = dict(parsimony_rows(subject, keys))
    assert list(found) == keys
    rows = list(found.values())
    assert [(row["model"], row["jobs"]) for row in rows] == [(m, n) for n in (3, 6) for m in sweep.MODELS]
    assert all(0.0 <= row["auroc"] <= 1.0 for row in rows)
    assert rows[0]["minutes"] < rows[3]["minutes"]
    assert len(PARSIMONY.tables(rows)["parsimony"].rows) == 6


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
