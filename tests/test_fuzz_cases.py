"""Inputs of every parser: those of `make fuzz` that once failed, and those that it starts from."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PARSE = """
import sys
from pathlib import Path
from benchmarks.fuzz.targets import TARGETS
for name in sys.argv[1:]:
    cases = Path("tests/fuzz_cases") / name
    for data in [*TARGETS[name].seeds(), *(path.read_bytes() for path in cases.glob("*"))]:
        TARGETS[name].parse(data)
"""


@pytest.mark.parametrize(
    "names", [("scenario", "message", "key", "jobs", "journal", "log", "settings"), ("checkpoint",)]
)
def test_every_parser_handles_its_cases(names):
    """In a process of its own, as the targets keep files in its folder."""
    done = subprocess.run(
        [sys.executable, "-c", PARSE, *names], cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
