"""Simpler methods with which a twin is compared.

A network that learned nothing; RMS torque relative to a nominal torque, the usual rule for sizing a motor; and
P(saturation) by a logistic regression on the load of the joints, fitted on the arm's past jobs.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from scipy.optimize import minimize

from fleet.difficulty import KNOWN, Forecast
from fleet.json_file import check_version, read_card, write_card
from fleet.motion import Plan
from twin.thermal.thermal_twin import LEAST_JOBS, NotEnoughExperience
from twin.vae.config import TwinConfig
from twin.vae.measures import TAU, Features
from twin.vae.window import STD_FLOOR, check_jobs

Array = np.ndarray


def untrained_config(config: TwinConfig) -> TwinConfig:
    """A VAE with its initial weights: one epoch at a rate below what the weights can resolve."""
    return replace(config, epochs=1, learning_rate=1e-12, restarts=1, allow_collapse=True)


def known_torque(records: Sequence[Array]) -> Array:
    """RMS torque of training motion [time, 3, joint], N·m, [joint]; needs no motor data."""
    if not records:
        raise ValueError("The torque of the training motion needs at least one record (got none).")
    squares = np.concatenate([np.square(record[:, TAU], dtype=float) for record in records])
    # A joint without load in training has no torque to divide by.
    return np.maximum(np.sqrt(squares.mean(axis=0)), STD_FLOOR[TAU])


def torque_ratio(plan: Plan, repetitions: int, nominal_nm: Array) -> Array:
    """RMS torque over the time of the repeated plan divided by a nominal torque > 0, [joint].

    Raises:
        ValueError: repetitions < 1, or a plan without motion or of other joints.
    """
    check_jobs([plan], [repetitions])
    squares = [
        share * np.square(phase.profile[:, TAU], dtype=float).mean(axis=0)
        for phase, share in zip(plan.phases, plan.weights(repetitions), strict=True)
        if len(phase.profile)
    ]
    if len(squares[0]) != len(nominal_nm):
        raise ValueError(f"The nominal torque has {len(nominal_nm)} joints, the plan {len(squares[0])}.")
    return np.sqrt(np.sum(squares, axis=0)) / nominal_nm


Evidence = Literal["excess", "torque"]
EVIDENCE: Mapping[Evidence, Callable[[Features], Array]] = {
    "excess": lambda features: features.excess_sq,
    "torque": lambda features: features.torque_sq,
}
"""Load that a regression reads, (N·m)², [..., joint]: torque² above the reconstruction of a twin, or all torque²."""

FORMAT = 3
FILE = "saturation.json"
WARMING_S = 1500.0
"""Time constant of heating: between those of a Gen3's windings (150 to 290 s) and housings (1700 to 2700 s)."""
LEAST_OF_EACH = 5
"""Least jobs that passed the limit, and that did not: fewer cannot be cross-validated."""
FOLDS = 5
STRENGTHS = tuple(float(c) for c in np.logspace(-2, 2, 9))
"""Candidates for the inverse regularisation."""


@dataclass(frozen=True, kw_only=True)
class LoadRegression:
    """P = logistic(offset + load · (at_once + share · later) + ln(duration) · of_log_duration
    + known_c · ((1 − share) · of_start + share · of_start_later)).

    share = 1 − exp(−duration / WARMING_S) is the share of its final heat that a load reaches in the job. P is affine
    in the temperatures, so that the engine can update it each step.
    """

    evidence: Evidence
    offset: float
    at_once: tuple[float, ...]
    """Slope of the load at zero duration, >= 0, [joint]."""
    later: tuple[float, ...]
    """Additional slope of the load in an endless job, >= 0, [joint]."""
    of_log_duration: float
    """Slope of ln(duration in s), >= 0."""
    of_start: tuple[float, ...]
    """Slope of the temperatures known at the start at zero duration, 1/K, >= 0, [KNOWN]."""
    of_start_later: tuple[float, ...]
    """The same in an endless job."""

    @property
    def version(self) -> str:
        """Hash of this model; not cached, because msgspec would write a cached value into the file."""
        return hashlib.sha256(msgspec.json.encode(self)).hexdigest()[:16]

    def risk(self, features: Features, duration_s: Array) -> Forecast:
        """P as a function of the temperatures known at the start.

        Args:
            features: Of whole jobs, [..., joint, part].
            duration_s: > 0, [...].
        """
        share = _heating_share(duration_s)[..., None]
        slope = np.array(self.at_once) + share * np.array(self.later)
        load = (EVIDENCE[self.evidence](features) * slope).sum(axis=-1)
        offset = self.offset + load + self.of_log_duration * np.log(duration_s)
        of_known = (1.0 - share) * np.array(self.of_start) + share * np.array(self.of_start_later)
        return Forecast(offset[..., None], of_known[..., None, :])


def _heating_share(duration_s: Array) -> Array:
    """Share of its final heat that a load reaches in this time, [0, 1)."""
    return -np.expm1(-duration_s / WARMING_S)


