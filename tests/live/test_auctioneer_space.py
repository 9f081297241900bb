"""Space in an auction: granted with the award, taken until the arm says that it is at home, freed by a person."""

import pytest

from fleet.bus.protocol.auction import Award, JobSpec, Lease, QuoteRequest, Report
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import ClearRequest
from fleet.errors import Refused
from fleet.live.journal import SpaceTaken
from fleet.live.space import ANYWHERE


def always(arm: str, space: str, other: str, other_space: str) -> bool:
    return True


def unless_known(arm: str, space: str, other: str, other_space: str) -> bool:
    return ANYWHERE in (space, other_space)


@pytest.fixture
def fleet_of(live):
    return lambda count, excludes=always: live.Fleet([live.Arm(f"arm_{i}") for i in range(count)], excludes=excludes)


def jobs(count: int, repetitions: int = 3) -> list[JobSpec]:
    return [JobSpec(name=f"job {i}", kind="hold", places=(f"p{i}",), repetitions=repetitions) for i in range(count)]


def states(fleet) -> list[str]:
    return [status.state for status in fleet.auctioneer.status()]


def clear(fleet, arm: str, present=()):
    return fleet.auctioneer.clear(ClearRequest(arm, "a person"), frozenset(present), fleet.true_s)


def test_plans_that_exclude_each_other_are_done_one_after_the_other(fleet_of):
    fleet = fleet_of(3)
    fleet.submit(*jobs(4))
    most = 0
    while not fleet.idle():
        fleet.run_without_faults(0.1, 0.1)
        fleet.check()
        most = max(most, len(fleet.auctioneer.ledger.open))
    assert most == 1
    assert states(fleet) == ["finished"] * 4
    assert {arm for job in fleet.arms.values() for arm in job.done} == {f"job {i}" for i in range(4)}


def test_an_arm_that_was_never_heard_keeps_all_its_space(fleet_of):
    fleet = fleet_of(2, unless_known)
    fleet.submit(*jobs(1))
    for _ in range(50):
        fleet.run_without_faults(0.1, 0.1, absent="arm_1")
    status = fleet.auctioneer.status()[0]
    assert (status.state, status.reason) == ("waiting", "It waits until arm_1 is out of the way.")
    fleet.run_until(lambda: states(fleet) == ["finished"])


def test_the_space_of_a_silent_arm_stays_taken_until_a_person_frees_it(fleet_of):
    fleet = fleet_of(2)
    fleet.submit(*jobs(2, repetitions=1000))
    fleet.run_until(lambda: any(arm.out for arm in fleet.arms.values()))
    name = next(arm.name for arm in fleet.arms.values() if arm.out)
    with pytest.raises(Refused, match="present and says itself"):
        clear(fleet, name, present=[name])
    with pytest.raises(Refused, match=f"lease of '{name}' has not ended"):
        clear(fleet, name)
    for _ in range(200):
        fleet.run_without_faults(0.1, 0.1, absent=name)
        fleet.check()
    assert states(fleet) == ["waiting"] * 2
    fleet.auctioneer = fleet.restart()
    for _ in range(100):
        fleet.run_without_faults(0.1, 0.1, absent=name)
    assert states(fleet) == ["waiting"] * 2
    fleet.clear(name)
    length = len(fleet.journal)
    assert clear(fleet, name).arm == name
    assert len(fleet.journal) == length  # the same request again changes nothing
    fleet.run_until(lambda: "awarded" in states(fleet), absent=name)


