"""An arm's part in allocation by consensus: it bids, chooses a job by its policy, and claims it.

A state machine without a clock and without I/O. Real seconds (`real_s`, monotonic) and the fleet's time (`time_s`) come
as arguments; messages to send are in `out`. The steps of an arm with room for a job:

1. It publishes a bid with an offer for every job that could begin now.
2. When the bids of its peers are there, its policy chooses a job from what it knows, and the next bid names it.
3. When the choices of its peers are there, of two that exclude each other the one with the lower difficulty remains.
4. It claims the job that remains (`fleet.live.consensus.claimant`); a majority has to reply it.

Safety rests on step 4 alone (`fleet.live.consensus.granter`). Steps 1 to 3 only keep the arms from claiming the same
job: where messages are lost two arms may claim one, and the one without a majority waits and tries again.
"""

import logging
import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from random import Random

import msgspec

from fleet.bus.protocol.auction import Ack, Award, JobEstimate, JobSpec, JobStatus, Quote
from fleet.bus.protocol.consensus import Bid, Claim, ClaimReply
from fleet.bus.protocol.messages import State
from fleet.live.arm.award_executor import AwardExecutor
from fleet.live.auction.knowledge import LiveFleet, claimed_jobs, observe
from fleet.live.auction.lease_timing import Timing
from fleet.live.auction.round import Bidding, resolve_claims
from fleet.live.consensus.claimant import Claimant
from fleet.live.consensus.granter import Granter
from fleet.live.consensus.job_status import status_by_grants
from fleet.live.monitor.snapshot import FRESH_S
from fleet.observation import Observation

_LOG = logging.getLogger(__name__)

QUIET_S = 0.05
"""Real seconds without a new bid or choice, after which all arms have most likely heard the same."""
BID_S = 1.0
"""Real seconds between two bids in which nothing is new but the costs."""
MOST_NAMED = 32
"""Jobs in one bid."""

Choose = Callable[[Observation, int], int]
"""The action of an arm by its observation and its place in the fleet: 0 waits, k claims slot k."""


@dataclass(frozen=True, kw_only=True)
class ArmInterface:
    """What the arm itself contributes."""

    offers: Callable[[tuple[JobSpec, ...]], tuple[JobEstimate, ...]]
    """What jobs would cost it now."""
    unfit: Callable[[], str]
    """Why it takes no job now; "" if it does."""
    take: Callable[[Award, float], Ack]
    """Accepts an award."""


