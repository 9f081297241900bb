"""One fleet, one fault: started anew, given jobs, struck, and judged."""

import math
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from namespaces import Namespaces
from partition import Line
from struck import Fault, Fleet, Outcome
from wall_clock import WallClocks

from fleet.bus.client.client import BusClient
from fleet.bus.client.router import open_client
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Clock, ClockRequest, JobSpec, Submission, SubmissionReply
from fleet.bus.security.access_control import Participant, of_arms
from fleet.bus.security.certificates import HERE
from fleet.bus.security.keyring import make
from fleet.bus.security.tls import Tls
from fleet.live.supervisor import Backoff, Supervisor
from scenarios.cli.live.up import free_port, parts_of
from scenarios.load import load

START_S = 60.0
LATE_S = 10.0
"""Given to late reports, at the end."""
SCENARIO = "quickstart"
"""Its name is that of the fleet too, as keys are for the fleet of their scenario."""
ROGUE = "rogue"
"""An arm of the roster that is not in the scenario."""


def campaign(fault: Fault, folder: Path, *, jobs: int, speed: float, namespaces: bool) -> Outcome:
    """One fleet, one fault, and what became of it.

    Args:
        namespaces: Cut by network namespaces, with certificates, rather than by a line of ours.

    Raises:
        RuntimeError: the fleet did not come up.
        CannotStrike: this machine cannot make the fault.
    """
    arms, port = tuple(arm.name for arm in load(SCENARIO).arms), free_port()
    away = arms[-(fault.away or len(arms) // 2) :]
    with ExitStack() as stack:
        cut = None
        if fault.line:
            cut = stack.enter_context(Namespaces(away, port) if namespaces and not fault.alone else Line(port))
        place = folder / "keys" if fault.tls or isinstance(cut, Namespaces) else None
        if place is not None:
            hosts = cut.hosts.values() if isinstance(cut, Namespaces) else ()
            make(place, of_arms(SCENARIO, arms, [Participant(ROGUE, "arm")]), days=30, hosts=(*HERE, *hosts))
        router, of_fleet, record, auction = parts_of(
            SCENARIO,
            arms,
            port=port,
            fleet=SCENARIO,
            folder=folder,
            speed=speed,
            policy="consensus" if fault.alone else "quickest_matching",
            difficulty="blind",
            jobs="none",
            seed=0,
            tls=place,
        )
        if isinstance(cut, Namespaces):
            router = replace(router, argv=(*router.argv, "--host", "0.0.0.0"))
        work = tuple(_job(number) for number in range(jobs))
        clocks = WallClocks(folder / "clocks") if fault.clocks else None
        if cut is not None:
            of_fleet[-len(away) :] = map(cut.through, of_fleet[-len(away) :], away)
        parts = [record, *([] if auction is None else [auction]), *of_fleet]
        if clocks is not None:
            router = replace(router, env=clocks.env("router"))
            parts = [replace(part, env=clocks.env(part.name)) for part in parts]
        supervisor = stack.enter_context(Supervisor(folder / "logs", backoff=Backoff(first_s=0.2)))
        supervisor.start(router, ready_s=START_S)
        for part in parts:
            supervisor.start(part)
        for part in parts:
            supervisor.await_ready(part.name, START_S)
        endpoint = router.ready if place is None else Tls(place, "submitter").endpoint(router.ready)
        link = stack.enter_context(BusClient(endpoint, SCENARIO))
        session = stack.enter_context(open_client(endpoint, timeout_s=5.0))
        fleet = Fleet(supervisor, link, router.ready, session, folder, arms, keys=place, line=cut, clocks=clocks)
        fleet.away = away
        fleet.listen()
        if math.isinf(fleet.until(lambda: len(fleet.states) == len(arms) and len(fleet.tokens) == len(arms), 30.0)):
            raise RuntimeError(f"Only {sorted(fleet.states)} of {arms} are on the bus.")
        fleet.until(
            lambda: bool(
                fleet.link.query_and_wait(keys.of_clock(SCENARIO), ClockRequest(), Clock, timeout_s=2.0).messages
            )
        )
        answers = link.query_and_wait(
            keys.of_jobs(SCENARIO, "submit"), Submission(work), SubmissionReply, timeout_s=10.0
        )
        taken = {job.job for word in answers.messages.values() for job in word.jobs if job.accepted}
        if len(taken) != jobs:
            raise RuntimeError(f"Only {len(taken)} of {jobs} jobs were accepted: {answers.refused}")
        fleet.until(lambda: fleet.working() is not None and _finished(fleet) >= 2)
        struck_s = time.monotonic()
        detected_s = fault.strike(fleet)
        well_s = fleet.until(lambda: _well(fleet))
        recovered_s = time.monotonic() - struck_s if math.isfinite(well_s) else math.inf
        settled_s = fleet.until(lambda: _settled(fleet, taken))
        ended_s = time.monotonic()
        fleet.until(lambda: not _doubtful(fleet), LATE_S)
        outcome = _outcome(fleet, taken)
        outcome.by = "" if cut is None else cut.by
        outcome.detected_s, outcome.recovered_s = detected_s, recovered_s
        outcome.took_s = ended_s - struck_s if math.isfinite(settled_s) else math.inf
    return outcome


def _job(number: int) -> JobSpec:
    """Work that the scenario's arms have planned, at three pairs of stations in turn, some minutes each."""
    name, repetitions = f"job {number:03d}", 4 + number % 3
    if number % 3 == 0:
        return JobSpec(name=name, kind="sort", places=("belt", "bin"), payload_kg=0.1, repetitions=repetitions)
    if number % 3 == 1:
        trays = ("tray_left", "tray_right")
        return JobSpec(name=name, kind="pick_place", places=trays, payload_kg=0.5, repetitions=repetitions)
    return JobSpec(name=name, kind="hold", places=("clamp",), payload_kg=3.0, dwell_s=60.0, repetitions=2)


def _finished(fleet: Fleet) -> int:
    return sum(job.state == "finished" for job in fleet.status().values())


def _well(fleet: Fleet) -> bool:
    """Whether everybody is there and speaks, the auctioneer answers, and everything that was killed is back."""
    fleet.link.serve(time.monotonic() + 0.05)
    there = all(fleet.supervisor.ready(name) for name in fleet.supervisor.restarts())
    return there and not any(fleet.unwell(arm) for arm in fleet.arms) and bool(fleet.status())


_SETTLED = ("finished", "unfinished")


def _settled(fleet: Fleet, taken: set[str]) -> bool:
    fleet.link.serve(time.monotonic() + 0.2)
    status = fleet.status()
    return taken <= set(status) and all(job.state in _SETTLED for job in status.values())


def _doubtful(fleet: Fleet) -> bool:
    """Whether a job is unfinished because nothing was heard of it; an arm that comes back may still report it."""
    fleet.link.serve(time.monotonic() + 0.2)
    return any(job.state == "unfinished" for job in fleet.status().values())


def _outcome(fleet: Fleet, taken: set[str]) -> Outcome:
    status, done = fleet.status(), fleet.done_by()
    finished = {name for name, job in status.items() if job.state == "finished"}
    unfinished = {name for name, job in status.items() if job.state == "unfinished"}
    restarts = fleet.supervisor.restarts()
    return Outcome(
        finished=len(finished),
        unfinished=len(unfinished),
        lost=tuple(sorted(taken - finished - unfinished)),
        twice=tuple(sorted(name for name, times in done.items() if times > 1)),
        died=tuple(sorted(name for name, count in restarts.items() if count > fleet.killed[name])),
        wrong=tuple(fleet.wrong),
        notes=tuple(fleet.notes),
    )
