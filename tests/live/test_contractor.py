"""What one arm promises: which awards it takes, what it may do with them, and what its journal makes of a crash."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from fleet.bus.trade import Award, JobWord, Lease, Receipt
from fleet.errors import JournalFull
from fleet.live.contractor import DRIFT, Contractor, Terms
from fleet.live.journal import Journal
from fleet.live.promises import MOST_KNOWN, Booted, Memory, Promise, recall, restarted, retold

JOB = JobWord(name="j", kind="hold", places=("p",), repetitions=3)
OTHER = JobWord(name="k", kind="hold", places=("p",))
VALID_S, LEASE_S = 5.0, 6.0


class Disk(list):
    """A journal that may be full."""

    full = False

    def keep(self, *records) -> None:
        if self.full:
            raise JournalFull("there is no room")
        self.extend(records)


def shop(disk=None, boot_nonce="n", **terms):
    """A contractor at its start, and its disk."""
    disk = Disk() if disk is None else disk
    memory = restarted(recall(disk), "a", 7.0)
    disk[:] = retold(memory)
    terms = Terms(**{"valid_s": VALID_S, **terms})
    return Contractor("a", disk.keep, memory, nonce=boot_nonce, terms=terms), disk


def award_on(quote, job=JOB, **changes):
    base = Award(award=f"w-{job.name}", auction="r", auctioneer="x", quote=quote, job=job, lease_s=LEASE_S)
    return replace(base, **changes)


def quoted(contractor, *jobs, now_s=0.0, can=True):
    return contractor.quoted({job.name: (job, can) for job in jobs or (JOB,)}, now_s)


def taken(contractor, now_s=0.0, **changes):
    """An award that the arm has taken."""
    award = award_on(quoted(contractor, now_s=now_s), **changes)
    assert contractor.awarded(award, now_s) == replace(contractor.awarded(award, now_s), accepted=True)
    return award


def test_an_award_on_a_good_quote_is_taken_and_on_disk():
    contractor, disk = shop()
    award = taken(contractor)
    assert [held.award for held in contractor.held] == [award]
    assert list(recall(disk).held) == [award.award]
    assert contractor.spare == 0


@pytest.mark.parametrize(
    ("change", "now_s", "reason"),
    [
        ({"quote": "1-n-99"}, 0.0, "no quote '1-n-99'"),
        ({"job": OTHER}, 0.0, "says nothing of a job 'k'"),
        ({"job": replace(JOB, payload_kg=4.0)}, 0.0, "not the one that the quote was for"),
        ({"cycles": 3}, 0.0, "nothing is left"),
        ({"lease_s": 60.0}, VALID_S + 0.01, "good for 5 s"),
        ({"lease_s": 2.0}, 2.0 * (1 - DRIFT), "lease is over"),
    ],
)
def test_an_award_that_does_not_fit_is_refused_with_the_reason(change, now_s, reason):
    contractor, disk = shop()
    award = replace(award_on(quoted(contractor)), **change)
    before = list(disk)
    ack = contractor.awarded(award, now_s)
    assert not ack.accepted
    assert reason in ack.reason
    assert disk == before
    assert not contractor.held


def test_the_last_moment_of_a_quote_is_good():
    contractor, _ = shop()
    assert contractor.awarded(award_on(quoted(contractor), lease_s=60.0), VALID_S).accepted


def test_an_arm_that_is_unfit_full_or_unable_refuses():
    contractor, _ = shop()
    assert "too hot" in contractor.awarded(award_on(quoted(contractor)), 0.0, "I am too hot").reason
    assert "cannot do it" in contractor.awarded(award_on(quoted(contractor, can=False)), 0.0).reason
    taken(contractor)
    full = contractor.awarded(award_on(quoted(contractor, OTHER), OTHER), 0.0)
    assert "1 job(s) in hand" in full.reason


def test_a_refusal_is_final_although_the_reason_has_gone():
    contractor, _ = shop()
    award = award_on(quoted(contractor))
    refused = contractor.awarded(award, 0.0, "I am too hot")
    assert contractor.awarded(award, 0.1) == refused
    assert not contractor.awarded(replace(award, award="another"), 0.1).accepted


def test_the_same_award_gets_the_same_answer_and_changes_nothing():
    contractor, disk = shop(capacity=3)
    award = taken(contractor)
    before = list(disk)
    assert contractor.awarded(award, 100.0, "I am too hot") == contractor.awarded(award, 0.0)
    assert disk == before
    assert len(contractor.held) == 1
    assert "was for the job 'j'" in contractor.awarded(replace(award, job=OTHER), 0.0).reason


def test_one_award_for_each_job_of_a_quote():
    contractor, _ = shop(capacity=3)
    quote = quoted(contractor, JOB, OTHER)
    assert contractor.awarded(award_on(quote), 0.0).accepted
    assert contractor.awarded(award_on(quote, OTHER), 0.0).accepted
    assert "by 'w-j'" in contractor.awarded(award_on(quote, award="w2"), 0.0).reason


def test_a_later_award_for_a_job_in_hand_takes_the_place_of_the_earlier():
    contractor, disk = shop()
    taken(contractor)
    contractor.worked(1, 9.0)
    again = award_on(quoted(contractor, now_s=10.0), award="w2", cycles=1)
    assert contractor.awarded(again, 10.0).accepted
    assert [held.award for held in contractor.held] == [again]
    assert list(recall(disk).held) == ["w2"]


def test_names_of_quotes_are_never_used_again():
    names, disk = [], Disk()
    for life in range(3):
        contractor, _ = shop(disk, boot_nonce=f"n{life}")
        names += [quoted(contractor) for _ in range(100)]
    wiped, _ = shop(boot_nonce="n9")
    names += [quoted(wiped) for _ in range(100)]
    assert len(set(names)) == 400


def test_only_so_many_quotes_are_remembered():
    contractor, _ = shop(quotes=4)
    names = [quoted(contractor) for _ in range(6)]
    assert "no quote" in contractor.awarded(award_on(names[1]), 0.0).reason
    assert contractor.awarded(award_on(names[2]), 0.0).accepted


# Leases and leave


def test_a_lease_lasts_from_the_quote_and_then_from_the_question():
    contractor, _ = shop()
    award = taken(contractor, now_s=10.0)
    end_s = 10.0 + LEASE_S * (1 - DRIFT)
    assert contractor.may(end_s - 1e-6) == 2  # all but the last cycle
    assert contractor.may(end_s) == 0
    contractor.leased(Lease("x", 4.0, (award.award,), ()), 15.0)
    assert contractor.may(15.0 + 4.0 * (1 - DRIFT) - 1e-6) == 2
    assert contractor.may(18.97) == 0
    contractor.leased(Lease("x", 4.0, (award.award,), ()), 12.0)  # a late answer takes nothing back
    assert contractor.may(18.0) == 2


def test_a_lease_of_another_auctioneer_counts_for_nothing():
    contractor, _ = shop()
    award = taken(contractor)
    contractor.leased(Lease("y", 100.0, (award.award,), (), (award.award,)), 0.0)
    contractor.leased(Lease("y", 100.0, (), (award.award,)), 0.0)
    assert contractor.may(50.0) == 0


def test_leases_are_asked_for_three_times_in_each_and_leave_at_once():
    contractor, _ = shop()
    taken(contractor)
    asked = [s / 100 for s in range(600) if contractor.lease_requests(s / 100)]
    assert asked == [2.0, 4.0]
    contractor.worked(2, 0.9)
    ((auctioneer, request),) = contractor.lease_requests(4.01)
    assert (auctioneer, request.holds[0].phase) == ("x", "finishing")
    assert not contractor.lease_requests(4.02)
    assert contractor.lease_requests(4.32)


def test_the_last_cycle_needs_leave_which_is_on_disk_and_for_good():
    contractor, disk = shop()
    award = taken(contractor)
    contractor.worked(2, 0.0)
    leave = Lease("x", 4.0, (award.award,), (), (award.award,))
    disk.full = True
    contractor.leased(leave, 1.0)
    assert contractor.may(1.0) == 2
    disk.full = False
    contractor.leased(leave, 1.0)
    assert contractor.may(1000.0) == 3
    contractor.leased(Lease("x", 4.0, (), (award.award,)), 2.0)
    contractor.give_up(0.0, 1000.0)
    assert contractor.may(1000.0) == 3
    assert recall(disk).held[award.award].leave


def test_what_is_lost_is_let_go_of_without_a_report():
    contractor, disk = shop()
    award = taken(contractor)
    contractor.leased(Lease("x", 4.0, (), (award.award,)), 2.0)
    assert not contractor.held
    assert not contractor.reports(2.0)
    assert not recall(disk).held


def test_without_a_lease_for_long_the_job_is_given_back():
    contractor, _ = shop(patience_s=20.0)
    taken(contractor)
    contractor.give_up(1.0, 25.9)
    assert contractor.held
    contractor.give_up(2.0, 26.0)
    ((_, report),) = contractor.reports(26.0)
    assert (report.outcome, report.time_s, report.reason) == ("returned", 2.0, "no lease for 20 s")


def test_no_more_cycles_are_told_than_are_on_disk():
    contractor, disk = shop()
    taken(contractor)
    contractor.worked(1, 9.0)
    disk.full = True
    assert contractor.lease_requests(2.0)[0][1].holds[0].cycles == 0
    disk.full = False
    assert contractor.lease_requests(4.0)[0][1].holds[0].cycles == 1
    assert next(iter(recall(disk).held.values())).cycles == 1


# Reports


def finished(contractor, award, now_s=1.0):
    contractor.leased(Lease("x", LEASE_S, (award.award,), (), (award.award,)), now_s)
    contractor.finished(33.0, now_s)


def test_a_report_is_said_again_ever_more_seldom_until_its_receipt():
    contractor, _ = shop()
    award = taken(contractor)
    finished(contractor, award, 1.0)
    said = [s / 10 for s in range(10, 600) if contractor.reports(s / 10)]
    assert said == [1.0, 1.5, 2.5, 4.5, 8.5, 16.5, 24.5, 32.5, 40.5, 48.5, 56.5]
    contractor.receipted(Receipt("y", award.award))
    assert contractor.reports(100.0)
    contractor.receipted(Receipt("x", award.award))
    assert not contractor.reports(200.0)


def test_a_finished_job_for_which_there_is_no_room_is_reported_once_there_is():
    contractor, disk = shop()
    award = taken(contractor)
    contractor.leased(Lease("x", LEASE_S, (award.award,), (), (award.award,)), 1.0)
    disk.full = True
    contractor.finished(33.0, 1.0)
    assert not contractor.held
    assert not contractor.reports(2.0)
    assert contractor.spare == 0
    assert "no room" in contractor.awarded(award_on(quoted(contractor, OTHER), OTHER), 0.0).reason
    disk.full = False
    contractor.catch_up()
    ((_, report),) = contractor.reports(3.0)
    assert (report.outcome, report.cycles, report.time_s) == ("finished", 3, 33.0)


def test_a_full_disk_takes_no_work():
    contractor, disk = shop()
    award = award_on(quoted(contractor))
    disk.full = True
    ack = contractor.awarded(award, 0.0)
    assert "cannot write it down: there is no room" in ack.reason
    disk.full = False
    assert contractor.awarded(award, 0.0) == ack


def test_a_faulted_arm_gives_back_all_it_has():
    contractor, _ = shop(capacity=2)
    quote = quoted(contractor, JOB, OTHER)
    for job in (JOB, OTHER):
        contractor.awarded(award_on(quote, job), 0.0)
    contractor.worked(1, 9.0)
    contractor.returned(5.0, 1.0, "too hot")
    assert [(r.job, r.cycles, r.unsure) for _, r in contractor.reports(1.0)] == [("j", 1, False), ("k", 0, False)]


# After a crash


def test_what_was_finished_is_reported_again_in_the_next_life():
    contractor, disk = shop()
    finished(contractor, taken(contractor))
    next_life, _ = shop(disk)
    ((auctioneer, report),) = next_life.reports(0.0)
    assert (auctioneer, report.outcome, report.time_s) == ("x", "finished", 33.0)
    next_life.receipted(Receipt("x", report.award))
    assert not shop(disk)[0].reports(0.0)


def test_what_was_in_hand_is_given_back_in_the_next_life_with_the_cycles_on_disk():
    contractor, disk = shop()
    taken(contractor, cycles=1)
    contractor.worked(2, 9.0)  # not on disk yet
    ((_, report),) = shop(disk)[0].reports(0.0)
    assert (report.outcome, report.cycles, report.time_s, report.unsure) == ("returned", 1, 7.0, False)


def test_an_award_is_known_over_many_restarts_and_the_journal_stays_small():
    disk = Disk()
    for life in range(MOST_KNOWN + 50):
        contractor, _ = shop(disk, boot_nonce=str(life))
        award = taken(contractor, award=f"w{life}")
        finished(contractor, award)
        contractor.receipted(Receipt("x", award.award))
    contractor, _ = shop(disk)
    assert contractor.awarded(award, 99.0).accepted
    assert len(disk) <= MOST_KNOWN + 2
    assert recall(disk).boot == MOST_KNOWN + 51


@given(st.integers(0, 5), st.booleans(), st.booleans())
def test_a_memory_retold_is_the_same_memory(cycles, leave, closed):
    contractor, disk = shop(capacity=3)
    award = taken(contractor)
    contractor.worked(min(cycles, 2), 0.0)
    contractor.lease_requests(3.0)
    if leave:
        contractor.leased(Lease("x", 4.0, (), (), (award.award,)), 1.0)
    if closed:
        contractor.returned(5.0, 1.0, "too hot")
    memory = recall(disk)
    told = recall(retold(memory))
    assert (told.boot, told.known, told.reports) == (memory.boot, memory.known, memory.reports)
    assert {n: (h.award, h.cycles, h.leave) for n, h in told.held.items()} == {
        n: (h.award, h.cycles, h.leave) for n, h in memory.held.items()
    }


def test_a_real_journal_keeps_the_promises(tmp_path):
    with Journal(tmp_path / "a.jsonl", Promise) as journal:
        memory = restarted(recall(journal.replay()), "a", 0.0)
        journal.rewrite(*retold(memory))
        award = taken(Contractor("a", journal.append, memory, nonce="n"))
    with Journal(tmp_path / "a.jsonl", Promise) as journal:
        again = recall(journal.replay())
    assert list(again.held) == [award.award]
    assert again.boot == 1


def test_a_first_start_is_the_first_boot():
    assert restarted(Memory(), "a", 0.0).boot == 1
    assert retold(restarted(recall([Booted(4)]), "a", 0.0)) == (Booted(5),)


@pytest.mark.parametrize(
    ("repetitions", "done", "phase"), [(1, 0, "finishing"), (3, 2, "finishing"), (3, 1, "working")]
)
def test_an_arm_that_has_only_the_last_cycle_left_asks_for_leave_from_afar(repetitions, done, phase):
    """It may not set out without: waiting until the last cycle is near, it would wait for ever."""
    contractor, _ = shop()
    job = replace(JOB, repetitions=repetitions)
    contractor.awarded(award_on(quoted(contractor, job), job), 0.0)
    contractor.worked(done, last_in_s=100.0)
    ((_, request),) = contractor.lease_requests(3.0)
    assert request.holds[0].phase == phase


@pytest.mark.parametrize("name", ["capacity", "valid_s", "quotes", "patience_s", "ahead_s"])
def test_terms_must_be_positive(name):
    with pytest.raises(ValueError, match=rf"Terms\.{name}"):
        Terms(**{name: 0})
