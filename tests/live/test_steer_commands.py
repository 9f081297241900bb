"""The commands and the example that steer a fleet, against the real auctioneer, and the gateway's requests."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from fleet.bus.router import Router
from tests import commands

ROOT = Path(__file__).parents[2]
JOBS = [{"name": name, "kind": "hold", "places": ["fixture"], "dwell_s": 5.0} for name in ("one", "two", "three")]


@pytest.fixture
def port(tmp_path):
    """The port of a router with the auctioneer of quickstart, whose arms are absent: every job waits."""
    with Router() as router:
        at = ("--fleet", "f", "--endpoint", router.endpoint, "--journal", str(tmp_path / "j"), "--jobs", "none")
        auction = commands.start("bus", "auctioneer", "quickstart", *at, stderr=None)
        try:
            assert auction.stdout is not None
            assert auction.stdout.readline().startswith("ready")
            yield int(router.endpoint.rsplit(":", 1)[1])
        finally:
            auction.terminate()
            auction.communicate(timeout=300)


def told(done: subprocess.CompletedProcess[str]) -> tuple[int, str]:
    return done.returncode, done.stdout + done.stderr


def test_the_commands_and_the_example_steer_a_fleet(port, tmp_path):
    def command(*words):
        return told(commands.run(*words, "--fleet", "f", "--endpoint", f"tcp/127.0.0.1:{port}"))

    def example(*words):
        steer = [sys.executable, str(ROOT / "examples" / "steer_jobs.py"), str(port), "f", *words]
        return told(subprocess.run(steer, capture_output=True, text=True, timeout=300, check=False))

    (tmp_path / "jobs.json").write_text(json.dumps(JOBS), encoding="utf-8")
    code, said = command("job", "submit", tmp_path / "jobs.json")
    assert (code, said.count("accepted")) == (0, 3)
    assert command("arm", "pause", "--by", "ann") == (0, "Paused: all arms.\n")
    assert command("arm", "pause", "arm_0", "--end")[0] == 2
    assert command("job", "cancel", "one") == (0, "one: cancelled, 0 of 1 cycles.\n")
    assert command("job", "cancel", "one") == (0, "one: cancelled, 0 of 1 cycles. It is cancelled.\n")
    assert command("job", "change", "two", "--due", 900, "--value", 3) == (0, "two: waiting, 0 of 1 cycles.\n")
    code, said = command("job", "list")
    assert code == 0
    assert [line.split()[:2] for line in said.splitlines()[1:]] == [
        ["one", "cancelled"],
        ["three", "waiting"],
        ["two", "waiting"],
    ]
    assert [job["job"] for job in json.loads(command("job", "list", "--json")[1])] == ["one", "three", "two"]
    code, said = command("job", "settle", "two", "done")
    assert code == 2
    assert "only an unfinished job can be settled" in said
    code, said = example("cancel", "two")
    assert code == 0
    assert '"state": "cancelled"' in said
    code, said = example("follow", "one", "two")
    assert (code, said.count("cancelled")) == (1, 2), said
    assert "refused: 'three' is cancelled" in (example("cancel", "three"), example("settle", "three", "redo"))[1][1]
    code, said = example("cell")
    assert code == 0
    (cell,) = json.loads(said)
    assert {place["name"] for place in cell["places"]} >= {"fixture", "belt", "bin"}
    assert [arm["name"] for arm in cell["arms"]] == [f"arm_{i}" for i in range(4)]
    assert cell["limits"]["payload_kg"] == {"low": 0.0, "high": 10.0, "unit": "kg"}
    assert example("resume")[0] == 0
    assert command("arm", "pause", "--end") == (0, "Paused: none. Nothing changed: it is so already.\n")
