"""The client of the bus: publishes, subscribes, queries and replies, and calls all handlers on one thread.

The message, history, priority and congestion control of each key are in `fleet.bus.protocol.keys`.
Zenoh's threads only queue what arrives; `serve` calls the handlers. So a participant needs no locks, and a handler may
publish and query. `query` does not wait: its replies go to a handler, too; outside handlers, `ask` waits for a reply. A
malformed message is counted and logged, and never raises; a malformed request is refused with the reason.
"""

import logging
import math
import re
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from functools import lru_cache, partial
from typing import Any, Generic, Literal, Self, TypeVar, TypeVarTuple

import msgspec
import zenoh
from zenoh import ext as advanced

from fleet.bus.mailbox import Mailbox
from fleet.bus.protocol import keys
from fleet.bus.protocol.keys import BusChannel, Pattern, channel_for, channel_of
from fleet.bus.protocol.messages import MOST_BYTES, MalformedMessage, Refusal, check_name, decode, encode, encoding
from fleet.bus.protocol.operator import check_request
from fleet.bus.router import Connection
from fleet.bus.security.access_control import RosterEntry, rights_by_role
from fleet.bus.security.tls import check_listed, expires_at, is_past, participant_at
from fleet.errors import NAME_RULE, ArgumentError, BusError, Refused, RefusedForNow, is_name, printable
from fleet.fields import check_instance, check_value

_LOG = logging.getLogger(__name__)

Message = TypeVar("Message", bound=msgspec.Struct)
Request = TypeVar("Request", bound=msgspec.Struct)
Reply = TypeVar("Reply", bound=msgspec.Struct)
Entry = TypeVar("Entry")
Arguments = TypeVarTuple("Arguments")

BACKLOG = 4096
MOST_BACKLOG, MOST_TIMEOUT_S = 2**24, 86_400.0
MOST_REPLIES = 1024
"""Replies to one query that are read: one of each arm of the largest fleet."""
MOST_REJECTIONS, MOST_CHARACTERS = 1024, 2048
"""Places whose last malformed message is kept (a state of each arm of the largest fleet); length of a kept reason."""
MOST_COUNTED = 256
"""Reasons whose messages are counted one by one for the log; those of all others are counted together."""
_DECIMAL = re.compile(r"\d+\.\d+")
"""A measured value, which differs from one reason to the next of the same fault."""

Action = Literal["publish", "show the token", "reply to", "query"]
"""What a certificate may or may not allow under a key."""

_SENDER: Mapping[str, str] = {"arm": "arm", "auction": "auctioneer", "monitor": "monitor"}
"""The field of a message that names the sender, by the role in its key."""


class AnotherReplies(Exception):
    """Raised by a handler of requests: another participant will reply."""


@dataclass(eq=False)
class NoReply(BusError):
    """A query without a reply or a refusal."""

    key: str
    late: bool
    """Whether a participant received the query and did not reply in time."""

    def __str__(self) -> str:
        if self.late:
            return f"The {replier(self.key)} did not reply in time."
        return f"No {replier(self.key)} is online in this fleet."


@dataclass(eq=False)
class Replies(Generic[Message]):
    """Replies so far; complete when the handler gets them."""

    messages: dict[str, Message] = field(default_factory=dict)
    """By the key of the replier; a second reply under the same key gets a number, as `KEY (2)`."""
    refused: dict[str, str] = field(default_factory=dict)
    """Reasons by the key of the replier; "" for one that did not reply in time, whose key is not known."""
    temporary: bool = False
    """Whether a refusal is of a state that passes."""
    took_s: float = math.nan
    """Real seconds until they were complete."""

    @property
    def refusals(self) -> list[str]:
        """Reasons of the participants that refused, without those that did not reply in time."""
        return [reason for reason in self.refused.values() if reason]

    def add(self, key: str, reply: Message | Refusal) -> None:
        """Add what a participant replied under a key."""
        if isinstance(reply, Refusal):
            add_reply(self.refused, key, reply.reason)
            self.temporary |= reply.temporary
        else:
            add_reply(self.messages, key, reply)

    def first(self, key: str) -> Message:
        """The first reply to a query of `key`.

        Raises:
            Refused: there is none, and a participant refuses, with its reason; RefusedForNow by a state that passes.
            NoReply: there is neither.
        """
        for message in self.messages.values():
            return message
        for reason in self.refusals:
            raise (RefusedForNow if self.temporary else Refused)(reason)
        raise NoReply(key, late=bool(self.refused))


