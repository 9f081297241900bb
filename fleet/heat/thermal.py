"""Thermal network of an arm: windings, housings and ambient as a graph, with an exact step for constant heat.

C_w Tw' = P_w − (Tw − Th)/R_wh;  C_h Th' = (Tw − Th)/R_wh − (Th − Ta)/R_ha + Σ_nb G (Th_nb − Th) + P_h.
Lumped capacitance with two nodes per joint (Kawaharazuka et al., arXiv 2407.08055); parameters in
`fleet/data/gen3_thermal.json`. Order of nodes: windings of joints 1..7, then housings of joints 1..7.

Housings have no sensor; `HousingObserver` estimates them from the measured motor temperatures. The inputs of their part
of the thermal network are the measured windings, the ambient temperature, and idle and friction heat: C_h Th' = −L_hh
Th + G_wh Tw + g Ta + P_h, stepped exactly for constant inputs. It is a reduced-order observer (Luenberger, IEEE Trans.
Automatic Control 16, 1971) without correction: an initial error decays with the housings' time constants.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import repeat
from typing import NamedTuple

import networkx as nx
import numpy as np

from fleet.errors import check_nonnegative
from fleet.heat.motor import Motors, copper_loss, magnet_factor, thermal_data
from fleet.motion import Drive
from fleet.robot import COOLING, JOINTS, Cooling

Array = np.ndarray

NODES = 2 * JOINTS
WINDING = slice(0, JOINTS)
HOUSING = slice(JOINTS, NODES)


@dataclass(frozen=True, kw_only=True)
class ThermalSpread:
    """Log-normal standard deviations, per joint, of the differences between arms of one model; 0: no difference."""

    copper: float = 0.0
    winding_housing: float = 0.0
    housing_ambient: float = 0.0
    capacity: float = 0.0
    idle: float = 0.0

    def __post_init__(self) -> None:
        check_nonnegative(self, *vars(self))

    @classmethod
    def gen3(cls, scale: float = 1.0) -> "ThermalSpread":
        """The spread measured between Gen3 joints of one size, times `scale`."""
        data = thermal_data()["spread"]
        return cls(**{name: scale * data[name] for name in cls.__dataclass_fields__})


def winding(joint: int) -> str:
    """Graph node of a joint's winding (joint 0..6)."""
    return f"winding_{joint + 1}"


def housing(joint: int) -> str:
    """Graph node of a joint's housing (joint 0..6)."""
    return f"housing_{joint + 1}"


def gen3_network(
    *,
    cooling: Cooling = "still_air",
    cooling_factor: float = 1.0,
    spread: ThermalSpread | None = None,
    rng: np.random.Generator | None = None,
) -> "nx.Graph[str]":
    """Thermal network of one Gen3: nodes with `capacity_j_per_k`, edges with `conductance_w_per_k`.

    Args:
        cooling: Its `CoolingStrategy` changes edges and capacities.
        cooling_factor: Scales every edge to ambient (dust, a blocked fan).
        spread: Random differences from the nominal arm, sampled with `rng`.
    """
    if cooling not in COOLING:
        raise ValueError(f"Unknown cooling '{cooling}'. Allowed: {', '.join(COOLING)}.")
    data, strategy = thermal_data(), COOLING[cooling]
    draw = _factors(spread, rng)
    graph: nx.Graph[str] = nx.Graph()
    graph.add_node("ambient")
    for j in range(JOINTS):
        shell = data["housing_j_per_k"][j] * draw["capacity"][1, j] * strategy.capacity_factor
        graph.add_node(winding(j), capacity_j_per_k=data["winding_j_per_k"][j] * draw["capacity"][0, j])
        graph.add_node(housing(j), capacity_j_per_k=shell)
        inner = 1.0 / (data["winding_housing_k_per_w"][j] * draw["winding_housing"][0, j])
        to_air = data["housing_ambient_k_per_w"][j] * draw["housing_ambient"][0, j]
        graph.add_edge(winding(j), housing(j), conductance_w_per_k=inner)
        scale = strategy.ambient_factor * cooling_factor
        graph.add_edge(housing(j), "ambient", conductance_w_per_k=scale / to_air)
        if strategy.winding_ratio:
            liquid = in_series(inner, COOLING["liquid"].ambient_factor / to_air)
            direct = strategy.winding_ratio * liquid - in_series(inner, strategy.ambient_factor / to_air)
            graph.add_edge(winding(j), "ambient", conductance_w_per_k=direct * cooling_factor)
        if j:
            between = data["neighbour_w_per_k"] + strategy.neighbour_w_per_k
            graph.add_edge(housing(j - 1), housing(j), conductance_w_per_k=between)
    return graph


