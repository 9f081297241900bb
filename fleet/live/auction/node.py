"""The auctioneer on the bus: it hears who is there, asks, awards, and keeps the fleet's time. One thread drives it."""

import logging
import math
import secrets
import time
from collections.abc import Callable
from typing import TypeVar

import msgspec

from fleet.bus.client.client import BusClient, Refused
from fleet.bus.client.replies import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    Announcement,
    Clock,
    ClockRequest,
    LeaseRequest,
    Quote,
    QuoteRequest,
    Report,
    Result,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.registry import SESSION_LEASE_S
from fleet.errors import BusError, JournalFull
from fleet.live.auction.auctioneer import SCAN_S, Auctioneer, Objection, SendAward
from fleet.live.auction.journal_records import AuctionRecord, ClockTick, Started
from fleet.live.auction.lease_timing import Timing
from fleet.live.auction.ledger import Ledger
from fleet.live.auction.round import Allocate
from fleet.live.auction.status_message import statuses_that_fit
from fleet.live.clock import FleetClock
from fleet.live.journal import Journal
from fleet.live.monitor.snapshot import FRESH_S

_LOG = logging.getLogger(__name__)

Word = TypeVar("Word", bound=msgspec.Struct)

TICK_S = 2.0
"""Real seconds between two records of the fleet's time."""
ROLL_S, ALONE_S = 1.0, 3.0
"""Real seconds between two questions who answers as auctioneer here; how long one is sure, after that, to be alone."""


