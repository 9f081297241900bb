"""Which jobs are accepted, ready and given up, and that a replay of the journal gives the same ledger."""

import graphlib
import sys
import time
from collections.abc import Mapping

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol.auction import MOST_JOBS, Award, JobSpec, Quote, Submission
from fleet.bus.protocol.consensus import History, JobOutcome
from fleet.bus.protocol.messages import MOST_BYTES, MalformedMessage, decode, encode
from fleet.bus.protocol.operator import Cancel, ClearRequest, ControlRequest, Operation, Settle
from fleet.job import reason_to_give_up
from fleet.live.auction.auctioneer import Auctioneer
from fleet.live.auction.rounds import Round, closed_space, stated_spaces
from fleet.live.book import JobBook
from fleet.live.epochs import adopted
from fleet.live.job_rules import PastJobs, admit
from fleet.live.journal import ClockTick, CommitPermitted, JobsAccepted, Released, SpaceTaken
from fleet.live.records import BookRecord, ContactLost, ContactRegained, Granted, JobSettled, Requested, ShiftEnded
from tests.live.records import awarded, closed
from tests.profiles import examples


def spec(name: str, *after: str, place: str = "rack", **changes) -> JobSpec:
    return JobSpec(name=name, kind="hold", places=(place,), after=after, **{"repetitions": 4, **changes})


def ledger(*jobs: JobSpec) -> JobBook:
    return JobBook().replay([JobsAccepted(jobs, "test", 0.0)])


def award(job: str, number: int = 0, arm: str = "arm_0", cycles: int = 0, *, place: str = "rack") -> Granted:
    more = {"auction": f"round {number}", "quote": "quote", "difficulty": 0.5, "p_saturation": 0.1}
    return awarded(f"{number}:{job}", job, arm, cycles, place=place, **more)


def names(jobs) -> list[str]:
    return [job.name for job in jobs]


# admission


def test_an_identical_job_is_accepted_again_another_is_not_and_their_number_is_limited():
    known = {"a": spec("a")}
    same, other, twice, third = admit([spec("a"), spec("a", value=2.0), spec("b"), spec("b", value=9.0)], known)
    assert same.accepted
    assert twice.accepted
    assert not other.accepted
    assert not third.accepted
    assert other.reason == "Another job has the name 'a'; names must be unique."
    admissions = admit([spec("b"), spec("c"), spec("a")], {"a": spec("a")}, limit=2)
    assert [a.accepted for a in admissions] == [True, False, True]
    assert admissions[1].reason == "There are 2 open jobs already; submit it again when some are finished."


def test_a_submission_may_name_predecessors_in_any_order_but_those_that_can_never_begin():
    assert all(a.accepted for a in admit([spec("c", "b"), spec("b", "a"), spec("a")], {}))
    jobs = [spec("a", "unknown"), spec("b", "a"), spec("c", "d"), spec("d", "c"), spec("e", "e"), spec("f")]
    a, b, c, d, e, f = admit(jobs, {})
    assert a.reason == "It waits for 'unknown', which is unknown or was not accepted."
    assert b.reason == "It waits for 'a', which is not accepted either."
    assert c.reason == "Jobs wait for each other in a ring: c → d → c."
    assert d.reason == "Jobs wait for each other in a ring: d → c → d."
    assert e.reason == "Jobs wait for each other in a ring: e → e."
    assert f.accepted
    first, second = admit([spec("a", place="moon"), spec("b", "a")], {}, places=frozenset({"rack", "bin"}))
    assert first.reason == "No place 'moon' in this cell. Places: bin, rack."
    assert second.reason == "It waits for 'a', which is unknown or was not accepted."


@examples(200)
@given(st.dictionaries(st.sampled_from("abcdef"), st.sets(st.sampled_from("abcdefg"), max_size=2), min_size=1))
def test_accepted_jobs_can_be_ordered_and_rejected_ones_cannot(graph):
    """Against the standard library's topological sorter."""
    admissions = admit([spec(name, *sorted(after)) for name, after in graph.items()], {})
    accepted = {a.job for a in admissions if a.accepted}
    order = tuple(graphlib.TopologicalSorter({name: graph[name] for name in accepted}).static_order())
    assert set(order) == accepted
    for rejected in set(graph) - accepted:  # none could be added alone
        assert not graph[rejected] <= accepted


