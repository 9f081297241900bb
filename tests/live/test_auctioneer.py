"""One thing at a time: rounds, awards, leases, leave and reports, with arms that keep the rule."""

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
from fleet.errors import JournalFull, Refused


@pytest.fixture
def fleet_of(live):
    return lambda count: live.Fleet([live.Arm(f"arm_{i}") for i in range(count)])


def hold(name: str, place: str = "rack", repetitions: int = 3, **changes) -> JobSpec:
    return JobSpec(name=name, kind="hold", places=(place,), repetitions=repetitions, **changes)


def under_way(fleet, kind: type) -> list:
    return [wire.word for wire in fleet.wires if isinstance(wire.word, kind)]


def bid(fleet, *words: JobSpec) -> None:
    """Hand in jobs, open a round and let every arm answer."""
    fleet.submit(*words)
    fleet.step(0.1)
    for _ in range(2):
        fleet.deliver_all()


def test_a_lease_ends_later_here_than_at_the_slowest_arm(live):
    fleet = live.Fleet([live.Arm("arm_0", 1 - 1e-3), live.Arm("arm_1")], rate=1 + 1e-3)
    bid(fleet, hold("j", repetitions=10**4))
    fleet.run_fair(1.0, but="arm_1")
    assert fleet.at_work() == {"j": ["arm_0"]}
    for _ in range(4000):
        fleet.run_fair(0.001, 0.001, but="arm_0")
        fleet.check()
        if fleet.at_work() == {"j": ["arm_1"]}:
            break
    assert fleet.at_work() == {"j": ["arm_1"]}


def test_a_round_closes_with_the_last_answer_or_when_its_time_is_over(fleet_of, live):
    fleet = fleet_of(2)
    bid(fleet, hold("a"), hold("b", "bin"))
    assert {word.job.name for word in under_way(fleet, Award)} == {"a", "b"}
    slow = fleet_of(2)
    slow.submit(hold("a"), hold("b", "bin"))
    slow.step(0.1)
    slow.wires = [wire for wire in slow.wires if wire.to == "arm_0"]
    slow.deliver_all()
    slow.deliver_all()
    assert under_way(slow, Award) == []
    slow.step(live.TIMING.window_s)
    assert len(under_way(slow, Award)) == 1


def test_nobody_waits_for_an_arm_that_has_gone(fleet_of):
    fleet = fleet_of(2)
    fleet.submit(hold("a"))
    fleet.step(0.1)
    fleet.arms["arm_1"].up = False
    fleet.deliver_all()
    fleet.deliver_all()
    assert under_way(fleet, Award) == []
    fleet.step(0.01)
    assert len(under_way(fleet, Award)) == 1


def test_an_award_without_an_answer_is_sent_three_times_and_then_given_up(fleet_of, live):
    fleet = fleet_of(1)
    bid(fleet, hold("a"))
    sent = []
    for _ in range(40):
        sent += under_way(fleet, Award)
        fleet.wires.clear()
        fleet.step(0.1)
        if not fleet.auctioneer.ledger.open:
            break
    assert [word.award for word in sent] == [sent[0].award] * 3
    assert fleet.true_s > live.TIMING.lease_s
    assert "did not answer the award" in fleet.auctioneer.status()[0].reason


def test_a_refused_job_is_auctioned_again_but_not_in_a_hurry(fleet_of):
    fleet = fleet_of(1)
    bid(fleet, hold("a"))
    fleet.arms["arm_0"].crash(fleet.true_s)  # so it knows nothing of its quote
    fleet.deliver_all()
    fleet.deliver_all()
    assert fleet.auctioneer.status()[0].reason == "'arm_0' refused it: not now"
    fleet.step(0.1)
    assert under_way(fleet, QuoteRequest) == []
    fleet.run_fair(5.0)
    assert fleet.auctioneer.status()[0].state == "finished"


def test_one_job_at_a_station_at_a_time(fleet_of):
    fleet = fleet_of(2)
    bid(fleet, hold("a"), hold("b"))
    assert len(under_way(fleet, Award)) == 1


def test_an_allocation_against_the_bids_is_not_awarded(fleet_of, caplog):
    fleet = fleet_of(1)
    fleet.auctioneer._allocate = lambda bidding: {"a": "nobody", "b": "arm_0", "c": "arm_0", "x": "arm_0"}
    bid(fleet, hold("a"), hold("b", "bin"), hold("c", "belt"))
    assert [word.job.name for word in under_way(fleet, Award)] == ["b"]
    assert caplog.text.count("The allocation rule gives") == 3


