"""Many arms behind two linked routers: kill either router, cut the link, count lost jobs and jobs done twice.

    python -m benchmarks.chaos.mesh [--arms 256] [--jobs 512] [--speed 120] [--keep DIR]

Host a has a router, the auctioneer and half of the arms, host b a router that is linked to the first, and the other
arms. The link passes a proxy. During the work router b is killed, the link is cut for 12 s (longer than a lease) and
healed, and router a is killed; the supervisor starts routers again. TLS, access control and journals are on. A job that
was done twice is found in the journals of the arms. Exit code 1: a job was lost or done twice, or a process exited that
was not killed.
"""

import logging
import math
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from benchmarks.chaos.fleet_under_test import AT_ONCE, Fleet, Outcome
from benchmarks.chaos.mesh_parts import FLEET, SCENARIO, job_of, names_of
from benchmarks.chaos.partition import CUT_S, Proxy
from benchmarks.harness import options
from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import SETTLED, JobStatus, Status, StatusRequest
from fleet.bus.router import open_client
from fleet.bus.security.access_control import RosterEntry, of_arms
from fleet.bus.security.certificates import HERE, make
from fleet.bus.security.tls import Tls
from fleet.live.supervisor import Backoff, Part, Supervisor
from scenarios.live.fleet_processes import PROGRAM, free_port
from scenarios.prepare.fleet import prepare
from scenarios.spec.load import load

START_S, BACK_S, LATE_REPORTS_S = 300.0, 120.0, 20.0
FAR = "router_b"


