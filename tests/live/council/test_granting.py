"""Grants, claims and space, step by step; random faults are in `test_simulation`."""

import re
from contextlib import nullcontext

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol.auction import Award, JobSpec
from fleet.bus.protocol.consensus import (
    Claim,
    ClaimEntry,
    ClaimReply,
    DeniedEntry,
    GrantedEntry,
    History,
    JobOutcome,
)
from fleet.bus.protocol.messages import MOST_BYTES, encode
from fleet.errors import BusError, Refused
from fleet.job import reason_to_give_up
from fleet.live.arm.awards import ArmHistory, AwardExecutor
from fleet.live.book import JobBook
from fleet.live.consensus.grants import NUMBERS_PER_BOOT, Claimant, Granter
from fleet.live.epochs import check_journals
from fleet.live.leases import Timing, expire
from fleet.live.records import Granted
from tests.live.disk import Disk

TIMING = Timing(lease_s=3.0, margin_s=0.05)
ROSTER = ("a", "b", "c", "d")
JOB = JobSpec(name="j", kind="hold", places=("x",), repetitions=3)


@pytest.fixture
def disk():
    return Disk()


@pytest.fixture
def granter(disk):
    return Granter("d", ROSTER, JobBook(is_central=False), disk.keep, real_s=0.0, timing=TIMING)


def restarted(disk, real_s):
    return Granter("d", ROSTER, JobBook(is_central=False).replay(disk.records), disk.keep, real_s=real_s, timing=TIMING)


def entry(award="a-1:j", job="j", *, place="x", cycles=0, phase="requested"):
    return ClaimEntry(award, job, (place,), cycles, phase)


def claim(arm, number, *entries, settled=()):
    return Claim(arm, number, entries, tuple(settled))


def finished(job="j", arm="a", outcome="finished"):
    return JobOutcome(job, f"{arm}-1:{job}", arm, outcome, 3, 9.0)


def granted(grant: ClaimReply) -> list[str]:
    return [each.award for each in grant.granted]


def test_a_job_is_granted_to_one_arm_until_its_lease_ends(granter):
    assert granted(granter.answer_claim(claim("a", 1, entry()), 0.0)) == ["a-1:j"]
    other = entry("b-1:j")
    denied = granter.answer_claim(claim("b", 1, other), TIMING.counted_lease_s - 0.01)
    assert (granted(denied), denied.denied[0].reason) == ([], "'a' has 'j'")
    assert granted(granter.answer_claim(claim("b", 2, other), TIMING.counted_lease_s + 0.01)) == ["b-1:j"]
    assert granted(granter.answer_claim(claim("a", 2, entry()), TIMING.counted_lease_s + 0.02)) == []


def test_a_repeated_claim_renews_the_lease_and_writes_nothing(granter, disk):
    granter.answer_claim(claim("a", 0), 0.0)
    disk.records.clear()
    for number in range(1, 5):
        assert granted(granter.answer_claim(claim("a", number, entry()), 2.0 * number)) == ["a-1:j"]
        assert [type(record).__name__ for record in disk.records] == ["ClaimNumbered", "Granted"]


def test_the_first_claim_of_each_start_of_an_arm_is_recorded(granter, disk):
    for start in (1, 2):
        for number in range(1, 4):
            granter.answer_claim(claim("a", start * NUMBERS_PER_BOOT + number), 0.0)
    assert [record.number for record in disk.records] == [NUMBERS_PER_BOOT + 1, 2 * NUMBERS_PER_BOOT + 1]


def test_arms_and_leases_have_the_same_order_in_every_process(granter):
    granter.adopt([Granted(f"a-1:{job}", job, "a", places=(job,)) for job in "klmnopqrstuv"], 0.0)
    assert (list(granter.book.space), list(granter.book.leases)) == (list(ROSTER), list(granter.book.open))


def test_a_station_serves_one_job_at_a_time(granter):
    granter.answer_claim(claim("a", 1, entry()), 0.0)
    same = claim("b", 1, entry("b-1:k", "k"), entry("b-1:l", "l", place="y"))
    assert granted(granter.answer_claim(same, 1.0)) == ["b-1:l"]


