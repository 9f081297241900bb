"""CPU-seconds per message of a router and of the auctioneer's client, over mutual TLS on loopback.

    python -m benchmarks.scaling.costs [--states 20000] [--arms 64]

Router, arms (one process) and client are separate processes, so the CPU time of each is its own; the time of day is
not used, so a busy machine changes little. `load.py` calculates with these costs.
"""

import os
import tempfile
import time
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path

from benchmarks.harness import cpu_s, options, received, route, spawned
from benchmarks.scaling.load import JOINTS, estimate_of, job_of, quote_of, state_of
from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Quote, QuoteRequest
from fleet.bus.protocol.messages import State
from fleet.bus.security.access_control import of_arms
from fleet.bus.security.certificates import make
from fleet.bus.security.tls import Tls

FLEET, PATIENCE_S, PERIOD_S = "f", 60.0, 0.1
ROUNDS, MANY = 20, 32


def arms(pipe: Connection, folder: Path, endpoint: str, count: int, states: int) -> None:
    """The process of all arms: each publishes its share of the states ten times a second, and quotes."""
    with ExitStack() as stack:
        publish = []
        for number in range(count):
            name = f"arm_{number:04d}"
            link = stack.enter_context(BusClient(Tls(folder, name).endpoint(endpoint), FLEET, timeout_s=PATIENCE_S))
            publish.append((link, name, link.publisher(keys.of_arm(FLEET, name, "state"), State)))

            def quote(request: QuoteRequest, name: str = name) -> Quote:
                return quote_of(name, request.auction, *(estimate_of(job.name) for job in request.jobs))

            link.reply_to(keys.of_arm(FLEET, name, "quote"), QuoteRequest, quote)
        pipe.recv()  # begin
        for tick in range(states // count):
            due_s = time.monotonic() + PERIOD_S
            for _, name, put in publish:
                put(state_of(name, tick))
            pipe.poll(max(0.0, due_s - time.monotonic()))
        while not pipe.poll():
            for link, *_ in publish:
                link.serve(time.monotonic() + 0.001)


def main() -> None:
    """Print the costs."""
    given = options(__doc__, states=20_000, arms=64)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "keys"
        make(folder, of_arms(FLEET, [f"arm_{number:04d}" for number in range(given.arms)]), days=30)
        endpoint, router = received(stack.enter_context(spawned(route, Tls(folder, "router"))))
        sender = stack.enter_context(spawned(arms, folder, endpoint, given.arms, given.states))
        with BusClient(Tls(folder, "auctioneer").endpoint(endpoint), FLEET) as client:
            came = [0]

            def count(_: str, state: State) -> None:
                came[0] += len(state.temp_c) == JOINTS

            client.subscribe(keys.of_every_arm(FLEET, "state"), State, count)
            sender.send("begin")
            expected = given.states // given.arms * given.arms
            while came[0] < given.arms:
                client.serve(time.monotonic() + 0.1)
            first, before = came[0], (cpu_s(router), cpu_s(os.getpid()))
            deadline_s = time.monotonic() + PATIENCE_S + given.states / given.arms * PERIOD_S * 3
            while came[0] < expected and time.monotonic() < deadline_s:
                client.serve(time.monotonic() + 0.1)
            got, after = came[0] - first, (cpu_s(router), cpu_s(os.getpid()))
            print(f"states received: {came[0]} of {expected}")
            print(f"router, per state (received once, sent once): {1e6 * (after[0] - before[0]) / got:.0f} µs")
            print(f"client, per state: {1e6 * (after[1] - before[1]) / got:.0f} µs")
            costs = []
            for jobs in (1, MANY):
                request = QuoteRequest("a", tuple(job_of(number) for number in range(jobs)))
                before_s, before_r, replies = cpu_s(os.getpid()), cpu_s(router), 0
                for _ in range(ROUNDS):
                    every = keys.of_every_arm(FLEET, "quote")
                    replies += len(client.query_and_wait(every, request, Quote, timeout_s=10.0).messages)
                costs.append((cpu_s(os.getpid()) - before_s) / replies)
                routed_s = (cpu_s(router) - before_r) / replies
                print(
                    f"quotes of {jobs} job(s): {replies} of {ROUNDS * given.arms}; per quote: client "
                    f"{1e6 * costs[-1]:.0f} µs, router {1e6 * routed_s:.0f} µs"
                )
            print(f"client, per further job in a quote: {1e6 * (costs[1] - costs[0]) / (MANY - 1):.1f} µs")


if __name__ == "__main__":
    main()