class Participant:
    """One arm among its peers, from one start of its process to the next.

    Attributes:
        jobs: All that it knows of, in the order of their release.
        claimant: What it claims, and holds.
        granter: What it grants.
        states: The last state of each arm; whoever drives it puts them in.
        out: Bids and claims to send, oldest first; whoever drives it takes them out.
        ended: The shift is over: it takes no more jobs.
        rounds: How often its policy has chosen.
        changed_s: When a bid or choice last changed, real seconds.
    """

    def __init__(
        self,
        executor: AwardExecutor,
        granter: Granter,
        interface: ArmInterface,
        *,
        fleet: LiveFleet,
        choose: Choose,
        life: int,
        rng: Random,
        slots: int = MOST_NAMED,
        timing: Timing | None = None,
    ) -> None:
        """Begin.

        Args:
            choose: The policy of this arm.
            life: Counts up with every start of the arm.
            rng: Draws how long to wait after a rejected claim.
            slots: Jobs that the policy chooses from.
        """
        self.arm, self.executor, self.granter = executor.arm, executor, granter
        self.claimant = Claimant(executor, granter, interface.take, life=life, timing=timing)
        self.jobs: dict[str, JobSpec] = {}
        self.states: dict[str, State] = {}
        self.out: deque[Bid | Claim] = deque()
        self.ended, self.rounds = False, 0
        self._interface, self._fleet, self._choose_action = interface, fleet, choose
        self._slots, self._rng, self._timing = min(slots, MOST_NAMED), rng, timing or Timing()
        self._number = life * 1_000_000_000
        self._bids: dict[str, tuple[Bid, float]] = {}
        self._present: frozenset[str] = frozenset()
        self._bid_s = self._chosen_s = self.changed_s = -math.inf
        self._about: object = None
        """What the last bid was about."""
        self._choice = ""
        """The job that its policy chose, until it is claimed or another arm has it."""
        self._lost = self._news = False
        self._later_s: dict[str, float] = {}
        self._pauses: dict[str, int] = {}
        self._behind_s: dict[str, float] = {}
        """Since when other arms know of fewer settled jobs, real seconds."""
        self._corrected = 0

    # Messages

    def add_jobs(self, words: Iterable[JobSpec]) -> None:
        """Add jobs that it does not know yet."""
        fresh = [word for word in words if word.name not in self.jobs]
        if fresh:
            every = sorted([*self.jobs.values(), *fresh], key=_order)
            self.jobs = {word.name: word for word in every}

    def set_present(self, present: frozenset[str]) -> None:
        """These arms show that they are alive."""
        self._present = present & self.granter.roster

    def apply_bid(self, bid: Bid, real_s: float) -> None:
        """Take a bid, of a peer or its own."""
        before = self._bids.get(bid.arm)
        if bid.arm not in self.granter.roster or (before is not None and bid.number < before[0].number):
            return
        self._bids[bid.arm] = bid, real_s
        if before is None or _gist(before[0]) != _gist(bid):
            self.changed_s, self._news = real_s, True
        elif before[0].choice != bid.choice:
            self.changed_s = real_s
        if bid.arm != self.arm:
            self._send_corrections(bid, real_s)

    def _send_corrections(self, bid: Bid, real_s: float) -> None:
        """Send a peer the outcome of jobs that it takes for open, and jobs that it does not know."""
        register = self.granter.register
        for job in bid.open_jobs:
            if job in register.settled:
                self.claimant.send_outcome(register.settled[job])
        if bid.closed_count >= len(register.settled):
            self._behind_s.pop(bid.arm, None)
        elif real_s >= self._behind_s.setdefault(bid.arm, real_s) + 2 * BID_S:
            every = list(register.settled.values())
            for _ in range(min(MOST_NAMED, len(every))):
                self._corrected = (self._corrected + 1) % len(every)
                self.claimant.send_outcome(every[self._corrected])
        full = len(bid.open_jobs) == MOST_NAMED and bid.open_jobs[-1] in self.jobs
        last = _order(self.jobs[bid.open_jobs[-1]]) if full else (math.inf, "")
        for job in self.open_jobs(real_s) if register.jobs else []:
            if job in register.jobs and job not in bid.open_jobs and _order(self.jobs[job]) < last:
                self.claimant.send_job(self.jobs[job])

    def answer_claim(self, claim: Claim, real_s: float) -> ClaimReply:
        """Answer to a peer's claim.

        Raises:
            Objection: it is not answered.
        """
        reply = self.granter.answer_claim(claim, real_s)
        self.add_jobs(claim.jobs)
        return reply

    def apply_reply(self, reply: ClaimReply, real_s: float) -> None:
        """Take a peer's answer to a claim."""
        self.claimant.apply_reply(reply, real_s)

    # Time

    def tick(self, real_s: float, time_s: float) -> None:
        """Do what is due."""
        for job in self.claimant.rejected:
            self._lost = True
            self._pause(job, real_s)
        self.claimant.rejected.clear()
        self._bid(real_s, time_s)
        if self._choice:
            self._claim_choice(real_s)
        else:
            self._choose(real_s, time_s)
        if claim := self.claimant.claim(self._present, real_s):
            self.out.append(claim)

    def open_jobs(self, real_s: float) -> list[str]:
        """Jobs that are not settled, as far as it knows, but for those whose arm fell silent in the last cycle."""
        register = self.granter.register
        gone = {job for job in self.granter.out_of_contact(real_s) if register.grants[job].arm not in self._present}
        return [job for job in self.jobs if job not in register.settled and job not in gone]

    def all_settled(self, real_s: float) -> bool:
        """Whether every present arm, a majority at least, knows that every job is settled."""
        others = [self._bids.get(arm) for arm in self._present - {self.arm}]
        if len(others) + 1 < self.claimant.majority:
            return False
        known = all(bid is not None and bid[0].open_count == 0 and real_s < bid[1] + FRESH_S for bid in others)
        return known and not (self.open_jobs(real_s) or self.executor.has_pending_reports or self.executor.active)

    def status(self, later: Iterable[JobSpec], real_s: float) -> list[JobStatus]:
        """Status of all jobs, as far as it knows; `later` ones are not released yet."""
        names = dict.fromkeys([*self.jobs, *(word.name for word in later), *self.granter.register.settled])
        statuses = [status_by_grants(name, self.granter, real_s) for name in names]
        return [_given_up(status) if self.ended and status.state == "waiting" else status for status in statuses]

    # Bids and choices

    def _free(self, real_s: float) -> dict[str, JobSpec]:
        """Jobs that no arm has, at free stations, as far as it knows."""
        taken, settled = self.granter.busy_stations(real_s), self.granter.register.settled
        return {
            name: word
            for name, word in self.jobs.items()
            if name not in settled and not self.granter.is_granted(name, real_s) and not taken & frozenset(word.places)
        }

    def _ready(self, real_s: float, time_s: float) -> tuple[JobSpec, ...]:
        """The first of these that could begin now: released, after their predecessors, and not rejected just now."""
        settled, ready = self.granter.register.settled, list[JobSpec]()
        for name, word in self._free(real_s).items():
            if word.release_s > time_s or len(ready) == self._slots:
                break
            before = [settled.get(job) for job in word.after]
            done = all(outcome is not None and outcome.outcome == "finished" for outcome in before)
            if done and self._later_s.get(name, -math.inf) <= real_s:
                ready.append(word)
        return tuple(ready)

    def _bid(self, real_s: float, time_s: float) -> None:
        """Publish a bid when it would say something new, and every `BID_S`."""
        room = 0 if self.ended or self._interface.unfit() else max(0, self.claimant.room)
        ready = self._ready(real_s, time_s) if room else ()
        names = tuple(word.name for word in ready)
        if self._choice not in names or self.claimant.pending:
            self._choice = ""
        left = self.open_jobs(real_s)
        about = (room, names, len(left), self._choice)
        if about == self._about and real_s < self._bid_s + BID_S:
            return
        self._about, self._bid_s = about, real_s
        self._number += 1
        bid = Bid(
            arm=self.arm,
            number=self._number,
            time_s=time_s,
            capacity=room,
            estimates=self._interface.offers(ready) if ready else (),
            open_count=len(left),
            closed_count=len(self.granter.register.settled),
            open_jobs=tuple(left[:MOST_NAMED]),
            choice=self._choice,
        )
        self.apply_bid(bid, real_s)
        self.out.append(bid)

    def _choose(self, real_s: float, time_s: float) -> None:
        """Let the policy choose a job, once the bids of all present arms are there."""
        own = self._bids[self.arm][0]
        news = self._news or real_s >= self._chosen_s + BID_S
        if not (own.estimates and news) or self.claimant.pending or self.claimant.room < 1:
            return
        bids = self._fresh_bids(real_s)
        if len(bids) < self.claimant.majority:
            return
        early = self._present - bids.keys() or real_s < self.changed_s + QUIET_S
        if early and real_s < self._bid_s + self._timing.window_s:
            return
        self._news, self._chosen_s = False, real_s
        self.rounds += 1
        bidding = self._bidding(bids, [offer.job for offer in own.estimates])
        seen = observe(bidding, self._fleet, lost={self.arm} if self._lost else ())
        action = self._choose_action(seen[self.arm], self._fleet.arms.index(self.arm))
        self._choice = claimed_jobs(bidding, seen, {self.arm: action}).get(self.arm, "")
        self._lost = False
        for word in bidding.jobs:
            if all(bidding.offer(arm, word.name) is None for arm in bidding.quotes):
                self._pause(word.name, real_s)  # nobody can do it: make room for others
        if self._choice:
            self._bid(real_s, time_s)

    def _claim_choice(self, real_s: float) -> None:
        """Claim the chosen job, once the choices of the others are there, unless another arm's excludes it."""
        if real_s < self.changed_s + QUIET_S and real_s < self._chosen_s + self._timing.window_s:
            return
        bids = self._fresh_bids(real_s)
        choices = {arm: bid.choice for arm, bid in bids.items() if bid.choice}
        bidding = self._bidding(bids, choices.values())
        job, self._choice = self._choice, ""
        if resolve_claims(bidding, choices, self._fleet.arms).get(job) == self.arm:
            self.claimant.request(self.jobs[job], real_s)
        else:
            self._lost = True

    def _fresh_bids(self, real_s: float) -> dict[str, Bid]:
        return {arm: bid for arm, (bid, at_s) in sorted(self._bids.items()) if real_s < at_s + FRESH_S}

    def _bidding(self, bids: dict[str, Bid], names: Iterable[str]) -> Bidding:
        """What the bids say about some jobs."""
        quotes = {arm: _quote(bid, self.states.get(arm)) for arm, bid in bids.items()}
        return Bidding(
            auction="consensus",
            time_s=max(bid.time_s for bid in bids.values()),
            jobs=tuple(self.jobs[name] for name in dict.fromkeys(names) if name in self.jobs),
            quotes={arm: quote for arm, quote in quotes.items() if quote.capacity and quote.estimates},
            full={arm: quote for arm, quote in quotes.items() if not (quote.capacity and quote.estimates)},
            states=self.states,
        )

    def _pause(self, job: str, real_s: float) -> None:
        """Bid for a job again only after a while: longer each time, and by chance, so that two arms do not collide."""
        first_s, most_s = self._timing.pause_s
        count = self._pauses[job] = self._pauses.get(job, 0) + 1
        self._later_s[job] = real_s + min(most_s, first_s * 2.0 ** min(count - 1, 10)) * self._rng.uniform(0.2, 1.0)


def _given_up(status: JobStatus) -> JobStatus:
    return msgspec.structs.replace(status, state="unfinished", reason="The shift ended before it was done.")


def _order(word: JobSpec) -> tuple[float, str]:
    """Jobs are in this order."""
    return word.release_s, word.name


def _gist(bid: Bid) -> tuple[bool, frozenset[str]]:
    """Which arm offers to do which jobs."""
    return bool(bid.capacity), frozenset(offer.job for offer in bid.estimates)


def _quote(bid: Bid, state: State | None) -> Quote:
    """A bid as an auctioneer would be told."""
    return Quote(
        arm=bid.arm,
        auction="consensus",
        quote="",
        valid_s=0.0,
        twin="",
        time_s=bid.time_s,
        mode="idle" if state is None else state.mode,
        headroom_k=0.0 if state is None else state.headroom_k,
        capacity=bid.capacity,
        estimates=bid.estimates,
    )