# readiness


def test_a_ready_job_is_released_and_after_its_predecessors_and_a_free_station_counts_if_not_all_fit():
    book = ledger(
        spec("late", release_s=9.0, place="a"),
        spec("first", place="b"),
        spec("next", "first", place="c"),
        spec("also at b", place="b"),
    )
    assert names(book.ready(0.0, 9)) == ["also at b", "first"]
    book.apply(award("first", place="b"))
    assert names(book.ready(9.0, 9)) == ["also at b", "late"]
    assert names(book.ready(9.0, 1)) == ["late"]
    book.apply(closed("0:first", "finished", 4, 5.0))
    assert names(book.ready(9.0, 9)) == ["also at b", "next", "late"]
    assert names(book.ready(9.0, 1)) == ["also at b"]


def test_the_oldest_jobs_are_offered_first_and_a_returned_one_counts_from_its_return():
    book = ledger(spec("b", release_s=1.0, place="x"), spec("a", release_s=2.0), spec("c", place="y"))
    assert names(book.ready(5.0, 2)) == ["c", "b"]
    book.apply(award("c"))
    book.apply(closed("0:c", "returned", 1, 5.0, "too hot"))
    assert names(book.ready(5.0, 3)) == ["b", "a", "c"]


# states of a job


def test_a_job_goes_from_waiting_to_finished():
    book = ledger(spec("a"))
    changes = [
        change.status
        for record in (award("a"), CommitPermitted("0:a", 2.0), closed("0:a", "finished", 4, 3.0))
        for change in book.apply(record)
    ]
    assert [s.state for s in changes] == ["awarded", "finishing", "finished"]
    assert (changes[-1].arm, changes[-1].finished_s, changes[-1].cycles) == ("arm_0", 3.0, 4)
    assert not book.open
    assert book.unsettled() == []


def test_cycles_done_are_kept_but_the_last_one_is_never_assumed():
    book = ledger(spec("a"))
    book.apply(award("a"))
    book.apply(closed("0:a", "returned", 99, 3.0))
    assert book.status(["a"])[0].cycles == 3
    book.apply(award("a", 1, cycles=3))
    book.apply(closed("1:a", "dropped", 0, 4.0))
    assert book.status(["a"])[0].cycles == 3


def test_a_job_is_unfinished_while_its_arm_is_silent_after_permission_to_commit():
    book = ledger(spec("a"))
    for record in (award("a"), CommitPermitted("0:a", 2.0), ContactLost("0:a", 8.0)):
        book.apply(record)
    (status,) = book.status()
    assert (status.state, status.arm) == ("unfinished", "arm_0")
    assert "0:a" in book.open
    assert book.ready(99.0, 9) == []
    assert book.busy_stations() == frozenset()
    book.apply(ContactRegained("0:a", 9.0))
    assert book.status()[0].state == "finishing"
    book.apply(closed("0:a", "finished", 4, 9.5))
    assert book.status()[0].state == "finished"


def test_a_job_with_an_unsure_last_cycle_is_unfinished_for_good():
    book = ledger(spec("a"))
    for record in (award("a"), CommitPermitted("0:a", 2.0), closed("0:a", "returned", 3, 8.0, "crashed", unsure=True)):
        book.apply(record)
    assert book.status()[0].state == "unfinished"
    assert book.ready(99.0, 9) == []


def test_a_late_report_of_a_finished_job_closes_a_newer_award():
    book = ledger(spec("a"))
    for record in (award("a"), closed("0:a", "dropped", 1, 5.0), award("a", 1, "arm_1", 1)):
        book.apply(record)
    book.apply(closed("0:a", "finished", 4, 6.0))
    assert (book.status()[0].state, book.status()[0].arm) == ("finished", "arm_0")
    assert not book.open
    assert book.grant_of("1:a") is None
    assert book.status()[0].finished_s == 6.0


@pytest.mark.parametrize("permitted", [False, True])
def test_a_job_that_an_arm_finished_without_permission_here_is_one_that_an_older_copy_has_as_awarded(permitted):
    """To any arm. With permission, the report of the arm may be on its way."""
    book = ledger(spec("a"))
    book.apply(award("a", arm="arm_1"))
    if permitted:
        book.apply(CommitPermitted("0:a", 2.0))
    book.replay(adopted(book, History("arm_0", "", (spec("a"),))))
    (status,) = book.status()
    assert (status.state, status.arm) == (("finishing", "arm_1") if permitted else ("finished", "arm_0"))
    assert bool(book.open) == permitted


