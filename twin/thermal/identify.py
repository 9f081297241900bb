"""Identification of an arm's thermal network from its logs, with 95 % intervals.

Nonlinear least squares through the exact step, with log-normal priors around a nominal arm. The ambient temperature is
given: motor temperatures alone do not distinguish it from idle heat. An error of two kelvin changes idle heat and
cooling by some 6 %; predictions in the same room hardly change.

With the copper's resistance taken at the measured winding temperature the network is linear in its temperatures. So
those at the start of a log, and the offset of the ambient temperature, follow by linear least squares for any
parameters (variable projection: Golub & Pereyra 1973; Jacobian in Kaufman's form, whose gradient is exact).
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import msgspec
import networkx as nx
import numpy as np

from fleet.errors import ArgumentError, FleetError, IdentificationError, distinguish
from fleet.fields import check_instance, check_value
from fleet.heat.motor import Motors, copper_loss, gen3_motors, magnet_factor, thermal_data
from fleet.heat.thermal import (
    HOUSING,
    NODES,
    WINDING,
    ThermalModel,
    gen3_network,
    housing,
    modal_model,
    node_heat,
    thermal_model,
    winding,
)
from fleet.robot import JOINTS, Cooling
from twin.logs.recording import (
    READINGS,
    STEP_S,
    CurrentSource,
    HeatLog,
    Recording,
    check_log,
    heat_logs,
    source_of,
)

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
        graph, of_motors = self.network.copy(), dict[str, Array]()
        for *_, data in (*graph.nodes(data=True), *graph.edges(data=True)):
            data.update({name: float(value) for name, value in data.items()})  # as JSON
        for name, value in values.items():
            if hasattr(self.motors, name):
                of_motors[name] = np.array(value)
            elif name in _CAPACITIES:
                for j in range(JOINTS):
                    graph.nodes[_CAPACITIES[name](j)]["capacity_j_per_k"] = float(value[j])
            elif name in _RESISTANCES:
                for j in range(JOINTS):
                    graph.edges[_RESISTANCES[name](j)]["conductance_w_per_k"] = 1.0 / float(value[j])
            else:
                for edge in _NEIGHBOURS:
                    graph.edges[edge]["conductance_w_per_k"] = float(value[0])
        return HeatModel(replace(self.motors, **of_motors), graph)

    def thermal(self) -> ThermalModel:
        """The network as matrices."""
        return thermal_model(self.network)


class ParameterVector:
    """Free parameters of one arm as a vector of logarithms, with their Gaussian prior around a nominal arm."""

    def __init__(self, nominal: HeatModel, free: Sequence[str] = tuple(PRIOR_SD)) -> None:
        if not isinstance(free, Sequence) or not free or set(free) - set(PRIOR_SD) or len(set(free)) != len(free):
            raise ArgumentError(f"Free parameters must be some of {', '.join(PRIOR_SD)}, each once (got {free!r}).")
        self.nominal = nominal
        self.free = tuple(free)
        self._held = {name: nominal.value(name) for name in PRIOR_SD}
        centre = [nominal.value(name) for name in free]
        if none := [name for name, values in zip(free, centre, strict=True) if not np.all(values > 0)]:
            raise ValueError(f"Free parameters must have nominal values > 0 (got 0 for {', '.join(none)}).")
        of_joint = {name: np.repeat(sd, (LARGE, JOINTS - LARGE)) for name, sd in PRIOR_SD.items()}
        self.mean = np.log(np.concatenate(centre))
        """Prior mean of the logarithms, [parameter]."""
        self.sd = np.concatenate([of_joint[name][: len(values)] for name, values in zip(free, centre, strict=True)])
        """Prior standard deviation of the logarithms, [parameter]."""
        self.information: Array = np.diag(1.0 / self.sd)
        """Root R of the prior information: RᵀR is the inverse covariance of the logarithms, [parameter, parameter]."""
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
        values, joints = self.values(x), range(JOINTS)
        between = np.broadcast_to(values["neighbour_w_per_k"], (*x.shape[:-1], JOINTS - 1))
        to_air = 1.0 / values["housing_ambient_k_per_w"]
        conductance = np.concatenate([1.0 / values["winding_housing_k_per_w"], to_air, between], axis=-1)
        laplacian = np.einsum("...e,en,em->...nm", conductance, _INCIDENCE, _INCIDENCE)
        capacity = np.concatenate([values["winding_j_per_k"], values["housing_j_per_k"]], axis=-1)
        # From windings to ambient, 0 unless the arm is immersed: no parameter changes it.
        edges = self.nominal.network.adj["ambient"]
        direct = np.array([edges.get(winding(j), {"conductance_w_per_k": 0.0})["conductance_w_per_k"] for j in joints])
        laplacian[..., joints, joints] += direct
        to_ambient = np.concatenate([np.broadcast_to(direct, to_air.shape), to_air], axis=-1)
        return modal_model(capacity, laplacian, to_ambient)


_ROWS = np.eye(NODES)
_INCIDENCE = np.concatenate([_ROWS[WINDING] - _ROWS[HOUSING], _ROWS[HOUSING], np.diff(_ROWS[HOUSING], axis=0)])
"""Ends of the edges winding–housing, housing–ambient and housing–housing, ±1, [edge, node]; ambient is no node."""
HOUSING_SD_K = 10.0
"""Prior standard deviation of a housing from its winding at the start of a log."""
FITTED = 6
"""Usual number of parameters per joint."""
_NUDGE = 1e-4
"""Change of a logarithm in central differences; their error is of order 1e-8."""


def linear_temperatures(dt_s: Array, model: ThermalModel, heat_w: Array, ambient_c: float, start_c: Array) -> Array:
    """Node temperatures at the edges of exact steps, °C, [set, step + 1, node], computed in modal coordinates.

    Args:
        dt_s: [step].
        model: Arrays [set, ...].
        heat_w: Constant over each step, [set, step, node].
        start_c: [node] or [set, node].
    """
    left, right = _modal(model)
    load = heat_w + model.to_ambient[:, None] * ambient_c
    exponent = -dt_s[:, None, None] * model.rates
    decay = np.exp(exponent)  # [step, set, mode]
    gain = -np.expm1(exponent) / model.rates
    driven = np.moveaxis(load @ (right / model.capacity[..., None]), 1, 0) * gain
    z = np.empty((len(dt_s) + 1, *driven.shape[1:]))
    z[0] = np.einsum("...n,...nm->...m", start_c, right)
    for step in range(len(dt_s)):
        z[step + 1] = decay[step] * z[step] + driven[step]
    return np.moveaxis(z, 0, 1) @ np.swapaxes(left, -1, -2)


def _modal(model: ThermalModel) -> tuple[Array, Array]:
    """Temperatures = left · modes and modes = rightᵀ · temperatures, each [..., node, mode]."""
    root = np.sqrt(model.capacity)[..., None]
    return model.modes / root, model.modes * root


@dataclass(frozen=True, eq=False)
class Noise:
    """Size and autocorrelation of the residuals of a fit."""

    sd_k: Array
    """[joint]."""
    steps: Array
    """Integrated autocorrelation time in steps, >= 1, [joint]: this many residuals count as one."""

    @property
    def weight(self) -> Array:
        """Of one residual, 1/K, [joint]."""
        return 1.0 / (self.sd_k * np.sqrt(self.steps))


def noise_of(unexplained: Sequence[Array], floor_k: Array) -> Noise:
    """Size and autocorrelation of residuals, K, [step, joint] per log; not below the sensors' own noise [joint].

    The sum of autocorrelations ends where they first fall below 0.05 (Sokal 1997, a fixed cut instead of his window).
    Corrected for the degrees of freedom of the fit: some parameters per joint, and per log the start of its two nodes.
    """
    sd_k = np.sqrt(np.mean(np.concatenate(unexplained) ** 2, axis=0))
    square = np.maximum(sum((u**2).sum(axis=0) for u in unexplained), np.finfo(float).tiny)
    steps, going = np.ones_like(sd_k), np.ones(len(sd_k), dtype=bool)
    for lag in range(1, max(map(len, unexplained))):
        pairs = [u[lag:] * u[:-lag] for u in unexplained if len(u) > lag]
        share = sum(p.sum(axis=0) for p in pairs) / square
        going &= share > 0.05
        if not going.any():
            break
        steps += np.where(going, 2.0 * share, 0.0)
    observations = sum(map(len, unexplained)) / steps
    left = np.maximum(observations - FITTED - 2 * len(unexplained), observations / 4.0)
    return Noise(np.maximum(sd_k * np.sqrt(observations / left), floor_k), steps)


@dataclass(frozen=True, eq=False)
class _Unknowns:
    """Least squares for the unknowns of one log: matrix · solution ≈ wanted; the last rows are their priors."""

    matrix: Array
    wanted: Array
    basis: Array
    """Orthonormal basis of the matrix, [row, unknown]."""
    upper: Array
    """Its coordinates in this basis, upper triangular, [unknown, unknown]."""
    solution: Array
    """Node temperatures at the start, °C, and the ambient offset, K, [unknown]."""
    scatter: Array
    """Observed over assumed standard deviation, [row]."""


class Problem:
    """Weighted residuals and their Jacobian for `scipy.optimize.least_squares`."""

    def __init__(
        self, logs: Sequence[HeatLog], ambient_c: float, ambient_sd_k: float, vector: ParameterVector, noise: Noise
    ) -> None:
        """
        Args:
            ambient_c: Ambient temperature, °C.
            ambient_sd_k: Its standard deviation from log to log; 0 if it was measured.
        """
        self.logs, self.ambient_c, self.ambient_sd_k = tuple(logs), ambient_c, ambient_sd_k
        self.vector, self.noise = vector, noise
        self.relative_sd = 1.0
        """Observed over assumed standard deviation of a residual, for samples (sandwich estimate: Huber 1967)."""
        self.winding_c = [log.middle_c for log in logs]
        """For the resistance, [step, joint] per log."""
        self.housing_c = self.winding_c
        """For the magnets, [step, joint] per log; replaced by those of an earlier solution."""

    def residual(self, x: Array) -> Array:
        """Of every log, then of the prior, [row]; half its square is the negative log posterior."""
        rows = [unknowns.wanted - unknowns.matrix @ unknowns.solution for unknowns in self._unknowns(x)]
        return np.concatenate([*rows, self.vector.information @ (x - self.vector.mean)])

    def jacobian(self, x: Array) -> Array:
        """Derivative of `residual` by the logarithms, [row, parameter]."""
        nudge = _NUDGE * np.eye(len(x))
        near = np.concatenate([x + nudge, x - nudge])
        model, values = self.vector.models(near), self.vector.values(near)
        parts = []
        for i, (log, unknowns) in enumerate(zip(self.logs, self._unknowns(x), strict=True)):
            windings = self._temperatures(i, model, values, unknowns.solution)[..., WINDING]
            slope = (windings[: len(x)] - windings[len(x) :]) / (2.0 * _NUDGE)
            rows = np.zeros((len(unknowns.wanted), len(x)))
            rows[: log.temp_c.size] = -(slope * self.noise.weight).reshape(len(x), -1).T
            parts.append(rows - unknowns.basis @ (unknowns.basis.T @ rows))
        return np.concatenate([*parts, self.vector.information])

    def samples(self, likely: Array, count: int, rng: np.random.Generator) -> Array:
        """Samples of the logarithms, an even number, in pairs around the most probable ones, [sample, parameter]."""
        jacobian = self.jacobian(likely)
        scatter = np.concatenate([*(each.scatter for each in self._unknowns(likely)), np.ones(len(likely))])
        noise = scatter * rng.standard_normal((count // 2, len(scatter)))
        change = np.linalg.solve(jacobian.T @ jacobian, (noise @ jacobian).T).T
        return likely + np.concatenate([change, -change])

    def temperatures(self, x: Array, rng: np.random.Generator | None = None) -> list[Array]:
        """All node temperatures with the best unknowns of each log, °C, [step + 1, node] per log.

        Args:
            rng: Samples the unknowns from their distribution instead.
        """
        model, values = self.vector.models(x[None]), self.vector.values(x[None])
        out = []
        for i, each in enumerate(self._unknowns(x)):
            change = 0.0
            if rng is not None:
                noise = each.scatter * rng.standard_normal(len(each.scatter))
                change = np.linalg.solve(each.upper, each.basis.T @ noise)
            out.append(self._temperatures(i, model, values, each.solution + change)[0])
        return out

    def unexplained(self, x: Array) -> list[Array]:
        """Simulated minus measured motor temperatures, K, [step + 1, joint] per log."""
        temps = self.temperatures(x)
        return [temp[:, WINDING] - log.temp_c for temp, log in zip(temps, self.logs, strict=True)]

    def _temperatures(self, i: int, model: ThermalModel, values: Mapping[str, Array], start: Array) -> Array:
        """Node temperatures of log i for sets of parameters, °C, [set, step + 1, node]."""
        log, motors = self.logs[i], self.vector.nominal.motors
        coulomb, viscous = values["coulomb_nm"], values["viscous_nms_per_rad"]
        current_sq = log.current_sq(coulomb, viscous)
        if log.source == "torque":
            current_sq = current_sq / magnet_factor(self.housing_c[i], motors) ** 2
        per_ohm = copper_loss(current_sq, self.winding_c[i], motors) / motors.copper_w_per_a2
        winding_w = values["copper_w_per_a2"][:, None] * per_ohm
        heat_w = node_heat(winding_w, values["idle_w"][:, None] + log.friction_w(coulomb, viscous))
        ambient_c = self.ambient_c + start[NODES:].sum()
        return linear_temperatures(log.dt_s, model, heat_w, ambient_c, start[:NODES])

    def _unknowns(self, x: Array) -> list[_Unknowns]:
        model, values = self.vector.models(x[None]), self.vector.values(x[None])
        return [self._unknowns_in(i, model, values) for i in range(len(self.logs))]

    def _unknowns_in(self, i: int, model: ThermalModel, values: Mapping[str, Array]) -> _Unknowns:
        log = self.logs[i]
        left, right = (part[0] for part in _modal(model))
        decay = np.exp(-np.outer(log.time_s - log.time_s[0], model.rates[0]))
        effect = (left[WINDING] * decay[:, None]) @ right.T  # of each start on each winding, [time, joint, node]
        if self.ambient_sd_k > 0:
            no_heat = np.zeros((1, len(log.dt_s), NODES))
            warmer = linear_temperatures(log.dt_s, model, no_heat, 1.0, np.zeros(NODES))[0, :, WINDING]
            effect = np.concatenate([effect, warmer[..., None]], axis=-1)
        unknowns = effect.shape[-1]
        prior_sd = np.append(np.full(JOINTS, HOUSING_SD_K), [self.ambient_sd_k] * (unknowns - NODES))
        prior = np.eye(unknowns)[HOUSING.start :] / prior_sd[:, None]
        forced_c = self._temperatures(i, model, values, np.zeros(NODES))[0, :, WINDING]
        missing = (log.temp_c - forced_c) * self.noise.weight
        likely = np.append(log.temp_c[0], np.zeros(unknowns - NODES)) / prior_sd
        matrix = np.concatenate([(effect * self.noise.weight[:, None]).reshape(-1, unknowns), prior])
        wanted = np.concatenate([missing.reshape(-1), likely])
        basis, upper = np.linalg.qr(matrix)
        scatter = np.append(np.full(log.temp_c.size, self.relative_sd), np.ones(len(prior)))
        return _Unknowns(matrix, wanted, basis, upper, np.linalg.solve(upper, basis.T @ wanted), scatter)


AMBIENT_C = 22.0
"""Default ambient temperature; that of the public Gen3 logs."""
BELOW_AMBIENT_K = 3.0
"""By how much the coolest motor of a powered arm may read less than the ambient temperature."""
INFORMED = 0.9
"""A parameter is informed if its standard deviation is below this share of the prior's."""
LEAST_WEIGHT = 0.01
"""A common factor is informed from this share of the prior's information on."""
MOST_COMMON_SD = 3.5
"""Usual distance of a common factor, in standard deviations: up to 2.9 in public logs, of copper loss, and 0.8 of idle
heat and cooling; 5.7 with currents √2 times as large, 3.8 with a temperature that drifts by 10 K in an hour."""
MOST_UNLIKE_JOINTS = 3
"""More joints with another idle temperature are those of an arm with other cooling."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One identified number."""

    name: str
    """As in `fleet/data/gen3_thermal.json`."""
    joint: int | None
    """1..7; None for the one conductance between neighbours."""
    value: float
    low: float
    """Lower end of the 95 % interval, given model, prior and logs."""
    high: float
    prior: float
    prior_sd: float
    """Of the logarithm, before the logs."""
    sd: float
    """Of the logarithm, after the logs."""

    @property
    def informed(self) -> bool:
        """Whether the logs informed it; if not, it is the prior."""
        return self.sd < INFORMED * self.prior_sd


