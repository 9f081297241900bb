"""Many faults on one fleet that works all the time: kills at random, and every fault that one fleet can take.

A seed determines which faults are injected, into what, in which order and with which pauses; only their real times
depend on the machine. Jobs are submitted for as long as the faults last, always `BACKLOG` that wait or are at work.
"""

import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
from msgspec import structs

from benchmarks.chaos.campaign import LATE_REPORTS_S, is_healthy, short_job, start_fleet
from benchmarks.chaos.fleet_under_test import TIMEOUT_S, Fault, Fleet, Inject
from benchmarks.chaos.messages import malformed, poison, replayed_awards
from benchmarks.chaos.partition import partition
from benchmarks.chaos.processes import (
    full_disk,
    full_disks,
    full_log_disk,
    kill_arm,
    kill_auctioneer,
    kill_recorder,
    kill_router,
    kill_router_often,
    stop_arm,
    stop_auctioneer,
    stuck_subscriber,
)
from benchmarks.chaos.wall_clock import clock_jump
from fleet.bus.client import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import SETTLED, JobSpec, JobState, Status, StatusRequest, Submission, SubmissionReply
from scenarios.live.recording import read_parts

BACKLOG, BATCH, ASK_S, REPLY_S = 24, 8, 0.5, 2.0
"""Open jobs; jobs in one submission; real seconds between two requests for their status, and to wait for a reply."""
PAUSE_S, HEALTHY_S, GAP_S = (5.0, 8.0), 30.0, 5.0
"""Real seconds: shortest and longest pause after a fault; longest wait for a healthy fleet before the next; longest
permitted time without a result after a fault."""
AT_ONCE = 100
"""Jobs in one request for their status."""
KILLS = (1, 3)
"""Fewest and most kills between two other faults."""
KILL: dict[str, Inject] = {
    "kill-arm": kill_arm,
    "kill-auctioneer": kill_auctioneer,
    "kill-router": kill_router,
    "kill-recorder": kill_recorder,
}
OTHERS: dict[str, Inject] = {
    "stop-arm": stop_arm,
    "stop-auctioneer": stop_auctioneer,
    "kill-router-often": kill_router_often,
    "stuck-subscriber": stuck_subscriber,
    "full-disk": full_disk,
    "full-log-disk": full_log_disk,
    "full-disks": full_disks,
    "malformed": malformed,
    "poison": poison,
    "replayed-awards": replayed_awards,
    "partition": partition,
    "clock-jump": clock_jump,
}


@dataclass(frozen=True)
class Step:
    """One fault of a schedule."""

    fault: str
    arm: str
    """The arm that it hits, if it hits one."""
    pause_s: float
    """Real seconds after the fault before this one, at which the fleet was healthy again."""


def schedule(seed: int, arms: tuple[str, ...]) -> Iterator[Step]:
    """Faults of a seed, without end: all others in random order, some kills before each, and again."""
    rng = np.random.default_rng(np.random.SeedSequence(seed))

    def step(fault: str) -> Step:
        return Step(fault, str(rng.choice(arms)), round(float(rng.uniform(*PAUSE_S)), 1))

    while True:
        for other in rng.permutation(list(OTHERS)):
            for _ in range(rng.integers(KILLS[0], KILLS[1], endpoint=True)):
                yield step(str(rng.choice(list(KILL))))
            yield step(str(other))


@dataclass(frozen=True)
class Injected:
    """A fault that was injected."""

    step: Step
    at_s: float
    """Real seconds since the first job."""
    gap_s: float
    """Real seconds from the end of the fault to the next result on the bus."""
    recovered_s: float
    """Until all participants are present and publish."""


@dataclass(eq=False)
class Figures:
    """Outcome of a campaign."""

    injected: list[Injected] = field(default_factory=list[Injected])
    states: Counter[str] = field(default_factory=Counter[str])
    """Number of accepted jobs by their last state."""
    lost: tuple[str, ...] = ()
    """Accepted jobs that the auctioneer does not know."""
    twice: tuple[str, ...] = ()
    unreported: tuple[str, ...] = ()
    """Accepted jobs without an end, or whose end is not in the recording, and no row says that it is missing."""
    violations: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    took_s: float = math.nan

    @property
    def jobs(self) -> int:
        """Number of accepted jobs."""
        return self.states.total()

    @property
    def longest_gap_s(self) -> float:
        """Longest time without a result after the end of a fault, s."""
        return max((each.gap_s for each in self.injected), default=math.nan)

    @property
    def good(self) -> bool:
        """Whether nothing is lost, done twice or unreported, and results came in time."""
        return not (self.lost or self.twice or self.unreported or self.violations) and self.longest_gap_s <= GAP_S


