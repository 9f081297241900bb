"""How often 95 % intervals contain the true mean, by simulation."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.statistics.interval_coverage import LAWS, SIZES, VERY_SKEWED, coverage, law_coverage, measure, shifts

FILE = Path(__file__).parents[2] / "docs/results/coverage.json"


@pytest.mark.parametrize("name", LAWS)
def test_ten_seeds_cover(name):
    assert law_coverage(np.random.default_rng(0), LAWS[name], 10, trials=20_000) >= 0.94


def test_ten_very_skewed_values_cover_less():
    """Lognormal, σ = 1, skewness 6.2: .927, where Student's t has .84. Twenty values cover .94."""
    rng = np.random.default_rng(0)
    assert 0.92 <= law_coverage(rng, VERY_SKEWED, 10, trials=20_000) <= 0.94
    assert law_coverage(rng, VERY_SKEWED, 20, trials=20_000) >= 0.94


@pytest.mark.parametrize("skewed", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_fleets_trainings_and_seeds_cover(size, skewed):
    values = shifts(np.random.default_rng(1), 2000, size, skewed)
    assert coverage(values, 0.0) >= 0.94
    flat = values.reshape(len(values), -1)
    naive = np.abs(flat.mean(axis=1)) < 1.96 * flat.std(axis=1, ddof=1) / np.sqrt(flat.shape[1])
    assert naive.mean() < 0.75  # one over shifts, as if they were independent


@pytest.mark.slow
def test_coverage_of_every_law_and_size():
    """The shares of docs/results.md repeat, and none is much too small."""
    measured, stored = measure(), json.loads(FILE.read_text(encoding="utf-8"))
    assert list(measured) == list(stored)
    for name in ("laws", "sizes"):
        assert list(measured[name]) == list(stored[name])
        for key, shares in measured[name].items():
            assert shares == pytest.approx(stored[name][key], abs=0.001), key
    assert measured["iqm"] == pytest.approx(stored["iqm"], abs=0.005)
    assert measured["cells"] == pytest.approx(stored["cells"], abs=0.001)
    assert min(measured["iqm"].values()) >= 0.92
    assert min(measured["cells"]) >= 0.92
    assert all(shares[measured["seeds"].index(10)] >= 0.94 for name, shares in measured["laws"].items() if name in LAWS)
    assert min(measured["sizes"]["10 × 1 × 10"]) >= 0.94
