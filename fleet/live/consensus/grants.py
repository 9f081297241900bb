"""Grants of an arm to its peers, and its own claims; state machines without a clock and without I/O.

The rules that make grants safe are at the head of `fleet.live.book`; the quorum is a majority of the roster.

To the arm's `AwardExecutor` its `Claimant` acts as an auctioneer: a job that a majority grants is an award, its lease
counts from the moment of the query to the last arm of a majority, and an outcome that a majority has on disk is
receipted. Every claim lists all jobs that the arm has, requests and reports: a peer that misses a job there that it has
granted knows that the arm has released it. A claim therefore also reports the jobs for which the arm had permission to
commit, by its own grants, and which its journal of awards lacks: until a majority has them as unfinished.
"""

import logging
import math
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, field

from msgspec.structs import replace

from fleet.bus.protocol.auction import MOST_JOBS, Ack, Award, JobSpec, Lease, Receipt
from fleet.bus.protocol.consensus import (
    Claim,
    ClaimEntry,
    ClaimReply,
    DeniedEntry,
    Faults,
    GrantedEntry,
    History,
    JobOutcome,
)
from fleet.bus.protocol.operator import ALL_ARMS, Operation, Pause, Resume
from fleet.errors import JournalError, JournalFull, Refused
from fleet.job import reason_to_give_up
from fleet.live.arm.awards import REVOKED, ActiveAward, AwardExecutor
from fleet.live.book import MAX_SETTLED, JobBook
from fleet.live.epochs import adopted, committed_job
from fleet.live.job_rules import MAX_OPEN_JOBS, fitting
from fleet.live.journal import JobsAccepted, Progress, Released, SpaceTaken
from fleet.live.leases import Timing, clear, expire, renewal
from fleet.live.records import (
    BookRecord,
    ClaimNumbered,
    CountedLease,
    Faulted,
    Granted,
    JobEntry,
    JobSettled,
    Requested,
    cancelled_by,
    outcome_of,
    requested_job,
)
from fleet.live.space import ANYWHERE, Excludes, arms_in_the_way, no_conflicts


