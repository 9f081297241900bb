"""Ledger of an auctioneer: journal records of its jobs and awards, and the state that follows from them alone.

A record is on disk before it is applied, so a replay gives the same ledger, with the same numbers on its results. The
ends of leases are not recorded: after a restart every open award counts as leased from then on.
"""

from collections import deque
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import msgspec
from msgspec.structs import asdict, replace

from fleet.bus.protocol.auction import SETTLED, Admission, JobSpec, JobState, JobStatus
from fleet.job import reason_to_give_up
from fleet.live.auction.job_rules import (
    EXPIRED,
    SHIFT_ENDED,
    admit,
    is_late,
    job_order,
    lost_jobs,
    ready_jobs,
    reason_for_silence,
)
from fleet.live.journal import TimedState
from fleet.live.journal_records import (
    ClockTick,
    Closed,
    CommitPermitted,
    JobsAccepted,
    SpaceCleared,
    SpaceTaken,
    Started,
)
from fleet.live.space import ANYWHERE

MAX_RECENT = 64
"""Latest changes, published again after a restart for those who missed them."""


class Awarded(msgspec.Struct, frozen=True, tag="awarded"):
    """A job is awarded to an arm, which may have a lease on it from now on."""

    award: str
    auction: str
    job: str
    arm: str
    quote: str
    cycles: int
    """Done by other arms before."""
    time_s: float
    difficulty: float | None = None
    p_saturation: float | None = None
    peak_c: float | None = None
    space: str = ANYWHERE
    """Name of the space of its plan."""
    plan: int = 0
    """Number of the plan in the quote."""


class ContactLost(msgspec.Struct, frozen=True, tag="contact_lost"):
    """The lease of an arm with permission to commit has ended: it is unknown whether the job is done."""

    award: str
    time_s: float


class ContactRegained(msgspec.Struct, frozen=True, tag="contact_regained"):
    """The arm renews its lease again, and still has the job."""

    award: str
    time_s: float


class Expired(msgspec.Struct, frozen=True, tag="expired"):
    """A waiting job is given up: its hard due date has passed."""

    job: str
    time_s: float


class ShiftEnded(msgspec.Struct, frozen=True, tag="shift_ended"):
    """The fleet's shift is over; open jobs stay unfinished."""

    time_s: float


class Change(msgspec.Struct, frozen=True):
    """A job's state has changed; fields as in `fleet.bus.protocol.auction.Result`."""

    number: int
    time_s: float
    status: JobStatus
    auction: str = ""
    difficulty: float | None = None
    p_saturation: float | None = None
    peak_c: float | None = None


class JobEntry(msgspec.Struct):
    """State of one job."""

    spec: JobSpec
    by: str
    state: JobState = "waiting"
    award: str = ""
    """The open one, or the last one."""
    cycles: int = 0
    finished_s: float | None = None
    reason: str = ""
    returns: int = 0
    """How many times an arm returned it."""
    returned_s: float = 0.0
    """Fleet time of the last return."""
    faults: tuple[str, ...] = ()
    """The arm of each fault in this job."""
    expired: bool = False
    """It waited when its hard due date passed."""


class AwardState(msgspec.Struct):
    """State of one award."""

    record: Awarded
    may_commit: bool = False
    silent: bool = False
    """The arm has permission to commit, and has not renewed its lease."""
    outcome: str = ""


class LedgerSnapshot(msgspec.Struct, frozen=True, tag="ledger_snapshot"):
    """The whole ledger, in place of the records before."""

    time_s: float
    number: int
    """Of the next change."""
    ended: bool
    jobs: tuple[JobEntry, ...]
    awards: tuple[AwardState, ...]
    """Awards on which a report could still change something."""
    open: tuple[str, ...]
    """Names of open awards."""
    recent: tuple[Change, ...]
    space: dict[str, tuple[str, ...]] = {}
    """As in `Ledger`."""


AwardRecord = Awarded | CommitPermitted | ContactLost | ContactRegained | Closed
AuctionRecord = (
    Started | ClockTick | JobsAccepted | AwardRecord | SpaceTaken | SpaceCleared | Expired | ShiftEnded | LedgerSnapshot
)


