"""What an arm grants its peers, and what they make of it, one step at a time; storms are in `test_council_storm`."""

import pytest

from fleet.bus.council import Claim, Denied, Grant, Granted, Settled, Stake
from fleet.bus.trade import Award, JobWord
from fleet.errors import JournalFull
from fleet.live import promises
from fleet.live.auctioneer import Objection
from fleet.live.claiming import Claimant
from fleet.live.contractor import Contractor
from fleet.live.granting import Grantor, Register, recalled, retold
from fleet.live.timing import Timing

TIMING = Timing(lease_s=3.0, margin_s=0.05)
ROSTER = ("a", "b", "c", "d")
JOB = JobWord(name="j", kind="hold", places=("x",), repetitions=3)


class Disk:
    """A journal in memory."""

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
def grantor(disk):
    return Grantor("d", ROSTER, Register(), disk.keep, real_s=0.0, timing=TIMING)


def reborn(disk, real_s):
    return Grantor("d", ROSTER, recalled(disk.records), disk.keep, real_s=real_s, timing=TIMING)


def stake(award="a-1:j", job="j", *, place="x", cycles=0, phase="wanted"):
    return Stake(award, job, (place,), cycles, phase)


def claim(arm, number, *stakes, settled=()):
    return Claim(arm, number, stakes, tuple(settled))


def finished(job="j", arm="a", outcome="finished"):
    return Settled(job, f"{arm}-1:{job}", arm, outcome, 3, 9.0)


def granted(grant: Grant) -> list[str]:
    return [each.award for each in grant.granted]


def test_a_job_is_one_arms_until_its_lease_is_over(grantor):
    assert granted(grantor.asked(claim("a", 1, stake()), 0.0)) == ["a-1:j"]
    other = stake("b-1:j")
    denied = grantor.asked(claim("b", 1, other), TIMING.hold_s - 0.01)
    assert (granted(denied), denied.denied[0].reason) == ([], "'a' has 'j'")
    assert granted(grantor.asked(claim("b", 2, other), TIMING.hold_s + 0.01)) == ["b-1:j"]
    assert granted(grantor.asked(claim("a", 2, stake()), TIMING.hold_s + 0.02)) == []


def test_the_same_claim_again_renews_and_writes_nothing(grantor, disk):
    for number in range(5):
        assert granted(grantor.asked(claim("a", number, stake()), 2.0 * number)) == ["a-1:j"]
    assert len(disk.records) == 1


def test_a_station_serves_one_job_at_a_time(grantor):
    grantor.asked(claim("a", 1, stake()), 0.0)
    same = claim("b", 1, stake("b-1:k", "k"), stake("b-1:l", "l", place="y"))
    assert granted(grantor.asked(same, 1.0)) == ["b-1:l"]


def test_what_is_no_more_in_a_claim_is_let_go(grantor):
    grantor.asked(claim("a", 1, stake()), 0.0)
    grantor.asked(claim("a", 2), 0.1)
    assert granted(grantor.asked(claim("b", 1, stake("b-1:j")), 0.2)) == ["b-1:j"]


def test_leave_outlives_the_lease_and_a_restart(grantor, disk):
    answer = grantor.asked(claim("a", 1, stake(cycles=2, phase="finishing")), 0.0)
    assert answer.granted == (Granted("a-1:j", 2, leave=True),)
    for each in (grantor, reborn(disk, 0.0)):
        assert granted(each.asked(claim("b", each.register.numbers.get("b", 0) + 1, stake("b-1:j")), 1e6)) == []
    assert not grantor.taken(1e6), "one that went silent does not bar its station"


@pytest.mark.parametrize("outcome", ["finished", "unfinished"])
def test_what_is_settled_is_nobodys_and_whoever_asks_is_told(grantor, disk, outcome):
    grantor.asked(claim("a", 1, settled=[finished(outcome=outcome)]), 0.0)
    for each in (grantor, reborn(disk, 0.0)):
        answer = each.asked(claim("b", each.register.numbers.get("b", 0) + 1, stake("b-1:j")), 9.0)
        assert answer.denied[0].settled == finished(outcome=outcome)


def test_a_job_that_is_given_back_keeps_its_cycles(grantor):
    grantor.asked(claim("a", 1, stake(cycles=1)), 0.0)
    grantor.asked(claim("a", 2, settled=[Settled("j", "a-1:j", "a", "returned", 2, 9.0)]), 0.1)
    assert grantor.asked(claim("b", 1, stake("b-1:j")), 0.2).granted == (Granted("b-1:j", 2),)


def test_after_a_restart_every_grant_counts_as_leased_from_then(grantor, disk):
    grantor.asked(claim("a", 1, stake()), 0.0)
    again = reborn(disk, 100.0)
    assert granted(again.asked(claim("b", 1, stake("b-1:j")), 100.0 + TIMING.hold_s - 0.01)) == []
    assert granted(again.asked(claim("b", 2, stake("b-1:j")), 100.0 + TIMING.hold_s + 0.01)) == ["b-1:j"]


@pytest.mark.parametrize("again", [False, True], ids=["", "after a restart"])
def test_a_claim_of_before_changes_nothing(grantor, disk, again):
    grantor.asked(claim("a", 7, stake()), 0.0)
    one = reborn(disk, 0.0) if again else grantor
    for old in (6, 7):
        with pytest.raises(Objection, match="comes after"):
            one.asked(claim("a", old), 0.1)
    assert one.bars("j", 0.2)


def test_a_stranger_is_granted_nothing(grantor):
    with pytest.raises(Objection, match=r"'z' is no arm of this fleet. Arms: a, b, c, d"):
        grantor.asked(claim("z", 1, stake()), 0.0)


