"""Time of a tick of a simulated shift that is also on the bus: `share` over Zenoh and in memory.

    python -m benchmarks.bench_exchange [--arms 4 16 64] [--ticks 200]

An observer in another session counts the messages: `received` is the time until it has those of the tick. Bare put: as
many puts of the same payloads with a Zenoh session, without waiting. All run in one process on loopback and alternate,
so that other load slows them equally.
"""

import threading
import time

import numpy as np
import zenoh

from benchmarks.harness import cells, options, quantiles, seconds
from fleet.bus.exchange.memory import Broadcast, MemoryExchange
from fleet.bus.exchange.zenoh import ZenohExchange, messages_of
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import encode
from fleet.bus.router import open_client

SLOTS = 8
WARM_UP = 5
TIMEOUT_S = 30.0
FLEET = "bench"


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


class Observer:
    """A session that counts what the arms publish."""

    def __init__(self, session: zenoh.Session, expected: int) -> None:
        self._expected, self._came, self._lock, self.done = expected, 0, threading.Lock(), threading.Event()
        count = zenoh.handlers.Callback(self._count, indirect=False)
        self._ears = [session.declare_subscriber(keys.of_every_arm(FLEET, t), count) for t in ("state", "difficulty")]
        assert list(session.get("@/*/router", timeout=TIMEOUT_S))  # the router has the subscribers: it replies in order

    def _count(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self._came += 1
            if self._came % self._expected == 0:
                self.done.set()


def measure(arms: int, ticks: int) -> str:
    """One row of the table."""
    rng = np.random.default_rng(0)
    names = tuple(f"arm_{i}" for i in range(arms))
    columns: dict[str, list[float]] = {"share": [], "received": [], "bare put": [], "memory": []}
    with (
        ZenohExchange(names, FLEET, timeout_s=TIMEOUT_S) as bus,
        MemoryExchange(names) as memory,
        open_client(bus.endpoint or "", timeout_s=TIMEOUT_S) as session,
    ):
        observer = Observer(session, 2 * arms)
        bare = [session.declare_publisher(f"bare/{i}") for i in range(2 * arms)]
        for tick in range(ticks + WARM_UP):
            words = words_at(tick, arms, rng)
            payloads = [encode(message) for pair in messages_of(words, names, tick) for message in pair]
            observer.done.clear()
            start_s = time.perf_counter()
            columns["share"].append(seconds(lambda words=words: bus.share(words), time.perf_counter))
            assert observer.done.wait(TIMEOUT_S), "The observer has not received all messages."
            columns["received"].append(time.perf_counter() - start_s)
            start_s = time.perf_counter()
            for publisher, payload in zip(bare, payloads, strict=True):
                publisher.put(payload)
            columns["bare put"].append(time.perf_counter() - start_s)
            columns["memory"].append(seconds(lambda words=words: memory.share(words), time.perf_counter))
    times = [time for column in columns.values() for time in quantiles(column[WARM_UP:], 0.95)]
    return f"{arms:>5}{2 * arms:>10}{cells(times, scale=1e3, width=9, digits=3)}"


def main() -> None:
    """Print the table."""
    given = options(__doc__, arms=[4, 16, 64], ticks=(200, "for 4 arms; fewer for more"))
    print("ms per tick          share over Zenoh          received          bare put   share in memory")
    print(" arms  messages" + "   median      p95" * 4)
    for arms in given.arms:
        print(measure(arms, max(20, given.ticks * 4 // arms)), flush=True)


if __name__ == "__main__":
    main()
