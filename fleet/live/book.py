"""Job book of a fleet: its jobs, grants, space and operator requests, as the journal of one participant records them.

An auctioneer keeps one, and so does each arm that allocates jobs with its peers. A job goes to an arm by a grant of a
quorum: the auctioneer is a quorum of one (`fleet.live.auction.auctioneer`), arms without one need a majority of the
roster (`fleet.live.consensus.grants`). The rules that make it safe (`fleet.bus.protocol.auction` and
`fleet.bus.protocol.consensus` say why):

- A record is durable before it is applied, and applied before anything is sent that relies on it.
- A job is granted to one arm at a time. From then on it counts as leased for `Timing.counted_lease_s`, with or without
  an answer; a renewal counts from the moment of the reply. Another arm gets the job only after the lease has ended here
  (`expire`), or its arm has refused, released or returned it.
- While a job is granted, no other job at one of its stations is.
- Permission to commit, that is to begin the last cycle, is durable before it is given. It stays unless the arm releases
  or returns the job; no other arm gets the job then. An arm without an auctioneer that lost its journal of awards
  reports such a job as unfinished, by its own grants or those of its peers.
- A settled job is granted to no arm, a cancelled one only to the arm that has permission to commit.
- After a crash every open grant counts as leased from the restart.
- A job that an arm may have done, by its report or history, is unfinished, also under an award that is not known here.
  So is one whose arm was restarted without the permission to commit that it was given.
- A grant without permission to commit also ends when an arm has finished the job, or, if an older copy of the journal
  has it (`fleet.live.epochs`), when an arm has permission to commit under another grant.
- An arm takes the space of a grant until a later quote or claim of the arm states that it does not. Of two plans that
  exclude each other one is granted. An arm without such a message may be anywhere.
- A silent grant is revoked when a later quote of its arm states that it takes no space: its job stays unfinished.
- Whoever frees the space of an arm also revokes its grants; if the arm is online again, it takes its space again.

A replay gives the same book, with the same numbers on its results. The ends of leases are not recorded.
"""

import logging
from bisect import insort
from collections import deque
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from msgspec.structs import asdict, replace

from fleet.bus.protocol.auction import ABANDONED, SETTLED, Admission, JobSpec, JobState, JobStatus, Offers, Result
from fleet.bus.protocol.consensus import JobOutcome
from fleet.bus.protocol.keys import HISTORY
from fleet.bus.protocol.messages import MOST_COUNT
from fleet.bus.protocol.operator import (
    ALL_ARMS,
    MAX_REQUEST_NAME,
    Cancel,
    Change,
    Clear,
    ControlRequest,
    Operation,
    Pause,
    Resume,
    Settle,
    by_whom,
)
from fleet.errors import JournalFull
from fleet.job import reason_to_give_up
from fleet.live.job_rules import (
    EXPIRED,
    MAX_OPEN_JOBS,
    NONE_RESERVED,
    SHIFT_ENDED,
    PastJobs,
    admit,
    hash_of,
    is_late,
    job_order,
    lost_jobs,
    ready_jobs,
    reason_for_silence,
    reason_to_follow,
    with_terms,
)
from fleet.live.journal import (
    ClockTick,
    CommitPermitted,
    EpochBegun,
    JobsAccepted,
    Progress,
    Released,
    SpaceCleared,
    SpaceTaken,
    Started,
    TimedState,
)
from fleet.live.records import (
    FINISHED_BY,
    NO_AWARD,
    BookRecord,
    BookSnapshot,
    ClaimNumbered,
    ContactLost,
    ContactRegained,
    CountedLease,
    Faulted,
    Grant,
    Granted,
    HistoryAdopted,
    JobEntry,
    JobSettled,
    Operations,
    Requested,
    ShiftEnded,
    cancelled_by,
    job_of,
    weight_of,
)
from fleet.live.space import ANYWHERE

_LOG = logging.getLogger(__name__)

MAX_RECENT = HISTORY
"""Latest changes and requests, published again after a restart for those who missed them: as many as were cached."""
MAX_SETTLED = 2_000
"""Finished and given-up jobs whose status is kept; older ones leave the book, and only `PastJobs` knows them."""
MAX_UNKNOWN = 4 * MAX_OPEN_JOBS
"""Jobs of which only the name is known, from peers; the first ones leave if there are more."""
MAX_ENDED = 16
"""Ended awards of one job on which a report is still expected."""
PLAIN = ("time_s", "number", "ended", "epoch", "succeeds", "operated", "roster")
"""Fields of a book that its snapshot holds as they are."""


def _outcome_hash(outcome: JobOutcome | None) -> int:
    return 0 if outcome is None else hash_of(repr((outcome.job, outcome.outcome, outcome.time_s)).encode())


