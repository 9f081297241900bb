"""Rules of the product, each broken on purpose by a patch of the running process.

A patch replaces methods of the product's classes until the end of its `with` block. The simulation must find each one.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import UnionType
from typing import Any, NamedTuple

from msgspec.structs import replace as changed

from fleet.bus.protocol.operator import Cancel, Change, Operation, Pause, Resume, Settle
from fleet.errors import Refused
from fleet.live import steering as steering_module
from fleet.live.arm.awards import ArmHistory, AwardAccepted, AwardExecutor, Closed
from fleet.live.arm.node import ArmNode
from fleet.live.auction import auctioneer as auctioneer_module
from fleet.live.auction import node as auction_node_module
from fleet.live.auction import rounds as round_module
from fleet.live.auction.auctioneer import Auctioneer
from fleet.live.auction.node import AuctionNode, EpochCheck
from fleet.live.auction.rounds import Rounds
from fleet.live.book import JobBook
from fleet.live.consensus import grants as grants_module
from fleet.live.consensus import node as consensus_node_module
from fleet.live.consensus import participant as participant_module
from fleet.live.consensus.grants import Claimant, Granter
from fleet.live.consensus.node import ConsensusNode
from fleet.live.consensus.participant import Participant
from fleet.live.job_rules import PastJobs, content_hash
from fleet.live.journal import CommitPermitted, JobsAccepted, Journal, Released
from fleet.live.leases import Timing
from fleet.live.records import CountedLease, Granted, JobSettled, Requested
from fleet.live.supervisor import Supervisor
from scenarios.live.recorder import GapFetcher, Recorder

Patch = tuple[Any, str, Callable[[Any], Any]]
"""Where, the name, and what makes the replacement of what was there."""


class Mutation(NamedTuple):
    """A broken rule."""

    rule: str
    patches: tuple[Patch, ...]
    alone: bool | None = None
    """Whether it concerns fleets without an auctioneer; None: all fleets."""


MUTATIONS: dict[str, Mutation] = {}
"""By name."""


def add_mutation(name: str, rule: str, *patches: Patch, alone: bool | None = None) -> None:
    MUTATIONS[name] = Mutation(rule, patches, alone)


@contextmanager
def applied(name: str) -> Iterator[None]:
    """Break one rule until the end of the block; "" breaks none."""
    before: list[tuple[Any, str, Any]] = []
    try:
        for owner, attribute, make in MUTATIONS[name].patches if name else ():
            original = vars(owner)[attribute]
            before.append((owner, attribute, original))
            setattr(owner, attribute, make(original))
        yield
    finally:
        for owner, attribute, original in reversed(before):
            setattr(owner, attribute, original)


def unwritten(kind: type | UnionType) -> Callable[[Any], Any]:
    """Journal whose records of one kind are not written."""

    def make(append: Any) -> Any:
        def patched(self: Any, *records: Any) -> None:
            append(self, *(record for record in records if not isinstance(record, kind)))

        return patched

    return make


def _forgetful(start: Any) -> Any:
    """Start without leases."""

    return lambda self, keep, counted_until_s, *announce: start(self, keep, -math.inf, *announce)


def _duplicate(answer: Any) -> Any:
    """Take a repeated award for a new one, on a new quote."""

    def patched(self: Any, award: Any, now_s: float, unfit: str = "") -> Any:
        if all(active.award.award != award.award for active in self.active):
            self._accepted.pop(award.award, None)
            for quote in self._quotes.values():
                if quote.answers.pop(award.job.name, None) is not None:
                    quote.made_s = now_s
        return answer(self, award, now_s, unfit)

    return patched


def _dropped(due: Any) -> Any:
    """Send each report once."""

    def patched(self: Any, now_s: float) -> Any:
        reports = due(self, now_s)
        for _, report in reports:
            self._reports.pop(report.award)
        return reports

    return patched


def _sure(after: Any) -> Any:
    """Return a job as surely not done after a crash in its last cycle."""

    def patched(self: Any, arm: str, time_s: float) -> Any:
        history = after(self, arm, time_s)
        history.reports = {
            name: (award, changed(report, unsure=False, restarted=False))
            for name, (award, report) in history.reports.items()
        }
        return history

    return patched


def _silent(report: Any) -> Any:
    """Send the receipt without a record."""

    def patched(self: Any, message: Any, real_s: float, time_s: float) -> Any:
        self.book.record = lambda *records: None
        try:
            return report(self, message, real_s, time_s)
        finally:
            del self.book.record

    return patched


def _expires_all(expire: Any) -> Any:
    """Take a job back although its arm was permitted to commit."""

    def patched(book: Any, real_s: float, time_s: float) -> list[CountedLease]:
        for name in [name for name, lease in book.leases.items() if real_s >= lease.until_s]:
            grant = book.open[name].record
            book.record(Released(name, grant.job, grant.arm, "dropped", 0, time_s, "mutation"))
        return []

    return patched


def _ends_free(end: Any) -> Any:
    """Free the space of a closed award at once."""
    return lambda self, grant, outcome, *, moved=True: end(self, grant, outcome, moved=False)


def _nobody_in_the_way(original: Any) -> Any:
    return lambda arm, space, taken, excludes: ()


add_mutation(
    "award-unwritten", "an award is on disk before it is sent", (Journal, "append", unwritten(Granted)), alone=False
)
add_mutation(
    "commit-unwritten",
    "permission to commit is on disk before it is given",
    (Journal, "append", unwritten(CommitPermitted)),
)
add_mutation("accept-unwritten", "an arm accepts an award on disk", (Journal, "append", unwritten(AwardAccepted)))
add_mutation("submission-unwritten", "an accepted job is on disk", (Journal, "append", unwritten(JobsAccepted)))
add_mutation(
    "grant-unwritten", "a grant is on disk before the reply", (Journal, "append", unwritten(Granted)), alone=True
)
add_mutation(
    "end-unwritten",
    "the end of a job is on disk before its report and receipt",
    (Journal, "append", unwritten(Closed | JobSettled)),
)
add_mutation(
    "no-fsync",
    "a record is written through",
    (Journal, "__init__", lambda start: lambda self, *a, **k: start(self, *a, durable=False, **k)),
)
add_mutation(
    "lease-forgotten",
    "after a restart open awards count as leased",
    (JobBook, "attach", _forgetful),
    alone=False,
)
add_mutation("grant-forgotten", "after a restart grants count as leased", (JobBook, "attach", _forgetful), alone=True)
add_mutation(
    "lease-too-short",
    "the granting side counts leases longer",
    (Timing, "counted_lease_s", lambda _: property(lambda self: 0.5 * self.lease_s)),
)
add_mutation(
    "lease-ignored",
    "an arm begins cycles under a lease only",
    (
        AwardExecutor,
        "allowed_cycles",
        lambda _: lambda self, now_s: self._current.award.job.repetitions - (not self._current.may_commit),
    ),
)
add_mutation(
    "commit-ignored",
    "the last cycle needs permission to commit",
    (AwardExecutor, "allowed_cycles", lambda _: lambda self, now_s: self._current.award.job.repetitions),
    (
        AwardExecutor,
        "finish",
        lambda finish: (
            lambda self, time_s, now_s: (setattr(self._current, "may_commit", True), finish(self, time_s, now_s))[1]
        ),
    ),
)
add_mutation(
    "commit-taken-back",
    "after permission to commit a job goes to no other arm",
    *((module, "expire", _expires_all) for module in (auctioneer_module, grants_module, participant_module)),
)
add_mutation(
    "duplicate-accepted",
    "a repeated award gets the same answer",
    (AwardExecutor, "answer_award", _duplicate),
    alone=False,
)
add_mutation(
    "past-forgotten",
    "the name of a settled job is not used again",
    (PastJobs, "__contains__", lambda _: lambda self, name: False),
    alone=False,
)
add_mutation("report-dropped", "a report is repeated until its receipt", (AwardExecutor, "due_reports", _dropped))
add_mutation(
    "receipt-first", "a report is on disk before its receipt", (Auctioneer, "apply_report", _silent), alone=False
)
add_mutation("crash-is-sure", "after a crash in the last cycle nobody repeats it", (ArmHistory, "after_restart", _sure))
add_mutation(
    "stop-is-sure",
    "an arm that is stopped in its last cycle does not return it",
    (AwardExecutor, "stop", lambda _: AwardExecutor.return_all),
)
add_mutation(
    "space-ignored",
    "plans that exclude each other are not awarded at a time",
    *((module, "arms_in_the_way", _nobody_in_the_way) for module in (round_module,)),
    alone=False,
)
add_mutation(
    "space-freed-early",
    "closed awards keep their space until the arm is at home",
    (JobBook, "_end", _ends_free),
    alone=False,
)
add_mutation(
    "space-not-asked",
    "the space of an idle arm is freed without another job",
    (Rounds, "_ask_for_space", lambda _: lambda self, real_s: None),
    alone=False,
)
add_mutation(
    "claim-space-ignored",
    "an arm grants one of two plans that exclude each other",
    (Granter, "in_the_way", lambda _: lambda self, arm, space: ()),
    alone=True,
)
add_mutation(
    "minority",
    "a claim needs a majority",
    (Claimant, "__init__", lambda start: lambda self, *a, **k: (start(self, *a, **k), setattr(self, "majority", 1))[0]),
    alone=True,
)
add_mutation(
    "wait-renewed",
    "an arm waits for the bids of its peers no longer than a window",
    (
        Participant,
        "_bid",
        lambda bid: lambda self, *times: (bid(self, *times), setattr(self, "_waiting_s", math.inf))[0],
    ),
    alone=True,
)
add_mutation(
    "no-restart",
    "the supervisor starts ended processes again",
    (Supervisor, "_handle_exit", lambda _: lambda self, running: False),
)
add_mutation(
    "no-backstop",
    "an unanswered award is sent again, or expires",
    (auctioneer_module, "expire", lambda _: lambda book, real_s, time_s: []),
    alone=False,
)


def _ignores(action: type) -> Callable[[Any], Any]:
    """Record a request of this kind, and change nothing."""

    def make(operate: Any) -> Any:
        def patched(self: Any, operation: Operation) -> Any:
            if isinstance(operation.request.action, action):
                self.operations.names[operation.request.request] = content_hash(operation.request)
                return []
            return operate(self, operation)

        return patched

    return make


def _redone_at_once(objection: Any) -> Any:
    """Redo a job although its arm may still do its last cycle."""

    def patched(*arguments: Any) -> str:
        try:
            return objection(*arguments)
        except Refused as refused:
            if "may still do the last cycle" in str(refused):
                return ""
            raise

    return patched


def _cleared_at_once(clear: Any) -> Any:
    """Free the space of an absent arm that may have a lease."""

    def patched(book: Any, *arguments: Any) -> Any:
        before = {name: grant.silent for name, grant in book.open.items()}
        for grant in book.open.values():
            grant.silent = True
        try:
            return clear(book, *arguments)
        finally:
            for name in before.keys() & book.open.keys():
                book.open[name].silent = before[name]

    return patched


def _gaps_unnoticed(take: Any) -> Any:
    def patched(self: Any, record: Any) -> bool:
        new = take(self, record)
        self.missing.clear()
        return new

    return patched


add_mutation(
    "request-unwritten",
    "a request of a person is on disk before the reply",
    (Journal, "append", unwritten(Requested)),
    alone=False,
)
add_mutation(
    "request-repeated",
    "a request of one name is carried out once",
    (
        JobBook,
        "_operate",
        lambda operate: (
            lambda self, operation: (
                operate(self, operation),
                self.operations.names.pop(operation.request.request, None),
            )[0]
        ),
    ),
    alone=False,
)
for action in (Cancel, Settle, Change, Pause, Resume):
    add_mutation(
        f"{action.__name__.lower()}-ignored",
        f"a request to {action.__name__.lower()} has its effect",
        (JobBook, "_operate", _ignores(action)),
        alone=False,
    )
add_mutation(
    "pause-without-effect",
    "a paused arm gets no job",
    (JobBook, "is_paused", lambda _: lambda self, arm: False),
    alone=False,
)
add_mutation(
    "cancelled-awarded",
    "a cancelled job goes to no other arm",
    (JobBook, "_reason_to_abandon", lambda _: lambda self, entry: None),
    alone=False,
)
add_mutation(
    "redo-at-once",
    "nothing is redone that an arm may still do",
    (steering_module, "objection", _redone_at_once),
    alone=False,
)
add_mutation(
    "clear-at-once",
    "space is freed only after the lease of its arm",
    (auctioneer_module, "clear", _cleared_at_once),
    alone=False,
)
add_mutation(
    "gap-unnoticed",
    "the recorder notices missing numbers",
    (Recorder, "_take", _gaps_unnoticed),
)
add_mutation(
    "gap-not-fetched",
    "the recorder fetches what it missed",
    (GapFetcher, "_begin", lambda _: lambda self, senders: None),
)
add_mutation(
    "repeats-recorded",
    "a message is recorded once",
    (Recorder, "_fill", lambda _: lambda self, series, count, time_s: True),
)


def _nothing(_: Any) -> Any:
    return lambda *_, **__: None


add_mutation(
    "journals-unchecked",
    "an arm takes part with the journals that its peers know",
    (consensus_node_module, "check_journals", _nothing),
    alone=True,
)
add_mutation(
    "empty-journal",
    "an auctioneer without its journal awards nothing to arms that know it",
    (auction_node_module, "check_begin", _nothing),
    (EpochCheck, "_accept", lambda _: lambda self, history: True),
    alone=False,
)
add_mutation(
    "history-ignored",
    "an auctioneer adopts what arms have done and have",
    (auctioneer_module, "adopted", lambda _: lambda book, history: []),
    alone=False,
)
add_mutation(
    "history-not-awaited",
    "after a restart no job is awarded before the arms reply",
    (EpochCheck, "awaited", lambda _: lambda self, arms: frozenset()),
    alone=False,
)
add_mutation(
    "two-auctioneers",
    "a second auctioneer is refused, or both award nothing",
    (AuctionNode, "_check_no_auctioneer", _nothing),
    (AuctionNode, "_set_rival", _nothing),
    alone=False,
)
add_mutation("break-ignored", "an arm takes no job in a break", (ArmNode, "_keep_breaks", _nothing))
add_mutation(
    "no-end",
    "no job is begun after the end of the shift",
    (AuctionNode, "end", _nothing),
    (ConsensusNode, "_end", _nothing),
)
