"""A journal returns what was written, and refuses damaged files and other owners."""

import errno
import sqlite3
import subprocess
import sys
from contextlib import closing, suppress
from pathlib import Path
from random import Random
from types import SimpleNamespace

import apsw
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.simulation.disk import Crash, Disk, SimulatedConnection, SqliteFiles
from fleet.bus.protocol.auction import Award, JobSpec, Report
from fleet.bus.protocol.consensus import JobOutcome
from fleet.bus.protocol.messages import encode
from fleet.errors import JournalError, JournalFull
from fleet.live import journal
from fleet.live.arm.awards import ArmHistory, ArmRecord, AwardAccepted, Closed, JobsFinished, ReportReceived
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.auction.node import AuctionNode
from fleet.live.book import JobBook
from fleet.live.consensus.node import ConsensusNode
from fleet.live.consensus.participant import Membership
from fleet.live.epochs import describe, history_of
from fleet.live.journal import CommitPermitted, CompactingJournal, JobsAccepted, Journal, Started, TimeRecorder
from fleet.live.records import BookRecord, JobSettled
from scenarios.live.arm import restart_history
from tests.live.test_poison import Arm
from tests.live.wire import Wire
from tests.profiles import examples

ROOT = Path(__file__).parents[2]


class Text(msgspec.Struct, frozen=True, tag="text"):
    text: str


class Counted(msgspec.Struct, frozen=True, tag="counted"):
    number: int
    share: float = 0.0


KIND = Text | Counted
record = st.builds(Text, st.text()) | st.builds(
    Counted, st.integers(-(2**60), 2**60), st.floats(allow_nan=False, allow_infinity=False)
)


def written(path, *batches):
    """Write a journal of these batches."""
    with Journal(path, KIND) as journal:
        for batch in batches:
            journal.append(*batch)


def read(path):
    with Journal(path, KIND) as journal:
        return list(journal.records())


def changed(path, statement, *values):
    """Change a closed journal as a person could."""
    with closing(sqlite3.connect(path)) as database, database:
        return database.execute(statement, values).fetchall()


@pytest.fixture
def disk(monkeypatch):
    """A simulated disk, on which the journals of a test are."""
    disk = Disk(Random(0))
    disk.power = True
    with SqliteFiles() as files:
        calls = {**vars(apsw), "Connection": lambda name: SimulatedConnection(files, disk, name)}
        monkeypatch.setattr(journal, "apsw", SimpleNamespace(**calls))
        yield disk


@examples(60)
@given(st.lists(st.lists(record, max_size=4), max_size=6), st.lists(record, max_size=3))
def test_records_are_read_in_the_order_of_writing(tmp_path_factory, batches, later):
    path = tmp_path_factory.mktemp("journal") / "deep" / "arm.journal"
    written(path, *batches)
    written(path, later)
    assert read(path) == [each for batch in [*batches, later] for each in batch]


def test_every_row_is_plain_json(tmp_path):
    written(tmp_path / "j", [Text("a\nb"), Counted(1)], [Text("ä")])
    assert [msgspec.json.decode(row) for (row,) in changed(tmp_path / "j", "SELECT records FROM journal")] == [
        [{"type": "text", "text": "a\nb"}, {"type": "counted", "number": 1, "share": 0.0}],
        [{"type": "text", "text": "ä"}],
    ]
    assert (tmp_path / "j").stat().st_mode & 0o077 == 0


@examples(30)
@given(st.data())
def test_a_log_that_ends_at_any_byte_gives_the_appends_before(tmp_path_factory, data):
    """As after a crash, or in a copy of a running participant."""
    folder = tmp_path_factory.mktemp("journal")
    whole = [Text("kept"), Text("torn"), Counted(7), Text("x" * 9000)]
    with Journal(folder / "j", KIND) as journal:
        for each in whole:
            journal.append(each)
        database, log = ((folder / name).read_bytes() for name in ("j", "j-wal"))
    (folder / "copy").write_bytes(database)
    (folder / "copy-wal").write_bytes(log[: data.draw(st.integers(0, len(log)))])
    found = read(folder / "copy")
    assert found == whole[: len(found)]
    written(folder / "copy", [Text("after")])
    assert read(folder / "copy") == [*found, Text("after")]


