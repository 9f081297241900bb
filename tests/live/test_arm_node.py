"""An arm without a network: state, quotes, leased jobs, reports, faults. Restarts are in test_allocation."""

import time
from collections import defaultdict
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec.structs import replace

from fleet.breaks import Break
from fleet.bus.client import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    ArmEvent,
    Award,
    Clock,
    ClockRequest,
    JobSpec,
    Lease,
    LeaseRequest,
    QuoteRequest,
    Receipt,
    Report,
)
from fleet.bus.protocol.messages import DifficultyScores, Info, State
from fleet.bus.protocol.operator import ResetRequest
from fleet.difficulty import KNOWN, Difficulty, Forecast
from fleet.errors import InfeasibleJob
from fleet.heat.thermal import WINDING
from fleet.job import Place
from fleet.live.arm.awards import ArmHistory, AwardExecutor, ExecutorConfig, FaultCleared
from fleet.live.arm.body import ReplayBody, SensorLog, SimulatedBody
from fleet.live.arm.estimator import NOT_PLANNED, Estimator, NominalPeaks
from fleet.live.arm.node import IDLE_PERIOD_S, PLANNING_S, ArmConfig, ArmNode
from fleet.live.clock import FleetClock
from fleet.robot import JOINTS, ThermalLimits
from tests.live.disk import Disk
from tests.live.wire import Wire
from tests.waiting import PATIENCE_S, wait_until

LIMITS = ThermalLimits()
SPEED, START_S = 60.0, 100.0
"""Fleet seconds per real second, and fleet time at which an arm starts."""
TURN_S = 0.02
"""Real seconds of a turn."""
JOB = JobSpec(name="j", kind="hold", places=("bench",), repetitions=3)
PLACES = {name: Place(name=name, position_m=(0.5, 0.0, 0.2)) for name in ("bench", "rack")}


class Line(Wire):
    """The bus of one arm, and an auctioneer that grants all leases, and permission to commit when asked.

    Attributes:
        published: Messages of the arm, by kind.
        now: Reply to requests for the clock; None for none.
    """

    def __init__(self):
        super().__init__()
        self.published, self.shown = defaultdict(list), []
        self.leases, self.reports, self.now = [], [], None

    def publisher(self, key, kind):
        return self.published[kind].append

    def declare_token(self, key):
        self.shown.append(key)

    def query(self, key, request, kind, done, *, timeout_s, each=None):
        reply = None
        match request:
            case LeaseRequest(_, entries):
                self.leases.append(request)
                finishing = tuple(entry.award for entry in entries if entry.phase == "finishing")
                reply = Lease("x", 2.0, tuple(entry.award for entry in entries), (), finishing)
            case Report():
                self.reports.append(request)
                reply = Receipt("x", request.award)
            case ClockRequest() if self.now is not None:
                reply = self.now()
        done(Replies({} if reply is None else {key: reply}))


class LoneArm:
    """An arm on its line."""

    def __init__(self, node, line, disk, body, clock):
        self.node, self.line, self.disk, self.body, self._clock = node, line, disk, body, clock
        self.events, self.states, self.words = (line.published[kind] for kind in (ArmEvent, State, DifficultyScores))

    @property
    def real_s(self):
        """Its time, which passes with its turns alone, or is that of the machine."""
        return self._clock.now_s()

    def until(self, condition):
        """Serve the arm, a turn at a time, until a condition holds."""
        if self._clock.now_s is time.monotonic:
            wait_until(condition, lambda: self.node.serve(time.monotonic()))
            return
        for _ in range(200_000):
            if condition():
                return
            self._clock.passed_s += TURN_S
            self.node.serve(self.real_s)
        raise AssertionError("waited in vain")

    def ask(self, request):
        return self.line.handlers[type(request)](request)

    def assign(self, job=JOB):
        """Award a job to the arm on a new quote."""
        assert self.ask(award(self.ask(request(job)).quote, job)).accepted

    def kinds(self):
        return [event.kind for event in self.events]


