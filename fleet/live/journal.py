"""Append-only journal: records are durable before they take effect.

Each line is one `append`: `{"crc":"0a1b2c3d","records":[…]}`, with the CRC-32 of the encoded records. A line is
complete or absent: an unfinished last line was torn by a crash before `append` returned, and is removed on opening. Any
other line whose checksum differs is damage, and the journal refuses to open.

Journals of arms and auctioneers share the record types in this file; each adds its own. Times are fleet seconds, 0 for
unknown. A journal is compacted when it has grown.
"""

import errno
import fcntl
import logging
import os
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, Generic, Literal, Self, TypeVar, cast

import msgspec

from fleet.bus.protocol.auction import Count, JobSpec, Name
from fleet.errors import JournalError, JournalFull, printable
from fleet.files import atomic_path

_LOG = logging.getLogger(__name__)

COMPACT_FACTOR, COMPACT_BYTES = 4, 1_000_000
"""A journal needs compaction once it has grown by this factor since the last one, and to this size."""

Record = TypeVar("Record", bound=msgspec.Struct)
Quarantine = Callable[[bytes, str], object]
"""Quarantines a record that cannot be applied, with the reason."""
Salvage = Callable[[bytes, str], Sequence[Record]]
"""Quarantines an unreadable record, with the reason, and returns its replacement."""

_REMEDY = (
    "Restore a copy. Without its journal a participant has lost its jobs, and may do them twice: see Epochs in "
    "docs/bus/auctioneer.md before you move the file away."
)
_HEAD, _MIDDLE, _TAIL = b'{"crc":"', b'","records":', b"}\n"
_CRC_END = len(_HEAD) + 8
_START = _CRC_END + len(_MIDDLE)
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class JournalState(ABC, Generic[Record]):
    """State that follows from journal records alone."""

    @abstractmethod
    def apply(self, record: Record) -> object:
        """Update the state by a record."""

    @abstractmethod
    def compact(self) -> tuple[Record, ...]:
        """Return the fewest records that give the same state."""

    def replay(self, records: Iterable[Record], quarantine: Quarantine | None = None) -> Self:
        """Apply records, oldest first, and return the state.

        Args:
            quarantine: Quarantines each record that cannot be applied; None: such a record is an error.
        """
        for record in records:
            try:
                self.apply(record)
            except (KeyError, ValueError, msgspec.ValidationError) as error:
                if quarantine is None:
                    raise
                quarantine(msgspec.json.encode(record), str(error))
        return self


class TimedState(JournalState[Record]):
    """State that includes fleet time."""

    time_s: float
    """Latest time of all records."""

    def checks_due(self) -> tuple[Record, ...]:
        """Return records to write before the next ones, by which a replay can check those before."""
        return ()


