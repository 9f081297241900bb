"""The example of an arm and that of an allocator follow the rules of the bus."""

import json
import subprocess
from contextlib import ExitStack

import pytest

from fleet.bus.client import AnotherReplies, BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    Award,
    Clock,
    ClockRequest,
    JobEstimate,
    JobSpec,
    Lease,
    LeaseEntry,
    LeaseRequest,
    PlanQuote,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
    Result,
    Status,
    StatusRequest,
)
from fleet.bus.protocol.messages import DifficultyScores, State
from fleet.bus.router import Router
from tests.examples.programs import program, running, started
from tests.waiting import PATIENCE_S, serve_until, serving

JOB = JobSpec(name="crate 1", kind="hold", places=("rack",), repetitions=3, payload_kg=1.0)


def only(answers):
    """The single reply to a query."""
    assert not answers.refused
    (reply,) = answers.messages.values()
    return reply


def test_own_arm_follows_the_rules_of_a_strict_auctioneer(bus):
    port, link = bus
    auctioneer, permissions, requests, reports, states = link(), [], [], [], []

    def lease(request):
        requests.append(request)
        awards = tuple(entry.award for entry in request.entries)
        return Lease(auctioneer="a", lease_s=6.0, granted=awards, revoked=(), may_commit=awards if permissions else ())

    def report(sent):
        reports.append(sent)
        return Receipt(auctioneer="a", award=sent.award)

    auctioneer.reply_to(keys.asked_by_every_arm("f", "a", "lease"), LeaseRequest, lease)
    auctioneer.reply_to(keys.asked_by_every_arm("f", "a", "report"), Report, report)
    auctioneer.reply_to(keys.of_clock("f"), ClockRequest, lambda _: Clock(time_s=5000.0, speed=60.0))
    auctioneer.subscribe(keys.of_every_arm("f", "state"), State, lambda _, state: states.append(state))
    scores, tokens = [], []
    auctioneer.subscribe(keys.of_every_arm("f", "difficulty"), DifficultyScores, lambda _, each: scores.append(each))
    auctioneer.watch_tokens(keys.of_every_arm("f", "alive"), lambda arm, there: tokens.append((arm, there)))
    with started(program("own_arm", port, "f", "arm 1+b")):
        serve_until(lambda: ("arm 1+b", True) in tokens and states, auctioneer)
        assert states[0].time_s >= 5000.0

        def ask(key, request, kind):
            return only(
                auctioneer.query_and_wait(keys.of_arm("f", "arm 1+b", key), request, kind, timeout_s=PATIENCE_S)
            )

        dry = ask("quote", QuoteRequest(auction="r", jobs=(JOB,), dry_run=True), Quote)
        assert dry.quote == ""
        quote = ask("quote", QuoteRequest(auction="r", jobs=(JOB,)), Quote)
        assert quote.estimates[0].feasible
        serve_until(lambda: scores, auctioneer)
        assert scores[0].difficulty == (quote.estimates[0].plans[0].difficulty,)
        award = Award(award="r-crate", auction="r", auctioneer="a", quote=quote.quote, job=JOB)
        first, again = (ask("award", award, Ack) for _ in range(2))
        assert first == again
        assert first.accepted
        second = Award(award="r-other", auction="r", auctioneer="a", quote=quote.quote, job=JOB)
        assert not ask("award", second, Ack).accepted
        unquoted = Award(award="r-unquoted", auction="r", auctioneer="a", quote="never made", job=JOB)
        assert not ask("award", unquoted, Ack).accepted

        serve_until(
            lambda: any(entry.phase == "finishing" for request in requests for entry in request.entries), auctioneer
        )
        requests.clear()
        serve_until(lambda: requests, auctioneer)  # it waits at its last cycle until it may begin it
        assert requests[0].entries[0].cycles == JOB.repetitions - 1
        assert not reports
        serve_until(lambda: states[-1].busy_s == 6.0, auctioneer)  # a cycle of 0.1 s at speed 60
        permissions.append(True)
        serve_until(lambda: reports, auctioneer)
        assert (reports[0].outcome, reports[0].cycles, reports[0].job) == ("finished", 3, "crate 1")
    serve_until(lambda: ("arm 1+b", False) in tokens, auctioneer)
    assert auctioneer.malformed == 0


def test_own_arm_waits_for_the_fleet_time_which_an_arm_of_the_fleet_keeps_too(bus):
    """In a fleet without an auctioneer every arm declares the key of the clock, and the first one by name replies."""
    port, link = bus
    second, first, states = link(), link(), []
    first.subscribe(keys.of_every_arm("f", "state"), State, lambda _, state: states.append(state))

    def leave_to_another(_):
        raise AnotherReplies

    second.reply_to(keys.of_clock("f"), ClockRequest, leave_to_another)
    with started(program("own_arm", port, "f", "x"), stderr=subprocess.PIPE) as process, serving(second):
        assert process.stderr.readline().startswith("No participant of this fleet replies with the fleet time")
        first.reply_to(keys.of_clock("f"), ClockRequest, lambda _: Clock(time_s=5000.0, speed=60.0))
        serve_until(lambda: states, first)
    assert states[0].time_s >= 5000.0


