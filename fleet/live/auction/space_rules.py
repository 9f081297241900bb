"""Space in an auction: what quotes say about it, which estimates it closes, and whose space a person may free."""

from collections.abc import Mapping, Set

from fleet.bus.protocol.auction import Quote
from fleet.bus.protocol.operator import ClearRequest
from fleet.errors import Refused
from fleet.live.auction.ledger import Ledger
from fleet.live.auction.round import MAX_REASON, Bidding, Round
from fleet.live.journal_records import Closed, SpaceCleared, SpaceTaken
from fleet.live.space import ANYWHERE


def _stated_space(quote: Quote) -> frozenset[str]:
    """Return the names of the spaces that an arm takes, and of those of its jobs, by its quote."""
    if quote.space is None:
        return frozenset() if quote.mode == "idle" else frozenset([ANYWHERE])
    return frozenset(quote.space)


def waits_for_space(bidding: Bidding) -> dict[str, str]:
    """Return why no plan for a job has free space, by job."""
    waits: dict[str, set[str]] = {}
    open_jobs: set[str] = set()
    for arm, quote in {**bidding.quotes, **bidding.full}.items():
        for offer in quote.estimates:
            for plan in offer.plans:
                in_way = bidding.in_the_way(arm, plan.space)
                waits.setdefault(offer.job, set()).update(in_way)
                if not in_way:
                    open_jobs.add(offer.job)
    return {
        job: f"It waits until {', '.join(sorted(arms))} is out of the way."[:MAX_REASON]
        for job, arms in waits.items()
        if arms and job not in open_jobs
    }


def stated_spaces(ledger: Ledger, closing: Round, time_s: float) -> list[SpaceTaken]:
    """Return what the quotes of a round change in the space that arms take.

    A quote says nothing about awards that were closed after the round was opened: these keep their space.
    """
    records: list[SpaceTaken] = []
    for arm, quote in sorted(closing.quotes.items()):
        before = ledger.space.get(arm, frozenset())
        open_space = {award.record.space for award in ledger.open.values() if award.record.arm == arm}
        after = (before - closing.space.get(arm, frozenset())) | (_stated_space(quote) - open_space)
        if after != before:
            records.append(SpaceTaken(arm, tuple(sorted(after)), time_s))
    return records


def retaken_space(ledger: Ledger, arm: str, space: Set[str]) -> list[SpaceTaken]:
    """Return what changes when an arm takes this space; it counts as free after a person has freed it.

    Args:
        space: Names of spaces that the arm takes, or for which it has an award.
    """
    taken = ledger.taken_space().get(arm, frozenset())
    if ANYWHERE in taken or space <= taken:
        return []
    return [SpaceTaken(arm, tuple(sorted(ledger.space.get(arm, frozenset()) | space)), ledger.time_s)]


def cleared_space(
    ledger: Ledger,
    request: ClearRequest,
    present: frozenset[str],
    cycles: Mapping[str, int],
    lease_s: float,
    time_s: float,
) -> list[Closed | SpaceCleared]:
    """Return what changes when a person frees the space of an arm: its awards end, each may be done or not.

    Args:
        cycles: Reported progress, by award.

    Raises:
        Refused: the arm is unknown, or present, or may have a lease.
    """
    arm, taken = request.arm, ledger.taken_space()
    awards = {name: award for name, award in ledger.open.items() if award.record.arm == arm}
    if arm in present:
        raise Refused(f"'{arm}' is present and says itself which space it takes. Stop it first, or move it home.")
    if arm not in ledger.space and not awards:
        arms = ", ".join(sorted(name for name, spaces in taken.items() if spaces))
        raise Refused(f"'{arm}' takes no space. Arms that do: {arms or 'none'}.")
    if not all(award.silent for award in awards.values()):
        raise Refused(f"The lease of '{arm}' has not ended; try again in {lease_s:g} s.")
    if not taken.get(arm):
        return []
    reason = f"The space of '{arm}' was cleared; it was about to finish it."[:MAX_REASON]
    ends = [Closed(name, "dropped", cycles.get(name, 0), time_s, reason, unsure=True) for name in awards]
    return [*ends, SpaceCleared(arm, request.by, time_s)]