def mesh(folder: Path, *, arms: int, jobs: int, speed: float, settle_s: float = 900.0) -> Outcome:
    """Run the campaign once.

    Raises:
        RuntimeError: the fleet did not start, or did not accept the jobs.
    """
    names, port_a, port_b = names_of(arms), free_port(), free_port()
    with ExitStack() as stack:
        cable = stack.enter_context(Proxy(port_a))
        place, at_a, at_b = folder / "keys", f"tls/127.0.0.1:{port_a}", f"tls/127.0.0.1:{port_b}"
        make(place, of_arms(FLEET, names, [RosterEntry(FAR, "router")]), days=30, hosts=HERE)
        router = (*PROGRAM, "bus", "router", "--tls", str(place))
        near = Part(name="router", argv=(*router, "--port", str(port_a)), ready=at_a)
        link = ("--port", str(port_b), "--name", FAR, "--connect", at_a)
        far = cable.through(Part(name=FAR, argv=(*router, *link), ready=at_b))

        def part(name: str, what: str, address: str, rank: int) -> Part:
            words = (what, address, str(place), str(folder / "journals"), str(arms), f"{speed:g}")
            return Part(name=name, argv=(sys.executable, "-m", "benchmarks.chaos.mesh_parts", *words), rank=rank)

        halves = [",".join(str(number) for number in range(first, arms, 2)) for first in (0, 1)]
        others = [
            part("auction", "auction", at_a, 3),
            part("arms-a", halves[0], at_a, 2),
            cable.through(part("arms-b", halves[1], at_b, 2)),
        ]
        supervisor = stack.enter_context(Supervisor(folder / "logs", backoff=Backoff(first_s=0.2)))
        supervisor.start(near, ready_s=START_S)
        supervisor.start(far, ready_s=START_S)
        for one in others:
            supervisor.start(one)
        for one in others:
            supervisor.await_ready(one.name, START_S)
        endpoint = Tls(place, "submitter").endpoint(at_a)
        client = stack.enter_context(BusClient(endpoint, FLEET))
        session = stack.enter_context(open_client(endpoint, timeout_s=5.0))
        fleet = Fleet(supervisor, client, at_a, session, folder, names, keys=place)
        fleet.listen()
        if math.isinf(fleet.wait_until(lambda: _all_present(fleet), START_S)):
            raise RuntimeError(f"Only {len(fleet.states)} of {arms} arms are on the bus.")
        accepted = tuple(job_of(number, arms) for number in range(jobs))
        fleet.submit(accepted)
        wanted, began_s = [job.name for job in accepted], time.monotonic()
        fleet.wait_until(lambda: _count(fleet, wanted, ("finished",)) >= max(1, jobs // 8), settle_s)
        for what, inject in (("router b killed", _kill_far), ("link cut", _cut), ("router a killed", _kill_near)):
            done, before_s = _count(fleet, wanted, SETTLED), time.monotonic()
            inject(fleet, cable)
            back_s = fleet.wait_until(lambda: _all_present(fleet), BACK_S)
            took_s = time.monotonic() - before_s
            fleet.note(
                f"{what} after {done} jobs: all arms present {took_s if math.isfinite(back_s) else back_s:.1f} s later"
            )
        settled_s = fleet.wait_until(lambda: _count(fleet, wanted, SETTLED) == jobs, settle_s)
        fleet.wait_until(lambda: _count(fleet, wanted, ("finished",)) == jobs, LATE_REPORTS_S)
        outcome = fleet.outcome(wanted, _statuses(fleet, wanted))
        outcome.took_s = time.monotonic() - began_s if math.isfinite(settled_s) else math.inf
    return outcome


def _kill_far(fleet: Fleet, _: Proxy) -> None:
    fleet.send_signal(FAR)
    fleet.wait_until(lambda: any(map(fleet.is_absent, fleet.arms[1::2])), 10.0)


def _cut(fleet: Fleet, cable: Proxy) -> None:
    cable.cut()
    fleet.wait_until(lambda: False, CUT_S)
    if not all(map(fleet.is_absent, fleet.arms[1::2])):
        fleet.violations.append("arms behind the cut link seemed present")
    cable.heal()


def _kill_near(fleet: Fleet, _: Proxy) -> None:
    fleet.send_signal("router")
    fleet.wait_until(lambda: any(map(fleet.is_absent, fleet.arms)), 10.0)


def _all_present(fleet: Fleet) -> bool:
    fleet.client.serve(time.monotonic() + 0.2)
    return len(fleet.states) == len(fleet.arms) and not any(map(fleet.is_absent, fleet.arms))


def _statuses(fleet: Fleet, wanted: Sequence[str]) -> dict[str, JobStatus]:
    statuses: dict[str, JobStatus] = {}
    for first in range(0, len(wanted), AT_ONCE):
        request = StatusRequest(tuple(wanted[first : first + AT_ONCE]))
        replies = fleet.client.query_and_wait(keys.of_jobs(FLEET, "status"), request, Status, timeout_s=5.0)
        statuses |= {job.job: job for reply in replies.messages.values() for job in reply.jobs}
    return statuses


def _count(fleet: Fleet, wanted: Sequence[str], states: Sequence[str]) -> int:
    fleet.client.serve(time.monotonic() + 1.0, at_least=10_000)
    return sum(job.state in states for job in _statuses(fleet, wanted).values())


def main() -> None:
    """Run the campaign and print its outcome."""
    given = options(
        __doc__,
        arms=256,
        jobs=512,
        speed=(120.0, "fleet seconds per real second"),
        keep=(Path, "folder for journals and logs; default: temporary"),
    )
    logging.basicConfig(level=logging.ERROR)
    prepare(load(SCENARIO), difficulty="blind")  # fills the cache
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.keep or Path(temporary)
        amount = {"arms": given.arms, "jobs": given.jobs, "speed": given.speed}
        outcome = mesh(folder / "mesh", **amount)
    print(f"{given.arms} arms, two routers")
    print(
        f"{given.jobs} jobs: {outcome.finished} finished, {outcome.unfinished} unfinished, {len(outcome.lost)} lost, "
        f"{len(outcome.twice)} twice; exited: {', '.join(outcome.exited) or 'none'}; {outcome.took_s:.0f} s"
    )
    for line in (*outcome.notes, *outcome.violations, *outcome.lost[:8], *outcome.twice[:8]):
        print("  " + line)
    sys.exit(0 if outcome.good else 1)


if __name__ == "__main__":
    main()
