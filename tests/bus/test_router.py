"""The router: a free port of this machine; and what holds behind one holds across two linked ones."""

import queue
import re
import socket
import time
from contextlib import ExitStack
from itertools import count
from pathlib import Path

import msgspec
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import State
from fleet.bus.router import Router, loopback, open_client, reachable
from fleet.bus.security.access_control import RosterEntry, of_arms
from fleet.bus.security.certificates import issue, make
from fleet.bus.security.tls import Tls, identified
from fleet.errors import BusError, NoRouter, is_name
from tests.waiting import PATIENCE_S, PAUSE, serve_until, wait_until


def test_the_router_listens_where_it_says_until_it_is_closed():
    router = Router().open()
    port = int(router.endpoint.removeprefix("tcp/127.0.0.1:"))
    open_client(router.endpoint, timeout_s=PATIENCE_S).close()
    router.close()
    router.close()
    with pytest.raises(BusError, match="not open"):
        _ = router.endpoint
    with Router(port) as again, Router() as other:
        assert again.endpoint == f"tcp/127.0.0.1:{port}" != other.endpoint


def test_lines_that_nobody_opens_keep_nobody_out():
    """Zenoh's own limit of 100 would make the next one wait ten seconds."""
    with ExitStack() as stack:
        router = stack.enter_context(Router())
        host, port = router.endpoint.removeprefix("tcp/").split(":")
        for _ in range(150):
            stack.enter_context(socket.create_connection((host, int(port)), timeout=PATIENCE_S))
        with open_client(router.endpoint, timeout_s=PATIENCE_S) as session:
            assert len(session.info.routers_zid()) == 1


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
        ("tcp/[::ffff:192.168.1.10]:7447", "not on loopback"),
        ("tcp/localhost.example.org:7447", "may resolve to another machine"),
        ("tcp/127.1:7447", "may resolve to another machine"),
        ("udp/127.0.0.1:7447", "Expected tcp"),
        ("tcp/127.0.0.1", "Expected tcp"),
        ("tcp/127.0.0.1:99999", "Expected tcp"),
        ("tcp/127.0.0.1:7447#iface=eth0", "Expected tcp"),
        ("tcp/127.0.0.1:7447,tcp/10.0.0.1:7447", "Expected tcp"),
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


@pytest.mark.ci_slow
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


ROUTES_S = 0.5
"""Zenoh calculates its routes 0.1 s after a new link, and shows nowhere that it has; a router that is closed before may
leave the other one without routes for good (Zenoh 1.10.2, panic in `unregister_router_entities`)."""

ARMS = tuple(f"arm_{number}" for number in range(4))
FAR = RosterEntry("router_b", "router")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    place = tmp_path_factory.mktemp("keys") / "f"
    make(place, of_arms("f", ARMS, [FAR]), days=30)
    return place


@pytest.fixture
def mesh(place):
    """Two routers, and sessions of participants on either."""
    with (
        Router(tls=Tls(place, "router")) as near,
        Router(tls=Tls(place, FAR.name), connect=[near.endpoint]) as far,
        ExitStack() as stack,
    ):
        wait_until(lambda: near.linked() == far.linked() == 1)

        def session(router, name):
            return stack.enter_context(open_client(router.endpoint, timeout_s=PATIENCE_S, tls=Tls(place, name)))

        yield near, far, session


def ask(session, key, timeout_s=PATIENCE_S):
    every = {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE}
    return [str(reply.ok.key_expr) for reply in session.get(key, payload=b"?", timeout=timeout_s, **every) if reply.ok]


