"""A simulated bus: the calls of `fleet.bus.client.BusClient` on a `World`.

Messages are passed as objects; some are encoded and decoded on their way, as a check of the contract. A subscriber with
history gets what its publisher has cached, in order and once, as soon as both reach each other, but for `MISSED`.
Everything else may be lost, late, doubled or out of order.
"""

import math
from collections import deque
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import msgspec

from benchmarks.simulation.world import Process, Sleep, World
from fleet.bus.client import AnotherReplies, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.keys import channel_for
from fleet.bus.protocol.messages import Refusal, decode, encode, encoding
from fleet.errors import BusError, Refused

ENCODED = 0.02
"""Share of messages that are encoded and decoded on their way."""
MISSED = 0.3
"""Share of lost messages that a subscriber with history never gets: it asks a cache once for what it misses."""

Handle = Callable[..., Any]


@lru_cache(100_000)
def matches(one: str, other: str) -> bool:
    """Return whether two key expressions have a key in common; `*` stands for one chunk."""
    parts, others = one.split("/"), other.split("/")
    return len(parts) == len(others) and all(a == b or "*" in (a, b) for a, b in zip(parts, others, strict=True))


class Bus:
    """What all clients of a world have declared."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.clients: dict[str, SimulatedClient] = {}
        self.on_publish: Handle = lambda published, message: None

    def drop(self, process: Process) -> None:
        """Forget an ended process."""
        for name in (process.name, f"{process.name}+"):
            self.clients.pop(name, None)
        self.update_tokens()

    def update_tokens(self) -> None:
        """Tell every client which tokens have changed for it."""
        for client in list(self.clients.values()):
            for expression, handle, seen in client.watches:
                present = self.tokens(client.process, expression)
                for name in sorted(present ^ seen):
                    self.world.after(self.world.delay_s(), client.receive_token, handle, expression, name)
                seen.clear()
                seen.update(present)

    def tokens(self, viewer: Process, expression: str) -> set[str]:
        """Names in the tokens that a process sees."""
        return {
            keys.parse(token).name
            for client in self.clients.values()
            for token in client.own_tokens
            if matches(expression, token) and not client.process.hung and self.visible(client.process, viewer)
        }

    @staticmethod
    def visible(process: Process, viewer: Process) -> bool:
        """Whether one process counts as connected for another."""
        return process is viewer or process.seen_group == viewer.seen_group


class Published:
    """A publisher with its cache."""

    def __init__(self, client: "SimulatedClient", key: str, channel: Any) -> None:
        self.client, self.key, self.channel = client, key, channel
        self.count = 0
        self.cache: deque[tuple[int, msgspec.Struct]] = deque(maxlen=max(1, channel.history))
        self.name = keys.parse(key).name

    def put(self, message: msgspec.Struct) -> None:
        """Publish a message."""
        self.count += 1
        self.cache.append((self.count, message))
        self.client.bus.on_publish(self, message)
        world, process = self.client.world, self.client.process
        for subscription in self.client.subscriptions_of(self.key):
            if subscription.history:
                subscription.fetch_soon(self, world.delay_s())
            elif world.reach(process, subscription.client.process):
                world.send(process, subscription.client.process, subscription.handle, self.name, message)


class Subscription:
    """A subscriber."""

    def __init__(self, client: "SimulatedClient", expression: str, handle: Handle, history: bool) -> None:
        self.client, self.expression, self.handle, self.history = client, expression, handle, history
        self._last: dict[Published, int] = {}
        self._due: set[Published] = set()

    def fetch_soon(self, source: Published, wait_s: float) -> None:
        """Fetch what is new after some time."""
        if source not in self._due:
            self._due.add(source)
            self.client.world.after(wait_s, self._fetch, source)

    def _fetch(self, source: Published) -> None:
        self._due.discard(source)
        world, process, own = self.client.world, source.client.process, self.client.process
        if not (source.client.open_ and self.client.open_):
            return
        lost = world.rng.random() < world.loss
        if not world.reach(process, own) or process.hung or lost:
            if lost and source.channel.history > 1 and world.rng.random() < MISSED:
                self._last[source] = source.count
            self.fetch_soon(source, source.channel.heartbeat_s * (1.0 + world.rng.random()))
            return
        last = self._last.get(source, 0)
        if source.count == last:
            return
        self._last[source] = source.count
        for number, message in list(source.cache):
            if number > last and self.client.open_:
                own.put(self.handle, source.name, message)


class SimulatedClient:
    """A participant's connection, as `BusClient`; a `further` one is opened and closed while it works."""

    def __init__(self, process: Process, fleet: str = "f", *, further: bool = False) -> None:
        self.process, self.world, self.fleet = process, process.world, fleet
        self.bus: Bus = process.world.bus
        self.malformed = self.overrun = 0
        self.elapsed = False
        self.own_tokens: list[str] = []
        self.watches: list[tuple[str, Handle, set[str]]] = []
        self.queryables: list[tuple[str, Handle]] = []
        self.subscriptions: list[Subscription] = []
        self.publishers: list[Published] = []
        self._boot, self._further, self._batch_s = process.boot, further, math.inf
        if not further:
            process.client = self
            self.bus.clients[process.name] = self

    @property
    def open_(self) -> bool:
        own = self.bus.clients.get(f"{self.process.name}+") is self if self._further else True
        return self.process.up and self.process.boot == self._boot and own

    def open(self) -> "SimulatedClient":
        """Connect a further client; `BusError` without a router."""
        if self.process.group:
            raise BusError("no router")
        self.bus.clients[f"{self.process.name}+"] = self
        return self

    def close(self) -> None:
        """Close a further client; the others end with their process."""
        if self._further and self.open_:
            del self.bus.clients[f"{self.process.name}+"]

    # Handling

    def serve(self, until_s: float = -math.inf, *, at_least: int = 1) -> int:
        """Handle what has arrived; without anything, wait once per turn of the process."""
        if at_least > 1:
            return self._serve_batch(until_s, at_least)
        handled = self.handle_all()
        if not handled and not self.elapsed and until_s > self.process.real_s:
            raise Sleep(until_s)
        self.elapsed = False
        return handled

    def _serve_batch(self, until_s: float, at_least: int) -> int:
        """Wait until there are as many messages, or until that time."""
        self._batch_s = min(self._batch_s, until_s)
        if len(self.process.inbox) < at_least and self.process.real_s < self._batch_s:
            raise Sleep(self._batch_s)
        self._batch_s = math.inf
        return self.handle_all()

    def handle_all(self) -> int:
        handled = 0
        for _ in range(len(self.process.inbox)):
            handle, arguments = self.process.inbox.popleft()
            handle(*arguments)
            handled += 1
        return handled

    def post(self, handle: Handle, *arguments: Any, urgent: bool = False) -> None:
        """Queue a call."""
        self.process.inbox.append((handle, arguments))

    def reject(self, reason: str) -> None:
        """Count a malformed message: none is ever sent here."""
        raise AssertionError(reason)

    def _checked(self, message: msgspec.Struct) -> msgspec.Struct:
        """Return the message; sometimes as its bytes give it."""
        if self.world.rng.random() >= ENCODED:
            return message
        return decode(type(message), encode(message), encoding(type(message)))

    # Publishing

    def publisher(self, key: str, kind: type[msgspec.Struct]) -> Handle:
        published = Published(self, key, channel_for(key, "publish", kind))
        self.publishers.append(published)
        for subscription in self.subscriptions_of(key):
            if subscription.history:
                subscription.fetch_soon(published, self.world.delay_s())
        return lambda message: published.put(self._checked(message))

    def publish(self, key: str, message: msgspec.Struct) -> None:
        Published(self, key, channel_for(key, "publish", type(message))).put(message)

    def subscriptions_of(self, key: str) -> list[Subscription]:
        return [
            subscription
            for client in self.bus.clients.values()
            for subscription in client.subscriptions
            if matches(subscription.expression, key)
        ]

    def subscribe(
        self,
        expression: str,
        kind: type[msgspec.Struct],
        handle: Handle,
        *,
        history: bool = False,
    ) -> None:
        channel_for(expression, "publish", kind)
        subscription = Subscription(self, expression, handle, history)
        self.subscriptions.append(subscription)
        for client in self.bus.clients.values() if history else ():
            for published in client.publishers:
                if matches(expression, published.key):
                    subscription.fetch_soon(published, self.world.delay_s())

    # Tokens

    def declare_token(self, key: str) -> None:
        channel_for(key, "token")
        self.own_tokens.append(key)
        self.bus.update_tokens()

    def watch_tokens(self, expression: str, handle: Handle) -> None:
        channel_for(expression, "token")
        self.watches.append((expression, handle, set()))
        self.bus.update_tokens()

    def receive_token(self, handle: Handle, expression: str, name: str) -> None:
        """Pass on the present state of a token, however late the news of its change is."""
        if self.open_:
            self.process.put(handle, name, name in self.bus.tokens(self.process, expression))

    def tokens(self, expression: str) -> frozenset[str]:
        return frozenset(self.bus.tokens(self.process, expression))

    # Queries

    def reply_to(self, key: str, kind: type[msgspec.Struct], handle: Handle) -> None:
        channel_for(key, "query", kind)
        self.queryables.append((key, handle))

    def query(
        self,
        key: str,
        request: msgspec.Struct,
        kind: type[msgspec.Struct],
        done: Handle,
        *,
        timeout_s: float,
        each: Handle = lambda reply: None,
    ) -> None:
        assert channel_for(key, "query", type(request)).reply is kind
        targets = [
            (client, expression, handle)
            for client in self.bus.clients.values()
            for expression, handle in client.queryables
            if matches(expression, key) and self.bus.visible(client.process, self.process)
        ]
        query = _Query(self, key, self._checked(request), done, each, len(targets))
        for target in targets:
            self.world.send(self.process, target[0].process, query.answer, *target)
        wait_s = self.world.delay_s() if not targets else timeout_s / self.process.rate
        self.world.after(wait_s, query.time_out)

    def query_and_wait(
        self, key: str, request: msgspec.Struct, kind: type[msgspec.Struct], *, timeout_s: float
    ) -> Replies[Any]:
        complete: list[Replies[Any]] = []
        self.query(key, request, kind, complete.append, timeout_s=timeout_s)

        def is_complete() -> bool:
            self.handle_all()
            return bool(complete)

        self.world.wait(self.process, self.process.real_s + timeout_s + 1.0, is_complete)
        return complete[0] if complete else Replies(took_s=timeout_s)

    def ask(self, key: str, request: msgspec.Struct, kind: type[msgspec.Struct], *, timeout_s: float) -> Any:
        return self.query_and_wait(key, request, kind, timeout_s=timeout_s).first(key)


