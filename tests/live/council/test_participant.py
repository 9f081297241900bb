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


def make_participant(arms=ARMS, estimate=estimate):
    executor = SimpleNamespace(
        arm="arm_0", active=(), spare_capacity=1, has_pending_reports=False, pending_reports=lambda: ()
    )
    executor.lease_entries = lambda _: ()
    arm = SimpleNamespace(
        executor=executor, estimate=estimate, unfit=lambda: "", space=(), answer_award=None, space_of=lambda *_: ""
    )
    granter = Granter("arm_0", arms, JobBook(is_central=False), lambda *_: None, real_s=0.0)
    granter.add_jobs(JOBS)
    membership = Membership(fleet=LiveFleet(arms=arms), choose=lambda observation, arm_index: 0)
    participant = Participant(arm, granter, membership, boot=1, rng=Random(0))
    participant.set_present(frozenset(arms))
    for name in arms:
        participant.apply_state(name, State(name, 1, 0.0, "idle", (30.0,) * 7, 30.0))
    return participant


@pytest.fixture
def participant():
    return make_participant()


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


@pytest.mark.parametrize(
    ("able_before", "refused_before", "reason"),
    [
        ((), (), "No arm that was asked can do it, and arm_3, arm_4 are not present."),
        (("arm_3",), (), "No arm that was asked can do it, and arm_3, arm_4 are not present."),
        ((), ("arm_3",), "No arm that was asked can do it, and arm_4 is not present."),
        ((), ("arm_3", "arm_4"), "No arm can do it: arm_0: no; arm_1: no; arm_2: no; arm_3: no; arm_4: no."),
    ],
)
def test_a_job_that_only_absent_arms_may_do_names_them(able_before, refused_before, reason):
    """Three of five arms are present and refuse the job; those that left have bid for it before, or not."""
    arms, job = tuple(f"arm_{k}" for k in range(5)), JOBS[0]
    refusing = (JobEstimate(job.name, reason="no"),)
    participant = make_participant(arms, lambda jobs, *_: refusing)
    for number, (peer, offers) in enumerate(
        [*((arm, estimate([job])) for arm in able_before), *((arm, refusing) for arm in refused_before)]
    ):
        participant.apply_bid(Bid(peer, number, 0.0, capacity=1, estimates=offers, open_count=1), 0.0)
    participant.set_present(frozenset(arms[:3]))
    for peer in arms[1:3]:
        participant.apply_bid(Bid(peer, 9, 10.0, capacity=1, estimates=refusing, open_count=1), 10.0)
    participant.tick(10.0, 10.0)
    (status,) = participant.status_of([participant.book.jobs[job.name]], 10.0)
    assert status.reason == reason


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
