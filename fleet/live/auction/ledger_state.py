"""State of a ledger: how a snapshot holds it, which records contradict it, and jobs that are put aside.

A journal can be undamaged and yet wrong: written by a version with an error or other bounds, or edited by hand. What
contradicts is put aside with its jobs, which no arm does until a person has settled them; the rest goes on. Each line
begins with what the line before has changed (`Checked`), so a missing record is noticed, too.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple
from zlib import crc32

import msgspec
from msgspec.structs import replace

from fleet.bus.protocol.auction import ABANDONED, JobState
from fleet.bus.protocol.messages import encode
from fleet.bus.protocol.operator import Pause, Resume
from fleet.live.auction.ledger_view import MAX_RECENT, LedgerView, reason_of_aside
from fleet.live.auction.past_jobs import PastJobs
from fleet.live.auction.records import (
    AuctionRecord,
    Awarded,
    AwardState,
    Checked,
    ContactLost,
    ContactRegained,
    Expired,
    JobEntry,
    LedgerSnapshot,
    Operated,
    job_of,
)
from fleet.live.journal import TimedState
from fleet.live.journal_records import Closed, CommitPermitted, Started
from fleet.live.space import ANYWHERE


@dataclass
class LedgerState(LedgerView, TimedState[AuctionRecord]):
    """Jobs and awards that can be written as one record, and restored."""

    name: str = field(default="", compare=False)
    """Of the auctioneer; "" in a journal of an earlier version."""
    _unnoted: bool = field(default=False, repr=False, compare=False)
    """Something has changed since the last `Checked`."""

    def __post_init__(self) -> None:
        self.space |= {arm: frozenset([ANYWHERE]) for arm in self.arms}

    def compact(self) -> tuple[LedgerSnapshot, Started]:
        """Return the records that give the same ledger, without awards on which a report would change nothing."""
        kept = [
            award
            for name, award in self.awards.items()
            if name in self.open or self._entry(name).award == name or self._may_count(award)
        ]
        snapshot = LedgerSnapshot(
            time_s=self.time_s,
            number=self.number,
            ended=self.ended,
            jobs=tuple(map(replace, self.jobs.values())),
            settled=tuple(self.settled),
            past=self.past.packed(),
            left=dict(self.left),
            epoch=self.epoch,
            succeeds=self.succeeds,
            awards=tuple(map(replace, kept)),
            open=tuple(self.open),
            recent=tuple(self.recent),
            space={arm: tuple(sorted(spaces)) for arm, spaces in self.space.items()},
            paused=dict(self.paused),
            requests=dict(self.requests),
            aside=dict(self.aside),
            checks=self.checks,
            operated=self.operated,
            operations=tuple(self.operations),
        )
        return snapshot, Started(self.name, self.time_s)

    def checks_due(self) -> tuple[Checked, ...]:
        """Return what to write before the next records, so that a replay notices if those before are wrong."""
        if not self._unnoted:
            return ()
        jobs = {name: digest(self, name) for name in sorted(self.unchecked) if name in self.jobs}
        return (Checked(self.checks + 1, self.number, jobs, self.time_s, dict(self.paused)),)

    # Inside

    def _aside_jobs(self) -> list[str]:
        return [*self.aside, *(name for name, entry in self.jobs.items() if entry.aside)]

    def _put_aside(self, reasons: Mapping[str, str]) -> None:
        """Have no arm do these jobs until a person has settled them, except for one that may have it already.

        As it is unknown where that arm is, every arm may be anywhere until it says where it is.
        """
        for name, reason in reasons.items():
            if (entry := self.jobs.get(name)) is None:
                if name not in self.past:
                    self.aside.setdefault(name, reason)
            else:
                entry.aside, entry.finished_s = entry.aside or reason, None
                if (award := self.open.get(entry.award)) is not None:
                    award.may_commit = award.silent = True
                self._move(entry, "unfinished")
        if reasons:
            self.space = dict.fromkeys([*self.arms, *self.space], frozenset([ANYWHERE]))

    def _apply_check(self, check: Checked) -> None:
        self.unchecked.clear()
        self._unnoted = False
        if check.number > self.checks:
            self.checks, self.number = check.number, max(self.number, check.changes)
            self.paused = dict(check.paused)

    def _restore(self, snapshot: LedgerSnapshot) -> None:
        self.number, self.ended, self.checks = snapshot.number, snapshot.ended, snapshot.checks
        self.jobs = {entry.spec.name: replace(entry) for entry in snapshot.jobs}
        self.waiting = {name: entry for name, entry in self.jobs.items() if entry.state == "waiting"}
        self.settled = dict.fromkeys(name for name in snapshot.settled if name in self.jobs)
        self.settled |= {name: None for name, e in self.jobs.items() if e.state in ("finished", *ABANDONED)}
        self.past, self.left, self.epoch = PastJobs(snapshot.past, self.past.limit), dict(snapshot.left), snapshot.epoch
        self.succeeds = snapshot.succeeds
        jobs = self.jobs
        self.awards = {a.record.award: replace(a) for a in snapshot.awards if a.record.job in jobs}
        self._awaited = {}
        self._note_followers(self.jobs.values())
        self._awards_of = {}
        for name, award in self.awards.items():
            self._awards_of.setdefault(award.record.job, []).append(name)
        self.open = {name: self.awards[name] for name in snapshot.open if name in self.awards}
        self.recent = deque(snapshot.recent, maxlen=MAX_RECENT)
        self.space |= {arm: frozenset(spaces) for arm, spaces in snapshot.space.items()}
        requests = snapshot.requests
        self.requests = dict(requests) if isinstance(requests, dict) else dict.fromkeys(requests, 0)
        self.paused = dict(snapshot.paused)
        self.operated, self.operations = snapshot.operated, deque(snapshot.operations, maxlen=MAX_RECENT)
        self.aside, self._unnoted = dict(snapshot.aside), False
        self.unchecked.clear()
        if broken := broken_parts(snapshot):
            for name in broken.keys() & self.jobs.keys():
                if self.jobs[name].award not in self.awards:
                    self.jobs[name].award = ""
            self._put_aside(broken)

    def _note_followers(self, entries: Iterable[JobEntry]) -> None:
        """Note which jobs these wait for."""
        for entry in entries:
            for before in entry.spec.after:
                self._awaited.setdefault(before, {})[entry.spec.name] = None

    def _move(self, entry: JobEntry, state: JobState, reason: str = "") -> None:
        """Change the state of a job."""
        name = entry.spec.name
        if state == "finished":
            entry.aside = ""
        elif entry.aside:
            state, reason = "unfinished", reason_of_aside(entry.aside)
        for index in (self.waiting, self.settled):
            index.pop(name, None)
        entry.state, entry.reason = state, reason
        if state == "waiting":
            self.waiting[name] = entry
        elif state in ("finished", *ABANDONED):
            self.settled[name] = None

    def _may_count(self, award: AwardState) -> bool:
        """Whether a report on a closed award could change the state of its job."""
        return award.outcome != "refused" and self.jobs[award.record.job].state != "finished"

    def _entry(self, award: str) -> JobEntry:
        return self.jobs[self.awards[award].record.job]


# Records that contradict others


class Doubt(NamedTuple):
    """Why a record is not applied."""

    reason: str
    jobs: tuple[str, ...] = ()
    """Jobs whose state is uncertain now; none if the record only repeats another one."""


def digest(ledger: LedgerView, name: str) -> int:
    """Return a checksum of the state of a job, and of the award that it has."""
    entry = ledger.jobs[name]
    award = ledger.awards.get(entry.award)
    terms = None if award is None else (entry.award, award.record.arm, award.record.plan, award.record.space)
    state = (entry.state, entry.cycles, entry.cancelled, entry.faults, terms)
    return crc32(msgspec.json.encode(state), crc32(encode(entry.spec)))


def doubt(ledger: LedgerView, record: AuctionRecord) -> Doubt | None:
    """Return why a record cannot follow those before; None if it can."""
    match record:
        case Awarded():
            return _doubt_award(ledger, record)
        case CommitPermitted() | ContactLost() | ContactRegained():
            if record.award in ledger.awards and record.award not in ledger.open:
                return Doubt("the award is closed already")
            if record.award not in ledger.awards:
                return _unknown_award(ledger, record.award) or Doubt(f"the job of '{record.award}' is done already")
            award = ledger.open[record.award]
            expected = {CommitPermitted: (False, False), ContactLost: (True, False), ContactRegained: (True, True)}
            if (award.may_commit, award.silent) == expected[type(record)] or ledger.jobs[award.record.job].aside:
                return None
            return Doubt("the award is in this state already", () if award.may_commit else (award.record.job,))
        case Closed():
            if record.award not in ledger.awards:
                return None if record.outcome == "refused" else _unknown_award(ledger, record.award)
            late = record.outcome in ("finished", "returned")
            ended = ledger.awards[record.award].outcome in ("finished", "returned")
            return None if record.award in ledger.open or (late and not ended) else Doubt("the award is closed already")
        case Expired(job):
            if job in ledger.waiting:
                return None
            return Doubt("the job does not wait") if _is_known(ledger, job) else _unknown_job(job)
        case Operated(request):
            if request.request in ledger.requests:
                return Doubt("the request was carried out before")
            job = "" if isinstance(request.action, Pause | Resume) else request.action.job
            return None if not job or _is_known(ledger, job) else _unknown_job(job)
        case Checked():
            return _doubt_check(ledger, record)
        case _:
            return None


def _is_known(ledger: LedgerView, job: str) -> bool:
    return job in ledger.jobs or job in ledger.past or job in ledger.aside


def _unknown_job(job: str) -> Doubt:
    return Doubt(f"the journal does not say what '{job}' is", (job,))


def _doubt_award(ledger: LedgerView, record: Awarded) -> Doubt | None:
    if record.award in ledger.awards:
        return Doubt("the award was given before")
    if record.job in ledger.waiting:
        return None
    if record.job not in ledger.jobs:
        return _unknown_job(record.job)
    return Doubt(f"'{record.job}' was {ledger.jobs[record.job].state} when it was awarded", (record.job,))


def _unknown_award(ledger: LedgerView, award: str) -> Doubt | None:
    """Doubt for a record on an award that is not in the ledger; None if it changes nothing."""
    job = job_of(award)
    entry = ledger.jobs.get(job)
    if job in ledger.past or (entry is not None and entry.state == "finished"):
        return None  # compaction leaves such awards out
    return Doubt(f"the journal has no award '{award}'", (job,) if job else ())


def _doubt_check(ledger: LedgerView, record: Checked) -> Doubt | None:
    """Compare the jobs that changed since the last check with what they were when it was written."""
    if record.number <= ledger.checks:
        return Doubt("it repeats a line")
    wrong = {name for name in ledger.unchecked - record.jobs.keys() if name in ledger.jobs}
    for name, expected in record.jobs.items():
        if name not in ledger.past and (name not in ledger.jobs or digest(ledger, name) != expected):
            wrong.add(name)
    wrong -= {name for name in wrong if name in ledger.aside or (name in ledger.jobs and ledger.jobs[name].aside)}
    if not wrong and (record.changes, record.paused) == (ledger.number, ledger.paused):
        return None
    return Doubt("the records before do not give the state that was noted", tuple(sorted(wrong)))


def broken_parts(snapshot: LedgerSnapshot) -> dict[str, str]:
    """Return why jobs of a snapshot cannot be restored, by name."""
    awards = {award.record.award: award.record.job for award in snapshot.awards}
    jobs = {entry.spec.name: entry for entry in snapshot.jobs}
    broken = {
        name: f"its award '{e.award}' is missing" for name, e in jobs.items() if e.award and e.award not in awards
    }
    broken |= {
        name: f"it is {e.state} without an award"
        for name, e in jobs.items()
        if e.state in ("awarded", "finishing") and e.award not in snapshot.open
    }
    unknown = {job for job in awards.values() if job not in jobs} | {
        job_of(award) for award in snapshot.open if award not in awards
    }
    return broken | {name: "the journal does not say what it is" for name in unknown - {""} - broken.keys()}
