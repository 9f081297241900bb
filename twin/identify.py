"""An arm's own thermal network from its own logs, with intervals that say how well the logs tell each parameter.

Nonlinear least squares through the exact step, with log-normal priors around a nominal arm. The room's air is given:
from the motors' temperatures alone it cannot be told from idle heat, so a wrong air temperature comes back as wrong
idle heat (two kelvin change it and the cooling by some 6 %); predictions in the same room hardly change.
"""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from fleet.errors import IdentificationError
from fleet.motor import thermal_data
from fleet.robot import JOINTS
from fleet.thermal import HOUSING, WINDING
from twin.heat_log import STEP_S, HeatLog, heat_logs, source_of
from twin.identified import AMBIENT_C, Identified, Parameter, nominal_body
from twin.recording import CHANNELS, Recording
from twin.thermal_fit import Noise, Problem, noise_of
from twin.thermal_values import PRIOR_SD, Body, Layout

Array = np.ndarray

LEAST_S = 300.0
"""Two time constants of a winding: below this the logs tell nothing that a prior does not."""
LEAST_CHANGE_K = 0.3
"""Some motor must warm or cool by so much within one log; idle sensors wander by 0.05."""
LEAST_CURRENT_A = 0.2
_SIGMA_95 = 1.96
_MORE_ROUNDS = 2
_FIRST_SD_K, _FIRST_MEMORY_S = 0.1, 600.0
"""Noise of the first round: what a good fit leaves on real logs, staying so for a quarter of a housing's time."""


def identify(
    recordings: Sequence[Recording],
    *,
    arm: str = "arm",
    nominal: Body | None = None,
    ambient_c: float = AMBIENT_C,
    ambient_sd_k: float | None = None,
    free: Sequence[str] = tuple(PRIOR_SD),
    step_s: float = STEP_S,
) -> Identified:
    """The arm's parameters, most probable given its recordings and the prior.

    Args:
        nominal: Centre of the prior; a Gen3 in still air unless given.
        ambient_c: Air around the arm.
        ambient_sd_k: How well the air during one recording is known; 0 is exactly, the default is that of rooms.
            What differs from recording to recording is then put down to the air, not to the arm.
        free: Names of `twin.thermal_values.PRIOR_SD`; the others are held at the nominal arm's.

    Raises:
        IdentificationError: the recordings cannot tell: none, other joints, no temperatures, too short, nothing that
            warms or cools, no current.
    """
    nominal = nominal or nominal_body()
    sd_k = thermal_data()["spread"]["ambient_k"] if ambient_sd_k is None else ambient_sd_k
    if sd_k < 0:
        raise ValueError(f"ambient_sd_k must be >= 0 (got {sd_k}).")
    _check_recordings(recordings)
    source = source_of(recordings)
    logs = [log for r in recordings for log in heat_logs(r, nominal.motors, source, step_s=step_s)]
    _check_logs(logs, nominal)
    layout = Layout(nominal, free)
    problem, x, jacobian = _fit(logs, ambient_c, sd_k, layout)
    return Identified(
        arm=arm,
        body=layout.body(x),
        parameters=_parameters(layout, x, jacobian),
        ambient_c=ambient_c,
        ambient_sd_k=sd_k,
        source=source,
        rms_k=_rms(logs, problem.unexplained(x)),
        memory_s=tuple((problem.noise.steps * _step(logs)).tolist()),
        seconds=float(sum(log.time_s[-1] - log.time_s[0] for log in logs)),
        data_hash=_hash(recordings),
    )


def _fit(logs: Sequence[HeatLog], ambient_c: float, sd_k: float, layout: Layout) -> tuple[Problem, Array, Array]:
    """The problem with the noise that its own solution leaves, that solution, and the Jacobian there."""
    steps = max(_FIRST_MEMORY_S / _step(logs), 1.0)
    problem = Problem(logs, ambient_c, sd_k, layout, Noise(np.full(JOINTS, _FIRST_SD_K), np.full(JOINTS, steps)))
    x = _solve(problem, layout.mean)
    for _ in range(_MORE_ROUNDS):
        temp_c = problem.temperatures(x)
        left = [temp[:, WINDING] - log.temp_c for temp, log in zip(temp_c, logs, strict=True)]
        problem = Problem(logs, ambient_c, sd_k, layout, noise_of(left, layout.nominal.motors.sensor_noise_k))
        problem.housing_c = [(temp[1:, HOUSING] + temp[:-1, HOUSING]) / 2.0 for temp in temp_c]
        x = _solve(problem, x)
    return problem, x, problem.jacobian(x)


def _solve(problem: Problem, x: Array) -> Array:
    jacobian: Any = problem.jacobian  # scipy-stubs know only the names of its own difference schemes.
    sd = problem.layout.sd
    return least_squares(problem.residual, x, jacobian, x_scale=sd, ftol=1e-6, xtol=1e-5, max_nfev=60).x


def _step(logs: Sequence[HeatLog]) -> float:
    return float(np.median(np.concatenate([log.dt_s for log in logs])))


def _parameters(layout: Layout, x: Array, jacobian: Array) -> tuple[Parameter, ...]:
    sd = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    value, low, high = (np.exp(x + shift * sd) for shift in (0.0, -_SIGMA_95, _SIGMA_95))
    return tuple(
        Parameter(
            name=name,
            joint=None if joint is None else joint + 1,
            value=float(value[i]),
            low=float(low[i]),
            high=float(high[i]),
            prior=float(np.exp(layout.mean[i])),
            prior_sd=float(layout.sd[i]),
            sd=float(sd[i]),
        )
        for i, (name, joint) in enumerate(layout.names)
    )


def _rms(logs: Sequence[HeatLog], unexplained: Sequence[Array]) -> dict[str, tuple[float, ...]]:
    squares: dict[str, list[Array]] = {}
    for log, left in zip(logs, unexplained, strict=True):
        squares.setdefault(log.name, []).append(left**2)
    return {name: tuple(np.sqrt(np.concatenate(s).mean(axis=0)).tolist()) for name, s in squares.items()}


def _hash(recordings: Sequence[Recording]) -> str:
    digest = hashlib.sha256()
    for recording in recordings:
        digest.update(recording.name.encode())
        for channel in ("time_s", *CHANNELS):
            if (values := getattr(recording, channel)) is not None:
                digest.update(channel.encode() + np.ascontiguousarray(values, dtype=float).tobytes())
    return digest.hexdigest()[:16]


def _check_recordings(recordings: Sequence[Recording]) -> None:
    if not recordings:
        raise IdentificationError("There is no recording to identify an arm from.")
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


def _check_logs(logs: Sequence[HeatLog], nominal: Body) -> None:
    seconds = sum(log.time_s[-1] - log.time_s[0] for log in logs)
    if seconds < LEAST_S:
        raise IdentificationError(
            f"The recordings have {seconds:.0f} s without a gap, at least {LEAST_S:.0f} s are needed; half an hour of "
            "work and cooling tells most."
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
            f"No motor carries more than {np.sqrt(max(squares)):.2f} A, so copper loss cannot be told. Record the arm "
            "powered: moving, or holding a posture against gravity."
        )