class _Query:
    """A query in progress."""

    def __init__(
        self, client: SimulatedClient, key: str, request: msgspec.Struct, done: Handle, each: Handle, count: int
    ) -> None:
        self.client, self.key, self.request, self.done, self.each = client, key, request, done, each
        self.replies: Replies[Any] = Replies()
        self.left, self.over, self.sent_s = count, False, client.process.real_s
        self.replied: set[str] = set()

    def answer(self, client: SimulatedClient, expression: str, handle: Handle) -> None:
        """Reply, as the process of `client`."""
        own_key = keys.answered(expression, self.key) if expression.endswith("*") else expression
        try:
            reply = client._checked(handle(self.request))
        except Refused as refused:
            reply = Refusal(str(refused), refused.temporary)
        except AnotherReplies:
            reply = None
        if client.world.reach(client.process, self.client.process):
            client.world.send(client.process, self.client.process, self.take, client.process.name, own_key, reply)

    def take(self, replier: str, key: str, reply: msgspec.Struct | None) -> None:
        """Take a reply, as the querying process."""
        if self.over or replier in self.replied or not self.client.open_:
            return
        self.replied.add(replier)
        self.left -= 1
        if reply is not None:
            self.replies.add(key, reply)
            if not isinstance(reply, Refusal):
                self.each(reply)
        if not self.left:
            self._finish()

    def time_out(self) -> None:
        """End the wait for replies."""
        if not self.over and self.client.open_:
            self.client.process.put(self._end)

    def _end(self) -> None:
        if not self.over:
            if self.left:
                self.replies.refused["?"] = ""
            self._finish()

    def _finish(self) -> None:
        self.over = True
        self.replies.took_s = self.client.process.real_s - self.sent_s
        self.done(self.replies)
