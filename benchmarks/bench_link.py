"""Latency of a difficulty message from one process to another, beside bare Zenoh in the same run.

    python -m benchmarks.bench_link [--words 1500] [--rate 100]

A publisher and a listener, in separate processes, connect to a router in a third. The publisher alternates between a
message by `BusClient` (validated, kept for late joiners, JSON) and the same bytes by a bare Zenoh publisher to a bare
callback. Both carry the monotonic clock, which the processes of one machine share. A message counts as used when the
listener's handler has it validated. Microseconds; the target is the ratio.
"""

import argparse
import json
import multiprocessing
import statistics
import time
from multiprocessing.connection import Connection

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import DifficultyScores, encode
from fleet.bus.router import Router, open_client

FLEET = "bench"
SLOTS = 8
TARGET = 1.5
PATIENCE_S = 30.0


def word(tick: int) -> DifficultyScores:
    """Difficulties of eight jobs, with the present time."""
    jobs = tuple(f"hold_at_fixture-{slot:03d}" for slot in range(SLOTS))
    scores = tuple(0.1 * slot + 2.0 for slot in range(SLOTS))
    return DifficultyScores("arm_0", tick, time.monotonic(), "0123456789abcdef", jobs, scores, scores)


def listen(endpoint: str, words: int, pipe: Connection) -> None:
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


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--words", type=int, default=1500)
    parser.add_argument("--rate", type=float, default=100.0, help="messages of each kind per second")
    arguments = parser.parse_args()
    spawn = multiprocessing.get_context("spawn")
    router_end, router_other = spawn.Pipe()
    router = spawn.Process(target=_route, args=(router_other,), daemon=True)
    router.start()
    endpoint = router_end.recv()
    here, there = spawn.Pipe()
    listener = spawn.Process(target=listen, args=(endpoint, arguments.words, there), daemon=True)
    listener.start()
    assert here.recv() == "ready"
    with BusClient(endpoint, FLEET) as link, open_client(endpoint, timeout_s=10.0) as session:
        say = link.publisher(keys.of_arm(FLEET, "arm_0", "difficulty"), DifficultyScores)
        put = session.declare_publisher("bare/difficulty")
        seen: list[str] = []
        link.watch_tokens(keys.of_every_arm(FLEET, "alive"), lambda arm, _: seen.append(arm))
        due_s = time.monotonic() + 0.5
        link.serve(due_s)
        for tick in range(arguments.words):
            for speak in (lambda tick=tick: say(word(tick)), lambda tick=tick: put.put(encode(word(tick)))):
                due_s += 0.5 / arguments.rate
                while time.monotonic() < due_s:
                    link.serve(due_s)
                speak()
        ours, bare = here.recv()
    router_end.send("end")
    print(f"{'one way, us':<26}{'count':>7}{'p50':>8}{'p99':>9}")
    rows = {"bare put → callback": bare, "ours, publish → used": ours}
    quantiles: dict[str, list[float]] = {}
    for name, ages in rows.items():
        cuts = statistics.quantiles(ages, n=100)
        quantiles[name] = [1e6 * cuts[49], 1e6 * cuts[98]]
        print(f"{name:<26}{len(ages):>7}{quantiles[name][0]:>8.0f}{quantiles[name][1]:>9.0f}")
    (bare_50, bare_99), (ours_50, ours_99) = quantiles.values()
    print(f"{'ratio (target ≤ ' + str(TARGET) + ')':<33}{ours_50 / bare_50:>8.2f}{ours_99 / bare_99:>9.2f}")
    listener.join(PATIENCE_S)
    router.join(PATIENCE_S)


def _route(pipe: Connection) -> None:
    with Router() as router:
        pipe.send(router.endpoint)
        pipe.recv()


if __name__ == "__main__":
    main()
