"""Estimated housing temperatures: against the differential equation, and in a shift."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fleet.engine.shift import step
from fleet.engine.state import initial
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import HOUSING, WINDING, gen3_network, housing_observer, thermal_model

MOTORS, THERMAL = gen3_motors(), thermal_model(gen3_network())


@pytest.mark.parametrize("dt_s", [1.0, 10.0, 400.0])
def test_a_step_solves_the_heat_balance_of_the_housings(dt_s) -> None:
    rng = np.random.default_rng(0)
    motor_c, housing_c, friction_w = rng.uniform(30, 60, 7), rng.uniform(25, 45, 7), rng.uniform(0, 3, 7)

    def slope(_, temp_c):
        heat = -THERMAL.laplacian[HOUSING, HOUSING] @ temp_c - THERMAL.laplacian[HOUSING, WINDING] @ motor_c
        return (heat + THERMAL.to_ambient[HOUSING] * 22.0 + MOTORS.idle_w + friction_w) / THERMAL.capacity[HOUSING]

    exact = solve_ivp(slope, (0.0, dt_s), housing_c, rtol=1e-10, atol=1e-10).y[:, -1]
    estimate = housing_observer(THERMAL, MOTORS, dt_s).step(housing_c, motor_c, 22.0, friction_w)
    assert estimate == pytest.approx(exact, abs=1e-6)


def test_an_arm_that_knows_itself_estimates_its_housings(small) -> None:
    """The true network, from a start that is 8 K wrong; the error decays with the time constants of the housings."""
    content = small.work(payload_kg=3.0)
    world, plant = small.shop([[small.job("a", content, repetitions=900)]], arms=1, ticks=1000)
    state = initial(world)
    state.housing_c[:] += 8.0
    errors = []
    for tick in range(world.ticks):
        state = step(world, state, np.array([[int(tick == 0)]]), plant).state
        errors.append(np.abs(state.housing_c[0, 0] - state.temp_c[0, 0, HOUSING]).max())
    assert errors[0] > 7.0
    assert errors[-1] < 0.3
    assert state.temp_c[0, 0, HOUSING].max() > 27.0  # they warmed meanwhile
