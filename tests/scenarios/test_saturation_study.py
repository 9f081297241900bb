"""Whether the study of trust finds what is there: with twins whose sight is known beforehand."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import binom

from fleet.motion import drive
from scenarios.saturation_study import lines, trust
from scenarios.study import Study, make_study
from twin.measures import Features


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
        return Features(np.repeat(heat[..., None], 5, axis=-1))


@pytest.fixture(scope="module")
def study() -> Study:
    return make_study(np.random.SeedSequence(5), train=0, reference=0, test=360, novel=20)


@pytest.fixture(scope="module")
def judged(study: Study):
    return {sees: trust(study, Seer(study, sees), seed=5, exploration=0, labelled=120, watched=100) for sees in (0, 1)}


def test_who_sees_the_heat_is_trusted_and_who_sees_noise_is_not(judged) -> None:
    def figures(sees):
        return {(s.evidence, s.method): s for s in judged[sees].stated}

    assert figures(1)["excess", "logistic"].auroc > 0.97
    assert figures(1)["excess", "logistic"].brier < 0.06
    # Duration and temperature remain to who sees noise: better than chance, and no more.
    assert 0.5 < figures(0)["excess", "logistic"].auroc < 0.9
    for stated in judged[0].stated:
        assert stated.table.count.sum() == len(stated.p) == len(stated.passed) == 140
        assert stated.passed.mean() == judged[0].share_passed


def test_alarms_are_rarely_false_whatever_they_go_by(judged) -> None:
    for sees in (0, 1):
        for alarm in judged[sees].alarms:
            # A calibration at its worst of a thousand, and the luck of the held-out jobs on top.
            calm = round(140 * (1 - judged[sees].share_passed))
            assert alarm.false_alarms <= binom.ppf(0.999, calm, 0.13) / calm
            assert alarm.expected[0] < 0.05 < alarm.expected[1]
    caught = {sees: {a.score: a.caught for a in judged[sees].alarms} for sees in (0, 1)}
    assert caught[1]["p_excess"] > 0.85 > 0.5 > caught[0]["sum"]


def test_a_study_repeats_and_prints(study, judged) -> None:
    again = trust(study, Seer(study, True), seed=5, exploration=0, labelled=120, watched=100)
    assert again.alarms == judged[1].alarms
    said = lines([again, again])
    assert "0.000" in said[-1]
    assert len(said) == 3 + len(again.stated) + len(again.alarms)


def test_nothing_held_out_is_refused(study) -> None:
    with pytest.raises(ValueError, match=r"more than 300 \+ 60 test jobs \(got 360\)"):
        trust(study, Seer(study, True), seed=5, exploration=0, labelled=300, watched=60)
