"""A policy of one's own that fails ends a command with one sentence that names it."""

import time
from pathlib import Path

import pytest

from fleet.errors import FleetError
from scenarios.evaluate.study import check_policy
from scenarios.policy_loader import PolicyFailed, failure
from tests.waiting import PATIENCE_S

POLICY = """
class Bad:
    scope = "central"

    def reset(self, rng):
        pass

    def act(self, observations):
        return {}


class Raises(Bad):
    def act(self, observations):
        raise ValueError("boom")


class Speaks(Bad):
    def act(self, observations):
        return {arm: "left" for arm in observations}


class Exits(Bad):
    def act(self, observations):
        raise SystemExit(0)


class Misplans(Bad):
    def plan_in(self, cell):
        raise ValueError("no plan")


class Endless(Bad):
    def __init__(self):
        while True:
            pass
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "bad.py"
    path.write_text(POLICY, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("policy", "expected"),
    [
        ("Raises", "ValueError: boom (FILE, line 14)"),
        ("Speaks", "(got 'left')"),
        ("Exits", "SystemExit: 0 (FILE, line 24)"),
        ("Misplans", "ValueError: no plan (FILE, line 29)"),
    ],
)
@pytest.mark.parametrize("command", ["run", "bounds"])
def test_it_is_one_sentence(thermofleet, small_toml, tmp_path, file, command, policy, expected) -> None:
    name = f"{file}:{policy}"
    words = {
        "run": (small_toml, "--policy", name, "--difficulty", "blind", "--bus", "memory"),
        "bounds": (small_toml, "--starts", name, "--evaluations", 2, "--nodes", 0, "--difficulty", "blind"),
    }
    result = thermofleet(command, *words[command], "--out", tmp_path / "out")
    assert result.code == 2
    assert "Traceback" not in result.err
    message = " ".join(result.err.split())
    assert f"The policy '{name}' failed in heat/" in message
    assert expected.replace("FILE", str(file)) in message


def test_a_policy_that_is_never_made_is_refused_in_time(file) -> None:
    began_s = time.monotonic()
    with pytest.raises(FleetError, match=r"takes longer than 0\.2 s to load"):
        check_policy(f"{file}:Endless", 0.2)
    assert time.monotonic() - began_s < PATIENCE_S


def test_errors_of_rules_and_errors_of_ours_stay_as_they_are() -> None:
    ours, other = FleetError("bus lost"), ValueError("a defect")
    assert failure("mine.py:X", ours, "here") is ours
    assert failure("wspt", other, "here") is other
    assert isinstance(failure("mine.py:X", other, "here"), PolicyFailed)