def test_what_cannot_be_written_down_is_not_granted(grantor, disk):
    disk.full = True
    assert grantor.asked(claim("a", 1, stake()), 0.0).denied[0].reason == "no room"
    with pytest.raises(Objection, match="no room"):
        grantor.asked(claim("a", 2, settled=[finished()]), 0.0)
    assert not grantor.register.settled


def test_a_register_is_told_again_in_few_words(grantor, disk):
    grantor.admit((JOB,))
    for number in range(9):
        grantor.asked(claim("a", number, stake(cycles=number)), 0.1 * number)
    grantor.asked(claim("b", 1, settled=[finished("k")]), 1.0)
    grantor.asked(claim("c", 4, stake("c-1:l", "l", place="y", phase="finishing")), 1.0)
    told = retold(grantor.register)
    assert len(told) < len(disk.records)
    assert retold(recalled(told)) == told
    assert recalled(told).settled == grantor.register.settled
    assert recalled(told).numbers == grantor.register.numbers


# The one who claims


class One:
    """One arm that claims, with a contractor and a grantor of its own; its peers are played by the test."""

    def __init__(self, roster=ROSTER, disk=None, grants=None):
        self.disk, self.grants = disk or Disk(), grants or Disk()
        memory = promises.restarted(promises.recall(self.disk.records), "a", 0.0)
        self.disk.records[:] = promises.retold(memory)
        self.contractor = Contractor("a", self.disk.keep, memory, nonce="n")
        self.grantor = Grantor("a", roster, recalled(self.grants.records), self.grants.keep, real_s=0.0, timing=TIMING)
        self.claimant = Claimant(
            self.contractor, self.grantor, self.contractor.awarded, life=memory.boot, timing=TIMING
        )

    def say(self, real_s) -> Claim:
        said = self.claimant.claim(frozenset("bcd"), real_s)
        assert said is not None
        return said

    def hear(self, said: Claim, real_s: float, *peers: str, leave: bool = False) -> None:
        for peer in peers:
            gifts = tuple(Granted(each.award, each.cycles, leave) for each in said.stakes)
            self.claimant.answered(Grant(peer, said.number, TIMING.lease_s, gifts), real_s)


def test_only_a_majority_of_the_roster_gives_a_job():
    one = One()
    one.claimant.want(JOB, 0.0)
    said = one.say(0.0)
    one.hear(said, 0.1, "b")
    assert not one.contractor.held, "two of four are no majority"
    one.hear(said, 0.1, "b", "z")
    assert not one.contractor.held, "nor with one who is not of the fleet"
    one.hear(said, 0.1, "c")
    assert [held.award.job for held in one.contractor.held] == [JOB]


def test_a_lease_is_counted_from_when_the_last_of_a_majority_was_asked():
    one = One()
    one.claimant.want(JOB, 0.0)
    said = one.say(0.0)
    one.hear(said, 0.9, "b", "c")
    assert one.contractor.may(2.96) == 2
    assert one.contractor.may(2.98) == 0
    one.claimant.hurry()
    later = one.say(2.0)
    one.hear(later, 2.5, "b")
    assert one.contractor.may(2.98) == 0, "two of four have renewed it: itself and b"
    one.hear(later, 2.9, "d")
    assert one.contractor.may(4.96) == 2
    assert one.contractor.may(4.98) == 0


def held_with_leave(one: One) -> None:
    one.claimant.want(JOB, 0.0)
    one.hear(one.say(0.0), 0.1, "b", "c")
    one.contractor.worked(2, 0.0)
    one.claimant.hurry()
    said = one.say(0.2)
    assert said.stakes[0].phase == "finishing"
    one.hear(said, 0.3, "b", leave=True)
    assert not one.contractor.held[0].leave
    one.hear(said, 0.3, "c", leave=True)
    assert one.contractor.held[0].leave


def test_the_first_claim_after_a_crash_says_what_nobody_knows():
    """Without it, its peers would take the job for let go of, and do its last cycle again."""
    one = One()
    held_with_leave(one)
    again = One(disk=one.disk, grants=one.grants)
    said = again.say(1.0)
    assert [(each.job, each.outcome) for each in said.settled] == [("j", "unfinished")]
    assert said.number > 1_000_000_000


def test_what_is_finished_and_not_on_disk_is_still_held():
    one = One()
    held_with_leave(one)
    one.disk.full = True
    one.contractor.finished(9.0, 0.5)
    one.claimant.hurry()
    said = one.say(0.6)
    assert ([each.job for each in said.stakes], said.settled) == (["j"], ())
    one.disk.full = False
    one.contractor.catch_up()
    said = one.say(0.7)
    assert ([*said.stakes], [each.outcome for each in said.settled]) == ([], ["finished"])
    one.hear(said, 0.8, "b")
    assert one.contractor.owes
    one.hear(said, 0.8, "c")
    assert not one.contractor.owes, "a majority has it on disk"


def test_a_job_that_a_majority_denies_is_let_go_of():
    one = One()
    one.claimant.want(JOB, 0.0)
    said = one.say(0.0)
    for peer in ("b", "c"):
        denied = Grant(peer, said.number, 3.0, (), (denial(said),))
        one.claimant.answered(denied, 0.1)
    assert one.claimant.vain == ["j"]
    assert not one.say(0.2).stakes
    late = Award("x", "x", "a", "q", JOB)
    assert not one.contractor.awarded(late, 0.2).accepted


def denial(said: Claim) -> Denied:
    return Denied(said.stakes[0].award, "'d' has 'j'")


def test_nobody_answers_and_the_wish_is_given_up():
    one = One()
    one.claimant.want(JOB, 0.0)
    one.say(0.0)
    assert one.say(0.6).stakes, "said again to those who have not answered"
    assert not one.say(2.1).stakes