def test_a_job_that_a_claim_does_not_list_is_released(granter):
    granter.answer_claim(claim("a", 1, entry()), 0.0)
    granter.answer_claim(claim("a", 2), 0.1)
    assert granted(granter.answer_claim(claim("b", 1, entry("b-1:j")), 0.2)) == ["b-1:j"]


def test_permission_to_commit_outlasts_the_lease_and_a_restart(granter, disk):
    answer = granter.answer_claim(claim("a", 1, entry(cycles=2, phase="finishing")), 0.0)
    assert answer.granted == (GrantedEntry("a-1:j", 2, may_commit=True),)
    for each in (granter, restarted(disk, 0.0)):
        assert granted(each.answer_claim(claim("b", each.book.numbers.get("b", 0) + 1, entry("b-1:j")), 1e6)) == []
    assert not granter.book.busy_stations(), "a silent arm does not block its station"


@pytest.mark.parametrize("outcome", ["finished", "unfinished"])
def test_a_settled_job_is_denied_with_its_outcome(granter, disk, outcome):
    granter.answer_claim(claim("a", 1, settled=[finished(outcome=outcome)]), 0.0)
    for each in (granter, restarted(disk, 0.0)):
        answer = each.answer_claim(claim("b", each.book.numbers.get("b", 0) + 1, entry("b-1:j")), 9.0)
        assert answer.denied[0].outcome == finished(outcome=outcome)


def test_a_returned_job_keeps_its_cycles(granter):
    granter.answer_claim(claim("a", 1, entry(cycles=1)), 0.0)
    granter.answer_claim(claim("a", 2, settled=[JobOutcome("j", "a-1:j", "a", "returned", 2, 9.0)]), 0.1)
    assert granter.answer_claim(claim("b", 1, entry("b-1:j")), 0.2).granted == (GrantedEntry("b-1:j", 2),)


def test_after_a_restart_every_grant_counts_as_leased_from_the_restart(granter, disk):
    granter.answer_claim(claim("a", 1, entry()), 0.0)
    again = restarted(disk, 100.0)
    assert granted(again.answer_claim(claim("b", 1, entry("b-1:j")), 100.0 + TIMING.counted_lease_s - 0.01)) == []
    assert granted(again.answer_claim(claim("b", 2, entry("b-1:j")), 100.0 + TIMING.counted_lease_s + 0.01)) == [
        "b-1:j"
    ]


@pytest.mark.parametrize("again", [False, True], ids=["", "after a restart"])
def test_an_old_claim_changes_nothing(granter, disk, again):
    granter.answer_claim(claim("a", 7, entry()), 0.0)
    one = restarted(disk, 0.0) if again else granter
    for old in (6, 7):
        with pytest.raises(Refused, match="Stale claim"):
            one.answer_claim(claim("a", old), 0.1)
    assert one.book.open


def test_an_arm_of_another_fleet_is_granted_nothing(granter):
    with pytest.raises(Refused, match=r"'z' is no arm of this fleet. Arms: a, b, c, d"):
        granter.answer_claim(claim("z", 1, entry()), 0.0)


def test_nothing_is_granted_without_space_on_the_disk(granter, disk):
    granter.answer_claim(claim("a", 0), 0.0)
    disk.full = True
    assert granter.answer_claim(claim("a", 1, entry()), 0.0).denied[0].reason == "no room"
    with pytest.raises(Refused, match="no room"):
        granter.answer_claim(claim("a", 2, settled=[finished()]), 0.0)
    assert not granter.book.jobs


def test_a_compacted_book_has_fewer_records(granter, disk):
    granter.add_jobs((JOB,))
    for number in range(9):
        granter.answer_claim(claim("a", number, entry(cycles=number)), 0.1 * number)
    granter.answer_claim(claim("b", 1, settled=[finished("k")]), 1.0)
    granter.answer_claim(claim("c", 4, entry("c-1:l", "l", place="y", phase="finishing")), 1.0)
    records = granter.book.compact()
    assert len(records) < len(disk.records)
    assert JobBook(is_central=False).replay(records).compact() == records


