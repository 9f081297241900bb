"""An arm on the bus: publishes its state, quotes jobs, accepts awards and executes them in fleet time.

One thread runs it, and another one plans, as a new motion takes 50 ms and more. A reply waits for plans for at most
`PLANNING_S`, publishes the state meanwhile, and calls the remaining jobs `NOT_PLANNED`; the next request finds them
planned.
"""

import logging
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import msgspec
import numpy as np

from fleet.arm.space import space_name
from fleet.breaks import Break, break_at, break_in_s
from fleet.bus.client import BusClient, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    ArmEvent,
    Award,
    Clock,
    ClockRequest,
    JobEstimate,
    JobSpec,
    Lease,
    LeaseRequest,
    PlanQuote,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
)
from fleet.bus.protocol.consensus import History, HistoryRequest
from fleet.bus.protocol.keys import STATE_GAP_S, STATE_HZ
from fleet.bus.protocol.messages import DifficultyScores, Info, State
from fleet.bus.protocol.operator import ResetReply, ResetRequest, by_whom
from fleet.difficulty import known_temperatures
from fleet.errors import BusError, Refused, RefusedForNow, printable
from fleet.events import EVENTS_PER_BOOT, Event
from fleet.live.arm.awards import ActiveAward, ArmHistory, AwardExecutor, FaultCleared
from fleet.live.arm.body import Body
from fleet.live.arm.estimator import NO_CYCLES, Estimator, ScoredPlan
from fleet.live.clock import FleetClock, next_due_s
from fleet.live.rate_limit import RateLimitedWarnings
from fleet.live.space import ANYWHERE
from fleet.offered_plans import PLANS


@dataclass(frozen=True, kw_only=True)
class ArmConfig:
    """How an arm takes part in the fleet."""

    warning_c: float
    """Motor temperature above which it accepts no work."""
    rate_hz: float = STATE_HZ
    """State messages per real second while it works; an idle arm publishes one in `IDLE_PERIOD_S`."""
    boot: int = 1
    """Number of this start."""
    ambient_c: Callable[[float], float] = lambda time_s: 25.0
    """Measured ambient temperature of the cell by fleet time."""
    takes_jobs: bool = True
    breaks: tuple[Break, ...] = ()
    """Its breaks, in fleet time."""

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= 1000:
            raise ValueError(f"ArmConfig.rate_hz must be > 0 and <= 1000 (got {self.rate_hz:g}).")


class Publications:
    """Publishers of one arm, which number its messages.

    Attributes:
        tick: Number of states so far.
        state: Publishes a state.
        info: Publishes the constants of the arm, and holds the last ones.
    """

    def __init__(self, link: BusClient, arm: str, boot: int) -> None:
        """Declare the publishers; `link` is open, and `boot` the number of this start of the arm."""
        self._arm, self._boot = arm, boot
        self.tick = self._events = 0
        self.state = link.publisher(keys.of_arm(link.fleet, arm, "state"), State)
        self._publish_difficulty = link.publisher(keys.of_arm(link.fleet, arm, "difficulty"), DifficultyScores)
        self._publish_event = link.publisher(keys.of_arm(link.fleet, arm, "event"), ArmEvent)
        self.info = link.publisher(keys.of_arm(link.fleet, arm, "info"), Info)

    def next_tick(self) -> int:
        """Return the number of the next state."""
        self.tick += 1
        return self.tick

    def difficulty(self, estimates: tuple[JobEstimate, ...], twin: str, time_s: float) -> None:
        """Publish how difficult jobs are for the arm, by the plan with the least difficulty, and its bids for them."""
        plans = [estimate.least for estimate in estimates]
        bids = [
            next((plan for plan in estimate.plans if plan.plan == number), PlanQuote())
            for estimate in estimates
            for number in range(PLANS)
        ]
        lacks_peak = any(bid.peak_c is None and bid.duration_s is not None for bid in bids)
        self._publish_difficulty(
            DifficultyScores(
                arm=self._arm,
                tick=self.tick,
                time_s=time_s,
                twin=twin,
                jobs=tuple(estimate.job for estimate in estimates),
                difficulty=_rounded((plan.difficulty for plan in plans), 4),
                p_saturation=_rounded((plan.p_saturation for plan in plans), 3),
                peak_c=_rounded((plan.peak_c for plan in plans), 1),
                bid_duration_s=_rounded((bid.duration_s for bid in bids), 1),
                bid_peak_c=_rounded((bid.peak_c for bid in bids), 1),
                bid_p_saturation=_rounded((bid.p_saturation for bid in bids), 3) if lacks_peak else (),
            )
        )

    def event(self, event: Event, epoch: str) -> None:
        """Publish an event of an epoch of the fleet."""
        self._events += 1
        self._publish_event(
            ArmEvent(
                arm=self._arm,
                number=self._boot * EVENTS_PER_BOOT + self._events,
                time_s=event.time_s,
                kind=event.kind,
                job=event.job,
                joint=event.joint,
                value=event.value if math.isfinite(event.value) else None,
                reason=event.reason,
                epoch=epoch,
            )
        )


