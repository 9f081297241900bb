"""Rounds of an auction: which jobs are offered when and to whom, what is awarded, and why other jobs wait."""

import dataclasses
import logging
import math
import re
from collections import defaultdict
from collections.abc import Callable, Container, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import NamedTuple

from msgspec.structs import replace

from fleet.bus.protocol.auction import (
    MOST_OFFERS,
    NOT_PLANNED,
    Announcement,
    ArmOffer,
    Award,
    JobEstimate,
    JobSpec,
    PlanQuote,
    Quote,
    QuoteRequest,
    Result,
)
from fleet.bus.protocol.consensus import Bid
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import ALL_ARMS, Operation, by_whom
from fleet.errors import JournalFull
from fleet.live.book import MAX_UNKNOWN, JobBook
from fleet.live.job_rules import why_not_ready
from fleet.live.journal import SpaceTaken
from fleet.live.leases import Timing, unanswered
from fleet.live.records import CountedLease, Granted, SendAward
from fleet.live.sensors import ArmSensors
from fleet.live.space import ANYWHERE, Excludes, arms_in_the_way, no_conflicts

_LOG = logging.getLogger(__name__)

MAX_REASON = 500
"""Characters of a reason, so that a message does not grow with the number of arms."""
_NUMBER = re.compile(r"\d[\d.]*")
"""What differs in the same reason of two arms."""
MOST_ABSENT = 3
"""Absent arms that a reason names."""
MOST_UNANSWERED = 3
"""Number of awards in a row that an arm has not answered, after which it is awarded no job for a while."""
MAX_BACK_OFFS = 4096
"""Arms and jobs of which the last refusals are kept; the oldest are dropped."""


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
    absent: frozenset[str] = frozenset()
    """Arms that may take space, or belong to the cell, and are not present."""
    unasked: Mapping[str, str] = field(default_factory=dict[str, str])
    """Why other present arms have not quoted, by arm."""
    excluded: Mapping[str, Mapping[str, str]] = field(default_factory=dict[str, Mapping[str, str]])
    """Why arms are not awarded a job for a while, by arm, by job; their quotes have no plan for it."""
    unfit: Mapping[str, str] = field(default_factory=dict[str, str])
    """Why arms accept no job now, by arm, as far as quotes and states do not show it."""
    at_work: frozenset[str] = frozenset()
    """Arms that have a job."""

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

    def estimates(self, job: str) -> Mapping[str, JobEstimate]:
        """Return what arms answered about a job, by arm."""
        return self._estimates.get(job, {})

    @cached_property
    def _estimates(self) -> dict[str, dict[str, JobEstimate]]:
        by_job: dict[str, dict[str, JobEstimate]] = {}
        for arm, quote in sorted({**self.quotes, **self.full}.items()):
            for each in quote.estimates:
                by_job.setdefault(each.job, {}).setdefault(arm, each)
        return by_job

    def has_free_stations(self, job: JobSpec) -> bool:
        """Return whether no arm is at work at the stations of a job."""
        return self.busy.isdisjoint(job.stations)

    def in_the_way(self, arm: str, space: str | None) -> tuple[str, ...]:
        """Return the arms that take a space which excludes this one of an arm."""
        key = arm, space
        if key not in self._in_the_way:
            self._in_the_way[key] = arms_in_the_way(arm, space, self.taken, self.excludes)
        return self._in_the_way[key]

    @cached_property
    def _in_the_way(self) -> dict[tuple[str, str | None], tuple[str, ...]]:
        return {}

    def after(self, allocation: Mapping[str, "Assignment"]) -> "Bidding":
        """Return what is left once these jobs are awarded: their arms, stations and spaces are taken."""
        winners = {arm: self.offer(arm, job, plan) for job, (arm, plan) in allocation.items()}
        spaces = {arm: frozenset([(offer and offer.space) or ANYWHERE]) for arm, offer in winners.items()}
        return dataclasses.replace(
            self,
            quotes={arm: quote for arm, quote in self.quotes.items() if arm not in winners},
            full={**self.full, **{arm: self.quotes[arm] for arm in winners}},
            busy=self.busy.union(*(job.stations for job in self.jobs if job.name in allocation)),
            at_work=self.at_work | winners.keys(),
            taken={**self.taken, **spaces},
        )


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
        estimate = bidding.estimates(job).get(quote.arm)
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
    places = {job.name: frozenset(job.stations) for job in bidding.jobs}
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


