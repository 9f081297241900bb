"""A result folder is complete or absent, and never replaces anything but an earlier result of its kind."""

import json
from pathlib import Path

import pytest

from fleet.errors import FleetError
from scenarios.result_folder import check_free, new_folder
from scenarios.run.log import RUN


def an_earlier_run(folder: Path, status: str) -> None:
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"status": status}), encoding="utf-8")


def test_the_folder_appears_at_the_end_and_all_at_once(tmp_path):
    out = tmp_path / "deep" / "run"
    with new_folder(out, RUN) as work:
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

    with pytest.raises(error), new_folder(tmp_path / "deep" / "run", RUN) as work:
        fail_after_writing(work)
    assert list(tmp_path.iterdir()) == []


def test_an_error_leaves_an_earlier_run_as_it_was(tmp_path):
    out = tmp_path / "run"
    an_earlier_run(out, "interrupted")
    with pytest.raises(ValueError, match="no"), new_folder(out, RUN):
        raise ValueError("no")
    assert json.loads((out / "run.json").read_text()) == {"status": "interrupted"}
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize(("status", "overwrite"), [("interrupted", False), ("finished", True)])
def test_a_run_that_may_be_replaced_is(tmp_path, status, overwrite):
    out = tmp_path / "run"
    an_earlier_run(out, status)
    with new_folder(out, RUN, overwrite=overwrite) as work:
        (work / "report.html").write_text("new", encoding="utf-8")
    assert [p.name for p in out.iterdir()] == ["report.html"]
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_a_finished_run_is_not_replaced_unasked(tmp_path):
    an_earlier_run(tmp_path / "run", "finished")
    with pytest.raises(FleetError, match="holds a finished run; give another --out, or --overwrite to replace it"):
        check_free(tmp_path / "run", RUN, overwrite=False)


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
    with pytest.raises(FleetError, match=r"holds other files \('.+'\); --out needs a new folder or an earlier run"):
        check_free(out, RUN, overwrite=True)


def test_an_empty_folder_is_free(tmp_path):
    (tmp_path / "run").mkdir()
    with new_folder(tmp_path / "run", RUN):
        pass
    assert (tmp_path / "run").is_dir()


def test_a_file_in_the_way_is_named(tmp_path):
    file = tmp_path / "file"
    file.write_text("", encoding="utf-8")
    with pytest.raises(FleetError, match="it is a file; --out needs a folder"):
        check_free(file, RUN, overwrite=True)
    with pytest.raises(FleetError, match=rf"Cannot write to '{file}/a/b': '{file}' is a file, not a folder"):
        check_free(file / "a" / "b", RUN, overwrite=False)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system that nobody may write to")
def test_a_place_where_nobody_may_write_is_told():
    with pytest.raises(FleetError, match="Cannot write to '/proc/run': "), new_folder(Path("/proc/run"), RUN):
        pass
