"""The one client of the bus: publishes, subscribes, queries and replies, and handles all that arrives on one thread.

What each key carries, and with which history, priority and congestion control, is in `fleet.bus.protocol.registry`.
Zenoh's threads only put what arrives into a queue; `serve` takes it out and calls the handlers. So a participant needs
no locks, and a handler may publish and query. `query` does not wait: its replies come to a handler too. A malformed
message is counted, logged and, where it was a request, refused with the reason; it never raises.
"""

import logging
import math
import time
import weakref
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial
from queue import Empty
from threading import Lock
from typing import Any, Self, TypeVar

import msgspec
import zenoh
from zenoh import ext as advanced

from fleet.bus.client.queue import Mailbox
from fleet.bus.client.replies import Replies, check_sender
from fleet.bus.client.router import open_client, plain_reason
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import MalformedMessage, Refusal, check_name, decode_as, encode, encoding
from fleet.bus.protocol.registry import channel_for
from fleet.bus.security.access_control import Participant, rights_by_role
from fleet.bus.security.tls import participant_at
from fleet.errors import BusError, Refused

_LOG = logging.getLogger(__name__)

Message = TypeVar("Message", bound=msgspec.Struct)
Request = TypeVar("Request", bound=msgspec.Struct)
Reply = TypeVar("Reply", bound=msgspec.Struct)

BACKLOG = 4096
"""Messages that wait to be handled, at most; the oldest is dropped first."""
_CONGESTION = {"DROP": zenoh.CongestionControl.DROP, "BLOCK": zenoh.CongestionControl.BLOCK}


class AnotherReplies(Exception):
    """Raised by a handler of requests: another participant will reply."""