def _rounded(values: Iterable[float | None], digits: int) -> tuple[float | None, ...]:
    return tuple(None if value is None else round(value, digits) for value in values)


PLANNING_S, POLL_S = 0.3, 0.05
"""Real seconds that one reply may wait for plans, as long as waiting takes less than half of all time; and between two
looks at what else is due."""
MAX_QUEUED = 256
"""Jobs that wait to be planned; the oldest of a queue that is full is dropped, and has to be requested again."""
IDLE_S = 5.0
"""Real seconds without work after which the thread ends, until there is work again."""
Key = tuple[JobSpec, int]


class PlanningThread:
    """Plans and scores jobs, those of an auction before those of dry runs.

    A plan has bounded size and time: `fleet.job.BOUNDS` and `check_dwell` limit the samples, `Estimator` the time and
    the memory of what it keeps. Only this thread calls `Estimator.prepare`.
    """

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self._queues: tuple[OrderedDict[Key, None], OrderedDict[Key, None]] = (OrderedDict(), OrderedDict())
        """Jobs and their cycles that are done, oldest first: of auctions, and of dry runs."""
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._waits_from_s = -math.inf
        """Real second from which `plan` may wait again."""

    def plan(self, jobs: Sequence[Key], step: Callable[[], None], *, dry_run: bool = False) -> None:
        """Plan jobs, each with the number of its cycles that are done: now if it is quick, else after the return.

        Args:
            step: Called at least every `POLL_S` while this waits for the plans.
        """
        self._request(jobs, dry_run=dry_run)
        start_s = time.monotonic()
        until_s = start_s + PLANNING_S if start_s >= self._waits_from_s else start_s
        self._waits_from_s = max(self._waits_from_s, until_s)  # also for what `step` plans
        while (now_s := time.monotonic()) < until_s and not all(self._estimator.is_prepared(*job) for job in jobs):
            with self._changed:
                self._changed.wait(min(until_s - now_s, POLL_S))
            step()
        if until_s > start_s:
            self._waits_from_s = 2.0 * time.monotonic() - start_s

    def _request(self, jobs: Iterable[Key], *, dry_run: bool) -> None:
        with self._changed:
            queue = self._queues[dry_run]
            for key in jobs:
                queue[key] = None
                if len(queue) > MAX_QUEUED:
                    queue.popitem(last=False)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="planning", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                queue = next(filter(None, self._queues), None)
                if queue is None:
                    if self._changed.wait(IDLE_S) or any(self._queues):
                        continue
                    self._thread = None
                    return
                job, done = next(iter(queue))
            self._estimator.prepare(job, done)
            with self._changed:
                queue.pop((job, done), None)
                self._changed.notify_all()


REPLY_S = 1.0
"""Real seconds that an auctioneer has to reply."""
CLOCK_S = (1.0, 30.0)
"""Real seconds between two clock requests: until the first reply, and after it."""


