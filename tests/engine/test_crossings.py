"""Times of limit crossings against SciPy, and the effects of warnings, faults and recoveries."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from fleet.engine.crossings import crossing_s, hottest_at, to_modes
from fleet.engine.shift import Stepped, initial, open_jobs, step
from fleet.engine.state import DONE, WAITING
from fleet.engine.world import World
from fleet.events import Event
from fleet.heat.thermal import NODES, WINDING
from fleet.robot import ThermalLimits
from fleet.telemetry import FAULTED, IDLE

DT_S, AMBIENT_C = 10.0, 25.0


def work_on(world: World, plant, log: list[Event]) -> list[Stepped]:
    """Play a shift in which arm 0 claims the oldest job if it may; the others wait."""
    state, steps = initial(world), []
    for _ in range(world.ticks):
        actions = np.zeros((1, len(world.arms)), dtype=int)
        legal = np.flatnonzero(open_jobs(world, state)[1][0, 0, 1:-1])
        actions[0, 0] = legal[0] + 1 if len(legal) else 0
        steps.append(step(world, state, actions, plant, log))
        state = steps[-1].state
    return steps


def hot_shop(small, *, payload_kg=8.0, repetitions=200, arms=1, start_c=25.0, **more):
    content = small.work(payload_kg=payload_kg)
    fleet = [small.arm(i, [content]) for i in range(arms)]
    jobs = [small.job("a", content, repetitions=repetitions)]
    return small.shop([jobs], arms=fleet, ambient_c=start_c, **more)


def hottest(temp_c) -> np.ndarray:
    return temp_c[..., WINDING].max(axis=-1)


def one(log: list[Event], kind: str) -> Event:
    return next(e for e in log if e.kind == kind)


def integrated(world: World, start_c, heat_w, seconds) -> tuple[np.ndarray, np.ndarray]:
    """Return times and hottest winding under constant heat by Runge-Kutta, every 5 ms."""
    m = world.thermal
    grid = np.arange(0.0, seconds + 1e-9, 0.005)

    def slope(_, t):
        return (heat_w + m.to_ambient[0] * AMBIENT_C - m.laplacian[0] @ t) / m.capacity[0]

    law = solve_ivp(slope, (0.0, grid[-1] + 1e-9), start_c, t_eval=grid, rtol=1e-10, atol=1e-10)
    return law.t, law.y[WINDING].max(axis=0)


def winding_after(world: World, start_c, heat_w, seconds: float) -> float:
    """Return the hottest motor after constant heat by the matrix exponential."""
    m = world.thermal
    law = np.zeros((NODES + 1, NODES + 1))
    law[:NODES, :NODES] = -m.laplacian[0] / m.capacity[0][:, None]
    law[:NODES, NODES] = (heat_w + m.to_ambient[0] * AMBIENT_C) / m.capacity[0]
    return float((expm(law * seconds) @ [*start_c, 1.0])[WINDING].max())


@pytest.mark.parametrize("start_c", [30.0, 80.0], ids=["warming", "cooling"])
def test_crossing_times_equal_brentq(small, start_c) -> None:
    """Also if the search hits the limit exactly; the time is never before the crossing."""
    world, _ = small.shop([[small.job("a")]])
    net = world.tables.modal[0, 0]
    heat_w, temp_c, modal = np.zeros(NODES), np.full(NODES, start_c), np.empty((6, NODES))
    heat_w[1] = 90.0 if start_c < 50.0 else 0.0
    temp_c[1] += 1.0
    to_modes(net, temp_c, heat_w + net["to_ambient"] * AMBIENT_C, modal)
    first_c, last_c = (winding_after(world, temp_c, heat_w, time_s) for time_s in (0.0, DT_S))
    assert (last_c > first_c) == (start_c < 50.0)
    exact = 0
    limits = np.random.default_rng(3).uniform(min(first_c, last_c), max(first_c, last_c), size=200)
    for limit_c in limits.tolist():
        root_s = crossing_s(net, modal, DT_S, limit_c, first_c, last_c)
        expected_s = brentq(lambda s, c=limit_c: winding_after(world, temp_c, heat_w, s) - c, 0.0, DT_S, xtol=1e-12)
        assert root_s == pytest.approx(expected_s, rel=0, abs=1e-9)
        there_c = hottest_at(net, modal, root_s)
        exact += there_c == limit_c
        assert there_c == limit_c or (there_c > limit_c) == (last_c > first_c)
    assert exact > 1


def test_times_of_warning_and_fault_equal_scipy(small) -> None:
    world, plant = hot_shop(small, ticks=120)
    log: list[Event] = []
    steps = work_on(world, plant, log)
    for kind, limit_c in (("warning", 60.0), ("fault", 75.0)):
        event = one(log, kind)
        s = steps[int(event.time_s // DT_S)]
        t, hot = integrated(world, s.record.start_c[0, 0], s.record.heat_w[0, 0], DT_S)
        assert event.time_s % DT_S == pytest.approx(t[np.argmax(hot >= limit_c)], abs=0.05)
        assert (event.joint, event.value, event.job) == (2, limit_c, "a")
    assert s.state.peak_c[0, 0] == pytest.approx(75.0, abs=1e-6)  # the highest temperature is that at the fault


def test_time_above_the_warning_limit_is_exact(small) -> None:
    limits = ThermalLimits(warning_c=45.0, error_c=200.0, restart_c=40.0)
    world, plant = hot_shop(small, repetitions=20, limits=limits, ticks=60)
    log: list[Event] = []
    steps = work_on(world, plant, log)
    above = 0.0
    for s in steps:
        t, hot = integrated(world, s.record.start_c[0, 0], s.record.heat_w[0, 0], DT_S)
        above += np.trapezoid((hot >= 45.0).astype(float), t)
    last = steps[-1].state
    assert hottest(last.temp_c)[0, 0] < 45.0
    assert last.above_warning_s[0, 0] == pytest.approx(above, abs=0.05)
    assert last.peak_c[0, 0] == pytest.approx(max(hottest(s.state.temp_c)[0, 0] for s in steps))
    assert len([e for e in log if e.kind == "warning"]) == 1


def test_a_fault_on_the_way_home_returns_nothing(small) -> None:
    content = small.work(payload_kg=10.0)
    arms = [small.arm(0, [content], times=small.Times(1.0, 1.0, 900.0))]
    world, plant = small.shop([[small.job("a", content, repetitions=1)]], arms=arms, ticks=90)
    log: list[Event] = []
    last = work_on(world, plant, log)[-1].state
    assert [e.kind for e in log if e.kind in ("finish", "fault", "return", "home")][:2] == ["finish", "fault"]
    assert not [e for e in log if e.kind in ("return", "give_up")]
    assert last.status[0, 0] == DONE


def test_an_arm_that_begins_too_hot_faults_at_once(small) -> None:
    world, plant = hot_shop(small, start_c=80.0, ticks=3)
    log: list[Event] = []
    steps = work_on(world, plant, log)
    assert one(log, "fault").time_s == 0.0
    assert steps[0].state.mode[0, 0] == FAULTED
    assert steps[0].state.busy_s[0, 0] == 0.0
    assert steps[0].state.lost_s[0, 0] == DT_S
    assert (steps[0].state.status[0, 0], steps[0].state.cycles[0, 0]) == (WAITING, 0)


@settings(max_examples=12)
@example(narrow=30.0, clear_s=33.0, dt_s=10.0, power_off=False)
@example(narrow=30.0, clear_s=33.0, dt_s=10.0, power_off=True)
@given(
    narrow=st.floats(0.02, 3.0), clear_s=st.floats(0.0, 25.0), dt_s=st.sampled_from([5.0, 10.0, 60.0]),
    power_off=st.booleans(),
)  # fmt: skip
def test_recovery_waits_for_every_motor_and_the_clearing_time(small, narrow, clear_s, dt_s, power_off) -> None:
    """For any distance of the limits: a fault and the fall below the restart limit may be in one step."""
    limits = ThermalLimits(
        warning_c=75.0 - narrow / 2, error_c=75.0, restart_c=75.0 - narrow, clear_s=clear_s,
        power_off_on_fault=power_off,
    )  # fmt: skip
    shift_s = 900.0 if narrow <= 3.0 else 3600.0
    world, plant = hot_shop(small, limits=limits, dt_s=dt_s, ticks=round(shift_s / dt_s))
    log: list[Event] = []
    steps = work_on(world, plant, log)
    events = sorted((e for e in log if e.kind in ("fault", "recover")), key=lambda e: e.time_s)
    assert [e.kind for e in events] == ["fault", "recover"] * (len(events) // 2) + ["fault"] * (len(events) % 2)
    assert len(events) >= 2
    for fault, recover in zip(events[::2], events[1::2], strict=False):
        assert recover.time_s >= fault.time_s + clear_s - 1e-6
    m, first = world.thermal, events[0]
    s = steps[int(first.time_s // dt_s)]
    at_fault = solve_ivp(
        lambda _, x: (s.record.heat_w[0, 0] + m.to_ambient[0] * 25.0 - m.laplacian[0] @ x) / m.capacity[0],
        (0, first.time_s % dt_s), s.record.start_c[0, 0], rtol=1e-10, atol=1e-10,
    ).y[:, -1]  # fmt: skip
    braked = np.concatenate([np.zeros(7), np.zeros(7) if power_off else world.motors.idle_w[0]])
    cool = solve_ivp(
        lambda _, x: (braked + m.to_ambient[0] * 25.0 - m.laplacian[0] @ x) / m.capacity[0], (0, shift_s), at_fault,
        rtol=1e-10, atol=1e-10, events=lambda _, x: x[WINDING].max() - limits.restart_c,
    )  # fmt: skip
    assert events[1].time_s == pytest.approx(first.time_s + cool.t_events[0][0] + clear_s, abs=0.01)
    ends_s = [*(e.time_s for e in events[1::2]), shift_s]
    lost_s = sum(end_s - fault.time_s for fault, end_s in zip(events[::2], ends_s, strict=False))
    assert steps[-1].state.lost_s[0, 0] == pytest.approx(lost_s, abs=1e-6)


def test_an_idle_arm_can_fault_too(small) -> None:
    limits = ThermalLimits(warning_c=30.0, error_c=31.0, restart_c=29.0)
    world, plant = hot_shop(small, arms=1, limits=limits, start_c=28.0, ticks=400)
    log: list[Event] = []
    state = initial(world)
    for _ in range(400):
        state = step(world, state, np.zeros((1, 1), int), plant, log).state
    assert one(log, "fault").job == ""
    assert state.busy_s[0, 0] == 0.0
    assert state.mode[0, 0] in (IDLE, FAULTED)
