"""Jobs and awards of an auctioneer, and what can be asked about them; `fleet.live.auction.ledger` changes them."""

from collections import deque
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from fleet.bus.protocol.auction import ABANDONED, SETTLED, Admission, JobSpec, JobState, JobStatus
from fleet.bus.protocol.operator import ALL_ARMS
from fleet.bus.protocol.registry import HISTORY
from fleet.live.auction.job_rules import admit, is_late, job_order, ready_jobs, with_terms
from fleet.live.auction.past_jobs import PastJobs
from fleet.live.auction.records import AwardState, Change, Expired, JobEntry, Operated

MAX_RECENT = HISTORY
"""Latest changes and requests, published again after a restart for those who missed them: as many as were cached."""


def reason_of_aside(reason: str) -> str:
    """Return why a job is unfinished that is put aside."""
    return f"Put aside, because the journal is wrong about it: {reason}. Settle it as done or redo."


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
    recent: deque[Change] = field(default_factory=lambda: deque(maxlen=MAX_RECENT))
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
    """Why jobs are put aside of which only the name is known, by name."""
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
