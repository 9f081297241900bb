"""Reliability of stated probabilities: Brier score, calibration error, and the table of the reliability diagram."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

Array = np.ndarray

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
