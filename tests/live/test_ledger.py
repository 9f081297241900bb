"""What is admitted, what is ready, and that the journal alone makes the same ledger again."""

import graphlib
from dataclasses import replace

import msgspec
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.bus.protocol.auction import JobSpec
from fleet.live.auction.job_rules import admit
from fleet.live.auction.ledger import AuctionRecord, Awarded, ContactLost, ContactRegained, Ledger, ShiftEnded
from fleet.live.journal_records import ClockTick, Closed, CommitPermitted, JobsAccepted


def word(name: str, *after: str, place: str = "rack", **changes) -> JobSpec:
    return JobSpec(name=name, kind="hold", places=(place,), after=after, **{"repetitions": 4, **changes})


def ledger(*words: JobSpec) -> Ledger:
    return Ledger().replay([JobsAccepted(words, "test", 0.0)])


def award(job: str, number: int = 0, arm: str = "arm_0", cycles: int = 0) -> Awarded:
    return Awarded(
        f"{number}:{job}", f"round {number}", job, arm, "quote", cycles, 1.0, difficulty=0.5, p_saturation=0.1
    )


def names(words) -> list[str]:
    return [w.name for w in words]


# admission


def test_the_same_job_again_is_taken_and_another_of_its_name_is_not():
    there = {"a": word("a")}
    same, other, twice, third = admit([word("a"), word("a", value=2.0), word("b"), word("b", value=9.0)], there)
    assert same.accepted
    assert twice.accepted
    assert not other.accepted
    assert not third.accepted
    assert other.reason == "Another job has the name 'a'; names must be unique."


def test_jobs_handed_in_together_may_wait_for_each_other_in_any_order():
    assert all(a.accepted for a in admit([word("c", "b"), word("b", "a"), word("a")], {}))


def test_who_waits_for_what_will_never_be_is_refused_with_the_reason():
    words = [word("a", "nobody"), word("b", "a"), word("c", "d"), word("d", "c"), word("e", "e"), word("f")]
    a, b, c, d, e, f = admit(words, {})
    assert a.reason == "It waits for 'nobody', which is unknown or was not accepted."
    assert b.reason == "It waits for 'a', which is not accepted either."
    assert c.reason == "Jobs wait for each other in a ring: c → d → c."
    assert d.reason == "Jobs wait for each other in a ring: d → c → d."
    assert e.reason == "Jobs wait for each other in a ring: e → e."
    assert f.accepted


def test_an_unknown_place_is_refused_and_takes_its_followers_with_it():
    first, second = admit([word("a", place="moon"), word("b", "a")], {}, places=frozenset({"rack", "bin"}))
    assert first.reason == "No place 'moon' in this cell. Places: bin, rack."
    assert second.reason == "It waits for 'a', which is unknown or was not accepted."


def test_no_more_jobs_than_there_is_room_for():
    admissions = admit([word("b"), word("c"), word("a")], {"a": word("a")}, limit=2)
    assert [a.accepted for a in admissions] == [True, False, True]
    assert admissions[1].reason == "There are 2 jobs already; no more are accepted."


@settings(max_examples=200, deadline=None)
@given(st.dictionaries(st.sampled_from("abcdef"), st.sets(st.sampled_from("abcdefg"), max_size=2), min_size=1))
def test_what_is_admitted_can_be_ordered_and_what_is_not_could_not(graph):
    """Against the standard library's topological sorter."""
    admissions = admit([word(name, *sorted(after)) for name, after in graph.items()], {})
    taken = {a.job for a in admissions if a.accepted}
    order = tuple(graphlib.TopologicalSorter({name: graph[name] for name in taken}).static_order())
    assert set(order) == taken
    for left in set(graph) - taken:  # nobody could be added to the order alone
        assert not graph[left] <= taken


# readiness


