"""What onlookers at a distance get told: a numbered stream of words, and a bounded letter box for each reader.

A reader that is slow misses telemetry (the newest word of each arm replaces the one before) and never delays anybody;
one that falls so far behind that events would be lost is dropped, and asks again from the last number it has seen.
"""

from collections import OrderedDict, deque
from dataclasses import dataclass, field

THREAD = 1024
"""Events and results that one who comes back can still get."""
MOST_NAMES = 4096
MOST_WAITING = 256
"""Events and results that wait for one reader."""
NEWEST_WINS = ("state", "difficulty", "info", "bid", "presence", "announce")
"""Topics of which only the newest word of each name counts; of all others every word does."""


@dataclass(frozen=True)
class Entry:
    """One word of the stream."""

    number: int
    """From 1, never the same again."""
    topic: str
    name: str
    """Of the arm or auctioneer."""
    data: str
    """JSON on one line."""


@dataclass
class Feed:
    """The newest word of each name and topic, and the last events and results."""

    number: int = 0
    _newest: "OrderedDict[tuple[str, str], Entry]" = field(default_factory=OrderedDict[tuple[str, str], Entry])
    _thread: "deque[Entry]" = field(default_factory=lambda: deque[Entry](maxlen=THREAD))
    _forgotten: int = 0
    """Number of the last event or result that is no longer there."""

    def add(self, topic: str, name: str, data: str) -> Entry:
        """Number a word and remember it."""
        self.number += 1
        entry = Entry(self.number, topic, name, data)
        if topic in NEWEST_WINS:
            keep_newest(self._newest, entry)
        else:
            if len(self._thread) == THREAD:
                self._forgotten = self._thread[0].number
            self._thread.append(entry)
        return entry

    def since(self, number: int) -> tuple[list[Entry], bool]:
        """What came after a number, in order, and whether events are missing between them."""
        entries = [entry for entry in (*self._newest.values(), *self._thread) if entry.number > number]
        return sorted(entries, key=lambda entry: entry.number), number < self._forgotten


@dataclass
class Letterbox:
    """What waits for one reader."""

    full: bool = False
    """Events were lost: the reader is to be dropped."""
    _newest: "OrderedDict[tuple[str, str], Entry]" = field(default_factory=OrderedDict[tuple[str, str], Entry])
    _thread: list[Entry] = field(default_factory=list[Entry])

    def put(self, entry: Entry) -> None:
        """Add a word; does nothing more once it is full."""
        if self.full:
            return
        if entry.topic in NEWEST_WINS:
            keep_newest(self._newest, entry)
        elif len(self._thread) < MOST_WAITING:
            self._thread.append(entry)
        else:
            self.full = True
            self._newest.clear()
            self._thread.clear()

    def take(self) -> list[Entry]:
        """All that waits, in order; the box is empty then."""
        entries = sorted((*self._newest.values(), *self._thread), key=lambda entry: entry.number)
        self._newest.clear()
        self._thread.clear()
        return entries


def keep_newest(newest: "OrderedDict[tuple[str, str], Entry]", entry: Entry) -> None:
    """Put a word in the place of the one before of its name and topic; the oldest name goes when there are too many."""
    where = (entry.topic, entry.name)
    newest[where] = entry
    newest.move_to_end(where)
    if len(newest) > MOST_NAMES:
        newest.popitem(last=False)
