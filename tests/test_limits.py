"""The limits of motor and core: a core of known resistance beside the simulated steady state of its joint."""

import numpy as np
import pytest

from fleet.heat.limits import CORE, MOTOR, core_allowance_k_per_w
from fleet.motor import thermal_data
from fleet.robot import JOINTS
from fleet.thermal import HOUSING, WINDING, gen3_network, housing, node_heat, thermal_model


def test_the_limits_are_those_of_the_user_guide():
    assert tuple(MOTOR) == (0.0, 60.0, 75.0, 80.0)
    assert tuple(CORE) == (0.0, 80.0, 90.0, 100.0)


@pytest.mark.parametrize("joint", range(JOINTS))
def test_a_core_of_the_allowed_resistance_warns_just_as_its_motor_reaches_the_error_limit(joint):
    network = gen3_network()
    for j in range(1, JOINTS):
        network.edges[housing(j - 1), housing(j)]["conductance_w_per_k"] = 0.0
    model, idle_w = thermal_model(network), np.array(thermal_data()["idle_w"])
    per_watt = model.steady(node_heat(np.ones(JOINTS), np.zeros(JOINTS)), 0.0)[WINDING][joint]
    idle_c = model.steady(node_heat(np.zeros(JOINTS), idle_w), 36.0)[WINDING][joint]
    copper_w = np.full(JOINTS, (MOTOR.error_c - idle_c) / per_watt)
    settled_c = model.steady(node_heat(copper_w, idle_w), 36.0)
    assert settled_c[WINDING][joint] == pytest.approx(MOTOR.error_c)
    core_c = settled_c[HOUSING][joint] + core_allowance_k_per_w(joint, 36.0) * idle_w[joint]
    assert core_c == pytest.approx(CORE.warning_c)


def test_cooler_air_allows_more():
    assert core_allowance_k_per_w(1, 20.0) > core_allowance_k_per_w(1, 36.0)
