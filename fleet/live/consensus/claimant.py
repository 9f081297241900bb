"""Claims of an arm, and what follows from the answers of a majority.

A state machine without a clock and without I/O. To the arm's `AwardExecutor` it acts as an auctioneer: a job that a
majority grants is an award, its lease counts from the moment at which the majority was asked, and an outcome that a
majority has on disk is receipted. Every claim lists all that the arm holds, requests and reports: a peer that no longer
finds a job there that it has granted knows that the arm has released it.
"""

import logging
import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

from fleet.bus.protocol.auction import MOST_JOBS, Ack, Award, JobSpec, Lease, Receipt, Report
from fleet.bus.protocol.consensus import Claim, ClaimEntry, ClaimReply, JobOutcome
from fleet.errors import JournalError
from fleet.live.arm.award_executor import AwardExecutor
from fleet.live.auction.auctioneer import Objection
from fleet.live.auction.lease_timing import Timing
from fleet.live.consensus.granter import Granter

_LOG = logging.getLogger(__name__)

CLAIM_S = 0.5
"""Real seconds after which a claim is repeated for peers that have not answered."""
PENDING_S = 2.0
"""Real seconds after which an arm gives up a requested job that no majority grants."""
MOST_CORRECTIONS = 32
"""In one claim."""
CLAIMS = 64
"""Latest claims whose answers count."""


@dataclass(eq=False)
class Vote:
    """Answers of the fleet about one award."""

    granted_s: dict[str, float] = field(default_factory=dict)
    """When each arm that granted it was asked, real seconds, the latest time."""
    denied: set[str] = field(default_factory=set)
    may_commit: set[str] = field(default_factory=set)
    cycles: int = 0

    def since_s(self, majority: int) -> float:
        """When the latest majority was asked; -inf for none."""
        asked = sorted(self.granted_s.values(), reverse=True)
        return asked[majority - 1] if len(asked) >= majority else -math.inf


@dataclass(frozen=True, eq=False)
class PendingClaim:
    """A job that the arm requests and does not hold yet."""

    word: JobSpec
    quote: str
    made_s: float