def in_series(one: float, other: float) -> float:
    """Conductance of two conductances in series, W/K."""
    return one * other / (one + other)


def spread_motors(motors: Motors, spread: ThermalSpread, rng: np.random.Generator) -> Motors:
    """Motors with copper loss and idle heat of an individual arm."""
    shape = motors.copper_w_per_a2.shape
    return replace(
        motors,
        copper_w_per_a2=motors.copper_w_per_a2 * _exp(spread.copper * rng.standard_normal(shape)),
        idle_w=motors.idle_w * _exp(spread.idle * rng.standard_normal(shape)),
    )


def _factors(spread: ThermalSpread | None, rng: np.random.Generator | None) -> dict[str, Array]:
    names = ("winding_housing", "housing_ambient", "capacity")
    if spread is None:
        return {name: np.ones((2, JOINTS)) for name in names}
    if rng is None:
        raise ValueError("A thermal spread needs an rng (got None).")
    return {name: _exp(getattr(spread, name) * rng.standard_normal((2, JOINTS))) for name in names}


def _exp(values: Array) -> Array:
    """`np.exp`, but equal on every processor: NumPy's has other last digits with AVX-512.

    An arm's parameters are part of the keys of its cached models.
    """
    return np.array([math.exp(value) for value in values.flat]).reshape(values.shape)


@dataclass(frozen=True, eq=False)
class ThermalModel:
    """A thermal network as matrices for exact steps of any length; leading axes for several arms.

    C T' = −L T + g Ta + P. Scaled by C^(1/2) the system is symmetric, so its modes are real and every step is stable.
    """

    capacity: Array
    """Heat capacity C, J/K, [..., node]."""
    laplacian: Array
    """L with the conductance to ambient on the diagonal, W/K, [..., node, node]."""
    to_ambient: Array
    """Conductance to ambient g, W/K, [..., node]."""
    rates: Array
    """Inverse time constants, 1/s, [..., mode]."""
    modes: Array
    """Orthonormal modes of C^(−1/2) L C^(−1/2), [..., node, mode]."""

    def step_matrices(self, dt_s: Array | float) -> tuple[Array, Array]:
        """Φ(dt) [..., node, node] and Γ(dt) [..., node, node] of T⁺ = Φ T + Γ (P + g Ta), Γ in K/W.

        Args:
            dt_s: Length of the step, or one per leading index, s, >= 0.
        """
        dt = np.asarray(dt_s, dtype=float)[..., None]
        root = np.sqrt(self.capacity)
        decay = np.exp(-self.rates * dt)
        # ∫ exp(−λ s) ds, exact also for tiny λ·dt.
        gain = -np.expm1(-self.rates * dt) / self.rates
        left = self.modes / root[..., :, None]
        right = np.swapaxes(self.modes, -1, -2)
        phi = (left * decay[..., None, :]) @ (right * root[..., None, :])
        gamma = (left * gain[..., None, :]) @ (right / root[..., None, :])
        return phi, gamma

    def steady(self, heat_w: Array, ambient_c: Array | float) -> Array:
        """Steady temperatures, °C, [..., node], for constant heat, W, [..., node]."""
        load = heat_w + self.to_ambient * np.asarray(ambient_c, dtype=float)[..., None]
        return np.linalg.solve(self.laplacian, load[..., None])[..., 0]

    def step(self, temp_c: Array, heat_w: Array, ambient_c: Array | float, dt_s: Array | float) -> Array:
        """Temperatures after constant heat for `dt_s`, °C, [..., node]; exact for any step length."""
        phi, gamma = self.step_matrices(dt_s)
        return advance(temp_c, heat_w, ambient_c, phi, gamma, self.to_ambient)


