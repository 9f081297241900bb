"""Run one fault: start a fleet, submit jobs, inject the fault, evaluate the outcome."""

import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from benchmarks.chaos.fleet_under_test import Fault, Fleet, Outcome
from benchmarks.chaos.partition import Proxy
from benchmarks.chaos.wall_clock import WallClocks
from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import SETTLED, Clock, ClockRequest, JobSpec
from fleet.bus.router import open_client
from fleet.bus.security.access_control import RosterEntry, of_arms
from fleet.bus.security.certificates import HERE, make
from fleet.bus.security.tls import Tls
from fleet.live.supervisor import Supervisor
from scenarios.live.fleet_processes import free_port, parts_of
from scenarios.spec.load import load
from scenarios.spec.options import LiveSpec

START_S = 60.0
LATE_REPORTS_S = 10.0
"""Longest wait for late reports, at the end."""
SCENARIO = "quickstart"
"""Also the name of the fleet: certificates are made for a fleet with the name of its scenario."""
ROGUE = "rogue"
"""An arm with a certificate that is not in the scenario."""


@contextmanager
def start_fleet(fault: Fault, folder: Path, *, speed: float) -> Iterator[Fleet]:
    """Start the fleet that a fault needs, and wait until all participants are on the bus.

    Raises:
        RuntimeError: the fleet did not start.
        CannotInject: this machine cannot inject the fault.
    """
    arms, port = tuple(arm.name for arm in load(SCENARIO).arms), free_port()
    cut_arms = arms[-(fault.cut_arms or len(arms) // 2) :]
    with ExitStack() as stack:
        cut = stack.enter_context(Proxy(port)) if fault.cut else None
        place = folder / "keys" if fault.tls else None
        if place is not None:
            make(place, of_arms(SCENARIO, arms, [RosterEntry(ROGUE, "arm")]), days=30, hosts=HERE)
        router, arm_parts, record, auction = parts_of(
            SCENARIO,
            arms,
            LiveSpec(
                fleet=SCENARIO,
                speed=speed,
                policy="consensus" if fault.no_auctioneer else "quickest_matching",
                difficulty="blind",
                jobs="none",
            ),
            port=port,
            folder=folder,
            tls=place,
        )
        clocks = WallClocks(folder / "clocks") if fault.clocks else None
        if cut is not None:
            arm_parts[-len(cut_arms) :] = map(cut.through, arm_parts[-len(cut_arms) :])
        parts = [record, *([] if auction is None else [auction]), *arm_parts]
        if clocks is not None:
            router = replace(router, env=clocks.env("router"))
            parts = [replace(part, env=clocks.env(part.name)) for part in parts]
        supervisor = stack.enter_context(Supervisor(folder / "logs"))
        supervisor.start(router, ready_s=START_S)
        for part in parts:
            supervisor.start(part)
        for part in parts:
            supervisor.await_ready(part.name, START_S)
        endpoint = router.ready if place is None else Tls(place, "submitter").endpoint(router.ready)
        client = stack.enter_context(BusClient(endpoint, SCENARIO))
        session = stack.enter_context(open_client(endpoint, timeout_s=5.0))
        fleet = Fleet(supervisor, client, router.ready, session, folder, arms, keys=place, cut=cut, clocks=clocks)
        fleet.cut_arms = cut_arms
        fleet.listen()
        if math.isinf(
            fleet.wait_until(lambda: len(fleet.states) == len(arms) and len(fleet.tokens) == len(arms), 30.0)
        ):
            raise RuntimeError(f"Only {sorted(fleet.states)} of {arms} are on the bus.")
        fleet.wait_until(
            lambda: bool(
                fleet.client.query_and_wait(keys.of_clock(SCENARIO), ClockRequest(), Clock, timeout_s=2.0).messages
            )
        )
        yield fleet


def campaign(fault: Fault, folder: Path, *, jobs: int, speed: float) -> Outcome:
    """Run one fault on a new fleet; arguments and errors as for `start_fleet`."""
    with start_fleet(fault, folder, speed=speed) as fleet:
        work = tuple(map(short_job, range(jobs)))
        accepted = {job.name for job in work}
        fleet.submit(work)
        fleet.wait_until(lambda: fleet.working_arm() is not None and _finished(fleet) >= 2)
        injected_s = time.monotonic()
        detected_s = fault.inject(fleet)
        well_s = fleet.wait_until(lambda: is_healthy(fleet))
        recovered_s = time.monotonic() - injected_s if math.isfinite(well_s) else math.inf
        settled_s = fleet.wait_until(lambda: _all_settled(fleet, accepted))
        ended_s = time.monotonic()
        fleet.wait_until(lambda: not _any_unfinished(fleet), LATE_REPORTS_S)
        outcome = fleet.outcome(accepted, fleet.status())
        outcome.detected_s, outcome.recovered_s = detected_s, recovered_s
        outcome.took_s = ended_s - injected_s if math.isfinite(settled_s) else math.inf
    return outcome


def short_job(number: int) -> JobSpec:
    """Return a job of a few minutes whose plans are cached, at one of three stations in turn."""
    name, repetitions = f"job {number:04d}", 4 + number % 3
    if number % 3 == 0:
        return JobSpec(name=name, kind="sort", places=("belt", "bin"), payload_kg=0.1, repetitions=repetitions)
    if number % 3 == 1:
        trays = ("rack_left", "tray_left")
        return JobSpec(name=name, kind="pick_place", places=trays, payload_kg=0.5, repetitions=repetitions)
    return JobSpec(name=name, kind="hold", places=("clamp",), payload_kg=3.0, dwell_s=60.0, repetitions=2)


def _finished(fleet: Fleet) -> int:
    return sum(job.state == "finished" for job in fleet.status().values())


def is_healthy(fleet: Fleet) -> bool:
    """Whether all participants are present and publish, killed ones too, and the auctioneer replies."""
    fleet.client.serve(time.monotonic() + 0.05)
    there = all(fleet.supervisor.ready(name) for name in fleet.supervisor.restarts())
    return there and not any(fleet.is_absent(arm) for arm in fleet.arms) and bool(fleet.status())


def _all_settled(fleet: Fleet, accepted: set[str]) -> bool:
    fleet.client.serve(time.monotonic() + 0.2)
    status = fleet.status()
    return accepted <= set(status) and all(job.state in SETTLED for job in status.values())


def _any_unfinished(fleet: Fleet) -> bool:
    """Whether a job is unfinished; an arm that reconnects may still report it as finished."""
    fleet.client.serve(time.monotonic() + 0.2)
    return any(job.state == "unfinished" for job in fleet.status().values())