@pytest.fixture
def make(small, monkeypatch):
    """Make an arm; it replies when it has planned, however slow the machine is."""
    monkeypatch.setattr("fleet.live.arm.node.PLANNING_S", PATIENCE_S / 2)

    def arm(*, plan=None, body=None, model=None, speed=SPEED, limits=LIMITS, warm=True, in_real_time=False, **config):
        clock, line, disk = SimpleNamespace(passed_s=1000.0, now_s=time.monotonic), Line(), Disk()
        clock.sleep = lambda seconds: setattr(clock, "passed_s", clock.passed_s + seconds)
        if not in_real_time:
            clock.now_s = lambda: clock.passed_s
            monkeypatch.setattr("fleet.live.arm.node.time", SimpleNamespace(monotonic=clock.now_s, sleep=clock.sleep))
        content = small.work("bench")
        own = small.arm(0, [content])
        steps = {"dt_s": speed / 20, "rng": np.random.default_rng(0), "time_s": START_S, "warm": warm}
        body = body or SimulatedBody(own, limits, lambda _: 25.0, **steps)
        history, executing = ArmHistory().after_restart("arm_0", 0.0), ExecutorConfig(valid_s=3.0)
        executor = AwardExecutor("arm_0", disk.keep, history, nonce="n", config=executing)
        estimator = Estimator(model or own.model, plan or (lambda work: own.plans[content]), PLACES, NominalPeaks())
        config = ArmConfig(**{"warning_c": 60.0, "rate_hz": 20.0, **config})
        node = ArmNode(line, body, executor, estimator, FleetClock(speed, clock.now_s(), START_S), config)
        return LoneArm(node, line, disk, body, clock)

    return arm


def request(*jobs, dry_run=False):
    return QuoteRequest("r", jobs or (JOB,), dry_run=dry_run)


def award(quote, job=JOB, name="w"):
    return Award(award=name, auction="r", auctioneer="x", quote=quote, job=job, lease_s=2.0)


def test_an_arm_publishes_info_and_state(make):
    arm = make()
    assert arm.line.shown == [keys.of_arm("f", "arm_0", "alive")]
    assert arm.line.published[Info] == [Info("arm_0", 7, "by payload")]
    state = arm.states[-1]
    assert (state.mode, state.job, len(state.q), len(state.current_a)) == ("idle", "", 7, 7)
    assert state.headroom_k == pytest.approx(60.0 - max(state.temp_c))
    assert state.time_s >= 100.0


def test_a_job_goes_from_quote_to_receipt(make):
    arm = make()
    quote = arm.ask(request())
    assert (quote.capacity, quote.valid_s, quote.twin, quote.space) == (1, 3.0, "by payload", ())
    ((offer,),) = (estimate.plans for estimate in quote.estimates)
    assert offer.duration_s == pytest.approx(35.0)
    assert arm.ask(award(quote.quote)).accepted
    assert arm.ask(request(dry_run=True)).space == (offer.space,)
    arm.until(lambda: arm.line.reports)
    (report,) = arm.line.reports
    assert (report.outcome, report.cycles, report.job) == ("finished", 3, "j")
    # Where the leave to finish comes late, it stands at its end until the next step.
    stood_s = report.time_s - next(e.time_s for e in arm.events if e.kind == "award") - 33.0
    assert stood_s >= -1e-6
    assert stood_s / (SPEED / 20) == pytest.approx(round(stood_s / (SPEED / 20)), abs=1e-6)
    assert any(h.phase == "finishing" for leased in arm.line.leases for h in leased.entries)
    arm.until(lambda: arm.kinds() == ["award", "finish", "home"])
    assert [e.number - arm.events[0].number for e in arm.events] == [0, 1, 2]
    assert arm.words[-1].jobs == ("j",)
    arm.until(lambda: not ArmHistory().replay(arm.disk.records).reports)
    last = arm.ask(request())
    assert (last.capacity, last.space) == (1, ())
    arm.until(lambda: arm.states[-1].mode == "idle")
    assert {(state.mode, state.space) for state in arm.states} == {("idle", ""), ("working", offer.space)}