@dataclass(frozen=True, kw_only=True, eq=False)
class Identified:
    """One arm's thermal network, identified from its logs."""

    arm: str
    heat_model: HeatModel
    """Motors and network with the identified values."""
    parameters: tuple[Parameter, ...]
    ambient_c: float
    """Assumed ambient temperature."""
    ambient_sd_k: float
    source: CurrentSource
    """Source of the current."""
    rms_k: dict[str, tuple[float, ...]]
    """Root mean square residual of each recording, per joint."""
    memory_s: tuple[float, ...]
    """Correlation time of the residuals, per joint; intervals count this much of a log as one observation."""
    seconds: float
    """Length of the recordings used."""
    data_hash: str
    information: Array | None = None
    """Root R of the information: RᵀR is the inverse covariance of the logarithms, float32 [parameter, parameter]."""

    @cached_property
    def version(self) -> str:
        """Hash of the data and of every number but the information, which follows from them."""
        sources = [self.arm, self.data_hash, self.ambient_c, self.source, self.parameters]
        digest = hashlib.sha256(msgspec.json.encode(sources))
        for value in vars(self.heat_model.motors).values():
            digest.update(np.asarray(value, dtype=float).tobytes())
        edges = self.heat_model.network.edges(data="conductance_w_per_k")
        for part in sorted((*sorted(ends), value) for *ends, value in edges):
            digest.update(msgspec.json.encode(part))
        digest.update(msgspec.json.encode(sorted(self.heat_model.network.nodes(data="capacity_j_per_k"))))
        return f"rc-{digest.hexdigest()[:13]}"

    def parameter(self, name: str, joint: int | None = None) -> Parameter:
        """One of the identified numbers, joint 1..7.

        Raises:
            KeyError: it was not free.
        """
        if named := [p for p in self.parameters if (p.name, p.joint) == (name, joint)]:
            return named[0]
        raise KeyError(f"{name} of joint {joint} was not free. Free: {sorted({p.name for p in self.parameters})}.")

    def unlike(self) -> "Unlike":
        """Common changes of its parameters that no Gen3 has."""
        if self.information is None:
            return Unlike()
        names = [(p.name, None if p.joint is None else p.joint - 1) for p in self.parameters]
        shift = np.log([p.value / p.prior for p in self.parameters])
        root = self.information.astype(float)
        prior = np.diag(1.0 / np.array([p.prior_sd for p in self.parameters]) ** 2)
        return Unlike.of(names, shift, prior, root.T @ root, self.source)


