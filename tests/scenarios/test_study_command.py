"""`thermofleet study`: errors, the result file and the tables."""

import json

import numpy as np
import pytest

from scenarios.studies.lifetime import arm_transfer, drift
from scenarios.studies.lifetime.arm_transfer import FURTHER, NOTHING, RESCALED, Cell, Trained
from scenarios.studies.lifetime.drift import DriftSize, Life
from scenarios.studies.lifetime.tables import drift_tables, transfer_tables


def cell(seed: int, further: tuple[float, float]) -> Cell:
    errors = {NOTHING: (0.6, 0.5), RESCALED: (0.55, 0.52), FURTHER: further}
    rows = [
        Trained(start, jobs, 10, 1.0, error, float("nan"))
        for start, pair in errors.items()
        for jobs, error in zip((5, 40), pair, strict=True)
    ]
    return Cell("tool", seed, (1.0, 8.0), 0.7, tuple(rows))


def test_the_share_of_data_is_that_of_equal_error():
    assert cell(1, (0.5, 0.4)).data_ratio(FURTHER) == 5 / 40
    assert cell(1, (0.55, 0.45)).data_ratio(FURTHER) == pytest.approx(np.sqrt(5 * 40) / 40)
    assert cell(1, (0.5, 0.4)).data_ratio(RESCALED) == 2.0
    assert transfer_tables([cell(1, (0.5, 0.4))])[1].rows[0][3] == "0.12"


def test_delays_and_false_alarms_are_counted_from_the_onset():
    size = DriftSize(days=40, onset=20, reference=10)
    none = {name: () for name in drift.WATCHED}
    lives = [
        Life("none", 1, "never", none | {"thermal": (15, 30)}, (), 1.0, 0.05),
        Life("wear", 1, "never", none | {"thermal": (15, 26), "p_value": (23,)}, (), 2.0, 0.1),
    ]
    delays, _ = drift_tables(lives, size)
    rows = {row[0]: row[1:] for row in delays.rows}
    assert rows["wear"] == ("– (0 of 1)", "3 (1 of 1)", "6 (1 of 1)")
    assert rows["false alarms per 100 days"] == ("0.00", "0.00", "7.50")  # 3 alarms in 30 + 10 watched days
    assert drift.delay_days(lives[1], 20) == 3


def test_a_study_writes_every_measurement_and_the_command(thermofleet, monkeypatch, tmp_path):
    monkeypatch.setattr(arm_transfer, "arm_transfer", lambda seeds, size, progress: (cell(4, (0.5, 0.4)),))
    said = thermofleet(
        "study", "transfer", "--quick", "--seeds", "1", "--first-seed", "4", "--out", tmp_path / "r.json"
    )
    assert said.code == 0
    assert "0.12" in said.out
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["command"] == "thermofleet study transfer --quick --seeds 1 --first-seed 4"
    assert result["seeds"] == [4]
    assert result["rows"][0]["trained"][0] == {
        "start": NOTHING, "jobs": 5, "steps": 10, "cpu_s": 1.0, "error": 0.6, "auroc": None
    }  # fmt: skip


def test_errors_name_the_studies(thermofleet, tmp_path):
    said = thermofleet("study", "transfers")
    assert said.code == 2
    assert "transfer" in said.err
    said = thermofleet("study", "drift", "--log", tmp_path)
    assert said.code == 2
    assert "--log belongs to the study 'transfer'" in said.err
