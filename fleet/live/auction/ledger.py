"""Jobs and awards of an auctioneer, and what can be asked about them; `fleet.live.auction.ledger` changes them.

State of a ledger: how a snapshot holds it, which records contradict it, and jobs that are quarantined.

A journal can be undamaged and yet wrong: written by a version with an error or other bounds, or edited by hand. What
contradicts is quarantined with its jobs, which no arm does until a person has settled them; the rest goes on. Each line
begins with what the line before has changed (`Checked`), so a missing record is noticed, too.

Ledger of an auctioneer: journal records of its jobs and awards, and the state that follows from them alone.

A record is on disk before it is applied, so a replay gives the same ledger, with the same numbers on its results. The
ends of leases are not recorded: after a restart every open award counts as leased from then on.
"""

import logging
from collections import deque
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Self
from zlib import crc32

import msgspec
from msgspec.structs import asdict, replace

from fleet.bus.protocol.auction import ABANDONED, SETTLED, Admission, JobSpec, JobState, JobStatus, Offers
from fleet.bus.protocol.keys import HISTORY
from fleet.bus.protocol.messages import encode
from fleet.bus.protocol.operator import ALL_ARMS, Cancel, Change, ControlRequest, Pause, Resume, Settle
from fleet.job import reason_to_give_up
from fleet.live.auction.job_rules import (
    EXPIRED,
    SHIFT_ENDED,
    admit,
    changed_spec,
    is_late,
    job_order,
    lost_jobs,
    ready_jobs,
    reason_for_silence,
    reason_to_follow,
    with_terms,
)
from fleet.live.auction.records import (
    AuctionRecord,
    Awarded,
    AwardState,
    Checked,
    ContactLost,
    ContactRegained,
    Expired,
    HistoryAdopted,
    JobChange,
    JobEntry,
    JobsQuarantined,
    LedgerSnapshot,
    Operated,
    PastJobs,
    ShiftEnded,
    content_hash,
    job_of,
)
from fleet.live.journal import (
    ClockTick,
    Closed,
    CommitPermitted,
    EpochBegun,
    JobsAccepted,
    Quarantine,
    SpaceCleared,
    SpaceTaken,
    Started,
    TimedState,
)
from fleet.live.space import ANYWHERE

MAX_RECENT = HISTORY
"""Latest changes and requests, published again after a restart for those who missed them: as many as were cached."""


def reason_of_aside(reason: str) -> str:
    """Return why a job is unfinished that is quarantined."""
    return f"Quarantined, because the journal is wrong about it: {reason}. Settle it as done or redo."