@dataclass(frozen=True, kw_only=True)
class Unlike:
    """Common changes of an arm's parameters that no Gen3 has, although each alone may be within the spread of arms."""

    doubts: tuple[str, ...] = ()
    """Parts of a sentence."""
    question: str = ""
    """Probable cause, as a sentence; empty if it is unknown."""

    @property
    def remedy(self) -> str:
        """What to check where the network or the log is in doubt, the probable cause first."""
        check = "Check the units and the order of temperatures, currents and torques, and the ambient temperature."
        return f"{self.question} {check}".strip()

    @classmethod
    def of(
        cls,
        names: Sequence[tuple[str, int | None]],
        shift: Array,
        prior: Array,
        posterior: Array,
        source: CurrentSource,
    ) -> "Unlike":
        """From the estimated logarithms of the parameters.

        Args:
            names: Name and joint (0..6) of each parameter.
            shift: Less those of a nominal Gen3, [parameter].
            prior: Inverse covariance before the logs, [parameter, parameter].
            posterior: The same after the logs.
            source: Of the current.
        """
        by_logs = prior - prior @ np.linalg.inv(posterior) @ prior

        def common(chosen: Callable[[str, int | None], bool]) -> tuple[float, float]:
            """Most likely common factor, and its distance from 1 in standard deviations (score test: Rao 1948)."""
            pick = np.array([chosen(*name) for name in names], dtype=float)
            weight, score = float(pick @ by_logs @ pick), float(pick @ prior @ shift)
            if weight <= LEAST_WEIGHT * float(pick @ prior @ pick):
                return 1.0, 0.0
            return float(np.exp(score / weight)), abs(score) / float(np.sqrt(weight))

        doubts, question = list[str](), ""
        copper, copper_sd = common(lambda name, _: name == "copper_w_per_a2")
        if copper_sd > MOST_COMMON_SD:
            doubts.append(f"copper_w_per_a2 of all joints is {copper:.2g} times that of a nominal Gen3")
            quantity, cause = "Currents", "are these RMS, or peak values, or in another unit"
            if source == "torque":
                quantity, cause = "Torques", "are these those of the joints, in N·m"
            question = f"{quantity} {np.sqrt(copper):.2g} times as large would fit a Gen3: {cause}?"
        sd = [common(lambda name, of, j=j: name in _IDLE and of == j)[1] for j in range(JOINTS)]
        idle = [j for j in range(JOINTS) if sd[j] > MOST_COMMON_SD]
        for j in idle if len(idle) <= MOST_UNLIKE_JOINTS else ():
            rise = np.exp(sum(shift[i] for i, (name, of) in enumerate(names) if name in _IDLE and of == j))
            above = f"{rise:.2g} times as far above the ambient temperature as in a nominal Gen3"
            doubts.append(f"joint {j + 1} without load is {above}")
        return cls(doubts=tuple(doubts), question=question)


