"""Fetch missed messages from the caches of their publishers.

An advanced subscriber asks a cache once when it detects a gap. If the router or the publisher is away at that moment,
the messages stay missing. So a second session subscribes to the same keys with history, which sends the whole cache.
Where no gap is known it does the same from time to time: a sender's last message may be missing.
"""

from collections import Counter
from collections.abc import Callable

from fleet.bus.client.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, Result
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import Operation
from fleet.errors import BusError
from scenarios.live.recorder import Recorder
from scenarios.live.recording import Message

FETCH_S, PAUSE_S = 2.0, 3.0
"""Real seconds: how long the caches have to reply; between two attempts."""
ATTEMPTS = 4
"""Attempts before the messages count as lost."""
MAX_KEYS = 64
"""Senders asked in one attempt."""
SWEEP_S, SWEEP_KEYS = 60.0, 8
"""Real seconds between two sweeps, and senders asked in one, by turns: a cache may hold a thousand messages."""


class GapFetcher:
    """Seeks what a recorder misses: call `step` often.

    Args:
        connect: Makes a client of the fleet, which is not open yet.
    """

    def __init__(self, recorder: Recorder, connect: Callable[[], BusClient]) -> None:
        self._recorder, self._connect = recorder, connect
        self._link: BusClient | None = None
        self._asked: tuple[str, ...] = ()
        self._tries: Counter[str] = Counter()
        self._due_s = self._swept_s = 0.0
        self._swept = 0

    def step(self, real_s: float) -> None:
        """Handle replies; begin or end an attempt if it is due."""
        if self._link is not None:
            self._link.serve()
        if real_s < self._due_s:
            return
        if self._link is not None:
            self.close()
            self._count()
            self._due_s = real_s + PAUSE_S
        elif senders := tuple(dict.fromkeys(gap.sender for gap in self._recorder.sought))[:MAX_KEYS]:
            self._due_s = real_s + FETCH_S
            self._begin(senders)
        elif real_s >= self._swept_s + SWEEP_S:
            self._due_s, self._swept_s = real_s + FETCH_S, real_s
            self._begin(self._next_senders())

    def close(self) -> None:
        """End the attempt."""
        if self._link is not None:
            self._link.close()
            self._link = None

    def _next_senders(self) -> tuple[str, ...]:
        """Return the senders of the next sweep: those of results and operations, which are few, first."""
        known = sorted({name.partition(", epoch")[0] for name in self._recorder.counts} - {""}, reverse=True)
        central = [name for name in known if name.startswith(("results", "operations"))][:SWEEP_KEYS]
        arms = [name for name in known if name.startswith("events")]
        start, self._swept = self._swept % max(1, len(arms)), self._swept + SWEEP_KEYS
        return (*central, *dict.fromkeys((arms[start:] + arms)[:SWEEP_KEYS]))

    def _begin(self, senders: tuple[str, ...]) -> None:
        link = self._connect()
        try:
            link.open()
        except BusError:  # no router: the next attempt is due soon, and this one does not count
            return
        self._link, self._asked = link, senders
        for sender in senders:
            label, _, name = sender.partition(" of ")
            key, kind = _channel(link.fleet, label, name)
            link.subscribe(key, kind, self._recorder.add, history=True)

    def _count(self) -> None:
        """Give up the gaps of senders that were asked often enough."""
        missing = {gap.sender for gap in self._recorder.sought}
        self._tries = Counter({sender: self._tries[sender] + (sender in self._asked) for sender in missing})
        for gap in list(self._recorder.sought):
            if self._tries[gap.sender] >= ATTEMPTS:
                self._recorder.give_up(gap, f"not in the cache of its publisher, asked {ATTEMPTS} times")
        self._tries = Counter({sender: count for sender, count in self._tries.items() if count < ATTEMPTS})


def _channel(fleet: str, label: str, name: str) -> tuple[str, type[Message]]:
    """Key and message of a sender, as `Series.sender` names it."""
    match label:
        case "results":
            return keys.of_auction(fleet, name, "result"), Result
        case "operations":
            return keys.of_auction(fleet, name, "operation"), Operation
        case "events":
            return keys.of_arm(fleet, name, "event"), ArmEvent
        case _:
            return keys.of_arm(fleet, name, "state"), State
