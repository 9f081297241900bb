"""What a twin's errors say of a job: how unusual, in which joint, why, and how many cool jobs are as unusual.

The paper's difficulty d_k is in `fleet.difficulty`. Its floor is far from zero, since a latent of two numbers never
tells a window whole; what stands here measures from what is usual in held-out cool jobs instead.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fleet.difficulty import difficulty_of_error
from fleet.errors import nearest
from fleet.motion import CHANNELS
from twin.conformal import p_value

Array = np.ndarray

ERROR_CAP = 30.0
"""Beyond this e_k, 1 − exp(−e_k) rounds to one; d_k stays below it."""
LEAST_SPREAD = 0.01
"""Least p95 − median of a joint's error, z units: below it, held-out jobs differ by rounding and sensor noise."""
TAU = CHANNELS.index("tau")
PARTS = len(CHANNELS) + 2
"""Numbers per joint in packed features: the error of each channel, the one-sided torque error, the excess tau²."""
TIE = 1e-5
"""Relative difference below which two scores are equal: the last digits of float32 depend on how many plans went
through the networks together, and counting a tie as higher keeps the p-value valid."""


@dataclass(frozen=True, eq=False)
class Features:
    """How far motion is from what a twin makes of it, time means; any leading axes, such as [job]."""

    packed: Array
    """[..., joint, part]: the three channels' errors, the one-sided torque error, the excess tau²."""

    def __post_init__(self) -> None:
        if self.packed.ndim < 2 or self.packed.shape[-1] != PARTS:
            raise ValueError(f"Features.packed must be [..., joint, {PARTS}] (got {self.packed.shape}).")

    @property
    def errors(self) -> Array:
        """|x − x̂| in training standard deviations, [..., joint, channel]."""
        return self.packed[..., : len(CHANNELS)]

    @property
    def one_sided(self) -> Array:
        """max(0, |tau| − |tau_hat|) in training standard deviations: only more load than known, [..., joint]."""
        return self.packed[..., len(CHANNELS)]

    @property
    def excess_sq(self) -> Array:
        """max(0, tau² − tau_hat²), (N·m)², [..., joint]: what heats a motor beyond what is known."""
        return self.packed[..., len(CHANNELS) + 1]

    @property
    def difficulty(self) -> Array:
        """d_k = 1 − exp(−e_k) with e_k the error summed over channels, [..., joint], each in [0, 1)."""
        return _saturated(self.errors.sum(axis=-1))

    @property
    def load(self) -> Array:
        """One-sided torque difficulty 1 − exp(−one-sided error), [..., joint], each in [0, 1)."""
        return _saturated(self.one_sided)


@dataclass(frozen=True, eq=False)
class Calibration:
    """What is usual: the features of held-out cool jobs, none of which the twin was trained on."""

    reference: Features
    """[job, joint, part]."""

    def __post_init__(self) -> None:
        if self.reference.packed.ndim != 3 or len(self.reference.packed) < 2:
            raise ValueError(
                "A calibration needs the features of two or more held-out cool jobs, better a hundred "
                f"(got shape {self.reference.packed.shape})."
            )

    @cached_property
    def floor(self) -> Array:
        """Median e_k of the cool jobs, [joint]."""
        return np.median(self.reference.errors.sum(axis=-1), axis=0)

    @cached_property
    def spread(self) -> Array:
        """From the median to the 95th percentile of e_k, at least `LEAST_SPREAD`, [joint]."""
        high = np.percentile(self.reference.errors.sum(axis=-1), 95, axis=0)
        return np.maximum(high - self.floor, LEAST_SPREAD)

    @cached_property
    def usual(self) -> Array:
        """Median error of each channel, [joint, channel]."""
        return np.median(self.reference.errors, axis=0)

    def difficulty(self, features: Features) -> Array:
        """1 − exp(−ln 2 · max(0, e_k − median) / (p95 − median)), [..., joint].

        Zero for half of the cool jobs, one half at their 95th percentile, towards one far beyond.
        """
        beyond = np.maximum(features.errors.sum(axis=-1) - self.floor, 0.0) / self.spread
        return _saturated(np.log(2) * beyond)

    def p_value(self, features: Features, score: str) -> Array:
        """Share of cool jobs that score as high, [...]: (1 + #{reference ≥ s}) / (n + 1).

        If a new cool job is exchangeable with those of the calibration, this is ≤ α with probability ≤ α, for every α
        (split conformal; Vovk, Gammerman & Shafer, Algorithmic Learning in a Random World, 2005, prop. 2.8; one-class:
        Bates et al., Annals of Statistics 51, 2023). It says nothing of motions that are new and light.
        """
        asked = score_of(features, score, self)
        return p_value(self._sorted(score), asked - TIE * np.abs(asked))

    def _sorted(self, score: str) -> Array:
        return np.sort(score_of(self.reference, score, self))


