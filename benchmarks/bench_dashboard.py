"""Load of the live page: messages that reach it, and the processor time and memory of the process that serves it.

    python -m benchmarks.bench_dashboard [--arms 16] [--rate 10] [--seconds 20] [--pages 1] [--chromium PROGRAM]

A process publishes states of arms with all their quantities, --rate a second each (live arms: 10), and scores of 16
jobs with every tenth, on a separate router. `thermofleet bus gateway --page` serves the page. Readers take its
stream as the page does; with --chromium the page is opened too, rendered without a graphics card, and its processes are
measured separately. Linux only.
"""

import json
import math
import os
import subprocess
import tempfile
import threading
import time
import urllib.request
from argparse import Namespace
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path

from benchmarks.harness import CHROMIUM, cpu_s, options, received, route, rss_mb, spawned
from docs.bus_contract import EXAMPLES
from fleet.bus.client import BusClient
from fleet.bus.protocol import auction as bus
from fleet.bus.protocol import keys
from fleet.bus.protocol.cell import Cell, CellArm, CellRequest
from fleet.bus.protocol.messages import DifficultyScores, State
from scenarios.live.fleet_processes import PROGRAM

FLEET, JOBS = "bench", 16
GOAL_CORE, GOAL_MB = 0.25, 150.0


