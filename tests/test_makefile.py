"""`make` on a machine that lacks something says so in a sentence; the repository's own environment is not touched."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="needs make")


def make(goal: str, venv: Path, python: object) -> subprocess.CompletedProcess[str]:
    command = ["make", "-C", str(ROOT), "--no-print-directory", goal, f"VENV={venv}", f"PYTHON={python}"]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def script(path: Path, body: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{body}\n", encoding="utf-8")
    path.chmod(0o755)
    return path


PIP_FAILS = """\
echo 'WARNING: Retrying after connection broken'
echo '  ERROR: Could not find a version that satisfies the requirement daqp' >&2
echo 'ERROR: No matching distribution found for daqp' >&2
exit 1"""


@pytest.fixture
def stub(tmp_path: Path) -> Path:
    """A python that makes environments whose pip finds no network."""
    broken = script(tmp_path / "pip_fails", PIP_FAILS)
    body = f'case "$1 $2" in "-m venv") mkdir -p "$3/bin"; cp "{broken}" "$3/bin/python";; esac'
    return script(tmp_path / "python3", body)


NEEDS = "thermofleet needs Python 3.11 or newer, and "
ANOTHER = "make test PYTHON=/path/to/python3.11\n"
NO_VENV = 'case "$1 $2" in "-m venv") mkdir -p "$3/bin"; touch "$3/bin/python"; echo Traceback >&2; exit 1;; esac'


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (None, f"{NEEDS}there is no '{{python}}' here. Install it, or name one: {ANOTHER}"),
        (
            'case "$1" in -c) exit 1;; --version) echo Python 3.8.10;; esac',
            f"{NEEDS}'{{python}}' is Python 3.8.10. Name another: {ANOTHER}",
        ),
        (NO_VENV, "could not make an environment. On Debian and Ubuntu the package python3-venv is missing"),
    ],
    ids=["none", "too old", "without venv"],
)
def test_a_python_that_makes_no_environment(tmp_path, body, says):
    python = tmp_path / "python3"
    if body is not None:
        script(python, body)
    said = make("test", tmp_path / "venv", python)
    assert said.returncode != 0
    assert says.format(python=python) in said.stdout
    assert "Traceback" not in said.stdout + said.stderr
    assert not (tmp_path / "venv").exists()


def test_no_network(tmp_path, stub):
    venv = tmp_path / "venv"
    said = make("test", venv, stub)
    assert said.returncode != 0
    assert said.stdout.splitlines()[1:] == [
        "The packages could not be installed. The usual reason is no network: they are fetched once, later runs need "
        "none.",
        "pip said: Could not find a version that satisfies the requirement daqp",
        f"All that pip said is in {venv}/install.log; 'make test' tries again.",
    ]
    assert not (venv / ".installed").exists()
    assert "Retrying" in (venv / "install.log").read_text(encoding="utf-8")


def test_the_next_call_tries_again_and_then_not_any_more(tmp_path, stub):
    venv = tmp_path / "venv"
    make("install", venv, stub)
    script(venv / "bin" / "python", "exit 0")
    assert make("install", venv, stub).returncode == 0
    assert (venv / ".installed").exists()
    script(venv / "bin" / "python", "exit 1")
    assert make("install", venv, stub).returncode == 0


@pytest.mark.parametrize("uv", ["exit 0", "exit 1", None])
def test_the_demo_and_the_tests_install_only_what_they_need_with_uv_if_it_works(tmp_path, stub, monkeypatch, uv):
    venv, log, tools = tmp_path / "venv", tmp_path / "log", tmp_path / "tools"
    if uv is not None:
        script(tools / "uv", f'echo "uv $*" >>"{log}"; {uv}')
    monkeypatch.setenv("PATH", f"{tools}:/usr/bin:/bin")
    program = script(venv / "bin" / "python", f'echo "python $*" >>"{log}"')
    script(program.with_name("thermofleet"), "exit 0")

    def installed(goal: str) -> list[str]:
        log.write_text("", encoding="utf-8")
        assert make(goal, venv, sys.executable).returncode == 0
        lines = log.read_text(encoding="utf-8").splitlines()
        return [f"{line.split()[0]} {line.split()[-1]}" for line in lines if " install " in line]

    by = {"exit 0": ["uv"], "exit 1": ["uv", "python"], None: ["python"]}[uv]
    assert installed("demo") == ["python setuptools", *(f"{tool} .[demo]" for tool in by)]
    assert installed("demo") == []
    assert installed("install") == ["python torch", *(f"{tool} .[dev]" for tool in by)]
    (venv / ".installed-demo").touch()
    assert installed("demo") == installed("install") == []


@pytest.mark.parametrize("adapter", ["", "nobody"])
def test_a_trainer_that_is_not_there(adapter):
    command = ["make", "-C", str(ROOT), "--no-print-directory", "test-adapter", f"ADAPTER={adapter}"]
    said = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert said.returncode != 0
    pinned = {path.stem for path in (ROOT / "constraints").glob("*.txt")}
    tested = {path.stem.removeprefix("test_") for path in (ROOT / "tests" / "adapters").glob("test_*.py")}
    trainers = " ".join(sorted(pinned & tested))
    assert said.stdout == f"Name a trainer: make test-adapter ADAPTER=NAME. There are: {trainers}.\n"