def attempt(granter: Granter, arm: str, number: int, faults: dict[str, str]) -> str:
    """An arm gets the job, faults, and names all faults that it knows then; return the state of the job."""
    award = f"{arm}-{number}"
    assert granted(granter.answer_claim(claim(arm, 2 * number, entry(award)), 0.0)) == [award]
    returned = JobOutcome("j", award, arm, "returned", 0, 1.0, "hot", faults | {award: arm})
    granter.answer_claim(claim(arm, 2 * number + 1, settled=[returned]), 0.0)
    return state(granter, 0.0)


def state(granter: Granter, real_s: float) -> str:
    expire(granter.book, real_s, 0.0)
    return granter.book.status_of(granter.book.jobs["j"]).state


@given(st.lists(st.sampled_from("abc"), min_size=1))
def test_an_arm_grants_a_job_until_arms_have_faulted_in_it_too_often(arms):
    disk, done = Disk(), list[str]()
    granter = restarted(disk, 0.0)
    for number, arm in enumerate(arms):
        done.append(arm)
        now = attempt(granter, arm, number, {})
        assert now == ("given_up" if reason_to_give_up(done) else "waiting")
        if now == "given_up":
            break
    for each in (granter, restarted(disk, 0.0), restarted(Disk([*granter.book.compact()]), 0.0)):
        assert state(each, 99.0) == ("given_up" if reason_to_give_up(done) else "waiting")
        reply = each.answer_claim(claim("a", 999, entry("a-999")), 99.0)
        if reason_to_give_up(done):
            assert not reply.granted
            assert reply.denied[0].outcome.outcome == "given_up"
            assert reply.denied[0].outcome.reason == reason_to_give_up(done)
        else:
            assert reply.granted[0].faults == {f"{arm}-{number}": arm for number, arm in enumerate(arms)}


def test_faults_known_to_different_arms_are_added_up(granter):
    assert attempt(granter, "a", 0, {}) == "waiting"
    assert attempt(granter, "b", 1, {"c-7": "c"}) == "given_up", "b has heard of a fault of c"


def test_a_job_that_an_arm_has_is_not_given_up_and_finishing_it_counts_more(granter):
    assert attempt(granter, "a", 0, {}) == "waiting"
    have = entry("b-1", phase="working")
    granter.answer_claim(claim("b", 1, have), 0.0)
    granter.add_faults("j", {"a-9": "a"})  # heard late
    assert granter.answer_claim(claim("b", 2, have), 0.1).granted
    assert state(granter, 0.1) == "awarded"
    granter.answer_claim(claim("b", 3), 0.2)  # b releases it
    assert state(granter, 0.2) == "given_up"
    granter.apply_outcome(JobOutcome("j", "b-1", "b", "finished", 9, 3.0))
    assert state(granter, 0.3) == "finished"
    granter.apply_outcome(JobOutcome("j", "b-1", "b", "given_up", 9, 3.0))
    assert state(granter, 0.3) == "finished"


# Claims


class One:
    """One arm that claims; the test sends the replies of its peers."""

    def __init__(self, roster=ROSTER, disk=None, grants=None):
        self.disk, self.grants = disk or Disk(), grants or Disk()
        history = ArmHistory().replay(self.disk.records).after_restart("a", 0.0)
        self.disk.records[:] = history.compact()
        self.executor = AwardExecutor("a", self.disk.keep, history, nonce="n")
        self.granter = Granter(
            "a",
            roster,
            JobBook(is_central=False).replay(self.grants.records),
            self.grants.keep,
            real_s=0.0,
            timing=TIMING,
        )
        self.claimant = Claimant(
            self.executor,
            self.granter,
            self.executor.answer_award,
            lambda job, plan: f"{job.name} {plan}",
            boot=history.boot,
            timing=TIMING,
        )

    def send_claim(self, real_s) -> Claim:
        claimed = self.claimant.claim(frozenset("bcd"), (), real_s)
        assert claimed is not None
        return claimed

    def receive(self, claimed: Claim, real_s: float, *peers: str, may_commit: bool = False) -> None:
        for peer in peers:
            grants = tuple(GrantedEntry(each.award, each.cycles, may_commit) for each in claimed.entries)
            self.claimant.apply_reply(ClaimReply(peer, claimed.number, TIMING.lease_s, grants), real_s)


