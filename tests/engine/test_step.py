"""One step of a shift: moments of events, heat, and what is conserved, whatever the actions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from fleet.engine.shift import initial
from fleet.engine.world import World
from fleet.events import Event
from fleet.heat.motor import thermal_data
from fleet.heat.thermal import gen3_network, thermal_model
from fleet.robot import JOINTS, ThermalLimits
from fleet.telemetry import IDLE
from tests.engine.play import DT_S, play, times
from tests.profiles import examples


@examples(30)
@given(
    approach=st.integers(1, 800),
    cycle=st.integers(5, 1500),
    retreat=st.integers(1, 800),
    repetitions=st.integers(1, 9),
    award_tick=st.integers(0, 5),
)
def test_a_job_is_finished_and_its_arm_home_at_the_planned_moment(
    small, approach, cycle, retreat, repetitions, award_tick
) -> None:
    spans = small.Times(approach / 50, cycle / 50, retreat / 50)
    content = small.work()
    jobs = [small.job("a", content, repetitions=repetitions, due_s=150.0)]
    world, plant = small.shop([jobs], arms=[small.arm(0, [content], times=spans)], ticks=40)
    log: list[Event] = []
    last = play(world, plant, [[0]] * award_tick + [[1]], log)[-1].state
    done = award_tick * DT_S + (approach + repetitions * cycle) / 50
    assert times(log, "finish") == pytest.approx([done] if done <= world.horizon_s else [])
    assert last.finished_s[0, 0] == pytest.approx(done if done <= world.horizon_s else np.nan, nan_ok=True)
    assert [e.value for e in log if e.kind == "finish"] == pytest.approx(
        [max(0.0, done - 150.0)] * len(times(log, "finish")), abs=1e-4
    )
    home = done + retreat / 50
    assert times(log, "home") == pytest.approx([home] if home <= world.horizon_s else [])


def test_an_arm_that_is_home_at_the_end_of_a_step_is_free_in_the_next(small) -> None:
    content = small.work()
    # 0.1 + 3 · 0.1 + 9.6 s is a whole step, but not in floating point.
    spans = small.Times(0.1, 0.1, 9.6)
    world, plant = small.shop([[small.job("a", content)]], arms=[small.arm(0, [content], times=spans)], ticks=2)
    assert play(world, plant, [[1]])[0].state.mode[0, 0] == IDLE


def test_a_release_is_an_event_at_its_time(small) -> None:
    """Also of a job that still waits for another."""
    first, second = small.work("bench"), small.work("rack")
    jobs = [
        small.job("late", second, release_s=31.0),
        small.job("next", second, after=("first",)),
        small.job("first", first),
    ]
    world, plant = small.shop([jobs], ticks=12)
    log: list[Event] = []
    play(world, plant, [], log)
    assert sorted((e.job, e.time_s) for e in log if e.kind == "release") == [("first", 0), ("late", 31), ("next", 0)]


def rhs(temp_c, current_sq, friction_w, ambient_c, powered=True):
    """Return the heat law of each joint from the data file, K/s, [node]."""
    d, out = thermal_data(), np.empty(2 * JOINTS)
    for j in range(JOINTS):
        winding, housing = temp_c[j], temp_c[JOINTS + j]
        magnets = 1.0 + d["alpha_kt_per_k"] * (housing - d["reference_c"])
        copper = d["copper_w_per_a2"][j] * (1.0 + d["alpha_cu_per_k"] * (winding - d["reference_c"]))
        flow = (winding - housing) / d["winding_housing_k_per_w"][j]
        out[j] = (copper * current_sq[j] / magnets**2 - flow) / d["winding_j_per_k"][j]
        into = flow + friction_w[j] + powered * d["idle_w"][j]
        into -= (housing - ambient_c) / d["housing_ambient_k_per_w"][j]
        for k in (j - 1, j + 1):
            if 0 <= k < JOINTS:
                into += d["neighbour_w_per_k"] * (temp_c[JOINTS + k] - housing)
        out[JOINTS + j] = into / d["housing_j_per_k"][j]
    return out


def amps_sq(tau):
    """Return the squared current of an arm at rest, A², [joint]."""
    d = thermal_data()
    return (tau / np.array(d["eta"]) / (d["gear_ratio"] * np.array(d["kt_nm_per_a"]))) ** 2


@pytest.mark.parametrize("payload_kg", [0.0, 4.0])
def test_one_step_of_a_constant_drive_is_the_exact_solution(small, payload_kg) -> None:
    content = small.work(payload_kg=payload_kg)
    spans = small.Times(3.0, 10.0, 2.0)
    world, plant = small.shop([[small.job("a", content, repetitions=100)]], arms=[small.arm(0, [content], times=spans)])
    steps = play(world, plant, [[1]])
    # Step 30, so that temperatures differ; the loss is constant within a step.
    before, after = steps[30].record.start_c[0, 0], steps[30].state.temp_c[0, 0]
    frozen = rhs(before, amps_sq(small.torque(payload_kg)), np.zeros(JOINTS), 25.0)
    laplacian = thermal_model(gen3_network()).laplacian / thermal_model(gen3_network()).capacity[:, None]
    exact = solve_ivp(lambda _, t: frozen - laplacian @ (t - before), (0, DT_S), before, rtol=1e-12, atol=1e-12)
    assert after == pytest.approx(exact.y[:, -1], abs=2e-5)  # profiles are float32


def test_a_long_job_follows_the_heat_law_integrated_by_scipy(small) -> None:
    content = small.work(payload_kg=small.WARM)
    spans = small.Times(0.0, 10.0, 2.0)
    jobs = [small.job("a", content, repetitions=1000)]
    fearless = ThermalLimits(warning_c=900.0, error_c=1000.0)
    arms = [small.arm(0, [content], times=spans, qd=0.3)]
    world, plant = small.shop([jobs], arms=arms, ticks=120, limits=fearless)
    got = play(world, plant, [[1]])[-1].state.temp_c[0, 0]
    d, qd, tau = thermal_data(), 0.3, small.torque(small.WARM)
    friction = np.array(d["coulomb_nm"]) * np.tanh(qd / d["v0_rad_s"]) + np.array(d["viscous_nms_per_rad"]) * qd
    current = (tau / np.array(d["eta"]) + friction) / (d["gear_ratio"] * np.array(d["kt_nm_per_a"]))
    law = solve_ivp(
        lambda _, t: rhs(t, current**2, friction * qd, 25.0), (0, 1200.0), np.full(14, 25.0), rtol=1e-9, atol=1e-9
    )
    assert got == pytest.approx(law.y[:, -1], abs=0.15)  # the loss lags by a step


def test_an_idle_warm_fleet_is_in_steady_state(small) -> None:
    content = small.work()
    world, plant = small.shop([[]], arms=[small.arm(0, [content])], ticks=60, start_warm=True)
    assert play(world, plant, [])[-1].state.temp_c == pytest.approx(initial(world).temp_c, abs=1e-4)


@pytest.mark.parametrize("power_off", [True, False])
def test_energy_equals_stored_heat_plus_heat_lost_to_ambient(small, power_off) -> None:
    content = small.work(payload_kg=small.HOT)
    limits = ThermalLimits(power_off_on_fault=power_off)
    world, plant = small.shop([[small.job("a", content, repetitions=60)]], ticks=120, limits=limits)
    steps = play(world, plant, [[1, 0]])
    assert steps[-1].state.faults[0, 0] == 1
    capacity, to_ambient = world.thermal.capacity, world.thermal.to_ambient
    for a in range(2):
        stored = ((steps[-1].state.temp_c - initial(world).temp_c)[0, a] * capacity[a]).sum()
        braked = np.concatenate([np.zeros(JOINTS), np.zeros(JOINTS) if power_off else world.motors.idle_w[a]])
        lost = 0.0
        for s in steps:
            cut_s = float(s.record.cut_s[0, a])
            temp_c, sum_kelvin_s = heated(world, a, s.record.start_c[0, a], s.record.heat_w[0, a], cut_s)
            lost += to_ambient[a] @ sum_kelvin_s
            temp_c, sum_kelvin_s = heated(world, a, temp_c, braked, DT_S - cut_s)
            lost += to_ambient[a] @ sum_kelvin_s
            np.testing.assert_allclose(s.state.temp_c[0, a], temp_c, atol=1e-5)
        assert steps[-1].state.energy_j[0, a] == pytest.approx(stored + lost, rel=1e-6)


def heated(world: World, a: int, start_c, heat_w, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return temperatures after constant heat, and the time integral of (T − 25 °C), [node], by expm."""
    m, n = world.thermal, 2 * JOINTS
    law = np.zeros((2 * n + 1, 2 * n + 1))  # of temperatures above ambient, their integral, and 1
    law[:n, :n], law[:n, -1] = -m.laplacian[a] / m.capacity[a][:, None], heat_w / m.capacity[a]
    law[n : 2 * n, :n] = np.eye(n)
    end = expm(law * seconds) @ np.concatenate([start_c - 25.0, np.zeros(n), [1.0]])
    return end[:n] + 25.0, end[n : 2 * n]
