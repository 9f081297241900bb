"""Bridge between an event loop and the bus: a thread that serves the bus, and requests that can be awaited.

Messages are numbered: a reader asks for those after the last number that it has seen. A slow reader misses telemetry,
as the newest message of each arm replaces the one before, and never delays the others. A reader that falls so far
behind that it has missed events is dropped, and reconnects.
"""

import asyncio
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from itertools import takewhile
from typing import Self, TypeVar

import msgspec

from fleet.bus.client import BusClient, Replies, replier
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Quote, QuoteRequest, Status
from fleet.bus.protocol.messages import encode
from fleet.bus.protocol.operator import Alarm
from fleet.errors import BusError, Refused
from fleet.live.job_client import query_statuses
from fleet.live.monitor.alarms import AlarmList
from fleet.live.monitor.health import Finding, check_connection, check_fleet, complaints_of_states
from fleet.live.monitor.snapshot import FRESH_S, MAX_JOBS, FleetListener, FleetSnapshot, Recent, Role

_LOG = logging.getLogger(__name__)

Reply = TypeVar("Reply", bound=msgspec.Struct)
Result = TypeVar("Result")
REPLY_S, QUOTE_S, TURN_S = 5.0, 1.0, 0.2
"""Real seconds: for the auctioneer to reply; for all arms to quote; between two checks whether to stop."""

CHECK_S = 1.0
"""Real seconds between two checks for alarms."""
MONITOR = "gateway"
"""Begin of the name under which alarms are published without a certificate, whose name would be used."""
HISTORY = 1024
"""Events and results that are kept for slow readers, and for those that reconnect."""
MAX_NAMES = 4096
NEWEST_ONLY = ("state", "difficulty", "info", "bid", "presence", "announce")
"""Topics of which only the newest message of each name counts; of all others every message does."""


@dataclass(frozen=True)
class FeedEntry:
    """One message of the stream."""

    number: int
    """Counts from 1."""
    topic: str
    name: str
    """Of the arm or auctioneer."""
    data: str
    """JSON on one line."""


class EventFeed:
    """The newest message of each name and topic, and the last events and results."""

    def __init__(self) -> None:
        self._number = 0
        self._newest: Recent[tuple[str, str], FeedEntry] = Recent(MAX_NAMES)
        self._events: deque[FeedEntry] = deque(maxlen=HISTORY)
        self._dropped = 0
        """Number of the last event or result that is no longer kept."""

    def add(self, topic: str, name: str, data: str) -> None:
        """Number a message and keep it."""
        self._number += 1
        entry = FeedEntry(self._number, topic, name, data)
        if topic in NEWEST_ONLY:
            self._newest[topic, name] = entry
            return
        if len(self._events) == HISTORY:
            self._dropped = self._events[0].number
        self._events.append(entry)

    def since(self, number: int) -> tuple[list[FeedEntry], bool]:
        """Return the entries after a number, in order, and whether events between them were dropped.

        Of a number that no entry has had yet nothing is known: all entries, and True.
        """
        if number > self._number:
            return self.since(0)[0], True
        entries: list[FeedEntry] = []
        for kept in (self._newest.values(), self._events):
            entries += takewhile(lambda entry: entry.number > number, reversed(kept))
        return sorted(entries, key=lambda entry: entry.number), number < self._dropped


class Quotes(msgspec.Struct, frozen=True):
    """Quotes of all arms."""

    quotes: tuple[Quote, ...]
    refused: tuple[str, ...]
    """Reasons of arms that did not quote; "" for one that did not reply in time."""