def test_own_allocator_follows_the_rules_of_a_strict_arm(bus):
    port, link = bus
    arm, awards, results = link(), [], []
    leases, receipts = [], []

    def offer(job):
        return JobEstimate(job.name, (PlanQuote(difficulty=0.5),))

    def quote(request):
        return Quote(
            arm="x", auction=request.auction, quote=f"x-{request.auction}", valid_s=3.0, twin="t", time_s=1.0,
            mode="idle", headroom_k=20.0, capacity=0 if awards else 1, estimates=tuple(map(offer, request.jobs)),
        )  # fmt: skip

    def take(award):
        awards.append(award)
        return Ack(arm="x", award=award.award, accepted=True)

    arm.reply_to(keys.of_arm("f", "x", "quote"), QuoteRequest, quote)
    arm.reply_to(keys.of_arm("f", "x", "award"), Award, take)
    arm.subscribe(keys.of_every_auction("f", "result"), Result, lambda _, result: results.append(result.status.state))
    with running("own_allocator", port, "f"), started(program("submit_jobs", port, "f")):
        serve_until(lambda: awards, arm)

        def lease_of(phase, cycles):
            entries = (LeaseEntry(award=awards[0].award, job=awards[0].job.name, cycles=cycles, phase=phase),)
            key = keys.asked_by("f", "own", "lease", "x")
            request = LeaseRequest(arm="x", entries=entries)
            arm.query(key, request, Lease, lambda answers: leases.append(only(answers)), timeout_s=PATIENCE_S)
            serve_until(lambda: leases, arm)
            return leases.pop()

        assert awards[0].award not in lease_of("working", 0).may_commit
        assert awards[0].award in lease_of("finishing", 0).may_commit
        report = Report(
            arm="x", award=awards[0].award, job=awards[0].job.name, outcome="finished", cycles=1, time_s=3.0
        )
        for _ in range(2):
            key = keys.asked_by("f", "own", "report", "x")
            arm.query(key, report, Receipt, lambda answers: receipts.append(only(answers)), timeout_s=PATIENCE_S)
        serve_until(lambda: len(receipts) == 2 and "finished" in results, arm)
        assert receipts[0] == receipts[1]
        assert awards[0].award in lease_of("working", 0).revoked
        status = only(arm.query_and_wait(keys.of_jobs("f", "status"), StatusRequest(), Status, timeout_s=PATIENCE_S))
        assert {job.job: job.state for job in status.jobs}[awards[0].job.name] == "finished"
    assert arm.malformed == 0


def test_own_allocator_does_not_start_beside_a_fleet_without_an_auctioneer(bus):
    """Such a fleet has no token of an auctioneer: one of the arms replies."""
    port, link = bus
    arm = link()
    arm.reply_to(keys.of_jobs("f", "status"), StatusRequest, lambda _: Status(auctioneer="x", time_s=1.0, jobs=()))
    with started(program("own_allocator", port, "f"), stderr=subprocess.PIPE) as process:
        serve_until(lambda: process.poll() is not None, arm)
        assert process.returncode == 1
        assert "jobs/status already" in process.stderr.read()
    assert arm.malformed == 0


@pytest.mark.parametrize("kinds", [("own_arm", "quote"), ("own_arm", "award"), ("own_allocator", "lease")])
@pytest.mark.parametrize(
    ("payload", "encoding"),
    [(b"{", None), (b"[]", None), (b"{}", None), (b"\xff", None), (b"{}", "text/plain"), (b'{"jobs": 3}', None)],
)
def test_an_example_refuses_malformed_requests(reply_to_malformed, kinds, payload, encoding):
    assert "Malformed" in reply_to_malformed(*kinds, payload, encoding)


@pytest.fixture(scope="module")
def reply_to_malformed():
    """A function that sends a malformed request to an example and returns the reason of its refusal."""
    requests = {"quote": "QuoteRequest", "award": "Award", "lease": "LeaseRequest"}
    with ExitStack() as stack:
        router = stack.enter_context(Router())
        port = int(router.endpoint.rsplit(":", 1)[1])
        client = stack.enter_context(BusClient(router.endpoint, "f"))
        stack.enter_context(running("own_allocator", port, "f"))
        stack.enter_context(running("own_arm", port, "f", "x"))

        def ask(example, topic, payload, encoding):
            key = keys.of_arm("f", "x", topic) if example == "own_arm" else keys.asked_by("f", "own", topic, "x")
            encoding = encoding or f"application/json;thermofleet.{requests[topic]}.v4"
            (reply,) = list(client._session.get(key, payload=payload, encoding=encoding, timeout=PATIENCE_S))
            assert str(reply.ok.encoding) == "application/json;thermofleet.Refusal.v4"
            return json.loads(reply.ok.payload.to_string())["reason"]

        yield ask
