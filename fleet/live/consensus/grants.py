"""Grants of an arm to its peers.

A state machine without a clock and without I/O. Real time is an argument. Records go to `keep`, which returns once they
are on disk, and are applied only then. The rules that make it safe (`fleet.bus.protocol.consensus` says why):

- A job is granted to one arm at a time; to another arm only after the lease of the first has ended, or the first has
  released the job.
- While a job is granted, no other job at one of its stations is.
- Permission to commit, that is to begin the last cycle, is granted once and stays, unless its arm releases the job.
- A settled job is granted to no arm.
- Of two plans that exclude each other one is granted. Its arm takes the space until a later claim of the arm says that
  it does not take it any more, or a person frees it. An arm without a claim may be anywhere.
- Whoever frees the space of an arm also revokes its grants: the arm gets no lease on them any more, and returns them.
- A person's cancellation ends the leases of a job, except for an arm with permission to commit.
- After a crash every grant counts as leased from the restart.

Claims of an arm, and what follows from the replies of a majority.

A state machine without a clock and without I/O. To the arm's `AwardExecutor` it acts as an auctioneer: a job that a
majority grants is an award, its lease counts from the moment of the query to the last arm of a majority, and an outcome
that a majority has on disk is receipted. Every claim lists all jobs that the arm has, requests and reports: a peer that
misses a job there that it has granted knows that the arm has released it.
"""

import logging
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from msgspec.structs import replace

from fleet.bus.protocol.auction import MOST_JOBS, Ack, Award, JobSpec, JobStatus, Lease, Receipt, Report
from fleet.bus.protocol.consensus import Claim, ClaimEntry, ClaimReply, DeniedEntry, Faults, GrantedEntry, JobOutcome
from fleet.bus.protocol.operator import Operation
from fleet.errors import JournalError, JournalFull, Refused
from fleet.job import reason_to_give_up
from fleet.live.arm.awards import ActiveAward, AwardExecutor
from fleet.live.auction.auctioneer import job_of
from fleet.live.auction.job_rules import MAX_OPEN_JOBS, reason_for_silence
from fleet.live.auction.ledger import MAX_SETTLED
from fleet.live.auction.rounds import Timing
from fleet.live.consensus.jobs import Faulted, GrantRecord, JobGranted, JobSettled, Register, Requested, is_for
from fleet.live.journal import EpochBegun, JobsAccepted, Released, SpaceCleared, SpaceTaken
from fleet.live.space import ANYWHERE, Excludes, arms_in_the_way, no_conflicts


