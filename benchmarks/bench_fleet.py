"""Cost of an arm's process: 64 working arms that publish ten states per second each, beside a bare Zenoh publisher.

    python -m benchmarks.bench_fleet [--arms 64] [--seconds 20] [--rate 10] [--speed 1]

Every arm is `thermofleet arm run`, a separate process, blind, in its own cell; all connect to one router. This process
deals: it awards each arm one long pick-and-place job and renews its lease, so that the arm moves and heats up. It also
listens as a recorder does: every message is validated, gaps are filled from the arm's cache within `GRACE_S`, and the
received ticks are compared with the published ones (`--plain`: without recovery of dropped messages). In the same run
one process publishes as many bytes at the same rate with bare Zenoh.

CPU time is user and system time of all threads over the window (/proc/PID/stat). PSS divides shared pages between the
processes that share them, so its sum over the arms is the memory that they really use.
"""

import os
import signal
import sys
import tempfile
import time
from argparse import Namespace
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

from benchmarks.harness import cells, cpu_s, options, pss_mb, quantiles, rss_mb, status_of
from fleet.bus.client import BusClient, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    Award,
    Clock,
    ClockRequest,
    JobSpec,
    Lease,
    LeaseRequest,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
)
from fleet.bus.protocol.messages import State, encode
from fleet.live.supervisor import Part, Supervisor
from scenarios.live.fleet_processes import PROGRAM, free_port
from scenarios.prepare.fleet import prepare
from scenarios.spec.load import load

FLEET, DEALER = "bench", "dealer"
START_S, SETTLE_S, GRACE_S, FAREWELL_S = 300.0, 5.0, 1.5, 10.0
LEASE_S = 6.0
JOINTS = 7
CELL = """
description = "One arm and its tray."
horizon_s = 3600
[[arms]]
name = "{arm}"
[[places]]
name = "tray"
position_m = [0.45, 0.2, 0.15]
[[places]]
name = "belt"
position_m = [0.45, -0.2, 0.15]
[[jobs]]
name = "load"
kind = "pick_place"
places = ["belt", "tray"]
payload_kg = [0.5]
arrivals = {{ kind = "batch", count = 1 }}
"""
BARE = """
import sys, threading, zenoh
endpoint, size, rate = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
config = '{"mode": "client", "connect": {"endpoints": ["%s"]}, "scouting": {"multicast": {"enabled": false}}}'
with zenoh.open(zenoh.Config.from_json5(config % endpoint)) as session:
    publisher = session.declare_publisher("bare/state")
    print("ready", flush=True)
    payload, pause = b"x" * size, threading.Event()
    while True:
        pause.wait(1 / rate)
        publisher.put(payload)
"""