def test_an_idle_arm_publishes_twice_a_second_and_a_working_one_at_its_rate(make, monkeypatch):
    """Rates by definition: 2 and 20 Hz. The first state of a job does not wait for the period of an idle arm.

    An idle arm makes one step for each state: ten times fewer than a working one, which is what it costs.
    """
    arm, states, steps = make(), [], []
    step = SimulatedBody._step
    monkeypatch.setattr(SimulatedBody, "_step", lambda body: steps.append(arm.real_s) or step(body))
    monkeypatch.setattr(arm.node._publish, "state", lambda state: states.append((arm.real_s, state.mode)))
    arm.until(lambda: len(states) >= 6)
    assert np.diff([at_s for at_s, _ in states])[1:] == pytest.approx(0.5, abs=0.021)
    assert len(steps) == len(states)
    arm.assign(replace(JOB, repetitions=20))
    began_s, before = arm.real_s, len(states)
    arm.until(lambda: len(states) >= before + 20)
    working_s = [at_s for at_s, mode in states[before:] if mode == "working"]
    assert working_s[0] - began_s < 0.25
    assert np.diff(working_s) == pytest.approx(0.05, abs=0.021)


def test_a_job_of_an_idle_arm_begins_after_its_award(make):
    """At 60 times real time, 0.4 s after the last step of an idle arm; the job takes 3 s to its place and 3 x 10 s."""
    arm = make()
    arm.until(lambda: len(arm.states) > 2)
    arm.states.clear()
    arm.until(lambda: arm.states)
    arm._clock.passed_s += 0.4
    arm.assign()
    awarded_s = arm.node.clock.now_s(arm.real_s)
    arm.until(lambda: arm.line.reports)
    assert arm.line.reports[0].time_s >= awarded_s + 33.0 - SPEED / 20


def test_a_dry_run_changes_nothing(make):
    arm = make()
    before = list(arm.disk.records)
    quote = arm.ask(request(dry_run=True))
    assert quote.quote == ""
    assert quote.estimates[0].feasible
    assert not arm.words
    arm.ask(request())
    assert len(arm.words) == 1
    assert list(arm.disk.records) == before


@pytest.mark.parametrize(("finish", "repetitions"), [("cycle", 40), ("job", 8)])
def test_an_arm_takes_no_jobs_in_a_break_and_returns_or_finishes_its_own_first(make, finish, repetitions):
    arm = make(breaks=(Break(name="lunch", begin_s=160.0, end_s=300.0, finish=finish),))
    arm.assign(replace(JOB, repetitions=repetitions))
    arm.until(lambda: "break" in arm.kinds() and arm.line.reports)
    (report,) = arm.line.reports
    if finish == "job":
        assert (report.outcome, report.cycles) == ("finished", 8)
    else:
        begun_s = next(e.time_s for e in arm.events if e.kind == "award") + 3.0
        assert report.outcome == "returned"
        assert report.reason == "a break, 'lunch'"
        assert report.cycles == int((report.time_s - 2.0 - begun_s) / 10.0 + 1e-6)
        assert 1 <= report.cycles < 20
    quote = arm.ask(request())
    assert (quote.capacity, arm.states[-1].break_in_s) == (0, 0.0)
    refused = arm.ask(award(quote.quote, name="w2"))
    assert (refused.accepted, "I have a break, 'lunch'" in refused.reason) == (False, True)
    arm.until(lambda: arm.events[-1].kind == "break_end")
    assert [(e.reason, e.time_s >= 300.0) for e in arm.events if e.kind == "break_end"] == [("lunch", True)]
    arm.until(lambda: arm.states[-1].break_in_s is None)
    assert arm.ask(request()).capacity == 1
    assert arm.node.unfit() == ""


def test_a_stopped_arm_returns_its_job_as_sure(make):
    arm = make(speed=1.0)
    arm.assign()
    assert not arm.states[-1].leaving
    arm.node.retire(arm.real_s)
    arm.until(lambda: arm.line.reports)
    assert arm.states[-1].leaving
    (report,) = arm.line.reports
    assert (report.outcome, report.unsure, report.reason) == ("returned", False, "The arm was stopped.")
    assert not arm.node.executor.has_pending_reports
    again = arm.ask(request())
    assert again.capacity == 0
    assert not arm.ask(award(again.quote, name="w2")).accepted


@pytest.mark.parametrize("patience_s", [0.0, 1.0])
def test_a_router_that_limits_the_rate_forwards_the_last_state_of_an_arm(make, monkeypatch, patience_s):
    """It drops a state that comes less than 10 ms after the one before; the arm is stopped right after a state."""
    arm, forwarded = make(), [(-1.0, None)]

    def forward(state):
        if arm.real_s >= forwarded[-1][0] + 1.0 / keys.CHANNEL["arm", "state"].limit_hz:
            forwarded.append((arm.real_s, state))

    monkeypatch.setattr(arm.node._publish, "state", forward)
    arm.until(lambda: len(forwarded) > 2)
    arm.node.retire(arm.real_s + patience_s)
    last = forwarded[-1][1]
    assert (last.leaving, last.job, last.space) == (True, "", "")


