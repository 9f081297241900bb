"""Ledger of an auctioneer: journal records of its jobs and awards, and the state that follows from them alone.

A record is on disk before it is applied, so a replay gives the same ledger, with the same numbers on its results. The
ends of leases are not recorded: after a restart every open award counts as leased from then on.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

from msgspec.structs import asdict, replace

from fleet.bus.protocol.auction import ABANDONED, SETTLED, JobStatus, Offers
from fleet.bus.protocol.messages import encode
from fleet.bus.protocol.operator import ALL_ARMS, Cancel, ControlRequest, Pause, Resume, Settle
from fleet.bus.protocol.operator import Change as ChangeJob
from fleet.job import reason_to_give_up
from fleet.live.auction.job_rules import (
    EXPIRED,
    SHIFT_ENDED,
    changed_spec,
    lost_jobs,
    reason_for_silence,
    reason_to_follow,
)
from fleet.live.auction.ledger_state import LedgerState, doubt
from fleet.live.auction.past_jobs import content_hash
from fleet.live.auction.records import (
    AuctionRecord,
    Awarded,
    AwardState,
    Change,
    Checked,
    ContactLost,
    ContactRegained,
    Expired,
    HistoryAdopted,
    JobEntry,
    JobsPutAside,
    LedgerSnapshot,
    Operated,
    ShiftEnded,
)
from fleet.live.journal import PutAside
from fleet.live.journal_records import (
    ClockTick,
    Closed,
    CommitPermitted,
    EpochBegun,
    JobsAccepted,
    SpaceCleared,
    SpaceTaken,
    Started,
)

_LOG = logging.getLogger(__name__)

MAX_SETTLED = 2_000
"""Finished and given-up jobs whose status is kept; older ones leave the ledger, and only `PastJobs` knows them."""
MAX_REQUESTS = 1_024
"""Requests of people whose names are kept."""
NUMBERS_SKIPPED = 1_000
"""Numbers of results that are left out after a journal that was wrong, so that none is used twice."""
MAX_AWARDS = 16
"""Closed awards of one job on which a report is still expected."""


@dataclass
class Ledger(LedgerState):
    """Jobs and awards; only `apply` changes it."""

    def replay(self, records: Iterable[AuctionRecord], put_aside: PutAside | None = None) -> Self:
        """Apply records, oldest first, and return the ledger.

        Records that contradict those before are not applied, and their jobs are put aside.

        Args:
            put_aside: Gets each of these records, with the reason; None: it is logged.
        """
        before, doubts = set(self._aside_jobs()), 0
        for record in records:
            if (found := doubt(self, record)) is None:
                self.apply(record)
                continue
            doubts += 1
            _LOG.error("A record of the journal is wrong, %s: %s", found.reason, record)
            if put_aside is not None:
                put_aside(encode(record), found.reason)
            self._put_aside(dict.fromkeys(found.jobs, found.reason))
            if isinstance(record, Checked):
                self._apply_check(record)
        aside = [name for name in self._aside_jobs() if name not in before]
        if doubts or aside:  # the numbers of the last changes are uncertain
            self.recent.clear()
            self.number += NUMBERS_SKIPPED
        for name in aside:
            self._change(self.status((name,))[0], self.time_s, "", self.jobs.get(name))
        return self

    def apply(self, record: AuctionRecord) -> list[Change]:
        """Apply a record that is on disk, and return the changes of job states."""
        changed: list[JobEntry] = []
        match record:
            case JobsAccepted():
                known = (self.jobs, self.past, self.aside)
                new = (job for job in record.jobs if not any(job.name in names for names in known))
                changed = [JobEntry(job, record.by) for job in new]
                for entry in changed:
                    self.jobs[entry.spec.name] = entry
                    self._move(entry, "waiting")
                self._note_followers(changed)
                if any(entry.spec.after for entry in changed):
                    self._apply_given_up()
            case Awarded():
                entry = self.jobs[record.job]
                self._forget_awards(entry)
                self.awards[record.award] = self.open[record.award] = AwardState(replace(record, offers=()))
                self._awards_of.setdefault(record.job, []).append(record.award)
                entry.award = record.award
                self._move(entry, "awarded")
                changed = [entry]
            case CommitPermitted() | ContactLost() | ContactRegained():
                award, entry = self.awards[record.award], self._entry(record.award)
                if not isinstance(record, ContactRegained):
                    _count(entry, record.cycles)
                award.may_commit, award.silent = True, isinstance(record, ContactLost)
                silence = reason_for_silence(award.record.arm) if award.silent else ""
                self._move(entry, "unfinished" if award.silent else "finishing", silence)
                changed = [entry]
            case Closed():
                changed = self._close(record)
            case Expired():
                entry = self.jobs[record.job]
                entry.expired = True
                self._move(entry, "given_up", EXPIRED)
                changed = [entry, *self._follow_given_up(entry)]
            case SpaceTaken():
                self.space[record.arm] = frozenset(record.space)
            case SpaceCleared():
                self.space[record.arm] = frozenset()
            case ShiftEnded():
                self.ended = True
                changed = [self.jobs[name] for name in self.unsettled()]
                for entry in changed:
                    _count(entry, record.cycles.get(entry.award, 0))
                    self._move(entry, "unfinished", entry.reason or SHIFT_ENDED)
            case EpochBegun():
                self.epoch, self.succeeds = record.epoch, record.succeeds
            case HistoryAdopted():
                changed = self._adopt(record)
            case Operated():
                self.operated += 1
                self.operations.append(record)
                changed = self._operate(record)
            case JobsPutAside():
                self._put_aside(record.jobs)
            case Checked():
                self._apply_check(record)
            case LedgerSnapshot():
                self._restore(record)
            case Started(name):
                self.name = name or self.name
            case ClockTick():
                pass
        self.time_s = max(self.time_s, record.time_s)
        self.unchecked.update(entry.spec.name for entry in changed)
        self._unnoted |= bool(changed) or isinstance(record, Operated | ShiftEnded)
        by = self._person(record)
        offers = record.offers if isinstance(record, Awarded) else ()
        changes = [self._change(self.status_of(entry), record.time_s, by, entry, offers) for entry in changed]
        while len(self.settled) > MAX_SETTLED:
            self._leave(next(iter(self.settled)))
        return changes

    # Inside

    def _person(self, record: AuctionRecord) -> str:
        """Return who asked for what a record changes; "" if nobody."""
        match record:
            case JobsAccepted():
                return record.by
            case Operated():
                return record.request.by
            case Closed() if (award := self.awards.get(record.award)) is not None:
                entry = self.jobs[award.record.job]
                return entry.changed_by if entry.state == "cancelled" else self._pauser(entry, record) or ""
            case _:
                return ""

    def _adopt(self, record: HistoryAdopted) -> list[JobEntry]:
        """Apply what an arm has finished; return the waiting jobs that need no arm any more."""
        for job in record.finished:
            if job.name not in self.jobs:
                self.past.add(job, finished=True)
        entries = [self.waiting[job.name] for job in record.finished if job.name in self.waiting]
        for entry in entries:
            entry.cycles, entry.finished_s = entry.spec.repetitions, record.time_s
            entry.award, entry.arm = "", record.arm
            self._move(entry, "finished", f"'{record.arm}' had finished it; the journal did not know it.")
        return entries

    def _leave(self, name: str) -> None:
        """Forget a settled job, except for its name and outcome."""
        entry = self.jobs.pop(name)
        del self.settled[name]
        for before in entry.spec.after:
            if (followers := self._awaited.get(before)) is not None:
                followers.pop(name, None)
                if not followers:
                    del self._awaited[before]
        self.past.add(entry.original, finished=entry.state == "finished")
        self.left[entry.state] = self.left.get(entry.state, 0) + 1
        for award in self._awards_of.pop(name, ()):
            del self.awards[award]

    def _forget_awards(self, entry: JobEntry) -> None:
        """Forget awards of a job on which no report is expected any more."""
        names = self._awards_of.get(entry.spec.name, [])
        kept = [name for name in names if name in self.open or self._may_count(self.awards[name])]
        old = [name for name in kept if name not in self.open and not self.awards[name].may_commit][:-MAX_AWARDS]
        kept = [name for name in kept if name not in old]
        for name in set(names) - set(kept):
            del self.awards[name]
        self._awards_of[entry.spec.name] = kept

    def _close(self, record: Closed) -> list[JobEntry]:
        award = self.awards.get(record.award)
        if award is None:  # left out by `compact`: the report changed nothing
            return []
        reopened = record.award in self.open
        award.silent, award.outcome = False, record.outcome
        self._end(award, moved=record.outcome != "refused")
        entry = self.jobs[award.record.job]
        if entry.state == "finished":
            return []
        if record.faulted:
            entry.faults += (award.record.arm,)
        entry.cycles = max(entry.cycles, min(record.cycles, entry.spec.repetitions))
        if record.outcome == "finished":
            if entry.award in self.open:  # a later award of the same job has no purpose any more
                self._end(self.open[entry.award])
            given_up = entry.state in ABANDONED
            entry.award, entry.finished_s = record.award, record.time_s
            self._move(entry, "finished")
            return [entry, *(self._follow_given_up(entry) if given_up else ())]
        if entry.award != record.award:  # the job was awarded again since
            return self._give_up(entry)
        if record.unsure or (self.ended and not entry.cancelled):
            self._move(entry, "unfinished", record.reason or "It is unknown whether its last cycle was done.")
            return [entry]
        pauser = self._pauser(entry, record)
        self._move(entry, "waiting", record.reason if pauser is None else f"Its arm was paused by '{pauser}'.")
        if record.outcome == "returned" and reopened:
            entry.returns, entry.returned_s = entry.returns + 1, record.time_s
        entry.cycles = min(entry.cycles, entry.spec.repetitions - 1)  # the last cycle is never assumed done
        return self._give_up(entry) or [entry]

    def _give_up(self, entry: JobEntry) -> list[JobEntry]:
        """Give a waiting job up if it is cancelled, or arms have faulted in it too often; return what has changed."""
        if entry.state == "waiting" and entry.cancelled:
            return self._cancel(entry)
        reason = reason_to_give_up(entry.faults)
        if entry.state != "waiting" or not reason:
            return []
        self._move(entry, "given_up", reason)
        return [entry, *self._follow_given_up(entry)]

    def _cancel(self, entry: JobEntry) -> list[JobEntry]:
        self._move(entry, "cancelled", f"Cancelled by '{entry.changed_by}'.")
        return [entry, *self._follow_given_up(entry)]

    def _pauser(self, entry: JobEntry, record: Closed) -> str | None:
        """Return who paused the arm that has returned a job; None if it has another reason to."""
        award = self.awards[record.award]
        if record.faulted or entry.state not in ("awarded", "finishing", "waiting") or entry.award != record.award:
            return None
        return None if award.may_commit or record.outcome == "refused" else self.pauser_of(award.record.arm)

    def _operate(self, record: Operated) -> list[JobEntry]:
        """Carry out a request of a person, which `fleet.live.auction.control` has checked; return what has changed."""
        request, time_s = record.request, record.time_s
        self.requests[request.request] = content_hash(request)
        while len(self.requests) > MAX_REQUESTS:
            del self.requests[next(iter(self.requests))]
        match request.action:
            case Pause(arm):
                self.paused[arm] = request.by
            case Resume(arm):
                self.paused = {} if arm == ALL_ARMS else {a: by for a, by in self.paused.items() if a != arm}
            case Settle(name, outcome) if name in self.aside:
                del self.aside[name]
                if outcome == "done":
                    self.past.add(name, finished=True)
            case Cancel(name) | Settle(name) | ChangeJob(name):
                if (entry := self.jobs.get(name)) is not None:
                    _count(entry, record.cycles)
                    return self._operate_job(entry, request, time_s)
        return []

    def _operate_job(self, entry: JobEntry, request: ControlRequest, time_s: float) -> list[JobEntry]:
        action, before = request.action, entry.state
        if isinstance(action, Cancel) and before not in ("finished", "unfinished", "cancelled"):
            entry.cancelled, entry.changed_by = True, request.by
            if before in ("waiting", "given_up"):
                return self._cancel(entry)
            self._move(entry, before, f"Cancelled by '{request.by}'; its arm ends the cycle in progress.")
            return [entry]
        if isinstance(action, Settle) and before == "unfinished":
            entry.cancelled, entry.changed_by, entry.aside = False, request.by, ""
            if action.outcome == "done":
                if entry.award in self.open:
                    self._end(self.open[entry.award])
                entry.cycles, entry.finished_s = entry.spec.repetitions, time_s
                self._move(entry, "finished", f"Settled as done by '{request.by}'.")
                return [entry, *self._follow_given_up(entry)]
            entry.arm = self.status_of(entry).arm
            entry.award = ""  # a late report on it that is unsure is settled, too
            entry.cycles = min(entry.cycles, entry.spec.repetitions - 1)
            self._move(entry, "waiting", f"To be redone, by '{request.by}'.")
            return self._give_up(entry) or [entry]
        if isinstance(action, ChangeJob) and before not in SETTLED:
            changed = changed_spec(entry.spec, action)
            if changed != entry.spec:
                entry.submitted, entry.spec, entry.changed_by = entry.original, changed, request.by
                return [entry]
        return []

    def _follow_given_up(self, entry: JobEntry) -> list[JobEntry]:
        """Apply a change of this job to jobs that wait for it; return what has changed."""
        if entry.spec.name not in self._awaited:
            return []
        if entry.state not in ABANDONED:
            return self._apply_given_up()
        changed, lost = list[JobEntry](), [entry.spec.name]
        for before in lost:  # grows meanwhile
            for name in self._awaited.get(before, ()):
                if (follower := self.waiting.get(name)) is not None:
                    self._move(follower, "given_up", reason_to_follow(before))
                    changed.append(follower)
                    lost.append(name)
        return changed

    def _apply_given_up(self) -> list[JobEntry]:
        """Give up jobs that wait for one that is given up; return what has changed.

        They wait again if that one was finished after all.
        """
        given_up = [self.jobs[name] for name in self.settled if self.jobs[name].state in ABANDONED]
        causes = {e.spec.name for e in given_up if e.cancelled or e.expired or reason_to_give_up(e.faults)}
        open_jobs = [*self.waiting.values(), *(entry for entry in given_up if entry.spec.name not in causes)]
        causes |= {name for entry in open_jobs for name in entry.spec.after if self.past.is_given_up(name)}
        lost = lost_jobs([entry.spec for entry in open_jobs], causes) if causes else {}
        changed = list[JobEntry]()
        for entry in open_jobs:
            state = "given_up" if entry.spec.name in lost else "waiting"
            if entry.state != state:
                self._move(entry, state, lost.get(entry.spec.name, ""))
                changed.append(entry)
        return changed

    def _end(self, award: AwardState, *, moved: bool = True) -> None:
        """Close an award; an arm that may have moved for it takes its space until it says that it is at home.

        So does an arm that reports on an award which was closed before: its space may have been freed since.
        """
        self.open.pop(award.record.award, None)
        if moved:
            arm = award.record.arm
            self.space[arm] = self.space.get(arm, frozenset()) | {award.record.space}

    def _change(self, status: JobStatus, time_s: float, by: str, entry: JobEntry | None, offers: Offers = ()) -> Change:
        change = Change(self.number, time_s, status, by=by, offers=offers)
        if entry is not None and entry.award in self.awards:
            award = asdict(self.awards[entry.award].record)
            change = replace(
                change, **{name: award[name] for name in ("auction", "difficulty", "p_saturation", "peak_c")}
            )
        self.number += 1
        self.recent.append(change)
        return change


def _count(entry: JobEntry, cycles: int) -> None:
    """Count the cycles of a job that an arm has reported; the last one counts when the job is finished."""
    entry.cycles = max(entry.cycles, min(cycles, entry.spec.repetitions - 1))