class Dealer:
    """Awards every arm one job, renews its lease, and counts the arms' messages."""

    def __init__(self, link: BusClient, speed: float, history: bool) -> None:
        self.ticks: dict[str, list[int]] = defaultdict(list)
        """Ticks of the received states, by arm."""
        self.working: set[str] = set()
        """Arms whose last state is `working`."""
        self.refused: list[str] = []
        self._link, self._speed, self._began_s = link, speed, time.monotonic()
        link.subscribe(keys.of_every_arm(FLEET, "state"), State, self._receive, history=history)
        link.reply_to(keys.asked_by_every_arm(FLEET, DEALER, "lease"), LeaseRequest, self._lease)
        link.reply_to(
            keys.asked_by_every_arm(FLEET, DEALER, "report"), Report, lambda report: Receipt(DEALER, report.award)
        )
        link.reply_to(keys.of_clock(FLEET), ClockRequest, lambda _: Clock(self._now_s(), speed))

    def deal(self, arm: str) -> None:
        """Request a quote of an arm and award it its job."""
        job = JobSpec(f"load-{arm}", "pick_place", ("belt", "tray"), 100_000, 0.5)

        def quoted(answers: Replies[Quote]) -> None:
            self.refused += answers.refused.values()
            for quote in answers.messages.values():
                award = Award(f"a-{arm}", f"q-{arm}", DEALER, quote.quote, job, 0, LEASE_S)
                self._link.query(keys.of_arm(FLEET, arm, "award"), award, Ack, acknowledged, timeout_s=START_S)

        def acknowledged(answers: Replies[Ack]) -> None:
            self.refused += [ack.reason for ack in answers.messages.values() if not ack.accepted]

        request = QuoteRequest(f"q-{arm}", (job,))
        self._link.query(keys.of_arm(FLEET, arm, "quote"), request, Quote, quoted, timeout_s=START_S)

    def serve(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Serve for `seconds`, or until the condition is true."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s and not until():
            self._link.serve(min(end_s, time.monotonic() + 0.2))

    def _receive(self, arm: str, state: State) -> None:
        self.ticks[arm].append(state.tick)
        (self.working.add if state.mode == "working" else self.working.discard)(arm)

    def _lease(self, request: LeaseRequest) -> Lease:
        return Lease(DEALER, LEASE_S, tuple(entry.award for entry in request.entries), ())

    def _now_s(self) -> float:
        return self._speed * (time.monotonic() - self._began_s)


def arms_of(folder: Path, names: list[str], endpoint: str, given: Namespace) -> list[Part]:
    """The arms' processes; their common plans are computed first, as by `thermofleet up`."""
    cells = [folder / f"{name}.toml" for name in names]
    for name, cell in zip(names, cells, strict=True):
        cell.write_text(CELL.format(arm=name), encoding="utf-8")
    prepare(load(cells[0]), difficulty="blind")
    how = ("--difficulty", "blind", "--speed", f"{given.speed:g}", "--rate-hz", f"{given.rate:g}")
    where = ("--endpoint", endpoint, "--fleet", FLEET, "--journal", str(folder / "journals"))
    return [
        Part(name=name, argv=(*PROGRAM, "arm", "run", str(cell), name, *where, *how))
        for name, cell in zip(names, cells, strict=True)
    ]


def end(supervisor: Supervisor, dealer: Dealer, names: list[str]) -> None:
    """Terminate all arms and receive their last reports."""
    pids = [pid for name in names if (pid := supervisor.pid(name)) is not None]
    for pid in pids:
        os.kill(pid, signal.SIGTERM)
    dealer.serve(FAREWELL_S, lambda: not any(supervisor.pid(name) for name in names))


def row(what: str, values: list[float], digits: int = 2) -> str:
    """Median, 95th percentile and maximum."""
    return f"{what:<36}{cells(quantiles(values, 0.95, 1.0), digits=digits)}"


def main() -> None:
    """Print the table."""
    given = options(
        __doc__,
        arms=64,
        seconds=(20.0, "measurement window, once all arms work"),
        rate=(10.0, "states per arm and second"),
        plain=(False, "listen without recovery of dropped messages"),
        speed=(1.0, "fleet seconds per real second"),
    )
    names = [f"arm_{i:02d}" for i in range(given.arms)]
    size = len(encode(State("arm_00", 1000, 123.456789, "working", (12.345678901234567,) * JOINTS, 12.3456789)))
    size += 4 * JOINTS * 20  # joint positions, speeds, torques and currents, as published by a simulated arm
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        supervisor = stack.enter_context(Supervisor(folder / "logs"))
        port = free_port()
        endpoint = f"tcp/127.0.0.1:{port}"
        supervisor.start(Part(name="router", argv=(*PROGRAM, "bus", "router", "--port", str(port)), ready=endpoint))
        supervisor.await_ready("router", START_S)
        bare = (sys.executable, "-c", BARE, endpoint, str(size), str(given.rate))
        supervisor.start(Part(name="bare", argv=bare, ready="ready"), ready_s=START_S)
        dealer = Dealer(stack.enter_context(BusClient(endpoint, FLEET)), given.speed, not given.plain)
        parts = arms_of(folder, names, endpoint, given)
        began_s = time.monotonic()
        for part in parts:
            supervisor.start(part)
        dealer.serve(START_S, lambda: all(supervisor.ready(n) for n in names) or not all(map(supervisor.pid, names)))
        for name in names:
            supervisor.await_ready(name, 0.0)
        started_s = time.monotonic() - began_s
        for name in names:
            dealer.deal(name)
        dealer.serve(START_S, lambda: len(dealer.working) == len(names) or bool(dealer.refused))
        assert not dealer.refused, dealer.refused[0]
        assert len(dealer.working) == len(names), f"{len(dealer.working)} of {len(names)} arms work"
        dealer.serve(SETTLE_S)
        pids = {name: supervisor.pid(name) or 0 for name in (*names, "bare", "router")} | {"this": os.getpid()}
        before = {name: cpu_s(pid) for name, pid in pids.items()}
        dealer.ticks.clear()
        begun_s = time.monotonic()
        dealer.serve(given.seconds)
        took_s = time.monotonic() - begun_s
        share = {name: (cpu_s(pid) - before[name]) / took_s for name, pid in pids.items()}
        bounds = {name: (of[0], of[-1]) for name in names if (of := dealer.ticks[name])}
        memory = {name: (rss_mb(pid), pss_mb(pid), float(status_of(pid)["Threads"])) for name, pid in pids.items()}
        still = len(dealer.working)
        dealer.serve(GRACE_S)
        ticks = {name: [t for t in dealer.ticks[name] if first <= t <= last] for name, (first, last) in bounds.items()}
        end(supervisor, dealer, names)
    arrived = sum(map(len, ticks.values()))
    published = sum(last - first + 1 for first, last in bounds.values())
    orderly = all(b > a for of in ticks.values() for a, b in pairwise(of))
    published_hz = [(last - first) / took_s for first, last in bounds.values()]
    arms = [100 * share[name] for name in names]
    print(f"{len(names)} arms, {os.cpu_count()} cores, {given.rate:g} Hz, speed {given.speed:g}, {took_s:.1f} s;")
    print(f"all ready {started_s:.1f} s after the first start; {still} working at the end\n")
    print(f"{'each arm':<36}{'median':>10}{'p95':>10}{'max':>10}")
    print(row("processor, % of a core", arms))
    print(row("RSS, MB", [memory[name][0] for name in names], 1))
    print(row("PSS, MB", [memory[name][1] for name in names], 1))
    print(row("threads", [memory[name][2] for name in names], 0))
    print(row("states per second", published_hz))
    print(f"\n{'other processes':<36}{'% of core':>10}{'RSS MB':>10}{'PSS MB':>10}")
    for what, name in (("bare publisher", "bare"), ("router", "router"), ("dealer and listener", "this")):
        print(f"{what:<36}{100 * share[name]:>10.2f}{memory[name][0]:>10.1f}{memory[name][1]:>10.1f}")
    print(f"\nall arms: {sum(arms) / 100:.2f} cores, {sum(memory[name][1] for name in names):.0f} MB (PSS)")
    print(
        f"delivered: {arrived} of {published} ({arrived / max(published, 1):.2%}){'' if orderly else ', out of order'}"
    )


if __name__ == "__main__":
    main()
