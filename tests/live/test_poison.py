"""Odd numbers in any field of any message to an arm or an auctioneer: all go on, quickly, in little memory.

So does an arm without an auctioneer.
"""

import gc
import json
import threading
import time
from contextlib import ExitStack
from copy import deepcopy
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from msgspec.structs import replace

from agents.auction import Consensus
from docs.bus_contract import EXAMPLES
from fleet.arm.planner import Planner
from fleet.arm.time_limit import check_time
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
    StatusRequest,
    Submission,
)
from fleet.bus.protocol.cell import CellRequest
from fleet.bus.protocol.consensus import (
    Bid,
    Claim,
    ClaimEntry,
    ClaimReply,
    DeniedEntry,
    GrantedEntry,
    History,
    HistoryRequest,
    JobOutcome,
)
from fleet.bus.protocol.messages import State, encode
from fleet.bus.protocol.operator import Cancel, Change, ClearRequest, ControlRequest, Operation, Pause, Resume, Settle
from fleet.job import Place
from fleet.live.arm.awards import ArmHistory, ArmRecord, AwardExecutor
from fleet.live.arm.body import SimulatedBody
from fleet.live.arm.estimator import Estimator, NominalPeaks, _size
from fleet.live.arm.node import ArmConfig, ArmNode, PlanningThread
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.auction.node import AuctionNode
from fleet.live.auction.rounds import Assignment
from fleet.live.clock import FleetClock
from fleet.live.consensus.node import ConsensusNode
from fleet.live.consensus.participant import Membership
from fleet.live.journal import Journal
from fleet.live.records import BookRecord
from fleet.motion import Plan
from fleet.robot import ThermalLimits
from tests.live.wire import Wire
from tests.profiles import examples
from tests.waiting import PATIENCE_S

SILENT_S, GROWN_BYTES = 1.0, 50_000_000
JOB = JobSpec(name="j", kind="hold", places=("bench",), repetitions=3, dwell_s=1.0, due_s=1e6)
PLACES = {name: Place(name=name, position_m=(0.45, y, 0.25)) for name, y in (("bench", 0.0), ("rack", 0.15))}
ODD = st.one_of(
    st.floats(),
    st.integers(-(10**400), 10**400),
    st.sampled_from(
        [0, -1, 1, 2, 1800.0, 3600.0, 60_000, 1e12, 1e200, 1e308, -1e308, 5e-324, 2**53, 2**64, True, None]
    ),
    st.sampled_from(["", "x", "\u202e", "a\0b", "x" * 9000, [], {}, [[]] * 9, [1e308] * 7]),
)


@pytest.fixture(scope="module")
def participants(tmp_path_factory, small):
    folder = tmp_path_factory.mktemp("poison")
    own = small.arm(0, [small.work("bench")])
    planner = Planner(own.robot, elbows=1)
    with ExitStack() as stack:
        book = stack.enter_context(Journal(folder / "arm_0", ArmRecord, durable=False))
        history = ArmHistory().after_restart("arm_0", 0.0)
        estimator = Estimator(own.model, planner.plan, PLACES, NominalPeaks())
        body = SimulatedBody(
            own, ThermalLimits(), lambda _: 25.0, dt_s=3.0, rng=np.random.default_rng(0), time_s=0.0, max_dt_s=30.0
        )
        executor = AwardExecutor("arm_0", book.append, history, nonce="n")
        clock = FleetClock(1.0, time.monotonic())
        arm = ArmNode(Wire(), body, executor, estimator, clock, ArmConfig(warning_c=60.0))
        ledger = stack.enter_context(Journal(folder / "auctioneer", BookRecord, durable=False))
        auction = AuctionNode(
            Wire(),
            "x",
            ledger,
            allocate=lambda bidding: dict(
                zip((job.name for job in bidding.jobs), map(Assignment, sorted(bidding.quotes)), strict=False)
            ),
            speed=1.0,
            arms=("arm_0",),
        )
        arm.estimate((JOB,))
        gc.collect()
        gc.freeze()  # what other tests left would be searched again for each message
        yield arm, auction
        gc.unfreeze()


