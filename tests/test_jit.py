"""Messages about compiling."""

import os
import subprocess
import sys
from pathlib import Path

MESSAGE = "Compiling the simulation engine"
DRAW = """
import numpy as np
from fleet.env.random_actions import random_legal
print(random_legal(np.eye(3, dtype=np.int8), np.random.default_rng(0)))
"""


def start(home: Path, **variables: str) -> str:
    """Messages of a process that runs one kernel."""
    env = os.environ | {"XDG_CACHE_HOME": str(home)} | variables
    process = subprocess.run(
        [sys.executable, "-c", DRAW], env=env, capture_output=True, text=True, timeout=120, check=True
    )
    assert process.stdout == "[0 1 2]\n"
    return process.stderr


def test_only_the_first_process_compiles(tmp_path):
    first = start(tmp_path)
    assert first.count(MESSAGE) == 1
    assert str(tmp_path) in first
    assert start(tmp_path) == ""


def test_nothing_is_compiled_where_that_is_switched_off(tmp_path):
    assert start(tmp_path, NUMBA_DISABLE_JIT="1") == ""
