"""How often 95 % intervals contain the true mean, by simulation."""

import numpy as np
import pytest
from scipy import stats

from scenarios.statistics.means import mean_bounds
from scenarios.statistics.suites import aggregates, by_group

LAWS = {
    "normal": (lambda rng, size: rng.normal(size=size), 0.0),
    "uniform": (lambda rng, size: rng.uniform(size=size), 0.5),
    "exponential": (lambda rng, size: rng.exponential(size=size), 1.0),
    "Poisson, mean 0.5": (lambda rng, size: rng.poisson(0.5, size), 0.5),
    "Poisson, mean 3": (lambda rng, size: rng.poisson(3.0, size), 3.0),
    "lognormal, σ = 0.75": (lambda rng, size: rng.lognormal(0.0, 0.75, size), np.exp(0.75**2 / 2)),
}
VERY_SKEWED = (lambda rng, size: rng.lognormal(0.0, 1.0, size), np.exp(0.5))
SIZES = ((4, 2, 10), (8, 2, 20), (10, 1, 10))
"""Fleets, trainings and seeds."""


def coverage(values: np.ndarray, mean: float) -> float:
    """Of [trial, fleet, training, seed]; trials without variation have no interval and do not count."""
    found = mean_bounds(values)
    some = np.isfinite(found.low)
    return float(((found.low <= mean) & (mean <= found.high))[some].mean())


def shifts(rng: np.random.Generator, trials: int, size: tuple[int, int, int], skewed: bool) -> np.ndarray:
    """Values with mean 0: fleets, trainings within fleets, seeds and single shifts all differ."""
    fleets, trainings, seeds = size

    def draw(*shape: int) -> np.ndarray:
        return rng.exponential(size=(trials, *shape)) - 1.0 if skewed else rng.normal(size=(trials, *shape))

    by_fleet = draw(fleets, 1, 1) + 0.5 * draw(fleets, trainings, 1)
    return by_fleet + 0.7 * draw(1, 1, seeds) + draw(fleets, trainings, seeds)


@pytest.mark.parametrize("name", LAWS)
def test_ten_seeds_cover(name):
    draw, mean = LAWS[name]
    assert coverage(draw(np.random.default_rng(0), (20_000, 1, 1, 10)), mean) >= 0.94


def test_ten_very_skewed_values_cover_less():
    """Lognormal, σ = 1, skewness 6.2: .927, where Student's t has .84. Twenty values cover .94."""
    draw, mean = VERY_SKEWED
    rng = np.random.default_rng(0)
    assert 0.92 <= coverage(draw(rng, (20_000, 1, 1, 10)), mean) <= 0.94
    assert coverage(draw(rng, (20_000, 1, 1, 20)), mean) >= 0.94


@pytest.mark.parametrize("skewed", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_fleets_trainings_and_seeds_cover(size, skewed):
    values = shifts(np.random.default_rng(1), 2000, size, skewed)
    assert coverage(values, 0.0) >= 0.94
    flat = values.reshape(len(values), -1)
    naive = np.abs(flat.mean(axis=1)) < 1.96 * flat.std(axis=1, ddof=1) / np.sqrt(flat.shape[1])
    assert naive.mean() < 0.75  # one over shifts, as if they were independent


def iqm_coverage(rng: np.random.Generator, instances: int, trials: int = 500) -> float:
    """Of the percentile interval of the IQM of exponential scores, whose true value is a mean of quantiles."""
    true = float(np.mean(stats.expon.ppf(np.linspace(0.25, 0.75, 20_001))))
    found = [aggregates({"x": rng.exponential(size=(1, instances))})["x"].iqm for _ in range(trials)]
    return float(np.mean([each.low <= true <= each.high for each in found]))


def cells_coverage(rng: np.random.Generator, skewed: bool, trials: int = 20_000) -> float:
    """Of the mean over the instances of cells as many as the test split has: cells and instances differ alike."""
    groups = np.repeat(np.arange(9), (30, 30, 30, 30, 30, 24, 12, 8, 6))
    draw = (lambda size: rng.exponential(size=size) - 1.0) if skewed else (lambda size: rng.normal(size=size))
    values = draw((trials, 9))[:, groups] + draw((trials, len(groups)))
    return coverage(np.stack([by_group(each[None], groups) for each in values]), 0.0)


@pytest.mark.slow
def test_coverage_of_every_law_and_size(capsys):
    """Prints the table of docs/results.md: `pytest -m slow tests/statistics/test_coverage.py`."""
    rng, counts = np.random.default_rng(2), (3, 5, 10, 20, 40)
    laws = {**LAWS, "lognormal, σ = 1": VERY_SKEWED}
    table = {
        name: [coverage(draw(rng, (200_000, 1, 1, n)), mean) for n in counts] for name, (draw, mean) in laws.items()
    }
    crossed = {
        (s, k): coverage(shifts(rng, 20_000, s, k), 0.0)
        for s in (*SIZES, (2, 2, 20), (3, 2, 20), (200, 1, 5))
        for k in (False, True)
    }
    iqm = {n: iqm_coverage(rng, n) for n in (10, 50, 200)}
    cells = [cells_coverage(rng, skewed) for skewed in (False, True)]
    with capsys.disabled():
        print("\n| values | " + " | ".join(f"n = {n}" for n in counts) + " |\n|---" + "|---" * len(counts) + "|")
        for name, row in table.items():
            print(f"| {name} | " + " | ".join(f"{share:.3f}" for share in row) + " |")
        for (size, skewed), share in crossed.items():
            print(f"{' × '.join(map(str, size))} {'exponential' if skewed else 'normal'}: {share:.3f}")
        print("IQM of exponential scores: " + ", ".join(f"{n} instances {share:.3f}" for n, share in iqm.items()))
        print(f"200 instances of 9 unequal cells, normal and exponential: {cells[0]:.3f}, {cells[1]:.3f}")
    assert all(share >= 0.92 for share in iqm.values())
    assert min(cells) >= 0.92
    assert all(row[counts.index(10)] >= 0.94 for name, row in table.items() if name in LAWS)
    assert all(share >= 0.94 for (size, _), share in crossed.items() if min(size[0], size[2]) >= 10)