def odd(draw, message):
    """The message as JSON with odd values in one to three places."""
    content = json.loads(encode(message))
    for _ in range(draw(st.integers(1, 3))):
        inner = content
        while True:
            places = list(inner) if isinstance(inner, dict) else list(range(len(inner)))
            if not places:
                break
            place = draw(st.sampled_from(places))
            if isinstance(inner[place], dict | list) and inner[place] and draw(st.booleans()):
                inner = inner[place]
                continue
            inner[place] = deepcopy(draw(ODD))
            break
    return json.dumps(content).encode()


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@examples(400, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_no_message_stops_an_arm_or_an_auctioneer(participants, data):
    arm, auction = participants
    arm_wire, auction_wire = arm.link, auction._link
    quote = arm_wire.handlers[QuoteRequest](QuoteRequest("r", (JOB,)))
    award = Award("w", "r", "x", quote.quote, JOB, lease_s=2.0)
    entry = LeaseEntry("w", "j", 1, "working")
    to_arm = {QuoteRequest: QuoteRequest("r", (JOB,), cycles={"j": 1}), Award: award}
    to_auction = {
        Submission: Submission((JOB,)),
        StatusRequest: StatusRequest(("j",)),
        ClearRequest: ClearRequest("arm_0"),
        LeaseRequest: LeaseRequest("arm_0", (entry,)),
        Report: Report("arm_0", "w", "j", "returned", 1, 0.0),
        State: replace(EXAMPLES[State], arm="arm_0"),
        ClockRequest: ClockRequest(),
    }
    kind = data.draw(st.sampled_from([*to_arm, *to_auction]), label="kind")
    for answer, message in (
        (Clock, Clock(1.0, 1.0)),
        (Lease, Lease("x", 2.0, ("w",), ())),
        (Receipt, Receipt("x", "w")),
    ):
        arm_wire.replies[answer] = [odd(data.draw, message)] if data.draw(st.booleans()) else [encode(message)]
    for answer, message in ((Quote, quote), (Ack, Ack("arm_0", "w", True))):
        auction_wire.replies[answer] = [odd(data.draw, message)] if data.draw(st.booleans()) else [encode(message)]
    arm.work_source._clock._asked_s = -np.inf  # ask for the time now
    start_s = time.thread_time()  # of this thread, whatever else the machine does
    message = (to_arm | to_auction)[kind]
    body = odd(data.draw, message) if msgspec.to_builtins(message) else b"[]"
    (arm_wire if kind in to_arm else auction_wire).take(kind, body)
    arm.serve(-np.inf)
    auction.serve(-np.inf)
    assert time.thread_time() - start_s < SILENT_S
    gc.collect()
    if not hasattr(arm, "first_bytes"):
        arm.first_bytes = resident()
    assert resident() - arm.first_bytes < GROWN_BYTES


def test_a_long_hold_costs_no_more_than_a_short_one_and_has_its_peak(participants):
    """Second method: repetitions of a short hold that are as long together."""
    arm, _ = participants
    estimator: Estimator = arm._estimator
    long, short = JobSpec("l", "hold", ("bench",), dwell_s=3600.0), JobSpec("s", "hold", ("bench",), 3600, dwell_s=1.0)
    for job in (long, short):
        estimator.prepare(job)
    one, many = (estimate.plans[0] for estimate in estimator.estimate([long, short], arm._known_c(), 0.0))
    assert one.duration_s == pytest.approx(many.duration_s)
    assert one.peak_c == pytest.approx(many.peak_c, abs=1e-6)
    assert one.joint_difficulty == pytest.approx(many.joint_difficulty)
    plans: tuple[Plan, ...] = estimator._variants(estimator._works(long)[0])
    assert _size(plans) < 2e6


def test_plans_of_any_number_of_works_take_bounded_memory(monkeypatch, small):
    own = small.arm(0, [small.work("bench")])
    plans = next(iter(own.plans.values()))
    monkeypatch.setattr("fleet.live.arm.estimator.MAX_BYTES", 10 * _size(plans))
    estimator = Estimator(own.model, lambda _: plans, PLACES, NominalPeaks())
    for i in range(40):
        estimator.prepare(JobSpec(f"p{i}", "hold", ("bench",), payload_kg=0.01 * i))
    assert len(estimator._requested) == len(estimator._offers) == 10


def test_an_error_in_a_quote_is_its_reason(small):
    def fail(work):
        raise MemoryError("no room")

    estimator = Estimator(small.ByPayload(1.0), fail, PLACES, NominalPeaks())
    estimator.prepare(JOB)
    (estimate,) = estimator.estimate([JOB], np.full(15, 30.0), 0.0)
    assert not estimate.feasible
    assert "MemoryError: no room" in estimate.reason


def test_a_plan_that_takes_too_long_is_the_reason_and_the_next_job_is_quoted(small, monkeypatch):
    """A planner that never ends of itself; an arm's messages are served meanwhile."""
    own, never = small.arm(0, [small.work("bench")]), threading.Event()

    def plan(work):
        while work.payload_kg == 0.25:
            check_time()
        return next(iter(own.plans.values()))

    monkeypatch.setattr("fleet.live.arm.estimator.PLAN_S", 0.2)
    estimator = Estimator(own.model, plan, PLACES, NominalPeaks())
    thread, steps = PlanningThread(estimator), []
    endless, good = replace(JOB, name="endless", payload_kg=0.25), JOB
    until_s = time.monotonic() + PATIENCE_S
    while not all(estimator.is_prepared(job) for job in (endless, good)) and time.monotonic() < until_s:
        thread.plan([(endless, 0), (good, 0)], lambda: steps.append(time.monotonic()))
        never.wait(0.01)
    slow, quick = estimator.estimate([endless, good], np.full(15, 30.0), 0.0)
    assert (slow.feasible, quick.feasible) == (False, True)
    assert "planning took more than 0.2 s" in slow.reason
    assert len(steps) > 2


ROSTER = ("arm_0", "arm_1", "arm_2")
OTHER = JobSpec("k", "hold", ("rack",), repetitions=1, after=("j",))


class Peers(Wire):
    def watch_tokens(self, expression, handle):
        for name in ROSTER:
            handle(name, True)


class Arm:
    """An arm that can do every job, and does none."""

    space = ()

    def __init__(self):
        self.link, self.clock = Peers(), FleetClock(1.0, time.monotonic())
        self.executor = AwardExecutor("arm_0", lambda *_: None, ArmHistory().after_restart("arm_0", 0.0), nonce="n")

    def set_clock(self, clock, *, jump=False):
        self.clock = clock

    def answer_award(self, award, real_s):
        return self.executor.answer_award(award, real_s)

    def space_of(self, job, plan):
        return "home"

    def unfit(self):
        return ""

    def estimate(self, jobs, cycles):
        return tuple(JobEstimate(job.name, (PlanQuote(difficulty=0.5, space="home"),)) for job in jobs)

    def publish_difficulty(self, estimates, real_s):
        pass


@pytest.fixture(scope="module")
def node(tmp_path_factory):
    with ExitStack() as stack:
        path = tmp_path_factory.mktemp("poison") / "grants"
        journal = stack.enter_context(Journal(path, BookRecord, durable=False))
        membership = Membership(fleet=LiveFleet(arms=ROSTER), choose=Consensus().choose)
        node = ConsensusNode(Arm(), membership, journal, boot=1)
        node._take_epoch("e")
        node._set_time(1.0, time.monotonic())
        yield node


def actions():
    return [Cancel("j"), Settle("j", "redo"), Settle("j", "done"), Change("j", 5.0, 2.0), Pause("arm_1"), Resume()]


def messages(number: int, action) -> dict:
    """One message of each kind, as a peer or a person sends it now."""
    request = ControlRequest(f"r{number}", action, "ann")
    outcomes = tuple(
        JobOutcome(f"done {number} {kind}", "w", "arm_1", kind, 3, 2.0, faults={"w": "arm_1"})
        for kind in ("finished", "unfinished", "given_up", "cancelled", "returned")
    )
    entries = (ClaimEntry(f"w{number}", "j", ("bench",), 1, "finishing", "s"),)
    operation = Operation("arm_1", 3.0, request, ("w",))
    claim = Claim("arm_1", number, entries, outcomes, (replace(JOB, name=f"n{number}"),), (operation,), ("s",))
    bid = replace(
        EXAMPLES[Bid],
        **{"arm": "arm_1", "number": number, "estimates": Arm().estimate((JOB,), {}), "open_jobs": ("j", "k")},
        **{"choice": "j", "epoch": "e", "digest": 7},
    )
    return {
        Bid: bid,
        Claim: claim,
        State: replace(EXAMPLES[State], arm="arm_1"),
        Submission: Submission((JOB, OTHER)),
        StatusRequest: StatusRequest(("j",)),
        ClearRequest: ClearRequest("arm_1"),
        ControlRequest: request,
        CellRequest: CellRequest(),
        HistoryRequest: HistoryRequest(),
        ClockRequest: ClockRequest(),
    }


@examples(300, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_no_message_stops_an_arm_without_an_auctioneer(node, data):
    node.count = getattr(node, "count", 10**9) + 1
    participant, wire = node.participant, node._link
    sent = messages(node.count, data.draw(st.sampled_from(actions()), label="action"))
    kind = data.draw(st.sampled_from(list(sent)), label="kind")
    award = next(iter(participant.claimant.pending), "w")
    finished = JobOutcome("z", "w", "arm_1", "finished", 3, 2.0)
    reply = ClaimReply(
        "arm_1",
        participant.claimant._number + 1,
        3.0,
        (GrantedEntry(award, 1, True, {"w": "arm_1"}),),
        (DeniedEntry("w", "no", finished), DeniedEntry(award, "no", None, replace(finished, outcome="unfinished"))),
    )
    history = History("arm_1", "e", (JOB,), claims={"arm_1": 1}, committed=(replace(finished, outcome="unfinished"),))
    for answer, message in ((ClaimReply, reply), (History, history)):
        wire.replies[answer] = [odd(data.draw, message) if data.draw(st.booleans()) else encode(message)]
    body = encode(sent[kind])
    start_s = time.thread_time()
    wire.take(kind, odd(data.draw, sent[kind]) if body != b"{}" else body)
    node.step(time.monotonic())
    participant.claimant.claim_soon()
    node.step(time.monotonic())
    participant.all_settled(time.monotonic())
    assert time.thread_time() - start_s < SILENT_S
    if node.count % 50 == 0:
        gc.collect()
    if node.count == 10**9 + 50:
        node.first_bytes = resident()
    assert resident() - getattr(node, "first_bytes", resident()) < GROWN_BYTES
