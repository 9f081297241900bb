"""A job in which arms fault too often is given up: by an auctioneer, and by arms that allocate without one."""

import sys

from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol.auction import JobSpec
from fleet.bus.protocol.consensus import Claim, ClaimEntry, JobOutcome
from fleet.job import reason_to_give_up
from fleet.live.book import JobBook
from fleet.live.consensus.grants import Granter
from fleet.live.journal import JobsAccepted
from fleet.live.leases import expire
from fleet.live.records import BookRecord, Granted
from tests.live.records import awarded, closed

JOB = JobSpec(name="j", kind="hold", places=("x",), repetitions=9)
NEXT = JobSpec(name="k", kind="hold", places=("x",), after=("j",))
LOST = "Given up, because it waits for 'j', which is given up or cancelled."
ROSTER = ("a", "b", "c", "d")
attempts = st.lists(st.tuples(st.sampled_from("abcd"), st.sampled_from(["faulted", "returned", "refused", "dropped"])))


def too_often(arms: list[str]) -> bool:
    """The rule, counted in another way: an arm occurs twice, or there are three."""
    return len(arms) > len(set(arms)) or len(arms) > 2


@given(st.lists(st.sampled_from("abcd")))
def test_two_faults_of_one_arm_or_three_of_all_are_too_many(arms):
    reason = reason_to_give_up(arms)
    assert bool(reason) == too_often(arms)
    assert all(f"'{arm}' {arms.count(arm)} time" in reason for arm in arms) or not reason


def award(number: int, arm: str) -> Granted:
    return awarded(f"w{number}", "j", arm, place="x", time_s=float(number))


def end(number: int, arm: str, outcome: str, time_s: float, cycles: int = 0, *, faulted: bool = False) -> BookRecord:
    return closed(f"w{number}", outcome, cycles, time_s, "hot", job="j", arm=arm, faulted=faulted)


