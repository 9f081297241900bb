"""Numbered stream of messages for slow readers, and a bounded buffer for each reader.

A slow reader misses telemetry (the newest message of each arm replaces the one before) and never delays the others. A
reader that falls so far behind that events would be lost is dropped; it reconnects with the last number it has seen.
"""

from collections import deque
from dataclasses import dataclass, field

from fleet.live.monitor.recent import Recent

HISTORY = 1024
"""Events and results that a reader can still get after it reconnects."""
MAX_NAMES = 4096
MAX_WAITING = 256
"""Events and results that wait for one reader."""
NEWEST_ONLY = ("state", "difficulty", "info", "bid", "presence", "announce")
"""Topics of which only the newest message of each name counts; of all others every message does."""


@dataclass(frozen=True)
class Entry:
    """One message of the stream."""

    number: int
    """Counts from 1."""
    topic: str
    name: str
    """Of the arm or auctioneer."""
    data: str
    """JSON on one line."""


def _newest() -> "Recent[tuple[str, str], Entry]":
    """The newest entry of each topic and name."""
    return Recent(MAX_NAMES)


@dataclass
class EventFeed:
    """The newest message of each name and topic, and the last events and results."""

    number: int = 0
    _newest: "Recent[tuple[str, str], Entry]" = field(default_factory=_newest)
    _events: "deque[Entry]" = field(default_factory=lambda: deque[Entry](maxlen=HISTORY))
    _dropped: int = 0
    """Number of the last event or result that is no longer kept."""

    def add(self, topic: str, name: str, data: str) -> Entry:
        """Number a message and keep it."""
        self.number += 1
        entry = Entry(self.number, topic, name, data)
        if topic in NEWEST_ONLY:
            self._newest[topic, name] = entry
        else:
            if len(self._events) == HISTORY:
                self._dropped = self._events[0].number
            self._events.append(entry)
        return entry

    def since(self, number: int) -> tuple[list[Entry], bool]:
        """Return the entries after a number, in order, and whether events between them were dropped."""
        entries = [entry for entry in (*self._newest.values(), *self._events) if entry.number > number]
        return sorted(entries, key=lambda entry: entry.number), number < self._dropped


@dataclass(eq=False)
class ReaderBuffer:
    """Entries that wait for one reader."""

    full: bool = False
    """Events were lost: the reader is to be dropped."""
    _newest: "Recent[tuple[str, str], Entry]" = field(default_factory=_newest)
    _events: list[Entry] = field(default_factory=list[Entry])

    def put(self, entry: Entry) -> None:
        """Add an entry; once full, do nothing."""
        if self.full:
            return
        if entry.topic in NEWEST_ONLY:
            self._newest[entry.topic, entry.name] = entry
        elif len(self._events) < MAX_WAITING:
            self._events.append(entry)
        else:
            self.full = True
            self.take()

    def take(self) -> list[Entry]:
        """Remove and return all waiting entries, in order."""
        entries = sorted((*self._newest.values(), *self._events), key=lambda entry: entry.number)
        self._newest.clear()
        self._events.clear()
        return entries
