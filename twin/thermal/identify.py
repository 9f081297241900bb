"""Identification of an arm's thermal network from its logs, with 95 % intervals.

Nonlinear least squares through the exact step, with log-normal priors around a nominal arm. The ambient temperature is
given: motor temperatures alone do not distinguish it from idle heat. An error of two kelvin changes idle heat and
cooling by
some 6 %; predictions in the same room hardly change.
"""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from fleet.errors import IdentificationError
from fleet.motor import thermal_data
from fleet.robot import JOINTS
from fleet.thermal import HOUSING
from twin.logs.heat_log import STEP_S, HeatLog, heat_logs, source_of
from twin.logs.recording import READINGS, Recording
from twin.thermal.least_squares import Noise, Problem, noise_of
from twin.thermal.parameters import PRIOR_SD, HeatModel, ParameterVector
from twin.thermal.result import AMBIENT_C, Identified, Parameter, nominal_heat_model

Array = np.ndarray

LEAST_S = 300.0
"""Two time constants of a winding: shorter logs add nothing to the prior."""
LEAST_CHANGE_K = 0.3
"""Least change of some motor's temperature within one log; idle sensors drift by 0.05."""
LEAST_CURRENT_A = 0.2
_SIGMA_95 = 1.96
_MORE_ROUNDS = 2
_FIRST_SD_K, _FIRST_MEMORY_S = 0.1, 600.0
"""Noise of the first round: residuals of a good fit to real logs, correlated for a quarter of a housing's time."""


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
        ambient_sd_k: Its standard deviation from recording to recording, by default that of rooms; 0 if it was
            measured. Differences between recordings are attributed to it, not to the arm.
        free: Names of `twin.thermal.parameters.PRIOR_SD`; the others keep their nominal values.

    Raises:
        IdentificationError: the recordings are too little: none, other joints, no temperatures, too short, no motor
            that warms or cools, no current.
    """
    nominal = nominal or nominal_heat_model()
    sd_k = thermal_data()["spread"]["ambient_k"] if ambient_sd_k is None else ambient_sd_k
    if sd_k < 0:
        raise ValueError(f"ambient_sd_k must be >= 0 (got {sd_k}).")
    _check_recordings(recordings)
    source = source_of(recordings)
    logs = [log for r in recordings for log in heat_logs(r, nominal.motors, source, step_s=step_s)]
    _check_logs(logs, nominal)
    vector = ParameterVector(nominal, free)
    problem, x, jacobian = _fit(logs, ambient_c, sd_k, vector)
    return Identified(
        arm=arm,
        heat_model=vector.heat_model(x),
        parameters=_parameters(vector, x, jacobian),
        ambient_c=ambient_c,
        ambient_sd_k=sd_k,
        source=source,
        rms_k=_rms(logs, problem.unexplained(x)),
        memory_s=tuple((problem.noise.steps * _step(logs)).tolist()),
        seconds=float(sum(log.time_s[-1] - log.time_s[0] for log in logs)),
        data_hash=_hash(recordings),
    )


def _fit(
    logs: Sequence[HeatLog], ambient_c: float, sd_k: float, vector: ParameterVector
) -> tuple[Problem, Array, Array]:
    """The problem with the noise of its own residuals, its solution, and the Jacobian there."""
    steps = max(_FIRST_MEMORY_S / _step(logs), 1.0)
    problem = Problem(logs, ambient_c, sd_k, vector, Noise(np.full(JOINTS, _FIRST_SD_K), np.full(JOINTS, steps)))
    x = _solve(problem, vector.mean)
    for _ in range(_MORE_ROUNDS):
        temp_c, noise = problem.temperatures(x), noise_of(problem.unexplained(x), vector.nominal.motors.sensor_noise_k)
        problem = Problem(logs, ambient_c, sd_k, vector, noise)
        problem.housing_c = [(temp[1:, HOUSING] + temp[:-1, HOUSING]) / 2.0 for temp in temp_c]
        x = _solve(problem, x)
    return problem, x, problem.jacobian(x)


def _solve(problem: Problem, x: Array) -> Array:
    jacobian: Any = problem.jacobian  # scipy-stubs accept only the names of SciPy's own difference schemes.
    sd = problem.vector.sd
    return least_squares(problem.residual, x, jacobian, x_scale=sd, ftol=1e-6, xtol=1e-5, max_nfev=60).x


def _step(logs: Sequence[HeatLog]) -> float:
    return float(np.median(np.concatenate([log.dt_s for log in logs])))


def _parameters(vector: ParameterVector, x: Array, jacobian: Array) -> tuple[Parameter, ...]:
    sd = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
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
        digest.update(recording.name.encode())
        for channel in ("time_s", *READINGS):
            if (values := getattr(recording, channel)) is not None:
                digest.update(channel.encode() + np.ascontiguousarray(values, dtype=float).tobytes())
    return digest.hexdigest()[:16]


def _check_recordings(recordings: Sequence[Recording]) -> None:
    if not recordings:
        raise IdentificationError("Identification needs at least one recording (got none).")
    names = [r.name for r in recordings]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise IdentificationError(f"Names of recordings must differ; given more than once: {', '.join(twice)}.")
    for recording in recordings:
        if recording.joints != JOINTS:
            raise IdentificationError(
                f"Recording '{recording.name}' has {recording.joints} joints, the thermal network {JOINTS}."
            )
        if recording.temp_c is None:
            raise IdentificationError(
                f"Recording '{recording.name}' has no motor temperatures. Record temperature_motor of every joint "
                "(Kortex ActuatorFeedback), or leave this recording out."
            )


def _check_logs(logs: Sequence[HeatLog], nominal: HeatModel) -> None:
    seconds = sum(log.time_s[-1] - log.time_s[0] for log in logs)
    if seconds < LEAST_S:
        raise IdentificationError(
            f"The recordings have {seconds:.0f} s without a gap, at least {LEAST_S:.0f} s are needed. Record half an "
            "hour of work and cooling."
        )
    change_k = max(float(np.ptp(log.temp_c, axis=0).max()) for log in logs)
    if change_k < LEAST_CHANGE_K:
        raise IdentificationError(
            f"No motor warms or cools by more than {change_k:.2f} K within a recording, {LEAST_CHANGE_K} K are needed "
            "at least. Record the arm while it works after a rest, or hold a load outstretched for some minutes."
        )
    motors = nominal.motors
    squares = [log.current_sq(motors.coulomb_nm, motors.viscous_nms_per_rad).max() for log in logs]
    if np.sqrt(max(squares)) < LEAST_CURRENT_A:
        raise IdentificationError(
            f"No motor carries more than {np.sqrt(max(squares)):.2f} A, so copper loss is unknown. Record the "
            "powered arm while it moves, or holds a posture against gravity."
        )
