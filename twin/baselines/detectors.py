"""Novelty detectors of scikit-learn, one per joint, on 18 statistics of each window."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from sklearn.covariance import LedoitWolf
from sklearn.ensemble import IsolationForest
from sklearn.neighbors import NearestNeighbors
from sklearn.preprocessing import StandardScaler

from fleet.motion import CHANNELS
from twin.baselines.reconstruction import CoolWindows, WindowScorer

Array = np.ndarray

NEIGHBOURS = 5
STATISTICS = ("mean", "std", "rms", "min", "max", "step")
"""Per channel over the window's time; `step` is the mean absolute difference from one sample to the next."""
FEATURES = tuple(f"{statistic}_{channel}" for statistic in STATISTICS for channel in CHANNELS)


def window_statistics(windows: Array) -> Array:
    """The 18 `FEATURES` of each joint, [batch, joint, feature], of windows [batch, time, joint, channel].

    Raises:
        ValueError: windows of another shape, or of fewer than two samples.
    """
    if windows.ndim != 4 or windows.shape[1] < 2 or windows.shape[3] != len(CHANNELS):
        raise ValueError(f"Windows must be [batch, time >= 2, joint, {len(CHANNELS)}] (got {windows.shape}).")
    x = np.asarray(windows, dtype=float)
    rms, step = np.sqrt(np.square(x).mean(axis=1)), np.abs(np.diff(x, axis=1)).mean(axis=1)
    return np.concatenate([x.mean(axis=1), x.std(axis=1), rms, x.min(axis=1), x.max(axis=1), step], axis=-1)


def neighbour_distance(index: NearestNeighbors, features: Array) -> Array:
    """Mean distance to the nearest training windows (Ramaswamy et al., SIGMOD 2000, mean instead of the last)."""
    return index.kneighbors(features)[0].mean(axis=1)


def mahalanobis_distance(covariance: LedoitWolf, features: Array) -> Array:
    """Mahalanobis distance with shrunk covariance (Ledoit & Wolf, J. Multivariate Analysis 88, 2004)."""
    return np.sqrt(covariance.mahalanobis(features))


def isolation_score(trees: IsolationForest, features: Array) -> Array:
    """Anomaly score of an isolation forest (Liu et al., ICDM 2008), (0, 1]."""
    return -trees.score_samples(features)


def nearest_neighbours(cool: CoolWindows, count: int = NEIGHBOURS) -> WindowScorer:
    """Distance to the `count` nearest training windows.

    Raises:
        ValueError: fewer training windows than neighbours.
    """
    if len(cool.z) < count:
        raise ValueError(f"{count} nearest neighbours need as many training windows (got {len(cool.z)}).")
    return _detector(f"kNN-{count}", cool, lambda _: NearestNeighbors(n_neighbors=count), neighbour_distance)


def mahalanobis(cool: CoolWindows) -> WindowScorer:
    """Mahalanobis distance from the training windows."""
    return _detector("Mahalanobis", cool, lambda _: LedoitWolf(), mahalanobis_distance)


def isolation_forest(cool: CoolWindows, seed: np.random.SeedSequence) -> WindowScorer:
    """Isolation forest; the seed determines the trees."""
    seeds = seed.generate_state(cool.scaler.joints).tolist()
    return _detector("isolation forest", cool, lambda j: IsolationForest(random_state=seeds[j]), isolation_score)


@dataclass(frozen=True, eq=False)
class _WindowDistance:
    """A distance per joint on the window's standardised statistics, the same for all samples of the window."""

    fitted: tuple[tuple[StandardScaler, Any], ...]  # Any: an estimator of scikit-learn
    distance: Callable[[Any, Array], Array]

    def __call__(self, z: Array) -> Array:
        """Windows in z-scores [batch, time, joint, channel] to [batch, time, joint]."""
        features = np.moveaxis(window_statistics(z), 1, 0)
        pairs = zip(self.fitted, features, strict=True)
        columns = [self.distance(model, np.asarray(scale.transform(x))) for (scale, model), x in pairs]
        return np.broadcast_to(np.stack(columns, axis=1)[:, None], z.shape[:3])


def _detector(
    name: str, cool: CoolWindows, make: Callable[[int], Any], distance: Callable[[Any, Array], Array]
) -> WindowScorer:
    """A scorer from an unfitted estimator per joint index and its distance of features [batch, feature], [batch]."""
    fitted = []
    for j, x in enumerate(np.moveaxis(window_statistics(cool.z), 1, 0)):
        scale = StandardScaler().fit(x)
        fitted.append((scale, make(j).fit(np.asarray(scale.transform(x)))))
    return WindowScorer(name, cool.config, cool.scaler, _WindowDistance(tuple(fitted), distance))