class BusClient:
    """`with BusClient(endpoint, fleet) as client:` is connected until the end of the block. One thread uses it.

    Attributes:
        fleet: Name of the fleet, part of every key.
        malformed: Messages that were not as the contract says.
        rejections: What was wrong with the last of them.
        overrun: Messages dropped because `serve` was not called for too long.
    """

    def __init__(self, endpoint: str, fleet: str, *, timeout_s: float = 5.0, backlog: int = BACKLOG) -> None:
        """Prepare a client of the router at `endpoint`, which has `timeout_s` to accept the connection."""
        self.fleet = fleet
        self.malformed = 0
        self.rejections: deque[str] = deque(maxlen=8)
        self.overrun = 0
        self._endpoint, self._timeout_s = endpoint, timeout_s
        self._waiting: Mailbox[Callable[[], None]] = Mailbox()
        self._backlog = backlog
        self._overrunning = Lock()
        self._session: zenoh.Session | None = None
        self._self: Participant | None = None
        self._resources = ExitStack()
        # A process that exits without closing its session would hang.
        self._at_exit = weakref.finalize(self, self._resources.close)

    def open(self) -> Self:
        """Connect.

        Raises:
            BusError: no router accepted the connection.
        """
        if self._session is None:
            self._session = open_client(self._endpoint, timeout_s=self._timeout_s)
            self._resources.callback(self._session.close)
            self._self = participant_at(self._endpoint)
        return self

    def close(self) -> None:
        """Disconnect; messages that were not handled are dropped. May be called twice."""
        self._session = None
        try:
            self._resources.close()
        except zenoh.ZError as error:
            raise BusError(f"The session at {self._endpoint} did not close cleanly: {plain_reason(error)}.") from error
        finally:
            self._waiting = Mailbox()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    # Handling what arrives

    def serve(self, until_s: float = -math.inf, *, at_least: int = 1) -> int:
        """Handle what has arrived, and what arrives until `time.monotonic()` is `until_s`; returns how much it was.

        Waits until `at_least` so many messages are there, or time is up. To be woken once for many messages costs
        much less than once for each.
        """
        self._waiting.wait(at_least, until_s)
        handled = 0
        for _ in range(len(self._waiting)):
            try:
                handle = self._waiting.get()
            except Empty:  # the oldest was dropped meanwhile
                break
            handle()
            handled += 1
        return handled

    def post(self, handle: Callable[[], None], *, urgent: bool = False) -> None:
        """Have something called by `serve`, which an urgent call wakes at once; any thread may post."""
        if len(self._waiting) >= self._backlog:
            with self._overrunning, suppress(Empty):
                self._waiting.get()
                self.overrun += 1
                if self.overrun == 1 or self.overrun % 1000 == 0:
                    _LOG.warning("Dropped %d message(s): they arrive faster than they are handled.", self.overrun)
        self._waiting.put(handle, urgent=urgent)

    # Publishing

    def publisher(self, key: str, kind: type[Message]) -> Callable[[Message], None]:
        """A function that publishes messages under one key; late subscribers get as many as the registry says."""
        channel = channel_for(key, "publish", kind)
        publisher = advanced.declare_advanced_publisher(
            self._open(),
            key,
            encoding=encoding(kind),
            congestion_control=_CONGESTION[channel.congestion],
            priority=getattr(zenoh.Priority, channel.priority),
            cache=advanced.CacheConfig(channel.history),
            publisher_detection=True,
            # Sporadic: the sequence number is repeated only after a publication, so silence costs nothing.
            sample_miss_detection=advanced.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=channel.heartbeat_s),
        )
        return lambda message: publisher.put(encode(message))

    def publish(self, key: str, message: msgspec.Struct) -> None:
        """Publish a message once to present subscribers; nobody else gets it."""
        channel = channel_for(key, "publish", type(message))
        self._open().put(
            key,
            encode(message),
            encoding=encoding(type(message)),
            congestion_control=_CONGESTION[channel.congestion],
            priority=getattr(zenoh.Priority, channel.priority),
        )

    def declare_token(self, key: str) -> None:
        """Show a liveliness token until this client is closed or loses its connection."""
        channel_for(key, "token")
        self._keep(self._open().liveliness().declare_token(key))

    # Querying

    def query(
        self,
        key: str,
        request: msgspec.Struct,
        kind: type[Reply],
        done: Callable[[Replies[Reply]], None],
        *,
        timeout_s: float,
        each: Callable[[Reply], None] = lambda reply: None,
    ) -> None:
        """Query all that reply under a key or key expression; `done` gets the replies when all are there or time is up.

        Args:
            kind: Message type of the replies; one that names another sender than its key is malformed.
            timeout_s: Real seconds. A stopped process costs this long, unless `each` finds enough replies before.
            each: Called with every reply as it arrives.

        Raises:
            BusError: the client is not open, or its certificate does not allow the query: a router would drop it.
        """
        channel = channel_for(key, "query", type(request))
        if channel.reply is not kind:
            raise ValueError(f"'{key}' is answered with {channel.reply}, not with {kind}.")
        self._check_may_query(key)
        replies: Replies[Reply] = Replies()
        begun_s = time.monotonic()

        def receive(reply: zenoh.Reply) -> None:
            self.post(partial(self._take, reply, kind, replies, each))

        def finish() -> None:
            replies.took_s = time.monotonic() - begun_s
            done(replies)

        # The stub of zenoh types handlers by their internals.
        handler: Any = zenoh.handlers.Callback(
            receive,
            drop=lambda: self.post(finish),
            indirect=False,
        )
        try:
            self._open().get(
                key,
                handler,
                payload=encode(request),
                encoding=encoding(type(request)),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=_CONGESTION[channel.congestion],
                priority=getattr(zenoh.Priority, channel.priority),
                timeout=timeout_s,
            )
        except zenoh.ZError as error:
            raise BusError(f"The query of '{key}' failed: {error}") from error

    def query_and_wait(
        self, key: str, request: msgspec.Struct, kind: type[Reply], *, timeout_s: float
    ) -> Replies[Reply]:
        """As `query`, serving until the replies are there: for participants that do nothing else meanwhile."""
        complete: list[Replies[Reply]] = []
        self.query(key, request, kind, complete.append, timeout_s=timeout_s)
        deadline_s = time.monotonic() + timeout_s + 1.0
        while not complete and time.monotonic() < deadline_s:
            self.serve(deadline_s)
        return complete[0] if complete else Replies(took_s=timeout_s)

    # Replying and subscribing

    def reply_to(self, key: str, kind: type[Request], handle: Callable[[Request], msgspec.Struct]) -> None:
        """Reply to queries of a concrete key; `handle` may raise `Refused` or `AnotherReplies`.

        Where the key ends in `*`, the place of the querier (`keys.asked_by_every_arm`), replies go under the key of
        the query. A request that names another arm than that key is malformed.
        """
        channel_for(key, "query", kind)
        self._keep(
            self._open().declare_queryable(
                key, _direct(lambda query: self.post(partial(self._reply, key, query, kind, handle))), complete=True
            )
        )

    def subscribe(
        self,
        expression: str,
        kind: type[Message],
        handle: Callable[[str, Message], None],
        *,
        history: bool = False,
        own: bool = True,
    ) -> None:
        """Receive all messages of one key expression; `handle` gets the name in the key and the message.

        Args:
            history: Also get what publishers have cached, now and after a break, and have lost messages resent.
            own: Also get what this client publishes.
        """
        channel = channel_for(expression, "publish", kind)
        origin = zenoh.Locality.ANY if own else zenoh.Locality.REMOTE
        receive = _direct(lambda sample: self.post(partial(self._receive, sample, kind, handle)))
        self._keep(
            advanced.declare_advanced_subscriber(
                self._open(),
                expression,
                receive,
                allowed_origin=origin,
                history=advanced.HistoryConfig(detect_late_publishers=True, max_samples=channel.history),
                recovery=advanced.RecoveryConfig(heartbeat=True, periodic_queries=None),
            )
            if history
            else self._open().declare_subscriber(expression, receive, allowed_origin=origin)
        )

    def watch_tokens(self, expression: str, handle: Callable[[str, bool], None]) -> None:
        """Follow liveliness tokens: `handle` gets the name in the key, and whether the token is there.

        The same change may be reported twice.
        """
        channel_for(expression, "token")

        def receive(sample: zenoh.Sample) -> None:
            there = sample.kind == zenoh.SampleKind.PUT
            self.post(partial(self._token, str(sample.key_expr), there, handle), urgent=True)

        self._keep(self._open().liveliness().declare_subscriber(expression, _direct(receive), history=True))

    def tokens(self, expression: str, *, timeout_s: float) -> frozenset[str]:
        """Names in the keys of the liveliness tokens that are there now; waits for the router's reply."""
        names: set[str] = set()
        for reply in self._open().liveliness().get(expression, timeout=timeout_s):
            if reply.ok is not None:
                self._token(str(reply.ok.key_expr), True, lambda name, _: names.add(name))
        return frozenset(names)

    def reject(self, reason: str) -> None:
        """Count and log a malformed message."""
        self.malformed += 1
        self.rejections.append(reason)
        if self.malformed & (self.malformed - 1) == 0:  # 1, 2, 4, 8, …: a flood of messages must not flood the log
            _LOG.warning("Dropped invalid message (%d so far): %s", self.malformed, reason)

    # Inside

    def _check_may_query(self, key: str) -> None:
        if self._self is None:
            return
        queried = zenoh.KeyExpr(key)
        allowed = [
            role
            for role, rights in rights_by_role(self.fleet, self._self.name).items()
            if any(zenoh.KeyExpr(expression).includes(queried) for expression in rights.queries)
        ]
        if self._self.role not in allowed:
            needed = f"; that takes a certificate of the role {' or '.join(allowed)}" if allowed else ""
            raise BusError(f"'{self._self.common_name}' may not query '{key}'{needed}.")

    def _open(self) -> zenoh.Session:
        if self._session is None:
            raise BusError("This client of the bus is not open.")
        return self._session

    def _keep(self, entity: object) -> None:
        """Keep a declared entity until the client is closed: Zenoh undeclares what is garbage-collected."""
        self._resources.callback(lambda: entity)

    def _token(self, key: str, there: bool, handle: Callable[[str, bool], None]) -> None:
        try:
            name = keys.parse(key).name
        except ValueError as error:
            self.reject(str(error))
        else:
            handle(name, there)

    def _receive(self, sample: zenoh.Sample, kind: type[Message], handle: Callable[[str, Message], None]) -> None:
        try:
            sender = keys.parse(str(sample.key_expr))
            message = check_sender(decode_as(kind, str(sample.encoding), sample.payload.to_bytes()), sender)
        except (ValueError, MalformedMessage) as error:
            self.reject(f"under '{sample.key_expr}': {error}")
        else:
            handle(sender.name, message)

    def _take(
        self,
        reply: zenoh.Reply,
        kind: type[Reply],
        replies: Replies[Reply],
        each: Callable[[Reply], None],
    ) -> None:
        if reply.ok is None:
            replies.miss("" if reply.err is None else reply.err.payload.to_bytes().decode(errors="replace"))
            return
        key = str(reply.ok.key_expr)
        try:
            message = replies.take(key, str(reply.ok.encoding), reply.ok.payload.to_bytes(), kind)
        except MalformedMessage as error:
            self.reject(f"reply under '{key}': {error}")
        else:
            if message is not None:
                each(message)

    def _reply(
        self, key: str, query: zenoh.Query, kind: type[Request], handle: Callable[[Request], msgspec.Struct]
    ) -> None:
        with query:
            try:
                own_key = keys.answered(key, str(query.key_expr))
            except ValueError as error:  # there is no key to reply under
                self.reject(f"query of '{query.key_expr}': {error}")
                return
            try:
                payload = b"" if query.payload is None else query.payload.to_bytes()
                request = decode_as(kind, "" if query.encoding is None else str(query.encoding), payload)
                if querier := keys.parse(own_key).asker:
                    request = check_name(request, querier, "arm")
                reply = handle(request)
            except MalformedMessage as error:
                self.reject(f"query of '{own_key}': {error}")
                reply = Refusal(str(error))
            except Refused as refused:
                reply = Refusal(str(refused))
            except AnotherReplies:
                return
            query.reply(own_key, encode(reply), encoding=encoding(type(reply)))


def _direct(handle: Callable[[Any], None]) -> Any:  # as above
    """A handler on Zenoh's receiving thread itself: it only enqueues, so a Python thread between would only cost."""
    return zenoh.handlers.Callback(handle, indirect=False)
