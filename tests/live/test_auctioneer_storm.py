"""The auctioneer and arms on a network that loses, repeats and delays messages, while any process may be killed:
no job is done twice, none is lost, and all are done after the faults."""

import random

from hypothesis import example, given
from hypothesis import strategies as st

from fleet.bus.protocol.auction import JobSpec
from fleet.bus.protocol.operator import Cancel, Change, ControlRequest, Pause, Resume, Settle
from tests.live.disk import random_conflicts


def lossy_network(fleet, rng: random.Random) -> None:
    """Messages are lost, repeated and reordered, and now and then an arm is stopped."""
    loss = rng.choice([0.0, 0.1, 0.4, 0.8])
    for _ in range(rng.randrange(5, 40)):
        for name, arm in fleet.arms.items():
            arm.up = rng.random() > 0.1
            fleet.step_arm(name)
        for _ in range(rng.randrange(1, 4) * len(fleet.packets)):
            if fleet.packets and rng.random() < loss:
                del fleet.packets[rng.randrange(len(fleet.packets))]
            if fleet.packets:
                fleet.deliver(rng.randrange(len(fleet.packets)), keep=rng.random() < 0.1)
        del fleet.packets[60:]
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
    """An arm works on without any messages from it or to it."""
    isolated = fleet.arms[f"arm_{rng.randrange(3)}"]
    for _ in range(rng.randrange(5, 60)):
        isolated.work(fleet.true_s)
        fleet.run_without_faults(0.1, 0.1, absent=isolated.name)
        fleet.check()


def kill_arm(fleet, rng: random.Random) -> None:
    fleet.arms[f"arm_{rng.randrange(3)}"].crash(fleet.true_s)


def give_back(fleet, rng: random.Random) -> None:
    fleet.arms[f"arm_{rng.randrange(3)}"].return_jobs(fleet.true_s)


def kill_auctioneer(fleet, rng: random.Random) -> None:
    """At once, or between writing a record and sending a message."""
    if rng.random() < 0.5:
        fleet.auctioneer = fleet.restart()
    else:
        fleet.kill_next = True


def fill_disk(fleet, rng: random.Random) -> None:
    fleet.full = rng.random() < 0.5


def clear(fleet, rng: random.Random) -> None:
    fleet.clear(f"arm_{rng.randrange(3)}")


def clear_one_that_lives_on(fleet, rng: random.Random) -> None:
    """A person moves an arm home that is about to finish a job, and frees its space; its process lives on."""
    for _ in range(60):
        finishing = [arm for arm in fleet.arms.values() if any(work.may_commit for work in arm.current.values())]
        if finishing:
            break
        fleet.run_without_faults(0.1, 0.1)
        fleet.check()
    else:
        return
    name = finishing[0].name
    for _ in range(rng.randrange(20, 60)):
        fleet.run_without_faults(0.1, 0.1, absent=name)
        fleet.check()
    fleet.clear(name, restart=False)
    for _ in range(rng.randrange(60)):
        finishing[0].work(fleet.true_s)
        fleet.run_without_faults(0.1, 0.1, absent=name)
        fleet.check()
    for _ in range(20):
        fleet.run_without_faults(0.1, 0.1)
        fleet.check()


def stop_on_the_way(fleet, rng: random.Random) -> None:
    """An arm stops away from home while the others go on; nobody hears it."""
    for _ in range(40):
        away = [arm for arm in fleet.arms.values() if arm.out]
        if away:
            break
        fleet.run_without_faults(0.1, 0.1)
        fleet.check()
    for _ in range(rng.randrange(5, 80) if away else 0):
        fleet.run_without_faults(0.1, 0.1, absent=away[0].name)
        fleet.check()


def steer(fleet, rng: random.Random) -> None:
    """A person requests something, or a request comes again: late, and often after a restart."""
    for _ in range(rng.randrange(1, 5)):
        again = [r for r in fleet.requests if r.request in fleet.answered or not isinstance(r.action, Settle)]
        if again and rng.random() < 0.3:
            fleet.control(rng.choice(again))
            continue
        job, arm = rng.choice(list(fleet.auctioneer.ledger.jobs) or ["job 0"]), rng.choice(["*", "arm_0", "arm_1"])
        done = any(job in each.done for each in fleet.arms.values())  # a person has looked
        action = rng.choice(
            [
                Cancel(job),
                Settle(job, "done" if done else "redo"),
                Change(job, value=rng.random()),
                Pause(arm),
                Resume(),
            ]
        )
        fleet.control(ControlRequest(str(len(fleet.requests)), action, "a person"))
        fleet.run_without_faults(0.1, 0.1)
        fleet.check()


def no_faults(fleet, rng: random.Random) -> None:
    fleet.run_without_faults(rng.choice([0.25, 0.5, 1.0, 2.0]))


ACTIONS = (
    *(lossy_network, submit, wait, cut_off, stop_on_the_way, kill_arm, give_back),
    *(steer, steer, clear, clear_one_that_lives_on, kill_auctioneer, fill_disk, no_faults),
)
rates = st.tuples(*[st.floats(1 - 1e-3, 1 + 1e-3)] * 4)


@example((1.0, 1.0, 1.0, 1.0), 3, [clear_one_that_lives_on, clear_one_that_lives_on], 0, 1.0)
@given(
    rates,
    st.integers(1, 5),
    st.lists(st.sampled_from(ACTIONS), min_size=4, max_size=16),
    st.integers(0, 2**32),
    st.sampled_from([0.0, 0.5, 1.0]),
)
def test_no_job_is_done_twice_or_lost_and_all_are_done_after_the_faults(live, rates, jobs, actions, seed, share):
    rng = random.Random(seed)
    arms = [live.Arm(f"arm_{i}", rate, offset_s=100.0 * i) for i, rate in enumerate(rates[1:])]
    fleet = live.Fleet(arms, rates[0], excludes=random_conflicts(seed, share))
    for _ in range(jobs):
        submit(fleet, rng)
    for action in actions:
        action(fleet, rng)
        fleet.check()
    fleet.full = fleet.kill_next = False
    fleet.control(ControlRequest("the last", Resume(), "a person"))
    for _ in range(60):
        fleet.run_without_faults(2.0)
        fleet.check()
        if fleet.idle():
            break
    fleet.check_settled()