class Granter:
    """Grants of one arm to its peers.

    Attributes:
        book: The state on its disk.
    """

    def __init__(
        self,
        arm: str,
        roster: Iterable[str],
        book: JobBook,
        keep: Callable[..., None],
        *,
        real_s: float,
        timing: Timing | None = None,
        excludes: Excludes = no_conflicts,
    ) -> None:
        """Start with the grants of a book.

        Args:
            roster: All arms of the fleet, present or not.
            keep: Writes records; returns when they are on disk, or raises `JournalError` and has written none.
        """
        self.arm, self.roster = arm, frozenset(roster)
        self.book, self.timing, self._excludes = book, timing or Timing(), excludes
        book.name = arm
        for each in sorted(self.roster):
            book.space.setdefault(each, frozenset([ANYWHERE]))
        book.attach(keep, real_s + self.timing.counted_lease_s)

    def answer_claim(self, claim: Claim, real_s: float) -> ClaimReply:
        """Return the reply to a claim; every grant in it is on disk.

        Raises:
            Refused: an arm of another fleet, a claim older than the latest of that arm, or a full journal.
        """
        book = self.book
        if claim.arm not in self.roster:
            raise Refused(f"'{claim.arm}' is no arm of this fleet. Arms: {', '.join(sorted(self.roster))}.")
        last = book.numbers.get(claim.arm, -1)
        if claim.number <= last:
            raise Refused(f"Stale claim {claim.number} from '{claim.arm}' (latest {last}).")
        if claim.number // NUMBERS_PER_BOOT > last // NUMBERS_PER_BOOT:  # by it, that arm notices an older copy
            book.record(ClaimNumbered(claim.arm, claim.number))
        try:
            self.add_jobs(claim.jobs)
        except JournalFull as error:  # the peer sends them again, and needs a lease meanwhile
            _LOG.error("Could not persist jobs of '%s': %s", claim.arm, error)
        for outcome in claim.outcomes:
            self.apply_outcome(outcome)
        kept = {entry.award for entry in claim.entries}
        its = (grant.record for grant in book.grants_of(claim.arm))
        released = [each for each in its if each.award not in kept]
        self._record(claim, *(Released(each.award, each.job, each.arm, time_s=book.time_s) for each in released))
        for operation in claim.operations:
            self.operate(operation)
        expire(book, real_s, book.time_s)
        self._set_space(claim)
        book.numbers[claim.arm] = claim.number
        granted: list[GrantedEntry] = []
        denied: list[DeniedEntry] = []
        for entry in claim.entries:
            if reason := self._objection(claim.arm, entry, real_s) or self._grant(claim, entry, real_s):
                denied.append(self._denied(claim.arm, entry, reason))
            else:
                job = book.jobs[entry.job]
                may_commit = job.grant is not None and job.grant.may_commit
                granted.append(GrantedEntry(entry.award, job.cycles, may_commit, dict(job.faults)))
        return ClaimReply(self.arm, claim.number, self.timing.lease_s, tuple(granted), tuple(denied))

    def clear(self, arm: str, by: str, present: frozenset[str], real_s: float, time_s: float) -> bool:
        """Free the space of an absent arm and revoke its grants, as `clear`.

        Raises:
            Refused: the arm is unknown, or present, or may have a lease.
        """
        if arm not in self.roster:
            raise Refused(f"'{arm}' is no arm of this fleet. Arms: {', '.join(sorted(self.roster))}.")
        expire(self.book, real_s, time_s)
        return clear(self.book, arm, by, present, self.timing.lease_s, time_s)

    def granted_to(self, arm: str) -> set[str]:
        """Return the awards of an arm that this one has granted and that have not ended."""
        return {award for award, grant in self.book.open.items() if grant.record.arm == arm}

    def in_the_way(self, arm: str, space: str | None) -> tuple[str, ...]:
        """Return the arms that take a space which excludes this one of an arm."""
        return arms_in_the_way(arm, space, self.book.taken_space(), self._excludes)

    def known_outcome(self, job: str) -> JobOutcome | None:
        """Return the outcome of a job, also of one that has left, as this arm knows it; None for none."""
        if job in self.book.jobs or job not in self.book.past:
            return self.book.jobs[job].outcome if job in self.book.jobs else None
        outcome = "finished" if self.book.past.is_finished(job) else "given_up"
        return JobOutcome(job, "?", self.arm, outcome, 0, 0.0, f"It was {outcome.replace('_', ' ')} long ago.")

    def apply_outcome(self, outcome: JobOutcome) -> None:
        """Record the outcome of a job that a peer knows.

        Raises:
            JournalError: it is not on disk, and nothing has changed.
        """
        if self.book.is_news(outcome):
            self.book.record(JobSettled(outcome))

    def operate(self, operation: Operation) -> None:
        """Record a request of a person, which a peer has carried out.

        Raises:
            JournalError: it is not on disk, and nothing has changed.
        """
        action = operation.request.action
        ours = not isinstance(action, Pause | Resume) or action.arm == ALL_ARMS or action.arm in self.roster
        if ours and requested_job(operation.request) not in self.book.past and self.book.operations.is_new(operation):
            self.book.record(Requested(operation))

    def add_faults(self, job: str, faults: Faults) -> None:
        """Record faults in a job that a peer knows.

        Raises:
            JournalError: they are not on disk, and nothing has changed.
        """
        entry = self.book.jobs.get(job)
        if faults and not (entry is not None and faults.keys() <= entry.faults.keys()):
            self.book.record(Faulted(job, faults))

    def add_jobs(self, jobs: Iterable[JobSpec], by: str = "") -> None:
        """Add jobs that this arm does not know.

        Raises:
            JournalError: none is on disk.
        """
        book = self.book
        new = tuple(job for job in jobs if not book.is_known(job.name))
        new = new[: max(0, MAX_OPEN_JOBS + MAX_SETTLED - len(book.jobs))]
        if new:
            self.book.record(JobsAccepted(new, by, book.time_s))

    def adopt(self, records: list[BookRecord], real_s: float) -> None:
        """Record what other arms have done and have; what they have counts as leased from now.

        Raises:
            JournalError: nothing is on disk.
        """
        self.book.record(*records)
        self.book.lease_open_grants(real_s + self.timing.counted_lease_s)

    # Inside

    def _set_space(self, claim: Claim) -> None:
        """Record which space an arm takes by its claim, without that of its entries that is not granted yet."""
        before = self.book.space[claim.arm]
        stated = frozenset([ANYWHERE] if claim.space is None else claim.space)
        after = before & {entry.space or ANYWHERE for entry in claim.entries} | stated
        if after != before:
            self._record(claim, SpaceTaken(claim.arm, tuple(sorted(after))))

    def _objection(self, arm: str, entry: ClaimEntry, real_s: float) -> str:
        """Return why a job cannot be granted now, or ""."""
        book, job = self.book, self.book.jobs.get(entry.job, JobEntry(entry.job))
        grant, before = job.grant, job.grants.get(entry.award)
        same = grant is not None and (grant.record.arm, grant.record.award) == (arm, entry.award)
        if book.is_settled(entry.job):
            return f"'{entry.job}' is settled"
        if entry.award in book.operations.redone(entry.job):
            return f"a person has '{entry.job}' done again"
        if before is not None and before.revoked:
            return f"the space of '{arm}' was cleared"
        cancel = book.operations.cancelled(entry.job)
        if cancel is not None and not (grant is not None and same and grant.may_commit):
            if same:  # its arm ends the cycle in progress, which may take longer than a lease
                book.leases[entry.award].until_s = real_s + self.timing.counted_lease_s
            return cancelled_by(cancel)
        space = entry.space or ANYWHERE
        if not (before is not None and space in book.taken_space()[arm]) and (in_way := self.in_the_way(arm, space)):
            return f"'{in_way[0]}' is in the way"
        if grant is not None:
            return "" if same else f"'{grant.record.arm}' has '{entry.job}'"
        for other in book.open.values():
            if not other.silent and set(other.record.places) & set(entry.places):
                return f"'{other.record.arm}' is at the same station with '{other.record.job}'"
        return "the shift is over" if book.ended else ""

    def _denied(self, arm: str, entry: ClaimEntry, reason: str) -> DeniedEntry:
        """Return a denial, with what the arm may not know: the outcome of the job, or another arm that may commit."""
        outcome, job = self.known_outcome(entry.job), self.book.jobs.get(entry.job)
        if outcome is not None or job is None or job.arm == arm:
            return DeniedEntry(entry.award, reason, outcome)
        return DeniedEntry(entry.award, reason, None, committed_job(self.arm, job, self.book.time_s))

    def _grant(self, claim: Claim, entry: ClaimEntry, real_s: float) -> str:
        """Grant a job, or extend its grant; return why it could not be written to disk, or ""."""
        book, job = self.book, self.book.jobs.get(entry.job)
        grant, asks = None if job is None else job.grant, entry.phase == "finishing"
        records: list[BookRecord] = []
        space = entry.space or ANYWHERE
        if job is None or grant is None:
            terms = (entry.award, entry.job, claim.arm, book.time_s, entry.cycles, entry.places, space, asks)
            records.append(Granted(*terms))
        else:
            records += renewal(book, entry.award, book.time_s, entry.cycles, finishing=asks)
            if entry.cycles > job.cycles:
                records.append(Progress(entry.job, entry.cycles))
            if space not in book.taken_space()[claim.arm]:
                records.append(SpaceTaken(claim.arm, tuple(sorted(book.space[claim.arm] | {space}))))
        try:
            self._record(claim, *records)
        except JournalFull as error:
            return str(error)
        book.leases.setdefault(entry.award, CountedLease(0.0)).until_s = real_s + self.timing.counted_lease_s
        return ""

    def _record(self, claim: Claim, *records: BookRecord) -> None:
        """Write what follows from a claim, with its number."""
        if records:
            self.book.record(ClaimNumbered(claim.arm, claim.number), *records)


