"""The files of a run read back as documented."""

import json
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from fleet.errors import FleetError
from scenarios.prepare.fleet import prepare
from scenarios.run.log import FILES, event_table, telemetry_table
from scenarios.run.shift import RunLog, run
from scenarios.spec.load import load
from scenarios.spec.options import RunSpec


@pytest.fixture
def result(small_toml: Path, plans: Path) -> RunLog:
    fleet = prepare(load(small_toml), difficulty="blind", cache=plans)
    return run(fleet, RunSpec(policy="round_robin", bus="memory", difficulty="blind"))


def test_a_disk_that_refuses_at_the_end_is_told(result, tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    shutil.rmtree(gone)
    with pytest.raises(FleetError, match=r"Cannot write to '.*gone': No such file or directory"):
        result.write(gone)


def test_the_files_of_a_run_read_back_as_documented(result, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    result.write(folder)
    assert sorted(p.name for p in folder.iterdir()) == sorted(FILES)
    told = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert told["status"] == "finished"
    telemetry = pq.read_table(folder / "telemetry.parquet")
    joints = [f"{name}_{j}" for name in ("q", "qd", "tau", "current_a", "temp_c") for j in range(1, 8)]
    assert telemetry.column_names == ["time_s", "arm", "mode", *joints]
    assert telemetry.num_rows == 2 * round(told["time_s"])
    assert set(telemetry["arm"].to_pylist()) == {"left", "right"}
    assert set(telemetry["mode"].to_pylist()) <= {"idle", "working", "faulted"}
    events = pq.read_table(folder / "events.parquet")
    assert events.column_names == ["time_s", "kind", "arm", "job", "joint", "value", "reason"]
    assert events.num_rows == len(result.events)
    assert "<html" in (folder / "report.html").read_text(encoding="utf-8")


def test_telemetry_rows_go_arm_by_arm_within_a_moment(result):
    table = telemetry_table(result.readings, ["left", "right"])
    rows = table.slice(6, 2).to_pylist()
    assert [(row["time_s"], row["arm"]) for row in rows] == [(4.0, "left"), (4.0, "right")]
    for a, row in enumerate(rows):
        assert row["temp_c_2"] == pytest.approx(float(result.readings.temp_c[3, a, 1]), rel=1e-6)
        assert row["qd_7"] == pytest.approx(float(result.readings.qd[3, a, 6]), rel=1e-6)


def test_events_keep_their_order_and_their_values(result):
    rows = event_table(result.events).to_pylist()
    assert [row["time_s"] for row in rows] == sorted(event.time_s for event in result.events)
    awards = [row for row in rows if row["kind"] == "award"]
    assert {row["arm"] for row in awards} <= {"left", "right"}
    assert awards[0]["job"]
