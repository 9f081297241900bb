"""Measures of a job from a twin's errors: difficulty per joint, its cause, and a p-value against cool jobs.

p-values are those of split conformal prediction: Vovk, Gammerman & Shafer, Algorithmic Learning in a Random World,
2005, prop. 2.8.

The paper's difficulty d_k is in `fleet.difficulty`. It is far from zero even for normal jobs, since a latent of two
numbers cannot encode a window exactly. The calibrated measures start from the median of held-out cool jobs instead.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fleet.difficulty import difficulty_of_error
from fleet.motion import CHANNELS

Array = np.ndarray


def p_value(ordered: Array, score: Array) -> Array:
    """(1 + #{reference ≥ score}) / (n + 1) of each score, in (0, 1], same shape as the scores.

    For a job exchangeable with the reference it is ≤ α with probability ≤ α, for every α.

    Args:
        ordered: Scores of the n reference jobs, ascending, [job].
    """
    at_least = len(ordered) - np.searchsorted(ordered, score, side="left")
    return (1.0 + at_least) / (len(ordered) + 1.0)


def largest_p_value(reference: Array, group: Array, score: Array) -> Array:
    """The largest of the p-values against each group of reference jobs, same shape as the scores.

    It is valid for a job that is exchangeable with the jobs of any one group, whichever that is.

    Args:
        reference: Scores of the reference jobs, [job].
        group: Group of each, int [job].
    """
    return np.max([p_value(np.sort(reference[group == g]), score) for g in np.unique(group)], axis=0)


def fewest(alpha: float) -> int:
    """Fewest reference jobs with which any p-value can be ≤ α."""
    return int(np.ceil(1 / alpha - 1 - 1e-9))


ERROR_CAP = 30.0
"""Beyond this e_k, 1 − exp(−e_k) rounds to one; d_k stays below it."""
LEAST_SPREAD = 0.01
"""Least p95 − median of a joint's error, z units: below it, held-out jobs differ by rounding and sensor noise."""
TAU = CHANNELS.index("tau")
PARTS = len(CHANNELS) + 3
"""First numbers per joint in packed features: error of each channel, one-sided torque error, excess tau², tau². The
time means of mu and of the upper triangle of mu muᵀ may follow, mu the posterior mean of the joint's network."""
LEAST_VARIANCE = 1e-4
"""Added to the variances of the latent cluster: a unit that is not used does not vary."""
TIE = 1e-5
"""Scores closer than this relative difference are equal: the last digits of float32 depend on the batch, and counting
a tie as higher keeps the p-value valid."""


@dataclass(frozen=True, eq=False)
class Features:
    """Reconstruction errors of motion, time means; any leading axes, such as [job]."""

    packed: Array
    """[..., joint, part]; see `PARTS`."""

    def __post_init__(self) -> None:
        if self.packed.ndim < 2 or self.packed.shape[-1] != PARTS + moments(self.latent):
            raise ValueError(
                f"Features.packed must be [..., joint, {PARTS} + moments of the latent] (got {self.packed.shape})."
            )

    @property
    def latent(self) -> int:
        """Latent units of which the moments are known."""
        extra = max(0, self.packed.shape[-1] - PARTS)
        return int((np.sqrt(9 + 8 * extra) - 3) // 2)

    @property
    def errors(self) -> Array:
        """|x − x̂| in training standard deviations, [..., joint, channel]."""
        return self.packed[..., : len(CHANNELS)]

    @property
    def one_sided(self) -> Array:
        """max(0, |tau| − |tau_hat|) in training standard deviations, [..., joint]: torque above the reconstruction."""
        return self.packed[..., len(CHANNELS)]

    @property
    def excess_sq(self) -> Array:
        """max(0, tau² − tau_hat²), (N·m)², [..., joint]: torque that heats beyond the reconstruction."""
        return self.packed[..., len(CHANNELS) + 1]

    @property
    def torque_sq(self) -> Array:
        """tau², (N·m)², [..., joint]; owes nothing to the reconstruction."""
        return self.packed[..., len(CHANNELS) + 2]

    @property
    def difficulty(self) -> Array:
        """d_k = 1 − exp(−e_k) with e_k the error summed over channels, [..., joint], each in [0, 1)."""
        return _saturated(self.errors.sum(axis=-1))

    @property
    def load(self) -> Array:
        """One-sided torque difficulty 1 − exp(−one-sided error), [..., joint], each in [0, 1)."""
        return _saturated(self.one_sided)

    @property
    def latent_moments(self) -> tuple[Array, Array]:
        """Time means of mu, [..., joint, latent], and of mu muᵀ, [..., joint, latent, latent]."""
        size = self.latent
        mean, second = np.split(self.packed[..., PARTS:], [size], axis=-1)
        square = np.empty((*mean.shape, size))
        rows, columns = np.triu_indices(size)
        square[..., rows, columns] = square[..., columns, rows] = second
        return mean, square


def moments(latent: int) -> int:
    """Number of latent moments in packed features: means, and the upper triangle of the second moments."""
    return latent * (latent + 3) // 2


def latent_moments(mu: Array) -> Array:
    """mu and the upper triangle of mu muᵀ of posterior means [..., latent], [..., moment]."""
    rows, columns = np.triu_indices(mu.shape[-1])
    return np.concatenate([mu, mu[..., rows] * mu[..., columns]], axis=-1)


@dataclass(frozen=True, eq=False)
class Calibration:
    """The features of held-out cool jobs, on none of which the twin was trained."""

    reference: Features
    """[job, joint, part]."""
    group: Array
    """Kind of each job, int [job]: the jobs of one kind are exchangeable, those of different kinds need not be."""

    def __post_init__(self) -> None:
        if self.group.shape != self.reference.packed.shape[:1]:
            raise ValueError(
                f"A calibration needs one group per job (got {self.group.shape} for {self.reference.packed.shape})."
            )
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
        """95th percentile minus median of e_k, at least `LEAST_SPREAD`, [joint]."""
        high = np.percentile(self.reference.errors.sum(axis=-1), 95, axis=0)
        return np.maximum(high - self.floor, LEAST_SPREAD)

    @cached_property
    def usual(self) -> Array:
        """Median error of each channel, [joint, channel]."""
        return np.median(self.reference.errors, axis=0)

    def difficulty(self, features: Features) -> Array:
        """1 − exp(−ln 2 · max(0, e_k − median) / (p95 − median)), [..., joint].

        Zero for half of the cool jobs, one half at their 95th percentile, almost one far beyond.
        """
        beyond = np.maximum(features.errors.sum(axis=-1) - self.floor, 0.0) / self.spread
        return _saturated(np.log(2) * beyond)

    @cached_property
    def cluster(self) -> tuple[Array, Array]:
        """Centre [joint, latent] and inverse covariance [joint, latent, latent] of the cool jobs' latents."""
        mean, second = (each.mean(axis=0) for each in self.reference.latent_moments)
        covariance = second - mean[..., None] * mean[..., None, :]
        return mean, np.linalg.inv(covariance + LEAST_VARIANCE * np.eye(mean.shape[-1]))

    def latent(self, features: Features) -> Array:
        """RMS Mahalanobis distance of the motion's latents from the cluster of the cool jobs, [..., joint].

        Over all windows of these cool jobs its mean square is the number of latent units. Zero without latents.
        """
        (centre, inverse), (mean, second) = self.cluster, features.latent_moments
        square = (
            np.einsum("jab,...jab->...j", inverse, second)
            - 2 * np.einsum("jab,ja,...jb->...j", inverse, centre, mean)
            + np.einsum("jab,ja,jb->j", inverse, centre, centre)
        )
        return np.sqrt(np.maximum(square, 0.0))

    def p_value(self, features: Features, weight: Array, reading: str = "load") -> Array:
        """Largest p-value against the kinds of cool jobs, [...]; see `twin.vae.measures.largest_p_value`.

        Valid for a job exchangeable with the cool jobs of one kind (one-class: Bates et al., Annals of Statistics 51,
        2023).

        Args:
            weight: w_k of the joints, [joint].
            reading: One of `READINGS`.
        """
        reference, scores = (READINGS[reading](each, self) @ weight for each in (self.reference, features))
        return largest_p_value(reference, self.group, scores - TIE * np.abs(scores))

    @property
    def smallest_group(self) -> int:
        """Number of jobs of the kind with the fewest."""
        return int(np.unique(self.group, return_counts=True)[1].min())


READINGS: Mapping[str, Callable[[Features, Calibration], Array]] = {
    "load": lambda features, _: features.one_sided,
    "d": lambda features, _: features.difficulty,
    "latent": lambda features, calibration: calibration.latent(features),
}
"""Scores [..., joint] that a verdict may use; the joints are summed with the weights of d. The torque error is not put
through 1 − exp(−e), which is flat where the heat is (`benchmarks/paper/readings.py`)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Measures:
    """All measures of one job, or of many with a leading axis [job]."""

    difficulty: Array
    """d_k of the paper, [joint]."""
    weight: Array
    """w_k of the joints in d, [joint]; see `fleet.difficulty`."""
    calibrated: Array | None
    """d_k measured from the median of cool jobs, [joint]; None without a calibration."""
    load: Array
    """One-sided torque difficulty, [joint]: counts only torque above the reconstruction."""
    latent: Array | None
    """Distance from the cluster of cool jobs in the latent space, [joint]; None without a calibration."""
    shares: Array
    """Share of each joint and channel in the error above the median of cool jobs (in all error, without a calibration),
    [joint, channel]. Sums to one, or to zero without such error."""
    heavier: Array
    """Whether a joint's torque error is mostly more load, bool [joint]."""
    p_value: Array | None
    """Conformal p-value, scalar; None without a calibration."""
    version: str
    """Version of the twin."""

    @property
    def total(self) -> Array:
        """d = Σ_k w_k d_k, scalar."""
        return self.difficulty @ self.weight

    @property
    def total_load(self) -> Array:
        """Torque above the reconstruction, training standard deviations, mean of the joints weighted by w_k, scalar."""
        return -np.log1p(-self.load) @ (self.weight / self.weight.sum())

    @property
    def total_latent(self) -> Array | None:
        """Σ_k w_k latent_k / Σ_k w_k, scalar; None without a calibration."""
        return None if self.latent is None else self.latent @ (self.weight / self.weight.sum())

    def of_job(self, i: int) -> "Measures":
        """The measures of one of many jobs."""
        per_job = {name: v[i] for name, v in vars(self).items() if isinstance(v, np.ndarray) and name != "weight"}
        return replace(self, **per_job)

    def why(self, most: int = 2) -> str:
        """The largest causes of one job as text, `joint 2: more load (61 %), joint 4: a new place (20 %)`."""
        order = np.argsort(-self.shares, axis=None, kind="stable")[:most]
        places = [divmod(int(flat), len(CHANNELS)) for flat in order if self.shares.flat[flat] > 0]
        causes = [f"joint {j + 1}: {self._cause(j, c)} ({100 * self.shares[j, c]:.0f} %)" for j, c in places]
        return ", ".join(causes) or "nothing beyond the usual"

    def _cause(self, joint: int, channel: int) -> str:
        torque = "more load" if self.heavier[joint] else "another load"
        return ("a new place", "a new speed", torque)[channel]


def measures_of(features: Features, calibration: Calibration | None, *, weight: Array, version: str) -> Measures:
    """Measures of features with any leading axes.

    Args:
        weight: w_k of the joints, [joint].
    """
    beyond = features.errors
    if calibration is not None:
        beyond = np.maximum(beyond - calibration.usual, 0.0)
    whole = beyond.sum(axis=(-2, -1), keepdims=True)
    return Measures(
        difficulty=features.difficulty,
        weight=weight,
        calibrated=None if calibration is None else calibration.difficulty(features),
        load=features.load,
        latent=None if calibration is None else calibration.latent(features),
        shares=np.divide(beyond, whole, out=np.zeros_like(beyond), where=whole > 0),
        heavier=features.one_sided > 0.5 * features.errors[..., TAU],
        p_value=None if calibration is None else calibration.p_value(features, weight),
        version=version,
    )


def _saturated(error: Array) -> Array:
    return difficulty_of_error(np.minimum(error, ERROR_CAP))