_LOG = logging.getLogger(__name__)

CLAIM_S = 0.5
"""Real seconds after which a claim is repeated for peers that have not replied."""
PENDING_S = 2.0
"""Real seconds after which an arm withdraws a request that no majority grants."""
LOST = "The journal of its arm was lost after it had permission to commit."
"""Why a job is unfinished of which the arm itself has no record."""
MAX_CORRECTIONS = 32
"""Outcomes and requests of people in one claim."""
MAX_CLAIMS = 64
"""Latest claims whose replies count."""
NUMBERS_PER_BOOT = 1_000_000_000
"""The number of a claim or bid is the boot number times this, plus a count."""


@dataclass(eq=False)
class Vote:
    """Replies of the fleet about one award."""

    granted_s: dict[str, float] = field(default_factory=dict[str, float])
    """Real second of the last query that each arm granted."""
    denied: set[str] = field(default_factory=set[str])
    may_commit: set[str] = field(default_factory=set[str])
    cycles: int = 0

    def since_s(self, majority: int) -> float:
        """Return the real second of the latest query that a majority granted; -inf for none."""
        asked_s = sorted(self.granted_s.values(), reverse=True)
        return asked_s[majority - 1] if len(asked_s) >= majority else -math.inf


@dataclass(frozen=True, eq=False)
class PendingClaim:
    """A job that the arm requests and does not have yet."""

    job: JobSpec
    plan: int
    quote: str
    made_s: float


