"""Award executor: its history after a crash."""

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from fleet.bus.protocol.auction import Lease, Receipt
from fleet.live.arm.awards import MAX_PAST_AWARDS, ArmHistory, ArmRecord, AwardExecutor, Started
from fleet.live.journal import Journal
from tests.live.award_shop import LEASE_S, finished, shop, taken
from tests.live.disk import Disk


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


def test_a_journal_on_disk_restores_the_history(tmp_path):
    with Journal(tmp_path / "a.jsonl", ArmRecord) as journal:
        history = ArmHistory().replay(journal.records()).after_restart("a", 0.0)
        journal.rewrite(*history.compact())
        award = taken(AwardExecutor("a", journal.append, history, nonce="n"))
    with Journal(tmp_path / "a.jsonl", ArmRecord) as journal:
        again = ArmHistory().replay(journal.records())
    assert list(again.active) == [award.award]
    assert again.boot == 1


def test_a_first_start_is_the_first_boot():
    assert ArmHistory().after_restart("a", 0.0).boot == 1
    history = ArmHistory().replay([Started(boot=4)]).after_restart("a", 0.0)
    assert history.compact() == (Started("a", boot=5),)