def test_a_report_on_the_award_of_another_is_refused(fleet_of):
    fleet = fleet_of(2)
    bid(fleet, hold("a"))
    (award,) = under_way(fleet, Award)
    lie = Report("arm_1", award.award, "a", "finished", 3, 1.0)
    with pytest.raises(Refused, match="is of 'a' to 'arm_0', not of 'a' to 'arm_1'"):
        fleet.auctioneer.apply_report(lie, fleet.real_s, fleet.true_s)
    assert fleet.auctioneer.status()[0].state == "awarded"


def test_the_same_report_again_changes_nothing(fleet_of):
    fleet = fleet_of(1)
    bid(fleet, hold("a"))
    fleet.deliver_all()
    fleet.arms["arm_0"].give_back(fleet.true_s)
    (report,) = fleet.arms["arm_0"].reports.values()
    first = fleet.auctioneer.apply_report(report, fleet.real_s, fleet.true_s)
    written = len(fleet.journal)
    assert fleet.auctioneer.apply_report(report, fleet.real_s, fleet.true_s) == first
    assert len(fleet.journal) == written


def test_a_report_on_an_award_that_nobody_made_changes_nothing(fleet_of):
    fleet = fleet_of(1)
    fleet.submit(hold("a"))
    receipt = fleet.auctioneer.apply_report(Report("arm_0", "old", "a", "finished", 3, 1.0), 0.0, 0.0)
    assert receipt == Receipt("auctioneer", "old")
    assert fleet.auctioneer.status()[0].state == "waiting"


def test_a_lease_of_another_arm_is_lost(fleet_of):
    fleet = fleet_of(2)
    bid(fleet, hold("a"))
    (award,) = under_way(fleet, Award)
    holds = (LeaseEntry(award.award, "a", 2, "finishing"),)
    lease = fleet.auctioneer.renew_leases(LeaseRequest("arm_1", holds), fleet.real_s, fleet.true_s)
    assert (lease.granted, lease.revoked, lease.may_commit) == ((), (award.award,), ())


def test_who_asks_late_keeps_a_job_that_was_not_taken_back(fleet_of, live):
    fleet = fleet_of(1)
    bid(fleet, hold("a"))
    fleet.deliver_all()
    fleet.true_s += 10 * live.TIMING.lease_s  # as if the auctioneer had stood still
    (award,) = fleet.arms["arm_0"].holds
    request = fleet.arms["arm_0"].request()
    assert fleet.auctioneer.renew_leases(request, fleet.real_s, fleet.true_s).granted == (award,)
    fleet.true_s += 2 * live.TIMING.lease_s
    fleet.auctioneer.tick(fleet.real_s, fleet.true_s)
    assert fleet.auctioneer.renew_leases(request, fleet.real_s, fleet.true_s).revoked == (award,)


def test_what_no_arm_can_do_says_why(fleet_of):
    fleet = fleet_of(1)
    fleet.submit(hold("a"))
    fleet.step(0.1)
    (request,) = under_way(fleet, QuoteRequest)
    offers = (JobEstimate("a", False, "reach: 1.2 m"),)
    quote = Quote("arm_0", request.auction, "q", 1.0, "model", 0.0, "idle", 10.0, 1, offers)
    fleet.auctioneer.add_quote(quote)
    fleet.step(0.0)
    assert fleet.auctioneer.status()[0].reason == "No arm can do it: arm_0: reach: 1.2 m."


def test_what_cannot_be_written_is_not_promised(fleet_of):
    fleet = fleet_of(1)
    fleet.full = True
    with pytest.raises(JournalFull):
        fleet.auctioneer.submit(Submission((hold("a"),)), 0.0, 0.0)
    assert fleet.auctioneer.status() == ()
    fleet.full = False
    bid(fleet, hold("a", repetitions=1))
    fleet.deliver_all()
    fleet.full = True
    (award,) = fleet.arms["arm_0"].holds
    lease = fleet.auctioneer.renew_leases(fleet.arms["arm_0"].request(), fleet.real_s, fleet.true_s)
    assert (lease.granted, lease.may_commit) == ((award,), ())


def test_the_last_results_are_said_again_after_a_restart(fleet_of):
    fleet = fleet_of(1)
    bid(fleet, hold("a"))
    fleet.run_fair(5.0)
    before = dict(fleet.results)
    fleet.results.clear()
    fleet.auctioneer = fleet.born()
    fleet.step(0.1)
    assert fleet.results == before
    assert [result.status.state for result in before.values()] == ["waiting", "awarded", "finishing", "finished"]


def test_the_end_of_the_shift_is_reported_for_what_is_not_done(fleet_of):
    fleet = fleet_of(1)
    bid(fleet, hold("a"), hold("b"))
    fleet.deliver_all()
    fleet.auctioneer.end(7200.0)
    assert [said.state for said in fleet.auctioneer.status()] == ["unfinished", "unfinished"]
    lease = fleet.auctioneer.renew_leases(fleet.arms["arm_0"].request(), fleet.real_s, fleet.true_s)
    assert len(lease.revoked) == 1
