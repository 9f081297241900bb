"""The router: a free port of this machine, and nothing else."""

import socket
from contextlib import ExitStack
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.client import BusClient
from fleet.bus.router import Router, loopback, open_client, reachable
from fleet.bus.security.tls import Tls, identified
from fleet.errors import BusError, NoRouter, is_name
from tests.waiting import PATIENCE_S


def test_the_router_listens_where_it_says():
    with Router() as router:
        host, port = router.endpoint.removeprefix("tcp/").split(":")
        assert host == "127.0.0.1"
        with socket.create_connection((host, int(port)), timeout=PATIENCE_S):
            pass
        open_client(router.endpoint, timeout_s=PATIENCE_S).close()


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


def test_lines_that_nobody_opens_keep_nobody_out():
    """Zenoh's own limit of 100 would make the next one wait ten seconds."""
    with ExitStack() as stack:
        router = stack.enter_context(Router())
        host, port = router.endpoint.removeprefix("tcp/").split(":")
        for _ in range(150):
            stack.enter_context(socket.create_connection((host, int(port)), timeout=PATIENCE_S))
        open_client(router.endpoint, timeout_s=9.0).close()


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
        ("tcp/example.org:7447", "may resolve to another machine"),
        ("tcp/localhost.example.org:7447", "may resolve to another machine"),
        ("tcp/127.1:7447", "may resolve to another machine"),
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


TLS = Tls(Path("keys"), "arm_0")


@pytest.mark.parametrize("endpoint", ["tls/127.0.0.1:7447", "tls/router.example:7447", "tls/[2001:db8::1]:80"])
def test_with_a_certificate_an_endpoint_may_be_anywhere(endpoint):
    assert reachable(endpoint, TLS) == endpoint


@pytest.mark.parametrize(
    ("endpoint", "tls", "reason"),
    [
        ("tls/127.0.0.1:7447", None, "needs a certificate"),
        ("tcp/10.0.0.1:7447", None, "Plain TCP does not authenticate"),
        ("tcp/127.0.0.1:7447", TLS, "no endpoint for the certificate of 'arm_0'"),
        ("tls/127.0.0.1:0", TLS, "Expected tls/"),
        ("quic/127.0.0.1:7447", TLS, "Expected tls/"),
        ("tls/127.0.0.1:7447#enable_mtls=false", TLS, "Expected tls/"),
        ("", TLS, "Expected tls/"),
    ],
)
def test_an_endpoint_and_a_certificate_belong_together(endpoint, tls, reason):
    with pytest.raises(BusError, match=reason):
        reachable(endpoint, tls)


@given(
    st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=20).filter(is_name),
    st.sampled_from(["keys", "/a b/c#d"]),
)
def test_an_endpoint_may_say_who_connects(name, folder):
    tls = Tls(Path(folder), name)
    assert identified(tls.endpoint("tls/127.0.0.1:7447")) == ("tls/127.0.0.1:7447", tls)


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:7447#keys/arm_0", "tls/127.0.0.1:7447", "tls/127.0.0.1:7447#", ""])
def test_an_endpoint_that_says_nobody_is_left_as_it_is(endpoint):
    assert identified(endpoint) == (endpoint, None)


@pytest.mark.parametrize("port", [-1, 65536])
def test_a_port_is_a_port(port):
    with pytest.raises(ValueError, match="port"):
        Router(port)


def test_a_client_waits_for_a_router_until_it_is_stopped():
    with Router() as first:
        endpoint = first.endpoint
    router, asked = Router(int(endpoint.rpartition(":")[2])), []

    def start_router():
        asked.append(None)
        if len(asked) == 2:  # the first attempt has failed
            router.open()
        return False

    with BusClient(endpoint, "f", stopped=start_router):
        assert len(asked) == 2
    router.close()
    with pytest.raises(NoRouter, match="Stopped while waiting for a router"):
        BusClient(endpoint, "f", stopped=lambda: bool(asked.append(None)) or len(asked) > 4).open()
