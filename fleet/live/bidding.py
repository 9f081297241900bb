"""One round of an auction: which jobs are on offer, what the arms bid, and what came of it."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

from fleet.bus.trade import JobWord, Offer, Quote

_LOG = logging.getLogger(__name__)

MOST_TOLD = 500
"""Characters of a reason that are passed on; a word must not grow with the number of arms."""


@dataclass(frozen=True, eq=False)
class Bidding:
    """What an allocation rule is given to decide on."""

    auction: str
    time_s: float
    """The fleet's time."""
    jobs: tuple[JobWord, ...]
    quotes: Mapping[str, Quote]
    """Of every arm that answered and has room for a job."""

    def offer(self, arm: str, job: str) -> Offer | None:
        """What an arm bid for a job; None if it did not, or cannot do it."""
        return self._offers.get((arm, job))

    @cached_property
    def _offers(self) -> dict[tuple[str, str], Offer]:
        pairs = ((arm, offer) for arm, quote in self.quotes.items() for offer in quote.offers if offer.feasible)
        return {(arm, offer.job): offer for arm, offer in pairs}


Allocate = Callable[[Bidding], Mapping[str, str]]
"""Arm of each job that is given away. An arm gets one job in a round: after that its other bids are no longer true,
and in the next round it bids anew."""


def sound(bidding: Bidding, wanted: Mapping[str, str]) -> dict[str, str]:
    """What of an allocation may be awarded: bid for, one job per arm and per station; the rest is logged."""
    places = {word.name: frozenset(word.places) for word in bidding.jobs}
    out: dict[str, str] = {}
    taken: set[str] = set()
    for job, arm in sorted(wanted.items()):
        if job not in places or bidding.offer(arm, job) is None:
            _LOG.error("The allocation rule gives '%s' to '%s', which did not bid for it: not awarded.", job, arm)
        elif arm in out.values() or taken & places[job]:
            _LOG.error("The allocation rule gives '%s' to '%s' against a job of the same arm or station.", job, arm)
        else:
            out[job] = arm
            taken |= places[job]
    return out


def nobody_can(bidding: Bidding) -> dict[str, str]:
    """Jobs that every arm which answered calls infeasible, with what the arms say."""
    reasons: dict[str, dict[str, str]] = {}
    for arm, quote in sorted(bidding.quotes.items()):
        for offer in quote.offers:
            if not offer.feasible:
                reasons.setdefault(offer.job, {})[arm] = offer.reason or "infeasible"
    return {
        job: f"No arm can do it: {'; '.join(f'{arm}: {reason}' for arm, reason in said.items())}."[:MOST_TOLD]
        for job, said in reasons.items()
        if len(said) == len(bidding.quotes)
    }


@dataclass(eq=False)
class Round:
    """A round that is open for bids."""

    auction: str
    jobs: tuple[JobWord, ...]
    asked: frozenset[str]
    """Arms whose answer it waits for."""
    until_s: float
    """Real second at which it closes anyway."""
    quotes: dict[str, Quote] = field(default_factory=dict)

    def complete(self, present: frozenset[str]) -> bool:
        """Whether every arm that was asked and is still there has answered."""
        return (self.asked & present) <= self.quotes.keys()