def test_the_space_of_an_arm_lost_in_its_last_cycle_stays_taken(fleet_of):
    fleet = fleet_of(2)
    fleet.submit(*jobs(1, repetitions=2))
    fleet.run_until(lambda: any(work.in_last_cycle for arm in fleet.arms.values() for work in arm.current.values()))
    name = next(arm.name for arm in fleet.arms.values() if arm.out)
    fleet.submit(*jobs(2)[1:])
    for _ in range(100):
        fleet.run_without_faults(0.1, 0.1, absent=name)
        fleet.check()
    assert states(fleet) == ["unfinished", "waiting"]
    fleet.arms[name].move_home()
    clear(fleet, name)
    fleet.run_until(lambda: states(fleet) == ["unfinished", "finished"], absent=name)
    fleet.run_until(lambda: states(fleet) == ["finished", "finished"])  # it returns the job, as it was not done


@pytest.mark.parametrize("heard", [Lease, State, Report])
def test_an_arm_that_is_heard_after_it_was_cleared_takes_its_space_until_it_is_home(fleet_of, heard):
    """The person was wrong: the arm is still in its last cycle."""
    fleet = fleet_of(2)
    fleet.submit(*jobs(1, repetitions=2))
    fleet.run_until(lambda: any(work.in_last_cycle for arm in fleet.arms.values() for work in arm.current.values()))
    arm = next(arm for arm in fleet.arms.values() if arm.out)
    (name,) = arm.current
    for _ in range(50):
        fleet.run_without_faults(0.1, 0.1, absent=arm.name)
    clear(fleet, arm.name)
    if heard is State:
        state = State(arm.name, 1, 0.0, "working", (40.0,), 20.0, space=f"{arm.name}: job 0")
        fleet.attempt(lambda: fleet.auctioneer.apply_state(arm.name, state))
    elif heard is Lease:
        assert fleet.answer(arm.request()).revoked == (name,)
    else:
        arm.work(fleet.true_s)
        fleet.answer(arm.reports[name])
        assert states(fleet) == ["finished"]
    fleet.submit(*jobs(2)[1:])
    for _ in range(20):
        fleet.run_without_faults(0.1, 0.1, absent=arm.name)
        assert states(fleet)[1] == "waiting"
    fleet.run_until(lambda: states(fleet) == ["finished", "finished"])


def test_only_space_that_is_taken_can_be_cleared(fleet_of):
    with pytest.raises(Refused, match=r"'arm_7' takes no space. Arms that do: arm_0, arm_1."):
        clear(fleet_of(2), "arm_7")


@pytest.mark.parametrize("before", [False, True])
def test_a_quote_says_nothing_about_an_award_that_was_closed_after_the_request(fleet_of, before):
    """The arm quotes before the award arrives, leaves home for it, and faults, all within one round.

    Args:
        before: It took the same space for an earlier award, which was closed before that round.
    """
    fleet = fleet_of(2)
    fleet.submit(*jobs(1, repetitions=1000))
    fleet.step(0.1)
    fleet.deliver_all()
    fleet.deliver_all()
    (award,) = [packet for packet in fleet.packets if isinstance(packet.message, Award)]
    fleet.packets.clear()
    if before:
        fleet.auctioneer.ledger.apply(SpaceTaken(award.to, (f"{award.to}: job 0",)))
    fleet.submit(*jobs(2)[1:])
    for _ in range(3):
        fleet.step(0.6)  # the arms are asked, while the award is under way
    first, other = fleet.arms[award.to], next(arm for arm in fleet.arms.values() if arm.name != award.to)
    request = next(packet.message for packet in fleet.packets if isinstance(packet.message, QuoteRequest))
    quote, other_quote = first.quote(request, fleet.true_s), other.quote(request, fleet.true_s)
    assert quote.space == ()
    first.quotes[award.message.quote] = first.own_s(fleet.true_s)
    assert first.answer_award(award.message, fleet.true_s).accepted
    first.work(fleet.true_s)
    first.return_jobs(fleet.true_s)
    assert first.out
    for message in (*first.reports.values(), quote, other_quote):
        fleet.attempt(lambda message=message: fleet.answer(message))
    assert fleet.auctioneer.ledger.space[first.name] == {f"{first.name}: job 0"}
    assert not fleet.auctioneer.ledger.open
