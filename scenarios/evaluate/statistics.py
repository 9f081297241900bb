"""Intervals of means, counts and shares, scores over a suite, and figures of policies beside a baseline.

**Means** over fleets, trainings and seeds. A seed draws the same jobs for every fleet, so values are correlated by
fleet and by seed; trainings are within fleets. The variance of the mean is clustered both ways, V = V_fleet + V_seed −
V_fleet×seed, with the smaller number of clusters minus one as degrees of freedom (Cameron, Gelbach & Miller, Journal of
Business & Economic Statistics 29, 2011). Student's t covers too rarely where values are skewed: .88 instead of .95 for
ten lognormal values. So each bound is the outer one of Student's and of Hall's transformation, which removes the
skewness of t (Journal of the Royal Statistical Society B 54, 1992); both have a closed form.
`benchmarks/statistics/interval_coverage.py` measures how often the intervals contain the mean.

**Counts and shares** have exact intervals, so that `0 faults in 10 shifts` is not `no faults`.

**Scores** over a suite [run, instance]: IQM, optimality gap, performance profile and probability of improvement
(Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS 2021), with 1 as the best
known. Intervals are percentiles of bootstrap resamples of runs (trainings) and instances, or of groups of instances and
instances within each; a single run is given, not a sample. Percentiles of few independent draws are too narrow, so
these are farther out, as Student's t is (Hesterberg, The American Statistician 69, 2015, section 5.4). Resamples are
weights, so every figure is a product of one matrix.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import beta, chi2, norm, trim_mean
from scipy.stats import t as student

Array = np.ndarray


LEVEL = 0.95
"""Coverage of every interval of the project."""
SKEW_BIAS = 8.0
"""A sample of n values from a skewed population shows too small a skewness; it is multiplied by 1 + SKEW_BIAS / n."""
FARTHEST = 2.0
"""No bound is farther from the mean than this many times Student's: fewer than ten values hardly show their skewness.

Both numbers were chosen by simulation, so that ten lognormal values (σ = 0.75) are covered with .94 or more.
`benchmarks/statistics/interval_coverage.py` measures coverage and width with this and with other limits.
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


class MeanIntervals(NamedTuple):
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
        return Interval(mean, note=ONE)
    count = draws(np.shape(values))
    note = f"no variation in {count}"
    if not np.isfinite(most - least) or mean not in (least, most):
        return Interval(mean, note=note)
    # All of n values at one end of a range: if the mean were `away` of it, that has less probability than one tail.
    away = (most - least) * (1 - ((1 - level) / 2) ** (1 / count))
    return Interval(mean, max(least, mean - away), min(most, mean + away), note=note)


def paired(values: ArrayLike, base: ArrayLike) -> Interval:
    """The interval of the mean difference of values to those of a baseline on the same fleets, trainings and seeds.

    Of [fleet, training, seed], one of the two may have a single fleet that stands for all.

    Raises:
        ValueError: as `interval`, or different shapes.
    """
    x, y = np.asarray(values, dtype=float), np.asarray(base, dtype=float)
    single = x.ndim == y.ndim == 3 and 1 in (len(x), len(y))
    if x.shape[single:] != y.shape[single:]:
        raise ValueError(f"Paired values need equal shapes (got {x.shape}, {y.shape}).")
    return interval(x - y)


