"""Which arm gets which job in a fleet without an auctioneer: choices of arms by their policies, grants, epochs."""

import random
from functools import partial
from itertools import islice

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from agents.auction import Consensus
from agents.registry import RULES
from benchmarks.simulation.machine import SimulatedEstimator
from benchmarks.simulation.participants import simulated_system
from benchmarks.simulation.simulated_fleet import FIRST
from fleet.bus.protocol.auction import Ack, Award
from fleet.bus.protocol.keys import of_arm
from tests.live.simulated import SimulatedFleet, job, refused
from tests.profiles import examples

ARM_POLICIES = [name for name, rule in RULES.items() if rule.scope == "arm"]


def offers(arm: str, jobs: list) -> dict[str, float]:
    """Difficulty of each job that an arm can do."""
    estimates = SimulatedEstimator(arm, FIRST).estimate(tuple(jobs), None, 0.0, {})
    return {each.job: each.least.difficulty for each in estimates if each.feasible}


def greedy(difficulty: dict[str, dict[str, float]], able: list[str]) -> dict[str, str | None]:
    """Assign the pair with the least difficulty relative to the average of the job first, to able arms only."""
    pairs = []
    for name in sorted({name for row in difficulty.values() for name in row}):
        scores = {arm: row[name] for arm, row in difficulty.items() if name in row}
        average = sum(scores.values()) / len(scores)
        pairs += [(score - average, name, arm) for arm, score in scores.items() if arm in able]
    out: dict[str, str | None] = {}
    for _, name, arm in sorted(pairs):
        if arm not in out and name not in out.values():
            out[arm] = name
    return {arm: out.get(arm) for arm in able}


@example(29830, 2, 1)  # the bid of one arm came later than the other had chosen
@example(118385827, 2, 2)  # so did that of a faulted arm, by which its peer knows how well each job suits it
@examples(8)
@given(st.integers(0, 2**32), st.integers(1, 5), st.integers(1, 4))
def test_without_message_loss_the_allocation_is_that_of_a_central_policy(seed, arms, jobs):
    """The first job of every arm, where every job has a separate station; some arms are faulted."""
    rng, jobs = random.Random(seed), [job(f"job {seed} {number}", 400, release_s=60.0) for number in range(jobs)]
    fleet = SimulatedFleet(True, arms, seed=seed, choose=Consensus().choose)
    with simulated_system(fleet.world):
        fleet.start()
        faulted = rng.sample(fleet.arms, rng.randrange(arms))
        for arm in faulted:
            fleet.fault(arm, 1e3)
        fleet.submit(*jobs)
        fleet.run(8.0)
        able = [arm for arm in fleet.arms if arm not in faulted]
        has = {active.job: arm for arm in able for active in fleet.node(arm).executor.active}
        wanted = greedy({arm: offers(arm, jobs) for arm in fleet.arms}, able)
        assert has == {name: arm for arm, name in wanted.items() if name}


@pytest.mark.parametrize("name", ARM_POLICIES)
@examples(2)
@given(seed=st.integers(0, 2**32), jobs=st.integers(1, 5))
def test_every_arm_policy_completes_all_jobs(name, seed, jobs):
    rng = random.Random(seed)
    fleet = SimulatedFleet(True, 3, seed=seed, choose=RULES[name].kind().choose)
    with simulated_system(fleet.world):
        fleet.start()
        names = [f"job {number}" for number in range(jobs)]
        fleet.submit(*(job(each, 2, place=rng.choice("xyz")) for each in names))
        fleet.until(lambda: all(fleet.is_everywhere(each, "finished") for each in names), 120.0)
        assert fleet.finished == dict.fromkeys(names, 1)


def second_plan(observation, arm: int) -> int:
    """Claim the second plan of the job of the slot with the number of the arm, where that is legal."""
    option, legal = 2 * arm + 1, observation.action_mask[1:-1]
    return option + 1 if option < len(legal) and legal[option] else 0


def both_second(arm: str, space: str, other: str, other_space: str) -> bool:
    return space.endswith(":1") and other_space.endswith(":1")


def drop_choice(handle, arm: str, bid) -> None:
    if not bid.choice:
        handle(arm, bid)


def offered(arm: str, name: str) -> tuple:
    return SimulatedEstimator(arm, FIRST).plans(job(name))


@pytest.mark.parametrize("seed", range(2))
def test_a_claim_covers_the_space_of_the_plan_that_was_chosen(fleet_of, seed):
    """No arm receives the choice of another: the grants alone keep two second plans apart, which exclude each other."""
    fleet = fleet_of(True, choose=second_plan, excludes=both_second, seed=seed)
    fleet.world.late_s, fleet.world.base_s = 0.0, 1e-4  # all arms claim at the same time
    for client in fleet.world.bus.clients.values():
        for each in client.subscriptions:
            if "/bid" in each.expression:
                each.handle = partial(drop_choice, each.handle)
    names = (f"j{number}" for number in range(1000))
    of_two_plans = (n for n in names if all(len(offered(arm, n)) == 2 for arm in fleet.arms))
    fleet.submit(*(job(name, 3, release_s=30.0) for name in islice(of_two_plans, 3)))
    fleet.until(lambda: len(fleet.finished) == 3)


def test_an_isolated_arm_does_not_report_that_all_jobs_are_settled(fleet_of):
    """Not even if the only open job is one that another arm was permitted to commit."""
    fleet = fleet_of(True)
    fleet.submit(job("a", 1, dwell_s=300.0))
    fleet.until(lambda: bool(fleet.begun))
    isolated = next(arm for arm in fleet.arms if arm != fleet.holder("a"))
    fleet.cut(isolated)
    fleet.run(15.0)
    participant = fleet.node(isolated).work_source.participant
    real_s = fleet.world.processes[isolated].real_s
    assert participant.open_jobs() == []
    assert not participant.all_settled(real_s)


def test_an_auctioneer_may_not_award_jobs_to_such_an_arm(fleet_of):
    fleet = fleet_of(True)
    award = Award("w", "r", "x", "q", job("a"))
    assert "allocate jobs together with my peers" in refused(
        lambda: fleet.ask(of_arm("f", "arm_0", "award"), award, Ack)
    )
