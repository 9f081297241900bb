"""Measures by hand, scores of tiny studies, the alarm, and P(saturation) of stand-ins that report the true heat."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from benchmarks.paper.quality import (
    QUALITY,
    QualitySize,
    neighbour_scorer,
    quality_rows,
    scorers_of,
    spread,
    window_statistics,
)
from benchmarks.paper.saturation import (
    PastWork,
    _plans,
    _true_peak,
    judge_networks,
    judge_twin,
    past_work,
    reliability_rows,
)
from benchmarks.paper.subjects import (
    CARRIER,
    Jobs,
    Study,
    TooFewJobs,
    alarm_threshold,
    detection,
    jobs_of,
    make_study,
    raised,
)
from fleet.errors import FleetError
from fleet.events import Event
from fleet.heat.thermal import NODES
from fleet.motion import CHANNELS, drive
from scenarios.prepare import twins
from scenarios.prepare.identify import identify_from_work
from scenarios.spec.load import load
from twin.thermal.thermal_twin import RcTwin
from twin.vae.config import TwinConfig
from twin.vae.measures import PARTS, Features, p_value
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
        patch.setattr("benchmarks.paper.quality.SIMULATED_LOGS", 1)
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


@dataclass(frozen=True)
class Seer:
    """Stands in for a twin: reports the true copper heat of each joint, or noise."""

    study: Study
    sees: bool
    version: str = "seer"

    def features(self, plans, repetitions) -> Features:
        heat = np.array([drive(plan.cycle.profile, self.study.motors).current_sq for plan in plans])
        if not self.sees:
            heat = np.random.default_rng(0).exponential(1.0, heat.shape)
        return Features(np.repeat(heat[..., None], PARTS, axis=-1))


@pytest.fixture(scope="module")
def saturation_study() -> Study:
    return make_study(np.random.SeedSequence(5), train=0, reference=0, test=360, novel=20)


@pytest.fixture(scope="module")
def work(saturation_study: Study) -> PastWork:
    return past_work(saturation_study, seed=5, labelled=120, watched=100)


@pytest.fixture(scope="module")
def judged(saturation_study: Study, work: PastWork):
    """Predictions by name and alarms by score, of a twin that sees noise and of one that sees the heat."""
    return [judge_twin(work, Seer(saturation_study, sees)) for sees in (False, True)]


def test_who_sees_the_heat_is_trusted_and_who_sees_noise_is_not(judged, work) -> None:
    (noise, _), (heat, _) = judged
    assert heat["excess"]["auroc"] > 0.97
    assert heat["excess"]["brier"] < 0.06
    # Duration and temperature remain to who sees noise: better than chance, and no more.
    assert 0.5 < noise["excess"]["auroc"] < 0.9
    assert len(work.held_out) == 140


def test_alarms_are_rarely_false_whatever_they_go_by(judged, work) -> None:
    for _, alarms in judged:
        for alarm in alarms.values():
            # A calibration at its worst of a thousand, and the luck of the held-out jobs on top.
            calm = round(140 * (1 - work.jobs.passed[work.held_out].mean()))
            assert alarm["false_alarms"] <= binom.ppf(0.999, calm, 0.13) / calm
    assert judged[1][1]["excess"]["caught"] > 0.85 > judged[0][1]["excess"]["caught"]


def test_a_study_repeats(saturation_study, judged) -> None:
    again = judge_twin(past_work(saturation_study, seed=5, labelled=120, watched=100), Seer(saturation_study, True))
    assert again[1] == judged[1][1]


def test_nothing_held_out_is_refused(saturation_study) -> None:
    with pytest.raises(ValueError, match=r"more than 300 \+ 60 test jobs \(got 360\)"):
        past_work(saturation_study, seed=5, labelled=300, watched=60)


def test_an_identified_arm_knows_its_peaks_and_both_are_trusted():
    study = make_study(np.random.SeedSequence(5), train=0, reference=0, test=160, novel=0)
    found = judge_networks(past_work(study, seed=5, labelled=80, watched=0))
    nominal, identified = found.values()
    assert list(found) == ["rc nominal", "rc identified"]
    assert min(each["auroc"] for each in found.values()) > 0.95
    assert max(each["brier"] for each in found.values()) < 0.08
    assert identified["peak_error_k"] < 0.7 * nominal["peak_error_k"]
    with pytest.raises(ValueError, match="more than 150 \\+ 10 test jobs"):
        past_work(study, seed=5, labelled=150, watched=10)


class Plain:
    """Stands in for the learned twin, which P by `rc` does not need: every plan is equally difficult."""

    version = "plain"
    joint_weight = None

    def features(self, plans, repetitions) -> Features:
        return Features(np.full((len(plans), 7, PARTS), 0.1))


def test_p_and_peaks_come_true_in_the_shift(monkeypatch) -> None:
    monkeypatch.setattr(
        twins, "train_twins", lambda scenario, planned, folder, progress, seed: [Plain()] * len(planned)
    )
    ((key, row),) = reliability_rows(load("heat_wave"), (10_000, 10_001), 1, "rc", {"key": "wspt"}, ["key"])
    assert (key, row["policy"]) == ("key", "wspt")
    said = row["groups"]["all"]
    assert said["awards"] > 100
    assert 20 < said["passed"] < said["awards"] - 20
    assert said["ece"] <= 0.05
    assert said["brier"] <= 0.05
    assert said["auroc"] >= 0.95
    assert said["peak_rms_k"] < 2.0
    assert row["groups"]["warm"]["brier"] <= 0.05
    assert row["groups"]["warm"]["awards"] + row["groups"]["cool"]["awards"] == said["awards"]


def test_a_plan_ends_at_home_or_by_a_fault_and_else_its_outcome_is_unknown() -> None:
    times = {
        "a": [("award", 0), ("home", 50), ("award", 60), ("fault", 90), ("recover", 200), ("award", 210)],
        "b": [("award", 10), ("give_back", 40), ("home", 60)],
    }
    events = [Event(time_s=t, kind=kind, arm=arm) for arm, log in times.items() for kind, t in log]  # pyright: ignore
    assert list(_plans(events)) == [
        ("a", 0, 50, False),
        ("a", 60, 90, True),
        ("a", 210, None, False),
        ("b", 10, None, False),
    ]


def test_the_first_two_minutes_do_not_count_but_in_short_plans() -> None:
    ends_c = 80.0 - np.arange(60.0)[:, None]  # cooling by 1 K in each step of 10 s
    assert _true_peak(ends_c, 10.0, 0.0, 400.0) == 80.0 - 11  # at 120 s
    assert _true_peak(ends_c, 10.0, 100.0, 150.0) == 80.0 - 14  # at its end
    assert _true_peak(-ends_c, 10.0, 100.0, 400.0) == 39.0 - 80.0


@pytest.mark.parametrize("draw", ["normal", "exponential", "coarse"])
@pytest.mark.parametrize(("alpha", "n"), [(0.05, 19), (0.05, 150), (0.2, 37)])
def test_false_alarms_stay_below_alpha_whatever_the_scores_are_like(draw, alpha, n) -> None:
    rng = np.random.default_rng([n, round(100 * alpha)])
    trials = 1500
    scores = rng.integers(0, 9, (trials, n + 1)) if draw == "coarse" else getattr(rng, draw)(size=(trials, n + 1))
    false = sum(row[-1] > alarm_threshold(row[:-1], alpha) for row in scores)
    # Exactly floor(alpha (n + 1))/(n + 1) without ties, and less with them.
    exact = np.floor(alpha * (n + 1) + 1e-9) / (n + 1)
    assert exact <= alpha + 1e-9
    assert false <= binom.ppf(0.9999, trials, exact)
    if draw != "coarse":
        assert false >= binom.ppf(0.0001, trials, exact)


@given(
    scores=st.lists(st.floats(-5, 5), min_size=9, max_size=60),
    alpha=st.floats(0.1, 0.9),
    asked=st.lists(st.floats(-6, 6), min_size=1),
)
def test_the_alarm_is_a_small_p_value(scores, alpha, asked) -> None:
    threshold = alarm_threshold(scores, alpha)
    new = np.array([*asked, *scores])
    counted = np.array([(1 + sum(s >= x for s in scores)) / (len(scores) + 1) for x in new])
    np.testing.assert_allclose(p_value(np.sort(scores), new), counted)
    np.testing.assert_array_equal(new > threshold, counted <= alpha + 1e-9 / (len(scores) + 1))


def test_too_few_jobs_promise_nothing() -> None:
    assert alarm_threshold(np.arange(19), 0.05) == 18
    with pytest.raises(TooFewJobs, match=r"0\.05 needs 19 or more jobs without the event \(got 18\)"):
        alarm_threshold(np.arange(18), 0.05)


def test_what_has_no_score_is_warned_of() -> None:
    assert raised(np.array([np.nan, 18.0, 18.5]), alarm_threshold(np.arange(19))) == 2 / 3


def test_what_makes_no_alarm_is_refused() -> None:
    with pytest.raises(ValueError, match="between 0 and 1"):
        alarm_threshold([1.0, 2.0], 0.0)
    with pytest.raises(ValueError, match="finite"):
        alarm_threshold([1.0, np.nan], 0.5)