class Claimant:
    """Claims of one arm, from one start of its process to the next.

    Attributes:
        majority: Arms that make one, of the whole roster.
        pending: Requested jobs, by award.
        rejected: Jobs that it requested and did not get, oldest first; the driver takes them out.
    """

    def __init__(
        self,
        executor: AwardExecutor,
        granter: Granter,
        take: Callable[[Award, float], Ack],
        *,
        life: int,
        timing: Timing | None = None,
    ) -> None:
        """Begin.

        Args:
            take: Accepts an award for the arm.
            life: Counts up with every start of the arm.
        """
        self.arm, self.executor, self.granter = executor.arm, executor, granter
        self.majority = len(granter.roster) // 2 + 1
        self.pending: dict[str, PendingClaim] = {}
        self.rejected: list[str] = []
        self._take_up, self._timing = take, timing or Timing()
        self._number = life * 1_000_000_000
        self._votes: dict[str, Vote] = {}
        self._receipts: dict[str, set[str]] = {}
        """Arms that have the outcome on disk, by award."""
        self._last_entries: dict[str, ClaimEntry] = {}
        """What it claimed last, by award: a job whose report is not on disk is claimed on."""
        self._corrections: dict[str, JobOutcome] = {}
        self._news: dict[str, JobSpec] = {}
        self._sent: OrderedDict[int, tuple[Claim, float, int]] = OrderedDict()
        self._answered: dict[str, int] = {}
        """Version of the claim that each arm has answered."""
        self._version, self._due, self._claimed_s = 1, True, -math.inf

    @property
    def room(self) -> int:
        """How many more jobs it may request."""
        word = MOST_JOBS - len(self.executor.active) - len(self.executor.pending_reports())
        return min(self.executor.spare_capacity, word) - len(self.pending)

    def request(self, word: JobSpec, real_s: float) -> None:
        """Request a job."""
        quote = self.executor.add_quote({word.name: (word, True)}, real_s)
        award = f"{self.arm}-{quote}:{word.name}"
        self.pending[award] = PendingClaim(word, quote, real_s)
        self._votes[award] = Vote()
        self._change()

    def send_outcome(self, settled: JobOutcome) -> None:
        """Send the outcome of a job with the next claim: a peer seems to miss it."""
        self._corrections[settled.job] = settled
        self._due = True

    def send_job(self, word: JobSpec) -> None:
        """Send a job with the next claim: a peer seems to miss it."""
        self._news[word.name] = word
        self._due = True

    def claim_soon(self) -> None:
        """Claim with the next tick: a lease, a permission to commit or a receipt is due."""
        self._due = True

    def claim(self, there: frozenset[str], real_s: float) -> Claim | None:
        """The claim to send now, if any: it has news, a lease is due, or a present arm has not answered.

        Args:
            there: Arms that show that they are alive.
        """
        self._expire(real_s)
        untold = any(self._answered.get(arm, 0) < self._version for arm in there)
        if not self._due and not (untold and real_s >= self._claimed_s + CLAIM_S):
            return None
        entries, settled = self._entries()
        corrections = list(self._corrections.values())[: min(MOST_CORRECTIONS, MOST_JOBS - len(settled))]
        self._number += 1
        jobs = tuple(self._news.values())[:MOST_CORRECTIONS]
        claim = Claim(self.arm, self._number, tuple(entries), (*settled, *corrections), jobs)
        self._claimed_s = real_s
        try:
            own = self.granter.answer_claim(claim, real_s)
        except Objection as objection:
            self._due = False  # tried again when something is due, or after CLAIM_S
            _LOG.warning("Nothing is claimed: %s", objection)
            return None
        self._due = False
        self._corrections.clear()
        self._news.clear()
        self._sent[claim.number] = claim, real_s, self._version
        if len(self._sent) > CLAIMS:
            self._sent.popitem(last=False)
        self.apply_reply(own, real_s)
        return claim

    def apply_reply(self, reply: ClaimReply, real_s: float) -> None:
        """Take the answer of a peer, or of this arm itself, to a claim."""
        sent = self._sent.get(reply.number)
        if sent is None or reply.arm not in self.granter.roster:
            return
        claim, asked_s, version = sent
        self._answered[reply.arm] = max(version, self._answered.get(reply.arm, 0))
        for granted in reply.granted:
            if vote := self._votes.get(granted.award):
                vote.granted_s[reply.arm] = max(asked_s, vote.granted_s.get(reply.arm, -math.inf))
                vote.denied.discard(reply.arm)
                vote.cycles = max(vote.cycles, granted.cycles)
                if granted.may_commit:
                    vote.may_commit.add(reply.arm)
        for denied in reply.denied:
            if denied.outcome is not None:
                self._apply_outcome(denied.outcome)
            vote = self._votes.get(denied.award)
            if vote is not None and asked_s >= vote.granted_s.get(reply.arm, -math.inf):
                vote.granted_s.pop(reply.arm, None)
                vote.denied.add(reply.arm)
        for settled in claim.outcomes:
            self._receipts.get(settled.award, set()).add(reply.arm)
        self._count_votes(real_s)

    # Inside

    def _change(self) -> None:
        """Mark news that every arm has to receive."""
        self._version += 1
        self._due = True

    def _entries(self) -> tuple[list[ClaimEntry], list[JobOutcome]]:
        """What it holds and requests, and the outcomes to report; without its report on disk a job is still held."""
        places = {held.award.award: held.award.job.places for held in self.executor.active}
        holds = self.executor.lease_entries(self.arm)
        entries = [ClaimEntry(hold.award, hold.job, places[hold.award], hold.cycles, hold.phase) for hold in holds]
        for award, pending in self.pending.items():
            entries.append(ClaimEntry(award, pending.word.name, pending.word.places, 0, "requested"))
        settled: list[JobOutcome] = []
        for report, written in self.executor.pending_reports():
            if written:
                settled.append(_settled(report))
            elif last := self._last_entries.get(report.award):
                phase = "finishing" if last.phase == "finishing" else "working"
                entries.append(ClaimEntry(report.award, report.job, last.places, report.cycles, phase))
        self._last_entries = {entry.award: entry for entry in entries}
        for hold in holds:
            self._votes.setdefault(hold.award, Vote())
        for each in settled:
            self._receipts.setdefault(each.award, set())
        return entries, settled

    def _count_votes(self, real_s: float) -> None:
        """Act on what a majority has answered."""
        for award, pending in list(self.pending.items()):
            vote = self._votes[award]
            if len(vote.granted_s) >= self.majority:
                self._accept(award, pending, vote, real_s)
            elif self._is_denied(vote):
                self._reject(award)
        for held in self.executor.active:
            if vote := self._votes.get(held.award.award):
                self._renew(held.award.award, vote, held.may_commit, real_s)
        for report, _ in self.executor.pending_reports():
            if len(self._receipts.get(report.award, ())) >= self.majority:
                del self._receipts[report.award]
                self.executor.apply_receipt(Receipt(self.arm, report.award))

    def _renew(self, award: str, vote: Vote, left: bool, real_s: float) -> None:
        """Pass the lease of a held award on to the executor."""
        lease_s, asked_s = self._timing.lease_s, vote.since_s(self.majority)
        leave = (award,) if len(vote.may_commit) >= self.majority else ()
        if self._is_denied(vote) and not left and not leave:
            self.executor.apply_lease(Lease(self.arm, lease_s, (), (award,)), real_s)
            self._change()
        elif asked_s > -math.inf:
            self.executor.apply_lease(Lease(self.arm, lease_s, (award,), (), leave), asked_s)
        elif leave:
            self.executor.apply_lease(Lease(self.arm, lease_s, (), (), leave), real_s)

    def _is_denied(self, vote: Vote) -> bool:
        return len(vote.denied) > len(self.granter.roster) - self.majority

    def _accept(self, award: str, pending: PendingClaim, vote: Vote, real_s: float) -> None:
        cycles = min(vote.cycles, pending.word.repetitions - 1)  # at least the last one is left to do
        given = Award(award, award, self.arm, pending.quote, pending.word, cycles, self._timing.lease_s)
        ack = self._take_up(given, real_s)
        if ack.accepted:
            del self.pending[award]
        else:
            _LOG.info("'%s' is not taken: %s", pending.word.name, ack.reason)
            self._reject(award)

    def _reject(self, award: str) -> None:
        """Withdraw a request; peers learn of it with the next claim."""
        self.rejected.append(self.pending.pop(award).word.name)
        self._change()

    def _expire(self, real_s: float) -> None:
        """Withdraw requests that are not granted in time, drop votes of no use, and mark new reports."""
        for award, pending in list(self.pending.items()):
            if real_s >= pending.made_s + PENDING_S:
                self._reject(award)
        needed = {*self.pending, *(held.award.award for held in self.executor.active)}
        for award in self._votes.keys() - needed:
            del self._votes[award]
        reports = {report.award for report, written in self.executor.pending_reports() if written}
        if reports - self._receipts.keys():
            self._change()

    def _apply_outcome(self, settled: JobOutcome) -> None:
        try:
            self.granter.apply_outcome(settled)
        except JournalError as error:
            _LOG.error("Could not persist outcome of '%s': %s", settled.job, error)


def _settled(report: Report) -> JobOutcome:
    """A report as a job outcome for peers."""
    outcome = "finished" if report.outcome == "finished" else "unfinished" if report.unsure else "returned"
    return JobOutcome(report.job, report.award, report.arm, outcome, report.cycles, report.time_s, report.reason)
