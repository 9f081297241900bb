"""What an arm without an auctioneer knows of jobs and arms that people steer, for `fleet.live.auction.auctioneer`.

Jobs that an arm without an auctioneer knows, and where they stand.

An arm's part in allocation by consensus: it bids, chooses a job by its policy, and claims it.

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

import logging
import math
from collections import defaultdict, deque
from collections.abc import Callable, Container, Iterable, Mapping, Set
from dataclasses import dataclass, field
from random import Random

from msgspec.structs import replace

from fleet.bus.protocol.auction import NOT_PLANNED, JobSpec, JobState, JobStatus, Quote
from fleet.bus.protocol.cell import Cell
from fleet.bus.protocol.consensus import Bid, Claim, ClaimReply
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import ALL_ARMS, Controlled, ControlRequest, Operation, Settle
from fleet.errors import JournalFull
from fleet.live.arm.node import ArmNode
from fleet.live.auction.auctioneer import ALREADY_DONE, job_of, next_step, objection, was_carried_out
from fleet.live.auction.job_rules import (
    EXPIRED,
    SHIFT_ENDED,
    is_late,
    job_order,
    joined_reasons,
    lost_jobs,
    ready_jobs,
    why_not_ready,
    with_terms,
)
from fleet.live.auction.knowledge import LiveFleet, claimed_jobs, observe
from fleet.live.auction.ledger import MAX_SETTLED
from fleet.live.auction.rounds import (
    NOT_OFFERED,
    Bidding,
    Choice,
    Timing,
    no_arm_can,
    reason_to_wait,
    resolve_claims,
)
from fleet.live.consensus.grants import NUMBERS_PER_BOOT, Claimant, Granter
from fleet.live.consensus.jobs import MAX_AWARDS, MAX_NOTES, Register
from fleet.live.monitor.snapshot import FRESH_S
from fleet.live.sensors import ArmSensors
from fleet.live.space import Excludes, no_conflicts
from fleet.observation import Observation


@dataclass(frozen=True)
class KnownJob:
    """A job, as `SteeredJob`."""

    spec: JobSpec
    status: JobStatus
    cancelled: bool
    award: str
    """Of the arm that has it, or had it last."""

    @property
    def state(self) -> JobState:
        """Its state."""
        return self.status.state


@dataclass(frozen=True)
class KnownFleet:
    """The fleet, as `SteeredFleet`."""

    register: Register
    jobs: Mapping[str, KnownJob]
    past: Container[str]
    ended: bool

    @property
    def paused(self) -> Mapping[str, str]:
        """Who paused an arm, by arm."""
        return self.register.operations.paused

    @property
    def space(self) -> Mapping[str, frozenset[str]]:
        """Names of the spaces that an arm may take, by arm."""
        return self.register.space

    @property
    def aside(self) -> Container[str]:
        """Jobs whose record cannot be read: none."""
        return ()

    @property
    def requests(self) -> Mapping[str, int]:
        """Names of the last requests; their content is not kept."""
        return dict.fromkeys(self.register.operations.names, 0)

    def at_work(self) -> Mapping[str, tuple[str, bool]]:
        """Return the arm that has a job, and whether it has permission to commit, by job."""
        grants = self.register.grants.items()
        settled = self.register.settled
        return {
            job: (grant.arm, grant.may_commit)
            for job, grant in grants
            if not grant.revoked and (job not in settled or settled[job].outcome != "unfinished")
        }

    def operation(self, arm: str, request: ControlRequest, time_s: float) -> Operation:
        """Return a request as the arm `arm` carries it out."""
        awards: tuple[str, ...] = ()
        match request.action:
            case Settle(job, "redo") if (known := self.jobs.get(job)) is not None:
                before = self.register.operations.latest.get(("redo", job))
                earlier = () if before is None else before.awards
                awards = (*earlier, known.award)[-MAX_AWARDS:] if known.award else earlier
            case _:
                pass
        return Operation(arm, time_s, request, awards=awards)


class KnownJobs:
    """All jobs that an arm knows.

    Attributes:
        submitted: Jobs as they were submitted, by release and name.
        current: The same jobs with the changes that people have requested.
        ended: The shift is over.
    """

    def __init__(self, granter: Granter) -> None:
        """Start without jobs; `granter` knows the grants and outcomes."""
        self.submitted: dict[str, JobSpec] = {}
        self.current: dict[str, JobSpec] = {}
        self.ended = False
        self._granter, self._register = granter, granter.register
        self._refusals: dict[str, dict[str, str]] = {}
        """Why arms cannot do a job, by arm, by job."""

    def add(self, jobs: Iterable[JobSpec]) -> None:
        """Add jobs that are not known yet."""
        new = {job.name: job for job in jobs if job.name not in self.submitted and job.name not in self._register.past}
        if new:
            self.submitted = {job.name: job for job in sorted((self.submitted | new).values(), key=job_order)}
            self.apply_changes()

    def forget(self, real_s: float, time_s: float) -> None:
        """Drop the jobs that have left, and have those leave that are given up without a fault, if there are many.

        Raises:
            JournalError: they are not on disk, and stay.
        """
        if len(self.current) > 2 * MAX_SETTLED:
            waiting = {name: job for name, job in self.current.items() if name not in self._register.settled}
            lost = self._lost(waiting, real_s, time_s)
            if len(lost) > MAX_SETTLED:
                self._granter.give_up(dict(list(lost.items())[: len(lost) - MAX_SETTLED]), time_s)
        for name in self._register.take_gone():
            self.submitted.pop(name, None)
            self.current.pop(name, None)

    def note_offers(self, bid: Bid) -> None:
        """Note which jobs the arm of a bid cannot do."""
        for offer in bid.estimates:
            by_arm = self._refusals.setdefault(offer.job, {})
            by_arm[bid.arm] = "" if offer.feasible else offer.reason or "infeasible"
        while len(self._refusals) > MAX_NOTES:
            del self._refusals[next(iter(self._refusals))]

    def _refusal(self, job: str, present: Set[str]) -> str:
        """Return why no present arm can do a job, or none works; "" if one can, or it is unknown."""
        if (pauser := self._register.operations.paused.get(ALL_ARMS)) is not None:
            return f"All arms are paused by '{pauser}'."
        reasons = self._refusals.get(job, {})
        if not reasons or present - reasons.keys() or not all(reasons.values()) or NOT_PLANNED in reasons.values():
            return ""
        return no_arm_can(reasons)

    def apply_changes(self) -> None:
        """Have the jobs follow what people have requested."""
        self.current = {name: self._register.operations.changed(job) for name, job in self.submitted.items()}

    def open(self, present: Set[str], real_s: float, time_s: float) -> list[str]:
        """Return the jobs that can still be done, without those of absent arms that had permission to commit."""
        register = self._register
        gone = {job for job in self._granter.out_of_contact(real_s) if register.grants[job].arm not in present}
        gone.update(register.settled, register.operations.all_cancelled, self._lost(self.current, real_s, time_s))
        return [job for job in self.current if job not in gone]

    def ready(self, real_s: float, time_s: float, limit: int, paused_until_s: Mapping[str, float]) -> list[JobSpec]:
        """Return the jobs that wait for an arm, as `ready_jobs` does.

        Args:
            paused_until_s: Real second from which on a job counts again, by job.
        """
        settled, cancelled = self._register.settled, self._register.operations.all_cancelled
        free = (
            job
            for name, job in self.current.items()
            if name not in settled
            and name not in cancelled
            and not self._granter.is_granted(name, real_s)
            and not is_late(job, time_s)
            and paused_until_s.get(name, real_s) <= real_s
        )
        finished, busy = self._register.is_finished, self._granter.busy_stations(real_s)
        return ready_jobs(free, time_s, limit, busy, finished, self._register.returned_s)

    def status(
        self,
        later: Iterable[JobSpec],
        states: Mapping[str, State],
        real_s: float,
        time_s: float,
        present: Set[str],
        why: Callable[[str], str],
    ) -> list[JobStatus]:
        """Return the status of all known jobs, and of `later` ones that are not offered yet.

        Args:
            why: Why no arm begins a job that is ready and that an arm can do.
        """
        jobs = self.current | {job.name: job for job in later}
        lost = self._lost(jobs, real_s, time_s)
        names = dict.fromkeys([*jobs, *self._register.settled])
        found = [self._status(name, jobs.get(name), lost, states, real_s) for name in names]
        busy = self._granter.busy_stations(real_s)

        def reasons(status: JobStatus) -> str:
            not_ready = why_not_ready(jobs[status.job], time_s, self._register.is_finished, busy)
            note = self._refusal(status.job, present) or not_ready or why(status.job)
            return joined_reasons(status.reason, note)

        return [
            replace(each, reason=reasons(each)) if each.state == "waiting" and each.job in jobs else each
            for each in found
        ]

    def steered(self, name: str, states: Mapping[str, State], real_s: float, time_s: float) -> dict[str, KnownJob]:
        """Return what is known of one job, by its name; nothing of an unknown one."""
        spec, register = self.current.get(name), self._register
        if spec is None:
            return {}
        status = self._status(name, spec, self._lost(self.current, real_s, time_s), states, real_s)
        grant, cancelled = register.grants.get(name), register.operations.cancelled(name) is not None
        return {name: KnownJob(spec, status, cancelled, status.award or ("" if grant is None else grant.award))}

    def _status(
        self, name: str, job: JobSpec | None, lost: Mapping[str, str], states: Mapping[str, State], real_s: float
    ) -> JobStatus:
        status = self._granter.status(name, real_s)
        if status.state == "waiting" and name in lost:
            status = replace(status, state="given_up", reason=lost[name])
        elif status.state == "waiting" and self.ended:
            status = replace(status, state="unfinished", reason=SHIFT_ENDED)
        state = states.get(status.arm) if status.state in ("awarded", "finishing") else None
        finish_s = state.time_s + state.busy_s if state is not None and state.job == name else None
        return replace(with_terms(status, job), finish_s=finish_s)

    def _lost(self, jobs: Mapping[str, JobSpec], real_s: float, time_s: float) -> dict[str, str]:
        """Return why jobs are given up in which no arm has faulted too often: they expired, or wait for one that is."""
        late = (job.name for job in jobs.values() if is_late(job, time_s))
        settled = self._register.settled
        expired = {name for name in late if name not in settled and not self._granter.is_granted(name, real_s)}
        before = {name for job in jobs.values() for name in job.after if name not in jobs}
        past = {name for name in before if self._register.past.is_given_up(name)}
        causes = self._register.given_up | expired | past
        return dict.fromkeys(expired, EXPIRED) | (lost_jobs(jobs.values(), causes) if causes else {})


_LOG = logging.getLogger(__name__)

QUIET_S = 0.05
"""Real seconds without a new bid or choice, after which all arms most likely have the same bids."""
BID_S = 1.0
"""Real seconds between two bids in which only the costs differ."""
NO_CHOICE = Choice("")
MAX_PAUSES = 4096
"""Jobs whose pauses are known, besides those of which one lasts."""
MAX_OPEN_JOBS = 32
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
    slots: int = MAX_OPEN_JOBS
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
        known: All jobs that it knows.
        claimant: Its claims.
        granter: Its grants.
        states: The last state of each arm, with its last possible temperatures.
        out: Bids, claims and requests of people that were carried out; the driver sends them.
        rounds: Number of choices of its policy.
        changed_s: Real second of the last change of a bid or choice.
    """

    def __init__(self, arm: ArmNode, granter: Granter, membership: Membership, *, boot: int, rng: Random) -> None:
        """Start.

        Args:
            boot: Number of this start of the arm.
            rng: Draws the pauses after rejected claims.
        """
        self.name, self.executor, self.granter = arm.executor.arm, arm.executor, granter
        self._timing = membership.timing
        self.claimant = Claimant(arm.executor, granter, arm.answer_award, arm.space_of, boot=boot, timing=self._timing)
        self.known = KnownJobs(granter)
        self.states: dict[str, State] = {}
        self._sensors: defaultdict[str, ArmSensors] = defaultdict(ArmSensors)
        self.out: deque[Bid | Claim | Operation] = deque()
        self.rounds = 0
        self._arm, self._fleet, self._policy = arm, membership.fleet, membership.choose
        self._excludes = membership.excludes
        self._slots, self._rng = min(membership.slots, MAX_OPEN_JOBS), rng
        self._number = boot * NUMBERS_PER_BOOT
        self._bids: dict[str, tuple[Bid, float]] = {}
        """Last bid of each arm, and its real second."""
        self._present: frozenset[str] = frozenset()
        self._bid_s = self._chosen_s = self.changed_s = -math.inf
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

    # Messages

    def add_jobs(self, jobs: Iterable[JobSpec]) -> None:
        """Add jobs that it does not know yet."""
        self.known.add(jobs)

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
        self._bids[bid.arm] = bid, real_s
        self.known.note_offers(bid)
        if before is None or _offered(before[0]) != _offered(bid):
            self.changed_s, self._new_bids = real_s, True
        elif (before[0].choice, before[0].choice_plan) != (bid.choice, bid.choice_plan):
            self.changed_s = real_s
        if bid.arm != self.name:
            self._send_corrections(bid, real_s)

    def _send_corrections(self, bid: Bid, real_s: float) -> None:
        """Send a peer outcomes of jobs that it takes for open, and jobs that it does not know."""
        register = self.granter.register
        for job in bid.open_jobs:
            if (outcome := register.settled.known(job, self.name)) is not None:
                self.claimant.send_outcome(outcome)
        if bid.digest == register.digest:
            self._behind_s.pop(bid.arm, None)
        elif real_s >= self._behind_s.setdefault(bid.arm, real_s) + 2 * BID_S:
            outcomes = list(register.settled.values())
            operations = register.operations.all
            for _ in range(MAX_OPEN_JOBS):
                self._corrected += 1
                if outcomes:
                    self.claimant.send_outcome(outcomes[self._corrected % len(outcomes)])
                if operations:
                    self.claimant.send_operation(operations[self._corrected % len(operations)])
        full = len(bid.open_jobs) == MAX_OPEN_JOBS and bid.open_jobs[-1] in self.known.current
        last = job_order(self.known.current[bid.open_jobs[-1]]) if full else (math.inf, "")
        for job in self.open_jobs(real_s) if register.jobs else []:
            if job in register.jobs and job not in bid.open_jobs and job_order(self.known.current[job]) < last:
                self.claimant.send_job(register.jobs[job])

    def answer_claim(self, claim: Claim, real_s: float) -> ClaimReply:
        """Return the reply to a peer's claim.

        Raises:
            Refused: as `Granter.answer_claim`.
        """
        before = self.granter.register.operations.digest
        try:
            return self.granter.answer_claim(claim, real_s)
        finally:
            self.add_jobs(job for job in claim.jobs if job.name in self.granter.register.jobs)
            if self.granter.register.operations.digest != before:
                self.known.apply_changes()

    def control(
        self, request: ControlRequest, real_s: float, time_s: float, later: Iterable[JobSpec] = ()
    ) -> Controlled:
        """Carry out a request of a person, once; it is on disk when this returns, and the peers get it.

        Args:
            later: Jobs that are not offered yet.

        Raises:
            Refused: it is not possible now.
        """
        granter, operations, job = self.granter, self.granter.register.operations, job_of(request)
        self.add_jobs(each for each in later if each.name == job)
        fleet = KnownFleet(
            granter.register,
            self.known.steered(job, self.states, real_s, time_s),
            granter.register.past,
            self.known.ended,
        )
        known = was_carried_out(fleet, request)
        note = ALREADY_DONE if known else objection(fleet, request, granter.roster)
        if not known:
            operation = fleet.operation(self.name, request, time_s)
            granter.operate(operation)
            if isinstance(request.action, Settle) and request.action.outcome == "done" and not note:
                settled = fleet.jobs[job]
                self.claimant.send_outcome(granter.settle(operation, settled.award, settled.spec.repetitions))
            granter.abandon(real_s)
            self.known.apply_changes()
            self.claimant.send_operation(operation)
            self.out.append(operation)
        status = next(iter(self.known.steered(job, self.states, real_s, time_s).values()), None)
        changed, note = not (known or note), note or next_step(fleet, request)
        return Controlled(self.name, request.request, changed, note, status and status.status, operations.paused)

    # Time

    def tick(self, real_s: float, time_s: float) -> None:
        """Do what is due."""
        self._time_s = time_s
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

    def _obey(self, real_s: float) -> None:
        """Stop what people have stopped, as far as it is not in its last cycle, and forget jobs of long ago."""
        operations = self.granter.register.operations
        try:
            self.known.forget(real_s, self._time_s)
        except JournalFull as error:
            _LOG.error("Jobs that are given up are not recorded: %s", error)
        if not operations.latest:
            return
        paused, cancelled = operations.is_paused(self.name), operations.all_cancelled
        self.claimant.revoke(lambda job: paused or job in cancelled, real_s)
        try:
            self.granter.abandon(real_s)
        except JournalFull as error:
            _LOG.error("Cancelled jobs are not recorded: %s", error)

    def open_jobs(self, real_s: float) -> list[str]:
        """Return the jobs that can still be done."""
        return self.known.open(self._present, real_s, self._time_s)

    def status(self, later: Iterable[JobSpec], real_s: float) -> list[JobStatus]:
        """Return the status of all known jobs, and of `later` ones that are not offered yet."""
        bids = self._fresh_bids(real_s)
        offered = {offer.job for bid in bids.values() for offer in bid.estimates}
        bidding = self._bidding(bids, offered, real_s) if bids else None
        fewer = len(self._present | {self.name}) < self.claimant.majority

        def why(job: str) -> str:
            if fewer:
                return f"A majority of the arms, {self.claimant.majority}, must be present."
            if bidding is None or job not in offered:
                return NOT_OFFERED.format(self._slots)
            return reason_to_wait(bidding, job)

        return self.known.status(later, self.states, real_s, self._time_s, self._present, why)

    def all_settled(self, real_s: float) -> bool:
        """Return whether every present arm, a majority at least, knows that every job is settled."""
        others = [self._bids.get(arm) for arm in self._present - {self.name}]
        if len(others) + 1 < self.claimant.majority:
            return False
        known = all(bid is not None and bid[0].open_count == 0 and real_s < bid[1] + FRESH_S for bid in others)
        return known and not (self.open_jobs(real_s) or self.executor.has_pending_reports or self.executor.active)

    # Bids and choices

    def _bid(self, real_s: float, time_s: float) -> None:
        """Publish a bid when its content has changed, and every `BID_S`."""
        paused = self.granter.register.operations.is_paused(self.name)
        capacity = 0 if self.known.ended or paused or self._arm.unfit() else max(0, self.claimant.capacity)
        ready = [] if self.known.ended else self.known.ready(real_s, time_s, self._slots, self._later_s)
        names = [job.name for job in ready]
        if self._choice.job not in names or self.claimant.pending:
            self._choice = NO_CHOICE
        open_jobs = self.open_jobs(real_s)
        register, busy = self.granter.register, self.granter.busy_stations(real_s)
        content = (capacity, names, len(open_jobs), self._choice, busy, dict(register.space), register.digest)
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
            estimates=self._arm.estimate(tuple(ready), register.cycles) if ready else (),
            open_count=len(open_jobs),
            open_jobs=tuple(open_jobs[:MAX_OPEN_JOBS]),
            choice=self._choice.job,
            choice_plan=self._choice.plan,
            epoch=register.epoch,
            digest=register.digest,
        )
        self.apply_bid(bid, real_s)
        self.out.append(bid)

    def _choose(self, real_s: float, time_s: float) -> None:
        """Let the policy choose a job, once the bids of all present arms have arrived."""
        own = self._bids[self.name][0]
        due = self._new_bids or real_s >= self._chosen_s + BID_S
        if not (own.capacity and own.estimates and due) or self.claimant.pending or self.claimant.capacity < 1:
            return
        bids = self._fresh_bids(real_s)
        if len(bids) < self.claimant.majority:
            return
        mine = {offer.job for offer in own.estimates}
        behind = any(not mine <= {offer.job for offer in bid.estimates} for bid in bids.values())
        early = self._present - bids.keys() or behind or real_s < self.changed_s + QUIET_S
        if early and real_s < self._bid_s + self._timing.window_s:
            return
        self._new_bids, self._chosen_s, self.rounds = False, real_s, self.rounds + 1
        bidding = self._bidding(bids, [offer.job for offer in own.estimates], real_s)
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
        if real_s < self.changed_s + QUIET_S and real_s < self._chosen_s + self._timing.window_s:
            return
        bids = self._fresh_bids(real_s)
        choices = {arm: Choice(bid.choice, bid.choice_plan) for arm, bid in bids.items() if bid.choice}
        bidding = self._bidding(bids, [choice.job for choice in choices.values()], real_s)
        (job, plan), self._choice = self._choice, NO_CHOICE
        if resolve_claims(bidding, choices, self._fleet.arms).get(job) == (self.name, plan):
            self.claimant.request(self.known.current[job], plan, real_s)
        else:
            self._lost = True

    def _fresh_bids(self, real_s: float) -> dict[str, Bid]:
        return {arm: bid for arm, (bid, at_s) in sorted(self._bids.items()) if real_s < at_s + FRESH_S}

    def _bidding(self, bids: dict[str, Bid], names: Iterable[str], real_s: float) -> Bidding:
        """Return the bids for some jobs as in a round of an auctioneer."""
        quotes = {arm: self._sensors[arm].check_quote(_quote(bid, self.states.get(arm))) for arm, bid in bids.items()}
        register = self.granter.register
        return Bidding(
            auction="consensus",
            time_s=max(bid.time_s for bid in bids.values()),
            jobs=tuple(self.known.current[name] for name in dict.fromkeys(names) if name in self.known.current),
            quotes={arm: quote for arm, quote in quotes.items() if quote.capacity and quote.estimates},
            full={arm: quote for arm, quote in quotes.items() if not (quote.capacity and quote.estimates)},
            states=self.states,
            returned={job: (len(register.faults.get(job, ())), at_s) for job, at_s in register.returned_s.items()},
            busy=self.granter.busy_stations(real_s),
            taken=register.space,
            excludes=self._excludes,
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
