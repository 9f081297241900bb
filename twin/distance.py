"""How far generated motion is from what it was made from, as a function of the perturbation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.motion import Plan
from twin.generate import Variation, vary
from twin.score import Twin

Array = np.ndarray

SCALES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Perturbations in posterior standard deviations."""
POINTS = 200
"""Per phase, at which two motions of unequal length are compared."""


@dataclass(frozen=True, eq=False)
class Distances:
    """Root mean square distances of joint positions, each [scale, seed], means over the sources."""

    scales: tuple[float, ...]
    from_source_rad: Array
    """At s = 0 it is that of the reconstruction."""
    from_source_z: Array
    """The same in training standard deviations of each joint."""
    from_reconstruction_rad: Array
    """From what the same source gives at s = 0; zero there, and about proportional to s while s is small."""


def distances(
    twin: Twin, sources: Sequence[Plan], *, scales: Sequence[float] = SCALES, seeds: Sequence[int] = (0, 1, 2)
) -> Distances:
    """Distances of motion as generated, before anything is verified. A seed draws the same noise at every scale.

    Raises:
        ValueError: no source, scale or seed, or as `twin.generate.vary`.
    """
    if not sources or not scales or not seeds:
        raise ValueError("Distances need at least one source motion, one scale and one seed.")
    shape = (len(scales), len(seeds), len(sources))
    rad, z, moved = (np.empty(shape) for _ in range(3))
    for i, source in enumerate(sources):
        still = vary(twin, source, 0.0, np.random.default_rng(0))
        for n, seed in enumerate(seeds):
            for k, s in enumerate(scales):
                made = vary(twin, source, s, np.random.default_rng([seed, i]))
                rad[k, n, i], z[k, n, i] = made.distance_rad, made.distance_z
                moved[k, n, i] = apart_rad(made, still)
    return Distances(tuple(scales), *(values.mean(axis=-1) for values in (rad, z, moved)))


def apart_rad(one: Variation, other: Variation) -> float:
    """Root mean square distance of two variations of one source, at equal shares of the time of each phase."""
    parts = [
        _shape(a.q) - _shape(b.q) for a, b in zip(one.stretches, other.stretches, strict=True) if len(a) and len(b)
    ]
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def _shape(q: Array) -> Array:
    at = np.linspace(0.0, len(q) - 1.0, POINTS)
    return np.stack([np.interp(at, np.arange(len(q)), column) for column in q.T], axis=1)
