"""The plans on offer: the fastest, and one that is clearly cooler by a simulation of the whole job."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import NODES, WINDING, gen3_network, simulate_temperatures, thermal_model
from fleet.motion import drives
from fleet.offered_plans import COOLER_K, offered_plans, predicted_rise

MOTORS, THERMAL = gen3_motors(), thermal_model(gen3_network())


def variants(small, *loads):
    """Return plans of one work with these (cycle seconds, torque factor)."""
    content, plans = small.work(payload_kg=4.0), []
    for cycle_s, factor in loads:
        (plan,) = small.arm(0, [content], times=small.Times(3.0, cycle_s, 2.0)).plans[content]
        profile = plan.cycle.profile.copy()
        profile[:, 2] *= factor
        plans.append(replace(plan, cycle=replace(plan.cycle, profile=profile)))
    return plans


def simulated_rise(plan, repetitions: int) -> float:
    """Rise of the hottest motor of a nominal arm above its idle temperature by the end of the job, in small steps."""
    idle_c = THERMAL.steady(np.concatenate([np.zeros(7), MOTORS.idle_w]), 25.0)
    temp_c = idle_c
    for phase, count in zip(plan.phases, (1, repetitions, 1), strict=True):
        load = drives([phase.profile], MOTORS)
        end = simulate_temperatures(
            load, [phase.duration_s * count], motors=MOTORS, thermal=THERMAL, start_c=temp_c, ambient_c=25.0
        )
        temp_c = end.end_c[0]
    assert temp_c.shape == (NODES,)
    return float((temp_c - idle_c)[WINDING].max())


@pytest.mark.parametrize("repetitions", [1, 20, 150])
def test_the_predicted_rise_is_that_of_the_simulation(small, repetitions) -> None:
    plans = variants(small, (10.0, 1.0), (14.0, 0.7), (10.0, 0.3))
    expected = [simulated_rise(plan, repetitions) for plan in plans]
    assert predicted_rise(tuple(plans), repetitions) == pytest.approx(expected, rel=0.12, abs=0.05)


def test_the_coolest_is_offered_beside_the_fastest_if_it_is_clearly_cooler(small) -> None:
    fast, slow_cool, slow_same, middle = plans = variants(small, (10.0, 1.0), (14.0, 0.7), (14.0, 1.0), (12.0, 0.9))
    assert offered_plans(plans, 100) == [fast, slow_cool]
    assert offered_plans([slow_same, fast], 100)[0] is fast
    assert offered_plans([fast, middle], 150) == [fast, middle]
    saved_k = simulated_rise(fast, 150) - simulated_rise(middle, 150)
    assert saved_k > COOLER_K
    assert offered_plans([slow_cool], 5) == [slow_cool]
    assert offered_plans([], 5) == []


def test_a_cooler_plan_that_is_as_fast_is_the_only_one(small) -> None:
    hot, cool = variants(small, (10.0, 1.0), (10.0, 0.99))
    assert offered_plans([hot, cool], 3) == [hot]  # hardly cooler: neither 1 K nor a tenth
