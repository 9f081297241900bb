"""Journals of an auctioneer with one wrong record: it goes on, quarantines what is not reliable, and reports it."""

import json
import random
import zlib
from contextlib import contextmanager, suppress
from functools import cache

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.simulation.participants import AUCTIONEER, simulated_system
from fleet.bus.protocol.auction import Award, JobSpec, Report
from fleet.bus.protocol.consensus import History
from fleet.bus.protocol.operator import Cancel, Change, ControlRequest, Pause, Resume, Settle
from fleet.errors import JournalError, Refused
from fleet.live import journal as journal_module
from fleet.live.arm.awards import ArmHistory, ArmRecord, AwardAccepted, Closed, ReportReceived
from fleet.live.book import JobBook
from fleet.live.doubts import replay
from fleet.live.epochs import adopted
from fleet.live.journal import ClockTick, CommitPermitted, JobsAccepted, Journal, Progress, Started, quarantine
from fleet.live.leases import expire
from fleet.live.records import BookRecord, Checked, salvage
from fleet.live.steering import objection
from tests.live.records import awarded, closed, requested
from tests.live.simulated import SimulatedFleet
from tests.profiles import examples

KINDS = ("deleted", "doubled", "repeated at the end", "changed")


def spec(name: str, *after: str, repetitions: int = 3) -> JobSpec:
    terms = {"repetitions": repetitions, "value": 2.0, "due_s": 900.0}
    return JobSpec(name=name, kind="hold", places=(f"place of {name}",), after=after, **terms)


class WronglyRemembered(SimulatedFleet):
    """A fleet in which two arms may have a quarantined job for a while, which only one of them finishes."""

    def _check_holders(self) -> None:
        pass


class Worked:
    """A fleet that has worked, and the records of its auctioneer, which are compacted at most once."""

    def __init__(self, seed: int) -> None:
        rng = random.Random(seed)
        self.fleet = fleet = WronglyRemembered(False, 2, seed=seed)
        with self.running():
            fleet.start()
            fleet.submit(*(spec(f"j{i}", repetitions=rng.randint(1, 4)) for i in range(3)))
            fleet.submit(spec("next", "j0"), spec("long", repetitions=1000))
            for step in range(14):
                fleet.cut(*rng.choice([(), (), ("arm_0",), ("arm_1",)]))
                fleet.run(rng.uniform(0.1, 1.0))
                actions = (Cancel("j1"), Pause("arm_0"), Resume(), Change("j2", value=5.0), Cancel("long"))
                with suppress(Refused):
                    fleet.control(rng.choice(actions))
                if rng.random() < 0.2:
                    fleet.restart(rng.choice(fleet.arms))
                if step == 4 and seed % 2:
                    fleet.restart()
                if step == 7:
                    fleet.submit(spec("late"))
            fleet.cut()
            fleet.world.processes[AUCTIONEER].kill("is killed")
        self.file = fleet.world.processes[AUCTIONEER].disk.names["auction"]
        lines = [msgspec.json.decode(line)["records"] for line in self.file.data.splitlines()]
        self.journal = [record for line in lines for record in msgspec.convert(line, list[BookRecord])]
        self.checked = max(i for i, record in enumerate(self.journal) if isinstance(record, Checked))
        """Place of the last check: no journal can tell that a later record is missing."""

    @contextmanager
    def running(self):
        with simulated_system(self.fleet.world):
            journal_module.COMPACT_BYTES = 10**6
            yield

    def go_on(self, journal) -> None:
        """Start the auctioneer from these records, and work."""
        body = msgspec.json.encode(journal)
        self.file.data[:] = b'{"crc":"%08x","records":%s}\n' % (zlib.crc32(body), body)
        self.fleet.submitter.accepted.clear()  # the description of a job may be lost
        for arm in self.fleet.arms:  # arms with nothing to adopt
            self.fleet.intercept(arm, "history", lambda request, reply_to, arm=arm: History(arm, "", ()))
        with self.running():
            self.fleet.world.processes[AUCTIONEER].start()
            self.fleet.run(8.0)


@cache
def worked(seed: int) -> Worked:
    """A fleet of which only the journal is needed."""
    return Worked(seed)


def altered(record, rng: random.Random, kind=BookRecord):
    """Return the record with one field changed to another value that can be read."""
    content = json.loads(msgspec.json.encode(record))
    places = []

    def visit(part, path):
        for key, value in part.items() if isinstance(part, dict) else enumerate(part):
            if isinstance(value, dict | list):
                visit(value, [*path, key])
            elif key not in ("type", "action", "time_s", "by"):
                places.append([*path, key])

    visit(content, [])
    rng.shuffle(places)
    for path in places:
        part = content
        for key in path[:-1]:
            part = part[key]
        before = part[path[-1]]
        others = {bool: [not before], str: ["j2", "arm_1", "x:j0", "finished"], int: [7, 0], float: [3.0]}
        for value in others.get(type(before), [0]):
            part[path[-1]] = value
            try:
                other = msgspec.convert(content, kind)
            except msgspec.ValidationError:
                continue
            if other != record:
                return other
        part[path[-1]] = before
    return None


