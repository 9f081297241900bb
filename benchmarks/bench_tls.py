"""Cost of TLS, access rules and rate limits: a round trip through the router and opening a session, beside bare Zenoh.

    python -m benchmarks.bench_tls [--rounds 2000] [--opens 40]

Three routers in one process on loopback: bare Zenoh, ours with plain TCP (size and rate limits), ours with mutual TLS
(limits, and the access rules of a fleet of 16 arms). A round trip is a put of 256 bytes from one client through the
router to another, whose callback puts it back; `open` is `zenoh.open` of a client with all checks of its certificate.
The three alternate, so that other load slows them equally.
"""

import json
import queue
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import zenoh

from benchmarks.harness import cells, in_turns, options, quantiles
from fleet.bus.protocol import keys
from fleet.bus.router import Router, open_client
from fleet.bus.security.access_control import of_arms
from fleet.bus.security.certificates import make
from fleet.bus.security.tls import Tls

ARMS = [f"arm_{i}" for i in range(16)]
PATIENT_S = 20.0
WARM_UP = 50
PAYLOAD = b"x" * 256
QUIET = {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}}


class PingPong:
    """Two arms that exchange messages on their own keys."""

    def __init__(self, open_arm: Callable[[str], zenoh.Session], stack: ExitStack) -> None:
        one, other = (stack.enter_context(open_arm(name)) for name in ARMS[:2])
        there, back = (keys.of_arm("bench", name, "event") for name in ARMS[:2])
        self._came: queue.SimpleQueue[None] = queue.SimpleQueue()
        answer = other.declare_publisher(back)
        self._ask = one.declare_publisher(there)

        def send_back(sample: zenoh.Sample) -> None:
            answer.put(sample.payload)

        on_ping = zenoh.handlers.Callback(send_back, indirect=False)
        on_pong = zenoh.handlers.Callback(lambda _: self._came.put(None), indirect=False)
        self._kept = (other.declare_subscriber(there, on_ping), one.declare_subscriber(back, on_pong))
        for session in (one, other):  # replies come in order, so the router has the declarations
            list(session.get(keys.caches_of("thermofleet/v4/bench/arm/nobody"), timeout=PATIENT_S))

    def round_trip(self) -> None:
        """Send a message there and back."""
        self._ask.put(PAYLOAD)
        self._came.get(timeout=PATIENT_S)


def bare_router(stack: ExitStack) -> str:
    """Endpoint of a plain Zenoh router."""
    config = {
        "mode": "router",
        "listen": {"endpoints": ["tcp/127.0.0.1:0"]},
        "scouting": QUIET,
        "adminspace": {"enabled": True},
        "transport": {"shared_memory": {"enabled": False}},
    }
    session = stack.enter_context(zenoh.open(zenoh.Config.from_json5(json.dumps(config))))
    (reply,) = list(session.get(f"@/{session.zid()}/router", timeout=PATIENT_S))
    assert reply.ok is not None
    return json.loads(reply.ok.payload.to_bytes())["locators"][0]


def bare_client(endpoint: str) -> zenoh.Session:
    """A plain Zenoh client."""
    config = {
        "mode": "client",
        "connect": {"endpoints": [endpoint]},
        "scouting": QUIET,
        "transport": {"shared_memory": {"enabled": False}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def open_one(open_arm: Callable[[str], zenoh.Session]) -> None:
    """Open and close a session."""
    with open_arm(ARMS[2]):
        pass


def row(name: str, rounds: list[float], opens: list[float]) -> str:
    """Median and 99th percentile of both, in µs and ms."""
    times = cells(quantiles(rounds, 0.99), scale=1e6, digits=0) + cells(quantiles(opens, 0.99), scale=1e3)
    return f"{name:<34}{times}"


def main() -> None:
    """Print the table."""
    given = options(__doc__, rounds=2000, opens=40)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "keys"
        make(folder, of_arms("bench", ARMS), days=30)
        bare = bare_router(stack)
        plain = stack.enter_context(Router(state_hz=100.0)).endpoint
        secure = stack.enter_context(Router(tls=Tls(folder, "router"), state_hz=100.0)).endpoint
        sides: dict[str, Callable[[str], zenoh.Session]] = {
            "bare Zenoh, TCP": lambda _: bare_client(bare),
            "ours, TCP, limits": lambda _: open_client(plain, timeout_s=PATIENT_S),
            "ours, mutual TLS, limits, rules": lambda arm: open_client(
                secure, timeout_s=PATIENT_S, tls=Tls(folder, arm)
            ),
        }
        pairs = {name: PingPong(open_arm, stack) for name, open_arm in sides.items()}
        trips = {name: pair.round_trip for name, pair in pairs.items()}
        rounds = in_turns(trips, given.rounds, warm_up=WARM_UP, clock=time.perf_counter)
        opening = {name: partial(open_one, open_arm) for name, open_arm in sides.items()}
        opens = in_turns(opening, given.opens, warm_up=0, clock=time.perf_counter)
        print(f"{'':<34}  round trip, µs       open, ms")
        print(f"{'':<34}{'p50':>10}{'p99':>10}{'p50':>10}{'p99':>10}")
        for name in sides:
            print(row(name, rounds[name], opens[name]))


if __name__ == "__main__":
    main()
