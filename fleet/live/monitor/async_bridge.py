"""Bridge between an event loop and the bus: a thread that serves the bus, and requests that can be awaited.

Messages are numbered for slow readers, with a bounded buffer for each. A slow reader misses telemetry (the newest
message of each arm replaces the one before) and never delays the others. A reader that falls so far behind that events
would be lost is dropped; it reconnects with the last number it has seen.
"""

import asyncio
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Self, TypeVar

import msgspec

from fleet.bus.client import BusClient, Replies, replier
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Quote, QuoteRequest
from fleet.bus.protocol.messages import encode
from fleet.errors import BusError, Refused
from fleet.live.monitor.snapshot import MAX_JOBS, FleetListener, FleetSnapshot, Recent, Role

_LOG = logging.getLogger(__name__)

Reply = TypeVar("Reply", bound=msgspec.Struct)
Result = TypeVar("Result")
REPLY_S, QUOTE_S, TURN_S = 5.0, 1.0, 0.2
"""Real seconds: for the auctioneer to reply; for all arms to quote; between two checks whether to stop."""

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
    """Events were lost, and the reader must be disconnected."""
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


class Quotes(msgspec.Struct, frozen=True):
    """Quotes of all arms."""

    quotes: tuple[Quote, ...]
    refused: tuple[str, ...]
    """Reasons of arms that did not quote; "" for one that did not reply in time."""


class AsyncBridge:
    """`async with AsyncBridge(link, on_entry) as bridge:` serves the bus on a thread until the end of the block.

    Attributes:
        fleet: Name of the fleet.
        feed: Numbered messages; used on the event loop only.
    """

    def __init__(self, link: BusClient, on_entry: Callable[[Entry], None]) -> None:
        """Prepare; `link` is open, and `on_entry` is called with every message, on the event loop."""
        self.feed = EventFeed()
        self.fleet = link.fleet
        self._link, self._on_entry = link, on_entry
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="bus", daemon=True)
        self._listener = FleetListener(link, on_message=self._message, on_presence=self._presence)
        self._loop: asyncio.AbstractEventLoop | None = None

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        self._thread.start()
        return self

    async def __aexit__(self, *exc: object) -> None:
        self._stop.set()
        await asyncio.to_thread(self._thread.join)

    async def snapshot(self, jobs: int = MAX_JOBS) -> FleetSnapshot:
        """Return the fleet as it is now, with at most `jobs` of the jobs that changed last."""
        return await self._on_bus(lambda done: done(self._listener.view.snapshot(time.monotonic(), jobs)))

    async def ask(self, key: str, request: msgspec.Struct, kind: type[Reply]) -> Reply:
        """Query a participant; return the first reply.

        Raises:
            Refused: it refuses.
            NoReply: no reply.
            BusError: the certificate does not permit the query.
        """
        replies = await self._query(key, request, kind, REPLY_S)
        try:
            return replies.first(key)
        except Refused as error:
            raise Refused(f"The {replier(key)} refused: {error}") from error

    async def quotes(self, request: QuoteRequest) -> Quotes:
        """Request quotes of every arm. Raises BusError if the certificate does not permit it."""
        answers = await self._query(keys.of_every_arm(self.fleet, "quote"), request, Quote, QUOTE_S)
        return Quotes(tuple(answers.messages.values()), tuple(answers.refused.values()))

    async def _query(self, key: str, request: msgspec.Struct, kind: type[Reply], timeout_s: float) -> Replies[Reply]:
        def query(done: Callable[[Replies[Reply] | BusError], None]) -> None:
            try:
                self._link.query(key, request, kind, done, timeout_s=timeout_s)
            except BusError as error:
                done(error)

        answers = await self._on_bus(query)
        if isinstance(answers, BusError):
            raise answers
        return answers

    async def _on_bus(self, call: Callable[[Callable[[Result], None]], None]) -> Result:
        """Run `call` on the bus thread and return what it passes to its callback."""
        future: asyncio.Future[Result] = asyncio.get_running_loop().create_future()

        def settle(result: Result) -> None:
            if not future.done():
                future.set_result(result)

        self._link.post(lambda: call(lambda result: self._on_loop(lambda: settle(result))))
        try:
            return await asyncio.wait_for(future, REPLY_S + 2.0)
        except TimeoutError as error:
            raise BusError("The bus did not reply.") from error

    def _serve(self) -> None:
        while not self._stop.is_set():
            self._listener.serve(time.monotonic() + TURN_S)

    def _message(self, topic: str, name: str, message: msgspec.Struct) -> None:
        data = encode(message).decode()
        self._on_loop(lambda: self._on_entry(self.feed.add(topic, name, data)))

    def _presence(self, role: Role, name: str, present: bool) -> None:
        data = msgspec.json.encode({"role": role, "name": name, "there": present}).decode()
        self._on_loop(lambda: self._on_entry(self.feed.add("presence", f"{role}/{name}", data)))

    def _on_loop(self, call: Callable[[], None]) -> None:
        """Run `call` on the event loop, if that still runs."""
        assert self._loop is not None
        try:
            self._loop.call_soon_threadsafe(call)
        except RuntimeError:
            _LOG.debug("The event loop has ended.")
