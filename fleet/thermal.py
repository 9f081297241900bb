"""The thermal network: windings, housings and ambient as a graph, and its exact step for constant heat.

C_w Tw' = P_w − (Tw − Th)/R_wh;  C_h Th' = (Tw − Th)/R_wh − (Th − Ta)/R_ha + Σ_nb G (Th_nb − Th) + P_h.
Lumped capacitance with two nodes per joint (Kawaharazuka et al., arXiv 2407.08055); numbers in
`fleet/data/gen3_thermal.json`. State order: windings of joints 1..7, then housings of joints 1..7.
"""

from dataclasses import dataclass, replace

import networkx as nx
import numpy as np

from fleet.motor import Motors, copper_loss, magnet_factor, thermal_data
from fleet.robot import JOINTS, Cooling

Array = np.ndarray

NODES = 2 * JOINTS
WINDING = slice(0, JOINTS)
HOUSING = slice(JOINTS, NODES)

AMBIENT_FACTOR: dict[Cooling, float] = {
    "still_air": 1.0,
    "forced_air": 2.5,
    "liquid": 6.0,
    "immersion": 10.0,
    "vacuum": 0.5,
}
"""Conductance housing → surroundings over that in still air, by cooling strategy.

Still air at a link's surface carries about 5 W/m²K by convection and 5.5 by radiation (4·ε·σ·T³, ε ≈ 0.9,
T ≈ 305 K), so vacuum keeps about half. The others are the lower ends of the film coefficients in Incropera &
DeWitt, table 1.1, limited by the conduction through the shell. Engineering values, not measured on a Gen3.
"""


@dataclass(frozen=True, kw_only=True)
class ThermalSpread:
    """Log-normal standard deviations by which arms of one make differ, per joint; zero turns one off."""

    copper: float = 0.0
    winding_housing: float = 0.0
    housing_ambient: float = 0.0
    capacity: float = 0.0
    idle: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value >= 0:
                raise ValueError(f"ThermalSpread.{name} must be >= 0 (got {value}).")

    @classmethod
    def gen3(cls, scale: float = 1.0) -> "ThermalSpread":
        """The spread seen between Gen3 joints of one class, times `scale`."""
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
) -> nx.Graph:
    """Thermal network of one Gen3: nodes with `capacity_j_per_k`, edges with `conductance_w_per_k`.

    Args:
        cooling: Scales every edge to ambient by `AMBIENT_FACTOR`.
        cooling_factor: A further scale on the same edges (dust, a blocked fan).
        spread: How far this arm may differ from the nominal one; drawn from `rng`.
    """
    if cooling not in AMBIENT_FACTOR:
        raise ValueError(f"Unknown cooling '{cooling}'. Allowed: {', '.join(AMBIENT_FACTOR)}.")
    data = thermal_data()
    draw = _factors(spread, rng)
    graph = nx.Graph()
    graph.add_node("ambient")
    for j in range(JOINTS):
        graph.add_node(winding(j), capacity_j_per_k=data["winding_j_per_k"][j] * draw["capacity"][0, j])
        graph.add_node(housing(j), capacity_j_per_k=data["housing_j_per_k"][j] * draw["capacity"][1, j])
        resistance = data["winding_housing_k_per_w"][j] * draw["winding_housing"][0, j]
        graph.add_edge(winding(j), housing(j), conductance_w_per_k=1.0 / resistance)
        to_air = data["housing_ambient_k_per_w"][j] * draw["housing_ambient"][0, j]
        scale = AMBIENT_FACTOR[cooling] * cooling_factor
        graph.add_edge(housing(j), "ambient", conductance_w_per_k=scale / to_air)
        if j:
            graph.add_edge(housing(j - 1), housing(j), conductance_w_per_k=data["neighbour_w_per_k"])
    return graph


def spread_motors(motors: Motors, spread: ThermalSpread, rng: np.random.Generator) -> Motors:
    """The same motors with copper loss and idle heat of one arm's own."""
    shape = motors.copper_w_per_a2.shape
    return replace(
        motors,
        copper_w_per_a2=motors.copper_w_per_a2 * np.exp(spread.copper * rng.standard_normal(shape)),
        idle_w=motors.idle_w * np.exp(spread.idle * rng.standard_normal(shape)),
    )


