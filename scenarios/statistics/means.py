"""Intervals of means over fleets, trainings and seeds, and p-values that agree with them.

A seed draws the same jobs for every fleet, so values are correlated by fleet and by seed; trainings are within fleets.
The variance of the mean is clustered both ways, V = V_fleet + V_seed − V_fleet×seed, and its degrees of freedom are the
smaller number of clusters minus one (Cameron, Gelbach & Miller, Journal of Business & Economic Statistics 29, 2011).

Student's t covers too rarely where values are skewed: .88 instead of .95 for ten lognormal values. So each bound is the
outer one of Student's and of Hall's transformation, which removes the skewness of t (Journal of the Royal Statistical
Society B 54, 1992). Both are in closed form: no resampling, and p-values as small as a table of many tests needs.
`benchmarks/statistics/interval_coverage.py` measures how often the intervals contain the mean.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t as student

Array = np.ndarray

LEVEL = 0.95
"""Coverage of every interval of the project."""
SKEW_BIAS = 8.0
"""A sample of n values from a skewed population shows too small a skewness; it is multiplied by 1 + SKEW_BIAS / n."""
FARTHEST = 2.0
"""No bound is farther from the mean than this many times Student's: fewer than ten values hardly show their skewness.

Both numbers were chosen by simulation, so that ten lognormal values (σ = 0.75) are covered with .94 or more.
"""
SAME = 1e-12
"""Values that differ by less than this part of the largest one are equal."""


@dataclass(frozen=True)
class Interval:
    """A mean, its interval, and the test whether it is 0."""

    mean: float
    low: float = math.nan
    """NaN where the values do not determine it; `note` says why."""
    high: float = math.nan
    p: float = math.nan
    """Two-sided p-value of the mean being 0, below 1 − level exactly if the interval excludes 0; NaN without a test."""
    note: str = ""
    """What the bounds rest on if not on the spread of the values, or why there are none."""

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval excludes 0."""
        return self.low > 0 or self.high < 0

    @property
    def margin(self) -> float:
        """Distance from the mean to the farther bound."""
        return max(self.high - self.mean, self.mean - self.low)

    def stars(self, p_holm: float) -> str:
        """`*` if it excludes 0, `**` if also after Holm's correction of its p-value."""
        return "*" * (self.excludes_zero + (p_holm < 1 - LEVEL))

    def text(self, digits: int = 2, sign: str = "") -> str:
        """`0.41 [0.35, 0.47]`; the mean alone without bounds. With the sign "+", a mean above 0 has one."""
        bounds = f" [{self.low:z.{digits}f}, {self.high:z.{digits}f}]" if np.isfinite(self.low + self.high) else ""
        return f"{self.mean:{sign}z.{digits}f}{bounds}"


class Bounds(NamedTuple):
    """Intervals of many means at once, each [...]."""

    mean: Array
    low: Array
    """NaN without variation or with a single cluster."""
    high: Array
    p: Array


def interval(values: ArrayLike, *, least: float = -np.inf, most: float = np.inf, level: float = LEVEL) -> Interval:
    """The interval of a mean.

    Args:
        values: Independent values [seed], or [fleet, training, seed].
        least, most: Smallest and largest possible value, which the bounds do not exceed.

    Raises:
        ValueError: no values, values that are not finite, or another number of axes.
    """
    x = _checked(values)
    mean, low, high, p = (float(each) for each in mean_bounds(x, level=level))
    if not np.isnan(low):
        return Interval(mean, max(low, least), min(high, most), p)
    if x.size == 1:
        return Interval(mean, note="one value")
    note = f"no variation in {draws(x)}"
    if not np.isfinite(most - least) or mean not in (least, most):
        return Interval(mean, note=note)
    # All of n values at one end of a range: if the mean were `away` of it, that has less probability than one tail.
    away = (most - least) * (1 - ((1 - level) / 2) ** (1 / draws(x)))
    return Interval(mean, max(least, mean - away), min(most, mean + away), note=note)


def paired(values: ArrayLike, base: ArrayLike, *, level: float = LEVEL) -> Interval:
    """The interval of the mean difference of values to those of a baseline on the same fleets, trainings and seeds.

    Of [fleet, training, seed], one of the two may have a single fleet that stands for all.

    Raises:
        ValueError: as `interval`, or different shapes.
    """
    x, y = np.asarray(values, dtype=float), np.asarray(base, dtype=float)
    single = x.ndim == y.ndim == 3 and 1 in (len(x), len(y))
    if x.shape[single:] != y.shape[single:]:
        raise ValueError(f"Paired values need equal shapes (got {x.shape}, {y.shape}).")
    return interval(x - y, level=level)


def mean_by_group(values: Iterable[tuple[str, float]]) -> Interval:
    """The interval of the mean over groups that each have some values, such as arms under seeds of their own.

    The groups are the sample; of a single group, its values are.

    Args:
        values: Name of the group, and a value of it.
    """
    groups = dict[str, list[float]]()
    for name, value in values:
        groups.setdefault(name, []).append(value)
    several = list(groups.values())
    return interval([np.mean(each) for each in several] if len(several) > 1 else several[0])


