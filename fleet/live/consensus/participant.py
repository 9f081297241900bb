"""An arm's part in allocation by consensus: it bids, chooses a job by its policy, and claims it.

A state machine without a clock and without I/O. Real seconds (`real_s`, monotonic) and fleet time (`time_s`) are
arguments; messages to send are in `out`. The steps of an arm with capacity for a job:

1. It publishes a bid with an estimate for every job that waits for an arm. Arms without capacity bid too, as their
   peers know by it how well a job suits them.
2. When the bids of its peers have arrived, its policy chooses a job, and the next bid names it.
3. When the choices of its peers have arrived, of two that exclude each other the one with the lower difficulty remains.
4. It claims the job that remains (`fleet.live.consensus.grants`); a majority has to grant it.

Safety rests on step 4 alone (`fleet.live.consensus.grants`). Steps 1 to 3 only keep the arms from claiming the same
job: where messages are lost two arms may claim one, and the one without a majority waits and tries again.
"""

import math
from collections import defaultdict, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from random import Random

from msgspec.structs import replace

from fleet.bus.protocol.auction import SETTLED, JobSpec, JobStatus, Quote
from fleet.bus.protocol.cell import Cell
from fleet.bus.protocol.consensus import Bid, Claim
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import ALL_ARMS, Controlled, ControlRequest, Operation, by_whom
from fleet.live.arm.node import ArmNode
from fleet.live.auction.knowledge import LiveFleet, claimed_jobs, observe
from fleet.live.auction.rounds import (
    NOT_OFFERED,
    Bidding,
    Choice,
    Refusals,
    no_arm_can,
    reason_to_wait,
    resolve_claims,
)
from fleet.live.consensus.grants import NUMBERS_PER_BOOT, Claimant, Granter
from fleet.live.job_rules import SHIFT_ENDED, finish_s, job_order, joined_reasons, why_not_ready
from fleet.live.leases import Timing, expire
from fleet.live.monitor.snapshot import FRESH_S
from fleet.live.records import JobEntry, ShiftEnded, requested_job
from fleet.live.sensors import ArmSensors
from fleet.live.space import Excludes, no_conflicts
from fleet.live.steering import carry_out, controlled
from fleet.observation import Observation

QUIET_S = 0.05
"""Real seconds without a new bid or choice, after which all arms most likely have the same bids."""
BID_S = 1.0
"""Real seconds between two bids in which only the costs differ."""
TOO_FEW = "{} of {} arms present: a majority, {}, is needed."
"""Why no job is granted or accepted."""
NO_CHOICE = Choice("")
MAX_PAUSES = 4096
"""Jobs whose pauses are known, besides those of which one lasts."""
MAX_BID_JOBS = 32
"""Jobs in one bid."""

Choose = Callable[[Observation, int], int]
"""The action of an arm by its observation and its index in the fleet: 0 waits, 1 + option claims."""


@dataclass(frozen=True, kw_only=True)
class Membership:
    """How an arm takes part in the consensus of its fleet."""

    fleet: LiveFleet
    """Its arms are the roster: a majority is counted in these, present or not."""
    choose: Choose
    """The policy of this arm."""
    slots: int = MAX_BID_JOBS
    """Jobs that the policy chooses from."""
    places: frozenset[str] | None = None
    """Places of the cell; None allows any name in submitted jobs."""
    stream: tuple[tuple[float, JobSpec], ...] = ()
    """Jobs that all arms know, each with the fleet time from which on it is offered."""
    horizon_s: float = math.inf
    """Fleet time at which the shift is over."""
    excludes: Excludes = no_conflicts
    """Which plans of two arms exclude each other."""
    cell: Cell | None = None
    """Reply to requests for the cell, in the name of this arm; None refuses them."""
    timing: Timing = field(default_factory=Timing)


