"""Journal of one participant: records are durable before they take effect.

A table of an SQLite database: each row is one `append`, the records as a JSON array, with a CRC-32 of all rows so far,
so that a changed, missing or repeated row before the last is noticed. With a write-ahead log and `synchronous = FULL`
an append is on disk, or is not there after a crash (https://sqlite.org/wal.html). A damaged journal does not open;
SQLite ignores a log from its first damaged page on, and here more than one step behind that is damage.

Journals of arms and auctioneers share the record types in this file; each adds its own. Times are fleet seconds, 0 for
unknown. A journal is compacted when it has grown.
"""

import errno
import logging
import os
import struct
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import UnionType
from typing import Any, Generic, Literal, NamedTuple, Protocol, Self, TypeVar, cast

import apsw
import msgspec

from fleet.bus.protocol.auction import Count, JobSpec, Name
from fleet.errors import JournalError, JournalFull, printable

_LOG = logging.getLogger(__name__)

COMPACT_FACTOR, COMPACT_BYTES = 4, 1_000_000
"""A journal needs compaction once it has grown by this factor since the last one, and to this size."""

Record = TypeVar("Record", bound=msgspec.Struct)

_REMEDY = (
    "Restore a copy in place of both, the file and its log with '-wal' in the name. Without its journal a participant "
    "has lost its jobs, and may do them twice: see Epochs in docs/bus/auctioneer.md before you move it away."
)
_LOG_HEAD, _FRAME_HEAD = struct.Struct(">8I"), struct.Struct(">4I8x")
"""Heads of a write-ahead log and of a frame (https://sqlite.org/fileformat2.html#the_write_ahead_log): magic number,
version, page size, sequence, two salts and two checksums; page, pages after a commit or 0, and the salts."""
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class JournalState(ABC, Generic[Record]):
    """State that follows from journal records alone."""

    @abstractmethod
    def apply(self, record: Record) -> object:
        """Update the state by a record."""

    @abstractmethod
    def compact(self) -> tuple[Record, ...]:
        """Return the fewest records that give the same state."""

    def replay(self, records: Iterable[Record]) -> Self:
        """Apply records, oldest first, and return the state."""
        for record in records:
            self.apply(record)
        return self


class TimedState(JournalState[Record]):
    """State that includes fleet time."""

    time_s: float
    """Latest time of all records."""


class _Database(Protocol):
    """What is used of `apsw.Connection`, with types that need no `Buffer`, which Python 3.11 lacks."""

    @property
    def system_errno(self) -> int: ...
    def execute(self, statement: str, values: tuple[int | str, ...] = ()) -> Iterator[tuple[int, bytes, int]]: ...
    def pragma(self, name: str, value: str) -> object: ...
    def config(self, option: int, value: int) -> int: ...
    def close(self) -> None: ...
    def __enter__(self) -> object: ...
    def __exit__(self, *exc: Any) -> bool | None: ...


class _End(NamedTuple):
    """The last row of a journal: its number, the checksum up to it, and the bytes of all records."""

    row: int = 0
    crc: int = 0
    size: int = 0

    def after(self, line: bytes) -> "_End":
        """Return the end after one more row."""
        return _End(self.row + 1, zlib.crc32(line, self.crc), self.size + len(line))


