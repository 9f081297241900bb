"""Statistics against SciPy, arch, closed forms and simulated coverage."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from benchmarks.statistics.interval_coverage import (
    INSTANCES,
    LAWS,
    SIZES,
    VERY_SKEWED,
    measure,
    measured,
    measured_law,
    shifts,
)
from scenarios.evaluate.statistics import (
    EQUAL,
    FARTHEST,
    SKEW_BIAS,
    FigureKind,
    aggregates,
    by_group,
    count_interval,
    figure_rows,
    figures_of,
    holm,
    improvement,
    interval,
    mean_bounds,
    paired,
    paired_counts,
    profile,
    rate_bounds,
    remarks,
    share_bounds,
    unit,
)
from scenarios.suite.splits import manifest


@pytest.mark.parametrize(("hits", "count"), [(0, 10), (3, 10), (10, 10), (1, 1)])
def test_a_share_has_the_exact_interval(hits, count):
    expected = stats.binomtest(hits, count).proportion_ci(method="exact")
    assert share_bounds(hits, count) == pytest.approx((expected.low, expected.high))


def test_a_rate_has_the_exact_interval():
    """Garwood 1936, table 1: 0 events 0 to 3.69, 1 event 0.0253 to 5.57, 10 events 4.80 to 18.39."""
    table = {0: (0.0, 3.69), 1: (0.0253, 5.57), 10: (4.80, 18.39)}
    for events, bounds in table.items():
        assert rate_bounds(events, 1) == pytest.approx(bounds, abs=0.005)
    low, high = rate_bounds(7, 4)
    assert stats.poisson.sf(6, 4 * low) == pytest.approx(0.025)
    assert stats.poisson.cdf(7, 4 * high) == pytest.approx(0.025)


def test_no_fault_in_ten_shifts_is_not_no_fault():
    none = count_interval(np.zeros(10))
    assert (none.mean, none.low, none.high) == (0.0, 0.0, pytest.approx(0.369, abs=0.001))
    assert none.note == "none in 10, Poisson"
    both = paired_counts(np.zeros(10), np.zeros(10))
    assert (both.low, both.high, both.p) == (-none.high, none.high, 1.0)
    for size in ((3, 2, 20), (1, 3, 20), (20, 1, 3)):
        assert count_interval(np.zeros(size)).high == pytest.approx(3.689 / 3, abs=0.001)
        assert interval(np.ones(size)).note == "no variation in 3"
    some = np.array([0.0, 1.0, 0.0, 3.0])
    assert count_interval(some) == interval(some, least=0.0)
    assert paired_counts(some, np.zeros(4)) == paired(some, np.zeros(4))


@pytest.mark.parametrize("mean", [0.02, 0.1, 0.3, 1.0, 5.0])
def test_counts_are_covered(mean):
    rng = np.random.default_rng(1)
    found = [count_interval(rng.poisson(mean, 10)) for _ in range(300)]
    assert np.mean([each.low <= mean <= each.high for each in found if not np.isnan(each.low)]) >= 0.94


@pytest.mark.parametrize("size", [(1, 3, 20), (3, 1, 20), (3, 2, 20), (20, 1, 3)])
def test_rare_counts_are_covered_if_some_fleets_trainings_or_seeds_alone_have_events(size):
    """Each cluster of the scarcer kind has one event per shift with probability q, or none: the mean is q."""
    rng, q = np.random.default_rng(3), 0.2
    clusters = tuple(count if count == 3 else 1 for count in size)
    intervals = [count_interval(rng.poisson(np.broadcast_to(rng.random(clusters) < q, size))) for _ in range(1000)]
    assert np.mean([each.low <= q <= each.high for each in intervals]) >= 0.94


def test_bad_values_and_scores_are_refused() -> None:
    for hits, count in ((3, 2), (-1, 2), (0, 0)):
        with pytest.raises(ValueError, match="Hits must be 0"):
            share_bounds(hits, count)
    with pytest.raises(ValueError, match="Events must be"):
        rate_bounds(-1, 2)
    for values in ([], [1.0, np.nan], [[1.0, 2.0]]):
        with pytest.raises(ValueError, match="Values must be"):
            interval(values)
    with pytest.raises(ValueError, match="equal shapes"):
        paired([1.0, 2.0], [1.0])
    for bad in ([[1.0, np.nan]], [1.0]):
        with pytest.raises(ValueError, match="Scores must be"):
            aggregates({"x": bad})
    with pytest.raises(ValueError, match="Scores need two instances"):
        aggregates({"x": [[1.0], [2.0]]})
    with pytest.raises(ValueError, match="same instances"):
        improvement([[1.0, 2.0]], [[1.0]])


SYMMETRIC = np.array([-4.0, -1.0, 0.0, 1.0, 4.0]) + 2.0


def student(values: np.ndarray) -> tuple[float, float]:
    low, high = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    return float(low), float(high)


def test_without_skewness_the_interval_and_the_test_are_student_s() -> None:
    found = interval(SYMMETRIC)
    assert (found.low, found.high) == pytest.approx(student(SYMMETRIC))
    assert found.p == pytest.approx(stats.ttest_1samp(SYMMETRIC, 0.0).pvalue)
    base = SYMMETRIC[::-1] ** 2
    assert paired(base + SYMMETRIC, base).p == pytest.approx(stats.ttest_rel(base + SYMMETRIC, base).pvalue)


def test_a_skewed_sample_reaches_as_far_as_hall_s_transformation() -> None:
    """Hall, JRSS B 54 (1992): g(T) = T + a (2 T² + 1) + 4/3 a² T³, a = skewness / (6 √n), is nearly Student's t."""
    x = np.random.default_rng(5).exponential(size=12) ** 0.7
    found, (_, high) = interval(x), student(x)
    t = (x.mean() - found.high) / stats.sem(x)
    a = (1 + SKEW_BIAS / 12) * stats.skew(x) / 6 / np.sqrt(12)
    assert t + a * (2 * t**2 + 1) + 4 / 3 * a**2 * t**3 == pytest.approx(stats.t.ppf(0.025, 11))
    assert found.high > high
    assert found.low == pytest.approx(student(x)[0])  # the other bound is Student's
    far, (_, high) = interval(x**3), student(x**3)
    assert far.high - far.mean == pytest.approx(FARTHEST * (high - far.mean))


