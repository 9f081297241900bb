"""An arm on the bus: it lives with the fleet's time, says how it is, offers, takes work, and keeps its promises.

One thread drives it. What could keep it from its state words is cut into pieces: a motion that was never planned takes
some 50 ms; an answer plans for at most `PLANNING_S`, says how the arm is between two plans, and offers what is left as
`not planned yet`; the rest is planned one motion a turn, so that the next question finds it.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fleet.bus import keys
from fleet.bus.link import REMEMBERED, Link, Refused
from fleet.bus.messages import DifficultyWord, Info, State
from fleet.bus.trade import Ack, ArmEvent, Award, JobWord, Offer, Quote, QuoteRequest
from fleet.events import Event
from fleet.live.body import Body
from fleet.live.clock import FleetClock, next_due_s
from fleet.live.contractor import Contractor
from fleet.live.estimate import Estimator
from fleet.live.orders import Complaints, FromAuctioneers, Orders, Worker
from fleet.live.promises import Held

PLANNING_S = 0.3
"""Real seconds that one answer may spend on planning."""
MOST_PLANNED = 256
"""Motions that wait to be planned."""
RETRY_S = 1.0
"""Real seconds between two attempts to write what there was no room for."""
EVENTS_OF_A_LIFE = 1_000_000_000
"""The number of an event is that of the boot times this, and a count."""


@dataclass(frozen=True, kw_only=True)
class Nature:
    """What kind of arm it is."""

    warning_c: float
    """Motor temperature at which it takes no more work."""
    rate_hz: float = 10.0
    """State words per real second."""
    life: int = 1
    """Number of its boot."""
    air_c: Callable[[float], float] = lambda time_s: 25.0
    """Air of the cell at a time of the fleet, as a thermometer on the wall tells it."""
    works: bool = True
    """Whether it takes jobs at all."""

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= 1000:
            raise ValueError(f"Nature.rate_hz must be > 0 and <= 1000 (got {self.rate_hz:g}).")


class ArmNode:
    """One arm of a fleet.

    Attributes:
        clock: The fleet's time as the arm keeps it.
        behind_s: Fleet seconds by which the body was last behind that time.
        contractor: What the arm has promised.
        link: Its line to the bus.
        orders: Where its work comes from.
    """

    def __init__(
        self,
        link: Link,
        body: Body,
        contractor: Contractor,
        estimator: Estimator,
        clock: FleetClock,
        nature: Nature,
        orders: Callable[[Worker], Orders] = FromAuctioneers,
    ) -> None:
        """Take part: `link` is open."""
        self.link, self.clock, self.contractor, self.behind_s = link, clock, contractor, 0.0
        self._body, self._estimator, self._nature = body, estimator, nature
        self._name = contractor.arm
        self._at_work = ""
        """Award that the body is at."""
        self._unplanned: deque[JobWord] = deque(maxlen=MOST_PLANNED)
        self._reading = body.read()
        self._tick = self._events = 0
        self._due_s = self._retry_s = -math.inf
        """Real seconds at which the next state word is due, and the next attempt to write."""
        self._complain = Complaints(self._name)
        self.orders = orders(self)
        self._declare()

    def serve(self, until_s: float) -> None:
        """Live until `time.monotonic()` is `until_s`, or a little less."""
        self.link.serve(-math.inf if self._unplanned else min(until_s, self._due_s, self.orders.wake_s))
        self._turn()
        if self._unplanned:
            self._estimator.prepare(self._unplanned.popleft())

    def retire(self, until_s: float) -> None:
        """Give back what is in hand, and say so until there are receipts or `time.monotonic()` is `until_s`."""
        self._nature = replace(self._nature, works=False)
        self.contractor.returned(self._body.time_s, time.monotonic(), "the arm was stopped")
        while self.contractor.owes and time.monotonic() < until_s:
            self.serve(until_s)

    # What it hears

    def _declare(self) -> None:
        link, fleet, name = self.link, self.link.fleet, self._name
        self._say_state = link.publisher(keys.of_arm(fleet, name, "state"), State, remember=REMEMBERED)
        self._say_difficulty = link.publisher(keys.of_arm(fleet, name, "difficulty"), DifficultyWord, remember=1)
        self._say_event = link.publisher(keys.of_arm(fleet, name, "event"), ArmEvent, remember=REMEMBERED)
        self._say_info = link.publisher(keys.of_arm(fleet, name, "info"), Info, remember=1)  # kept: it remembers
        self._say_info(Info(name, len(self._reading.temp_c), self._estimator.model.version))
        link.answer(keys.of_arm(fleet, name, "quote"), QuoteRequest, self._quote)
        link.answer(keys.of_arm(fleet, name, "award"), Award, self._award)
        link.alive(keys.of_arm(fleet, name, "alive"))
        self._turn()

    def _quote(self, request: QuoteRequest) -> Quote:
        words = {word.name: word for word in request.jobs}
        if len(words) != len(request.jobs):
            raise Refused("A job is named twice in this question.")
        offers = self.offers(request.jobs)
        real_s = time.monotonic()
        name = ""
        if not request.dry_run:
            can = {offer.job: (words[offer.job], offer.feasible) for offer in offers}
            name = self.contractor.quoted(can, real_s)
            self.tell_difficulty(offers, real_s)
        return Quote(
            arm=self._name,
            auction=request.auction,
            quote=name,
            valid_s=self.contractor.terms.valid_s,
            twin=self._estimator.model.version,
            time_s=self.clock.now_s(real_s),
            mode=self._reading.mode,
            headroom_k=self._headroom_k,
            capacity=0 if self.unfit() or self.orders.objection else self.contractor.spare,
            offers=offers,
        )

    def offers(self, words: tuple[JobWord, ...]) -> tuple[Offer, ...]:
        """What jobs would cost it now; what cannot be planned in the time for it is offered as not planned yet."""
        self._plan_what_is_new(words)
        air_c = self._nature.air_c(self.clock.now_s(time.monotonic()))
        return self._estimator.offers(words, np.array(self._reading.temp_c), air_c, self._busy_s())

    def _plan_what_is_new(self, words: tuple[JobWord, ...]) -> None:
        """Plan within the time for it, and leave the rest for later."""
        until_s = time.monotonic() + PLANNING_S
        for word in words:
            if self._estimator.ready(word):
                continue
            if time.monotonic() < until_s:
                self._estimator.prepare(word)
                self._turn()
            else:
                self._unplanned.append(word)

    def tell_difficulty(self, offers: tuple[Offer, ...], real_s: float) -> None:
        """Say how hard it finds jobs."""
        self._say_difficulty(
            DifficultyWord(
                arm=self._name,
                tick=self._tick,
                time_s=self.clock.now_s(real_s),
                twin=self._estimator.model.version,
                jobs=tuple(offer.job for offer in offers),
                difficulty=tuple(offer.d for offer in offers),
                p_saturation=tuple(offer.p_saturation for offer in offers),
            )
        )

    def _award(self, award: Award) -> Ack:
        if self.orders.objection:
            raise Refused(self.orders.objection)
        return self.take(award, time.monotonic())

    def take(self, award: Award, real_s: float) -> Ack:
        """Take an award in hand, or not."""
        before = len(self.contractor.held)
        ack = self.contractor.awarded(award, real_s, self.unfit())
        if ack.accepted and len(self.contractor.held) > before:
            way = self._estimator.way(award.job)
            score = None if way is None or way.difficulty is None else way.difficulty.total
            self._tell(Event(time_s=self._body.time_s, kind="award", job=award.job.name), score)
        return ack

    def unfit(self) -> str:
        """Why it takes no work just now; "" if it does."""
        if not self._nature.works:
            return "I take no jobs"
        if self._reading.mode == "faulted":
            return "I am faulted"
        if self._headroom_k <= 0:
            return f"I am too hot: a motor is {-self._headroom_k:.1f} K above the warning limit"
        return ""

    # What it does by itself

    def _turn(self) -> None:
        real_s = time.monotonic()
        if real_s >= self._retry_s:
            self._retry_s = real_s + RETRY_S
            self.contractor.catch_up()
        self._live(real_s)
        self.contractor.give_up(self._body.time_s, real_s)
        for auctioneer, request in self.contractor.lease_requests(real_s):
            self.orders.lease(auctioneer, request, real_s)
        for auctioneer, report in self.contractor.reports(real_s):
            self.orders.report(auctioneer, report)
        self.orders.turn(real_s)
        if real_s >= self._due_s:
            self._due_s = next_due_s(self._due_s, real_s, 1.0 / self._nature.rate_hz)
            self._say()

    def _live(self, real_s: float) -> None:
        """Let the body live up to now, within what it may do."""
        now_s, first = self.clock.now_s(real_s), next(iter(self.contractor.held), None)
        self._hand_over(first)
        if first is not None and not first.leave and first.until_s < real_s:
            # What it did while it had a lease is its own, also if this process was held up since.
            before_s = math.nextafter(first.until_s, -math.inf)
            self._advance(self.clock.now_s(before_s), first, before_s, real_s)
            first = next(iter(self.contractor.held), None)
        self._advance(now_s, first, real_s, real_s)
        self.behind_s = now_s - self._body.time_s
        if self.behind_s > 2.0 * self.clock.speed:
            self._complain("behind", f"is {self.behind_s:.1f} s of the fleet's time behind.")

    def _hand_over(self, first: Held | None) -> None:
        """Have the body let go of what is no longer the arm's own, and take up what comes next."""
        name = "" if first is None else first.award.award
        if self._at_work not in ("", name):
            self._body.let_go()
            self._at_work = ""
        if first is None or not self._body.free:
            return
        job, way = self._estimator.job(first.award.job), self._estimator.way(first.award.job)
        assert job is not None and way is not None, "an award for what cannot be is refused"  # noqa: PT018
        self._body.begin(job, way.plan, first.cycles)
        self._at_work = name

    def _advance(self, until_s: float, first: Held | None, permit_s: float, real_s: float) -> None:
        if first is not None and self._at_work == first.award.award:
            may = self.contractor.may(permit_s)
            if self._awaits_leave(first, real_s):
                may = first.cycles  # at home: to leave it and come back for the last cycle would be a waste
            self._body.permit(may)
        for event in self._body.advance(until_s):
            self._lived(event, real_s)
        if self._reading.mode == "faulted" and self.contractor.held:
            self.contractor.returned(self._body.time_s, real_s, "the arm is faulted")
            self._at_work = ""
        first = next(iter(self.contractor.held), None)
        if first is not None:
            at_it = self._at_work == first.award.award and self._body.job
            cycles = self._body.cycles if at_it else first.cycles
            self.contractor.worked(cycles, self._last_in_s(first) / self.clock.speed)

    def _awaits_leave(self, first: Held, real_s: float) -> bool:
        """Whether the arm stands at home, the last cycle is near, and leave for it may come any moment."""
        near = first.last_in_s <= self.contractor.terms.ahead_s and not first.leave
        return near and self._reading.mode != "working" and real_s < first.until_s

    def _last_in_s(self, first: Held) -> float:
        """Fleet seconds until the last cycle of the first job could begin."""
        if self._at_work == first.award.award:
            return self._body.last_in_s()
        way = self._estimator.way(first.award.job)
        if way is None:
            return math.inf
        left = first.award.job.repetitions - 1 - first.cycles
        return self._body.free_in_s() + way.plan.approach.duration_s + left * way.plan.cycle.duration_s

    def _lived(self, event: Event, real_s: float) -> None:
        """Draw the consequences of what happened to the body, and tell."""
        if event.kind == "finish":
            self._at_work = ""
            self.contractor.finished(event.time_s, real_s)
        elif event.kind == "return":
            self._at_work = ""
            self.contractor.worked(int(event.value), math.inf)
            self.contractor.returned(event.time_s, real_s, f"the arm faulted; {event.reason}")
            self._reading = self._body.read()  # what it offers from now on knows of the fault
        self._tell(event)

    def _busy_s(self) -> float:
        """Until the arm has done all that it has in hand, fleet seconds."""
        busy_s = self._body.free_in_s()
        for held in self.contractor.held:
            way = self._estimator.way(held.award.job)
            if held.award.award != self._at_work and way is not None:
                busy_s += way.plan.duration_s(held.award.job.repetitions - held.cycles)
        return busy_s

    @property
    def _headroom_k(self) -> float:
        return self._nature.warning_c - max(self._reading.temp_c)

    # What it says

    def _say(self) -> None:
        self._reading = reading = self._body.read()
        self._tick += 1
        state = State(
            arm=self._name,
            tick=self._tick,
            time_s=self._body.time_s,
            mode=reading.mode,
            temp_c=reading.temp_c,
            headroom_k=self._headroom_k,
            job=next((held.award.job.name for held in self.contractor.held), ""),
            q=reading.q,
            qd=reading.qd,
            tau=reading.tau,
            current_a=reading.current_a,
        )
        self._say_state(state)

    def _tell(self, event: Event, value: float | None = None) -> None:
        self._events += 1
        value = event.value if value is None and math.isfinite(event.value) else value
        self._say_event(
            ArmEvent(
                arm=self._name,
                number=self._nature.life * EVENTS_OF_A_LIFE + self._events,
                time_s=event.time_s,
                kind=event.kind,
                job=event.job,
                joint=event.joint,
                value=value,
                reason=event.reason,
            )
        )

    def set_clock(self, clock: FleetClock, *, jump: bool = False) -> None:
        """Go by another clock; with `jump` it reads another time now, and the body shall know."""
        if clock.speed != self.clock.speed:
            self._body.set_pace(clock.speed / self._nature.rate_hz)
        self.clock = clock
        if jump:
            self._body.set_time(clock.now_s(time.monotonic()))
