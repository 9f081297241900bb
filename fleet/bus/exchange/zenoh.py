"""The exchange over Zenoh: what an arm knows of its peers arrived over the bus.

In small fleets every arm has its own client. In large ones all arms publish with one and receive with another, as the
messages that n sessions receive from n arms grow with n², and with them memory and the time for discovery.

At each step an arm publishes its `state` and then its `difficulty`, over the same connection. It publishes `info` when
it changes, and a liveliness token shows that the arm is present.
"""

import logging
import math
import time
import weakref
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path
from typing import Self, TypeVar

import numpy as np
import zenoh

from fleet.bus.client.client import BACKLOG, BusClient
from fleet.bus.client.replies import read_message
from fleet.bus.client.router import Router, reachable
from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.bus.exchange.delivery import Delivery
from fleet.bus.exchange.group import Group, messages_of
from fleet.bus.exchange.protocol import (
    Broadcast,
    PeerView,
    assemble,
    check,
    check_order,
    checked_arms,
)
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import DifficultyScores, State
from fleet.bus.security.tls import Tls
from fleet.errors import BusError

_LOG = logging.getLogger(__name__)

Message = TypeVar("Message", State, DifficultyScores)

MOST_OWN_SESSIONS = 8
"""Largest fleet whose arms have a session each; a larger one has two, one to publish and one to receive."""
MOST_NAMED = 8
"""Arms listed in one message."""
_OPEN_TIMEOUT_S = 20.0


def sessions_for(arms: int) -> int:
    """Number of sessions from which a fleet without certificates publishes."""
    return arms if arms <= MOST_OWN_SESSIONS else 1


