"""Identifiable parameters of an arm's thermal network: names, priors, and conversion to a network."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import networkx as nx
import numpy as np

from fleet.motor import Motors
from fleet.robot import JOINTS
from fleet.thermal import HOUSING, NODES, WINDING, ThermalModel, housing, modal_model, thermal_model, winding

Array = np.ndarray

LARGE = 4
"""Joints 1..4 of a Gen3 have the large actuator, 5..7 the small one."""

_FRICTION_SD = (0.25, 0.25)
"""Engineering value: running friction within one joint class; breakaway (2.5 to 5.3 N·m in the logs) varies more."""

PRIOR_SD: Mapping[str, tuple[float, float]] = {
    "copper_w_per_a2": (0.24, 0.39),
    "winding_j_per_k": (0.23, 0.23),
    "winding_housing_k_per_w": (0.26, 0.30),
    "housing_j_per_k": (0.15, 0.17),
    "housing_ambient_k_per_w": (0.19, 0.22),
    "idle_w": (0.20, 0.20),
    "neighbour_w_per_k": (0.85, 0.85),
    "coulomb_nm": _FRICTION_SD,
    "viscous_nms_per_rad": _FRICTION_SD,
}
"""Relative standard deviations of large and small joints, read as those of a log-normal.

Source: the fit of 65 public Gen3 logs behind `fleet/data/gen3_thermal.json`, spread of repeated fits with the prior on
the absolute scale; the names are those of that file.
"""

THERMAL = tuple(name for name in PRIOR_SD if name not in ("coulomb_nm", "viscous_nms_per_rad"))
"""Free parameters if an arm's friction is known. Fixed friction watts set the absolute scale of all heat, so an error
in them, or in the speed between slow samples, enters every parameter and no interval shows it."""

_CAPACITIES: Mapping[str, Callable[[int], str]] = {"winding_j_per_k": winding, "housing_j_per_k": housing}
_RESISTANCES: Mapping[str, Callable[[int], tuple[str, str]]] = {
    "winding_housing_k_per_w": lambda j: (winding(j), housing(j)),
    "housing_ambient_k_per_w": lambda j: (housing(j), "ambient"),
}
_NEIGHBOURS = [(housing(j - 1), housing(j)) for j in range(1, JOINTS)]


@dataclass(frozen=True, eq=False)
class HeatModel:
    """One arm's motors and thermal network."""

    motors: Motors
    network: nx.Graph

    def value(self, name: str) -> Array:
        """A parameter of `PRIOR_SD`, [joint]; [1] for the conductance between neighbours."""
        if hasattr(self.motors, name):
            return np.array(getattr(self.motors, name), dtype=float)
        network, joints = self.network, range(JOINTS)
        if name in _CAPACITIES:
            return np.array([network.nodes[_CAPACITIES[name](j)]["capacity_j_per_k"] for j in joints])
        if name in _RESISTANCES:
            return np.array([1.0 / network.edges[_RESISTANCES[name](j)]["conductance_w_per_k"] for j in joints])
        return np.array([np.mean([network.edges[edge]["conductance_w_per_k"] for edge in _NEIGHBOURS])])

    def with_values(self, values: Mapping[str, Array]) -> "HeatModel":
        """The same arm with some parameters of `PRIOR_SD` replaced, each [joint] or [1] as `value` gives them."""
        graph = self.network.copy()
        own = {}
        for name, value in values.items():
            if hasattr(self.motors, name):
                own[name] = np.array(value)
            elif name in _CAPACITIES:
                for j in range(JOINTS):
                    graph.nodes[_CAPACITIES[name](j)]["capacity_j_per_k"] = float(value[j])
            elif name in _RESISTANCES:
                for j in range(JOINTS):
                    graph.edges[_RESISTANCES[name](j)]["conductance_w_per_k"] = 1.0 / float(value[j])
            else:
                for edge in _NEIGHBOURS:
                    graph.edges[edge]["conductance_w_per_k"] = float(value[0])
        return HeatModel(replace(self.motors, **own), graph)

    def thermal(self) -> ThermalModel:
        """The network as matrices."""
        return thermal_model(self.network)