def test_only_a_majority_of_the_roster_grants_a_job():
    one = One()
    one.claimant.request(JOB, 0, 0.0)
    claimed = one.send_claim(0.0)
    one.receive(claimed, 0.1, "b")
    assert not one.executor.active, "two of four are no majority"
    one.receive(claimed, 0.1, "b", "z")
    assert not one.executor.active, "nor with an arm of another fleet"
    one.receive(claimed, 0.1, "c")
    assert [active.award.job for active in one.executor.active] == [JOB]


def test_a_lease_counts_from_the_query_to_the_last_arm_of_a_majority():
    one = One()
    one.claimant.request(JOB, 0, 0.0)
    claimed = one.send_claim(0.0)
    one.receive(claimed, 0.9, "b", "c")
    assert one.executor.allowed_cycles(2.96) == 2
    assert one.executor.allowed_cycles(2.98) == 0
    one.claimant.claim_soon()
    later = one.send_claim(2.0)
    one.receive(later, 2.5, "b")
    assert one.executor.allowed_cycles(2.98) == 0, "two of four have renewed it: itself and b"
    one.receive(later, 2.9, "d")
    assert one.executor.allowed_cycles(4.96) == 2
    assert one.executor.allowed_cycles(4.98) == 0


def obtain_permission(one: One) -> None:
    one.claimant.request(JOB, 0, 0.0)
    one.receive(one.send_claim(0.0), 0.1, "b", "c")
    one.executor.record_progress(2, 0.0)
    one.claimant.claim_soon()
    claimed = one.send_claim(0.2)
    assert claimed.entries[0].phase == "finishing"
    one.receive(claimed, 0.3, "b", may_commit=True)
    assert not one.executor.active[0].may_commit
    one.receive(claimed, 0.3, "c", may_commit=True)
    assert one.executor.active[0].may_commit


def test_the_first_claim_after_a_crash_reports_an_unsure_job():
    """Else its peers would take the job as released, and do its last cycle again."""
    one = One()
    obtain_permission(one)
    again = One(disk=one.disk, grants=one.grants)
    claimed = again.send_claim(1.0)
    assert [(each.job, each.outcome) for each in claimed.outcomes] == [("j", "unfinished")]
    assert claimed.number > 1_000_000_000


def test_a_finished_job_is_claimed_until_its_report_is_on_disk_with_and_without_an_own_grant():
    one = One()
    obtain_permission(one)
    one.disk.full = True
    one.executor.finish(9.0, 0.5)
    one.claimant.claim_soon()
    claimed = one.send_claim(0.6)
    assert ([each.job for each in claimed.entries], claimed.outcomes) == (["j"], ())
    one.disk.full = False
    one.executor.retry_writes()
    claimed = one.send_claim(0.7)
    assert ([*claimed.entries], [each.outcome for each in claimed.outcomes]) == ([], ["finished"])
    one.receive(claimed, 0.8, "b")
    assert one.executor.has_pending_reports
    one.receive(claimed, 0.8, "c")
    assert not one.executor.has_pending_reports, "a majority has it on disk"
    # Its own grant was not written either; else its peers would take the job as released.
    one = One()
    obtain_permission(one)
    one.claimant.granter.book.jobs.clear()
    one.claimant.granter.book.open.clear()
    one.disk.full = True
    one.executor.finish(9.0, 0.5)
    one.claimant.claim_soon()
    (entry,) = one.send_claim(0.6).entries
    assert (entry.job, entry.places, entry.phase) == ("j", ("x",), "finishing")


def test_a_request_that_a_majority_denies_or_nobody_answers_is_withdrawn():
    one = One()
    one.claimant.request(JOB, 0, 0.0)
    claimed = one.send_claim(0.0)
    for peer in ("b", "c"):
        denied = ClaimReply(peer, claimed.number, 3.0, (), (denial(claimed),))
        one.claimant.apply_reply(denied, 0.1)
    assert one.claimant.rejected == ["j"]
    assert not one.send_claim(0.2).entries
    late = Award("x", "x", "a", "q", JOB)
    assert not one.executor.answer_award(late, 0.2).accepted
    one = One()
    one.claimant.request(JOB, 0, 0.0)
    one.send_claim(0.0)
    assert one.send_claim(0.6).entries, "repeated for peers that have not replied"
    assert not one.send_claim(2.1).entries


