"""One participant on the bus: it says, asks, answers and listens, and all that it hears is handled on one thread.

Zenoh's threads only put what arrives into a queue; `serve` takes it out and calls the handlers, so a participant needs
no locks, and a handler may say and ask what it likes. An `ask` does not wait: its answers come to a handler too.
Whatever is malformed is counted, logged and, where it was a question, answered with what is wrong; it is never fatal.
"""

import logging
import math
import time
import weakref
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from queue import Empty
from threading import Lock
from typing import Any, Protocol, Self, TypeVar

import msgspec
import zenoh
from zenoh import ext as advanced

from fleet.bus import keys
from fleet.bus.answers import Answers, by
from fleet.bus.mailbox import Mailbox
from fleet.bus.messages import MalformedMessage, Refusal, encode, encoding, read_as, spoken_by
from fleet.bus.permission import participant_at, rights_by_role
from fleet.bus.roster import Participant
from fleet.bus.router import first_words, open_client
from fleet.errors import BusError

_LOG = logging.getLogger(__name__)

Asked = TypeVar("Asked", bound=msgspec.Struct)
Said = TypeVar("Said", bound=msgspec.Struct)
Heard = TypeVar("Heard", bound=msgspec.Struct)

BACKLOG = 4096
"""What waits to be handled, at most; the oldest goes first. A fleet that behaves needs a few per participant."""
REMEMBERED = 1024
"""Words that a publisher of telemetry or events keeps for those who come later or come back: at ten a second a router
may be away for a minute and a half. A listener that wants them all asks for as many: after a break it gets so many of
the last ones and no others."""
HEARTBEAT_S = 0.5


class LeftToOthers(Exception):
    """The question was heard, and another one answers it."""


class Refused(Exception):
    """Raised by a handler of questions: the asker gets this sentence instead of an answer."""


class Publisher(Protocol):
    """Says words under one key."""

    def put(self, payload: bytes) -> None:
        """Send it; what cannot be sent now is lost, or kept for those who come later, as declared."""
        ...


