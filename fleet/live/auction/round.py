"""One round of an auction: which jobs are on offer, what the arms bid, and who gets which job."""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from fleet.bus.protocol.auction import JobEstimate, JobSpec, Quote
from fleet.bus.protocol.messages import State

_LOG = logging.getLogger(__name__)

REASON_CHARACTERS = 500
"""Length at which a reason is cut, so that a message does not grow with the number of arms."""


@dataclass(frozen=True, eq=False)
class Bidding:
    """What an allocation rule decides on."""

    auction: str
    time_s: float
    """The fleet's time."""
    jobs: tuple[JobSpec, ...]
    quotes: Mapping[str, Quote]
    """Of every arm that answered and has room for a job."""
    full: Mapping[str, Quote] = field(default_factory=dict)
    """Of every arm that answered and takes no job now."""
    states: Mapping[str, State] = field(default_factory=dict)
    """The last state that each arm published."""
    ages_s: Mapping[str, float] = field(default_factory=dict)
    """Age of an answer, fleet seconds; 0 where none is given."""
    returned: Mapping[str, tuple[int, float]] = field(default_factory=dict)
    """How often a job came back unfinished, and when last (the fleet's time); jobs that never did are left out."""

    def offer(self, arm: str, job: str) -> JobEstimate | None:
        """What an arm bid for a job; None if it did not, or cannot do it."""
        return self._offers.get((arm, job))

    @cached_property
    def _offers(self) -> dict[tuple[str, str], JobEstimate]:
        pairs = ((arm, offer) for arm, quote in self.quotes.items() for offer in quote.estimates if offer.feasible)
        return {(arm, offer.job): offer for arm, offer in pairs}


Allocate = Callable[[Bidding], Mapping[str, str]]
"""Arm of each job that is assigned. An arm gets one job in a round: after that its other bids no longer hold, and in
the next round it bids again."""


def resolve_claims(bidding: Bidding, claims: Mapping[str, str], order: Sequence[str]) -> dict[str, str]:
    """Arm of each job, of what arms claim: the lower quoted difficulty wins, then the arm that comes first in `order`.

    As in simulation, a job goes to one arm, a station serves one job, and no difficulty loses against any.

    Args:
        claims: The job that each arm claims; a claim without a feasible offer is ignored.
    """
    places = {word.name: frozenset(word.places) for word in bidding.jobs}
    ranked: list[tuple[float, int, str, str]] = []
    for arm, job in claims.items():
        if (offer := bidding.offer(arm, job)) is not None and job in places:
            ranked.append((math.inf if offer.difficulty is None else offer.difficulty, order.index(arm), arm, job))
    out: dict[str, str] = {}
    taken: set[str] = set()
    for _, _, arm, job in sorted(ranked):
        if job not in out and not taken & places[job]:
            out[job] = arm
            taken |= places[job]
    return out


def drop_invalid(bidding: Bidding, wanted: Mapping[str, str]) -> dict[str, str]:
    """What of an allocation may be awarded: with a bid, one job per arm and per station. The rest is logged."""
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


def infeasible_jobs(bidding: Bidding) -> dict[str, str]:
    """Jobs that every arm which answered calls infeasible, with the arms' reasons."""
    answered = {**bidding.quotes, **bidding.full}
    reasons: dict[str, dict[str, str]] = {}
    for arm, quote in sorted(answered.items()):
        for offer in quote.estimates:
            if not offer.feasible:
                reasons.setdefault(offer.job, {})[arm] = offer.reason or "infeasible"
    return {
        job: f"No arm can do it: {'; '.join(f'{arm}: {reason}' for arm, reason in by_arm.items())}."[:REASON_CHARACTERS]
        for job, by_arm in reasons.items()
        if len(by_arm) == len(answered)
    }


@dataclass(eq=False)
class Round:
    """A round that is open for bids."""

    auction: str
    jobs: tuple[JobSpec, ...]
    asked: frozenset[str]
    """Arms whose answer it waits for."""
    until_s: float
    """Real second at which it closes anyway."""
    quotes: dict[str, Quote] = field(default_factory=dict)

    def complete(self, present: frozenset[str]) -> bool:
        """Whether every arm that was asked and is still present has answered."""
        return (self.asked & present) <= self.quotes.keys()