class Journal(Generic[Record]):
    """`with Journal(path, Opened | Closed) as journal:` keeps the file open, for this process alone.

    Attributes:
        path: The file; the log beside it, with the same name and `-wal`, is a part of it.
    """

    def __init__(self, path: Path, kind: type[Record] | UnionType, *, durable: bool = True) -> None:
        """Prepare a journal of records of one `msgspec.Struct`, or of a union of tagged ones.

        Args:
            durable: False: a loss of power may lose records.
        """
        self.path = path
        self._decoder = msgspec.json.Decoder(cast(type[list[Record]], list[kind]))
        self._durable = durable
        self._db: _Database | None = None
        self._end, self._compacted = _End(), 0
        self._broken = ""

    def open(self) -> Self:
        """Open and lock the file, create it if it is missing, and check every row.

        Raises:
            JournalError: another process has it open, it is damaged, or it cannot be created.
        """
        if self._db is not None:
            return self
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.touch(mode=0o600)  # SQLite gives its log the same mode
            self._db = cast(_Database, apsw.Connection(str(self.path)))
            self._db.config(apsw.SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, 1)  # what is refused stays as it is
            self._db.pragma("locking_mode", "exclusive")
            self._db.pragma("journal_mode", "wal")
            self._db.pragma("synchronous", "full" if self._durable else "off")
            if commits := self._commits_of_log():  # the file is locked now
                self._check_log(self._db, commits)
            self._db.execute("CREATE TABLE IF NOT EXISTS journal (row INTEGER PRIMARY KEY, records TEXT, crc INTEGER)")
            for _ in self.records():
                pass
            self._db.config(apsw.SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, 0)
        except (OSError, apsw.Error, UnicodeEncodeError) as error:
            failure = self._failure(error, "opened")
            self.close()
            raise failure from error
        except JournalError:
            self.close()
            raise
        return self

    def close(self) -> None:
        """Close and unlock the file; a second call does nothing."""
        if self._db is not None:
            self._db.close()
            self._db = None

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    def records(self) -> Iterator[Record]:
        """Yield all records, oldest first.

        Raises:
            JournalError: it is damaged, or of another version.
        """
        end, rows = _End(), "SELECT row, IFNULL(CAST(records AS BLOB), x''), crc FROM journal ORDER BY row"
        for row, line, crc in self._opened().execute(rows):
            end = end.after(line)
            if (row, crc) != (end.row, end.crc):
                raise JournalError(f"{self.path}, row {end.row}: damaged (wrong checksum). {_REMEDY}")
            try:
                yield from self._decoder.decode(line)
            except (msgspec.DecodeError, RecursionError) as error:
                raise JournalError(f"{self.path}, row {row}: not of this version ({error}). {_REMEDY}") from error
        self._end = end

    def append(self, *records: Record) -> None:
        """Write records and return when they are durable: all of them or, if it raises, none.

        Raises:
            JournalFull: no space on the disk; the journal is unchanged.
            JournalError: the disk failed and the content of the file is uncertain; further writes are refused.
        """
        if records:
            self._write(records)

    def rewrite(self, *records: Record) -> None:
        """Replace the whole content by these records; after a crash it is the old one or the new one.

        Raises:
            JournalError: as `append`.
        """
        self._write(records, replace=True)

    @property
    def needs_compaction(self) -> bool:
        """Whether it has grown enough since the last compaction."""
        return self._end.size > max(COMPACT_BYTES, COMPACT_FACTOR * self._compacted)

    def compact(self, *records: Record) -> None:
        """Replace all records by fewer that give the same state; a full disk leaves the journal unchanged.

        Raises:
            JournalError: as `append`.
        """
        try:
            self.rewrite(*records)
        except JournalFull as error:
            _LOG.warning("The journal is not compacted: %s", error)
        self._compacted = self._end.size

    # Inside

    def _opened(self) -> _Database:
        if self._db is None:
            raise JournalError(f"Journal '{self.path}' is not open.")
        return self._db

    def _commits_of_log(self) -> list[int]:
        """Return the numbers of the frames of the log that end a transaction, from 1; none without a log.

        Raises:
            JournalError: its head is damaged.
        """
        log = self.path.with_name(f"{self.path.name}-wal")
        content = log.read_bytes() if log.exists() else b""
        if len(content) < _LOG_HEAD.size or not any(content[: _LOG_HEAD.size]):
            return []
        magic, _, page_bytes, _, *salts, first, second = _LOG_HEAD.unpack_from(content)
        words = struct.unpack_from(">6I" if magic & 1 else "<6I", content)
        sums = [0, 0]
        for one, two in zip(words[::2], words[1::2], strict=True):
            sums[0] = (sums[0] + one + sums[1]) % 2**32
            sums[1] = (sums[1] + two + sums[0]) % 2**32
        if sums != [first, second]:
            raise JournalError(f"'{log}' is damaged (wrong checksum of its head). {_REMEDY}")
        frames = range(_LOG_HEAD.size, len(content) - _FRAME_HEAD.size + 1, _FRAME_HEAD.size + page_bytes)
        heads = [_FRAME_HEAD.unpack_from(content, start) for start in frames]
        return [number for number, (_, pages, *own) in enumerate(heads, start=1) if pages and own == salts]

    def _check_log(self, db: _Database, commits: list[int]) -> None:
        """Compare the log with what SQLite has taken from it, and begin a new one.

        Raises:
            JournalError: it is damaged in the middle.
        """
        ((_, taken, _),) = db.execute("PRAGMA wal_checkpoint(NOOP)")
        left_out = sum(number > int(taken) for number in commits)
        if left_out > 1:  # a crash leaves one, which was not acknowledged
            raise JournalError(f"'{self.path}-wal' is damaged: {left_out} steps at its end cannot be read. {_REMEDY}")
        if left_out:
            _LOG.warning("%s: left out the last step of its log, which was not complete.", self.path)
        db.pragma("wal_checkpoint", "truncate")

    def _write(self, records: tuple[Record, ...], *, replace: bool = False) -> None:
        if self._broken:
            raise JournalError(self._broken)
        db, line = self._opened(), msgspec.json.encode(records)
        end = (_End() if replace else self._end).after(line)
        try:
            with db:
                if replace:
                    db.execute("DELETE FROM journal")
                db.execute("INSERT INTO journal VALUES (?, ?, ?)", (end.row, line.decode(), end.crc))
        except apsw.Error as error:
            failure = self._failure(error, "written")
            if not isinstance(failure, JournalFull):
                # After a failed fsync the page cache may differ from the disk.
                self._broken = f"{failure} No further writes until it is reopened."
                failure = JournalError(self._broken)
            raise failure from error
        self._end = end

    def _failure(self, error: OSError | apsw.Error | UnicodeEncodeError, tried: str) -> JournalError:
        number = error.errno if isinstance(error, OSError) else 0 if self._db is None else self._db.system_errno
        tells = isinstance(error, OSError | apsw.CantOpenError)  # otherwise it may be the number of an earlier error
        tells |= getattr(error, "extendedresult", 0) == apsw.SQLITE_IOERR_WRITE
        if isinstance(error, apsw.FullError) or (tells and number in _FULL):
            return JournalFull(f"Journal '{self.path}' cannot be {tried}: no space left on the disk.")
        if isinstance(error, apsw.BusyError):
            return JournalError(
                f"Journal '{self.path}' is in use by another process. Stop that process, or choose another folder."
            )
        outside = apsw.CantOpenError | apsw.IOError | apsw.PermissionsError | apsw.ReadOnlyError
        if isinstance(error, apsw.Error) and not isinstance(error, outside):
            return JournalError(f"Journal '{self.path}' is damaged, or of another version ({error}). {_REMEDY}")
        why = error.strerror if isinstance(error, OSError) else os.strerror(number) if tells and number else str(error)
        if isinstance(error, UnicodeEncodeError):
            why = "its path is no text in UTF-8"
        elif isinstance(error, apsw.ReadOnlyError | apsw.CantOpenError) and not self.path.is_dir():
            why = "it needs a file and a folder that this user may read and write"
        return JournalError(f"Journal '{printable(str(self.path))}' cannot be {tried}: {why}.")


