"""Submissions of one job each, at a constant rate, to an auctioneer with a journal.

    python -m benchmarks.bench_submit [--rate 1000] [--seconds 30] [--sessions 4] [--out DIR]

Router and auctioneer are separate processes. The submitter does not wait for replies, so a slow reply delays no
later submission. No arm is present, and every job expires `EXPIRES_S` after its submission: it is accepted, durable,
abandoned and evicted, and at most 10,000 jobs are open. Prints the numbers of answered and accepted submissions, and
the time to the reply. Exit code 1: one was not answered or not accepted, or the rate was not reached.
"""

import os
import sys
import tempfile
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.harness import options
from fleet.bus.client import BusClient, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Clock, ClockRequest, JobSpec, Submission, SubmissionReply
from fleet.live.supervisor import Supervisor
from scenarios.live.fleet_processes import free_port, parts_of
from scenarios.prepare.fleet import prepare
from scenarios.spec.load import load
from scenarios.spec.options import LiveSpec

SCENARIO, START_S, REPLY_S, EXPIRES_S = "quickstart", 60.0, 5.0, 2.0
"""Real seconds: to start a process, to wait for a reply, and until a job expires."""


class Submitters:
    """Sends submissions over some sessions, and counts their replies."""

    def __init__(self, links: list[BusClient], clock: Clock) -> None:
        self._links, self._clock, self._clock_s = links, clock, time.monotonic()
        self._key = keys.of_jobs(links[0].fleet, "submit")
        self.took_s: list[float] = []
        """Real seconds from each answered submission to its reply."""
        self.accepted = self.sent = self.ended = 0

    def send(self) -> None:
        """Submit the next job."""
        now_s = time.monotonic()
        due_s = self._clock.time_s + (now_s - self._clock_s + EXPIRES_S) * self._clock.speed
        job = JobSpec(f"job {self.sent:07d}", "hold", ("clamp",), payload_kg=3.0, due_s=due_s, expires=True)
        link, done = self._links[self.sent % len(self._links)], partial(self._reply, now_s)
        link.query(self._key, Submission((job,), "rate"), SubmissionReply, done, timeout_s=REPLY_S)
        self.sent += 1

    def serve(self) -> None:
        """Handle the replies that are there."""
        for link in self._links:
            link.serve()

    def _reply(self, sent_s: float, replies: Replies[SubmissionReply]) -> None:
        self.ended += 1
        for reply in replies.messages.values():
            self.took_s.append(time.monotonic() - sent_s)
            self.accepted += sum(job.accepted for job in reply.jobs)


def main() -> None:
    """Submit, and print the figures."""
    out = Path, "folder for journal and logs; default: temporary"
    given = options(__doc__, rate=(1000.0, "submissions a second"), seconds=30.0, sessions=4, out=out)
    prepare(load(SCENARIO), difficulty="blind")
    with ExitStack() as stack:
        folder = given.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        router, _, _, auction = parts_of(
            SCENARIO,
            tuple(arm.name for arm in load(SCENARIO).arms),
            LiveSpec(fleet=SCENARIO, policy="quickest_matching", difficulty="blind", jobs="none"),
            port=free_port(),
            folder=folder,
        )
        assert auction is not None
        supervisor = stack.enter_context(Supervisor(folder / "logs"))
        supervisor.start(router, ready_s=START_S)
        supervisor.start(auction, ready_s=START_S)
        links = [stack.enter_context(BusClient(router.ready, SCENARIO)) for _ in range(given.sessions)]
        clocks = links[0].query_and_wait(keys.of_clock(SCENARIO), ClockRequest(), Clock, timeout_s=REPLY_S)
        submitters = Submitters(links, *clocks.messages.values())
        took_s = run(submitters, given.rate, given.seconds)
    wanted, per_s = round(given.rate * given.seconds), submitters.sent / took_s
    answered, (p50_s, p99_s) = len(submitters.took_s), np.quantile(submitters.took_s or [np.nan], [0.5, 0.99])
    print(
        f"{submitters.sent} submissions in {took_s:.1f} s, {per_s:.0f} a second: {answered} answered, "
        f"{submitters.accepted} accepted; reply p50 {p50_s * 1e3:.1f} ms, p99 {p99_s * 1e3:.1f} ms, longest "
        f"{max(submitters.took_s, default=np.nan) * 1e3:.0f} ms; load of the machine {os.getloadavg()[0]:.1f}"
    )
    sys.exit(not (submitters.accepted == answered == wanted and per_s > 0.99 * given.rate))


def run(submitters: Submitters, rate: float, seconds: float) -> float:
    """Submit at a constant rate; return the real seconds until the last was sent, and wait for all replies."""
    wanted, start_s = round(rate * seconds), time.monotonic()
    while submitters.sent < wanted:
        while submitters.sent < min(wanted, (time.monotonic() - start_s) * rate):
            submitters.send()
        submitters.serve()
        time.sleep(0.001)
    sent_s = time.monotonic() - start_s
    while submitters.ended < wanted and time.monotonic() < start_s + sent_s + REPLY_S + 1.0:
        submitters.serve()
        time.sleep(0.001)
    return sent_s


if __name__ == "__main__":
    main()
