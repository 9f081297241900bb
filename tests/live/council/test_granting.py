"""What an arm grants its peers, and what they make of it, one step at a time; storms are in `test_council_storm`."""

import pytest

from fleet.bus.protocol.auction import Award, JobSpec
from fleet.bus.protocol.consensus import Claim, ClaimEntry, ClaimReply, DeniedEntry, GrantedEntry, JobOutcome
from fleet.errors import JournalFull, Refused
from fleet.live.arm.award_executor import AwardExecutor
from fleet.live.arm.journal_records import ArmHistory
from fleet.live.auction.round import Timing
from fleet.live.consensus.claimant import Claimant
from fleet.live.consensus.granter import Granter, Register

TIMING = Timing(lease_s=3.0, margin_s=0.05)
ROSTER = ("a", "b", "c", "d")
JOB = JobSpec(name="j", kind="hold", places=("x",), repetitions=3)


class Disk:
    """A journal in history."""

    def __init__(self):
        self.records, self.full = [], False

    def keep(self, *records):
        if self.full:
            raise JournalFull("no room")
        self.records.extend(records)


@pytest.fixture
def disk():
    return Disk()


@pytest.fixture
def granter(disk):
    return Granter("d", ROSTER, Register(), disk.keep, real_s=0.0, timing=TIMING)


def reborn(disk, real_s):
    return Granter("d", ROSTER, Register().replay(disk.records), disk.keep, real_s=real_s, timing=TIMING)


def entry(award="a-1:j", job="j", *, place="x", cycles=0, phase="requested"):
    return ClaimEntry(award, job, (place,), cycles, phase)


def claim(arm, number, *entries, settled=()):
    return Claim(arm, number, entries, tuple(settled))


def finished(job="j", arm="a", outcome="finished"):
    return JobOutcome(job, f"{arm}-1:{job}", arm, outcome, 3, 9.0)


def granted(grant: ClaimReply) -> list[str]:
    return [each.award for each in grant.granted]


def test_a_job_is_one_arms_until_its_lease_is_over(granter):
    assert granted(granter.answer_claim(claim("a", 1, entry()), 0.0)) == ["a-1:j"]
    other = entry("b-1:j")
    denied = granter.answer_claim(claim("b", 1, other), TIMING.counted_lease_s - 0.01)
    assert (granted(denied), denied.denied[0].reason) == ([], "'a' has 'j'")
    assert granted(granter.answer_claim(claim("b", 2, other), TIMING.counted_lease_s + 0.01)) == ["b-1:j"]
    assert granted(granter.answer_claim(claim("a", 2, entry()), TIMING.counted_lease_s + 0.02)) == []


def test_the_same_claim_again_renews_and_writes_nothing(granter, disk):
    for number in range(5):
        assert granted(granter.answer_claim(claim("a", number, entry()), 2.0 * number)) == ["a-1:j"]
    assert len(disk.records) == 1


def test_a_station_serves_one_job_at_a_time(granter):
    granter.answer_claim(claim("a", 1, entry()), 0.0)
    same = claim("b", 1, entry("b-1:k", "k"), entry("b-1:l", "l", place="y"))
    assert granted(granter.answer_claim(same, 1.0)) == ["b-1:l"]


def test_what_is_no_more_in_a_claim_is_let_go(granter):
    granter.answer_claim(claim("a", 1, entry()), 0.0)
    granter.answer_claim(claim("a", 2), 0.1)
    assert granted(granter.answer_claim(claim("b", 1, entry("b-1:j")), 0.2)) == ["b-1:j"]


def test_leave_outlives_the_lease_and_a_restart(granter, disk):
    answer = granter.answer_claim(claim("a", 1, entry(cycles=2, phase="finishing")), 0.0)
    assert answer.granted == (GrantedEntry("a-1:j", 2, may_commit=True),)
    for each in (granter, reborn(disk, 0.0)):
        assert granted(each.answer_claim(claim("b", each.register.numbers.get("b", 0) + 1, entry("b-1:j")), 1e6)) == []
    assert not granter.busy_stations(1e6), "one that went silent does not bar its station"