def denial(claimed: Claim) -> DeniedEntry:
    return DeniedEntry(claimed.entries[0].award, "'d' has 'j'")


def receive_faults(one: One, **faults: dict[str, str]) -> None:
    """Grant the request of an arm; each peer names the faults in the job that it knows."""
    claimed = one.send_claim(0.0)
    for peer, known in faults.items():
        grants = tuple(GrantedEntry(each.award, 0, faults=known) for each in claimed.entries)
        one.claimant.apply_reply(ClaimReply(peer, claimed.number, TIMING.lease_s, grants), 0.1)


def test_an_arm_that_faults_names_the_faults_that_its_granters_know():
    """Also after a restart; so every granter learns of all faults, and not each of its own only."""
    one = One()
    one.claimant.request(JOB, 0, 0.0)
    receive_faults(one, b={"b-1": "b"}, c={"c-1": "c"})
    (active,) = one.executor.active
    one.executor.return_all(1.0, 0.5, "hot", faulted=True)
    for each in (one, One(disk=one.disk, grants=one.grants)):
        (outcome,) = each.send_claim(0.6).outcomes
        assert outcome.faults == {"b-1": "b", "c-1": "c", active.award.award: "a"}
        assert each.granter.book.jobs["j"].state == "given_up"


def test_a_request_is_withdrawn_if_the_granters_together_know_too_many_faults():
    one = One()
    one.claimant.request(JOB, 0, 0.0)
    receive_faults(one, b={"b-1": "b"}, c={"b-2": "b"})
    assert not one.executor.active
    assert one.claimant.rejected == ["j"]
    assert not one.send_claim(0.2).entries
    assert one.granter.book.jobs["j"].state == "given_up"


THREE = ("a", "b", "c")
LATER_S = 1e6


def same_name(arm: str, space: str, other: str, other_space: str) -> bool:
    """Two plans exclude each other if their names begin with the same letter; an arm that may be anywhere, all."""
    return "*" in (space, other_space) or space[0] == other_space[0]


class Granting:
    """Arm `c`, its disk, and claims of its peers."""

    def __init__(self):
        self.records, self.number = [], 0
        self.start(0.0)
        for arm in THREE:
            self.claim(arm)

    def start(self, real_s: float) -> None:
        book = JobBook(is_central=False).replay(self.records)
        self.records[:] = book.compact()
        self.granter = Granter(
            "c",
            THREE,
            book,
            lambda *records: self.records.extend(records),
            real_s=real_s,
            timing=TIMING,
            excludes=same_name,
        )

    def claim(self, arm: str, *jobs: str, space=(), at_s: float = 0.0, phase="requested", outcomes=()) -> list[str]:
        """Claim jobs, each with a plan of its name; return the reasons for which they are denied."""
        self.number += 1
        entries = tuple(ClaimEntry(f"{arm}: {job}", job, (f"at {job}",), 0, phase, job) for job in jobs)
        claim = Claim(arm, self.number, entries, tuple(outcomes), space=space)
        return [denied.reason for denied in self.granter.answer_claim(claim, at_s).denied]


@pytest.fixture
def granting():
    return Granting()


def test_of_two_plans_that_exclude_each_other_one_is_granted(granting):
    assert granting.claim("a", "p1", "q1") == []
    assert granting.claim("b", "p2", "r1") == ["'a' is in the way"]
    assert granting.claim("a", "q1") == []
    assert granting.claim("b", "p2", "r1") == []


@pytest.mark.parametrize("restart", [False, True])
def test_space_stays_taken_after_the_lease_and_after_a_restart(granting, restart):
    assert granting.claim("a", "p1", phase="working") == []
    if restart:
        granting.start(LATER_S)
    assert granting.claim("b", "p2", at_s=LATER_S) == ["'a' is in the way"]
    assert granting.claim("a", space=("p1",), at_s=LATER_S) == []  # it is on its way home
    assert granting.claim("b", "p2", at_s=LATER_S) == ["'a' is in the way"]
    granting.claim("a", at_s=LATER_S)
    assert granting.claim("b", "p2", at_s=LATER_S) == []