class Claimant:
    """Claims of one arm, from one start of its process to the next.

    Attributes:
        majority: Number of arms that make one, of the whole roster.
        pending: Requested jobs, by award.
        rejected: Requested jobs that were not granted, oldest first; the driver takes them out.
    """

    def __init__(
        self,
        executor: AwardExecutor,
        granter: Granter,
        answer_award: Callable[[Award, float], Ack],
        space_of: Callable[[JobSpec, int], str | None],
        *,
        boot: int,
        timing: Timing | None = None,
    ) -> None:
        """Start.

        Args:
            answer_award: Accepts or refuses an award for the arm.
            space_of: Name of the space of one of the arm's plans for a job.
            boot: Number of this start of the arm.
        """
        self.arm, self.executor, self.granter = executor.arm, executor, granter
        self.majority = len(granter.roster) // 2 + 1
        self.pending: dict[str, PendingClaim] = {}
        self.rejected: list[str] = []
        self._answer_award, self._space_of, self._timing = answer_award, space_of, timing or Timing()
        self._space: tuple[str, ...] = ()
        self._number = boot * NUMBERS_PER_BOOT
        self._votes: dict[str, Vote] = {}
        self._receipts: dict[str, set[str]] = {}
        """Arms that have the outcome on disk, by award."""
        self._last_entries: dict[str, ClaimEntry] = {}
        """Entries of the last claim, by award: a job is claimed until its report is on disk."""
        self._corrections: dict[str, JobOutcome] = {}
        self._new_jobs: dict[str, JobSpec] = {}
        self._operations: dict[str, Operation] = {}
        self._sent: dict[int, tuple[Claim, float, int]] = {}
        """Claims by number, each with its real second and version."""
        self._answered: dict[str, int] = {}
        """Version of the last claim to which each arm has replied."""
        self._version, self._due, self._claimed_s = 1, True, -math.inf

    def count_after(self, number: int) -> None:
        """Number the next claims as those of the start after the one with this number."""
        self._number = max(self._number, (number // NUMBERS_PER_BOOT + 1) * NUMBERS_PER_BOOT)

    @property
    def capacity(self) -> int:
        """How many more jobs it may request."""
        in_message = MOST_JOBS - len(self.executor.active) - len(self.executor.pending_reports())
        return min(self.executor.spare_capacity, in_message) - len(self.pending)

    def request(self, job: JobSpec, plan: int, real_s: float) -> None:
        """Request a job, to do it by one of the arm's plans."""
        quote = self.executor.add_quote({job.name: (job, plan + 1)}, real_s)
        award = f"{self.arm}-{quote}:{job.name}"
        self.pending[award] = PendingClaim(job, plan, quote, real_s)
        self._votes[award] = Vote()
        self._change()

    def send_outcome(self, outcome: JobOutcome) -> None:
        """Send the outcome of a job with the next claim: a peer seems to miss it."""
        self._corrections[outcome.job] = outcome
        self._due = True

    def send_job(self, job: JobSpec) -> None:
        """Send a job with the next claim: a peer seems to miss it."""
        self._new_jobs[job.name] = job
        self._due = True

    def send_operation(self, operation: Operation) -> None:
        """Send a request of a person with the next claim: a peer seems to miss it."""
        self._operations[operation.request.request] = operation
        self._due = True

    def repeat_for(self, arm: str) -> None:
        """Repeat the claim for an arm that has started again: it may have lost its journals."""
        self._answered.pop(arm, None)

    def revoke(self, is_stopped: Callable[[str], bool]) -> None:
        """Withdraw requests for jobs, and have the arm return those whose last cycle is not permitted."""
        for award, pending in list(self.pending.items()):
            if is_stopped(pending.job.name):
                self._reject(award)
        self.executor.revoke(REVOKED, is_stopped)

    def claim_soon(self) -> None:
        """Claim with the next tick: a lease, a permission to commit or a receipt is due."""
        self._due = True

    def claim(self, present: frozenset[str], space: tuple[str, ...], real_s: float) -> Claim | None:
        """Return the claim to send now, if it has changed, a lease is due, or a present arm has not replied.

        Args:
            space: Names of the spaces that the arm takes; empty at home.
        """
        self._expire(real_s)
        if space != self._space:
            self._space = space
            self._change()
        unanswered = any(self._answered.get(arm, 0) < self._version for arm in present)
        if not self._due and not (unanswered and real_s >= self._claimed_s + CLAIM_S):
            return None
        entries, outcomes = self._entries()
        corrections = list(self._corrections.values())[: min(MAX_CORRECTIONS, MOST_JOBS - len(outcomes))]
        self._number += 1
        operations = tuple(self._operations.values())[:MAX_CORRECTIONS]
        claim = Claim(self.arm, self._number, tuple(entries), (*outcomes, *corrections), (), operations, space)
        new = list(self._new_jobs.items())
        if new:
            claim = replace(claim, jobs=fitting(claim, [job for _, job in new[:MOST_JOBS]]))
        self._claimed_s, self._due = real_s, False
        try:
            own_reply = self.granter.answer_claim(claim, real_s)
        except Refused as error:  # repeated when something is due, or after `CLAIM_S`
            _LOG.warning("Nothing is claimed: %s", error)
            return None
        self._corrections.clear()
        self._new_jobs = dict(new[max(1, len(claim.jobs)) :])  # one that never fits delays no other
        self._due = bool(self._new_jobs)
        self._operations.clear()
        self._sent = {number: sent for number, sent in self._sent.items() if number > claim.number - MAX_CLAIMS}
        self._sent[claim.number] = claim, real_s, self._version
        self.apply_reply(own_reply, real_s)
        return claim

    def apply_reply(self, reply: ClaimReply, real_s: float) -> None:
        """Apply the reply of a peer, or of this arm itself, to a claim."""
        sent = self._sent.get(reply.number)
        if sent is None or reply.arm not in self.granter.roster:
            return
        claim, asked_s, version = sent
        jobs = {entry.award: entry.job for entry in claim.entries}
        self._answered[reply.arm] = max(version, self._answered.get(reply.arm, 0))
        for granted in reply.granted:
            if vote := self._votes.get(granted.award):
                vote.granted_s[reply.arm] = max(asked_s, vote.granted_s.get(reply.arm, -math.inf))
                vote.denied.discard(reply.arm)
                vote.cycles = max(vote.cycles, granted.cycles)
                self._add_faults(jobs[granted.award], granted.faults)
                if granted.may_commit:
                    vote.may_commit.add(reply.arm)
        for denied in reply.denied:
            if denied.outcome is not None:
                self._apply_outcome(denied.outcome)
            if denied.committed is not None and denied.award in self.pending:
                self._adopt_commit(reply.arm, denied.award, denied.committed, real_s)
            vote = self._votes.get(denied.award)
            if vote is not None and asked_s >= vote.granted_s.get(reply.arm, -math.inf):
                vote.granted_s.pop(reply.arm, None)
                vote.denied.add(reply.arm)
        for outcome in claim.outcomes:
            self._receipts.get(outcome.award, set()).add(reply.arm)
        self._count_votes(real_s)

    # Inside

    def _change(self) -> None:
        """Mark a change that every arm has to receive."""
        self._version += 1
        self._due = True

    def _entries(self) -> tuple[list[ClaimEntry], list[JobOutcome]]:
        """Return the jobs that it has and requests, and outcomes; a job is claimed until its report is on disk."""
        awards = {active.award.award: active.award for active in self.executor.active}
        entries: list[ClaimEntry] = []
        for lease in self.executor.lease_entries(self.arm):
            job, space = awards[lease.award].job, self._space_of(awards[lease.award].job, awards[lease.award].plan)
            entries.append(ClaimEntry(lease.award, job.name, job.stations, lease.cycles, lease.phase, space))
            self._votes.setdefault(lease.award, Vote())
        for award, pending in self.pending.items():
            job, space = pending.job, self._space_of(pending.job, pending.plan)
            entries.append(ClaimEntry(award, job.name, job.stations, 0, "requested", space))
        outcomes: list[JobOutcome] = []
        for report, on_disk in self.executor.pending_reports():
            if on_disk:
                faults = self._faults(report.job) | ({report.award: self.arm} if report.faulted else {})
                outcomes.append(outcome_of(report, faults))
                self._receipts.setdefault(report.award, set())
            elif last := self._last_entries.get(report.award):
                phase = "finishing" if last.phase == "finishing" else "working"
                entries.append(replace(last, cycles=report.cycles, phase=phase))
        self._last_entries = {entry.award: entry for entry in entries}
        outcomes += self._lost_jobs({*self._last_entries, *(outcome.award for outcome in outcomes)})
        return entries, outcomes[:MOST_JOBS]

    def _lost_jobs(self, claimed: Container[str]) -> list[JobOutcome]:
        """Return unfinished jobs of this arm that it neither has nor reports, and that no majority is known to have."""
        lost: list[JobOutcome] = []
        for entry in self.granter.book.jobs.values():
            outcome, grant = entry.outcome, entry.grant
            if grant is not None and grant.may_commit and grant.record.arm == self.arm:
                terms = (grant.record.award, self.arm, "unfinished", entry.cycles, self.granter.book.time_s, LOST)
                outcome = JobOutcome(entry.name, *terms)
            if outcome is None or (outcome.outcome, outcome.arm) != ("unfinished", self.arm):
                continue
            if outcome.award not in claimed and len(self._receipts.setdefault(outcome.award, set())) < self.majority:
                lost.append(outcome)
        return lost

    def _count_votes(self, real_s: float) -> None:
        """Act on the replies of a majority."""
        for award, pending in list(self.pending.items()):
            vote = self._votes[award]
            if reason_to_give_up(self._faults(pending.job.name).values()):
                self._reject(award)
            elif len(vote.granted_s) >= self.majority:
                self._accept(award, pending, vote, real_s)
            elif self._is_denied(vote):
                self._reject(award)
        for active in self.executor.active:
            if vote := self._votes.get(active.award.award):
                self._renew(active, vote, real_s)
        for report, _ in self.executor.pending_reports():
            if len(self._receipts.get(report.award, ())) >= self.majority:
                del self._receipts[report.award]
                self.executor.apply_receipt(Receipt(self.arm, report.award))

    def _renew(self, active: ActiveAward, vote: Vote, real_s: float) -> None:
        """Apply the votes on an active award as a lease."""
        award = active.award.award
        lease_s, asked_s = self._timing.lease_s, vote.since_s(self.majority)
        permitted = (award,) if len(vote.may_commit) >= self.majority else ()
        if self._is_denied(vote):
            self.executor.apply_lease(Lease(self.arm, lease_s, (), (award,)), real_s)
        elif asked_s > -math.inf:
            self.executor.apply_lease(Lease(self.arm, lease_s, (award,), (), permitted), asked_s)
        elif permitted:
            self.executor.apply_lease(Lease(self.arm, lease_s, (), (), permitted), real_s)

    def _is_denied(self, vote: Vote) -> bool:
        return len(vote.denied) > len(self.granter.roster) - self.majority

    def _accept(self, award: str, pending: PendingClaim, vote: Vote, real_s: float) -> None:
        cycles = min(vote.cycles, pending.job.repetitions - 1)  # the last cycle is never assumed done
        terms = (pending.quote, pending.job, cycles, self._timing.lease_s, pending.plan)
        granted = Award(award, award, self.arm, *terms)
        ack = self._answer_award(granted, real_s)
        if ack.accepted:
            del self.pending[award]
        else:
            _LOG.info("'%s' is not accepted: %s", pending.job.name, ack.reason)
            self._reject(award)

    def _reject(self, award: str) -> None:
        """Withdraw a request; peers learn of it with the next claim."""
        self.rejected.append(self.pending.pop(award).job.name)
        self._change()

    def _adopt_commit(self, peer: str, award: str, committed: JobOutcome, real_s: float) -> None:
        """Withdraw a request for a job that another arm may finish, as a peer knows, and record the grant of that arm.

        Else this arm would request the job for ever, and nobody could settle it here.
        """
        entry = self.granter.book.jobs.get(committed.job)
        grant = None if entry is None else entry.grant
        if grant is not None and grant.record.award != award:  # a lease that was granted here has to end first
            return
        try:
            self.granter.adopt(adopted(self.granter.book, History(peer, committed=(committed,))), real_s)
        except JournalError as error:
            _LOG.error("Could not persist the grant of '%s' to '%s': %s", committed.job, committed.arm, error)
        self._reject(award)

    def _expire(self, real_s: float) -> None:
        """Withdraw requests that are not granted in time, drop unneeded votes, and mark new reports."""
        for award, pending in list(self.pending.items()):
            if real_s >= pending.made_s + PENDING_S:
                self._reject(award)
        needed = {*self.pending, *(active.award.award for active in self.executor.active)}
        self._votes = {award: vote for award, vote in self._votes.items() if award in needed}
        reports = {report.award for report, on_disk in self.executor.pending_reports() if on_disk}
        if reports - self._receipts.keys():
            self._change()

    def _faults(self, job: str) -> Faults:
        """Return the known faults in a job."""
        entry = self.granter.book.jobs.get(job)
        return {} if entry is None else entry.faults

    def _add_faults(self, job: str, faults: Faults) -> None:
        try:
            self.granter.add_faults(job, faults)
        except JournalError as error:
            _LOG.error("Could not persist faults in '%s': %s", job, error)

    def _apply_outcome(self, outcome: JobOutcome) -> None:
        try:
            self.granter.apply_outcome(outcome)
        except JournalError as error:
            _LOG.error("Could not persist outcome of '%s': %s", outcome.job, error)
