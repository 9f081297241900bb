"""A queue from any thread to one reader, whose waits end in time."""

import math
import socket
import time
import weakref
from collections import deque
from queue import Empty
from typing import Generic, TypeVar

Item = TypeVar("Item")

_LONGEST_WAIT_S = 3600.0
"""Of one system call; then the reader looks again."""


class Mailbox(Generic[Item]):
    """A queue whose waits end in time, whichever signals arrive; the reader may wait for several items at once.

    `queue.SimpleQueue.get` does not: in CPython 3.11 a signal just before its timeout makes it wait with a negative
    timeout, which is for ever. Of 60 replays that were asked to stop, 9 never did. Here the reader waits for a byte
    on a socket, whose timeouts hold, and which also wakes it some 30 µs sooner than a lock of Python does.

    Any thread may `put`, one reads.
    """

    def __init__(self) -> None:
        self._items: deque[Item] = deque()
        self._wanted = 1
        self._urgent = self._rung = False
        self._bell, self._ringer = socket.socketpair()
        self._at_exit = weakref.finalize(self, _close, self._bell, self._ringer)

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Item, *, urgent: bool = False) -> None:
        """Append an item; never waits. An urgent one wakes the reader, however many it waits for."""
        self._items.append(item)
        if urgent:
            self._urgent = True
        if (urgent or len(self._items) >= self._wanted) and not self._rung:
            self._rung = True
            self._ringer.send(b"\0")

    def wait(self, count: int = 1, until_s: float = math.inf) -> bool:
        """Whether `count` items, or an urgent one, are there before `time.monotonic()` is `until_s`."""
        self._wanted = count
        try:
            while len(self._items) < count and not self._urgent:
                wait_s = until_s - time.monotonic()
                if wait_s <= 0:
                    return False
                self._bell.settimeout(min(wait_s, _LONGEST_WAIT_S))
                try:
                    self._bell.recv(4096)
                except TimeoutError:
                    continue
                self._rung = False  # before the items are counted again: what is put from now on rings again
            return True
        finally:
            self._wanted, self._urgent = 1, False

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


def _close(*ends: socket.socket) -> None:
    for end in ends:
        end.close()
