"""P(saturation): the probability that a motor passes the warning limit during a job that starts now.

A logistic regression on the twin's features of the job, its duration, and the motor temperatures at its start, fitted
on the arm's past jobs by `twin.saturation.fit`. Its score is affine in the temperatures, so that the engine can update
it each step. Saved beside its twin as `saturation.json`.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import msgspec
import numpy as np

from fleet.difficulty import KNOWN, Difficulty, Forecast
from fleet.errors import CheckpointError, nearest
from fleet.motion import Plan
from twin.json_file import check_version, read_card, write_card
from twin.vae.measures import Features
from twin.vae.twin import Twin

Array = np.ndarray

FORMAT = 1
FILE = "saturation.json"

Evidence = Literal["errors", "load", "excess"]
Method = Literal["logistic", "isotonic"]
EVIDENCE: tuple[Evidence, ...] = get_args(Evidence)
METHODS: tuple[Method, ...] = get_args(Method)

_COLUMNS: Mapping[str, Callable[[Features], Array]] = {
    "errors": lambda features: features.errors,
    "load": lambda features: features.one_sided[..., None],
    "excess": lambda features: features.excess_sq[..., None],
}
ONE_SIDED: tuple[Evidence, ...] = ("load", "excess")
"""Evidence that counts only load above the reconstruction: more of it never makes a job safer."""

WARMING_S = 1500.0
"""Time constant of heating: between those of a Gen3's windings (150 to 290 s) and housings (1700 to 2700 s)."""


def evidence_of(features: Features, evidence: Evidence) -> Array:
    """Inputs of a model per joint, [..., joint, column].

    `errors`: the error of each channel; `load`: the one-sided torque error; `excess`: the excess tau².
    """
    if evidence not in _COLUMNS:
        raise ValueError(f"No evidence '{evidence}'{nearest(evidence, _COLUMNS)}")
    return _COLUMNS[evidence](features)


@dataclass(frozen=True, kw_only=True)
class SaturationModel:
    """P = link(offset + evidence · (at_once + share · later) + ln(duration) · of_log_duration + temp_c · of_temp).

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
    of_temp: tuple[float, ...]
    """Slope of the temperatures, 1/K, >= 0, [joint]."""
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
        joints = [len(self.at_once), len(self.later), len(self.of_temp)]
        if len(set(joints)) != 1 or not self.of_temp:
            raise ValueError(
                f"SaturationModel.at_once, later and of_temp must have one entry per joint (got {joints})."
            )
        slopes = [w for row in self.at_once + self.later for w in row]
        numbers = [self.offset, self.of_log_duration, *self.of_temp, *slopes]
        if not np.isfinite(numbers).all() or min(self.of_log_duration, *self.of_temp) < 0:
            raise ValueError("SaturationModel needs finite numbers, and no slope of temperature or duration below 0.")

    @property
    def version(self) -> str:
        """Hash of this model; not cached, because msgspec would write a cached value into the file."""
        return hashlib.sha256(msgspec.json.encode(self)).hexdigest()[:16]

    def risk(self, features: Features, duration_s: Array | float) -> Forecast:
        """P as a function of the motor temperatures at the start.

        Args:
            features: Of whole jobs, [..., joint, part].
            duration_s: [...].

        Raises:
            ValueError: another number of joints, or a duration that is not > 0.
        """
        base = self._base(features, duration_s)
        weight = np.zeros((*base.shape, 1, KNOWN))
        weight[..., : len(self.of_temp)] = self.of_temp
        curve = None if self.curve is None else np.broadcast_to(self.curve, (*base.shape, len(self.curve), 2))
        return Forecast(base[..., None], weight, curve)

    def score(self, features: Features, duration_s: Array | float, temp_c: Array) -> Array:
        """The argument of the link, [...]: ranks jobs also where P rounds to 0 or 1.

        Args:
            features: Of whole jobs, [..., joint, part].
            duration_s: [...].
            temp_c: Motor temperatures as measured at the start, °C, [..., joint].
        """
        return self._base(features, duration_s) + np.asarray(temp_c, dtype=float) @ np.array(self.of_temp)

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


@dataclass(frozen=True, eq=False)
class CalibratedTwin:
    """A twin with P(saturation); implements `fleet.difficulty.DifficultyModel`."""

    twin: Twin
    saturation: SaturationModel

    def __post_init__(self) -> None:
        if self.saturation.twin != self.twin.version:
            raise ValueError(
                f"The saturation model was fitted on twin {self.saturation.twin}, this is {self.twin.version}; "
                "fit it again on this twin's features."
            )

    @property
    def version(self) -> str:
        """Version of the twin and of the saturation model."""
        return f"{self.twin.version}+{self.saturation.version}"

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """Difficulty by the twin, with the risk of the repeated plan."""
        features = self.twin.features([plan], [repetitions])
        risk = self.saturation.risk(features, np.array([plan.duration_s(repetitions)]))[0]
        return Difficulty(features.difficulty[0], risk=risk)


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


def load_calibrated(twin: Twin, folder: Path, *, data_hash: str | None = None) -> CalibratedTwin:
    """The twin with the model that was saved in the folder.

    Args:
        data_hash: `Experience.data_hash` of the past jobs that the model must come from; None takes any.

    Raises:
        CheckpointError: as `load_saturation`, or the model is of another twin or of other past jobs.
    """
    model = load_saturation(folder)
    for what, value, wanted in (
        ("twin", model.twin, twin.version),
        ("data_hash", model.data_hash, data_hash or model.data_hash),
        ("joints", len(model.of_temp), twin.joints),
    ):
        if value != wanted:
            raise CheckpointError(f"{folder / FILE}: {what} is {value}, wanted {wanted}. Fit the model again.")
    return CalibratedTwin(twin, model)
