"""Where an arm gets its work from, and to whom it answers for it: as a rule, auctioneers."""

import logging
import math
import time
from collections.abc import Callable
from functools import partial
from typing import Protocol

from fleet.bus import keys
from fleet.bus.answers import Answers
from fleet.bus.link import Link
from fleet.bus.trade import Ack, Award, Clock, ClockRequest, JobWord, Lease, LeaseRequest, Offer, Receipt, Report
from fleet.errors import BusError
from fleet.live.clock import FleetClock
from fleet.live.contractor import Contractor

_LOG = logging.getLogger(__name__)

ANSWER_S = 1.0
"""Real seconds that an auctioneer has to answer."""
CLOCK_S = (1.0, 30.0)
"""Real seconds between two questions for the time: until the first answer, and after it."""
TOLD_S = 10.0
"""Real seconds between two complaints about the same."""


class Worker(Protocol):
    """The arm that works on orders."""

    link: Link
    contractor: Contractor
    clock: FleetClock

    def set_clock(self, clock: FleetClock, *, jump: bool = False) -> None:
        """Go by another clock; with `jump` it reads another time now, and its body shall know."""
        ...

    def offers(self, words: tuple[JobWord, ...]) -> tuple[Offer, ...]:
        """What jobs would cost it now."""
        ...

    def tell_difficulty(self, offers: tuple[Offer, ...], real_s: float) -> None:
        """Say how hard it finds jobs."""
        ...

    def unfit(self) -> str:
        """Why it takes no work just now; "" if it does."""
        ...

    def take(self, award: Award, real_s: float) -> Ack:
        """Take an award in hand, or not."""
        ...


class Orders(Protocol):
    """Gives an arm its work."""

    objection: str
    """Why nobody else may give it any; "" if everybody may."""
    wake_s: float
    """Real second at which it wants its turn, though nothing has come."""

    def lease(self, auctioneer: str, request: LeaseRequest, asked_s: float) -> None:
        """Have leases renewed, and ask for leave to finish."""
        ...

    def report(self, auctioneer: str, report: Report) -> None:
        """Tell what became of an award."""
        ...

    def turn(self, real_s: float) -> None:
        """Do what is due."""
        ...


class Complaints:
    """Says the same only now and then."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._told_s: dict[str, float] = {}

    def __call__(self, what: str, sentence: str) -> None:
        """Say a sentence about something."""
        if (now_s := time.monotonic()) >= self._told_s.get(what, -math.inf) + TOLD_S:
            self._told_s[what] = now_s
            _LOG.warning("Arm '%s' %s", self._name, sentence)


class FromAuctioneers:
    """Orders of whatever auctioneer awards a job; the fleet's time is that of the auctioneer."""

    objection = ""
    wake_s = math.inf

    def __init__(self, worker: Worker) -> None:
        """Take part: the arm's line is open."""
        self._worker, self._link, self._name = worker, worker.link, worker.contractor.arm
        self._complain = Complaints(self._name)
        self._asked_s, self._known = -math.inf, False

    def lease(self, auctioneer: str, request: LeaseRequest, asked_s: float) -> None:
        """Ask an auctioneer."""

        def done(answers: Answers[Lease]) -> None:
            for lease in answers.words.values():
                self._worker.contractor.leased(lease, asked_s)

        key = keys.asked_by(self._link.fleet, auctioneer, "lease", self._name)
        self._safely(partial(self._link.ask, key, request, Lease, done, timeout_s=ANSWER_S))

    def report(self, auctioneer: str, report: Report) -> None:
        """Tell the auctioneer."""

        def done(answers: Answers[Receipt]) -> None:
            for receipt in answers.words.values():
                self._worker.contractor.receipted(receipt)

        key = keys.asked_by(self._link.fleet, auctioneer, "report", self._name)
        self._safely(partial(self._link.ask, key, report, Receipt, done, timeout_s=ANSWER_S))

    def turn(self, real_s: float) -> None:
        """Ask for the time, when that is due."""

        def done(answers: Answers[Clock]) -> None:
            for said in answers.words.values():
                self._hear(said, real_s, time.monotonic())
                return

        if real_s >= self._asked_s + CLOCK_S[self._known]:
            self._asked_s = real_s
            key = keys.of_clock(self._link.fleet)
            self._safely(partial(self._link.ask, key, ClockRequest(), Clock, done, timeout_s=ANSWER_S))

    def _hear(self, said: Clock, asked_s: float, answered_s: float) -> None:
        """Take the fleet's time: at once the first time, little by little after that."""
        clock = self._worker.clock
        if said.speed != clock.speed:
            self._complain("speed", f"goes at the fleet's speed of {said.speed:g}, not at {clock.speed:g}.")
            clock = FleetClock(said.speed, answered_s, clock.now_s(answered_s))
        if self._known:
            self._worker.set_clock(clock.corrected(asked_s, answered_s, said.time_s))
        else:
            self._known = True
            self._worker.set_clock(clock.set_by(asked_s, answered_s, said.time_s), jump=True)

    def _safely(self, ask: Callable[[], None]) -> None:
        """Ask; what cannot be asked now is asked again in its time."""
        try:
            ask()
        except BusError as error:
            self._complain("bus", str(error))
