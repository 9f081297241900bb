"""What the first start on a machine says about compiling."""

import os
import subprocess
import sys
from pathlib import Path

SAID = "The first step compiles the engine"
DRAW = """
import numpy as np
from fleet.env.chance import random_legal
print(random_legal(np.eye(3, dtype=np.int8), np.random.default_rng(0)))
"""


def start(home: Path, **variables: str) -> str:
    """What a process that has one compiled function and runs it says on stderr."""
    env = os.environ | {"XDG_CACHE_HOME": str(home)} | variables
    said = subprocess.run(
        [sys.executable, "-c", DRAW], env=env, capture_output=True, text=True, timeout=120, check=True
    )
    assert said.stdout == "[0 1 2]\n"
    return said.stderr


def test_the_first_start_says_that_it_compiles_and_later_ones_say_nothing(tmp_path):
    first = start(tmp_path)
    assert first.count(SAID) == 1
    assert str(tmp_path) in first
    assert start(tmp_path) == ""


def test_what_is_not_compiled_is_not_announced(tmp_path):
    assert start(tmp_path, NUMBA_DISABLE_JIT="1") == ""