_IDLE = ("idle_w", "housing_ambient_k_per_w")
"""Parameters whose product is the rise of an idle motor above the ambient temperature, roughly."""


def nominal_heat_model(cooling: Cooling = "still_air") -> HeatModel:
    """A Gen3 with the default parameters."""
    return HeatModel(gen3_motors(), gen3_network(cooling=cooling))


LEAST_S = 300.0
"""Two time constants of a winding: shorter logs add nothing to the prior."""
LEAST_CHANGE_K = 0.3
"""Least change of some motor's temperature within one log; idle sensors drift by 0.05."""
LEAST_CURRENT_A = 0.2
_SIGMA_95 = 1.96
_MORE_ROUNDS = 2
RESIDUAL_K, RESIDUAL_S = 0.1, 600.0
"""Residuals of a good fit to real logs, correlated for a quarter of a housing's time: the noise of the first round."""


def identify(
    recordings: Sequence[Recording],
    *,
    arm: str = "arm",
    nominal: HeatModel | None = None,
    ambient_c: float = AMBIENT_C,
    ambient_sd_k: float | None = None,
    free: Sequence[str] = tuple(PRIOR_SD),
    step_s: float = STEP_S,
) -> Identified:
    """The most probable parameters of an arm given its recordings and the prior.

    Args:
        nominal: Centre of the prior; a Gen3 in still air unless given.
        ambient_c: Ambient temperature.
        ambient_sd_k: Its standard deviation from recording to recording, 0 if it was measured. By default that of
            rooms, and motors that are cooler than the ambient temperature are refused. Differences between recordings
            are attributed to it, not to the arm.
        free: Names of `twin.thermal.identify.PRIOR_SD`; the others keep their nominal values.
        step_s: Length of a step of the simulation.

    Raises:
        IdentificationError: the recordings are insufficient: wrong number of joints, no temperatures, too short, no
            motor that warms or cools, no current.
        FleetError: an argument is not allowed; see `check_log` and `check_ambient`.
    """
    check_log(recordings)
    check_value("arm", arm, is_name=True)
    ambient_c = check_value("ambient_c", ambient_c, float, low=-40, high=60)
    ambient_sd_k = check_value("ambient_sd_k", ambient_sd_k, float, low=0, high=100, takes_none=True)
    step_s = check_value("step_s", step_s, float, low=0, high=RESIDUAL_S, above=True)
    nominal = nominal_heat_model() if nominal is None else nominal
    check_instance("nominal", nominal, HeatModel, "nominal_heat_model()")
    vector = ParameterVector(nominal, free)
    sd_k = thermal_data()["spread"]["ambient_k"] if ambient_sd_k is None else ambient_sd_k
    _check_recordings(recordings)
    if ambient_sd_k is None:
        for recording in recordings:
            check_ambient(recording, ambient_c)
    source = source_of(recordings)
    logs = [log for r in recordings for log in heat_logs(r, nominal.motors, source, step_s=step_s)]
    _check_logs(recordings, logs, nominal)
    problem, x = _fit(logs, ambient_c, sd_k, vector)
    jacobian = problem.jacobian(x)
    information = np.linalg.cholesky(jacobian.T @ jacobian).T
    return Identified(
        arm=arm,
        heat_model=vector.heat_model(x),
        parameters=_parameters(vector, x, information),
        information=information.astype(np.float32),
        ambient_c=ambient_c,
        ambient_sd_k=sd_k,
        source=source,
        rms_k=_rms(logs, problem.unexplained(x)),
        memory_s=tuple((problem.noise.steps * _step(logs)).tolist()),
        seconds=float(sum(log.time_s[-1] - log.time_s[0] for log in logs)),
        data_hash=_hash(recordings),
    )