class Participant:
    """One arm among its peers, from one start of its process to the next.

    Attributes:
        book: All jobs that it knows.
        claimant: Its claims.
        granter: Its grants.
        states: The last state of each arm, with its last possible temperatures.
        out: Bids, claims and requests of people that were carried out; the driver sends them.
        rounds: Number of choices of its policy.
    """

    def __init__(self, arm: ArmNode, granter: Granter, membership: Membership, *, boot: int, rng: Random) -> None:
        """Start.

        Args:
            boot: Number of this start of the arm.
            rng: Draws the pauses after rejected claims.
        """
        self.name, self.executor, self.granter = arm.executor.arm, arm.executor, granter
        self.book, self._timing = granter.book, membership.timing
        self.claimant = Claimant(arm.executor, granter, arm.answer_award, arm.space_of, boot=boot, timing=self._timing)
        self.states: dict[str, State] = {}
        self._sensors: defaultdict[str, ArmSensors] = defaultdict(ArmSensors)
        self.out: deque[Bid | Claim | Operation] = deque()
        self.rounds = 0
        self._arm, self._fleet, self._policy = arm, membership.fleet, membership.choose
        self._excludes = membership.excludes
        self._slots, self._rng = min(membership.slots, MAX_BID_JOBS), rng
        self._number = boot * NUMBERS_PER_BOOT
        self._bids: dict[str, tuple[Bid, float]] = {}
        """Last bid of each arm, and its real second."""
        self._granted: dict[str, set[str]] = {}
        """Awards that this arm had granted to each arm when its last bid came."""
        self._present: frozenset[str] = frozenset()
        self._bid_s = self._chosen_s = self._changed_s = -math.inf
        self._waiting_s = math.inf
        """Real second since which its next choice waits for bids of its peers; inf if it does not."""
        self._last_bid: object = None
        """Content of the last bid, without the costs."""
        self._choice = NO_CHOICE
        """What its policy chose, until it is claimed or another arm has the job."""
        self._lost = self._new_bids = False
        self._later_s: dict[str, float] = {}
        """Real second from which it bids for a job again."""
        self._pauses: dict[str, int] = {}
        self._behind_s: dict[str, float] = {}
        """Real second since which a peer knows fewer outcomes."""
        self._corrected, self._time_s = 0, 0.0
        self._refusals = Refusals()

    # Messages

    def count_after(self, number: int) -> None:
        """Number the next claims and bids as those of the start after the one with this number."""
        self.claimant.count_after(number)
        self._number = max(self._number, (number // NUMBERS_PER_BOOT + 1) * NUMBERS_PER_BOOT)

    def set_present(self, present: frozenset[str]) -> None:
        """Set which arms are present."""
        self._present = present & self.granter.roster

    def apply_state(self, arm: str, state: State) -> None:
        """Apply the state of an arm, a peer or this one."""
        self.states[arm] = self._sensors[arm].check(state)

    def apply_bid(self, bid: Bid, real_s: float) -> None:
        """Apply a bid, of a peer or its own."""
        before = self._bids.get(bid.arm)
        if bid.arm not in self.granter.roster or (before is not None and bid.number < before[0].number):
            return
        if before is None or bid.number // NUMBERS_PER_BOOT > before[0].number // NUMBERS_PER_BOOT:
            self.claimant.repeat_for(bid.arm)
        self._bids[bid.arm], self._granted[bid.arm] = (bid, real_s), self.granter.granted_to(bid.arm)
        self._refusals.note(bid)
        if before is None or _offered(before[0]) != _offered(bid):
            self._changed_s, self._new_bids = real_s, True
        elif (before[0].choice, before[0].choice_plan) != (bid.choice, bid.choice_plan):
            self._changed_s = real_s
        if bid.arm != self.name:
            self._send_corrections(bid, real_s)

    def _send_corrections(self, bid: Bid, real_s: float) -> None:
        """Send a peer outcomes of jobs that it takes for open, and jobs that it does not know."""
        book = self.book
        for job in bid.open_jobs:
            if (outcome := self.granter.known_outcome(job)) is not None:
                self.claimant.send_outcome(outcome)
        jobs = [spec for name in self.open_jobs() if (spec := book.jobs[name].original) is not None]
        if bid.digest == book.digest and bid.open_count >= len(jobs):
            self._behind_s.pop(bid.arm, None)
        elif real_s >= self._behind_s.setdefault(bid.arm, real_s) + 2 * BID_S:
            outcomes = [entry.outcome for entry in book.jobs.values() if entry.outcome is not None]
            operations = book.operations.all
            for _ in range(MAX_BID_JOBS):
                self._corrected += 1
                if outcomes:
                    self.claimant.send_outcome(outcomes[self._corrected % len(outcomes)])
                if operations:
                    self.claimant.send_operation(operations[self._corrected % len(operations)])
                if bid.open_count < len(jobs):
                    self.claimant.send_job(jobs[self._corrected % len(jobs)])
        last = book.jobs.get(bid.open_jobs[-1]) if len(bid.open_jobs) == MAX_BID_JOBS else None
        end = (math.inf, "") if last is None or last.spec is None else job_order(last.spec)
        missing = (job for job in jobs if job.name not in bid.open_jobs and job_order(job) < end)
        for job in islice(missing, MAX_BID_JOBS):
            self.claimant.send_job(job)

    def control(self, request: ControlRequest, time_s: float, later: Iterable[JobSpec] = ()) -> Controlled:
        """Carry out a request of a person, as `carry_out`; the peers get it.

        Args:
            later: Jobs that are not offered yet.
        """
        job = requested_job(request)
        self.granter.add_jobs(each for each in later if each.name == job)
        states = {arm: state for arm, state in self.states.items() if arm in self._present}
        operation, note = carry_out(self.book, request, self.granter.roster, states, time_s)
        if operation is not None:
            if (outcome := self.granter.known_outcome(job)) is not None:
                self.claimant.send_outcome(outcome)
            self.claimant.send_operation(operation)
            self.out.append(operation)
        return controlled(self.book, request, note, next(map(self._status_of, self.book.entries([job])), None))

    # Time

    def tick(self, real_s: float, time_s: float) -> None:
        """Do what is due."""
        self._time_s = time_s
        self.book.pass_time(time_s)
        self._obey(real_s)
        for job in self.claimant.rejected:
            self._lost = True
            self._pause(job, real_s)
        self.claimant.rejected.clear()
        self._bid(real_s, time_s)
        if self._choice.job:
            self._claim_choice(real_s)
        else:
            self._choose(real_s, time_s)
        if claim := self.claimant.claim(self._present, self._arm.space, real_s):
            self.out.append(claim)

    def wake_s(self, real_s: float) -> float:
        """Return the next real second at which a bid, a choice or a claim is due without a message; inf for none."""
        window_s = self._timing.window_s
        chosen_s = self._chosen_s if self._choice.job else math.inf
        due_s = (self._bid_s + BID_S, self._changed_s + QUIET_S, self._waiting_s + window_s, chosen_s + window_s)
        return min((each for each in due_s if each > real_s), default=math.inf)

    def _obey(self, real_s: float) -> None:
        """Apply operator requests to uncommitted jobs, end leases, and give up jobs that have expired."""
        book, cancelled = self.book, self.book.operations.cancelled
        expire(book, real_s, self._time_s)
        book.try_to_record("Late jobs are not given up", *book.expired(self._time_s))
        if book.operations.latest:
            paused = book.is_paused(self.name)
            self.claimant.revoke(lambda job: paused or cancelled(job) is not None)

    def end(self) -> bool:
        """End the shift; return whether that is on disk."""
        return self.book.ended or self.book.try_to_record("The shift does not end", ShiftEnded(self._time_s))

    def open_jobs(self) -> list[str]:
        """Return the jobs that can still be done, without those of absent arms that had permission to commit."""
        return [name for name in self.book.in_order if self._is_open(self.book.jobs[name])]

    def _is_open(self, entry: JobEntry) -> bool:
        if entry.outcome is None and entry.state == "unfinished" and (grant := entry.grant) is not None:
            return grant.record.arm in self._present
        return entry.state not in SETTLED and self.book.operations.cancelled(entry.name) is None

    def _missed(self) -> list[str]:
        """Return the jobs that others wait for and of which this arm knows nothing: a peer may know their outcomes."""
        book = self.book
        awaited = dict.fromkeys(name for entry in book.waiting.values() if entry.spec for name in entry.spec.after)
        return [name for name in awaited if not (book.is_known(name) or book.is_settled(name))]

    def entries(self, later: Iterable[JobSpec]) -> list[JobEntry]:
        """Return all known jobs, and `later` ones that are not offered yet."""
        book, reason = self.book, SHIFT_ENDED if self.book.ended else ""
        new = [job for job in later if job.name not in book.jobs and job.name not in book.past]
        state = "unfinished" if book.ended else "waiting"
        return book.entries() + [
            JobEntry(job.name, job, state=state, reason=reason, shift_ended=book.ended) for job in new
        ]

    def status_of(self, entries: Iterable[JobEntry], real_s: float) -> list[JobStatus]:
        """Return the status of jobs, with why they wait."""
        bids = self._fresh_bids(real_s)
        offered = {offer.job for bid in bids.values() for offer in bid.estimates}
        bidding = self._bidding(bids, offered) if bids else None
        too_few = self.too_few(self._present)
        busy, book = self.book.busy_stations(), self.book

        def why(job: JobSpec) -> str:
            not_ready = why_not_ready(job, self._time_s, book.is_finished, busy)
            if reason := self._refusal(job.name) or not_ready:
                return reason
            if too_few:
                return too_few
            if bidding is None or job.name not in offered:
                return NOT_OFFERED.format(self._slots)
            return reason_to_wait(bidding, job.name)

        statuses: list[JobStatus] = []
        for entry in entries:
            status = self._status_of(entry)
            if status.state == "waiting" and entry.spec is not None:
                status = replace(status, reason=joined_reasons(status.reason, why(entry.spec)))
            statuses.append(status)
        return statuses

    def _status_of(self, entry: JobEntry) -> JobStatus:
        """Return the status of a job, with the expected finish of one in work."""
        status = self.book.status_of(entry)
        return replace(status, finish_s=finish_s(status, self.states.get(status.arm), self._time_s))

    def too_few(self, present: frozenset[str]) -> str:
        """Return why these arms, and this one, neither grant nor accept a job; "" if they are a majority."""
        count, roster, majority = len(present | {self.name}), self.granter.roster, self.claimant.majority
        return TOO_FEW.format(count, len(roster), majority) if count < majority else ""

    @property
    def _absent(self) -> frozenset[str]:
        return self.granter.roster - self._present - {self.name}

    def _refusal(self, job: str) -> str:
        """Return why no arm can do a job, or none works; "" if one can, or this arm does not know whether it can."""
        if (pauser := self.book.operations.paused.get(ALL_ARMS)) is not None:
            return f"All arms are paused{by_whom(pauser)}."
        reasons = self._refusals.of_all(job, {self.name})
        if not reasons:
            return ""
        return no_arm_can(reasons, all_known=self._present <= reasons.keys(), absent=self._absent - reasons.keys())

    def all_settled(self, real_s: float) -> bool:
        """Return whether every present arm, a majority at least, knows that every job is settled."""
        others = [self._bids.get(arm) for arm in self._present - {self.name}]
        if len(others) + 1 < self.claimant.majority:
            return False
        known = all(bid is not None and bid[0].open_count == 0 and real_s < bid[1] + FRESH_S for bid in others)
        return known and not (self.open_jobs() or self.executor.has_pending_reports or self.executor.active)

    # Bids and choices

    def _bid(self, real_s: float, time_s: float) -> None:
        """Publish a bid when its content has changed, and every `BID_S`."""
        book = self.book
        idle = book.ended or book.is_paused(self.name) or self._arm.unfit()
        capacity = 0 if idle else max(0, self.claimant.capacity)
        later = {job for job, until_s in self._later_s.items() if until_s > real_s}
        # A job that this arm cannot do, and that no bid can do, comes last: a peer that is able to do it bids for it.
        rank = partial(self._refusals.refused_by_all, {self.name})
        ready = book.ready(time_s, self._slots, excluded=later, rank=rank)
        names = [job.name for job in ready]
        cycles = {name: book.jobs[name].cycles for name in names}
        if self._choice.job not in names or self.claimant.pending:
            self._choice = NO_CHOICE
        open_jobs = self.open_jobs()
        busy, space = book.busy_stations(), dict(book.taken_space())
        content = (capacity, names, len(open_jobs), self._choice, busy, space, book.digest)
        if content == self._last_bid and real_s < self._bid_s + BID_S:
            return
        self._new_bids |= content != self._last_bid
        self._last_bid, self._bid_s = content, real_s
        self._number += 1
        bid = Bid(
            arm=self.name,
            number=self._number,
            time_s=time_s,
            capacity=capacity,
            estimates=self._arm.estimate(tuple(ready), cycles) if ready else (),
            open_count=len(open_jobs),
            open_jobs=(*self._missed(), *open_jobs)[:MAX_BID_JOBS],
            choice=self._choice.job,
            choice_plan=self._choice.plan,
            epoch=book.epoch,
            digest=book.digest,
        )
        self.apply_bid(bid, real_s)
        self.out.append(bid)

    def _choose(self, real_s: float, time_s: float) -> None:
        """Let the policy choose a job, once the bids of all present arms have arrived."""
        own = self._bids[self.name][0]
        due = self._new_bids or real_s >= self._chosen_s + BID_S
        if not (own.capacity and own.estimates and due) or self.claimant.pending or self.claimant.capacity < 1:
            self._waiting_s = math.inf
            return
        bids = self._fresh_bids(real_s)
        if len(bids) < self.claimant.majority:
            return
        mine = {offer.job for offer in own.estimates}
        behind = any(not mine <= {offer.job for offer in bid.estimates} for bid in bids.values())
        early = self._present - bids.keys() or behind or real_s < self._changed_s + QUIET_S
        self._waiting_s = min(self._waiting_s, real_s)
        if early and real_s < self._waiting_s + self._timing.window_s:
            return
        self._new_bids, self._chosen_s, self.rounds = False, real_s, self.rounds + 1
        self._waiting_s = math.inf
        bidding = self._bidding(bids, [offer.job for offer in own.estimates])
        observations = observe(bidding, self._fleet, last={self.name: -1} if self._lost else {})
        action = self._policy(observations[self.name], self._fleet.arms.index(self.name))
        self._choice = claimed_jobs(bidding, observations, {self.name: action}).get(self.name, NO_CHOICE)
        self._lost = False
        feasible = {offer.job for bid in bids.values() for offer in bid.estimates if offer.feasible}
        for job in bidding.jobs:
            if job.name not in feasible:
                self._pause(job.name, real_s)  # no arm can do it: its slot is free for another job
        if self._choice.job:
            self._bid(real_s, time_s)

    def _claim_choice(self, real_s: float) -> None:
        """Claim the chosen job once the choices of the peers have arrived, unless another arm's excludes it."""
        if real_s < self._changed_s + QUIET_S and real_s < self._chosen_s + self._timing.window_s:
            return
        bids = self._fresh_bids(real_s)
        choices = {arm: Choice(bid.choice, bid.choice_plan) for arm, bid in bids.items() if bid.choice}
        bidding = self._bidding(bids, [choice.job for choice in choices.values()])
        (job, plan), self._choice = self._choice, NO_CHOICE
        if resolve_claims(bidding, choices, self._fleet.arms).get(job) == (self.name, plan):
            spec = self.book.jobs[job].spec
            assert spec is not None, "the arm has bid for it"
            self.claimant.request(spec, plan, real_s)
        else:
            self._lost = True

    def _fresh_bids(self, real_s: float) -> dict[str, Bid]:
        return {arm: bid for arm, (bid, at_s) in sorted(self._bids.items()) if real_s < at_s + FRESH_S}

    def _bidding(self, bids: dict[str, Bid], names: Iterable[str]) -> Bidding:
        """Return the bids for some jobs as in a round of an auctioneer."""
        book, paused = self.book, self.book.operations.paused
        quotes: dict[str, Quote] = {}
        for arm, bid in bids.items():
            gained = self.granter.granted_to(arm) - self._granted[arm]
            bid = replace(bid, capacity=max(0, bid.capacity - len(gained)))
            quotes[arm] = self._sensors[arm].check_quote(_quote(bid, self.states.get(arm)))
        entries = [book.jobs[name] for name in dict.fromkeys(names) if name in book.jobs]
        unfit = {arm: why for arm in bids if (why := self._sensors[arm].why_unfit)}
        return Bidding(
            auction="consensus",
            time_s=max(bid.time_s for bid in bids.values()),
            jobs=tuple(entry.spec for entry in entries if entry.spec is not None),
            quotes={arm: quote for arm, quote in quotes.items() if quote.capacity and quote.estimates},
            full={arm: quote for arm, quote in quotes.items() if not (quote.capacity and quote.estimates)},
            states=self.states,
            returned={entry.name: (len(entry.faults), entry.returned_s) for entry in entries if entry.returns},
            busy=book.busy_stations(),
            taken=book.taken_space(),
            excludes=self._excludes,
            absent=self._absent,
            unfit=unfit | {arm: f"is paused{by_whom(paused[arm])}" for arm in bids if arm in paused},
            at_work=frozenset(arm for arm, _ in book.at_work().values()),
        )

    def _pause(self, job: str, real_s: float) -> None:
        """Bid for a job again after a pause: longer each time, and random, so that two arms do not collide."""
        first_s, longest_s = self._timing.pause_s
        count = self._pauses[job] = self._pauses.get(job, 0) + 1
        pause_s = min(longest_s, first_s * 2.0 ** min(count - 1, 10))
        if len(self._later_s) > MAX_PAUSES:
            self._later_s = {name: until_s for name, until_s in self._later_s.items() if until_s > real_s}
            self._pauses = {name: count for name, count in self._pauses.items() if name in self._later_s}
        self._later_s[job] = real_s + pause_s * self._rng.uniform(0.2, 1.0)


def _offered(bid: Bid) -> tuple[bool, frozenset[str]]:
    """Return whether an arm has capacity, and the jobs that it bids for."""
    return bool(bid.capacity), frozenset(offer.job for offer in bid.estimates)


def _quote(bid: Bid, state: State | None) -> Quote:
    """Return a bid as a quote."""
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
