"""Time of a tick: `share` over Zenoh and in memory, beside the same deliveries with bare Zenoh.

    python benchmarks/bench_exchange.py [--arms 4 16 64] [--ticks 200]

Bare Zenoh: as many client sessions on the same kind of router; each puts two payloads of the same sizes per tick and
counts the puts of its peers without decoding them. Ping-pong: one put to a peer and the put of its callback, halved.
All run in one process on loopback and alternate, so that other load slows them equally.
"""

import argparse
import multiprocessing
import os
import statistics
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import zenoh

from fleet.bus.client.router import Router, open_client
from fleet.bus.exchange.group import messages_of
from fleet.bus.exchange.memory import MemoryExchange
from fleet.bus.exchange.protocol import Broadcast
from fleet.bus.exchange.zenoh import ZenohExchange, sessions_for
from fleet.bus.protocol.messages import encode

SLOTS = 8
WARM_UP = 5
TIMEOUT_S = 30.0


def words_at(tick: int, arms: int, rng: np.random.Generator) -> Broadcast:
    """Broadcasts of a typical size: seven joints, eight slots, one score in five unknown."""
    difficulty, p_saturation = rng.random((2, arms, SLOTS))
    difficulty[rng.random((arms, SLOTS)) < 0.2] = np.nan
    return Broadcast(
        time_s=10.0 * tick,
        mode=rng.integers(0, 3, arms),
        temp_c=rng.normal(40.0, 10.0, (arms, 7)),
        headroom_k=rng.normal(20.0, 5.0, arms),
        busy_s=rng.uniform(0.0, 600.0, arms),
        jobs=tuple(f"job_{tick + slot}" for slot in range(SLOTS)),
        difficulty=difficulty,
        p_saturation=p_saturation,
        twin=("lstm-1",) * arms,
    )


