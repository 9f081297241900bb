"""Some faults of benchmarks/chaos: real processes, real signals, and every job done once."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.chaos.fleet_under_test import JournalFiles
from benchmarks.chaos.mesh import mesh
from fleet.bus.protocol.auction import Award, JobSpec, Report
from fleet.live.arm.awards import ArmHistory, ArmRecord, AwardAccepted, Closed
from fleet.live.journal import Journal

ROOT = Path(__file__).parents[2]


def strike(*faults, jobs, env=None):
    return subprocess.run(
        [sys.executable, "-m", "benchmarks.chaos", "--only", ",".join(faults), "--jobs", str(jobs), "--speed", "240"],
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
        cwd=ROOT,
        env=env,
    )


def test_jobs_are_counted_that_a_journal_has_left_out(tmp_path, monkeypatch):
    def close(journal, award, job):
        journal.append(
            AwardAccepted(Award(award, "r", "auctioneer", "q", JobSpec(job, "hold", ("x",)))),
            Closed(Report("a", award, job, "finished", 1, 0.0)),
        )

    files = JournalFiles(tmp_path)
    with Journal[ArmRecord](tmp_path / "a.journal", ArmRecord) as journal:
        close(journal, "1", "j")
        files.follow(0.0)
        with monkeypatch.context() as unchanged:
            unchanged.setattr(shutil, "copyfile", None)
            files.follow(0.0)  # copies nothing
        journal.rewrite(*ArmHistory().replay(journal.records()).compact())  # as at a start: the report is repeated
        files.follow(0.0)
        journal.rewrite()
        close(journal, "2", "j")
        close(journal, "3", "k")
        assert files.count_finished() == {"j": 2, "k": 1}


@pytest.mark.ci_slow
def test_a_fleet_survives_a_kill_of_its_auctioneer():
    told = strike("kill-auctioneer", jobs=8)
    assert told.returncode == 0, told.stdout + told.stderr
    (row,) = [line.split() for line in told.stdout.splitlines() if line.split()[0] == "kill-auctioneer"]
    assert row[1:3] == ["8", "8"]  # all of them, and none twice, says the exit code


@pytest.mark.ci_slow
def test_a_fleet_with_certificates_refuses_intruders():
    told = strike("trespass", jobs=12)
    assert told.returncode == 0, told.stdout + told.stderr
    tried, opened = map(int, re.search(r"(\d+) attempts, (\d+) successful", told.stdout).groups())
    assert tried >= 30
    assert opened == 0


@pytest.mark.ci_slow
def test_a_fault_that_this_machine_cannot_inject_is_skipped_and_not_passed():
    told = strike("clock-jump", jobs=12, env=os.environ | {"PATH": ""})
    assert told.returncode == 2, told.stdout + told.stderr
    *_, row, end = told.stdout.splitlines()
    assert row.strip() == "clock-jump  not run: a wall clock that jumps needs Linux and a C compiler, cc."
    assert end == "Not run: clock-jump."
    assert told.stderr == ""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="a clock that jumps needs a C compiler")
def test_a_jump_of_the_wall_clock_harms_nothing():
    told = strike("clock-jump", jobs=12)
    assert told.returncode == 0, told.stdout + told.stderr


@pytest.mark.slow
def test_arms_without_an_auctioneer_survive_a_kill_and_network_cuts():
    told = strike("alone-kill-arm", "alone-cut-one", "alone-halves", jobs=24)
    assert told.returncode == 0, told.stdout + told.stderr


@pytest.mark.slow
def test_a_fleet_survives_every_fault():
    processes = ("kill-arm", "stop-arm", "kill-router", "stuck-subscriber", "full-disk", "partition")
    told = strike(*processes, "malformed", "replayed-awards", jobs=24)
    assert told.returncode == 0, told.stdout + told.stderr


@pytest.mark.slow
def test_two_linked_routers_are_killed_and_cut_without_a_lost_job(tmp_path):
    arms, jobs = 4, 16
    outcome = mesh(tmp_path, arms=arms, jobs=jobs, speed=40.0)
    assert (outcome.lost, outcome.twice, outcome.exited, outcome.violations) == ((), (), (), ())
    assert outcome.finished + outcome.unfinished == jobs
    assert outcome.finished >= jobs - arms  # an unfinished job is one that an arm had when it was cut off
    assert all("inf" not in note for note in outcome.notes)  # all arms were present again after each fault