def test_ready_is_released_after_its_predecessors_and_at_a_free_station():
    book = ledger(
        word("late", release_s=9.0, place="a"),
        word("first", place="b"),
        word("next", "first", place="c"),
        word("also at b", place="b"),
    )
    assert names(book.ready(0.0, 9)) == ["also at b", "first"]
    book.apply(award("first"))
    assert names(book.ready(9.0, 9)) == ["late"]
    book.apply(Closed("0:first", "finished", 4, 5.0))
    assert names(book.ready(9.0, 9)) == ["also at b", "next", "late"]
    assert names(book.ready(9.0, 1)) == ["also at b"]


def test_the_oldest_are_offered_first():
    book = ledger(word("b", release_s=1.0, place="x"), word("a", release_s=2.0), word("c", place="y"))
    assert names(book.ready(5.0, 2)) == ["c", "b"]
    book.apply(award("c"))
    book.apply(Closed("0:c", "returned", 1, 5.0, "too hot"))
    assert names(book.ready(5.0, 2)) == ["c", "b"]


# a job's life


def test_a_job_goes_from_waiting_to_finished():
    book = ledger(word("a"))
    said = [
        change.status
        for record in (award("a"), CommitPermitted("0:a", 2.0), Closed("0:a", "finished", 4, 3.0))
        for change in book.apply(record)
    ]
    assert [s.state for s in said] == ["awarded", "finishing", "finished"]
    assert (said[-1].arm, said[-1].finished_s, said[-1].cycles) == ("arm_0", 3.0, 4)
    assert not book.open
    assert book.unsettled() == []


def test_cycles_done_are_kept_but_the_last_one_is_never_taken_for_granted():
    book = ledger(word("a"))
    book.apply(award("a"))
    book.apply(Closed("0:a", "returned", 99, 3.0))
    assert book.status(["a"])[0].cycles == 3
    book.apply(award("a", 1, cycles=3))
    book.apply(Closed("1:a", "dropped", 0, 4.0))
    assert book.status(["a"])[0].cycles == 3


def test_silence_after_leave_is_unfinished_until_heard_of():
    book = ledger(word("a"))
    for record in (award("a"), CommitPermitted("0:a", 2.0), ContactLost("0:a", 8.0)):
        book.apply(record)
    (status,) = book.status()
    assert (status.state, status.arm) == ("unfinished", "arm_0")
    assert "0:a" in book.open
    assert book.ready(99.0, 9) == []
    assert book.busy_stations() == frozenset()
    book.apply(ContactRegained("0:a", 9.0))
    assert book.status()[0].state == "finishing"
    book.apply(Closed("0:a", "finished", 4, 9.5))
    assert book.status()[0].state == "finished"


def test_who_is_unsure_of_the_last_cycle_leaves_the_job_unfinished_for_good():
    book = ledger(word("a"))
    for record in (award("a"), CommitPermitted("0:a", 2.0), Closed("0:a", "returned", 3, 8.0, "crashed", unsure=True)):
        book.apply(record)
    assert book.status()[0].state == "unfinished"
    assert book.ready(99.0, 9) == []


def test_done_is_done_and_takes_the_job_from_whoever_was_given_it_meanwhile():
    book = ledger(word("a"))
    for record in (award("a"), Closed("0:a", "dropped", 1, 5.0), award("a", 1, "arm_1", 1)):
        book.apply(record)
    book.apply(Closed("0:a", "finished", 4, 6.0))
    assert (book.status()[0].state, book.status()[0].arm) == ("finished", "arm_0")
    assert not book.open
    assert book.apply(Closed("1:a", "finished", 4, 7.0)) == []
    assert book.status()[0].finished_s == 6.0