def no_arm_can(reasons: Mapping[str, str], *, all_known: bool = True, absent: Set[str] = frozenset()) -> str:
    """Return the reason of a job that no arm can do, from the reasons of the arms.

    Args:
        all_known: Whether all present arms have answered.
        absent: Arms that are not present, of which it is unknown whether they can.
    """
    if absent:
        return _no_arm(reasons, [_not_present(absent)], "arm")
    start = f"No arm {'' if all_known else 'that has answered '}can do it: "
    each = start + "; ".join(f"{arm}: {reason}" for arm, reason in sorted(reasons.items())) + "."
    if len(each) <= MAX_REASON:
        return each
    alike: dict[str, list[str]] = defaultdict(list)
    for arm, reason in sorted(reasons.items()):
        alike[_NUMBER.sub("", reason)].append(arm)
    parts = [
        f"{first}: {reasons[first]}" + (f" ({len(more)} more alike)" if more else "")
        for first, *more in sorted(alike.values(), key=len)
    ]
    return _short(f"{start}{'; '.join(parts)}.")


def _short(reason: str) -> str:
    return reason if len(reason) <= MAX_REASON else f"{reason[: MAX_REASON - 1]}…"


def reason_to_wait(bidding: Bidding, job: str) -> str:
    """Return why no arm begins a job, by the quotes of a round that has just closed."""
    if any(each.name == job and not bidding.has_free_stations(each) for each in bidding.jobs):
        return "Its place was in use when it was last offered."
    estimates, excluded = bidding.estimates(job), bidding.excluded.get(job, {})
    able = {arm: each.plans for arm, each in estimates.items() if each.feasible}
    if offered := {arm: plans for arm in able if (plans := bidding.plans(arm, job))}:
        late = _lateness(bidding, job, (plan for plans in offered.values() for plan in plans.values()))
        return _short(f"The policy lets it wait: {late}{', '.join(offered)} could begin it.")
    refusals = {
        arm: each.reason or "infeasible" for arm, each in estimates.items() if not each.feasible and arm not in excluded
    }
    if NOT_PLANNED in refusals.values():
        return "Arms are planning its motion."
    quoted = bidding.quotes.keys() | bidding.full.keys()
    unquoted = dict.fromkeys(quoted - estimates.keys(), "did not quote this job")
    out = {arm: why for arm, why in excluded.items() if arm in quoted}
    others = [f"{arm} {why}" for arm, why in sorted({**unquoted, **out, **bidding.unasked}.items())]
    if not able:
        if bidding.absent:
            others.append(_not_present(bidding.absent))
        return _no_arm(refusals, others, "other arm" if out else "arm")
    plans = [(arm, plan) for arm in able.keys() & bidding.quotes for plan in able[arm]]
    in_way = {other for arm, plan in plans for other in bidding.in_the_way(arm, plan.space)}
    are = "are" if len(in_way) > 1 else "is"
    reasons = [f"It waits until {', '.join(sorted(in_way))} {are} out of the way."] if in_way else []
    reasons += [f"{_not_present(in_way & bidding.absent)}."] if in_way & bidding.absent else []
    taken = [f"{arm} {_why_without_capacity(bidding, arm)}" for arm in able if arm in bidding.full]
    reasons += [f"{', '.join([*taken, *others])}."] if taken or others else []
    return _short(" ".join(reasons))


def _no_arm(refusals: Mapping[str, str], others: Sequence[str], asked: str) -> str:
    """Return why no arm with a quote can do a job.

    Args:
        refusals: Reasons of the arms that cannot.
        others: What is known of each other arm.
        asked: Name of the arms that cannot.
    """
    if not others:
        return no_arm_can(refusals) if refusals else "No arm has answered whether it can do it."
    start = f"No {asked} that was asked can do it, and " if refusals else ""
    return _short(f"{start}{', '.join(others)}.")


def _not_present(arms: Iterable[str]) -> str:
    """Return that some arms are not present; of many only the first are named."""
    names = sorted(arms)
    shown, more = names[:MOST_ABSENT], len(names[MOST_ABSENT:])
    others = f" and {more} other{'s' if more > 1 else ''}" if more else ""
    return f"{', '.join(shown)}{others} {'are' if len(names) > 1 else 'is'} not present"


