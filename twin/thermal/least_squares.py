"""Least squares of thermal parameters through the exact step; start temperatures and ambient offset are eliminated.

With the copper's resistance taken at the measured winding temperature the network is linear in its temperatures. So
those at the start of a log, and the offset of the ambient temperature, follow by linear least squares for any
parameters (variable projection: Golub & Pereyra 1973; Jacobian in Kaufman's form, whose gradient is exact).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fleet.motor import Motors, copper_loss, magnet_factor
from fleet.robot import JOINTS
from fleet.thermal import HOUSING, NODES, WINDING, ThermalModel, node_heat
from twin.logs.heat_log import HeatLog
from twin.thermal.parameters import ParameterVector

Array = np.ndarray

HOUSING_SD_K = 10.0
"""Prior standard deviation of a housing from its winding at the start of a log."""
FITTED = 6
"""Usual number of parameters per joint."""
_NUDGE = 1e-4
"""Change of a logarithm in central differences; their error is of order 1e-8."""


def heat(log: HeatLog, values: Mapping[str, Array], motors: Motors, winding_c: Array, housing_c: Array) -> Array:
    """Heat per node over each step, W, [set, step, node].

    Args:
        values: Parameters by name, [set, joint].
        winding_c: For the resistance, [step, joint].
        housing_c: For the magnets, where the current comes from torque, [step, joint].
    """
    coulomb, viscous = values["coulomb_nm"], values["viscous_nms_per_rad"]
    current_sq = log.current_sq(coulomb, viscous)
    if log.source == "torque":
        current_sq = current_sq / magnet_factor(housing_c, motors) ** 2
    per_ohm = copper_loss(current_sq, winding_c, motors) / motors.copper_w_per_a2
    winding_w = values["copper_w_per_a2"][:, None] * per_ohm
    return node_heat(winding_w, values["idle_w"][:, None] + log.friction_w(coulomb, viscous))


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


def start_sensitivity(elapsed_s: Array, model: ThermalModel) -> Array:
    """Derivative of each winding by each initial temperature of one network [1, ...], [time, joint, node]."""
    left, right = (part[0] for part in _modal(model))
    decay = np.exp(-np.outer(elapsed_s, model.rates[0]))
    return (left[WINDING] * decay[:, None]) @ right.T


def _modal(model: ThermalModel) -> tuple[Array, Array]:
    """Temperatures = left · modes and modes = rightᵀ · temperatures, each [..., node, mode]."""
    root = np.sqrt(model.capacity)[..., None]
    return model.modes / root, model.modes * root


@dataclass(frozen=True, eq=False)
class Noise:
    """Residuals of a fit: their size and autocorrelation."""

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
    solution: Array
    """Node temperatures at the start, °C, and the ambient offset, K, [unknown]."""


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
        self.winding_c = [log.middle_c for log in logs]
        """For the resistance, [step, joint] per log."""
        self.housing_c = self.winding_c
        """For the magnets, [step, joint] per log; replaced by those of an earlier solution."""

    def residual(self, x: Array) -> Array:
        """Of every log, then of the prior, [row]; half its square is the negative log posterior."""
        rows = [unknowns.wanted - unknowns.matrix @ unknowns.solution for unknowns in self._unknowns(x)]
        return np.concatenate([*rows, (x - self.vector.mean) / self.vector.sd])

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
        return np.concatenate([*parts, np.diag(1.0 / self.vector.sd)])

    def temperatures(self, x: Array) -> list[Array]:
        """All node temperatures with the best unknowns of each log, °C, [step + 1, node] per log."""
        model, values = self.vector.models(x[None]), self.vector.values(x[None])
        return [self._temperatures(i, model, values, each.solution)[0] for i, each in enumerate(self._unknowns(x))]

    def unexplained(self, x: Array) -> list[Array]:
        """Simulated minus measured motor temperatures, K, [step + 1, joint] per log."""
        temps = self.temperatures(x)
        return [temp[:, WINDING] - log.temp_c for temp, log in zip(temps, self.logs, strict=True)]

    def _temperatures(self, i: int, model: ThermalModel, values: Mapping[str, Array], start: Array) -> Array:
        log = self.logs[i]
        heat_w = heat(log, values, self.vector.nominal.motors, self.winding_c[i], self.housing_c[i])
        ambient_c = self.ambient_c + start[NODES:].sum()
        return linear_temperatures(log.dt_s, model, heat_w, ambient_c, start[:NODES])

    def _unknowns(self, x: Array) -> list[_Unknowns]:
        model, values = self.vector.models(x[None]), self.vector.values(x[None])
        return [self._unknowns_in(i, model, values) for i in range(len(self.logs))]

    def _unknowns_in(self, i: int, model: ThermalModel, values: Mapping[str, Array]) -> _Unknowns:
        log = self.logs[i]
        effect = start_sensitivity(log.time_s - log.time_s[0], model)
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
        return _Unknowns(matrix, wanted, basis, np.linalg.solve(upper, basis.T @ wanted))
