"""P(saturation): the probability that a motor passes the warning limit during a job that starts now.

A logistic regression on the twin's features of the job, its duration, and the temperatures known at its start, fitted
on the arm's past jobs by `twin.p_saturation`. Its score is affine in the temperatures, so that the engine can update
it each step. Saved as `saturation.json`.

Fit P(saturation) on an arm's past jobs: their features, their temperatures at the start, and their outcome.

Reliability of stated probabilities: Brier score, calibration error, and the table of the reliability diagram.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

import msgspec
import numpy as np
from scipy.optimize import minimize
from scipy.stats import norm

from fleet.difficulty import KNOWN, Forecast
from fleet.errors import FleetError, nearest
from fleet.motion import Plan
from twin.json_file import check_version, read_card, write_card
from twin.vae.measures import Features
from twin.vae.twin import Twin

Array = np.ndarray

FORMAT = 2
FILE = "saturation.json"

Evidence = Literal["errors", "load", "excess", "torque"]
Method = Literal["logistic", "isotonic"]
EVIDENCE: tuple[Evidence, ...] = get_args(Evidence)
METHODS: tuple[Method, ...] = get_args(Method)

_COLUMNS: Mapping[str, Callable[[Features], Array]] = {
    "errors": lambda features: features.errors,
    "load": lambda features: features.one_sided[..., None],
    "excess": lambda features: features.excess_sq[..., None],
    "torque": lambda features: features.torque_sq[..., None],
}
ONE_SIDED: tuple[Evidence, ...] = ("load", "excess", "torque")
"""Evidence that counts load: more of it never makes a job safer."""

WARMING_S = 1500.0
"""Time constant of heating: between those of a Gen3's windings (150 to 290 s) and housings (1700 to 2700 s)."""


def evidence_of(features: Features, evidence: Evidence) -> Array:
    """Inputs of a model per joint, [..., joint, column].

    `errors`: the error of each channel; `load`: the one-sided torque error; `excess`: the excess tau²;
    `torque`: the mean tau², without any reconstruction.
    """
    if evidence not in _COLUMNS:
        raise ValueError(f"No evidence '{evidence}'{nearest(evidence, _COLUMNS)}")
    return _COLUMNS[evidence](features)


@dataclass(frozen=True, kw_only=True)
class SaturationModel:
    """P = link(offset + evidence · (at_once + share · later) + ln(duration) · of_log_duration
    + known_c · ((1 − share) · of_start + share · of_start_later)).

    share = 1 − exp(−duration / WARMING_S) is the share of its final heat that a load reaches in the job.
    """

    twin: str
    """Version of the twin whose features it uses."""
    evidence: Evidence
    method: Method
    horizon_s: float | None
    """Time after the start that counts; None for the whole job."""
    offset: float
    at_once: tuple[tuple[float, ...], ...]
    """Slope of the evidence at zero duration, [joint][column]."""
    later: tuple[tuple[float, ...], ...]
    """Additional slope of the evidence in an endless job, [joint][column]."""
    of_log_duration: float
    """Slope of ln(duration in s), >= 0."""
    of_start: tuple[float, ...]
    """Slope of the temperatures known at the start at zero duration, 1/K, >= 0, [KNOWN]."""
    of_start_later: tuple[float, ...]
    """The same in an endless job."""
    curve: tuple[tuple[float, float], ...] | None
    """Score and probability, as in `fleet.difficulty.Forecast`; None for the logistic function."""
    data_hash: str
    """Hash of the past jobs."""
    jobs: int
    """Number of past jobs."""
    passed: int
    """Number of past jobs in which a motor passed the limit."""
    strength: float
    """Inverse regularisation, chosen by cross-validation."""
    log_loss: float
    """Cross-validated, nats per job."""

    def __post_init__(self) -> None:
        if self.evidence not in _COLUMNS or self.method not in METHODS:
            raise ValueError(
                f"SaturationModel needs evidence of {', '.join(_COLUMNS)} and method of {', '.join(METHODS)} "
                f"(got {self.evidence}, {self.method})."
            )
        if len(self.at_once) != len(self.later) or not self.later:
            joints = [len(self.at_once), len(self.later)]
            raise ValueError(f"SaturationModel.at_once and later must have one entry per joint (got {joints}).")
        if not len(self.of_start) == len(self.of_start_later) == KNOWN:
            known = [len(self.of_start), len(self.of_start_later)]
            raise ValueError(f"SaturationModel.of_start and of_start_later must have {KNOWN} entries (got {known}).")
        slopes = [w for row in self.at_once + self.later for w in row]
        rising = [self.of_log_duration, *self.of_start, *self.of_start_later]
        if not np.isfinite([self.offset, *rising, *slopes]).all() or min(rising) < 0:
            raise ValueError("SaturationModel needs finite numbers, and no slope of temperature or duration below 0.")

    @property
    def version(self) -> str:
        """Hash of this model; not cached, because msgspec would write a cached value into the file."""
        return hashlib.sha256(msgspec.json.encode(self)).hexdigest()[:16]

    def risk(self, features: Features, duration_s: Array | float) -> Forecast:
        """P as a function of the temperatures known at the start.

        Args:
            features: Of whole jobs, [..., joint, part].
            duration_s: [...].

        Raises:
            ValueError: another number of joints, or a duration that is not > 0.
        """
        base = self._base(features, duration_s)
        curve = None if self.curve is None else np.broadcast_to(self.curve, (*base.shape, len(self.curve), 2))
        return Forecast(base[..., None], self._of_known(duration_s)[..., None, :], curve)

    def score(self, features: Features, duration_s: Array | float, known_c: Array) -> Array:
        """The argument of the link, [...]: ranks jobs also where P rounds to 0 or 1.

        Args:
            features: Of whole jobs, [..., joint, part].
            duration_s: [...].
            known_c: Temperatures known at the start, °C, [..., KNOWN].
        """
        return self._base(features, duration_s) + (np.asarray(known_c) * self._of_known(duration_s)).sum(axis=-1)

    def _of_known(self, duration_s: Array | float) -> Array:
        """Slope of the temperatures known at the start, 1/K, [..., KNOWN]."""
        share = heating_share(heating_time(duration_s, self.horizon_s))[..., None]
        return (1.0 - share) * np.array(self.of_start) + share * np.array(self.of_start_later)

    def _base(self, features: Features, duration_s: Array | float) -> Array:
        """The score at 0 °C, [...]."""
        evidence, wanted = evidence_of(features, self.evidence), np.shape(self.at_once)
        if evidence.shape[-2:] != wanted:
            raise ValueError(f"This model needs {wanted} numbers [joint, column] of a job (got {evidence.shape[-2:]}).")
        heating_s = heating_time(duration_s, self.horizon_s)
        slope = np.array(self.at_once) + heating_share(heating_s)[..., None, None] * np.array(self.later)
        return self.offset + (evidence * slope).sum(axis=(-2, -1)) + self.of_log_duration * np.log(heating_s)


