"""Requests of people who steer a fleet: which are possible, and what happens next; the same without an auctioneer.

The auctioneer: requests quotes, awards jobs, renews leases and accepts reports, so that no job is done twice.

A state machine without a clock and without I/O. Real seconds (`real_s`, monotonic) and fleet time (`time_s`) are
arguments. Records go to `keep`, which returns once they are on disk. Messages to send are in `out`. The rules that
make it safe (`fleet.bus.protocol.auction` says why):

- An award is on disk before it is sent. From then on it counts as leased for `Timing.counted_lease_s`, with or without
  an answer; a renewal counts from the moment of the reply.
- A job is offered again only after its lease has ended here, or its arm has refused or returned it.
- Permission to commit, that is to begin the last cycle, is on disk before it is given; no other arm gets the job then.
- After a crash every open award counts as leased from the restart.
- An arm takes the space of an award from then on until its quote in a later round says that it does not take it any
  more; an award is given only if its space is free. The space of an arm without a quote stays taken.
- Whoever frees the space of an arm also ends its awards; if the arm is heard again, it takes its space again.
"""

import logging
import math
from collections.abc import Callable, Container, Iterable, Mapping, Set
from typing import Protocol

from msgspec.structs import replace

from fleet.bus.protocol.auction import (
    SETTLED,
    Ack,
    JobSpec,
    JobState,
    JobStatus,
    Lease,
    LeaseEntry,
    LeaseRequest,
    Quote,
    Receipt,
    Report,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.consensus import History
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import (
    ALL_ARMS,
    Cancel,
    Change,
    Cleared,
    ClearRequest,
    Controlled,
    ControlRequest,
    Pause,
    Resume,
    Settle,
)
from fleet.errors import Refused
from fleet.live.auction.job_rules import changed_spec, joined_reasons
from fleet.live.auction.ledger import Ledger
from fleet.live.auction.records import AuctionRecord, ContactLost, ContactRegained, Operated, ShiftEnded, content_hash
from fleet.live.auction.rounds import (
    MAX_REASON,
    SCAN_S,
    Allocate,
    CountedLease,
    LedgerWriter,
    Rounds,
    Timing,
    adopted,
    cleared_space,
    retaken_space,
    send_again,
    unanswered,
)
from fleet.live.journal import Closed, CommitPermitted, JobsAccepted
from fleet.live.space import Excludes, no_conflicts

ALREADY_DONE = "This request was carried out before."
NO_CHANGE = "Nothing changed: it is so already."


class SteeredJob(Protocol):
    """What the rules need to know about a job."""

    @property
    def spec(self) -> JobSpec: ...
    @property
    def state(self) -> JobState: ...
    @property
    def cancelled(self) -> bool: ...


class SteeredFleet(Protocol):
    """What the rules need to know about a fleet: the ledger of an auctioneer, or what an arm without one knows."""

    @property
    def jobs(self) -> Mapping[str, SteeredJob]: ...
    @property
    def past(self) -> Container[str]: ...
    @property
    def paused(self) -> Mapping[str, str]: ...
    @property
    def space(self) -> Mapping[str, frozenset[str]]: ...
    @property
    def aside(self) -> Container[str]: ...
    @property
    def requests(self) -> Mapping[str, int]: ...
    @property
    def ended(self) -> bool: ...

    def at_work(self) -> Mapping[str, tuple[str, bool]]:
        """Return the arm that has a job, and whether it has permission to commit, by job."""
        ...


def was_carried_out(fleet: SteeredFleet, request: ControlRequest) -> bool:
    """Return whether this request was carried out before.

    Raises:
        Refused: another request of this name was.
    """
    before = fleet.requests.get(request.request)
    if before not in (None, 0, content_hash(request)):
        raise Refused(
            f"Another request of the name '{request.request}' was carried out before, so this one is not "
            f"({request.action}). Give each request a name of its own, for example a UUID."
        )
    return before is not None


def job_of(request: ControlRequest) -> str:
    """Return the name of the job of a request; "" if it is for arms."""
    return "" if isinstance(request.action, Pause | Resume) else request.action.job


def objection(fleet: SteeredFleet, request: ControlRequest, arms: Set[str]) -> str:
    """Return why a request changes nothing; "" if it changes something.

    Args:
        arms: Those that are present, and those of the cell.

    Raises:
        Refused: it is not possible now.
    """
    match request.action:
        case Pause(arm):
            _check_arm(fleet, arm, arms)
            return NO_CHANGE if arm in fleet.paused else ""
        case Resume(arm):
            _check_arm(fleet, arm, arms)
            if arm != ALL_ARMS and ALL_ARMS in fleet.paused:
                raise Refused("All arms are paused. Resume all; then pause those that must stay paused.")
            paused = fleet.paused if arm == ALL_ARMS else arm in fleet.paused
            return "" if paused else NO_CHANGE
        case Cancel() | Settle() | Change() as action:
            return _objection_to_job(fleet, action)


def _check_arm(fleet: SteeredFleet, arm: str, arms: Set[str]) -> None:
    if arm != ALL_ARMS and not any(arm in names for names in (arms, fleet.space, fleet.paused)):
        raise Refused(f"There is no arm '{arm}'. Arms: {', '.join(sorted(arms)) or 'none'}; '*' for all.")


def _objection_to_job(fleet: SteeredFleet, action: Cancel | Settle | Change) -> str:
    entry = fleet.jobs.get(action.job)
    if entry is None:
        if action.job in fleet.past:
            return "It was settled long ago."
        if action.job in fleet.aside:
            if isinstance(action, Settle):
                return ""
            raise Refused(f"'{action.job}' is quarantined, and its description is lost: settle it as done or redo.")
        raise Refused(f"There is no job '{action.job}'.")
    state = entry.state
    match action:
        case Cancel():
            if state == "unfinished":
                raise Refused(f"'{action.job}' is unfinished: settle it as done, or redo it and then cancel it.")
            return f"It is {state}." if state == "finished" or entry.cancelled else ""
        case Settle(_, outcome):
            if state != "unfinished":
                if state in ("finished", "waiting") and (state == "finished") == (outcome == "done"):
                    return NO_CHANGE
                raise Refused(f"'{action.job}' is {state}; only an unfinished job can be settled.")
            if outcome == "redo" and fleet.ended:
                raise Refused("The shift is over: nothing is redone.")
            if outcome == "redo" and action.job in (at_work := fleet.at_work()):
                arm = at_work[action.job][0]
                raise Refused(
                    f"'{arm}' may still do the last cycle of '{action.job}'. Stop it and free its space "
                    f"(jobs/clear, or thermofleet arm clear {arm}) first."
                )
            return ""
        case Change():
            if state in SETTLED:
                raise Refused(f"'{action.job}' is {state}; only a job that is not settled can be changed.")
            try:
                changed = changed_spec(entry.spec, action)
            except ValueError as error:
                raise Refused(str(error)) from error
            return NO_CHANGE if changed == entry.spec else ""


def next_step(fleet: SteeredFleet, request: ControlRequest) -> str:
    """Return what happens next; "" if nothing does."""
    match request.action:
        case Pause(arm):
            jobs = [job for job, (has, _) in fleet.at_work().items() if arm in (ALL_ARMS, has)]
            return f"{len(jobs)} job(s) end or go back after the cycle in progress." if jobs else ""
        case Cancel(job) if job in (at_work := fleet.at_work()):
            if at_work[job][1]:
                return "It is in its last cycle: it is cancelled only if the arm returns it."
            return "The arm ends the cycle in progress and returns it."
        case _:
            return ""


_LOG = logging.getLogger(__name__)


class Auctioneer:
    """One auctioneer, from one start of its process to the next.

    Attributes:
        ledger: Its jobs and awards.
        out: Messages to send, oldest first; the driver takes them out.
        rounds: Its rounds.
    """

    def __init__(
        self,
        name: str,
        ledger: Ledger,
        *,
        allocate: Allocate,
        keep: Callable[..., None],
        boot: str,
        real_s: float,
        timing: Timing | None = None,
        excludes: Excludes = no_conflicts,
    ) -> None:
        """Start with the jobs and awards of a ledger.

        Args:
            keep: Writes records; returns when they are on disk, or raises `JournalError` and has written none.
            boot: Part of the names of auctions and awards; unique for each start of an auctioneer of this name.
        """
        self.name, self.ledger = name, ledger
        self._timing = timing or Timing()
        self._writer = LedgerWriter(name, ledger, keep, real_s + self._timing.counted_lease_s)
        self.rounds = Rounds(name, self._writer, allocate, self._timing, excludes, boot)
        self._checked_s = -math.inf
        self.out = self._writer.out

    # Messages

    def submit(self, submission: Submission, real_s: float, time_s: float) -> SubmissionReply:
        """Accept jobs; every accepted one is on disk when this returns."""
        admissions = self.ledger.admit(submission.jobs)
        accepted = {job.name: job for job, reply in zip(submission.jobs, admissions, strict=True) if reply.accepted}
        new = tuple(j for name, j in accepted.items() if name not in self.ledger.jobs and name not in self.ledger.past)
        if new:
            self._writer.record(JobsAccepted(new, submission.by, time_s))
            self.rounds.retry_now()
        return SubmissionReply(self.name, admissions, self.ledger.epoch)

    def renew_leases(self, request: LeaseRequest, real_s: float, time_s: float) -> Lease:
        """Renew leases, and permit to commit where an arm asks for it.

        An arm that asks after the end of its lease, but before its award was closed, keeps it: no other arm has it.
        """
        its = {entry.award: entry for entry in request.entries if self._is_open(entry, request.arm)}
        leased = {award: entry for award, entry in its.items() if self.ledger.may_begin(award)}
        revoked = tuple(entry.award for entry in request.entries if entry.award not in leased)
        self._take_space(request.arm, self.ledger.space_of(revoked, request.arm))
        for award, entry in its.items():
            lease = self._writer.leases[award]
            lease.unanswered, lease.cycles = None, max(entry.cycles, lease.cycles)
            if award not in leased:  # its arm ends the cycle in progress, which may take longer than a lease
                lease.until_s = real_s + self._timing.counted_lease_s
        if not self._permit_commits(leased, time_s):
            leased = {award: entry for award, entry in leased.items() if not self.ledger.open[award].silent}
        for award in leased:
            self._writer.leases[award].until_s = real_s + self._timing.counted_lease_s
        return Lease(
            auctioneer=self.name,
            lease_s=self._timing.lease_s,
            granted=tuple(leased),
            revoked=revoked,
            may_commit=tuple(award for award in leased if self.ledger.open[award].may_commit),
        )

    def apply_report(self, report: Report, real_s: float, time_s: float) -> Receipt:
        """Record the outcome of an award; the same report again changes nothing.

        Raises:
            Refused: the award is another arm's, or for another job.
        """
        receipt = Receipt(self.name, report.award)
        award = self.ledger.awards.get(report.award)
        if award is None:
            # Its journal is lost. The receipt ends the repetition of the report.
            _LOG.warning("'%s' reports on an unknown award: %s.", report.arm, report.award)
            return receipt
        if (award.record.arm, award.record.job) != (report.arm, report.job):
            raise Refused(
                f"Award '{report.award}' gives '{award.record.job}' to '{award.record.arm}', not '{report.job}' to "
                f"'{report.arm}'."
            )
        if award.outcome not in ("finished", "returned"):
            if report.outcome == "finished" and not award.may_commit:
                _LOG.error("'%s' finished '%s' without permission to commit.", report.arm, report.job)
            done_s, reason = min(report.time_s, time_s), report.reason[:MAX_REASON]
            outcome = (report.award, report.outcome, report.cycles, done_s, reason, report.unsure)
            self._writer.record(Closed(*outcome, faulted=report.faulted))
            if report.outcome == "finished":
                self.rounds.retry_now()
            else:
                self.rounds.delay(real_s, (report.job,))
        return receipt

    def adopt(self, history: History, real_s: float) -> None:
        """Take over what an arm has done and has, as far as the journal does not know it.

        Raises:
            JournalError: it is not on disk.
        """
        records = adopted(self.ledger, history, self.name, self.ledger.time_s)
        if records:
            _LOG.warning("%d records of what '%s' has done and has are new to the journal.", len(records), history.arm)
            self._writer.record(*records)
            for award in self.ledger.open.keys() - self._writer.leases.keys():
                self._writer.leases[award] = CountedLease(real_s + self._timing.counted_lease_s)

    def add_quote(self, quote: Quote) -> None:
        """Add a quote; after the last one that the round waits for, the next tick closes it."""
        if (current := self.rounds.open) is not None and quote.auction == current.auction:
            current.quotes[quote.arm] = quote

    def end_quotes(self, auction: str) -> None:
        """Have the next tick close a round: no more quotes will arrive."""
        if (current := self.rounds.open) is not None and current.auction == auction:
            current.until_s = -math.inf

    def apply_ack(self, ack: Ack, real_s: float, time_s: float) -> None:
        """Apply an arm's answer to an award."""
        lease = self._writer.leases.get(ack.award)
        if lease is None or lease.unanswered is None or lease.unanswered.arm != ack.arm:
            return
        if not ack.accepted:
            reason = f"'{ack.arm}' refused it: {ack.reason}"[:MAX_REASON]
            self._writer.record(Closed(ack.award, "refused", 0, time_s, reason))
            self.rounds.delay(real_s, (lease.unanswered.award.job.name,))
        lease.unanswered = None
        if not unanswered(self._writer.leases):
            self.rounds.scan_now()

    def apply_state(self, arm: str, state: State) -> None:
        """Apply the state of an arm; one that has come home may have freed space."""
        before = self.rounds.states.get(arm)
        self._take_space(arm, {state.space} - {""})
        if before is not None and before.space and not state.space:
            self.rounds.retry_now()
        self.rounds.states[arm] = self.rounds.sensors[arm].check(state)

    def clear(self, request: ClearRequest, present: frozenset[str], time_s: float) -> Cleared:
        """Free the space of an absent arm and end its awards: a person has seen that it is at home, or removed.

        It is unknown whether its last cycle was done; if the arm is heard again, it reports that.

        Raises:
            Refused: the arm is unknown, or present, or may have a lease.
        """
        cycles = {name: lease.cycles for name, lease in self._writer.leases.items()}
        if records := cleared_space(self.ledger, request, present, cycles, self._timing.lease_s, time_s):
            self._writer.record(*records)
            _LOG.warning("The space of '%s' was cleared by '%s'.", request.arm, request.by)
            self.rounds.retry_now()
        return Cleared(self.name, request.arm)

    def control(self, request: ControlRequest, time_s: float) -> Controlled:
        """Carry out a request of a person, once; it is on disk when this returns.

        Raises:
            Refused: it is not possible now.
        """
        ledger, job = self.ledger, job_of(request)
        known = was_carried_out(ledger, request)
        note = ALREADY_DONE if known else objection(ledger, request, self.rounds.present.union(ledger.arms))
        if not known:
            entry = ledger.jobs.get(job)
            lease = None if entry is None else self._writer.leases.get(entry.award)
            self._writer.record(Operated(request, time_s, 0 if lease is None else lease.cycles))
            _LOG.warning("'%s' requested: %s", request.by, request.action)
            self.rounds.retry_now()
        changed = not (known or note)
        status = next(iter(self.status((job,))), None) if job else None
        note = note or next_step(ledger, request)
        return Controlled(self.name, request.request, changed, note, status, dict(ledger.paused))

    def set_present(self, present: frozenset[str]) -> None:
        """Set which arms are present."""
        if present - self.rounds.present:
            self.rounds.retry_now()
        self.rounds.present = present

    def tick(self, real_s: float, time_s: float) -> None:
        """Do what is due."""
        self._expire(real_s, time_s)
        if real_s >= self._checked_s + SCAN_S:
            self._checked_s = real_s
            self._writer.try_to_record("Late jobs are not given up", *self.ledger.expired(time_s))
        self.out.extend(send_again(self._writer.leases, real_s, self._timing))
        self.rounds.step(real_s, time_s)

    def end(self, time_s: float) -> None:
        """End the shift: nothing more is offered, and open jobs are reported unfinished."""
        if not self.ledger.ended:
            self.rounds.open = None
            self._writer.record(ShiftEnded(time_s, {name: lease.cycles for name, lease in self._writer.leases.items()}))

    def finishing(self) -> bool:
        """Return whether a present arm may be in the last cycle of a job."""
        return any(award.may_commit and award.record.arm in self.rounds.present for award in self.ledger.open.values())

    def status(self, names: Iterable[str] = ()) -> tuple[JobStatus, ...]:
        """Return the status of jobs, with the last reported progress."""
        busy = self.ledger.busy_stations()
        return tuple(self._with_progress(status, busy) for status in self.ledger.status(names))

    # Leases

    def _with_progress(self, status: JobStatus, busy: Container[str]) -> JobStatus:
        lease = self._writer.leases.get(status.award)
        cycles = status.cycles if lease is None else max(status.cycles, lease.cycles)
        waits = status.state == "waiting"
        note = self.rounds.reason_to_wait(self.ledger.jobs[status.job].spec, busy) if waits else ""
        planned = not waits or self.rounds.is_planned(status.job)
        state = self.rounds.states.get(status.arm) if status.state in ("awarded", "finishing") else None
        finish_s = state.time_s + state.busy_s if state is not None and state.job == status.job else None
        reason = joined_reasons(status.reason, note)
        return replace(status, cycles=cycles, reason=reason, finish_s=finish_s, not_planned=not planned)

    def _is_open(self, entry: LeaseEntry, arm: str) -> bool:
        award = self.ledger.open.get(entry.award)
        return award is not None and (award.record.arm, award.record.job) == (arm, entry.job)

    def _permit_commits(self, leased: dict[str, LeaseEntry], time_s: float) -> bool:
        """Record permissions to commit, and contact with silent arms; return whether that is on disk."""
        records: list[AuctionRecord] = []
        for name, entry in leased.items():
            award = self.ledger.open[name]
            if entry.phase == "finishing" and not award.may_commit:
                records.append(CommitPermitted(name, time_s, entry.cycles))
            elif award.silent and not self.ledger.ended:
                records.append(ContactRegained(name, time_s))
        return self._writer.try_to_record("No permission to commit is given", *records)

    def _take_space(self, arm: str, space: set[str]) -> None:
        """Record that an arm that is heard takes this space; on a full disk nothing is awarded, and it is repeated."""
        self._writer.try_to_record(f"The space of '{arm}' is not recorded", *retaken_space(self.ledger, arm, space))

    def _expire(self, real_s: float, time_s: float) -> None:
        """Close awards whose lease has ended; one with permission to commit stays open."""
        for name, lease in [(name, lease) for name, lease in self._writer.leases.items() if real_s >= lease.until_s]:
            award = self.ledger.open[name]
            missing = "renew its lease" if lease.unanswered is None else "answer the award"
            vain = f"'{award.record.job}' is not taken back from '{award.record.arm}'"
            if not award.may_commit:
                reason = f"'{award.record.arm}' did not {missing}."
                if not self._writer.try_to_record(vain, Closed(name, "dropped", lease.cycles, time_s, reason)):
                    return
                self.rounds.retry_now()
            elif not award.silent and not self.ledger.ended:
                if not self._writer.try_to_record(vain, ContactLost(name, time_s, lease.cycles)):
                    return
                lease.until_s = math.inf