@pytest.mark.parametrize("outcome", ["finished", "unfinished"])
def test_what_is_settled_is_nobodys_and_whoever_asks_is_told(granter, disk, outcome):
    granter.answer_claim(claim("a", 1, settled=[finished(outcome=outcome)]), 0.0)
    for each in (granter, reborn(disk, 0.0)):
        answer = each.answer_claim(claim("b", each.register.numbers.get("b", 0) + 1, entry("b-1:j")), 9.0)
        assert answer.denied[0].outcome == finished(outcome=outcome)


def test_a_job_that_is_given_back_keeps_its_cycles(granter):
    granter.answer_claim(claim("a", 1, entry(cycles=1)), 0.0)
    granter.answer_claim(claim("a", 2, settled=[JobOutcome("j", "a-1:j", "a", "returned", 2, 9.0)]), 0.1)
    assert granter.answer_claim(claim("b", 1, entry("b-1:j")), 0.2).granted == (GrantedEntry("b-1:j", 2),)


def test_after_a_restart_every_grant_counts_as_leased_from_then(granter, disk):
    granter.answer_claim(claim("a", 1, entry()), 0.0)
    again = reborn(disk, 100.0)
    assert granted(again.answer_claim(claim("b", 1, entry("b-1:j")), 100.0 + TIMING.counted_lease_s - 0.01)) == []
    assert granted(again.answer_claim(claim("b", 2, entry("b-1:j")), 100.0 + TIMING.counted_lease_s + 0.01)) == [
        "b-1:j"
    ]


@pytest.mark.parametrize("again", [False, True], ids=["", "after a restart"])
def test_a_claim_of_before_changes_nothing(granter, disk, again):
    granter.answer_claim(claim("a", 7, entry()), 0.0)
    one = reborn(disk, 0.0) if again else granter
    for old in (6, 7):
        with pytest.raises(Refused, match="Stale claim"):
            one.answer_claim(claim("a", old), 0.1)
    assert one.is_granted("j", 0.2)


def test_a_stranger_is_granted_nothing(granter):
    with pytest.raises(Refused, match=r"'z' is no arm of this fleet. Arms: a, b, c, d"):
        granter.answer_claim(claim("z", 1, entry()), 0.0)


def test_what_cannot_be_written_down_is_not_granted(granter, disk):
    disk.full = True
    assert granter.answer_claim(claim("a", 1, entry()), 0.0).denied[0].reason == "no room"
    with pytest.raises(Refused, match="no room"):
        granter.answer_claim(claim("a", 2, settled=[finished()]), 0.0)
    assert not granter.register.settled


def test_a_register_is_told_again_in_few_words(granter, disk):
    granter.add_jobs((JOB,))
    for number in range(9):
        granter.answer_claim(claim("a", number, entry(cycles=number)), 0.1 * number)
    granter.answer_claim(claim("b", 1, settled=[finished("k")]), 1.0)
    granter.answer_claim(claim("c", 4, entry("c-1:l", "l", place="y", phase="finishing")), 1.0)
    told = granter.register.compact()
    assert len(told) < len(disk.records)
    assert Register().replay(told).compact() == told
    assert Register().replay(told).settled == granter.register.settled
    assert Register().replay(told).numbers == granter.register.numbers


# The one who claims


class One:
    """One arm that claims, with a executor and a granter of its own; its peers are played by the test."""

    def __init__(self, roster=ROSTER, disk=None, grants=None):
        self.disk, self.grants = disk or Disk(), grants or Disk()
        history = ArmHistory().replay(self.disk.records).after_restart("a", 0.0)
        self.disk.records[:] = history.compact()
        self.executor = AwardExecutor("a", self.disk.keep, history, nonce="n")
        self.granter = Granter(
            "a", roster, Register().replay(self.grants.records), self.grants.keep, real_s=0.0, timing=TIMING
        )
        self.claimant = Claimant(
            self.executor, self.granter, self.executor.answer_award, boot=history.boot, timing=TIMING
        )

    def say(self, real_s) -> Claim:
        said = self.claimant.claim(frozenset("bcd"), real_s)
        assert said is not None
        return said

    def hear(self, said: Claim, real_s: float, *peers: str, leave: bool = False) -> None:
        for peer in peers:
            grants = tuple(GrantedEntry(each.award, each.cycles, leave) for each in said.entries)
            self.claimant.apply_reply(ClaimReply(peer, said.number, TIMING.lease_s, grants), real_s)


