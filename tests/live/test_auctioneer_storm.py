"""The auctioneer and arms that keep the rule, on a network that loses, repeats and delays, while anybody may be killed:
no job is done twice, none is lost, and all gets done when it calms down."""

import random

from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol.auction import JobSpec


def weather(fleet, rng: random.Random) -> None:
    """Messages are lost, repeated and overtake each other, and now and then an arm stands still."""
    loss = rng.choice([0.0, 0.1, 0.4, 0.8])
    for _ in range(rng.randrange(5, 40)):
        for name, arm in fleet.arms.items():
            arm.up = rng.random() > 0.1
            fleet.arm_turn(name)
        for _ in range(rng.randrange(1, 4) * len(fleet.wires)):
            if fleet.wires and rng.random() < loss:
                del fleet.wires[rng.randrange(len(fleet.wires))]
            if fleet.wires:
                fleet.deliver(rng.randrange(len(fleet.wires)), keep=rng.random() < 0.1)
        del fleet.wires[60:]
        fleet.step(rng.choice([0.0, 0.01, 0.1, 0.1, 0.3]))
        fleet.check()


def submit(fleet, rng: random.Random) -> None:
    names = list(fleet.accepted)
    after = (rng.choice(names),) if names and rng.random() < 0.3 else ()
    name = f"job {len(fleet.auctioneer.ledger.jobs)}"
    place = rng.choice("xyz")
    fleet.submit(
        JobSpec(name=name, kind="hold", places=(place,), repetitions=rng.choice([1, 2, 3, 20, 40]), after=after)
    )


def wait(fleet, rng: random.Random) -> None:
    fleet.step(rng.choice([0.5, 2.9, 2.97, 3.0, 3.02, 3.05, 3.2, 10.0]))


def cut_off(fleet, rng: random.Random) -> None:
    """An arm works on, but nothing reaches it and nothing comes from it."""
    apart = fleet.arms[f"arm_{rng.randrange(3)}"]
    for _ in range(rng.randrange(5, 60)):
        apart.work(fleet.true_s)
        fleet.run_fair(0.1, 0.1, but=apart.name)
        fleet.check()


def kill_arm(fleet, rng: random.Random) -> None:
    fleet.arms[f"arm_{rng.randrange(3)}"].crash(fleet.true_s)


def give_back(fleet, rng: random.Random) -> None:
    fleet.arms[f"arm_{rng.randrange(3)}"].give_back(fleet.true_s)


def kill_auctioneer(fleet, rng: random.Random) -> None:
    """At once, or right after it has written something and told nobody."""
    if rng.random() < 0.5:
        fleet.auctioneer = fleet.born()
    else:
        fleet.kill_next = True


def fill_disk(fleet, rng: random.Random) -> None:
    fleet.full = rng.random() < 0.5


def fair_weather(fleet, rng: random.Random) -> None:
    fleet.run_fair(rng.choice([0.25, 0.5, 1.0, 2.0]))


DEEDS = (weather, submit, wait, cut_off, kill_arm, give_back, kill_auctioneer, fill_disk, fair_weather)
rates = st.tuples(*[st.floats(1 - 1e-3, 1 + 1e-3)] * 4)


@given(rates, st.integers(1, 5), st.lists(st.sampled_from(DEEDS), min_size=4, max_size=16), st.integers(0, 2**32))
def test_no_job_is_done_twice_or_lost_and_all_gets_done_when_it_calms_down(live, rates, jobs, deeds, seed):
    rng = random.Random(seed)
    arms = [live.Arm(f"arm_{i}", rate, offset_s=100.0 * i) for i, rate in enumerate(rates[1:])]
    fleet = live.Fleet(arms, rates[0])
    for _ in range(jobs):
        submit(fleet, rng)
    for deed in deeds:
        deed(fleet, rng)
        fleet.check()
    for _ in range(60):
        fleet.run_fair(2.0)
        fleet.check()
        if fleet.calm():
            break
    fleet.settled()
