"""Whole fleets in one process, on a simulated network, clock and disk (benchmarks/simulation)."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def simulate(*arguments, hash_seed="0"):
    return subprocess.run(
        [sys.executable, "-m", "benchmarks.simulation", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
        env=os.environ | {"PYTHONHASHSEED": hash_seed},
    )


def test_no_rule_is_broken_under_faults():
    told = simulate("--seeds", "6")
    assert told.returncode == 0, told.stdout + told.stderr


def test_a_seed_repeats_the_same_events_in_every_process():
    one, other = (simulate("--seed", "3", hash_seed=seed) for seed in ("1", "2"))
    assert one.returncode == 0, one.stdout[-2000:] + one.stderr
    digests = [re.search(r"^digest (\w+)$", told.stdout, re.MULTILINE).group(1) for told in (one, other)]
    assert digests[0] == digests[1]


@pytest.mark.ci_slow
@pytest.mark.parametrize(
    "mutation", ["submission-unwritten", "commit-ignored", "space-ignored", "repeats-recorded", "pause-ignored"]
)
def test_a_rule_that_is_broken_on_purpose_is_found(mutation):
    told = simulate("--mutations", mutation)
    assert told.returncode == 0, told.stdout + told.stderr
    assert re.search(rf"^\| `{mutation}` .* \| \d+ \| .+ \|$", told.stdout, re.MULTILINE)
