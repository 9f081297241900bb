"""Where an arm's work comes from, and to whom it reports: by default, auctioneers."""

import logging
import math
import time
from collections.abc import Callable
from functools import partial
from typing import Protocol

from fleet.bus.client.client import BusClient
from fleet.bus.client.replies import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    Award,
    Clock,
    ClockRequest,
    JobEstimate,
    JobSpec,
    Lease,
    LeaseRequest,
    Receipt,
    Report,
)
from fleet.errors import BusError
from fleet.live.arm.award_executor import AwardExecutor
from fleet.live.clock import FleetClock

_LOG = logging.getLogger(__name__)

REPLY_S = 1.0
"""Real seconds that an auctioneer has to reply."""
CLOCK_S = (1.0, 30.0)
"""Real seconds between two clock requests: until the first reply, and after it."""
WARNING_S = 10.0
"""Real seconds between two warnings about the same thing."""


class LiveArm(Protocol):
    """An arm, as its work source sees it."""

    link: BusClient
    executor: AwardExecutor
    clock: FleetClock

    def set_clock(self, clock: FleetClock, *, jump: bool = False) -> None:
        """Use another clock; with `jump` it reads another time now, and the body is set to that time."""
        ...

    def estimate(self, jobs: tuple[JobSpec, ...]) -> tuple[JobEstimate, ...]:
        """Estimate what jobs would cost the arm now."""
        ...

    def publish_difficulty(self, estimates: tuple[JobEstimate, ...], real_s: float) -> None:
        """Publish how difficult jobs are for the arm."""
        ...

    def unfit(self) -> str:
        """Why the arm accepts no work now; "" if it does."""
        ...

    def answer_award(self, award: Award, real_s: float) -> Ack:
        """Accept or refuse an award."""
        ...


class WorkSource(Protocol):
    """Gives an arm its work, and takes its reports."""

    objection: str
    """Why nobody else may award the arm jobs; "" if everybody may."""
    wake_s: float
    """Real second at which `step` is due even if no message arrives."""

    def request_leases(self, auctioneer: str, request: LeaseRequest, asked_s: float) -> None:
        """Request renewal of leases, and permission to commit."""
        ...

    def send_report(self, auctioneer: str, report: Report) -> None:
        """Report the end of an award."""
        ...

    def step(self, real_s: float) -> None:
        """Do what is due."""
        ...


class RateLimitedWarnings:
    """Logs warnings of an arm, each kind at most once in `WARNING_S`."""

    def __init__(self, arm: str) -> None:
        self._arm = arm
        self._logged_s: dict[str, float] = {}

    def __call__(self, kind: str, sentence: str) -> None:
        """Log a warning; `sentence` continues after the name of the arm."""
        if (now_s := time.monotonic()) >= self._logged_s.get(kind, -math.inf) + WARNING_S:
            self._logged_s[kind] = now_s
            _LOG.warning("Arm '%s' %s", self._arm, sentence)


class AuctioneerClient:
    """Work source: any auctioneer that awards a job. Fleet time is that of the auctioneer."""

    objection = ""
    wake_s = math.inf

    def __init__(self, arm: LiveArm) -> None:
        """Start; the arm's link is open."""
        self._arm, self._link, self._name = arm, arm.link, arm.executor.arm
        self._warn = RateLimitedWarnings(self._name)
        self._asked_s, self._clock_is_set = -math.inf, False

    def request_leases(self, auctioneer: str, request: LeaseRequest, asked_s: float) -> None:
        """Send a lease request to its auctioneer."""

        def done(answers: Replies[Lease]) -> None:
            for lease in answers.messages.values():
                self._arm.executor.apply_lease(lease, asked_s)

        key = keys.asked_by(self._link.fleet, auctioneer, "lease", self._name)
        self._try(partial(self._link.query, key, request, Lease, done, timeout_s=REPLY_S))

    def send_report(self, auctioneer: str, report: Report) -> None:
        """Send a report to its auctioneer."""

        def done(answers: Replies[Receipt]) -> None:
            for receipt in answers.messages.values():
                self._arm.executor.apply_receipt(receipt)

        key = keys.asked_by(self._link.fleet, auctioneer, "report", self._name)
        self._try(partial(self._link.query, key, report, Receipt, done, timeout_s=REPLY_S))

    def step(self, real_s: float) -> None:
        """Request the fleet time, when that is due."""

        def done(answers: Replies[Clock]) -> None:
            for reply in answers.messages.values():
                self._apply_clock(reply, real_s, time.monotonic())
                return

        if real_s >= self._asked_s + CLOCK_S[self._clock_is_set]:
            self._asked_s = real_s
            key = keys.of_clock(self._link.fleet)
            self._try(partial(self._link.query, key, ClockRequest(), Clock, done, timeout_s=REPLY_S))

    def _apply_clock(self, reply: Clock, asked_s: float, answered_s: float) -> None:
        """Set the arm's clock by a reply: at once the first time, gradually afterwards."""
        clock = self._arm.clock
        if reply.speed != clock.speed:
            self._warn("speed", f"runs at the fleet's speed of {reply.speed:g}, not at {clock.speed:g}.")
            clock = FleetClock(reply.speed, answered_s, clock.now_s(answered_s))
        if self._clock_is_set:
            self._arm.set_clock(clock.slewed_to(asked_s, answered_s, reply.time_s))
        else:
            self._clock_is_set = True
            self._arm.set_clock(clock.set_to(asked_s, answered_s, reply.time_s), jump=True)

    def _try(self, ask: Callable[[], None]) -> None:
        """Send a request; if it cannot be sent now, the next one is due later anyway."""
        try:
            ask()
        except BusError as error:
            self._warn("bus", str(error))