@dataclass
class JobBook(TimedState[BookRecord]):
    """Jobs and grants; only `apply` changes them, and `record` writes a record before."""

    places: frozenset[str] | None = None
    """Places of the cell; None allows any name."""
    arms: tuple[str, ...] = ()
    """Arms of the cell: each may be anywhere until it says where it is."""
    name: str = field(default="", compare=False)
    """Of the participant that keeps it."""
    is_central: bool = True
    """An auctioneer keeps it: no job is granted or settled that was not accepted here. False at an arm, whose peers may
    know more."""
    jobs: dict[str, JobEntry] = field(default_factory=dict[str, JobEntry])
    """By name, in the order of submission."""
    waiting: dict[str, JobEntry] = field(default_factory=dict[str, JobEntry])
    """Those that wait, and whose description is known."""
    settled: list[tuple[float, str]] = field(default_factory=list[tuple[float, str]])
    """Time and name of those that are finished or given up, oldest first."""
    open: dict[str, Grant] = field(default_factory=dict[str, Grant])
    """Grants that have not ended, without revoked ones, by award."""
    leases: dict[str, CountedLease] = field(default_factory=dict[str, CountedLease], repr=False, compare=False)
    """Of the open grants, once the book is attached to its journal."""
    past: PastJobs = field(default_factory=PastJobs)
    """Jobs that have left."""
    left: dict[JobState, int] = field(default_factory=dict[JobState, int])
    """How many have left, by state."""
    epoch: str = ""
    """Of the journal; another one begins when the journal is lost. "" before the first start."""
    succeeds: bool = False
    """A person has requested that the epoch takes the place of another one."""
    roster: tuple[str, ...] = ()
    """All arms among which a majority was counted in this epoch; empty with an auctioneer."""
    time_s: float = 0.0
    """Fleet time, at least that of the latest record."""
    number: int = 0
    """Of the next change."""
    ended: bool = False
    recent: deque[Result] = field(default_factory=lambda: deque(maxlen=MAX_RECENT))
    operations: Operations = field(default_factory=Operations)
    operated: int = 0
    """Number of the next request of a person."""
    requested: deque[Operation] = field(default_factory=lambda: deque(maxlen=MAX_RECENT))
    """The latest ones that were carried out."""
    space: dict[str, frozenset[str]] = field(default_factory=dict[str, frozenset[str]])
    """Names of the spaces that an arm may take besides those of its open grants, by arm: ended grants leave theirs here
    until the arm states which space it takes."""
    numbers: dict[str, int] = field(default_factory=dict[str, int])
    """Number of the last claim, by arm."""
    _awaited: dict[str, dict[str, None]] = field(default_factory=dict[str, dict[str, None]], repr=False, compare=False)
    """Names of the jobs that wait for each job, settled ones included, in the order of their submission."""
    _unknown: dict[str, None] = field(default_factory=dict[str, None], repr=False, compare=False)
    """Names of the jobs without a description."""
    _in_order: list[str] | None = field(default=None, repr=False, compare=False)
    _recorded_s: float = field(default=0.0, repr=False, compare=False)
    """`time_s` by the records."""
    _outcomes: int = field(default=0, repr=False, compare=False)
    """Checksum of the outcomes."""
    _keep: Callable[..., object] = field(default=lambda *_: None, repr=False, compare=False)
    _announce: Callable[[Result | Operation], object] = field(default=lambda _: None, repr=False, compare=False)

    def __post_init__(self) -> None:
        self.space |= {arm: frozenset([ANYWHERE]) for arm in self.arms}

    # Journal

    def attach(
        self,
        keep: Callable[..., object],
        counted_until_s: float,
        announce: Callable[[Result | Operation], object] = lambda _: None,
    ) -> None:
        """Write further records to a journal.

        Args:
            keep: Writes records; returns when they are durable, or raises `JournalError` and has written none.
            counted_until_s: Real second until which the open grants count as leased.
            announce: Gets each change of a job, and each operator request.
        """
        self._keep, self._announce, self.leases = keep, announce, {}
        self.lease_open_grants(counted_until_s)

    def lease_open_grants(self, until_s: float) -> None:
        """Have the open grants without a lease count as leased until this real second."""
        for award in self.open:
            self.leases.setdefault(award, CountedLease(until_s))

    def pass_time(self, time_s: float) -> None:
        """Set the fleet time, which is that of the next records; it never goes back."""
        self.time_s = max(self.time_s, time_s)

    def record(self, *records: BookRecord) -> None:
        """Write records, then apply them.

        Raises:
            JournalError: nothing was written, and nothing has changed.
        """
        if not records:
            return
        if max(self._recorded_s, getattr(records[0], "time_s", 0.0)) < self.time_s:  # a replay needs it, too
            records = (ClockTick(self.time_s), *records)
        self._keep(*records)
        for record in records:
            for change in self.apply(record):
                self._announce(change)
            if isinstance(record, Requested | SpaceCleared):
                self._announce(self.requested[-1])
        for award in self.leases.keys() - self.open.keys():
            del self.leases[award]

    def try_to_record(self, failure: str, *records: BookRecord) -> bool:
        """Record; return whether that is durable, and log the failure if not."""
        try:
            self.record(*records)
        except JournalFull as error:
            _LOG.error("%s: %s", failure, error)
            return False
        return True

    def compact(self) -> tuple[BookSnapshot, Started]:
        """Return the records that give the same book."""
        snapshot = BookSnapshot(
            **{name: getattr(self, name) for name in PLAIN},
            jobs=tuple(entry.copied() for entry in self.jobs.values()),
            recent=tuple(self.recent),
            space={arm: tuple(sorted(spaces)) for arm, spaces in self.space.items()},
            past=self.past.packed(),
            left=dict(self.left),
            numbers=dict(self.numbers),
            names=dict(self.operations.names),
            operations=self.operations.all,
            requested=tuple(self.requested),
        )
        return snapshot, Started(self.name, self.time_s)

    # Questions

    @property
    def digest(self) -> int:
        """Equal for arms that know the same outcomes and operator requests."""
        return (self.operations.digest ^ self._outcomes) % MOST_COUNT

    @property
    def in_order(self) -> list[str]:
        """Names of the jobs with a description, by release and name."""
        if self._in_order is None:
            specs = (entry.spec for entry in self.jobs.values() if entry.spec is not None)
            self._in_order = [job.name for job in sorted(specs, key=job_order)]
        return self._in_order

    def admit(
        self,
        jobs: Sequence[JobSpec],
        time_s: float,
        later: Mapping[str, JobSpec] | None = None,
        reserved: Mapping[str, JobSpec] = NONE_RESERVED,
    ) -> tuple[Admission, ...]:
        """Return which submitted jobs can be accepted at a fleet time; changes nothing.

        Args:
            later: Jobs that will be accepted, by name.
            reserved: As of `fleet.live.job_rules.admit`.
        """
        named = [name for job in jobs for name in (job.name, *job.after)]
        entries = {name: self.jobs[name] for name in named if name in self.jobs}
        known = {name: job for name, entry in entries.items() if (job := entry.original) is not None}
        given_up = {name for name, entry in entries.items() if entry.state in ABANDONED}
        given_up |= {name for job in jobs for name in job.after if self.past.is_given_up(name)}
        return admit(
            jobs,
            {**(later or {}), **known},
            reserved=reserved,
            places=self.places,
            count=len(self.jobs) - len(self.settled),
            ended=self.ended,
            given_up=given_up,
            ended_as={name: entry.state for name, entry in entries.items() if entry.is_settled},
            past=self.past,
            time_s=time_s,
        )

    def ready(
        self,
        time_s: float,
        limit: int,
        *,
        excluded: Container[str] = (),
        rank: Callable[[str], int] = lambda job: 0,
    ) -> list[JobSpec]:
        """Return the jobs that wait for an arm, as `ready_jobs` does."""
        if self.ended:
            return []
        waiting = [entry for name, entry in self.waiting.items() if name not in excluded]
        returned_s = {entry.name: entry.returned_s for entry in waiting if entry.returns}
        specs = (entry.spec for entry in waiting if entry.spec is not None)
        return ready_jobs(specs, time_s, limit, self.busy_stations(), self.is_finished, returned_s, rank)

    def is_finished(self, name: str) -> bool:
        """Return whether a job is finished.

        One that has left is, unless it was given up; at an auctioneer also if its name is not known any more: followers
        of a job that is given up do not wait.
        """
        entry = self.jobs.get(name)
        if entry is not None:
            return entry.state == "finished"
        if not self.is_central:
            return self.past.is_finished(name)
        return not self.past.is_given_up(name)

    def is_known(self, name: str) -> bool:
        """Return whether a job was accepted here, also if it has left."""
        return name in self.past or (name in self.jobs and self.jobs[name].spec is not None)

    def is_settled(self, name: str) -> bool:
        """Return whether no arm gets a job any more."""
        return name in self.past or (name in self.jobs and self.jobs[name].is_settled)

    def expired(self, time_s: float) -> list[JobSettled]:
        """Return the outcomes of the waiting jobs whose hard due date has passed."""
        records: list[JobSettled] = []
        for entry in () if self.ended else self.waiting.values():
            if (job := entry.spec) is not None and job.due_s is not None and is_late(job, time_s):
                outcome = JobOutcome(
                    job.name, NO_AWARD, self.name or NO_AWARD, "given_up", entry.cycles, job.due_s, EXPIRED
                )
                records.append(JobSettled(outcome, time_s))
        return records

    def is_paused(self, arm: str) -> bool:
        """Return whether an arm gets no jobs."""
        return arm in self.operations.paused or ALL_ARMS in self.operations.paused

    def at_work(self) -> Mapping[str, tuple[str, bool]]:
        """Return the arm with an open grant of a job, and whether it has permission to commit, by job."""
        return {grant.record.job: (grant.record.arm, grant.may_commit) for grant in self.open.values()}

    def may_begin(self, award: str) -> bool:
        """Return whether cycles of an open grant may be begun under a lease."""
        grant = self.open[award]
        stopped = self.ended or self.operations.cancelled(grant.record.job) or self.is_paused(grant.record.arm)
        return grant.may_commit or not stopped

    def busy_stations(self) -> frozenset[str]:
        """Return the stations at which an arm may be at work; a silent arm does not block its station."""
        return frozenset(place for grant in self.open.values() if not grant.silent for place in grant.record.places)

    def taken_space(self) -> Mapping[str, frozenset[str]]:
        """Return the names of the spaces that each arm may take."""
        taken = dict(self.space)
        for grant in self.open.values():
            arm = grant.record.arm
            taken[arm] = taken.get(arm, frozenset()) | {grant.record.space}
        return taken

    def grant_of(self, award: str, job: str = "") -> Grant | None:
        """Return a grant by its award, also one that has ended; None if it is not kept.

        Args:
            job: Its job, if that is known.
        """
        entries = (self.jobs[name] for name in (job, job_of(award)) if name in self.jobs)
        return self.open.get(award) or next((e.grants[award] for e in entries if award in e.grants), None)

    def grants_of(self, arm: str) -> list[Grant]:
        """Return the grants of an arm that have not ended, also revoked ones."""
        grants = (entry.grant for entry in self.jobs.values())
        return [grant for grant in grants if grant is not None and grant.record.arm == arm]

    def unsettled(self) -> list[str]:
        """Return the names of jobs that still need an arm or a report."""
        return [name for name, entry in self.jobs.items() if entry.state not in SETTLED]

    def entries(self, names: Iterable[str] = ()) -> list[JobEntry]:
        """Return these jobs, without unknown ones; all jobs if none is named."""
        wanted = dict.fromkeys(names) or [*self.in_order, *self._unknown]
        return [
            self.jobs[name]
            for name in wanted
            if name in self.jobs and (name not in self._unknown or self.jobs[name].is_settled)
        ]

    def status(self, names: Iterable[str] = ()) -> list[JobStatus]:
        """Return the status of these jobs, without unknown ones; of all jobs if none is named."""
        return [self.status_of(entry) for entry in self.entries(names)]

    def status_of(self, entry: JobEntry) -> JobStatus:
        """Return the status of a job."""
        has = entry.grant is not None and not entry.grant.revoked and entry.state != "waiting"
        award = entry.award if (has or entry.state == "finished") and entry.award != NO_AWARD else ""
        status = JobStatus(entry.name, entry.state, entry.arm, award, entry.cycles, entry.finished_s, entry.reason)
        return replace(with_terms(status, entry.spec), accepted_s=entry.accepted_s, shift_ended=entry.shift_ended)

    # Changes

    def apply(self, record: BookRecord) -> list[Result]:
        """Apply a record that is durable, and return the changes of job states."""
        time_s = getattr(record, "time_s", self.time_s)
        self.pass_time(time_s)
        self._recorded_s = self.time_s
        by, changed = self._apply(record)
        offers = record.offers if isinstance(record, Granted) else ()
        changes = [self.note_change(self.status_of(entry), time_s, entry, by, offers) for entry in changed]
        while len(self.settled) > MAX_SETTLED:
            self._leave(self.settled[0][1])
        return changes

    def _apply(self, record: BookRecord) -> tuple[str, list[JobEntry]]:
        """Apply a record; return the person who requested it, "" for none, and the jobs whose state has changed."""
        by, changed = "", list[JobEntry]()
        match record:
            case JobsAccepted():
                by, changed = record.by, self._accept(record)
            case Granted():
                changed = self._grant(record)
            case CommitPermitted() | ContactLost() | ContactRegained():
                if (grant := self.open.get(record.award)) is not None:
                    entry = self.jobs[grant.record.job]
                    if not isinstance(record, ContactRegained):
                        entry.count(record.cycles)
                    grant.may_commit, grant.silent = True, isinstance(record, ContactLost)
                    silence = reason_for_silence(grant.record.arm) if grant.silent else ""
                    self._move(entry, "unfinished" if grant.silent else "finishing", silence)
                    changed = [entry]
            case Progress(job, cycles):
                if (entry := self._entry(job)) is not None:
                    entry.count(cycles)
            case Released():
                pauser = None if record.outcome == "refused" else self._pauser(record.job, record.award)
                by, changed = pauser or "", self._release(record, pauser)
            case JobSettled(outcome):
                returned = outcome.outcome == "returned" and not outcome.faults
                pauser = self._pauser(outcome.job, outcome.award) if returned else None
                by, changed = pauser or "", self._settle(outcome, pauser)
            case Faulted(job, faults):
                if (entry := self._entry(job)) is not None:
                    entry.faults |= faults
                    changed = self._give_up(entry)
            case HistoryAdopted():
                changed = self._adopt(record)
            case Requested(operation):
                self._number(operation)
                by, changed = operation.request.by, self._operate(operation)
            case ShiftEnded():
                self.ended = True
                changed = [self.jobs[name] for name in self.unsettled()]
                for entry in changed:
                    self._move(entry, "waiting", entry.reason)
            case SpaceTaken():
                self.space[record.arm] = frozenset(record.space)
                changed = self._lose(record.lost)
            case SpaceCleared(arm, by):
                request = ControlRequest(f"clear-{record.time_s:.3f}-{arm}"[:MAX_REQUEST_NAME], Clear(arm), by)
                self._number(Operation(self.name, record.time_s, request, epoch=self.epoch if self.is_central else ""))
                changed = self._clear(arm, by)
            case EpochBegun():
                self.epoch, self.succeeds = record.epoch, record.succeeds
                self.roster = record.roster or self.roster
            case ClaimNumbered(arm, number):
                self.numbers[arm] = max(number, self.numbers.get(arm, -1))
            case BookSnapshot():
                self._restore(record)
            case Started(name):
                self.name = name or self.name
            case ClockTick():
                pass
        return by, changed

    def _entry(self, name: str) -> JobEntry | None:
        """Return the entry of a job, a new one for an unknown name; None if it has left."""
        if (entry := self.jobs.get(name)) is None and name not in self.past:
            entry = self.jobs[name] = JobEntry(name)
            self._unknown[name] = None
            if len(self._unknown) > MAX_UNKNOWN:
                self._leave(next((each for each in self._unknown if self.jobs[each].grant is None), name))
        return entry

    def _accept(self, record: JobsAccepted) -> list[JobEntry]:
        new: list[JobEntry] = []
        for job in record.jobs:
            known = job.name in self.jobs and self.jobs[job.name].spec is not None
            if known or (entry := self._entry(job.name)) is None:
                continue
            del self._unknown[job.name]
            entry.spec, entry.by, self._in_order = self.operations.changed(job), record.by, None
            entry.submitted, entry.accepted_s = job if entry.spec != job else None, record.time_s
            if entry.state == "waiting":
                self._move(entry, "waiting", entry.reason)
            new.append(entry)
        self._note_followers(new)
        if any(entry.spec.after for entry in new if entry.spec is not None):
            self._apply_given_up()
        for entry in new:
            self._give_up(entry)
        return new

    def _grant(self, record: Granted) -> list[JobEntry]:
        if (entry := self._entry(record.job)) is None:
            return []
        if (before := entry.grant) is not None:
            self._end(before, "dropped")
        counts = {award: grant for award, grant in entry.grants.items() if grant.outcome != "refused"}
        old = [award for award, grant in counts.items() if grant.outcome and not grant.may_commit][:-MAX_ENDED]
        grant = Grant(replace(record, offers=()), record.may_commit)
        entry.grants = {award: each for award, each in counts.items() if award not in old} | {record.award: grant}
        self.open[record.award], entry.award, entry.arm = grant, record.award, record.arm
        entry.count(record.cycles)
        self._move(entry, "finishing" if record.may_commit else "awarded")
        return [entry]

    def _end(self, grant: Grant, outcome: str, *, moved: bool = True) -> None:
        """End a grant; an arm that may have moved for it takes its space until it states which space it takes."""
        grant.outcome, arm = outcome, grant.record.arm
        self.open.pop(grant.record.award, None)
        if moved:
            self.space[arm] = self.space.get(arm, frozenset()) | {grant.record.space}

    def _pauser(self, job: str, award: str) -> str | None:
        """Return who paused the arm that gives a job back, "" for nobody named; None if it has another reason to."""
        entry = self.jobs.get(job)
        grant = None if entry is None or entry.award != award else entry.grant
        if entry is None or grant is None or grant.may_commit or entry.state == "unfinished":
            return None
        paused = self.operations.paused
        return paused.get(grant.record.arm, paused.get(ALL_ARMS))

    def _release(self, record: Released, pauser: str | None) -> list[JobEntry]:
        entry = self.jobs.get(record.job)
        grant = None if entry is None else entry.grants.get(record.award)
        if entry is None or grant is None or grant.outcome:
            return []
        self._end(grant, record.outcome, moved=record.outcome != "refused")
        entry.count(record.cycles)
        if entry.award != record.award or entry.outcome is not None:
            return self._give_up(entry)
        return self._wait(entry, record.reason if pauser is None else f"Its arm was paused{by_whom(pauser)}.")

    def is_news(self, outcome: JobOutcome) -> bool:
        """Return whether an outcome tells more than what is known of the job.

        A job counts as abandoned only when no arm has it. An attempt that is over counts once.
        """
        entry = self.jobs.get(outcome.job)
        if entry is None and outcome.job in self.past:
            return outcome.outcome == "finished" and self.past.is_given_up(outcome.job)
        if outcome.outcome == "returned":
            if entry is None:
                return bool(outcome.cycles or outcome.faults)
            has = entry.grants.get(outcome.award)
            more = outcome.cycles > entry.cycles or not outcome.faults.keys() <= entry.faults.keys()
            return more or (has is not None and not has.outcome)
        if outcome.outcome == "unfinished" and outcome.award in self.operations.redone(outcome.job):
            return False
        if entry is None:
            return True
        if outcome.outcome in ABANDONED and entry.grant is not None:
            return False
        return entry.outcome is None or weight_of(outcome) > weight_of(entry.outcome)

    def _settle(self, outcome: JobOutcome, pauser: str | None = None) -> list[JobEntry]:
        """Apply the outcome of a job, or of an attempt at it."""
        news, finished = self.is_news(outcome), outcome.outcome == "finished"
        if (entry := self._entry(outcome.job)) is None:
            if finished and news:
                self.past.add(outcome.job, finished=True)
            return []
        grant = entry.grants.get(outcome.award)
        was_open = grant is not None and not grant.outcome
        if grant is not None and outcome.outcome not in ABANDONED:
            if was_open:
                self._end(grant, outcome.outcome, moved=self.is_central or not grant.revoked)
            grant.outcome = outcome.outcome
        entry.faults |= outcome.faults
        if outcome.outcome == "returned":
            entry.count(outcome.cycles)
            if entry.award != outcome.award or entry.is_settled:
                return self._give_up(entry)
            if was_open:
                entry.returns, entry.returned_s = entry.returns + 1, outcome.time_s
            why = outcome.reason if was_open or outcome.faults else entry.reason or outcome.reason
            return self._wait(entry, why if pauser is None else f"Its arm was paused{by_whom(pauser)}.")
        return self._set(entry, outcome) if news else self._give_up(entry)

    def _set(self, entry: JobEntry, outcome: JobOutcome) -> list[JobEntry]:
        """Set the outcome of a job; return what has changed."""
        before = entry.state
        self._outcomes ^= _outcome_hash(entry.outcome) ^ _outcome_hash(outcome)
        entry.outcome = outcome
        if outcome.outcome == "finished" or outcome.outcome == "unfinished":
            if (has := entry.grant) is not None:  # a later award of the same job has no purpose any more
                self._end(has, "dropped", moved=not has.revoked)
            entry.award = outcome.award
            if outcome.award != NO_AWARD or not entry.arm:
                entry.arm = outcome.arm
        if outcome.outcome == "finished":
            most = outcome.cycles if entry.spec is None else entry.spec.repetitions
            entry.cycles = max(entry.cycles, min(outcome.cycles, most))
            entry.grants = {award: grant for award, grant in entry.grants.items() if award == outcome.award}
        else:
            entry.count(outcome.cycles)
        assert outcome.outcome != "returned"
        unsure = "" if outcome.outcome != "unfinished" else "It is unknown whether its last cycle was done."
        self._move(entry, outcome.outcome, outcome.reason or unsure)
        follows = before in ABANDONED or entry.state in ABANDONED
        return [entry, *(self._follow_given_up(entry) if follows else ())]

    def _wait(self, entry: JobEntry, reason: str) -> list[JobEntry]:
        """Have a job wait again, unless it is abandoned; return what has changed."""
        if entry.spec is not None:  # the last cycle is never assumed done
            entry.cycles = min(entry.cycles, entry.spec.repetitions - 1)
        if (lost := self._reason_to_abandon(entry)) is not None:
            return self._set(entry, lost)
        self._move(entry, "waiting", reason)
        return [entry]

    def _give_up(self, entry: JobEntry) -> list[JobEntry]:
        """Abandon a job that waits if there is a reason; return what has changed."""
        lost = self._reason_to_abandon(entry) if entry.state == "waiting" else None
        return [] if lost is None else self._set(entry, lost)

    def _reason_to_abandon(self, entry: JobEntry) -> JobOutcome | None:
        """Return the outcome of a job that a person has cancelled, or in which arms have faulted too often."""
        if (cancel := self.operations.cancelled(entry.name)) is not None:
            end = (NO_AWARD, cancel.auctioneer, "cancelled", entry.cycles, cancel.time_s, cancelled_by(cancel))
            return JobOutcome(entry.name, *end)
        if reason := reason_to_give_up(entry.faults.values()):
            award = max(entry.faults)
            return JobOutcome(entry.name, award, entry.faults[award], "given_up", entry.cycles, self.time_s, reason)
        return None

    def _number(self, operation: Operation) -> None:
        """Number a request of a person, which is to be published."""
        self.requested.append(replace(operation, number=self.operated if self.is_central else 0))
        self.operated += 1

    def _operate(self, operation: Operation) -> list[JobEntry]:
        """Carry out a request of a person; return what has changed."""
        # Peers may know other requests, in which it changes something.
        self.operations.add(operation, counts=not (self.is_central and operation.note))
        action, by = operation.request.action, operation.request.by
        if isinstance(action, Pause | Resume | Clear):
            return []
        if (entry := self._entry(action.job)) is None:
            self.operations.forget(action.job)
            return []
        if isinstance(action, Change) and entry.spec is not None and entry.state not in SETTLED:
            original = entry.original or entry.spec
            if (changed := self.operations.changed(original)) != entry.spec:
                entry.submitted, entry.spec = original, changed
                return [entry]
        elif isinstance(action, Cancel) and self.operations.cancelled(entry.name) is operation:
            if entry.state in ("waiting", "given_up"):
                lost = self._reason_to_abandon(entry)
                return [] if lost is None else self._set(entry, lost)
            if entry.state in ("awarded", "finishing"):
                reason = f"{cancelled_by(operation)[:-1]}; its arm ends the cycle in progress."
                self._move(entry, entry.state, reason)
                return [entry]
        elif isinstance(action, Settle) and entry.state == "unfinished":
            if action.outcome == "redo":
                return self._redo(entry)
            cycles = entry.cycles if entry.spec is None else entry.spec.repetitions
            award, arm = entry.award or NO_AWARD, entry.arm
            end = (arm or self.name or NO_AWARD, "finished", cycles, operation.time_s, f"Settled as done{by_whom(by)}.")
            changes = self._set(entry, JobOutcome(entry.name, award, *end))
            entry.arm = arm
            return changes
        return []

    def _redo(self, entry: JobEntry) -> list[JobEntry]:
        """Have a job wait again if a person has called its last cycle not done, and no arm may still do it."""
        redo, grant = self.operations.latest.get(("redo", entry.name)), entry.grant
        if redo is None:
            return []
        if grant is not None and grant.revoked and grant.record.award in redo.awards:
            grant.outcome = "dropped"
        if entry.outcome is not None and entry.outcome.outcome == "unfinished" and entry.outcome.award in redo.awards:
            self._outcomes ^= _outcome_hash(entry.outcome)
            entry.outcome = None
        if entry.state != "unfinished" or entry.outcome is not None or entry.grant is not None:
            return []
        entry.award = ""  # a late report on it that is unsure is settled, too
        return self._wait(entry, f"To be redone{by_whom(redo.request.by)}.")

    def _clear(self, arm: str, by: str) -> list[JobEntry]:
        """Free the space of an arm, and revoke its grants."""
        cleared = f"The space of '{arm}' was cleared{by_whom(by)}"
        self.space[arm], changed = frozenset(), list[JobEntry]()
        for entry in list(self.jobs.values()):
            its = [grant for grant in entry.grants.values() if grant.record.arm == arm]
            for grant in its:
                grant.revoked = True
            if (grant := entry.grant) is not None and grant in its:
                self.open.pop(grant.record.award, None)
                reason = f"{cleared}; it was about to finish it."
                if grant.may_commit:
                    grant.silent = True
                    self._move(entry, "unfinished", reason)
                    changed.append(entry)
                else:
                    grant.outcome = "dropped"
                    changed += self._wait(entry, f"{cleared}.")
            changed += self._redo(entry) if its else []
        return changed

    def _lose(self, awards: Iterable[str]) -> list[JobEntry]:
        """Revoke silent grants that their arm, at home, no longer has: the jobs stay unfinished until settled."""
        changed: list[JobEntry] = []
        for award in awards:
            if (grant := self.open.pop(award, None)) is not None:
                grant.revoked, entry = True, self.jobs[grant.record.job]
                reason = f"'{grant.record.arm}' is at home and no longer has it; its last cycle may have been done."
                self._move(entry, "unfinished", reason)
                changed.append(entry)
        return changed

    def _adopt(self, record: HistoryAdopted) -> list[JobEntry]:
        """Apply what an arm has finished; return the open and unfinished jobs that need no arm any more."""
        changed: list[JobEntry] = []
        for job in record.finished:
            known = job.name in self.jobs
            self._accept(JobsAccepted((job,), f"adopted from {record.arm}", record.time_s))
            entry = self.jobs.get(job.name)
            if entry is None or entry.state not in ("waiting", "awarded", "unfinished"):
                continue
            reason = FINISHED_BY.format(record.arm)
            end = (NO_AWARD, record.arm, "finished", job.repetitions, record.time_s, reason)
            entry.arm = record.arm
            changes = self._set(entry, JobOutcome(job.name, *end))
            changed += changes if known else []
        return changed

    def _leave(self, name: str) -> None:
        """Drop a job, except for its name and outcome."""
        entry = self.jobs.pop(name)
        self._unsettle(entry)
        self.waiting.pop(name, None)
        self._unknown.pop(name, None)
        for before in () if entry.spec is None else entry.spec.after:
            if (followers := self._awaited.get(before)) is not None:
                followers.pop(name, None)
                if not followers:
                    del self._awaited[before]
        if entry.is_settled:
            self.past.add(entry.original or name, finished=entry.state == "finished")
            self.left[entry.state] = self.left.get(entry.state, 0) + 1
        self._outcomes ^= _outcome_hash(entry.outcome)
        self.operations.forget(name)
        self._in_order = None

    def _unsettle(self, entry: JobEntry) -> None:
        if entry.settled_s is not None:
            self.settled.remove((entry.settled_s, entry.name))
            entry.settled_s = None

    def _move(self, entry: JobEntry, state: JobState, reason: str = "") -> None:
        """Change the state of a job."""
        entry.shift_ended = state == "waiting" and self.ended
        if entry.shift_ended:
            state, reason = "unfinished", (entry.reason if entry.state == "unfinished" else reason) or SHIFT_ENDED
        self.waiting.pop(entry.name, None)
        self._unsettle(entry)
        entry.state, entry.reason = state, reason
        if state == "waiting" and entry.spec is not None:
            self.waiting[entry.name] = entry
        elif state in ("finished", *ABANDONED):
            entry.settled_s = self.time_s if entry.outcome is None else entry.outcome.time_s
            insort(self.settled, (entry.settled_s, entry.name))

    def _note_followers(self, entries: Iterable[JobEntry]) -> None:
        """Note which jobs these wait for."""
        for entry in entries:
            for before in () if entry.spec is None else entry.spec.after:
                self._awaited.setdefault(before, {})[entry.name] = None

    def _follow_given_up(self, entry: JobEntry) -> list[JobEntry]:
        """Apply a change of this job to jobs that wait for it; return what has changed."""
        if entry.name not in self._awaited:
            return []
        if entry.state not in ABANDONED:
            return self._apply_given_up()
        changed, lost = list[JobEntry](), [entry.name]
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
        abandoned = [entry for _, name in self.settled if (entry := self.jobs[name]).state in ABANDONED]
        causes = {entry.name for entry in abandoned if entry.outcome is not None}
        followers = [entry for entry in abandoned if entry.outcome is None]
        open_jobs = {entry.name: entry for entry in (*self.waiting.values(), *followers)}
        specs = [entry.spec for entry in open_jobs.values() if entry.spec is not None]
        causes |= {name for job in specs for name in job.after if self.past.is_given_up(name)}
        lost = lost_jobs(specs, causes) if causes else {}
        changed = list[JobEntry]()
        for name, entry in open_jobs.items():
            state = "given_up" if name in lost else "waiting"
            if entry.state != state:
                self._move(entry, state, lost.get(name, ""))
                changed.append(entry)
        return changed

    def note_change(
        self, status: JobStatus, time_s: float, entry: JobEntry | None, by: str = "", offers: Offers = ()
    ) -> Result:
        """Number a change of a job, and return it."""
        cancel = None if entry is None else self.operations.cancelled(entry.name)
        change = Result(
            self.name or NO_AWARD,
            time_s=time_s,
            status=status,
            number=self.number,
            by=cancel.request.by if cancel is not None and status.state == "cancelled" else by,
            epoch=self.epoch,
            offers=offers,
        )
        if entry is not None and (grant := entry.grants.get(entry.award)) is not None:
            award = asdict(grant.record)
            names = ("auction", "difficulty", "p_saturation", "peak_c")
            change = replace(change, **{name: award[name] for name in names})
        self.number += 1
        self.recent.append(change)
        return change

    def _restore(self, snapshot: BookSnapshot) -> None:
        for name in PLAIN:
            setattr(self, name, getattr(snapshot, name))
        self.numbers = dict(snapshot.numbers)
        self.jobs = {entry.name: entry.copied() for entry in snapshot.jobs}
        entries = self.jobs.values()
        self.waiting = {name: entry for name, entry in self.jobs.items() if entry.state == "waiting" and entry.spec}
        self.settled = sorted((entry.settled_s, entry.name) for entry in entries if entry.settled_s is not None)
        self._unknown = dict.fromkeys(entry.name for entry in entries if entry.spec is None)
        grants = (entry.grant for entry in entries)
        self.open = {grant.record.award: grant for grant in grants if grant is not None and not grant.revoked}
        self._in_order, self._awaited, self._outcomes = None, {}, 0
        self._note_followers(entries)
        for entry in entries:
            self._outcomes ^= _outcome_hash(entry.outcome)
        self.past, self.left = PastJobs(snapshot.past, self.past.limit), dict(snapshot.left)
        self.recent = deque(snapshot.recent, maxlen=MAX_RECENT)
        self.space |= {arm: frozenset(spaces) for arm, spaces in snapshot.space.items()}
        self.operations = Operations()
        for operation in snapshot.operations:
            self.operations.add(operation)
        self.operations.names = dict(snapshot.names)
        self.requested = deque(snapshot.requested, maxlen=MAX_RECENT)
