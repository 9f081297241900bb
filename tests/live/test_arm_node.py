"""An arm on a real bus: state, quotes, leased jobs, reports, faults. Restarts are in test_allocation."""

import time
from contextlib import ExitStack
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec.structs import replace

from fleet.breaks import Break
from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    ArmEvent,
    Award,
    Clock,
    ClockRequest,
    JobSpec,
    Lease,
    LeaseRequest,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
)
from fleet.bus.protocol.messages import DifficultyScores, Info, State
from fleet.bus.protocol.operator import ResetReply, ResetRequest
from fleet.bus.router import Router
from fleet.difficulty import KNOWN, Difficulty, Forecast
from fleet.errors import InfeasibleJob
from fleet.heat.thermal import WINDING
from fleet.job import Place
from fleet.live.arm.awards import ArmHistory, ArmRecord, AwardExecutor, ExecutorConfig, FaultCleared
from fleet.live.arm.body import ReplayBody, SensorLog, SimulatedBody
from fleet.live.arm.estimator import NOT_PLANNED, Estimator, NominalPeaks
from fleet.live.arm.node import IDLE_PERIOD_S, PLANNING_S, ArmConfig, ArmNode
from fleet.live.clock import FleetClock
from fleet.live.journal import Journal
from fleet.robot import JOINTS, ThermalLimits
from tests.waiting import PATIENCE_S

LIMITS = ThermalLimits()
SPEED = 60.0
JOB = JobSpec(name="j", kind="hold", places=("bench",), repetitions=3)
PLACES = {name: Place(name=name, position_m=(0.5, 0.0, 0.2)) for name in ("bench", "rack")}


class Auctioneer:
    """Grants all leases, and permission to commit when asked; keeps what it receives."""

    def __init__(self, link):
        self.link, self.leases, self.reports = link, [], []
        self.revokes = False
        link.reply_to(keys.asked_by_every_arm("f", "x", "lease"), LeaseRequest, self.lease)
        link.reply_to(keys.asked_by_every_arm("f", "x", "report"), Report, self.report)

    def lease(self, request):
        self.leases.append(request)
        names = tuple(h.award for h in request.entries)
        permitted = tuple(h.award for h in request.entries if h.phase == "finishing")
        return Lease("x", 2.0, () if self.revokes else names, names if self.revokes else (), permitted)

    def report(self, report):
        self.reports.append(report)
        return Receipt("x", report.award)


@pytest.fixture
def bus(tmp_path, small, monkeypatch):
    """A router; makers of arms and lines; and what serves them all until something is true.

    An arm replies when it has planned, however slow the machine is.
    """
    monkeypatch.setattr("fleet.live.arm.node.PLANNING_S", PATIENCE_S / 2)
    with ExitStack() as stack:
        router = stack.enter_context(Router())
        nodes, links, clocks = [], [], []

        def link():
            links.append(stack.enter_context(BusClient(router.endpoint, "f")))
            return links[-1]

        def arm(plan=None, body=None, speed=SPEED, clock_s=100.0, limits=LIMITS, warm=True, model=None, **config):
            content = small.work("bench")
            own = small.arm(0, [content])
            book = stack.enter_context(Journal(tmp_path / "arm_0.jsonl", ArmRecord, durable=False))
            history = ArmHistory().replay(book.records()).after_restart("arm_0", 0.0)
            book.rewrite(*history.compact())
            body = body or SimulatedBody(
                own, limits, lambda _: 25.0, dt_s=speed / 20, rng=np.random.default_rng(0), time_s=clock_s, warm=warm
            )
            line = stack.enter_context(BusClient(router.endpoint, "f"))
            executor = AwardExecutor(
                "arm_0", book.append, history, nonce=str(history.boot), config=ExecutorConfig(valid_s=3.0)
            )
            estimator = Estimator(model or own.model, plan or (lambda work: own.plans[content]), PLACES, NominalPeaks())
            clock = FleetClock(speed, time.monotonic(), clock_s)
            config = ArmConfig(**{"warning_c": 60.0, "rate_hz": 20.0, "boot": history.boot, **config})
            node = ArmNode(line, body, executor, estimator, clock, config)
            nodes.append(node)
            return SimpleNamespace(node=node, link=line, book=book, body=body)

        def step_time():
            """From now on the time of the arms advances by 20 ms a turn, however long a turn takes."""
            clock = SimpleNamespace(now_s=time.monotonic())
            monkeypatch.setattr("fleet.live.arm.node.time", SimpleNamespace(monotonic=lambda: clock.now_s))
            clocks.append(clock)
            return clock

        def serve(condition):
            deadline_s = time.monotonic() + PATIENCE_S
            while not condition():
                assert time.monotonic() < deadline_s, "waited in vain"
                for clock in clocks:
                    clock.now_s += 0.02
                for node in nodes:
                    node.serve(time.monotonic() + 0.005)
                for each in links:
                    each.serve(time.monotonic() + 0.001)

        def ask(line, topic, word, kind):
            for _ in range(50):  # the router may not know yet that the arm answers
                got = []
                line.query(keys.of_arm("f", "arm_0", topic), word, kind, got.append, timeout_s=PATIENCE_S)
                serve(partial(bool, got))
                assert not got[0].refused, got[0].refused
                if got[0].messages:
                    return next(iter(got[0].messages.values()))
            raise AssertionError("nobody answers")

        yield SimpleNamespace(link=link, arm=arm, serve=serve, step_time=step_time, ask=ask, small=small)