def test_variances_are_clustered_by_fleet_and_by_seed() -> None:
    """Without differences between fleets the interval is that of seeds, and the other way round; equal ones add."""
    of_seeds = interval(np.tile(SYMMETRIC, (200, 2, 1)))  # [fleet, training, seed]
    assert (of_seeds.low, of_seeds.high) == pytest.approx(student(SYMMETRIC), rel=0.01)
    fleets = np.array([1.0, 4.0, 7.0])
    of_fleets = interval(np.tile(fleets[:, None, None], (1, 2, 500)))
    assert (of_fleets.low, of_fleets.high) == pytest.approx(student(fleets), rel=0.01)
    effect = np.linspace(-1.0, 1.0, 41)
    both = interval(effect[:, None, None] + effect)
    variance = 2 * effect.var(ddof=1) / 41
    assert both.margin == pytest.approx(stats.t.ppf(0.975, 40) * np.sqrt(variance), rel=0.02)


def test_trainings_are_the_sample_within_a_single_fleet_unless_they_change_nothing() -> None:
    trainings = np.array([1.0, 4.0, 7.0])
    found = interval(np.tile(trainings[None, :, None], (1, 1, 500)))
    assert (found.low, found.high) == pytest.approx(student(trainings), rel=0.01)
    assert interval(np.tile(SYMMETRIC, (1, 3, 1))) == interval(SYMMETRIC)


@given(st.lists(st.integers(-50, 50), min_size=2, max_size=12).filter(lambda x: len(set(x)) > 1), st.floats(0.5, 0.999))
def test_the_test_rejects_exactly_when_the_interval_excludes_zero(values: list[int], level: float) -> None:
    found = interval(values, level=level)
    if abs(found.p - (1 - level)) > 1e-9:
        assert found.excludes_zero == (found.p < 1 - level)
    assert found.low < found.mean < found.high
    mirrored = interval([-x for x in values], level=level)
    assert (-mirrored.high, -mirrored.low) == pytest.approx((found.low, found.high), abs=1e-8)
    scaled = interval([3.0 * x + 7.0 for x in values], level=level)
    assert (scaled.low, scaled.high) == pytest.approx((3 * found.low + 7, 3 * found.high + 7), abs=1e-8)


def test_many_means_at_once_are_those_one_by_one() -> None:
    x = np.random.default_rng(0).exponential(size=(4, 5, 3, 2, 6))
    many = mean_bounds(x)
    one = interval(x[2, 3])
    assert (many.low[2, 3], many.high[2, 3], many.p[2, 3]) == pytest.approx((one.low, one.high, one.p))