class Granter:
    """Grants of one arm to its peers.

    Attributes:
        register: The state on its disk.
    """

    def __init__(
        self,
        arm: str,
        roster: Iterable[str],
        register: Register,
        keep: Callable[..., None],
        *,
        real_s: float,
        timing: Timing | None = None,
        excludes: Excludes = no_conflicts,
    ) -> None:
        """Start with the grants of a register.

        Args:
            roster: All arms of the fleet, present or not.
            keep: Writes records; returns when they are on disk, or raises `JournalError` and has written none.
        """
        self.arm, self.roster = arm, frozenset(roster)
        self.register = register
        self._keep, self._timing, self._excludes = keep, timing or Timing(), excludes
        for each in self.roster:
            register.space.setdefault(each, frozenset([ANYWHERE]))
        for grant in register.grants.values():
            grant.until_s = real_s + self._timing.counted_lease_s

    def answer_claim(self, claim: Claim, real_s: float) -> ClaimReply:
        """Return the reply to a claim; every grant in it is on disk.

        Raises:
            Refused: an arm of another fleet, a claim older than the latest of that arm, or a full journal.
        """
        register = self.register
        if claim.arm not in self.roster:
            raise Refused(f"'{claim.arm}' is no arm of this fleet. Arms: {', '.join(sorted(self.roster))}.")
        last = register.numbers.get(claim.arm, -1)
        if claim.number <= last:
            raise Refused(f"Stale claim {claim.number} from '{claim.arm}' (latest {last}).")
        self.add_jobs(claim.jobs)
        self._record([JobSettled(outcome) for outcome in claim.outcomes if self._is_new(outcome)])
        self._record(self._released(claim))
        for operation in claim.operations:
            self.operate(operation)
        self.abandon(real_s)
        self._set_space(claim)
        register.numbers[claim.arm] = claim.number
        granted: list[GrantedEntry] = []
        denied: list[DeniedEntry] = []
        for entry in claim.entries:
            reason = self._objection(claim.arm, entry, real_s) or self._grant(claim, entry, real_s)
            if reason:
                denied.append(DeniedEntry(entry.award, reason, register.settled.known(entry.job, self.arm)))
            else:
                may_commit = register.grants[entry.job].may_commit
                cycles, faults = register.cycles.get(entry.job, 0), register.faults.get(entry.job, {})
                granted.append(GrantedEntry(entry.award, cycles, may_commit, faults))
        return ClaimReply(self.arm, claim.number, self._timing.lease_s, tuple(granted), tuple(denied))

    def clear(self, arm: str, by: str, present: frozenset[str], real_s: float, time_s: float) -> None:
        """Free the space of an absent arm and revoke its grants: a person has seen that it is at home, or removed.

        Raises:
            Refused: the arm is unknown, or present, or may have a lease.
            JournalError: it is not on disk, and nothing has changed.
        """
        grants = self.register.grants.values()
        if arm not in self.roster:
            raise Refused(f"'{arm}' is no arm of this fleet. Arms: {', '.join(sorted(self.roster))}.")
        if arm in present:
            raise Refused(f"'{arm}' is present and says itself which space it takes. Stop it first, or move it home.")
        if any(grant.arm == arm and real_s < grant.until_s for grant in grants):
            raise Refused(f"The lease of '{arm}' has not ended; try again in {self._timing.lease_s:g} s.")
        if self.register.space[arm]:
            self._record([SpaceCleared(arm, by, time_s)])

    def in_the_way(self, arm: str, space: str | None) -> tuple[str, ...]:
        """Return the arms that take a space which excludes this one of an arm."""
        return arms_in_the_way(arm, space, self.register.space, self._excludes)

    def apply_outcome(self, outcome: JobOutcome) -> None:
        """Record the outcome of a job that a peer knows.

        Raises:
            JournalError: it is not on disk, and nothing has changed.
        """
        if self._is_new(outcome):
            self._record([JobSettled(outcome)])

    def operate(self, operation: Operation) -> None:
        """Record a request of a person, which was carried out by this arm or a peer.

        Raises:
            JournalError: it is not on disk, and nothing has changed.
        """
        operations = self.register.operations
        known = operation.request.request in operations.names
        past = job_of(operation.request) in self.register.past
        if not past and is_for(operation, self.roster) and not (known and not operations.is_new(operation)):
            self._record([Requested(operation)])

    def settle(self, operation: Operation, award: str, cycles: int) -> JobOutcome:
        """Record that a person calls a job of so many cycles done, and return its outcome.

        Raises:
            JournalError: it is not on disk, and nothing has changed.
        """
        job, by = job_of(operation.request), operation.request.by
        award, arm = award or operation.request.request, self.register.last_arm.get(job, operation.auctioneer)
        reason = f"Settled as done by '{by}'."
        outcome = JobOutcome(job, award, arm, "finished", cycles, operation.time_s, reason)
        self._record([JobSettled(outcome)])
        return outcome

    def give_up(self, lost: Mapping[str, str], time_s: float) -> None:
        """Record jobs as given up for these reasons, so that they can leave.

        Raises:
            JournalError: they are not on disk, and nothing has changed.
        """
        outcomes = (JobOutcome(job, "?", self.arm, "given_up", 0, time_s, reason) for job, reason in lost.items())
        self._record([JobSettled(outcome) for outcome in outcomes])

    def abandon(self, real_s: float) -> None:
        """Record the outcomes of jobs that no arm has, and that are cancelled or in which arms have faulted too often.

        Raises:
            JournalError: they are not on disk, and nothing has changed.
        """
        self._record([*self._given_up(real_s), *self._cancelled(real_s)])

    def add_faults(self, job: str, faults: Faults) -> None:
        """Record faults in a job that a peer knows.

        Raises:
            JournalError: they are not on disk, and nothing has changed.
        """
        if not self.register.knows(job, faults):
            self._record([Faulted(job, faults)])

    def add_jobs(self, jobs: tuple[JobSpec, ...], by: str = "") -> None:
        """Add submitted jobs.

        Raises:
            JournalError: none is on disk.
        """
        register = self.register
        new = tuple(job for job in jobs if job.name not in register.jobs and job.name not in register.past)
        new = new[: max(0, MAX_OPEN_JOBS + MAX_SETTLED - len(register.jobs))]
        self._record([JobsAccepted(new, by)] if new else [])

    def adopt(self, records: list[GrantRecord], real_s: float) -> None:
        """Record what other arms have done and have; what they have counts as leased from now.

        Raises:
            JournalError: nothing is on disk.
        """
        self._record(records)
        for record in records:
            if isinstance(record, JobGranted):
                self.register.grants[record.job].until_s = real_s + self._timing.counted_lease_s

    def begin_epoch(self, epoch: str) -> None:
        """Record the name of the shift.

        Raises:
            JournalError: it is not on disk.
        """
        self._record([EpochBegun(epoch)])

    def is_granted(self, job: str, real_s: float) -> bool:
        """Return whether an arm has a job, or may have it."""
        grant = self.register.grants.get(job)
        return grant is not None and (grant.may_commit or real_s < grant.until_s)

    def busy_stations(self, real_s: float) -> frozenset[str]:
        """Return the stations at which an arm may be at work."""
        leased = (grant for grant in self.register.grants.values() if real_s < grant.until_s)
        return frozenset(place for grant in leased for place in grant.places)

    def out_of_contact(self, real_s: float) -> frozenset[str]:
        """Return the jobs whose arm got permission to commit and has not renewed its lease since."""
        grants = self.register.grants.items()
        return frozenset(job for job, grant in grants if grant.may_commit and real_s >= grant.until_s)

    def status(self, job: str, real_s: float) -> JobStatus:
        """Return the status of a job, as far as this arm knows from its grants and from received outcomes."""
        outcome, grant = self.register.settled.get(job), self.register.grants.get(job)
        cycles, last = self.register.cycles.get(job, 0), self.register.last_arm.get(job, "")
        if outcome is not None and outcome.outcome == "finished":
            return JobStatus(job, "finished", outcome.arm, outcome.award, cycles, outcome.time_s, outcome.reason)
        if outcome is not None and (outcome.outcome == "given_up" or outcome.outcome == "cancelled"):
            return JobStatus(job, outcome.outcome, last, cycles=cycles, reason=outcome.reason)
        if outcome is not None:
            return JobStatus(job, "unfinished", outcome.arm, outcome.award, cycles, None, outcome.reason)
        if grant is None or not self.is_granted(job, real_s):
            return JobStatus(job, "waiting", last, cycles=cycles, reason=self._why_again(job, last))
        if grant.may_commit and real_s >= grant.until_s:
            return JobStatus(job, "unfinished", grant.arm, grant.award, cycles, None, reason_for_silence(grant.arm))
        cancel = self.register.operations.cancelled(job)
        reason = "" if cancel is None else f"{_cancelled_by(cancel)[:-1]}; its arm ends the cycle in progress."
        state = "finishing" if grant.may_commit else "awarded"
        return JobStatus(job, state, grant.arm, grant.award, cycles, None, reason)

    # Inside

    def _why_again(self, job: str, arm: str) -> str:
        """Return the request of a person by which a job waits again; "" if there is none."""
        operations = self.register.operations
        if arm and (pauser := operations.paused.get(arm)) is not None:
            return f"Its arm was paused by '{pauser}'."
        redo = operations.latest.get(("redo", job))
        return "" if redo is None else f"To be redone, by '{redo.request.by}'."

    def _is_new(self, outcome: JobOutcome) -> bool:
        if outcome.outcome == "returned":
            more = outcome.cycles > self.register.cycles.get(outcome.job, 0)
            return more or not self.register.knows(outcome.job, outcome.faults)
        return self.register.is_news(outcome)

    def _given_up(self, real_s: float) -> list[GrantRecord]:
        """Outcomes of jobs that no arm has, and in which arms have faulted too often."""
        register = self.register
        outcomes: list[GrantRecord] = []
        for job, faults in register.faults.items():
            reason = reason_to_give_up(faults.values())
            if reason and job not in register.settled and not self.is_granted(job, real_s):
                award, cycles = max(faults), register.cycles.get(job, 0)
                outcome = JobOutcome(job, award, faults[award], "given_up", cycles, register.time_s, reason)
                outcomes.append(JobSettled(outcome))
        return outcomes

    def _cancelled(self, real_s: float) -> list[GrantRecord]:
        """Outcomes of cancelled jobs that no arm has."""
        register = self.register
        outcomes: list[GrantRecord] = []
        for job, operation in register.operations.all_cancelled.items():
            known = register.settled.get(job)
            if (known is None or known.outcome == "given_up") and not self.is_granted(job, real_s):
                award, arm, cycles = operation.request.request, operation.auctioneer, register.cycles.get(job, 0)
                reason = _cancelled_by(operation)
                outcomes.append(JobSettled(JobOutcome(job, award, arm, "cancelled", cycles, operation.time_s, reason)))
        return outcomes

    def _released(self, claim: Claim) -> list[GrantRecord]:
        kept = {entry.award for entry in claim.entries}
        return [
            Released(grant.award, job, claim.arm, claim.number)
            for job, grant in self.register.grants.items()
            if grant.arm == claim.arm and grant.award not in kept
        ]

    def _set_space(self, claim: Claim) -> None:
        """Record which space an arm takes by its claim, without that of its entries that is not granted yet."""
        before = self.register.space[claim.arm]
        stated = frozenset([ANYWHERE] if claim.space is None else claim.space)
        after = before & {entry.space or ANYWHERE for entry in claim.entries} | stated
        if after != before:
            self._record([SpaceTaken(claim.arm, tuple(sorted(after)), number=claim.number)])

    def _objection(self, arm: str, entry: ClaimEntry, real_s: float) -> str:
        """Return why a job cannot be granted now, or ""."""
        if self.register.is_settled(entry.job):
            return f"'{entry.job}' is settled"
        if entry.award in self.register.operations.redone(entry.job):
            return f"a person has '{entry.job}' done again"
        grant = self.register.grants.get(entry.job)
        same = grant is not None and (grant.arm, grant.award) == (arm, entry.award)
        if grant is not None and same and grant.revoked:
            return f"the space of '{arm}' was cleared"
        cancel = self.register.operations.cancelled(entry.job)
        if cancel is not None and not (grant is not None and same and grant.may_commit):
            if grant is not None and same:  # its arm ends the cycle in progress, which may take longer than a lease
                grant.until_s = real_s + self._timing.counted_lease_s
            return _cancelled_by(cancel)
        has_space = same and (entry.space or ANYWHERE) in self.register.space[arm]
        if not has_space and (in_way := self.in_the_way(arm, entry.space)):
            return f"'{in_way[0]}' is in the way"
        if grant is not None and self.is_granted(entry.job, real_s):
            return "" if same else f"'{grant.arm}' has '{entry.job}'"
        for job, other in self.register.grants.items():
            if job != entry.job and real_s < other.until_s and set(other.places) & set(entry.places):
                return f"'{other.arm}' is at the same station with '{job}'"
        return ""

    def _grant(self, claim: Claim, entry: ClaimEntry, real_s: float) -> str:
        """Grant a job, or extend its grant; return why it could not be written to disk, or ""."""
        done = self.register.cycles.get(entry.job, 0)
        cycles = max(entry.cycles, done)
        grant = self.register.grants.get(entry.job)
        permitted = grant.may_commit if grant is not None and grant.award == entry.award else None
        may_commit = entry.phase == "finishing" or bool(permitted)
        records: list[GrantRecord] = []
        if permitted != may_commit or cycles > done:
            records.append(
                JobGranted(claim.arm, claim.number, entry.award, entry.job, entry.places, cycles, may_commit)
            )
        taken, space = self.register.space[claim.arm], entry.space or ANYWHERE
        if space not in taken:
            records.append(SpaceTaken(claim.arm, tuple(sorted(taken | {space})), number=claim.number))
        try:
            self._record(records)
        except JournalFull as error:
            return str(error)
        self.register.grants[entry.job].until_s = real_s + self._timing.counted_lease_s
        return ""

    def _record(self, records: list[GrantRecord]) -> None:
        """Write records, then apply them."""
        if records:
            self._keep(*records)
        for record in records:
            self.register.apply(record)


