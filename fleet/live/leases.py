"""Leases of open grants, as the granting side counts them: an auctioneer, or an arm for its peers."""

from collections.abc import Container, Mapping, Set
from dataclasses import dataclass

from fleet.bus.protocol.auction import LEASE_S
from fleet.errors import Refused, RefusedForNow, listed
from fleet.live.book import JobBook
from fleet.live.clock import CLOCK_DRIFT
from fleet.live.job_rules import reason_for_no_progress
from fleet.live.journal import CommitPermitted, Progress, Released, SpaceCleared
from fleet.live.records import BookRecord, ContactLost, ContactRegained, CountedLease, SendAward

STOPPED_S = 1.0
"""Real seconds after the end of a lease: a process that notices the end later was stopped meanwhile."""

STALLED = 3.0
"""Multiple of the predicted duration of a job, and of a lease, after which a job without a cycle makes no progress."""
STALLED_S = 60.0
"""Fleet seconds more than that."""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Auction timeouts, in real seconds."""

    lease_s: float = LEASE_S
    """Length of a lease: an arm may work this long without renewing it."""
    margin_s: float = 0.25
    """Between the end of a lease and the next offer of its job."""
    window_s: float = 0.5
    """A round closes after this, if not every arm has answered before."""
    ack_s: float = 1.0
    """To wait for the answer to an award."""
    attempts: int = 3
    """Maximum number of times that an award is sent."""
    pause_s: tuple[float, float] = (0.25, 2.0)
    """Between rounds in which nothing was awarded: the first pause and the longest."""
    refused_s: tuple[float, float] = (1.0, 32.0)
    """Before an arm is awarded a job again that it refused, or whose award it did not answer: the first pause and the
    longest."""
    max_jobs: int = 64
    """Jobs in one round; a quote for more would be a large message."""

    def __post_init__(self) -> None:
        for name in ("lease_s", "margin_s", "window_s", "ack_s", "attempts", "max_jobs"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Timing.{name} must be > 0 (got {getattr(self, name)}).")
        for name in ("pause_s", "refused_s"):
            first_s, longest_s = getattr(self, name)
            if not 0 < first_s <= longest_s:
                raise ValueError(f"Timing.{name} must be 0 < first <= longest (got {getattr(self, name)}).")

    @property
    def counted_lease_s(self) -> float:
        """Length of a lease as the granting side counts it: longer than the arm does, as clocks differ in rate."""
        return self.lease_s * (1.0 + CLOCK_DRIFT) + self.margin_s


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


def expire(book: JobBook, real_s: float, time_s: float) -> list[CountedLease]:
    """Record the ends of leases; return those of the jobs that go back. One in its last cycle stays with its arm."""
    back: list[CountedLease] = []
    for award, lease in [(award, lease) for award, lease in book.leases.items() if real_s >= lease.until_s]:
        grant = book.open[award]
        job, arm = grant.record.job, grant.record.arm
        vain = f"'{job}' is not taken back from '{arm}'"
        if not grant.may_commit:
            missing = "renew its lease" if lease.unanswered is None else "answer the award"
            reason = f"'{arm}' did not {missing}."
            if was_stopped(lease, real_s):  # the arm may have tried
                reason = f"The lease of '{arm}' ended while nobody could renew it: the process that awards was stopped."
            if not book.try_to_record(vain, Released(award, job, arm, "dropped", lease.cycles, time_s, reason)):
                return back
            back.append(lease)
        elif not (grant.silent or book.ended) and not book.try_to_record(
            vain, ContactLost(award, time_s, lease.cycles)
        ):
            return back
    return back


def no_progress(lease: CountedLease, arm: str, timing: Timing, real_s: float, time_s: float) -> str:
    """Return that an arm renews a lease and does nothing for its job; "" if it may do something."""
    limit_s = STALLED * lease.takes_s + STALLED_S
    since_real_s, since_s = lease.progress_s
    if time_s - since_s > limit_s and real_s - since_real_s > STALLED * timing.lease_s:
        return reason_for_no_progress(arm, limit_s)
    return ""


def was_stopped(lease: CountedLease, real_s: float) -> bool:
    """Return whether this process was stopped when a lease ended, by the real second at which it notices the end."""
    return real_s > lease.until_s + STOPPED_S


def renewal(book: JobBook, award: str, time_s: float, cycles: int, *, finishing: bool) -> list[BookRecord]:
    """Return what to record before the lease of an open grant is renewed.

    Args:
        cycles: Done so far, by its arm.
        finishing: Whether its arm asks for permission to commit, or has it.
    """
    grant = book.open[award]
    if finishing and not grant.may_commit:
        return [CommitPermitted(award, time_s, cycles)]
    return [ContactRegained(award, time_s)] if grant.silent and not book.ended else []


def progress(book: JobBook, jobs: Container[str]) -> list[Progress]:
    """Return the reported cycles of jobs that are about to change, as far as they are not recorded."""
    leases = ((book.open[award].record.job, lease.cycles) for award, lease in book.leases.items())
    return [Progress(job, cycles) for job, cycles in leases if job in jobs and cycles > book.jobs[job].cycles]


def clear(book: JobBook, arm: str, by: str, present: Set[str], lease_s: float, time_s: float) -> bool:
    """Free the space of an absent arm and revoke its grants: a person has seen that it is at home, or removed.

    It is unknown whether its last cycle was done; if the arm is online again, it reports that. Return whether
    anything changes.

    Raises:
        Refused: the arm is unknown, or present, or may have a lease.
        JournalError: it is not durable, and nothing has changed.
    """
    taken, grants = book.taken_space(), [grant for grant in book.open.values() if grant.record.arm == arm]
    if arm in present:
        raise Refused(f"'{arm}' is present and says itself which space it takes. Stop it first, or move it home.")
    if arm not in book.space and not grants:
        raise Refused(f"There is no arm '{arm}'. Arms: {listed(sorted(taken))}.")
    if not all(grant.silent for grant in grants):
        raise RefusedForNow(f"The lease of '{arm}' has not ended; try again in at most {lease_s:g} s.")
    if taken.get(arm):
        book.record(*progress(book, [grant.record.job for grant in grants]), SpaceCleared(arm, by, time_s))
    return bool(taken.get(arm))
