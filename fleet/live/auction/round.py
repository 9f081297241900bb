"""One round of an auction: its time limits, the bids of the arms, and which arm gets which job."""

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

from msgspec.structs import replace

from fleet.bus.protocol.auction import LEASE_S, MOST_OFFERS, NOT_PLANNED, ArmOffer, JobSpec, PlanQuote, Quote
from fleet.bus.protocol.messages import State
from fleet.live.clock import CLOCK_DRIFT
from fleet.live.space import ANYWHERE, Excludes, arms_in_the_way, no_conflicts

_LOG = logging.getLogger(__name__)

MAX_REASON = 500
"""Characters of a reason, so that a message does not grow with the number of arms."""


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
    max_jobs: int = 64
    """Jobs in one round; a quote for more would be a large message."""

    def __post_init__(self) -> None:
        for name in ("lease_s", "margin_s", "window_s", "ack_s", "attempts", "max_jobs"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Timing.{name} must be > 0 (got {getattr(self, name)}).")
        if not 0 < self.pause_s[0] <= self.pause_s[1]:
            raise ValueError(f"Timing.pause_s must be 0 < first <= longest (got {self.pause_s}).")

    @property
    def counted_lease_s(self) -> float:
        """Length of a lease as the granting side counts it: longer than the arm does, as clocks differ in rate."""
        return self.lease_s * (1.0 + CLOCK_DRIFT) + self.margin_s


@dataclass(frozen=True, eq=False)
class Bidding:
    """Input of an allocation rule."""

    auction: str
    time_s: float
    """Fleet time."""
    jobs: tuple[JobSpec, ...]
    quotes: Mapping[str, Quote]
    """Quotes of the arms with capacity for a job."""
    full: Mapping[str, Quote] = field(default_factory=dict[str, Quote])
    """Quotes of the arms without."""
    states: Mapping[str, State] = field(default_factory=dict[str, State])
    """Latest published state of each arm."""
    returned: Mapping[str, tuple[int, float]] = field(default_factory=dict[str, tuple[int, float]])
    """Number of faults in a job, and fleet time at which it last returned; only of jobs that were ever returned."""
    busy: frozenset[str] = frozenset()
    """Stations at which an arm may be at work."""
    taken: Mapping[str, frozenset[str]] = field(default_factory=dict[str, frozenset[str]])
    """Names of the spaces that each arm may take."""
    excludes: Excludes = no_conflicts

    def offer(self, arm: str, job: str, plan: int = 0) -> PlanQuote | None:
        """Return what an arm quotes for a plan of a job of the round; None if it is not open."""
        return self.plans(arm, job).get(plan)

    def plans(self, arm: str, job: str) -> Mapping[int, PlanQuote]:
        """Return an arm's open plans for a job of the round, by number.

        A plan is open if the arm has capacity and quotes the plan, and its stations and its space are free.
        """
        return self._plans.get((arm, job), {})

    @cached_property
    def _plans(self) -> dict[tuple[str, str], dict[int, PlanQuote]]:
        names = {job.name for job in self.jobs if self.has_free_stations(job)}
        pairs = ((arm, offer) for arm, quote in self.quotes.items() for offer in quote.estimates)
        return {
            (arm, offer.job): {plan.plan: plan for plan in offer.plans if not self.in_the_way(arm, plan.space)}
            for arm, offer in pairs
            if offer.job in names
        }

    def has_free_stations(self, job: JobSpec) -> bool:
        """Return whether no arm is at work at the stations of a job."""
        return self.busy.isdisjoint(job.places)

    def in_the_way(self, arm: str, space: str | None) -> tuple[str, ...]:
        """Return the arms that take a space which excludes this one of an arm."""
        key = arm, space
        if key not in self._in_the_way:
            self._in_the_way[key] = arms_in_the_way(arm, space, self.taken, self.excludes)
        return self._in_the_way[key]

    @cached_property
    def _in_the_way(self) -> dict[tuple[str, str | None], tuple[str, ...]]:
        return {}


class Choice(NamedTuple):
    """What an arm claims."""

    job: str
    plan: int = 0
    """Number of the plan that it quotes."""


class Assignment(NamedTuple):
    """Who does a job."""

    arm: str
    plan: int = 0
    """Number of the plan that it quotes."""


Allocate = Callable[[Bidding], Mapping[str, Assignment]]
"""Arm and plan of each assigned job. An arm gets one job a round, since its other bids no longer hold after that."""


def resolve_claims(bidding: Bidding, claims: Mapping[str, Choice], order: Sequence[str]) -> dict[str, Assignment]:
    """Return the arm and plan of each job: the lower quoted difficulty wins, then the arm that comes first in `order`.

    As in simulation, a job goes to one arm, a station serves one job, plans that exclude each other are not done at a
    time, and an unknown difficulty loses.

    Args:
        claims: What each arm claims; a claim without such an offer is ignored.
    """
    ranked: list[tuple[float, int, str, Assignment]] = []
    for arm, (job, plan) in claims.items():
        if (offer := bidding.offer(arm, job, plan)) is not None:
            difficulty = math.inf if offer.difficulty is None else offer.difficulty
            ranked.append((difficulty, order.index(arm), job, Assignment(arm, plan)))
    return _without_conflicts(bidding, [(job, assignment) for _, _, job, assignment in sorted(ranked)])


def offers_of(bidding: Bidding, job: str, awarded: Assignment) -> tuple[ArmOffer, ...]:
    """Return what the arms offered for an awarded job: first the arm that gets it, then the others, best first."""
    offers: list[ArmOffer] = []
    for quote in (*bidding.quotes.values(), *bidding.full.values()):
        estimate = next((each for each in quote.estimates if each.job == job), None)
        plan = None if estimate is None or not estimate.feasible else estimate.least
        if quote.arm == awarded.arm:
            plan = bidding.offer(awarded.arm, job, awarded.plan)
        shown = None if plan is None else replace(plan, joint_difficulty=None, space=None)
        offers.append(ArmOffer(quote.arm, quote.mode, bool(bidding.plans(quote.arm, job)), shown))

    def rank(offer: ArmOffer) -> tuple[bool, bool, float, float]:
        cost = offer.plan or PlanQuote()
        p, d = (math.inf if value is None else value for value in (cost.p_saturation, cost.difficulty))
        return offer.arm != awarded.arm, not offer.free, p, d

    return tuple(sorted(offers, key=rank)[:MOST_OFFERS])


def drop_invalid(bidding: Bidding, allocation: Mapping[str, Assignment]) -> dict[str, Assignment]:
    """Return the valid part of an allocation: jobs with a bid, one job per arm, station and space. Log the rest."""
    pairs = sorted(allocation.items())
    valid = _without_conflicts(bidding, pairs)
    for job, (arm, plan) in pairs:
        if bidding.offer(arm, job, plan) is None:
            _LOG.error("The policy gives '%s' to '%s', which did not bid for it: not awarded.", job, arm)
        elif job not in valid:
            _LOG.error(
                "The policy gives '%s' to '%s', which conflicts with another job of that arm, station or space.",
                job,
                arm,
            )
    return valid


def _without_conflicts(bidding: Bidding, pairs: Iterable[tuple[str, Assignment]]) -> dict[str, Assignment]:
    """Return the assignment of each job with an offer; of two with one job, arm, station or space the first is kept."""
    places = {job.name: frozenset(job.places) for job in bidding.jobs}
    kept: dict[str, Assignment] = {}
    busy: set[str] = set()
    taken: dict[str, list[str]] = {}
    for job, assignment in pairs:
        arm, plan = assignment
        offer = bidding.offer(arm, job, plan)
        if offer is None or job in kept or arm in taken or busy & places[job]:
            continue
        if not arms_in_the_way(arm, offer.space, taken, bidding.excludes):
            kept[job] = assignment
            busy |= places[job]
            taken[arm] = [offer.space or ANYWHERE]
    return kept


def no_arm_can(reasons: Mapping[str, str]) -> str:
    """Return the reason of a job that no arm can do, from the reasons of the arms."""
    return f"No arm can do it: {'; '.join(f'{arm}: {reason}' for arm, reason in sorted(reasons.items()))}."[:MAX_REASON]


def infeasible_jobs(quotes: Mapping[str, Quote]) -> dict[str, str]:
    """Return the jobs that every arm with a quote calls infeasible, with the reasons of the arms."""
    reasons: dict[str, dict[str, str]] = {}
    for arm, quote in sorted(quotes.items()):
        for offer in quote.estimates:
            if not offer.feasible:
                reasons.setdefault(offer.job, {})[arm] = offer.reason or "infeasible"
    return {
        job: no_arm_can(by_arm)
        for job, by_arm in reasons.items()
        if len(by_arm) == len(quotes) and NOT_PLANNED not in by_arm.values()
    }


def planned_jobs(quotes: Mapping[str, Quote]) -> set[str]:
    """Return the jobs for which an arm quotes a plan, and those for which every arm says that it has none."""
    offers = [offer for quote in quotes.values() for offer in quote.estimates]
    open_jobs = {offer.job for offer in offers if offer.reason == NOT_PLANNED}
    return {offer.job for offer in offers if offer.feasible or offer.job not in open_jobs}


@dataclass(eq=False)
class Round:
    """A round that is open for bids."""

    auction: str
    jobs: tuple[JobSpec, ...]
    asked: frozenset[str]
    """Arms whose quotes it waits for."""
    until_s: float
    """Real second at which it closes in any case."""
    space: Mapping[str, frozenset[str]] = field(default_factory=dict[str, frozenset[str]])
    """Space that each arm might still take for closed awards alone when the round was opened: its quote says if it
    does."""
    quotes: dict[str, Quote] = field(default_factory=dict[str, Quote])

    def complete(self, present: frozenset[str]) -> bool:
        """Return whether every arm that was asked and is still present has answered."""
        return (self.asked & present) <= self.quotes.keys()