def request(*jobs, dry_run=False):
    return QuoteRequest("r", jobs or (JOB,), dry_run=dry_run)


def assign(bus, line, job=JOB):
    """Award a job to the arm on a new quote."""
    quote = bus.ask(line, "quote", request(job), Quote)
    assert bus.ask(line, "award", award(quote.quote, job), Ack).accepted


def award(quote, job=JOB, name="w"):
    return Award(award=name, auction="r", auctioneer="x", quote=quote, job=job, lease_s=2.0)


def test_an_arm_publishes_info_and_state(bus):
    watcher, heard = bus.link(), {}
    for topic, kind, history in (("state", State, False), ("info", Info, True)):
        watcher.subscribe(
            keys.of_every_arm("f", topic), kind, lambda arm, word, t=topic: heard.update({t: word}), history=history
        )
    there = []
    watcher.watch_tokens(keys.of_every_arm("f", "alive"), lambda name, is_there: there.append((name, is_there)))
    bus.arm()
    bus.serve(lambda: {"state", "info"} <= heard.keys() and there)
    assert there[0] == ("arm_0", True)
    assert heard["info"] == Info("arm_0", 7, "by payload")
    state = heard["state"]
    assert (state.mode, state.job, len(state.q), len(state.current_a)) == ("idle", "", 7, 7)
    assert state.headroom_k == pytest.approx(60.0 - max(state.temp_c))
    assert state.time_s >= 100.0


def test_a_job_goes_from_quote_to_receipt(bus):
    auctioneer, events, words = Auctioneer(bus.link()), [], []
    line = bus.link()
    line.subscribe(keys.of_every_arm("f", "event"), ArmEvent, lambda _, e: events.append(e), history=True)
    line.subscribe(keys.of_every_arm("f", "difficulty"), DifficultyScores, lambda _, w: words.append(w), history=True)
    states = []
    line.subscribe(keys.of_every_arm("f", "state"), State, lambda _, state: states.append(state))
    arm = bus.arm()
    quote = bus.ask(line, "quote", request(), Quote)
    assert (quote.capacity, quote.valid_s, quote.twin, quote.space) == (1, 3.0, "by payload", ())
    ((offer,),) = (estimate.plans for estimate in quote.estimates)
    assert offer.duration_s == pytest.approx(35.0)
    assert bus.ask(line, "award", award(quote.quote), Ack).accepted
    assert bus.ask(line, "quote", request(dry_run=True), Quote).space == (offer.space,)
    bus.serve(lambda: auctioneer.reports)
    (report,) = auctioneer.reports
    assert (report.outcome, report.cycles, report.job) == ("finished", 3, "j")
    # Where the leave to finish comes late, it stands at its end until the next step.
    stood_s = report.time_s - next(e.time_s for e in events if e.kind == "award") - 33.0
    assert stood_s >= -1e-6
    assert stood_s / (SPEED / 20) == pytest.approx(round(stood_s / (SPEED / 20)), abs=1e-6)
    assert any(h.phase == "finishing" for leased in auctioneer.leases for h in leased.entries)
    bus.serve(lambda: [e.kind for e in events] == ["award", "finish", "home"])
    assert [e.number - events[0].number for e in events] == [0, 1, 2]
    assert words[-1].jobs == ("j",)
    bus.serve(lambda: not ArmHistory().replay(arm.book.records()).reports)
    last = bus.ask(line, "quote", request(), Quote)
    assert (last.capacity, last.space) == (1, ())
    bus.serve(lambda: states[-1].mode == "idle")
    assert {(state.mode, state.space) for state in states} == {("idle", ""), ("working", offer.space)}


