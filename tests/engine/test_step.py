"""One step of a shift: moments of events, heat, and what is conserved, whatever the actions."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from fleet.engine.shift import open_jobs, step
from fleet.engine.state import DONE, GIVEN_UP, RUNNING, WAITING, State, World, initial
from fleet.events import Event
from fleet.heat.motor import gen3_motors, thermal_data
from fleet.heat.thermal import WINDING, gen3_network, thermal_model
from fleet.robot import JOINTS, ThermalLimits
from fleet.telemetry import FAULTED, IDLE, WORKING
from tests.engine.play import DT_S, play, times, with_random_difficulty
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
        [max(0.0, done - 150.0)] * len(times(log, "finish"))
    )
    home = done + retreat / 50
    assert times(log, "home") == pytest.approx([home] if home <= world.horizon_s else [])


def test_an_arm_that_is_home_at_the_end_of_a_step_is_free_in_the_next(small) -> None:
    content = small.work()
    # 0.1 + 3 · 0.1 + 9.6 s is a whole step, but not in floating point.
    spans = small.Times(0.1, 0.1, 9.6)
    world, plant = small.shop([[small.job("a", content)]], arms=[small.arm(0, [content], times=spans)], ticks=2)
    assert play(world, plant, [[1]])[0].state.mode[0, 0] == IDLE


def test_a_job_waits_for_its_release_and_its_predecessors(small) -> None:
    first, second = small.work("bench"), small.work("rack")
    jobs = [
        small.job("late", second, release_s=31.0),
        small.job("next", second, after=("first",)),
        small.job("first", first),
    ]
    world, plant = small.shop([jobs], ticks=12)
    log: list[Event] = []
    state = initial(world)
    offered: list[set[str]] = []
    for _ in range(world.ticks):
        now = open_jobs(world, state)[0][0]
        offered.append({world.jobs.names[0][j] for j in now.tolist() if j >= 0})
        claim = now.tolist().index(2) + 1 if 2 in now.tolist() else 0
        state = step(world, state, np.array([[claim, 0]]), plant, log).state
    # first: 3 s approach and three cycles of 10 s; ticks begin every 10 s.
    assert [("late" in o, "next" in o, "first" in o) for o in offered[:6]] == [
        (False, False, True),
        (False, False, False),
        (False, False, False),
        (False, False, False),
        (True, True, False),
        (True, True, False),
    ]
    assert times(log, "finish") == [33.0]
    assert sorted((e.job, e.time_s) for e in log if e.kind == "release") == [("first", 0), ("late", 31), ("next", 0)]


def test_arms_stay_idle_in_a_shift_without_jobs(small) -> None:
    content = small.work()
    world, plant = small.shop([[]], arms=[small.arm(0, [content]), small.arm(1, [content])], ticks=30)
    last = play(world, plant, [[1, 2]])[-1].state
    assert (last.mode == IDLE).all()
    assert (last.busy_s == 0).all()
    assert last.illegal.tolist() == [[1, 1]]


# Rows and arms


@pytest.mark.parametrize("envs", [2, 5])
def test_a_row_does_not_depend_on_the_number_of_rows(small, envs) -> None:
    works = [small.work(p, kg) for p in ("bench", "rack") for kg in (small.LIGHT, small.HOT)]
    shifts = [
        [small.job(f"j{i}", works[(i + e) % 4], repetitions=50 + i, release_s=20.0 * i) for i in range(3 + e)]
        for e in range(envs)
    ]
    arms = [small.arm(i, works) for i in range(3)]
    together, plant = small.shop(shifts, arms=arms, ticks=120)
    rng = np.random.default_rng(3)
    actions = rng.integers(0, 5, (120, envs, 3))
    together = with_random_difficulty(together, rng)
    many = initial(together)
    ones = []
    for e, jobs in enumerate(shifts):
        world, own = small.shop([jobs], arms=arms, ticks=120)
        difficulty = together.offers.difficulty[e : e + 1, :, : len(jobs)]
        ones.append((replace(world, offers=replace(world.offers, difficulty=difficulty)), own))
    states = [initial(world) for world, _ in ones]
    for tick in range(120):
        many = step(together, many, actions[tick], plant).state
        for e, (world, own) in enumerate(ones):
            states[e] = step(world, states[e], actions[tick, e : e + 1], own).state
    assert many.faults.sum() > 0
    for e, state in enumerate(states):
        for name in State._fields:
            if name == "plan":
                continue  # rows of other tables
            row, one = getattr(many, name)[e], getattr(state, name)[0]
            np.testing.assert_array_equal(row[: len(one)] if one.shape else row, one, err_msg=name)


def test_relabelling_the_arms_relabels_the_shift(small) -> None:
    works = [small.work(p, kg) for p in ("bench", "rack", "press") for kg in (small.LIGHT, small.HOT)]
    jobs = [small.job(f"j{i}", works[i], repetitions=20) for i in range(6)]
    # Two different motors, so that the arms differ.
    kinds = [small.arm(i, works, times=small.Times(3, 8 + i, 2)) for i in range(3)]
    order = [2, 0, 1]
    straight, plant = small.shop([jobs], arms=kinds)
    turned, turned_plant = small.shop([jobs], arms=[kinds[i] for i in order])
    rng = np.random.default_rng(8)
    straight = with_random_difficulty(straight, rng)
    turned = replace(turned, offers=replace(turned.offers, difficulty=straight.offers.difficulty[:, order]))
    one, other = initial(straight), initial(turned)
    for _ in range(straight.ticks):
        actions = rng.integers(0, 5, (1, 3))
        one = step(straight, one, actions, plant).state
        other = step(turned, other, actions[:, order], turned_plant).state
    assert one.faults.sum() > 0
    for name in State._fields:
        mine, theirs = getattr(one, name), getattr(other, name)
        if name in ("plan", "failed_arm"):
            continue  # rows and arms by other numbers
        per_arm = mine.shape[:2] == (1, 3) and name not in ("status", "queued_s", "cycles", "returns", "finished_s")
        np.testing.assert_allclose(mine[:, order] if per_arm else mine, theirs, rtol=1e-12, err_msg=name)


@st.composite
def shifts(draw):
    """Draw a small shift, and a seed for legal and illegal actions."""
    arms, jobs = draw(st.integers(1, 3)), draw(st.integers(0, 6))
    rows = [
        (
            draw(st.sampled_from(["bench", "rack", "press"])),
            draw(st.sampled_from([0.0, 4.0, 8.0, 10.0])),
            draw(st.integers(1, 12)),
            draw(st.sampled_from([0.0, 5.0, 50.0, 1e4])),
            draw(st.booleans()) and i > 0,
        )
        for i in range(jobs)
    ]
    ticks = draw(st.integers(1, 60))
    actions = draw(st.integers(0, 2**32 - 1))
    narrow = draw(st.booleans())
    crowded = draw(st.sampled_from([0.0, 0.3, 0.9]))
    return arms, rows, ticks, actions, narrow, crowded


@examples(60)
@given(shifts())
def test_jobs_and_time_are_conserved(small, shift) -> None:
    arms, rows, ticks, seed, narrow, crowded = shift
    works = [small.work(place, payload) for place, payload, *_ in rows]
    jobs = [
        small.job(f"j{i}", works[i], repetitions=n, release_s=release, due_s=2e4, after=(f"j{i - 1}",) if after else ())
        for i, (_, _, n, release, after) in enumerate(rows)
    ]
    near = ThermalLimits(warning_c=40.0, error_c=42.0, restart_c=39.9, clear_s=7.0, power_off_on_fault=False)
    fleet = [small.arm(i, dict.fromkeys(works) or [small.work()], times=small.Times(3, 7 + i, 2)) for i in range(arms)]
    world, plant = small.shop(
        [jobs], arms=fleet, ticks=ticks, slots=3, ambient_c=30.0, limits=near if narrow else ThermalLimits()
    )
    rng = np.random.default_rng(seed)
    world = with_random_difficulty(world, rng)
    conflicts = np.triu(rng.random((len(world.plans.volume),) * 2) < crowded, 1)
    conflicts |= conflicts.T
    world = replace(world, plans=replace(world.plans, volume=np.arange(len(conflicts))), conflicts=conflicts)
    log: list[Event] = []
    state = initial(world)
    for tick in range(ticks):
        actions = rng.choice([-7, 0, 1, 1, 2, 3, 4, 99], size=(1, arms))
        before = state.copy()
        _, mask = open_jobs(world, state)
        after = step(world, state, actions, plant, log).state
        for name, value in before._asdict().items():
            np.testing.assert_array_equal(getattr(state, name), value, err_msg=f"{name} of the state before")
        inside = (actions >= 0) & (actions <= 4)
        chosen = np.take_along_axis(mask, np.where(inside, actions, 0)[..., None], axis=2)[..., 0]
        allowed = inside & (chosen == 1)
        np.testing.assert_array_equal(after.illegal - state.illegal, ~allowed)
        state = after
        table, time_s = world.jobs, (tick + 1) * DT_S
        assert np.isin(state.status, [WAITING, RUNNING, DONE, GIVEN_UP]).all()
        assert (state.cycles <= table.repetitions).all()
        assert (state.cycles >= 0).all()
        held = [j for j in state.job[0].tolist() if j >= 0]
        running = np.flatnonzero(state.status[0] == RUNNING).tolist()
        assert len(held) == len(set(held))
        assert set(running) <= set(held)
        given_back = {e.job for e in log if e.kind == "give_back"}
        assert all(state.status[0, j] in (RUNNING, DONE) or f"j{j}" in given_back for j in held)
        assert (state.mode[0][state.job[0] >= 0] == WORKING).all()
        assert (state.plan[0][state.mode[0] == WORKING] >= 0).all()
        assert (state.plan[0][state.mode[0] == IDLE] < 0).all()
        places = [p for j in held for p in table.stations[0, j].tolist() if p >= 0]
        assert len(places) == len(set(places)), "two arms at one station"
        away = state.plan[0][state.plan[0] >= 0]
        assert not conflicts[np.ix_(away, away)].any(), "two arms whose plans touch"
        for j in held:
            assert all(state.status[0, p] == DONE for p in table.after[0, j].tolist() if p >= 0)
            assert table.release_s[0, j] <= time_s
        assert ((state.status == DONE) == ~np.isnan(state.finished_s)).all()
        assert (state.cycles[state.status == DONE] == table.repetitions[state.status == DONE]).all()
        # Seconds busy, lost and idle.
        assert (state.busy_s >= -1e-9).all()
        assert (state.lost_s >= -1e-9).all()
        assert (state.busy_s + state.lost_s <= time_s + 1e-6).all()
        assert (state.above_warning_s <= time_s + 1e-6).all()
    counts = {
        kind: len(times(log, kind))
        for kind in ("award", "finish", "return", "give_up", "fault", "recover", "give_back")
    }
    ended = counts["finish"] + counts["return"] + counts["give_up"] + counts["give_back"]
    assert counts["award"] == ended + int((state.status == RUNNING).sum())
    assert counts["fault"] == int(state.faults.sum())
    assert counts["return"] + counts["give_up"] == int(state.returns.sum())
    assert counts["fault"] == counts["recover"] + int((state.mode == FAULTED).sum())
    _check_seconds(world, state, log)


def _check_seconds(world, state, log) -> None:
    """Compute busy and lost time from the event log."""
    for a, name in enumerate(world.arms):
        busy = lost = 0.0
        since_award, since_fault, away = None, None, False
        for e in sorted((e for e in log if e.arm == name), key=lambda e: e.time_s):
            if e.kind == "award":
                since_award = e.time_s
            elif e.kind in ("home", "fault") and since_award is not None:
                busy, since_award, away = busy + e.time_s - since_award, None, e.kind == "fault"
            if e.kind == "fault":
                since_fault = e.time_s
            elif e.kind == "moved":
                away = False
            elif e.kind == "recover":
                assert since_fault is not None
                lost, since_fault = lost + e.time_s - since_fault, None
                if away:  # it goes home from the beginning of the next step
                    since_award = math.ceil(e.time_s / DT_S - 1e-9) * DT_S
        busy += 0.0 if since_award is None else world.horizon_s - since_award
        lost += 0.0 if since_fault is None else world.horizon_s - since_fault
        assert state.busy_s[0, a] == pytest.approx(busy, abs=1e-6)
        assert state.lost_s[0, a] == pytest.approx(lost, abs=1e-6)


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
    assert after == pytest.approx(exact.y[:, -1], abs=1e-6)  # profiles are float32


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


def test_temperatures_converge_with_the_step_size(small) -> None:
    content = small.work(payload_kg=small.WARM)
    ends = []
    for dt_s in (10.0, 5.0, 1.0):
        world, plant = small.shop([[small.job("a", content, repetitions=200)]], dt_s=dt_s, ticks=round(600 / dt_s))
        ends.append(play(world, plant, [[1, 0]])[-1].state.temp_c)
    coarse, middle, fine = ends
    assert np.abs(coarse - fine).max() < 0.2
    # First order: the error is proportional to the step. Against 1 s, e(10) : e(5) = 9 : 4.
    assert np.abs(coarse - fine).max() / np.abs(middle - fine).max() == pytest.approx(9 / 4, rel=0.1)


def test_an_idle_warm_fleet_is_in_steady_state(small) -> None:
    content = small.work()
    world, plant = small.shop([[]], arms=[small.arm(0, [content])], ticks=60, start_warm=True)
    assert play(world, plant, [])[-1].state.temp_c == pytest.approx(initial(world).temp_c, abs=1e-6)


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
            np.testing.assert_allclose(s.state.temp_c[0, a], temp_c, atol=1e-8)
        assert steps[-1].state.energy_j[0, a] == pytest.approx(stored + lost, rel=1e-9)


def heated(world: World, a: int, start_c, heat_w, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return temperatures after constant heat, and the time integral of (T − 25 °C), [node], by expm."""
    m, n = world.thermal, 2 * JOINTS
    law = np.zeros((2 * n + 1, 2 * n + 1))  # of temperatures above ambient, their integral, and 1
    law[:n, :n], law[:n, -1] = -m.laplacian[a] / m.capacity[a][:, None], heat_w / m.capacity[a]
    law[n : 2 * n, :n] = np.eye(n)
    end = expm(law * seconds) @ np.concatenate([start_c - 25.0, np.zeros(n), [1.0]])
    return end[:n] + 25.0, end[n : 2 * n]


def test_the_motors_of_a_standing_arm_are_nominal(small) -> None:
    """The arms have the parameters that `rhs` reads from the data file."""
    assert gen3_motors().copper_w_per_a2.tolist() == thermal_data()["copper_w_per_a2"]
    assert small.arm(0, [small.work()]).thermal.capacity[WINDING].tolist() == thermal_data()["winding_j_per_k"]