def test_permissions_hold_across_linked_routers(mesh):
    near, far, session = mesh
    arm, other, auctioneer, monitor = (
        session(router, name)
        for router, name in ((far, "arm_0"), (near, "arm_1"), (near, "auctioneer"), (near, "monitor"))
    )
    states, tokens = queue.Queue(), queue.Queue()
    listeners = [
        monitor.declare_subscriber(keys.all_of_fleet("f"), lambda sample: states.put(str(sample.key_expr))),
        monitor.liveliness().declare_subscriber(
            keys.of_every_arm("f", "alive"), lambda sample: tokens.put(str(sample.key_expr)), history=True
        ),
    ]
    quotes = {one: keys.of_arm("f", one, "quote") for one in ("arm_0", "arm_1")}
    entities = [
        arm.declare_queryable(quotes["arm_0"], lambda query: query.reply(quotes["arm_0"], b"own"), complete=True),
        arm.declare_queryable(quotes["arm_1"], lambda query: query.reply(quotes["arm_1"], b"fake"), complete=True),
        other.declare_queryable(quotes["arm_1"], lambda query: query.reply(quotes["arm_1"], b"own"), complete=True),
        arm.liveliness().declare_token(keys.of_arm("f", "arm_1", "alive")),
        arm.liveliness().declare_token(keys.of_arm("f", "arm_0", "alive")),
    ]
    assert tokens.get(timeout=PATIENCE_S) == keys.of_arm("f", "arm_0", "alive")
    wait_until(lambda: len(ask(auctioneer, keys.of_every_arm("f", "quote"))) == 2)
    assert sorted(ask(auctioneer, keys.of_every_arm("f", "quote"))) == sorted(quotes.values())
    assert ask(monitor, keys.of_every_arm("f", "quote"), 0.5) == []  # its role may not
    for key in ("arm/arm_1/state", "auction/auctioneer/result", "arm/arm_0/state"):
        arm.put(f"{keys.all_of_fleet('f').removesuffix('/**')}/{key}", b"x")
    assert states.get(timeout=PATIENCE_S) == keys.of_arm("f", "arm_0", "state")
    assert states.empty()
    assert tokens.empty()
    for entity in (*listeners, *entities):
        entity.undeclare()


def test_missed_messages_are_fetched_when_a_router_is_back(place):
    with Router(tls=Tls(place, "router")) as near, ExitStack() as stack:
        far = Router(tls=Tls(place, FAR.name), connect=[near.endpoint]).open()
        arm = stack.enter_context(BusClient(Tls(place, "arm_0").endpoint(far.endpoint), "f"))
        monitor = stack.enter_context(BusClient(Tls(place, "monitor").endpoint(near.endpoint), "f"))
        ticks, tokens = [], []
        monitor.subscribe(
            keys.of_every_arm("f", "state"), State, lambda _, state: ticks.append(state.tick), history=True
        )
        monitor.watch_tokens(keys.of_every_arm("f", "alive"), lambda name, there: tokens.append((name, there)))
        publish = arm.publisher(keys.of_arm("f", "arm_0", "state"), State)
        arm.declare_token(keys.of_arm("f", "arm_0", "alive"))

        def state(tick):
            publish(State("arm_0", tick, float(tick), "idle", (30.0,) * 7, 30.0))

        state(0)
        serve_until(lambda: ticks == [0] and tokens == [("arm_0", True)], monitor)
        PAUSE.wait(ROUTES_S)
        port = int(far.endpoint.rsplit(":", 1)[1])
        far.close()
        for tick in (1, 2, 3):
            state(tick)
        serve_until(lambda: tokens[-1] == ("arm_0", False), monitor)
        with Router(port, tls=Tls(place, FAR.name), connect=[near.endpoint]):
            serve_until(lambda: tokens[-1] == ("arm_0", True), monitor)
            later = count(4)  # a message that is lost while the link is new is fetched with a later one
            wait_until(lambda: ticks[-1] >= 4, lambda: (state(next(later)), monitor.serve(time.monotonic() + 0.2)))
            assert ticks == list(range(len(ticks)))


def test_the_rate_limit_counts_each_arm_and_not_the_link(place):
    """Four arms of 25 messages a second are as many as one arm may send; behind a link they are one session."""
    with (
        Router(tls=Tls(place, "router"), state_hz=50.0) as near,
        Router(tls=Tls(place, FAR.name), connect=[near.endpoint], state_hz=50.0) as far,
        ExitStack() as stack,
    ):
        wait_until(lambda: near.linked() == far.linked() == 1)
        arms, monitor = (
            [
                stack.enter_context(open_client(router.endpoint, timeout_s=PATIENCE_S, tls=Tls(place, name)))
                for name in names
            ]
            for router, names in ((far, ARMS), (near, ["monitor"]))
        )
        heard = []
        listener = monitor[0].declare_subscriber(
            keys.all_of_fleet("f"), lambda sample: heard.append(str(sample.key_expr))
        )

        def put_all(topic):
            for name, arm in zip(ARMS, arms, strict=True):
                arm.put(keys.of_arm("f", name, topic), b"x", congestion_control=zenoh.CongestionControl.BLOCK)

        # Scores, which have no limit, mark when all routes are there and when a flood of states has passed.
        wait_until(lambda: len(set(heard)) == len(ARMS), lambda: put_all("difficulty"))
        for _ in range(10):
            del heard[:]
            put_all("state")
            wait_until(lambda: sum(key.endswith("/state") for key in heard) == len(ARMS))
            PAUSE.wait(0.04)
        del heard[:]
        began_s = time.monotonic()
        for _ in range(200):
            arms[0].put(keys.of_arm("f", "arm_0", "state"), b"x")
        put_all("difficulty")
        wait_until(lambda: keys.of_arm("f", "arm_0", "difficulty") in heard)
        took_s = time.monotonic() - began_s
        assert 1 <= heard.count(keys.of_arm("f", "arm_0", "state")) <= 1 + 50.0 * took_s
        listener.undeclare()