def mean_bounds(values: Array, *, level: float = LEVEL, farthest: float = FARTHEST) -> MeanIntervals:
    """The intervals of many means.

    Args:
        values: [..., fleet, training, seed].
        farthest: As `FARTHEST`; 1 gives Student's intervals, inf those without a limit.
    """
    x = np.asarray(values, dtype=float)
    cells = x.mean(axis=-2) if x.shape[-3] > 1 else x[..., 0, :, :]
    mean = cells.mean(axis=(-2, -1))
    clusters = draws(x.shape)
    variance, third = _moments(cells)
    flat = np.ptp(x, axis=(-3, -2, -1)) <= SAME * np.abs(x).max(axis=(-3, -2, -1))
    if clusters == 1:
        flat = np.ones_like(mean, dtype=bool)
    variance = np.where(flat | (variance <= 0), np.nan, variance)
    spread = np.sqrt(variance)
    skew = third / spread**3 / 6
    bound = float(student.ppf(0.5 + level / 2, max(clusters - 1, 1)))
    below = np.clip(_untransformed(-bound, skew), -farthest * bound, -bound)
    above = np.clip(_untransformed(bound, skew), bound, farthest * bound)
    ratio = mean / spread
    hall, nearest = _transformed(ratio, skew), ratio / farthest
    least, most = np.minimum(ratio, np.maximum(hall, nearest)), np.maximum(ratio, np.minimum(hall, nearest))
    tails = student.cdf(most, max(clusters - 1, 1)), student.sf(least, max(clusters - 1, 1))
    p = np.minimum(1.0, 2 * np.minimum(*tails))
    return MeanIntervals(mean, mean - above * spread, mean - below * spread, p)


def draws(shape: tuple[int, ...]) -> int:
    """Independent draws among values [seed] or [..., fleet, training, seed]: the smaller number of clusters.

    A single fleet or seed is given, not a sample. Trainings are within fleets; of a single fleet they are the clusters.
    """
    fleets, trainings, seeds = (1, 1, *shape)[-3:]
    return fewest((fleets if fleets > 1 else trainings, seeds))


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
    return x if np.ptp(x, axis=1).any() else x[:, :1]  # trainings that change nothing


def share_bounds(hits: int, count: int) -> tuple[float, float]:
    """Exact interval of a probability after some hits in `count` draws (Clopper & Pearson, Biometrika 26, 1934).

    Raises:
        ValueError: no draws, or more hits than draws.
    """
    if not 0 <= hits <= count or not count:
        raise ValueError(f"Hits must be 0 to the number of draws, at least one draw (got {hits} of {count}).")
    tail = (1 - LEVEL) / 2
    low = float(beta.ppf(tail, hits, count - hits + 1)) if hits else 0.0
    high = float(beta.ppf(1 - tail, hits + 1, count - hits)) if hits < count else 1.0
    return low, high


def rate_bounds(events: int, count: int) -> tuple[float, float]:
    """Exact interval of a Poisson mean after `events` in all of `count` draws (Garwood, Biometrika 28, 1936).

    Raises:
        ValueError: no draws, or fewer than no events.
    """
    if events < 0 or count < 1:
        raise ValueError(f"Events must be >= 0 and draws >= 1 (got {events} in {count}).")
    tail = (1 - LEVEL) / 2
    low = float(chi2.ppf(tail, 2 * events)) / 2 if events else 0.0
    return low / count, float(chi2.ppf(1 - tail, 2 * events + 2)) / 2 / count


def count_interval(values: ArrayLike) -> Interval:
    """As `interval`, of counts of rare events (≥ 0); where none occurred, the bound of a Poisson mean.

    Args:
        values: [seed] or [fleet, training, seed].
    """
    x = np.asarray(values, dtype=float)
    if x.any() or not x.size:
        return interval(x, least=0.0)
    return Interval(0.0, *rate_bounds(0, draws(x.shape)), 1.0, f"none in {draws(x.shape)}, Poisson")


def paired_counts(values: ArrayLike, base: ArrayLike) -> Interval:
    """As `paired`, of counts of rare events; where none occurred in either, the difference of two Poisson bounds."""
    x, y = np.asarray(values, dtype=float), np.asarray(base, dtype=float)
    if x.any() or y.any() or x.shape != y.shape:
        return paired(x, y)
    most = rate_bounds(0, draws(x.shape))[1]
    return Interval(0.0, -most, most, 1.0, f"none in {draws(x.shape)}, Poisson")