def advance(
    temp_c: Array, heat_w: Array, ambient_c: Array | float, phi: Array, gamma: Array, to_ambient: Array
) -> Array:
    """Temperatures after a step with the matrices of `step_matrices`: Φ T + Γ (P + g Ta), °C, [..., node]."""
    load = heat_w + to_ambient * np.asarray(ambient_c, dtype=float)[..., None]
    return (phi @ temp_c[..., None] + gamma @ load[..., None])[..., 0]


def thermal_model(network: "nx.Graph[str]") -> ThermalModel:
    """Matrices of a network with the nodes of `gen3_network`.

    Raises:
        ValueError: a node, capacity or conductance is missing or out of range, there is another node, or a node has
            no path to ambient.
    """
    names = [winding(j) for j in range(JOINTS)] + [housing(j) for j in range(JOINTS)]
    _check(network, names)
    capacity = np.array([network.nodes[name]["capacity_j_per_k"] for name in names], dtype=float)
    conductance = nx.to_numpy_array(network, nodelist=[*names, "ambient"], weight="conductance_w_per_k")
    laplacian = np.diag(conductance[:NODES].sum(axis=1)) - conductance[:NODES, :NODES]
    return modal_model(capacity, laplacian, conductance[:NODES, NODES])


def modal_model(capacity: Array, laplacian: Array, to_ambient: Array) -> ThermalModel:
    """The model of a network given by its matrices, see `ThermalModel`."""
    root = np.sqrt(capacity)
    rates, modes = np.linalg.eigh(laplacian / (root[..., :, None] * root[..., None, :]))
    return ThermalModel(capacity, laplacian, to_ambient, rates, modes)


def _check(network: "nx.Graph[str]", names: list[str]) -> None:
    expected = {*names, "ambient"}
    if missing := sorted(expected - set(network)):
        raise ValueError(f"The thermal network lacks the nodes {', '.join(missing)}.")
    if unknown := sorted(set(network) - expected):
        raise ValueError(
            f"The thermal network has unknown nodes: {', '.join(unknown)}. Allowed: {', '.join(sorted(expected))}."
        )
    for name in names:
        capacity = network.nodes[name].get("capacity_j_per_k")
        if capacity is None or not 0 < capacity < np.inf:
            raise ValueError(f"Node '{name}' needs a capacity_j_per_k > 0 (got {capacity}).")
    for one, other, conductance in network.edges(data="conductance_w_per_k"):
        if conductance is None or not 0 <= conductance < np.inf:
            raise ValueError(f"Edge '{one}' - '{other}' needs a conductance_w_per_k >= 0 (got {conductance}).")
    # By reachability, since the smallest rate of a cut-off node is not zero but rounding noise of either sign.
    open_edges = [(a, b) for a, b, conductance in network.edges(data="conductance_w_per_k") if conductance > 0]
    cooled = nx.node_connected_component(nx.Graph([("ambient", "ambient"), *open_edges]), "ambient")
    if trapped := [name for name in names if name not in cooled]:
        raise ValueError(f"Nodes without a path to ambient: {', '.join(trapped)}.")


def stack_models(models: list[ThermalModel]) -> ThermalModel:
    """Models of several arms as one value, arrays [arm, ...]."""
    return ThermalModel(*(np.stack([getattr(model, f.name) for model in models]) for f in fields(ThermalModel)))


def node_heat(winding_w: Array, housing_w: Array) -> Array:
    """Heat per node, W, [..., node], from heat into windings and housings, each [..., joint] or broadcast to it."""
    return np.concatenate(np.broadcast_arrays(winding_w, housing_w), axis=-1)


