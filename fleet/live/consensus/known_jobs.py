"""Jobs that an arm without an auctioneer knows, and where they stand."""

from collections.abc import Iterable, Mapping, Set

from msgspec.structs import replace

from fleet.bus.protocol.auction import NOT_PLANNED, JobSpec, JobStatus
from fleet.bus.protocol.consensus import Bid
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import ALL_ARMS
from fleet.live.auction.job_rules import EXPIRED, SHIFT_ENDED, is_late, job_order, lost_jobs, ready_jobs, with_terms
from fleet.live.auction.ledger import MAX_SETTLED
from fleet.live.auction.round import no_arm_can
from fleet.live.consensus.control import KnownJob
from fleet.live.consensus.granter import Granter
from fleet.live.consensus.register import MAX_NOTES


class KnownJobs:
    """All jobs that an arm knows.

    Attributes:
        submitted: Jobs as they were submitted, by release and name.
        current: The same jobs with the changes that people have requested.
        ended: The shift is over.
    """

    def __init__(self, granter: Granter) -> None:
        """Start without jobs; `granter` knows the grants and outcomes."""
        self.submitted: dict[str, JobSpec] = {}
        self.current: dict[str, JobSpec] = {}
        self.ended = False
        self._granter, self._register = granter, granter.register
        self._refusals: dict[str, dict[str, str]] = {}
        """Why arms cannot do a job, by arm, by job."""

    def add(self, jobs: Iterable[JobSpec]) -> None:
        """Add jobs that are not known yet."""
        new = {job.name: job for job in jobs if job.name not in self.submitted and job.name not in self._register.past}
        if new:
            self.submitted = {job.name: job for job in sorted((self.submitted | new).values(), key=job_order)}
            self.apply_changes()

    def forget(self, real_s: float, time_s: float) -> None:
        """Drop the jobs that have left, and have those leave that are given up without a fault, if there are many.

        Raises:
            JournalError: they are not on disk, and stay.
        """
        if len(self.current) > 2 * MAX_SETTLED:
            waiting = {name: job for name, job in self.current.items() if name not in self._register.settled}
            lost = self._lost(waiting, real_s, time_s)
            if len(lost) > MAX_SETTLED:
                self._granter.give_up(dict(list(lost.items())[: len(lost) - MAX_SETTLED]), time_s)
        for name in self._register.take_gone():
            self.submitted.pop(name, None)
            self.current.pop(name, None)

    def note_offers(self, bid: Bid) -> None:
        """Note which jobs the arm of a bid cannot do."""
        for offer in bid.estimates:
            by_arm = self._refusals.setdefault(offer.job, {})
            by_arm[bid.arm] = "" if offer.feasible else offer.reason or "infeasible"
        while len(self._refusals) > MAX_NOTES:
            del self._refusals[next(iter(self._refusals))]

    def _refusal(self, job: str, present: Set[str]) -> str:
        """Return why no present arm can do a job, or none works; "" if one can, or it is unknown."""
        if (pauser := self._register.operations.paused.get(ALL_ARMS)) is not None:
            return f"All arms are paused by '{pauser}'."
        reasons = self._refusals.get(job, {})
        if not reasons or present - reasons.keys() or not all(reasons.values()) or NOT_PLANNED in reasons.values():
            return ""
        return no_arm_can(reasons)

    def apply_changes(self) -> None:
        """Have the jobs follow what people have requested."""
        self.current = {name: self._register.operations.changed(job) for name, job in self.submitted.items()}

    def open(self, present: Set[str], real_s: float, time_s: float) -> list[str]:
        """Return the jobs that can still be done, without those of absent arms that had permission to commit."""
        register = self._register
        gone = {job for job in self._granter.out_of_contact(real_s) if register.grants[job].arm not in present}
        gone.update(register.settled, register.operations.all_cancelled, self._lost(self.current, real_s, time_s))
        return [job for job in self.current if job not in gone]

    def ready(self, real_s: float, time_s: float, limit: int, paused_until_s: Mapping[str, float]) -> list[JobSpec]:
        """Return the jobs that wait for an arm, as `ready_jobs` does.

        Args:
            paused_until_s: Real second from which on a job counts again, by job.
        """
        settled, cancelled = self._register.settled, self._register.operations.all_cancelled
        free = (
            job
            for name, job in self.current.items()
            if name not in settled
            and name not in cancelled
            and not self._granter.is_granted(name, real_s)
            and not is_late(job, time_s)
            and paused_until_s.get(name, real_s) <= real_s
        )
        finished, busy = self._register.is_finished, self._granter.busy_stations(real_s)
        return ready_jobs(free, time_s, limit, busy, finished, self._register.returned_s)

    def status(
        self,
        later: Iterable[JobSpec],
        states: Mapping[str, State],
        real_s: float,
        time_s: float,
        present: Set[str] = frozenset(),
    ) -> list[JobStatus]:
        """Return the status of all known jobs, and of `later` ones that are not offered yet."""
        jobs = self.current | {job.name: job for job in later}
        lost = self._lost(jobs, real_s, time_s)
        names = dict.fromkeys([*jobs, *self._register.settled])
        found = [self._status(name, jobs.get(name), lost, states, real_s) for name in names]
        return [
            replace(each, reason=each.reason or self._refusal(each.job, present)) if each.state == "waiting" else each
            for each in found
        ]

    def steered(self, name: str, states: Mapping[str, State], real_s: float, time_s: float) -> dict[str, KnownJob]:
        """Return what is known of one job, by its name; nothing of an unknown one."""
        spec, register = self.current.get(name), self._register
        if spec is None:
            return {}
        status = self._status(name, spec, self._lost(self.current, real_s, time_s), states, real_s)
        grant, cancelled = register.grants.get(name), register.operations.cancelled(name) is not None
        return {name: KnownJob(spec, status, cancelled, status.award or ("" if grant is None else grant.award))}

    def _status(
        self, name: str, job: JobSpec | None, lost: Mapping[str, str], states: Mapping[str, State], real_s: float
    ) -> JobStatus:
        status = self._granter.status(name, real_s)
        if status.state == "waiting" and name in lost:
            status = replace(status, state="given_up", reason=lost[name])
        elif status.state == "waiting" and self.ended:
            status = replace(status, state="unfinished", reason=SHIFT_ENDED)
        state = states.get(status.arm) if status.state in ("awarded", "finishing") else None
        finish_s = state.time_s + state.busy_s if state is not None and state.job == name else None
        return replace(with_terms(status, job), finish_s=finish_s)

    def _lost(self, jobs: Mapping[str, JobSpec], real_s: float, time_s: float) -> dict[str, str]:
        """Return why jobs are given up in which no arm has faulted too often: they expired, or wait for one that is."""
        late = (job.name for job in jobs.values() if is_late(job, time_s))
        settled = self._register.settled
        expired = {name for name in late if name not in settled and not self._granter.is_granted(name, real_s)}
        before = {name for job in jobs.values() for name in job.after if name not in jobs}
        past = {name for name in before if self._register.past.is_given_up(name)}
        causes = self._register.given_up | expired | past
        return dict.fromkeys(expired, EXPIRED) | (lost_jobs(jobs.values(), causes) if causes else {})
