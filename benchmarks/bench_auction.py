"""Time of an auction: 50 offered jobs, 8 arms, until all 8 awards of a batch are acknowledged.

    python -m benchmarks.bench_auction [--arms 8] [--jobs 50] [--batches 100] [--policy matching]

Router, auctioneer and every arm are separate processes on loopback. Ours: JSON messages validated at both ends, costs,
matching, and awards that are durable before they are sent. The arms quote constants and accept every award. Bare
Zenoh: in the same processes, a query to all arms and one to each, with payloads of the same sizes, half of it before
and half after ours.
"""

import os
import tempfile
import time
from argparse import Namespace
from contextlib import ExitStack
from itertools import count
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event
from typing import Any

import zenoh

from benchmarks.harness import cells, options, quantiles, received, route, seconds, spawned
from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Ack, Award, JobEstimate, JobSpec, PlanQuote, Quote, QuoteRequest, Submission
from fleet.bus.protocol.messages import State, encode
from fleet.bus.router import open_client
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.auction.node import AuctionNode
from fleet.live.journal import Journal
from fleet.live.leases import Timing
from fleet.live.records import BookRecord
from scenarios.live.auctioneer import CentralAllocation
from scenarios.policy_loader import policy_at

FLEET = "bench"
PATIENCE_S = 20.0
STATE_S = 0.1
JOINTS = 7


def estimate(job: JobSpec, number: int) -> JobEstimate:
    """Estimate with numbers of typical length, different for every arm."""
    d = tuple(0.123456789 * (1 + joint + number) for joint in range(JOINTS))
    heat = (51.23456789, 9.123456789, 0.0123456789 * number, d, sum(d))
    return JobEstimate(job.name, tuple(PlanQuote(plan, *heat, 123.456789, 234.56789) for plan in range(2)))


def arm(pipe: Connection, endpoint: str, number: int, quote_size: int) -> None:
    """An arm's process: quotes, accepts awards, publishes its state ten times per second and answers bare queries."""
    name, numbers, published_s = f"arm_{number}", count(), 0.0
    with BusClient(endpoint, FLEET, timeout_s=PATIENCE_S) as link, open_client(endpoint, timeout_s=PATIENCE_S) as bare:

        def quote(request: QuoteRequest) -> Quote:
            offers = tuple(estimate(job, number) for job in request.jobs)
            return Quote(name, request.auction, f"{name}-{next(numbers)}", 5.0, "t", 0.0, "idle", 20.0, 1, offers)

        link.reply_to(keys.of_arm(FLEET, name, "quote"), QuoteRequest, quote)
        link.reply_to(keys.of_arm(FLEET, name, "award"), Award, lambda award: Ack(name, award.award, True))
        link.declare_token(keys.of_arm(FLEET, name, "alive"))
        sizes = {"quote": quote_size, "award": len(encode(Ack(name, "x" * 32, True)))}
        queryables = [constant(bare, f"bare/{number}/{topic}", b"x" * size) for topic, size in sizes.items()]
        pipe.send("ready")
        while not pipe.poll():
            link.serve(time.monotonic() + STATE_S / 2)
            if time.monotonic() >= published_s + STATE_S:
                published_s = time.monotonic()
                link.publish(
                    keys.of_arm(FLEET, name, "state"), State(name, next(numbers), 0.0, "idle", (30.0,) * JOINTS, 30.0)
                )
        del queryables


def constant(session: zenoh.Session, key: str, answer: bytes) -> zenoh.Queryable[None]:
    """Queryable with a constant reply, sent on the receiving thread."""

    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply(key, answer)

    handler: Any = zenoh.handlers.Callback(reply, indirect=False)
    return session.declare_queryable(key, handler, complete=True)


class Stopwatch:
    """Times every batch of a node, from its request for quotes to the last reply to its awards."""

    def __init__(self, link: BusClient, node: AuctionNode) -> None:
        self.batches_s: list[tuple[int, float]] = []
        """Number of awards and duration of each batch."""
        self._asked_s, self._open, self._sent = 0.0, 0, 0
        query, acknowledged = link.query, node.auctioneer.apply_ack

        def timed_query(key: str, message: Any, *rest: Any, **more: Any) -> None:
            if isinstance(message, QuoteRequest):
                self._asked_s, self._open, self._sent = time.perf_counter(), 0, 0
            elif isinstance(message, Award):
                self._open, self._sent = self._open + 1, self._sent + 1
            query(key, message, *rest, **more)

        def answered(*acknowledgement: Any) -> None:
            acknowledged(*acknowledgement)
            self._open -= 1
            if not self._open:
                self.batches_s.append((self._sent, time.perf_counter() - self._asked_s))

        vars(link)["query"], vars(node.auctioneer)["apply_ack"] = timed_query, answered