def under(key: str) -> str:
    """Place of the malformed messages that are published under a key."""
    return f"under '{key}'"


def replier(key: str) -> str:
    """Who replies to the queries of a key, for example `auctioneer` or `arm 'arm_0'`."""
    sender = channel_of(key).sender
    return f"{sender} '{keys.parse(key).name}'" if sender == "arm" and "*" not in key else sender


def read_message(kind: type[Message], key: str, sent_encoding: str, payload: bytes) -> tuple[str, Message]:
    """The name in the key and the message of this type in the payload.

    Raises:
        ValueError: not a key of this bus.
        MalformedMessage: another encoding, not of this type, or the message names another sender than its key.
    """
    sender = keys.parse(key)
    message = decode(kind, payload, sent_encoding)
    field_of_sender = _SENDER.get(sender.role, "")
    if hasattr(message, field_of_sender):
        check_name(message, sender.name, field_of_sender)
    return sender.name, message


class BusClient(Connection):
    """A participant's connection to the router, for one thread: `with BusClient(endpoint, fleet) as client:`.

    Attributes:
        fleet: Name of the fleet, part of every key.
        malformed: Number of messages that violate the contract.
        rejections: The reason and the monotonic second of the last of them at each place; the newest last.
        overrun: Messages dropped because `serve` was not called for too long.
    """

    def __init__(
        self,
        endpoint: str,
        fleet: str,
        *,
        timeout_s: float = 5.0,
        backlog: int = BACKLOG,
        stopped: Callable[[], bool] | None = None,
    ) -> None:
        """Prepare a client of the router at `endpoint`.

        Args:
            timeout_s: How long the router may take to accept the connection, and to list tokens.
            backlog: Maximum number of queued messages; a full queue drops the oldest.
            stopped: Wait for a router until this is true, instead of `timeout_s`.
        """
        super().__init__(endpoint, check_value("timeout_s", timeout_s, float, low=0, high=MOST_TIMEOUT_S), stopped)
        check_instance("endpoint", endpoint, str, "tcp/127.0.0.1:7447")
        check_value("backlog", backlog, int, low=1, high=MOST_BACKLOG)
        check_instance("fleet", fleet, str, "quickstart")
        if not is_name(fleet):
            raise ArgumentError(f"fleet must have {NAME_RULE} (got '{printable(fleet)}').")
        self.fleet = fleet
        self.malformed = 0
        self.rejections: OrderedDict[str, tuple[str, float]] = OrderedDict()
        self._rejected: Counter[str] = Counter()
        """Number of malformed messages by place and reason; of those beyond `MOST_COUNTED` under ""."""
        self.overrun = 0
        self._calls: Mailbox[tuple[Callable[..., None], tuple[Any, ...]]] = Mailbox(backlog)
        self._participant: RosterEntry | None = None
        self._expires: datetime | None = None
        self._expiry_logged = False

    def open(self) -> Self:
        """Connect.

        Raises:
            BusError: no router accepts the connection, or `stopped` meanwhile; or by the roster in the folder of its
                certificate the router would drop everything.
        """
        if self._session is None:
            self._participant = participant_at(self._endpoint)
            if self._participant is not None:
                check_listed(self._endpoint, self._participant, self.fleet)
            self._expires = expires_at(self._endpoint)
            super().open()
        return self

    @property
    def participant(self) -> str:
        """Its name in the roster of the keys with which it is connected; "" without one."""
        return "" if self._participant is None else self._participant.name

    @property
    def expiry(self) -> str:
        """Sentence that its certificate has expired; "" if it has not or was renewed meanwhile, and without TLS."""
        if self._expires is not None and is_past(self._expires):
            with suppress(BusError):  # missing while it is replaced
                self._expires = expires_at(self._endpoint)
        if self._expires is None or not is_past(self._expires):
            return ""
        return (
            f"The certificate of '{self.participant}' expired on {self._expires:%Y-%m-%d %H:%M} UTC, so it has no "
            "connection until it is renewed with thermofleet bus keys --add --overwrite."
        )

    def close(self) -> None:
        """Disconnect; messages that were not handled are dropped. May be called twice."""
        try:
            super().close()
        finally:
            for _ in self._calls.take():
                pass

    # Handling what arrives

    def serve(self, until_s: float = -math.inf, *, at_least: int = 1) -> int:
        """Wait until `time.monotonic()` is `until_s` or `at_least` messages are queued, and handle all that are.

        Returns how many it handled. Waking once for many messages costs much less than once for each.
        """
        self._log_expiry()
        handled = 0
        for handle, arguments in self._calls.take(until_s, count=at_least):
            handle(*arguments)
            handled += 1
        return handled

    def post(self, handle: Callable[[*Arguments], None], *arguments: *Arguments, urgent: bool = False) -> None:
        """Queue a call of `handle` for `serve`, which an urgent one wakes at once; any thread may post."""
        if self._calls.put((handle, arguments), urgent=urgent):
            self.overrun += 1
            if self.overrun == 1 or self.overrun % 1000 == 0:
                _LOG.warning("Dropped %d message(s): they arrive faster than they are handled.", self.overrun)

    # Publishing

    def objection(self, action: Action, key: str) -> str:
        """Why the router would drop this, by the role of the certificate; "" if it would not, and without TLS."""
        return "" if self._participant is None else _objection(self.fleet, self._participant, action, key)

    def require(self, action: Action, key: str) -> None:
        """Refuse an action that the certificate does not allow.

        Raises:
            BusError: as `objection`.
        """
        if objection := self.objection(action, key):
            raise BusError(objection)

    def publisher(self, key: str, kind: type[Message], *, check: bool = True) -> Callable[[Message], None]:
        """A function that publishes messages under one key; late subscribers get the history that the registry sets.

        Args:
            check: Whether the certificate must allow it; otherwise perhaps only this client receives the messages.

        Raises:
            BusError: the client is not open, or its certificate does not allow it.
        """
        channel, settings = _transport(key, "publish", kind)
        if check:
            self.require("publish", key)
        publisher = advanced.declare_advanced_publisher(
            self._open(),
            key,
            **settings,
            cache=advanced.CacheConfig(channel.history),
            publisher_detection=True,
            # Sporadic: the sequence number is repeated only after a publication, so silence costs nothing.
            sample_miss_detection=advanced.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=channel.heartbeat_s),
        )
        return lambda message: publisher.put(encode(message))

    def publish(self, key: str, message: msgspec.Struct) -> None:
        """Publish one message to the present subscribers, without history; raises as `publisher`."""
        _, settings = _transport(key, "publish", type(message))
        self.require("publish", key)
        self._open().put(key, encode(message), **settings)

    def declare_token(self, key: str) -> None:
        """Show a liveliness token until this client is closed or loses its connection; raises as `publisher`."""
        channel_for(key, "token")
        self.require("show the token", key)
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
        most: int = MOST_REPLIES,
    ) -> None:
        """Query all that reply under a key or key expression; `done` gets the replies, complete or after the timeout.

        Args:
            kind: Message type of the replies; one that names another sender than its key is malformed.
            timeout_s: Real seconds. A stopped process costs this long, unless `each` has enough replies before.
            each: Called with every reply as it arrives.
            most: Replies that are read; the next one ends the query, with a reason in `refused`. So does a request that
                is larger than a message, which is not sent.

        Raises:
            BusError: the client is not open, or its certificate does not allow the query: a router would drop it.
        """
        channel, settings = _transport(key, "query", type(request))
        if channel.reply is not kind:
            raise ValueError(f"'{key}' is answered with {channel.reply}, not with {kind}.")
        self.require("query", key)
        payload = encode(request)
        if len(payload) > MOST_BYTES and channel.role != "policy":
            self.post(done, Replies(refused={key: _too_large(len(payload))}, took_s=0.0))
            return
        pending = _PendingQuery(self, kind, most, timeout_s, each, done)
        try:
            self._open().get(
                key,
                _direct(pending.receive, pending.finish),
                payload=payload,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
                cancellation_token=pending.token,
                **settings,
            )
        except zenoh.ZError as error:
            raise BusError(f"The query of '{key}' failed: {error}") from error

    def query_and_wait(
        self, key: str, request: msgspec.Struct, kind: type[Reply], *, timeout_s: float, most: int = MOST_REPLIES
    ) -> Replies[Reply]:
        """As `query`, and serve until the replies are complete."""
        query = partial(self.query, key, request, kind, timeout_s=timeout_s, most=most)
        return self.wait(query, timeout_s)

    def wait(self, query: Callable[[Callable[[Replies[Reply]], None]], None], timeout_s: float) -> Replies[Reply]:
        """Begin a query, and serve until its replies are complete.

        Args:
            query: Called with the handler of the replies.
            timeout_s: Real seconds of the query.
        """
        complete: list[Replies[Reply]] = []
        query(complete.append)
        deadline_s = time.monotonic() + timeout_s + 1.0
        while not complete and time.monotonic() < deadline_s:
            self.serve(deadline_s)
        return complete[0] if complete else Replies(refused={"?": ""}, took_s=timeout_s)

    def ask(
        self, key: str, request: msgspec.Struct, kind: type[Reply], *, timeout_s: float, attempts: int = 1
    ) -> Reply:
        """Query a participant, and return its reply; of several, the first.

        Args:
            timeout_s: Real seconds of one attempt.
            attempts: Maximum number of requests, repeated without a reply.

        Raises:
            Refused: the participant refuses, with its reason.
            NoReply: no reply and no refusal.
            BusError: as `query`.
        """
        replies: Replies[Reply] = Replies()
        for _ in range(attempts):
            replies = self.query_and_wait(key, request, kind, timeout_s=timeout_s)
            if replies.messages or replies.refusals:
                break
        return replies.first(key)

    def wait_for_queryable(self, key: str, timeout_s: float) -> bool:
        """Wait until a participant replies under a concrete key; whether one does.

        A new session learns a moment after it opens who does, and a query before that moment gets no reply.
        """
        matching = threading.Event()
        querier = self._open().declare_querier(key, target=zenoh.QueryTarget.ALL)
        listener = querier.declare_matching_listener(
            _direct(lambda status: matching.set() if status.matching else matching.clear())
        )
        now: Any = querier.matching_status  # not a bool, as Zenoh's stubs state
        found = now.matching or matching.wait(timeout_s)
        listener.undeclare()
        querier.undeclare()
        return found

    # Replying and subscribing

    def reply_to(self, key: str, kind: type[Request], handle: Callable[[Request], msgspec.Struct]) -> None:
        """Reply to queries of a concrete key; `handle` may raise `Refused` or `AnotherReplies`.

        A key may end in `*` for the querier (`keys.asked_by_every_arm`); replies then go under the key of the query. A
        request that names another arm than that key is malformed.

        Raises:
            BusError: the client is not open, or its certificate does not allow it.
        """
        channel_for(key, "query", kind)
        self.require("reply to", key)
        receive = _direct(partial(self._receive, key, kind, handle))
        self._keep(self._open().declare_queryable(key, receive, complete=True))

    def subscribe(
        self,
        expression: str,
        kind: type[Message],
        handle: Callable[[str, Message], None],
        *,
        history: bool = False,
        most: int | None = None,
    ) -> None:
        """Receive all messages of one key expression; `handle` gets the name in the key and the message.

        Args:
            history: Also receive what publishers have cached, now and after a break, and messages lost in transit.
            most: Cached messages of each publisher, the newest; None for all.
        """
        channel = channel_for(expression, "publish", kind)

        def take(sample: zenoh.Sample) -> None:
            if sample.kind != zenoh.SampleKind.PUT:
                return
            try:
                payload = sample.payload.to_bytes()
                name, message = read_message(kind, str(sample.key_expr), str(sample.encoding), payload)
            except ValueError as error:
                self.reject(under(str(sample.key_expr)), error)
            else:
                handle(name, message)

        receive = _direct(partial(self.post, take))
        if not history:
            self._keep(self._open().declare_subscriber(expression, receive))
            return
        self._keep(
            advanced.declare_advanced_subscriber(
                self._open(),
                expression,
                receive,
                history=advanced.HistoryConfig(detect_late_publishers=True, max_samples=most or channel.history),
                recovery=advanced.RecoveryConfig(heartbeat=True, periodic_queries=None),
            )
        )

    def watch_tokens(self, expression: str, handle: Callable[[str, bool], None]) -> None:
        """Follow liveliness tokens: `handle` gets the name in the key, and whether the token is present.

        The same change may be reported twice.
        """
        channel_for(expression, "token")

        def receive(sample: zenoh.Sample) -> None:
            self.post(self._token, str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT, handle, urgent=True)

        self._keep(self._open().liveliness().declare_subscriber(expression, _direct(receive), history=True))

    def tokens(self, expression: str) -> frozenset[str]:
        """Names in the keys of the present liveliness tokens; waits for the router's reply.

        Raises:
            BusError: the router did not reply in time: it is unknown who is present.
        """
        names: set[str] = set()
        for reply in self._open().liveliness().get(expression, timeout=self._timeout_s):
            if reply.ok is None:
                raise BusError(
                    f"The router did not reply within {self._timeout_s:g} s: it is unknown who is present. Try again."
                )
            self._token(str(reply.ok.key_expr), True, lambda name, _: names.add(name))
        return frozenset(names)

    def complaints(self, since_s: float = -math.inf) -> dict[str, str]:
        """The last reason at each place with malformed messages since a monotonic second; the newest last."""
        return {place: reason for place, (reason, at_s) in self.rejections.items() if at_s >= since_s}

    def reject(self, place: str, error: object) -> None:
        """Count a malformed message; the log has the first, second, fourth, … one of each place and reason.

        Args:
            place: Where it was, for example `under`; `rejections` keeps the last one of each.
        """
        self.malformed += 1
        reason = f"{place}: {error}"
        place = place[:MOST_CHARACTERS]
        self.rejections[place] = reason[:MOST_CHARACTERS], time.monotonic()
        self.rejections.move_to_end(place)
        if len(self.rejections) > MOST_REJECTIONS:
            self.rejections.popitem(last=False)
        fault = _DECIMAL.sub("", reason[:MOST_CHARACTERS])
        if fault not in self._rejected and len(self._rejected) >= MOST_COUNTED:
            fault = ""
        self._rejected[fault] += 1
        count = self._rejected[fault]
        if count & (count - 1) == 0:  # 1, 2, 4, 8, …: a flood of messages must not flood the log
            alike = "like this" if fault else "of other kinds"
            _LOG.warning("Dropped invalid message (%d %s so far): %s", count, alike, reason)

    # Inside

    def _log_expiry(self) -> None:
        """Log once that the certificate has expired, and that the connection is back with a renewed one."""
        expiry = self.expiry
        if expiry and not self._expiry_logged:
            self._expiry_logged = True
            _LOG.error("%s", expiry)
        elif self._expiry_logged and not expiry and self.connected:
            self._expiry_logged = False
            _LOG.warning("The certificate of '%s' was renewed, and it is connected again.", self.participant)

    def _token(self, key: str, present: bool, handle: Callable[[str, bool], None]) -> None:
        try:
            name = keys.parse(key).name
        except ValueError as error:
            self.reject(f"token '{key}'", error)
        else:
            handle(name, present)

    def _receive(
        self, key: str, kind: type[Request], handle: Callable[[Request], msgspec.Struct], query: zenoh.Query
    ) -> None:
        """Queue a request; on Zenoh's thread. A large one is refused at once, because queued ones fill the memory."""
        parts = (query.payload, query.attachment, str(query.parameters))
        if (size := sum(len(part) for part in parts if part is not None)) <= MOST_BYTES:
            self.post(self._reply, key, query, kind, handle)
            return
        refusal = Refusal(_too_large(size))
        self.post(self.reject, f"query of '{key}'", refusal.reason)
        with query, suppress(ValueError):  # if there is no key to reply under
            query.reply(keys.answered(key, str(query.key_expr)), encode(refusal), encoding=encoding(Refusal))

    def _reply(
        self, key: str, query: zenoh.Query, kind: type[Request], handle: Callable[[Request], msgspec.Struct]
    ) -> None:
        with query:
            try:
                own_key = keys.answered(key, str(query.key_expr))
            except ValueError as error:  # there is no key to reply under
                self.reject(f"query of '{query.key_expr}'", error)
                return
            try:
                payload = b"" if query.payload is None else query.payload.to_bytes()
                request = decode(kind, payload, "" if query.encoding is None else str(query.encoding))
                if own_key != key:  # it ends in the name of the querier
                    check_name(request, keys.parse(own_key).asker, "arm")
                check_request(request)
                reply = handle(request)
            except MalformedMessage as error:
                self.reject(f"query of '{own_key}'", error)
                reply = Refusal(str(error))
            except Refused as refused:
                reply = Refusal(str(refused), refused.temporary)
            except AnotherReplies:
                return
            query.reply(own_key, encode(reply), encoding=encoding(type(reply)))


