"""Share of 95 % intervals that contain the true mean, and their width, by simulation: the tables of docs/results.md.

python -m benchmarks.statistics.interval_coverage [--out docs/results/coverage.json]   # two minutes of one core
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from benchmarks.harness import options, write_text
from scenarios.evaluate.statistics import FARTHEST, aggregates, by_group, mean_bounds
from scenarios.suite.instances import CELLS

Array = np.ndarray
Law = tuple[Callable[[np.random.Generator, tuple[int, ...]], Array], float]
"""Draws of a distribution in some shape, and its mean."""

LAWS: dict[str, Law] = {
    "normal": (lambda rng, size: rng.normal(size=size), 0.0),
    "uniform": (lambda rng, size: rng.uniform(size=size), 0.5),
    "exponential": (lambda rng, size: rng.exponential(size=size), 1.0),
    "Poisson, mean 0.5": (lambda rng, size: rng.poisson(0.5, size), 0.5),
    "Poisson, mean 3": (lambda rng, size: rng.poisson(3.0, size), 3.0),
    "lognormal, σ = 0.75": (lambda rng, size: rng.lognormal(0.0, 0.75, size), float(np.exp(0.75**2 / 2))),
}
VERY_SKEWED: Law = (lambda rng, size: rng.lognormal(0.0, 1.0, size), float(np.exp(0.5)))
MANY_EQUAL: Law = (
    lambda rng, size: (rng.random(size) < 0.45) * rng.lognormal(0.0, 1.0, size),
    0.45 * float(np.exp(0.5)),
)
"""Differences of policies are 0 in many shifts."""
SEEDS = (3, 5, 10, 20, 40)
SIZES = ((4, 2, 10), (8, 2, 20), (10, 1, 10))
"""Fleets, trainings and seeds."""
MORE_SIZES = ((2, 2, 20), (3, 2, 20), (200, 1, 5))
LIMITS = (1.0, 1.5, FARTHEST, 2.5, 3.0, np.inf)
"""Largest distances of a bound from the mean, as multiples of Student's."""
LIMITED_SEEDS = 10
"""Seeds with which the limits are compared."""
INSTANCES = tuple(cell.instances for cell in CELLS if cell.split == "test")
"""Instances of each cell of the test split."""
PARTS = ((18, 18, 6, 18, 6, 18, 6, 18, 18), (12, 8, 4))
"""Of its cells with at most eight arms where heat binds, and of those with 16 arms or more."""


class Measured(NamedTuple):
    """Intervals of one kind of values."""

    share: float
    """That contain the mean."""
    width: float
    """Mean width, as a multiple of the mean width of Student's intervals of the same values."""


def measured(values: Array, mean: float, farthest: float = FARTHEST) -> Measured:
    """Of [trial, fleet, training, seed]; trials without variation have no interval and do not count."""
    bounds, student = mean_bounds(values, farthest=farthest), mean_bounds(values, farthest=1.0)
    contains = (bounds.low <= mean) & (mean <= bounds.high)
    width = np.nanmean(bounds.high - bounds.low) / np.nanmean(student.high - student.low)
    return Measured(float(contains[np.isfinite(bounds.low)].mean()), float(width))


def measured_law(
    rng: np.random.Generator, law: Law, seeds: int, trials: int = 200_000, farthest: float = FARTHEST
) -> Measured:
    """Of the mean over seeds."""
    draw, mean = law
    return measured(draw(rng, (trials, 1, 1, seeds)), mean, farthest)


def effects(rng: np.random.Generator, size: tuple[int, ...], skewed: bool) -> Array:
    """Normal or exponential values with mean 0."""
    return rng.exponential(size=size) - 1.0 if skewed else rng.normal(size=size)


def shifts(rng: np.random.Generator, trials: int, size: tuple[int, int, int], skewed: bool) -> Array:
    """Values with mean 0: fleets, trainings within fleets, seeds and single shifts all differ."""
    fleets, trainings, seeds = size

    def draw(*shape: int) -> Array:
        return effects(rng, (trials, *shape), skewed)

    by_fleet = draw(fleets, 1, 1) + 0.5 * draw(fleets, trainings, 1)
    return by_fleet + 0.7 * draw(1, 1, seeds) + draw(fleets, trainings, seeds)


def cells_coverage(
    rng: np.random.Generator, skewed: bool, trials: int = 20_000, instances: Sequence[int] = INSTANCES
) -> float:
    """Of the mean over instances of several cells: cells and instances differ alike."""
    groups = np.repeat(np.arange(len(instances)), instances)
    values = effects(rng, (trials, len(instances)), skewed)[:, groups] + effects(rng, (trials, len(groups)), skewed)
    return measured(np.stack([by_group(each[None], groups) for each in values]), 0.0).share


def iqm_coverage(rng: np.random.Generator, instances: int, trials: int = 500) -> float:
    """Of the percentile interval of the IQM of exponential scores, whose true value is a mean of quantiles."""
    true = float(np.mean(stats.expon.ppf(np.linspace(0.25, 0.75, 20_001))))
    found = [aggregates({"x": rng.exponential(size=(1, instances))})["x"].iqm for _ in range(trials)]
    return float(np.mean([each.low <= true <= each.high for each in found]))


def measure() -> dict[str, Any]:
    """Intervals by law and number of seeds, by fleets × trainings × seeds, of IQMs by instances, over cells, by limit.

    Over laws and limits with their widths, else shares only; those of fleets and of cells are pairs, of normal and of
    exponential effects.
    """
    rng = np.random.default_rng(2)
    laws = {**LAWS, "lognormal, σ = 1": VERY_SKEWED}
    parts_rng, zeros_rng = np.random.default_rng(3), np.random.default_rng(4)
    return {
        "seeds": list(SEEDS),
        "laws": {name: [measured_law(rng, law, n)._asdict() for n in SEEDS] for name, law in laws.items()}
        | {"0 in 55 %, else lognormal, σ = 1": [measured_law(zeros_rng, MANY_EQUAL, n)._asdict() for n in SEEDS]},
        "sizes": {
            " × ".join(map(str, size)): [
                measured(shifts(rng, 20_000, size, skewed), 0.0).share for skewed in (False, True)
            ]
            for size in (*SIZES, *MORE_SIZES)
        },
        "iqm": {str(n): iqm_coverage(rng, n) for n in (10, 50, 200)},
        "cells": {
            f"{sum(INSTANCES)} instances of {len(INSTANCES)} cells": [
                cells_coverage(rng, skewed) for skewed in (False, True)
            ]
        }
        | {
            f"{sum(part)} instances of {len(part)} cells": [
                cells_coverage(parts_rng, skewed, instances=part) for skewed in (False, True)
            ]
            for part in PARTS
        },
        "limits": ["none" if np.isinf(limit) else f"{limit:g}" for limit in LIMITS],
        "limited": {
            name: [measured_law(rng, law, LIMITED_SEEDS, farthest=limit)._asdict() for limit in LIMITS]
            for name, law in laws.items()
        },
    }


def main() -> None:
    """Write the shares as JSON."""
    out = options(__doc__, out=Path("docs/results/coverage.json")).out
    write_text(out, json.dumps(measure(), indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
