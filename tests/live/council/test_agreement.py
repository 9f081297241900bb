"""Arms among themselves, with every word heard: they do what the agreement says, and know when all is done."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.registry import RULES
from fleet.bus.protocol.auction import JobSpec

ALONE = [name for name, rule in RULES.items() if rule.scope == "arm"]


def greedy(difficulty: dict[str, dict[str, float]]) -> dict[str, str | None]:
    """The pair of arm and job with the least difficulty relative to the average of that job first."""
    jobs = sorted({job for row in difficulty.values() for job in row})
    pairs = []
    for job in jobs:
        scores = {arm: row[job] for arm, row in difficulty.items() if job in row}
        average = sum(scores.values()) / len(scores)
        pairs += [(score - average, job, arm) for arm, score in scores.items()]
    out: dict[str, str | None] = {}
    for _, job, arm in sorted(pairs):
        if arm not in out and job not in out.values():
            out[arm] = job
    return {arm: out.get(arm) for arm in difficulty}


@given(st.integers(0, 2**32), st.integers(1, 5), st.integers(1, 7))
def test_with_every_message_delivered_they_do_what_one_who_knows_every_score_would(council, seed, arms, jobs):
    """The first job of every arm, where no two want one station."""
    rng = random.Random(seed)
    words = [JobSpec(name=f"job {i}", kind="hold", places=(f"p{i}",), repetitions=50) for i in range(jobs)]
    fleet = council.Fleet([1.0] * arms, words)
    for name in rng.sample(fleet.names, rng.randrange(arms)):
        fleet.arms[name].hot = True
    fleet.calm(0.8)
    cool = [name for name, arm in fleet.arms.items() if not arm.hot]
    offers = {name: [fleet.offer(name, word) for word in words] for name in cool}
    wanted = greedy(
        {arm: {offer.job: offer.difficulty for offer in row if offer.feasible} for arm, row in offers.items()}
    )
    has = {name: next((h.award.job.name for h in fleet.arms[name].executor.active), None) for name in cool}
    assert has == wanted
    assert all(fleet.arms[name].council.rounds <= 2 for name in cool)


@pytest.mark.parametrize("name", ALONE)
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32), jobs=st.integers(1, 6))
def test_every_arm_policy_gets_all_jobs_done(council, name, seed, jobs):
    rng = random.Random(seed)
    words = [JobSpec(name=f"job {i}", kind="hold", places=(rng.choice("xyz"),), repetitions=2) for i in range(jobs)]
    fleet = council.Fleet([1.0] * 3, words, RULES[name].kind)
    for _ in range(60):
        fleet.calm(1.0)
        if len(fleet.settled()) == jobs:
            break
    assert fleet.settled() == {word.name: "finished" for word in words}


class First:
    """Every arm wants the same job: the oldest that it may have."""

    scope = "arm"

    def reset(self, rng):
        """Nothing to reset."""

    def choose(self, observation, place):
        return int(observation.action_mask[1:].argmax()) + 1 if observation.action_mask[1:].any() else 0


def test_of_two_that_choose_one_job_the_one_with_the_lower_difficulty_gets_it(council):
    fleet = council.Fleet([1.0] * 3, [JobSpec(name="j", kind="hold", places=("p",), repetitions=50)], First)
    fleet.calm(0.8)
    (holder,) = [arm.name for arm in fleet.arms.values() if arm.executor.active]
    offers = {name: fleet.offer(name, fleet.jobs[0]) for name in fleet.names}
    assert holder == min((offer.difficulty, name) for name, offer in offers.items() if offer.feasible)[1]


def test_who_is_cut_off_does_not_say_that_all_is_done(council):
    """Not even if all that is left is a job that another had leave to finish."""
    fleet = council.Fleet([1.0] * 3, [JobSpec(name="j", kind="hold", places=("p",))])
    holder = fleet.busy(random.Random(0), leave=True)
    fleet.cut = {next(name for name in fleet.names if name != holder.name)}
    fleet.calm(8.0, but=holder.name)
    alone = fleet.arms[min(fleet.cut)]
    assert alone.council.open_jobs(alone.real_s) == []
    assert not alone.council.all_settled(alone.real_s)
