"""Source of an arm's work, by default auctioneers."""

import logging
import math
import time
from collections.abc import Callable
from typing import Protocol, TypeVar

import msgspec

from fleet.bus.client.client import BusClient
from fleet.bus.client.replies import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Lease, LeaseRequest, Receipt, Report
from fleet.bus.protocol.history import HistoryRequest
from fleet.errors import BusError
from fleet.live.arm.award_executor import AwardExecutor
from fleet.live.arm.clock_sync import REPLY_S, ClockSync
from fleet.live.arm.journal_records import ArmHistory
from fleet.live.clock import FleetClock

_LOG = logging.getLogger(__name__)

Message = TypeVar("Message", bound=msgspec.Struct)
WARNING_S = 10.0
"""Real seconds between two warnings about the same thing."""


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


class WorkingArm(Protocol):
    """What a work source needs of its arm."""

    link: BusClient
    executor: AwardExecutor
    clock: FleetClock

    def set_clock(self, clock: FleetClock, *, jump: bool = False) -> None:
        """Use another clock; with `jump` it reads another time now."""
        ...


class AuctioneerClient:
    """Work source: any auctioneer that awards a job. Fleet time is that of the auctioneer."""

    objection = ""
    wake_s = math.inf

    def __init__(self, arm: WorkingArm, history: ArmHistory | None = None) -> None:
        """Start.

        Args:
            history: The awards of the arm on its disk, now and later: auctioneers ask for it.
        """
        self._link, self._executor = arm.link, arm.executor
        if history is not None:
            link, fleet, name = arm.link, arm.link.fleet, arm.executor.arm
            link.reply_to(keys.of_arm(fleet, name, "history"), HistoryRequest, lambda _: history.message(name))
        self._warn = RateLimitedWarnings(arm.executor.arm)
        self._clock = ClockSync(
            arm.link, lambda: arm.clock, lambda clock, jump: arm.set_clock(clock, jump=jump), self._warn
        )

    def request_leases(self, auctioneer: str, request: LeaseRequest, asked_s: float) -> None:
        """Send a lease request to its auctioneer."""
        self._send(auctioneer, "lease", request, Lease, lambda lease: self._executor.apply_lease(lease, asked_s))

    def send_report(self, auctioneer: str, report: Report) -> None:
        """Send a report to its auctioneer."""
        self._send(auctioneer, "report", report, Receipt, self._executor.apply_receipt)

    def step(self, real_s: float) -> None:
        """Request the fleet time, when that is due."""
        self._clock.step(real_s)

    def _send(
        self,
        auctioneer: str,
        topic: keys.AskedTopic,
        request: LeaseRequest | Report,
        kind: type[Message],
        apply: Callable[[Message], None],
    ) -> None:
        """Send a request, and apply its replies; if it cannot be sent now, the next one is due later anyway."""

        def done(answers: Replies[Message]) -> None:
            for reply in answers.messages.values():
                apply(reply)

        key = keys.asked_by(self._link.fleet, auctioneer, topic, self._executor.arm)
        try:
            self._link.query(key, request, kind, done, timeout_s=REPLY_S)
        except BusError as error:
            self._warn("bus", str(error))