class ClockSync:
    """Requests fleet time, and sets a clock to it: at once by the first reply, gradually by later ones.

    Args:
        clock: Returns the clock.
        set_clock: Replaces it; the second argument is whether it reads another time now.
        warn: Logs a warning of a kind.

    Attributes:
        is_set: Whether the clock has been set to fleet time.
    """

    def __init__(
        self,
        link: BusClient,
        clock: Callable[[], FleetClock],
        set_clock: Callable[[FleetClock, bool], None],
        warn: Callable[[str, str], None],
    ) -> None:
        self._link, self._clock, self._set_clock, self._warn = link, clock, set_clock, warn
        self._asked_s, self.is_set, self._asking = -math.inf, False, False

    def ask_first(self, real_s: float) -> None:
        """Request the fleet time now, unless it is known: an award may follow, whose event has a time."""
        if not (self.is_set or self._asking):
            self._ask(real_s)

    def step(self, real_s: float) -> None:
        """Request the fleet time, when that is due."""
        if real_s >= self._asked_s + CLOCK_S[self.is_set]:
            self._ask(real_s)

    def _ask(self, real_s: float) -> None:
        self._asked_s, self._asking = real_s, True

        def done(answers: Replies[Clock]) -> None:
            self._asking = False
            for reply in answers.messages.values():
                self._apply(reply, real_s, time.monotonic())
                return

        try:
            self._link.query(keys.of_clock(self._link.fleet), ClockRequest(), Clock, done, timeout_s=REPLY_S)
        except BusError as error:
            self._asking = False
            self._warn("bus", str(error))

    def _apply(self, reply: Clock, asked_s: float, answered_s: float) -> None:
        clock = self._clock()
        if reply.speed != clock.speed:
            clock = FleetClock(reply.speed, answered_s, clock.now_s(answered_s))
        clock = replace(clock, epoch=reply.epoch)
        set_to, jump = (clock.slewed_to, False) if self.is_set else (clock.set_to, True)
        self.is_set = True
        self._set_clock(set_to(asked_s, answered_s, reply.time_s), jump)


_LOG = logging.getLogger(__name__)

Message = TypeVar("Message", bound=msgspec.Struct)


class WorkSource(Protocol):
    """Gives an arm its work, and takes its reports."""

    objection: str
    """Why nobody else may award the arm jobs; "" if everybody may."""
    wake_s: float
    """Real second at which `step` is due even if no message arrives."""

    def request_leases(self, auctioneer: str, request: LeaseRequest, asked_s: float) -> None:
        """Request renewal of leases, and permission to commit."""
        ...

    def send_report(self, auctioneer: str, report: Report) -> None:
        """Report the end of an award."""
        ...

    def step(self, real_s: float) -> None:
        """Do what is due."""
        ...

    def prepare_quote(self, real_s: float) -> None:
        """Prepare for an award, as the arm is about to quote."""
        ...


class AuctioneerClient:
    """Work source: any auctioneer that awards a job. Fleet time is that of the auctioneer."""

    objection = ""
    wake_s = math.inf

    def __init__(self, arm: "ArmNode", history: ArmHistory | None = None) -> None:
        """Start.

        Args:
            history: The awards of the arm on its disk, now and later: auctioneers ask for it.
        """
        link, name = arm.link, arm.executor.arm
        self._link, self._executor = link, arm.executor
        self._warn = RateLimitedWarnings(name)
        self._clock = ClockSync(link, lambda: arm.clock, arm.set_clock, self._warn)
        if history is not None:

            def reply(_: HistoryRequest) -> History:
                known = self._clock.is_set and arm.clock.epoch == history.epoch
                return history.message(name, arm.clock.now_s(time.monotonic()) if known else 0.0)

            link.reply_to(keys.of_arm(link.fleet, name, "history"), HistoryRequest, reply)

    def request_leases(self, auctioneer: str, request: LeaseRequest, asked_s: float) -> None:
        """Send a lease request to its auctioneer."""
        self._send(auctioneer, "lease", request, Lease, lambda lease: self._executor.apply_lease(lease, asked_s))

    def send_report(self, auctioneer: str, report: Report) -> None:
        """Send a report to its auctioneer."""
        self._send(auctioneer, "report", report, Receipt, self._executor.apply_receipt)

    def step(self, real_s: float) -> None:
        """Request the fleet time, when that is due."""
        self._clock.step(real_s)

    def prepare_quote(self, real_s: float) -> None:
        """Request the fleet time before the first quote."""
        self._clock.ask_first(real_s)

    def _send(
        self,
        auctioneer: str,
        topic: str,
        request: LeaseRequest | Report,
        kind: type[Message],
        apply: Callable[[Message], None],
    ) -> None:
        """Send a request, and apply its replies; if it cannot be sent now, the next one is due later anyway."""

        def done(answers: Replies[Message]) -> None:
            for reply in answers.messages.values():
                apply(reply)

        key = keys.asked_by(self._link.fleet, auctioneer, topic, self._executor.arm)
        try:
            self._link.query(key, request, kind, done, timeout_s=REPLY_S)
        except BusError as error:
            self._warn("bus", str(error))


Array = np.ndarray

WRITE_RETRY_S = 1.0
"""Real seconds between two attempts to write records for which the disk had no space."""


