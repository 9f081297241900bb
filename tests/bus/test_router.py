"""The router: a free port of this machine, and nothing else."""

import socket

import pytest

from fleet.bus.router import Router, loopback, open_client
from fleet.errors import BusError


def test_the_router_listens_where_it_says():
    with Router() as router:
        host, port = router.endpoint.removeprefix("tcp/").split(":")
        assert host == "127.0.0.1"
        with socket.create_connection((host, int(port)), timeout=10):
            pass
        open_client(router.endpoint, timeout_s=10).close()


def test_two_routers_listen_on_different_ports():
    with Router() as one, Router() as other:
        assert one.endpoint != other.endpoint


def test_a_port_in_use_is_named():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(BusError, match=f"port {port} .*in use"):
            Router(port).open()


def test_a_port_is_free_again_after_close():
    router = Router().open()
    port = int(router.endpoint.rsplit(":", 1)[1])
    router.close()
    router.close()
    with pytest.raises(BusError, match="not open"):
        _ = router.endpoint
    with Router(port) as again:
        assert again.endpoint == f"tcp/127.0.0.1:{port}"


def test_no_router_is_said_within_the_time_given():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
    with pytest.raises(BusError, match=f"No router answered at tcp/127.0.0.1:{port}"):
        open_client(f"tcp/127.0.0.1:{port}", timeout_s=0.2)


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:7447", "tcp/127.9.8.7:1", "tcp/[::1]:7447", "tcp/localhost:80"])
def test_loopback_is_allowed(endpoint):
    assert loopback(endpoint) == endpoint


@pytest.mark.parametrize(
    ("endpoint", "reason"),
    [
        ("tcp/0.0.0.0:7447", "not on loopback"),
        ("tcp/[::]:7447", "not on loopback"),
        ("tcp/192.168.1.10:7447", "not on loopback"),
        ("tcp/[::ffff:192.168.1.10]:7447", "not on loopback"),
        ("tcp/example.org:7447", "may lead anywhere"),
        ("tcp/localhost.example.org:7447", "may lead anywhere"),
        ("tcp/127.1:7447", "may lead anywhere"),
        ("udp/127.0.0.1:7447", "Expected tcp"),
        ("tcp/127.0.0.1", "Expected tcp"),
        ("tcp/127.0.0.1:99999", "Expected tcp"),
        ("tcp/127.0.0.1:7447#iface=eth0", "Expected tcp"),
        ("tcp/127.0.0.1:7447,tcp/10.0.0.1:7447", "Expected tcp"),
        ("127.0.0.1:7447", "Expected tcp"),
        ("", "Expected tcp"),
    ],
)
def test_every_other_endpoint_is_refused_with_the_reason(endpoint, reason):
    with pytest.raises(BusError, match=reason):
        loopback(endpoint)


@pytest.mark.parametrize("port", [-1, 65536])
def test_a_port_is_a_port(port):
    with pytest.raises(ValueError, match="port"):
        Router(port)
