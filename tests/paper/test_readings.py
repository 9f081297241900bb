"""Readings of a twin's errors and the sides of its latent space, by hand and by synthetic features."""

import numpy as np
import pytest

from benchmarks.paper.readings import JOINTS, MEASURES, TOTALS, Errors, reading_cells, share_of
from scenarios.evaluate.statistics import interval
from twin.vae.measures import PARTS, Calibration, Features, moments


def test_readings_rank_more_error_higher_and_tell_jobs_apart() -> None:
    rng = np.random.default_rng(4)
    known = Features(rng.gamma(2.0, 0.2, (40, 7, PARTS + moments(2))))
    calibration = Calibration(known, np.zeros(40, int))
    less = known.packed[:10]
    more = less.copy()
    more[..., :PARTS] *= 1.7
    weight = rng.dirichlet(np.ones(7)) * 7
    for name, reading in {**TOTALS, **JOINTS}.items():
        low, high = (reading(Errors(Features(packed), calibration, weight)) for packed in (less, more))
        assert np.all(high >= low), name
        if not name.startswith("latent"):
            assert np.any(high > low), name


def test_shares_have_their_intervals() -> None:
    share, low, high = share_of(np.repeat([True, False], [9, 1]))
    # Wilson's interval of 9 of 10, Agresti & Coull, The American Statistician 52 (1998): centre (9 + 1.92) / 13.84.
    assert share == 0.9
    assert (low + high) / 2 == pytest.approx((9 + 1.96**2 / 2) / (10 + 1.96**2), abs=1e-3)


def test_readings_are_means_over_arms_not_over_their_seeds() -> None:
    values = {"s/a/0": 0.1, "s/a/1": 0.3, "s/b/0": 0.5, "s/b/1": None, "s/c/0": 0.6, "s/c/1": 0.6}
    measures = {name: dict.fromkeys(MEASURES) | {"auroc": value} for name, value in values.items()}
    rows = [{"arm": name, "any": {"d": each}} for name, each in measures.items()]
    ((reading, found),) = reading_cells(rows, "any").items()
    assert reading == "d"
    assert found["auroc"] == interval([0.2, 0.5, 0.6], least=0.0, most=1.0)
    assert np.isnan(found["hits"].mean)
