"""New and adopted awards, and leases of open ones as the auctioneer counts them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from fleet.bus.protocol.auction import Award, JobSpec
from fleet.bus.protocol.history import History
from fleet.live.auction.job_rules import is_same_work
from fleet.live.auction.ledger import Ledger
from fleet.live.auction.records import AuctionRecord, Awarded, HistoryAdopted
from fleet.live.auction.round import Assignment, Bidding, Timing, offers_of
from fleet.live.journal_records import CommitPermitted, JobsAccepted
from fleet.live.space import ANYWHERE


@dataclass(frozen=True)
class SendAward:
    """Send this award to its arm."""

    arm: str
    award: Award


@dataclass(eq=False)
class CountedLease:
    """Lease of an open award, as the auctioneer counts it."""

    until_s: float
    """Real second at which it ends."""
    cycles: int = 0
    """Last reported progress."""
    unanswered: SendAward | None = None
    """The award, until its arm answers."""
    sent_s: float = -math.inf
    attempts: int = 1


def unanswered(leases: Mapping[str, CountedLease]) -> list[tuple[CountedLease, SendAward]]:
    """Return the leases of awards that their arms have not answered, and these awards."""
    return [(lease, lease.unanswered) for lease in leases.values() if lease.unanswered is not None]


def send_again(leases: Mapping[str, CountedLease], real_s: float, timing: Timing) -> list[SendAward]:
    """Return the unanswered awards that are due to be sent again; they count as sent."""
    due: list[SendAward] = []
    for lease, message in unanswered(leases):
        if real_s >= lease.sent_s + timing.ack_s and lease.attempts < timing.attempts:
            lease.sent_s, lease.attempts = real_s, lease.attempts + 1
            due.append(message)
    return due


def new_awards(ledger: Ledger, bidding: Bidding, allocation: Mapping[str, Assignment], time_s: float) -> list[Awarded]:
    """Return the records of the awards of a round."""
    records: list[Awarded] = []
    for job, (arm, plan) in allocation.items():
        offer = bidding.offer(arm, job, plan)
        assert offer is not None, "drop_invalid keeps jobs with a bid"
        names = (f"{bidding.auction}:{job}", bidding.auction, job, arm, bidding.quotes[arm].quote)
        heat = (offer.difficulty, offer.p_saturation, offer.peak_c)
        terms = (ledger.jobs[job].cycles, time_s, *heat, offer.space or ANYWHERE, plan)
        records.append(Awarded(*names, *terms, offers_of(bidding, job, Assignment(arm, plan))))
    return records


def adopted(ledger: Ledger, history: History, name: str, time_s: float) -> list[AuctionRecord]:
    """Return what an auctioneer takes over from an arm: jobs that it finished, and awards that it has.

    Args:
        name: Name of the auctioneer; an arm leases the awards of another one there.
    """
    records: list[AuctionRecord] = []
    waiting = {job: entry.spec for job, entry in ledger.waiting.items()}

    def is_waiting(job: JobSpec) -> bool:
        return job.name in waiting and is_same_work(waiting[job.name], job)

    unknown = tuple(
        job
        for job in history.finished
        if is_waiting(job) or (job.name not in ledger.jobs and job.name not in ledger.past)
    )
    if unknown:
        records.append(HistoryAdopted(history.arm, unknown, time_s))
    done = {job.name for job in unknown}
    for award in history.awards:
        job = award.job
        fresh = job.name not in ledger.jobs and job.name not in ledger.past and job.name not in done
        if award.auctioneer != name or award.award in ledger.awards or not (fresh or is_waiting(job)):
            continue
        if fresh:
            records.append(JobsAccepted((job,), f"adopted from {history.arm}", time_s))
        records.append(_awarded(award, history.arm, time_s))
        if award.award in history.may_commit:
            records.append(CommitPermitted(award.award, time_s))
    return records


def _awarded(award: Award, arm: str, time_s: float) -> Awarded:
    terms = (award.award, award.auction, award.job.name, arm, award.quote, award.cycles, time_s)
    return Awarded(*terms, plan=award.plan)