def test_an_idle_arm_publishes_twice_a_second_and_a_working_one_at_its_rate(bus, monkeypatch):
    """Rates by definition: 2 and 20 Hz. The first state of a job does not wait for the period of an idle arm."""
    Auctioneer(bus.link())
    line, arm, clock, states = bus.link(), bus.arm(), bus.step_time(), []
    monkeypatch.setattr(arm.node._publish, "state", lambda state: states.append((clock.now_s, state.mode)))
    bus.serve(lambda: len(states) >= 6)
    assert np.diff([at_s for at_s, _ in states])[1:] == pytest.approx(0.5, abs=0.021)
    assign(bus, line, replace(JOB, repetitions=20))
    began_s, before = clock.now_s, len(states)
    bus.serve(lambda: len(states) >= before + 20)
    working_s = [at_s for at_s, mode in states[before:] if mode == "working"]
    assert working_s[0] - began_s < 0.25
    assert np.diff(working_s) == pytest.approx(0.05, abs=0.021)


def test_a_dry_run_changes_nothing(bus):
    words, line = [], bus.link()
    line.subscribe(keys.of_every_arm("f", "difficulty"), DifficultyScores, lambda _, w: words.append(w), history=True)
    arm = bus.arm()
    before = list(arm.book.records())
    quote = bus.ask(line, "quote", request(dry_run=True), Quote)
    assert quote.quote == ""
    assert quote.estimates[0].feasible
    bus.ask(line, "quote", request(), Quote)
    bus.serve(lambda: words)
    assert len(words) == 1
    assert list(arm.book.records()) == before


@pytest.mark.parametrize(("finish", "repetitions"), [("cycle", 40), ("job", 8)])
def test_an_arm_takes_no_jobs_in_a_break_and_returns_or_finishes_its_own_first(bus, finish, repetitions):
    auctioneer, events, states, line = Auctioneer(bus.link()), [], [], bus.link()
    line.subscribe(keys.of_every_arm("f", "event"), ArmEvent, lambda _, e: events.append(e), history=True)
    line.subscribe(keys.of_every_arm("f", "state"), State, lambda _, state: states.append(state))
    arm = bus.arm(breaks=(Break(name="lunch", begin_s=160.0, end_s=300.0, finish=finish),))
    bus.step_time()
    assign(bus, line, replace(JOB, repetitions=repetitions))
    bus.serve(lambda: any(e.kind == "break" for e in events))
    bus.serve(lambda: auctioneer.reports)
    (report,) = auctioneer.reports
    if finish == "job":
        assert (report.outcome, report.cycles) == ("finished", 8)
    else:
        begun_s = next(e.time_s for e in events if e.kind == "award") + 3.0
        assert report.outcome == "returned"
        assert report.reason == "a break, 'lunch'"
        assert report.cycles == int((report.time_s - 2.0 - begun_s) / 10.0 + 1e-6)
        assert 1 <= report.cycles < 20
    quote = bus.ask(line, "quote", request(), Quote)
    assert (quote.capacity, states[-1].break_in_s) == (0, 0.0)
    refused = bus.ask(line, "award", award(quote.quote, name="w2"), Ack)
    assert (refused.accepted, "I have a break, 'lunch'" in refused.reason) == (False, True)
    bus.serve(lambda: events[-1].kind == "break_end")
    assert [(e.reason, e.time_s >= 300.0) for e in events if e.kind == "break_end"] == [("lunch", True)]
    bus.serve(lambda: states[-1].break_in_s is None)
    assert bus.ask(line, "quote", request(), Quote).capacity == 1
    assert arm.node.unfit() == ""