def publish(pipe: Connection, endpoint: str, arms: int, rate_hz: float) -> None:
    """Publish a fleet until there is a message in the pipe."""
    names = tuple(f"arm_{i:02d}" for i in range(arms))
    example = EXAMPLES[Cell]
    assert isinstance(example, Cell)
    mounts = tuple(
        CellArm(name, (1.6 * (i % 4), 1.6 * (i // 4), 0.0), (0.0, 0.0, 0.0), 3.0, 0.2, 0.902)
        for i, name in enumerate(names)
    )
    cell = Cell(example.auctioneer, "bench", example.places, mounts, example.kinds, example.limits, 60.0, 75.0, 128)
    jobs = tuple(f"crate_{i}" for i in range(JOBS))
    statuses = tuple(bus.JobStatus(job, "waiting", repetitions=20) for job in jobs)
    with BusClient(endpoint, FLEET) as link:
        states = [link.publisher(keys.of_arm(FLEET, name, "state"), State) for name in names]
        scores = [link.publisher(keys.of_arm(FLEET, name, "difficulty"), DifficultyScores) for name in names]
        for name in names:
            link.declare_token(keys.of_arm(FLEET, name, "alive"))
        link.declare_token(keys.of_auction(FLEET, "auctioneer", "alive"))
        start_s = time.monotonic()
        link.reply_to(keys.of_jobs(FLEET, "cell"), CellRequest, lambda _: cell)
        link.reply_to(
            keys.of_jobs(FLEET, "status"),
            bus.StatusRequest,
            lambda _: bus.Status("auctioneer", time.monotonic() - start_s, statuses),
        )
        link.reply_to(keys.of_clock(FLEET), bus.ClockRequest, lambda _: bus.Clock(time.monotonic() - start_s, 1.0))
        pipe.send("ready")
        tick = 0
        while not pipe.poll():
            tick += 1
            now_s = tick / rate_hz
            for i, name in enumerate(names):
                swing = math.sin(now_s + i)
                q = (swing, 0.4 + 0.3 * swing, 3.1, -2.0 + 0.4 * swing, 0.1, 0.9, 1.57)
                temp_c = tuple(40.0 + 3.0 * joint + 10.0 * math.sin(0.1 * now_s + i) for joint in range(7))
                states[i](
                    State(name, tick, now_s, "working", temp_c, 60.0 - max(temp_c), "crate_0", "5d1c0f7e92ab3486", 30.0,
                          temp_c, 22.0, 1.0, 5, 55.0, 0.05, q, q, q, q)
                )  # fmt: skip
                if tick % 10 == i % 10:
                    values = tuple(0.1 * job for job in range(JOBS))
                    scores[i](DifficultyScores(name, tick, now_s, "twin", jobs, values, (0.1,) * JOBS, values))
            while time.monotonic() < start_s + (tick + 1) / rate_hz:
                link.serve(start_s + (tick + 1) / rate_hz)


class Reader(threading.Thread):
    """Counts the states of a stream of events."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self.address, self.count, self.octets = address, 0, 0

    def run(self) -> None:
        """Read until the stream ends."""
        with urllib.request.urlopen(f"{self.address}v4/events", timeout=60) as stream:
            for line in stream:
                self.octets += len(line)
                self.count += line == b"event: state\n"


def family(process: int) -> list[int]:
    """A process and all below it."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [process, *(below for child in children for below in family(int(child)))]


def main() -> None:
    """Measure and print a table."""
    given = options(
        __doc__,
        arms=16,
        rate=10.0,
        seconds=20.0,
        pages=(1, "readers of the stream"),
        chromium=("", "program that opens the page, with playwright"),
    )
    with ExitStack() as stack:
        log = stack.enter_context(tempfile.TemporaryFile("w+"))
        endpoint, _ = received(stack.enter_context(spawned(route)))
        assert received(stack.enter_context(spawned(publish, endpoint, given.arms, given.rate))) == "ready"
        argv = [*PROGRAM, "bus", "gateway", "--page", "--fleet", FLEET, "--endpoint", endpoint, "--port", "0"]
        server = subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=log, text=True)
        try:
            assert server.stdout is not None
            address = server.stdout.readline().split()[2]
            urllib.request.urlopen(f"{address}v4/scene", timeout=60).read()
            urllib.request.urlopen(f"{address}page/three.js", timeout=60).read()
            print_table(measure(address, server.pid, given), given)
        finally:
            server.terminate()
            server.wait(20)


def measure(address: str, server: int, given: Namespace) -> dict[str, float]:
    """Figures of a page that is read for a while, each per second of real time where it is a rate."""
    readers = [Reader(address) for _ in range(given.pages)]
    for reader in readers:
        reader.start()
    pause, found = threading.Event(), dict[str, float]()
    if given.chromium:
        from playwright.sync_api import sync_playwright

        with sync_playwright() as play:
            browser = play.chromium.launch(executable_path=given.chromium, args=list(CHROMIUM))
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.goto(address)
            page.wait_for_selector("body[data-ready]", timeout=60_000)
            page.wait_for_timeout(3000)
            read = "({...dashboard, at: performance.now() / 1000})"
            mine = [one for one in family(os.getpid()) if b"chrom" in Path(f"/proc/{one}/cmdline").read_bytes()]
            before, core = page.evaluate(read), sum(map(cpu_s, mine))
            found |= rates(readers, server, given.seconds, lambda: page.wait_for_timeout(1000 * given.seconds))
            after = page.evaluate(read)
            span_s = after["at"] - before["at"]
            found["states of each arm in the page, 1/s"] = (after["states"] - before["states"]) / span_s / given.arms
            found["frames rendered by the page, 1/s"] = (after["updates"] - before["updates"]) / span_s
            found["browser, cores"] = (sum(map(cpu_s, mine)) - core) / span_s
            browser.close()
        return found
    pause.wait(3.0)
    return rates(readers, server, given.seconds, lambda: pause.wait(given.seconds))


def rates(readers: list[Reader], server: int, seconds: float, wait: Callable[[], object]) -> dict[str, float]:
    """Figures of the server while `wait` runs."""
    counts, octets = [reader.count for reader in readers], sum(reader.octets for reader in readers)
    start_s, start_core_s = time.monotonic(), cpu_s(server)
    wait()
    span_s = time.monotonic() - start_s
    least = min(reader.count - count for reader, count in zip(readers, counts, strict=True))
    return {
        "updates": least / span_s,
        "kB/s to one reader": (sum(reader.octets for reader in readers) - octets) / span_s / len(readers) / 1000,
        "server, cores": (cpu_s(server) - start_core_s) / span_s,
        "server, MB at most": rss_mb(server, peak=True),
    }


def print_table(found: dict[str, float], given: Namespace) -> None:
    """Print the figures beside their goals."""
    found = {"states of each arm to a reader, 1/s": found.pop("updates") / given.arms, **found}
    goals = {
        "states of each arm to a reader, 1/s": f"of {given.rate:g} published",
        "server, cores": f"≤ {GOAL_CORE:g}",
        "server, MB at most": f"≤ {GOAL_MB:g}",
    }
    print(f"{given.arms} arms, {given.pages} reader(s), {given.seconds:g} s, {json.dumps(os.cpu_count())} cores")
    for name, value in found.items():
        print(f"{name:<42}{value:10.2f}   {goals.get(name, '')}")


if __name__ == "__main__":
    main()