def test_the_end_of_the_shift_leaves_nothing_open_to_offer():
    book = ledger(word("a"), word("b", place="bin"), word("c", place="belt"))
    book.apply(award("a"))
    book.apply(award("b"))
    book.apply(Closed("0:b", "finished", 4, 5.0))
    book.apply(ShiftEnded(7200.0))
    assert {s.job: s.state for s in book.status()} == {"a": "unfinished", "b": "finished", "c": "unfinished"}
    assert book.ready(9999.0, 9) == []
    assert "shift is over" in book.admit([word("d")])[0].reason
    book.apply(Closed("0:a", "finished", 4, 7201.0))
    assert book.status(["a", "nobody"])[0].state == "finished"


steps = st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 9)), max_size=25)


def begun() -> Ledger:
    return Ledger().replay(
        [JobsAccepted((word("a"), word("b", "a", place="bin"), word("c", place="belt")), "test", 0.0)]
    )


def next_record(book: Ledger, job: str, choice: int, time_s: int):
    """Something that may happen to a job now."""
    entry = book.jobs[job]
    if entry.state == "waiting" and job in names(book.ready(float(time_s), 9)):
        return award(job, time_s)
    if entry.award not in book.open:
        return ClockTick(float(time_s))
    promise = book.awards[entry.award]
    may = [Closed(entry.award, "finished", 4, time_s), Closed(entry.award, "returned", choice, time_s)]
    if promise.silent:
        may.append(ContactRegained(entry.award, time_s))
    elif promise.may_commit:
        may.append(ContactLost(entry.award, time_s))
    else:
        may += [CommitPermitted(entry.award, time_s), Closed(entry.award, "dropped", 0, time_s)]
        may += [Closed(entry.award, "refused", 0, time_s, "not now")]
    return may[choice % len(may)]


@settings(max_examples=200, deadline=None)
@given(steps)
def test_the_journal_alone_makes_the_same_ledger_again(steps):
    """Any life of three jobs: replayed in one go it gives the same states, and the same numbers on its changes."""
    book, written, said = begun(), [JobsAccepted(tuple(e.spec for e in begun().jobs.values()), "test", 0.0)], []
    for time_s, (job, choice) in enumerate(steps, start=1):
        written.append(next_record(book, job, choice, time_s))
        said.extend(book.apply(written[-1]))
    again = Ledger().replay(written)
    assert again == book
    assert [change.number for change in said] == list(range(3, 3 + len(said)))
    assert again.number == 3 + len(said)


@settings(max_examples=300, deadline=None)
@given(steps, steps, st.booleans())
def test_where_records_have_led_can_stand_for_them(steps, later, ends):
    """Through JSON and back it is the same ledger, whatever happens after it, but for awards that nobody needs."""
    book = begun()
    for time_s, (job, choice) in enumerate(steps, start=1):
        book.apply(next_record(book, job, choice, time_s))
    if ends:
        book.apply(ShiftEnded(50.0))
    record = msgspec.json.decode(msgspec.json.encode(book.compact()[0]), type=AuctionRecord)
    short = Ledger().replay([record])
    for time_s, (job, choice) in enumerate(later, start=100):
        happens = next_record(book, job, choice, time_s)
        assert short.apply(happens) == book.apply(happens)
    needed = {name: promise for name, promise in book.awards.items() if name in short.awards}
    assert replace(short, awards={}) == replace(book, awards={})
    assert short.awards == needed
    assert list(short.jobs) == list(book.jobs)
    assert book.open.keys() | {e.award for e in book.jobs.values() if e.award} <= needed.keys()


@settings(max_examples=300, deadline=None)
@given(steps, st.data())
def test_a_late_report_changes_as_much_after_the_journal_was_shortened(steps, data):
    """Of any award there ever was: one that is not known any more would have changed nothing."""
    book = begun()
    for time_s, (job, choice) in enumerate(steps, start=1):
        book.apply(next_record(book, job, choice, time_s))
    reported = [name for name, promise in book.awards.items() if promise.outcome != "refused"]
    if not reported:
        return
    short, name = Ledger().replay(book.compact()), data.draw(st.sampled_from(reported))
    late = Closed(name, data.draw(st.sampled_from(["finished", "returned"])), 2, 100.0)
    before = book.status()
    changes = book.apply(late)
    if name in short.awards:
        assert short.apply(late) == changes
    else:
        assert changes == []
        assert book.status() == before