def holm(p: ArrayLike) -> Array:
    """p-values adjusted for all tests of a table (Holm, Scandinavian Journal of Statistics 6, 1979).

    The probability of any adjusted value below α where there is no difference is at most α, whether or not the tests
    depend on each other.

    Args:
        p: Any shape; NaN is no test and remains NaN.
    """
    raw = np.asarray(p, dtype=float)
    tested = raw[np.isfinite(raw)]
    order = np.argsort(tested)
    grown = np.maximum.accumulate(tested[order] * np.arange(len(tested), 0, -1))
    adjusted = np.empty(len(tested))
    adjusted[order] = np.minimum(grown, 1.0)
    result = np.full(raw.shape, np.nan)
    result[np.isfinite(raw)] = adjusted
    return result


DRAWS = 4000
FEWEST_RESAMPLED = 5
"""Of fewer independent scores, percentiles of resamples cover the true value too seldom: of four in 87 %."""
FEW = f"fewer than {FEWEST_RESAMPLED} instances or cells, whose range no resample leaves"
TRIM = 0.25
"""Share of the scores that the interquartile mean leaves out at each end."""


@dataclass(frozen=True)
class Aggregate:
    """The figures of one policy over a suite; no intervals with less than `FEWEST_RESAMPLED` instances or groups."""

    iqm: Interval
    """Interquartile mean: of the middle half of all scores."""
    optimality_gap: Interval
    """By how much scores are below 1 in the mean; those above count as 1. Less is better."""


def aggregates(scores: Mapping[str, ArrayLike], *, groups: ArrayLike | None = None) -> dict[str, Aggregate]:
    """IQM and optimality gap of each policy, with intervals.

    Args:
        scores: By policy, [run, instance].
        groups: Number of the group of each instance, from 0, [instance]; None if each is its own.

    Raises:
        ValueError: scores that are not finite or not [run, instance], or a single instance.
    """
    return {policy: _aggregate(_checked_scores(each), groups) for policy, each in scores.items()}


def profile(scores: ArrayLike, threshold: ArrayLike, *, groups: ArrayLike | None = None) -> tuple[Array, Array, Array]:
    """The performance profile of one policy: share of runs with a score above each threshold.

    Args:
        scores: [run, instance].
        threshold: Scores at which it is given, [threshold].
        groups: As of `aggregates`.

    Returns:
        Share, and its pointwise lower and upper bound, each [threshold].
    """
    x, at = _checked_scores(scores), np.asarray(threshold, dtype=float)
    above = (x[..., None] > at).astype(float)  # [run, instance, threshold]
    drawn = _weights(x.shape, groups).reshape(DRAWS, -1) @ above.reshape(x.size, -1) / x.size
    share, (low, high) = above.mean(axis=(0, 1)), _percentiles(drawn, _clusters(x.shape, groups))
    most, least = _beyond(x.shape, groups)
    return share, np.where(share == 1, least, low), np.where(share == 0, most, high)


def improvement(scores: ArrayLike, base: ArrayLike, *, groups: ArrayLike | None = None) -> Interval:
    """Probability that a run is better than one of a baseline on the same instance; an equal score counts one half.

    Args:
        scores, base: [run, instance], the same instances; the numbers of runs may differ.
        groups: As of `aggregates`.

    Returns:
        The interval; 0.5 is no difference, and `p` is not given. No bounds with less than `FEWEST_RESAMPLED` instances
        or groups, unless all are better or none is.

    Raises:
        ValueError: as `aggregates`, or different numbers of instances.
    """
    x, y = _checked_scores(scores), _checked_scores(base)
    if x.shape[1] != y.shape[1]:
        raise ValueError(f"Scores need the same instances as the baseline (got {x.shape[1]} and {y.shape[1]}).")
    better = (x[:, None] > y) + 0.5 * (x[:, None] == y)  # [run, run of the baseline, instance]
    own, other = (_run_weights(len(each), stream) for stream, each in enumerate((x, y), start=1))
    instances = _instance_weights(x.shape[1], groups)
    drawn = np.einsum("dri,dqi,di,rqi->d", own, other, instances, better, optimize=True)
    share, (most, least) = float(better.mean()), _beyond(x.shape, groups)
    if share in (0, 1):
        return Interval(share, share and least, share or most, note="the same everywhere, Clopper–Pearson")
    if _few(x, groups):
        return Interval(share, note=FEW)
    return percentile_interval(share, drawn / better.size, clusters=_clusters(x.shape, groups))


