"""An arm's part in sharing out jobs among equals: it bids, and works out from all bids who gets what.

A state machine without a clock and without I/O. Real seconds (`real_s`, monotonic) and the fleet's time (`time_s`) come
as arguments; what is to be said or asked lies in `out`. Safety does not rest on it, but on the majority that has to
grant what is claimed (`fleet.live.claiming`, `fleet.live.granting`). That all arms work out the same result keeps them
out of each other's way; where they heard different things, two may want one job, and who gets no majority waits.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from random import Random

import msgspec

from fleet.bus.council import Bid, Claim, Grant
from fleet.bus.trade import Ack, Award, JobStatus, JobWord, Offer, Quote
from fleet.live.bidding import Allocate, Bidding, sound
from fleet.live.claiming import Claimant
from fleet.live.contractor import Contractor
from fleet.live.granting import Grantor
from fleet.live.overview import FRESH_S
from fleet.live.standing import by_grants
from fleet.live.timing import Timing

QUIET_S = 0.05
"""Real seconds without news of who bids for what, after which all have most likely heard the same."""
BID_S = 1.0
"""Real seconds between two bids in which nothing is new but the costs."""
MOST_NAMED = 32
"""Jobs in one bid."""


@dataclass(frozen=True, kw_only=True)
class Faculties:
    """What the arm itself contributes."""

    offers: Callable[[tuple[JobWord, ...]], tuple[Offer, ...]]
    """What jobs would cost it now."""
    unfit: Callable[[], str]
    """Why it takes no work just now; "" if it does."""
    take: Callable[[Award, float], Ack]
    """Takes an award in hand."""


class Council:
    """One arm among its peers, in one life.

    Attributes:
        jobs: All that it knows of, in the order of their release.
        claimant: What it claims, and holds.
        grantor: What it grants.
        out: Bids and claims to be said, oldest first; whoever drives it takes them out.
        ended: The shift is over: it wants no more jobs.
        rounds: How often it has worked out who gets what.
        changed_s: When it was news last who bids for what, real seconds.
    """

    def __init__(
        self,
        contractor: Contractor,
        grantor: Grantor,
        faculties: Faculties,
        *,
        agree: Allocate,
        life: int,
        rng: Random,
        timing: Timing | None = None,
    ) -> None:
        """Begin.

        Args:
            agree: What all arms make of all bids; a function of these alone.
            life: Counts up with every start of the arm.
            rng: Draws how long to wait where two got into each other's way.
        """
        self.arm, self.contractor, self.grantor = contractor.arm, contractor, grantor
        self.claimant = Claimant(contractor, grantor, faculties.take, life=life, timing=timing)
        self.jobs: dict[str, JobWord] = {}
        self.out: deque[Bid | Claim] = deque()
        self.ended, self.rounds = False, 0
        self._faculties, self._agree, self._rng, self._timing = faculties, agree, rng, timing or Timing()
        self._number = life * 1_000_000_000
        self._bids: dict[str, tuple[Bid, float]] = {}
        self._there: frozenset[str] = frozenset()
        self._bid_s = self._decided_s = self.changed_s = -math.inf
        self._about: object = None
        """What the last bid was about."""
        self._news = False
        self._later_s: dict[str, float] = {}
        self._pauses: dict[str, int] = {}
        self._behind_s: dict[str, float] = {}
        """Since when other arms know of fewer jobs that are settled, real seconds."""
        self._retold = 0

    # What comes from outside

    def know(self, words: Iterable[JobWord]) -> None:
        """There are these jobs."""
        fresh = [word for word in words if word.name not in self.jobs]
        if fresh:
            every = sorted([*self.jobs.values(), *fresh], key=_order)
            self.jobs = {word.name: word for word in every}

    def seen(self, there: frozenset[str]) -> None:
        """These arms show that they are alive."""
        self._there = there & self.grantor.roster

    def heard(self, bid: Bid, real_s: float) -> None:
        """An arm, maybe this one, has said what it would take."""
        before = self._bids.get(bid.arm)
        if bid.arm not in self.grantor.roster or (before is not None and bid.number < before[0].number):
            return
        self._bids[bid.arm] = bid, real_s
        if before is None or _gist(before[0]) != _gist(bid):
            self.changed_s, self._news = real_s, True
        if bid.arm != self.arm:
            self._put_right(bid, real_s)

    def _put_right(self, bid: Bid, real_s: float) -> None:
        """Tell an arm how it ended with a job that it holds for open, and of jobs that it does not know."""
        register = self.grantor.register
        for job in bid.open:
            if job in register.settled:
                self.claimant.correct(register.settled[job])
        if bid.settled >= len(register.settled):
            self._behind_s.pop(bid.arm, None)
        elif real_s >= self._behind_s.setdefault(bid.arm, real_s) + 2 * BID_S:
            every = list(register.settled.values())
            for _ in range(min(MOST_NAMED, len(every))):
                self._retold = (self._retold + 1) % len(every)
                self.claimant.correct(every[self._retold])
        full = len(bid.open) == MOST_NAMED and bid.open[-1] in self.jobs
        last = _order(self.jobs[bid.open[-1]]) if full else (math.inf, "")
        left = self.left(real_s) if register.jobs else []
        for job in left:
            if job in register.jobs and job not in bid.open and _order(self.jobs[job]) < last:
                self.claimant.tell(self.jobs[job])

    def asked(self, claim: Claim, real_s: float) -> Grant:
        """Answer to a peer's claim.

        Raises:
            Objection: it is not answered.
        """
        grant = self.grantor.asked(claim, real_s)
        self.know(claim.jobs)
        return grant

    def answered(self, grant: Grant, real_s: float) -> None:
        """A peer has answered a claim."""
        self.claimant.answered(grant, real_s)

    # What it does by itself

    def tick(self, real_s: float, time_s: float) -> None:
        """Do what is due."""
        for job in self.claimant.vain:
            self._pause(job, real_s)
        self.claimant.vain.clear()
        self._bid(real_s, time_s)
        self._decide(real_s)
        if claim := self.claimant.claim(self._there, real_s):
            self.out.append(claim)

    def left(self, real_s: float) -> list[str]:
        """Jobs that are not settled, as far as it knows; nor is one whose arm was about to finish it and is gone."""
        register = self.grantor.register
        gone = {job for job in self.grantor.silent(real_s) if register.gifts[job].arm not in self._there}
        return [job for job in self.jobs if job not in register.settled and job not in gone]

    def over(self, real_s: float) -> bool:
        """Whether every arm that is there, a majority at least, knows that every job is settled."""
        others = [self._bids.get(arm) for arm in self._there - {self.arm}]
        if len(others) + 1 < self.claimant.majority:
            return False
        known = all(bid is not None and bid[0].left == 0 and real_s < bid[1] + FRESH_S for bid in others)
        return known and not (self.left(real_s) or self.contractor.owes or self.contractor.held)

    def status(self, later: Iterable[JobWord], real_s: float) -> list[JobStatus]:
        """Where all jobs stand, as far as it knows; `later` ones are still to come."""
        names = dict.fromkeys([*self.jobs, *(word.name for word in later), *self.grantor.register.settled])
        found = [by_grants(name, self.grantor, real_s) for name in names]
        return [_given_up(said) if self.ended and said.state == "waiting" else said for said in found]

    # Who gets what

    def _free(self, real_s: float) -> dict[str, JobWord]:
        """Jobs that nobody has, at stations at which nobody is, as far as it knows."""
        taken, settled = self.grantor.taken(real_s), self.grantor.register.settled
        return {
            name: word
            for name, word in self.jobs.items()
            if name not in settled and not self.grantor.bars(name, real_s) and not taken & frozenset(word.places)
        }

    def _ready(self, real_s: float, time_s: float) -> tuple[JobWord, ...]:
        """The first of these that could begin now: released, after their predecessors, not tried in vain just now."""
        settled, found = self.grantor.register.settled, list[JobWord]()
        for name, word in self._free(real_s).items():
            if word.release_s > time_s or len(found) == MOST_NAMED:
                break
            before = [settled.get(job) for job in word.after]
            done = all(told is not None and told.outcome == "finished" for told in before)
            if done and self._later_s.get(name, -math.inf) <= real_s:
                found.append(word)
        return tuple(found)

    def _bid(self, real_s: float, time_s: float) -> None:
        """Say what it would take, when that is new, and now and then."""
        room = 0 if self.ended or self._faculties.unfit() else max(0, self.claimant.room)
        ready = self._ready(real_s, time_s) if room else ()
        left = self.left(real_s)
        about = (room, tuple(word.name for word in ready), len(left))
        if about == self._about and real_s < self._bid_s + BID_S:
            return
        self._about, self._bid_s = about, real_s
        self._number += 1
        offers = self._faculties.offers(ready) if ready else ()
        settled = len(self.grantor.register.settled)
        bid = Bid(self.arm, self._number, time_s, room, offers, len(left), settled, tuple(left[:MOST_NAMED]))
        self.heard(bid, real_s)
        self.out.append(bid)

    def _decide(self, real_s: float) -> None:
        """Work out who gets what, once everybody that is there was heard, and claim what is its own."""
        own = self._bids[self.arm][0]
        news = self._news or real_s >= self._decided_s + BID_S
        if not (own.offers and news) or self.claimant.wishes or self.claimant.room < 1:
            return
        voices = {arm: bid for arm, (bid, at_s) in sorted(self._bids.items()) if real_s < at_s + FRESH_S}
        if len(voices) < self.claimant.majority:
            return
        hasty = self._there - voices.keys() or real_s < self.changed_s + QUIET_S
        if hasty and real_s < self._bid_s + self._timing.window_s:
            return
        self._news, self._decided_s = False, real_s
        self.rounds += 1
        named = {offer.job for bid in voices.values() for offer in bid.offers}
        jobs = tuple(word for name, word in self._free(real_s).items() if name in named)
        quotes = {arm: _quote(bid) for arm, bid in voices.items() if bid.capacity and bid.offers}
        bidding = Bidding("council", max(bid.time_s for bid in voices.values()), jobs, quotes)
        result = sound(bidding, self._agree(bidding)) if jobs else {}
        for word in jobs:
            if result.get(word.name) == self.arm:
                self.claimant.want(word, real_s)
            elif all(bidding.offer(arm, word.name) is None for arm in quotes):
                self._pause(word.name, real_s)  # nobody can do it: make room for others

    def _pause(self, job: str, real_s: float) -> None:
        """Bid for a job again only after a while, longer each time, and not as long as the other that wanted it."""
        first_s, most_s = self._timing.pause_s
        count = self._pauses[job] = self._pauses.get(job, 0) + 1
        self._later_s[job] = real_s + min(most_s, first_s * 2.0 ** min(count - 1, 10)) * self._rng.uniform(0.2, 1.0)


def _given_up(said: JobStatus) -> JobStatus:
    return msgspec.structs.replace(said, state="unfinished", reason="The shift ended before it was done.")


def _order(word: JobWord) -> tuple[float, str]:
    """Jobs are named in this order."""
    return word.release_s, word.name


def _gist(bid: Bid) -> tuple[bool, frozenset[str]]:
    """What decides who takes part in what."""
    return bool(bid.capacity), frozenset(offer.job for offer in bid.offers)


def _quote(bid: Bid) -> Quote:
    """A bid as the rules of an auction know it."""
    return Quote(
        arm=bid.arm,
        auction="council",
        quote="",
        valid_s=0.0,
        twin="",
        time_s=bid.time_s,
        mode="idle",
        headroom_k=0.0,
        capacity=bid.capacity,
        offers=bid.offers,
    )