IDLE_PERIOD_S = 0.5
"""Real seconds between two states of an idle arm: a fraction of `FRESH_S`, after which it counts as offline."""


class ArmNode:
    """One arm of a fleet.

    Attributes:
        clock: Fleet time, as the arm keeps it.
        executor: The awards of the arm.
        link: Its connection to the bus.
        work_source: Where its work comes from.
    """

    def __init__(
        self,
        link: BusClient,
        body: Body,
        executor: AwardExecutor,
        estimator: Estimator,
        clock: FleetClock,
        config: ArmConfig,
        work_source: "Callable[[ArmNode], WorkSource]" = AuctioneerClient,
    ) -> None:
        """Join the fleet; `link` is open."""
        self.link, self.clock, self.executor = link, clock, executor
        self._body, self._estimator, self._config = body, estimator, config
        self._name = executor.arm
        self._body_award = ""
        """Award that the body works on."""
        self._cleared_by: str | None = None
        """The person who has cleared the present fault."""
        self._planning = PlanningThread(estimator)
        self._plans: dict[str, ScoredPlan] = {}
        """Plan of each active award: it stays even if the estimator drops it."""
        self._reading = body.read_sensors()
        self._break: Break | None = None
        self._quoted_s = -math.inf
        self._idle: bool = False
        self._leaving: bool = False
        self._state_due_s = self._retry_s = -math.inf
        """Real seconds at which the next state message and the next attempt to write are due."""
        self._warn = RateLimitedWarnings(self._name)
        self.work_source = work_source(self)
        self._declare()

    def serve(self, until_s: float) -> None:
        """Handle messages and run the arm until `time.monotonic()` is `until_s`, or slightly less."""
        self.link.serve(min(until_s, self._state_due_s, self.work_source.wake_s))
        self._step()

    def retire(self, until_s: float) -> None:
        """Return all awards, report them until they are acknowledged, and quote the space of an arm at home.

        A last cycle that has begun ends first; an award that is left returns at the next start.
        The last state says that the arm leaves. At the latest it ends when `time.monotonic()` is `until_s`.
        """
        self._leaving = True
        self._stop_awards("The arm was stopped.")
        reported_s = time.monotonic() if self.executor.has_pending_reports else -math.inf
        while time.monotonic() < until_s:
            if self.executor.has_pending_reports:
                reported_s = time.monotonic()
            elif not self.executor.active and (self._body.away is not None or self._quoted_s >= reported_s):
                break
            self.serve(min(until_s, time.monotonic() + POLL_S))
        time.sleep(STATE_GAP_S)  # no later state makes up for this one
        self._send_state()

    def _stop_awards(self, reason: str) -> None:
        """Return all awards, except for the current one if its last cycle may have begun."""
        real_s = time.monotonic()
        self.executor.stop(self._body.time_s, real_s, reason)
        if (current := self._current) is None:
            return
        if self._body_award == current.award.award:
            self._body.allow_cycles(self.executor.allowed_cycles(real_s))  # from now on it begins none
            if not 0.0 < self._body.last_cycle_in_s() < math.inf:
                return
        self.executor.return_all(self._body.time_s, real_s, reason)

    # Requests

    def _declare(self) -> None:
        link, fleet, name = self.link, self.link.fleet, self._name
        self._publish = Publications(link, name, self._config.boot)
        self._publish.info(Info(name, len(self._reading.temp_c), self._estimator.model.version))
        link.reply_to(keys.of_arm(fleet, name, "quote"), QuoteRequest, self._quote)
        link.reply_to(keys.of_arm(fleet, name, "award"), Award, self._award)
        link.reply_to(keys.of_arm(fleet, name, "reset"), ResetRequest, self._reset)
        link.declare_token(keys.of_arm(fleet, name, "alive"))
        self._step()

    def _quote(self, request: QuoteRequest) -> Quote:
        jobs = {job.name: job for job in request.jobs}
        if len(jobs) != len(request.jobs):
            raise Refused("The request names a job twice.")
        self.work_source.prepare_quote(time.monotonic())
        estimates, name = self.estimate(request.jobs, request.cycles, dry_run=request.dry_run), ""
        real_s = self._quoted_s = time.monotonic()
        if not request.dry_run:
            offers = {estimate.job: (jobs[estimate.job], len(estimate.plans)) for estimate in estimates}
            name = self.executor.add_quote(offers, real_s)
            self.publish_difficulty(estimates, real_s)
        return Quote(
            arm=self._name,
            auction=request.auction,
            quote=name,
            valid_s=self.executor.config.valid_s,
            twin=self._estimator.model.version,
            time_s=self.clock.now_s(real_s),
            mode=self._reading.mode,
            headroom_k=self._headroom_k,
            capacity=0 if self.unfit() or self.work_source.objection else self.executor.spare_capacity,
            estimates=estimates,
            space=self._possible_space(),
        )

    def _reset(self, request: ResetRequest) -> ResetReply:
        self._reading = self._body.read_sensors()
        if self._reading.mode != "faulted":
            return ResetReply(self._name, changed=False)
        if reason := self._body.clear_fault():
            raise RefusedForNow(f"The fault of '{self._name}' is not cleared: {reason}.")
        self.executor.write(FaultCleared(request.by, self._body.time_s))
        self._cleared_by = request.by
        return ResetReply(self._name, changed=True)

    @property
    def space(self) -> tuple[str, ...]:
        """Name of the space that the arm takes; empty at home."""
        plan = self._body.away
        return () if plan is None else (space_name(plan),)

    def space_of(self, job: JobSpec, plan: int) -> str | None:
        """Return the name of the space that the arm takes for a job by a plan; None if it has no such plan now."""
        for active in self.executor.active:
            if (active.award.job, active.award.plan) == (job, plan):
                return space_name(self._scored(active.award).plan)
        return self._estimator.space_of(job, plan)

    def _possible_space(self) -> tuple[str, ...]:
        """Names of the spaces that the arm takes, and of those for which it may leave home at any moment."""
        awards = [active.award for active in self.executor.active]
        jobs = {self.space_of(award.job, award.plan) or ANYWHERE for award in awards}
        return tuple(sorted(jobs.union(self.space)))

    def estimate(
        self, jobs: tuple[JobSpec, ...], cycles: Mapping[str, int] = NO_CYCLES, *, dry_run: bool = False
    ) -> tuple[JobEstimate, ...]:
        """Estimate what jobs would cost the arm now; those that cannot be planned in time are called `NOT_PLANNED`.

        Args:
            cycles: Cycles that are done, by job; 0 if not named.
            dry_run: Whether they may be planned after the jobs of others.
        """
        begun = [(job, cycles.get(job.name, 0)) for job in jobs]
        missing = [each for each in begun if not self._estimator.is_prepared(*each)]
        if missing:
            self._planning.plan(missing, self._step, dry_run=dry_run)
        return self._estimator.estimate(jobs, self._known_c(), self._busy_s(), cycles)

    @property
    def _ambient_c(self) -> float:
        return self._config.ambient_c(self.clock.now_s(time.monotonic()))

    def _known_c(self) -> Array:
        _, offset_k = self._body.found
        return known_temperatures(np.array(self._reading.temp_c) - offset_k, self._body.housing_c, self._ambient_c)

    def publish_difficulty(self, estimates: tuple[JobEstimate, ...], real_s: float) -> None:
        """Publish how difficult jobs are for the arm, by the plan with the least difficulty."""
        self._publish.difficulty(estimates, self._estimator.model.version, self.clock.now_s(real_s))

    def _award(self, award: Award) -> Ack:
        if self.work_source.objection:
            raise RefusedForNow(self.work_source.objection)
        return self.answer_award(award, time.monotonic())

    def answer_award(self, award: Award, real_s: float) -> Ack:
        """Accept or refuse an award."""
        before = {active.award.award for active in self.executor.active}
        plans = self._estimator.plans(award.job)
        unplanned = "" if award.plan < len(plans) else "its plan is not kept any more: request another quote"
        ack = self.executor.answer_award(award, real_s, self.unfit() or unplanned)
        active = {active.award.award for active in self.executor.active}
        if award.award in active - before:
            self._plans = {name: plan for name, plan in self._plans.items() if name in active}
            self._plans[award.award] = plans[award.plan]
            difficulty = self._scored(award).difficulty
            score = math.nan if difficulty is None else difficulty.total
            reason = f"plan {award.plan}, twin {self._estimator.model.version}"
            event = Event(time_s=self._body.time_s, kind="award", job=award.job.name, value=score, reason=reason)
            self._publish.event(event, self.clock.epoch)
        return ack

    def unfit(self) -> str:
        """Why the arm accepts no work now; "" if it does."""
        if not self._takes_jobs:
            return "I take no jobs"
        if self._reading.mode == "faulted":
            return "I am faulted"
        if self._headroom_k <= 0:
            return f"I am too hot: a motor is {-self._headroom_k:.1f} K above the warning limit"
        if self._break is not None:
            return f"I have a break, '{self._break.name}', for {self._break.end_s - self._body.time_s:.0f} s"
        if self._body.away is not None and not self.executor.active:
            return "I am on my way home"
        return ""

    # One step

    def _step(self) -> None:
        real_s = time.monotonic()
        if real_s >= self._retry_s:
            self._retry_s = real_s + WRITE_RETRY_S
            self.executor.retry_writes()
        self._set_pace(real_s)
        self._advance_body(real_s)
        self._keep_breaks()
        self.executor.return_ended(self._body.time_s, real_s, at_home=self._body.away is None)
        for auctioneer, request in self.executor.lease_requests(real_s):
            self.work_source.request_leases(auctioneer, request, real_s)
        for auctioneer, report in self.executor.due_reports(real_s):
            self.work_source.send_report(auctioneer, report)
        self.work_source.step(real_s)
        if real_s >= self._state_due_s:
            self._state_due_s = next_due_s(self._state_due_s, real_s, self._period_s)
            self._send_state()

    @property
    def _takes_jobs(self) -> bool:
        return self._config.takes_jobs and not self._leaving

    @property
    def _period_s(self) -> float:
        """Real seconds between two states, and between two steps of the body."""
        return max(1.0 / self._config.rate_hz, IDLE_PERIOD_S if self._idle else 0.0)

    def _set_pace(self, real_s: float) -> None:
        """Step the body and publish its state less often while an arm that takes jobs has none and is at home."""
        at_home = self._body.is_free and self._body.away is None
        idle = at_home and not self.executor.active and self._takes_jobs
        if idle != self._idle:
            self._idle, self._state_due_s = idle, real_s
            self._body.set_step(self._period_s * self.clock.speed)
            for event in self._body.advance(self.clock.now_s(real_s)):  # a job does not begin before its award
                self._handle_event(event, real_s)

    def _keep_breaks(self) -> None:
        """Begin and end breaks; in some the arm ends the cycle and returns its jobs."""
        before, time_s = self._break, self._body.time_s
        self._break = now = break_at(self._config.breaks, time_s)
        if now is not None and now.finish == "cycle":
            self.executor.revoke(f"a break, '{now.name}'")
        if now is not None and before is None:
            event = Event(time_s=time_s, kind="break", value=now.end_s - time_s, reason=now.name)
            self._publish.event(event, self.clock.epoch)
        elif now is None and before is not None:
            self._publish.event(Event(time_s=time_s, kind="break_end", reason=before.name), self.clock.epoch)

    @property
    def _current(self) -> ActiveAward | None:
        return next(iter(self.executor.active), None)

    def _advance_body(self, real_s: float) -> None:
        """Advance the body to the present, as far as leases allow."""
        now_s, current = self.clock.now_s(real_s), self._current
        self._assign(current)
        if current is not None and self.clock.real_s <= current.lease_end_s < real_s:
            # Work done within the lease counts, even if this process was stopped since. A clock that was set later does
            # not know the fleet time of the end of the lease: it returns a later one.
            lease_end_s = math.nextafter(current.lease_end_s, -math.inf)
            self._advance(self.clock.now_s(lease_end_s), current, lease_end_s, real_s)
            current = self._current
        self._advance(now_s, current, real_s, real_s)
        if (lag_s := now_s - self._body.time_s) > 2.0 * self.clock.speed:
            self._warn("lag", f"is {lag_s:.1f} s of fleet time behind.")

    def _assign(self, current: ActiveAward | None) -> None:
        """Make the body release a job whose award has ended, and start the current one."""
        name = "" if current is None else current.award.award
        if self._body_award not in ("", name):
            self._body.release()
            self._body_award = ""
        if current is None or not self._body.is_free:
            return
        try:
            self._body.start(self._estimator.job(current.award.job), self._scored(current.award).plan, current.cycles)
        except ValueError as error:
            self._warn("start", f"returns '{printable(current.job)}', which it cannot start: {error}")
            self.executor.return_all(self._body.time_s, time.monotonic(), f"It cannot be started: {error}")
        else:
            self._body_award = name

    def _scored(self, award: Award) -> ScoredPlan:
        """Return the plan of an active award."""
        return self._plans[award.award]

    def _advance(self, until_s: float, current: ActiveAward | None, leased_s: float, real_s: float) -> None:
        if current is not None and self._body_award == current.award.award:
            self._body.allow_cycles(self.executor.allowed_cycles(leased_s))
        for event in self._body.advance(until_s):
            self._handle_event(event, real_s)
        if self._reading.mode == "faulted" and self.executor.active:
            self.executor.return_all(self._body.time_s, real_s, "The arm is faulted.")
            self._body_award = ""
        self._estimator.heat_ratio, _ = self._body.found
        if current := self._current:
            at_work = self._body_award == current.award.award and self._body.job
            if at_work and (excess := self._body.excess) is not None:
                self._estimator.learn(current.award.job, excess)
            cycles = self._body.cycles if at_work else current.cycles
            self.executor.record_progress(cycles, self._last_cycle_in_s(current) / self.clock.speed)

    def _last_cycle_in_s(self, current: ActiveAward) -> float:
        """Fleet seconds until the last cycle of the current job could begin."""
        if self._body_award == current.award.award:
            return self._body.last_cycle_in_s()
        left, plan = current.award.job.repetitions - 1 - current.cycles, self._scored(current.award).plan
        return self._body.free_in_s() + plan.approach.duration_s + left * plan.cycle.duration_s

    def _handle_event(self, event: Event, real_s: float) -> None:
        """Update the awards after an event of the body, and publish it."""
        if event.kind == "finish":
            self._body_award = ""
            self.executor.finish(event.time_s, real_s)
        elif event.kind == "return":
            self._body_award = ""
            self.executor.record_progress(int(event.value), math.inf)
            self.executor.return_all(event.time_s, real_s, f"The arm faulted: {event.reason}", faulted=True)
            self._reading = self._body.read_sensors()  # the next estimates take the fault into account
        elif event.kind == "recover" and self._cleared_by is not None:
            event, self._cleared_by = replace(event, reason=f"cleared{by_whom(self._cleared_by)}"), None
        self._publish.event(event, self.clock.epoch)

    def _busy_s(self) -> float:
        """Fleet seconds until the arm has finished all its jobs."""
        busy_s = self._body.free_in_s()
        for active in self.executor.active:
            if active.award.award != self._body_award:
                busy_s += self._scored(active.award).plan.duration_s(active.award.job.repetitions - active.cycles)
        return busy_s

    @property
    def _headroom_k(self) -> float:
        return self._config.warning_c - max(self._reading.temp_c)

    # Publishing

    def _send_state(self) -> None:
        self._reading = self._body.read_sensors()
        self._publish.state(
            State(
                arm=self._name,
                tick=self._publish.next_tick(),
                time_s=self._body.time_s,
                headroom_k=self._headroom_k,
                job="" if self._current is None else self._current.job,
                space="".join(self.space),
                epoch=self.clock.epoch,
                busy_s=busy_s if math.isfinite(busy_s := self._busy_s()) else 0.0,
                housing_c=tuple(self._body.housing_c.tolist()),
                ambient_c=self._ambient_c,
                break_in_s=break_in_s(self._config.breaks, self._body.time_s),
                leaving=self._leaving,
                **self._describe_job(),
                **vars(self._reading),
            )
        )

    def _describe_job(self) -> dict[str, float | None]:
        """Fields of the state about the current job, which the body has begun."""
        current = self._current
        if current is None or self._body_award != current.award.award:
            return {}
        job, score, left_s = current.award.job, self._scored(current.award).difficulty, self._body.free_in_s()
        known_c, excess = self._known_c(), self._estimator.excess_of(job)
        return {
            "job_value": job.value,
            "job_cycles_left": job.repetitions - self._body.cycles,
            "job_peak_c": None if score is None else score.peak_at(known_c, left_s, excess),
            "job_p_saturation": None if score is None else score.p_at(known_c, left_s, excess),
        }

    def set_clock(self, clock: FleetClock, jump: bool = False) -> None:
        """Use another clock; with `jump` it reads another time now, and the body is set to that time."""
        if clock.speed != self.clock.speed:
            self._warn("speed", f"runs at the fleet's speed of {clock.speed:g}, not at {self.clock.speed:g}.")
            self._body.set_step(clock.speed * self._period_s)
        self.clock = clock
        if jump:
            self._body.set_time(clock.now_s(time.monotonic()))
