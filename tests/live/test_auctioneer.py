"""Rounds, awards, leases, space, reports and requests of people, with arms that follow the rules."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fleet.arm.space import space_name
from fleet.bus.protocol.auction import (
    Award,
    JobEstimate,
    JobSpec,
    Lease,
    LeaseEntry,
    LeaseRequest,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
    Submission,
)
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import Cancel, Change, ClearRequest, ControlRequest, Pause, Resume, Settle
from fleet.errors import JournalFull, Refused
from fleet.job import Place, Work
from fleet.live.auction.rounds import Assignment
from fleet.live.journal import SpaceTaken
from fleet.live.space import ANYWHERE, CellSpace, arms_in_the_way


@pytest.fixture
def fleet_of(live):
    return lambda count: live.Fleet([live.Arm(f"arm_{i}") for i in range(count)])


def hold(name: str, place: str = "rack", repetitions: int = 3, **changes) -> JobSpec:
    return JobSpec(name=name, kind="hold", places=(place,), repetitions=repetitions, **changes)


def in_transit(fleet, kind: type) -> list:
    return [packet.message for packet in fleet.packets if isinstance(packet.message, kind)]


def bid(fleet, *jobs: JobSpec) -> None:
    """Submit jobs, open a round and let every arm bid."""
    fleet.submit(*jobs)
    fleet.step(0.1)
    for _ in range(2):
        fleet.deliver_all()


def test_a_lease_ends_later_at_the_auctioneer_than_at_the_slowest_arm(live):
    fleet = live.Fleet([live.Arm("arm_0", 1 - 1e-3), live.Arm("arm_1")], rate=1 + 1e-3)
    bid(fleet, hold("j", repetitions=10**4))
    fleet.run_without_faults(1.0, absent="arm_1")
    assert fleet.at_work() == {"j": ["arm_0"]}
    for _ in range(4000):
        fleet.run_without_faults(0.001, 0.001, absent="arm_0")
        fleet.check()
        if fleet.at_work() == {"j": ["arm_1"]}:
            break
    assert fleet.at_work() == {"j": ["arm_1"]}


def test_a_round_closes_with_the_last_quote_or_at_its_time_limit(fleet_of, live):
    fleet = fleet_of(2)
    bid(fleet, hold("a"), hold("b", "bin"))
    assert {award.job.name for award in in_transit(fleet, Award)} == {"a", "b"}
    slow = fleet_of(2)
    slow.submit(hold("a"), hold("b", "bin"))
    slow.step(0.1)
    slow.packets = [packet for packet in slow.packets if packet.to == "arm_0"]
    slow.deliver_all()
    slow.deliver_all()
    assert in_transit(slow, Award) == []
    slow.step(live.TIMING.window_s)
    assert len(in_transit(slow, Award)) == 1


def test_a_round_does_not_wait_for_an_absent_arm(fleet_of):
    fleet = fleet_of(2)
    fleet.submit(hold("a"))
    fleet.step(0.1)
    fleet.arms["arm_1"].up = False
    fleet.deliver_all()
    fleet.deliver_all()
    assert in_transit(fleet, Award) == []
    fleet.step(0.01)
    assert len(in_transit(fleet, Award)) == 1


def test_an_award_without_an_answer_is_sent_three_times_and_then_dropped(fleet_of, live):
    fleet = fleet_of(1)
    bid(fleet, hold("a"))
    sent = []
    for _ in range(40):
        sent += in_transit(fleet, Award)
        fleet.packets.clear()
        fleet.step(0.1)
        if not fleet.auctioneer.ledger.open:
            break
    assert [award.award for award in sent] == [sent[0].award] * 3
    assert fleet.true_s > live.TIMING.lease_s
    assert "did not answer the award" in fleet.auctioneer.status()[0].reason


def test_a_refused_job_is_auctioned_again_after_a_pause(fleet_of):
    fleet = fleet_of(1)
    bid(fleet, hold("a"))
    fleet.arms["arm_0"].crash(fleet.true_s)  # so its quotes are lost
    fleet.deliver_all()
    fleet.deliver_all()
    assert fleet.auctioneer.status()[0].reason == "'arm_0' refused it: not now"
    fleet.step(0.1)
    assert in_transit(fleet, QuoteRequest) == []
    fleet.run_without_faults(5.0)
    assert fleet.auctioneer.status()[0].state == "finished"


def requests(fleet, steps: int) -> list[QuoteRequest]:
    """Run without faults, and return the requests for quotes."""
    asked: list[QuoteRequest] = []
    for _ in range(steps):
        fleet.step(0.1)
        asked += in_transit(fleet, QuoteRequest)
        for name in fleet.arms:
            fleet.step_arm(name)
        for _ in range(3):
            fleet.deliver_all()
    return asked


def test_quotes_are_requested_for_the_cycles_that_are_left(fleet_of):
    fleet = fleet_of(1)
    fleet.submit(hold("j", repetitions=50))
    assert [request.cycles for request in requests(fleet, 12)] == [{}]
    (arm,) = fleet.arms.values()
    arm.return_jobs(fleet.true_s)
    (done,) = [report.cycles for report in arm.reports.values()]
    assert done > 3
    assert [request.cycles for request in requests(fleet, 12)] == [{"j": done}]


def test_jobs_at_busy_stations_are_named_when_another_job_can_begin(fleet_of):
    """Policies observe them, as in simulation."""
    fleet = fleet_of(2)
    fleet.submit(hold("j", repetitions=500))
    requests(fleet, 12)
    fleet.submit(hold("k"))
    assert requests(fleet, 12) == []
    fleet.submit(hold("l", "bin"))
    assert [job.name for job in requests(fleet, 1)[0].jobs] == ["k", "l"]


def test_a_station_gets_one_job_at_a_time(fleet_of):
    fleet = fleet_of(2)
    bid(fleet, hold("a"), hold("b"))
    assert len(in_transit(fleet, Award)) == 1


def test_an_allocation_against_the_bids_is_not_awarded(fleet_of, caplog):
    fleet = fleet_of(1)
    arms = {"a": "unknown", "b": "arm_0", "c": "arm_0", "x": "arm_0"}
    fleet.auctioneer.rounds.allocate = lambda bidding: {job: Assignment(arm) for job, arm in arms.items()}
    bid(fleet, hold("a"), hold("b", "bin"), hold("c", "belt"))
    assert [award.job.name for award in in_transit(fleet, Award)] == ["b"]
    assert caplog.text.count("The policy gives") == 3


def test_a_report_on_the_award_of_another_arm_is_refused(fleet_of):
    fleet = fleet_of(2)
    bid(fleet, hold("a"))
    (award,) = in_transit(fleet, Award)
    report = Report("arm_1", award.award, "a", "finished", 3, 1.0)
    with pytest.raises(Refused, match="gives 'a' to 'arm_0', not 'a' to 'arm_1'"):
        fleet.auctioneer.apply_report(report, fleet.real_s, fleet.true_s)
    assert fleet.auctioneer.status()[0].state == "awarded"


def test_the_same_report_again_changes_nothing(fleet_of):
    fleet = fleet_of(1)
    bid(fleet, hold("a"))
    fleet.deliver_all()
    fleet.arms["arm_0"].return_jobs(fleet.true_s)
    (report,) = fleet.arms["arm_0"].reports.values()
    first = fleet.auctioneer.apply_report(report, fleet.real_s, fleet.true_s)
    written = len(fleet.journal)
    assert fleet.auctioneer.apply_report(report, fleet.real_s, fleet.true_s) == first
    assert len(fleet.journal) == written


def test_a_report_on_an_unknown_award_changes_nothing(fleet_of):
    fleet = fleet_of(1)
    fleet.submit(hold("a"))
    receipt = fleet.auctioneer.apply_report(Report("arm_0", "old", "a", "finished", 3, 1.0), 0.0, 0.0)
    assert receipt == Receipt("auctioneer", "old")
    assert fleet.auctioneer.status()[0].state == "waiting"


def test_a_lease_of_another_arm_is_revoked(fleet_of):
    fleet = fleet_of(2)
    bid(fleet, hold("a"))
    (award,) = in_transit(fleet, Award)
    entries = (LeaseEntry(award.award, "a", 2, "finishing"),)
    lease = fleet.auctioneer.renew_leases(LeaseRequest("arm_1", entries), fleet.real_s, fleet.true_s)
    assert (lease.granted, lease.revoked, lease.may_commit) == ((), (award.award,), ())


def test_a_late_lease_request_renews_an_award_that_is_still_open(fleet_of, live):
    fleet = fleet_of(1)
    bid(fleet, hold("a"))
    fleet.deliver_all()
    fleet.true_s += 10 * live.TIMING.lease_s  # as if the auctioneer had been stopped
    (award,) = fleet.arms["arm_0"].current
    request = fleet.arms["arm_0"].request()
    assert fleet.auctioneer.renew_leases(request, fleet.real_s, fleet.true_s).granted == (award,)
    fleet.true_s += 2 * live.TIMING.lease_s
    fleet.auctioneer.tick(fleet.real_s, fleet.true_s)
    assert fleet.auctioneer.renew_leases(request, fleet.real_s, fleet.true_s).revoked == (award,)


@pytest.mark.parametrize("action", [Cancel("a"), Pause("arm_0")])
def test_a_stopped_job_stays_with_an_arm_that_ends_a_long_cycle_and_the_cycle_counts(fleet_of, live, action):
    fleet = fleet_of(1)
    bid(fleet, hold("a", repetitions=3))
    fleet.deliver_all()
    arm = fleet.arms["arm_0"]
    (award,) = arm.current
    fleet.auctioneer.control(ControlRequest("one", action, "ann"), fleet.true_s)
    for _ in range(10):  # a cycle of five leases
        fleet.true_s += live.TIMING.lease_s / 2
        fleet.auctioneer.tick(fleet.real_s, fleet.true_s)
        lease = fleet.auctioneer.renew_leases(arm.request(), fleet.real_s, fleet.true_s)
        assert (lease.granted, lease.revoked) == ((), (award,))
        (status,) = fleet.auctioneer.status()
        assert (status.state, status.cycles) == ("awarded", 0)
    report = Report("arm_0", award, "a", "returned", 1, fleet.true_s, "the award was revoked")
    for _ in range(2):
        fleet.auctioneer.apply_report(report, fleet.real_s, fleet.true_s)
        (status,) = fleet.auctioneer.status()
        assert (status.state, status.arm, status.cycles) == (
            "cancelled" if isinstance(action, Cancel) else "waiting",
            "arm_0",
            1,
        )


def test_a_stopped_job_of_a_silent_arm_is_taken_back_after_the_lease(fleet_of, live):
    fleet = fleet_of(1)
    bid(fleet, hold("a", repetitions=3))
    fleet.deliver_all()
    fleet.auctioneer.control(ControlRequest("one", Cancel("a"), "ann"), fleet.true_s)
    fleet.true_s += 2 * live.TIMING.lease_s
    fleet.auctioneer.tick(fleet.real_s, fleet.true_s)
    assert fleet.auctioneer.status()[0].state == "cancelled"


def test_the_status_of_an_infeasible_job_gives_the_reason(fleet_of):
    fleet = fleet_of(1)
    fleet.submit(hold("a"))
    fleet.step(0.1)
    (request,) = in_transit(fleet, QuoteRequest)
    offers = (JobEstimate("a", reason="reach: 1.2 m"),)
    quote = Quote("arm_0", request.auction, "q", 1.0, "model", 0.0, "idle", 10.0, 1, offers)
    fleet.auctioneer.add_quote(quote)
    fleet.step(0.0)
    assert fleet.auctioneer.status()[0].reason == "No arm can do it: arm_0: reach: 1.2 m."


def test_nothing_is_accepted_or_permitted_without_space_on_the_disk(fleet_of):
    fleet = fleet_of(1)
    fleet.full = True
    with pytest.raises(JournalFull):
        fleet.auctioneer.submit(Submission((hold("a"),)), 0.0, 0.0)
    assert fleet.auctioneer.status() == ()
    fleet.full = False
    bid(fleet, hold("a", repetitions=1))
    fleet.deliver_all()
    fleet.full = True
    (award,) = fleet.arms["arm_0"].current
    lease = fleet.auctioneer.renew_leases(fleet.arms["arm_0"].request(), fleet.real_s, fleet.true_s)
    assert (lease.granted, lease.may_commit) == ((award,), ())


def test_at_the_end_of_the_shift_open_jobs_are_reported_unfinished(fleet_of):
    fleet = fleet_of(1)
    bid(fleet, hold("a"), hold("b"))
    fleet.deliver_all()
    fleet.auctioneer.end(7200.0)
    assert [status.state for status in fleet.auctioneer.status()] == ["unfinished", "unfinished"]
    lease = fleet.auctioneer.renew_leases(fleet.arms["arm_0"].request(), fleet.real_s, fleet.true_s)
    assert len(lease.revoked) == 1


def always(arm: str, space: str, other: str, other_space: str) -> bool:
    return True


def unless_known(arm: str, space: str, other: str, other_space: str) -> bool:
    return ANYWHERE in (space, other_space)


@pytest.fixture
def fleet_in_space(live):
    return lambda count, excludes=always: live.Fleet([live.Arm(f"arm_{i}") for i in range(count)], excludes=excludes)


def jobs(count: int, repetitions: int = 3) -> list[JobSpec]:
    return [JobSpec(name=f"job {i}", kind="hold", places=(f"p{i}",), repetitions=repetitions) for i in range(count)]


def states(fleet) -> list[str]:
    return [status.state for status in fleet.auctioneer.status()]


def clear(fleet, arm: str, present=()):
    return fleet.auctioneer.clear(ClearRequest(arm, "a person"), frozenset(present), fleet.true_s)


def test_plans_that_exclude_each_other_are_done_one_after_the_other(fleet_in_space):
    fleet = fleet_in_space(3)
    fleet.submit(*jobs(4))
    most = 0
    while not fleet.idle():
        fleet.run_without_faults(0.1, 0.1)
        fleet.check()
        most = max(most, len(fleet.auctioneer.ledger.open))
    assert most == 1
    assert states(fleet) == ["finished"] * 4
    assert {arm for job in fleet.arms.values() for arm in job.done} == {f"job {i}" for i in range(4)}


def test_an_arm_that_was_never_heard_keeps_all_its_space(fleet_in_space):
    fleet = fleet_in_space(2, unless_known)
    fleet.submit(*jobs(1))
    for _ in range(50):
        fleet.run_without_faults(0.1, 0.1, absent="arm_1")
    status = fleet.auctioneer.status()[0]
    assert (status.state, status.reason) == ("waiting", "It waits until arm_1 is out of the way.")
    fleet.run_until(lambda: states(fleet) == ["finished"])


def test_the_space_of_a_silent_arm_stays_taken_until_a_person_frees_it(fleet_in_space):
    fleet = fleet_in_space(2)
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


def test_the_space_of_an_arm_lost_in_its_last_cycle_stays_taken(fleet_in_space):
    fleet = fleet_in_space(2)
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
def test_an_arm_that_is_heard_after_it_was_cleared_takes_its_space_until_it_is_home(fleet_in_space, heard):
    """The person was wrong: the arm is still in its last cycle."""
    fleet = fleet_in_space(2)
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


def test_only_space_that_is_taken_can_be_cleared(fleet_in_space):
    with pytest.raises(Refused, match=r"'arm_7' takes no space. Arms that do: arm_0, arm_1."):
        clear(fleet_in_space(2), "arm_7")


@pytest.mark.parametrize("before", [False, True])
def test_a_quote_says_nothing_about_an_award_that_was_closed_after_the_request(fleet_in_space, before):
    """The arm quotes before the award arrives, leaves home for it, and faults, all within one round.

    Args:
        before: It took the same space for an earlier award, which was closed before that round.
    """
    fleet = fleet_in_space(2)
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


WORK = Work(kind="hold", places=(Place(name="bench", position_m=(0.5, 0.0, 0.2)),), payload_kg=2.0)
CELL = CellSpace(
    volume={"a": 0, "b": 1, "c": 2},
    conflicts=np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1]], bool),
    reach=frozenset([frozenset(["one", "other"])]),
    arms=frozenset(["one", "other", "far"]),
)


def test_the_name_of_a_space_follows_from_the_values_of_the_plan():
    name = space_name(("arm", WORK, 1, 0.5))
    assert len(name) == 16
    same = replace(WORK, payload_kg=2, places=(replace(WORK.places[0], position_m=tuple(np.array([0.5, 0.0, 0.2]))),))
    assert space_name(("arm", same, np.int64(1), np.float64(0.5))) == name
    place = replace(WORK.places[0], retreat_m=0.1)
    others = [replace(WORK, payload_kg=2.1), replace(WORK, dwell_s=1.0), replace(WORK, places=(place,))]
    names = {space_name(("arm", work, 1, 0.5)) for work in others}
    names |= {space_name(key) for key in (("b", WORK, 1, 0.5), ("arm", WORK, 2, 0.5), ("arm", WORK, 1, 1.0))}
    assert len(names - {name}) == 6


@pytest.mark.parametrize(
    ("arm", "space", "other", "other_space", "excluded"),
    [
        ("one", "a", "other", "b", True),
        ("one", "a", "other", "c", False),
        ("one", "a", "other", "unknown", True),
        ("one", ANYWHERE, "other", "c", True),
        ("one", "a", "far", "unknown", False),
        ("one", "a", "outsider", "unknown", True),
        ("far", ANYWHERE, "one", ANYWHERE, False),
    ],
)
def test_spaces_of_a_cell_exclude_each_other_both_ways(arm, space, other, other_space, excluded):
    assert CELL(arm, space, other, other_space) == CELL(other, other_space, arm, space) == excluded


def test_an_arm_is_never_in_its_own_way():
    taken = {"one": ["a"], "other": ["c"], "far": []}
    assert arms_in_the_way("one", "b", taken, CELL) == ()
    assert arms_in_the_way("other", "b", taken, CELL) == ("one",)
    assert arms_in_the_way("one", None, taken, CELL) == ("other",)
