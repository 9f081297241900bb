"""A journal returns what was written, and refuses damaged files and other owners."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol.auction import Award, JobSpec, Report
from fleet.bus.protocol.messages import encode
from fleet.errors import FleetError, JournalError, JournalFull
from fleet.live import journal
from fleet.live.arm.awards import ArmHistory, ArmRecord, AwardAccepted, Closed, JobsFinished, ReportReceived
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.auction.node import AuctionNode
from fleet.live.book import JobBook
from fleet.live.consensus.node import ConsensusNode
from fleet.live.consensus.participant import Membership
from fleet.live.doubts import replay
from fleet.live.journal import CommitPermitted, CompactingJournal, Journal, Started, TimeRecorder
from fleet.live.records import BookRecord
from scenarios.live.arm import restart_history
from tests.live.council.test_council_poison import Arm
from tests.live.test_poison import Wire
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


def written(path, *batches, **options):
    """Write a journal of these batches, and return its bytes."""
    with Journal(path, KIND, **options) as journal:
        for batch in batches:
            journal.append(*batch)
    return path.read_bytes()


def read(path):
    with Journal(path, KIND) as journal:
        return list(journal.records())


@examples(60)
@given(st.lists(st.lists(record, max_size=4), max_size=6), st.lists(record, max_size=3))
def test_records_are_read_in_the_order_of_writing(tmp_path_factory, batches, later):
    path = tmp_path_factory.mktemp("journal") / "deep" / "arm.jsonl"
    quick = {"sync": lambda file: None}
    written(path, *batches, **quick)
    written(path, later, **quick)
    assert read(path) == [each for batch in [*batches, later] for each in batch]


def test_every_line_is_plain_json(tmp_path):
    lines = written(tmp_path / "j", [Text("a\nb"), Counted(1)], [Text("ä")]).splitlines()
    assert [msgspec.json.decode(line)["records"] for line in lines] == [
        [{"type": "text", "text": "a\nb"}, {"type": "counted", "number": 1, "share": 0.0}],
        [{"type": "text", "text": "ä"}],
    ]


@examples(60)
@given(st.data())
def test_an_unfinished_last_line_is_removed_and_counted(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("journal") / "j"
    first = len(written(path, [Text("kept")]))
    whole = written(path, [Text("torn"), Counted(7)])
    cut = data.draw(st.integers(first + 1, len(whole) - 1))
    path.write_bytes(whole[:cut])
    with Journal(path, KIND) as journal:
        assert journal.torn == cut - first
        assert list(journal.records()) == [Text("kept")]
        journal.append(Text("after"))
    assert path.read_bytes()[:first] == whole[:first]
    assert read(path) == [Text("kept"), Text("after")]


def test_an_unfinished_line_is_logged(tmp_path, caplog):
    path = tmp_path / "j"
    path.write_bytes(written(path, [Text("a")]) + b'{"crc":"')
    read(path)
    assert "last line (8 bytes)" in caplog.text


@examples(100)
@given(st.data())
def test_damage_is_reported_with_file_and_line(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("journal") / "j"
    whole = written(path, [Text("one")], [Text("two"), Counted(2)], [Text("three")])
    where = data.draw(st.integers(0, len(whole) - 2))
    byte = data.draw(st.integers(0, 255).filter(lambda b: b != whole[where]))
    path.write_bytes(whole[:where] + bytes([byte]) + whole[where + 1 :])
    line = whole[:where].count(b"\n") + 1
    with pytest.raises(JournalError, match=rf"{path}, line {line}: damaged"):
        read(path)


def test_a_cut_line_another_version_a_closed_journal_and_a_file_as_a_folder_are_refused(tmp_path):
    path = tmp_path / "j"
    lines = written(path, [Text("one")], [Counted(2)]).splitlines(keepends=True)
    with pytest.raises(JournalError, match="line 2: not a record of this version"), Journal(path, Text):
        pass
    path.write_bytes(lines[0] + lines[1][:9] + b"\n" + lines[1])
    with pytest.raises(JournalError, match="line 2: damaged"):
        read(path)
    with pytest.raises(JournalError, match="not open"):
        Journal(path, KIND).append(Text("a"))
    with pytest.raises(JournalError, match="cannot be opened"):
        Journal(path / "j", KIND).open()


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
    assert subprocess.run(ask, capture_output=True, text=True, check=True, timeout=300, cwd=ROOT).stdout == ""


def test_append_returns_after_the_records_are_on_disk(tmp_path):
    """The last fsync of an append comes after its last byte."""
    sizes = []
    with Journal(tmp_path / "j", KIND, sync=lambda file: sizes.append(os.fstat(file).st_size)) as journal:
        del sizes[:]
        journal.append(Text("a"), Text("b"))
        assert sizes == [journal.path.stat().st_size]


class AlmostFullDisk:
    """An `os.write` that writes some bytes, and then fails since the disk is full."""

    def __init__(self, space, code=errno.ENOSPC):
        self.space, self.code, self.write = space, code, os.write

    def __call__(self, file, data):
        if not self.space:
            raise OSError(self.code, "No space left on device")
        taken = self.write(file, bytes(data[: self.space]))
        self.space -= taken
        return taken


@pytest.mark.parametrize(("space", "code"), [(0, errno.ENOSPC), (1, errno.EDQUOT), (20, errno.EFBIG)])
def test_a_full_disk_leaves_the_file_unchanged(tmp_path, monkeypatch, space, code):
    path = tmp_path / "j"
    before = written(path, [Text("kept")])
    with Journal(path, KIND) as journal:
        with monkeypatch.context() as full:
            full.setattr(os, "write", AlmostFullDisk(space, code))
            with pytest.raises(JournalFull, match="no space left to write \\(No space left") as raised:
                journal.append(Text("too much"))
        assert isinstance(raised.value, FleetError)
        assert path.read_bytes() == before
        journal.append(Text("space again"))
        assert list(journal.records()) == [Text("kept"), Text("space again")]


def test_after_a_failed_sync_further_writes_are_refused(tmp_path):
    path = tmp_path / "j"
    before = written(path, [Text("kept")])

    def fail(file):
        raise OSError(errno.EIO, "Input/output error")

    with Journal(path, KIND, sync=fail) as journal:
        for result in ("cannot be written: Input/output error", "must be reopened"):
            with pytest.raises(JournalError, match=result):
                journal.append(Text("lost"))
    assert path.read_bytes() == before


def test_a_rewritten_journal_contains_only_the_new_records(tmp_path, monkeypatch):
    path = tmp_path / "j"
    written(path, *[[Counted(n)] for n in range(50)])
    with Journal(path, KIND) as journal:
        journal.rewrite(Counted(49))
        journal.append(Text("next"))
        assert list(journal.records()) == [Counted(49), Text("next")]
        with monkeypatch.context() as full:
            full.setattr(os, "write", AlmostFullDisk(5))
            with pytest.raises(JournalFull):
                journal.rewrite(Text("too much"))
        journal.append(Text("still"))
    assert read(path) == [Counted(49), Text("next"), Text("still")]
    assert sorted(each.name for each in tmp_path.iterdir()) == ["j", "j.lock"]


class Crash(BaseException):
    """The process is killed, or the power is lost."""


class Disk:
    """Counts file operations, crashes at a given one, and records what is on disk by then."""

    def __init__(self, moment):
        self.left, self.synced = moment, {}
        self.open, self.write, self.replace = os.open, os.write, os.replace

    def _tick(self):
        if not self.left:
            raise Crash
        self.left -= 1

    def opens(self, *args):
        self._tick()
        return self.open(*args)

    def writes(self, file, data):
        """Write half, so that every line is written in several pieces."""
        self._tick()
        return self.write(file, bytes(data[: (len(data) + 1) // 2]))

    def replaces(self, *args):
        self._tick()
        return self.replace(*args)

    def syncs(self, file):
        self._tick()
        self.synced[os.fstat(file).st_ino] = os.fstat(file).st_size

    def lose_power(self, folder):
        """Remove what was not synced."""
        for path in folder.iterdir():
            if path.name == "j" or path.name.startswith(".j."):
                os.truncate(path, self.synced.get(path.stat().st_ino, 0))


@pytest.mark.parametrize("power", [False, True], ids=["killed", "without power"])
def test_a_crash_at_any_moment_of_a_rewrite_leaves_the_old_records_or_the_new(tmp_path, monkeypatch, power):
    old, new, later = [Text("one"), Counted(2)], [Counted(1)], Text("later")
    seen = set()
    for moment in range(60):
        path = tmp_path / str(moment) / "j"
        written(path, old)
        disk, stage = Disk(moment), 0
        disk.synced[path.stat().st_ino] = path.stat().st_size
        journal = Journal(path, KIND, sync=disk.syncs).open()
        with monkeypatch.context() as patched:
            patched.setattr(os, "open", disk.opens)
            patched.setattr(os, "write", disk.writes)
            patched.setattr(os, "replace", disk.replaces)
            try:
                journal.rewrite(*new)
                stage = 1
                journal.append(later)
                stage = 2
            except Crash:
                pass
        journal.close()
        if power:
            disk.lose_power(path.parent)
        allowed = {0: [old, new], 1: [new, [*new, later]], 2: [[*new, later]]}[stage]
        records = read(path)
        assert records in allowed, f"crash at {moment}"
        seen.add(tuple(records))
        with Journal(path, KIND) as journal:  # the rewrite works after any crash
            journal.rewrite(*new)
        assert read(path) == new
        if stage == 2:
            break
    assert stage == 2
    assert seen == {tuple(old), tuple(new), (*new, later)}


def test_after_a_failed_sync_of_the_folder_further_writes_are_refused(tmp_path):
    """The sync fails after the new file has replaced the old one."""
    path = tmp_path / "j"
    written(path, [Text("old")])

    def fail(file):
        if os.path.isdir(f"/proc/self/fd/{file}"):
            raise OSError(errno.EIO, "Input/output error")

    with Journal(path, KIND, sync=fail) as journal:
        with pytest.raises(JournalError, match="No further writes until"):
            journal.rewrite(Text("new"))
        with pytest.raises(JournalError, match="until it is reopened"):
            journal.append(Text("lost"))
    assert read(path) == [Text("new")]


def test_fleet_time_never_runs_backwards_after_a_restart(tmp_path, monkeypatch):
    """Not even if the journal was compacted after the last job event."""
    monkeypatch.setattr(journal, "COMPACT_BYTES", 1)
    with Journal[BookRecord](tmp_path / "j", BookRecord) as book:
        recorder = TimeRecorder(book, JobBook(), real_s=0.0)
        assert recorder.start_s(speed=60.0) == 0.0
        for real_s in range(1, 30):
            recorder.step(float(real_s), 60.0 * real_s)
        assert len(list(book.records())) < 10
    with Journal[BookRecord](tmp_path / "j", BookRecord) as book:
        again = TimeRecorder(book, replay(JobBook(), book.records()), real_s=0.0)
        assert 29 * 60.0 <= again.start_s(speed=60.0) <= 31 * 60.0


def test_the_journal_of_an_arm_stays_short_while_it_is_written(tmp_path, monkeypatch):
    """2000 jobs, of which it remembers 256: after a restart it tells the same history as without compaction."""
    monkeypatch.setattr(journal, "COMPACT_BYTES", 20_000)
    whole, path, sizes = ArmHistory(), tmp_path / "j", []
    with Journal[ArmRecord](path, ArmRecord, sync=lambda file: None) as book:
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


@pytest.mark.parametrize("starts", [1, 2, 3])
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