class Started(msgspec.Struct, frozen=True, tag="started"):
    """The process starts, for the first time or again."""

    name: str = ""
    """Of the arm or auctioneer."""
    time_s: float = 0.0
    boot: Count = 0
    """Counts the starts of an arm from 1."""


class EpochBegun(msgspec.Struct, frozen=True, tag="epoch_begun"):
    """The journal is new, and has this name; or an arm without an auctioneer has learned it from another."""

    epoch: str
    time_s: float = 0.0
    succeeds: bool = False
    """An operator has requested that it replaces another one: arms may have older epochs."""
    roster: tuple[str, ...] = ()
    """All arms of a fleet without an auctioneer, sorted; empty with one."""


class ClockTick(msgspec.Struct, frozen=True, tag="clock_tick"):
    """Fleet time has reached this value."""

    time_s: float


class JobsAccepted(msgspec.Struct, frozen=True, tag="jobs_accepted"):
    """These jobs were submitted and accepted."""

    jobs: tuple[JobSpec, ...]
    by: str = ""
    time_s: float = 0.0


class Progress(msgspec.Struct, frozen=True, tag="progress"):
    """Number of cycles of a job that are done, by any arm."""

    job: Name
    cycles: Count


class CommitPermitted(msgspec.Struct, frozen=True, tag="commit_permitted"):
    """The arm may begin the last cycle; from now on the job goes to no other arm."""

    award: Name
    time_s: float = 0.0
    cycles: Count = 0
    """Done then, where an auctioneer writes it."""


