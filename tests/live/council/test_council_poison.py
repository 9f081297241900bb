"""Odd numbers in any field of any message that an arm without an auctioneer hears: it goes on, in little memory."""

import gc
import time
from contextlib import ExitStack

import pytest
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from msgspec.structs import replace

from agents.auction import Consensus
from docs.bus_contract import EXAMPLES
from fleet.bus.protocol.auction import ClockRequest, JobEstimate, JobSpec, PlanQuote, StatusRequest, Submission
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
from fleet.live.arm.awards import ArmHistory, AwardExecutor
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.clock import FleetClock
from fleet.live.consensus.node import ConsensusNode
from fleet.live.consensus.participant import Membership
from fleet.live.journal import Journal
from fleet.live.records import BookRecord
from tests.live.test_poison import GROWN_BYTES, SILENT_S, Wire, odd, resident
from tests.profiles import examples

ROSTER = ("arm_0", "arm_1", "arm_2")
JOB = JobSpec("j", "hold", ("bench",), repetitions=3, due_s=1e6)
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
        (DeniedEntry("w", "no", finished),),
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
