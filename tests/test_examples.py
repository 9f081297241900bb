"""The examples run as their first lines say, and see what the fleet does."""

import importlib.util
import os
import re
import socket
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
COMMAND = [sys.executable, "-c", "from scenarios.cli import main; main()"]


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("THERMOFLEET_CACHE", str(tmp_path / "cache"))


def test_own_policy_finishes_a_shift(capsys) -> None:
    example("own_policy").main(horizon_s=1800, difficulty="oracle")
    told = capsys.readouterr().out
    for name in ("LeastDifficulty", "Careful"):
        assert re.search(rf"{name}: reward -?[\d.]+, jobs \d+, peaks arm_0 [\d.]+ °C", told)


def test_own_policy_is_compared_beside_the_rules() -> None:
    own = f"{ROOT / 'examples' / 'own_policy.py'}:Careful"
    options = ["--policies", f"least_difficulty,{own}", "--baseline", "least_difficulty", "--seeds", "2"]
    command = [*COMMAND, "compare", "quickstart", *options, "--difficulty", "oracle"]
    done = subprocess.run(command, timeout=120, capture_output=True, text=True, check=True)
    assert "Careful" in done.stdout


def test_monitor_hears_every_arm_from_another_process(tmp_path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    env = os.environ | {"PYTHONUNBUFFERED": "1"}
    monitor = subprocess.Popen(
        [sys.executable, str(ROOT / "examples" / "monitor.py"), str(port)], stdout=subprocess.PIPE, text=True, env=env
    )
    try:
        command = [*COMMAND, "run", "quickstart"]
        options = ["--difficulty", "blind", "--listen", str(port), "--out", str(tmp_path / "run"), "--seed", "1"]
        subprocess.run([*command, *options], check=True, timeout=120, env=env, capture_output=True)
        told, _ = monitor.communicate(timeout=60)
    finally:
        monitor.kill()
    assert monitor.returncode == 0
    assert all(f"arm_{i}" in told for i in range(4))
    assert "hottest motor" in told