class Released(msgspec.Struct, frozen=True, tag="released"):
    """The arm no longer has the award, and has nothing to report on it, or has not reported it."""

    award: Name
    job: str = ""
    arm: str = ""
    outcome: Literal["released", "refused", "dropped"] = "released"
    """refused: the arm did not accept it; dropped: its lease has expired."""
    cycles: Count = 0
    """Done so far, by any arm."""
    time_s: float = 0.0
    reason: str = ""


class SpaceTaken(msgspec.Struct, frozen=True, tag="space_taken"):
    """Spaces that an arm takes, by its own report; empty at home."""

    arm: Name
    space: tuple[Name, ...] = ()
    """Names, without those of its open awards."""
    time_s: float = 0.0
    lost: tuple[Name, ...] = ()
    """Silent awards that the arm, at home, no longer has. They are revoked, as by `SpaceCleared`."""


class SpaceCleared(msgspec.Struct, frozen=True, tag="space_cleared"):
    """An operator has freed all space of an absent arm."""

    arm: Name
    by: str = ""
    time_s: float = 0.0


TICK_S = 2.0
"""Real seconds between two records of the fleet's time."""


def own_records(journal: Journal[Record], name: str) -> Iterator[Record]:
    """Yield the records of the journal of an arm or auctioneer, oldest first.

    Raises:
        JournalError: it is of another one, or damaged.
    """
    for record in journal.records():
        if isinstance(record, Started) and record.name not in ("", name):
            raise JournalError(
                f"Journal '{journal.path}' is of '{printable(record.name)}'; '{name}' needs its own. If journals were "
                f"swapped or copied, restore that of '{name}'. See Epochs in docs/bus/auctioneer.md before you "
                "move one away."
            )
        yield record


class CompactingJournal(Generic[Record]):
    """Appends to a journal, and compacts it when it has grown."""

    def __init__(self, journal: Journal[Record], state: JournalState[Record]) -> None:
        """Prepare; `state` is that of the journal, and belongs to this object from now on."""
        self._journal, self._state = journal, state

    def append(self, *records: Record) -> None:
        """Write records, as `Journal.append` does.

        Raises:
            JournalError: none of them is written.
        """
        self._journal.append(*records)
        for record in records:
            self._state.apply(record)
        if self._journal.needs_compaction:
            try:
                self._journal.compact(*self._state.compact())
            except JournalError as error:  # the records are written; the next ones are refused if it is serious
                _LOG.error("%s", error)


class TimeRecorder:
    """Records fleet time, so that it continues after a restart and never decreases.

    Attributes:
        failure: Why it could not be recorded last time; "" if it was.
    """

    def __init__(self, journal: Journal[Any], state: TimedState[Any], real_s: float) -> None:
        """Compact the journal, which gave this state."""
        self._journal, self._state, self._recorded_s = journal, state, real_s
        self.failure = ""
        journal.compact(*state.compact())

    def start_s(self, speed: float) -> float:
        """Return the fleet time to start with: after a restart, later than any reading before."""
        return self._state.time_s + TICK_S * speed if self._state.time_s else 0.0

    def step(self, real_s: float, time_s: float) -> None:
        """Record the fleet time every `TICK_S`, and compact the journal when it has grown.

        Raises:
            JournalError: the journal is no longer reliable.
        """
        if real_s < self._recorded_s + TICK_S:
            return
        self._recorded_s = real_s
        try:
            self._journal.append(ClockTick(time_s))
        except JournalFull as error:
            self.failure = str(error)
            _LOG.error("Could not record the fleet's time: %s", error)
        else:
            self.failure = ""
            self._state.apply(ClockTick(time_s))
        if self._journal.needs_compaction:
            self._journal.compact(*self._state.compact())
