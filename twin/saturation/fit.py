"""Fit P(saturation) on an arm's past jobs: their features, their temperatures at the start, and their outcome."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import minimize

from fleet.difficulty import KNOWN
from fleet.errors import FleetError
from fleet.motion import Plan
from twin.saturation.model import (
    METHODS,
    ONE_SIDED,
    Evidence,
    Method,
    SaturationModel,
    evidence_of,
    heating_share,
    heating_time,
)
from twin.vae.measures import Features
from twin.vae.twin import Twin

Array = np.ndarray

LEAST_JOBS = 30
LEAST_OF_EACH = 5
"""Least jobs that passed the limit, and that did not: fewer cannot be cross-validated."""
FOLDS = 5
STRENGTHS = tuple(float(c) for c in np.logspace(-2, 2, 9))
"""Candidates for the inverse regularisation."""


class NotEnoughExperience(FleetError):
    """Too few past jobs to fit P(saturation)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Experience:
    """An arm's past jobs: features, duration, temperatures at the start, and whether a motor passed the limit."""

    twin: str
    """Version of the twin that computed the features."""
    features: Features
    """[job, joint, part]."""
    duration_s: Array
    """[job]."""
    known_c: Array
    """Temperatures known at the start, [job, KNOWN]; see `fleet.difficulty.known_temperatures`."""
    passed: Array
    """bool [job]."""

    def __post_init__(self) -> None:
        packed = self.features.packed
        jobs = (len(packed),)
        for name, shape in (("duration_s", jobs), ("known_c", (*jobs, KNOWN)), ("passed", jobs)):
            if getattr(self, name).shape != shape:
                raise ValueError(f"Experience.{name} must be {shape} (got {getattr(self, name).shape}).")
        if self.passed.dtype != bool:
            raise ValueError(f"Experience.passed must be bool (got {self.passed.dtype}).")
        for name, values in (("features", packed), ("duration_s", self.duration_s), ("known_c", self.known_c)):
            broken = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
            if len(broken):
                raise ValueError(
                    f"Experience.{name} must be finite; it is not for {len(broken)} of {len(values)} jobs, first job "
                    f"{broken[0]}. Leave those jobs out."
                )

    def __len__(self) -> int:
        return len(self.passed)

    @classmethod
    def of_jobs(
        cls, twin: Twin, plans: Sequence[Plan], repetitions: Sequence[int], *, known_c: Array, passed: Array
    ) -> "Experience":
        """The experience of jobs, each a repeated plan, [job]."""
        duration = [plan.duration_s(times) for plan, times in zip(plans, repetitions, strict=True)]
        return cls(
            twin=twin.version,
            features=twin.features(plans, repetitions),
            duration_s=np.array(duration),
            known_c=np.asarray(known_c, dtype=float),
            passed=np.asarray(passed),
        )

    def part(self, rows: Array) -> "Experience":
        """Some of the jobs, by index or mask."""
        arrays = {name: getattr(self, name)[rows] for name in ("duration_s", "known_c", "passed")}
        return Experience(twin=self.twin, features=Features(self.features.packed[rows]), **arrays)

    @cached_property
    def data_hash(self) -> str:
        """Hash of the jobs."""
        digest = hashlib.sha256(self.twin.encode())
        for values in (self.features.packed, self.duration_s, self.known_c, self.passed):
            digest.update(f"{values.dtype}{values.shape}".encode())
            digest.update(np.ascontiguousarray(values).tobytes())
        return digest.hexdigest()[:32]


def fit_saturation(
    past: Experience, *, evidence: Evidence = "excess", method: Method = "logistic", horizon_s: float | None = None
) -> SaturationModel:
    """P(saturation) fitted on past jobs. Deterministic.

    Regularised logistic regression on standardised columns, its strength by cross-validation. Temperatures, duration
    and one-sided evidence cannot make a job safer: their slopes are kept >= 0, which a few jobs might not show.

    Args:
        evidence: Features to use; see `twin.saturation.model.evidence_of`. The default has the least Brier score in
            `benchmarks/paper/saturation.py`, `errors` the largest.
        method: `isotonic` replaces the logistic function by a monotone curve fitted on cross-validated scores: for a
            few hundred jobs at least.
        horizon_s: Time after the start that `passed` covers; None for the whole job.

    Raises:
        NotEnoughExperience: too few jobs, or hardly any that passed the limit, or hardly any that did not.
        ValueError: an unknown method or evidence.
    """
    if method not in METHODS:
        raise ValueError(f"No method '{method}'. Allowed: {', '.join(METHODS)}.")
    check_outcomes(past.passed)
    x, rising = _design(past, evidence, horizon_s)
    mean, std = x.mean(axis=0), x.std(axis=0)
    std = np.where(std > 1e-9 * np.maximum(np.abs(mean), 1e-9), std, np.inf)  # constant columns get no slope
    z = (x - mean) / std
    strength, held_out = choose_strength(z, past.passed, rising)
    slope, offset = logistic(z, past.passed, rising, strength)
    slope = slope / std
    of_evidence, of_log_duration, *of_known = np.split(slope, [-2 * KNOWN - 1, -2 * KNOWN, -KNOWN])
    at_once, later = np.split(of_evidence.reshape(2 * past.features.packed.shape[1], -1), 2)
    return SaturationModel(
        twin=past.twin,
        evidence=evidence,
        method=method,
        horizon_s=horizon_s,
        offset=float(offset - slope @ mean),
        at_once=tuple(map(_floats, at_once)),
        later=tuple(map(_floats, later)),
        of_log_duration=float(of_log_duration[0]),
        of_start=_floats(of_known[0]),
        of_start_later=_floats(of_known[1]),
        curve=None if method == "logistic" else monotone_curve(held_out, past.passed),
        data_hash=past.data_hash,
        jobs=len(past),
        passed=int(past.passed.sum()),
        strength=strength,
        log_loss=float(nats(held_out, past.passed).mean()),
    )


