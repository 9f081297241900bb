"""A week of work through one auctioneer, with time compressed: memory, journal and time to accept jobs.

    python -m benchmarks.soak [--jobs 100000] [--arms 16] [--out runs/soak]

The auctioneer's state machine runs with its real journal and 16 model arms, which bid for, accept and finish jobs at
once. Real time is simulated: a week, whatever the number of jobs. The records are not written through to the disk: its
time is not that of the product. One job in 50 is returned once, one in 200 expires.

Writes soak.json. Exit code 1: the p99 of the time to accept a submission is more than 1.5 times as long in
the last tenth as in the first, memory or journal have grown by more than half since the middle, a job is missing, or a
restart with 10,000 open jobs takes more than 3 s. The first tenth counts from the moment that settled jobs leave.
"""

import json
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.harness import options, rss_mb
from fleet.bus.protocol.auction import (
    Ack,
    JobEstimate,
    JobSpec,
    LeaseEntry,
    LeaseRequest,
    PlanQuote,
    Quote,
    QuoteRequest,
    Report,
    Submission,
)
from fleet.live.auction.auctioneer import Auctioneer
from fleet.live.auction.rounds import Assignment, Bidding
from fleet.live.book import JobBook
from fleet.live.job_rules import MAX_OPEN_JOBS
from fleet.live.journal import EpochBegun, Journal, TimeRecorder
from fleet.live.leases import Timing
from fleet.live.records import BookRecord, SendAward

WEEK_S = 7 * 24 * 3600.0
BATCH, BACKLOG = 10, 200
"""Jobs in one submission, and jobs that wait for an arm."""
SAMPLES = 200
PLAN = (PlanQuote(difficulty=0.5, duration_s=60.0, finish_in_s=60.0),)
GOAL_RATIO, GOAL_GROWTH, GOAL_RESTART_S = 1.5, 1.5, 3.0


@dataclass(frozen=True)
class Sample:
    """State after a number of jobs."""

    jobs: int
    took_s: float
    rss_mb: float
    journal_mb: float
    kept_jobs: int
    """In the book, settled ones included."""
    submit_p50_ms: float
    submit_p99_ms: float


def first_come(bidding: Bidding) -> dict[str, Assignment]:
    """Return one job per arm, in the order of jobs and arms."""
    arms = iter(bidding.quotes)
    return {job.name: Assignment(arm) for job, arm in zip(bidding.jobs, arms, strict=False)}


class Week:
    """An auctioneer and its arms, which do everything at once."""

    def __init__(self, journal: Journal[BookRecord], arms: int, jobs: int) -> None:
        self.arms = tuple(f"arm_{number}" for number in range(arms))
        self.real_s, self._left, self._made = 0.0, jobs, 0
        book = JobBook().replay(journal.records())
        self._recorder = TimeRecorder(journal, book, 0.0)
        journal.append(EpochBegun("soak"))
        self.auctioneer = Auctioneer(
            "auctioneer",
            book,
            allocate=first_come,
            keep=journal.append,
            boot="1",
            real_s=0.0,
            timing=Timing(max_jobs=arms),
        )
        self.auctioneer.set_present(frozenset(self.arms))
        self.done = 0
        self.submit_s: list[float] = []
        self._step_s = WEEK_S / (jobs / arms)

    def submit(self) -> None:
        """Submit the next jobs, and measure how long the reply takes."""
        now_s, specs = self.real_s, list[JobSpec]()
        for _ in range(BATCH):
            self._made += 1
            late = self._made % 200 == 0
            due_s = now_s if late else now_s + 3600.0
            place = f"place {self._made % 997}"
            specs.append(JobSpec(f"job {self._made:07d}", "hold", (place,), due_s=due_s, expires=late))
        start_s = time.perf_counter()
        reply = self.auctioneer.submit(Submission(tuple(specs), "soak"), now_s)
        self.submit_s.append(time.perf_counter() - start_s)
        assert all(job.accepted for job in reply.jobs), reply

    def step(self) -> None:
        """Run one round, and finish what it awards."""
        while self._made < self._left and len(self.auctioneer.book.waiting) < BACKLOG:
            self.submit()
        self.real_s += self._step_s
        out = self.auctioneer.out
        self.auctioneer.tick(self.real_s, self.real_s)
        while out:
            match out.popleft():
                case QuoteRequest() as request:
                    estimates = tuple(JobEstimate(job.name, PLAN) for job in request.jobs)
                    for arm in self.arms:
                        quote = Quote(arm, request.auction, "q", 5.0, "", self.real_s, "idle", 20.0, 1, estimates, ())
                        self.auctioneer.add_quote(quote)
                    self.auctioneer.tick(self.real_s, self.real_s)
                case SendAward(arm, award):
                    self._work(arm, award.award, award.job.name)
                case _:
                    pass
        self._recorder.step(self.real_s, self.real_s)

    def _work(self, arm: str, award: str, job: str) -> None:
        now_s, auctioneer = self.real_s, self.auctioneer
        auctioneer.apply_ack(Ack(arm, award, True), now_s, now_s)
        self.done += 1
        if self.done % 50 == 0 and auctioneer.book.jobs[job].returns == 0:
            self.done -= 1
            auctioneer.apply_report(Report(arm, award, job, "returned", 0, now_s, "too hot"), now_s, now_s)
            return
        auctioneer.renew_leases(LeaseRequest(arm, (LeaseEntry(award, job, 0, "finishing"),)), now_s, now_s)
        auctioneer.apply_report(Report(arm, award, job, "finished", 1, now_s), now_s, now_s)

    @property
    def over(self) -> bool:
        """Whether all jobs are settled."""
        return self._made >= self._left and not self.auctioneer.book.unsettled()


