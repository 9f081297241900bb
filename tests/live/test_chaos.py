"""A short part of the campaign of benchmarks/chaos.py: real processes, real signals, and every job done once."""

import subprocess
import sys
from pathlib import Path

import pytest

CAMPAIGN = Path(__file__).parents[2] / "benchmarks" / "chaos.py"


def strike(*faults, jobs):
    return subprocess.run(
        [sys.executable, str(CAMPAIGN), "--only", ",".join(faults), "--jobs", str(jobs), "--speed", "240"],
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )


def test_a_fleet_survives_the_death_of_its_auctioneer():
    told = strike("kill-auctioneer", jobs=8)
    assert told.returncode == 0, told.stdout + told.stderr
    (row,) = [line.split() for line in told.stdout.splitlines() if line.split()[0] == "kill-auctioneer"]
    assert row[1:3] == ["8", "8"]  # all of them, and none twice, says the exit code


@pytest.mark.slow
def test_a_fleet_survives_every_fault():
    told = strike("kill-arm", "stop-arm", "kill-router", "stuck-subscriber", "full-disk", "rubbish", jobs=24)
    assert told.returncode == 0, told.stdout + told.stderr