def heating_share(duration_s: Array) -> Array:
    """Share of its final heat that a load reaches in this time, [0, 1)."""
    return -np.expm1(-duration_s / WARMING_S)


def heating_time(duration_s: Array | float, horizon_s: float | None) -> Array:
    """Duration of jobs within the horizon, s, [...].

    Raises:
        ValueError: a duration that is not > 0.
    """
    duration = np.asarray(duration_s, dtype=float)
    valid = (duration > 0) & np.isfinite(duration)
    if not valid.all():
        raise ValueError(f"A job lasts > 0 s (got {duration[~valid][:3]}).")
    return duration if horizon_s is None else np.minimum(duration, horizon_s)


class _Card(msgspec.Struct, forbid_unknown_fields=True):
    """The content of `saturation.json`."""

    format: int
    version: str
    model: SaturationModel


def save_saturation(model: SaturationModel, folder: Path) -> None:
    """Write the model atomically into the folder of its twin, made if need be."""
    write_card(_Card(FORMAT, model.version, model), folder / FILE)


def load_saturation(folder: Path) -> SaturationModel:
    """The model that `save_saturation` wrote, with the same probabilities to the last bit.

    Raises:
        CheckpointError: the file is missing or damaged, of another format, or not what was saved.
    """
    card = read_card(folder / FILE, _Card, format_=FORMAT, what="saturation model")
    check_version(folder / FILE, card.version, card.model.version)
    return card.model


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
        evidence: Features to use; see `twin.p_saturation.evidence_of`. The default has the least Brier score in
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


BINS = 10
"""Default number of bins of equal mass."""


@dataclass(frozen=True, eq=False)
class Reliability:
    """Stated probabilities against outcomes, by bins of equal mass without those that ties leave empty."""

    mean_p: Array
    """Mean stated probability, [bin], ascending."""
    share: Array
    """Share of jobs with the event, [bin]."""
    count: Array
    """Jobs, int [bin]."""
    low: Array
    """Lower end of the Wilson interval of the share, [bin]."""
    high: Array
    """Upper end, [bin]."""

    @property
    def error(self) -> float:
        """Expected calibration error: mean over jobs of |share − stated probability| of their bin (Naeini et al.,
        AAAI 2015, with bins of equal mass)."""
        return float(np.average(np.abs(self.share - self.mean_p), weights=self.count))


def reliability(p: Array, event: Array, *, bins: int = BINS, confidence: float = 0.95) -> Reliability:
    """The reliability table of stated probabilities [job] against outcomes, bool [job].

    Raises:
        ValueError: no jobs, unequal lengths, or probabilities outside [0, 1].
    """
    p, event = _checked(p, event)
    if bins < 1:
        raise ValueError(f"A reliability table needs at least one bin (got {bins}).")
    edges = np.percentile(p, np.linspace(0.0, 1.0, bins + 1) * 100)  # rounds as scikit-learn does
    of_job = np.searchsorted(edges[1:-1], p)
    count = np.bincount(of_job, minlength=bins)
    filled = count > 0
    some = np.maximum(count, 1)
    share = np.bincount(of_job, weights=event, minlength=bins) / some
    mean_p = np.bincount(of_job, weights=p, minlength=bins) / some
    low, high = wilson(share[filled], count[filled], confidence)
    return Reliability(mean_p[filled], share[filled], count[filled], low, high)


def wilson(share: Array, count: Array, confidence: float = 0.95) -> tuple[Array, Array]:
    """Confidence interval of a probability from the share of `count` draws (Wilson, JASA 22, 1927), both ends."""
    z = float(norm.ppf(0.5 + 0.5 * confidence))
    middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * np.sqrt(share * (1 - share) / count + z**2 / (4 * count**2))
    return np.clip(middle - half, 0.0, 1.0), np.clip(middle + half, 0.0, 1.0)


def brier(p: Array, event: Array) -> float:
    """Mean squared distance of stated probabilities [job] from outcomes, bool [job]; 0 is perfect."""
    p, event = _checked(p, event)
    return float(np.mean(np.square(p - event)))


def _checked(p: Array, event: Array) -> tuple[Array, Array]:
    p, event = np.asarray(p, dtype=float), np.asarray(event)
    if p.ndim != 1 or p.shape != event.shape or len(p) == 0:
        raise ValueError(f"Probabilities and events must be [job], at least one (got {p.shape}, {event.shape}).")
    if not ((p >= 0) & (p <= 1)).all():
        raise ValueError("Probabilities must lie in [0, 1].")
    return p, event.astype(bool).astype(float)