class Feeder:
    """Keeps jobs waiting, and follows what becomes of them.

    Attributes:
        states: Last known state of every accepted job; None for one that the auctioneer does not know.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._fleet, self._made, self._wanted = fleet, 0, True
        self._batch: tuple[JobSpec, ...] = ()
        self._waits = self._asks = False
        self._asked_s = -math.inf
        self.states: dict[str, JobState | None] = {}

    def open(self) -> list[str]:
        """Accepted jobs that have not ended, as far as known."""
        return [name for name, state in self.states.items() if state not in SETTLED]

    def stop(self) -> None:
        """Submit no further jobs; one that may have been accepted is submitted until that is known."""
        self._wanted = False

    def idle(self) -> bool:
        """Whether all submissions were answered."""
        return not (self._batch or self._wanted)

    def step(self) -> None:
        """Submit and ask, without waiting."""
        fleet, open_jobs = self._fleet.client.fleet, self.open()
        if not self._batch and self._wanted and len(open_jobs) < BACKLOG:
            jobs = (short_job(self._made + number) for number in range(BATCH))
            self._batch = tuple(structs.replace(job, repetitions=2) for job in jobs)
            self._made += BATCH
        if self._batch and not self._waits:
            self._waits = True
            key, submission = keys.of_jobs(fleet, "submit"), Submission(self._batch, "campaign")
            self._fleet.client.query(key, submission, SubmissionReply, self._accept, timeout_s=REPLY_S)
        if not self._asks and time.monotonic() >= self._asked_s + ASK_S:
            self._asks, self._asked_s = True, time.monotonic()
            self.ask(open_jobs or ["?"])

    def ask(self, names: list[str]) -> None:
        """Request the status of some jobs; the reply is handled later."""

        def take(replies: Replies[Status]) -> None:
            self._asks = False
            for reply in replies.messages.values():
                self.states |= dict.fromkeys(set(names) & self.states.keys())
                self.states |= {job.job: job.state for job in reply.jobs if job.job in self.states}

        key = keys.of_jobs(self._fleet.client.fleet, "status")
        self._fleet.client.query(key, StatusRequest(tuple(names)), Status, take, timeout_s=REPLY_S)

    def _accept(self, replies: Replies[SubmissionReply]) -> None:
        self._waits = False
        for reply in replies.messages.values():
            self.states |= {job.job: "waiting" for job in reply.jobs if job.accepted and job.job not in self.states}
            self._fleet.violations += [f"{job.job} was refused: {job.reason}" for job in reply.jobs if not job.accepted]
            self._batch = ()


def run(seed: int, folder: Path, *, minutes: float, speed: float, clocks: bool) -> Iterator[Injected | Figures]:
    """Run the faults of a seed on a new fleet; yield each one, and then the figures.

    Args:
        clocks: Also let the wall clocks jump, which needs a C compiler.
    """
    inject = {**KILL, **OTHERS}
    if not clocks:
        del inject["clock-jump"]
    figures = Figures()
    with start_fleet(Fault(kill_arm, cut=True, clocks=clocks), folder, speed=speed) as fleet:
        feeder = Feeder(fleet)
        fleet.each_step = feeder.step
        fleet.wait_until(lambda: "finished" in feeder.states.values())
        start_s = time.monotonic()
        for step in schedule(seed, fleet.arms):
            if step.fault not in inject:
                continue
            fleet.wait_until(lambda: False, step.pause_s)
            at_s = time.monotonic() - start_s
            if at_s > 60.0 * minutes:
                break
            each = _inject(fleet, step, inject[step.fault], at_s)
            figures.injected.append(each)
            yield each
        feeder.stop()
        ended_s = fleet.wait_until(lambda: feeder.idle() and not feeder.open())
        fleet.wait_until(lambda: "unfinished" not in feeder.states.values(), LATE_REPORTS_S)
        for first in range(0, len(feeder.states), AT_ONCE):
            feeder.ask(list(islice(feeder.states, first, first + AT_ONCE)))
        fleet.wait_until(lambda: False, REPLY_S)
        figures.took_s = time.monotonic() - start_s
        figures.twice, done = fleet.done_twice(), fleet.journals.count_finished()
        fleet.violations += [f"{name} exited by itself" for name in fleet.exited()]
        if math.isinf(ended_s):
            fleet.note(f"jobs were open {TIMEOUT_S:g} s after the last fault")
    (recorded, named), states = _recorded(folder / "recording"), feeder.states
    figures.states = Counter(str(state) for state in states.values())
    figures.lost = tuple(sorted(name for name, state in states.items() if state is None))
    ended = {name: state for name, state in states.items() if state in SETTLED}
    missing = {name for name, state in ended.items() if recorded.get(name) != state}
    if named and missing:
        fleet.note(
            f"the recording has a row for each result that it misses, as the end of {', '.join(sorted(missing))}"
        )
    figures.unreported = tuple(sorted((states.keys() - ended.keys()) | (set() if named else missing)))
    by_nobody = sorted(name for name, state in states.items() if state == "finished" and not done[name])
    fleet.violations += [f"{name} is called finished, and no arm has finished it" for name in by_nobody]
    figures.violations, figures.notes = tuple(fleet.violations), tuple(fleet.notes)
    yield figures


def _inject(fleet: Fleet, step: Step, inject: Inject, at_s: float) -> Injected:
    fleet.target, fleet.ended_s = step.arm, -math.inf
    inject(fleet)
    ended_s = fleet.ended_s if math.isfinite(fleet.ended_s) else time.monotonic()
    fleet.wait_until(lambda: is_healthy(fleet), HEALTHY_S)
    recovered_s = time.monotonic() - ended_s
    if not is_healthy(fleet):
        fleet.violations.append(f"{step.fault} at {at_s:.0f} s: the fleet had not recovered after {HEALTHY_S:g} s")
    before = len(fleet.results)
    fleet.wait_until(lambda: len(fleet.results) > before, HEALTHY_S)
    next_s = next((real_s for real_s, _ in fleet.results if real_s >= ended_s), math.inf)
    return Injected(step, at_s, next_s - ended_s, recovered_s)


def _recorded(folder: Path) -> tuple[dict[str, str], bool]:
    """Last recorded state of each job, and whether results are missing and a row of the recording names each one."""
    table, gaps = read_parts(folder, "results").sort_by("number"), read_parts(folder, "gaps").to_pylist()
    numbers = set(table["number"].to_pylist())
    missing = set(range(max(numbers, default=0))) - numbers
    gaps = [gap for gap in gaps if gap["sender"].startswith("results of")]
    named = {number for number in missing if any(gap["first"] <= number <= gap["last"] for gap in gaps)}
    states = dict(zip(table["job"].to_pylist(), table["state"].to_pylist(), strict=True))
    return states, bool(missing) and named == missing
