"""What must not be forgotten: an append-only file of records that are on disk before anybody hears of them.

One line is one `append`: `{"crc":"0a1b2c3d","records":[…]}`, the CRC-32 over the records as they are written. A line is
there as a whole or not at all: one without its end was torn by a crash before anybody was told, and is taken away;
anything else that is not what it was when it was written is damage, and refused.
"""

import errno
import fcntl
import logging
import os
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import msgspec

from fleet.errors import JournalError, JournalFull

_LOG = logging.getLogger(__name__)

GROWTH = 4
LEAST_LONG_BYTES = 1_000_000
"""A journal that has grown so many times, and to at least so many bytes, is long."""

Record = TypeVar("Record", bound=msgspec.Struct)

_HEAD, _MIDDLE, _TAIL = b'{"crc":"', b'","records":', b"}\n"
_CRC_END = len(_HEAD) + 8
_START = _CRC_END + len(_MIDDLE)
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Journal(Generic[Record]):
    """`with Journal(path, Opened | Closed) as journal:` holds the file alone until the end of the block.

    Attributes:
        path: The file.
        torn: Bytes of an unfinished last line that were taken away when it was opened.
    """

    def __init__(self, path: Path, kind: Any, *, sync: Callable[[int], None] = os.fsync) -> None:
        """Prepare a journal of records of a `msgspec.Struct`, or of a union of tagged ones.

        Args:
            sync: Brings an open file to the disk.
        """
        self.path = path
        self.torn = 0
        self._decoder: msgspec.json.Decoder[list[Record]] = msgspec.json.Decoder(list[kind])
        self._encoder = msgspec.json.Encoder()
        self._sync = sync
        self._file = self._lock = -1
        self._end = self._short = 0
        self._broken = ""

    def open(self) -> Self:
        """Take hold of the file, made if it is missing, and check it line by line.

        Raises:
            JournalError: another process has it, it is damaged, or it cannot be made.
        """
        if self._file >= 0:
            return self
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = self._locked()
            fresh = not self.path.exists()
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
            if fresh:
                self._sync_folder()
            self._end = sum(len(line) for line, _ in self._lines())
            self.torn = os.fstat(self._file).st_size - self._end
            if self.torn:
                _LOG.warning("%s: its last line was torn (%d bytes) and is taken away.", self.path, self.torn)
                os.ftruncate(self._file, self._end)
                self._sync(self._file)
        except OSError as error:
            self.close()
            raise JournalError(f"Journal '{self.path}' cannot be opened: {error.strerror}.") from error
        except JournalError:
            self.close()
            raise
        return self

    def close(self) -> None:
        """Let go of the file; twice is fine."""
        for handle in (self._file, self._lock):
            if handle >= 0:
                os.close(handle)
        self._file = self._lock = -1

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    @property
    def size(self) -> int:
        """Of the file, bytes."""
        return self._end

    def replay(self) -> Iterator[Record]:
        """All records, oldest first.

        Raises:
            JournalError: the file was damaged while it was open.
        """
        for _, records in self._lines():
            yield from records

    def append(self, *records: Record) -> None:
        """Write records and return when they are on disk, all of them or, by an exception, none.

        Raises:
            JournalFull: there is no room; the file is as it was.
            JournalError: the disk failed, so nobody knows what is on it; nothing more is written.
        """
        if self._broken:
            raise JournalError(self._broken)
        if not records:
            return
        line = self._line(records)
        try:
            self._write(self._opened(), line)
            self._sync(self._file)
        except OSError as error:
            self._take_back(error)
        self._end += len(line)

    def rewrite(self, *records: Record) -> None:
        """Replace all that is there by these records, at once: after a crash it is the old or the new file.

        Raises:
            JournalFull: there is no room; the file is as it was.
            JournalError: the disk failed; the file is as it was, or it is the new one and must be opened anew.
        """
        draft = self.path.with_name(f"{self.path.name}.new")
        line = self._line(records) if records else b""
        file = -1
        try:
            self._opened()
            file = os.open(draft, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC, 0o600)
            self._write(file, line)
            self._sync(file)
            os.replace(draft, self.path)
        except OSError as error:
            if file >= 0:
                os.close(file)
            draft.unlink(missing_ok=True)
            raise self._failed(error) from error
        # From here on the old file has no name, and what would be written there were lost.
        os.close(self._file)
        self._file, self._end, self._broken = file, len(line), ""
        try:
            self._sync_folder()
        except OSError as error:
            self._broken = f"{self._failed(error)} Nothing more is written until it is opened anew."
            raise JournalError(self._broken) from error

    @property
    def long(self) -> bool:
        """Whether it has grown so much since it was shortened that it should be again."""
        return self._end > max(LEAST_LONG_BYTES, GROWTH * self._short)

    def shorten(self, *records: Record) -> None:
        """Begin anew with where all records have led, so that no restart reads through the past again.

        Where there is no room it stays as long as it is.

        Raises:
            JournalError: as `rewrite`.
        """
        try:
            self.rewrite(*records)
        except JournalFull as error:
            _LOG.warning("The journal stays as long as it is: %s", error)
        self._short = self._end

    # Inside

    def _opened(self) -> int:
        if self._file < 0:
            raise JournalError(f"Journal '{self.path}' is not open.")
        return self._file

    def _locked(self) -> int:
        """A lock that ends with this process, whatever happens to it."""
        path = self.path.with_name(f"{self.path.name}.lock")
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(lock)
            raise JournalError(
                f"Journal '{self.path}' is in use by another process; two that write it would both be wrong."
            ) from error
        return lock

    def _line(self, records: tuple[Record, ...]) -> bytes:
        body = self._encoder.encode(records)
        return b"".join((_HEAD, b"%08x" % zlib.crc32(body), _MIDDLE, body, _TAIL))

    def _lines(self) -> Iterator[tuple[bytes, list[Record]]]:
        """Every whole line, with its records."""
        with open(os.dup(self._opened()), "rb") as file:
            file.seek(0)
            for number, line in enumerate(file, start=1):
                if line.endswith(b"\n"):
                    yield line, self._read(line, number)

    def _read(self, line: bytes, number: int) -> list[Record]:
        body = line[_START : -len(_TAIL)]
        whole = line.startswith(_HEAD) and line[_CRC_END:_START] == _MIDDLE and line.endswith(_TAIL)
        if not whole or line[len(_HEAD) : _CRC_END] != b"%08x" % zlib.crc32(body):
            raise JournalError(
                f"{self.path}, line {number}: damaged (its checksum does not fit). What was promised there is not "
                "known any more; put the file aside to begin anew."
            )
        try:
            return self._decoder.decode(body)
        except msgspec.DecodeError as error:
            raise JournalError(f"{self.path}, line {number}: no record of this version ({error}).") from error

    def _write(self, file: int, line: bytes) -> None:
        rest = memoryview(line)
        while rest:  # each turn writes some or raises
            rest = rest[os.write(file, rest) :]

    def _take_back(self, error: OSError) -> None:
        """Leave the file as it was before a line that could not be written.

        Raises:
            JournalError: always.
        """
        failed = self._failed(error)
        if not isinstance(failed, JournalFull):
            # After a failed fsync the cache may say what the disk does not hold.
            self._broken = f"{failed} Nothing more is written until it is opened anew."
        try:
            os.ftruncate(self._file, self._end)
            self._sync(self._file)
        except OSError as worse:
            self._broken = f"Journal '{self.path}' could not be put right ({worse.strerror}); it must be opened anew."
        raise failed from error

    def _failed(self, error: OSError) -> JournalError:
        if error.errno in _FULL:
            return JournalFull(f"Journal '{self.path}' has no room for more: {error.strerror}.")
        return JournalError(f"Journal '{self.path}' cannot be written: {error.strerror}.")

    def _sync_folder(self) -> None:
        """The name of a new file is on disk only with its folder."""
        folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            self._sync(folder)
        finally:
            os.close(folder)