def soak(path: Path, jobs: int, arms: int) -> tuple[list[Sample], int]:
    """Run the week; return samples over time, and the number of jobs that are missing at the end."""
    samples, start_s = list[Sample](), time.monotonic()
    with Journal[BookRecord](path, BookRecord, durable=False) as journal:
        week = Week(journal, arms, jobs)
        book, each = week.auctioneer.book, max(1, jobs // SAMPLES)
        while not week.over:
            week.step()
            if week.done >= each * (len(samples) + 1):
                p50, p99 = np.quantile(week.submit_s or [np.nan], [0.5, 0.99]) * 1e3
                week.submit_s.clear()
                size = path.stat().st_size / 1e6
                kept = len(book.jobs)
                row = (week.done, time.monotonic() - start_s, rss_mb(), size, kept, float(p50), float(p99))
                samples.append(Sample(*row))
                if len(samples) % 20 == 0:
                    print(json.dumps(asdict(samples[-1])), flush=True)
        return samples, jobs - len(book.settled) - sum(book.left.values())


def restart_s(folder: Path) -> float:
    """Return the start-up time of an auctioneer with the largest number of open jobs, s."""
    path = folder / "open.journal"
    with Journal[BookRecord](path, BookRecord, durable=False) as journal:
        week = Week(journal, 4, MAX_OPEN_JOBS)
        for _ in range(MAX_OPEN_JOBS // BATCH):
            week.submit()
    start_s = time.perf_counter()
    with Journal[BookRecord](path, BookRecord) as journal:
        week = Week(journal, 4, 1)
        took_s = time.perf_counter() - start_s
        assert len(week.auctioneer.book.waiting) == MAX_OPEN_JOBS
    return took_s


def main() -> None:
    """Run the week, write the figures and check the goals."""
    arguments = options(__doc__, jobs=100_000, arms=16, out=Path("runs/soak"))
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=arguments.out) as folder:
        samples, missing = soak(Path(folder) / "auctioneer.journal", arguments.jobs, arguments.arms)
        took_s = restart_s(Path(folder))
    tenth = max(1, len(samples) // 10)
    first, last = (float(np.nanmedian([s.submit_p99_ms for s in part])) for part in (samples[:tenth], samples[-tenth:]))
    half = samples[: len(samples) // 2] or samples
    figures = {
        "jobs": arguments.jobs,
        "missing": missing,
        "took_s": samples[-1].took_s,
        "submit_p99_ms": {"first": first, "last": last, "ratio": last / first},
        "rss_mb": {"half": max(s.rss_mb for s in half), "whole": max(s.rss_mb for s in samples)},
        "journal_mb": {"half": max(s.journal_mb for s in half), "whole": max(s.journal_mb for s in samples)},
        "restart_10000_open_s": took_s,
    }
    grown = [figures[name]["whole"] / figures[name]["half"] for name in ("rss_mb", "journal_mb")]
    good = not missing and last <= GOAL_RATIO * first and max(grown) <= GOAL_GROWTH and took_s <= GOAL_RESTART_S
    text = json.dumps({**figures, "good": good, "samples": [asdict(sample) for sample in samples]})
    (arguments.out / "soak.json").write_text(text + "\n", encoding="utf-8")
    print(json.dumps({**figures, "good": good}, indent=1))
    sys.exit(not good)


if __name__ == "__main__":
    main()
