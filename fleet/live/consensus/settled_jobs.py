"""Outcomes of settled jobs, as an arm without an auctioneer knows them.

The latest `MAX_SETTLED` by fleet time stay, and unfinished ones; of older ones only name and outcome are known
(`PastJobs`). Arms that know the same outcomes keep the same ones, in whatever order they have received them; where two
times of one outcome are known, only until these have left.
"""

from bisect import insort
from collections.abc import Iterator, Mapping

from fleet.bus.protocol.auction import ABANDONED, JobSpec, JobState
from fleet.bus.protocol.consensus import JobOutcome
from fleet.live.auction.job_rules import MAX_OPEN_JOBS
from fleet.live.auction.ledger import MAX_SETTLED
from fleet.live.auction.past_jobs import PastJobs, hash_of

RANKS = ("returned", "given_up", "cancelled", "unfinished", "finished")
"""Outcomes of a job: the later ones count more."""


class SettledJobs(Mapping[str, JobOutcome]):
    """Outcome of each settled job, by name.

    Attributes:
        past: Jobs that have left.
        left: How many have left, by state.
        gone: Names of jobs that have left since they were last taken from here.
        digest: Equal for arms that keep the same outcomes.
    """

    def __init__(self) -> None:
        self.past, self.left = PastJobs(), dict[JobState, int]()
        self.gone: list[str] = []
        self.digest = 0
        self._outcomes: dict[str, JobOutcome] = {}
        self._order: list[tuple[float, str]] = []
        """Time and name of those that may leave."""

    def __getitem__(self, job: str) -> JobOutcome:
        return self._outcomes[job]

    def __iter__(self) -> Iterator[str]:
        return iter(self._outcomes)

    def __len__(self) -> int:
        return len(self._outcomes)

    def __contains__(self, job: object) -> bool:
        return job in self._outcomes

    def is_news(self, outcome: JobOutcome) -> bool:
        """Return whether an outcome counts more than the known one: by its kind, then the later one."""
        known = self._outcomes.get(outcome.job)
        if known is None and outcome.job in self.past:
            return outcome.outcome == "finished" and self.past.is_given_up(outcome.job)
        return known is None or _weight(outcome) > _weight(known)

    def known(self, job: str, arm: str) -> JobOutcome | None:
        """Return the outcome of a job, also of one that has left, as the arm `arm` knows it; None for none."""
        if job in self._outcomes or job not in self.past:
            return self._outcomes.get(job)
        outcome = "finished" if self.past.is_finished(job) else "given_up"
        return JobOutcome(job, "?", arm, outcome, 0, 0.0, f"It was {outcome.replace('_', ' ')} long ago.")

    def put(self, outcome: JobOutcome, specs: Mapping[str, JobSpec]) -> None:
        """Add an outcome that is news; the oldest one leaves if there are too many.

        Args:
            specs: Jobs by name; one of unknown content is the same as any other of its name.
        """
        job = outcome.job
        self.drop(job)
        if job in self.past:
            self.past.add(specs.get(job, job), finished=outcome.outcome == "finished")
            return
        self._outcomes[job] = outcome
        self.digest ^= _hash(outcome)
        if outcome.outcome != "unfinished":
            insort(self._order, (outcome.time_s, job))
        while len(self._order) > MAX_SETTLED:
            self._leave(self._order[0][1], specs)
        if len(self._outcomes) > MAX_SETTLED + MAX_OPEN_JOBS:
            self._leave(next(name for name, each in self._outcomes.items() if each.outcome == "unfinished"), specs)

    def drop(self, job: str) -> None:
        """Forget the outcome of a job."""
        if (known := self._outcomes.pop(job, None)) is not None:
            self.digest ^= _hash(known)
            if known.outcome != "unfinished":
                self._order.remove((known.time_s, job))

    def restore(self, packed: bytes, left: Mapping[JobState, int]) -> None:
        """Start with jobs that have left."""
        self.past, self.left = PastJobs(packed, self.past.limit), dict(left)

    def _leave(self, job: str, specs: Mapping[str, JobSpec]) -> None:
        outcome = self._outcomes[job].outcome
        assert outcome != "returned"
        self.drop(job)
        self.past.add(specs.get(job, job), finished=outcome == "finished")
        self.left[outcome] = self.left.get(outcome, 0) + 1
        self.gone.append(job)


def is_abandoned(outcome: JobOutcome) -> bool:
    """Return whether a job is given up or cancelled: it may be finished after all."""
    return outcome.outcome in ABANDONED


def _weight(outcome: JobOutcome) -> tuple[int, float]:
    return RANKS.index(outcome.outcome), outcome.time_s


def _hash(outcome: JobOutcome) -> int:
    return hash_of(repr((outcome.job, outcome.outcome, outcome.time_s)).encode())