def test_a_stopped_arm_returns_its_job_as_sure(bus):
    auctioneer, line, states = Auctioneer(bus.link()), bus.link(), []
    line.subscribe(keys.of_every_arm("f", "state"), State, lambda _, state: states.append(state))
    arm = bus.arm(speed=1.0)
    assign(bus, line)
    bus.serve(lambda: states)
    assert not states[-1].leaving
    arm.node.retire(time.monotonic())
    bus.serve(lambda: auctioneer.reports and states[-1].leaving)
    (report,) = auctioneer.reports
    assert (report.outcome, report.unsure, report.reason) == ("returned", False, "The arm was stopped.")
    bus.serve(lambda: not arm.node.executor.has_pending_reports)
    again = bus.ask(line, "quote", request(), Quote)
    assert again.capacity == 0
    assert not bus.ask(line, "award", award(again.quote, name="w2"), Ack).accepted


@pytest.mark.ci_slow
def test_a_faulted_arm_returns_its_job_with_the_cycles_and_a_person_clears_the_fault(bus):
    auctioneer, line, events = Auctioneer(bus.link()), bus.link(), []
    line.subscribe(keys.of_every_arm("f", "event"), ArmEvent, lambda _, e: events.append(e), history=True)
    limits = ThermalLimits(warning_c=33.0, error_c=34.0, restart_c=30.0, clear_s=1e5)
    arm = bus.arm(limits=limits, warning_c=1000.0, speed=600.0, warm=False)
    assert not bus.ask(line, "reset", ResetRequest("ann"), ResetReply).changed
    long = JobSpec(name="j", kind="hold", places=("bench",), repetitions=5000)
    assign(bus, line, long)
    bus.serve(lambda: auctioneer.reports and {"fault", "return"} <= {e.kind for e in events})
    (report,) = auctioneer.reports
    fault, returned = (next(e for e in events if e.kind == kind) for kind in ("fault", "return"))
    assert (report.outcome, report.time_s, report.faulted) == ("returned", fault.time_s, True)
    assert report.cycles == returned.value > 3
    assert bus.ask(line, "quote", request(), Quote).capacity == 0
    bus.serve(lambda: arm.body.truth.temp_c[0, 0, WINDING].max() < 29.0)
    assert bus.ask(line, "reset", ResetRequest("ann"), ResetReply).changed
    bus.serve(lambda: any(e.kind == "recover" for e in events))
    assert next(e for e in events if e.kind == "recover").reason == "cleared by 'ann'"
    assert not bus.ask(line, "reset", ResetRequest("ann"), ResetReply).changed
    assert [record.by for record in arm.book.records() if isinstance(record, FaultCleared)] == ["ann"]


def test_a_hot_arm_quotes_but_accepts_no_award(bus):
    line = bus.link()
    bus.arm(warning_c=20.0)
    quote = bus.ask(line, "quote", request(), Quote)
    assert quote.headroom_k < 0
    assert "too hot" in bus.ask(line, "award", award(quote.quote), Ack).reason


def test_fleet_time_is_the_auctioneers_from_the_first_message(bus):
    line = bus.link()
    start_s = time.monotonic()
    line.reply_to(keys.of_clock("f"), ClockRequest, lambda _: Clock(5000.0 + 30.0 * (time.monotonic() - start_s), 30.0))
    arm = bus.arm()
    bus.serve(lambda: arm.node.clock.speed == 30.0)
    off_s = arm.node.clock.now_s(time.monotonic()) - 5000.0 - 30.0 * (time.monotonic() - start_s)
    assert abs(off_s) < 30.0 * 0.5
    bus.serve(lambda: arm.body.time_s > 5000.0)
    assert arm.body.truth.tick[0] < 1000  # set, not lived through