def _lateness(bidding: Bidding, job: str, plans: Iterable[PlanQuote]) -> str:
    """By how much a job would end after its due date if it began now; "" if in time, or without such a date."""
    due_s = next((each.due_s for each in bidding.jobs if each.name == job), None)
    takes_s = min(plan.duration_s or 0.0 for plan in plans)
    late_s = 0.0 if due_s is None else bidding.time_s + takes_s - due_s
    return f"it would end {late_s / 60:.0f} min late; " if late_s >= 60.0 else ""


def _why_without_capacity(bidding: Bidding, arm: str) -> str:
    quote, state = bidding.full[arm], bidding.states.get(arm)
    if arm in bidding.unfit:
        return bidding.unfit[arm]
    if quote.mode == "faulted":
        return "is faulted"
    if state is not None and state.break_in_s == 0.0:
        return "has a break"
    if quote.headroom_k <= 0.0:
        return "is above its warning limit"
    if state is None or state.job or arm in bidding.at_work:
        return "has a job"
    return "is on its way home" if state.space else "accepts no job now"


def planned_jobs(quotes: Mapping[str, Quote]) -> set[str]:
    """Return the jobs for which an arm quotes a plan, and those for which every arm says that it has none."""
    offers = [offer for quote in quotes.values() for offer in quote.estimates]
    open_jobs = {offer.job for offer in offers if offer.reason == NOT_PLANNED}
    return {offer.job for offer in offers if offer.feasible or offer.job not in open_jobs}


class Refusals:
    """Jobs that arms cannot do, by their last quotes or bids."""

    def __init__(self) -> None:
        """Start without any."""
        self._reasons: dict[str, dict[str, str]] = {}
        """By arm, by job; "" of an arm that can do it."""

    def note(self, quote: Quote | Bid) -> None:
        """Note which jobs an arm can do."""
        for offer in quote.estimates:
            by_arm = self._reasons.setdefault(offer.job, {})
            by_arm[quote.arm] = "" if offer.feasible else offer.reason or "infeasible"
        while len(self._reasons) > MAX_UNKNOWN:
            del self._reasons[next(iter(self._reasons))]

    def of_all(self, job: str, arms: Set[str]) -> Mapping[str, str]:
        """Return the reasons, by arm, why none of these arms, and no other that has answered, can do a job.

        They are empty if one can, or one of these has not answered.
        """
        reasons = self._reasons.get(job, {})
        known = bool(reasons) and not (arms - reasons.keys() or NOT_PLANNED in reasons.values())
        return reasons if known and all(reasons.values()) else {}

    def refused_by_all(self, arms: Set[str], job: str) -> bool:
        """Return whether there are reasons as of `of_all`."""
        return bool(self.of_all(job, arms))


class BackOff(NamedTuple):
    """Why, how often in a row, and until which real second an arm was not awarded a job."""

    why: str
    times: int
    until_s: float


ANY_JOB = ""
"""In place of the name of a job: all of them."""


class BackOffs:
    """Arms that are not awarded a job for a while: they refused it, or did not answer its award.

    The pause doubles each time in a row. An arm that has not answered several awards in a row is awarded no job.
    """

    def __init__(self, first_s: float, longest_s: float) -> None:
        """Start without any; arguments in real seconds, the first pause and the longest."""
        self._first_s, self._longest_s = first_s, longest_s
        self._last: dict[tuple[str, str], BackOff] = {}
        """By arm and job; of the awards that an arm has not answered in a row, by `ANY_JOB`."""

    def add_refusal(self, arm: str, job: str, why: str, real_s: float) -> None:
        """Count the refusal of an award."""
        self._last.pop((arm, ANY_JOB), None)
        self._add(arm, job, f"has refused it: {why.rstrip('.') or 'no reason'}", real_s)

    def add_unanswered(self, arm: str, job: str, real_s: float) -> None:
        """Count an award that has ended without an answer."""
        self._add(arm, job, "did not answer its award", real_s)
        self._add(arm, ANY_JOB, "", real_s)

    def end(self, arm: str, job: str) -> None:
        """End the back-offs of an arm that has accepted a job."""
        self._last.pop((arm, job), None)
        self._last.pop((arm, ANY_JOB), None)

    def forget(self, arm: str) -> None:
        """Forget all of an arm: it may come back with another program."""
        self._last = {key: each for key, each in self._last.items() if key[0] != arm}

    def why_by_job(self, real_s: float) -> dict[str, dict[str, str]]:
        """Return why arms are not awarded a job now, by arm, by job."""
        by_job: dict[str, dict[str, str]] = {}
        for (arm, job), each in self._last.items():
            if job != ANY_JOB and real_s < each.until_s:
                by_job.setdefault(job, {})[arm] = each.why
        return by_job

    def why_no_job(self, arm: str, real_s: float) -> str:
        """Return why an arm is awarded no job now; "" if it may be."""
        each = self._last.get((arm, ANY_JOB))
        return self.unanswering.get(arm, "") if each is not None and real_s < each.until_s else ""

    @property
    def unanswering(self) -> dict[str, str]:
        """Arms that have not answered several awards in a row, and that they have not."""
        return {
            arm: f"has not answered the last {each.times} awards"
            for (arm, job), each in self._last.items()
            if job == ANY_JOB and each.times >= MOST_UNANSWERED
        }

    def _add(self, arm: str, job: str, why: str, real_s: float) -> None:
        last = self._last.pop((arm, job), None)
        times = 1 if last is None else last.times + 1
        pause_s = min(self._first_s * 2.0 ** min(times - 1, 30), self._longest_s)
        self._last[arm, job] = BackOff(why, times, real_s + pause_s)
        if len(self._last) > MAX_BACK_OFFS:
            del self._last[next(iter(self._last))]


