"""Measures by hand, tables by permutation, sentences from made-up figures."""

from dataclasses import dataclass

import numpy as np
import pytest

from fleet.errors import FleetError
from scenarios.studies.detection_metrics import Detection, detection
from scenarios.studies.ranking import MEASURES, QUESTIONS, Jobs, judge, side_by_side, spread, verdicts
from twin.baselines.reconstruction import Scores

REFERENCE = np.arange(19.0)


def test_measures_by_hand():
    peak_c = np.array([30.0, 40.0, 50.0, 60.0, 70.0])
    score = np.array([2.0, 1.0, 19.0, 18.0, 20.0])
    found = detection(score, peak_c, reference=REFERENCE, novel=np.array([0.0, 18.0, 18.5, 40.0]))
    assert found.auroc == pytest.approx(5 / 6)  # of six pairs critical-other only (18, 19) is the wrong way round
    assert found.auprc == pytest.approx(0.5 * 1 + 0.5 * 2 / 3)  # precision 1 at the first, 2/3 at the second
    # ranks 2 1 4 3 5 against 1 2 3 4 5: 1 − 6·(1 + 1 + 1 + 1)/(5·24)
    assert found.spearman == pytest.approx(0.8)
    assert found.caught == 0.5  # 18 ties with a reference, 20 is beyond all
    assert found.false_novel == 0.5


@pytest.mark.parametrize("peak_c", [np.full(4, 80.0), np.full(4, 20.0)])
def test_without_both_kinds_there_is_no_quality(peak_c):
    with pytest.raises(FleetError, match="some of both kinds"):
        detection(np.arange(4.0), peak_c, reference=REFERENCE, novel=REFERENCE)


def test_what_cannot_be_measured_says_so():
    peak_c = np.array([30.0, 70.0])
    with pytest.raises(FleetError, match=r"needs 19 or more jobs without the event \(got 5\)"):
        detection(np.arange(2.0), peak_c, reference=np.arange(5.0), novel=REFERENCE)
    with pytest.raises(ValueError, match="finite"):
        detection(np.array([0.0, np.nan]), peak_c, reference=REFERENCE, novel=REFERENCE)
    with pytest.raises(ValueError, match="alike"):
        detection(np.arange(3.0), peak_c, reference=REFERENCE, novel=REFERENCE)
    with pytest.raises(ValueError, match="a repetition and a peak per plan"):
        Jobs((), (1,), np.zeros((0, 7)))


@dataclass(frozen=True)
class ByRepetitions:
    """Stands for a scorer; the repetitions of a job tell it everything."""

    name: str
    joint_2: np.ndarray

    def scores(self, plans, repetitions):
        at = np.array(repetitions)
        per_joint = np.zeros((len(at), 7))
        per_joint[:, 1] = self.joint_2[at]
        return Scores(per_joint, -per_joint.sum(axis=1))


def jobs_of(make_plan, numbers, peak_2):
    peak_c = np.full((len(numbers), 7), 25.0)
    peak_c[:, 1] = peak_2
    return Jobs((make_plan,) * len(numbers), tuple(numbers), peak_c)


@pytest.fixture
def parts(small):
    plan = small.arm(0, [small.work()]).plans[small.work()][0]
    numbers = np.arange(20, 60)
    return {
        "test": jobs_of(plan, numbers, numbers + 20.0),
        "reference": jobs_of(plan, np.arange(20), 25.0),
        "novel": jobs_of(plan, np.arange(10), 25.0),
    }


def test_each_question_asks_its_own_score(parts):
    found = judge([ByRepetitions("rises", np.arange(60.0))], **parts)
    assert found["any joint, total"]["rises"].auroc == 0.0  # its total falls
    assert found["any joint, joint 2"]["rises"].auroc == 1.0
    assert found["joint 2, joint 2"]["rises"] == Detection(
        auroc=1.0, auprc=1.0, spearman=1.0, caught=1.0, false_novel=0.0
    )
    with pytest.raises(ValueError, match="must be unique"):
        judge([ByRepetitions("a", np.arange(60.0))] * 2, **parts)


def test_the_order_of_jobs_does_not_matter(parts):
    rng = np.random.default_rng(4)
    scorer = ByRepetitions("noisy", np.arange(60.0) + rng.normal(0, 10, 60))

    def shuffled(jobs):
        order = rng.permutation(len(jobs.plans))
        return Jobs(jobs.plans, tuple(np.array(jobs.repetitions)[order].tolist()), jobs.peak_c[order])

    test, reference, novel = (shuffled(parts[name]) for name in ("test", "reference", "novel"))
    moved = judge([scorer], test=test, reference=reference, novel=novel)
    first = judge([scorer], **parts)
    for question, by_scorer in first.items():
        for measure in MEASURES:
            expected = getattr(by_scorer["noisy"], measure)
            assert getattr(moved[question]["noisy"], measure) == pytest.approx(expected)


def some(**values):
    return Detection(**({"auroc": 0.9, "auprc": 0.8, "spearman": 0.7, "caught": 0.5, "false_novel": 0.5} | values))


def by_seed(seeds):
    """Judged of each seed from {scorer: Detection}; the same for each question."""
    return [dict.fromkeys(QUESTIONS, seed) for seed in seeds]


def test_verdicts_follow_the_figures():
    quality = side_by_side(
        by_seed(
            [
                {
                    "VAE": some(auroc=0.90),
                    "mixed": some(auroc=0.91, spearman=0.6),
                    "better": some(auroc=0.98),
                    "turns": some(auroc=0.95),
                    "worse": some(auprc=0.7),
                    "as the table shows it": some(auroc=0.90001),
                    "rc": some(auroc=0.99),
                },
                {
                    "VAE": some(auroc=0.92),
                    "mixed": some(auroc=0.93, spearman=0.6),
                    "better": some(auroc=0.99),
                    "turns": some(auroc=0.91),
                    "worse": some(auroc=0.92, auprc=0.6),
                    "as the table shows it": some(auroc=0.92001),
                    "rc": some(auroc=0.99),
                },
            ]
        )
    )
    everybody = ("mixed", "better", "turns", "worse", "as the table shows it", "absent", "rc")
    said = verdicts(quality, "VAE", everybody, thermal=("rc",))
    assert len(said) == 2 * len(QUESTIONS)
    assert said[4] == (
        "Joint 2 overheats, by its own score. Among scorers with motion alone, VAE is beaten by better "
        "(AUROC +.075). It is partly beaten by mixed (AUROC +.010, but Spearman −.100). It ties with turns and as the "
        "table shows it. It beats worse."
    )
    assert said[5].endswith("Among scorers with motor data and the thermal law, VAE is beaten by rc (AUROC +.080).")


def test_quality_of_seeds_is_side_by_side_in_the_order_of_the_scorers():
    quality = side_by_side(by_seed([{"b": some(), "a": some(auroc=1.0)}] * 2))
    assert list(quality) == list(QUESTIONS)
    assert all(list(scorers) == ["b", "a"] for scorers in quality.values())
    assert quality["joint 2, joint 2"]["a"]["auroc"].tolist() == [1.0, 1.0]
    assert spread(np.array([-0.5])) == "-0.500"
    with pytest.raises(ValueError, match="same scorers under each"):
        side_by_side([*by_seed([{"b": some()}]), *by_seed([{"a": some()}])])
    with pytest.raises(ValueError, match="at least one seed"):
        side_by_side([])