@dataclass
class Ledger(TimedState[AuctionRecord]):
    """Jobs and awards; only `apply` changes it."""

    places: frozenset[str] | None = None
    """Places of the cell; None allows any name."""
    arms: tuple[str, ...] = ()
    """Arms of the cell: each may be anywhere until it says where it is."""
    jobs: dict[str, JobEntry] = field(default_factory=dict[str, JobEntry])
    """By release and name."""
    awards: dict[str, AwardState] = field(default_factory=dict[str, AwardState])
    time_s: float = 0.0
    """Latest time of all records."""
    number: int = 0
    """Of the next change."""
    ended: bool = False
    recent: deque[Change] = field(default_factory=lambda: deque(maxlen=MAX_RECENT))
    open: dict[str, AwardState] = field(default_factory=dict[str, AwardState])
    """Awards that are not closed, by name."""
    space: dict[str, frozenset[str]] = field(default_factory=dict[str, frozenset[str]])
    """Names of the spaces that an arm may take besides those of its open awards, by arm: closed awards leave theirs
    here until the arm says that it is at home."""

    def __post_init__(self) -> None:
        self.space |= {arm: frozenset([ANYWHERE]) for arm in self.arms}

    def admit(self, jobs: Sequence[JobSpec]) -> tuple[Admission, ...]:
        """Return which submitted jobs can be accepted; changes nothing."""
        known = {name: entry.spec for name, entry in self.jobs.items()}
        given_up = {name for name, entry in self.jobs.items() if entry.state == "given_up"}
        return admit(jobs, known, places=self.places, ended=self.ended, given_up=given_up)

    def ready(self, time_s: float, limit: int, *, excluded: Container[str] = ()) -> list[JobSpec]:
        """Return the jobs that wait for an arm, as `ready_jobs` does."""
        if self.ended:
            return []
        waiting = [e for name, e in self.jobs.items() if name not in excluded and e.state == "waiting"]
        returned_s = {entry.spec.name: entry.returned_s for entry in waiting}
        specs, busy = (entry.spec for entry in waiting), self.busy_stations()
        return ready_jobs(specs, time_s, limit, busy, lambda name: self.jobs[name].state == "finished", returned_s)

    def expired(self, time_s: float) -> list[Expired]:
        """Return the waiting jobs whose hard due date has passed."""
        entries = () if self.ended else self.jobs.values()
        late = (entry.spec.name for entry in entries if entry.state == "waiting" and is_late(entry.spec, time_s))
        return [Expired(name, time_s) for name in late]

    def busy_stations(self) -> frozenset[str]:
        """Return the stations at which an arm may be at work; a silent arm does not block its station."""
        active = (award.record.job for award in self.open.values() if not award.silent)
        return frozenset(place for job in active for place in self.jobs[job].spec.places)

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
        wanted = dict.fromkeys(names) or self.jobs
        return [self._status(self.jobs[name]) for name in wanted if name in self.jobs]

    def compact(self) -> tuple[LedgerSnapshot]:
        """Return one record that gives the same ledger, without awards on which a report would change nothing."""
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
            awards=tuple(map(replace, kept)),
            open=tuple(self.open),
            recent=tuple(self.recent),
            space={arm: tuple(sorted(spaces)) for arm, spaces in self.space.items()},
        )
        return (snapshot,)

    def apply(self, record: AuctionRecord) -> list[Change]:
        """Apply a record that is on disk, and return the changes of job states."""
        changed: list[JobEntry] = []
        match record:
            case JobsAccepted():
                changed = [JobEntry(job, record.by) for job in record.jobs if job.name not in self.jobs]
                self._set_jobs([*self.jobs.values(), *changed])
                self._follow_given_up()
            case Awarded():
                entry = self.jobs[record.job]
                self.awards[record.award] = self.open[record.award] = AwardState(record)
                entry.state, entry.award, entry.reason = "awarded", record.award, ""
                changed = [entry]
            case CommitPermitted() | ContactLost() | ContactRegained():
                award, entry = self.awards[record.award], self._entry(record.award)
                award.may_commit, award.silent = True, isinstance(record, ContactLost)
                entry.state, entry.reason = "finishing", ""
                if award.silent:
                    entry.state, entry.reason = "unfinished", reason_for_silence(award.record.arm)
                changed = [entry]
            case Closed():
                changed = self._close(record)
                changed += [entry for entry in self._follow_given_up() if entry not in changed]
            case Expired():
                entry = self.jobs[record.job]
                entry.state, entry.reason, entry.expired = "given_up", EXPIRED, True
                changed = [entry, *self._follow_given_up()]
            case SpaceTaken():
                self.space[record.arm] = frozenset(record.space)
            case SpaceCleared():
                self.space[record.arm] = frozenset()
            case ShiftEnded():
                self.ended = True
                changed = [self.jobs[name] for name in self.unsettled()]
                for entry in changed:
                    entry.state, entry.reason = "unfinished", entry.reason or SHIFT_ENDED
            case LedgerSnapshot():
                self._restore(record)
            case Started() | ClockTick():
                pass
        self.time_s = max(self.time_s, record.time_s)
        return [self._change(entry, record.time_s) for entry in changed]

    # Inside

    def _set_jobs(self, entries: Iterable[JobEntry]) -> None:
        self.jobs = {entry.spec.name: entry for entry in sorted(entries, key=lambda entry: job_order(entry.spec))}

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
            entry.state, entry.award, entry.reason, entry.finished_s = "finished", record.award, "", record.time_s
        elif entry.award != record.award:  # the job was awarded again since
            return [entry] if self._give_up(entry) else []
        elif record.unsure or self.ended:
            entry.state, entry.reason = "unfinished", record.reason or "It is unknown whether its last cycle was done."
        else:
            entry.state, entry.reason = "waiting", record.reason
            if record.outcome == "returned" and reopened:
                entry.returns, entry.returned_s = entry.returns + 1, record.time_s
            entry.cycles = min(entry.cycles, entry.spec.repetitions - 1)  # the last cycle is never assumed done
            self._give_up(entry)
        return [entry]

    @staticmethod
    def _give_up(entry: JobEntry) -> bool:
        """Give a waiting job up if arms have faulted in it too often; return whether it is given up now."""
        reason = reason_to_give_up(entry.faults)
        if entry.state != "waiting" or not reason:
            return False
        entry.state, entry.reason = "given_up", reason
        return True

    def _follow_given_up(self) -> list[JobEntry]:
        """Give up jobs that wait for one that is given up; return what has changed.

        They wait again if that one was finished after all.
        """
        if not (given_up := [entry for entry in self.jobs.values() if entry.state == "given_up"]):
            return []
        causes = {entry.spec.name for entry in given_up if entry.expired or reason_to_give_up(entry.faults)}
        lost = lost_jobs([entry.spec for entry in self.jobs.values()], causes)
        changed = list[JobEntry]()
        for name, entry in self.jobs.items():
            state = "given_up" if name in causes or name in lost else "waiting"
            if entry.state in ("waiting", "given_up") and entry.state != state:
                entry.state, entry.reason = state, lost.get(name, "")
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

    def _restore(self, snapshot: LedgerSnapshot) -> None:
        self.number, self.ended = snapshot.number, snapshot.ended
        self._set_jobs(map(replace, snapshot.jobs))
        self.awards = {award.record.award: replace(award) for award in snapshot.awards}
        self.open = {name: self.awards[name] for name in snapshot.open}
        self.recent = deque(snapshot.recent, maxlen=MAX_RECENT)
        self.space |= {arm: frozenset(spaces) for arm, spaces in snapshot.space.items()}

    def _may_count(self, award: AwardState) -> bool:
        """Whether a report on a closed award could change the state of its job."""
        return award.outcome != "refused" and self.jobs[award.record.job].state != "finished"

    def _entry(self, award: str) -> JobEntry:
        return self.jobs[self.awards[award].record.job]

    def _status(self, entry: JobEntry) -> JobStatus:
        assigned = entry.state in ("awarded", "finishing", "finished") or (
            entry.state == "unfinished" and entry.award in self.open
        )
        award = entry.award if assigned else ""
        arm = self.awards[award].record.arm if assigned else ""
        return JobStatus(entry.spec.name, entry.state, arm, award, entry.cycles, entry.finished_s, entry.reason)

    def _change(self, entry: JobEntry, time_s: float) -> Change:
        change = Change(self.number, time_s, self._status(entry))
        if entry.award:
            award = asdict(self.awards[entry.award].record)
            change = replace(
                change, **{name: award[name] for name in ("auction", "difficulty", "p_saturation", "peak_c")}
            )
        self.number += 1
        self.recent.append(change)
        return change
