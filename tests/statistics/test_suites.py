"""Scores over a suite against rliable, arch and SciPy, and the export against marl-eval's own reader."""

import json

import numpy as np
import pytest
from scipy import stats

from fleet.errors import FleetError
from scenarios.evaluate.scores import to_marl_eval
from scenarios.evaluate.statistics import aggregates, by_group, improvement, interval, profile

THRESHOLDS = np.linspace(0.0, 1.0, 5)


@pytest.fixture(scope="module")
def scores() -> tuple[np.ndarray, np.ndarray]:
    """[run, instance] of two policies; instances differ, and one instance has equal scores."""
    rng = np.random.default_rng(0)
    level = rng.uniform(0.2, 0.9, 24)
    own, base = level + rng.normal(0.05, 0.2, (10, 24)), level + rng.normal(0.0, 0.2, (8, 24))
    own[:, 0] = base[:, 0] = 0.5
    return own, base


def test_figures_are_those_of_rliable(scores):
    library = pytest.importorskip("rliable.library", reason="rliable is in the extra `dev`")
    from rliable import metrics

    own, base = scores
    names = {"iqm": metrics.aggregate_iqm, "optimality_gap": metrics.aggregate_optimality_gap}
    np.random.seed(0)  # noqa: NPY002 # rliable draws from the global state
    points, _ = library.get_interval_estimates(
        {"own": own}, lambda x: np.array([figure(x) for figure in names.values()]), reps=2
    )
    found = aggregates({"own": own})["own"]
    for i, name in enumerate(names):
        assert getattr(found, name).mean == pytest.approx(points["own"][i])
    shares, _ = library.create_performance_profile({"own": own}, THRESHOLDS, reps=2)
    np.testing.assert_allclose(profile(own, THRESHOLDS).share, shares["own"])
    points, _ = library.get_interval_estimates(
        {"pair": [own, base]}, lambda x, y: np.array([metrics.probability_of_improvement(x, y)]), reps=2
    )
    assert improvement(own, base).mean == pytest.approx(points["pair"][0])


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
    ends = profile(own, [0.0, 1.0])
    assert (ends.low[0], ends.high[0]) == pytest.approx((found.low, 1.0))
    assert (ends.low[1], ends.high[1]) == pytest.approx((0.0, 1 - found.low))


def test_bad_scores_are_refused():
    for scores in ([[1.0, np.nan]], [1.0]):
        with pytest.raises(ValueError, match="Scores must be"):
            aggregates({"x": scores})
    with pytest.raises(ValueError, match="Scores need two instances"):
        aggregates({"x": [[1.0], [2.0]]})
    with pytest.raises(ValueError, match="same instances"):
        improvement([[1.0, 2.0]], [[1.0]])


def rows() -> list[dict[str, object]]:
    """A rule without trainings and a policy with two, on two instances of a split, with two fleets."""
    result = []
    for policy, trainings in (("wspt", 1), ("Learned, large", 2)):
        for n in range(2):
            for fleet in range(2):
                for training in range(trainings):
                    value = 10.0 * n + fleet + 0.1 * training
                    key = {"policy": policy, "instance": f"test/{n:04}", "fleet": fleet, "training": training}
                    result.append({**key, "seed": n, "difficulty": "twin", "reward": value, "faults": 0})
    return result


def test_the_export_has_the_documented_structure():
    """https://github.com/instadeepai/marl-eval#data-structure-for-raw-experiment-data."""
    made = json.loads(json.dumps(to_marl_eval(rows(), ["reward", "faults"])))
    assert list(made) == ["test"]
    assert list(made["test"]) == ["0000", "0001"]
    for task in made["test"].values():
        assert sorted(task) == ["Learned; large", "wspt"]
        for runs in task.values():
            assert list(runs) == ["run_1", "run_2", "run_3", "run_4"]
            for steps in runs.values():
                assert steps["step_1"] == {"step_count": 1, **steps["absolute_metrics"]}
    rewards = {name: [run["absolute_metrics"]["reward"] for run in runs.values()] for name, runs in task.items()}
    assert rewards == {"wspt": [[10.0], [10.0], [11.0], [11.0]], "Learned; large": [[10.0], [10.1], [11.0], [11.1]]}


def test_marl_eval_reads_the_export():
    """Its release pins pandas 1.4.4, which Python 3.11 has not; `pip install --no-deps id-marl-eval colorama` does."""
    processing = pytest.importorskip("marl_eval.utils.data_processing_utils")
    from marl_eval.utils.diagnose_data_errors import DiagnoseData

    made = to_marl_eval(rows(), ["reward", "faults"])
    checks = DiagnoseData(made).check_data()["test"]
    assert all(checks.values()), checks
    processed = processing.data_process_pipeline(made, ["reward"])
    matrices, _ = processing.create_matrices_for_rliable(processed, "test", ["reward"])
    normalised = matrices["mean_norm_reward"]["learned; large"]  # [run, instance], from 0 to 1 in each instance
    np.testing.assert_allclose(normalised, [[0, 0], [1 / 11, 1 / 11], [10 / 11, 10 / 11], [1, 1]], atol=1e-4)


def test_an_export_that_marl_eval_cannot_read_is_refused():
    complete = rows()
    for damaged, sentence in (
        (complete[:3] + complete[4:], "wspt on test/0001, fleet 1, training 0, seed 1 is missing"),
        ([*complete, complete[0]], "wspt on test/0000, fleet 0, training 0, seed 0 is given twice"),
        ([*complete[1:], {**complete[0], "reward": np.nan}], "has no finite reward"),
        ([*complete, {**complete[0], "policy": "WSPT"}], "names must differ by more"),
        ([row for row in complete if row["instance"] == "test/0000" or row["fleet"] == 0], "as many runs"),
    ):
        with pytest.raises(FleetError, match=sentence):
            to_marl_eval(damaged, ["reward", "faults"])
