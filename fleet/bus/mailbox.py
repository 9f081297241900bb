"""A queue from any thread to one reader, whose waits end in time."""

import math
import os
import select
import time
import weakref
from collections import deque
from collections.abc import Iterator
from queue import Empty
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

    def __init__(self) -> None:
        self._items: deque[Item] = deque()
        self._wanted = math.inf
        """Number of items the blocked reader waits for; inf if none is blocked."""
        self._urgent = self._rung = False
        self._bell, self._ringer = os.pipe()
        self._poll = select.poll()
        self._poll.register(self._bell, select.POLLIN)
        self._at_exit = weakref.finalize(self, _close, self._bell, self._ringer)

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Item, *, urgent: bool = False) -> None:
        """Append an item; never waits. An urgent one wakes the reader, however many it waits for."""
        self._items.append(item)
        if urgent:
            self._urgent = True
        if (len(self._items) >= self._wanted or (urgent and self._wanted < math.inf)) and not self._rung:
            self._rung = True
            os.write(self._ringer, b"\0")

    def wait(self, count: int = 1, until_s: float = math.inf) -> bool:
        """Whether `count` items, or an urgent one, are there before `time.monotonic()` is `until_s`."""
        self._wanted = count
        try:
            while len(self._items) < count and not self._urgent:
                wait_s = until_s - time.monotonic()
                if wait_s <= 0:
                    return False
                if self._poll.poll(1000 * min(wait_s, _LONGEST_WAIT_S)):
                    os.read(self._bell, 1)
                    self._rung = False  # before the items are counted again: a later put then rings again
            return True
        finally:
            self._wanted, self._urgent = math.inf, False

    def get(self, until_s: float = -math.inf) -> Item:
        """The oldest item that is there, or that arrives until `time.monotonic()` is `until_s`.

        Raises:
            queue.Empty: nothing arrived.
        """
        if not self._items and not self.wait(1, until_s):
            raise Empty
        try:
            return self._items.popleft()
        except IndexError:  # another thread made room
            raise Empty from None

    def drain(self) -> Iterator[Item]:
        """Take the items that are there now, oldest first."""
        for _ in range(len(self._items)):
            try:
                item = self._items.popleft()
            except IndexError:  # another thread made room
                return
            yield item


def _close(*ends: int) -> None:
    for end in ends:
        os.close(end)
