"""The oracle against a shift, and against the heat law integrated by SciPy."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fleet.difficulty import KNOWN
from fleet.engine.shift import step
from fleet.engine.state import initial
from fleet.engine.world import warm_start
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import WINDING, drive_heat, gen3_network, steady_state, thermal_model
from fleet.motion import Plan, drive
from fleet.robot import ThermalLimits
from scenarios.prepare.arms import Oracle, peaks

MOTORS, THERMAL = gen3_motors(), thermal_model(gen3_network())
FEARLESS = ThermalLimits(warning_c=900.0, error_c=1000.0)


def plan_of(small, payload_kg: float) -> Plan:
    content = small.work(payload_kg=payload_kg)
    return small.arm(0, [content]).plans[content][0]


def oracle(start_c=None) -> Oracle:
    start = np.full(14, 25.0) if start_c is None else start_c
    return Oracle(MOTORS, THERMAL, start, 25.0, 60.0)


@pytest.mark.parametrize(("payload_kg", "repetitions"), [(0.0, 30), (4.0, 90), (8.0, 40)])
def test_peaks_equal_those_of_a_shift(small, payload_kg, repetitions) -> None:
    content = small.work(payload_kg=payload_kg)
    arms = [small.arm(0, [content], times=small.Times(0.0, 10.0, 0.02))]
    jobs = [small.job("a", content, repetitions=repetitions)]
    world, plant = small.shop([jobs], arms=arms, ticks=repetitions, limits=FEARLESS)
    state = initial(world)
    for tick in range(repetitions):
        state = step(world, state, np.array([[int(tick == 0)]]), plant).state
    plan = arms[0].plans[content][0]
    start = np.full(14, 25.0)
    (actual,) = peaks([plan], [10.0 * repetitions], motors=MOTORS, thermal=THERMAL, start_c=start, ambient_c=25.0)
    assert actual == pytest.approx(state.temp_c[0, 0, WINDING], abs=1e-9)
    assert actual.max() == pytest.approx(state.peak_c[0, 0], abs=1e-9)


@pytest.mark.parametrize("duration_s", [0.0, 2.0, 12.0, 99.0])
def test_heating_time_is_the_duration_of_the_plan(small, duration_s) -> None:
    plan = plan_of(small, 6.0)
    start = np.full(14, 30.0)
    load = drive(plan.cycle.profile, MOTORS)

    def slope(_, temp_c):
        heat = drive_heat(temp_c, load.current_sq, load.friction_w, MOTORS)
        return (heat + THERMAL.to_ambient * 25.0 - THERMAL.laplacian @ temp_c) / THERMAL.capacity

    law = solve_ivp(slope, (0.0, duration_s), start, rtol=1e-9, atol=1e-9).y[WINDING]
    other = plan_of(small, 0.0)  # other plans in the same call have no effect
    actual = peaks([plan, other], [duration_s, 55.0], motors=MOTORS, thermal=THERMAL, start_c=start, ambient_c=25.0)
    assert actual[0, 1] == pytest.approx(law[1].max(), abs=0.01 + 0.02 * (law[1].max() - 30.0))


def test_no_plans_have_no_peaks() -> None:
    assert peaks([], [], motors=MOTORS, thermal=THERMAL, start_c=np.zeros(14), ambient_c=0.0).shape == (0, 7)


def test_more_payload_or_more_repetitions_is_never_easier(small) -> None:
    plans = [plan_of(small, kg) for kg in (0.0, 1.0, 2.0, 4.0, 8.0)]
    by_payload = [oracle().score(p, 60).total for p in plans]
    assert by_payload == sorted(by_payload)
    assert len(set(by_payload)) == len(plans)
    by_length = [oracle().score(plans[3], n).total for n in (1, 5, 50, 500)]
    assert by_length == sorted(by_length)
    risk = [oracle().score(p, 200).p_at(np.full(KNOWN, 25.0)) for p in plans]
    assert risk[0] == 0.0
    assert risk[-1] == 1.0


def test_p_is_that_of_the_true_motors_from_any_state(small) -> None:
    """Against the simulation of the same plan from random states that the arm knows exactly."""
    plan, rng = plan_of(small, 6.0), np.random.default_rng(0)
    score, sure = oracle().score(plan, 60), 0
    for _ in range(60):
        ambient_c = rng.uniform(15.0, 40.0)
        housing_c = ambient_c + rng.uniform(0.0, 22.0, 7)
        start_c = np.concatenate([housing_c + rng.uniform(0.0, 4.0, 7), housing_c])
        (peak,) = peaks(
            [plan], [plan.duration_s(60)], motors=MOTORS, thermal=THERMAL, start_c=start_c, ambient_c=ambient_c
        )
        known_c = np.append(start_c, ambient_c)
        if start_c[:7].max() < peak.max() < 80.0:
            assert score.peak_at(known_c) == pytest.approx(peak.max(), abs=0.6)
        if abs(peak.max() - 60.0) > 1.0:
            assert score.p_at(known_c) == float(peak.max() > 60.0)
            sure += 1
    assert sure > 30


def test_difficulty_follows_its_formula(small) -> None:
    plan = plan_of(small, 4.0)
    score = oracle().score(plan, 30)
    (peak,) = peaks(
        [plan], [plan.duration_s(30)], motors=MOTORS, thermal=THERMAL, start_c=np.full(14, 25.0), ambient_c=25.0
    )
    assert score.per_joint == pytest.approx([1.0 - math.exp(-(c - 25.0) / (60.0 - 25.0)) for c in peak])


def test_a_warm_start_is_the_steady_state_at_rest(small) -> None:
    arm = small.arm(0, [small.work()])
    rest = arm.rest_drive()
    assert warm_start(arm, 25.0) == pytest.approx(steady_state(THERMAL, rest.current_sq, rest.friction_w, MOTORS, 25.0))
