"""P(saturation): how probable it is that a motor passes the warning limit during a job, begun as warm as now.

A logistic regression on what the twin sees in the job's motion, its duration, and the motor temperatures at its start;
fitted on the arm's own past jobs by `twin.calibrate`. Affine in the temperatures, so that a fleet can follow them.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import msgspec
import numpy as np

from fleet.difficulty import Difficulty, Risk
from fleet.errors import nearest
from fleet.motion import Plan
from twin.measures import Features
from twin.score import Twin

Array = np.ndarray

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
"""Evidence that counts only more load than known: more of it never makes a job safer."""


WARMING_S = 1500.0
"""How fast load becomes heat: between the modes of a Gen3's windings (150 to 290 s) and housings (1700 to 2700 s)."""


def evidence_of(features: Features, evidence: Evidence) -> Array:
    """What a model may read of each joint, [..., joint, column].

    `errors`: the error of each channel; `load`: the one-sided torque error; `excess`: the excess tau².
    """
    if evidence not in _COLUMNS:
        raise ValueError(f"No evidence '{evidence}'{nearest(evidence, _COLUMNS)}")
    return _COLUMNS[evidence](features)


@dataclass(frozen=True, kw_only=True)
class SaturationModel:
    """P = link(offset + evidence · (at_once + warmed · later) + ln(duration) · of_log_duration + temp_c · of_temp).

    warmed = 1 − exp(−duration / WARMING_S): what the load of a joint comes to by the end of the job.
    """

    twin: str
    """Version of the twin that it reads."""
    evidence: Evidence
    method: Method
    horizon_s: float | None
    """Only what happens so soon counts; None for the whole job."""
    offset: float
    at_once: tuple[tuple[float, ...], ...]
    """Of the evidence in however short a job, [joint][column]."""
    later: tuple[tuple[float, ...], ...]
    """Of the evidence, in addition, in an endless job, [joint][column]."""
    of_log_duration: float
    """>= 0, of ln(duration in s)."""
    of_temp: tuple[float, ...]
    """>= 0, 1/K, [joint]."""
    curve: tuple[tuple[float, float], ...] | None
    """Score and probability, as in `fleet.difficulty.Risk`; None for the logistic function."""
    data_hash: str
    """Name of the past jobs by their content."""
    jobs: int
    """How many past jobs it learned from."""
    passed: int
    """In how many of them a motor passed the limit."""
    strength: float
    """Inverse of the regularisation, chosen by cross-validation."""
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
        """Short name of this model by its content."""
        return self._content_hash

    @cached_property
    def _content_hash(self) -> str:
        content = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return hashlib.sha256(msgspec.json.encode(content)).hexdigest()[:16]

    def risk(self, features: Features, duration_s: Array | float) -> Risk:
        """P as it depends on the motor temperatures at the start.

        Args:
            features: Of whole jobs, [..., joint, part].
            duration_s: [...].

        Raises:
            ValueError: another number of joints, or a duration that is not > 0.
        """
        base = self._base(features, duration_s)
        weight = np.broadcast_to(self.of_temp, (*base.shape, 1, len(self.of_temp)))
        curve = None if self.curve is None else np.broadcast_to(self.curve, (*base.shape, len(self.curve), 2))
        return Risk(base[..., None], weight, curve)

    def score(self, features: Features, duration_s: Array | float, temp_c: Array) -> Array:
        """What the link turns into P, [...]: ranks jobs also where P rounds to 0 or 1.

        Args:
            features: Of whole jobs, [..., joint, part].
            duration_s: [...].
            temp_c: Motor temperatures as measured at the start, °C, [..., joint].
        """
        return self._base(features, duration_s) + np.asarray(temp_c, dtype=float) @ np.array(self.of_temp)

    def _base(self, features: Features, duration_s: Array | float) -> Array:
        """The score at 0 °C, [...]."""
        found, wanted = evidence_of(features, self.evidence), np.shape(self.at_once)
        if found.shape[-2:] != wanted:
            raise ValueError(f"This model reads {wanted} numbers [joint, column] of a job (got {found.shape[-2:]}).")
        heating_s = within(duration_s, self.horizon_s)
        slope = np.array(self.at_once) + warmed(heating_s)[..., None, None] * np.array(self.later)
        return self.offset + (found * slope).sum(axis=(-2, -1)) + self.of_log_duration * np.log(heating_s)


def warmed(duration_s: Array) -> Array:
    """Share of its final heat that a load reaches in so long, [0, 1)."""
    return -np.expm1(-duration_s / WARMING_S)


def within(duration_s: Array | float, horizon_s: float | None) -> Array:
    """How long jobs heat within the horizon, s, [...].

    Raises:
        ValueError: a duration that is not > 0.
    """
    duration = np.asarray(duration_s, dtype=float)
    right = (duration > 0) & np.isfinite(duration)
    if not right.all():
        raise ValueError(f"A job lasts > 0 s (got {duration[~right][:3]}).")
    return duration if horizon_s is None else np.minimum(duration, horizon_s)


@dataclass(frozen=True, eq=False)
class CalibratedTwin:
    """A twin that knows what its errors meant in the arm's past jobs; a `fleet.difficulty.DifficultyModel`."""

    twin: Twin
    saturation: SaturationModel

    def __post_init__(self) -> None:
        if self.saturation.twin != self.twin.version:
            raise ValueError(
                f"The saturation model was fitted on twin {self.saturation.twin}, this is {self.twin.version}; "
                "fit it anew on this twin's features."
            )

    @property
    def version(self) -> str:
        """Of the twin and of what it was calibrated to."""
        return f"{self.twin.version}+{self.saturation.version}"

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """d of the twin, with the risk of doing the plan so many times."""
        features = self.twin.features([plan], [repetitions])
        risk = self.saturation.risk(features, np.array([plan.duration_s(repetitions)]))[0]
        return Difficulty(features.difficulty[0], risk=risk)
