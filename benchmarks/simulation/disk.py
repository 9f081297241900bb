"""A simulated disk: files in memory that may be full, fail, or lose what was not written through.

`Disk` offers calls of `os`, `DiskPath` those of `pathlib.Path`, and `SqliteFiles` is the file system of the journals'
SQLite (https://sqlite.org/vfs.html). A crash is possible before, in the middle of, and after each call that changes a
file.
"""

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from random import Random
from typing import Any

import apsw


class Crash(BaseException):  # no handler of the product may catch it
    """The process is killed during a call; with `power`, its machine loses power."""

    def __init__(self, call: str, *, power: bool) -> None:
        super().__init__(call)
        self.power = power


SECTOR = 512


@dataclass(eq=False)
class File:
    """Content of a file, and the writes that are not written through."""

    data: bytearray = field(default_factory=bytearray)
    unsynced: list[tuple[int, bytes | None, bytes, int]] = field(default_factory=list[Any])
    """Where and what (None: the end was cut off); what was there before, and the size before."""

    def write(self, start: int, content: bytes) -> None:
        """Write; what lies between the end and `start` is zero."""
        self.unsynced.append((start, content, bytes(self.data[start : start + len(content)]), len(self.data)))
        self._change(start, content)

    def truncate(self, size: int) -> None:
        """Cut the end off."""
        self.unsynced.append((size, None, bytes(self.data[size:]), len(self.data)))
        self._change(size, None)

    def _change(self, start: int, content: bytes | None) -> None:
        if content is None:
            del self.data[start:]
            return
        if start > len(self.data):
            self.data += bytes(start - len(self.data))
        self.data[start : start + len(content)] = content

    def sync(self) -> None:
        """Write through."""
        self.unsynced.clear()

    def lose(self, rng: Random) -> None:
        """Lose writes since the last sync: any of them, or the end of one."""
        lost, self.unsynced = self.unsynced, []
        for start, _, before, size in reversed(lost):
            self.data[start : start + len(before)] = before
            del self.data[size:]
        for start, content, _, _ in lost:
            if (chance := rng.random()) < 0.7:
                if content is not None and chance > 0.5:  # a disk writes whole sectors
                    content = content[: SECTOR * rng.randrange(len(content) // SECTOR + 1)]
                self._change(start, content)


class Disk:
    """The disk of one process.

    Attributes:
        full: Writes fail for lack of space, after a part of them.
        broken: Number of calls until one fails with an I/O error; 0 for none.
        crash_in: Number of changing calls until the process crashes; 0 for never.
    """

    def __init__(self, rng: Random) -> None:
        self.full = False
        self.broken = self.crash_in = 0
        self.power = self._crashed = False
        self._rng = rng
        self.names: dict[str, File] = {}
        self._durable: dict[str, File] = {}
        self._open: dict[int, tuple[str, File]] = {}
        self._next = 1000
        self.connections: list[SimulatedConnection] = []

    def path(self, name: str) -> "DiskPath":
        """Path of a file."""
        return DiskPath(self, name)

    def lose(self, *, power: bool) -> None:
        """Lose what a killed process, or a machine without power, loses."""
        if not power:
            return
        for name in sorted(self.names.keys() | self._durable.keys()):  # each change of a name that no fsync has kept
            if self.names.get(name) is not self._durable.get(name) and self._rng.random() < 0.5:
                self.names.pop(name, None)
                if name in self._durable:
                    self.names[name] = self._durable[name]
        for name in sorted(self.names):
            self.names[name].lose(self._rng)
        self._durable = dict(self.names)

    def copy(self) -> dict[str, bytes]:
        """Return the content of all files."""
        return {name: bytes(file.data) for name, file in self.names.items()}

    def restore(self, files: dict[str, bytes]) -> None:
        """Replace all files by copies."""
        self.names = {name: File(bytearray(content)) for name, content in files.items()}
        self._durable = dict(self.names)

    def close_all(self) -> None:
        """Close what an ended process had open."""
        self._open.clear()
        for connection in self.connections:
            connection.die()
        self.connections.clear()
        self.crash_in, self._crashed = 0, False

    # Calls of `os`

    def open(self, path: "DiskPath", flags: int, mode: int = 0o777) -> int:
        self._next += 1
        if path.name == "":
            self._open[self._next] = "", File()
            return self._next
        if path.name not in self.names:
            self.create(path.name)
        file = self.names[path.name]
        if flags & os.O_TRUNC:
            file.truncate(0)
        self._open[self._next] = path.name, file
        return self._next

    def close(self, handle: int) -> None:
        self._open.pop(handle, None)

    def write(self, handle: int, content: bytes | memoryview) -> int:
        file, content = self._open[handle][1], bytes(content)
        if len(content) > 1 and self._rng.random() < 0.05:
            content = content[: self._rng.randrange(1, len(content))]
        self.write_at(file, len(file.data), content)
        return len(content)

    def write_at(self, file: File, start: int, content: bytes) -> None:
        """Write at a place of a file, as pwrite(2)."""
        end = start + self._rng.randrange(len(content) + 1)
        if end < len(file.data):  # what is there is replaced by whole sectors
            end = max(start, end // SECTOR * SECTOR)
        part = content[: end - start]
        if self.full:
            file.write(start, part)
            raise OSError(errno.ENOSPC, "No space left on device")
        if self.crash_in == 1:
            file.write(start, part)
        self._before("write")
        file.write(start, content)

    def fsync(self, handle: int) -> None:
        name, file = self._open[handle]
        self.sync(file if name else None)

    def sync(self, file: File | None) -> None:
        """Write a file through, or the names of the folder."""
        self._before("fsync")
        if self.broken:
            self.broken -= 1
            if not self.broken:
                raise OSError(errno.EIO, "Input/output error")
        if file is None:
            self._durable = dict(self.names)
        else:
            file.sync()
        self._before("return from fsync")

    def truncate(self, file: File, size: int) -> None:
        """Cut a file."""
        self._before("truncate")
        file.truncate(size)

    def replace(self, draft: str, name: str) -> None:
        self._before("rename")
        self.names[name] = self.names.pop(draft)

    def create(self, name: str) -> None:
        """Create an empty file."""
        self._before("create")
        self.names[name] = File()

    def remove(self, name: str) -> None:
        """Remove a file."""
        self._before("unlink")
        self.names.pop(name, None)

    def random_bytes(self, count: int) -> bytes:
        """Return random bytes, the same in every run of a seed."""
        return self._rng.randbytes(count)

    def end_if_crashed(self) -> None:
        """End the process, if it has crashed in a call whose error somebody has caught."""
        if self._crashed:
            raise Crash("a call of SQLite", power=self.power)

    def unlink(self, name: str) -> None:
        if not self._crashed:  # a killed process cleans nothing up
            self.names.pop(name, None)

    def _before(self, call: str) -> None:
        if self._crashed:
            raise Crash(call, power=self.power)
        if self.crash_in:
            self.crash_in -= 1
            if not self.crash_in:
                self._crashed = True
                raise Crash(call, power=self.power)


class DiskPath:
    """A path on a simulated disk; its folder has the name ""."""

    def __init__(self, disk: Disk, name: str) -> None:
        self.disk, self.name = disk, name

    @property
    def parent(self) -> "DiskPath":
        return DiskPath(self.disk, "")

    def with_name(self, name: str) -> "DiskPath":
        return DiskPath(self.disk, name)

    def __truediv__(self, name: str) -> "DiskPath":
        return DiskPath(self.disk, name)

    def __str__(self) -> str:
        return self.name

    def touch(self, mode: int = 0o666) -> None:
        self.disk.close(self.disk.open(self, 0, mode))

    def resolve(self) -> "DiskPath":
        return self  # there are no links

    def is_file(self) -> bool:
        return self.exists() and not self.is_dir()

    def is_dir(self) -> bool:
        return self.name == ""

    def exists(self) -> bool:
        return self.name in self.disk.names

    def mkdir(self, *, parents: bool = False, exist_ok: bool = False) -> None:
        """Do nothing: the folder is there."""

    def replace(self, other: "DiskPath") -> None:
        self.disk.replace(self.name, other.name)

    def unlink(self, *, missing_ok: bool = False) -> None:
        self.disk.unlink(self.name)

    def iterdir(self) -> list["DiskPath"]:
        return [DiskPath(self.disk, name) for name in self.disk.names]

    def read_bytes(self) -> bytes:
        if not self.exists():
            raise FileNotFoundError(errno.ENOENT, "No such file", self.name)
        return bytes(self.disk.names[self.name].data)

    def write_bytes(self, content: bytes) -> None:
        handle, rest = self.disk.open(self, os.O_TRUNC), memoryview(content)
        while rest:
            rest = rest[self.disk.write(handle, rest) :]
        self.disk.close(handle)

    def open(self, mode: str, **options: Any) -> "_Log":
        return _Reader(self.disk, self.disk.open(self, 0)) if mode == "rb" else _Log(self.disk)


class _Log:
    """An open log, whose content nobody reads."""

    def __init__(self, disk: Disk) -> None:
        self._disk = disk

    def write(self, text: str | bytes) -> int:
        if self._disk.full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return len(text)

    def flush(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""

    def __enter__(self) -> "_Log":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class _Reader(_Log):
    """A file that is open for `fsync`."""

    def __init__(self, disk: Disk, handle: int) -> None:
        super().__init__(disk)
        self._handle = handle

    def fileno(self) -> int:
        return self._handle

    def close(self) -> None:
        self._disk.close(self._handle)


class DiskCalls:
    """Stands for `os` in a module: calls go to the disk of the running process, the rest to `os`."""

    def __init__(self, disk: Callable[[], Disk]) -> None:
        self._disk = disk

    def __getattr__(self, name: str) -> Any:
        if name in ("open", "close", "write", "fsync"):
            return getattr(self._disk(), name)
        return getattr(os, name)


# SQLite


class SimulatedConnection(apsw.Connection):
    """A connection to a database on a simulated disk. A crash during a call ends the call, as it ends the process."""

    def __init__(self, files: "SqliteFiles", disk: Disk, name: str) -> None:
        self.disk, self.alive = disk, True
        self._key = files.add(self)
        disk.connections.append(self)
        super().__init__(f"/{self._key}/{name}", vfs=files.NAME)

    def die(self) -> None:
        """End with the process, which can change no file any more."""
        self.alive = False
        self.close(True)

    def execute(self, *args: Any, **options: Any) -> Any:
        with self._crash():
            return super().execute(*args, **options)

    def pragma(self, *args: Any, **options: Any) -> Any:
        with self._crash():
            return super().pragma(*args, **options)

    def __exit__(self, *error: Any) -> Any:
        with self._crash():
            return super().__exit__(*error)

    @contextmanager
    def _crash(self) -> Iterator[None]:
        try:
            yield
        finally:
            self.disk.end_if_crashed()


class SqliteFiles(apsw.VFS):
    """The file system of all simulated databases; `with` it, SQLite knows it. Names are `/CONNECTION/FILE`."""

    NAME = "simulated"

    def __init__(self) -> None:
        super().__init__(self.NAME, base="")
        self._connections: list[SimulatedConnection] = []

    def __enter__(self) -> "SqliteFiles":
        return self

    def __exit__(self, *exc: object) -> None:
        self.unregister()

    def add(self, connection: SimulatedConnection) -> int:
        """Add a connection, and return its number."""
        self._connections.append(connection)
        return len(self._connections) - 1

    def _find(self, path: Any) -> tuple[SimulatedConnection, str]:
        _, number, name = path.split("/")
        return self._connections[int(number)], name

    def xOpen(self, name: Any, flags: list[int]) -> Any:
        connection, file = self._find(name.filename() if isinstance(name, apsw.URIFilename) else name)
        log = bool(flags[0] & (apsw.SQLITE_OPEN_WAL | apsw.SQLITE_OPEN_MAIN_JOURNAL))
        if connection.alive and file not in connection.disk.names:
            with _errors():
                connection.disk.create(file)
        return SqliteFile(connection, connection.disk.names.get(file, File()), syncs_names=log)

    def xDelete(self, filename: str, syncdir: bool) -> None:
        connection, file = self._find(filename)
        if connection.alive:
            with _errors():
                connection.disk.remove(file)
                if syncdir:
                    connection.disk.sync(None)

    def xAccess(self, pathname: str, flags: int) -> bool:
        connection, file = self._find(pathname)
        return file in connection.disk.names

    def xFullPathname(self, name: str) -> str:
        return name

    def xRandomness(self, numbytes: int) -> bytes:
        return self._connections[-1].disk.random_bytes(numbytes)

    def xCurrentTime(self) -> float:
        return 2_460_000.5

    def xSleep(self, microseconds: int) -> int:
        return microseconds

    def xGetLastError(self) -> tuple[int, str]:
        return 0, ""


class SqliteFile:
    """One open file of a simulated database."""

    def __init__(self, connection: SimulatedConnection, file: File, *, syncs_names: bool) -> None:
        self._connection, self._file, self._syncs_names = connection, file, syncs_names

    def xRead(self, amount: int, offset: int) -> bytes:
        return bytes(self._file.data[offset : offset + amount])

    def xWrite(self, data: bytes, offset: int) -> None:
        if self._connection.alive:
            with _errors():
                self._connection.disk.write_at(self._file, offset, bytes(data))

    def xTruncate(self, size: int) -> None:
        if self._connection.alive:
            with _errors():
                self._connection.disk.truncate(self._file, size)

    def xSync(self, flags: int) -> None:
        if self._connection.alive:
            with _errors():
                self._connection.disk.sync(self._file)
                if self._syncs_names:  # the first sync of a new log, as SQLite does on Unix
                    self._connection.disk.sync(None)
                    self._syncs_names = False

    def xFileSize(self) -> int:
        return len(self._file.data)

    def xFileControl(self, op: int, pointer: int) -> bool:
        return False

    def xDeviceCharacteristics(self) -> int:
        return apsw.SQLITE_IOCAP_POWERSAFE_OVERWRITE

    def xSectorSize(self) -> int:
        return 4096

    def xLock(self, level: int) -> None:
        """Do nothing: no other process uses the disk."""

    xUnlock = xLock

    def xCheckReservedLock(self) -> bool:
        return False

    def xClose(self) -> None:
        """Do nothing."""


@contextmanager
def _errors() -> Iterator[None]:
    """Turn an error of the disk, or the crash of the process, into one of SQLite."""
    try:
        yield
    except OSError as error:
        raise (apsw.FullError if error.errno == errno.ENOSPC else apsw.IOError)(str(error)) from None
    except Crash as crash:
        raise apsw.IOError(str(crash)) from None
