"""Network namespaces of the fault campaign: a cut link is silent, and nothing is left behind."""

import importlib
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from fleet.errors import FleetError
from fleet.live.supervisor import Part
from tests.waiting import PATIENCE_S

CHAOS = Path(__file__).parents[2] / "benchmarks" / "chaos"
CALL = "import socket, sys; s = socket.create_connection(sys.argv[1].split(':')); s.sendall(b'x'); s.recv(1)"


@pytest.fixture
def namespaces(monkeypatch):
    monkeypatch.syspath_prepend(CHAOS)
    module = importlib.import_module("namespaces")
    if reason := module.unavailable_reason():
        pytest.skip(reason)
    return module


def leftovers(pid):
    """Return the namespaces and interfaces that a process has created."""
    listed = subprocess.run("ip netns list; ip -o link", shell=True, capture_output=True, text=True, check=True).stdout
    return [word for word in listed.split() if word.startswith(f"tf{pid}-")]


def test_a_cut_link_delivers_nothing_and_reports_nothing(namespaces):
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
                        caller.wait(0.5)  # it got neither data nor an error
                    cables.heal()  # TCP resends what was lost
                    assert caller.wait(PATIENCE_S) == 0
    assert leftovers(os.getpid()) == []


def test_nothing_is_left_after_a_namespace_could_not_be_created(namespaces):
    subprocess.run(["ip", "netns", "add", f"tf{os.getpid()}-1"], check=True)
    try:
        with pytest.raises(FleetError, match=f"'ip netns add tf{os.getpid()}-1' failed: .*File exists"):
            namespaces.Namespaces(["a", "b"], 1).__enter__()
        assert leftovers(os.getpid()) == [f"tf{os.getpid()}-1"]
    finally:
        subprocess.run(["ip", "netns", "del", f"tf{os.getpid()}-1"], check=True)


def test_only_the_namespaces_of_killed_campaigns_are_removed(namespaces):
    with subprocess.Popen([sys.executable, "-c", "pass"]) as ended:
        pass
    left = f"tf{ended.pid}-0"
    subprocess.run(["ip", "netns", "add", left], check=True)
    subprocess.run(f"ip link add {left} type veth peer name eth0 netns {left}".split(), check=True)
    with namespaces.Namespaces(["a"], 1):
        assert leftovers(ended.pid) == []
        namespaces.remove_stale()
        assert leftovers(os.getpid())
    assert leftovers(os.getpid()) == []


def test_without_root_the_reason_is_given(namespaces, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert namespaces.unavailable_reason() == "network namespaces need root"
    monkeypatch.setenv("PATH", "")
    assert namespaces.unavailable_reason() == "network namespaces need Linux and its command ip"
