"""Whole fleets in one process, on a simulated network, clock and disk (benchmarks/simulation)."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.simulation.mutations import MUTATIONS

ROOT = Path(__file__).parents[2]
FIND_SOON = ("submission-unwritten", "commit-ignored", "space-ignored", "repeats-recorded", "pause-ignored")


def simulate(*arguments, hash_seed="0"):
    return subprocess.run(
        [sys.executable, "-m", "benchmarks.simulation", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=3600,
        check=False,
        env=os.environ | {"PYTHONHASHSEED": hash_seed},
    )


@pytest.mark.parametrize("first", [pytest.param(0, marks=pytest.mark.slow), pytest.param(8, marks=pytest.mark.ci_slow)])
def test_no_rule_is_broken_under_faults(first):
    done = simulate("--first", str(first), "--seeds", "8")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.ci_slow
@pytest.mark.parametrize("seed", ["3", "104"], ids=["auctioneer", "consensus"])
def test_a_seed_repeats_the_same_events_in_every_process(seed):
    one, other = (simulate("--seed", seed, hash_seed=hash_seed) for hash_seed in ("1", "2"))
    assert one.returncode == 0, one.stdout[-2000:] + one.stderr
    digests = [re.search(r"^digest (\w+)$", done.stdout, re.MULTILINE).group(1) for done in (one, other)]
    assert digests[0] == digests[1]


@pytest.mark.parametrize(
    "mutation",
    [pytest.param(name, marks=pytest.mark.ci_slow if name in FIND_SOON else pytest.mark.slow) for name in MUTATIONS],
)
def test_a_rule_that_is_broken_on_purpose_is_found(mutation):
    done = simulate("--mutations", mutation)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(rf"^\| `{mutation}` .* \| \d+ \| .+ \|$", done.stdout, re.MULTILINE)
