"""Arms without an auctioneer and without message loss: they agree on the allocation, and know when all is done."""

import random
import re
from contextlib import nullcontext

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.registry import RULES
from fleet.bus.protocol.auction import JobSpec
from fleet.bus.protocol.consensus import History
from fleet.errors import BusError
from fleet.live.consensus.grants import NUMBERS_PER_BOOT
from fleet.live.consensus.node import check_journals

ARM_POLICIES = [name for name, rule in RULES.items() if rule.scope == "arm"]


def greedy(difficulty: dict[str, dict[str, float]], cool: list[str]) -> dict[str, str | None]:
    """Assign the pair with the least difficulty relative to the average of the job first, to cool arms only."""
    jobs = sorted({job for row in difficulty.values() for job in row})
    pairs = []
    for job in jobs:
        scores = {arm: row[job] for arm, row in difficulty.items() if job in row}
        average = sum(scores.values()) / len(scores)
        pairs += [(score - average, job, arm) for arm, score in scores.items() if arm in cool]
    out: dict[str, str | None] = {}
    for _, job, arm in sorted(pairs):
        if arm not in out and job not in out.values():
            out[arm] = job
    return {arm: out.get(arm) for arm in cool}


@given(st.integers(0, 2**32), st.integers(1, 5), st.integers(1, 7))
def test_without_message_loss_the_allocation_is_that_of_a_central_policy(council, seed, arms, jobs):
    """The first job of every arm, where every job has a separate station."""
    rng = random.Random(seed)
    jobs = [JobSpec(name=f"job {i}", kind="hold", places=(f"p{i}",), repetitions=50) for i in range(jobs)]
    fleet = council.Fleet([1.0] * arms, jobs)
    for name in rng.sample(fleet.names, rng.randrange(arms)):
        fleet.arms[name].hot = True
    fleet.run(0.8)
    cool = [name for name, arm in fleet.arms.items() if not arm.hot]
    offers = {name: [fleet.offer(name, job) for job in jobs] for name in fleet.names}
    wanted = greedy(
        {arm: {offer.job: offer.least.difficulty for offer in row if offer.feasible} for arm, row in offers.items()},
        cool,
    )
    has = {name: next((h.award.job.name for h in fleet.arms[name].executor.active), None) for name in cool}
    assert has == wanted
    assert all(fleet.arms[name].participant.rounds <= 2 for name in cool)


@pytest.mark.parametrize("name", ARM_POLICIES)
@settings(max_examples=20)
@given(seed=st.integers(0, 2**32), jobs=st.integers(1, 6))
def test_every_arm_policy_completes_all_jobs(council, name, seed, jobs):
    rng = random.Random(seed)
    jobs = [JobSpec(name=f"job {i}", kind="hold", places=(rng.choice("xyz"),), repetitions=2) for i in range(jobs)]
    fleet = council.Fleet([1.0] * 3, jobs, RULES[name].kind)
    for _ in range(60):
        fleet.run(1.0)
        if len(fleet.settled()) == jobs:
            break
    assert fleet.settled() == {job.name: "finished" for job in jobs}


class First:
    """Every arm chooses the same job: the first legal one."""

    scope = "arm"

    def reset(self, rng):
        """Nothing to reset."""

    def choose(self, observation, place):
        options = observation.action_mask[1:-1]
        return int(options.argmax()) + 1 if options.any() else 0


def test_of_two_that_choose_one_job_the_one_with_the_lower_difficulty_gets_it(council):
    fleet = council.Fleet([1.0] * 3, [JobSpec(name="j", kind="hold", places=("p",), repetitions=50)], First)
    fleet.run(0.8)
    (holder,) = [arm.name for arm in fleet.arms.values() if arm.executor.active]
    offers = {name: fleet.offer(name, fleet.jobs[0]) for name in fleet.names}
    assert holder == min((offer.plans[0].difficulty, name) for name, offer in offers.items() if offer.feasible)[1]


def test_an_isolated_arm_does_not_report_that_all_jobs_are_settled(council):
    """Not even if the only open job is one that another arm was permitted to commit."""
    fleet = council.Fleet([1.0] * 3, [JobSpec(name="j", kind="hold", places=("p",))])
    holder = fleet.busy_arm(random.Random(0), may_commit=True)
    fleet.cut = {next(name for name in fleet.names if name != holder.name)}
    fleet.run(8.0, stopped=holder.name)
    isolated = fleet.arms[min(fleet.cut)]
    assert isolated.participant.open_jobs(isolated.real_s) == []
    assert not isolated.participant.all_settled(isolated.real_s)


@pytest.mark.parametrize(
    ("boot", "epoch", "peer", "reason"),
    [
        (1, "", History("b"), ""),  # nobody has begun
        (1, "", History("b", "x", claims={"b": 1000000003}), ""),  # the arm is new in a fleet that has
        (2, "x", History("b", "x", claims={"a": 1000000003}), ""),  # it was restarted
        (2, "", History("b", "", claims={"a": 1000000003}), ""),  # neither has heard of epochs
        (1, "", History("b", "x", claims={"a": 1000000003}), "'b' knows claims of 'a' that its journals do not"),
        (2, "", History("b", "x", claims={"a": 1000000003}), "'b' knows claims of 'a' that its journals do not"),
        (2, "x", History("b", "x", claims={"a": 2000000001}), "'b' knows claims of 'a' that its journals do not"),
        (2, "y", History("b", "x"), "The journals of 'a' are of the epoch 'y', but 'b' knows the epoch 'x'"),
    ],
)
def test_an_arm_with_other_journals_than_its_peers_know_does_not_start(boot, epoch, peer, reason):
    own = History("a", "z", claims={"a": 9000000000})  # its own reply says nothing
    with pytest.raises(BusError, match=re.escape(reason)) if reason else nullcontext():
        check_journals("a", boot * NUMBERS_PER_BOOT, epoch, [own, peer])