def job_specs(jobs: int) -> list[JobSpec]:
    """Jobs at separate stations, so that every batch is full."""
    return [
        JobSpec(
            name=f"load_tray-{i:04d}", kind="hold", places=(f"tray_{i}",), repetitions=30, payload_kg=1.5, due_s=900.0
        )
        for i in range(jobs)
    ]


def ours(endpoint: str, folder: Path, given: Namespace) -> tuple[list[tuple[int, float]], float]:
    """Batches of an auctioneer, and the awards per second over all of them."""

    timing = Timing(lease_s=120.0, max_jobs=given.jobs)
    # Enough jobs to keep the number of offers constant until the last batch.
    work = job_specs(given.arms * given.batches + given.jobs)
    allocate = CentralAllocation(policy_at(given.policy, 0), LiveFleet(arms=()))
    with BusClient(endpoint, FLEET) as link, Journal[BookRecord](folder / "bench.journal", BookRecord) as book:
        node = AuctionNode(link, "auctioneer", book, allocate=allocate, speed=1.0, timing=timing)
        deadline_s = time.monotonic() + PATIENCE_S
        while len(node.present) < given.arms and time.monotonic() < deadline_s:
            node.serve(deadline_s)
        watch = Stopwatch(link, node)
        for i in range(0, len(work), 200):
            node.submit(Submission(tuple(work[i : i + 200])))
        begun_s, deadline_s = time.perf_counter(), time.monotonic() + 30.0
        while len(watch.batches_s) < given.batches and time.monotonic() < deadline_s:
            node.serve(deadline_s)
        took_s = time.perf_counter() - begun_s
    return watch.batches_s, sum(sent for sent, _ in watch.batches_s) / took_s


def bare_batch(session: zenoh.Session, arms: int, request: bytes, award: bytes) -> float:
    """Duration of a query to all, then one to each, s."""

    def both() -> None:
        gather(session, ["bare/*/quote"], request, arms)
        gather(session, [f"bare/{i}/award" for i in range(arms)], award, arms)

    return seconds(both, time.perf_counter)


def gather(session: zenoh.Session, requested: list[str], payload: bytes, answers: int) -> None:
    """Query each key, wait for the end of all, and check the number of replies."""
    left, came, done = count(len(requested) - 1, -1), count(1), Event()
    last = [0]

    def reply(one: zenoh.Reply) -> None:
        if one.ok is not None:
            last[0] = next(came)

    def over() -> None:
        if next(left) == 0:
            done.set()

    for key in requested:
        handler: Any = zenoh.handlers.Callback(reply, drop=over, indirect=False)
        session.get(
            key,
            handler,
            payload=payload,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=PATIENCE_S,
        )
    assert done.wait(PATIENCE_S)
    assert last[0] == answers, f"{last[0]} of {answers} answered"


def row(what: str, times_s: list[float]) -> str:
    """Median and 95th percentile in ms."""
    return f"{what:<44}{cells(quantiles(times_s, 0.95), scale=1e3, width=9)}{len(times_s):>7}"


def main() -> None:
    """Print the table."""
    given = options(__doc__, arms=8, jobs=(50, "on offer at a time"), batches=100, policy="matching")
    sample = job_specs(given.jobs)
    request = encode(QuoteRequest("auctioneer-0a1b2c3d-1", tuple(sample)))
    quote = encode(
        Quote("arm_0", "a" * 22, "q" * 12, 5.0, "t", 0.0, "idle", 20.0, 1, tuple(estimate(job, 1) for job in sample))
    )
    award = encode(Award("a" * 36, "a" * 24, "auctioneer", "q" * 16, sample[0]))
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=os.getcwd())))
        endpoint, _ = received(stack.enter_context(spawned(route)))
        for pipe in [stack.enter_context(spawned(arm, endpoint, i, len(quote))) for i in range(given.arms)]:
            received(pipe)
        with open_client(endpoint, timeout_s=PATIENCE_S) as session:
            half = max(1, given.batches // 2)
            bare = [bare_batch(session, given.arms, request, award) for _ in range(half)]
            batches, per_s = ours(endpoint, folder, given)
            bare += [bare_batch(session, given.arms, request, award) for _ in range(half)]
    times = [s for _, s in batches]
    print(
        f"{given.arms} arms, {given.jobs} jobs on offer, {given.policy}; request {len(request)} B, quote {len(quote)} B"
    )
    print(f"{'':<44}{'p50 ms':>9}{'p95 ms':>9}{'times':>7}")
    print(row(f"a batch: quotes, {given.arms} awards, all answers", times))
    print(row("bare Zenoh: the same queries", bare))
    print(f"awards per second: {per_s:.0f}; full batches: {sum(n == given.arms for n, _ in batches)} of {len(batches)}")


if __name__ == "__main__":
    main()