@given(attempts)
def test_the_auctioneer_gives_a_job_up_at_that_fault_and_no_other_event(attempts):
    """Against a list of faults; a replay of the journal, and of its snapshot, gives the same."""
    written: list[BookRecord] = [JobsAccepted((JOB, NEXT), "test", 0.0)]
    book, faults = JobBook().replay(written), list[str]()
    for number, (arm, end) in enumerate(attempts, start=1):
        if too_often(faults):
            break
        assert [job.name for job in book.ready(99.0, 9)] == ["j"]
        outcome = "returned" if end == "faulted" else end
        records = [
            award(number, arm),
            closed(f"w{number}", outcome, 1, float(number), "hot", job="j", arm=arm, faulted=end == "faulted"),
        ]
        written += records
        for record in records:
            book.apply(record)
        faults += [arm] if end == "faulted" else []
    for ledger in (book, JobBook().replay(written), JobBook().replay(book.compact())):
        (status,) = ledger.status(["j"])
        assert status.state == ("given_up" if too_often(faults) else "waiting")
        if too_often(faults):
            assert status.reason == reason_to_give_up(faults)
            assert (status.arm, status.award) == (attempts[len(written) // 2 - 1][0], "")
            assert not ledger.unsettled()
            (successor,) = ledger.status(["k"])
            assert (successor.state, successor.reason) == ("given_up", LOST)


def test_faults_of_lost_arms_count_when_they_are_reported_late():
    book = JobBook().replay([JobsAccepted((JOB,), "test", 0.0)])
    for number in (1, 2):
        book.apply(award(number, "a"))
        book.apply(end(number, "a", "dropped", float(number)))
    book.apply(end(1, "a", "returned", 3.0, faulted=True))
    assert book.status()[0].state == "waiting"
    (change,) = book.apply(end(2, "a", "returned", 4.0, faulted=True))
    assert change.status.state == "given_up"
    (change,) = book.apply(end(2, "a", "finished", 5.0, 9))
    assert change.status.state == "finished", "it was done after all"


def test_jobs_that_wait_for_a_job_that_is_given_up_are_given_up_until_that_one_is_finished():
    last = JobSpec(name="a", kind="hold", places=("x",), after=("k",))  # sorted before the others
    book = JobBook().replay([JobsAccepted((JOB, NEXT), "test", 0.0)])
    for number in (1, 2):
        book.apply(award(number, "a"))
        changes = book.apply(end(number, "a", "returned", float(number), faulted=True))
    assert [(change.status.job, change.status.state) for change in changes] == [("j", "given_up"), ("k", "given_up")]
    (admission,) = book.admit((last,))
    assert (admission.accepted, admission.reason) == (True, LOST.replace("'j'", "'k'"))
    (change,) = book.apply(JobsAccepted((last,), "test", 3.0))
    assert (change.status.state, change.status.reason) == ("given_up", admission.reason)
    for ledger in (book, JobBook().replay(book.compact())):
        assert not ledger.unsettled()
        changes = ledger.apply(end(2, "a", "finished", 5.0, 9))
        assert {change.status.job: change.status.state for change in changes} == {
            "j": "finished",
            "k": "waiting",
            "a": "waiting",
        }
        assert [job.name for job in ledger.ready(9.0, 9)] == ["k"]


# without an auctioneer


def granter_of(disk: list[BookRecord]) -> Granter:
    book = JobBook(is_central=False).replay(disk)
    return Granter("d", ROSTER, book, lambda *records: disk.extend(records), real_s=0.0)


def attempt(granter: Granter, arm: str, number: int, faults: dict[str, str]) -> str:
    """An arm gets the job, faults, and names all faults that it knows then; return the state of the job."""
    award = f"{arm}-{number}"
    asked = granter.answer_claim(Claim(arm, 2 * number, (ClaimEntry(award, "j", ("x",), 0, "requested"),)), 0.0)
    assert [each.award for each in asked.granted] == [award]
    returned = JobOutcome("j", award, arm, "returned", 0, 1.0, "hot", faults | {award: arm})
    granter.answer_claim(Claim(arm, 2 * number + 1, (), (returned,)), 0.0)
    return state(granter, 0.0)


def state(granter: Granter, real_s: float) -> str:
    expire(granter.book, real_s, 0.0)
    return granter.book.status_of(granter.book.jobs["j"]).state


@given(st.lists(st.sampled_from("abc"), min_size=1))
def test_an_arm_grants_a_job_until_arms_have_faulted_in_it_too_often(arms):
    disk: list[BookRecord] = []
    granter, done = granter_of(disk), list[str]()
    for number, arm in enumerate(arms):
        done.append(arm)
        now = attempt(granter, arm, number, {})
        assert now == ("given_up" if too_often(done) else "waiting")
        if now == "given_up":
            break
    for each in (granter, granter_of(disk), granter_of(list(granter.book.compact()))):
        assert state(each, 99.0) == ("given_up" if too_often(done) else "waiting")
        reply = each.answer_claim(Claim("a", 999, (ClaimEntry("a-999", "j", ("x",), 0, "requested"),)), 99.0)
        if too_often(done):
            assert not reply.granted
            assert reply.denied[0].outcome.outcome == "given_up"
            assert reply.denied[0].outcome.reason == reason_to_give_up(done)
        else:
            assert reply.granted[0].faults == {f"{arm}-{number}": arm for number, arm in enumerate(arms)}


def test_faults_known_to_different_arms_are_added_up():
    granter = granter_of([])
    assert attempt(granter, "a", 0, {}) == "waiting"
    assert attempt(granter, "b", 1, {"c-7": "c"}) == "given_up", "b has heard of a fault of c"


def test_a_job_that_an_arm_has_is_not_given_up_and_finishing_it_counts_more():
    granter = granter_of([])
    assert attempt(granter, "a", 0, {}) == "waiting"
    have = ClaimEntry("b-1", "j", ("x",), 0, "working")
    granter.answer_claim(Claim("b", 1, (have,)), 0.0)
    granter.add_faults("j", {"a-9": "a"})  # heard late
    assert granter.answer_claim(Claim("b", 2, (have,)), 0.1).granted
    assert state(granter, 0.1) == "awarded"
    granter.answer_claim(Claim("b", 3, ()), 0.2)  # b releases it
    assert state(granter, 0.2) == "given_up"
    granter.apply_outcome(JobOutcome("j", "b-1", "b", "finished", 9, 3.0))
    assert state(granter, 0.3) == "finished"
    granter.apply_outcome(JobOutcome("j", "b-1", "b", "given_up", 9, 3.0))
    assert state(granter, 0.3) == "finished"


def test_the_work_for_jobs_that_expire_together_grows_with_their_number(monkeypatch):
    """So does that for the jobs that wait for them."""
    monkeypatch.setattr("fleet.live.book.MAX_SETTLED", 200)

    def calls(count: int) -> int:
        late = [JobSpec(f"j{number}", "hold", ("x",), due_s=1.0, expires=True) for number in range(count)]
        after = [JobSpec(f"after {job.name}", "hold", ("x",), after=(job.name,)) for job in late]
        book, calls = JobBook().replay([JobsAccepted((*late, *after), "test", 0.0)]), 0

        def count_call(*_: object) -> None:
            nonlocal calls
            calls += 1

        sys.setprofile(count_call)
        try:
            book.replay(book.expired(2.0))
        finally:
            sys.setprofile(None)
        assert (len(book.jobs), book.unsettled(), book.left["given_up"]) == (200, [], 2 * count - 200)
        return calls

    assert calls(600) < 3 * calls(300)