@pytest.mark.parametrize("unsure_first", [False, True])
@pytest.mark.parametrize("is_known", [False, True])
def test_an_older_copy_adopts_a_finished_job_that_another_arm_is_unsure_of(unsure_first, is_known):
    """A person had it redone, which the copy lacks."""
    book = JobBook(name="boss").replay([JobsAccepted((spec("a"),), "test", 0.0)] if is_known else [])
    unsure = History("arm_0", "", committed=(JobOutcome("a", "0:a", "arm_0", "unfinished", 3, 1.0),))
    finished = History("arm_1", "", (spec("a"),))
    histories = (unsure, finished) if unsure_first else (finished, unsure)
    for history in histories:
        book.replay(adopted(book, history))
    (status,) = book.status()
    assert (status.state, status.arm, status.cycles) == ("finished", "arm_1", 4)
    assert [adopted(book, history) for history in histories] == [[], []]


def test_a_job_that_its_silent_arm_may_still_finish_stays_unfinished():
    book = ledger(spec("a"))
    for record in (award("a"), CommitPermitted("0:a", 2.0), ContactLost("0:a", 8.0)):
        book.apply(record)
    assert adopted(book, History("arm_1", "", (spec("a"),))) == []


@pytest.mark.parametrize(
    ("number", "arm", "permitted", "state", "has"),
    [
        (0, "arm_1", False, "awarded", "arm_1"),
        (0, "arm_1", True, "finishing", "arm_1"),
        (1, "arm_0", False, "awarded", "arm_1"),  # it goes back: its lease is not renewed
        (1, "arm_0", True, "finishing", "arm_0"),
    ],
)
def test_a_permission_to_commit_that_an_older_copy_lacks_is_adopted(number, arm, permitted, state, has):
    """Of the award that the copy has, or of a later one to another arm."""
    book = ledger(spec("a"))
    book.name = "boss"
    book.apply(award("a", arm="arm_1"))
    held = Award(f"{number}:a", "r", "boss", "q", spec("a"), cycles=2)
    history = History(arm, "", awards=(held,), may_commit=(held.award,) if permitted else ())
    for _ in range(2):
        book.replay(adopted(book, history))
        (status,) = book.status()
        assert (status.state, status.arm, len(book.open)) == (state, has, 1)
    assert adopted(book, history) == []


@pytest.mark.parametrize(("arm", "job"), [("arm_0", "a"), ("arm_1", "b")])
def test_only_the_arm_of_an_award_has_permission_to_commit_its_job(arm, job):
    book = ledger(spec("a"), spec("b"))
    book.name = "boss"
    book.apply(award("a", arm="arm_1"))
    held = Award("0:a", "r", "boss", "q", spec(job), cycles=2)
    assert adopted(book, History(arm, "", awards=(held,), may_commit=(held.award,))) == []


@pytest.mark.parametrize(
    ("number", "arm", "state"),
    [(0, "arm_1", "finishing"), (1, "arm_2", "finishing"), (1, "arm_0", "unfinished")],
)
def test_an_older_copy_without_an_auctioneer_learns_of_permission_to_commit(number, arm, state):
    """That a peer has given, for the grant that the copy has, for a later one, or to the arm of the copy itself."""
    book = JobBook(name="arm_0", is_central=False).replay([JobsAccepted((spec("a"),), "test", 0.0)])
    book.apply(award("a", arm="arm_1"))
    outcome = JobOutcome("a", f"{number}:a", arm, "unfinished", 2, 0.0, "The journals of its arm were lost.")
    history = History("arm_3", "", claims={arm: 5}, committed=(outcome,))
    book.replay(adopted(book, history))
    (status,), grant = book.status(), book.jobs["a"].grant
    assert (status.state, status.arm, status.cycles) == (state, arm, 2)
    assert (grant is not None and grant.may_commit) == (state == "finishing") == bool(book.open)
    assert book.numbers == ({arm: 5} if state == "finishing" else {})
    assert adopted(book, history) == []


