"""Rounds, awards, leases, permission to commit and reports, with arms that follow the rules."""

import pytest

from fleet.bus.protocol.auction import (
    Award,
    JobEstimate,
    JobSpec,
    LeaseEntry,
    LeaseRequest,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
    Submission,
)
from fleet.bus.protocol.operator import Cancel, ControlRequest, Pause
from fleet.errors import JournalFull, Refused
from fleet.live.auction.rounds import Assignment


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


def test_the_last_results_are_published_again_after_a_restart(fleet_of):
    fleet = fleet_of(1)
    bid(fleet, hold("a"))
    fleet.run_without_faults(5.0)
    before = dict(fleet.results)
    fleet.results.clear()
    fleet.auctioneer = fleet.restart()
    fleet.step(0.1)
    assert fleet.results == before
    assert [result.status.state for result in before.values()] == ["waiting", "awarded", "finishing", "finished"]


def test_at_the_end_of_the_shift_open_jobs_are_reported_unfinished(fleet_of):
    fleet = fleet_of(1)
    bid(fleet, hold("a"), hold("b"))
    fleet.deliver_all()
    fleet.auctioneer.end(7200.0)
    assert [status.state for status in fleet.auctioneer.status()] == ["unfinished", "unfinished"]
    lease = fleet.auctioneer.renew_leases(fleet.arms["arm_0"].request(), fleet.real_s, fleet.true_s)
    assert len(lease.revoked) == 1