def _fit(logs: Sequence[HeatLog], ambient_c: float, sd_k: float, vector: ParameterVector) -> tuple[Problem, Array]:
    """The problem with the noise of its own residuals, and its solution."""
    problem = Problem(logs, ambient_c, sd_k, vector, usual_noise(logs))
    x = solve(problem, vector.mean)
    for _ in range(_MORE_ROUNDS):
        temp_c, noise = problem.temperatures(x), noise_of(problem.unexplained(x), vector.nominal.motors.sensor_noise_k)
        problem = Problem(logs, ambient_c, sd_k, vector, noise)
        problem.housing_c = [(temp[1:, HOUSING] + temp[:-1, HOUSING]) / 2.0 for temp in temp_c]
        x = solve(problem, x)
    return problem, x


def usual_noise(logs: Sequence[HeatLog]) -> Noise:
    """Residuals of a good fit to real logs."""
    return Noise(np.full(JOINTS, RESIDUAL_K), np.full(JOINTS, max(RESIDUAL_S / _step(logs), 1.0)))


def solve(problem: Problem, x: Array) -> Array:
    """The most probable logarithms, [parameter], from a first guess."""
    from scipy.optimize import least_squares

    jacobian: Any = problem.jacobian  # scipy-stubs accept only the names of SciPy's own difference schemes.
    sd = problem.vector.sd
    return least_squares(problem.residual, x, jacobian, x_scale=sd, ftol=1e-6, xtol=1e-5, max_nfev=60).x


