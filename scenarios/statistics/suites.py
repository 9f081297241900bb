"""Scores over the instances of a suite: IQM, optimality gap, performance profile, probability of improvement.

After Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS 2021. Scores are
[run, instance], normalised so that 1 is the best known. Intervals are percentiles of bootstrap resamples. What is drawn
is the unit that an interval is about:

- `within`: runs of each instance apart (stratified, as in rliable): the same suite with other seeds.
- `runs`: whole runs: the same suite with other trainings, each of which does all instances.
- `instances`: instances, with their runs: other instances of the same generator. If instances belong to groups, such as
  cells, then groups are drawn, and instances within each: other groups.
- `both`: runs and instances; a single run is given, so that this is the same as `instances`.

Percentiles of few independent draws are too narrow, so those of `instances` and `both` are farther out, as Student's t
is (Hesterberg, What Teachers Should Know about the Bootstrap, The American Statistician 69, 2015, section 5.4).

Resamples are weights, so every figure of every policy is a product of one matrix. The mean over instances needs none:
`means.interval` of [run, 1, instance], or of `by_group`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm
from scipy.stats import t as student

from scenarios.statistics.counts import share_bounds
from scenarios.statistics.means import LEVEL, SAME, Interval, fewest

Array = np.ndarray
Unit = Literal["within", "runs", "instances", "both"]

DRAWS = 4000
TRIM = 0.25
"""Share of the scores that the interquartile mean leaves out at each end."""


@dataclass(frozen=True, eq=False)
class Profile:
    """Share of runs with a score above each threshold."""

    threshold: Array
    share: Array
    """[threshold]."""
    low: Array
    high: Array


@dataclass(frozen=True)
class Aggregate:
    """The figures of one policy over a suite."""

    iqm: Interval
    """Interquartile mean: of the middle half of all scores."""
    optimality_gap: Interval
    """By how much scores are below 1 in the mean; those above count as 1. Less is better."""


def aggregates(
    scores: Mapping[str, ArrayLike], unit: Unit = "instances", *, groups: ArrayLike | None = None, level: float = LEVEL
) -> dict[str, Aggregate]:
    """IQM and optimality gap of each policy, with intervals.

    Args:
        scores: By policy, [run, instance].
        groups: Number of the group of each instance, from 0, [instance]; None if each is its own.

    Raises:
        ValueError: scores that are not finite or not [run, instance], or a unit of which there is only one.
    """
    return {policy: _aggregate(_checked(each), unit, groups, level) for policy, each in scores.items()}


def profile(
    scores: ArrayLike,
    threshold: ArrayLike,
    unit: Unit = "instances",
    *,
    groups: ArrayLike | None = None,
    level: float = LEVEL,
) -> Profile:
    """The performance profile of one policy, with pointwise intervals.

    Args:
        scores: [run, instance].
        threshold: Scores at which it is given, [threshold].
        groups: As of `aggregates`.
    """
    x, at = _checked(scores), np.asarray(threshold, dtype=float)
    above = (x[..., None] > at).astype(float)  # [run, instance, threshold]
    drawn = _weights(x.shape, unit, groups).reshape(DRAWS, -1) @ above.reshape(x.size, -1) / x.size
    share, (low, high) = above.mean(axis=(0, 1)), _percentiles(drawn, level, _clusters(x.shape, unit, groups))
    most, least = _beyond(x.shape, unit, groups, level)
    return Profile(at, share, np.where(share == 1, least, low), np.where(share == 0, most, high))


def improvement(
    scores: ArrayLike,
    base: ArrayLike,
    unit: Unit = "instances",
    *,
    groups: ArrayLike | None = None,
    level: float = LEVEL,
) -> Interval:
    """Probability that a run is better than one of a baseline on the same instance; an equal score counts one half.

    Args:
        scores, base: [run, instance], the same instances; the numbers of runs may differ.
        groups: As of `aggregates`.

    Returns:
        The interval; 0.5 is no difference, and `p` is not given.

    Raises:
        ValueError: as `aggregates`, or different numbers of instances.
    """
    x, y = _checked(scores), _checked(base)
    if x.shape[1] != y.shape[1]:
        raise ValueError(f"Scores need the same instances as the baseline (got {x.shape[1]} and {y.shape[1]}).")
    better = (x[:, None] > y) + 0.5 * (x[:, None] == y)  # [run, run of the baseline, instance]
    own, other = (_run_weights(each.shape, unit, stream) for stream, each in enumerate((x, y), start=1))
    instances = _instance_weights(x.shape[1], unit, groups)
    drawn = np.einsum("dri,dqi,di,rqi->d", own, other, instances, better, optimize=True)
    share, (most, least) = float(better.mean()), _beyond(x.shape, unit, groups, level)
    if share in (0, 1):
        return Interval(share, share and least, share or most, note="the same everywhere, Clopper–Pearson")
    return percentile_interval(share, drawn / better.size, level=level, clusters=_clusters(x.shape, unit, groups))


def by_group(scores: ArrayLike, groups: ArrayLike) -> Array:
    """Values [run, 1, group] whose `means.interval` is that of the mean over instances, clustered by run and by group.

    A group's value is its mean, its distance to the mean of all weighted by its number of instances.

    Args:
        scores: [run, instance].
        groups: As of `aggregates`.
    """
    x, of = _checked(scores), np.asarray(groups)
    count, mean = np.bincount(of), x.mean(axis=1, keepdims=True)
    means = np.stack([np.bincount(of, each) for each in x]) / count  # [run, group]
    return (mean + count / count.mean() * (means - mean))[:, None]


def _clusters(shape: tuple[int, ...], unit: Unit, groups: ArrayLike | None) -> int | None:
    """Independent draws of a unit with instances, the smaller number of those of instances and of runs; else None."""
    if unit in ("within", "runs"):
        return None
    return fewest((shape[1] if groups is None else int(np.max(groups)) + 1, shape[0] if unit == "both" else 1))


def _beyond(shape: tuple[int, ...], unit: Unit, groups: ArrayLike | None, level: float) -> tuple[float, float]:
    """Bounds of a share that is 0 and of one that is 1 in everything that was drawn, which resamples cannot exceed."""
    drawn = _clusters(shape, unit, groups) or shape[unit != "runs"]
    most = share_bounds(0, drawn, level=level)[1]
    return most, 1 - most


def _aggregate(x: Array, unit: Unit, groups: ArrayLike | None, level: float) -> Aggregate:
    weights, lack = _weights(x.shape, unit, groups), 1 - np.minimum(x, 1)
    iqm, whole = _trimmed(x, weights), _trimmed(x, np.ones((1, *x.shape)))
    gap = weights.reshape(DRAWS, -1) @ lack.ravel() / x.size
    clusters = _clusters(x.shape, unit, groups)
    return Aggregate(
        percentile_interval(float(whole[0]), iqm, level=level, clusters=clusters),
        percentile_interval(float(lack.mean()), gap, level=level, clusters=clusters),
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


def _weights(shape: tuple[int, ...], unit: Unit, groups: ArrayLike | None) -> Array:
    """How often each score is drawn, [draw, run, instance]; the same for every policy of one shape."""
    return _run_weights(shape, unit, 1) * _instance_weights(shape[1], unit, groups)[:, None]


def _run_weights(shape: tuple[int, ...], unit: Unit, stream: int) -> Array:
    """Of runs, [draw, run, instance or 1]."""
    runs, instances = shape
    if unit == "instances" or (unit == "both" and runs == 1):  # a single run is given
        return np.ones((DRAWS, runs, 1))
    if runs < 2:
        raise ValueError(f"The unit '{unit}' needs two runs or more of each instance (got one).")
    drawn = _drawn(runs, (DRAWS, instances if unit == "within" else 1), stream)
    return drawn.transpose(0, 2, 1)


def _instance_weights(instances: int, unit: Unit, groups: ArrayLike | None) -> Array:
    """Of instances, [draw, instance], with the sum of their number."""
    if unit in ("within", "runs"):
        return np.ones((DRAWS, instances))
    if instances < 2:
        raise ValueError(f"The unit '{unit}' needs two instances or more (got one).")
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
    """How often each of some things is drawn, [*size, thing]."""
    rng = np.random.default_rng(np.random.SeedSequence(0, spawn_key=(stream,)))
    return rng.multinomial(count, np.full(count, 1 / count), size=size).astype(float)


def percentile_interval(at: float, drawn: Array, *, level: float = LEVEL, clusters: int | None = None) -> Interval:
    """The interval of a figure between the percentiles of its values in resamples, [draw].

    Args:
        clusters: Independent draws of the sample, if the interval is to be as much wider as Student's t is.
    """
    if np.ptp(drawn) <= SAME * abs(at):
        return Interval(at, note=f"no variation in {len(drawn)} resamples")
    low, high = _percentiles(drawn, level, clusters)
    return Interval(at, float(low), float(high))


def _percentiles(drawn: Array, level: float, clusters: int | None) -> tuple[Array, Array]:
    tail = (1 - level) / 2
    if clusters is not None:
        n = max(clusters, 2)
        tail = float(norm.cdf(student.ppf(tail, n - 1) * np.sqrt(n / (n - 1))))
    low, high = np.percentile(drawn, [100 * tail, 100 * (1 - tail)], axis=0)
    return low, high


def _checked(scores: ArrayLike) -> Array:
    x = np.asarray(scores, dtype=float)
    if x.ndim != 2 or not x.size or not np.isfinite(x).all():
        raise ValueError(f"Scores must be [run, instance], finite, at least one (got shape {x.shape}).")
    return x