def test_permission_to_commit_that_has_ended_here_is_not_adopted_from_a_peer():
    """By the report of the arm, or by a person who has its job redone; an ended lease is no such end."""
    history = History("arm_3", committed=(JobOutcome("a", "0:a", "arm_1", "unfinished", 2, 0.0),))
    granted = [JobsAccepted((spec("a"),), "test", 0.0), award("a", arm="arm_1")]
    redo = Operation("arm_2", 5.0, ControlRequest("redo", Settle("a", "redo"), "ann"), awards=("0:a",))
    lease_ended, returned = (
        Released("0:a", "a", "arm_1", "dropped"),
        JobOutcome("a", "0:a", "arm_1", "returned", 1, 2.0),
    )
    for end, is_adopted in ((lease_ended, True), (JobSettled(returned), False), (Requested(redo), False)):
        book = JobBook(name="arm_0", is_central=False).replay([*granted, end])
        assert bool(adopted(book, history)) == is_adopted


@pytest.mark.parametrize("before", [False, True])
def test_a_quote_says_nothing_about_an_award_that_was_closed_after_the_request(before):
    """The arm quotes before the award arrives, leaves home for it, and faults, all within one round.

    Args:
        before: It took the same space for an earlier award, which was closed before that round.
    """
    book = ledger(spec("a"))
    if before:
        book.apply(SpaceTaken("arm_0", ("s",)))
    book.apply(awarded("0:a", "a", space="s"))
    at_home = Quote("arm_0", "r", "q", 5.0, "", 0.0, "idle", 9.0, 1, (), ())

    def changes(requested: Mapping[str, frozenset[str]]) -> list[SpaceTaken]:
        closing = Round("r", (), frozenset(["arm_0"]), 0.0, requested, {"arm_0": at_home})
        return stated_spaces(book, closing, 3.0)

    requested = closed_space(book)
    book.apply(closed("0:a", "returned", 0, 2.0))
    assert changes(requested) == []
    assert changes(closed_space(book)) == [SpaceTaken("arm_0", (), 3.0)]


def test_a_job_whose_hard_due_date_has_passed_is_accepted_with_the_reason_why_it_is_given_up():
    late, soft = spec("late", due_s=5.0, expires=True), spec("soft", due_s=5.0)
    for time_s, reason in ((6.0, "Its hard due date has passed, so it is given up."), (4.0, "")):
        admissions = admit([late, soft], {}, time_s=time_s)
        assert [(each.accepted, each.reason) for each in admissions] == [(True, reason), (True, "")]


def test_after_the_end_of_the_shift_no_job_is_ready():
    book = ledger(spec("a"), spec("b", place="bin"), spec("c", place="belt"))
    book.apply(award("a"))
    book.apply(award("b"))
    book.apply(closed("0:b", "finished", 4, 5.0))
    book.apply(ShiftEnded(7200.0))
    assert {s.job: s.state for s in book.status()} == {"a": "unfinished", "b": "finished", "c": "unfinished"}
    assert book.ready(9999.0, 9) == []
    assert "shift is over" in book.admit([spec("d")], 0.0)[0].reason
    book.apply(closed("0:a", "finished", 4, 7201.0))
    assert book.status(["a", "unknown"])[0].state == "finished"


def test_the_end_of_a_shift_marks_the_jobs_that_are_known_to_be_undone():
    """`unsure`: its arm falls silent in its last cycle, at the end of the shift."""
    book = ledger(spec("waits"), spec("back", place="bin"), spec("unsure", place="belt"), spec("late", place="box"))
    for name in ("back", "unsure", "late"):
        book.apply(award(name))
    book.apply(closed("0:back", "returned", 1, 3.0, "an arm faulted"))
    book.apply(CommitPermitted("0:unsure", 4.0))
    assert not any(status.shift_ended for status in book.status())
    book.apply(ShiftEnded(7200.0))
    book.apply(closed("0:late", "returned", 1, 7201.0, "an arm faulted"))
    book.apply(ContactLost("0:unsure", 7202.0))
    for each in (book, JobBook().replay([*book.compact()])):
        assert {s.job for s in each.status() if s.shift_ended} == {"waits", "back", "late"}
    book.apply(closed("0:unsure", "returned", 1, 7203.0))
    assert book.status(["unsure"])[0].shift_ended


steps = st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 9)), max_size=25)


def three_jobs() -> JobBook:
    jobs = (spec("a"), spec("b", "a", place="bin"), spec("c", place="belt"))
    return JobBook().replay([JobsAccepted(jobs, "test", 0.0)])