class _PendingQuery(Generic[Reply]):
    """A query that is not complete; arguments as of `BusClient.query`.

    Zenoh's thread calls `receive` and `finish`, which only queue calls.

    Attributes:
        token: Cancels the query when more replies arrive than are read.
    """

    def __init__(
        self,
        client: BusClient,
        kind: type[Reply],
        most: int,
        timeout_s: float,
        each: Callable[[Reply], None],
        done: Callable[[Replies[Reply]], None],
    ) -> None:
        self.token = zenoh.CancellationToken()
        self._client, self._kind, self._most, self._each, self._done = client, kind, most, each, done
        self._timeout_s = timeout_s
        self._replies: Replies[Reply] = Replies()
        self._start_s = time.monotonic()
        self._arrived = 0

    def receive(self, reply: zenoh.Reply) -> None:
        self._arrived += 1
        if self._arrived <= self._most:
            self._client.post(self._take, reply)
        elif self._arrived == self._most + 1:
            self._client.post(self._stop)

    def finish(self) -> None:
        self._client.post(self._complete)

    def _take(self, reply: zenoh.Reply) -> None:
        if reply.ok is None:
            # Any: Zenoh's stubs do not state that a reply has either `ok` or `err`.
            error: Any = reply.err
            reason = "" if error is None else error.payload.to_bytes().decode(errors="replace")
            add_reply(self._replies.refused, "?", "" if reason == "Timeout" else reason)
            return
        key, sent_encoding = str(reply.ok.key_expr), str(reply.ok.encoding)
        kind = Refusal if sent_encoding == encoding(Refusal) else self._kind
        try:
            _, message = read_message(kind, key, sent_encoding, reply.ok.payload.to_bytes())
        except ValueError as error:
            add_reply(self._replies.refused, key, str(error))
            self._client.reject(f"reply under '{key}'", error)
            return
        self._replies.add(key, message)
        if not isinstance(message, Refusal):
            self._each(message)

    def _stop(self) -> None:
        add_reply(self._replies.refused, "?", f"More than {self._most} replies to one query; no more are read.")
        self.token.cancel()  # and so calls `finish`

    def _complete(self) -> None:
        self._replies.took_s = time.monotonic() - self._start_s
        if self._arrived == 0 and self._replies.took_s >= self._timeout_s:  # a timeout of the router states none
            add_reply(self._replies.refused, "?", "")
        self._done(self._replies)