class Journal(Generic[Record]):
    """`with Journal(path, Opened | Closed) as journal:` keeps the file open, for this process alone.

    Attributes:
        path: The file.
        torn: Bytes of an unfinished last line that were removed on opening.
        quarantine: Quarantines records that cannot be applied.
    """

    def __init__(
        self,
        path: Path,
        kind: type[Record] | UnionType,
        *,
        sync: Callable[[int], None] = os.fsync,
        quarantine: Salvage[Record] | None = None,
    ) -> None:
        """Prepare a journal of records of one `msgspec.Struct`, or of a union of tagged ones.

        Args:
            sync: Writes an open file through to the disk.
            quarantine: Quarantines each undamaged record of another version, with the reason; `records` yields its
                replacement. None: the journal refuses to open.
        """
        self.path = path
        self.torn = 0
        self._decoder = msgspec.json.Decoder(cast(type[list[Record]], list[kind]))
        self._encoder = msgspec.json.Encoder()
        self._sync, self.quarantine = sync, quarantine
        self._file = self._lock = -1
        self._end = self._compacted = 0
        self._broken = ""

    def open(self) -> Self:
        """Open and lock the file, create it if it is missing, and check every line.

        Raises:
            JournalError: another process has it open, it is damaged, or it cannot be created.
        """
        if self._file >= 0:
            return self
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = self._lock_file()
            fresh = not self.path.exists()
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
            if fresh:
                self._sync_folder()
            self._end = sum(len(line) for line, _ in self._lines(_ignore if self.quarantine else None))
            self.torn = os.fstat(self._file).st_size - self._end
            if self.torn:
                _LOG.warning("%s: removed an unfinished last line (%d bytes).", self.path, self.torn)
                os.ftruncate(self._file, self._end)
                self._sync(self._file)
        except OSError as error:
            self.close()
            kind = JournalFull if error.errno in _FULL else JournalError
            raise kind(f"Journal '{self.path}' cannot be opened: {error.strerror}.") from error
        except JournalError:
            self.close()
            raise
        return self

    def close(self) -> None:
        """Close and unlock the file; a second call does nothing."""
        for handle in (self._file, self._lock):
            if handle >= 0:
                os.close(handle)
        self._file = self._lock = -1

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    def records(self) -> Iterator[Record]:
        """Yield all records, oldest first.

        Raises:
            JournalError: the file was damaged while it was open.
        """
        for _, records in self._lines(self.quarantine):
            yield from records

    def append(self, *records: Record) -> None:
        """Write records and return when they are durable: all of them or, if it raises, none.

        Raises:
            JournalFull: no space on the disk; the file is unchanged.
            JournalError: the disk failed and the content of the file is uncertain; further writes are refused.
        """
        if self._broken:
            raise JournalError(self._broken)
        if not records:
            return
        line = self._encode(records)
        try:
            self._write(self._opened(), line)
        except OSError as error:
            self._undo_append(error)
        self._end += len(line)

    def rewrite(self, *records: Record) -> None:
        """Replace the whole content by these records; after a crash the file is the old one or the new one.

        Raises:
            JournalFull: no space on the disk; the file is unchanged.
            JournalError: the disk failed; the file is unchanged, or it is the new one and must be reopened.
        """
        line = self._encode(records) if records else b""
        file = -1
        try:
            self._opened()
            with atomic_path(self.path) as draft:
                file = os.open(draft, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC, 0o600)
                self._write(file, line)
        except OSError as error:
            if file >= 0:
                os.close(file)
            raise self._failure(error) from error
        # The old file has no name any more: what is written there would be lost.
        os.close(self._file)
        self._file, self._end, self._broken = file, len(line), ""
        try:
            self._sync_folder()
        except OSError as error:
            self._broken = f"{self._failure(error)} No further writes until it is reopened."
            raise JournalError(self._broken) from error

    @property
    def needs_compaction(self) -> bool:
        """Whether the file has grown enough since the last compaction."""
        return self._end > max(COMPACT_BYTES, COMPACT_FACTOR * self._compacted)

    def compact(self, *records: Record) -> None:
        """Replace all records by fewer that give the same state; a full disk leaves the file unchanged.

        Raises:
            JournalError: as `rewrite`.
        """
        try:
            self.rewrite(*records)
        except JournalFull as error:
            _LOG.warning("The journal is not compacted: %s", error)
        self._compacted = self._end

    # Inside

    def _opened(self) -> int:
        if self._file < 0:
            raise JournalError(f"Journal '{self.path}' is not open.")
        return self._file

    def _lock_file(self) -> int:
        """Lock that the system releases when this process exits."""
        path = self.path.with_name(f"{self.path.name}.lock")
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(lock)
            raise JournalError(
                f"Journal '{self.path}' is in use by another process. Stop that process, or choose another folder."
            ) from error
        return lock

    def _encode(self, records: tuple[Record, ...]) -> bytes:
        body = self._encoder.encode(records)
        return b"".join((_HEAD, b"%08x" % zlib.crc32(body), _MIDDLE, body, _TAIL))

    def _lines(self, quarantine: Salvage[Record] | None) -> Iterator[tuple[bytes, list[Record]]]:
        """Yield every complete line with its records."""
        with open(os.dup(self._opened()), "rb") as file:
            file.seek(0)
            for number, line in enumerate(file, start=1):
                if line.endswith(b"\n"):
                    yield line, self._decode(line, number, quarantine)

    def _decode(self, line: bytes, number: int, quarantine: Salvage[Record] | None) -> list[Record]:
        body = line[_START : -len(_TAIL)]
        complete = line.startswith(_HEAD) and line[_CRC_END:_START] == _MIDDLE and line.endswith(_TAIL)
        if not complete or line[len(_HEAD) : _CRC_END] != b"%08x" % zlib.crc32(body):
            raise JournalError(
                f"{self.path}, line {number}: damaged (wrong checksum), so its records are lost. {_REMEDY}"
            )
        try:
            return self._decoder.decode(body)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            if quarantine is not None and (records := self._some_of(body, quarantine)) is not None:
                return records
            raise JournalError(
                f"{self.path}, line {number}: not a record of this version ({error}). {_REMEDY}"
            ) from error

    def _some_of(self, body: bytes, quarantine: Salvage[Record]) -> list[Record] | None:
        """Decode records one by one; None if it is no list."""
        try:
            raws = msgspec.json.decode(body, type=list[msgspec.Raw])
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return None
        records: list[Record] = []
        for raw in raws:
            try:
                records += self._decoder.decode(b"[" + bytes(raw) + b"]")
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                records += quarantine(bytes(raw), str(error))
        return records

    def _write(self, file: int, line: bytes) -> None:
        """Write a line through to the disk."""
        rest = memoryview(line)
        while rest:  # each call writes some bytes or raises
            rest = rest[os.write(file, rest) :]
        self._sync(file)

    def _undo_append(self, error: OSError) -> None:
        """Remove a line that could not be written.

        Raises:
            JournalError: always.
        """
        failure = self._failure(error)
        if not isinstance(failure, JournalFull):
            # After a failed fsync the page cache may differ from the disk.
            self._broken = f"{failure} No further writes until it is reopened."
        try:
            os.ftruncate(self._file, self._end)
            self._sync(self._file)
        except OSError as worse:
            self._broken = f"Journal '{self.path}' could not be restored ({worse.strerror}); it must be reopened."
        raise failure from error

    def _failure(self, error: OSError) -> JournalError:
        if error.errno in _FULL:
            return JournalFull(f"Journal '{self.path}': no space left to write ({error.strerror}).")
        return JournalError(f"Journal '{self.path}' cannot be written: {error.strerror}.")

    def _sync_folder(self) -> None:
        """Write the folder through to the disk: only then is the name of a new file safe."""
        folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            self._sync(folder)
        finally:
            os.close(folder)


