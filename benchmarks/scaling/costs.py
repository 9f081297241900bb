"""CPU-seconds per message of a router and of the auctioneer's client, over mutual TLS on loopback.

    python -m benchmarks.scaling.costs [--states 20000] [--arms 64]

Router, arms (one process) and client are separate processes, so the CPU time of each is its own; the time of day is
not used, so a busy machine changes little. `load.py` calculates with these costs.
"""

import argparse
import multiprocessing
import os
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.scaling.load import JOINTS, estimate_of, job_of, quote_of, state_of
from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Quote, QuoteRequest
from fleet.bus.protocol.messages import State
from fleet.bus.router import Router
from fleet.bus.security.access_control import of_arms
from fleet.bus.security.certificates import make
from fleet.bus.security.tls import Tls

FLEET, PATIENCE_S, PERIOD_S = "f", 60.0, 0.1
ROUNDS, MANY = 20, 32


def cpu_s(pid: int) -> float:
    """CPU time of a process so far, user and system, s (proc_pid_stat(5))."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def route(folder: Path, port: Any, stop: Any) -> None:
    """The router's process."""
    with Router(tls=Tls(folder, "router")) as router:
        port.put(router.endpoint)
        stop.wait()


def arms(folder: Path, endpoint: str, count: int, states: int, begin: Any, stop: Any) -> None:
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
        begin.wait()
        for tick in range(states // count):
            due_s = time.monotonic() + PERIOD_S
            for _, name, put in publish:
                put(state_of(name, tick))
            stop.wait(max(0.0, due_s - time.monotonic()))
        while not stop.is_set():
            for link, *_ in publish:
                link.serve(time.monotonic() + 0.001)


def main() -> None:
    """Print the costs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=20_000)
    parser.add_argument("--arms", type=int, default=64)
    given = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    begin, stop, port = context.Event(), context.Event(), context.Queue()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "keys"
        make(folder, of_arms(FLEET, [f"arm_{number:04d}" for number in range(given.arms)]), days=30)
        router = context.Process(target=route, args=(folder, port, stop), daemon=True)
        router.start()
        endpoint = port.get(timeout=PATIENCE_S)
        sender = context.Process(
            target=arms, args=(folder, endpoint, given.arms, given.states, begin, stop), daemon=True
        )
        sender.start()
        assert router.pid is not None
        with BusClient(Tls(folder, "auctioneer").endpoint(endpoint), FLEET) as client:
            received = [0]

            def count(_: str, state: State) -> None:
                received[0] += len(state.temp_c) == JOINTS

            client.subscribe(keys.of_every_arm(FLEET, "state"), State, count)
            begin.set()
            expected = given.states // given.arms * given.arms
            while received[0] < given.arms:
                client.serve(time.monotonic() + 0.1)
            first, before = received[0], (cpu_s(router.pid), cpu_s(os.getpid()))
            deadline_s = time.monotonic() + PATIENCE_S + given.states / given.arms * PERIOD_S * 3
            while received[0] < expected and time.monotonic() < deadline_s:
                client.serve(time.monotonic() + 0.1)
            got, after = received[0] - first, (cpu_s(router.pid), cpu_s(os.getpid()))
            print(f"states received: {received[0]} of {expected}")
            print(f"router, per state (received once, sent once): {1e6 * (after[0] - before[0]) / got:.0f} µs")
            print(f"client, per state: {1e6 * (after[1] - before[1]) / got:.0f} µs")
            costs = []
            for jobs in (1, MANY):
                request = QuoteRequest("a", tuple(job_of(number) for number in range(jobs)))
                before_s, before_r, replies = cpu_s(os.getpid()), cpu_s(router.pid), 0
                for _ in range(ROUNDS):
                    every = keys.of_every_arm(FLEET, "quote")
                    replies += len(client.query_and_wait(every, request, Quote, timeout_s=10.0).messages)
                costs.append((cpu_s(os.getpid()) - before_s) / replies)
                routed_s = (cpu_s(router.pid) - before_r) / replies
                print(
                    f"quotes of {jobs} job(s): {replies} of {ROUNDS * given.arms}; per quote: client "
                    f"{1e6 * costs[-1]:.0f} µs, router {1e6 * routed_s:.0f} µs"
                )
            print(f"client, per further job in a quote: {1e6 * (costs[1] - costs[0]) / (MANY - 1):.1f} µs")
            stop.set()
        for process in (sender, router):
            process.join(PATIENCE_S)


if __name__ == "__main__":
    main()
