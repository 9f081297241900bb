"""The line between an event loop and the bus: a thread that serves the bus, and questions that can be awaited."""

import asyncio
import logging
import threading
import time
from collections.abc import Callable
from typing import Self, TypeVar

import msgspec

from fleet.bus import keys
from fleet.bus.answers import Answers
from fleet.bus.link import Link
from fleet.bus.messages import encode
from fleet.bus.trade import Quote, QuoteRequest, Status, StatusRequest, Submission, Submitted
from fleet.errors import BusError
from fleet.live.onlooker import Onlooker
from fleet.live.overview import FleetNow, Role
from fleet.live.stream import Entry, Feed

_LOG = logging.getLogger(__name__)

Said = TypeVar("Said", bound=msgspec.Struct)
Result = TypeVar("Result")
ANSWER_S, QUOTE_S, TURN_S = 5.0, 1.0, 0.2
"""Real seconds: for the auctioneer to answer; for all arms to quote; between two looks whether to end."""


class Silence(Exception):
    """Nobody answered, or the one who did refused; says which."""


class Quotes(msgspec.Struct, frozen=True):
    """What jobs would cost whom."""

    quotes: tuple[Quote, ...]
    refused: tuple[str, ...]
    """What arms said that did not quote; "" for one that did not answer in time."""


class Gateway:
    """`async with Gateway(link, tell) as gateway:` serves the bus on a thread until the end of the block.

    Attributes:
        feed: Numbered words, on the event loop.
    """

    def __init__(self, link: Link, tell: Callable[[Entry], None]) -> None:
        """Prepare a gateway on an open line; `tell` gets every word, on the event loop."""
        self.feed = Feed()
        self._link, self._tell = link, tell
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="bus", daemon=True)
        self._onlooker = Onlooker(link, heard=self._heard, came=self._came)
        self._loop: asyncio.AbstractEventLoop | None = None

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        self._thread.start()
        return self

    async def __aexit__(self, *exc: object) -> None:
        self._stop.set()
        await asyncio.to_thread(self._thread.join)

    async def now(self) -> FleetNow:
        """The fleet now."""
        return await self._on_bus(lambda done: done(self._onlooker.overview.now(time.monotonic())))

    async def submit(self, word: Submission) -> Submitted:
        """Hand in jobs.

        Raises:
            Silence: no auctioneer answered, or it refused.
        """
        return await self._one(keys.of_jobs(self._link.fleet, "submit"), word, Submitted)

    async def status(self, word: StatusRequest) -> Status:
        """Ask where jobs stand.

        Raises:
            Silence: no auctioneer answered, or it refused.
        """
        return await self._one(keys.of_jobs(self._link.fleet, "status"), word, Status)

    async def quotes(self, word: QuoteRequest) -> Quotes:
        """Ask every arm what jobs would cost.

        Raises:
            Silence: with its certificate the gateway may not ask.
        """
        answers = await self._ask(keys.of_every_arm(self._link.fleet, "quote"), word, Quote, QUOTE_S)
        return Quotes(tuple(answers.words.values()), tuple(answers.refused.values()))

    async def _one(self, key: str, word: msgspec.Struct, kind: type[Said]) -> Said:
        answers = await self._ask(key, word, kind, ANSWER_S)
        for answer in answers.words.values():
            return answer
        for reason in answers.refused.values():
            raise Silence(f"The auctioneer refused: {reason}" if reason else "The auctioneer did not answer in time.")
        raise Silence("There is no auctioneer in this fleet.")

    async def _ask(self, key: str, word: msgspec.Struct, kind: type[Said], timeout_s: float) -> Answers[Said]:
        def ask(done: Callable[[Answers[Said] | BusError], None]) -> None:
            try:
                self._link.ask(key, word, kind, done, timeout_s=timeout_s)
            except BusError as error:
                done(error)

        answers = await self._on_bus(ask)
        if isinstance(answers, BusError):
            raise Silence(str(answers)) from answers
        return answers

    async def _on_bus(self, question: Callable[[Callable[[Result], None]], None]) -> Result:
        """What a question on the bus thread is answered with."""
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[Result] = loop.create_future()

        def settle(result: Result) -> None:
            if not answer.done():
                answer.set_result(result)

        self._link.post(lambda: question(lambda result: self._cross(lambda: settle(result))))
        try:
            return await asyncio.wait_for(answer, ANSWER_S + 2.0)
        except TimeoutError as error:
            raise Silence("The bus did not answer.") from error

    def _serve(self) -> None:
        while not self._stop.is_set():
            self._onlooker.serve(time.monotonic() + TURN_S)

    def _heard(self, topic: str, name: str, word: msgspec.Struct) -> None:
        data = encode(word).decode()
        self._cross(lambda: self._tell(self.feed.add(topic, name, data)))

    def _came(self, role: Role, name: str, there: bool) -> None:
        data = msgspec.json.encode({"role": role, "name": name, "there": there}).decode()
        self._cross(lambda: self._tell(self.feed.add("presence", f"{role}/{name}", data)))

    def _cross(self, handle: Callable[[], None]) -> None:
        """To the event loop, if it still runs."""
        assert self._loop is not None
        try:
            self._loop.call_soon_threadsafe(handle)
        except RuntimeError:
            _LOG.debug("The event loop has ended.")