def next_record(book: JobBook, job: str, choice: int, time_s: int):
    """Return a record that is possible for a job now."""
    entry = book.jobs[job]
    if entry.state == "waiting" and job in names(book.ready(float(time_s), 9)):
        return award(job, time_s)
    if entry.award not in book.open:
        return ClockTick(float(time_s))
    award_state = book.open[entry.award]
    possible = [closed(entry.award, "finished", 4, time_s), closed(entry.award, "returned", choice, time_s)]
    possible.append(closed(entry.award, "returned", choice, time_s, faulted=True))
    if award_state.silent:
        possible.append(ContactRegained(entry.award, time_s))
    elif award_state.may_commit:
        possible.append(ContactLost(entry.award, time_s))
    else:
        possible += [CommitPermitted(entry.award, time_s), closed(entry.award, "dropped", 0, time_s)]
        possible += [closed(entry.award, "refused", 0, time_s, "not now")]
    return possible[choice % len(possible)]


@examples(200)
@given(steps)
def test_a_replay_of_the_journal_gives_the_same_ledger(steps):
    """Any history of three jobs: a replay gives the same states, and the same numbers of changes."""
    book, written, changes = (
        three_jobs(),
        [JobsAccepted(tuple(e.spec for e in three_jobs().jobs.values()), "test", 0.0)],
        [],
    )
    for time_s, (job, choice) in enumerate(steps, start=1):
        written.append(next_record(book, job, choice, time_s))
        changes.extend(book.apply(written[-1]))
    again = JobBook().replay(written)
    assert again == book
    assert [change.number for change in changes] == list(range(3, 3 + len(changes)))
    assert again.number == 3 + len(changes)


@examples(300)
@given(steps, steps, st.booleans())
def test_a_snapshot_gives_the_same_ledger_as_the_records(steps, later, ends):
    """Also encoded as JSON, and with further records."""
    book = three_jobs()
    for time_s, (job, choice) in enumerate(steps, start=1):
        book.apply(next_record(book, job, choice, time_s))
    if ends:
        book.apply(ShiftEnded(50.0))
    record = msgspec.json.decode(msgspec.json.encode(book.compact()[0]), type=BookRecord)
    short = JobBook().replay([record])
    for time_s, (job, choice) in enumerate(later, start=100):
        record = next_record(book, job, choice, time_s)
        assert short.apply(record) == book.apply(record)
    assert short == book
    assert list(short.jobs) == list(book.jobs)


@examples(300)
@given(steps, st.data())
def test_a_late_report_changes_the_same_after_compaction(steps, data):
    """A report on any earlier award that the book keeps."""
    book = three_jobs()
    for time_s, (job, choice) in enumerate(steps, start=1):
        book.apply(next_record(book, job, choice, time_s))
    grants = [grant for entry in book.jobs.values() for grant in entry.grants.values()]
    reported = [grant.record.award for grant in grants if grant.outcome != "refused"]
    if not reported:
        return
    short, name = JobBook().replay(book.compact()), data.draw(st.sampled_from(reported))
    outcome = data.draw(st.sampled_from(["finished", "returned"]))
    late = closed(name, outcome, 2, 100.0, faulted=outcome == "returned" and data.draw(st.booleans()))
    assert short.apply(late) == book.apply(late)
    assert short == book


def test_a_ledger_and_its_snapshot_share_no_objects():
    book = ledger(spec("a"))
    book.apply(award("a"))
    record = book.compact()[0]
    short = JobBook().replay([record])
    book.apply(CommitPermitted("0:a", 2.0))
    assert not record.jobs[0].grants["0:a"].may_commit
    assert short.status()[0].state == "awarded"
    short.apply(closed("0:a", "finished", 4, 3.0))
    assert record.jobs[0].state == "awarded"


def test_the_snapshot_of_a_week_is_short():
    """Thousands of records of time and hundreds of awards on 30 jobs: only the jobs remain."""
    book = ledger(*(spec(f"job {i}", place=f"p{i}") for i in range(30)))
    for i in range(300):
        job = f"job {i % 30}"
        book.apply(award(job, i))
        book.apply(closed(f"{i}:{job}", "refused" if i < 270 else "finished", 4, float(i)))
        book.replay([ClockTick(float(i))] * 10)
    assert sum(len(entry.grants) for entry in book.compact()[0].jobs) == 30