class AsyncBridge:
    """`async with AsyncBridge(link, on_message) as bridge:` serves the bus on a thread until the end of the block.

    Attributes:
        fleet: Name of the fleet.
        feed: Numbered messages; used on the event loop only.
    """

    def __init__(
        self,
        link: BusClient,
        on_message: Callable[[], None],
        *,
        monitor: str = MONITOR,
        kept: Sequence[Alarm] = (),
        on_alarm: Callable[[Alarm], None] = lambda alarm: None,
        more_findings: Callable[[], Sequence[Finding]] = tuple,
    ) -> None:
        """Prepare; `link` is open.

        Args:
            on_message: Called for every message in `feed`, on the event loop.
            monitor: Name under which alarms are published if `link` has no certificate, whose name is used.
            kept: Alarms of a recording, which are published again.
            on_alarm: Called on the event loop: at the first check for every known alarm, then for every change of an
                alarm by any monitor. A receiver thereby learns what changed while this monitor did not run.
            more_findings: Findings beside those of the fleet, which raise alarms too; called on the thread of the bus.
        """
        self.feed = EventFeed()
        self.fleet = link.fleet
        self._link, self._on_message = link, on_message
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="bus", daemon=True)
        self._listener = FleetListener(link, on_message=self._message, on_presence=self._presence)
        self._loop: asyncio.AbstractEventLoop | None = None
        name = link.participant or monitor
        self._alarms, self._on_alarm = AlarmList(name, self._listener.view.alarms, kept, start_s=time.time()), on_alarm
        self._more_findings = more_findings
        key = keys.build(self.fleet, "monitor", "alarm", name)
        self._publish = link.publisher(key, Alarm, check=False)
        if objection := link.objection("publish", key):
            _LOG.warning("%s Only users of this gateway see its alarms.", objection)
        else:
            link.declare_token(keys.build(self.fleet, "monitor", "alive", name))
        link.watch_tokens(keys.of_every(self.fleet, "monitor", "alive"), self._monitor)
        self._check_s = time.monotonic() + FRESH_S  # by then it has heard from everybody who is there
        self._earlier = deque[FleetSnapshot](maxlen=3)
        self._known: list[Finding] = []
        """Findings of the last check with a connection to the router."""
        self._told: dict[str, tuple[bool, str]] = {}
        """Whether each alarm lasts and who has acknowledged it, as `on_alarm` was last called."""
        for alarm in self._alarms.alarms.values():
            self._publish(alarm)

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        self._thread.start()
        return self

    async def __aexit__(self, *exc: object) -> None:
        self._stop.set()
        await asyncio.to_thread(self._thread.join)

    async def snapshot(self, jobs: int = MAX_JOBS) -> FleetSnapshot:
        """Return the fleet as it is now, with at most `jobs` jobs, as `FleetView.snapshot`."""
        return await self._on_bus(lambda done: done(self._listener.view.snapshot(time.monotonic(), jobs)))

    async def ask(self, key: str, request: msgspec.Struct, kind: type[Reply]) -> Reply:
        """Query a participant; return the first reply.

        Raises:
            Refused: it refuses.
            NoReply: no reply.
            BusError: the certificate does not permit the query.
        """
        return first_reply(await self._query(key, request, kind, REPLY_S), key)

    async def statuses(self, names: Sequence[str]) -> Status:
        """Query the status of these jobs, of all if none is named; raises as `ask`."""
        query = partial(query_statuses, self._link, names=names, timeout_s=REPLY_S)
        return first_reply(await self._replies(query), keys.of_jobs(self.fleet, "status"))

    async def acknowledge(self, alarm: str, by: str) -> Alarm:
        """Note that a person has seen an alarm. Raises Refused as `AlarmList.acknowledge`."""

        def acknowledge(done: Callable[[Alarm | Refused], None]) -> None:
            now = self._listener.view.snapshot(time.monotonic(), 0)
            try:
                changed = self._alarms.acknowledge(alarm, by, now.time_s or 0.0, datetime.now(UTC))
            except Refused as refused:
                done(refused)
            else:
                self._publish(changed)
                done(changed)

        answer = await self._on_bus(acknowledge)
        if isinstance(answer, Refused):
            raise answer
        return answer

    async def quotes(self, request: QuoteRequest) -> Quotes:
        """Request quotes of every arm. Raises BusError if the certificate does not permit it."""
        answers = await self._query(keys.of_every_arm(self.fleet, "quote"), request, Quote, QUOTE_S)
        return Quotes(tuple(answers.messages.values()), tuple(answers.refused.values()))

    async def _query(self, key: str, request: msgspec.Struct, kind: type[Reply], timeout_s: float) -> Replies[Reply]:
        return await self._replies(partial(self._link.query, key, request, kind, timeout_s=timeout_s))

    async def _replies(self, query: Callable[[Callable[[Replies[Reply]], None]], None]) -> Replies[Reply]:
        """Begin a query with the handler of its replies; return them."""

        def begin(done: Callable[[Replies[Reply] | BusError], None]) -> None:
            try:
                if not self._link.connected:
                    raise BusError("The connection to the router is lost: it has ended, or is unreachable.")
                query(done)
            except BusError as error:
                done(error)

        answers = await self._on_bus(begin)
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
            if (real_s := time.monotonic()) >= self._check_s:
                self._check_s = real_s + CHECK_S
                self._check_alarms(real_s)

    def _check_alarms(self, real_s: float) -> None:
        """Begin and end alarms by what the fleet shows."""
        now = self._listener.view.snapshot(real_s)
        if lost := check_connection(now):
            self._earlier.clear()
            self._known = [each for each in self._known if self._alarms.lasts(each)]  # no other one begins meanwhile
        else:
            earlier = self._earlier[0] if len(self._earlier) == self._earlier.maxlen else None
            complaints = self._link.complaints(real_s - FRESH_S)
            self._known = check_fleet(now, earlier, malformed=complaints_of_states(now, complaints))
            self._earlier.append(now)
        findings = [*self._known, *lost]
        heard = {each.arm for each in now.arms} | {*now.left} | {each.job for each in now.jobs}
        heard |= {each.auctioneer for each in now.auctioneers if each.heard_age_s is not None}
        findings += self._more_findings()
        for alarm in self._alarms.update(findings, now.time_s or 0.0, real_s, heard, now.speed or 1.0):
            self._publish(alarm)
        alarms = self._alarms.alarms
        told, self._told = self._told, {name: (each.ended_s is None, each.by) for name, each in alarms.items()}
        for name, state in self._told.items():
            if state != told.get(name):
                self._on_loop(partial(self._on_alarm, alarms[name]))

    def _message(self, topic: str, name: str, message: msgspec.Struct) -> None:
        self._on_loop(lambda: self._add(topic, name, encode(message)))

    def _monitor(self, name: str, present: bool) -> None:
        if not present:
            self._alarms.take_up(name)

    def _presence(self, role: Role, name: str, present: bool) -> None:
        data = msgspec.json.encode({"role": role, "name": name, "there": present})
        self._on_loop(lambda: self._add("presence", f"{role}/{name}", data))

    def _add(self, topic: str, name: str, data: bytes) -> None:
        self.feed.add(topic, name, data.decode())
        self._on_message()

    def _on_loop(self, call: Callable[[], None]) -> None:
        """Run `call` on the event loop, if that still runs."""
        assert self._loop is not None
        try:
            self._loop.call_soon_threadsafe(call)
        except RuntimeError:
            _LOG.debug("The event loop has ended.")


def first_reply(replies: Replies[Reply], key: str) -> Reply:
    """As `Replies.first`; a refusal names who refuses."""
    try:
        return replies.first(key)
    except Refused as error:
        raise type(error)(f"The {replier(key)} refused: {error}") from error
