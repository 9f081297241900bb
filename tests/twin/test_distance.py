"""Distances grow with the perturbation, from that of the reconstruction on."""

import numpy as np
import pytest

from twin.distance import apart_rad, distances
from twin.generate import vary


def test_distance_grows_from_that_of_the_reconstruction(twin, make_plan, motion):
    sources = [make_plan(*(motion(np.random.default_rng([i, k]), 5.0) for k in range(3))) for i in range(3)]
    found = distances(twin, sources, seeds=(0, 1, 2))
    assert found.from_source_rad.shape == (6, 3)
    at_zero = [vary(twin, source, 0.0, np.random.default_rng(9)).distance_rad for source in sources]
    np.testing.assert_allclose(found.from_source_rad[0], np.mean(at_zero))
    np.testing.assert_array_equal(found.from_reconstruction_rad[0], 0.0)
    for values in (found.from_source_rad, found.from_source_z, found.from_reconstruction_rad):
        assert np.all(np.diff(values.mean(axis=1)) > 0)
    # Decoders are smooth: twice a small perturbation moves about twice as far.
    twice = found.from_reconstruction_rad[2] / found.from_reconstruction_rad[1]
    np.testing.assert_allclose(twice, 2.0, rtol=0.2)


def test_a_motion_is_as_far_from_itself_as_nothing(twin, plan):
    one, other = (vary(twin, plan, 1.0, np.random.default_rng(seed)) for seed in (1, 2))
    assert apart_rad(one, one) == 0.0
    assert apart_rad(one, other) == apart_rad(other, one) > 0.0


def test_something_must_be_asked(twin, plan):
    with pytest.raises(ValueError, match="at least one source"):
        distances(twin, [])
    with pytest.raises(ValueError, match=r"s must be a number >= 0"):
        distances(twin, [plan], scales=(-1.0,))