class Bare:
    """Bare Zenoh: put, and count in callbacks until all messages have arrived."""

    def __init__(self, arms: int, resources: ExitStack) -> None:
        endpoint = resources.enter_context(Router()).endpoint
        seats = sessions_for(arms)
        self._expected = messages(arms)
        self._came = 0
        self._lock = threading.Lock()
        self._done = threading.Event()
        sessions = [open_client(endpoint, timeout_s=TIMEOUT_S) for _ in range(seats if seats == arms else seats + 1)]
        for session in sessions:
            resources.callback(session.close)
        remote = zenoh.Locality.REMOTE
        count = zenoh.handlers.Callback(self._count, indirect=False)
        for session in sessions if seats == arms else sessions[seats:]:
            session.declare_subscriber("bare/*/*", count, allowed_origin=remote)
        self._publishers = [
            [sessions[i % seats].declare_publisher(f"bare/{i}/{topic}", allowed_destination=remote) for topic in "ab"]
            for i in range(arms)
        ]
        for session in sessions:
            await_router(session)

    def _count(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self._came += 1
            if self._came == self._expected:
                self._done.set()

    def tick(self, payloads: list[tuple[bytes, bytes]]) -> None:
        self._came = 0
        self._done.clear()
        for publishers, pair in zip(self._publishers, payloads, strict=True):
            for publisher, payload in zip(publishers, pair, strict=True):
                publisher.put(payload)
        assert self._done.wait(TIMEOUT_S), f"bare Zenoh lost {self._expected - self._came} deliveries"


class PingPong:
    """One client puts, the callback of another puts back."""

    def __init__(self, resources: ExitStack) -> None:
        endpoint = resources.enter_context(Router()).endpoint
        near, far = (open_client(endpoint, timeout_s=TIMEOUT_S) for _ in range(2))
        resources.callback(near.close)
        resources.callback(far.close)
        self._back = threading.Event()
        self._ping = near.declare_publisher("ping")
        pong = far.declare_publisher("pong")

        def put_back(sample: zenoh.Sample) -> None:
            pong.put(sample.payload)

        far.declare_subscriber("ping", zenoh.handlers.Callback(put_back, indirect=False))
        near.declare_subscriber("pong", zenoh.handlers.Callback(lambda _: self._back.set(), indirect=False))
        await_router(far)
        await_router(near)

    def one_way_s(self) -> float:
        self._back.clear()
        start_s = time.perf_counter()
        self._ping.put(b"x" * 256)
        assert self._back.wait(TIMEOUT_S)
        return (time.perf_counter() - start_s) / 2


def messages(arms: int) -> int:
    """Deliveries per tick: two messages of every arm, to all other sessions or to the one that receives for all."""
    return 2 * arms * (arms - 1 if sessions_for(arms) == arms else 1)


def await_router(session: zenoh.Session) -> None:
    """Return when the router has processed the declarations of the session; it replies in order."""
    assert list(session.get("@/*/router", timeout=TIMEOUT_S))


def timed(call: Callable[[], object]) -> float:
    """Duration of a call, s."""
    start_s = time.perf_counter()
    call()
    return time.perf_counter() - start_s


def measure(arms: int, ticks: int) -> str:
    """One row of the table."""
    rng = np.random.default_rng(0)
    names = tuple(f"arm_{i}" for i in range(arms))
    zenoh_s, memory_s, bare_s = [], [], []
    with ExitStack() as resources:
        bus = resources.enter_context(ZenohExchange(names, "bench", timeout_s=TIMEOUT_S))
        memory = resources.enter_context(MemoryExchange(names))
        bare = Bare(arms, resources)
        for tick in range(ticks + WARM_UP):
            words = words_at(tick, arms, rng)
            payloads = [(encode(state), encode(word)) for state, word in messages_of(words, names, tick)]
            zenoh_s.append(timed(lambda words=words: bus.share(words)))
            memory_s.append(timed(lambda words=words: memory.share(words)))
            bare_s.append(timed(lambda payloads=payloads: bare.tick(payloads)))
        lost = bus.late
    times = [sorted(1e3 * s for s in column[WARM_UP:]) for column in (zenoh_s, bare_s, memory_s)]
    cells = "".join(f"{statistics.median(column):>9.3f}{column[int(0.95 * len(column))]:>9.3f}" for column in times)
    ratio = statistics.median(times[0]) / statistics.median(times[1])
    return f"{arms:>5}{messages(arms):>12}{cells}{ratio:>8.2f}{lost:>6}"


def start(arms: int, pipe: Connection) -> None:
    """In a separate process: seconds until the exchange is open and until every arm has all messages, and its MB."""
    rng = np.random.default_rng(0)
    words = words_at(0, arms, rng)
    with Router() as router, open_client(router.endpoint, timeout_s=TIMEOUT_S):  # the fixed cost of Zenoh
        before_mb, begun_s = resident_mb(), time.perf_counter()
        with ZenohExchange(tuple(f"arm_{i}" for i in range(arms)), "start", timeout_s=TIMEOUT_S) as bus:
            open_s = time.perf_counter() - begun_s
            bus.share(words)
            heard_s, late = time.perf_counter() - begun_s, bus.late
            pipe.send((open_s, heard_s, resident_mb() - before_mb, late))


def resident_mb() -> float:
    """Resident set of this process, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def started(arms: int, times: int) -> str:
    """One line about the start of an exchange with `arms` arms, medians of `times` starts."""
    spawn = multiprocessing.get_context("spawn")
    found = []
    for _ in range(times):
        here, there = spawn.Pipe()
        process = spawn.Process(target=start, args=(arms, there))
        process.start()
        found.append(here.recv())
        process.join(TIMEOUT_S)
    open_s, heard_s, mb, late = (statistics.median(column) for column in zip(*found, strict=True))
    verdict = {True: "met", False: "missed"}
    return (
        f"{arms} arms from start: open after {open_s:.2f} s, all messages delivered after {heard_s:.2f} s, "
        f"{mb:.0f} MB, {late:.0f} late (targets: <= 1 s {verdict[heard_s <= 1]}, <= 120 MB {verdict[mb <= 120]})"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, nargs="+", default=[4, 16, 64])
    parser.add_argument("--ticks", type=int, default=200, help="for 4 arms; fewer for more (default 200)")
    parser.add_argument("--start", type=int, default=256, help="arms of the fleet whose start is timed")
    options = parser.parse_args()
    with ExitStack() as resources:
        ping = PingPong(resources)
        one_way = statistics.median(ping.one_way_s() for _ in range(500))
    print(f"bare Zenoh put → callback through the router, one way, median: {1e3 * one_way:.3f} ms\n")
    print(started(options.start, 5) + "\n")
    print("ms per tick          share over Zenoh        bare Zenoh     share in memory   Zenoh/")
    print(" arms  deliveries   median      p95   median      p95   median      p95    bare  late")
    for arms in options.arms:
        print(measure(arms, max(20, options.ticks * 4 // arms)), flush=True)


if __name__ == "__main__":
    main()
