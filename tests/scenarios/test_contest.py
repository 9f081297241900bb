"""Who takes part, and that twins are read as they score themselves; tiny studies, networks left untrained."""

from dataclasses import replace

import numpy as np
import pytest

from scenarios.contest import RIVALS, VAE, TwinScorer, contest, difficulty, jobs_of, quality, readings, variants
from scenarios.quality import MEASURES, QUESTIONS, beaten
from scenarios.rehearse import trained
from scenarios.study import make_study
from twin.model import TwinConfig
from twin.rivals import Modelled, Scores, untrained

SEED = np.random.SeedSequence(1)
TINY = replace(untrained(TwinConfig()), hidden=4, max_windows=64)


def tiny(seed):
    return make_study(seed, train=8, reference=20, test=30, novel=4)


@pytest.fixture(scope="module")
def study():
    return tiny(SEED)


@pytest.fixture(scope="module")
def twin(study, tmp_path_factory):
    folder = tmp_path_factory.mktemp("twins")
    return trained(study.train.records(), TINY, SEED, arm="arm", folder=folder)


def test_jobs_fill_the_horizon(study):
    jobs = jobs_of(study.test, study.horizon_s)
    for plan, times in zip(jobs.plans, jobs.repetitions, strict=True):
        assert times * plan.cycle.duration_s >= study.horizon_s
        assert (times - 1) * plan.cycle.duration_s < study.horizon_s


def test_a_twin_is_read_as_it_scores_itself(study, twin):
    jobs = jobs_of(study.novel, study.horizon_s)
    read = TwinScorer(VAE, twin, difficulty).scores(jobs.plans, jobs.repetitions)
    told = Modelled(VAE, twin).scores(jobs.plans, jobs.repetitions)
    np.testing.assert_allclose(read.per_joint, told.per_joint)
    np.testing.assert_allclose(read.total, told.total)


def test_d_cal_is_zero_for_half_of_the_reference_and_one_half_at_its_95th_percentile(study, twin):
    jobs = jobs_of(study.reference, study.horizon_s)
    scorers = {s.name: s for s in readings({VAE: twin}, jobs)}
    d_cal = scorers["VAE d_cal"].scores(jobs.plans, jobs.repetitions).per_joint
    np.testing.assert_array_equal((d_cal == 0).sum(axis=0), 10)
    assert np.all((d_cal > 0.5).sum(axis=0) == 1)


def test_the_variants_differ_in_one_thing_each():
    named = variants(TwinConfig())
    assert named[VAE] == TwinConfig()
    assert replace(named["AE"], kind="vae") == TwinConfig()
    assert replace(named["VAE z=8"], latent=2) == TwinConfig()
    assert replace(named["VAE whole arm"], scope="joint", hidden=32, latent=2) == TwinConfig()


class ByTemperature:
    """Looks at the answer."""

    name = "rc, identified"

    def __init__(self, study):
        parts = (study.test, study.reference, study.novel)
        self.peak = {plan: peak for part in parts for plan, peak in zip(part.plans, part.peak_c, strict=True)}

    def scores(self, plans, repetitions):
        peak_c = np.stack([self.peak[plan] for plan in plans])
        return Scores(peak_c, peak_c.max(axis=1))


def test_everybody_takes_part_and_the_truth_wins(study, tmp_path):
    seeds = [SEED]
    result = quality(
        seeds, config=TINY, folder=tmp_path, make=lambda _: study, bring=lambda study: [ByTemperature(study)]
    )
    names = {row.scorer for row in result.rows}
    assert set(RIVALS) <= names
    assert {VAE, "VAE d_cal", "VAE torque channel", "VAE one-sided torque", "VAE z=8", "VAE whole arm"} <= names
    for question in QUESTIONS:
        for row in (result.row(name, question) for name in names):
            for measure in MEASURES:
                assert -1 <= row.values(measure)[0] <= 1, (row.scorer, measure)
    for question in ("any joint, total", "joint 2, joint 2"):
        best = result.row("rc, identified", question)
        assert [best.values(m)[0] for m in ("auroc", "auprc", "spearman")] == pytest.approx([1.0, 1.0, 1.0])
    assert any("rc, identified beats VAE" in said for said in beaten(result, VAE, RIVALS))


def test_fewer_networks_may_take_part_but_not_without_the_twin(study, tmp_path):
    few = contest(SEED, config=TINY, folder=tmp_path, make=lambda _: study, networks=(VAE, "AE"))
    names = {scorer for scorer, _ in few}
    assert {VAE, "AE", "kNN-5"} <= names
    assert not {"VAE z=8", "collapsed VAE"} & names
    for networks in (("AE",), (VAE, "GAN")):
        with pytest.raises(ValueError, match="A contest is of the 'VAE' and any of"):
            contest(SEED, config=TINY, folder=tmp_path, make=lambda _: study, networks=networks)
