"""Requests of people to an auctioneer: what each does in each state of a job, also after a restart."""

import math

import pytest

from fleet.bus.protocol.auction import JobSpec
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import Cancel, Change, ControlRequest, Pause, Resume, Settle
from fleet.errors import Refused


@pytest.fixture
def fleet(live):
    return live.Fleet([live.Arm("arm_0"), live.Arm("arm_1")])


def job(name: str, repetitions: int = 1000, **more) -> JobSpec:
    return JobSpec(name=name, kind="hold", places=(f"place of {name}",), repetitions=repetitions, **more)


def ask(fleet, action, name: str = ""):
    """Return the reply; a refusal is raised."""
    name = name or str(len(fleet.auctioneer.ledger.requests))
    return fleet.auctioneer.control(ControlRequest(name, action, "ann"), fleet.true_s)


def status(fleet, name: str):
    return next(status for status in fleet.auctioneer.status((name,)))


def finishing(fleet, name: str = "a"):
    """Run until a job of one cycle may be committed, then let its arm fall silent; return the arm's name."""
    fleet.submit(job(name, 1))
    fleet.run_until(lambda: any(w.in_last_cycle for arm in fleet.arms.values() for w in arm.current.values()))
    arm = status(fleet, name).arm
    fleet.run_until(lambda: status(fleet, name).state == "unfinished", absent=arm)
    return arm


def test_a_waiting_job_is_cancelled_at_once_and_its_followers_are_given_up(fleet):
    fleet.submit(job("a", release_s=1e6), job("b", after=("a",)))
    reply = ask(fleet, Cancel("a"))
    assert (reply.changed, reply.job.state, reply.job.reason) == (True, "cancelled", "Cancelled by 'ann'.")
    assert status(fleet, "b").state == "given_up"
    assert not ask(fleet, Cancel("a")).changed
    fleet.attempt(lambda: None)
    assert [result.by for result in fleet.results.values() if result.status.state == "cancelled"] == ["ann"]
    assert fleet.auctioneer.ledger.admit((job("a", release_s=1e6),))[0].accepted, "the same job again is no other job"


def test_a_job_at_work_is_cancelled_after_the_cycle_in_progress_also_over_a_restart(fleet):
    fleet.submit(job("a"))
    fleet.run_until(lambda: status(fleet, "a").cycles > 3)
    reply = ask(fleet, Cancel("a"), "one")
    assert (reply.changed, reply.job.state, reply.job.repetitions) == (True, "awarded", 1000)
    fleet.auctioneer = fleet.restart()
    assert not ask(fleet, Cancel("a"), "one").changed
    fleet.run_until(lambda: status(fleet, "a").state == "cancelled")
    fleet.run_until(lambda: not any(arm.out for arm in fleet.arms.values()))
    assert not fleet.auctioneer.ledger.open
    assert not any(arm.done for arm in fleet.arms.values())
    fleet.submit(job("b", 2))
    fleet.run_until(lambda: status(fleet, "b").state == "finished")


def test_a_job_in_its_last_cycle_is_finished_in_spite_of_a_cancellation(fleet):
    fleet.submit(job("a", 1))
    fleet.run_until(lambda: status(fleet, "a").state == "finishing")
    assert "last cycle" in ask(fleet, Cancel("a")).note
    fleet.run_until(lambda: status(fleet, "a").state == "finished")


def test_an_unfinished_job_is_settled_as_done_and_stays_so(fleet):
    arm = finishing(fleet)
    with pytest.raises(Refused, match="settle it"):
        ask(fleet, Cancel("a"))
    fleet.arms[arm].work(fleet.true_s)  # it finishes the job, and nobody hears its report yet
    assert fleet.arms[arm].done == ["a"]
    assert ask(fleet, Settle("a", "done")).job.state == "finished"
    assert not ask(fleet, Settle("a", "done")).changed
    with pytest.raises(Refused, match="finished; only"):
        ask(fleet, Settle("a", "redo"))
    fleet.run_without_faults(2.0)
    assert status(fleet, "a").state == "finished"
    assert sum(each.done.count("a") for each in fleet.arms.values()) == 1