class AuctionNode:
    """The one auctioneer of a fleet.

    Attributes:
        auctioneer: Its state machine.
        journal: Where its promises are.
        rivals: Other auctioneers that are in the fleet, against the rule; its own name stands for another of that name.
            While there are any, it takes and awards no jobs: they might be done twice, or two arms sent to one
            station. What arms have in hand goes on.
    """

    def __init__(
        self,
        link: BusClient,
        name: str,
        journal: Journal[AuctionRecord],
        *,
        allocate: Allocate,
        speed: float,
        places: frozenset[str] | None = None,
        timing: Timing | None = None,
    ) -> None:
        """Take up the auction where the journal, which is open, leaves it.

        Args:
            link: Open line to the bus.
            speed: Fleet seconds per real second.
            places: Names of the cell's places; None: jobs may name any.

        Raises:
            BusError: the fleet has an auctioneer already.
            JournalError: the journal is damaged, or has no room.
        """
        self._link, self._name, self.journal = link, name, journal
        self._timing = timing or Timing()
        self._refuse_a_second()
        ledger = Ledger(places).replay(journal.records())
        real_s = time.monotonic()
        # It may have told the time until just before its next record of it, and never tells an earlier one.
        zero_s = ledger.time_s + TICK_S * speed if ledger.time_s else 0.0
        self._clock = FleetClock(speed, real_s, zero_s)
        journal.compact(*ledger.compact())
        journal.append(Started(name, zero_s))
        self.auctioneer = Auctioneer(
            name,
            ledger,
            allocate=allocate,
            keep=journal.append,
            life=secrets.token_hex(4),
            real_s=real_s,
            timing=self._timing,
        )
        self.rivals: set[str] = set()
        self._roll_s = self._alone_s = -math.inf
        self._tokens: set[str] = set()
        self._heard_s: dict[str, float] = {}
        self._ticked_s = real_s
        self._declare()

    @property
    def time_s(self) -> float:
        """The fleet's time."""
        return self._clock.now_s(time.monotonic())

    @property
    def present(self) -> frozenset[str]:
        """Arms that are there."""
        real_s = time.monotonic()
        return frozenset(arm for arm in self._tokens if real_s - self._heard_s.get(arm, -math.inf) < FRESH_S)

    def serve(self, until_s: float) -> None:
        """Handle what comes and do what is due, until `time.monotonic()` is `until_s` or a little earlier.

        Raises:
            JournalError: the journal cannot be relied on any more.
        """
        self._link.serve(min(until_s, time.monotonic() + SCAN_S))
        real_s, time_s = self._now()
        if real_s >= self._roll_s:
            self._call_roll(real_s)
        sure = not self.rivals and real_s - self._alone_s < ALONE_S
        self.auctioneer.set_present(self.present if sure else frozenset())
        self.auctioneer.tick(real_s, time_s)
        if real_s >= self._ticked_s + TICK_S:
            self._ticked_s = real_s
            self._note_time(time_s)
        self._send()

    def submit(self, word: Submission) -> SubmissionReply:
        """Take jobs.

        Raises:
            JournalFull: nothing is taken.
            Objection: nothing is taken, as there is another auctioneer.
        """
        answer = self._submitted(word, *self._now())
        self._send()
        return answer

    def end(self) -> None:
        """The shift is over.

        Raises:
            JournalFull: nobody was told.
        """
        self.auctioneer.end(self.time_s)
        self._send()

    # Inside

    def _now(self) -> tuple[float, float]:
        real_s = time.monotonic()
        return real_s, self._clock.now_s(real_s)

    def _refuse_a_second(self) -> None:
        """Two that take the same jobs would have them done twice.

        One that hangs still shows its token, and one that is about to show it answers already.
        """
        fleet = self._link.fleet
        there = self._link.tokens(keys.of_every_auction(fleet, "alive"), timeout_s=2.0)
        if self._name in there:
            raise BusError(
                f"Fleet '{fleet}' has an auctioneer '{self._name}' already: its token is there. Stop that one first; "
                f"if it has just died, its token goes within {SESSION_LEASE_S:g} s."
            )
        if there:
            raise BusError(f"Fleet '{fleet}' has an auctioneer already: '{', '.join(sorted(there))}'. A fleet has one.")
        nobody = StatusRequest(("?",))
        answers = self._link.query_and_wait(keys.of_jobs(fleet, "status"), nobody, Status, timeout_s=2.0)
        for status in answers.messages.values():
            name = status.auctioneer
            if name in self._link.tokens(keys.of_every_arm(fleet, "alive"), timeout_s=2.0):
                raise BusError(
                    f"The arms of fleet '{fleet}' share the jobs out themselves; '{name}' answers for them. "
                    "Stop them first."
                )
            raise BusError(f"Fleet '{fleet}' has an auctioneer already: '{name}'. A fleet has one.")
        if answers.refused:
            raise BusError(f"Fleet '{fleet}' has an auctioneer already, which does not answer. Stop it first.")

    def _declare(self) -> None:
        link, fleet, name = self._link, self._link.fleet, self._name
        self._announce = link.publisher(keys.of_auction(fleet, name, "announce"), Announcement)
        self._result = link.publisher(keys.of_auction(fleet, name, "result"), Result)
        auctioneer = self.auctioneer
        link.reply_to(keys.of_jobs(fleet, "submit"), Submission, self._checked(self._submitted))
        link.reply_to(keys.of_jobs(fleet, "status"), StatusRequest, self._status)
        link.reply_to(
            keys.asked_by_every_arm(fleet, name, "lease"), LeaseRequest, self._checked(auctioneer.renew_leases)
        )
        link.reply_to(keys.asked_by_every_arm(fleet, name, "report"), Report, self._checked(auctioneer.apply_report))
        link.reply_to(keys.of_clock(fleet), ClockRequest, lambda _: Clock(self.time_s, self._clock.speed))
        link.subscribe(keys.of_every_arm(fleet, "state"), State, self._state)
        link.watch_tokens(keys.of_every_arm(fleet, "alive"), self._token)
        link.watch_tokens(keys.of_every_auction(fleet, "alive"), self._rival)
        link.declare_token(keys.of_auction(fleet, name, "alive"))

    def _checked(self, handle: Callable[[Word, float, float], msgspec.Struct]) -> Callable[[Word], msgspec.Struct]:
        """The handler with the time, whose objections go back to the one who asked."""

        def answer(word: Word) -> msgspec.Struct:
            try:
                return handle(word, *self._now())
            except (Objection, JournalFull) as error:
                _LOG.warning("Refused: %s", error)
                raise Refused(str(error)) from error
            finally:
                self._send()

        return answer

    def _submitted(self, word: Submission, real_s: float, time_s: float) -> SubmissionReply:
        if self.rivals:
            raise Objection(f"{self._two()}: no jobs are taken until one is stopped.")
        return self.auctioneer.submit(word, real_s, time_s)

    def _call_roll(self, real_s: float) -> None:
        """Ask who answers as auctioneer: a token tells nothing of another of the same name, but both of them answer.

        Of two that begin in the same moment at least one sees the other at once, as each can be asked before it asks.
        """
        self._roll_s = real_s + ROLL_S
        key = keys.of_jobs(self._link.fleet, "status")

        def called(answers: Replies[Status]) -> None:
            mine = sum(status.auctioneer == self._name for status in answers.messages.values())
            if mine:  # its own answer may be late
                self._alone_s = real_s
                self._note_rival(self._name, mine > 1)

        self._link.query(key, StatusRequest(("?",)), Status, called, timeout_s=ROLL_S)

    def _rival(self, name: str, there: bool) -> None:
        if name != self._name:  # its own token and that of another of the same name are one
            self._note_rival(name, there)

    def _note_rival(self, name: str, there: bool) -> None:
        if there == (name in self.rivals):
            return
        (self.rivals.add if there else self.rivals.discard)(name)
        if self.rivals:
            _LOG.error("%s: no jobs are taken or awarded until one is stopped.", self._two())
        else:
            _LOG.warning("The other auctioneer '%s' is gone; jobs are taken and awarded again.", name)

    def _two(self) -> str:
        return (
            f"Fleet '{self._link.fleet}' has more than one auctioneer ({', '.join(sorted([self._name, *self.rivals]))})"
        )

    def _status(self, word: StatusRequest) -> Status:
        return Status(self._name, self.time_s, statuses_that_fit(self.auctioneer.status(word.jobs)))

    def _state(self, arm: str, state: State) -> None:
        self._heard_s[arm] = time.monotonic()
        self.auctioneer.states[arm] = state

    def _token(self, arm: str, there: bool) -> None:
        if there:
            self._tokens.add(arm)
        else:
            self._tokens.discard(arm)
            self._heard_s.pop(arm, None)

    def _note_time(self, time_s: float) -> None:
        try:
            self.journal.append(ClockTick(time_s))
        except JournalFull as error:
            _LOG.error("The fleet's time is not noted: %s", error)
        if self.journal.needs_compaction:
            self.journal.compact(*self.auctioneer.ledger.compact())

    # What goes out

    def _send(self) -> None:
        out = self.auctioneer.out
        while out:
            match out.popleft():
                case QuoteRequest() as request:
                    self._ask(request)
                case SendAward(arm, award):
                    key = keys.of_arm(self._link.fleet, arm, "award")
                    self._link.query(key, award, Ack, self._acknowledged, timeout_s=self._timing.ack_s)
                case Announcement() as announce:
                    self._announce(announce)
                case Result() as result:
                    self._result(result)

    def _ask(self, request: QuoteRequest) -> None:
        read: set[str] = set()

        def came(answers: Replies[Quote]) -> None:
            for key in answers.messages.keys() - read:
                read.add(key)
                self.auctioneer.add_quote(answers.messages[key], *self._now())
            self._send()

        def over(answers: Replies[Quote]) -> None:
            came(answers)
            for reason in filter(None, answers.refused.values()):
                _LOG.warning("No quote: %s", reason)
            self.auctioneer.end_quotes(request.auction, *self._now())
            self._send()

        key = keys.of_every_arm(self._link.fleet, "quote")
        self._link.query(key, request, Quote, over, timeout_s=self._timing.window_s, each=came)

    def _acknowledged(self, answers: Replies[Ack]) -> None:
        for ack in answers.messages.values():
            try:
                self.auctioneer.apply_ack(ack, *self._now())
            except JournalFull as error:  # it is sent again, and answered again
                _LOG.error("The answer of '%s' is not noted: %s", ack.arm, error)
        for reason in filter(None, answers.refused.values()):
            _LOG.warning("No answer to an award: %s", reason)
        self._send()
