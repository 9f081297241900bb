"""Cables between network namespaces, as the campaign pulls them: what is cut is silent, and nothing is left."""

import importlib
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from fleet.errors import FleetError
from fleet.live.supervisor import Part

CHAOS = Path(__file__).parents[2] / "benchmarks" / "chaos"
PATIENCE_S = 20.0
CALL = "import socket, sys; s = socket.create_connection(sys.argv[1].split(':')); s.sendall(b'x'); s.recv(1)"


@pytest.fixture
def namespaces(monkeypatch):
    monkeypatch.syspath_prepend(CHAOS)
    module = importlib.import_module("namespaces")
    if reason := module.why_not():
        pytest.skip(reason)
    return module


def there(pid):
    """Namespaces and interfaces that bear the number of a process."""
    listed = subprocess.run("ip netns list; ip -o link", shell=True, capture_output=True, text=True, check=True).stdout
    return [word for word in listed.split() if word.startswith(f"tf{pid}-")]


def test_a_pulled_cable_lets_nothing_through_and_tells_nobody(namespaces):
    with socket.create_server(("0.0.0.0", 0)) as server:
        server.settimeout(PATIENCE_S)
        port = server.getsockname()[1]
        with namespaces.Namespaces(["arm_0"], port) as cables:
            part = Part(name="a", argv=(sys.executable, "-c", CALL, f"127.0.0.1:{port}"))
            with subprocess.Popen(cables.through(part, "arm_0").argv) as caller:
                line, (address, _) = server.accept()
                with line:
                    line.settimeout(PATIENCE_S)
                    assert address == "198.18.0.2"
                    assert line.recv(1) == b"x"
                    cables.cut()
                    line.sendall(b"y")
                    with pytest.raises(subprocess.TimeoutExpired):
                        caller.wait(0.5)  # neither heard it nor was told
                    cables.heal()  # what was lost is sent again by TCP
                    assert caller.wait(PATIENCE_S) == 0
    assert there(os.getpid()) == []


def test_nothing_is_left_where_one_of_them_cannot_be_made(namespaces):
    subprocess.run(["ip", "netns", "add", f"tf{os.getpid()}-1"], check=True)
    try:
        with pytest.raises(FleetError, match=f"'ip netns add tf{os.getpid()}-1' failed: .*File exists"):
            namespaces.Namespaces(["a", "b"], 1).__enter__()
        assert there(os.getpid()) == [f"tf{os.getpid()}-1"]
    finally:
        subprocess.run(["ip", "netns", "del", f"tf{os.getpid()}-1"], check=True)


def test_what_a_killed_campaign_left_is_cleared_away_and_nothing_else(namespaces):
    with subprocess.Popen([sys.executable, "-c", "pass"]) as ended:
        pass
    left = f"tf{ended.pid}-0"
    subprocess.run(["ip", "netns", "add", left], check=True)
    subprocess.run(f"ip link add {left} type veth peer name eth0 netns {left}".split(), check=True)
    with namespaces.Namespaces(["a"], 1):
        assert there(ended.pid) == []
        namespaces.clear_away()
        assert there(os.getpid())
    assert there(os.getpid()) == []


def test_without_root_it_says_why(namespaces, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert namespaces.why_not() == "network namespaces need root"
    monkeypatch.setenv("PATH", "")
    assert namespaces.why_not() == "network namespaces need Linux and its command ip"