class ZenohExchange:
    """Shares broadcasts through Zenoh: a router and the clients of the arms, all in this process.

    Nothing is opened before the first `share` or the `with` block. One thread at a time may use an exchange.

    The receivers apply a channel that is not perfect: the bus carries every message to every arm, and each receiver
    delays and drops messages as the channel says. So the result is that of a `MemoryExchange`.
    """

    def __init__(
        self,
        arms: Sequence[str],
        fleet: str,
        endpoint: str | None = None,
        *,
        channel: Channel = PERFECT,
        tls: Path | None = None,
        timeout_s: float = 2.0,
        sessions: int | None = None,
    ) -> None:
        """Prepare an exchange between `arms`.

        Args:
            fleet: Name of the fleet, part of every key.
            endpoint: Of a router on loopback, as `tcp/127.0.0.1:7447`; None to start one on a free port.
            tls: Folder with a certificate of every arm, and of `router` to start one. The endpoint then begins with
                `tls/`, and may be on any host.
            timeout_s: Longest wait of `share` for missing messages.
            sessions: Most sessions from which the arms publish; by default `sessions_for` them. Arms that share one
                receive with another. With `tls` each has its own.

        Raises:
            BusError: the endpoint is not on loopback.
            ValueError: the channel names an arm that is not there.
        """
        self.arms = checked_arms(arms)
        if not 0 < timeout_s < math.inf:
            raise ValueError(f"timeout_s must be finite and > 0 (got {timeout_s}).")
        if sessions is not None and sessions < 1:
            raise ValueError(f"sessions must be >= 1 (got {sessions}).")
        self.delivered = 0
        self.malformed = 0
        self.late = 0
        count = len(self.arms)
        self._sessions = count if tls is not None else min(sessions or sessions_for(count), count)
        keys.chunk(fleet)
        self._fleet = fleet
        self._tls = {arm: None if tls is None else Tls(tls, arm) for arm in self.arms}
        self._own_tls = None if tls is None else Tls(tls, "router")
        self._endpoint = None if endpoint is None else reachable(endpoint, self._tls[self.arms[0]])
        self._timeout_s = timeout_s
        self._delivery = None if channel.perfect else Delivery(self.arms, channel)
        self._groups: list[Group] = []
        # Where several clients receive the messages of every arm, the first one decodes them.
        self._read = read_message if self._sessions == 1 else lru_cache(4 * count)(read_message)
        self._tick = -1
        self._now_s = -math.inf
        self._missed: set[tuple[int, int]] = set()
        self._closed = False
        self._resources = ExitStack()
        # A process that exits without closing its router would hang.
        self._at_exit = weakref.finalize(self, self._resources.close)

    @property
    def endpoint(self) -> str | None:
        """Where the router listens; None before the exchange is open."""
        return self._endpoint

    def open(self) -> Self:
        """Start a router if no endpoint was given, connect every arm, and wait until all see each other.

        Raises:
            BusError: no router, an arm of this name is already present, an arm does not see another, or closed.
        """
        if self._closed:
            raise BusError("This exchange is closed.")
        if self._groups:
            return self
        try:
            if self._endpoint is None:
                self._endpoint = self._resources.enter_context(Router(tls=self._own_tls)).endpoint
            clients = [self._resources.enter_context(self._client(arm)) for arm in self.arms[: self._sessions]]
            self._refuse_namesakes(clients[0])
            everybody = range(len(self.arms))
            for i, client in enumerate(clients):
                members = everybody[i :: len(clients)]
                alone = len(members) == 1
                reader = client if alone else self._resources.enter_context(self._client(self.arms[i]))
                self._groups.append(Group(client, reader, self.arms, members))
            deadline_s = time.monotonic() + _OPEN_TIMEOUT_S
            for group in self._groups:
                if missing := group.await_peers(deadline_s):
                    raise BusError(
                        f"Arm '{self.arms[group.members[0]]}' did not discover "
                        f"{_named(self.arms[i] for i in missing)} on the bus within {_OPEN_TIMEOUT_S} s."
                    )
        except zenoh.ZError as error:
            self._give_up()
            raise BusError(f"The bus at {self._endpoint} could not be opened: {error}") from error
        except BaseException:
            self._give_up()
            raise
        return self

    def begin(self, rng: np.random.Generator | None = None) -> None:
        """Begin an episode without any received messages; `rng` is for channels with loss or jitter."""
        if self._delivery is not None:
            self._delivery.begin(rng)
        for group in self._groups:
            group.begin_step(self._tick, self._now_s)  # queued messages belong to the last episode
            group.forget(self._tick)
        self._now_s = -math.inf

    def share(self, broadcast: Broadcast) -> PeerView:
        """Publish the broadcast of one step, and return what every arm knows after it.

        Waits at most `timeout_s` until every arm has received the messages of every present peer. If a message is
        late, the last one remains with its age, and `late` counts it.

        Raises:
            ValueError: the broadcast does not fit the arms or holds infinite numbers; or the channel has loss or
                jitter, and there is no rng.
            BusError: the bus could not be opened, was lost, or is closed.
        """
        check(broadcast, self.arms)
        check_order(broadcast.time_s, self._now_s)
        self.open()
        for group in self._groups:
            group.begin_step(self._tick, self._now_s)
        self._tick += 1
        self._now_s = float(broadcast.time_s)
        try:
            messages = messages_of(broadcast, self.arms, self._tick)
            for group in self._groups:
                group.publish(self._tick, self._now_s, messages)
        except zenoh.ZError as error:
            raise BusError(f"The bus at {self._endpoint} was lost: {error}") from error
        deadline_s = time.monotonic() + self._timeout_s
        self._count(
            {
                (receiver, sender)
                for group in self._groups
                for sender in group.await_messages(deadline_s)
                for receiver in group.members
                if receiver != sender
            }
        )
        self.malformed = sum(group.reader.malformed for group in self._groups)
        states, difficulties = zip(*messages, strict=True)
        if self._delivery is None:
            conditions = self._by_receiver([group.conditions.last for group in self._groups], states)
            scores = self._by_receiver([group.scores.last for group in self._groups], difficulties)
            return assemble(self._now_s, broadcast.jobs, conditions, scores)
        # On a channel that is not perfect, a message that the bus itself delivers a step late is lost.
        conditions = self._by_receiver([group.conditions.of(self._tick) for group in self._groups], states)
        scores = self._by_receiver([group.scores.of(self._tick) for group in self._groups], difficulties)
        self._delivery.carry(self._now_s, conditions, scores)
        self.delivered, self.late = self._delivery.delivered, self._delivery.late
        return assemble(self._now_s, broadcast.jobs, self._delivery.conditions, self._delivery.scores)

    def close(self) -> None:
        """Disconnect every arm and stop the router; may be called twice.

        Raises:
            BusError: a client or the router did not close cleanly; the others are closed.
        """
        self._closed = True
        self._groups = []
        try:
            self._resources.close()
        except (zenoh.ZError, BusError) as error:
            raise BusError(f"The exchange did not close cleanly: {error}") from error
        finally:
            self._at_exit.detach()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if error is None:
            self.close()
        else:
            self._give_up()

    def _client(self, arm: str) -> BusClient:
        assert self._endpoint is not None
        tls = self._tls[arm]
        endpoint = self._endpoint if tls is None else tls.endpoint(self._endpoint)
        backlog = max(BACKLOG, 16 * len(self.arms))
        return BusClient(endpoint, self._fleet, timeout_s=self._timeout_s, backlog=backlog, read=self._read)

    def _give_up(self) -> None:
        """Close without hiding the exception that is being raised."""
        try:
            self.close()
        except BusError:
            _LOG.exception("While closing after another error:")

    def _by_receiver(self, of_groups: list[list[Message | None]], own: Sequence[Message]) -> list[list[Message | None]]:
        """[receiver][sender], from what each group received and the messages of this step, [arm].

        An arm has its own message, also when the bus did not bring it back.
        """
        rows = [of_groups[i % len(of_groups)] for i in range(len(self.arms))]
        return [
            row if (last := row[i]) is not None and last.tick == self._tick else [*row[:i], own[i], *row[i + 1 :]]
            for i, row in enumerate(rows)
        ]

    def _refuse_namesakes(self, client: BusClient) -> None:
        present = client.tokens(keys.of_every_arm(self._fleet, "alive"), timeout_s=self._timeout_s)
        if taken := sorted(present & set(self.arms)):
            raise BusError(f"Fleet '{self._fleet}' already has {', '.join(taken)} on the bus at {self._endpoint}.")

    def _count(self, missed: set[tuple[int, int]]) -> None:
        self.late += len(missed)
        self.delivered += len(self.arms) * (len(self.arms) - 1) - len(missed)
        if fresh := sorted(missed - self._missed):
            pairs = _named(f"{self.arms[sender]} by {self.arms[receiver]}" for receiver, sender in fresh)
            _LOG.warning("Not received at %s s (logged once until received again): %s.", self._now_s, pairs)
        self._missed = missed


def _named(names: Iterable[str]) -> str:
    """The first names of a list, and the number of the others."""
    names = list(names)
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return ", ".join(names[:MOST_NAMED]) + more
