"""What other threads hand to the one that reads, which waits for it no longer than it says."""

import math
import time
from collections import deque
from contextlib import suppress
from queue import Empty
from threading import TIMEOUT_MAX, Lock
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Mailbox(Generic[Item]):
    """A queue whose `get` comes back in time, whichever signals come.

    That of `queue.SimpleQueue` does not: in CPython 3.11 one that a signal interrupts just before its time is up goes
    on with a time below zero, which is for ever. Of 60 replays that were told to end, 9 never did. A lock keeps its
    time.

    Any thread may `put`, one reads.
    """

    def __init__(self) -> None:
        self._items: deque[Item] = deque()
        self._bell = Lock()
        self._bell.acquire()

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Item) -> None:
        """Hand something over; never waits."""
        self._items.append(item)
        with suppress(RuntimeError):  # it has rung, and nobody has heard it yet
            self._bell.release()

    def get(self, until_s: float = -math.inf) -> Item:
        """The oldest that is there, or that comes until `time.monotonic()` is `until_s`.

        Raises:
            queue.Empty: nothing came.
        """
        while True:
            try:
                return self._items.popleft()
            except IndexError:
                wait_s = until_s - time.monotonic()
            if wait_s <= 0:
                raise Empty
            self._bell.acquire(timeout=min(wait_s, TIMEOUT_MAX))  # one left over from earlier rings at once: look again
