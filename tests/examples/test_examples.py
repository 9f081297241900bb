"""Examples that need no fleet, or only watch one, run as their docstrings describe."""

import importlib.util
import re
import sys
from types import ModuleType

import pytest

from scenarios.live.fleet_processes import free_port
from tests import commands
from tests.examples.programs import ROOT, program, started
from tests.waiting import PATIENCE_S


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.ci_slow
def test_own_policy_finishes_a_shift(capsys) -> None:
    example("own_policy").main(horizon_s=1800, difficulty="oracle")
    output = capsys.readouterr().out
    for name in ("LeastDifficulty", "Careful"):
        assert re.search(rf"{name}: reward -?[\d.]+, jobs \d+, peaks arm_0 [\d.]+ °C", output)


@pytest.mark.ci_slow
def test_the_monitor_receives_every_arm_from_another_process(tmp_path) -> None:
    port = free_port()
    with started(program("monitor", port)) as monitor:
        options = ["--difficulty", "blind", "--listen", str(port), "--out", str(tmp_path / "run"), "--seed", "1"]
        assert commands.run("run", "quickstart", *options).returncode == 0
        output, _ = monitor.communicate(timeout=PATIENCE_S)
        assert monitor.returncode == 0
    assert all(f"arm_{i}" in output for i in range(4))
    assert "hottest motor" in output


def test_every_example_for_outsiders_imports_nothing_of_ours():
    for name in ("monitor", "submit_jobs", "own_arm", "own_allocator", "own_policy_process"):
        source = (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")
        imported = set(re.findall(r"^(?:import|from) (\w+)", source, re.MULTILINE))
        assert imported - set(sys.stdlib_module_names) == {"zenoh"}
