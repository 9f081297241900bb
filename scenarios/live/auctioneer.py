"""The auctioneer of a live fleet as a process: a central policy allocates the jobs of each round."""

import logging
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from graphlib import TopologicalSorter
from pathlib import Path

import numpy as np

from agents.policy import Policy
from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import JobSpec, JobState, JobStatus, Submission
from fleet.bus.router import other_versions
from fleet.env.validation import actions_of
from fleet.errors import BusError, FleetError, Refused
from fleet.job import Job
from fleet.live.auction.knowledge import LiveFleet, claimed_jobs, observe
from fleet.live.auction.node import AuctionNode
from fleet.live.auction.rounds import Allocate, Assignment, Bidding, resolve_claims
from fleet.live.job_rules import MAX_OPEN_JOBS
from fleet.live.journal import Journal
from fleet.live.leases import Timing
from fleet.live.records import BookRecord
from fleet.live.supervisor import return_memory
from scenarios.live.cell import cell_of
from scenarios.policy_loader import ON_BUS, OnBus, policy_at, scope_of, without_simulator
from scenarios.result_folder import disk_errors
from scenarios.signals import StopRequest, until_stopped
from scenarios.spec.jobs import draw_jobs
from scenarios.spec.options import LiveSpec
from scenarios.spec.schema import Scenario
from scenarios.terminal import echo, progress_bar

_LOG = logging.getLogger(__name__)

ON_BUS_S = 1.0
"""Maximum real seconds for a decision of a policy in another process; no lease is renewed meanwhile."""
TURN_S = 0.1
"""Real seconds between two submissions of released jobs."""
NONE_LEFT: Mapping[JobState, int] = {}
FAREWELL_S = (1.0, 10.0)
"""Real seconds to serve after the end, and at most while a job is in its last cycle."""


class CentralAllocation:
    """An allocation rule of the auctioneer, made of a central policy."""

    def __init__(self, policy: Policy, fleet: LiveFleet) -> None:
        self._policy, self._fleet = policy, fleet
        self._last: dict[str, int] = {}
        self._problem = ""

    def __call__(self, bidding: Bidding) -> dict[str, Assignment]:
        """Arm and plan of each job that is assigned: the claims of the policy, resolved as in simulation.

        Empty if the policy runs in another process and does not reply; the auctioneer offers the jobs again.
        """
        seen = observe(bidding, self._fleet, last=self._last)
        try:
            actions = actions_of(list(seen), self._policy.act(seen)).tolist()
        except BusError as error:
            if str(error) != self._problem:  # logged once, not in every round
                _LOG.error("Nothing is awarded until the policy replies: %s", error)
            self._problem = str(error)
            return {}
        if self._problem:
            _LOG.warning("The policy replies again.")
            self._problem = ""
        claims = claimed_jobs(bidding, seen, dict(zip(seen, actions, strict=True)))
        awarded = resolve_claims(bidding, claims, self._fleet.order(bidding.quotes))
        winners = {assignment.arm for assignment in awarded.values()}
        self._last = {arm: 1 if arm in winners else -1 for arm in claims}
        return awarded


def live_fleet(scenario: Scenario, *, ends: bool = True) -> LiveFleet:
    """Parameters of a scenario that live policies see.

    Args:
        ends: Whether the shift ends at the scenario's horizon; a fleet without the scenario's jobs has no end.
    """
    return LiveFleet(
        arms=tuple(arm.name for arm in scenario.arms),
        limits=scenario.limits,
        horizon_s=scenario.horizon_s if ends else float("inf"),
    )


def central_allocation(
    policy: str, scenario: Scenario, seed: int, *, ends: bool = True, bus: OnBus = ON_BUS
) -> Allocate:
    """Allocation rule of the auctioneer of a scenario.

    Args:
        policy: As `scenarios.policy_loader` takes it.
        ends: As of `live_fleet`.
        bus: Fleet and router, for a policy in another process.

    Raises:
        FleetError: no such policy, or one of scope `arm`, which takes no auctioneer.
    """
    if scope_of(policy) == "arm":
        raise FleetError(
            f"Policy '{policy}' of scope arm runs without an auctioneer. "
            f"Start each arm with: thermofleet arm run SCENARIO NAME --policy {policy}"
        )
    made = without_simulator(policy, policy_at(policy, seed, bus))
    return CentralAllocation(made, live_fleet(scenario, ends=ends))