def test_an_unfinished_job_is_redone_only_after_its_arm_was_stopped_and_cleared(fleet):
    arm = finishing(fleet)
    with pytest.raises(Refused, match=f"'{arm}' may still do the last cycle"):
        ask(fleet, Settle("a", "redo"))
    fleet.clear(arm)
    assert status(fleet, "a").state == "unfinished"
    assert ask(fleet, Settle("a", "redo"), "redo").job.state == "waiting"
    fleet.run_without_faults(3.0)  # the late report of the first arm, which is unsure, changes nothing
    assert status(fleet, "a").state == "finished"
    assert sum(each.done.count("a") for each in fleet.arms.values()) == 1
    assert not ask(fleet, Settle("a", "redo"), "redo").changed


def test_a_paused_arm_gives_its_job_back_and_gets_none_until_it_is_resumed(fleet):
    fleet.submit(job("a"))
    fleet.run_until(lambda: status(fleet, "a").cycles > 3)
    arm = status(fleet, "a").arm
    ask(fleet, Pause(arm))
    fleet.auctioneer = fleet.restart()
    fleet.run_until(lambda: status(fleet, "a").arm not in ("", arm))
    assert ask(fleet, Pause()).paused == {arm: "ann", "*": "ann"}
    with pytest.raises(Refused, match="All arms are paused"):
        ask(fleet, Resume(arm))
    fleet.run_until(lambda: not fleet.auctioneer.ledger.open)
    fleet.run_without_faults(3.0)
    assert status(fleet, "a").state == "waiting"
    assert ask(fleet, Resume()).paused == {}
    fleet.run_until(lambda: status(fleet, "a").state == "awarded")
    with pytest.raises(Refused, match="no arm 'x'"):
        ask(fleet, Pause("x"))


def test_due_date_and_value_change_and_the_job_stays_the_same_to_its_submitter(fleet):
    before = job("a", release_s=10.0, due_s=50.0, expires=True)
    fleet.submit(before)
    ask(fleet, Change("a", due_s=90.0))
    ask(fleet, Change("a", value=7.0))
    with pytest.raises(Refused, match="due_s must be >= release_s"):
        ask(fleet, Change("a", due_s=5.0))
    with pytest.raises(Refused, match="value must be between"):
        ask(fleet, Change("a", value=-1.0))
    fleet.auctioneer = fleet.restart()
    spec = fleet.auctioneer.ledger.jobs["a"].spec
    assert (spec.due_s, spec.value, spec.repetitions) == (90.0, 7.0, before.repetitions)
    assert fleet.auctioneer.ledger.admit((before,))[0].accepted
    assert not fleet.auctioneer.ledger.expired(60.0)
    assert fleet.auctioneer.ledger.expired(91.0)
    ask(fleet, Change("a", due_s=None))
    assert not fleet.auctioneer.ledger.expired(math.inf)


@pytest.mark.parametrize("restarts", [0, 1, 2])
def test_the_name_of_a_request_stands_for_one_request(fleet, restarts):
    """Also after restarts from records and from a snapshot."""
    fleet.submit(job("a", release_s=1e6), job("b", release_s=1e6))
    ask(fleet, Cancel("a"), "one")
    for _ in range(restarts):
        fleet.auctioneer = fleet.restart()
    same = ask(fleet, Cancel("a"), "one")
    assert (same.changed, same.note, same.job.state) == (False, "This request was carried out before.", "cancelled")
    for other in (Cancel("b"), Change("a", value=2.0), Pause()):
        with pytest.raises(Refused, match="Another request of the name 'one'"):
            ask(fleet, other, "one")
    assert (status(fleet, "b").state, fleet.auctioneer.ledger.paused) == ("waiting", {})
    assert ask(fleet, Cancel("b"), "two").changed


def test_a_refusal_names_the_arms_that_are_present_or_of_the_cell(fleet):
    """A state under any name comes in over plain TCP, and stays known when its sender has gone."""
    fleet.run_without_faults(0.1)
    fleet.auctioneer.apply_state("ghost", State("ghost", 1, 0.0, "idle", (30.0,), 50.0))
    with pytest.raises(Refused, match=r"no arm 'x'\. Arms: arm_0, arm_1;"):
        ask(fleet, Pause("x"))
    ask(fleet, Pause("arm_0"))
    fleet.auctioneer.set_present(frozenset(["arm_1"]))
    assert ask(fleet, Resume("arm_0")).paused == {}