@dataclass(frozen=True, eq=False, kw_only=True)
class Measures:
    """Everything a twin says of one job, or of many with a leading axis [job]."""

    difficulty: Array
    """d_k of the paper, [joint]; their sum is d."""
    calibrated: Array | None
    """Floor-shifted d_k, ~0 for normal and towards 1 for critical, [joint]; None without a calibration."""
    load: Array
    """One-sided torque difficulty, [joint]: counts only more torque than known."""
    shares: Array
    """Why: each joint's and channel's share of the error beyond the usual (of all error, without a calibration),
    [joint, channel]. Sums to one, or to zero where nothing is beyond the usual."""
    heavier: Array
    """Whether a joint's torque error is mostly more load than known, bool [joint]."""
    p_value: Array | None
    """Conformal p-value, scalar; None without a calibration."""
    version: str
    """Of the twin that says so, for the digital thread."""

    @property
    def total(self) -> Array:
        """d = Σ_k d_k, scalar."""
        return self.difficulty.sum(axis=-1)

    def of_job(self, i: int) -> "Measures":
        """Those of one of many jobs."""
        if self.difficulty.ndim < 2:
            raise ValueError("These are the measures of one job.")
        return Measures(
            difficulty=self.difficulty[i],
            calibrated=None if self.calibrated is None else self.calibrated[i],
            load=self.load[i],
            shares=self.shares[i],
            heavier=self.heavier[i],
            p_value=None if self.p_value is None else self.p_value[i],
            version=self.version,
        )

    def why(self, most: int = 2) -> str:
        """The largest reasons of one job in words, `joint 2: more load (61 %), joint 4: a new place (20 %)`."""
        if self.shares.ndim != 2:
            raise ValueError("Ask for the reasons of one job: measures.of_job(i).why().")
        order = np.argsort(-self.shares, axis=None, kind="stable")[:most]
        places = [divmod(int(flat), len(CHANNELS)) for flat in order if self.shares.flat[flat] > 0]
        said = [f"joint {j + 1}: {self._word(j, c)} ({self.shares[j, c]:.0%})".replace("%)", " %)") for j, c in places]
        return ", ".join(said) or "nothing beyond the usual"

    def _word(self, joint: int, channel: int) -> str:
        if channel == TAU:
            return "more load" if self.heavier[joint] else "another load"
        return ("a new place", "a new speed")[channel]


def measures_of(features: Features, calibration: Calibration | None, *, score: str, version: str) -> Measures:
    """Measures of features with any leading axes; `score` is what the conformal p-value ranks jobs by."""
    beyond = features.errors
    if calibration is not None:
        beyond = np.maximum(beyond - calibration.usual, 0.0)
    whole = beyond.sum(axis=(-2, -1), keepdims=True)
    return Measures(
        difficulty=features.difficulty,
        calibrated=None if calibration is None else calibration.difficulty(features),
        load=features.load,
        shares=np.divide(beyond, whole, out=np.zeros_like(beyond), where=whole > 0),
        heavier=features.one_sided > 0.5 * features.errors[..., TAU],
        p_value=None if calibration is None else calibration.p_value(features, score),
        version=version,
    )


def score_of(features: Features, score: str, calibration: Calibration | None = None) -> Array:
    """One number per job, [...]: any of `SCORES`, or `joint_k` for d of joint k alone, counted from one.

    Raises:
        ValueError: another name, or `calibrated_…` without a calibration.
    """
    if score in SCORES:
        return SCORES[score](features)
    if score in _CALIBRATED:
        if calibration is None:
            raise ValueError(f"The score '{score}' needs a twin with a calibration: Twin.calibrated.")
        return _CALIBRATED[score](calibration.difficulty(features))
    joints = {f"joint_{k + 1}": k for k in range(features.packed.shape[-2])}
    if score in joints:
        return features.difficulty[..., joints[score]]
    raise ValueError(f"No score '{score}'{nearest(score, [*SCORES, *_CALIBRATED, *joints])}")


SCORES: Mapping[str, Callable[[Features], Array]] = {
    "sum": lambda features: features.difficulty.sum(axis=-1),
    "max": lambda features: features.difficulty.max(axis=-1),
    "load": lambda features: features.load.sum(axis=-1),
    "load_max": lambda features: features.load.max(axis=-1),
    "excess": lambda features: features.excess_sq.sum(axis=-1),
}
"""d of the paper; its largest joint; the same of the one-sided torque difficulty; the excess tau² of all joints."""
_CALIBRATED: Mapping[str, Callable[[Array], Array]] = {
    "calibrated_sum": lambda difficulty: difficulty.sum(axis=-1),
    "calibrated_max": lambda difficulty: difficulty.max(axis=-1),
}


def _saturated(error: Array) -> Array:
    return difficulty_of_error(np.minimum(error, ERROR_CAP))