def run_auctioneer(scenario: Scenario, name: str, spec: LiveSpec, endpoint: str) -> None:
    """Run the auctioneer of a fleet until its shift ends, its jobs are settled, or Ctrl-C or SIGTERM.

    Its journal is `NAME.journal`. With `jobs` "none" only Ctrl-C or SIGTERM ends it.

    Raises:
        FleetError: the policy is not central, or the journals are of a shift without an auctioneer.
    """
    bus = OnBus(fleet=spec.fleet or scenario.name, endpoint=endpoint, limit_s=ON_BUS_S)
    allocate = central_allocation(spec.policy, scenario, spec.seed, ends=spec.jobs == "scenario", bus=bus)
    own = scenario_jobs(scenario, spec.seed) if spec.jobs == "scenario" else []
    fleet, folder = folder_of(spec.journal, spec.fleet, scenario)
    refuse_other_way(folder, (arm.name for arm in scenario.arms), alone=False)
    with progress_bar() as progress:
        cell, excludes = cell_of(scenario, name, progress)
    with (
        until_stopped() as stop,
        BusClient(endpoint, fleet, stopped=stop.is_set) as link,
        Journal[BookRecord](folder / f"{name}.journal", BookRecord) as book,
    ):
        link.require("show the token", keys.of_auction(fleet, name, "alive"))
        places = frozenset(place.name for place in scenario.places)
        timing = Timing(max_jobs=scenario.slots)
        node = AuctionNode(
            link,
            name,
            book,
            allocate=allocate,
            speed=spec.speed,
            places=places,
            timing=timing,
            arms=tuple(arm.name for arm in scenario.arms),
            excludes=excludes,
            new_epoch=spec.new_epoch,
            cell=cell,
            reserved={job.name: job for _, job in own},
        )
        for sentence in other_versions(endpoint, fleet):
            _LOG.error("Refused: %s", sentence)
        return_memory()
        echo(f"ready {name} {endpoint} {os.getpid()}")
        if node.book.jobs:
            so_far = summary(node.auctioneer.status(), node.time_s, node.book.left).partition("\n")[0]
            _LOG.warning("Continuing from %s: %s", book.path, so_far)
        if node.book.ended:
            _LOG.warning("That shift is over; another --journal (of thermofleet up: --out) begins a new one.")
        if own:
            submit_stream(node, own, scenario.horizon_s, stop)
        else:
            while not stop.is_set():
                node.serve(time.monotonic() + TURN_S)
        echo(summary(node.auctioneer.status(), node.time_s, node.book.left))
        stop.leave(f"Interrupted at {node.time_s:.0f} s; the journal is {book.path}, and the same command continues.")


def submit_stream(
    node: AuctionNode, stream: Sequence[tuple[float, JobSpec]], horizon_s: float, stop: StopRequest
) -> None:
    """Serve, and submit a stream of jobs as they are released, until all are settled or the shift is over."""
    left, full = [] if node.book.ended else list(stream), False
    while not stop.is_set():
        node.serve(time.monotonic() + TURN_S)
        due = tuple(job for at_s, job in left if at_s <= node.time_s)
        room = max(0, MAX_OPEN_JOBS - len(node.book.unsettled())) if due else 0
        if full != (len(due) > room):
            full = not full
            if full:
                _LOG.warning("There are %d open jobs: the scenario's jobs wait until some are finished.", MAX_OPEN_JOBS)
        due = due[:room]
        if due and not node.rivals:
            try:
                for admission in node.submit(Submission(due, "scenario")).jobs:
                    if not admission.accepted:
                        _LOG.warning("'%s' was refused: %s", admission.job, admission.reason)
                del left[: len(due)]
            except Refused as error:
                _LOG.error("Could not submit the scenario's jobs; retrying: %s", error)
        over = node.time_s >= horizon_s and not node.book.ended
        if over:
            node.end()
        if over or not (left or node.book.unsettled()):
            break
    first_s, last_s = (time.monotonic() + farewell_s for farewell_s in FAREWELL_S)
    while not stop.is_set() and time.monotonic() < (last_s if node.auctioneer.finishing() else first_s):
        node.serve(time.monotonic() + TURN_S)


