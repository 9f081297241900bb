"""Measures by hand, and scores of tiny studies with untrained networks."""

import numpy as np
import pytest

from benchmarks.paper.quality import (
    QUALITY,
    QualitySize,
    neighbour_scorer,
    quality_rows,
    scorers_of,
    spread,
    window_statistics,
)
from benchmarks.paper.subjects import CARRIER, Jobs, detection, jobs_of, make_study
from fleet.errors import FleetError
from fleet.heat.thermal import NODES
from fleet.motion import CHANNELS
from scenarios.prepare.identify import identify_from_work
from twin.thermal.thermal_twin import RcTwin
from twin.vae.config import TwinConfig
from twin.vae.window import Scaler, cut_jobs, windows_of

SEED = np.random.SeedSequence(1)
SIZE = QualitySize(train=8, reference=20, test=30, novel=4, epochs=1)


@pytest.fixture(scope="module")
def study():
    return make_study(SEED, train=8, reference=20, test=30, novel=4)


REFERENCE = np.arange(19.0)


def test_measures_by_hand():
    peak_c = np.array([30.0, 40.0, 50.0, 60.0, 70.0])
    score = np.array([2.0, 1.0, 19.0, 18.0, 20.0])
    found = detection(score, peak_c, limit_c=60.0, reference=REFERENCE, novel=np.array([0.0, 18.0, 18.5, 40.0]))
    assert found["auroc"] == pytest.approx(5 / 6)  # of six pairs critical-other only (18, 19) is the wrong way round
    assert found["auprc"] == pytest.approx(0.5 * 1 + 0.5 * 2 / 3)  # precision 1 at the first, 2/3 at the second
    # ranks 2 1 4 3 5 against 1 2 3 4 5: 1 − 6·(1 + 1 + 1 + 1)/(5·24)
    assert found["spearman"] == pytest.approx(0.8)
    assert found["caught"] == 0.5  # 18 ties with a reference, 20 is beyond all
    assert found["false_novel"] == 0.5


@pytest.mark.parametrize("peak_c", [np.full(4, 80.0), np.full(4, 20.0)])
def test_without_both_kinds_there_is_no_quality(peak_c):
    with pytest.raises(FleetError, match="some of both kinds"):
        detection(np.arange(4.0), peak_c, limit_c=60.0, reference=REFERENCE, novel=REFERENCE)


def test_what_cannot_be_measured_says_so():
    peak_c = np.array([30.0, 70.0])
    with pytest.raises(FleetError, match=r"needs 19 or more jobs without the event \(got 5\)"):
        detection(np.arange(2.0), peak_c, limit_c=60.0, reference=np.arange(5.0), novel=REFERENCE)
    with pytest.raises(ValueError, match="finite"):
        detection(np.array([0.0, np.nan]), peak_c, limit_c=60.0, reference=REFERENCE, novel=REFERENCE)
    with pytest.raises(ValueError, match="alike"):
        detection(np.arange(3.0), peak_c, limit_c=60.0, reference=REFERENCE, novel=REFERENCE)
    with pytest.raises(ValueError, match="a repetition and a peak per plan"):
        Jobs((), (1,), np.zeros((0, 7)))


def test_jobs_fill_the_horizon(study):
    jobs = jobs_of(study.test, study.horizon_s)
    for plan, times in zip(jobs.plans, jobs.repetitions, strict=True):
        assert times * plan.cycle.duration_s >= study.horizon_s
        assert (times - 1) * plan.cycle.duration_s < study.horizon_s


def test_logs_of_cool_jobs_identify_the_arm(study):
    """Nearer to the truth than a nominal arm, for jobs that overheat too, none of which was logged."""
    jobs = jobs_of(study.test, study.horizon_s)
    start_c = np.full(NODES, study.ambient_c)
    nominal = RcTwin.nominal(ambient_c=study.ambient_c)
    own = identify_from_work(
        study.hardware, study.train.plans[:2], np.random.default_rng(SEED), ambient_c=study.ambient_c
    )
    wrong_k = [
        rc.peaks(jobs.plans, jobs.repetitions, start_c=start_c)[:, CARRIER] - jobs.peak_c[:, CARRIER]
        for rc in (nominal, RcTwin.of(own))
    ]
    assert np.abs(wrong_k[1]).mean() < 0.5 * np.abs(wrong_k[0]).mean()


def test_features_of_a_window_by_hand():
    window = np.zeros((1, 4, 2, 3))
    window[0, :, 1, 2] = [3.0, -1.0, 1.0, 1.0]
    names = [f"{each}_{channel}" for each in ("mean", "std", "rms", "min", "max", "step") for channel in CHANNELS]
    found = dict(zip(names, window_statistics(window)[0, 1], strict=True))
    assert found["mean_tau"] == 1.0
    assert found["std_tau"] == pytest.approx(np.sqrt(2.0))
    assert found["rms_tau"] == pytest.approx(np.sqrt(3.0))
    assert (found["min_tau"], found["max_tau"]) == (-1.0, 3.0)
    assert found["step_tau"] == pytest.approx((4 + 2 + 0) / 3)
    assert len(names) == 18
    assert all(value == 0 for name, value in found.items() if not name.endswith("tau"))


def test_neighbours_are_brute_force(study):
    """Mean distance to the nearest training windows, in standardised statistics, averaged over the job's time."""
    config, records, joint = TwinConfig(), study.train.records(), 2
    score = neighbour_scorer(records, config, SEED)
    jobs = jobs_of(study.novel, study.horizon_s)
    found = score(jobs.plans, jobs.repetitions)[:, joint]
    scaler = Scaler.fit(windows_of(records, config))
    known, asked = (
        window_statistics(scaler.to_z(windows))[:, joint]
        for windows in (windows_of(records, config), cut_jobs(jobs.plans, jobs.repetitions, config).windows)
    )
    mean, deviation = known.mean(axis=0), known.std(axis=0)
    known, asked = (known - mean) / deviation, (asked - mean) / deviation
    distance = np.sort(np.linalg.norm(asked[:, None] - known, axis=-1), axis=1)[:, :5].mean(axis=1)
    expected = cut_jobs(jobs.plans, jobs.repetitions, config).mean(distance[:, None, None])[:, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.fixture(scope="module")
def row():
    """Quality of every score under one seed, with networks of one epoch."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.paper.quality.LOGS", 1)
        ((_, found),) = quality_rows(1, SIZE, [""])
    return found


def test_every_score_is_measured(row, study):
    assert list(row["scores"]) == list(scorers_of(study, SIZE.config, SEED))
    for name, by_question in row["scores"].items():
        for values in by_question.values():
            assert all(-1 <= value <= 1 for value in values.values()), name
    tables = QUALITY.tables([row])
    assert [line[0] for line in tables["quality_joint 2"].rows] == list(row["scores"])
    auroc = row["scores"]["d"]["joint 2"]["auroc"]
    assert tables["quality_joint 2"].rows[0][1] == f"{auroc:.3f}"


def test_thermal_networks_rank_best(row):
    """The label follows from the thermal law, so the networks of a nominal arm and of the arm rank nearly all."""
    for name in ("rc nominal", "rc identified"):
        for question in ("any joint", "joint 2"):
            assert row["scores"][name][question]["auroc"] > 0.97
            assert row["scores"][name][question]["spearman"] > 0.97


def test_a_spread_is_the_sample_deviation():
    assert spread([1.0, 3.0]) == "2.000 ± 1.414"
    assert spread([-0.5]) == "-0.500"
    assert spread([float("nan")]) == "–"
