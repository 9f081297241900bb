"""`thermofleet auction`: the fleet's auctioneer as a process of its own."""

import logging
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleet.errors import FleetError
from fleet.job import Job
from scenarios.cli.options import ENDPOINT, EndpointOption, PolicyOption
from scenarios.load import load
from scenarios.schema import Scenario

if TYPE_CHECKING:
    from fleet.bus.protocol.auction import JobSpec
    from fleet.live.auction.node import AuctionNode
    from scenarios.cli.signals import Stop

log = logging.getLogger(__name__)

TURN_S = 0.1
"""Real seconds between two looks at what else is to be done."""
FAREWELL_S = (1.0, 10.0)
"""Real seconds to say the last words; and at most, to hear of jobs that are in their last cycle."""


def auction_command(
    scenario: Annotated[str, typer.Argument(help="A library name (see `thermofleet list`) or a .toml file.")],
    name: Annotated[str, typer.Option(help="Of the auctioneer; part of its keys.")] = "auctioneer",
    policy: PolicyOption = "matching",
    speed: Annotated[float, typer.Option(help="Fleet seconds per real second.")] = 1.0,
    journal: Annotated[
        Path | None, typer.Option(help="Folder of its journal; the same one again goes on where it stopped.")
    ] = None,
    jobs: Annotated[
        str, typer.Option(help="scenario: the scenario's own stream, until it is done; none: what others submit.")
    ] = "scenario",
    seed: Annotated[int, typer.Option(help="Draws the scenario's jobs; 0 or more.")] = 0,
    endpoint: EndpointOption = ENDPOINT,
    fleet: Annotated[str, typer.Option(help="Name of the fleet; default: the scenario's name.")] = "",
) -> None:
    """Auction jobs to the arms of a fleet, keep its time, and record awards in a journal."""
    from fleet.bus.client.client import BusClient
    from fleet.live.auction.ledger import AuctionRecord
    from fleet.live.auction.node import AuctionNode
    from fleet.live.auction.round import Timing
    from fleet.live.journal import Journal
    from scenarios.cli.live.consensus import refuse_other_way
    from scenarios.cli.signals import until_stopped
    from scenarios.live.allocation import central_allocation

    chosen = load(scenario)
    if jobs not in ("scenario", "none"):
        raise FleetError(f"--jobs must be scenario or none (got {jobs}).")
    if not 0 < speed < float("inf") or seed < 0:
        raise FleetError(f"--speed must be > 0 and --seed 0 or more (got {speed:g}, {seed}).")
    allocate = central_allocation(policy, chosen, seed)
    own = own_jobs(chosen, seed) if jobs == "scenario" else []
    fleet = fleet or chosen.name
    folder = journal or Path("runs") / f"live-{fleet}"
    refuse_other_way(folder, (arm.name for arm in chosen.arms), alone=False)
    with (
        until_stopped() as stop,
        BusClient(endpoint, fleet) as link,
        Journal[AuctionRecord](folder / f"{name}.journal", AuctionRecord) as book,
    ):
        places = frozenset(place.name for place in chosen.places)
        timing = Timing(max_jobs=chosen.slots)
        node = AuctionNode(link, name, book, allocate=allocate, speed=speed, places=places, timing=timing)
        typer.echo(f"ready {name} {endpoint} {os.getpid()}")
        if node.auctioneer.ledger.jobs:
            log.warning("Going on from %s: %s", book.path, told(node).partition("\n")[0])
        if node.auctioneer.ledger.ended:
            log.warning("That shift is over; another --journal (of thermofleet up: --out) begins a new one.")
        if own:
            work(node, own, chosen.horizon_s, stop)
        else:
            while not stop.is_set():
                node.serve(time.monotonic() + TURN_S)
        typer.echo(told(node))
        stop.leave(f"Interrupted at {node.time_s:.0f} s; the journal is {book.path}, and the same command goes on.")


def work(node: "AuctionNode", own: "Sequence[tuple[float, JobSpec]]", horizon_s: float, stop: "Stop") -> None:
    """Serve, and hand in a stream of jobs as they are released, until all is done or the shift is over."""
    from fleet.bus.protocol.auction import Submission
    from fleet.errors import JournalFull

    left = [] if node.auctioneer.ledger.ended else list(own)
    while not stop.is_set():
        node.serve(time.monotonic() + TURN_S)
        due = tuple(word for at_s, word in left if at_s <= node.time_s)
        if due and not node.rivals:
            try:
                for said in node.submit(Submission(due, "scenario")).jobs:
                    if not said.accepted:
                        log.warning("'%s' was not taken: %s", said.job, said.reason)
                del left[: len(due)]
            except JournalFull as error:
                log.error("The scenario's jobs have to wait: %s", error)
        over = node.time_s >= horizon_s and not node.auctioneer.ledger.ended
        if over or not (left or node.auctioneer.ledger.unsettled()):
            if over:
                node.end()
            break
    first_s, last_s = (time.monotonic() + farewell_s for farewell_s in FAREWELL_S)
    while not stop.is_set() and time.monotonic() < (last_s if node.auctioneer.finishing() else first_s):
        node.serve(time.monotonic() + TURN_S)


def own_jobs(scenario: Scenario, seed: int) -> "list[tuple[float, JobSpec]]":
    """The stream of a scenario for one seed, the same as in `thermofleet run`, each job with when to hand it in.

    That is when it is released and everything that it waits for is handed in.
    """
    from graphlib import TopologicalSorter

    import numpy as np

    from scenarios.job_stream import draw_jobs

    # As `ShiftFactory` draws them for the first shift of a seed.
    jobs = {job.name: job for job in draw_jobs(scenario, np.random.SeedSequence(seed, spawn_key=(0,)))}
    at_s: dict[str, float] = {}
    for name in TopologicalSorter({name: job.after for name, job in jobs.items()}).static_order():
        at_s[name] = max([jobs[name].release_s, *(at_s[before] for before in jobs[name].after)])
    return [(when_s, word_of(jobs[name])) for name, when_s in sorted(at_s.items(), key=lambda item: item[1])]


def word_of(job: Job) -> "JobSpec":
    """The job as it travels."""
    from fleet.bus.protocol.auction import JobSpec

    return JobSpec(
        name=job.name,
        kind=job.work.kind,
        places=tuple(place.name for place in job.work.places),
        repetitions=job.repetitions,
        payload_kg=job.work.payload_kg,
        dwell_s=job.work.dwell_s,
        force_n=job.work.force_n,
        release_s=job.release_s,
        due_s=job.due_s,
        value=job.value,
        after=job.after,
    )


def told(node: "AuctionNode") -> str:
    """How it stands, in a line or more."""
    statuses = node.auctioneer.status()
    done = [said for said in statuses if said.state == "finished"]
    lines = [f"{node.time_s:.0f} s: {len(done)} of {len(statuses)} jobs finished."]
    lines += [
        f"  {said.job}: {said.state}{f' at {said.arm}' if said.arm else ''}{f', {said.reason}' if said.reason else ''}"
        for said in statuses
        if said.state != "finished"
    ]
    return "\n".join(lines)