def _design(past: Experience, evidence: Evidence, horizon_s: float | None) -> tuple[Array, Array]:
    """Columns [job, column] and whether their slope must be >= 0, bool [column]: the evidence, the evidence times the
    heating share, ln(duration), temperatures times the cooling share, and times the heating share."""
    columns = evidence_of(past.features, evidence).reshape(len(past), -1)
    heating_s = heating_time(past.duration_s, horizon_s)
    share = heating_share(heating_s)[:, None]
    known_c = past.known_c
    x = np.column_stack([columns, columns * share, np.log(heating_s), (1.0 - share) * known_c, share * known_c])
    return x, np.arange(x.shape[1]) >= (0 if evidence in ONE_SIDED else 2 * columns.shape[1])


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(values.tolist())


def check_outcomes(passed: Array) -> None:
    """Raise NotEnoughExperience if there are too few past jobs, or too few of one outcome; bool [job]."""
    count, some = len(passed), int(passed.sum())
    if count < LEAST_JOBS or min(some, count - some) < LEAST_OF_EACH:
        raise NotEnoughExperience(
            f"P(saturation) needs {LEAST_JOBS} past jobs, better 200, {LEAST_OF_EACH} in which a motor passed the "
            f"limit and {LEAST_OF_EACH} in which none did (got {count}; passed in {some}). Let the arm work first, "
            "simulate past jobs, or label the jobs by another limit."
        )


def choose_strength(z: Array, passed: Array, rising: Array) -> tuple[float, Array]:
    """The candidate with the least cross-validated log loss, and its held-out scores, [job]."""
    from sklearn.model_selection import StratifiedKFold  # slow import that a fleet with fitted models does not need

    folds = min(FOLDS, int(passed.sum()), int((~passed).sum()))
    held_out = np.empty((len(STRENGTHS), len(z)))
    for train, test in StratifiedKFold(folds, shuffle=True, random_state=0).split(z, passed):
        start = None
        for row, strength in enumerate(STRENGTHS):
            slope, offset = logistic(z[train], passed[train], rising, strength, start)
            start = np.append(slope, offset)
            held_out[row, test] = z[test] @ slope + offset
    best = int(nats(held_out, passed).mean(axis=1).argmin())
    return STRENGTHS[best], held_out[best]


def logistic(
    z: Array, passed: Array, rising: Array, strength: float, start: Array | None = None
) -> tuple[Array, float]:
    """Slopes [column] and offset that minimise ½ |slope|² + strength · Σ log loss, slopes of `rising` columns >= 0.

    scikit-learn's LogisticRegression has no such bounds; without them the result is the same.
    """
    sign = np.where(passed, 1.0, -1.0)

    def cost(w: Array) -> tuple[float, Array]:
        margin = sign * (z @ w[:-1] + w[-1])
        pull = -strength * sign * 0.5 * (1.0 - np.tanh(0.5 * margin))
        value = strength * np.logaddexp(0.0, -margin).sum() + 0.5 * w[:-1] @ w[:-1]
        return float(value), np.append(z.T @ pull + w[:-1], pull.sum())

    bounds = [(0.0 if r else None, None) for r in rising] + [(None, None)]
    first = np.zeros(z.shape[1] + 1) if start is None else start
    options = {"maxiter": 5000, "ftol": 1e-10, "gtol": 1e-6}
    solution = minimize(cost, first, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
    return solution[:-1], float(solution[-1])


def nats(score: Array, passed: Array) -> Array:
    """Log loss of logistic scores, [..., job]."""
    return np.logaddexp(0.0, np.where(passed, -score, score))


def monotone_curve(score: Array, passed: Array) -> tuple[tuple[float, float], ...]:
    """Isotonic regression of the outcome on held-out scores, as knots of a curve.

    It keeps a distance of 1/(n + 2) from 0 and 1 (Laplace's rule of succession for n jobs of one outcome).
    """
    from sklearn.isotonic import IsotonicRegression  # slow import

    fitted = IsotonicRegression(y_min=0.0, y_max=1.0, out_of_bounds="clip").fit(score, passed.astype(float))
    least = 1.0 / (len(score) + 2.0)
    knots = np.column_stack([fitted.X_thresholds_, np.clip(fitted.y_thresholds_, least, 1.0 - least)])
    return tuple((float(x), float(p)) for x, p in knots)
