"""Jobs that have left a ledger: two hashes and the outcome of each, 16 bytes, for the last of them.

A job that is settled leaves memory and journal; the recording has it. Its name must not be used again: a submission
that is repeated late would be done twice. The last `MAX_PAST` names are known, at one job in 10 s those of 11 days.
"""

from collections import deque
from collections.abc import Container, Iterator
from hashlib import blake2b
from struct import iter_unpack, pack

from msgspec import Struct

from fleet.bus.protocol.auction import JobSpec
from fleet.bus.protocol.messages import encode

MAX_PAST = 100_000
"""Jobs whose names are known after they have left the ledger."""


def hash_of(content: bytes) -> int:
    """Return 64 bits, the same in every process."""
    return int.from_bytes(blake2b(content, digest_size=8).digest(), "little")


def content_hash(message: Struct) -> int:
    """Return a hash of the content of a message."""
    return hash_of(encode(message))


def _spec_hash(job: JobSpec) -> int:
    """Hash of a job without the lowest bit, which says whether it was finished."""
    return content_hash(job) & ~1


class PastJobs(Container[str]):
    """Names of the last jobs that have left a ledger.

    Attributes:
        limit: How many are known at most.
    """

    def __init__(self, packed: bytes = b"", limit: int = MAX_PAST) -> None:
        """Start with jobs as `packed` returns them."""
        self.limit = limit
        self._jobs: dict[int, int] = {}
        self._order: deque[int] = deque()
        for name, value in iter_unpack("<QQ", packed):
            self._put(name, value)

    def add(self, job: JobSpec | str, *, finished: bool) -> None:
        """Add a job that is finished, or given up; the oldest one is dropped if there are too many.

        Args:
            job: A job, or the name of one of unknown content, which is the same as any other of that name.
        """
        name, content = (job, 0) if isinstance(job, str) else (job.name, _spec_hash(job))
        self._put(hash_of(name.encode()), content | finished)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and hash_of(name.encode()) in self._jobs

    def __len__(self) -> int:
        return len(self._jobs)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PastJobs) and self._jobs == other._jobs

    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def is_same(self, job: JobSpec) -> bool:
        """Return whether a job of this name is known, and is this one."""
        return self._jobs.get(hash_of(job.name.encode()), -1) & ~1 in (0, _spec_hash(job))

    def is_finished(self, name: str) -> bool:
        """Return whether a job of this name is known, and was finished."""
        return bool(self._jobs.get(hash_of(name.encode()), 0) & 1)

    def is_given_up(self, name: str) -> bool:
        """Return whether a job of this name is known, and was given up."""
        return not self._jobs.get(hash_of(name.encode()), 1) & 1

    def packed(self) -> bytes:
        """Return all jobs, oldest first."""
        return b"".join(pack("<QQ", name, value) for name, value in self._items())

    def _items(self) -> Iterator[tuple[int, int]]:
        return ((name, self._jobs[name]) for name in self._order)

    def _put(self, name: int, value: int) -> None:
        if name not in self._jobs:
            self._order.append(name)
            if len(self._order) > self.limit:
                del self._jobs[self._order.popleft()]
        self._jobs[name] = value