def test_settled_jobs_leave_and_their_names_are_known(monkeypatch):
    """Of nine settled jobs two stay whole, the names of four more are known, and the first three are forgotten."""
    monkeypatch.setattr("fleet.live.book.MAX_SETTLED", 2)
    book = JobBook(past=PastJobs(limit=4))
    for i in range(9):
        done = award(f"job {i}", i), closed(f"{i}:job {i}", "finished", 4, float(i))
        book.replay([JobsAccepted((spec(f"job {i}", due_s=float(i), expires=i == 4),)), *(done if i != 4 else ())])
        book.replay(book.expired(4.5))
    book.apply(JobsAccepted((spec("next", "job 6"), spec("waits"))))
    records = msgspec.json.decode(msgspec.json.encode(book.compact()), type=list[BookRecord])
    short = JobBook(past=PastJobs(limit=4)).replay(records)
    for each in (book, short):
        assert list(each.jobs) == ["job 7", "job 8", "next", "waits"]
        assert each.left == {"finished": 6, "given_up": 1}
        assert names(each.ready(9.0, 9)) == list(each.waiting) == ["next", "waits"]
        same, other, forgotten = each.admit([spec("job 3", due_s=3.0), spec("job 5", value=2.0), spec("job 2")], 0.0)
        assert (same.accepted, other.accepted, forgotten.accepted) == (True, False, True)
        assert same.reason == "It was finished long ago, and is not done again; the recording has its result."
        assert other.reason == "Another job has the name 'job 5'; names must be unique."
        assert forgotten.reason == ""
        late, after = each.admit([spec("late", "job 4"), spec("after", "job 5")], 0.0)
        assert late.reason == "Given up, because it waits for 'job 4', which is given up or cancelled."
        assert after.reason == ""
        assert each.apply(JobsAccepted((spec("job 3"),))) == []
    assert short.past == book.past
    assert sum(len(entry.grants) for entry in book.jobs.values()) == 2


# given up

JOB, NEXT = spec("j"), spec("k", "j")
LOST = "Given up, because it waits for 'j', which is given up or cancelled."
attempts = st.lists(st.tuples(st.sampled_from("abcd"), st.sampled_from(["faulted", "returned", "refused", "dropped"])))


def too_often(arms: list[str]) -> bool:
    """The rule, counted in another way: an arm occurs twice, or there are three."""
    return len(arms) > len(set(arms)) or len(arms) > 2


@given(st.lists(st.sampled_from("abcd")))
def test_two_faults_of_one_arm_or_three_of_all_are_too_many(arms):
    reason = reason_to_give_up(arms)
    assert bool(reason) == too_often(arms)
    assert all(f"'{arm}' {arms.count(arm)} time" in reason for arm in arms) or not reason


def end(number: int, arm: str, outcome: str, time_s: float, cycles: int = 0, *, faulted: bool = False) -> BookRecord:
    return closed(f"{number}:j", outcome, cycles, time_s, "hot", arm=arm, faulted=faulted)


@given(attempts)
def test_the_auctioneer_gives_a_job_up_at_that_fault_and_no_other_event(attempts):
    """Against a list of faults; a replay of the journal, and of its snapshot, gives the same."""
    written: list[BookRecord] = [JobsAccepted((JOB, NEXT), "test", 0.0)]
    book, faults = JobBook().replay(written), list[str]()
    for number, (arm, ending) in enumerate(attempts, start=1):
        if too_often(faults):
            break
        assert [job.name for job in book.ready(99.0, 9)] == ["j"]
        outcome = "returned" if ending == "faulted" else ending
        ended = end(number, arm, outcome, float(number), 1, faulted=ending == "faulted")
        records = [award("j", number, arm), ended]
        written += records
        for record in records:
            book.apply(record)
        faults += [arm] if ending == "faulted" else []
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
        book.apply(award("j", number, "a"))
        book.apply(end(number, "a", "dropped", float(number)))
    book.apply(end(1, "a", "returned", 3.0, faulted=True))
    assert book.status()[0].state == "waiting"
    (change,) = book.apply(end(2, "a", "returned", 4.0, faulted=True))
    assert change.status.state == "given_up"
    (change,) = book.apply(end(2, "a", "finished", 5.0, 4))
    assert change.status.state == "finished", "it was done after all"