@pytest.mark.parametrize("has_begun", [False, True])
def test_a_stopped_arm_returns_as_sure_a_permitted_job_whose_last_cycle_has_not_begun(make, has_begun):
    """Also far from home; after the last cycle has begun, only the next start returns it, as unsure."""
    arm = make(speed=1.0)
    arm.line.serve = lambda until_s: setattr(arm._clock, "passed_s", until_s)
    arm.assign(replace(JOB, repetitions=1))
    arm.until(lambda: arm.body.away is not None and (arm.body.last_cycle_in_s() == 0.0) == has_begun)
    (active,) = arm.node.executor.active
    assert active.may_commit
    arm.node.retire(arm.real_s + 1.0)
    assert arm.body.away is not None
    assert [(report.outcome, report.cycles, report.unsure) for report in arm.line.reports] == (
        [] if has_begun else [("returned", 0, False)]
    )
    reports = ArmHistory().replay(arm.disk.records).after_restart("arm_0", 0.0).reports.values()
    assert [report.unsure for _, report in reports] == [True] * has_begun
    arm.until(lambda: arm.body.away is None)
    assert ("finish" in arm.kinds()) == has_begun


def test_a_stopped_arm_at_home_leaves_once_it_has_quoted_that_it_takes_no_space(make):
    """Otherwise its space would stay closed to the others until a person clears it."""
    arm, quotes = make(), []

    def serve(until_s):
        arm._clock.passed_s = until_s
        if until_s >= asked_s:
            quotes.append(arm.ask(request(dry_run=True)))

    arm.line.serve = serve
    arm.assign()
    arm._clock.passed_s += TURN_S
    asked_s = arm.real_s + 2.0
    arm.node.retire(arm.real_s + 60.0)
    assert [report.outcome for report in arm.line.reports] == ["returned"]
    assert [quote.space for quote in quotes] == [()]
    assert arm.real_s == pytest.approx(asked_s, abs=IDLE_PERIOD_S)


def test_a_faulted_arm_returns_its_job_with_the_cycles_and_a_person_clears_the_fault(make):
    limits = ThermalLimits(warning_c=33.0, error_c=34.0, restart_c=30.0, clear_s=1e5)
    arm = make(limits=limits, warning_c=1000.0, speed=600.0, warm=False)
    assert not arm.ask(ResetRequest("ann")).changed
    arm.assign(replace(JOB, repetitions=5000))
    arm.until(lambda: arm.line.reports and {"fault", "return"} <= {*arm.kinds()})
    (report,) = arm.line.reports
    fault, returned = (next(e for e in arm.events if e.kind == kind) for kind in ("fault", "return"))
    assert (report.outcome, report.time_s, report.faulted) == ("returned", fault.time_s, True)
    assert report.cycles == returned.value > 3
    assert arm.ask(request()).capacity == 0
    arm.until(lambda: arm.body.truth.temp_c[0, 0, WINDING].max() < 29.0)
    assert arm.ask(ResetRequest("ann")).changed
    arm.until(lambda: "recover" in arm.kinds())
    assert next(e for e in arm.events if e.kind == "recover").reason == "cleared by 'ann'"
    assert not arm.ask(ResetRequest("ann")).changed
    assert [record.by for record in arm.disk.records if isinstance(record, FaultCleared)] == ["ann"]


def test_a_hot_arm_quotes_but_accepts_no_award(make):
    arm = make(warning_c=20.0)
    quote = arm.ask(request())
    assert quote.headroom_k < 0
    assert "too hot" in arm.ask(award(quote.quote)).reason


def test_fleet_time_is_the_auctioneers_from_the_first_message(make):
    arm = make()
    start_s = arm.real_s
    arm.line.now = lambda: Clock(5000.0 + 30.0 * (arm.real_s - start_s), 30.0)
    arm.until(lambda: arm.node.clock.speed == 30.0)
    assert arm.node.clock.now_s(arm.real_s) == pytest.approx(arm.line.now().time_s)
    arm.until(lambda: arm.body.time_s > 5000.0)
    assert arm.body.truth.tick[0] < 1000  # set, not lived through


