"""Between the threads that receive and the one that reads: a queue to wait on, and what was last said by whom."""

import math
from collections import deque
from contextlib import suppress
from queue import Empty
from typing import Generic, TypeVar

from fleet.bus.exchange import Condition, Scores
from fleet.bus.mailbox import Mailbox

Content = TypeVar("Content", Condition, Scores)
Item = TypeVar("Item")


class LastWords(Generic[Content]):
    """The last words of one topic that one arm received, per sender."""

    def __init__(self, arms: int) -> None:
        self.ticks = [-1] * arms
        self.words: list[Content | None] = [None] * arms

    def forget(self, tick: int) -> None:
        """Know nothing, and keep nothing that was said at `tick` or before."""
        self.ticks = [tick] * len(self.ticks)
        self.words = [None] * len(self.words)

    def keep(self, sender: int, tick: int, word: Content) -> bool:
        """Whether the word is newer than what was known of the sender."""
        if tick <= self.ticks[sender]:
            return False
        self.ticks[sender] = tick
        self.words[sender] = word
        return True

    def of(self, tick: int) -> list[Content | None]:
        """Those words that were said at a tick, [sender]."""
        return [word if said == tick else None for said, word in zip(self.ticks, self.words, strict=True)]


class Inbox(Generic[Item]):
    """Samples on their way from receiving threads to the one that reads; full, it lets go of the oldest.

    The reader is woken once, when as many have come as it waits for: a wake for each would cost more than reading it.
    """

    def __init__(self, limit: int) -> None:
        self._samples: deque[Item] = deque(maxlen=limit)
        self._limit = limit
        self._wanted = math.inf
        self._enough: Mailbox[None] = Mailbox()

    def hear(self, sample: Item) -> None:
        """Take a sample; called by receiving threads."""
        self._samples.append(sample)
        if len(self._samples) >= self._wanted:
            self._wanted = math.inf
            self._enough.put(None)

    def wait(self, count: int, deadline_s: float) -> None:
        """Return when `count` samples are there, when time is up, or now and then earlier."""
        self._wanted = min(count, self._limit)
        if len(self._samples) < self._wanted:
            with suppress(Empty):
                self._enough.get(deadline_s)
        self._wanted = math.inf

    def take(self) -> list[Item]:
        """All that is there, oldest first."""
        return [self._samples.popleft() for _ in range(len(self._samples))]
