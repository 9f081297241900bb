"""Arms without an auctioneer that fault in a job: all give it up, at the fault at which the rule says so."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.bus.protocol.auction import JobSpec

JOB = JobSpec(name="j", kind="hold", places=("x",), repetitions=50)


@settings(max_examples=20)
@given(st.integers(1, 5), st.lists(st.booleans(), max_size=5), st.data())
def test_a_job_that_always_faults_is_given_up_by_all_and_others_go_on(council, arms, restarts, data):
    other = JobSpec(name="other", kind="hold", places=("y",), repetitions=3)
    fleet = council.Fleet([1.0] * arms, [JOB, other])
    restarts = iter(restarts)
    for _ in range(400):
        at_work = [a for a in fleet.arms.values() if a.executor.active and a.executor.active[0].job == "j"]
        if at_work:
            fleet.run(0.3)
            at_work[0].fault()
            fleet.run(0.3)  # the majority has its report
            if next(restarts, False):
                data.draw(st.sampled_from(list(fleet.arms.values()))).crash()
        fleet.run(0.3)
        if "given_up" in fleet.settled().values():
            break
    fleet.run(8.0)
    faults = fleet.faults["j"]
    assert len(faults) == 3 or len(faults) > len(set(faults))
    assert len(faults[:-1]) == len(set(faults[:-1])) < 3, "not one attempt more"
    for arm in fleet.arms.values():
        register = arm.participant.granter.register
        assert register.settled["j"].outcome == "given_up"
        assert register.settled["other"].outcome in ("finished", "unfinished")  # a crash in its last cycle
        (status,) = [each for each in arm.participant.status([], arm.real_s) if each.job == "j"]
        assert status.state == "given_up"
        assert all(f"'{name}' {faults.count(name)} time" in status.reason for name in faults)


@pytest.mark.parametrize("lost", [0, 1])
def test_an_arm_that_was_away_learns_that_a_job_is_given_up(council, lost):
    successor = JobSpec(name="k", kind="hold", places=("y",), after=("j",))
    fleet = council.Fleet([1.0] * 4, [JOB, successor])
    away = fleet.names[lost]
    fleet.cut = {away}
    for _ in range(200):
        fleet.run(0.3)
        at_work = [a for a in fleet.arms.values() if a.executor.active and a.name != away]
        if at_work:
            at_work[0].fault()
        if "given_up" in fleet.settled().values():
            break
    assert "j" not in fleet.arms[away].participant.granter.register.settled
    fleet.cut = set()
    fleet.run(5.0)
    for arm in fleet.arms.values():
        assert {status.job: status.state for status in arm.participant.status([], arm.real_s)} == {
            "j": "given_up",
            "k": "given_up",
        }
        assert arm.participant.all_settled(arm.real_s)