def by_group(scores: ArrayLike, groups: ArrayLike) -> Array:
    """Values [run, 1, group] whose `means.interval` is that of the mean over instances, clustered by run and by group.

    A group's value is its mean, its distance to the mean of all weighted by its number of instances.

    Args:
        scores: [run, instance].
        groups: As of `aggregates`.
    """
    x, of = _checked_scores(scores), np.asarray(groups)
    count, mean = np.bincount(of), x.mean(axis=1, keepdims=True)
    means = np.stack([np.bincount(of, each) for each in x]) / count  # [run, group]
    return (mean + count / count.mean() * (means - mean))[:, None]


def _clusters(shape: tuple[int, ...], groups: ArrayLike | None) -> int:
    """Independent draws: the smaller number of those of instances, or of their groups, and of runs."""
    return fewest((shape[1] if groups is None else int(np.max(groups)) + 1, shape[0]))


def _beyond(shape: tuple[int, ...], groups: ArrayLike | None) -> tuple[float, float]:
    """Bounds of a share that is 0 and of one that is 1 in everything that was drawn, which resamples cannot exceed."""
    most = share_bounds(0, _clusters(shape, groups))[1]
    return most, 1 - most


def _few(x: Array, groups: ArrayLike | None) -> bool:
    return (x.shape[1] if groups is None else int(np.max(groups)) + 1) < FEWEST_RESAMPLED


def _aggregate(x: Array, groups: ArrayLike | None) -> Aggregate:
    weights, lack = _weights(x.shape, groups), 1 - np.minimum(x, 1)
    whole = _trimmed(x, np.ones((1, *x.shape)))
    if _few(x, groups):
        return Aggregate(*(Interval(float(each), note=FEW) for each in (whole[0], lack.mean())))
    iqm = _trimmed(x, weights)
    gap = weights.reshape(DRAWS, -1) @ lack.ravel() / x.size
    clusters = _clusters(x.shape, groups)
    return Aggregate(
        percentile_interval(float(whole[0]), iqm, clusters=clusters),
        percentile_interval(float(lack.mean()), gap, clusters=clusters),
    )


def _trimmed(x: Array, weights: Array) -> Array:
    """The mean of the middle scores of each resample, [draw]; whole scores are left out, as SciPy's `trim_mean` does.

    Args:
        weights: How often each score was drawn, [draw, run, instance]; they sum to the number of scores.
    """
    order, cut = np.argsort(x, axis=None), int(TRIM * x.size)
    reached = np.cumsum(weights.reshape(len(weights), -1)[:, order], axis=1)
    kept = np.diff(np.clip(reached, cut, x.size - cut), axis=1, prepend=cut)
    return kept @ x.ravel()[order] / (x.size - 2 * cut)


def _weights(shape: tuple[int, ...], groups: ArrayLike | None) -> Array:
    """How often each score is drawn, [draw, run, instance]; the same for every policy of one shape."""
    return _run_weights(shape[0], 1) * _instance_weights(shape[1], groups)[:, None]


def _run_weights(runs: int, stream: int) -> Array:
    """Of runs, [draw, run, 1]; a single run is given."""
    return np.ones((DRAWS, 1, 1)) if runs == 1 else _drawn(runs, (DRAWS, 1), stream).transpose(0, 2, 1)


def _instance_weights(instances: int, groups: ArrayLike | None) -> Array:
    """Of instances, [draw, instance], with the sum of their number."""
    if instances < 2:
        raise ValueError("Scores need two instances or more (got one).")
    return _drawn(instances, (DRAWS,), 0) if groups is None else _grouped(tuple(np.asarray(groups).tolist()))