def wrong_journal(records, kind: str, index: int, rng: random.Random, record_kind=BookRecord):
    records, record = list(records), records[index]
    if kind == "deleted":
        del records[index]
    elif kind == "doubled":
        records.insert(index, record)
    elif kind == "repeated at the end":
        records.append(record)
    else:
        other = altered(record, rng, record_kind)
        if other is None:
            return None
        records[index] = other
    return records


def names_in(*records) -> set[str]:
    """Names of the jobs that records are about, with the jobs that wait for them."""
    text = b"".join(map(msgspec.json.encode, records)).decode()
    named = {name for name in ("j0", "j1", "j2", "next", "long", "late", "a", "b") if f'{name}"' in text}
    return named | ({"next"} if "j0" in named else set())


@pytest.mark.ci_slow
@examples(300)
@given(st.integers(0, 5), st.sampled_from(KINDS), st.integers(0, 10_000), st.randoms(use_true_random=False))
def test_one_wrong_record_leaves_other_jobs_as_they_are_and_no_job_is_done_twice(seed, kind, index, rng):
    records, arms = worked(seed).journal, worked(seed).fleet.arms
    whole = replay(JobBook(arms=arms), records)
    index = 1 + index % worked(seed).checked  # without the snapshot, which is the whole journal
    journal = wrong_journal(records, kind, index, rng)
    if journal is None:
        return
    kept: list[bytes] = []
    ledger = replay(JobBook(arms=arms), journal, lambda record, reason: kept.append(record))
    before, after = ({each.job: each for each in book.status()} for book in (whole, ledger))
    touched = names_in(records[index], journal[min(index, len(journal) - 1)])
    aside = {name for name, status in after.items() if status.reason.startswith("Quarantined")}
    for name, status in before.items():
        assert name in after, f"'{name}' is lost without a report"
        if name not in touched:
            assert after[name].state == status.state, f"'{name}' was not touched"
        assert after[name].state == status.state or name in aside, f"'{name}' is wrong without a report"
    assert not aside or kept
    for name in aside:
        assert after[name].state == "unfinished"
        assert name not in {job.name for job in ledger.ready(1e6, 99)}
    again = replay(JobBook(arms=arms), ledger.compact())
    assert again.status() == ledger.status(), "it is the same after the next start"

    again = Worked(seed)
    sent = again.fleet.sent.messages
    for key in list(sent):  # results may repeat a changed field
        if kind == "changed":
            del sent[key]
    again.go_on(journal)  # the rules of the simulation are checked
    assert max(again.fleet.finished.values(), default=0) <= 1


def journal_of(path, records: list[dict]):
    """Write records with a right checksum, as another version may have written them; return the journal."""
    body = json.dumps(records).encode()
    path.write_bytes(b'{"crc":"%08x","records":%s}\n' % (zlib.crc32(body), body))
    return Journal[BookRecord](path, BookRecord, quarantine=salvage(quarantine(path.with_suffix(".aside"), "au")))


def as_json(record) -> dict:
    return json.loads(msgspec.json.encode(record))


@pytest.mark.parametrize("in_snapshot", [False, True])
def test_a_job_that_cannot_be_read_is_quarantined_alone_and_settled_by_a_person(tmp_path, in_snapshot):
    """`dwell_s` in milliseconds, from a version that had no bounds; an award of it follows."""
    jobs = JobsAccepted((spec("good"), spec("poison"), spec("after", "poison")))
    record = as_json(replay(JobBook(), [jobs]).compact()[0] if in_snapshot else jobs)
    poison = record["jobs"][1]["spec"] if in_snapshot else record["jobs"][1]
    poison["dwell_s"] = 60_000
    award = as_json(awarded("r:poison", "poison"))
    path = tmp_path / "au.journal"
    with journal_of(path, [record, award]) as book:
        ledger = replay(JobBook(), book.records(), book.quarantine)
        book.compact(*ledger.compact())
    assert "60000" in path.with_suffix(".aside").read_text()
    with Journal[BookRecord](path, BookRecord) as book:
        ledger = replay(JobBook(), book.records())
    states = {each.job: each for each in ledger.status()}
    assert {name: each.state for name, each in states.items()} == {
        "good": "waiting",
        "after": "waiting",
        "poison": "unfinished",
    }
    assert "dwell_s" in states["poison"].reason
    assert [job.name for job in ledger.ready(1.0, 9)] == ["good"]
    refused = ledger.admit([spec("poison")])[0]
    assert (refused.accepted, "settle it first" in refused.reason) == (False, True)
    with pytest.raises(Refused, match="quarantined"):
        objection(ledger, ControlRequest("1", Cancel("poison")), frozenset())
    done, redo = (replay(JobBook(), ledger.compact()) for _ in range(2))
    done.apply(requested(Settle("poison", "done"), 2.0))
    assert [job.name for job in done.ready(1.0, 9)] == ["after", "good"]
    redo.apply(requested(Settle("poison", "redo"), 2.0))
    assert redo.admit([spec("poison")])[0].accepted


