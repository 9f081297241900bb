"""Settled jobs leave the memory and the journal of an arm without an auctioneer, and are not done again."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol.auction import JobSpec
from fleet.bus.protocol.consensus import Claim, ClaimEntry, JobOutcome
from fleet.bus.protocol.messages import encode
from fleet.live.consensus import jobs
from fleet.live.consensus.grants import Granter
from fleet.live.consensus.jobs import JobSettled, Register
from fleet.live.journal import JobsAccepted
from tests.live.disk import Disk


def job(number: int) -> JobSpec:
    return JobSpec(name=f"job {number}", kind="hold", places=("x",), repetitions=3)


def outcome(number: int, kind: str = "finished", time_s: float | None = None) -> JobOutcome:
    return JobOutcome(f"job {number}", f"a-{number}", "a", kind, 3, float(number) if time_s is None else time_s)


def entry(number: int) -> ClaimEntry:
    return ClaimEntry(f"b-{number}", f"job {number}", ("x",), 0, "requested", "home")


kinds = st.sampled_from(["finished", "given_up", "cancelled"])


@given(st.lists(st.tuples(st.integers(0, 9), kinds)), st.randoms())
def test_arms_with_the_same_outcomes_keep_the_same_ones_in_any_order(several, rng):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jobs, "MAX_SETTLED", 3)
        digests, kept = set(), set()
        for _ in range(3):
            register = Register().replay([JobsAccepted(tuple(map(job, range(10))))])
            for _ in range(2):  # peers send their outcomes again until all agree
                rng.shuffle(several)
                for each in several:
                    if register.is_news(outcome(*each)):
                        register.apply(JobSettled(outcome(*each)))
            again = Register().replay(register.compact())
            assert (again.digest, dict(again.settled), again.past) == (
                register.digest,
                dict(register.settled),
                register.past,
            )
            digests.add(register.digest)
            kept.add(tuple(sorted((name, each.outcome) for name, each in register.settled.items())))
        assert (len(digests), len(kept)) == (1, 1)


def test_a_long_run_takes_bounded_memory_and_disk_and_no_job_is_granted_again():
    disk, register = Disk(), Register()
    granter = Granter("a", ("a", "b"), register, disk.keep, real_s=0.0)
    sizes = []
    for number in range(6000):
        granter.add_jobs((job(number),))
        granter.answer_claim(Claim("b", number, (), (outcome(number),), space=()), 0.0)
        register.take_gone()
        if number in (2999, 5999):
            records = register.compact()
            sizes.append(sum(len(encode(record)) for record in records) - len(register.past.packed()) * 4 / 3)
    assert sizes[1] < 1.1 * sizes[0]
    for content in (register.settled, register.jobs, register.cycles, register.faults, register.returned_s):
        assert len(content) <= jobs.MAX_SETTLED
    assert (len(register.past), register.settled.left) == (4000, {"finished": 4000})
    again = Register().replay(register.compact())
    for number in random.Random(0).sample(range(6000), 50):
        reply = Granter("a", ("a", "b"), again, disk.keep, real_s=0.0).answer_claim(
            Claim("b", 10_000 + number, (entry(number),), space=()), 0.0
        )
        again.numbers.clear()
        assert reply.denied[0].outcome.outcome == "finished"
    granter.add_jobs((job(3),))
    assert "job 3" not in register.jobs


def test_an_arm_that_was_away_learns_that_a_job_has_left(council, monkeypatch):
    monkeypatch.setattr(jobs, "MAX_SETTLED", 2)
    fleet = council.Fleet([1.0] * 3, [JobSpec(f"job {n}", "hold", (f"p{n}",), 2) for n in range(8)])
    fleet.cut = {"arm_2"}
    for _ in range(100):
        fleet.run(0.2, stopped="arm_2")
        if fleet.arms["arm_0"].participant.all_settled(fleet.arms["arm_0"].real_s):
            break
    assert len(fleet.arms["arm_0"].participant.granter.register.past) == 6
    assert len(fleet.arms["arm_0"].participant.known.current) == 2
    fleet.cut = set()
    fleet.run(8.0)
    assert fleet.arms["arm_2"].participant.open_jobs(fleet.arms["arm_2"].real_s) == []
    assert set(fleet.last_cycles.values()) == {1}
