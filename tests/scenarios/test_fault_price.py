"""The price of a fault against integrated cooling and drawn jobs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import NODES, WINDING, gen3_network, node_heat, thermal_model
from fleet.robot import ThermalLimits
from fleet.seeding import shift_seeds
from scenarios.spec.jobs import JobSampler, downtime_s, fault_price, weights_of
from scenarios.spec.load import load
from scenarios.spec.schema import Ambient, RewardSpec


@pytest.mark.parametrize(("power_off", "ambient_c"), [(True, 30.0), (False, 15.0)])
def test_the_downtime_is_the_integrated_cooling_of_a_long_loaded_arm(power_off, ambient_c) -> None:
    limits = ThermalLimits(power_off_on_fault=power_off, clear_s=45.0)
    model, idle_w = thermal_model(gen3_network()), node_heat(np.zeros(7), gen3_motors().idle_w)

    def rate(heat_w):
        return lambda _, temp_c: (heat_w + model.to_ambient * ambient_c - model.laplacian @ temp_c) / model.capacity

    def loaded_c(load_w: float) -> np.ndarray:
        heat_w = idle_w + load_w * np.eye(NODES)[1]
        return solve_ivp(rate(heat_w), (0.0, 1e5), np.full(NODES, ambient_c), method="LSODA", rtol=1e-8).y[:, -1]

    idle_c, by_watt_k = loaded_c(0.0), loaded_c(1.0) - loaded_c(0.0)
    start_c = idle_c + (limits.error_c - idle_c[1]) / by_watt_k[1] * by_watt_k

    def cool(_, temp_c):
        return temp_c[WINDING].max() - limits.restart_c

    after = np.zeros(NODES) if power_off else idle_w
    cooling = solve_ivp(rate(after), (0.0, 1e5), start_c, method="LSODA", rtol=1e-8, events=cool)
    assert downtime_s(limits, ambient_c, most_s=1e5) == pytest.approx(cooling.t_events[0][0] + 45.0, rel=1e-3)


def test_an_arm_that_never_cools_enough_is_lost_for_the_whole_shift() -> None:
    assert downtime_s(ThermalLimits(restart_c=30.0), 35.0, most_s=7200.0) == 7200.0


@pytest.mark.parametrize("name", ["quickstart", "active_waiting", "heat_wave"])
def test_the_value_rate_is_the_mean_of_drawn_shifts(name) -> None:
    scenario = load(name)
    sampler = JobSampler(scenario)
    drawn = [
        sum(job.value for job in sampler.jobs(shift_seeds(np.random.SeedSequence(seed))[0])) for seed in range(200)
    ]
    mean, error = np.mean(drawn), np.std(drawn) / np.sqrt(len(drawn))
    assert abs(fault_price(scenario).value_per_s * scenario.horizon_s - mean) < 4 * error


def test_a_scenario_without_a_weight_of_faults_takes_the_price() -> None:
    scenario = load("heat_wave")
    assert weights_of(scenario).faults == -fault_price(scenario).price
    assert weights_of(replace(scenario, reward=RewardSpec(faults=-3.0))).faults == -3.0
    hotter = replace(scenario, ambient=Ambient(points=((0.0, 36.0),)))
    assert weights_of(hotter).faults < weights_of(scenario).faults