def test_no_variation_is_not_certainty() -> None:
    assert np.isnan(interval(np.full(5, 4.0)).low)
    assert interval(np.full(5, 4.0)).note == "no variation in 5"
    assert interval([4.0]).note == "one value"
    assert interval(np.full((3, 2, 20), 1.0)).note == "no variation in 3"
    # At the end of a range there is a bound: of a probability by Clopper & Pearson.
    certain = interval(np.ones(10), least=0.0, most=1.0)
    assert (certain.low, certain.high) == pytest.approx(tuple(stats.binomtest(10, 10).proportion_ci()))
    assert interval([0.0, 0.0, 0.0, 3.0], least=0.0).low == 0.0


def test_what_has_a_single_fleet_stands_for_all_in_a_difference() -> None:
    rng = np.random.default_rng(0)
    several, single = rng.normal(1.0, 1.0, (3, 1, 20)), rng.normal(size=(1, 1, 20))
    assert paired(several, single) == paired(several, np.tile(single, (3, 1, 1)))
    assert paired(several, single).mean == -paired(single, several).mean


def test_the_unit_says_what_is_fixed() -> None:
    assert unit((8, 2, 20)) == "8 fleets × 2 trainings × 20 seeds"
    assert unit((1, 1, 10)) == "10 seeds, this fleet only"
    assert unit((4, 1, 1)) == "4 fleets, this seed only"


def test_holm_rejects_what_the_procedure_of_the_paper_rejects() -> None:
    """Step down (Holm 1979): the least p is compared with α / m, the next with α / (m − 1), until one is not below."""
    rng, alpha = np.random.default_rng(0), 0.05
    for _ in range(200):
        p = rng.uniform(0, 0.05, 6)
        rejected, left = set[int](), list(np.argsort(p))
        while left and p[left[0]] < alpha / len(left):
            rejected.add(int(left.pop(0)))
        assert set(np.flatnonzero(holm(p) < alpha)) == rejected
    found = holm([[0.01, np.nan], [0.04, 0.03]])
    np.testing.assert_allclose(found, [[0.03, np.nan], [0.06, 0.06]])


FILE = Path(__file__).parents[2] / "docs/results/coverage.json"


@pytest.mark.parametrize("name", LAWS)
def test_ten_seeds_cover(name):
    assert measured_law(np.random.default_rng(0), LAWS[name], 10, trials=20_000).share >= 0.94


def test_ten_very_skewed_values_cover_less():
    """Lognormal, σ = 1, skewness 6.2: .927, where Student's t has .84. Twenty values cover .94."""
    rng = np.random.default_rng(0)
    assert 0.92 <= measured_law(rng, VERY_SKEWED, 10, trials=20_000).share <= 0.94
    assert measured_law(rng, VERY_SKEWED, 20, trials=20_000).share >= 0.94


def test_the_limit_1_gives_student_s_intervals_and_a_limit_bounds_the_width() -> None:
    """Student's cover normal values with .95 exactly; their bounds are those of SciPy."""
    rng = np.random.default_rng(0)
    share, width = measured_law(rng, LAWS["normal"], 10, trials=40_000, farthest=1.0)
    assert (share, width) == (pytest.approx(0.95, abs=0.005), 1.0)
    x = rng.lognormal(size=(5, 10))
    found = mean_bounds(x[:, None, None], farthest=1.0)
    low, high = stats.ttest_1samp(x, 0.0, axis=1).confidence_interval(0.95)
    np.testing.assert_allclose((found.low, found.high), (low, high))
    np.testing.assert_allclose(found.p, stats.ttest_1samp(x, 0.0, axis=1).pvalue)
    widths = [measured(x[:, None, None], 1.0, limit).width for limit in (1.5, FARTHEST, np.inf)]
    assert widths == sorted(widths)
    assert widths[0] <= 1.25  # one bound is Student's, the other is at most 1.5 times as far
    assert widths[1] <= 1.5


def test_the_cells_of_the_simulation_are_those_of_the_test_split() -> None:
    assert sorted(INSTANCES) == sorted(Counter(row.cell for row in manifest("test")).values())