def test_only_a_majority_of_the_roster_gives_a_job():
    one = One()
    one.claimant.request(JOB, 0.0)
    said = one.say(0.0)
    one.hear(said, 0.1, "b")
    assert not one.executor.active, "two of four are no majority"
    one.hear(said, 0.1, "b", "z")
    assert not one.executor.active, "nor with one who is not of the fleet"
    one.hear(said, 0.1, "c")
    assert [held.award.job for held in one.executor.active] == [JOB]


def test_a_lease_is_counted_from_when_the_last_of_a_majority_was_asked():
    one = One()
    one.claimant.request(JOB, 0.0)
    said = one.say(0.0)
    one.hear(said, 0.9, "b", "c")
    assert one.executor.allowed_cycles(2.96) == 2
    assert one.executor.allowed_cycles(2.98) == 0
    one.claimant.claim_soon()
    later = one.say(2.0)
    one.hear(later, 2.5, "b")
    assert one.executor.allowed_cycles(2.98) == 0, "two of four have renewed it: itself and b"
    one.hear(later, 2.9, "d")
    assert one.executor.allowed_cycles(4.96) == 2
    assert one.executor.allowed_cycles(4.98) == 0


def held_with_leave(one: One) -> None:
    one.claimant.request(JOB, 0.0)
    one.hear(one.say(0.0), 0.1, "b", "c")
    one.executor.record_progress(2, 0.0)
    one.claimant.claim_soon()
    said = one.say(0.2)
    assert said.entries[0].phase == "finishing"
    one.hear(said, 0.3, "b", leave=True)
    assert not one.executor.active[0].may_commit
    one.hear(said, 0.3, "c", leave=True)
    assert one.executor.active[0].may_commit


def test_the_first_claim_after_a_crash_says_what_nobody_knows():
    """Without it, its peers would take the job for let go of, and do its last cycle again."""
    one = One()
    held_with_leave(one)
    again = One(disk=one.disk, grants=one.grants)
    said = again.say(1.0)
    assert [(each.job, each.outcome) for each in said.outcomes] == [("j", "unfinished")]
    assert said.number > 1_000_000_000


def test_what_is_finished_and_not_on_disk_is_still_held():
    one = One()
    held_with_leave(one)
    one.disk.full = True
    one.executor.finish(9.0, 0.5)
    one.claimant.claim_soon()
    said = one.say(0.6)
    assert ([each.job for each in said.entries], said.outcomes) == (["j"], ())
    one.disk.full = False
    one.executor.retry_writes()
    said = one.say(0.7)
    assert ([*said.entries], [each.outcome for each in said.outcomes]) == ([], ["finished"])
    one.hear(said, 0.8, "b")
    assert one.executor.has_pending_reports
    one.hear(said, 0.8, "c")
    assert not one.executor.has_pending_reports, "a majority has it on disk"


def test_what_is_finished_and_not_on_disk_is_still_held_without_a_grant_of_its_own():
    """Its own grants were not written either; else its peers would take the job for released."""
    one = One()
    held_with_leave(one)
    one.claimant.granter.register.grants.clear()
    one.disk.full = True
    one.executor.finish(9.0, 0.5)
    one.claimant.claim_soon()
    (entry,) = one.say(0.6).entries
    assert (entry.job, entry.places, entry.phase) == ("j", ("x",), "finishing")


def test_a_job_that_a_majority_denies_is_let_go_of():
    one = One()
    one.claimant.request(JOB, 0.0)
    said = one.say(0.0)
    for peer in ("b", "c"):
        denied = ClaimReply(peer, said.number, 3.0, (), (denial(said),))
        one.claimant.apply_reply(denied, 0.1)
    assert one.claimant.rejected == ["j"]
    assert not one.say(0.2).entries
    late = Award("x", "x", "a", "q", JOB)
    assert not one.executor.answer_award(late, 0.2).accepted


def denial(said: Claim) -> DeniedEntry:
    return DeniedEntry(said.entries[0].award, "'d' has 'j'")


def test_nobody_answers_and_the_wish_is_given_up():
    one = One()
    one.claimant.request(JOB, 0.0)
    one.say(0.0)
    assert one.say(0.6).entries, "said again to those who have not answered"
    assert not one.say(2.1).entries
