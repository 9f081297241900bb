"""Classical novelty detectors of scikit-learn, one per joint, on the plain features of its windows."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from sklearn.covariance import LedoitWolf
from sklearn.ensemble import IsolationForest
from sklearn.neighbors import NearestNeighbors
from sklearn.preprocessing import StandardScaler

from twin.features import window_features
from twin.rivals import ByWindow, Known

Array = np.ndarray

NEIGHBOURS = 5


class Detector(Protocol):
    """One joint's novelty detector on standardised features."""

    def distance(self, features: Array) -> Array:
        """Features [batch, feature] to [batch]; more is stranger."""
        ...


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Mean distance to the nearest training windows (Ramaswamy et al., SIGMOD 2000, mean instead of the last)."""

    index: NearestNeighbors

    @classmethod
    def fit(cls, features: Array, count: int = NEIGHBOURS) -> "Neighbours":
        """Of training features [batch, feature]; needs at least `count` of them."""
        if len(features) < count:
            raise ValueError(f"{count} nearest neighbours need as many training windows (got {len(features)}).")
        return cls(NearestNeighbors(n_neighbors=count).fit(features))

    def distance(self, features: Array) -> Array:
        """[batch, feature] to [batch]."""
        return self.index.kneighbors(features)[0].mean(axis=1)


@dataclass(frozen=True, eq=False)
class Mahalanobis:
    """Mahalanobis distance with shrunk covariance (Ledoit & Wolf, J. Multivariate Analysis 88, 2004)."""

    covariance: LedoitWolf

    @classmethod
    def fit(cls, features: Array) -> "Mahalanobis":
        """Of training features [batch, feature]."""
        return cls(LedoitWolf().fit(features))

    def distance(self, features: Array) -> Array:
        """[batch, feature] to [batch]."""
        return np.sqrt(self.covariance.mahalanobis(features))


@dataclass(frozen=True, eq=False)
class Forest:
    """Isolation forest (Liu et al., ICDM 2008), anomaly score in (0, 1]."""

    trees: IsolationForest

    @classmethod
    def fit(cls, features: Array, seed: int) -> "Forest":
        """Of training features [batch, feature]."""
        return cls(IsolationForest(random_state=seed).fit(features))

    def distance(self, features: Array) -> Array:
        """[batch, feature] to [batch]."""
        return -self.trees.score_samples(features)


@dataclass(frozen=True, eq=False)
class Novelty:
    """A detector per joint on the window's features, standardised; its word holds for all samples of the window."""

    scales: tuple[StandardScaler, ...]
    detectors: tuple[Detector, ...]

    def __call__(self, z: Array) -> Array:
        """Distance [batch, time, joint]."""
        features = window_features(z)
        pairs = enumerate(zip(self.scales, self.detectors, strict=True))
        found = np.stack(
            [detector.distance(np.asarray(scale.transform(features[:, j]))) for j, (scale, detector) in pairs], axis=1
        )
        return np.broadcast_to(found[:, None], (len(z), z.shape[1], z.shape[2]))


def _novelty(name: str, cool: Known, fit: Callable[[Array, int], Detector]) -> ByWindow:
    """`fit` makes a joint's detector of its standardised features [batch, feature] and its index."""
    features = window_features(cool.z)
    joints = range(cool.scaler.joints)
    scales = tuple(StandardScaler().fit(features[:, j]) for j in joints)
    detectors = tuple(
        fit(np.asarray(scale.transform(features[:, j])), j) for j, scale in zip(joints, scales, strict=True)
    )
    return ByWindow(name, cool.config, cool.scaler, Novelty(scales, detectors))


def nearest_neighbours(cool: Known, count: int = NEIGHBOURS) -> ByWindow:
    """kNN distance per joint on 18 window features."""
    return _novelty(f"kNN-{count}", cool, lambda features, _: Neighbours.fit(features, count))


def mahalanobis(cool: Known) -> ByWindow:
    """Mahalanobis distance per joint on 18 window features."""
    return _novelty("Mahalanobis", cool, lambda features, _: Mahalanobis.fit(features))


def isolation_forest(cool: Known, seed: np.random.SeedSequence) -> ByWindow:
    """Isolation forest per joint on 18 window features; trees drawn by the seed."""
    seeds = seed.generate_state(cool.scaler.joints).tolist()
    return _novelty("isolation forest", cool, lambda features, joint: Forest.fit(features, seeds[joint]))