def test_a_ledger_and_what_stands_for_it_share_nothing():
    book = ledger(word("a"))
    book.apply(award("a"))
    (record,) = book.compact()
    short = Ledger().replay([record])
    book.apply(CommitPermitted("0:a", 2.0))
    assert not record.awards[0].may_commit
    assert short.status()[0].state == "awarded"
    short.apply(Closed("0:a", "finished", 4, 3.0))
    assert record.jobs[0].state == "awarded"


def test_what_stands_for_a_week_is_short():
    """302 400 ticks and 3000 awards on 300 jobs: only the jobs remain."""
    book = ledger(*(word(f"job {i}", place=f"p{i}") for i in range(300)))
    for i in range(3000):
        job = f"job {i % 300}"
        book.apply(award(job, i))
        book.apply(Closed(f"{i}:{job}", "refused" if i < 2700 else "finished", 4, float(i)))
        for _ in range(100):
            book.apply(ClockTick(float(i)))
    assert len(book.awards) == 3000
    assert len(book.compact()[0].awards) == 300


FIRST_VERSION = """[
{"type": "ledger_snapshot", "time_s": 7.0, "number": 8, "ended": false, "jobs": [
  {"word": {"name": "a", "kind": "hold", "places": ["rack"], "repetitions": 4}, "by": "test", "state": "awarded",
   "award": "s:a", "cycles": 3, "finished_s": null, "reason": "", "returns": 1, "returned_s": 6.0}],
 "awards": [
  {"made": {"type": "awarded", "award": "r:a", "auction": "r", "job": "a", "arm": "arm_0", "quote": "q", "cycles": 0,
    "time_s": 2.0, "difficulty": 0.5, "p_saturation": 0.1},
   "may_commit": true, "silent": false, "outcome": "returned"},
  {"made": {"type": "awarded", "award": "s:a", "auction": "s", "job": "a", "arm": "arm_1", "quote": "q", "cycles": 3,
    "time_s": 7.0, "difficulty": null, "p_saturation": null}, "may_commit": false, "silent": false, "outcome": ""}],
 "open": ["s:a"],
 "recent": [{"number": 7, "time_s": 7.0, "auction": "s", "difficulty": null, "p_saturation": null, "status": {
  "job": "a", "state": "awarded", "arm": "arm_1", "award": "s:a", "cycles": 3, "finished_s": null, "reason": ""}}]},
{"type": "started", "name": "auctioneer", "time_s": 9.0, "boot": 0},
{"type": "jobs_accepted", "by": "test", "time_s": 9.5, "jobs": [
  {"name": "b", "kind": "hold", "places": ["bin"], "after": ["a"]}]},
{"type": "clock_tick", "time_s": 10.0},
{"type": "commit_permitted", "award": "s:a", "time_s": 11.0},
{"type": "contact_lost", "award": "s:a", "time_s": 12.0},
{"type": "contact_regained", "award": "s:a", "time_s": 13.0},
{"type": "closed", "award": "s:a", "outcome": "finished", "cycles": 4, "time_s": 14.0, "reason": "", "unsure": false,
 "job": "", "arm": ""},
{"type": "shift_ended", "time_s": 15.0}]"""


def test_records_of_the_first_version_are_readable():
    records = msgspec.json.decode(FIRST_VERSION, type=list[AuctionRecord])
    book = Ledger().replay(records)
    assert {status.job: (status.state, status.arm) for status in book.status()} == {
        "a": ("finished", "arm_1"),
        "b": ("unfinished", ""),
    }
    assert (book.time_s, book.number, book.recent[0].status.state) == (15.0, 14, "awarded")
    assert msgspec.json.decode(msgspec.json.encode(records)) == msgspec.json.decode(FIRST_VERSION)