class ParameterVector:
    """Free parameters of one arm as a vector of logarithms, with their Gaussian prior around a nominal arm."""

    def __init__(self, nominal: HeatModel, free: Sequence[str] = tuple(PRIOR_SD)) -> None:
        """Raise ValueError for a name that is not in `PRIOR_SD` or given twice, and for a nominal value of zero."""
        if not free or set(free) - set(PRIOR_SD) or len(set(free)) != len(free):
            raise ValueError(f"Free parameters must be some of {', '.join(PRIOR_SD)}, each once (got {tuple(free)}).")
        self.nominal = nominal
        self.free = tuple(free)
        self._held = {name: nominal.value(name) for name in PRIOR_SD}
        centre = [nominal.value(name) for name in free]
        if none := [name for name, values in zip(free, centre, strict=True) if not np.all(values > 0)]:
            raise ValueError(f"Free parameters must have nominal values > 0 (got 0 for {', '.join(none)}).")
        self.mean = np.log(np.concatenate(centre))
        """Prior mean of the logarithms, [parameter]."""
        self.sd = np.concatenate([_sd(name, len(values)) for name, values in zip(free, centre, strict=True)])
        """Prior standard deviation of the logarithms, [parameter]."""
        self.names = tuple(
            (name, joint if len(values) > 1 else None)
            for name, values in zip(free, centre, strict=True)
            for joint in range(len(values))
        )
        """Name and joint (0..6, None for the one value of all neighbours) of each entry."""

    def __len__(self) -> int:
        return len(self.mean)

    def values(self, x: Array) -> dict[str, Array]:
        """Values by name, [..., joint], also of those that are not free, for logarithms [..., parameter]."""
        out = {name: np.broadcast_to(held, (*x.shape[:-1], len(held))) for name, held in self._held.items()}
        first = 0
        for name in self.free:
            width = len(self._held[name])
            out[name] = np.exp(x[..., first : first + width])
            first += width
        return out

    def heat_model(self, x: Array) -> HeatModel:
        """The arm with these logarithms, [parameter]."""
        values = self.values(x)
        return self.nominal.with_values({name: values[name] for name in self.free})

    def models(self, x: Array) -> ThermalModel:
        """Networks of several sets of logarithms [set, parameter] as one model, arrays [set, ...].

        The same matrices as by `heat_model`, without a graph for each: the Laplacian is linear in the conductances.
        """
        values = self.values(x)
        between = np.broadcast_to(values["neighbour_w_per_k"], (*x.shape[:-1], JOINTS - 1))
        to_air = 1.0 / values["housing_ambient_k_per_w"]
        conductance = np.concatenate([1.0 / values["winding_housing_k_per_w"], to_air, between], axis=-1)
        laplacian = np.einsum("...e,en,em->...nm", conductance, _INCIDENCE, _INCIDENCE)
        capacity = np.concatenate([values["winding_j_per_k"], values["housing_j_per_k"]], axis=-1)
        direct = np.array([self._direct(j) for j in range(JOINTS)])
        laplacian[..., range(JOINTS), range(JOINTS)] += direct
        to_ambient = np.concatenate([np.broadcast_to(direct, to_air.shape), to_air], axis=-1)
        return modal_model(capacity, laplacian, to_ambient)

    def _direct(self, joint: int) -> float:
        """Conductance from a winding to ambient, which no parameter changes; 0 unless the arm is immersed."""
        edge = (winding(joint), "ambient")
        network = self.nominal.network
        return float(network.edges[edge]["conductance_w_per_k"]) if network.has_edge(*edge) else 0.0


_ROWS = np.eye(NODES)
_INCIDENCE = np.concatenate([_ROWS[WINDING] - _ROWS[HOUSING], _ROWS[HOUSING], np.diff(_ROWS[HOUSING], axis=0)])
"""Ends of the edges winding–housing, housing–ambient and housing–housing, ±1, [edge, node]; ambient is no node."""


def _sd(name: str, width: int) -> Array:
    large, small = PRIOR_SD[name]
    return np.array([large] * LARGE + [small] * (JOINTS - LARGE))[:width]