def _factors(spread: ThermalSpread | None, rng: np.random.Generator | None) -> dict[str, Array]:
    names = ("winding_housing", "housing_ambient", "capacity")
    if spread is None:
        return {name: np.ones((2, JOINTS)) for name in names}
    if rng is None:
        raise ValueError("A thermal spread needs an rng to draw from.")
    return {name: np.exp(getattr(spread, name) * rng.standard_normal((2, JOINTS))) for name in names}


@dataclass(frozen=True, eq=False)
class ThermalModel:
    """A thermal network as matrices, ready for exact steps of any length; leading axes for several arms.

    C T' = −L T + g Ta + P is symmetric under C^(1/2), so its modes are real and the step never grows.
    """

    capacity: Array
    """J/K, [..., node]."""
    laplacian: Array
    """L with the conductance to ambient on the diagonal, W/K, [..., node, node]."""
    to_ambient: Array
    """g, W/K, [..., node]."""
    rates: Array
    """Inverse time constants, 1/s, [..., mode]."""
    modes: Array
    """Orthonormal modes of C^(−1/2) L C^(−1/2), [..., node, mode]."""

    def step_matrices(self, dt_s: Array | float) -> tuple[Array, Array]:
        """Φ(dt) [..., node, node] and Γ(dt) [..., node, node] of T⁺ = Φ T + Γ (P + g Ta), Γ in K/W.

        Args:
            dt_s: A length, or one per leading index, s, >= 0.
        """
        dt = np.asarray(dt_s, dtype=float)[..., None]
        root = np.sqrt(self.capacity)
        decay = np.exp(-self.rates * dt)
        # ∫ exp(−λ s) ds, exact also where λ·dt is tiny.
        gain = -np.expm1(-self.rates * dt) / self.rates
        left = self.modes / root[..., :, None]
        right = np.swapaxes(self.modes, -1, -2)
        phi = (left * decay[..., None, :]) @ (right * root[..., None, :])
        gamma = (left * gain[..., None, :]) @ (right / root[..., None, :])
        return phi, gamma

    def steady(self, heat_w: Array, ambient_c: Array | float) -> Array:
        """Temperatures at which nothing changes any more, °C, [..., node], for constant heat W, [..., node]."""
        load = heat_w + self.to_ambient * np.asarray(ambient_c, dtype=float)[..., None]
        return np.linalg.solve(self.laplacian, load[..., None])[..., 0]

    def step(self, temp_c: Array, heat_w: Array, ambient_c: Array | float, dt_s: Array | float) -> Array:
        """Temperatures after constant heat for `dt_s`, °C, [..., node]. Exact, so independent of step size."""
        phi, gamma = self.step_matrices(dt_s)
        return advance(temp_c, heat_w, ambient_c, phi, gamma, self.to_ambient)


def advance(
    temp_c: Array, heat_w: Array, ambient_c: Array | float, phi: Array, gamma: Array, to_ambient: Array
) -> Array:
    """One step with matrices at hand: Φ T + Γ (P + g Ta), °C, [..., node]."""
    load = heat_w + to_ambient * np.asarray(ambient_c, dtype=float)[..., None]
    return (phi @ temp_c[..., None] + gamma @ load[..., None])[..., 0]


def thermal_model(network: nx.Graph) -> ThermalModel:
    """Matrices of a network made by `gen3_network` (or of the same nodes with other numbers).

    Raises:
        ValueError: a node, capacity or conductance is missing or out of range, a node is not a Gen3's, or a node
            has no path to ambient.
    """
    names = [winding(j) for j in range(JOINTS)] + [housing(j) for j in range(JOINTS)]
    _check(network, names)
    capacity = np.array([network.nodes[name]["capacity_j_per_k"] for name in names], dtype=float)
    conductance = nx.to_numpy_array(network, nodelist=[*names, "ambient"], weight="conductance_w_per_k")
    laplacian = np.diag(conductance[:NODES].sum(axis=1)) - conductance[:NODES, :NODES]
    root = np.sqrt(capacity)
    rates, modes = np.linalg.eigh(laplacian / np.outer(root, root))
    return ThermalModel(capacity, laplacian, conductance[:NODES, NODES], rates, modes)