def _ignore(record: bytes, reason: str) -> tuple[()]:
    """Leave a record out."""
    return ()


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


class SpaceCleared(msgspec.Struct, frozen=True, tag="space_cleared"):
    """An operator has freed all space of an absent arm."""

    arm: Name
    by: str = ""
    time_s: float = 0.0


TICK_S = 2.0
"""Real seconds between two records of the fleet's time."""


def quarantine(path: Path, name: str) -> Callable[[bytes, str], tuple[()]]:
    """Return a function that quarantines a journal record: it appends the record to a file, and logs the reason.

    Args:
        path: The file.
        name: Of the arm or auctioneer.
    """

    def put(record: bytes, reason: str) -> tuple[()]:
        begin = printable(record[:200].decode(errors="replace"))
        _LOG.error("'%s': quarantined a journal record in '%s': %s. It begins %s.", name, path, reason, begin)
        try:
            with path.open("ab") as file:
                file.write(record + b"\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise JournalError(
                f"A record cannot be quarantined in '{path}': {error.strerror}. Free space there."
            ) from error
        return ()

    return put


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
    """Records fleet time, so that it continues after a restart and never decreases."""

    def __init__(self, journal: Journal[Any], state: TimedState[Any], real_s: float) -> None:
        """Compact the journal, which gave this state."""
        self._journal, self._state, self._recorded_s = journal, state, real_s
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
        records = (*self._state.checks_due(), ClockTick(time_s))
        try:
            self._journal.append(*records)
        except JournalFull as error:
            _LOG.error("Could not record the fleet's time: %s", error)
        else:
            for record in records:
                self._state.apply(record)
        if self._journal.needs_compaction:
            self._journal.compact(*self._state.compact())