def test_a_job_quarantined_by_contradiction_waits_again_after_it_was_settled():
    twice = [awarded(f"r{i}:a", "a") for i in range(2)]
    ledger = replay(JobBook(), [JobsAccepted((spec("a"), spec("b"))), *twice])
    assert [(each.job, each.state) for each in ledger.status()] == [("a", "unfinished"), ("b", "waiting")]
    with pytest.raises(Refused, match="may still do the last cycle"):
        objection(ledger, ControlRequest("1", Settle("a", "redo")), frozenset())
    ledger.apply(closed("r0:a", "returned", 1, 2.0))
    assert ledger.status(["a"])[0].state == "unfinished"
    ledger.apply(requested(Settle("a", "redo"), 3.0, awards=("r0:a",)))
    assert ledger.status(["a"])[0].state == "waiting"


def test_a_damaged_line_in_the_middle_is_not_taken_for_a_wrong_job(tmp_path):
    with journal_of(tmp_path / "au.journal", [as_json(JobsAccepted((spec("a"),)))]) as book:
        book.append(ClockTick(1.0))
        book.append(ClockTick(2.0))
    content = book.path.read_bytes().replace(b'"time_s":1.0', b'"time_s":1.5')
    book.path.write_bytes(content)
    with pytest.raises(JournalError, match="line 2: damaged"):
        book.open()


@examples(200)
@given(st.integers(0, 3), st.sampled_from(KINDS), st.integers(0, 10_000), st.randoms(use_true_random=False))
def test_one_wrong_record_in_the_journal_of_an_arm_does_not_stop_it(boots, kind, index, rng):
    award = Award("r:a", "r", "au", "q", spec("a"))
    other = Award("r:b", "r", "au", "q", spec("b"))
    records = [
        Started(boot=boots),
        AwardAccepted(award),
        Progress("a", 1),
        CommitPermitted("r:a"),
        AwardAccepted(other),
    ]
    records += [Closed(Report("arm_0", "r:a", "a", "finished", 3, 2.0)), ReportReceived("r:a"), Progress("b", 2)]
    journal = wrong_journal(records, kind, index % len(records), rng, ArmRecord)
    if journal is None:
        return
    kept: list[str] = []
    history = ArmHistory().replay(journal, lambda record, reason: kept.append(reason)).after_restart("arm_0", 3.0)
    assert ArmHistory().replay(history.compact()).boot == history.boot
    if not names_in(records[index % len(records)]) & {"b"} and "r:b" in history.reports:
        assert history.reports["r:b"][1].outcome == "returned"


def test_an_arm_that_has_a_job_whose_description_is_lost_neither_stops_the_auctioneer_nor_gets_it_again():
    """The journal has lost `JobsAccepted`, and the history of the arm names its award."""
    history = History("arm_0", "e", awards=(Award("r:a", "r", "au", "q", spec("a")),), may_commit=("r:a",))
    book = replay(JobBook(name="au", epoch="e"), [awarded("r:a", "a")])
    assert adopted(book, history) == []
    assert book.apply(awarded("s:a", "a", "arm_1")) == []
    assert (book.status()[0].state, book.open) == ("unfinished", {})
    book.apply(closed("r:a", "finished", 3, 2.0))
    assert book.past.is_finished("a")


@pytest.mark.parametrize("is_central", [True, False])
def test_of_two_grants_of_one_job_one_is_open_and_it_is_not_taken_back(is_central):
    twice = [JobsAccepted((spec("a"),)), awarded("r:a", "a"), awarded("s:a", "a", "arm_1")]
    book = replay(JobBook(is_central=is_central), twice)
    book.attach(lambda *_: None, counted_until_s=0.0)
    expire(book, 1e6, 0.0)
    assert list(book.open) == ["r:a"]
    assert book.status()[0].state == "unfinished"
    assert book.ready(1e6, 9) == []