def _step(logs: Sequence[HeatLog]) -> float:
    return float(np.median(np.concatenate([log.dt_s for log in logs])))


def _parameters(vector: ParameterVector, x: Array, information: Array) -> tuple[Parameter, ...]:
    sd = np.linalg.norm(np.linalg.inv(information), axis=1)
    value, low, high = (np.exp(x + shift * sd) for shift in (0.0, -_SIGMA_95, _SIGMA_95))
    prior = np.exp(vector.mean)
    columns = {"value": value, "low": low, "high": high, "prior": prior, "prior_sd": vector.sd, "sd": sd}
    return tuple(
        Parameter(name=name, joint=None if joint is None else joint + 1, **{c: float(v[i]) for c, v in columns.items()})
        for i, (name, joint) in enumerate(vector.names)
    )


def _rms(logs: Sequence[HeatLog], unexplained: Sequence[Array]) -> dict[str, tuple[float, ...]]:
    residuals: dict[str, list[Array]] = {}
    for log, residual in zip(logs, unexplained, strict=True):
        residuals.setdefault(log.name, []).append(residual)
    return {
        name: tuple(np.sqrt(np.mean(np.concatenate(parts) ** 2, axis=0)).tolist()) for name, parts in residuals.items()
    }


def _hash(recordings: Sequence[Recording]) -> str:
    digest = hashlib.sha256()
    for recording in recordings:
        digest.update("/".join(recording.name.split("/")[-2:]).encode())  # without the folder, which may be renamed
        for channel in ("time_s", *READINGS):
            if (values := getattr(recording, channel)) is not None:
                digest.update(channel.encode() + np.ascontiguousarray(values, dtype=float).tobytes())
    return digest.hexdigest()[:16]


