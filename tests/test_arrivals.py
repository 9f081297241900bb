"""Arrivals: Poisson streams against theory, batches and traces against worked examples."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from fleet.arrivals import Arrivals, arrival_table, sample_arrivals, scale_rate
from fleet.jit import kernel
from fleet.seeding import key_of

HORIZON_S = 8 * 3600.0


@kernel
def sample(table, stream, key, out):
    """The inlined function as one that Python calls."""
    return sample_arrivals(table, stream, key, out)


def release_times(stream: Arrivals, horizon_s: float, seed: int = 0) -> np.ndarray:
    """The arrivals of the second of three streams."""
    table = arrival_table([Arrivals(kind="batch", count=2), stream, Arrivals(kind="trace", times_s=(1.0,))], horizon_s)
    key, out = np.uint64(key_of(np.random.SeedSequence(seed))), np.full(200_000, np.nan)
    count = sample.chosen()(table, 1, key, out)
    assert np.isnan(out[count:]).all()
    if count:
        assert sample.chosen()(table, 1, key, out[: count - 1]) == -1  # no room
    return out[:count].copy()


def test_poisson_counts_have_the_mean_and_the_spread_of_theory() -> None:
    stream, shifts = Arrivals(kind="poisson", every_s=600.0), 4000
    counts = np.array([len(release_times(stream, HORIZON_S, s)) for s in range(shifts)])
    mean = HORIZON_S / 600.0
    # The mean of n counts has the deviation √(μ/n); their variance, μ √(2/n + 1/(μ n)). Four deviations each.
    assert counts.mean() == pytest.approx(mean, abs=4 * np.sqrt(mean / shifts))
    assert counts.var() == pytest.approx(mean, abs=4 * mean * np.sqrt(2 / shifts + 1 / (mean * shifts)))


def test_poisson_gaps_are_exponential_and_times_uniform() -> None:
    times = release_times(Arrivals(kind="poisson", every_s=10.0), 1e6, 5)
    gaps = np.diff(times, prepend=0.0)
    assert stats.kstest(gaps, "expon", args=(0, 10.0)).pvalue > 0.01
    assert stats.kstest(times, "uniform", args=(0, 1e6)).pvalue > 0.01


@given(
    every_s=st.floats(1.0, 1e4),
    start_s=st.floats(0.0, 5e4),
    length_s=st.floats(0.0, 5e4),
    horizon_s=st.floats(0.0, 5e4),
    seed=st.integers(0, 9),
)
def test_poisson_arrivals_are_in_order_and_inside(every_s, start_s, length_s, horizon_s, seed) -> None:
    stream = Arrivals(kind="poisson", every_s=every_s, start_s=start_s, stop_s=start_s + length_s)
    times = release_times(stream, horizon_s, seed)
    assert (np.diff(times) >= 0).all()
    assert ((times >= start_s) & (times <= min(start_s + length_s, horizon_s))).all()
    np.testing.assert_array_equal(times, release_times(stream, horizon_s, seed))


@pytest.mark.parametrize(
    ("stream", "expected"),
    [
        (Arrivals(kind="batch", count=3), [0.0, 0.0, 0.0]),
        (Arrivals(kind="batch", count=2, start_s=10.0, every_s=40.0), [10.0, 10.0, 50.0, 50.0, 90.0, 90.0]),
        (Arrivals(kind="batch", count=1, start_s=100.0), []),
        (Arrivals(kind="batch", count=1, start_s=99.0), [99.0]),
        (Arrivals(kind="batch", count=1, start_s=200.0, every_s=5.0), []),
        (Arrivals(kind="trace", times_s=(0.0, 3.0, 3.0, 99.5, 100.0, 250.0)), [0.0, 3.0, 3.0, 99.5]),
        (Arrivals(kind="trace", times_s=()), []),
        (Arrivals(kind="poisson", every_s=5.0, start_s=100.0), []),
        (Arrivals(kind="poisson", every_s=5.0, start_s=300.0), []),
    ],
)
def test_arrivals_stop_before_the_horizon(stream, expected) -> None:
    assert release_times(stream, 100.0).tolist() == expected


def test_a_scaled_stream_arrives_more_often() -> None:
    stream, shifts = Arrivals(kind="poisson", every_s=600.0, start_s=10.0), 2000
    counts = [len(release_times(scale_rate(stream, 2.5), HORIZON_S, s)) for s in range(shifts)]
    mean = 2.5 * (HORIZON_S - 10.0) / 600.0
    assert np.mean(counts) == pytest.approx(mean, abs=4 * np.sqrt(mean / shifts))
    assert scale_rate(Arrivals(kind="batch", count=2, every_s=30.0), 3.0) == Arrivals(
        kind="batch", count=2, every_s=10.0
    )
    for fixed in (Arrivals(kind="batch", count=2), Arrivals(kind="trace", times_s=(1.0, 2.0))):
        assert scale_rate(fixed, 3.0) == fixed


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Arrivals(kind="poisson", every_s=0.0), r"Arrivals.every_s must be > 0 and finite \(got 0.0\)"),
        (lambda: Arrivals(kind="poisson", every_s=1.0, start_s=5.0, stop_s=4.0), "0 <= start_s <= stop_s"),
        (lambda: Arrivals(kind="poisson", every_s=1.0, start_s=-1.0), "0 <= start_s <= stop_s"),
        (lambda: Arrivals(kind="batch", count=0), r"Arrivals.count must be >= 1 \(got 0\)"),
        (lambda: Arrivals(kind="batch", count=1, start_s=-1.0), "Arrivals.start_s must be >= 0"),
        (lambda: Arrivals(kind="batch", count=1, every_s=0.0), "Arrivals.every_s must be > 0"),
        (lambda: Arrivals(kind="trace", times_s=(3.0, 2.0)), "in order"),
        (lambda: Arrivals(kind="trace", times_s=(-1.0,)), "in order"),
    ],
)
def test_streams_that_cannot_be_are_refused(make, says) -> None:
    with pytest.raises(ValueError, match=says):
        make()


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_numbers_that_are_none_are_refused(bad) -> None:
    for make in (
        lambda: Arrivals(kind="poisson", every_s=bad),
        lambda: Arrivals(kind="poisson", every_s=1.0, start_s=bad),
        lambda: Arrivals(kind="batch", count=1, start_s=bad),
        lambda: Arrivals(kind="batch", count=1, every_s=bad),
        lambda: Arrivals(kind="trace", times_s=(bad,)),
    ):
        with pytest.raises(ValueError, match=r"must be|needs"):
            make()