def drive_heat(temp_c: Array, current_sq: Array, friction_w: Array, motors: Motors) -> Array:
    """Heat per node of a powered arm, W, [..., node].

    Args:
        temp_c: °C, [..., node].
        current_sq: Mean squared current at the magnets' reference temperature, A², [..., joint].
        friction_w: Mean friction heat, W, [..., joint].
    """
    warm_sq = current_sq / magnet_factor(temp_c[..., HOUSING], motors) ** 2
    return node_heat(copper_loss(warm_sq, temp_c[..., WINDING], motors), motors.idle_w + friction_w)


STEP_S = 10.0
"""Longest simulated step; each step computes the heat anew, since it depends on temperature."""


@dataclass(frozen=True, eq=False)
class SimulatedTemperatures:
    """Result of `simulate_temperatures`."""

    end_c: Array
    """Temperatures at the end, °C, [case, node]."""
    highest_c: Array
    """Highest temperature of each winding, start and end included, °C, [case, joint]."""


def simulate_temperatures(
    load: Drive,
    duration_s: Array | Sequence[float],
    *,
    motors: Motors,
    thermal: ThermalModel,
    start_c: Array,
    ambient_c: Array | float,
) -> SimulatedTemperatures:
    """Simulate one powered arm under constant loads, in equal steps of at most `STEP_S`.

    Args:
        load: Mean drives, [case, joint] or [joint] for all cases.
        duration_s: Duration of each load, >= 0, [case].
        start_c: Temperatures at the start, [case, node] or [node].
        ambient_c: [case] or one for all.
    """
    duration = np.asarray(duration_s, dtype=float)
    steps = np.ceil(duration / STEP_S)
    rows = temperature_steps(
        repeat(load, int(steps.max(initial=0.0))),
        duration / np.maximum(steps, 1),
        motors=motors,
        thermal=thermal,
        start_c=np.broadcast_to(np.asarray(start_c, dtype=float), (len(duration), NODES)),
        ambient_c=np.broadcast_to(ambient_c, duration.shape),
        steps=steps,
    )
    end_c = next(rows)
    highest_c = end_c[:, WINDING]
    for end_c in rows:
        highest_c = np.maximum(highest_c, end_c[:, WINDING])
    return SimulatedTemperatures(end_c, highest_c)


def temperature_steps(
    loads: Iterable[Drive],
    dt_s: Array | float,
    *,
    motors: Motors,
    thermal: ThermalModel,
    start_c: Array,
    ambient_c: Array | float,
    steps: Array | None = None,
) -> Iterator[Array]:
    """Yield the temperatures of one powered arm at the start and after each load, °C, [..., node].

    Args:
        loads: Mean drive of each step, [..., joint]; `itertools.repeat` for a constant one.
        dt_s: Length of every step, or one per case.
        start_c: [..., node].
        ambient_c: One, or one per case.
        steps: Number of steps of each case, [case], after which its temperatures stay constant; default: all.
    """
    phi, gamma = thermal.step_matrices(dt_s)
    temp_c = start_c
    yield temp_c
    for step, load in enumerate(loads):
        heat_w = drive_heat(temp_c, load.current_sq, load.friction_w, motors)
        next_c = advance(temp_c, heat_w, ambient_c, phi, gamma, thermal.to_ambient)
        temp_c = next_c if steps is None else np.where((step < steps)[:, None], next_c, temp_c)
        yield temp_c


NEWTON_STEPS = 100


