"""Listens to a whole fleet without taking part in it."""

import logging
import time
from collections.abc import Callable
from functools import partial

import msgspec

from fleet.bus.client.client import BusClient
from fleet.bus.client.replies import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Clock, ClockRequest, Status, StatusRequest
from fleet.bus.protocol.registry import PUBLISHED
from fleet.errors import BusError
from fleet.live.monitor.snapshot import FleetView, Role

_LOG = logging.getLogger(__name__)

STATUS_EVERY_S = 5.0
"""Real seconds between two requests of the clock and of all jobs, whose results may be older than the listener."""
OnMessage = Callable[[str, str, msgspec.Struct], None]
"""Called with the topic, the name in the key, and the message."""
OnPresence = Callable[[Role, str, bool], None]
"""Called with the role and name of a participant, and whether it is present."""


class FleetListener:
    """`FleetListener(link).serve(until_s)` in a loop keeps `view` up to date.

    Attributes:
        view: The fleet as its messages show it.
    """

    def __init__(
        self,
        link: BusClient,
        *,
        on_message: OnMessage = lambda topic, name, message: None,
        on_presence: OnPresence = lambda role, name, present: None,
    ) -> None:
        """Subscribe to all that is published in the fleet; `link` is open.

        Args:
            on_message: Called after `view` was updated.
        """
        self.view = FleetView(link.fleet)
        self._link, self._on_message, self._on_presence = link, on_message, on_presence
        self._status_due_s = time.monotonic()
        for channel, message in PUBLISHED.items():
            one = str(keys.Key(link.fleet, channel.role, "x", channel.topic))
            everyone = one.replace(f"/{channel.role}/x/", f"/{channel.role}/*/")
            link.subscribe(everyone, message, partial(self._message, channel.topic), history=True)
        link.watch_tokens(keys.of_every_arm(link.fleet, "alive"), partial(self._token, "arm"))
        link.watch_tokens(keys.of_every_auction(link.fleet, "alive"), partial(self._token, "auction"))

    def serve(self, until_s: float) -> None:
        """Handle messages until the real second `until_s`; request the fleet's clock and all jobs when that is due."""
        asked_s = time.monotonic()
        if asked_s >= self._status_due_s:
            self._status_due_s = asked_s + STATUS_EVERY_S
            fleet, done = self._link.fleet, partial(self._statuses, asked_s)
            try:
                self._link.query(keys.of_clock(fleet), ClockRequest(), Clock, self._clocks, timeout_s=STATUS_EVERY_S)
                self._link.query(keys.of_jobs(fleet, "status"), StatusRequest(), Status, done, timeout_s=STATUS_EVERY_S)
            except BusError as error:
                _LOG.warning("%s", error)
        while time.monotonic() < until_s:
            self._link.serve(until_s)

    def _message(self, topic: str, name: str, message: msgspec.Struct) -> None:
        self.view.update(name, message, time.monotonic())
        self._on_message(topic, name, message)

    def _token(self, role: Role, name: str, present: bool) -> None:
        if self.view.set_token(role, name, present):
            self._on_presence(role, name, present)

    def _clocks(self, answers: Replies[Clock]) -> None:
        for reply in answers.messages.values():
            self.view.speed = reply.speed

    def _statuses(self, asked_s: float, answers: Replies[Status]) -> None:
        replies = list(answers.messages.values())
        for reply in replies:
            self.view.update_jobs(reply, time.monotonic())
        if not answers.refused:
            self.view.forget_other_jobs(replies, asked_s)