def without_excluded(quote: Quote, excluded: Mapping[str, Mapping[str, str]]) -> Quote:
    """Return a quote without the plans for jobs that its arm is not awarded for a while, as in `Bidding`."""
    estimates = (JobEstimate(each.job) if quote.arm in excluded.get(each.job, ()) else each for each in quote.estimates)
    return replace(quote, estimates=tuple(estimates)) if excluded else quote


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
    unusable: dict[str, str] = field(default_factory=dict[str, str])
    """What is wrong with the replies of arms without a usable quote, by arm."""
    silent: frozenset[str] = frozenset()
    """Awards that were silent when the round was opened."""

    def complete(self, present: frozenset[str]) -> bool:
        """Return whether every arm that was asked and is still present has answered."""
        return (self.asked & present) <= self.quotes.keys() | self.unusable.keys()


def new_awards(book: JobBook, bidding: Bidding, allocation: Mapping[str, Assignment], time_s: float) -> list[Granted]:
    """Return the records of the awards of a round."""
    records: list[Granted] = []
    for job, (arm, plan) in allocation.items():
        offer, entry = bidding.offer(arm, job, plan), book.jobs[job]
        assert offer is not None, "drop_invalid keeps jobs with a bid"
        assert entry.spec is not None, "a job of a round is known"
        award = Granted(
            f"{bidding.auction}:{job}",
            job,
            arm,
            time_s,
            cycles=entry.cycles,
            places=entry.spec.stations,
            space=offer.space or ANYWHERE,
            auction=bidding.auction,
            quote=bidding.quotes[arm].quote,
            plan=plan,
            difficulty=offer.difficulty,
            p_saturation=offer.p_saturation,
            peak_c=offer.peak_c,
            offers=offers_of(bidding, job, Assignment(arm, plan)),
        )
        records.append(award)
    return records


Out = QuoteRequest | SendAward | Announcement | Result | Operation


def space_of(book: JobBook, awards: Iterable[str], arm: str) -> set[str]:
    """Return the names of the spaces of an arm's awards; unknown awards have none."""
    grants = (book.grant_of(award) for award in awards)
    return {grant.record.space for grant in grants if grant is not None and grant.record.arm == arm}


def closed_space(book: JobBook) -> Mapping[str, frozenset[str]]:
    """Return the names of the spaces that each arm may take for ended grants alone."""
    still_open: dict[str, set[str]] = {}
    for grant in book.open.values():
        still_open.setdefault(grant.record.arm, set()).add(grant.record.space)
    return {arm: names - still_open.get(arm, set()) for arm, names in book.space.items()}


def silent_awards(book: JobBook) -> frozenset[str]:
    """Return the awards in their last cycle whose arms have not renewed the lease."""
    return frozenset(award for award, grant in book.open.items() if grant.silent)


def retaken_space(book: JobBook, arm: str, space: Set[str]) -> list[SpaceTaken]:
    """Return what changes when an arm takes this space; it counts as free after a person has freed it.

    Args:
        space: Names of spaces that the arm takes, or for which it has an award.
    """
    taken = book.taken_space().get(arm, frozenset())
    if ANYWHERE in taken or space <= taken:
        return []
    return [SpaceTaken(arm, tuple(sorted(book.space.get(arm, frozenset()) | space)), book.time_s)]


