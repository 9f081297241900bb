"""The commands and the example that steer a fleet, against the real auctioneer, and the gateway's requests."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from fleet.bus.client.router import Router

ROOT = Path(__file__).parents[2]
COMMAND = [sys.executable, "-c", "from scenarios.cli.main import main; main()"]
JOBS = [{"name": name, "kind": "hold", "places": ["fixture"], "dwell_s": 5.0} for name in ("one", "two", "three")]


@pytest.fixture
def port(tmp_path):
    """The port of a router with the auctioneer of quickstart, whose arms are absent: every job waits."""
    with Router() as router:
        at = ("--fleet", "f", "--endpoint", router.endpoint, "--journal", str(tmp_path / "j"), "--jobs", "none")
        auction = subprocess.Popen(
            [*COMMAND, "bus", "auctioneer", "quickstart", *at], stdout=subprocess.PIPE, text=True
        )
        try:
            assert auction.stdout is not None
            assert auction.stdout.readline().startswith("ready")
            yield int(router.endpoint.rsplit(":", 1)[1])
        finally:
            auction.terminate()
            auction.communicate(timeout=30)


def run(*command: object) -> tuple[int, str]:
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, done.stdout + done.stderr


def test_the_commands_and_the_example_steer_a_fleet(port, tmp_path):
    def command(*words):
        return run(*COMMAND, *words, "--fleet", "f", "--endpoint", f"tcp/127.0.0.1:{port}")

    def example(*words):
        return run(sys.executable, ROOT / "examples" / "steer_jobs.py", port, "f", *words)

    (tmp_path / "jobs.json").write_text(json.dumps(JOBS), encoding="utf-8")
    code, told = command("job", "submit", tmp_path / "jobs.json")
    assert (code, told.count("accepted")) == (0, 3)
    assert command("arm", "pause", "--by", "ann") == (0, "Paused: all arms.\n")
    assert command("arm", "resume", "arm_0")[0] == 2
    assert command("job", "cancel", "one") == (0, "one: cancelled, 0 of 1 cycles.\n")
    assert command("job", "cancel", "one") == (0, "one: cancelled, 0 of 1 cycles. It is cancelled.\n")
    assert command("job", "change", "two", "--due", 900, "--value", 3) == (0, "two: waiting, 0 of 1 cycles.\n")
    code, told = command("job", "list")
    assert code == 0
    assert [line.split()[:2] for line in told.splitlines()[1:]] == [
        ["one", "cancelled"],
        ["three", "waiting"],
        ["two", "waiting"],
    ]
    assert [job["job"] for job in json.loads(command("job", "list", "--json")[1])] == ["one", "three", "two"]
    code, told = command("job", "settle", "two", "done")
    assert code == 2
    assert "only an unfinished job can be settled" in told
    code, told = example("cancel", "two")
    assert code == 0
    assert '"state": "cancelled"' in told
    code, told = example("follow", "one", "two")
    assert (code, told.count("cancelled")) == (1, 2), told
    assert "refused: 'three' is cancelled" in (example("cancel", "three"), example("settle", "three", "redo"))[1][1]
    code, told = example("cell")
    assert code == 0
    (cell,) = json.loads(told)
    assert {place["name"] for place in cell["places"]} >= {"fixture", "belt", "bin"}
    assert [arm["name"] for arm in cell["arms"]] == [f"arm_{i}" for i in range(4)]
    assert cell["limits"]["payload_kg"] == {"low": 0.0, "high": 10.0, "unit": "kg"}
    assert example("resume")[0] == 0
    assert command("arm", "resume") == (0, "Paused: none. Nothing changed: it is so already.\n")