def steady_state(
    model: ThermalModel, current_sq: Array, friction_w: Array, motors: Motors, ambient_c: float
) -> Array | None:
    """Steady temperatures of one arm under a constant drive, °C, [node]; None for thermal runaway.

    Copper loss grows with winding temperature and current with magnet temperature, so beyond some load there is no
    equilibrium. Newton's method starts from the cold arm, below every equilibrium. Heat is convex in each temperature.
    So the iteration rises to the lowest equilibrium while the inverse Jacobian has no negative entry (Ortega &
    Rheinboldt, Iterative Solution of Nonlinear Equations, theorem 13.3.4); a negative entry means that there is none.

    Args:
        current_sq: Mean squared current at the magnets' reference temperature, A², [joint].
        friction_w: Mean friction heat, W, [joint].
    """
    temp_c = np.full(NODES, float(ambient_c))
    for _ in range(NEWTON_STEPS):
        excess = drive_heat(temp_c, current_sq, friction_w, motors)
        excess += model.to_ambient * ambient_c - model.laplacian @ temp_c
        inverse = _inverse_or_none(model.laplacian - _heat_slope(temp_c, current_sq, motors))
        if inverse is None:
            return None
        step = inverse @ excess
        temp_c = temp_c + step
        if np.any(magnet_factor(temp_c[HOUSING], motors) <= 0):
            return None
        if np.max(np.abs(step)) < 1e-9:
            return temp_c
    return None


def _heat_slope(temp_c: Array, current_sq: Array, motors: Motors) -> Array:
    """Derivative of `drive_heat` with respect to the temperatures, W/K, [node, node]."""
    factor = magnet_factor(temp_c[HOUSING], motors)
    warm_sq = current_sq / factor**2
    slope = np.zeros((NODES, NODES))
    rows = np.arange(JOINTS)
    slope[rows, rows] = motors.copper_w_per_a2 * motors.alpha_cu_per_k * warm_sq
    loss_w = copper_loss(warm_sq, temp_c[WINDING], motors)
    slope[rows, rows + JOINTS] = -2.0 * motors.alpha_kt_per_k / factor * loss_w
    return slope


def _inverse_or_none(jacobian: Array) -> Array | None:
    """Inverse of a matrix with off-diagonal entries <= 0; None unless the inverse is non-negative (an M-matrix)."""
    try:
        inverse = np.linalg.inv(jacobian)
    except np.linalg.LinAlgError:  # singular, at the largest load with an equilibrium
        return None
    return inverse if inverse.min() >= -1e-9 * np.abs(inverse).max() else None


class HousingObserver(NamedTuple):
    """Matrices of one step of the observer; leading axes for several arms."""

    keep: Array
    """Transition matrix of the housing temperatures, [..., joint, joint]."""
    gain: Array
    """Temperature change per constant heat, K/W, [..., joint, joint]."""
    from_winding: Array
    """Conductance between winding and housing, W/K, [..., joint]."""
    from_ambient: Array
    """Conductance between ambient and housing, W/K, [..., joint]."""
    idle_w: Array
    """Heat of the powered motor without load, W, [..., joint]."""

    def step(self, housing_c: Array, motor_c: Array, ambient_c: Array | float, friction_w: Array | float) -> Array:
        """Estimated housing temperatures of a powered arm after the step, °C, [..., joint].

        Args:
            housing_c: Estimate before, [..., joint].
            motor_c: Mean measured motor temperatures in the step, [..., joint].
            ambient_c: [...].
            friction_w: Mean friction heat in the step, [..., joint].
        """
        load = self.from_winding * motor_c + self.from_ambient * np.asarray(ambient_c, dtype=float)[..., None]
        load = load + self.idle_w + friction_w
        return (self.keep @ housing_c[..., None] + self.gain @ load[..., None])[..., 0]


def housing_observer(thermal: ThermalModel, motors: Motors, dt_s: Array | float) -> HousingObserver:
    """The observer of an arm with this thermal model and these motors.

    Args:
        dt_s: Length of the step; [...] for one observer per element.
    """
    to_ambient = thermal.to_ambient[HOUSING]
    housings = modal_model(thermal.capacity[HOUSING], thermal.laplacian[HOUSING, HOUSING], to_ambient)
    keep, gain = housings.step_matrices(dt_s)
    from_winding = -np.diagonal(thermal.laplacian[WINDING, HOUSING])
    return HousingObserver(keep, gain, from_winding.copy(), to_ambient, motors.idle_w)
