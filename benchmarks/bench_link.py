"""Latency of a difficulty message from one process to another, beside bare Zenoh in the same run.

    python -m benchmarks.bench_link [--words 1500] [--rate 100]

A publisher and a listener, in separate processes, connect to a router in a third. The publisher alternates between a
message by `BusClient` (validated, kept for late joiners, JSON) and the same bytes by a bare Zenoh publisher to a bare
callback. Both carry the monotonic clock, which the processes of one machine share. A message counts as used when the
listener's handler has it validated. Microseconds; the target is the ratio.
"""

import json
import statistics
import time
from contextlib import ExitStack
from multiprocessing.connection import Connection

from benchmarks.harness import options, received, route, spawned
from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import DifficultyScores, encode
from fleet.bus.router import open_client

FLEET = "bench"
SLOTS = 8
TARGET = 1.5
PATIENCE_S = 30.0


def word(tick: int) -> DifficultyScores:
    """Difficulties of eight jobs, with the present time."""
    jobs = tuple(f"hold_at_fixture-{slot:03d}" for slot in range(SLOTS))
    scores = tuple(0.1 * slot + 2.0 for slot in range(SLOTS))
    return DifficultyScores("arm_0", tick, time.monotonic(), "0123456789abcdef", jobs, scores, scores)


def listen(pipe: Connection, endpoint: str, words: int) -> None:
    """Receive both kinds of message and send back their ages, s."""
    ours: list[float] = []
    bare: list[float] = []
    with BusClient(endpoint, FLEET) as link, open_client(endpoint, timeout_s=10.0) as session:
        link.subscribe(
            keys.of_every_arm(FLEET, "difficulty"),
            DifficultyScores,
            lambda _, said: ours.append(time.monotonic() - said.time_s),
            history=True,
        )

        def took(sample: object) -> None:
            bare.append(time.monotonic() - json.loads(sample.payload.to_bytes())["time_s"])  # type: ignore[attr-defined]

        subscriber = session.declare_subscriber("bare/difficulty", took)
        link.declare_token(keys.of_arm(FLEET, "listener", "alive"))
        pipe.send("ready")
        deadline_s = time.monotonic() + PATIENCE_S
        while len(ours) < words and time.monotonic() < deadline_s:
            link.serve(time.monotonic() + 0.5)
        pipe.send((ours, bare))
        subscriber.undeclare()
    pipe.recv()


def main() -> None:
    """Print the table."""
    given = options(__doc__, words=1500, rate=(100.0, "messages of each kind per second"))
    with ExitStack() as stack:
        endpoint, _ = received(stack.enter_context(spawned(route)))
        listener = stack.enter_context(spawned(listen, endpoint, given.words))
        assert received(listener) == "ready"
        link = stack.enter_context(BusClient(endpoint, FLEET))
        session = stack.enter_context(open_client(endpoint, timeout_s=10.0))
        say = link.publisher(keys.of_arm(FLEET, "arm_0", "difficulty"), DifficultyScores)
        put = session.declare_publisher("bare/difficulty")
        link.watch_tokens(keys.of_every_arm(FLEET, "alive"), lambda arm, there: None)
        due_s = time.monotonic() + 0.5
        link.serve(due_s)
        for tick in range(given.words):
            for speak in (lambda tick=tick: say(word(tick)), lambda tick=tick: put.put(encode(word(tick)))):
                due_s += 0.5 / given.rate
                while time.monotonic() < due_s:
                    link.serve(due_s)
                speak()
        ours, bare = received(listener)
    print(f"{'one way, us':<26}{'count':>7}{'p50':>8}{'p99':>9}")
    rows = {"bare put → callback": bare, "ours, publish → used": ours}
    quantiles: dict[str, list[float]] = {}
    for name, ages in rows.items():
        cuts = statistics.quantiles(ages, n=100)
        quantiles[name] = [1e6 * cuts[49], 1e6 * cuts[98]]
        print(f"{name:<26}{len(ages):>7}{quantiles[name][0]:>8.0f}{quantiles[name][1]:>9.0f}")
    (bare_50, bare_99), (ours_50, ours_99) = quantiles.values()
    print(f"{'ratio (target ≤ ' + str(TARGET) + ')':<33}{ours_50 / bare_50:>8.2f}{ours_99 / bare_99:>9.2f}")


if __name__ == "__main__":
    main()
