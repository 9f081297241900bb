"""P(saturation): the probability that a motor passes the warning limit during a job that starts now.

A logistic regression on the twin's features of the job, its duration, and the temperatures known at its start, fitted
on the arm's past jobs by `twin.saturation.fit`. Its score is affine in the temperatures, so that the engine can update
it each step. Saved as `saturation.json`.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import msgspec
import numpy as np

from fleet.difficulty import KNOWN, Forecast
from fleet.errors import nearest
from twin.json_file import check_version, read_card, write_card
from twin.vae.measures import Features

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
