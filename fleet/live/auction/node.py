"""The auctioneer on the bus: follows which arms are present, runs the auction and publishes fleet time; one thread."""

import logging
import math
import secrets
import time
from collections.abc import Iterable, Mapping, Sequence, Set
from contextlib import suppress
from functools import partial

from fleet.bus.client import BusClient, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    Announcement,
    JobSpec,
    JobStatus,
    Lease,
    LeaseRequest,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
    Result,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.cell import Cell
from fleet.bus.protocol.consensus import History, HistoryRequest
from fleet.bus.protocol.keys import SESSION_LEASE_S
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import Cleared, ClearRequest, Controlled, ControlRequest, Operation
from fleet.errors import BusError, JournalError, JournalFull, Refused, RefusedForNow
from fleet.live.auction.auctioneer import Auctioneer
from fleet.live.auction.rounds import MOST_UNANSWERED, SCAN_S, Allocate
from fleet.live.book import JobBook
from fleet.live.clock import FleetClock
from fleet.live.desk import JobDesk
from fleet.live.epochs import REMEDY, REPLY_S, ask_arms, check_begin, describe, kept_time_s
from fleet.live.job_rules import NONE_RESERVED
from fleet.live.journal import EpochBegun, Journal, Started, TimeRecorder, own_records
from fleet.live.leases import Timing
from fleet.live.monitor.snapshot import FRESH_S
from fleet.live.rate_limit import RateLimitedWarnings
from fleet.live.records import MAX_REASON, BookRecord, JobEntry, SendAward
from fleet.live.space import Excludes, no_conflicts

_LOG = logging.getLogger(__name__)


class EpochCheck:
    """Which arms have sent their history, and whether it is one of this auctioneer's journal."""

    def __init__(self, link: BusClient, auctioneer: Auctioneer, hold_s: float) -> None:
        """Start; no arm is admitted yet.

        Args:
            hold_s: Real seconds, from the first present arm, for which no job is awarded unless all arms have sent
                their history.
        """
        self._link, self._auctioneer = link, auctioneer
        self._asked_s: dict[str, float] = {}
        """Real second of the last request to each arm that has not sent its history."""
        self._admitted: set[str] = set()
        self._replied: set[str] = set()
        """Arms that have been admitted since the start."""
        self._hold_s, self._hold_until_s = hold_s, math.inf if hold_s else -math.inf
        self._foreign: dict[str, str] = {}
        """Why the history of an arm does not fit, by arm."""
        self.unreadable: dict[str, str] = {}
        """Why an arm that replies without a valid history gets no jobs, by arm."""

    @property
    def objection(self) -> str:
        """Why no jobs are accepted or awarded; "" if they are."""
        return next(iter(self._foreign.values()), "")

    def admitted(self, arms: Iterable[str]) -> frozenset[str]:
        """Return those of these arms that get jobs: their history fits, and no other one may know more of the jobs.

        Request missing histories.
        """
        arms = frozenset(arms)
        if arms:
            self._hold_until_s = min(self._hold_until_s, time.monotonic() + self._hold_s)
        for arm in sorted(arms - self._admitted):
            self._ask(arm)
        return frozenset() if self.objection or self.awaited(arms) else arms & self._admitted

    def awaited(self, arms: Iterable[str]) -> Set[str]:
        """Return the arms, of these and of the cell, without whose history no job is awarded."""
        all_arms = {*arms, *self._auctioneer.book.arms} if time.monotonic() < self._hold_until_s else set[str]()
        return all_arms - self._replied

    def forget(self, arm: str) -> None:
        """Forget an arm that has left: it may come back with another history."""
        self._admitted.discard(arm)
        self._foreign.pop(arm, None)
        self.unreadable.pop(arm, None)
        self._asked_s.pop(arm, None)

    def _ask(self, arm: str) -> None:
        real_s = time.monotonic()
        if real_s < self._asked_s.get(arm, -REPLY_S) + REPLY_S:
            return
        self._asked_s[arm] = real_s

        def done(replies: Replies[History]) -> None:
            if "" in replies.refused.values() or replies.temporary:  # it did not reply in time, or not yet
                return
            for reason in replies.refused.values():
                if arm not in self.unreadable:
                    self.unreadable[arm] = f"gives no valid history ({reason.rstrip('.')})"
                    _LOG.error("'%s' %s: it gets no jobs.", arm, self.unreadable[arm])
                return
            for history in replies.messages.values():
                if not self._accept(history):
                    return
            self._foreign.pop(arm, None)
            self.unreadable.pop(arm, None)
            self._admitted.add(arm)  # an arm of another maker may have no history
            self._replied.add(arm)

        self._link.query(
            keys.of_arm(self._link.fleet, arm, "history"), HistoryRequest(), History, done, timeout_s=REPLY_S
        )

    def _accept(self, history: History) -> bool:
        """Adopt what an arm knows; return whether it fits and is on disk."""
        book = self._auctioneer.book
        if history.epoch not in ("", book.epoch) and not book.succeeds:
            if history.arm not in self._foreign:
                remedy = REMEDY.format("put this one aside and ")
                self._foreign[history.arm] = (
                    f"No jobs are accepted or awarded: the journal has the epoch '{book.epoch}', but "
                    f"{describe(history)}. {remedy} Or stop '{history.arm}', if it alone is wrong."
                )
                _LOG.error("%s", self._foreign[history.arm])
            return False
        try:
            self._auctioneer.adopt(history, time.monotonic())
        except JournalError as error:
            _LOG.error("The history of '%s' is not recorded: %s", history.arm, error)
            return False
        return True


