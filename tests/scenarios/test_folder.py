"""A run folder is whole or not there, and never takes the place of anything else."""

import json
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from fleet.errors import FleetError
from scenarios.build import prepare
from scenarios.folder import FILES, check_free, event_table, new_folder, telemetry_table, write
from scenarios.load import load
from scenarios.run import RunResult, RunSpec, run


@pytest.fixture
def result(small_toml: Path, plans: Path) -> RunResult:
    fleet = prepare(load(small_toml), difficulty="blind", cache=plans)
    return run(fleet, RunSpec(policy="round_robin", bus="memory", difficulty="blind"))


def an_earlier_run(folder: Path, status: str) -> None:
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"status": status}), encoding="utf-8")


def test_the_folder_appears_at_the_end_and_all_at_once(tmp_path):
    out = tmp_path / "deep" / "run"
    with new_folder(out) as work:
        (work / "run.json").write_text("{}", encoding="utf-8")
        assert not out.exists()
        assert work.name.startswith(".run.")
        assert work.parent == out.parent
    assert [p.name for p in out.iterdir()] == ["run.json"]
    assert [p.name for p in out.parent.iterdir()] == ["run"]
    assert out.stat().st_mode & 0o777 == 0o755


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_leaves_nothing_not_even_the_folders_on_the_way(tmp_path, error):
    def fail_after_writing(work: Path) -> None:
        (work / "run.json").write_text("{}", encoding="utf-8")
        raise error

    with pytest.raises(error), new_folder(tmp_path / "deep" / "run") as work:
        fail_after_writing(work)
    assert list(tmp_path.iterdir()) == []


def test_an_error_leaves_an_earlier_run_as_it_was(tmp_path):
    out = tmp_path / "run"
    an_earlier_run(out, "interrupted")
    with pytest.raises(ValueError, match="no"), new_folder(out):
        raise ValueError("no")
    assert json.loads((out / "run.json").read_text()) == {"status": "interrupted"}
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize(("status", "overwrite"), [("interrupted", False), ("finished", True)])
def test_a_run_that_may_be_replaced_is(tmp_path, status, overwrite):
    out = tmp_path / "run"
    an_earlier_run(out, status)
    with new_folder(out, overwrite=overwrite) as work:
        (work / "report.html").write_text("new", encoding="utf-8")
    assert [p.name for p in out.iterdir()] == ["report.html"]
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_a_finished_run_is_not_replaced_unasked(tmp_path):
    an_earlier_run(tmp_path / "run", "finished")
    with pytest.raises(FleetError, match="holds a finished run; give another --out, or --overwrite to replace it"):
        check_free(tmp_path / "run", overwrite=False)


@pytest.mark.parametrize(
    "files",
    [
        {"notes.txt": "mine"},
        {"run.json": '{"status": "finished"}', "notes.txt": "mine"},
        {"report.html": "somebody's"},
        {"run.json": "[1, 2]"},
        {"run.json": "not json"},
        {"run.json": '{"status": "of the union"}'},
    ],
)
def test_a_folder_with_anything_else_is_refused_even_to_overwrite(tmp_path, files):
    out = tmp_path / "run"
    out.mkdir()
    for name, text in files.items():
        (out / name).write_text(text, encoding="utf-8")
    with pytest.raises(FleetError, match=r"holds other things \('.+'\); --out needs a new folder or an earlier run"):
        check_free(out, overwrite=True)


def test_an_empty_folder_is_free(tmp_path):
    (tmp_path / "run").mkdir()
    with new_folder(tmp_path / "run"):
        pass
    assert (tmp_path / "run").is_dir()


def test_a_file_in_the_way_is_named(tmp_path):
    file = tmp_path / "file"
    file.write_text("", encoding="utf-8")
    with pytest.raises(FleetError, match="it is a file; --out needs a folder"):
        check_free(file, overwrite=True)
    with pytest.raises(FleetError, match=rf"Cannot write to '{file}/a/b': '{file}' is a file, not a folder"):
        check_free(file / "a" / "b", overwrite=False)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system that nobody may write to")
def test_a_place_where_nobody_may_write_is_told():
    with pytest.raises(FleetError, match="Cannot write to '/proc/run': "), new_folder(Path("/proc/run")):
        pass


def test_a_disk_that_refuses_at_the_end_is_told(result, tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    shutil.rmtree(gone)
    with pytest.raises(FleetError, match=r"Cannot write to '.*gone': No such file or directory"):
        write(result, gone)


def test_the_files_of_a_run_read_back_as_documented(result, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    write(result, folder)
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
    table = telemetry_table(result.telemetry, ["left", "right"])
    rows = table.slice(6, 2).to_pylist()
    assert [(row["time_s"], row["arm"]) for row in rows] == [(4.0, "left"), (4.0, "right")]
    for a, row in enumerate(rows):
        assert row["temp_c_2"] == pytest.approx(float(result.telemetry.temp_c[3, a, 1]), rel=1e-6)
        assert row["qd_7"] == pytest.approx(float(result.telemetry.qd[3, a, 6]), rel=1e-6)


def test_events_keep_their_order_and_their_values(result):
    rows = event_table(result.events).to_pylist()
    assert [row["time_s"] for row in rows] == sorted(event.time_s for event in result.events)
    awards = [row for row in rows if row["kind"] == "award"]
    assert {row["arm"] for row in awards} <= {"left", "right"}
    assert awards[0]["job"]