@lru_cache(maxsize=4)
def _grouped(groups: tuple[int, ...]) -> Array:
    """Weights of instances that are drawn within drawn groups, [draw, instance]."""
    of, rng = np.array(groups), np.random.default_rng(np.random.SeedSequence(0, spawn_key=(3,)))
    instances = len(of)
    weights = np.empty((DRAWS, instances))
    for group, times in enumerate(_drawn(int(of.max()) + 1, (DRAWS,), 0).T):
        own = np.flatnonzero(of == group)
        weights[:, own] = rng.multinomial(times.astype(int) * len(own), np.full(len(own), 1 / len(own)))
    return weights * instances / weights.sum(axis=1, keepdims=True)


def _drawn(count: int, size: tuple[int, ...], stream: int) -> Array:
    """How often each item is drawn, [*size, item]."""
    rng = np.random.default_rng(np.random.SeedSequence(0, spawn_key=(stream,)))
    return rng.multinomial(count, np.full(count, 1 / count), size=size).astype(float)


def percentile_interval(at: float, drawn: Array, *, clusters: int | None = None) -> Interval:
    """The interval of a figure between the percentiles of its values in resamples, [draw].

    Args:
        clusters: Independent draws of the sample, if the interval is to be as much wider as Student's t is.
    """
    if np.ptp(drawn) <= SAME * abs(at):
        return Interval(at, note=f"no variation in {len(drawn)} resamples")
    low, high = _percentiles(drawn, clusters)
    return Interval(at, float(low), float(high))


def _percentiles(drawn: Array, clusters: int | None) -> tuple[Array, Array]:
    tail = (1 - LEVEL) / 2
    if clusters is not None:
        n = max(clusters, 2)
        tail = float(norm.cdf(student.ppf(tail, n - 1) * np.sqrt(n / (n - 1))))
    low, high = np.percentile(drawn, [100 * tail, 100 * (1 - tail)], axis=0)
    return low, high


def _checked_scores(scores: ArrayLike) -> Array:
    x = np.asarray(scores, dtype=float)
    if x.ndim != 2 or not x.size or not np.isfinite(x).all():
        raise ValueError(f"Scores must be [run, instance], finite, at least one (got shape {x.shape}).")
    return x


LEGEND = "95 % intervals; * excludes 0, ** also after Holm's correction over the table"
EQUAL, ONE = "all equal", "one value"
"""In place of an interval."""
HEAD = ("", "mean", "interval", "difference", "interval", "")
MORE_DIGITS = 3
"""Decimals that a row may have beyond the least, so that no interval that excludes 0 seems to include it."""


class FigureKind(NamedTuple):
    """What a table says of a figure, and which values it can have."""

    heading: str
    """With its unit."""
    digits: int = 1
    """Least decimals."""
    least: float = 0.0
    most: float = math.inf
    is_count: bool = False
    """Of rare events; see `count_interval`."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One figure of one policy, and its paired difference to that of the baseline."""

    mean: float
    iqm: float
    """Interquartile mean (Agarwal et al., NeurIPS 2021)."""
    low: float
    high: float
    """95 % interval of the mean; NaN where the values do not determine it."""
    note: str
    """What the interval rests on if not on the spread of the values, or why there is none."""
    difference: float
    """Mean paired difference to the baseline."""
    difference_low: float
    difference_high: float
    difference_note: str
    p: float
    """Of no difference; NaN without a test."""
    p_holm: float
    """Adjusted for all differences of the table."""

    @property
    def to_base(self) -> Interval:
        """The difference to the baseline."""
        return Interval(self.difference, self.difference_low, self.difference_high, self.p, self.difference_note)

    @property
    def stars(self) -> str:
        """As `LEGEND` says."""
        return self.to_base.stars(self.p_holm)


