"""Award executor: accepted awards, allowed cycles and reports, also after a crash."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from fleet.bus.protocol.auction import Award, JobSpec, Lease, Receipt, Report
from fleet.live.arm.awards import (
    CLOCK_DRIFT,
    MAX_PAST_AWARDS,
    MAX_UNSURE,
    ArmHistory,
    AwardAccepted,
    AwardExecutor,
    Closed,
    ExecutorConfig,
)
from tests.live.disk import Disk

JOB = JobSpec(name="j", kind="hold", places=("p",), repetitions=3)
OTHER = JobSpec(name="k", kind="hold", places=("p",))
VALID_S, LEASE_S = 5.0, 6.0


def shop(disk=None, boot_nonce="n", **config):
    """An executor at its start, and its disk."""
    disk = Disk() if disk is None else disk
    history = ArmHistory().replay(disk.records).after_restart("a", 7.0)
    disk.records[:] = history.compact()
    config = ExecutorConfig(**{"valid_s": VALID_S, **config})
    return AwardExecutor("a", disk.keep, history, nonce=boot_nonce, config=config), disk


def award_on(quote, job=JOB, **changes):
    base = Award(award=f"w-{job.name}", auction="r", auctioneer="x", quote=quote, job=job, lease_s=LEASE_S)
    return replace(base, **changes)


def quoted(executor, *jobs, now_s=0.0, can=True):
    return executor.add_quote({job.name: (job, can) for job in jobs or (JOB,)}, now_s)


def taken(executor, now_s=0.0, **changes):
    """An award that the arm has taken."""
    award = award_on(quoted(executor, now_s=now_s), **changes)
    assert executor.answer_award(award, now_s) == replace(executor.answer_award(award, now_s), accepted=True)
    return award


def finished(executor, award, now_s=1.0):
    executor.apply_lease(Lease("x", LEASE_S, (award.award,), (), (award.award,)), now_s)
    executor.finish(33.0, now_s)


@pytest.mark.parametrize(
    ("change", "now_s", "reason"),
    [
        ({"quote": "1-n-99"}, 0.0, "no quote '1-n-99'"),
        ({"job": OTHER}, 0.0, "not for a job 'k'"),
        ({"job": replace(JOB, payload_kg=4.0)}, 0.0, "not the one that the quote was for"),
        ({"cycles": 3}, 0.0, "none is left"),
        ({"lease_s": 60.0}, VALID_S + 0.01, "valid for 5 s"),
        ({"lease_s": 2.0}, 2.0 * (1 - CLOCK_DRIFT), "lease has expired"),
    ],
)
def test_an_award_that_does_not_match_is_refused_with_the_reason(change, now_s, reason):
    executor, disk = shop()
    award = replace(award_on(quoted(executor)), **change)
    before = list(disk.records)
    ack = executor.answer_award(award, now_s)
    assert not ack.accepted
    assert reason in ack.reason
    assert disk.records == before
    assert not executor.active


def test_quotes_are_unique_few_and_valid_until_their_end():
    names, disk = [], Disk()
    for life in range(3):
        executor, _ = shop(disk, boot_nonce=f"n{life}")
        names += [quoted(executor) for _ in range(100)]
    wiped, _ = shop(boot_nonce="n9")
    names += [quoted(wiped) for _ in range(100)]
    assert len(set(names)) == 400
    executor, _ = shop()
    assert executor.answer_award(award_on(quoted(executor), lease_s=60.0), VALID_S).accepted
    executor, _ = shop(quotes=4)
    names = [quoted(executor) for _ in range(6)]
    assert "no quote" in executor.answer_award(award_on(names[1]), 0.0).reason
    assert executor.answer_award(award_on(names[2]), 0.0).accepted


def test_an_unfit_full_or_unable_arm_refuses_and_a_refusal_is_final():
    executor, _ = shop()
    assert "too hot" in executor.answer_award(award_on(quoted(executor)), 0.0, "I am too hot").reason
    assert "cannot do it" in executor.answer_award(award_on(quoted(executor, can=False)), 0.0).reason
    taken(executor)
    full = executor.answer_award(award_on(quoted(executor, OTHER), OTHER), 0.0)
    assert "I have 1 job(s)" in full.reason
    executor, _ = shop()
    award = award_on(quoted(executor))
    refused = executor.answer_award(award, 0.0, "I am too hot")
    assert executor.answer_award(award, 0.1) == refused
    assert not executor.answer_award(replace(award, award="another"), 0.1).accepted


def test_the_same_award_gets_the_same_answer_and_changes_nothing():
    executor, disk = shop(capacity=3)
    award = taken(executor)
    before = list(disk.records)
    assert executor.answer_award(award, 100.0, "I am too hot") == executor.answer_award(award, 0.0)
    assert disk.records == before
    assert len(executor.active) == 1
    assert "was for the job 'j'" in executor.answer_award(replace(award, job=OTHER), 0.0).reason


def test_one_award_for_each_job_of_a_quote():
    executor, _ = shop(capacity=3)
    quote = quoted(executor, JOB, OTHER)
    assert executor.answer_award(award_on(quote), 0.0).accepted
    assert executor.answer_award(award_on(quote, OTHER), 0.0).accepted
    assert "by 'w-j'" in executor.answer_award(award_on(quote, award="w2"), 0.0).reason


def test_a_later_award_of_the_current_job_replaces_the_earlier():
    executor, disk = shop()
    taken(executor)
    executor.record_progress(1, 9.0)
    again = award_on(quoted(executor, now_s=10.0), award="w2", cycles=1)
    assert executor.answer_award(again, 10.0).accepted
    assert [held.award for held in executor.active] == [again]
    assert list(ArmHistory().replay(disk.records).active) == ["w2"]


# Leases and leave


def test_a_lease_runs_from_the_quote_and_then_from_the_request():
    executor, _ = shop()
    award = taken(executor, now_s=10.0)
    end_s = 10.0 + LEASE_S * (1 - CLOCK_DRIFT)
    assert executor.allowed_cycles(end_s - 1e-6) == 2  # all but the last cycle
    assert executor.allowed_cycles(end_s) == 0
    executor.apply_lease(Lease("x", 4.0, (award.award,), ()), 15.0)
    assert executor.allowed_cycles(15.0 + 4.0 * (1 - CLOCK_DRIFT) - 1e-6) == 2
    assert executor.allowed_cycles(18.97) == 0
    executor.apply_lease(Lease("x", 4.0, (award.award,), ()), 12.0)  # a late answer takes nothing back
    assert executor.allowed_cycles(18.0) == 2


def test_a_lease_of_another_auctioneer_is_ignored():
    executor, _ = shop()
    award = taken(executor)
    executor.apply_lease(Lease("y", 100.0, (award.award,), (), (award.award,)), 0.0)
    executor.apply_lease(Lease("y", 100.0, (), (award.award,)), 0.0)
    assert executor.allowed_cycles(50.0) == 0


def test_leases_are_requested_three_times_in_each_and_permission_at_once():
    executor, _ = shop()
    taken(executor)
    asked = [s / 100 for s in range(600) if executor.lease_requests(s / 100)]
    assert asked == [2.0, 4.0]
    executor.record_progress(2, 0.9)
    ((auctioneer, request),) = executor.lease_requests(4.01)
    assert (auctioneer, request.entries[0].phase) == ("x", "finishing")
    assert not executor.lease_requests(4.02)
    assert executor.lease_requests(4.32)


def test_the_last_cycle_needs_permission_which_is_on_disk_and_a_lease():
    executor, disk = shop()
    award = taken(executor)
    executor.record_progress(2, 0.0)
    leave = Lease("x", 4.0, (award.award,), (), (award.award,))
    disk.full = True
    executor.apply_lease(leave, 1.0)
    assert executor.allowed_cycles(1.0) == 2
    disk.full = False
    executor.apply_lease(leave, 1.0)
    assert (executor.allowed_cycles(5.9), executor.allowed_cycles(6.0)) == (3, 2)
    executor.return_ended(0.0, 1000.0, at_home=True)
    assert ArmHistory().replay(disk.records).active[award.award].may_commit
    executor.apply_lease(leave, 1000.0)
    assert executor.allowed_cycles(1001.0) == 3


@pytest.mark.parametrize("in_last_cycle", [False, True])
def test_after_permission_to_commit_a_revoked_award_is_reported_from_home(in_last_cycle):
    executor, _ = shop()
    award = taken(executor)
    executor.record_progress(2, 0.0)
    executor.apply_lease(Lease("x", 4.0, (award.award,), (), (award.award,)), 1.0)
    executor.apply_lease(Lease("x", 4.0, (), (award.award,)), 2.0)
    executor.apply_lease(Lease("x", 4.0, (award.award,), (), (award.award,)), 1.5)  # it was late
    assert executor.allowed_cycles(2.0) == 2
    executor.return_ended(9.0, 3.0, at_home=False)
    assert executor.active
    if in_last_cycle:
        executor.finish(10.0, 4.0)
    else:
        executor.return_ended(10.0, 4.0, at_home=True)
    ((_, report),) = executor.due_reports(4.0)
    assert (report.cycles, report.unsure, report.outcome == "finished") == (2 + in_last_cycle, False, in_last_cycle)


def test_a_revoked_award_is_returned_at_home_with_the_cycle_that_was_in_progress():
    executor, disk = shop()
    award = taken(executor)
    executor.apply_lease(Lease("x", 4.0, (), (award.award,)), 2.0)
    assert executor.allowed_cycles(2.0) == 0
    executor.return_ended(1.0, 1000.0, at_home=False)  # a cycle may be longer than any lease
    assert executor.active
    assert not executor.due_reports(1000.0)
    executor.record_progress(1, 5.0)
    assert executor.allowed_cycles(2.0) == 1
    executor.return_ended(9.0, 1000.5, at_home=True)
    ((_, report),) = executor.due_reports(1000.5)
    assert (report.outcome, report.cycles, report.time_s) == ("returned", 1, 9.0)
    history = ArmHistory().replay(disk.records)
    assert not history.active
    assert [on_disk.cycles for _, on_disk in history.reports.values()] == [1]


def test_a_job_without_a_lease_for_long_is_returned():
    executor, _ = shop(return_after_s=20.0)
    taken(executor)
    executor.return_ended(1.0, 25.9, at_home=True)
    assert executor.active
    executor.return_ended(1.5, 26.0, at_home=False)
    assert executor.active, "a cycle is in progress"
    executor.return_ended(2.0, 26.0, at_home=True)
    ((_, report),) = executor.due_reports(26.0)
    assert (report.outcome, report.time_s, report.reason) == ("returned", 2.0, "It had no lease for 20 s.")


def test_a_lease_request_has_no_more_cycles_than_are_on_disk():
    executor, disk = shop()
    taken(executor)
    executor.record_progress(1, 9.0)
    disk.full = True
    assert executor.lease_requests(2.0)[0][1].entries[0].cycles == 0
    disk.full = False
    assert executor.lease_requests(4.0)[0][1].entries[0].cycles == 1
    assert next(iter(ArmHistory().replay(disk.records).active.values())).cycles == 1


# Reports


def test_a_report_is_repeated_with_back_off_until_its_receipt():
    executor, _ = shop()
    award = taken(executor)
    finished(executor, award, 1.0)
    said = [s / 10 for s in range(10, 600) if executor.due_reports(s / 10)]
    assert said == [1.0, 1.5, 2.5, 4.5, 8.5, 16.5, 24.5, 32.5, 40.5, 48.5, 56.5]
    executor.apply_receipt(Receipt("y", award.award))
    assert executor.due_reports(100.0)
    executor.apply_receipt(Receipt("x", award.award))
    assert not executor.due_reports(200.0)


def test_with_a_full_disk_no_work_is_taken_and_a_finished_job_is_reported_later():
    executor, disk = shop()
    award = taken(executor)
    executor.apply_lease(Lease("x", LEASE_S, (award.award,), (), (award.award,)), 1.0)
    disk.full = True
    executor.finish(33.0, 1.0)
    assert not executor.active
    assert not executor.due_reports(2.0)
    assert executor.spare_capacity == 0
    assert "no space left" in executor.answer_award(award_on(quoted(executor, OTHER), OTHER), 0.0).reason
    disk.full = False
    executor.retry_writes()
    ((_, report),) = executor.due_reports(3.0)
    assert (report.outcome, report.cycles, report.time_s) == ("finished", 3, 33.0)
    executor, disk = shop()
    award = award_on(quoted(executor))
    disk.full = True
    ack = executor.answer_award(award, 0.0)
    assert "journal cannot be written: no room" in ack.reason
    disk.full = False
    assert executor.answer_award(award, 0.0) == ack


def test_a_faulted_arm_returns_all_awards():
    executor, disk = shop(capacity=2)
    quote = quoted(executor, JOB, OTHER)
    for job in (JOB, OTHER):
        executor.answer_award(award_on(quote, job), 0.0)
    executor.record_progress(1, 9.0)
    executor.return_all(5.0, 1.0, "too hot", faulted=True)
    for each in (executor, shop(disk)[0]):  # the fault counts for the current job alone, also after a restart
        reports = [(r.job, r.cycles, r.unsure, r.faulted) for _, r in each.due_reports(1.0)]
        assert reports == [("j", 1, False, True), ("k", 0, False, False)]


@pytest.mark.parametrize(
    ("repetitions", "done", "phase"), [(1, 0, "finishing"), (3, 2, "finishing"), (3, 1, "working")]
)
def test_an_arm_with_only_the_last_cycle_left_requests_permission_early(repetitions, done, phase):
    """It may not set out without: waiting until the last cycle is near, it would wait for ever."""
    executor, _ = shop()
    job = replace(JOB, repetitions=repetitions)
    executor.answer_award(award_on(quoted(executor, job), job), 0.0)
    executor.record_progress(done, last_cycle_in_s=100.0)
    ((_, request),) = executor.lease_requests(3.0)
    assert request.entries[0].phase == phase


@pytest.mark.parametrize("name", ["capacity", "valid_s", "quotes", "return_after_s", "commit_lead_s"])
def test_config_values_must_be_positive(name):
    with pytest.raises(ValueError, match=rf"ExecutorConfig\.{name}"):
        ExecutorConfig(**{name: 0})


def test_a_finished_job_is_reported_again_after_a_restart():
    executor, disk = shop()
    finished(executor, taken(executor))
    next_life, _ = shop(disk)
    ((auctioneer, report),) = next_life.due_reports(0.0)
    assert (auctioneer, report.outcome, report.time_s) == ("x", "finished", 33.0)
    next_life.apply_receipt(Receipt("x", report.award))
    assert not shop(disk)[0].due_reports(0.0)


def test_an_active_job_is_returned_after_a_restart_with_the_cycles_on_disk():
    executor, disk = shop()
    taken(executor, cycles=1)
    executor.record_progress(2, 9.0)  # not on disk yet
    ((_, report),) = shop(disk)[0].due_reports(0.0)
    assert (report.outcome, report.cycles, report.time_s, report.unsure) == ("returned", 1, 7.0, False)


def test_an_arm_that_may_have_finished_a_job_returns_it_as_unsure():
    executor, disk = shop()
    award = taken(executor)
    executor.record_progress(2, 0.0)
    ((auctioneer, request),) = executor.lease_requests(1.0)
    assert (auctioneer, request.entries[0].phase, request.entries[0].cycles) == ("x", "finishing", 2)
    executor.apply_lease(Lease("x", LEASE_S, (award.award,), (), (award.award,)), 1.0)
    restarted, _ = shop(disk)
    assert not restarted.active
    ((_, report),) = restarted.due_reports(0.0)
    assert (report.outcome, report.cycles, report.unsure) == ("returned", 2, True)
    assert restarted.answer_award(award, 0.2).accepted  # the same answer after the restart
    assert not restarted.answer_award(replace(award, award="other"), 0.2).accepted  # on the same quote
    restarted.apply_receipt(Receipt("x", report.award))
    for _ in range(2):
        restarted, _ = shop(disk)
        (outcome,) = ArmHistory().replay(disk.records).message("a").committed
        assert (outcome.job, outcome.award, outcome.outcome, outcome.cycles) == ("j", report.award, "unfinished", 2)
    finished(restarted, taken(restarted, award="again"))
    assert ArmHistory().replay(disk.records).message("a").committed == ()


def test_the_last_jobs_that_an_arm_may_have_finished_are_kept():
    history = ArmHistory()
    for number in range(MAX_UNSURE + 1):
        report = Report("a", f"w{number}", f"j{number}", "returned", 2, 1.0, unsure=True)
        history.apply(AwardAccepted(award_on("q", replace(JOB, name=report.job), award=report.award)))
        history.apply(Closed(report))
    assert [outcome.job for outcome in history.message("a").committed] == [f"j{n}" for n in range(1, MAX_UNSURE + 1)]


def test_an_award_is_kept_over_many_restarts_and_the_journal_stays_small():
    disk = Disk()
    for life in range(MAX_PAST_AWARDS + 50):
        executor, _ = shop(disk, boot_nonce=str(life))
        award = taken(executor, award=f"w{life}")
        finished(executor, award)
        executor.apply_receipt(Receipt("x", award.award))
    executor, _ = shop(disk)
    assert executor.answer_award(award, 99.0).accepted
    assert len(disk.records) <= MAX_PAST_AWARDS + 2
    assert ArmHistory().replay(disk.records).boot == MAX_PAST_AWARDS + 51


@given(st.integers(0, 5), st.booleans(), st.booleans())
def test_a_compacted_history_is_the_same_history(cycles, leave, closed):
    executor, disk = shop(capacity=3)
    award = taken(executor)
    executor.record_progress(min(cycles, 2), 0.0)
    executor.lease_requests(3.0)
    if leave:
        executor.apply_lease(Lease("x", 4.0, (), (), (award.award,)), 1.0)
    if closed:
        executor.return_all(5.0, 1.0, "too hot")
    history = ArmHistory().replay(disk.records)
    told = ArmHistory().replay(history.compact())
    assert (told.boot, told.accepted, told.reports) == (history.boot, history.accepted, history.reports)
    assert {n: (h.award, h.cycles, h.may_commit) for n, h in told.active.items()} == {
        n: (h.award, h.cycles, h.may_commit) for n, h in history.active.items()
    }