@pytest.mark.parametrize("skewed", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_fleets_trainings_and_seeds_cover(size, skewed):
    values = shifts(np.random.default_rng(1), 2000, size, skewed)
    assert measured(values, 0.0).share >= 0.94
    flat = values.reshape(len(values), -1)
    naive = np.abs(flat.mean(axis=1)) < 1.96 * flat.std(axis=1, ddof=1) / np.sqrt(flat.shape[1])
    assert naive.mean() < 0.75  # one over shifts, as if they were independent


@pytest.mark.slow
def test_coverage_of_every_law_and_size():
    """The shares and widths of docs/results.md repeat, and no share is much too small."""
    found, stored = measure(), json.loads(FILE.read_text(encoding="utf-8"))
    assert list(found) == list(stored)
    for name in ("laws", "limited"):
        assert list(found[name]) == list(stored[name])
        for key, cells in found[name].items():
            for cell, kept in zip(cells, stored[name][key], strict=True):
                assert cell == pytest.approx(kept, abs=0.001), key
    for name in ("sizes", "cells"):
        assert list(found[name]) == list(stored[name])
        for key, shares in found[name].items():
            assert shares == pytest.approx(stored[name][key], abs=0.001), key
    assert found["iqm"] == pytest.approx(stored["iqm"], abs=0.005)
    assert min(found["iqm"].values()) >= 0.92
    assert min(min(shares) for shares in found["cells"].values()) >= 0.92
    ten = found["seeds"].index(10)
    assert all(cells[ten]["share"] >= 0.94 for name, cells in found["laws"].items() if name in LAWS)
    assert min(found["sizes"]["10 × 1 × 10"]) >= 0.94


KINDS = {"faults": FigureKind("faults", is_count=True)}


@pytest.fixture
def paired_values() -> dict[str, dict[str, np.ndarray]]:
    """Ten seeds: `better` clearly, `luck` at p = .02 by itself, `same` by a constant."""
    rng = np.random.default_rng(0)
    jobs, noise = rng.normal(100.0, 30.0, 10), rng.normal(0.0, 1.0, 10)
    noise = (noise - noise.mean()) / noise.std(ddof=1)
    value = {"base": jobs, "better": jobs + 8.0 + noise, "luck": jobs + 1.1 + noise, "same": jobs + 2.0}
    return {policy: {"value": each, "faults": np.zeros(10)} for policy, each in value.items()}


def test_differences_are_paired_and_corrected_over_the_table(paired_values):
    found = figures_of(paired_values, "base", KINDS)
    better, luck = found["better"]["value"], found["luck"]["value"]
    expected = paired(paired_values["better"]["value"], paired_values["base"]["value"])
    assert (better.difference, better.difference_low) == (expected.mean, expected.low)
    assert better.low == interval(paired_values["better"]["value"]).low
    assert better.difference_high - better.difference_low < 0.1 * (better.high - better.low)
    # Tests: two of value, three of faults (without an event, p = 1); `same` has no variation, so no test.
    raw = [found[policy][name].p for policy in ("better", "luck", "same") for name in ("value", "faults")]
    assert np.isfinite(raw).sum() == 5
    assert better.p_holm == 5 * better.p == pytest.approx(np.nanmin(holm(raw)))
    assert (better.stars, luck.stars) == ("**", "*")
    assert luck.p < 0.05 < luck.p_holm


def test_a_baseline_differs_by_nothing_and_cells_without_variation_say_so(paired_values):
    found = figures_of(paired_values, "base", KINDS)
    base, other = found["base"]["faults"], found["better"]["faults"]
    assert (base.difference_low, base.difference_high) == (0.0, 0.0)
    assert (other.low, other.high) == (0.0, pytest.approx(0.369, abs=0.001))
    assert (other.difference_low, other.difference_high) == (-other.high, other.high)
    shown = figure_rows({policy: each["value"] for policy, each in found.items()}, "base", str)
    rows = {name: cells for name, *cells in shown}
    assert rows["same"][-3:] == ["+2.0", EQUAL, ""]
    assert rows["better"][-1] == "**"
    assert list(remarks(found, 10)) == [
        "all equal: no variation in 10, at 95 % confidence up to 31% of all may differ.",
        "Counts without an event have the exact bound of a Poisson mean.",
    ]
    always = {policy: {"availability": np.ones(10)} for policy in ("base", "same")}
    found = figures_of(always, "base", {"availability": FigureKind("availability", most=1.0)})
    assert found["same"]["availability"].low == pytest.approx(share_bounds(10, 10)[0])
    assert "All values at one end of their range, as availability 1: bound of 10 in 10 (Clopper–Pearson)." in remarks(
        found, 10
    )


def test_a_single_value_has_no_interval_and_says_so():
    single = {policy: {"value": np.array([x])} for policy, x in (("base", 2.0), ("other", 5.0))}
    found = figures_of(single, "base", {"value": FigureKind("value")})
    rows = figure_rows({policy: each["value"] for policy, each in found.items()}, "base", str)
    assert rows[1] == ("other", "5.0", "one value", "+3.0", "one value", "")
    assert list(remarks(found, 1)) == []


THRESHOLDS = np.linspace(0.0, 1.0, 5)


@pytest.fixture(scope="module")
def scores() -> tuple[np.ndarray, np.ndarray]:
    """[run, instance] of two policies; instances differ, and one instance has equal scores."""
    rng = np.random.default_rng(0)
    level = rng.uniform(0.2, 0.9, 24)
    own, base = level + rng.normal(0.05, 0.2, (10, 24)), level + rng.normal(0.0, 0.2, (8, 24))
    own[:, 0] = base[:, 0] = 0.5
    return own, base


def test_resamples_are_those_of_arch(scores):
    """Of a single run, which is given: percentiles as far out as Student's t is, of resampled instances."""
    bootstrap = pytest.importorskip("arch.bootstrap", reason="arch is in the extra `dev`")
    own, n = scores[0][:1], scores[0].shape[1]
    size = 2 * stats.norm.cdf(stats.t.ppf(0.975, n - 1) * np.sqrt(n / (n - 1))) - 1
    by_arch = bootstrap.IIDBootstrap(own[0], seed=np.random.default_rng(1))
    low, high = by_arch.conf_int(lambda x: stats.trim_mean(x, 0.25), reps=4000, method="percentile", size=size)[:, 0]
    found = aggregates({"own": own})["own"].iqm
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.15 * found.margin)


