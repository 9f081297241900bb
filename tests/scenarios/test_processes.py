"""Processes, signals, progress and result folders: what is kept of an interrupted run."""

import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from joblib import delayed

from fleet.errors import FleetError
from scenarios.processes import Call, LocalWorker, worker_processes
from scenarios.progress import HINTS, Count, StageClock
from scenarios.result_folder import check_free, lock_folder, new_folder
from scenarios.run.log import FILES, RUN
from scenarios.signals import until_stopped
from scenarios.table import Table
from scenarios.terminal import Interrupted, SafeConsole, echo, progress_bar
from tests.scenarios.conftest import QUICK, run_json
from tests.waiting import PATIENCE_S, PAUSE, wait_until


def nested(n: int) -> list[int]:
    with worker_processes(2, in_order=True) as pool:
        return list(pool(delayed(abs)(-k) for k in range(n)))


@pytest.mark.parametrize("count", [1, 2])
def test_work_inside_work_is_done(count):
    with worker_processes(count, in_order=True) as pool:
        assert list(pool(delayed(nested)(n) for n in range(4))) == [list(range(n)) for n in range(4)]


@pytest.mark.ci_slow
def test_processes_end_with_the_one_that_began_them(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(
        textwrap.dedent("""
            import os, signal, threading
            from joblib import delayed
            from scenarios.processes import worker_processes

            def work(first):
                if first:
                    os.kill(os.getppid(), signal.SIGKILL)
                threading.Event().wait(600)

            if __name__ == "__main__":
                with worker_processes(2) as pool:
                    list(pool(delayed(work)(first) for first in (True, False)))
        """)
    )
    # Returns when no process has its output open.
    killed = subprocess.run([sys.executable, str(script)], capture_output=True, timeout=300, check=False)
    assert killed.returncode == -signal.SIGKILL


def die_once(marker: Path) -> str:
    """Ends its process the first time."""
    if not marker.exists():
        marker.touch()
        os._exit(1)
    return "done"


KEPT = []


def grow():
    """Keep more memory than loky grants a process, so that it ends after this."""
    PAUSE.wait(1.1)  # the time between its checks
    KEPT.append(np.ones(50_000_000))
    return os.getpid()


def test_a_process_that_ends_as_it_gets_work_is_replaced(monkeypatch):
    monkeypatch.setattr("scenarios.processes.IDLE_S", 0.3)
    worker = LocalWorker()
    ran = [worker.submit(Call(n, function, ())).result(PATIENCE_S) for n, function in enumerate((os.getpid, grow))]
    ran += [worker.submit(Call(n, os.getpid, ())).result(PATIENCE_S) for n in range(2)]
    for pause_s in (0.29, 0.3):
        PAUSE.wait(pause_s)
        ran.append(worker.submit(Call(9, os.getpid, ())).result(PATIENCE_S))
    assert len(set(ran)) >= 2
    worker.close()


def test_work_of_a_process_that_died_is_done_again(tmp_path):
    with worker_processes(2, in_order=True) as pool:
        calls = [delayed(die_once)(tmp_path / "died"), delayed(abs)(-1), delayed(abs)(-2)]
        assert list(pool(calls)) == ["done", 1, 2]
        with pytest.raises(FleetError, match=r"The process that ran _exit died 3 times\."):
            list(pool([delayed(os._exit)(1), delayed(abs)(-1)]))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_asks_for_an_end_and_breaks_nothing_off(number):
    with until_stopped() as stop:
        assert not stop.is_set()
        assert not stop.wait(0.01)
        os.kill(os.getpid(), number)
        assert stop.wait(PATIENCE_S)
        assert stop.is_set()
    if number == signal.SIGTERM:
        stop.leave("said to nobody")
    else:
        with pytest.raises(Interrupted, match="the journal is whole"):
            stop.leave("the journal is whole")


def test_one_that_was_not_told_to_stop_leaves_without_a_word():
    with until_stopped() as stop:
        pass
    assert not stop.is_set()
    stop.leave("said to nobody")


def test_a_signal_that_comes_while_waiting_wakes():
    with until_stopped() as stop:
        threading.Timer(0.05, lambda: os.kill(os.getpid(), signal.SIGTERM)).start()
        assert stop.wait(PATIENCE_S)


def test_ctrl_c_while_working_keeps_what_was_done_and_the_same_command_replaces_it(
    thermofleet, small_toml, tmp_path, press_ctrl_c
):
    out = tmp_path / "run"
    with press_ctrl_c():
        said = thermofleet("run", small_toml, *QUICK, "--out", out)
    assert said.code == 130
    assert "Interrupted after 40 s of 180 s: the shift until then is kept in " in said.err
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)
    assert run_json(out)["status"] == "interrupted"
    assert run_json(out)["time_s"] == 40.0
    thermofleet("run", small_toml, *QUICK, "--out", out).succeeded()
    assert run_json(out)["status"] == "finished"
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_a_second_ctrl_c_leaves_nothing(thermofleet, small_toml, tmp_path, press_ctrl_c):
    with press_ctrl_c(times=2):
        said = thermofleet("run", small_toml, *QUICK, "--out", tmp_path / "run")
    assert said.code == 130
    assert "Interrupted while working: nothing was written." in said.err
    assert [p.name for p in tmp_path.iterdir()] == ["heat.toml"]


