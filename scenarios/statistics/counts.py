"""Intervals of counts and shares: exact, so that `0 faults in 10 shifts` is not `no faults`."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import beta, chi2

from scenarios.statistics.means import LEVEL, Interval, draws, interval, paired

Array = np.ndarray


def share_bounds(hits: int, count: int, *, level: float = LEVEL) -> tuple[float, float]:
    """Exact interval of a probability after some hits in `count` draws (Clopper & Pearson, Biometrika 26, 1934).

    Raises:
        ValueError: no draws, or more hits than draws.
    """
    if not 0 <= hits <= count or not count:
        raise ValueError(f"Hits must be 0 to the number of draws, at least one draw (got {hits} of {count}).")
    tail = (1 - level) / 2
    low = float(beta.ppf(tail, hits, count - hits + 1)) if hits else 0.0
    high = float(beta.ppf(1 - tail, hits + 1, count - hits)) if hits < count else 1.0
    return low, high


def rate_bounds(events: int, count: int, *, level: float = LEVEL) -> tuple[float, float]:
    """Exact interval of a Poisson mean after `events` in all of `count` draws (Garwood, Biometrika 28, 1936).

    Raises:
        ValueError: no draws, or fewer than no events.
    """
    if events < 0 or count < 1:
        raise ValueError(f"Events must be >= 0 and draws >= 1 (got {events} in {count}).")
    tail = (1 - level) / 2
    low = float(chi2.ppf(tail, 2 * events)) / 2 if events else 0.0
    return low / count, float(chi2.ppf(1 - tail, 2 * events + 2)) / 2 / count


def count_interval(values: ArrayLike, *, level: float = LEVEL) -> Interval:
    """As `interval`, of counts of rare events (≥ 0); where none occurred, the bound of a Poisson mean.

    Args:
        values: [seed] or [fleet, training, seed].
    """
    x = np.asarray(values, dtype=float)
    if x.any() or not x.size:
        return interval(x, least=0.0, level=level)
    return Interval(0.0, *rate_bounds(0, draws(x), level=level), 1.0, f"none in {draws(x)}, Poisson")


def paired_counts(values: ArrayLike, base: ArrayLike, *, level: float = LEVEL) -> Interval:
    """As `paired`, of counts of rare events; where none occurred in either, the difference of two Poisson bounds."""
    x, y = np.asarray(values, dtype=float), np.asarray(base, dtype=float)
    if x.any() or y.any() or x.shape != y.shape:
        return paired(x, y, level=level)
    most = rate_bounds(0, draws(x), level=level)[1]
    return Interval(0.0, -most, most, 1.0, f"none in {draws(x)}, Poisson")