@dataclass
class LedgerView:
    """Jobs and awards, and what can be asked about them."""

    places: frozenset[str] | None = None
    """Places of the cell; None allows any name."""
    arms: tuple[str, ...] = ()
    """Arms of the cell: each may be anywhere until it says where it is."""
    jobs: dict[str, JobEntry] = field(default_factory=dict[str, JobEntry])
    """By name, in the order of submission."""
    waiting: dict[str, JobEntry] = field(default_factory=dict[str, JobEntry])
    """Those that wait."""
    settled: dict[str, None] = field(default_factory=dict[str, None])
    """Names of those that are finished or given up, in that order."""
    past: PastJobs = field(default_factory=PastJobs)
    """Jobs that have left."""
    left: dict[JobState, int] = field(default_factory=dict[JobState, int])
    """How many have left, by state."""
    epoch: str = ""
    """Of the journal; another one begins when the journal is lost. "" before the first start."""
    succeeds: bool = False
    """A person has requested that the epoch takes the place of another one."""
    awards: dict[str, AwardState] = field(default_factory=dict[str, AwardState])
    time_s: float = 0.0
    """Latest time of all records."""
    number: int = 0
    """Of the next change."""
    ended: bool = False
    recent: deque[JobChange] = field(default_factory=lambda: deque(maxlen=MAX_RECENT))
    operated: int = 0
    """Number of the next request of a person."""
    operations: deque[Operated] = field(default_factory=lambda: deque(maxlen=MAX_RECENT))
    """The latest ones that were carried out."""
    open: dict[str, AwardState] = field(default_factory=dict[str, AwardState])
    """Awards that are not closed, by name."""
    _awards_of: dict[str, list[str]] = field(default_factory=dict[str, list[str]], repr=False, compare=False)
    """Names of the awards of each job."""
    _awaited: dict[str, dict[str, None]] = field(default_factory=dict[str, dict[str, None]], repr=False, compare=False)
    """Names of the jobs that wait for each job, settled ones included, in the order of their submission."""
    space: dict[str, frozenset[str]] = field(default_factory=dict[str, frozenset[str]])
    """Names of the spaces that an arm may take besides those of its open awards, by arm: closed awards leave theirs
    here until the arm says that it is at home."""

    paused: dict[str, str] = field(default_factory=dict[str, str])
    """Who paused an arm, by arm; "*" for all arms."""
    requests: dict[str, int] = field(default_factory=dict[str, int])
    """Hashes of the last requests of people that were carried out, by name, oldest first; 0 for unknown."""

    aside: dict[str, str] = field(default_factory=dict[str, str])
    """Why jobs are quarantined of which only the name is known, by name."""
    checks: int = 0
    """Number of the last `Checked` record."""
    unchecked: set[str] = field(default_factory=set[str], repr=False, compare=False)
    """Names of the jobs that have changed since."""

    def admit(self, jobs: Sequence[JobSpec]) -> tuple[Admission, ...]:
        """Return which submitted jobs can be accepted; changes nothing."""
        named = {name for job in jobs for name in (job.name, *job.after) if name in self.jobs}
        known = {name: self.jobs[name].original for name in named}
        given_up = {name for name in named if self.jobs[name].state in ABANDONED}
        given_up |= {name for job in jobs for name in job.after if self.past.is_given_up(name)}
        count = len(self.jobs) - len(self.settled)
        return admit(
            jobs,
            known,
            places=self.places,
            count=count,
            ended=self.ended,
            given_up=given_up,
            past=self.past,
            aside=self.aside,
        )

    def ready(self, time_s: float, limit: int, *, excluded: Container[str] = ()) -> list[JobSpec]:
        """Return the jobs that wait for an arm, as `ready_jobs` does."""
        if self.ended:
            return []
        waiting = [entry for name, entry in self.waiting.items() if name not in excluded]
        returned_s = {entry.spec.name: entry.returned_s for entry in waiting if entry.returns}
        specs = (entry.spec for entry in waiting)
        return ready_jobs(specs, time_s, limit, self.busy_stations(), self.is_finished, returned_s)

    def is_finished(self, name: str) -> bool:
        """Return whether a job is finished.

        One that has left is, unless it was given up, also if its name is not known any more: followers of a job that is
        given up do not wait.
        """
        entry = self.jobs.get(name)
        if entry is None:
            return name not in self.aside and not self.past.is_given_up(name)
        return entry.state == "finished"

    def expired(self, time_s: float) -> list[Expired]:
        """Return the waiting jobs whose hard due date has passed."""
        entries = () if self.ended else self.waiting.values()
        return [Expired(entry.spec.name, time_s) for entry in entries if is_late(entry.spec, time_s)]

    def is_paused(self, arm: str) -> bool:
        """Return whether an arm gets no jobs."""
        return arm in self.paused or ALL_ARMS in self.paused

    def at_work(self) -> Mapping[str, tuple[str, bool]]:
        """Return the arm with an open award of a job, and whether it has permission to commit, by job."""
        return {award.record.job: (award.record.arm, award.may_commit) for award in self.open.values()}

    def pauser_of(self, arm: str) -> str | None:
        """Return who paused an arm; None if it is not paused."""
        return self.paused.get(arm, self.paused.get(ALL_ARMS))

    def may_begin(self, award: str) -> bool:
        """Return whether cycles of an open award may be begun under a lease."""
        state = self.open[award]
        cancelled = self.jobs[state.record.job].cancelled
        return state.may_commit or not (self.ended or cancelled or self.is_paused(state.record.arm))

    def busy_stations(self) -> frozenset[str]:
        """Return the stations at which an arm may be at work; a silent arm does not block its station."""
        active = (award.record.job for award in self.open.values() if not award.silent)
        return frozenset(place for job in active for place in self.jobs[job].spec.stations)

    def taken_space(self) -> Mapping[str, frozenset[str]]:
        """Return the names of the spaces that each arm may take."""
        taken = dict(self.space)
        for award in self.open.values():
            arm = award.record.arm
            taken[arm] = taken.get(arm, frozenset()) | {award.record.space}
        return taken

    def space_of(self, awards: Iterable[str], arm: str) -> set[str]:
        """Return the names of the spaces of an arm's awards; unknown awards have none."""
        records = (self.awards[name].record for name in awards if name in self.awards)
        return {record.space for record in records if record.arm == arm}

    def closed_space(self) -> Mapping[str, frozenset[str]]:
        """Return the names of the spaces that each arm may take for closed awards alone."""
        still_open: dict[str, set[str]] = {}
        for award in self.open.values():
            still_open.setdefault(award.record.arm, set()).add(award.record.space)
        return {arm: names - still_open.get(arm, set()) for arm, names in self.space.items()}

    def unsettled(self) -> list[str]:
        """Return the names of jobs that still need an arm or a report."""
        return [name for name, entry in self.jobs.items() if entry.state not in SETTLED]

    def status(self, names: Iterable[str] = ()) -> list[JobStatus]:
        """Return the status of these jobs, without unknown ones; of all jobs if none is named."""
        in_order = [*sorted(self.jobs, key=lambda name: job_order(self.jobs[name].spec)), *self.aside]
        wanted = dict.fromkeys(names) or in_order
        return [
            self.status_of(self.jobs[name])
            if name in self.jobs
            else JobStatus(name, "unfinished", reason=reason_of_aside(self.aside[name]))
            for name in wanted
            if name in self.jobs or name in self.aside
        ]

    def status_of(self, entry: JobEntry) -> JobStatus:
        """Return the status of a job."""
        assigned = entry.state in ("awarded", "finishing", "finished") or (
            entry.state == "unfinished" and entry.award in self.open
        )
        last, spec = self.awards.get(entry.award), entry.spec
        arm, award = entry.arm if last is None else last.record.arm, entry.award if assigned else ""
        done = (entry.cycles, entry.finished_s, entry.reason)
        return with_terms(JobStatus(spec.name, entry.state, arm, award, *done), spec)


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

    def _quarantine(self, reasons: Mapping[str, str]) -> None:
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
            self._quarantine(broken)

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

    def replay(self, records: Iterable[AuctionRecord], quarantine: Quarantine | None = None) -> Self:
        """Apply records, oldest first, and return the ledger.

        Records that contradict those before are not applied, and their jobs are quarantined.

        Args:
            quarantine: Gets each of these records, with the reason; None: it is logged.
        """
        before, doubts = set(self._aside_jobs()), 0
        for record in records:
            if (found := doubt(self, record)) is None:
                self.apply(record)
                continue
            doubts += 1
            _LOG.error("A record of the journal is wrong, %s: %s", found.reason, record)
            if quarantine is not None:
                quarantine(encode(record), found.reason)
            self._quarantine(dict.fromkeys(found.jobs, found.reason))
            if isinstance(record, Checked):
                self._apply_check(record)
        aside = [name for name in self._aside_jobs() if name not in before]
        if doubts or aside:  # the numbers of the last changes are uncertain
            self.recent.clear()
            self.number += NUMBERS_SKIPPED
        for name in aside:
            self._change(self.status((name,))[0], self.time_s, "", self.jobs.get(name))
        return self

    def apply(self, record: AuctionRecord) -> list[JobChange]:
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
            case JobsQuarantined():
                self._quarantine(record.jobs)
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
        """Carry out a checked request of a person; return what has changed."""
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
            case Cancel(name) | Settle(name) | Change(name):
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
        if isinstance(action, Change) and before not in SETTLED:
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

    def _change(
        self, status: JobStatus, time_s: float, by: str, entry: JobEntry | None, offers: Offers = ()
    ) -> JobChange:
        change = JobChange(self.number, time_s, status, by=by, offers=offers)
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
