"""What a thermal network is made of: cooling, arms that differ, several arms, and networks that cannot be."""

from itertools import pairwise

import numpy as np
import pytest

from fleet.heat.motor import Motors, gen3_motors
from fleet.heat.thermal import (
    HOUSING,
    NODES,
    WINDING,
    ThermalModel,
    ThermalSpread,
    gen3_network,
    housing,
    node_heat,
    spread_motors,
    stack_models,
    thermal_model,
    winding,
)
from fleet.robot import COOLING, JOINTS, Cooling

MODEL = thermal_model(gen3_network())
MOTORS = gen3_motors()
REST = np.zeros(JOINTS)


def test_better_cooling_is_cooler():
    order: list[Cooling] = ["vacuum", "still_air", "heat_sink", "forced_air", "liquid", "immersion"]
    assert set(order) | {"heat_spreader"} == set(COOLING)
    heat_w = node_heat(np.full(JOINTS, 8.0), MOTORS.idle_w)
    ends = [thermal_model(gen3_network(cooling=name)).steady(heat_w, 25.0) for name in order]
    assert all(np.all(worse > better) for worse, better in pairwise(ends))


def test_immersion_conducts_3_7_times_what_liquid_does():
    """Zhu et al., measured from the winding. Without neighbours a joint is two conductances, so rise = heat / G."""
    spread = ThermalSpread.gen3()
    rises = []
    for name in ("liquid", "immersion"):
        network = gen3_network(cooling=name, spread=spread, rng=np.random.default_rng(3))
        for j in range(1, JOINTS):
            network.edges[housing(j - 1), housing(j)]["conductance_w_per_k"] = 0.0
        rises.append(thermal_model(network).steady(node_heat(np.full(JOINTS, 5.0), REST), 0.0)[WINDING])
    np.testing.assert_allclose(rises[0] / rises[1], 3.7)
    nominal = thermal_model(gen3_network(cooling="liquid")).laplacian
    assert nominal[0, 0] == pytest.approx(1 / 2.5)  # with liquid at the shell the winding touches the housing only


def test_a_heat_spreader_moves_heat_and_a_heat_sink_delays_it():
    only_second = node_heat(np.eye(JOINTS)[1] * 10.0, REST)
    plain, spread = (thermal_model(gen3_network(cooling=name)) for name in ("still_air", "heat_spreader"))
    before, after = plain.steady(only_second, 0.0), spread.steady(only_second, 0.0)
    assert after[WINDING][1] < before[WINDING][1]
    assert np.all(np.delete(after[WINDING], 1) > np.delete(before[WINDING], 1))
    for model, end in ((plain, before), (spread, after)):
        assert model.to_ambient @ end == pytest.approx(10.0)  # all heat leaves through the shells
    sink = thermal_model(gen3_network(cooling="heat_sink"))
    np.testing.assert_allclose(sink.capacity[HOUSING] / plain.capacity[HOUSING], 1.35)


def test_dust_is_hotter_and_no_cooling_at_all_is_refused():
    heat_w = node_heat(REST, MOTORS.idle_w)
    assert np.all(thermal_model(gen3_network(cooling_factor=0.7)).steady(heat_w, 25.0) > MODEL.steady(heat_w, 25.0))
    with pytest.raises(ValueError, match="without a path to ambient"):
        thermal_model(gen3_network(cooling_factor=0.0))
    with pytest.raises(ValueError, match="Unknown cooling 'wind'"):
        gen3_network(cooling="wind")  # pyright: ignore[reportArgumentType]


def spread_arm(seed: int) -> tuple[ThermalModel, Motors]:
    """One arm that differs from the nominal one."""
    rng = np.random.default_rng(seed)
    network = gen3_network(spread=ThermalSpread.gen3(), rng=rng)
    return thermal_model(network), spread_motors(MOTORS, ThermalSpread.gen3(), rng)