def test_figures_are_those_of_scipy_and_by_hand(scores):
    own, base = scores
    found = aggregates({"own": own})["own"]
    assert found.iqm.mean == pytest.approx(stats.trim_mean(own, 0.25, axis=None))
    assert found.optimality_gap.mean == pytest.approx(np.maximum(1 - own, 0).mean())
    by_instance = [stats.mannwhitneyu(x, y).statistic / 80 for x, y in zip(own.T, base.T, strict=True)]
    assert improvement(own, base).mean == pytest.approx(np.mean(by_instance))
    assert improvement(own, own).mean == 0.5
    np.testing.assert_allclose(profile(own, THRESHOLDS)[0], [(own > at).mean() for at in THRESHOLDS])


def test_more_is_drawn_the_wider_the_interval(scores):
    own = scores[0]
    one = aggregates({"own": own.mean(axis=0, keepdims=True)})["own"].optimality_gap
    assert one.margin < aggregates({"own": own})["own"].optimality_gap.margin


def test_the_mean_over_groups_has_the_clustered_variance(scores):
    """Liang & Zeger 1986, with groups of unequal size: the sums of the deviations in each group."""
    x, groups = scores[0][:1], np.repeat(np.arange(5), (9, 1, 4, 8, 2))
    values = by_group(x, groups)
    sums = np.bincount(groups, x[0] - x.mean())
    error = np.sqrt((sums**2).sum() * 5 / 4) / x.size
    assert values.mean() == pytest.approx(x.mean())
    assert np.std(values, ddof=1) / np.sqrt(5) == pytest.approx(error)
    equal = np.repeat(np.arange(6), 4)
    means = x.reshape(6, 4).mean(axis=1)
    assert interval(by_group(x, equal)) == pytest.approx(interval(means), nan_ok=True)


def test_groups_of_one_instance_are_instances_and_like_groups_widen(scores):
    own, base = scores
    alone = np.arange(24)
    assert aggregates({"own": own}, groups=alone) == aggregates({"own": own})
    assert improvement(own, base, groups=alone) == improvement(own, base)
    like, groups = np.repeat(own[:, :8], 3, axis=1), np.repeat(np.arange(8), 3)  # a group says one thing three times
    for found, few, apart in (
        (aggregates({"x": like}, groups=groups)["x"].iqm, aggregates({"x": own[:, :8]})["x"].iqm,
         aggregates({"x": like})["x"].iqm),
        (improvement(like, np.repeat(base[:, :8], 3, axis=1), groups=groups), improvement(own[:, :8], base[:, :8]),
         improvement(like, np.repeat(base[:, :8], 3, axis=1))),
    ):  # fmt: skip
        assert found.margin == pytest.approx(few.margin, rel=0.1)
        assert apart.margin < 0.8 * found.margin


def test_a_certain_order_has_the_bound_of_a_share():
    """Better on all of 20 instances: the probability of improvement is at least .83 (Clopper & Pearson)."""
    own = np.linspace(0.5, 0.9, 20)[None]
    found = improvement(own, own - 0.1)
    assert (found.mean, found.high) == (1.0, 1.0)
    assert found.low == pytest.approx(stats.binomtest(20, 20).proportion_ci().low)
    _, low, high = profile(own, [0.0, 1.0])
    assert (low[0], high[0]) == pytest.approx((found.low, 1.0))
    assert (low[1], high[1]) == pytest.approx((0.0, 1 - found.low))