def test_ctrl_c_while_planning_writes_nothing_and_keeps_the_plans(thermofleet, small_toml, tmp_path, monkeypatch):
    from fleet.arm.planner import Planner

    made = 0
    plan = Planner.plan

    def interrupted(self, work):
        nonlocal made
        if made == 2:
            raise KeyboardInterrupt
        made += 1
        return plan(self, work)

    own = tmp_path / "cache"
    monkeypatch.setenv("THERMOFLEET_CACHE", str(own))
    monkeypatch.setattr(Planner, "plan", interrupted)
    said = thermofleet("run", small_toml, *QUICK, "--out", tmp_path / "a" / "run")
    assert said.code == 130
    assert said.err.startswith("Interrupted while planning: nothing was written.")
    assert str(own) in said.err
    assert not (tmp_path / "a").exists()
    kept = [set(np.load(path).files) for path in (own / "plans").glob("*.npz")]
    assert sum("profile" in arrays for arrays in kept) == 2


def test_a_killed_run_leaves_only_a_folder_with_a_dot(small_toml, tmp_path):
    program = textwrap.dedent("""
        import os, signal, sys
        import scenarios.policy_loader
        from scenarios.cli.main import main

        class Killed:
            def reset(self, rng): pass
            def act(self, observations): os.kill(os.getpid(), signal.SIGKILL)

        scenarios.policy_loader.policy_of = lambda *name: Killed()
        main(sys.argv[1:])
    """)
    where = tmp_path / "runs"
    command = [sys.executable, "-c", program, "run", str(small_toml), *QUICK, "--out", str(where / "run")]
    killed = subprocess.run(command, capture_output=True, timeout=240, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert all(p.name.startswith(".run.") for p in where.iterdir())


def interrupted(stage: str, **bar: str) -> str:
    """What is said of Ctrl-C in this stage."""
    try:
        with progress_bar(**bar) as progress:
            progress(stage, 0.5)
            raise KeyboardInterrupt
    except Interrupted as error:
        return str(error)


def test_without_a_terminal_a_long_stage_says_what_goes_on_how_many_and_how_long(capsys, monkeypatch):
    """The lines come while a step reports nothing, as one that trains for a quarter of an hour."""
    lines: list[str] = []

    def has_said(count: int) -> bool:
        said = capsys.readouterr()
        assert said.out == ""
        lines.extend(said.err.splitlines())
        return len(lines) >= count

    monkeypatch.setattr("scenarios.terminal.AFTER_S", 1.0)
    monkeypatch.setattr("scenarios.terminal.EVERY_S", 0.1)
    with progress_bar() as progress:
        progress("planning", 0.5)  # over at once: no line
        progress("training", Count(1, 4))
        wait_until(lambda: has_said(3))
        progress("computing section 1 of 2: Latent map", 0.0)
        progress("computing section 2 of 2: Epochs", 0.5)
        progress("filming", 1.0)
    has_said(0)
    first, *again, one, two = lines
    assert first == f"Training the twins 1/4 ({HINTS['training']}) …"
    assert all(re.fullmatch(r"Training the twins 1/4: 25%, for \d+ s\.", line) for line in again)
    assert (one, two) == ("Computing section 1 of 2: Latent map", "Computing section 2 of 2: Epochs")


@given(
    first=st.floats(0, 0.5), pace=st.floats(1e-4, 0.01), spent_s=st.floats(10, 40), began_s=st.floats(0, 1e6)
)  # fmt: skip
def test_at_a_constant_pace_the_time_left_is_exact(first, pace, spent_s, began_s):
    clock = StageClock()
    assert clock.update("comparing", first, began_s)
    assert clock.left_s(began_s) is None
    now = first + pace * spent_s
    assert not clock.update("comparing", now, began_s + spent_s)
    assert clock.left_s(began_s + spent_s) == pytest.approx((1.0 - now) / pace, rel=1e-3)


def test_what_processes_work_on_is_taken_for_half_done():
    """Two processes make four models of one pace: after the first, 1.5 of the work are done."""
    clock = StageClock()
    clock.update("training", Count(0, 4, 2), 0.0)
    clock.update("training", Count(1, 4, 2), 30.0)
    assert clock.left_s(30.0) == pytest.approx(30.0 * 2.5 / 1.5)
    clock.update("training", Count(4, 4, 2), 90.0)
    assert clock.left_s(90.0) == 0.0


def test_a_stage_whose_name_counts_is_one_stage():
    clock = StageClock()
    assert [clock.update(f"iteration {n}, best {n / 7:.1f}", n / 9, n) for n in range(3)] == [True, False, False]
    assert clock.line(2.0) == "Iteration 2, best 0.3: 22%, for 2 s."
    assert clock.line(8.0) == "Iteration 2, best 0.3: 22%, about 28 s left of this stage."


def test_an_interruption_says_what_is_kept_and_where_or_that_nothing_was(monkeypatch, tmp_path):
    monkeypatch.setenv("THERMOFLEET_CACHE", str(tmp_path))
    assert interrupted("training") == (
        "Interrupted while training: nothing was written. Plans and twins already made are kept in "
        f"{tmp_path}, and the same command continues from there."
    )
    assert interrupted("learning the log", kept="") == "Interrupted while learning the log: nothing was written."


def test_text_from_others_cannot_move_the_cursor_or_reorder_a_line(capsys):
    odd = "a\x1b[2Jb\u202ec\x9bd"
    SafeConsole(width=200).print(Table(head=("name",), rows=((odd,),)))
    echo(odd)
    for line in capsys.readouterr().out.splitlines()[1:]:
        assert line.strip() == r"a\u001b[2Jb\u202ec\u009bd"


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


def test_of_two_writers_of_a_folder_the_second_is_refused_and_what_a_killed_one_left_is_removed(tmp_path):
    out, killed = tmp_path / "run", tmp_path / ".run.0a1b_2c3"
    killed.mkdir()
    (killed / "run.json").write_text("{}", encoding="utf-8")
    kept = tmp_path / ".run.old.0a1b2c3d"  # of an earlier run that was being replaced
    kept.mkdir()
    with new_folder(out, RUN) as work:
        assert set(tmp_path.iterdir()) == {work, kept}
        with pytest.raises(FleetError, match=r"Another process writes to '.*run'\. Wait for it"), new_folder(out, RUN):
            pass
        assert set(tmp_path.iterdir()) == {work, kept}
    assert set(tmp_path.iterdir()) == {out, kept}


def test_a_draft_that_another_process_has_removed_is_no_error_of_the_system(tmp_path):
    with (
        pytest.raises(FleetError, match=r"Another process writes to '.*run'"),
        lock_folder(tmp_path / "gone", tmp_path / "run"),
    ):
        pass
    with new_folder(tmp_path / "run", RUN) as work:
        (work / "report.html").write_text("new", encoding="utf-8")
    with pytest.raises(FleetError, match="other"), new_folder(tmp_path / "other", RUN) as work:
        work.rmdir()


def test_a_run_that_another_process_has_written_meanwhile_is_not_replaced(tmp_path):
    out = tmp_path / "run"
    with pytest.raises(FleetError, match="holds a finished run"), new_folder(out, RUN):
        an_earlier_run(out, "finished")
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_a_finished_run_is_not_replaced_unasked_and_a_file_in_the_way_is_named(tmp_path):
    an_earlier_run(tmp_path / "run", "finished")
    file = tmp_path / "file"
    file.write_text("", encoding="utf-8")
    for path, overwrite, said in (
        (tmp_path / "run", False, "holds a finished run; give another --out, or --overwrite to replace it"),
        (file, True, "it is a file; --out needs a folder"),
        (file / "a" / "b", False, rf"Cannot write to '{file}/a/b': '{file}' is a file, not a folder"),
    ):
        with pytest.raises(FleetError, match=said):
            check_free(path, RUN, overwrite=overwrite)


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


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system that nobody may write to")
def test_a_place_where_nobody_may_write_is_told():
    with pytest.raises(FleetError, match="Cannot write to '/proc/run': "), new_folder(Path("/proc/run"), RUN):
        pass