def test_a_link_needs_tls(place):
    with pytest.raises(BusError, match="needs TLS: routers recognise each other"):
        Router(connect=["tcp/127.0.0.1:7447"])
    with pytest.raises(BusError, match=r"no endpoint for the certificate of 'router'. Expected tls/"):
        Router(tls=Tls(place, "router"), connect=["tcp/127.0.0.1:7447"])


def test_a_link_is_reported_when_it_opens_and_when_it_is_lost(place):
    with Router(tls=Tls(place, "router")) as near:
        endpoint = near.endpoint.replace("127.0.0.1", "localhost")
        far = Router(tls=Tls(place, FAR.name), connect=[endpoint]).open()
        wait_until(lambda: near.linked() == far.linked() == 1)
        with Router(tls=Tls(place, "router"), connect=[far.endpoint]) as beside:  # the certificate of `near`
            assert far.link_changes() == [f"Linked to the router at {endpoint}."]
            wait_until(lambda: beside.linked() == 1)
            assert beside.link_changes() == [f"Linked to the router at {far.endpoint}."]
        assert far.link_changes() == []
    wait_until(lambda: far.linked() == 0)
    assert far.link_changes() == [
        f"No link to the router at {endpoint} (Connection refused). It is tried again every second."
    ]
    assert far.link_changes() == []
    far.close()


def test_a_missing_link_has_its_reason_from_one_trial(place, tmp_path, monkeypatch):
    make(tmp_path / "other", of_arms("f", ARMS), days=30)
    with Router() as plain, Router(tls=Tls(tmp_path / "other", "router")) as foreign, ExitStack() as stack:
        unknown, http = "tls/nowhere.invalid:7447", plain.endpoint.replace("tcp/", "tls/")
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        own = f"tls/127.0.0.1:{port}"
        connect = [unknown, http, foreign.endpoint, own]
        router = stack.enter_context(Router(port, tls=Tls(place, "router"), connect=connect))
        reasons = [
            "not known|resolution",
            "does not use TLS",
            "is not valid: .*another fleet",
            "address of this router",
        ]
        tried, connect_to = [], socket.create_connection
        monkeypatch.setattr(socket, "create_connection", lambda *at, **how: tried.append(at) or connect_to(*at, **how))
        sentences = router.link_changes()
        assert len(tried) == len(sentences) == len(reasons)
        for endpoint, reason, sentence in zip(connect, reasons, sentences, strict=True):
            assert re.search(rf"No link to the router at {re.escape(endpoint)} \(.*({reason})", sentence), sentence


@pytest.mark.ci_slow
def test_a_router_in_no_roster_has_no_rights(place, tmp_path):
    """Nor has one with the name of the router itself: only other routers are linked."""
    rogue = tmp_path / "rogue"
    rogue.mkdir()
    for name in ("ca.pem", "ca.key"):
        (rogue / name).write_bytes((place / name).read_bytes())
    roster = of_arms("f", ARMS, [RosterEntry("router_c", "router")])
    for name in ("router_c", "router"):
        issue(rogue, RosterEntry(name, "router"), days=20)
    (rogue / "roster.json").write_bytes(msgspec.json.encode(roster))
    with Router(tls=Tls(place, "router")) as near:
        heard = queue.Queue()
        session = open_client(near.endpoint, timeout_s=PATIENCE_S, tls=Tls(place, "monitor"))
        listener = session.declare_subscriber(keys.of_every_arm("f", "state"), lambda sample: heard.put(sample.payload))
        for name in ("router_c", "router"):
            with (
                Router(tls=Tls(rogue, name), connect=[near.endpoint]) as far,
                open_client(far.endpoint, timeout_s=PATIENCE_S, tls=Tls(place, "arm_0")) as arm,
            ):
                wait_until(lambda: near.linked() == 1)
                for _ in range(10):  # the routes of a new link take 0.1 s
                    arm.put(keys.of_arm("f", "arm_0", "state"), b"x")
                    with pytest.raises(queue.Empty):
                        heard.get(timeout=0.1)
            wait_until(lambda: near.linked() == 0)
        listener.undeclare()
        session.close()
