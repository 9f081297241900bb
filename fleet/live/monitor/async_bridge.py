"""Bridge between an event loop and the bus: a thread that serves the bus, and requests that can be awaited."""

import asyncio
import logging
import threading
import time
from collections.abc import Callable
from typing import Self, TypeVar

import msgspec

from fleet.bus.client.client import BusClient
from fleet.bus.client.replies import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Quote, QuoteRequest, Status, StatusRequest, Submission, SubmissionReply
from fleet.bus.protocol.messages import encode
from fleet.errors import BusError
from fleet.live.monitor.event_feed import Entry, EventFeed
from fleet.live.monitor.listener import FleetListener
from fleet.live.monitor.snapshot import MAX_JOBS, FleetSnapshot, Role

_LOG = logging.getLogger(__name__)

Reply = TypeVar("Reply", bound=msgspec.Struct)
Result = TypeVar("Result")
REPLY_S, QUOTE_S, TURN_S = 5.0, 1.0, 0.2
"""Real seconds: for the auctioneer to reply; for all arms to quote; between two checks whether to stop."""


class NoReply(Exception):
    """No participant replied, or it refused; says which."""


class Quotes(msgspec.Struct, frozen=True):
    """Quotes of all arms."""

    quotes: tuple[Quote, ...]
    refused: tuple[str, ...]
    """Reasons of arms that did not quote; "" for one that did not reply in time."""


class AsyncBridge:
    """`async with AsyncBridge(link, on_entry) as bridge:` serves the bus on a thread until the end of the block.

    Attributes:
        feed: Numbered messages; used on the event loop only.
    """

    def __init__(self, link: BusClient, on_entry: Callable[[Entry], None]) -> None:
        """Prepare; `link` is open, and `on_entry` is called with every message, on the event loop."""
        self.feed = EventFeed()
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

    async def submit(self, submission: Submission) -> SubmissionReply:
        """Submit jobs. Raises NoReply if no auctioneer replied, or it refused."""
        return await self._ask_auctioneer(keys.of_jobs(self._link.fleet, "submit"), submission, SubmissionReply)

    async def status(self, request: StatusRequest) -> Status:
        """Request the status of jobs. Raises NoReply if no auctioneer replied, or it refused."""
        return await self._ask_auctioneer(keys.of_jobs(self._link.fleet, "status"), request, Status)

    async def request(self, topic: keys.JobsTopic, request: msgspec.Struct, kind: type[Reply]) -> Reply:
        """Send another request to the auctioneer. Raises NoReply if it did not reply, or refused."""
        return await self._ask_auctioneer(keys.of_jobs(self._link.fleet, topic), request, kind)

    async def request_of_arm(self, arm: str, topic: keys.ArmTopic, request: msgspec.Struct, kind: type[Reply]) -> Reply:
        """Send a request to an arm. Raises NoReply if it did not reply, or refused."""
        return _only(await self._ask(keys.of_arm(self._link.fleet, arm, topic), request, kind, REPLY_S), f"arm '{arm}'")

    async def quotes(self, request: QuoteRequest) -> Quotes:
        """Request quotes of every arm. Raises NoReply if the gateway's certificate does not permit it."""
        answers = await self._ask(keys.of_every_arm(self._link.fleet, "quote"), request, Quote, QUOTE_S)
        return Quotes(tuple(answers.messages.values()), tuple(answers.refused.values()))

    async def _ask_auctioneer(self, key: str, request: msgspec.Struct, kind: type[Reply]) -> Reply:
        return _only(await self._ask(key, request, kind, REPLY_S), "auctioneer")

    async def _ask(self, key: str, request: msgspec.Struct, kind: type[Reply], timeout_s: float) -> Replies[Reply]:
        def ask(done: Callable[[Replies[Reply] | BusError], None]) -> None:
            try:
                self._link.query(key, request, kind, done, timeout_s=timeout_s)
            except BusError as error:
                done(error)

        answers = await self._on_bus(ask)
        if isinstance(answers, BusError):
            raise NoReply(str(answers)) from answers
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
            raise NoReply("The bus did not reply.") from error

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


def _only(answers: Replies[Reply], who: str) -> Reply:
    """Return the first reply. Raises NoReply if there is none."""
    for reply in answers.messages.values():
        return reply
    for reason in answers.refused.values():
        raise NoReply(f"The {who} refused: {reason}" if reason else f"The {who} did not reply in time.")
    raise NoReply(f"There is no {who} in this fleet.")
