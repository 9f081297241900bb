"""A simulated disk: files in memory that may be full, fail, or lose what was not written through.

`Disk` offers the calls of `os` that `fleet.live.journal` uses, and `DiskPath` those of `pathlib.Path`. A crash is
possible before, in the middle of, and after each call that changes a file.
"""

import errno
import io
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from types import SimpleNamespace
from typing import Any


class Crash(BaseException):  # no handler of the product may catch it
    """The process is killed during a call; with `power`, its machine loses power."""

    def __init__(self, call: str, *, power: bool) -> None:
        super().__init__(call)
        self.power = power


@dataclass(eq=False)
class File:
    """Content of a file, and how much of it is written through."""

    data: bytearray = field(default_factory=bytearray)
    synced: int = 0


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
        self._locked: dict[int, str] = {}
        self._next = 1000

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
        for file in self.names.values():
            kept = self._rng.randint(file.synced, max(file.synced, len(file.data)))
            del file.data[kept:]

    def close_all(self) -> None:
        """Close what an ended process had open."""
        self._open.clear()
        self._locked.clear()
        self.crash_in, self._crashed = 0, False

    # Calls of `os`

    def open(self, path: "DiskPath", flags: int, mode: int = 0o777) -> int:
        self._next += 1
        if path.name == "":
            self._open[self._next] = "", File()
            return self._next
        if path.name not in self.names:
            self._before("create")
            self.names[path.name] = File()
        file = self.names[path.name]
        if flags & os.O_TRUNC:
            file.data.clear()
            file.synced = 0
        self._open[self._next] = path.name, file
        return self._next

    def close(self, handle: int) -> None:
        self._open.pop(handle, None)
        self._locked.pop(handle, None)

    def dup(self, handle: int) -> int:
        return handle

    def fstat(self, handle: int) -> Any:
        return SimpleNamespace(st_size=len(self._open[handle][1].data))

    def write(self, handle: int, content: bytes | memoryview) -> int:
        file, content = self._open[handle][1], bytes(content)
        part = self._rng.randrange(len(content) + 1)
        if self.full:
            file.data += content[: part // 2]
            raise OSError(errno.ENOSPC, "No space left on device")
        if self.crash_in == 1:
            file.data += content[:part]
        self._before("write")
        if len(content) > 1 and self._rng.random() < 0.05:
            content = content[: max(1, part)]
        file.data += content
        return len(content)

    def fsync(self, handle: int) -> None:
        name, file = self._open[handle]
        self._before("fsync")
        if self.broken:
            self.broken -= 1
            if not self.broken:
                raise OSError(errno.EIO, "Input/output error")
        if name:
            file.synced = len(file.data)
        else:
            self._durable = dict(self.names)
        self._before("return from fsync")

    def ftruncate(self, handle: int, size: int) -> None:
        file = self._open[handle][1]
        self._before("truncate")
        del file.data[size:]
        file.synced = min(file.synced, size)

    def flock(self, handle: int, operation: int) -> None:
        name = self._open[handle][0]
        if name in self._locked.values():
            raise BlockingIOError
        self._locked[handle] = name

    def read(self, handle: int) -> io.BytesIO:
        return io.BytesIO(bytes(self._open[handle][1].data))

    def replace(self, draft: str, name: str) -> None:
        self._before("rename")
        self.names[name] = self.names.pop(draft)

    def unlink(self, name: str) -> None:
        if not self._crashed:  # a killed process cleans nothing up
            self.names.pop(name, None)

    def _before(self, call: str) -> None:
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
    """Stands for `os` in the journal module: calls go to the disk of the running process, the rest to `os`."""

    def __init__(self, disk: Callable[[], Disk]) -> None:
        self._disk = disk

    def __getattr__(self, name: str) -> Any:
        if name in ("open", "close", "dup", "fstat", "write", "fsync", "ftruncate"):
            return getattr(self._disk(), name)
        return getattr(os, name)
