"""A queue from any thread to one reader, whose waits end in time."""

import math
import os
import select
import time
import weakref
from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

Item = TypeVar("Item")

_LONGEST_WAIT_S = 3600.0
"""Of one system call; then the reader looks again."""


class Mailbox(Generic[Item]):
    """A queue whose waits end in time, whichever signals arrive; the reader may wait for several items at once.

    `queue.SimpleQueue.get` does not: in CPython 3.11 a signal just before its timeout makes it wait with a negative
    timeout, without end. Here the reader waits for a byte in a pipe, which keeps its timeouts.

    Any thread may `put`, one reads.
    """

    def __init__(self, most: int | None = None) -> None:
        """Prepare a queue of at most `most` items; None for any number."""
        self._items: deque[Item] = deque(maxlen=most)
        self._wanted = math.inf
        """Number of items the blocked reader waits for; inf if none is blocked."""
        self._urgent = self._rung = False
        self._bell, self._ringer = os.pipe()
        self._poll = select.poll()
        self._poll.register(self._bell, select.POLLIN)
        self._at_exit = weakref.finalize(self, _close, self._bell, self._ringer)

    def put(self, item: Item, *, urgent: bool = False) -> bool:
        """Append an item, without waiting; return whether the queue was full and has dropped the oldest item.

        An urgent item wakes the reader, whatever number of items it waits for.
        """
        full = len(self._items) == self._items.maxlen
        self._items.append(item)
        if urgent:
            self._urgent = True
        if (len(self._items) >= self._wanted or (urgent and self._wanted < math.inf)) and not self._rung:
            self._rung = True
            os.write(self._ringer, b"\0")
        return full

    def take(self, until_s: float = -math.inf, *, count: int = 1) -> Iterator[Item]:
        """Wait until `time.monotonic()` is `until_s`, or `count` items or an urgent one are there; yield all that are.

        The oldest comes first. Items that the caller does not iterate over stay in the queue.
        """
        self._wanted = count
        try:
            while len(self._items) < count and not self._urgent:
                wait_s = until_s - time.monotonic()
                if wait_s <= 0:
                    break
                if self._poll.poll(1000 * min(wait_s, _LONGEST_WAIT_S)):
                    os.read(self._bell, 1)
                    self._rung = False  # before the items are counted again: a later put then rings again
        finally:
            self._wanted, self._urgent = math.inf, False
        for _ in range(len(self._items)):
            yield self._items.popleft()


def _close(*ends: int) -> None:
    for end in ends:
        os.close(end)
