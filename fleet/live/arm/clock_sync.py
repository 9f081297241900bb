"""Synchronisation of an arm's clock with fleet time."""

import math
import time
from collections.abc import Callable
from dataclasses import replace

from fleet.bus.client.client import BusClient
from fleet.bus.client.replies import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Clock, ClockRequest
from fleet.errors import BusError
from fleet.live.clock import FleetClock

REPLY_S = 1.0
"""Real seconds that an auctioneer has to reply."""
CLOCK_S = (1.0, 30.0)
"""Real seconds between two clock requests: until the first reply, and after it."""


class ClockSync:
    """Requests fleet time, and sets a clock to it: at once by the first reply, gradually by later ones.

    Args:
        clock: Returns the clock.
        set_clock: Replaces it; the second argument is whether it reads another time now.
        warn: Logs a warning of a kind.
    """

    def __init__(
        self,
        link: BusClient,
        clock: Callable[[], FleetClock],
        set_clock: Callable[[FleetClock, bool], None],
        warn: Callable[[str, str], None],
    ) -> None:
        self._link, self._clock, self._set_clock, self._warn = link, clock, set_clock, warn
        self._asked_s, self._is_set = -math.inf, False

    def step(self, real_s: float) -> None:
        """Request the fleet time, when that is due."""
        if real_s < self._asked_s + CLOCK_S[self._is_set]:
            return
        self._asked_s = real_s

        def done(answers: Replies[Clock]) -> None:
            for reply in answers.messages.values():
                self._apply(reply, real_s, time.monotonic())
                return

        try:
            self._link.query(keys.of_clock(self._link.fleet), ClockRequest(), Clock, done, timeout_s=REPLY_S)
        except BusError as error:
            self._warn("bus", str(error))

    def _apply(self, reply: Clock, asked_s: float, answered_s: float) -> None:
        clock = self._clock()
        if reply.speed != clock.speed:
            clock = FleetClock(reply.speed, answered_s, clock.now_s(answered_s))
        clock = replace(clock, epoch=reply.epoch)
        set_to, jump = (clock.slewed_to, False) if self._is_set else (clock.set_to, True)
        self._is_set = True
        self._set_clock(set_to(asked_s, answered_s, reply.time_s), jump)