def test_jobs_that_wait_for_a_job_that_is_given_up_are_given_up_until_that_one_is_finished():
    last = spec("a", "k")  # sorted before the others
    book = JobBook().replay([JobsAccepted((JOB, NEXT), "test", 0.0)])
    for number in (1, 2):
        book.apply(award("j", number, "a"))
        changes = book.apply(end(number, "a", "returned", float(number), faulted=True))
    assert [(change.status.job, change.status.state) for change in changes] == [("j", "given_up"), ("k", "given_up")]
    (admission,) = book.admit((last,), 0.0)
    assert (admission.accepted, admission.reason) == (True, LOST.replace("'j'", "'k'"))
    (change,) = book.apply(JobsAccepted((last,), "test", 3.0))
    assert (change.status.state, change.status.reason) == ("given_up", admission.reason)
    for ledger in (book, JobBook().replay(book.compact())):
        assert not ledger.unsettled()
        changes = ledger.apply(end(2, "a", "finished", 5.0, 4))
        assert {change.status.job: change.status.state for change in changes} == {
            "j": "finished",
            "k": "waiting",
            "a": "waiting",
        }
        assert [job.name for job in ledger.ready(9.0, 9)] == ["k"]


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


# requests as large as a message may be

SOON_S = 2.0
"""Of the processor: far below the 6 s after which an arm loses its lease, and far above what a slow one takes."""


@pytest.fixture
def auctioneer() -> Auctioneer:
    ledger = JobBook(frozenset({"rack"}), ("arm_0",))
    return Auctioneer(
        "auctioneer", ledger, allocate=lambda *_: {}, keep=lambda *_: None, boot="b", real_s=0.0
    )  # fmt: skip


def test_a_cancelled_job_gives_up_a_long_chain_that_waits_for_it_soon(auctioneer):
    """Each submission names its jobs last first, so that no job comes after the one that it waits for."""
    auctioneer.submit(Submission((spec("0"),)), 0.0)
    last = 40 * MOST_JOBS
    for first in range(1, last, MOST_JOBS):
        chain = tuple(spec(str(i), str(i - 1)) for i in range(first, first + MOST_JOBS))
        auctioneer.submit(Submission(chain[::-1]), 0.0)
    began_s = time.process_time()
    auctioneer.control(ControlRequest("r", Cancel("0")), 1.0)
    assert time.process_time() - began_s < SOON_S
    assert {status.state for status in auctioneer.status(map(str, range(1, last)))} == {"given_up"}
    end = auctioneer.status((str(last),))[0]  # the first ones have left the ledger
    assert end.reason == f"Given up, because it waits for '{last - 1}', which is given up or cancelled."


def ring() -> tuple[JobSpec, ...]:
    names = [f"{i:03}".rjust(128, "é") for i in range(30)]
    return tuple(spec(name, before) for name, before in zip(names, names[1:] + names[:1], strict=True))


def long_names() -> tuple[JobSpec, ...]:
    return tuple(spec(f"{i:03}".rjust(128, "\U0001f600")) for i in range(100))


@pytest.mark.parametrize("jobs", [ring(), long_names()])
def test_why_jobs_are_not_accepted_fits_into_one_message(auctioneer, jobs):
    """The router drops what is larger, and who submits would never hear of it."""
    first = Submission(tuple(msgspec.structs.replace(each, after=()) for each in long_names()))
    auctioneer.submit(first, 0.0)
    request = Submission(tuple(msgspec.structs.replace(each, dwell_s=7.0) for each in jobs))
    assert len(encode(request)) <= MOST_BYTES
    reply = auctioneer.submit(request, 0.0)
    assert len(encode(reply)) <= MOST_BYTES
    assert not any(each.accepted for each in reply.jobs)


@pytest.mark.parametrize("request_", [Submission((spec("j"),)), ClearRequest("arm_0")])
def test_a_requester_has_a_short_name(request_):
    """It comes back in every result, which a router would drop if it were larger than the request was."""
    kind = type(request_)
    assert decode(kind, encode(msgspec.structs.replace(request_, by="x" * 128))).by == "x" * 128
    with pytest.raises(MalformedMessage):
        decode(kind, encode(msgspec.structs.replace(request_, by="x" * 129)))