def _check_recordings(recordings: Sequence[Recording]) -> None:
    for recording in recordings:
        if recording.temp_c is None:
            raise IdentificationError(
                f"Recording '{recording.name}' has no motor temperatures. Record temperature_motor of every joint "
                "(Kortex ActuatorFeedback), or leave this recording out."
            )


def check_ambient(log: Recording, ambient_c: float) -> None:
    """Raise a FleetError if a motor temperature of a log is below its ambient temperature."""
    coolest_c = np.inf if log.temp_c is None else float(log.temp_c.min(initial=np.inf))
    if coolest_c < ambient_c - BELOW_AMBIENT_K:
        coolest, ambient = distinguish(coolest_c, ambient_c)
        raise FleetError(
            f"The log '{log.name}' has a motor at {coolest} °C, below the ambient temperature of {ambient} °C, which "
            "no powered motor can be. State the ambient temperature of the log in °C (--ambient)."
        )


def _check_logs(recordings: Sequence[Recording], logs: Sequence[HeatLog], nominal: HeatModel) -> None:
    seconds, whole_s = sum(log.time_s[-1] - log.time_s[0] for log in logs), sum(r.duration_s for r in recordings)
    names = f"'{recordings[0].name}'" if len(recordings) == 1 else f"{len(recordings)} logs ('{recordings[0].name}', …)"
    if seconds < LEAST_S:
        length, least = distinguish(seconds if whole_s >= LEAST_S else whole_s, LEAST_S)
        length += " s" if whole_s < LEAST_S else f" s in stretches without a gap, of {whole_s:.4g} s"
        raise IdentificationError(
            f"Too little was recorded in {names}: {length}, at least {least} s are needed. Record half an hour "
            "of work and cooling."
        )
    change_k = max(float(np.ptp(log.temp_c, axis=0).max()) for log in logs)
    if change_k < LEAST_CHANGE_K:
        change, least = distinguish(change_k, LEAST_CHANGE_K)
        raise IdentificationError(
            f"No motor warms or cools by more than {change} K within a recording of {names}, {least} K are needed "
            "at least. Record the arm while it works after a rest, or hold a load outstretched for some minutes."
        )
    motors = nominal.motors
    most_a = np.sqrt(max(log.current_sq(motors.coulomb_nm, motors.viscous_nms_per_rad).max() for log in logs))
    if most_a < LEAST_CURRENT_A:
        raise IdentificationError(
            f"No motor carries more than {most_a:.2f} A in {names}, so copper loss is unknown. Record the "
            "powered arm while it moves, or holds a posture against gravity."
        )