def _cancelled_by(operation: Operation) -> str:
    return f"Cancelled by '{operation.request.by}'."


_LOG = logging.getLogger(__name__)

CLAIM_S = 0.5
"""Real seconds after which a claim is repeated for peers that have not replied."""
PENDING_S = 2.0
"""Real seconds after which an arm withdraws a request that no majority grants."""
MAX_CORRECTIONS = 32
"""In one claim."""
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

    def revoke(self, is_stopped: Callable[[str], bool], real_s: float) -> None:
        """Withdraw requests for jobs, and have the arm return those whose last cycle is not permitted."""
        for award, pending in list(self.pending.items()):
            if is_stopped(pending.job.name):
                self._reject(award)
        going_on = (active for active in self.executor.active if not (active.may_commit or active.revoked))
        if awards := tuple(active.award.award for active in going_on if is_stopped(active.job)):
            self.executor.apply_lease(Lease(self.arm, self._timing.lease_s, (), awards), real_s)

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
        jobs = tuple(self._new_jobs.values())[:MAX_CORRECTIONS]
        operations = tuple(self._operations.values())[:MAX_CORRECTIONS]
        claim = Claim(self.arm, self._number, tuple(entries), (*outcomes, *corrections), jobs, operations, space)
        self._claimed_s, self._due = real_s, False
        try:
            own_reply = self.granter.answer_claim(claim, real_s)
        except Refused as error:  # repeated when something is due, or after `CLAIM_S`
            _LOG.warning("Nothing is claimed: %s", error)
            return None
        self._corrections.clear()
        self._new_jobs.clear()
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
                faults = self.granter.register.faults.get(report.job, {})
                outcomes.append(_outcome_of(report, faults | ({report.award: self.arm} if report.faulted else {})))
                self._receipts.setdefault(report.award, set())
            elif last := self._last_entries.get(report.award):
                phase = "finishing" if last.phase == "finishing" else "working"
                entries.append(replace(last, cycles=report.cycles, phase=phase))
        self._last_entries = {entry.award: entry for entry in entries}
        return entries, outcomes

    def _count_votes(self, real_s: float) -> None:
        """Act on the replies of a majority."""
        for award, pending in list(self.pending.items()):
            vote = self._votes[award]
            if reason_to_give_up(self.granter.register.faults.get(pending.job.name, {}).values()):
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


def _outcome_of(report: Report, faults: Faults) -> JobOutcome:
    """Return a report as a job outcome for peers; one that leaves the job open names all known faults in it."""
    outcome = "finished" if report.outcome == "finished" else "unfinished" if report.unsure else "returned"
    named = faults if outcome == "returned" else {}
    return JobOutcome(report.job, report.award, report.arm, outcome, report.cycles, report.time_s, report.reason, named)
