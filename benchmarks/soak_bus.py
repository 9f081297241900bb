"""Jobs through one auctioneer over a real router, as fast as it can: memory, journal and time to accept jobs.

    python -m benchmarks.soak_bus [--jobs 5000] [--arms 4] [--out runs/soak]

The auctioneer and model arms, which finish a job at once, run in one process, each with a session of its own. A thread
submits ten jobs whenever fewer than 200 wait. Writes soak_bus.json. For a week of work see soak.py.
"""

import json
import sys
import tempfile
import threading
import time
from itertools import count
from pathlib import Path

import numpy as np

from benchmarks.harness import options, rss_mb
from benchmarks.soak import BACKLOG, BATCH, PLAN, first_come
from fleet.bus.client import BusClient, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    Award,
    JobEstimate,
    JobSpec,
    Lease,
    LeaseEntry,
    LeaseRequest,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.messages import State
from fleet.bus.router import Router
from fleet.live.auction.node import AuctionNode
from fleet.live.auction.records import AuctionRecord
from fleet.live.journal import Journal

FLEET, AUCTIONEER, STATE_S, PATIENCE_S = "soak", "auctioneer", 0.1, 5.0


class Arm:
    """Accepts one job at a time, and finishes it as soon as it is permitted to commit."""

    def __init__(self, link: BusClient, name: str) -> None:
        self.done = 0
        self._link, self._name, self._numbers = link, name, count()
        self._current: Award | None = None
        self._sent_s = 0.0
        link.reply_to(keys.of_arm(FLEET, name, "quote"), QuoteRequest, self._quote)
        link.reply_to(keys.of_arm(FLEET, name, "award"), Award, self._accept)
        link.declare_token(keys.of_arm(FLEET, name, "alive"))

    def step(self) -> None:
        """Handle messages, and publish the state when it is due."""
        self._link.serve()
        if (now_s := time.monotonic()) >= self._sent_s + STATE_S:
            self._sent_s = now_s
            state = State(self._name, next(self._numbers), 0.0, "idle", (30.0,), 30.0)
            self._link.publish(keys.of_arm(FLEET, self._name, "state"), state)

    def _quote(self, request: QuoteRequest) -> Quote:
        estimates = tuple(JobEstimate(job.name, PLAN) for job in request.jobs)
        number, free = f"{self._name}-{next(self._numbers)}", int(self._current is None)
        return Quote(self._name, request.auction, number, 5.0, "", 0.0, "idle", 20.0, free, estimates, ())

    def _accept(self, award: Award) -> Ack:
        if self._current is not None and self._current.award != award.award:
            return Ack(self._name, award.award, False, "busy")
        self._current = award
        request = LeaseRequest(self._name, (LeaseEntry(award.award, award.job.name, 0, "finishing"),))
        key = keys.asked_by(FLEET, AUCTIONEER, "lease", self._name)
        self._link.post(lambda: self._link.query(key, request, Lease, self._finish, timeout_s=PATIENCE_S))
        return Ack(self._name, award.award, True)

    def _finish(self, replies: Replies[Lease]) -> None:
        award = self._current
        if award is not None and any(award.award in lease.may_commit for lease in replies.messages.values()):
            report = Report(self._name, award.award, award.job.name, "finished", 1, 0.0)
            key = keys.asked_by(FLEET, AUCTIONEER, "report", self._name)
            self._link.query(key, report, Receipt, self._receipt, timeout_s=PATIENCE_S)

    def _receipt(self, replies: Replies[Receipt]) -> None:
        assert replies.messages
        self._current, self.done = None, self.done + 1


class Submitter(threading.Thread):
    """Submits jobs while few wait, and measures how long each reply takes."""

    def __init__(self, endpoint: str, jobs: int, waiting: "list[int]") -> None:
        super().__init__(daemon=True)
        self.took_s: list[float] = []
        self._endpoint, self._jobs, self._waiting = endpoint, jobs, waiting
        self.stopped = threading.Event()

    def run(self) -> None:
        """Submit all jobs."""
        with BusClient(self._endpoint, FLEET) as link:
            for first in range(0, self._jobs, BATCH):
                while self._waiting[0] >= BACKLOG and not self.stopped.wait(0.01):
                    pass
                names = (f"job {first + number:07d}" for number in range(BATCH))
                jobs = tuple(JobSpec(name, "hold", (f"place {name[-3:]}",)) for name in names)
                key, start_s = keys.of_jobs(FLEET, "submit"), time.perf_counter()
                replies = link.query_and_wait(key, Submission(jobs), SubmissionReply, timeout_s=PATIENCE_S)
                self.took_s.append(time.perf_counter() - start_s)
                assert replies.messages, replies.refused


def main() -> None:
    """Run all jobs and write the figures."""
    arguments = options(__doc__, jobs=5000, arms=4, out=Path("runs/soak"))
    arguments.out.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory(dir=arguments.out) as folder,
        Router() as router,
        BusClient(router.endpoint, FLEET) as link,
        Journal[AuctionRecord](Path(folder) / "auctioneer.journal", AuctionRecord) as journal,
    ):
        node = AuctionNode(link, AUCTIONEER, journal, allocate=first_come, speed=1.0)
        links = [BusClient(router.endpoint, FLEET).open() for _ in range(arguments.arms)]
        arms = [Arm(each, f"arm_{number}") for number, each in enumerate(links)]
        waiting, start_s = [0], time.monotonic()
        submitter = Submitter(router.endpoint, arguments.jobs, waiting)
        submitter.start()
        rows: list[dict[str, float]] = []
        while (done := sum(arm.done for arm in arms)) < arguments.jobs:
            node.serve(time.monotonic() + 0.001)
            for arm in arms:
                arm.step()
            waiting[0] = len(node.auctioneer.ledger.waiting)
            if done >= arguments.jobs / 20 * (len(rows) + 1):
                size = journal.path.stat().st_size / 1e6
                rows.append({"jobs": done, "s": time.monotonic() - start_s, "rss_mb": rss_mb(), "journal_mb": size})
                print(json.dumps(rows[-1]), flush=True)
        submitter.stopped.set()
        submitter.join(PATIENCE_S)
        for each in links:
            each.close()
    tenth = max(1, len(submitter.took_s) // 10)
    first, last = (1e3 * float(np.quantile(s, 0.99)) for s in (submitter.took_s[:tenth], submitter.took_s[-tenth:]))
    figures = {"jobs": done, "submit_p99_ms": {"first": first, "last": last}, "samples": rows}
    (arguments.out / "soak_bus.json").write_text(json.dumps(figures) + "\n", encoding="utf-8")
    print(json.dumps({"jobs": done, "p99 first, last ms": [first, last]}))
    sys.exit(done != arguments.jobs)


if __name__ == "__main__":
    main()
