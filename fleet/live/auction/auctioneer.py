"""The auctioneer: requests quotes, awards jobs, renews leases and accepts reports, so that no job is done twice.

A state machine without a clock and without I/O. Real seconds (`real_s`, monotonic) and fleet time (`time_s`) are
arguments. Messages to send are in `out`. It grants jobs as a quorum of one; the rules that make it safe are at the head
of `fleet.live.book`. An award is sent until its arm answers; one whose lease ends without an answer has ended.
"""

import logging
import math
from collections import deque
from collections.abc import Callable, Container, Iterable, Mapping

from msgspec.structs import replace

from fleet.bus.protocol.auction import (
    Ack,
    JobSpec,
    JobStatus,
    Lease,
    LeaseEntry,
    LeaseRequest,
    Quote,
    Receipt,
    Report,
    Result,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.consensus import History
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import Cleared, ClearRequest, Controlled, ControlRequest, Operation
from fleet.errors import Refused
from fleet.live.auction.rounds import SCAN_S, Allocate, Out, Rounds, retaken_space, space_of
from fleet.live.book import JobBook
from fleet.live.epochs import adopted
from fleet.live.job_rules import NONE_RESERVED, finish_s, joined_reasons
from fleet.live.journal import JobsAccepted, Released
from fleet.live.leases import Timing, clear, expire, no_progress, progress, renewal, send_again, unanswered, was_stopped
from fleet.live.records import MAX_REASON, JobEntry, JobSettled, ShiftEnded, outcome_of, requested_job
from fleet.live.space import Excludes, no_conflicts
from fleet.live.steering import carry_out, controlled

_LOG = logging.getLogger(__name__)


class Auctioneer:
    """One auctioneer, from one start of its process to the next.

    Attributes:
        book: Its jobs and awards.
        out: Messages to send, oldest first; the driver takes them out.
        rounds: Its rounds.
    """

    def __init__(
        self,
        name: str,
        book: JobBook,
        *,
        allocate: Allocate,
        keep: Callable[..., None],
        boot: str,
        real_s: float,
        timing: Timing | None = None,
        excludes: Excludes = no_conflicts,
    ) -> None:
        """Start with the jobs and awards of a book.

        Args:
            keep: Writes records; returns when they are on disk, or raises `JournalError` and has written none.
            boot: Part of the names of auctions and awards; unique for each start of an auctioneer of this name.
        """
        self.name, self.book = name, book
        book.name = name
        self._timing = timing or Timing()
        self.out: deque[Out] = deque()
        book.attach(keep, real_s + self._timing.counted_lease_s, self._announce)
        self.rounds = Rounds(name, book, allocate, self._timing, excludes, boot, self.out.append)
        self._checked_s = -math.inf
        for change in (*book.recent, *book.requested):  # for those who missed them
            self._announce(change)

    # Messages

    def submit(
        self, submission: Submission, time_s: float, reserved: Mapping[str, JobSpec] = NONE_RESERVED
    ) -> SubmissionReply:
        """Accept jobs; every accepted one is on disk when this returns.

        Args:
            reserved: As of `fleet.live.job_rules.admit`.
        """
        admissions = self.book.admit(submission.jobs, time_s, reserved=reserved)
        accepted = {job.name: job for job, reply in zip(submission.jobs, admissions, strict=True) if reply.accepted}
        new = tuple(job for name, job in accepted.items() if not self.book.is_known(name))
        if new:
            self.book.record(JobsAccepted(new, submission.by, time_s))
            self.rounds.retry_now()
        return SubmissionReply(self.name, admissions, self.book.epoch)

    def renew_leases(self, request: LeaseRequest, real_s: float, time_s: float) -> Lease:
        """Renew leases, and permit to commit where an arm asks for it.

        An arm that asks after the end of its lease, but before its award was closed, keeps it: no other arm has it.
        """
        its = {entry.award: entry for entry in request.entries if self._is_open(entry, request.arm)}
        leased = {award: entry for award, entry in its.items() if self.book.may_begin(award)}
        revoked = tuple(entry.award for entry in request.entries if entry.award not in leased)
        self._take_space(request.arm, space_of(self.book, revoked, request.arm))
        for award, entry in its.items():
            lease = self.book.leases[award]
            if lease.unanswered is not None:
                self.rounds.back_offs.end(request.arm, entry.job)
            if (
                entry.phase == "queued"
                or entry.cycles > lease.cycles
                or award not in leased
                or self._rests(request.arm)
            ):
                lease.progress_s = real_s, time_s
            lease.unanswered, lease.cycles = None, max(self._counted(entry), lease.cycles)
            if award not in leased:  # its arm ends the cycle in progress, which may take longer than a lease
                lease.until_s = real_s + self._timing.counted_lease_s
        if not self._permit_commits(leased, time_s):
            leased = {award: entry for award, entry in leased.items() if not self.book.open[award].silent}
        for award in leased:
            self.book.leases[award].until_s = real_s + self._timing.counted_lease_s
        return Lease(
            auctioneer=self.name,
            lease_s=self._timing.lease_s,
            granted=tuple(leased),
            revoked=revoked,
            may_commit=tuple(award for award in leased if self.book.open[award].may_commit),
        )

    def apply_report(self, report: Report, real_s: float, time_s: float) -> Receipt:
        """Record the outcome of an award; the same report again changes nothing.

        Raises:
            Refused: the award is another arm's, or for another job.
        """
        receipt, grant = Receipt(self.name, report.award), self.book.grant_of(report.award, report.job)
        shown = replace(report, time_s=min(report.time_s, time_s), reason=report.reason[:MAX_REASON])
        faults = {report.award: report.arm} if report.faulted else {}
        if grant is None:
            # It was settled long ago, or the journal is an older copy. The receipt ends the repetition of the report.
            _LOG.warning("'%s' reports on an unknown award: %s.", report.arm, report.award)
            outcome = outcome_of(shown, faults)
            counts = outcome.outcome == "returned" and report.job in self.book.jobs
            if (counts or outcome.outcome == "unfinished") and self.book.is_news(outcome):
                self.book.record(JobSettled(outcome))
            return receipt
        arm, job = grant.record.arm, grant.record.job
        if (arm, job) != (report.arm, report.job):
            raise Refused(f"Award '{report.award}' gives '{job}' to '{arm}', not '{report.job}' to '{report.arm}'.")
        if grant.outcome not in ("finished", "unfinished", "returned"):
            spec, doubts = self.book.jobs[job].spec, list[str]()
            if report.outcome == "finished" and not grant.may_commit:
                doubts.append(f"'{arm}' finished '{job}' without permission to commit: it may have been done twice.")
            if report.outcome == "finished" and spec is not None and report.cycles != spec.repetitions:
                counts = f"finished after {report.cycles} cycles, but it has {spec.repetitions}"
                doubts.append(f"'{arm}' reports '{job}' {counts}: it counts as finished.")
            if report.restarted and grant.may_commit and not report.unsure:
                doubts.append(f"The journal of '{arm}' lacks its permission to commit '{job}': it may have been done.")
                shown = replace(shown, unsure=True)
            for doubt in doubts:
                _LOG.error("%s", doubt)
            shown = replace(shown, reason=joined_reasons(report.reason, " ".join(doubts))[:MAX_REASON])
            # The space of an award that has ended may have been freed since.
            space = retaken_space(self.book, arm, {grant.record.space}) if grant.outcome else []
            self.book.record(*space, JobSettled(outcome_of(shown, faults)))
            if report.outcome == "finished":
                self.rounds.retry_now()
            else:
                self.rounds.delay(real_s, (job,))
        return receipt

    def adopt(self, history: History, real_s: float) -> None:
        """Take over what an arm has done and has, as far as the journal does not know it.

        Raises:
            JournalError: it is not on disk.
        """
        if records := adopted(self.book, history):
            _LOG.warning("%d records of what '%s' has done and has are new to the journal.", len(records), history.arm)
            self.book.record(*records)
            self.book.lease_open_grants(real_s + self._timing.counted_lease_s)

    def add_quote(self, quote: Quote) -> None:
        """Add a quote; after the last one that the round waits for, the next tick closes it."""
        if (current := self.rounds.open) is not None and quote.auction == current.auction:
            current.quotes[quote.arm] = quote

    def note_unusable_quote(self, auction: str, arm: str, why: str) -> None:
        """Note what is wrong with the reply of an arm in a round, for the reasons of its jobs."""
        if (current := self.rounds.open) is not None and auction == current.auction:
            current.unusable[arm] = why[:MAX_REASON]

    def end_quotes(self, auction: str) -> None:
        """Have the next tick close a round: no more quotes will arrive."""
        if (current := self.rounds.open) is not None and current.auction == auction:
            current.until_s = -math.inf

    def apply_ack(self, ack: Ack, real_s: float, time_s: float) -> None:
        """Apply an arm's answer to an award."""
        lease = self.book.leases.get(ack.award)
        if lease is None or lease.unanswered is None or lease.unanswered.arm != ack.arm:
            return
        job = lease.unanswered.award.job.name
        if ack.accepted:
            self.rounds.back_offs.end(ack.arm, job)
        else:
            reason = f"'{ack.arm}' refused it: {ack.reason}"[:MAX_REASON]
            self.book.record(Released(ack.award, job, ack.arm, "refused", 0, time_s, reason))
            self.rounds.back_offs.add_refusal(ack.arm, job, ack.reason[:MAX_REASON], real_s)
        lease.unanswered = None
        if not unanswered(self.book.leases):
            self.rounds.scan_now()

    def apply_state(self, arm: str, state: State) -> None:
        """Apply the state of an arm; one that has come home may have freed space."""
        before = self.rounds.states.get(arm)
        self._take_space(arm, {state.space} - {""})
        if before is not None and before.space and not state.space:
            self.rounds.retry_now()
        self.rounds.states[arm] = self.rounds.sensors[arm].check(state)

    def clear(self, request: ClearRequest, present: frozenset[str], time_s: float) -> Cleared:
        """Free the space of an absent arm and end its awards, as `clear`."""
        if clear(self.book, request.arm, request.by, present, self._timing.lease_s, time_s):
            _LOG.warning("The space of '%s' was cleared by '%s'.", request.arm, request.by)
            self.rounds.retry_now()
        return Cleared(self.name, request.arm)

    def control(self, request: ControlRequest, time_s: float) -> Controlled:
        """Carry out a request of a person, as `carry_out`."""
        rounds = self.rounds
        states = {arm: state for arm, state in rounds.states.items() if arm in rounds.present}
        operation, note = carry_out(self.book, request, rounds.present.union(self.book.arms), states, time_s)
        if operation is not None:
            self.rounds.retry_now()
        job = requested_job(request)
        return controlled(self.book, request, note, next(iter(self.status((job,))), None) if job else None)

    def set_present(self, present: frozenset[str], obstacle: str = "") -> None:
        """Set which arms are present, and why no job is awarded; "" if jobs are."""
        if present - self.rounds.present:
            self.rounds.retry_now()
        self.rounds.present, self.rounds.obstacle = present, obstacle

    def tick(self, real_s: float, time_s: float) -> None:
        """Do what is due."""
        ended = expire(self.book, real_s, time_s)
        for lease in ended:
            if lease.unanswered is not None and not was_stopped(lease, real_s):
                self.rounds.back_offs.add_unanswered(lease.unanswered.arm, lease.unanswered.award.job.name, real_s)
        if ended:
            self.rounds.retry_now()
        if real_s >= self._checked_s + SCAN_S:
            self._checked_s = real_s
            self.book.try_to_record("Late jobs are not given up", *self.book.expired(time_s))
        self.out.extend(send_again(self.book.leases, real_s, self._timing))
        self.rounds.step(real_s, time_s)

    def end(self, time_s: float) -> None:
        """End the shift: nothing more is offered, and open jobs are reported unfinished."""
        if not self.book.ended:
            self.rounds.open = None
            self.book.record(*progress(self.book, self.book.jobs), ShiftEnded(time_s))

    def finishing(self) -> bool:
        """Return whether a present arm may be in the last cycle of a job."""
        return any(award.may_commit and award.record.arm in self.rounds.present for award in self.book.open.values())

    def status(self, names: Iterable[str] = ()) -> tuple[JobStatus, ...]:
        """Return the status of jobs, with the last reported progress."""
        return self.status_of(self.book.entries(names))

    def status_of(self, entries: Iterable[JobEntry]) -> tuple[JobStatus, ...]:
        """As `status`, of entries of the book."""
        busy = self.book.busy_stations()
        return tuple(self._with_progress(self.book.status_of(entry), entry.spec, busy) for entry in entries)

    # Leases

    def _with_progress(self, status: JobStatus, spec: JobSpec | None, busy: Container[str]) -> JobStatus:
        lease = self.book.leases.get(status.award)
        cycles = status.cycles if lease is None else max(status.cycles, lease.cycles)
        waits = status.state == "waiting"
        note = "" if spec is None or not waits else self.rounds.reason_to_wait(spec, busy)
        if lease is not None and status.state in ("awarded", "finishing"):
            note = no_progress(lease, status.arm, self._timing, *self.rounds.now_s)
        planned = not waits or bool(status.arm) or self.rounds.is_planned(status.job)  # an arm had it before
        expected_s = finish_s(status, self.rounds.states.get(status.arm), self.rounds.now_s[1])
        reason = joined_reasons(status.reason, note)
        return replace(status, cycles=cycles, reason=reason, finish_s=expected_s, not_planned=not planned)

    def _counted(self, entry: LeaseEntry) -> int:
        """Return the cycles of a renewal that count: the last one counts once it is reported."""
        spec = self.book.jobs[entry.job].spec
        return entry.cycles if spec is None else min(entry.cycles, spec.repetitions - 1)

    def _rests(self, arm: str) -> bool:
        """Return whether an arm is in a break, or faulted, by its last state."""
        state = self.rounds.states.get(arm)
        return state is not None and (state.break_in_s == 0.0 or state.mode == "faulted")

    def _is_open(self, entry: LeaseEntry, arm: str) -> bool:
        award = self.book.open.get(entry.award)
        return award is not None and (award.record.arm, award.record.job) == (arm, entry.job)

    def _permit_commits(self, leased: dict[str, LeaseEntry], time_s: float) -> bool:
        """Record permissions to commit, and contact with silent arms; return whether that is on disk."""
        needed = (
            renewal(self.book, award, time_s, entry.cycles, finishing=entry.phase == "finishing")
            for award, entry in leased.items()
        )
        records = [record for each in needed for record in each]
        return self.book.try_to_record("No permission to commit is given", *records)

    def _take_space(self, arm: str, space: set[str]) -> None:
        """Record that an arm that is heard takes this space; on a full disk nothing is awarded, and it is repeated."""
        self.book.try_to_record(f"The space of '{arm}' is not recorded", *retaken_space(self.book, arm, space))

    def _announce(self, change: Result | Operation) -> None:
        """Publish a change of a job, or a request of a person, of which nobody needs to know the awards."""
        self.out.append(replace(change, awards=()) if isinstance(change, Operation) else change)