HOLD_S = 20.0
"""Real seconds for which an auctioneer that continues from a journal waits for the histories of all arms."""
OTHERS_S = 2.0
"""Real seconds that another auctioneer has to reply at the start."""
CHECK_S = 1.0
"""Real seconds between two checks for other auctioneers."""
ALONE_S = 3.0
"""Real seconds after a check during which its result counts."""


class AuctionNode(JobDesk):
    """The one auctioneer of a fleet.

    Attributes:
        auctioneer: Its state machine.
        journal: Its journal.
        rivals: Other auctioneers in the fleet, against the rule; its own name stands for another one of that name.
            With any, it accepts and awards no jobs: a job might be done twice, or two arms sent to one station.
            Current jobs continue.
    """

    def __init__(
        self,
        link: BusClient,
        name: str,
        journal: Journal[BookRecord],
        *,
        allocate: Allocate,
        speed: float,
        places: frozenset[str] | None = None,
        timing: Timing | None = None,
        arms: tuple[str, ...] = (),
        excludes: Excludes = no_conflicts,
        new_epoch: bool = False,
        cell: Cell | None = None,
        reserved: Mapping[str, JobSpec] = NONE_RESERVED,
    ) -> None:
        """Continue from a journal.

        Args:
            link: Open client of the bus.
            journal: Open journal.
            speed: Fleet seconds per real second.
            places: Names of the cell's places; None allows any name.
            arms: Arms of the cell; each may be anywhere until it is heard.
            excludes: Which plans of two arms exclude each other.
            cell: Reply to requests for the cell; None refuses them.
            new_epoch: Begin with an empty journal even if arms know an older one.
            reserved: Jobs, by name, whose names only `submit` may use; requests for other jobs of these names are
                refused.

        Raises:
            BusError: the fleet has an auctioneer already, or the journal is empty and arms know an older one.
            JournalError: the journal is damaged, of another auctioneer, or has no space.
        """
        super().__init__(name, speed, cell)
        self._link, self.journal, self._reserved = link, journal, reserved
        self._timing = timing or Timing()
        self._check_no_auctioneer()
        book = self.book = JobBook(places, arms).replay(own_records(journal, name))
        histories = ask_arms(link)
        continues = bool(book.epoch or new_epoch)
        if not continues:
            check_begin(link.fleet, histories)
        real_s = time.monotonic()
        self._recorder = TimeRecorder(journal, book, real_s)
        start_s = max(self._recorder.start_s(speed), kept_time_s(histories, book.epoch))
        self._clock = FleetClock(speed, real_s, start_s)
        epoch = () if book.epoch else (EpochBegun(secrets.token_hex(4), start_s, succeeds=new_epoch),)
        begun = (Started(name, start_s), *epoch)
        journal.append(*begun)
        book.replay(begun)
        self.auctioneer = Auctioneer(
            name,
            book,
            allocate=allocate,
            keep=journal.append,
            boot=secrets.token_hex(4),
            real_s=real_s,
            timing=self._timing,
            excludes=excludes,
        )
        self._epochs = EpochCheck(link, self.auctioneer, HOLD_S if continues else 0.0)
        self.rivals: set[str] = set()
        self._check_s = self._alone_s = -math.inf
        self._tokens: set[str] = set()
        self._state_s: dict[str, float] = {}
        """Real second of the last state of each arm."""
        self._warnings: dict[str, RateLimitedWarnings] = {}
        """By arm with a token."""
        self._invalid: dict[str, str] = {}
        """What is wrong with the last quote of an arm; without those whose last quote is valid."""
        self._late: dict[str, int] = {}
        """Number of rounds in a row in which an arm has not quoted in time, by arm with a token."""
        self._declare()

    @property
    def time_s(self) -> float:
        """Fleet time."""
        return self._clock.now_s(time.monotonic())

    @property
    def present(self) -> frozenset[str]:
        """Arms with a token and a recent state."""
        real_s = time.monotonic()
        return frozenset(arm for arm in self._tokens if real_s - self._state_s.get(arm, -math.inf) < FRESH_S)

    @property
    def epoch(self) -> str:
        """Name of the journal."""
        return self.book.epoch

    def serve(self, until_s: float) -> None:
        """Handle messages and do what is due, until `time.monotonic()` is `until_s` or slightly earlier.

        Raises:
            JournalError: the journal cannot be relied on any more.
        """
        self._link.serve(min(until_s, time.monotonic() + SCAN_S))
        real_s, time_s = self._now()
        if real_s >= self._check_s:
            self._check_rivals(real_s)
        alone = not self.rivals and real_s - self._alone_s < ALONE_S
        admitted = self._epochs.admitted(self.present if alone else ())
        self.auctioneer.set_present(admitted, self._obstacle(admitted, alone))
        self.auctioneer.tick(real_s, time_s)
        self._recorder.step(real_s, time_s)
        self._send()

    def submit(self, submission: Submission) -> SubmissionReply:
        """Accept jobs, also under reserved names.

        Raises:
            Refused: no job is accepted: the journal has no space, or there is another auctioneer.
        """
        reply = self._accept_jobs(submission, NONE_RESERVED)
        self._send()
        return reply

    def end(self) -> None:
        """End the shift.

        Raises:
            JournalFull: the shift goes on.
        """
        self.auctioneer.end(self.time_s)
        self._send()

    # Inside

    def _now(self) -> tuple[float, float]:
        real_s = time.monotonic()
        return real_s, self._clock.now_s(real_s)

    def _declare(self) -> None:
        link, fleet, name = self._link, self._link.fleet, self._name
        self._announce = link.publisher(keys.of_auction(fleet, name, "announce"), Announcement)
        self._result = link.publisher(keys.of_auction(fleet, name, "result"), Result)
        self._operation = link.publisher(keys.of_auction(fleet, name, "operation"), Operation)
        self._declare_desk(link)
        link.reply_to(keys.asked_by_every_arm(fleet, name, "lease"), LeaseRequest, self._logged(self._renew_leases))
        link.reply_to(keys.asked_by_every_arm(fleet, name, "report"), Report, self._apply_report)
        link.subscribe(keys.of_every_arm(fleet, "state"), State, self._apply_state)
        link.watch_tokens(keys.of_every_arm(fleet, "alive"), self._apply_token)
        link.watch_tokens(keys.of_every_auction(fleet, "alive"), self._apply_rival_token)
        link.declare_token(keys.of_auction(fleet, name, "alive"))

    def _renew_leases(self, request: LeaseRequest) -> Lease:
        for entry in request.entries:
            spec = None if (job := self.book.jobs.get(entry.job)) is None else job.spec
            if spec is not None and entry.cycles > spec.repetitions:
                counts = f"{entry.cycles} cycles of '{entry.job}', which has {spec.repetitions}"
                self._warn(request.arm, "cycles", f"reports {counts}: only {spec.repetitions - 1} count.")
        return self.auctioneer.renew_leases(request, *self._now())

    def _apply_report(self, report: Report) -> Receipt:
        try:
            return self.auctioneer.apply_report(report, *self._now())
        except Refused as error:
            self._warn(report.arm, "report", f"reports in vain: {error}")
            raise

    def _check_first(self) -> None:
        """Reply always: an auctioneer finds another one by its replies."""

    def _check_alone(self, vain: str) -> None:
        if self.rivals:
            raise RefusedForNow(f"{self._name_rivals()}: {vain} until one is stopped.")

    def _obstacle(self, admitted: frozenset[str], alone: bool) -> str:
        """Return why no job is awarded; "" if jobs are, or no arm is present."""
        if admitted and not self._recorder.failure:
            return ""
        if trouble := self._trouble():
            return trouble
        if not alone:
            return "It is being checked whether the fleet has another auctioneer."
        waits = ", ".join(sorted(self._epochs.awaited(self.present) or self.present)) if self.present else ""
        return f"It is not known yet which jobs have been done by {waits}." if waits else ""

    def _trouble(self) -> str:
        if self.rivals:
            return f"{self._name_rivals()}: no jobs are accepted or awarded until one is stopped."
        if self._recorder.failure:
            return f"No jobs are accepted or awarded: {self._recorder.failure}"
        return self._epochs.objection

    def _left_out(self) -> Mapping[str, str]:
        late = {
            arm: f"has not quoted within {self._timing.window_s:g} s in the last {count} rounds"
            for arm, count in self._late.items()
            if count >= MOST_UNANSWERED
        }
        return {**late, **self._invalid, **self.auctioneer.rounds.back_offs.unanswering, **self._epochs.unreadable}

    def _submit(self, submission: Submission) -> SubmissionReply:
        return self._accept_jobs(submission, self._reserved)

    def _accept_jobs(self, submission: Submission, reserved: Mapping[str, JobSpec]) -> SubmissionReply:
        self._check_alone("no jobs are accepted")
        if self._epochs.objection:
            raise RefusedForNow(self._epochs.objection)
        return self.auctioneer.submit(submission, self.time_s, reserved)

    def _clear(self, request: ClearRequest) -> Cleared:
        self._check_alone("no space is cleared")
        return self.auctioneer.clear(request, self.present, self.time_s)

    def _control(self, request: ControlRequest) -> Controlled:
        self._check_alone("nothing is changed")
        return self.auctioneer.control(request, self.time_s)

    def _entries(self) -> list[JobEntry]:
        return self.book.entries()

    def _status_of(self, entries: Sequence[JobEntry]) -> Sequence[JobStatus]:
        return self.auctioneer.status_of(entries)

    def _apply_state(self, arm: str, state: State) -> None:
        # An arm outside the cell may be anywhere: without a token it would stop all others, and nobody could ask it.
        if arm in self._tokens or arm in self.book.arms:
            self._state_s[arm] = time.monotonic()
            self.auctioneer.apply_state(arm, state)

    def _apply_token(self, arm: str, present: bool) -> None:
        (self._tokens.add if present else self._tokens.discard)(arm)
        if not present:
            self._state_s.pop(arm, None)
            self._warnings.pop(arm, None)
            self._late.pop(arm, None)
            self._invalid.pop(arm, None)
            self._epochs.forget(arm)
            self.auctioneer.rounds.back_offs.forget(arm)

    # Other auctioneers

    def _check_no_auctioneer(self) -> None:
        """Check that no other participant allocates jobs: two would have them done twice.

        One that is stopped still shows its token, and one that is about to show it replies already.
        """
        fleet = self._link.fleet
        tokens = self._link.tokens(keys.of_every_auction(fleet, "alive"))
        if self._name in tokens:
            raise BusError(
                f"Fleet '{fleet}' has an auctioneer '{self._name}' already: its token is present. Stop that one first; "
                f"if it has just exited, its token disappears within {SESSION_LEASE_S:g} s."
            )
        if tokens:
            raise BusError(
                f"Fleet '{fleet}' has an auctioneer already: '{', '.join(sorted(tokens))}'. A fleet has one."
            )
        no_job = StatusRequest(("?",))
        replies = self._link.query_and_wait(keys.of_jobs(fleet, "status"), no_job, Status, timeout_s=OTHERS_S)
        for status in replies.messages.values():
            if status.auctioneer in self._link.tokens(keys.of_every_arm(fleet, "alive")):
                raise BusError(
                    f"The arms of fleet '{fleet}' allocate the jobs themselves; '{status.auctioneer}' replies for "
                    "them. Stop them first."
                )
            raise BusError(f"Fleet '{fleet}' has an auctioneer already: '{status.auctioneer}'. A fleet has one.")
        if replies.refused:
            raise BusError(f"Fleet '{fleet}' has an auctioneer already, which does not reply. Stop it first.")

    def _check_rivals(self, real_s: float) -> None:
        """Query all auctioneers: another one of the same name shares the token, but both reply.

        Of two that start at the same moment at least one detects the other at once, as each replies before it queries.
        """
        self._check_s = real_s + CHECK_S

        def done(replies: Replies[Status]) -> None:
            own = sum(status.auctioneer == self._name for status in replies.messages.values())
            if own:  # its own reply may be late
                self._alone_s = real_s
                self._set_rival(self._name, own > 1)

        self._link.query(
            keys.of_jobs(self._link.fleet, "status"), StatusRequest(("?",)), Status, done, timeout_s=CHECK_S
        )

    def _apply_rival_token(self, name: str, present: bool) -> None:
        if name != self._name:  # its own token also stands for another one of the same name
            self._set_rival(name, present)

    def _set_rival(self, name: str, present: bool) -> None:
        if present == (name in self.rivals):
            return
        (self.rivals.add if present else self.rivals.discard)(name)
        if self.rivals:
            _LOG.error("%s: no jobs are accepted or awarded until one is stopped.", self._name_rivals())
        else:
            _LOG.warning("The other auctioneer '%s' has stopped; jobs are accepted and awarded again.", name)

    def _name_rivals(self) -> str:
        names = ", ".join(sorted([self._name, *self.rivals]))
        return f"Fleet '{self._link.fleet}' has more than one auctioneer ({names})"

    # Messages to send

    def _send(self) -> None:
        fleet, out = self._link.fleet, self.auctioneer.out
        while out:
            match out.popleft():
                case QuoteRequest() as request:
                    current = self.auctioneer.rounds.open
                    asked = frozenset[str]() if current is None else current.asked
                    key, done = keys.of_every_arm(fleet, "quote"), partial(self._end_quotes, request.auction, asked)
                    window_s, add = self._timing.window_s, partial(self._add_quote, request)
                    self._link.query(key, request, Quote, done, timeout_s=window_s, each=add)
                case SendAward(arm, award):
                    key = keys.of_arm(fleet, arm, "award")
                    self._link.query(key, award, Ack, self._apply_acks, timeout_s=self._timing.ack_s)
                case Announcement() as announcement:
                    self._announce(announcement)
                case Result() as result:
                    self._result(result)
                case Operation() as operation:
                    self._operation(operation)

    def _end_quotes(self, auction: str, asked: frozenset[str], replies: Replies[Quote]) -> None:
        replied = {quote.arm for quote in replies.messages.values()} | {_arm_of(key) for key in replies.refused}
        self._late = {arm: count for arm, count in self._late.items() if arm not in replied}
        for arm in sorted((asked & self.present) - replied):
            self._late[arm] = self._late.get(arm, 0) + 1
            self._warn(arm, "late", f"has not quoted within {self._timing.window_s:g} s: it is awarded no job.")
        for key, reason in replies.refused.items():
            if reason and (arm := _arm_of(key)):
                why = f"gave no valid quote: {reason.rstrip('.')}"
                self._note_unusable_quote(auction, arm, "invalid", why)
                if arm in self._tokens:
                    self._invalid[arm] = why[:MAX_REASON]
            elif reason:
                self._warnings.setdefault("", RateLimitedWarnings(""))("quote", f"No quote: {reason}")
        self.auctioneer.end_quotes(auction)

    def _add_quote(self, request: QuoteRequest, quote: Quote) -> None:
        self._invalid.pop(quote.arm, None)
        if quote.auction != request.auction:
            self._note_unusable_quote(request.auction, quote.arm, "round", "quoted for another round")
            return
        missing = {job.name for job in request.jobs} - {each.job for each in quote.estimates}
        if missing:
            self._warn(quote.arm, "jobs", f"did not quote '{min(missing)}', as requested.")
        self.auctioneer.add_quote(quote)

    def _note_unusable_quote(self, auction: str, arm: str, kind: str, why: str) -> None:
        self._warn(arm, kind, f"{why}.")
        self.auctioneer.note_unusable_quote(auction, arm, why)

    def _warn(self, arm: str, kind: str, sentence: str) -> None:
        """Log a warning about an arm with a token; any process may reply in the name of others."""
        if arm in self._tokens:
            self._warnings.setdefault(arm, RateLimitedWarnings(arm))(kind, sentence)

    def _apply_acks(self, replies: Replies[Ack]) -> None:
        for ack in replies.messages.values():
            if not ack.accepted:
                self._warn(ack.arm, "refused", f"refuses award '{ack.award}': {ack.reason.rstrip('.') or 'no reason'}.")
            try:
                self.auctioneer.apply_ack(ack, *self._now())
            except JournalFull as error:  # the award is sent again, and answered again
                _LOG.error("Could not record the answer of '%s': %s", ack.arm, error)
        for reason in filter(None, replies.refused.values()):
            _LOG.warning("No answer to an award: %s", reason)


def _arm_of(key: str) -> str:
    """Return the arm in the key of a reply; "" if the replier is unknown."""
    with suppress(ValueError):
        return keys.parse(key).name
    return ""
