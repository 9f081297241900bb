"""The live body equals the arm of a simulated shift, and does only allowed cycles."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from fleet.engine.batch import Engine, RewardWeights, empty_parts
from fleet.env.allocation_v2 import Episode, parallel_env
from fleet.heat.thermal import WINDING, modal_model
from fleet.live.arm.body import ExpectedTemperatures, SimulatedBody
from fleet.observation import Layout
from fleet.robot import ThermalLimits
from fleet.telemetry import FAULTED

DT_S = 10.0
LIMITS = ThermalLimits()
SOON_HOT = ThermalLimits(warning_c=38.0, error_c=40.0, restart_c=36.0)
"""A hot job passes them within minutes."""


def body_of(arm, *, dt_s=DT_S, limits=LIMITS, ambient_c=lambda time_s: 25.0, warm=False, seed=0, time_s=0.0):
    rng = np.random.default_rng(seed)
    return SimulatedBody(arm, limits, ambient_c, dt_s=dt_s, rng=rng, warm=warm, time_s=time_s)


def one_job(small, *, repetitions=3, payload=None, times=None):
    """An arm, a job of three cycles of 10 s after 3 s of approach, 2 s of retreat, and its plan."""
    content = small.work(payload_kg=small.LIGHT if payload is None else payload)
    arm = small.arm(0, [content], times=times)
    return arm, small.job("a", content, repetitions=repetitions), arm.plans[content][0]


def started(small, allowed, *, done=0, repetitions=3, payload=None, **options):
    """A body with a job of which some cycles are done, and some allowed; `options` are those of `body_of`."""
    arm, job, plan = one_job(small, repetitions=repetitions, payload=payload)
    body = body_of(arm, **options)
    body.start(job, plan, done)
    body.allow_cycles(allowed)
    return body


@pytest.mark.ci_slow
@settings(max_examples=8, phases=[Phase.generate])
@given(st.data())
def test_a_body_passes_the_same_shift_as_the_simulator(small, data):
    """One arm, the same jobs in the same order: temperatures at every tick and every event agree."""
    draw = data.draw
    loads = [small.LIGHT, small.WARM, small.HOT]
    works = [small.work(f"p{i}", load) for i, load in enumerate(loads)]
    spans = small.Times(*(draw(st.integers(1, 900)) / 50 for _ in range(3)))
    arm = small.arm(0, works, times=spans)
    jobs = [
        small.job(
            f"j{i}",
            works[draw(st.integers(0, 2))],
            repetitions=draw(st.integers(1, 40)),
            release_s=float(draw(st.integers(0, 600))),
            due_s=2000.0,
        )
        for i in range(draw(st.integers(1, 5)))
    ]
    limits = ThermalLimits(  # faults within a short shift
        warning_c=35.0, error_c=40.0, restart_c=34.0, move_home_s=draw(st.sampled_from([0.0, 33.0, 90.0, 900.0]))
    )
    world, plant = small.shop([jobs], arms=[arm], limits=limits, dt_s=DT_S, ticks=200, slots=8)
    air = 25.0 + 3.0 * np.sin(np.arange(200) / 30.0)[:, None]
    world.tables.ambient_c[:] = air
    shift = parallel_env(
        lambda seed: Episode(world=world, plant=plant, twins=("t",), sensors=np.random.SeedSequence(0)),
        keep_events=True,
    )
    body = body_of(arm, limits=limits, ambient_c=lambda time_s: float(air[int(time_s / DT_S), 0]))
    shift.reset(seed=0)
    waiting = {job.name: job.release_s for job in jobs}
    done, by_name, lived = dict.fromkeys(waiting, 0), {job.name: job for job in jobs}, []
    for tick in range(world.ticks):
        legal = shift.knowledge()["arm_0"].action_mask
        shift.step({"arm_0": 1 if legal[1] else 0})
        order = sorted(waiting, key=lambda n: (waiting[n], list(by_name).index(n)))
        ready = [n for n in order if waiting[n] <= tick * DT_S]
        if body.is_free and ready:
            job = by_name[ready[0]]
            del waiting[job.name]
            body.start(job, arm.plans[job.work][0], done[job.name])
            body.allow_cycles(job.repetitions)
        for each in body.advance((tick + 1) * DT_S):
            again = each.kind == "return" and any((e.kind, e.job) == ("return", each.job) for e in lived)
            lived.append(replace(each, kind="give_up") if again else each)  # the second fault with this job
            if each.kind == "return":
                done[each.job] = int(each.value)
                waiting |= {} if again else {each.job: each.time_s}
        assert (body.away is None) == (shift.truth.plan[0, 0] < 0)
        np.testing.assert_allclose(body.truth.temp_c[0, 0], shift.truth.temp_c[0, 0], rtol=0, atol=1e-6)
        assert body.truth.mode[0, 0] == shift.truth.mode[0, 0]
        if not shift.agents:
            break
    told = ("finish", "home", "warning", "fault", "return", "give_up", "recover", "moved")
    expected = sorted((e.kind, e.job, round(e.time_s, 6)) for e in shift.events if e.kind in told)
    assert sorted((e.kind, e.job, round(e.time_s, 6)) for e in lived if e.kind in told) == expected
    assert {n: c for n, c in done.items() if n in waiting} == {
        n: int(shift.truth.cycles[0, j]) for j, n in enumerate(world.shifts[0].names) if n in waiting
    }


def test_a_job_ends_at_its_planned_time_for_any_step(small):
    arm, job, plan = one_job(small)
    for dt_s in (0.3, 0.7, 6.0):
        body = body_of(arm, dt_s=dt_s)
        body.start(job, plan, 1)
        assert body.last_cycle_in_s() == pytest.approx(3.0 + 10.0)
        assert body.free_in_s() == pytest.approx(3.0 + 20.0 + 2.0)
        body.allow_cycles(3)
        events = body.advance(60.0)
        assert [(e.kind, e.job) for e in events if e.kind in ("finish", "home")] == [("finish", "a"), ("home", "a")]
        assert [e.time_s for e in events if e.kind in ("finish", "home")] == pytest.approx([23.0, 25.0])
        assert body.is_free


def test_without_permission_it_returns_home_before_the_last_cycle(small):
    body = started(small, 2, dt_s=1.0)
    events = body.advance(24.0)
    assert body.cycles == 2
    assert body.last_cycle_in_s() == pytest.approx(1.0 + 3.0)  # on its way home, and back again
    events += body.advance(100.0)
    assert [e.kind for e in events] == ["home"]
    assert events[0].time_s == pytest.approx(25.0)
    assert (body.job, body.cycles, body.is_free) == ("a", 2, False)
    body.allow_cycles(3)
    events = body.advance(200.0)
    assert [(e.kind, e.time_s) for e in events] == [("finish", pytest.approx(113.0)), ("home", pytest.approx(115.0))]
    assert body.is_free


def test_early_permission_makes_it_one_stint(small):
    body = started(small, 2, dt_s=1.0)
    body.advance(22.0)
    assert body.last_cycle_in_s() == pytest.approx(1.0)
    body.allow_cycles(3)
    assert [e.time_s for e in body.advance(60.0) if e.kind == "finish"] == pytest.approx([33.0])


@pytest.mark.parametrize(
    ("when", "cycles", "home_s"), [(2.0, 0, 5.0), (3.5, 1, 15.0), (13.0, 1, 15.0), (14.0, 2, 25.0)]
)
def test_a_paused_arm_finishes_its_cycle_and_returns_home(small, when, cycles, home_s):
    body = started(small, 3, dt_s=0.5)
    body.advance(when)
    body.allow_cycles(body.cycles)
    events = body.advance(50.0)
    assert [(e.kind, e.time_s) for e in events] == [("home", pytest.approx(home_s))]
    assert (body.job, body.cycles) == ("a", cycles)


def test_nothing_moves_before_cycles_are_allowed(small):
    arm, job, plan = one_job(small, repetitions=1)
    body = body_of(arm)
    body.start(job, plan, 0)
    assert body.advance(300.0) == []
    assert (body.job, body.cycles, body.is_free) == ("a", 0, False)
    assert body.last_cycle_in_s() == pytest.approx(3.0)


def test_a_released_job_is_dropped_at_home(small):
    arm, job, plan = one_job(small)
    body = body_of(arm, dt_s=1.0)
    body.start(job, plan, 0)
    body.allow_cycles(3)
    body.advance(8.0)
    body.release()
    assert (body.job, body.is_free) == ("", False)
    assert [(e.kind, e.time_s) for e in body.advance(30.0)] == [("home", pytest.approx(15.0))]
    assert body.is_free
    body.start(job, plan, 0)
    body.release()
    assert body.is_free


def test_release_in_the_last_cycle_finishes_no_job(small):
    body = started(small, 3, done=2, dt_s=1.0)
    body.advance(8.0)
    body.release()
    assert [e.kind for e in body.advance(60.0)] == ["home"]


def test_a_faulted_arm_is_not_free_until_a_person_clears_the_fault_of_the_cool_arm(small):
    arm, job, plan = one_job(small, repetitions=5000, payload=small.HOT)
    body = body_of(arm, limits=SOON_HOT)
    body.start(job, plan, 0)
    body.allow_cycles(5000)
    while body.truth.mode[0, 0] != FAULTED:
        body.advance(body.time_s + DT_S)
    assert (body.is_free, body.free_in_s(), body.last_cycle_in_s()) == (False, np.inf, np.inf)
    assert set(body.read_sensors().current_a) == {0.0}
    with pytest.raises(ValueError, match="not free and cannot start"):
        body.start(job, plan, 0)
    assert "a fault can be cleared below 36 °C" in body.clear_fault()
    while body.truth.temp_c[0, 0, WINDING].max() >= SOON_HOT.restart_c:
        body.advance(body.time_s + DT_S)
    assert body.read_sensors().mode == "faulted", "it waits for a person"
    cool_s = body.time_s
    assert not body.clear_fault()
    events = body.advance(cool_s + DT_S)
    assert [(event.kind, event.time_s) for event in events] == [("recover", cool_s)]
    body.advance(body.time_s + 120.0)
    assert body.is_free
    assert body.away is None


def test_sensors_read_the_motion(small):
    arm, job, plan = one_job(small, payload=small.WARM)
    body = body_of(arm, dt_s=1.0, warm=True)
    rest = body.read_sensors()
    assert rest.mode == "idle"
    np.testing.assert_allclose(rest.q, arm.robot.home_q())
    np.testing.assert_allclose(rest.tau, arm.rest_tau)
    noise_k = arm.motors.sensor_noise_k
    assert (np.abs(np.array(rest.temp_c) - body.truth.temp_c[0, 0, WINDING]) < 6 * noise_k).all()
    body.start(job, plan, 0)
    body.allow_cycles(3)
    body.advance(5.0)
    working = body.read_sensors()
    assert working.mode == "working"
    np.testing.assert_allclose(working.tau, small.torque(small.WARM), rtol=1e-6)
    assert working.current_a[1] > rest.current_a[1] > 0
    body.advance(60.0)
    np.testing.assert_allclose(body.read_sensors().current_a, rest.current_a, rtol=1e-3)


def test_its_time_can_be_set_and_it_catches_up_in_bounded_steps(small, monkeypatch):
    monkeypatch.setattr("fleet.live.arm.body.MAX_STEPS", 40)
    arm, job, plan = one_job(small)
    body = body_of(arm, dt_s=1.0)
    body.advance(10.0)
    body.set_time(5000.0)
    assert body.time_s == pytest.approx(5000.0)
    body.start(job, plan, 0)
    body.allow_cycles(3)
    assert [e.time_s for e in body.advance(1e6) if e.kind == "finish"] == pytest.approx([5033.0])
    assert body.time_s == 5040.0


def test_a_change_of_step_changes_no_event(small):
    """A faulted arm is moved home and recovers at the same moments, whatever the steps; heat is exact at rest."""
    arm, job, plan = one_job(small, repetitions=5000, payload=small.HOT)
    bodies = [body_of(arm, dt_s=5.0, limits=replace(SOON_HOT, move_home_s=60.0)) for _ in range(2)]
    for body in bodies:
        body.start(job, plan, 0)
        body.allow_cycles(5000)
        while body.truth.mode[0, 0] != FAULTED:
            body.advance(body.time_s + 5.0)
    steady, changed = bodies
    changed.set_step(2.5)
    assert changed.time_s == pytest.approx(steady.time_s)
    until_s = steady.time_s + 900.0
    events = [[], []]
    for told, body in zip(events, bodies, strict=True):
        while body.time_s < until_s - 1e-6:
            told += body.advance(until_s)
    assert [[event.kind for event in told] for told in events] == [["moved", "recover"]] * 2
    for one, other in zip(*events, strict=True):
        assert one.time_s == pytest.approx(other.time_s, abs=1e-3)
    np.testing.assert_allclose(steady.truth.temp_c, changed.truth.temp_c, atol=0.01)


def test_no_step_is_longer_than_the_limit_except_of_an_idle_arm(small):
    """One long step of an arm at rest ends as many short ones do."""
    arm, job, plan = one_job(small, repetitions=5000)
    body = SimulatedBody(
        arm, LIMITS, lambda time_s: 25.0, dt_s=60.0, max_dt_s=10.0, rng=np.random.default_rng(0), warm=False
    )
    body.advance(10.0)
    assert body.time_s == 10.0
    body.set_step(30.0)
    body.advance(39.0)
    assert body.time_s == 10.0
    body.advance(40.0)
    steps = body_of(arm, dt_s=1.0, limits=LIMITS, warm=False)
    steps.advance(40.0)
    np.testing.assert_allclose(body.truth.temp_c, steps.truth.temp_c, atol=1e-3)
    body.start(job, plan, 0)
    body.advance(50.0)
    assert body.time_s == 50.0


def test_a_body_measures_the_heat_of_its_job_once_the_cycles_have_begun(small):
    arm, job, plan = one_job(small, payload=small.WARM)
    harder = replace(plan, cycle=small.phase(10.0, np.sqrt(1.3) * small.torque(small.WARM)))
    found = {}
    for learns in (True, False):
        body = body_of(replace(arm, learns=learns, executed={plan: harder}, known=(arm.thermal, arm.motors)), dt_s=1.0)
        body.start(job, plan, 0)
        body.allow_cycles(3)
        found[learns] = []
        for second in range(1, 36):
            body.advance(float(second))
            found[learns].append(body.excess)
    assert found[False] == [None] * 35
    assert found[True][:2] == [None] * 2  # the approach takes 3 s
    assert found[True][3:30] == pytest.approx([0.3] * 27, abs=1e-3)
    assert found[True][-1] is None  # at home


@pytest.mark.parametrize(("drift_k_per_s", "time_s"), [(0.0, 0.0), (-0.01, 0.0), (0.01, 36_000.0)])
def test_an_arm_finds_by_how_much_its_readings_have_drifted(small, drift_k_per_s, time_s):
    """At home in a steady state, also in an arm that starts late.

    Smoothed with a time constant of 100 s, the offset lags by as much. Readings that are too high may also be heat of
    motors that are hardly warm.
    """
    arm, _, _ = one_job(small)
    quiet = replace(arm.motors, sensor_noise_k=np.zeros(7))
    arm = replace(arm, motors=quiet, learns=True, known=(arm.thermal, quiet), drift_k_per_s=drift_k_per_s)
    body = body_of(arm, warm=True, time_s=time_s)
    expected = body._expected
    assert expected is not None
    first_c = expected.temp_c
    read_c = [np.array(body.read_sensors().temp_c)]
    for tick in range(1, 201):
        body.advance(time_s + DT_S * tick)
        read_c.append(np.array(body.read_sensors().temp_c))
        if tick == 150:
            body.set_step(DT_S / 2.0)
            body.set_time(body.time_s)
    np.testing.assert_allclose(expected.temp_c, first_c, atol=0.02)
    least_k, most_k = (9.0, 19.0) if drift_k_per_s > 0.0 else (drift_k_per_s * 2000.0, drift_k_per_s * 1700.0)
    assert least_k - 0.1 <= body.found[1] <= most_k + 0.1
    np.testing.assert_allclose(np.diff(read_c, axis=0), drift_k_per_s * DT_S, atol=0.02)


def test_without_a_reading_an_arm_does_not_change_what_it_has_found(small):
    arm, _, _ = one_job(small)
    known = np.arange(4, dtype=np.float32)
    expected = ExpectedTemperatures(arm.thermal, np.full(14, 40.0), known.copy())
    expected.step(np.zeros(14), 10.0, 25.0, np.full(7, np.nan))
    assert (expected.moments == known).all()
    assert (expected.temp_c < 40.0).all()
    with pytest.raises(ValueError, match="must be > 0 s"):
        body_of(arm).set_step(0.0)


def test_a_body_compares_its_temperatures_as_the_arms_of_a_simulated_shift_do(small):
    """At work, with a network that cools half as much as the arm believes and motors that are not those it believes."""
    content = small.work(payload_kg=small.WARM)
    arm = small.arm(0, [content], times=small.Times(approach=20.0, cycle=30.0, retreat=20.0))
    half = 0.5 * arm.thermal.to_ambient
    worse = modal_model(arm.thermal.capacity, arm.thermal.laplacian - np.diag(half), half)
    hotter = replace(arm.motors, copper_w_per_a2=1.1 * arm.motors.copper_w_per_a2)
    arm = replace(arm, thermal=worse, motors=hotter, learns=True, known=(arm.thermal, arm.motors))
    job = small.job("a", content, repetitions=40)
    world, _ = small.shop([[job]], arms=[arm], dt_s=DT_S, ticks=150, slots=1)
    engine = Engine(world.tables, 1, Layout(1, 1), RewardWeights())
    engine.reset(np.arange(1), world.shifts)
    parts = empty_parts(engine.layout, 1)
    engine.observe(np.arange(1), parts)
    body = body_of(arm)
    body.start(job, arm.plans[content][0], 0)
    body.allow_cycles(40)
    for tick in range(1, 151):
        engine.step(np.ones((1, 1), int) if tick == 1 else None, parts)
        body.advance(DT_S * tick)
    excess, offset_k = engine.measured(0, [0])
    assert body.found[0] > 1.05
    assert body.found == pytest.approx((1.0 + excess[0, 0], offset_k[0]), abs=0.1)