def mean_bounds(values: Array, *, level: float = LEVEL) -> Bounds:
    """The intervals of many means.

    Args:
        values: [..., fleet, training, seed]. A single fleet or seed counts as fixed, not as a sample; of a single
            fleet, the trainings are the clusters.
    """
    x = np.asarray(values, dtype=float)
    cells = x.mean(axis=-2) if x.shape[-3] > 1 else x[..., 0, :, :]
    mean = cells.mean(axis=(-2, -1))
    clusters = fewest(cells.shape[-2:])
    variance, third = _moments(cells)
    flat = np.ptp(x, axis=(-3, -2, -1)) <= SAME * np.abs(x).max(axis=(-3, -2, -1))
    if clusters == 1:
        flat = np.ones_like(mean, dtype=bool)
    variance = np.where(flat | (variance <= 0), np.nan, variance)
    spread = np.sqrt(variance)
    skew = third / spread**3 / 6
    bound = float(student.ppf(0.5 + level / 2, max(clusters - 1, 1)))
    below = np.clip(_untransformed(-bound, skew), -FARTHEST * bound, -bound)
    above = np.clip(_untransformed(bound, skew), bound, FARTHEST * bound)
    ratio = mean / spread
    hall, nearest = _transformed(ratio, skew), ratio / FARTHEST
    least, most = np.minimum(ratio, np.maximum(hall, nearest)), np.maximum(ratio, np.minimum(hall, nearest))
    tails = student.cdf(most, max(clusters - 1, 1)), student.sf(least, max(clusters - 1, 1))
    p = np.minimum(1.0, 2 * np.minimum(*tails))
    return Bounds(mean, mean - above * spread, mean - below * spread, p)


def draws(values: Array) -> int:
    """Independent draws among [seed] or [fleet, training, seed]: the smaller number of clusters, as for a variance."""
    return fewest((values.shape[0], values.shape[-1]))


def fewest(counts: Iterable[int]) -> int:
    """The smallest of the numbers of clusters of crossed samples; a single cluster is given, not a sample."""
    return min((count for count in counts if count > 1), default=1)


def unit(shape: tuple[int, ...]) -> str:
    """What an interval of values of this shape speaks about: `3 fleets × 20 seeds`, `10 seeds, this fleet only`."""
    names = ("fleet", "training", "seed")[-len(shape) :]
    several = [f"{count} {name}s" for name, count in zip(names, shape, strict=True) if count > 1]
    fixed = [
        f", this {name} only" for name in ("fleet", "seed") if dict(zip(names, shape, strict=True)).get(name, 1) < 2
    ]
    return (" × ".join(several) or "one value") + "".join(fixed)


def _moments(cells: Array) -> tuple[Array, Array]:
    """Variance and third central moment of the mean of [..., fleet, seed], clustered both ways."""
    fleets, seeds = cells.shape[-2:]
    by_cell = _one_way(cells.reshape(*cells.shape[:-2], -1))
    if min(fleets, seeds) == 1:
        return by_cell
    by_fleet, by_seed = _one_way(cells.mean(axis=-1)), _one_way(cells.mean(axis=-2))
    # The sum can be too small, even negative, in small samples; use the larger of the one-way variances then.
    variance = np.maximum(by_fleet[0] + by_seed[0] - by_cell[0], np.maximum(by_fleet[0], by_seed[0]))
    return variance, by_fleet[1] + by_seed[1] - by_cell[1]


def _one_way(values: Array) -> tuple[Array, Array]:
    """Variance and third central moment of the mean of independent values [..., n]."""
    n = values.shape[-1]
    if n < 2:
        return np.zeros(values.shape[:-1]), np.zeros(values.shape[:-1])
    off = values - values.mean(axis=-1, keepdims=True)
    variance = (off**2).mean(axis=-1)
    # Bias of the skewness; its cube of the standard deviation is that of the unbiased variance.
    third = (off**3).mean(axis=-1) * (1 + SKEW_BIAS / n) * (n / (n - 1)) ** 1.5
    return variance / (n - 1), third / n**2


def _transformed(ratio: Array, skew: Array) -> Array:
    """Hall's monotone cubic of t, without skewness; `skew` is a sixth of the skewness of the mean."""
    return ratio + skew + 2 * skew * ratio**2 + 4 / 3 * skew**2 * ratio**3


def _untransformed(value: float, skew: Array) -> Array:
    """The t that `_transformed` maps to a value."""
    small = np.abs(skew) < 1e-6
    a = np.where(small, 1.0, skew)
    return np.where(small, value - skew * (1 + 2 * value**2), (np.cbrt(1 + 6 * a * (value - a)) - 1) / (2 * a))


def _checked(values: ArrayLike) -> Array:
    x = np.asarray(values, dtype=float)
    if x.ndim not in (1, 3) or not x.size:
        raise ValueError(f"Values must be [seed] or [fleet, training, seed], at least one (got shape {x.shape}).")
    if not np.isfinite(x).all():
        raise ValueError("Values must be finite.")
    x = x if x.ndim == 3 else x[None, None]
    return x if np.ptp(x, axis=1).any() else x[:, :1]  # without trainings of its own
