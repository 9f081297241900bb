"""Quality of P(saturation), for stand-ins of a twin that report the true heat or noise."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import binom

from benchmarks.paper.saturation import PastWork, judge_networks, judge_twin, past_work
from benchmarks.paper.subjects import Study, make_study
from fleet.motion import drive
from twin.vae.measures import PARTS, Features


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
def study() -> Study:
    return make_study(np.random.SeedSequence(5), train=0, reference=0, test=360, novel=20)


@pytest.fixture(scope="module")
def work(study: Study) -> PastWork:
    return past_work(study, seed=5, labelled=120, watched=100)


@pytest.fixture(scope="module")
def judged(study: Study, work: PastWork):
    """Predictions by name and alarms by score, of a twin that sees noise and of one that sees the heat."""
    return [judge_twin(work, Seer(study, sees)) for sees in (False, True)]


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


def test_a_study_repeats(study, judged) -> None:
    again = judge_twin(past_work(study, seed=5, labelled=120, watched=100), Seer(study, True))
    assert again[1] == judged[1][1]


def test_nothing_held_out_is_refused(study) -> None:
    with pytest.raises(ValueError, match=r"more than 300 \+ 60 test jobs \(got 360\)"):
        past_work(study, seed=5, labelled=300, watched=60)


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