@examples(60)
@given(st.data())
def test_a_damaged_bit_of_the_log_is_noticed_unless_it_is_in_the_last_step(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("journal")
    whole = [Counted(number) for number in range(20)]
    with Journal(folder / "j", KIND) as journal:
        for each in whole:
            journal.append(each)
        database, log = ((folder / name).read_bytes() for name in ("j", "j-wal"))
    log = bytearray(log)
    log[data.draw(st.integers(0, len(log) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    (folder / "copy").write_bytes(database)
    (folder / "copy-wal").write_bytes(log)
    try:
        found = read(folder / "copy")
    except JournalError:
        assert ((folder / "copy").read_bytes(), (folder / "copy-wal").read_bytes()) == (database, log), "changed"
        return
    assert found in (whole, whole[:-1])


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE journal SET records = replace(records, 'two', 'too')",
        "UPDATE journal SET crc = crc + 1 WHERE row = 2",
        "DELETE FROM journal WHERE row = 2",
        "INSERT INTO journal SELECT row + 3, records, crc FROM journal WHERE row = 2",
        "UPDATE journal SET row = row + 1 WHERE row = 3",
        "UPDATE journal SET records = NULL WHERE row = 2",
        "UPDATE journal SET records = x'ff' WHERE row = 2",
        "UPDATE journal SET crc = NULL WHERE row = 2",
    ],
)
def test_a_changed_missing_or_repeated_row_is_refused(tmp_path, change):
    written(tmp_path / "j", [Text("one")], [Text("two"), Counted(2)], [Text("three")])
    changed(tmp_path / "j", change)
    with pytest.raises(JournalError, match=rf"{tmp_path / 'j'}, row \d: damaged"):
        read(tmp_path / "j")


@examples(100)
@given(st.data())
def test_a_damaged_byte_never_gives_other_records(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("journal") / "j"
    records = [Text("one"), Text("two"), Counted(2), Text("three")]
    written(path, *([each] for each in records))
    whole = bytearray(path.read_bytes())
    whole[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(whole)
    with suppress(JournalError):
        assert read(path) == records  # bytes that SQLite does not use


def test_another_version_a_closed_journal_and_a_file_as_a_folder_are_refused(tmp_path):
    path = tmp_path / "j"
    written(path, [Text("one")], [Counted(2)])
    with pytest.raises(JournalError, match="row 2: not of this version"), Journal(path, Text):
        pass
    with pytest.raises(JournalError, match="not open"):
        Journal(path, KIND).append(Text("a"))
    with pytest.raises(JournalError, match="cannot be opened: File exists"):
        Journal(path / "j", KIND).open()
    with pytest.raises(JournalError, match="cannot be opened"):
        Journal(tmp_path, KIND).open()
    (tmp_path / "old").write_text('{"crc":"0a1b2c3d","records":[]}\n' * 100)
    with pytest.raises(JournalError, match="damaged, or of another version"):
        read(tmp_path / "old")


def test_a_journal_is_open_in_one_process_at_a_time(tmp_path):
    path = tmp_path / "j"
    program = f"""
from pathlib import Path
from fleet.live.journal import Journal
from msgspec import Struct
from fleet.errors import JournalError
try:
    Journal(Path({str(path)!r}), Struct).open()
except JournalError as error:
    print(error)
"""
    ask = [sys.executable, "-c", program]
    with Journal(path, KIND):
        with pytest.raises(JournalError, match="in use by another"):
            Journal(path, KIND).open()
        result = subprocess.run(ask, capture_output=True, text=True, check=True, timeout=300, cwd=ROOT)
        assert "in use by another process" in result.stdout
    Journal(path, KIND).open().close()


def test_a_full_disk_leaves_the_journal_unchanged(disk):
    with Journal(disk.path("j"), KIND) as journal:
        journal.append(Text("kept"))
        disk.full = True
        for write in (journal.append, journal.rewrite):
            with pytest.raises(JournalFull, match="'j' cannot be written: no space left on the disk"):
                write(Text("too much"))
        disk.full = False
        journal.append(Text("space again"))
        assert list(journal.records()) == [Text("kept"), Text("space again")]
    assert read(disk.path("j")) == [Text("kept"), Text("space again")]


@pytest.mark.parametrize(
    ("number", "of", "is_full"),
    [
        (errno.EDQUOT, apsw.SQLITE_IOERR_WRITE, True),
        (errno.EFBIG, apsw.SQLITE_IOERR_WRITE, True),
        (errno.EIO, apsw.SQLITE_IOERR_WRITE, False),
        (errno.ENOSPC, apsw.SQLITE_IOERR_FSYNC, False),
    ],
)
def test_an_exceeded_quota_is_a_full_disk_unless_the_sync_fails(tmp_path, number, of, is_full):
    """SQLite tells them from other errors of writing by the number of the system; after a sync nothing is certain."""
    journal = Journal(tmp_path / "j", KIND)
    journal._db = SimpleNamespace(system_errno=number)
    error = apsw.IOError("disk I/O error")
    error.extendedresult = of
    assert isinstance(journal._failure(error, "written"), JournalFull) == is_full


def test_after_a_failed_sync_further_writes_are_refused_until_it_is_reopened(disk):
    with Journal(disk.path("j"), KIND) as journal:
        journal.append(Text("kept"))
        disk.broken = 1
        for _ in range(2):
            with pytest.raises(JournalError, match="No further writes until it is reopened"):
                journal.append(Text("perhaps"))
    assert read(disk.path("j")) in ([Text("kept")], [Text("kept"), Text("perhaps")])


@pytest.mark.parametrize("power", [False, True], ids=["killed", "without power"])
def test_a_crash_at_any_moment_leaves_what_was_written_before_or_after(disk, power):
    """At every call of the disk, ten times with other writes lost: an append that has returned is on disk."""
    old, new, later = [Text("one"), Counted(2)], [Counted(1)], Text("later")
    seen = set()
    for moment in range(1, 60):
        for times in range(10):
            path, stage = disk.path(f"{moment}-{times}"), 0
            written(path, old)
            journal = Journal(path, KIND).open()
            disk.crash_in, disk.power = moment, power
            with suppress(Crash):
                journal.rewrite(*new)
                stage = 1
                journal.append(later)
                stage = 2
            disk.lose(power=power)
            disk.close_all()
            allowed = {0: [old, new], 1: [new, [*new, later]], 2: [[*new, later]]}[stage]
            records = read(path)
            assert records in allowed, f"crash at {moment}"
            seen.add(tuple(records))
        if stage == 2:
            break
    assert stage == 2
    assert seen == {tuple(old), tuple(new), (*new, later)}


def test_fleet_time_never_runs_backwards_after_a_restart(tmp_path, monkeypatch):
    """Not even if the journal was compacted after the last job event."""
    monkeypatch.setattr(journal, "COMPACT_BYTES", 1)
    monkeypatch.setattr(journal, "COMPACT_FACTOR", 2)
    with Journal[BookRecord](tmp_path / "j", BookRecord) as book:
        recorder = TimeRecorder(book, JobBook(), real_s=0.0)
        assert recorder.start_s(speed=60.0) == 0.0
        for real_s in range(1, 30):
            recorder.step(float(real_s), 60.0 * real_s)
        assert len(list(book.records())) < 10
    with Journal[BookRecord](tmp_path / "j", BookRecord) as book:
        again = TimeRecorder(book, JobBook().replay(book.records()), real_s=0.0)
        assert 29 * 60.0 <= again.start_s(speed=60.0) <= 31 * 60.0


def test_the_journal_of_an_arm_stays_short_while_it_is_written(tmp_path, monkeypatch):
    """2000 jobs, of which it remembers 256: after a restart it tells the same history as without compaction."""
    monkeypatch.setattr(journal, "COMPACT_BYTES", 20_000)
    whole, path, sizes = ArmHistory(), tmp_path / "j", []
    with Journal[ArmRecord](path, ArmRecord, durable=False) as book:
        kept = CompactingJournal(book, ArmHistory())
        for number in range(2000):
            job = JobSpec(name=f"job {number}", kind="hold", places=("rack",))
            award = Award(f"award {number}", "round", "auctioneer", "quote", job, epoch=f"{number // 1500}")
            records = [AwardAccepted(award), CommitPermitted(award.award)]
            if number < 1999:
                records += [Closed(Report("a", award.award, job.name, "finished", 1, 1.0)), ReportReceived(award.award)]
            kept.append(*records)
            whole.replay(records)
            sizes.append(path.stat().st_size)
    assert max(sizes[1000:]) == pytest.approx(max(sizes[:1000]), rel=0.2)
    with Journal[ArmRecord](path, ArmRecord) as book:
        again = ArmHistory().replay(book.records())
    assert again.message("a") == whole.message("a")
    message = again.after_restart("a", 0.0).message("a")
    assert (message.epoch, message.awards) == ("1", ())
    assert [job.name for job in message.finished] == [f"job {number}" for number in range(1743, 1999)]
    assert [award.award for award in whole.message("a").awards] == list(whole.message("a").may_commit) == ["award 1999"]


def test_a_history_of_long_names_fits_into_one_message():
    jobs = tuple(JobSpec(name=f"{number:0128d}", kind="hold", places=("p" * 128,)) for number in range(256))
    history = ArmHistory().replay([JobsFinished(jobs, "x")])
    message = history.message("a")
    assert 0 < len(message.finished) < 256
    assert message.finished[-1] == jobs[-1]
    assert len(encode(message)) < 65_536


def test_the_history_of_an_arm_without_an_auctioneer_has_the_jobs_that_finished_last():
    """In that order, whatever their releases and names are."""
    jobs = tuple(JobSpec(name=f"{number:0128d}", kind="hold", places=("p" * 128,)) for number in range(250))
    book = JobBook(name="a", is_central=False).replay([JobsAccepted(jobs, "test", 0.0)])
    for time_s, job in enumerate(reversed(jobs)):
        book.apply(JobSettled(JobOutcome(job.name, "award", "a", "finished", 1, float(time_s))))
    message = history_of("a", book)
    assert 0 < len(message.finished) < 250
    assert message.finished == jobs[len(message.finished) - 1 :: -1]
    last = ", ".join(job.name for job in jobs[4::-1])
    assert f"{len(message.finished)} finished job(s), the last ones {last}, and" in describe(message)


KINDS = {"arm": ArmRecord, "arm without auctioneer": BookRecord, "auctioneer": BookRecord}


def start(kind: str, name: str, journal) -> None:
    """Start a participant of this name, as its process does."""
    match kind:
        case "arm":
            restart_history(journal, name, 0.0)
        case "auctioneer":
            AuctionNode(Wire(), name, journal, allocate=lambda bidding: {}, speed=1.0)
        case _:
            arm = Arm()
            arm.executor.arm = name
            fleet = LiveFleet(arms=("arm_1", "arm_2"))
            ConsensusNode(arm, Membership(fleet=fleet, choose=lambda *_: {}), journal, boot=1)


@pytest.mark.parametrize("starts", [1, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_a_journal_of_another_name_is_refused_and_stays_as_it_is(kind, starts, tmp_path):
    path = tmp_path / "arm_2.journal"  # under the name of the other one, as after a swap
    for _ in range(starts):
        with Journal(path, KINDS[kind]) as journal:
            start(kind, "arm_1", journal)
    before = path.read_bytes()
    with Journal(path, KINDS[kind]) as journal, pytest.raises(JournalError, match=r"of 'arm_1'; 'arm_2' needs its own"):
        start(kind, "arm_2", journal)
    assert path.read_bytes() == before


@pytest.mark.parametrize("kind", KINDS)
def test_a_journal_without_a_name_is_read_and_gets_one(kind, tmp_path):
    """As earlier versions wrote it."""
    with Journal(tmp_path / "old", KINDS[kind]) as journal:
        journal.append(Started(boot=3))
        start(kind, "arm_1", journal)
        with pytest.raises(JournalError, match="arm_1"):
            start(kind, "arm_2", journal)