def _too_large(size: int) -> str:
    return f"The request has {size:,} bytes, and at most {MOST_BYTES:,} are allowed."


def add_reply(table: dict[str, Entry], key: str, entry: Entry) -> None:
    """Add without replacing another entry: several may reply under one key, as two auctioneers do."""
    name, number = key, 1
    while name in table:
        number += 1
        name = f"{key} ({number})"
    table[name] = entry


@lru_cache(4096)
def _objection(fleet: str, participant: RosterEntry, action: Action, key: str) -> str:
    """As `BusClient.objection`, of a participant of a fleet."""
    expression, name = zenoh.KeyExpr(key), participant.name
    if action != "query":
        name = keys.owner_of(key) or name
    allowed: list[str] = []
    for role, rights in rights_by_role(fleet, name).items():
        granted = rights.queries if action == "query" else rights.publishes
        if any(zenoh.KeyExpr(each).includes(expression) for each in granted):
            allowed.append(role)
    if participant.name == name and participant.role in allowed:
        return ""
    named = "" if participant.name == name else f" and the name '{name}'"
    needed = f"; that takes a certificate of the role {' or '.join(allowed)}{named}" if allowed else ""
    return f"'{participant.common_name}' may not {action} '{key}'{needed}."


@lru_cache(4096)
def _transport(key: str, pattern: Pattern, kind: type[msgspec.Struct]) -> tuple[BusChannel, dict[str, Any]]:
    """The channel of a key or key expression, and how Zenoh transports its messages; raises as `channel_for`."""
    channel = channel_for(key, pattern, kind)
    return channel, {  # Any: Zenoh's stubs have no types for settings
        "encoding": encoding(kind),
        "congestion_control": getattr(zenoh.CongestionControl, channel.congestion),
        "priority": getattr(zenoh.Priority, channel.priority),
    }


def _direct(handle: Callable[[Any], None], drop: Callable[[], None] | None = None) -> Any:
    """A handler on Zenoh's receiving thread: it only queues, so a Python thread in between would only cost time."""
    return zenoh.handlers.Callback(handle, drop, indirect=False)  # Any: the stubs type handlers by their internals