def _stated_space(quote: Quote) -> frozenset[str]:
    """Return the names of the spaces that an arm takes, and of those of its jobs, by its quote."""
    if quote.space is None:
        return frozenset() if quote.mode == "idle" else frozenset([ANYWHERE])
    return frozenset(quote.space)


def stated_spaces(book: JobBook, closing: Round, time_s: float) -> list[SpaceTaken]:
    """Return what the quotes of a round change in the space that arms take.

    A quote says nothing about awards that were closed after the round was opened: these keep their space. An arm that
    takes no space has no job: it has lost the awards that were silent before, for example without a journal.
    """
    records: list[SpaceTaken] = []
    for arm, quote in sorted(closing.quotes.items()):
        before = book.space.get(arm, frozenset())
        grants = {award: grant for award, grant in book.open.items() if grant.record.arm == arm}
        silent = {award for award in grants.keys() & closing.silent if grants[award].silent}
        lost = silent if quote.space == () else set[str]()
        open_space = {grant.record.space for award, grant in grants.items() if award not in lost}
        after = (before - closing.space.get(arm, frozenset())) | (_stated_space(quote) - open_space)
        if after != before or lost:
            records.append(SpaceTaken(arm, tuple(sorted(after)), time_s, tuple(sorted(lost))))
    return records


SCAN_S = 0.05
"""Real seconds between two checks for jobs that have become ready."""
NO_JOB = JobSpec(name="space", kind="hold", places=("?",))
"""A job that no arm can do, to ask arms for their space before there was any job."""
NOT_OFFERED = (
    "It waits to be offered: at most {} jobs are offered at a time, first the ones that wait longest, last those that "
    "no arm can do."
)


