"""What the status of a job says in each of its states, and that results say the same."""

import random

import pytest

from fleet.bus.protocol.auction import NOT_PLANNED, JobEstimate, JobSpec, PlanQuote, Quote
from fleet.bus.protocol.operator import Cancel, Change, ControlRequest, Pause, Resume, Settle
from fleet.live.auction.rounds import planned_jobs


def job(name: str, repetitions: int = 6, **more) -> JobSpec:
    return JobSpec(name=name, kind="hold", places=(f"place of {name}",), repetitions=repetitions, **more)


def status(fleet, name: str):
    return next(iter(fleet.auctioneer.status((name,))))


def newest(fleet) -> dict:
    fleet.attempt(lambda: None)
    return {result.status.job: result for _, result in sorted(fleet.results.items())}


@pytest.mark.parametrize("seed", range(6))
def test_a_result_counts_the_cycles_and_names_the_arm_as_the_status_of_that_moment(live, seed):
    rng, fleet, seen = random.Random(seed), live.Fleet([live.Arm("a"), live.Arm("b")]), -1
    fleet.submit(*(job(f"j{i}", rng.randint(1, 30), due_s=50.0 + i, value=3.0) for i in range(4)))
    actions = [
        Cancel("j0"),
        Pause("a"),
        Resume(),
        Change("j1", value=9.0),
        Change("j2", due_s=None),
        Settle("j3", "done"),
    ]
    for step in range(60):
        for name in fleet.arms:
            fleet.step_arm(name)
        while fleet.packets:
            fleet.deliver(0)
            for number in sorted(number for number in fleet.results if number > seen):
                seen, told = number, fleet.results[number].status
                now = status(fleet, told.job)
                assert (told.cycles, told.arm, told.due_s, told.value, told.state) == (
                    now.cycles,
                    now.arm,
                    now.due_s,
                    now.value,
                    now.state,
                ), told
        fleet.step(0.25)
        if step % 7 == 3:
            fleet.control(ControlRequest(f"r{step}", rng.choice(actions), "ann"))
            seen = max(fleet.results, default=-1)
        if step % 20 == 19:
            fleet.auctioneer = fleet.restart()
            fleet.attempt(lambda: None)
            seen = max(fleet.results)
    assert seen > 8


def test_the_arm_that_had_a_job_is_named_after_cancellation_and_restart(live):
    fleet = live.Fleet([live.Arm("a")])
    fleet.submit(job("long", 1000), job("never", release_s=1e6))
    fleet.run_without_faults(2.0)
    assert status(fleet, "long").state == "awarded"
    fleet.control(ControlRequest("1", Cancel("long"), "ann"))
    fleet.run_without_faults(2.0)
    for _ in range(2):
        assert (status(fleet, "long").state, status(fleet, "long").arm) == ("cancelled", "a")
        assert (status(fleet, "never").arm, status(fleet, "never").not_planned) == ("", True)
        fleet.auctioneer = fleet.restart()


@pytest.mark.parametrize("arm", ["a", "*"])
def test_a_job_that_stopped_for_a_pause_says_who_paused_its_arm(live, arm):
    fleet = live.Fleet([live.Arm("a"), live.Arm("b")])
    fleet.submit(job("first", 1000))
    fleet.run_without_faults(2.0)
    arm = status(fleet, "first").arm if arm == "a" else arm
    fleet.control(ControlRequest("1", Pause(arm), "ann"))
    fleet.run_without_faults(3.0)
    returned = [r for r in fleet.results.values() if r.status.state == "waiting" and r.number]
    assert [(r.by, r.status.reason) for r in returned] == [("ann", "Its arm was paused by 'ann'.")]
    if arm == "*":
        fleet.submit(job("second"))
        assert status(fleet, "second").reason == "All arms are paused by 'ann'."
    else:
        assert status(fleet, "first").state == "awarded"
        assert status(fleet, "first").reason == ""


def test_a_job_is_planned_once_an_arm_has_a_plan_or_every_arm_has_none():
    def quote(arm: str, **reasons: str) -> Quote:
        estimates = (JobEstimate(name, (PlanQuote(),) if not why else (), why) for name, why in reasons.items())
        return Quote(arm, "r", "q", 3.0, "t", 0.0, "idle", 9.0, 1, tuple(estimates))

    one = quote("a", x="", y=NOT_PLANNED, z="too far", w=NOT_PLANNED)
    other = quote("b", x=NOT_PLANNED, y=NOT_PLANNED, z="too heavy", w="too far")
    assert planned_jobs({"a": one, "b": other}) == {"x", "z"}
