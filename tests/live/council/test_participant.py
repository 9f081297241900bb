"""An arm among its peers: when it chooses a job, with a stand-in for the arm itself."""

import math
from random import Random
from types import SimpleNamespace

import pytest

from fleet.bus.protocol.auction import JobEstimate, JobSpec, PlanQuote
from fleet.bus.protocol.consensus import Bid, Claim, ClaimReply
from fleet.bus.protocol.messages import State
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.book import JobBook
from fleet.live.consensus.grants import Granter
from fleet.live.consensus.participant import BID_S, Membership, Participant
from fleet.live.leases import Timing

ARMS = ("arm_0", "arm_1", "arm_2")
JOBS = tuple(JobSpec(name=f"job_{k}", kind="hold", places=("u",), dwell_s=1.0) for k in range(2))


def estimate(jobs, *_):
    return tuple(JobEstimate(job.name, (PlanQuote(difficulty=0.5, duration_s=1.0),)) for job in jobs)


@pytest.fixture
def participant():
    executor = SimpleNamespace(
        arm="arm_0", active=(), spare_capacity=1, has_pending_reports=False, pending_reports=lambda: ()
    )
    executor.lease_entries = lambda _: ()
    arm = SimpleNamespace(
        executor=executor, estimate=estimate, unfit=lambda: "", space=(), answer_award=None, space_of=lambda *_: ""
    )
    granter = Granter("arm_0", ARMS, JobBook(is_central=False), lambda *_: None, real_s=0.0)
    granter.add_jobs(JOBS)
    membership = Membership(fleet=LiveFleet(arms=ARMS), choose=lambda observation, arm_index: 0)
    participant = Participant(arm, granter, membership, boot=1, rng=Random(0))
    participant.set_present(frozenset(ARMS))
    for name in ARMS:
        participant.apply_state(name, State(name, 1, 0.0, "idle", (30.0,) * 7, 30.0))
    return participant


@pytest.mark.parametrize("period_s", [0.2, 2.0, math.inf], ids=["often", "seldom", "when it says"])
def test_it_chooses_within_a_window_though_its_peers_never_bid_for_the_same_jobs(participant, period_s):
    real_s, peers_s, number = 0.0, 0.0, 0
    while real_s < 20.0:
        if real_s >= peers_s:
            number, peers_s = number + 1, real_s + BID_S
            for peer in ARMS[1:]:
                bid = Bid(peer, number, real_s, capacity=1, estimates=estimate(JOBS[1:]), open_count=2)
                participant.apply_bid(bid, real_s)
        participant.tick(real_s, real_s)
        real_s = min(real_s + period_s, peers_s, participant.wake_s(real_s))
    longest_s = 2 * BID_S + Timing().window_s + (period_s if period_s < math.inf else 0.0)
    assert participant.rounds >= int(20.0 / longest_s)


def test_it_repeats_its_claim_with_the_first_bid_of_a_peer_that_has_replied_before(participant):
    """That peer may have started again since, without its journals."""
    real_s = 0.0
    while real_s < 5.0:
        participant.tick(real_s, real_s)
        for claim in [each for each in participant.out if isinstance(each, Claim)]:
            for peer in ARMS[1:]:
                participant.claimant.apply_reply(ClaimReply(peer, claim.number, 10.0), real_s)
        participant.out.clear()
        real_s += 0.1
    names = tuple(job.name for job in JOBS)
    participant.apply_bid(Bid("arm_1", 1, real_s, 1, estimate(JOBS), len(names), names), real_s)
    participant.tick(real_s, real_s)
    assert any(isinstance(each, Claim) for each in participant.out)
