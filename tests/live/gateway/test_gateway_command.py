"""`thermofleet bus gateway` as a process, and the monitor in JavaScript."""

import http.client
import os
import re
import shutil
import signal
import socket
import subprocess
from contextlib import contextmanager
from pathlib import Path

import pytest

from fleet.bus.router import Router
from tests import commands
from tests.waiting import PATIENCE_S, wait_until

ROOT = Path(__file__).parents[3]


@contextmanager
def process(endpoint, *options):
    """The command in a process of its own, from when it says that it is ready, and its address."""
    started = commands.start("bus", "gateway", "--fleet", "f", "--endpoint", endpoint, "--port", 0, *options)
    try:
        line = started.stdout.readline()
        assert line.startswith("ready gateway http://127.0.0.1:"), line + started.stderr.read()
        yield started, line.split()[2]
    finally:
        started.kill()
        started.communicate(timeout=PATIENCE_S)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_the_command_exits_on_a_signal_even_while_a_reader_is_connected(router, number, code):
    with process(router) as (started, address):
        port = int(address.split(":")[2].split("/")[0])
        line = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        line.request("GET", "/v4/events")
        assert line.getresponse().status == 200
        started.send_signal(number)
        assert started.wait(PATIENCE_S) == code
        line.close()
        assert "Traceback" not in started.stderr.read()


def test_the_command_waits_for_a_router():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with Router(port):
        pass  # now the port is free, and was a router's
    started = commands.start("bus", "gateway", "--fleet", "f", "--endpoint", f"tcp/127.0.0.1:{port}", "--port", 0)
    try:
        assert "Waiting for a router." in started.stderr.readline()
        assert started.poll() is None
        with Router(port):
            assert started.stdout.readline().startswith("ready gateway http://127.0.0.1:")
            started.terminate()
            assert started.wait(PATIENCE_S) == 0
    finally:
        started.kill()
        started.communicate(timeout=PATIENCE_S)


@pytest.mark.skipif(shutil.which("node") is None, reason="no Node")
def test_the_monitor_in_javascript_shows_the_fleet(router, arm, tmp_path):
    log = tmp_path / "log"  # a pipe that nobody reads would stop it
    with process(router) as (_, address), log.open("w") as out:
        arm.state(1)
        arm.difficulty()
        arm.happens(7)
        command = ["node", str(ROOT / "examples" / "monitor.mjs"), address, "3"]
        node = subprocess.Popen(command, stdout=out, env=os.environ | {"NO_COLOR": "1"})
        try:
            wait_until(lambda: node.poll() is not None, lambda: (arm.state(1), arm.difficulty(), arm.happens(7)))
        finally:
            node.kill()
            node.wait(timeout=PATIENCE_S)
    told = log.read_text(encoding="utf-8")
    assert node.returncode == 0
    assert re.search(r"a\+1 .*idle.*41\.5.*2 .*18\.5", told)
    assert "warning" in told
    assert "crate 1 0.50" in told