def test_space_of_a_finished_job_stays_taken_until_the_arm_is_home(granting):
    granting.claim("a", "p1", phase="finishing")
    outcome = JobOutcome("p1", "a: p1", "a", "finished", 1, 9.0)
    granting.claim("a", space=("p1",), outcomes=[outcome])
    assert granting.claim("b", "p2") == ["'a' is in the way"]
    granting.claim("a")
    assert granting.claim("b", "p2") == []


def test_space_of_a_job_that_its_arm_still_claims_stays_taken_when_the_claim_is_denied(granting):
    """The claim may have been sent from home, and the arm may have left since, under the lease of a majority."""
    granting.claim("a", "p1", phase="working")
    granting.claim("b", outcomes=[JobOutcome("p1", "a: p1", "a", "finished", 1, 9.0)])
    assert granting.claim("a", "p1", phase="working") == ["'p1' is settled"]
    assert granting.claim("b", "p2") == ["'a' is in the way"]
    granting.claim("a")
    assert granting.claim("b", "p2") == []


def test_a_denied_request_takes_no_space(granting):
    granting.claim("a", "p1")
    assert granting.claim("b", "p2") == ["'a' is in the way"]
    assert granting.claim("a", "p3") == []


def test_an_arm_without_a_claim_or_that_does_not_say_where_it_is_may_be_anywhere():
    granting = Granting()
    granting.records.clear()
    granting.start(0.0)
    assert granting.claim("b", "p2") == ["'a' is in the way"]
    granting.claim("c")
    granting.claim("a", space=None)
    assert granting.claim("b", "p2") == ["'a' is in the way"]
    granting.claim("a")
    assert granting.claim("b", "p2") == []


@pytest.mark.parametrize(
    ("next_start", "epoch", "peer", "reason"),
    [
        (0, "", History("b"), ""),  # nobody has begun
        (0, "", History("b", "x", claims={"b": 1000000003}), ""),  # the arm is new in a fleet that has
        (2, "x", History("b", "x", claims={"a": 1000000003}), ""),  # it was restarted
        (0, "", History("b", "x", claims={"a": 1000000003}), "'b' knows claims of 'a' that its journals do not"),
        (2, "x", History("b", "x", claims={"a": 2000000001}), "'b' knows claims of 'a' that its journals do not"),
        (2, "y", History("b", "x"), "The journals of 'a' are of the epoch 'y', but 'b' knows the epoch 'x'"),
    ],
)
def test_an_arm_with_other_journals_than_its_peers_know_does_not_start(next_start, epoch, peer, reason):
    own = History("a", "z", claims={"a": 9000000000})  # its own reply says nothing
    with pytest.raises(BusError, match=re.escape(reason)) if reason else nullcontext():
        check_journals("a", next_start * NUMBERS_PER_BOOT, epoch, [own, peer])


def test_a_replay_gives_the_time_at_which_a_job_was_abandoned(disk, granter):
    """Its record names no time."""
    follower = JobSpec(name="k", kind="hold", places=("y",), after=("j",))
    granter.add_jobs([JOB, follower])
    granter.book.pass_time(100.0)
    granter.add_faults("j", {f"{arm}-1:j": arm for arm in ROSTER})
    assert granter.book.settled == [(100.0, "j"), (100.0, "k")]
    replayed = JobBook(is_central=False).replay(disk.records)
    assert (replayed.settled, replayed.digest) == (granter.book.settled, granter.book.digest)


def test_the_next_claims_contain_all_new_jobs_as_many_as_a_message_holds():
    one, names = One(), [f"job {number}" for number in range(200)]
    after = tuple(f"{number:0128d}" for number in range(20))
    for name in names:
        one.claimant.send_job(JobSpec(name=name, kind="hold", places=("x",), after=after))
    one.claimant.send_job(JobSpec(name="too large", kind="hold", places=("x",), after=30 * after))
    claims: list[Claim] = []
    while len(claims) < 50 and (each := one.claimant.claim(frozenset(), (), 0.0)) is not None:
        claims.append(each)
    assert [job.name for each in claims for job in each.jobs] == names
    assert all(len(encode(each)) <= MOST_BYTES for each in claims)
    assert len(claims) < 15