class Rounds:
    """Rounds of one auctioneer, one after another.

    Attributes:
        open: The round that is open for bids; None between two rounds.
        allocate: The allocation rule.
        states: The last state of each arm, with its last possible temperatures.
        sensors: The motor sensors of each arm.
        present: Arms that are present.
        obstacle: Why no job is awarded; "" if jobs are.
        back_offs: Arms that are not awarded jobs for a while.
        now_s: Real second and fleet time of the last step.
    """

    def __init__(
        self,
        name: str,
        book: JobBook,
        allocate: Allocate,
        timing: Timing,
        excludes: Excludes,
        boot: str,
        send: Callable[[Out], object],
    ) -> None:
        """Start; arguments as of `fleet.live.auction.auctioneer.Auctioneer`."""
        self.open: Round | None = None
        self.states: dict[str, State] = {}
        self.sensors: defaultdict[str, ArmSensors] = defaultdict(ArmSensors)
        self.present: frozenset[str] = frozenset()
        self.obstacle = ""
        self.back_offs = BackOffs(*timing.refused_s)
        self._refusals = Refusals()
        self._name, self._book, self.allocate, self._send = name, book, allocate, send
        self._timing, self._excludes, self._boot = timing, excludes, boot
        self._count = 0
        self._later_s: dict[str, float] = {}
        """Real second from which a job may be offered again."""
        self._notes: dict[str, str] = {}
        """Why no arm began a job that was offered, by job."""
        self.now_s = -math.inf, -math.inf
        self._planned: set[str] = set()
        """Waiting jobs for which arms have plans, or have said that there is none."""
        self._scan_s = self._space_s = -math.inf
        """Real seconds from which jobs are offered, and arms are asked for their space alone."""
        self._pause_s = self._space_pause_s = timing.pause_s[0]

    def step(self, real_s: float, time_s: float) -> None:
        """Open or close a round if that is due."""
        self.now_s = real_s, time_s
        if self.open is None:
            if real_s >= self._scan_s:
                self._scan_s = real_s + SCAN_S
                self._begin(real_s, time_s)
        elif real_s >= self.open.until_s or self.open.complete(self.present):
            self._close(self.open, real_s, time_s)

    def scan_now(self) -> None:
        """Open the next round with the next step."""
        self._scan_s = -math.inf

    def reason_to_wait(self, job: JobSpec, busy: Container[str]) -> str:
        """Return why no arm begins a waiting job.

        Args:
            busy: Stations at which an arm may be at work.
        """
        book = self._book
        if self.obstacle:
            return self.obstacle
        if (pauser := book.operations.paused.get(ALL_ARMS)) is not None:
            return f"All arms are paused{by_whom(pauser)}."
        if not self.present:
            return "No arm is present."
        able = [arm for arm in sorted(self.present) if not book.is_paused(arm)]
        if not able:
            return "All present arms are paused."
        left_out = {arm: self.back_offs.why_no_job(arm, self.now_s[0]) for arm in able}
        if all(left_out.values()):
            return _short(f"{', '.join(f'{arm} {why}' for arm, why in left_out.items())}.")
        if reason := why_not_ready(job, self.now_s[1], book.is_finished, busy):
            return reason
        most, soon = self._timing.max_jobs, "It waits to be offered in the next round."
        return self._notes.get(job.name, NOT_OFFERED.format(most) if len(book.waiting) > most else soon)

    def is_planned(self, job: str) -> bool:
        """Return whether an arm has a plan for a waiting job, or all have said that there is none."""
        return job in self._planned

    def retry_now(self) -> None:
        """Offer delayed jobs again at once: something has changed."""
        self._later_s.clear()
        self._scan_s = self._space_s = -math.inf
        self._pause_s = self._space_pause_s = self._timing.pause_s[0]

    def delay(self, real_s: float, jobs: Iterable[str]) -> None:
        """Offer these jobs again after a pause, which is longer each time in a row."""
        self._later_s |= dict.fromkeys(jobs, real_s + self._pause_s)
        self._pause_s = min(2 * self._pause_s, self._timing.pause_s[1])

    # Inside

    def _begin(self, real_s: float, time_s: float) -> None:
        waiting = unanswered(self._book.leases)
        book = self._book
        able = {arm for arm in self.present if not (book.is_paused(arm) or self.back_offs.why_no_job(arm, real_s))}
        bidders = frozenset(able - {message.arm for _, message in waiting})
        if any(real_s < lease.sent_s + self._timing.window_s for lease, _ in waiting):
            return
        self._later_s = {job: at_s for job, at_s in self._later_s.items() if at_s > real_s}
        self._notes = {job: note for job, note in self._notes.items() if job in book.waiting}
        self._planned &= book.waiting.keys()
        # Many jobs that no arm can do would take the places of others in one round after the other.
        rank = partial(self._refusals.refused_by_all, able)
        jobs = tuple(book.ready(time_s, self._timing.max_jobs, excluded=self._later_s, rank=rank))
        busy = book.busy_stations()
        if not (bidders and any(busy.isdisjoint(job.stations) for job in jobs)):
            self._ask_for_space(real_s)
            return
        auction = self._open(jobs, bidders, real_s)
        self._send(Announcement(self._name, auction, time_s, tuple(job.name for job in jobs)))
        cycles = {job.name: done for job in jobs if (done := self._book.jobs[job.name].cycles)}
        self._send(QuoteRequest(auction, jobs, cycles=cycles))

    def _open(self, jobs: tuple[JobSpec, ...], asked: frozenset[str], real_s: float) -> str:
        """Open a round; return its name."""
        self._count += 1
        auction = f"{self._name}-{self._boot}-{self._count}"
        closed, silent = closed_space(self._book), silent_awards(self._book)
        self.open = Round(auction, jobs, asked, real_s + self._timing.window_s, closed, silent=silent)
        return auction

    def _ask_for_space(self, real_s: float) -> None:
        """Open a round without jobs for present arms that may still take space for closed or silent awards.

        Otherwise the space of an arm without a next job would stay closed, also when the arm has left. Only a quote
        frees it: a state may have been sent before the award. The quote is a dry run of the last job that was changed.
        """
        book = self._book
        closed = {arm for arm, names in closed_space(book).items() if names}
        silent = {book.open[award].record.arm for award in silent_awards(book)}
        takes_space = frozenset(closed | silent) & self.present
        if not takes_space or real_s < self._space_s:
            return
        last = book.jobs.get(book.recent[-1].status.job) if book.recent else None
        job = NO_JOB if last is None or last.spec is None else last.spec
        self._space_s = real_s + self._space_pause_s
        self._space_pause_s = min(2 * self._space_pause_s, self._timing.pause_s[1])
        auction = self._open((), takes_space, real_s)
        self._send(QuoteRequest(auction, (job,), dry_run=True))

    def _close(self, closing: Round, real_s: float, time_s: float) -> None:
        self.open = None
        spaces, before = stated_spaces(self._book, closing, time_s), self._book.space
        freed = any(each.lost or frozenset(each.space) < before.get(each.arm, frozenset()) for each in spaces)
        if not self._book.try_to_record("Nothing is awarded", *spaces):
            self.delay(real_s, (job.name for job in closing.jobs))
            return
        if not closing.jobs:
            if freed:
                self.retry_now()
            return
        waiting = self._book.waiting  # a job may have been settled meanwhile, and have left
        entries = [waiting[job.name] for job in closing.jobs if job.name in waiting]
        entries = [entry for entry in entries if entry.spec in closing.jobs]
        jobs = tuple(entry.spec for entry in entries if entry.spec is not None)
        quotes = {
            arm: self.sensors[arm].check_quote(quote)
            for arm, quote in closing.quotes.items()
            if self._may_work(arm, closing)
        }
        self._planned |= planned_jobs(quotes)
        for quote in quotes.values():
            self._refusals.note(quote)
        excluded = self.back_offs.why_by_job(real_s)
        usable = {arm: without_excluded(quote, excluded) for arm, quote in quotes.items()}
        taken = self._book.taken_space()
        bidding = Bidding(
            closing.auction,
            time_s,
            jobs,
            {arm: quote for arm, quote in usable.items() if quote.capacity},
            {arm: quote for arm, quote in usable.items() if not quote.capacity},
            states=self.states,
            returned={entry.name: (len(entry.faults), entry.returned_s) for entry in entries if entry.returns},
            busy=self._book.busy_stations(),
            taken=taken,
            excludes=self._excludes,
            absent=frozenset(arm for arm in taken if taken[arm] or arm in self._book.arms) - self.present,
            unasked={arm: self._why_unasked(arm, closing, real_s) for arm in self.present - quotes.keys()},
            excluded=excluded,
            unfit={arm: why for arm in quotes if (why := self.sensors[arm].why_unfit)},
            at_work=frozenset(arm for arm, _ in self._book.at_work().values()),
        )
        allocation = drop_invalid(bidding, self.allocate(bidding)) if bidding.quotes and jobs else {}
        try:
            self._award(bidding, allocation, real_s, time_s)
        except JournalFull as error:
            _LOG.error("Nothing is awarded: %s", error)
            allocation = {}
        left = bidding.after(allocation) if allocation else bidding
        self._notes |= {job.name: reason_to_wait(left, job.name) for job in jobs if job.name not in allocation}
        if allocation:
            self._scan_s, self._pause_s = -math.inf, self._timing.pause_s[0]
        else:
            if not bidding.quotes:  # no arm has capacity for any job
                self._scan_s = real_s + self._pause_s
            self.delay(real_s, (job.name for job in closing.jobs))

    def _why_unasked(self, arm: str, closing: Round, real_s: float) -> str:
        paused = self._book.operations.paused
        if arm in paused:
            return f"is paused{by_whom(paused[arm])}"
        if why := self.back_offs.why_no_job(arm, real_s):
            return why
        if any(message.arm == arm for _, message in unanswered(self._book.leases)):
            return "has not answered its last award yet"
        if arm not in closing.asked:
            return "was not asked in time"
        return closing.unusable.get(arm, "has not answered in time")

    def _may_work(self, arm: str, closing: Round) -> bool:
        return arm in closing.asked & self.present and not self._book.is_paused(arm)

    def _award(self, bidding: Bidding, allocation: dict[str, Assignment], real_s: float, time_s: float) -> None:
        self._book.record(*(records := new_awards(self._book, bidding, allocation, time_s)))
        specs = {job.name: job for job in bidding.jobs}
        for record in records:
            self._notes.pop(record.job, None)
            terms = (record.quote, specs[record.job], record.cycles, self._timing.lease_s, record.plan)
            award = Award(record.award, bidding.auction, self._name, *terms, epoch=self._book.epoch)
            message = SendAward(record.arm, award)
            until_s = real_s + self._timing.counted_lease_s
            plan = bidding.offer(record.arm, record.job, record.plan)
            takes_s = math.inf if plan is None or plan.duration_s is None else plan.duration_s
            counted = CountedLease(until_s, 0, message, real_s, takes_s=takes_s, progress_s=(real_s, time_s))
            self._book.leases[record.award] = counted
            self._send(message)