def figures_of(
    values: Mapping[str, Mapping[str, Array]],
    baseline: str,
    kinds: Mapping[str, FigureKind],
    groups: Array | None = None,
) -> dict[str, dict[str, Figure]]:
    """The figures of every policy, by policy and name.

    Args:
        values: By policy and name of the figure, [seed] or [fleet, training, seed], the same for every policy.
        baseline: The policy that differences refer to.
        kinds: By name of the figure; one that it lacks has any value.
        groups: As of `aggregates`, of values [training, 1, instance]; None if the last axis has independent values.
    """

    def sample(x: Array) -> Array:
        return x if groups is None else by_group(x[:, 0], groups)

    made = dict[tuple[str, str], tuple[Interval, Interval]]()
    for policy, figures in values.items():
        for name, given in figures.items():
            x, base = sample(given), sample(values[baseline][name])
            kind = kinds.get(name, FigureKind("", least=-math.inf))
            own = count_interval(x) if kind.is_count else interval(x, least=kind.least, most=kind.most)
            to_base = (paired_counts if kind.is_count else paired)(x, base)
            made[policy, name] = own, Interval(0.0, 0.0, 0.0) if policy == baseline else to_base
    adjusted = dict(zip(made, holm([to_base.p for _, to_base in made.values()]).tolist(), strict=True))

    def figure(policy: str, name: str) -> Figure:
        (own, to_base), p_holm = made[policy, name], adjusted[policy, name]
        return Figure(
            mean=own.mean,
            iqm=float(trim_mean(values[policy][name].ravel(), TRIM)),
            low=own.low,
            high=own.high,
            note=own.note,
            difference=to_base.mean,
            difference_low=to_base.low,
            difference_high=to_base.high,
            difference_note=to_base.note,
            p=to_base.p,
            p_holm=p_holm if p_holm == p_holm else math.nan,  # one object, so that equal results compare equal
        )

    return {policy: {name: figure(policy, name) for name in figures} for policy, figures in values.items()}


def figure_rows(
    figures: Mapping[str, Figure], baseline: str, label: Callable[[str], str], least_digits: int = 1
) -> list[tuple[str, ...]]:
    """A row of `HEAD` for each policy: mean and paired difference, each with its interval."""
    digits, rows = _digits(list(figures.values()), least_digits), list[tuple[str, ...]]()
    for policy, f in figures.items():
        cells = (label(policy), f"{f.mean:z.{digits}f}", _span(f.low, f.high, f.note, digits))
        if policy == baseline:
            rows.append((*cells, "", "", ""))
            continue
        low, high = (round(bound, digits) for bound in (f.difference_low, f.difference_high))
        stars = f.stars if low > 0 or high < 0 else ""
        rows.append((*cells, f"{f.difference:+z.{digits}f}", _span(low, high, f.difference_note, digits, "+"), stars))
    return rows


def remarks(figures: Mapping[str, Mapping[str, Figure]], draws: int) -> Iterator[str]:
    """What a reader of the table must know of cells without variation.

    Args:
        draws: Independent values that the intervals rest on.
    """
    notes = [note for each in figures.values() for f in each.values() for note in (f.note, f.difference_note)]
    spans = [
        pair
        for each in figures.values()
        for f in each.values()
        for pair in ((f.low, f.note), (f.difference_low, f.difference_note))
    ]
    if any(np.isnan(low) and note != ONE for low, note in spans):
        most = share_bounds(0, draws)[1]
        yield f"{EQUAL}: no variation in {draws}, at 95 % confidence up to {most:.0%} of all may differ."
    if any(note.endswith("Poisson") for note in notes):
        yield "Counts without an event have the exact bound of a Poisson mean."
    if any(
        f.note.startswith("no variation") and np.isfinite(f.low) for each in figures.values() for f in each.values()
    ):
        yield f"All values at one end of their range, as availability 1: bound of {draws} in {draws} (Clopper–Pearson)."


def _span(low: float, high: float, note: str, digits: int, sign: str = "") -> str:
    if np.isnan(low + high):
        return ONE if note == ONE else EQUAL
    return f"{low:{sign}z.{digits}f} … {high:{sign}z.{digits}f}"


def _digits(figures: Sequence[Figure], least: int) -> int:
    """Decimals, up to `MORE_DIGITS` more than the least, with which no interval that excludes 0 seems to include it."""
    nearest = [min(abs(f.difference_low), abs(f.difference_high)) for f in figures if f.to_base.excludes_zero]
    enough = (n for n in range(least, least + MORE_DIGITS) if all(round(bound, n) for bound in nearest))
    return next(enough, least + MORE_DIGITS)
