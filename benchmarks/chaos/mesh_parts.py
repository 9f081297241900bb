"""Participants of the campaign with two routers: an auctioneer, and one process with many arms.

    python -m benchmarks.chaos.mesh_parts auction|NUMBER,NUMBER,… ADDRESS KEYS JOURNALS ARMS SPEED

Four arms are a cell with places of its own, so many arms can work at a time. Bodies, plans and journals are those of
`thermofleet arm run` without twins; the arms of a process take turns on one thread, and publish one state a second.
"""

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from fleet.bus.client import BusClient
from fleet.bus.protocol.auction import JobSpec
from fleet.bus.security.tls import Tls
from fleet.job import Work
from fleet.live.arm.awards import ArmRecord
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.auction.node import AuctionNode
from fleet.live.journal import Journal
from fleet.live.leases import Timing
from fleet.live.records import BookRecord
from scenarios.live.arm import PreparedArm, make_node, simulated_arm
from scenarios.live.auctioneer import CentralAllocation
from scenarios.policy_loader import policy_at
from scenarios.progress import quiet
from scenarios.signals import StopRequest, until_stopped
from scenarios.spec.load import load

SCENARIO, FLEET = "quickstart", "mesh"
CELL = 4
"""Arms of a cell."""
RATE_HZ, TURN_S, OPEN_S = 1.0, 0.05, 60.0


def names_of(arms: int) -> tuple[str, ...]:
    """Return the names of the arms."""
    return tuple(f"arm_{number:03d}" for number in range(arms))


def job_of(number: int, arms: int) -> JobSpec:
    """Return a job of a few minutes whose plans are cached, in one of the cells in turn."""
    cells = -(-arms // CELL)
    cell, name = number % cells, f"job {number:04d}"
    repetitions = 4 + number // cells % 3
    if number // cells % 2:
        places = (f"rack_left {cell}", f"tray_left {cell}")
        return JobSpec(name=name, kind="pick_place", places=places, payload_kg=0.5, repetitions=repetitions)
    places = (f"belt {cell}", f"bin {cell}")
    return JobSpec(name=name, kind="sort", places=places, payload_kg=0.1, repetitions=repetitions)


def auction(endpoint: str, journals: Path, arms: int, speed: float, stop: StopRequest) -> None:
    """Run the auctioneer."""
    with (
        BusClient(endpoint, FLEET, stopped=stop.is_set) as link,
        Journal[BookRecord](journals / "auctioneer.journal", BookRecord) as book,
    ):
        known = LiveFleet(arms=names_of(arms), limits=load(SCENARIO).limits)
        allocate = CentralAllocation(policy_at("quickest_matching", 0), known)
        timing = Timing(max_jobs=16, window_s=2.0, ack_s=2.0)
        node = AuctionNode(link, "auctioneer", book, allocate=allocate, speed=speed, timing=timing)
        print("ready auctioneer", flush=True)
        while not stop.is_set():
            node.serve(time.monotonic() + 0.25)


def work_arms(numbers: list[int], address: str, keys: Path, journals: Path, speed: float, stop: StopRequest) -> None:
    """Run arms."""
    scenario = load(SCENARIO)
    places = {place.name: place for place in scenario.places}
    prepared = [simulated_arm(scenario, arm.name, "blind", 0, quiet) for arm in scenario.arms]

    def plan_at_home(arm: PreparedArm) -> Callable[[Work], tuple]:
        """Return a planner that takes the places of any cell."""

        def plan(work: Work) -> tuple:
            return arm.plan(replace(work, places=tuple(places[place.name.split()[0]] for place in work.places)))

        return plan

    with ExitStack() as stack:
        nodes = []
        for number in numbers:
            name, cell, arm = f"arm_{number:03d}", number // CELL, prepared[number % CELL]
            link = BusClient(Tls(keys, name).endpoint(address), FLEET, timeout_s=OPEN_S, stopped=stop.is_set)
            book = stack.enter_context(Journal[ArmRecord](journals / f"{name}.journal", ArmRecord))
            own = tuple(replace(place, name=f"{place.name} {cell}") for place in scenario.places)
            nodes.append(
                make_node(
                    stack.enter_context(link),
                    book,
                    replace(arm, name=name, plan=plan_at_home(arm), works=()),
                    replace(scenario, places=(*scenario.places, *own)),
                    speed=speed,
                    rate_hz=RATE_HZ,
                )
            )
            for node in nodes[:: max(1, len(nodes) // 8)]:
                node.serve(0.0)
        print("ready arms", flush=True)
        while not stop.is_set():
            for node in nodes:
                node.serve(0.0)
            stop.wait(TURN_S)


def main() -> None:
    """Run one participant, or one process of arms."""
    what, address, keys, journals, arms, speed = sys.argv[1:]
    folder = Path(journals)
    folder.mkdir(parents=True, exist_ok=True)
    with until_stopped() as stop:
        if what == "auction":
            auction(Tls(Path(keys), "auctioneer").endpoint(address), folder, int(arms), float(speed), stop)
        else:
            work_arms([int(word) for word in what.split(",")], address, Path(keys), folder, float(speed), stop)


if __name__ == "__main__":
    main()
