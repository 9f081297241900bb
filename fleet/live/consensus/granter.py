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
"""

from collections.abc import Callable, Iterable, Mapping

from fleet.bus.protocol.auction import JobSpec, JobStatus
from fleet.bus.protocol.consensus import (
    Claim,
    ClaimEntry,
    ClaimReply,
    DeniedEntry,
    Faults,
    GrantedEntry,
    JobOutcome,
)
from fleet.bus.protocol.operator import Operation
from fleet.errors import JournalFull, Refused
from fleet.job import reason_to_give_up
from fleet.live.auction.control import job_of
from fleet.live.auction.job_rules import MAX_OPEN_JOBS, reason_for_silence
from fleet.live.auction.ledger import MAX_SETTLED
from fleet.live.auction.round import Timing
from fleet.live.consensus.operations import is_for
from fleet.live.consensus.records import Faulted, GrantRecord, JobGranted, JobSettled, Requested
from fleet.live.consensus.register import Register
from fleet.live.journal_records import EpochBegun, JobsAccepted, Released, SpaceCleared, SpaceTaken
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