def fit_regression(
    features: Features, duration_s: Array, known_c: Array, passed: Array, *, evidence: Evidence = "excess"
) -> LoadRegression:
    """P(saturation) fitted on past jobs. Deterministic.

    Regularised logistic regression on standardised columns, its strength by cross-validation. Temperatures, duration
    and load cannot make a job safer: their slopes are kept >= 0, which a few jobs might not show.

    Args:
        features: [job, joint, part].
        duration_s: [job].
        known_c: Temperatures known at the start, [job, KNOWN]; see `fleet.difficulty.known_temperatures`.
        passed: Whether a motor passed the limit, bool [job].

    Raises:
        NotEnoughExperience: too few jobs, or hardly any that passed the limit, or hardly any that did not.
    """
    count, some = len(passed), int(passed.sum())
    if count < LEAST_JOBS or min(some, count - some) < LEAST_OF_EACH:
        raise NotEnoughExperience(
            f"P(saturation) needs {LEAST_JOBS} past jobs, better 200, {LEAST_OF_EACH} in which a motor passed the "
            f"limit and {LEAST_OF_EACH} in which none did (got {count}; passed in {some}). Let the arm work first, "
            "simulate past jobs, or label the jobs by another limit."
        )
    load, share = EVIDENCE[evidence](features), _heating_share(duration_s)[:, None]
    x = np.column_stack([load, load * share, np.log(duration_s), (1.0 - share) * known_c, share * known_c])
    mean, std = x.mean(axis=0), x.std(axis=0)
    std = np.where(std > 1e-9 * np.maximum(np.abs(mean), 1e-9), std, np.inf)  # constant columns get no slope
    z = (x - mean) / std
    slope, offset = logistic(z, passed, _choose_strength(z, passed))
    slope = slope / std
    joints = load.shape[1]
    at_once, later, of_log_duration, of_start, of_start_later = np.split(slope, np.cumsum([joints, joints, 1, KNOWN]))
    return LoadRegression(
        evidence=evidence,
        offset=float(offset - slope @ mean),
        at_once=tuple(at_once.tolist()),
        later=tuple(later.tolist()),
        of_log_duration=float(of_log_duration[0]),
        of_start=tuple(of_start.tolist()),
        of_start_later=tuple(of_start_later.tolist()),
    )


def _choose_strength(z: Array, passed: Array) -> float:
    """The candidate with the least cross-validated log loss."""
    from sklearn.model_selection import StratifiedKFold  # slow import that a fleet with fitted models does not need

    folds = min(FOLDS, int(passed.sum()), int((~passed).sum()))
    held_out = np.empty((len(STRENGTHS), len(z)))
    for train, test in StratifiedKFold(folds, shuffle=True, random_state=0).split(z, passed):
        start = None
        for row, strength in enumerate(STRENGTHS):
            slope, offset = logistic(z[train], passed[train], strength, start)
            start = np.append(slope, offset)
            held_out[row, test] = z[test] @ slope + offset
    loss = np.logaddexp(0.0, np.where(passed, -held_out, held_out)).mean(axis=1)
    return STRENGTHS[int(loss.argmin())]


def logistic(z: Array, passed: Array, strength: float, start: Array | None = None) -> tuple[Array, float]:
    """Slopes >= 0, [column], and offset that minimise ½ |slope|² + strength · Σ log loss.

    scikit-learn's LogisticRegression has no such bounds.
    """
    sign = np.where(passed, 1.0, -1.0)

    def cost(w: Array) -> tuple[float, Array]:
        margin = sign * (z @ w[:-1] + w[-1])
        pull = -strength * sign * 0.5 * (1.0 - np.tanh(0.5 * margin))
        value = strength * np.logaddexp(0.0, -margin).sum() + 0.5 * w[:-1] @ w[:-1]
        return float(value), np.append(z.T @ pull + w[:-1], pull.sum())

    bounds = [(0.0, None)] * z.shape[1] + [(None, None)]
    first = np.zeros(z.shape[1] + 1) if start is None else start
    options = {"maxiter": 5000, "ftol": 1e-10, "gtol": 1e-6}
    solution = minimize(cost, first, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
    return solution[:-1], float(solution[-1])


class RegressionCard(msgspec.Struct, forbid_unknown_fields=True):
    """The content of `saturation.json`."""

    format: int
    version: str
    model: LoadRegression


def save_regression(model: LoadRegression, folder: Path) -> None:
    """Write the model atomically into a folder, made if need be."""
    write_card(RegressionCard(FORMAT, model.version, model), folder / FILE)


def load_regression(folder: Path) -> LoadRegression:
    """The model that `save_regression` wrote.

    Raises:
        CheckpointError: the file is missing or damaged, of another format, or not what was saved.
    """
    card = read_card(folder / FILE, RegressionCard, format_=FORMAT, what="saturation model")
    check_version(folder / FILE, card.version, card.model.version)
    return card.model