def scenario_jobs(scenario: Scenario, seed: int) -> list[tuple[float, JobSpec]]:
    """Jobs of a scenario for one seed, as in `thermofleet run`, each with its submission time, s.

    A job is submitted when it and all its predecessors are released.
    """
    # As `ShiftFactory` draws them for the first shift of a seed.
    jobs = {job.name: job for job in draw_jobs(scenario, np.random.SeedSequence(seed, spawn_key=(0,)))}
    at_s: dict[str, float] = {}
    for name in TopologicalSorter({name: job.after for name, job in jobs.items()}).static_order():
        at_s[name] = max([jobs[name].release_s, *(at_s[before] for before in jobs[name].after)])
    return [(due_s, job_spec(jobs[name])) for name, due_s in sorted(at_s.items(), key=lambda item: item[1])]


def job_spec(job: Job) -> JobSpec:
    """Message that describes a job."""
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
        expires=job.expires,
        alternatives=tuple(tuple(place.name for place in work.places) for work in job.alternatives),
    )


def summary(statuses: Sequence[JobStatus], time_s: float, left: Mapping[JobState, int] = NONE_LEFT) -> str:
    """Number of finished jobs, and one line for each other job.

    Args:
        left: Number of evicted jobs, by state.
    """
    others = [status for status in statuses if status.state != "finished"]
    finished, total = len(statuses) - len(others) + left.get("finished", 0), len(statuses) + sum(left.values())
    lines = [f"{time_s:.0f} s: {finished} of {total} jobs finished."]
    for job in others:
        arm, reason = f" (arm: {job.arm})" if job.arm else "", f", {job.reason}" if job.reason else ""
        lines.append(f"  {job.job}: {job.state}{arm}{reason}")
    return "\n".join(lines)


def folder_of(folder: Path | None, fleet: str, scenario: Scenario) -> tuple[str, Path]:
    """Name of the fleet, and its folder, which is created: the given ones or the default ones.

    Raises:
        FleetError: the folder cannot be created.
    """
    name = fleet or scenario.name
    where = folder or Path("runs") / f"live-{name}"
    if where.is_file():
        raise FleetError(f"The journals need a folder, and '{where}' is a file. Give the path of a folder.")
    with disk_errors(where):
        where.mkdir(parents=True, exist_ok=True)
    return name, where


def refuse_other_way(folder: Path, arms: Iterable[str], *, alone: bool, new_epoch: bool = False) -> None:
    """Refuse journals of a shift with the other kind of allocation, since jobs would be done twice.

    Args:
        alone: Whether the arms allocate jobs without an auctioneer.
        new_epoch: Whether an arm may begin without its grants.

    Raises:
        FleetError: a journal is of the other kind.
    """
    remedy = "Use the --policy that the shift was started with, or another folder for a new shift."
    for arm in arms:
        grants, journal = folder / f"{arm}.grants", folder / f"{arm}.journal"
        if alone and not (new_epoch or grants.exists()) and journal.exists() and journal.stat().st_size:
            raise FleetError(
                f"'{journal}' has no '{grants.name}' in its folder: the shift had an auctioneer, or the grants are "
                f"lost, and jobs would be done twice. {remedy} If the grants are lost: --new-epoch."
            )
        if not alone and grants.exists() and grants.stat().st_size:
            raise FleetError(
                f"'{grants}' belongs to a shift without an auctioneer, so jobs could be done twice. {remedy}"
            )