def test_planning_delays_state_messages_by_one_plan_at_most(make, monkeypatch, small):
    """Twenty motions of 50 ms each: the answer comes within its time, states go on, and the rest is planned after."""
    planned, came = [], []
    own = small.arm(0, [small.work("bench")])

    def slowly(work):
        end_s = time.monotonic() + 0.05
        while time.monotonic() < end_s:
            pass
        planned.append(work)
        if work.payload_kg > 9:
            raise InfeasibleJob("arm_0", "bench", "torque")
        return next(iter(own.plans.values()))

    arm = make(plan=slowly, speed=1.0, in_real_time=True)
    monkeypatch.setattr("fleet.live.arm.node.PLANNING_S", PLANNING_S)
    monkeypatch.setattr(arm.node._publish, "state", lambda state: came.append(state.time_s))
    arm.until(lambda: len(came) > 3)

    def in_time(attempt: int) -> bool:
        payloads_kg = [i / 2 - attempt / 100 for i in range(1, 21)]
        jobs = tuple(JobSpec(f"{attempt} {kg}", "hold", ("bench",), payload_kg=kg) for kg in payloads_kg)
        del came[:-1]
        began_s = time.monotonic()
        quote = arm.ask(request(*jobs))
        took_s = time.monotonic() - began_s
        arm.until(lambda: came and came[-1] - came[0] > 0.5)
        longest_s = np.diff(came).max()
        late = [o.job for o in quote.estimates if o.reason == NOT_PLANNED]
        arm.until(lambda: len(planned) == 20 * (attempt + 1))
        quote = arm.ask(request(*jobs))
        assert [o.feasible for o in quote.estimates] == [kg <= 9 for kg in payloads_kg]
        return took_s < PLANNING_S + 0.4 and longest_s < IDLE_PERIOD_S + 0.3 and 0 < len(late) < 20

    assert any(in_time(attempt) for attempt in range(5))  # a busy machine delays one attempt, a defect all


class Continues:
    """A peak at the temperature of the hottest motor, and 20 K more with twice the assumed heat."""

    version = "continues"

    def score(self, plan, repetitions):
        peak = Forecast(np.zeros(JOINTS), np.eye(JOINTS, KNOWN), gain=np.full(JOINTS, 20.0))
        return Difficulty(np.full(JOINTS, 0.1), peak=peak)


def test_an_arm_quotes_by_the_offset_of_its_sensors_and_the_heat_that_it_has_found(make, monkeypatch):
    """At 25 °C by its sensors: 22 K more than it reads, and half of the 20 K of twice the heat."""
    monkeypatch.setattr(SimulatedBody, "found", (1.5, -22.0))
    quote = make(warm=False, model=Continues()).ask(request())
    assert quote.estimates[0].plans[0].peak_c == pytest.approx(47.0 + 10.0, abs=0.05)


def test_a_replayed_log_is_an_arm_that_takes_no_work(make):
    time_s = np.linspace(0.0, 20.0, 201)
    ramp = np.tile(time_s[:, None], (1, 7))
    readings = SensorLog(
        time_s=time_s + 77.0, temp_c=30.0 + ramp, q=0.1 * ramp, qd=np.full_like(ramp, 0.1), tau=ramp, current_a=-ramp
    )

    def refuse(work):
        raise InfeasibleJob("arm_0", work.places[0].name, "it replays a log")

    arm = make(plan=refuse, body=ReplayBody(readings, time_s=100.0), speed=20.0, takes_jobs=False)
    arm.until(lambda: arm.states[-1].time_s > 125.0)
    for state in arm.states:
        into_s = min(np.floor((state.time_s - 100.0) * 10 + 1e-6) / 10, 20.0)
        assert state.temp_c == pytest.approx((30.0 + into_s,) * 7)
        assert state.current_a == pytest.approx((-into_s,) * 7)
        assert state.mode == ("idle" if into_s == 20.0 else "working")
    assert arm.states[-1].qd == (0.0,) * 7
    quote = arm.ask(request())
    assert (quote.capacity, quote.estimates[0].feasible) == (0, False)
    assert "replays a log" in quote.estimates[0].reason
    assert not arm.ask(award(quote.quote)).accepted
