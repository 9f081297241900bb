"""An arm that follows `fleet.bus.protocol.auction`, as a state machine on any clock; for tests of auctioneers."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from fleet.bus.protocol.auction import (
    Ack,
    Award,
    JobEstimate,
    Lease,
    LeaseEntry,
    LeaseRequest,
    PlanQuote,
    Quote,
    QuoteRequest,
    Report,
)
from fleet.live.auction.rounds import Assignment, Timing

VALID_S = 2.0
TIMING = Timing(lease_s=3.0, margin_s=0.05, window_s=0.5, ack_s=0.5, max_jobs=8)


def first_come(bidding) -> Mapping[str, Assignment]:
    """Give each job to the first free arm that bids for it; one job per station."""
    out: dict[str, Assignment] = {}
    taken: set[str] = set()
    for job in bidding.jobs:
        for arm in sorted(bidding.quotes):
            free = (arm, 0) not in out.values() and not taken & set(job.places)
            if free and bidding.offer(arm, job.name):
                out[job.name] = Assignment(arm)
                taken |= set(job.places)
                break
    return out


@dataclass
class Work:
    """A current job."""

    award: Award
    cycles: int
    until_s: float
    """End of the lease, on the arm's clock."""
    may_commit: bool = False
    in_last_cycle: bool = False


@dataclass
class ModelArm:
    """Does one cycle of each current job with each `work`, if the lease allows it."""

    name: str
    rate: float = 1.0
    offset_s: float = 0.0
    up: bool = True
    boots: int = 1
    quotes: dict[str, float] = field(default_factory=dict)
    answers: dict[str, Ack] = field(default_factory=dict)
    current: dict[str, Work] = field(default_factory=dict)
    reports: dict[str, Report] = field(default_factory=dict)
    done: list[str] = field(default_factory=list)
    """Jobs whose last cycle it has done."""
    out: str = ""
    """Job for which it is away from home; "" at home."""
    steps_home: int = 0
    """Steps of `work` that it has been on its way home."""

    def own_s(self, true_s: float) -> float:
        return self.offset_s + self.rate * true_s

    def quote(self, request: QuoteRequest, true_s: float) -> Quote:
        name = f"{self.name}.{self.boots}.{len(self.quotes)}"
        self.quotes[name] = self.own_s(true_s)
        offers = tuple(
            JobEstimate(job.name, (PlanQuote(finish_in_s=1.0, space=f"{self.name}: {job.name}"),))
            for job in request.jobs
        )
        jobs = {work.award.job.name for work in self.current.values()} | ({self.out} - {""})
        return Quote(
            self.name,
            request.auction,
            name,
            VALID_S,
            "model",
            0.0,
            "idle",
            10.0,
            max(0, 1 - len(self.current)),
            offers,
            tuple(f"{self.name}: {job}" for job in sorted(jobs)),
        )

    def answer_award(self, award: Award, true_s: float) -> Ack:
        if award.award not in self.answers:
            made_s = self.quotes.pop(award.quote, None)  # one award per quote
            late = made_s is None or self.own_s(true_s) - made_s > VALID_S
            takes = not late and not self.current
            self.answers[award.award] = Ack(self.name, award.award, takes, "" if takes else "not now")
            if takes and made_s is not None:
                self.current[award.award] = Work(award, award.cycles, made_s + award.lease_s)
        return self.answers[award.award]

    def may_work(self, true_s: float) -> list[Work]:
        """Return the jobs that it may work on now: under a lease, or in the last cycle."""
        return [w for w in self.current.values() if self.up and (self.own_s(true_s) < w.until_s or w.in_last_cycle)]

    def work(self, true_s: float) -> None:
        able = self.may_work(true_s)
        if self.out and self.out not in {work.award.job.name for work in able}:
            self.steps_home += 1
            if self.steps_home >= 3:  # the way home takes some time
                self.out, self.steps_home = "", 0
            return
        for name, work in list(self.current.items()):
            if work not in able:
                continue
            self.out, self.steps_home = work.award.job.name, 0
            if work.cycles < work.award.job.repetitions - 1:
                work.cycles += 1
            elif work.may_commit and not work.in_last_cycle:
                work.in_last_cycle = True
            elif work.in_last_cycle:
                del self.current[name]
                self.done.append(work.award.job.name)
                self._report(work, "finished", true_s, work.cycles + 1)

    def return_jobs(self, true_s: float) -> None:
        for name, work in list(self.current.items()):
            if not work.in_last_cycle:
                del self.current[name]
                self._report(work, "returned", true_s, work.cycles)

    def request(self) -> LeaseRequest:
        entries = tuple(
            LeaseEntry(
                name, w.award.job.name, w.cycles, "finishing" if w.cycles >= w.award.job.repetitions - 1 else "working"
            )
            for name, w in self.current.items()
        )
        return LeaseRequest(self.name, entries)

    def apply_lease(self, lease: Lease, asked_s: float) -> None:
        for name in lease.granted:
            if name in self.current:
                self.current[name].until_s = max(self.current[name].until_s, asked_s + lease.lease_s)
                self.current[name].may_commit |= name in lease.may_commit
        for name in lease.revoked:
            if name in self.current and not self.current[name].in_last_cycle:
                self._report(self.current.pop(name), "returned", asked_s, 0)

    def crash(self, true_s: float) -> None:
        """Lose everything but the journal, and return the current jobs; unsure of one in its last cycle.

        A person moves the arm home before it is started again.
        """
        self.out, self.steps_home = "", 0
        self.boots += 1
        self.quotes = {}
        for work in self.current.values():
            self._report(work, "returned", true_s, work.cycles, unsure=work.in_last_cycle)
        self.current = {}

    def move_home(self) -> None:
        """Have a person break its cycle off and move it home; its process lives on."""
        self.out, self.steps_home = "", 0
        for work in self.current.values():
            work.in_last_cycle = False

    def _report(self, work: Work, outcome, true_s: float, cycles: int, unsure: bool = False) -> None:
        award = work.award
        self.reports[award.award] = Report(
            self.name, award.award, award.job.name, outcome, cycles, true_s, unsure=unsure
        )