def test_the_same_seed_makes_the_same_arm():
    (one, one_motors), (same, same_motors), (other, other_motors) = (spread_arm(seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.laplacian, same.laplacian)
    np.testing.assert_array_equal(one.capacity, same.capacity)
    np.testing.assert_array_equal(one_motors.copper_w_per_a2, same_motors.copper_w_per_a2)
    assert not np.allclose(one.laplacian, other.laplacian)
    assert not np.allclose(one_motors.idle_w, other_motors.idle_w)


def test_spread_has_the_width_it_says():
    width = ThermalSpread(housing_ambient=0.2, capacity=0.1, winding_housing=0.15)
    rng = np.random.default_rng(3)
    models = [thermal_model(gen3_network(spread=width, rng=rng)) for _ in range(300)]
    to_air = np.log([m.to_ambient[HOUSING] / MODEL.to_ambient[HOUSING] for m in models])
    capacity = np.log([m.capacity / MODEL.capacity for m in models])
    assert to_air.std() == pytest.approx(0.2, rel=0.1)
    assert capacity.std() == pytest.approx(0.1, rel=0.1)
    assert to_air.mean() == pytest.approx(0.0, abs=0.02)


def test_no_spread_is_the_nominal_arm_and_spread_needs_a_seed():
    none = gen3_network(spread=ThermalSpread(), rng=np.random.default_rng(0))
    np.testing.assert_allclose(thermal_model(none).laplacian, MODEL.laplacian)
    with pytest.raises(ValueError, match="rng"):
        gen3_network(spread=ThermalSpread.gen3())
    with pytest.raises(ValueError, match=r"ThermalSpread\.copper"):
        ThermalSpread(copper=-0.1)


def test_several_arms_step_as_each_alone():
    models = [spread_arm(seed)[0] for seed in range(3)]
    start_c = np.linspace(20.0, 70.0, 3 * NODES).reshape(3, NODES)
    heat_w = np.linspace(0.0, 20.0, 3 * NODES).reshape(3, NODES)
    ambient_c, dt_s = np.array([20.0, 25.0, 30.0]), np.array([1.0, 60.0, 3600.0])
    stacked = stack_models(models)
    together = stacked.step(start_c, heat_w, ambient_c, dt_s)
    steady = stacked.steady(heat_w, ambient_c)
    for k, model in enumerate(models):
        alone = model.step(start_c[k], heat_w[k], ambient_c[k], dt_s[k])
        np.testing.assert_allclose(together[k], alone, rtol=1e-12)
        np.testing.assert_allclose(steady[k], model.steady(heat_w[k], ambient_c[k]), rtol=1e-12)


# Networks that cannot be


def test_a_node_without_a_path_to_ambient_is_refused():
    graph = gen3_network()
    graph.remove_edge(housing(2), "ambient")
    thermal_model(graph)  # Its neighbours still carry its heat away.
    graph.remove_edge(housing(1), housing(2))
    graph.remove_edge(housing(2), housing(3))
    with pytest.raises(ValueError, match="Nodes without a path to ambient: winding_3, housing_3"):
        thermal_model(graph)


def test_missing_or_foreign_parts_are_named():
    graph = gen3_network()
    graph.add_node("gripper", capacity_j_per_k=100.0)
    with pytest.raises(ValueError, match="gripper"):
        thermal_model(graph)
    graph = gen3_network()
    graph.remove_node(winding(4))
    with pytest.raises(ValueError, match="lacks the nodes winding_5"):
        thermal_model(graph)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf"), None])
def test_impossible_capacities_are_named(value):
    graph = gen3_network()
    graph.nodes[housing(0)]["capacity_j_per_k"] = value
    with pytest.raises(ValueError, match="'housing_1' needs a capacity_j_per_k"):
        thermal_model(graph)


@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf"), None])
def test_impossible_conductances_are_named(value):
    graph = gen3_network()
    graph.edges[winding(0), housing(0)]["conductance_w_per_k"] = value
    with pytest.raises(ValueError, match="needs a conductance_w_per_k"):
        thermal_model(graph)