class Link:
    """`with Link(endpoint, fleet) as link:` is on the bus until the end of the block. One thread uses it.

    Attributes:
        fleet: Name of the fleet, part of every key.
        malformed: Messages that were not what they should be.
        complaints: What was wrong with the last of them.
        overrun: Messages that were lost because nobody served for too long.
    """

    def __init__(self, endpoint: str, fleet: str, *, timeout_s: float = 5.0, backlog: int = BACKLOG) -> None:
        """Prepare a line to the router at `endpoint`, which has `timeout_s` to answer."""
        self.fleet = fleet
        self.malformed = 0
        self.complaints: deque[str] = deque(maxlen=8)
        self.overrun = 0
        self._endpoint, self._timeout_s = endpoint, timeout_s
        self._waiting: Mailbox[Callable[[], None]] = Mailbox()
        self._backlog = backlog
        self._overrunning = Lock()
        self._session: zenoh.Session | None = None
        self._who: Participant | None = None
        self._resources = ExitStack()
        # A process that ends without closing its session would hang.
        self._at_exit = weakref.finalize(self, self._resources.close)

    def open(self) -> Self:
        """Connect.

        Raises:
            BusError: no router answered.
        """
        if self._session is None:
            self._session = open_client(self._endpoint, timeout_s=self._timeout_s)
            self._resources.callback(self._session.close)
            self._who = participant_at(self._endpoint)
        return self

    def close(self) -> None:
        """Disconnect; what was heard and not handled is forgotten. Twice is fine."""
        self._session = None
        try:
            self._resources.close()
        except zenoh.ZError as error:
            raise BusError(f"The line to {self._endpoint} did not close in order: {first_words(error)}.") from error
        finally:
            self._waiting = Mailbox()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    # What is heard

    def serve(self, until_s: float = -math.inf) -> int:
        """Handle what has come, and what comes until `time.monotonic()` is `until_s`; returns how much that was.

        Returns at the first pause after something was handled, or when time is up.
        """
        try:
            handle = self._waiting.get(until_s)
        except Empty:
            return 0
        handle()
        handled = 1
        for _ in range(len(self._waiting)):
            try:
                handle = self._waiting.get()
            except Empty:  # the oldest went to make room
                break
            handle()
            handled += 1
        return handled

    def post(self, handle: Callable[[], None]) -> None:
        """Have something handled by `serve`; any thread may call this."""
        if len(self._waiting) >= self._backlog:
            with self._overrunning, suppress(Empty):
                self._waiting.get()
                self.overrun += 1
                if self.overrun == 1 or self.overrun % 1000 == 0:
                    _LOG.warning("%d message(s) lost: they came faster than they were handled.", self.overrun)
        self._waiting.put(handle)

    # Saying

    def say(self, key: str, message: msgspec.Struct) -> None:
        """Say a word once, to whoever listens now; dropped under congestion."""
        self._open().put(
            key, encode(message), encoding=encoding(type(message)), congestion_control=zenoh.CongestionControl.DROP
        )

    def publisher(self, key: str, kind: type[msgspec.Struct], *, remember: int = 0) -> Callable[[Any], None]:
        """What says words of one kind under one key; the last `remember` of them also reach those who come later."""
        said = encoding(kind)
        if remember:
            # Sporadic: its number is repeated only after something was said, so silence costs nothing.
            missing = advanced.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S)
            publisher: Publisher = advanced.declare_advanced_publisher(
                self._open(),
                key,
                encoding=said,
                congestion_control=zenoh.CongestionControl.DROP,
                cache=advanced.CacheConfig(remember),
                publisher_detection=True,
                sample_miss_detection=missing,
            )
        else:
            publisher = self._open().declare_publisher(
                key, encoding=said, congestion_control=zenoh.CongestionControl.DROP
            )
        return lambda message: publisher.put(encode(message))

    def alive(self, key: str) -> None:
        """Show a liveliness token until this line is closed or breaks."""
        token = self._open().liveliness().declare_token(key)
        self._resources.callback(lambda: token)  # kept: a forgotten token is undeclared

    # Asking

    def ask(
        self,
        key: str,
        message: msgspec.Struct,
        kind: type[Said],
        done: Callable[[Answers[Said]], None],
        *,
        timeout_s: float,
        each: Callable[[Answers[Said]], None] | None = None,
    ) -> None:
        """Ask all that answer under a key or key expression; `done` gets the answers when all are there or time is up.

        Args:
            kind: What the answers should be; an answer that speaks for another than its key says is malformed.
            timeout_s: Real seconds. One that stands still costs this long, unless `each` shows that enough is there.
            each: Called after every answer with all that are there.

        Raises:
            BusError: the line is not open, or with this certificate that may not be asked: a router would drop it.
        """
        self._check_may_ask(key)
        answers: Answers[Said] = Answers()
        asked_s = time.monotonic()

        def came(reply: zenoh.Reply) -> None:
            self.post(lambda: self._take(reply, kind, answers, each))

        def over() -> None:
            self.post(finish)

        def finish() -> None:
            answers.took_s = time.monotonic() - asked_s
            done(answers)

        handler: Any = zenoh.handlers.Callback(came, drop=over, indirect=False)
        try:
            self._open().get(
                key,
                handler,
                payload=encode(message),
                encoding=encoding(type(message)),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
            )
        except zenoh.ZError as error:
            raise BusError(f"Nothing can be asked under '{key}': {error}") from error

    def ask_and_wait(self, key: str, message: msgspec.Struct, kind: type[Said], *, timeout_s: float) -> Answers[Said]:
        """As `ask`, serving until the answers are there: for participants that do nothing else meanwhile."""
        there: list[Answers[Said]] = []
        self.ask(key, message, kind, there.append, timeout_s=timeout_s)
        deadline_s = time.monotonic() + timeout_s + 1.0
        while not there and time.monotonic() < deadline_s:
            self.serve(deadline_s)
        return there[0] if there else Answers(took_s=timeout_s)

    # Answering and listening

    def answer(self, key: str, kind: type[Asked], handle: Callable[[Asked], msgspec.Struct]) -> None:
        """Answer what is asked under a concrete key; `handle` may raise `Refused` or `LeftToOthers`.

        Where the key ends in `*`, the place of the asker (`keys.asked_by_every_arm`), answers go under the key that
        was asked. A question that speaks for another arm than that key names is malformed.
        """
        queryable = self._open().declare_queryable(
            key, _direct(lambda query: self.post(lambda: self._reply(key, query, kind, handle))), complete=True
        )
        self._resources.callback(lambda: queryable)

    def listen(
        self,
        expression: str,
        kind: type[Heard],
        handle: Callable[[str, Heard], None],
        *,
        remembered: int = 0,
    ) -> None:
        """Hear all words of one kind; `handle` gets who said it (the name in the key) and what.

        Args:
            remembered: So many last words of each remembering publisher come at once, and gaps are filled.
        """

        def came(sample: zenoh.Sample) -> None:
            self.post(lambda: self._hear(sample, kind, handle))

        if remembered:
            subscriber: object = advanced.declare_advanced_subscriber(
                self._open(),
                expression,
                _direct(came),
                history=advanced.HistoryConfig(detect_late_publishers=True, max_samples=remembered),
                recovery=advanced.RecoveryConfig(heartbeat=True, periodic_queries=None),
            )
        else:
            subscriber = self._open().declare_subscriber(expression, _direct(came))
        self._resources.callback(lambda: subscriber)

    def watch(self, expression: str, handle: Callable[[str, bool], None]) -> None:
        """Learn who comes and goes: `handle` gets the name in the key of a liveliness token, and whether it is there.

        The same news may come twice.
        """

        def came(sample: zenoh.Sample) -> None:
            there = sample.kind == zenoh.SampleKind.PUT
            self.post(lambda: self._token(str(sample.key_expr), there, handle))

        subscriber = self._open().liveliness().declare_subscriber(expression, _direct(came), history=True)
        self._resources.callback(lambda: subscriber)

    def there(self, expression: str, *, timeout_s: float) -> frozenset[str]:
        """Names in the keys of the liveliness tokens that are shown now; waits for the router's answer."""
        names: set[str] = set()
        for reply in self._open().liveliness().get(expression, timeout=timeout_s):
            if reply.ok is not None:
                self._token(str(reply.ok.key_expr), True, lambda name, _: names.add(name))
        return frozenset(names)

    # Inside

    def _check_may_ask(self, key: str) -> None:
        if self._who is None:
            return
        asked = zenoh.KeyExpr(key)
        may = {
            role: any(zenoh.KeyExpr(allowed).includes(asked) for allowed in one.asks)
            for role, one in rights_by_role(self.fleet, self._who.name).items()
        }
        if not may[self._who.role]:
            others = " or ".join(role for role in may if may[role])
            needed = f"; that takes the certificate of one in the role {others}" if others else ""
            raise BusError(f"'{self._who.common_name}' may not ask '{key}'{needed}.")

    def _open(self) -> zenoh.Session:
        if self._session is None:
            raise BusError("This line to the bus is not open.")
        return self._session

    def _token(self, key: str, there: bool, handle: Callable[[str, bool], None]) -> None:
        try:
            name = keys.parse(key).name
        except ValueError as error:
            self._complain(str(error))
        else:
            handle(name, there)

    def _hear(self, sample: zenoh.Sample, kind: type[Heard], handle: Callable[[str, Heard], None]) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        try:
            speaker = keys.parse(str(sample.key_expr))
            message = read_as(kind, str(sample.encoding), sample.payload.to_bytes())
            message = by(message, speaker)
        except (ValueError, MalformedMessage) as error:
            self._complain(f"under '{sample.key_expr}': {error}")
        else:
            handle(speaker.name, message)

    def _take(
        self,
        reply: zenoh.Reply,
        kind: type[Said],
        answers: Answers[Said],
        each: Callable[[Answers[Said]], None] | None,
    ) -> None:
        if reply.ok is None:
            answers.miss("" if reply.err is None else reply.err.payload.to_bytes().decode(errors="replace"))
            return
        key = str(reply.ok.key_expr)
        try:
            answers.take(key, str(reply.ok.encoding), reply.ok.payload.to_bytes(), kind)
        except MalformedMessage as error:
            self._complain(f"answer under '{key}': {error}")
        if each is not None:
            each(answers)

    def _reply(
        self, key: str, query: zenoh.Query, kind: type[Asked], handle: Callable[[Asked], msgspec.Struct]
    ) -> None:
        with query:
            try:
                mine = keys.answered(key, str(query.key_expr))
            except ValueError as error:  # there is no key to answer under
                self._complain(f"question under '{query.key_expr}': {error}")
                return
            try:
                payload = query.payload
                said = "" if query.encoding is None else str(query.encoding)
                question = read_as(kind, said, b"" if payload is None else payload.to_bytes())
                if asker := keys.parse(mine).asker:
                    question = spoken_by(question, asker, "arm")
                answer = handle(question)
            except MalformedMessage as error:
                self._complain(f"question under '{mine}': {error}")
                answer = Refusal(str(error))
            except Refused as refusal:
                answer = Refusal(str(refusal))
            except LeftToOthers:
                return
            query.reply(mine, encode(answer), encoding=encoding(type(answer)))

    def _complain(self, reason: str) -> None:
        """Log the first few and then fewer and fewer: whoever floods the bus shall not flood the log."""
        self.malformed += 1
        self.complaints.append(reason)
        if self.malformed & (self.malformed - 1) == 0:  # 1, 2, 4, 8, …
            _LOG.warning("Left out (%d so far): %s", self.malformed, reason)


def _direct(handle: Callable[[Any], None]) -> Any:
    """On the receiving thread itself: a thread of Python's between would only hand on."""
    return zenoh.handlers.Callback(handle, indirect=False)
