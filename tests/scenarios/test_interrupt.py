"""Interrupted and killed runs: what is kept, and what is not."""

import json
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np

from scenarios.run.log import FILES

QUICK = ("--difficulty", "blind", "--bus", "memory", "--policy", "round_robin")


def run_json(folder: Path) -> dict:
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


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
    assert thermofleet("run", small_toml, *QUICK, "--out", out).code == 0
    assert run_json(out)["status"] == "finished"
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_a_second_ctrl_c_leaves_nothing(thermofleet, small_toml, tmp_path, press_ctrl_c):
    with press_ctrl_c(times=2):
        said = thermofleet("run", small_toml, *QUICK, "--out", tmp_path / "run")
    assert said.code == 130
    assert "Interrupted while working: nothing was written." in said.err
    assert [p.name for p in tmp_path.iterdir()] == ["heat.toml"]


def test_afterwards_ctrl_c_is_as_it_was(thermofleet, small_toml, tmp_path):
    before = signal.getsignal(signal.SIGINT)
    thermofleet("run", small_toml, *QUICK, "--out", tmp_path / "run")
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_while_planning_writes_nothing_and_keeps_the_plans(
    thermofleet, small_toml, tmp_path, monkeypatch, plans
):
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


def test_a_killed_run_leaves_only_a_folder_with_a_dot(small_toml, tmp_path, plans):
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
    env = {**os.environ, "THERMOFLEET_CACHE": str(plans)}
    killed = subprocess.run(command, env=env, capture_output=True, timeout=240, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert all(p.name.startswith(".run.") for p in where.iterdir())


def test_the_processes_of_a_killed_comparison_end_with_it(small_toml, tmp_path, plans):
    policy = tmp_path / "killer.py"
    policy.write_text(
        textwrap.dedent("""
            import os, signal, threading

            class Killer:
                scope = "central"
                def reset(self, rng): pass
                def act(self, observations):
                    os.kill(os.getppid(), signal.SIGKILL)
                    threading.Event().wait(600)
        """)
    )
    command = [sys.executable, "-m", "scenarios", "compare", str(small_toml), "--difficulty", "blind", "--workers", "2"]
    command += ["--policies", f"{policy}:Killer,round_robin", "--seeds", "2", "--out", str(tmp_path / "out")]
    env = {**os.environ, "THERMOFLEET_CACHE": str(plans)}
    # Returns when no process has its output open.
    killed = subprocess.run(command, env=env, capture_output=True, timeout=240, check=False)
    assert killed.returncode == -signal.SIGKILL