def _check(network: nx.Graph, names: list[str]) -> None:
    expected = {*names, "ambient"}
    if missing := sorted(expected - set(network)):
        raise ValueError(f"The thermal network lacks the nodes {', '.join(missing)}.")
    if unknown := sorted(set(network) - expected):
        raise ValueError(f"The thermal network has nodes that no Gen3 has: {', '.join(unknown)}.")
    for name in names:
        capacity = network.nodes[name].get("capacity_j_per_k")
        if capacity is None or not 0 < capacity < np.inf:
            raise ValueError(f"Node '{name}' needs a capacity_j_per_k > 0 (got {capacity}).")
    for one, other, conductance in network.edges(data="conductance_w_per_k"):
        if conductance is None or not 0 <= conductance < np.inf:
            raise ValueError(f"Edge '{one}' - '{other}' needs a conductance_w_per_k >= 0 (got {conductance}).")
    # By reachability: the smallest rate of a cut-off node is rounding noise of either sign, not zero.
    open_edges = [(a, b) for a, b, conductance in network.edges(data="conductance_w_per_k") if conductance > 0]
    cooled = nx.node_connected_component(nx.Graph([("ambient", "ambient"), *open_edges]), "ambient")
    if trapped := [name for name in names if name not in cooled]:
        raise ValueError(f"No path to ambient, heat could not leave: {', '.join(trapped)}.")


def stack_models(models: list[ThermalModel]) -> ThermalModel:
    """Models of several arms as one, arrays [arm, ...]."""
    return ThermalModel(
        *(np.stack([getattr(m, f) for m in models]) for f in ("capacity", "laplacian", "to_ambient", "rates", "modes"))
    )


def node_heat(winding_w: Array, housing_w: Array) -> Array:
    """Heat per node, W, [..., node], from heat into windings and into housings, each [..., joint] or broadcast."""
    return np.concatenate(np.broadcast_arrays(winding_w, housing_w), axis=-1)


def drive_heat(temp_c: Array, current_sq: Array, friction_w: Array, motors: Motors) -> Array:
    """Heat per node of a powered arm at its temperatures, W, [..., node].

    Args:
        temp_c: °C, [..., node].
        current_sq: Mean squared current at the magnets' reference temperature, A², [..., joint].
        friction_w: Mean friction heat, W, [..., joint].
    """
    warm_sq = current_sq / magnet_factor(temp_c[..., HOUSING], motors) ** 2
    return node_heat(copper_loss(warm_sq, temp_c[..., WINDING], motors), motors.idle_w + friction_w)


NEWTON_STEPS = 100


def settled(
    model: ThermalModel, current_sq: Array, friction_w: Array, motors: Motors, ambient_c: float
) -> Array | None:
    """Temperatures at which one arm settles under a constant drive, °C, [node]; None when it never does.

    Copper loss grows with the winding's temperature and the current with the magnets', so beyond some load no
    temperature balances the heat. The cold arm is below every balance, heat grows with every temperature and ever
    faster, so Newton's steps climb to the lowest balance as long as the inverse Jacobian has no negative entry
    (Ortega & Rheinboldt, Iterative Solution of Nonlinear Equations, theorem 13.3.4); where it has one, there is none.

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
    """Derivative of `drive_heat` by the temperatures, W/K, [node, node]."""
    factor = magnet_factor(temp_c[HOUSING], motors)
    warm_sq = current_sq / factor**2
    slope = np.zeros((NODES, NODES))
    rows = np.arange(JOINTS)
    slope[rows, rows] = motors.copper_w_per_a2 * motors.alpha_cu_per_k * warm_sq
    loss_w = copper_loss(warm_sq, temp_c[WINDING], motors)
    slope[rows, rows + JOINTS] = -2.0 * motors.alpha_kt_per_k / factor * loss_w
    return slope


def _inverse_or_none(jacobian: Array) -> Array | None:
    """Inverse of a matrix with off-diagonal entries <= 0, None unless it is non-negative (an M-matrix)."""
    try:
        inverse = np.linalg.inv(jacobian)
    except np.linalg.LinAlgError:  # Singular: exactly at the fold.
        return None
    return inverse if inverse.min() >= -1e-9 * np.abs(inverse).max() else None