def test_planning_delays_state_messages_by_one_plan_at_most(bus, monkeypatch):
    """Twenty motions of 50 ms each: the answer comes within its time, states go on, and the rest is planned after."""
    monkeypatch.setattr("fleet.live.arm.node.PLANNING_S", PLANNING_S)
    planned = []
    own = bus.small.arm(0, [bus.small.work("bench")])

    def slowly(work):
        end_s = time.monotonic() + 0.05
        while time.monotonic() < end_s:
            pass
        planned.append(work)
        if work.payload_kg > 9:
            raise InfeasibleJob("arm_0", "bench", "torque")
        return next(iter(own.plans.values()))

    line, came = bus.link(), []
    line.subscribe(keys.of_every_arm("f", "state"), State, lambda _, state: came.append(state.time_s))
    bus.arm(plan=slowly, speed=1.0)
    bus.serve(lambda: len(came) > 3)

    def in_time(attempt: int) -> bool:
        payloads_kg = [i / 2 - attempt / 100 for i in range(1, 21)]
        jobs = tuple(JobSpec(f"{attempt} {kg}", "hold", ("bench",), payload_kg=kg) for kg in payloads_kg)
        del came[:-1]
        began_s = time.monotonic()
        quote = bus.ask(line, "quote", request(*jobs), Quote)
        took_s = time.monotonic() - began_s
        bus.serve(lambda: came and came[-1] - came[0] > 0.5)
        longest_s = np.diff(came).max()
        late = [o.job for o in quote.estimates if o.reason == NOT_PLANNED]
        bus.serve(lambda: len(planned) == 20 * (attempt + 1))
        quote = bus.ask(line, "quote", request(*jobs), Quote)
        assert [o.feasible for o in quote.estimates] == [kg <= 9 for kg in payloads_kg]
        return took_s < PLANNING_S + 0.4 and longest_s < IDLE_PERIOD_S + 0.3 and 0 < len(late) < 20

    assert any(in_time(attempt) for attempt in range(5))  # a busy machine delays one attempt, a defect all


class Continues:
    """A peak at the temperature of the hottest motor, and 20 K more with twice the assumed heat."""

    version = "continues"

    def score(self, plan, repetitions):
        peak = Forecast(np.zeros(JOINTS), np.eye(JOINTS, KNOWN), gain=np.full(JOINTS, 20.0))
        return Difficulty(np.full(JOINTS, 0.1), peak=peak)


def test_an_arm_quotes_by_the_offset_of_its_sensors_and_the_heat_that_it_has_found(bus, monkeypatch):
    """At 25 °C by its sensors: 22 K more than it reads, and half of the 20 K of twice the heat."""
    monkeypatch.setattr(SimulatedBody, "found", (1.5, -22.0))
    bus.arm(warm=False, model=Continues())
    quote = bus.ask(bus.link(), "quote", request(), Quote)
    assert quote.estimates[0].plans[0].peak_c == pytest.approx(47.0 + 10.0, abs=0.05)


def test_a_replayed_log_is_an_arm_that_takes_no_work(bus):
    time_s = np.linspace(0.0, 20.0, 201)
    ramp = np.tile(time_s[:, None], (1, 7))
    readings = SensorLog(
        time_s=time_s + 77.0, temp_c=30.0 + ramp, q=0.1 * ramp, qd=np.full_like(ramp, 0.1), tau=ramp, current_a=-ramp
    )

    def refuse(work):
        raise InfeasibleJob("arm_0", work.places[0].name, "it replays a log")

    line, states = bus.link(), []
    line.subscribe(keys.of_every_arm("f", "state"), State, lambda _, state: states.append(state))
    bus.arm(plan=refuse, body=ReplayBody(readings, time_s=100.0), speed=20.0, takes_jobs=False)
    bus.serve(lambda: states and states[-1].time_s > 125.0)
    for state in states:
        into_s = min(np.floor((state.time_s - 100.0) * 10 + 1e-6) / 10, 20.0)
        assert state.temp_c == pytest.approx((30.0 + into_s,) * 7)
        assert state.current_a == pytest.approx((-into_s,) * 7)
        assert state.mode == ("idle" if into_s == 20.0 else "working")
    assert states[-1].qd == (0.0,) * 7
    quote = bus.ask(line, "quote", request(), Quote)
    assert (quote.capacity, quote.estimates[0].feasible) == (0, False)
    assert "replays a log" in quote.estimates[0].reason
    assert not bus.ask(line, "award", award(quote.quote), Ack).accepted
