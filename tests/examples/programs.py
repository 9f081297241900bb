"""The examples and the command line as processes."""

import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]


def program(name, *arguments):
    return [sys.executable, "-u", str(ROOT / "examples" / f"{name}.py"), *map(str, arguments)]


@contextmanager
def killed_afterwards(process):
    try:
        yield process
    finally:
        process.kill()
        process.communicate(timeout=PATIENCE_S)


def started(command, **options):
    """A process that is killed at the end of the block; its output can be read."""
    return killed_afterwards(subprocess.Popen(command, stdout=subprocess.PIPE, text=True, **options))


@contextmanager
def running(name, *arguments):
    """An example in a separate process, once it has printed that it is ready."""
    with started(program(name, *arguments), stderr=subprocess.STDOUT) as process:
        line = process.stdout.readline()
        assert line.startswith("ready"), line + process.stdout.read()
        yield process


def submit_jobs(port, *, timeout_s=PATIENCE_S):
    """Have the submitter submit its jobs to the fleet f and see them finished."""
    command = program("submit_jobs", port, "f")
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 of 3 jobs finished" in done.stdout
