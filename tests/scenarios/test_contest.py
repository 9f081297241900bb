"""Who takes part, and that twins are read as they score themselves; tiny studies, networks left untrained_config."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.thermal import NODES
from scenarios.prepare.train_twins import train_or_load
from scenarios.studies.benchmark import (
    BASELINES,
    THERMAL,
    VAE,
    TwinScorer,
    chosen_variants,
    difficulty,
    identified_twin,
    jobs_of,
    quality,
    twin_scorers,
    variants,
)
from scenarios.studies.ranking import CARRIER, HEAT, MEASURES, verdicts
from scenarios.studies.setup import make_study
from twin.baselines.reconstruction import ModelScorer, untrained_config
from twin.thermal.thermal_twin import RcTwin
from twin.vae.model import TwinConfig

SEED = np.random.SeedSequence(1)
TINY = replace(untrained_config(TwinConfig()), hidden=4, max_windows=64)


def tiny(seed):
    return make_study(seed, train=8, reference=20, test=30, novel=4)


@pytest.fixture(scope="module")
def study():
    return tiny(SEED)


@pytest.fixture(scope="module")
def twin(study, tmp_path_factory):
    folder = tmp_path_factory.mktemp("twins")
    return train_or_load(study.train.records(), TINY, SEED, arm="arm", folder=folder)


def test_jobs_fill_the_horizon(study):
    jobs = jobs_of(study.test, study.horizon_s)
    for plan, times in zip(jobs.plans, jobs.repetitions, strict=True):
        assert times * plan.cycle.duration_s >= study.horizon_s
        assert (times - 1) * plan.cycle.duration_s < study.horizon_s


def test_a_twin_is_read_as_it_scores_itself(study, twin):
    jobs = jobs_of(study.novel, study.horizon_s)
    read = TwinScorer(VAE, twin, difficulty).scores(jobs.plans, jobs.repetitions)
    told = ModelScorer(VAE, twin).scores(jobs.plans, jobs.repetitions)
    np.testing.assert_allclose(read.per_joint, told.per_joint)
    np.testing.assert_allclose(read.total, told.total)


def test_d_cal_is_zero_for_half_of_the_reference_and_one_half_at_its_95th_percentile(study, twin):
    jobs = jobs_of(study.reference, study.horizon_s)
    scorers = {s.name: s for s in twin_scorers({VAE: twin}, jobs)}
    d_cal = scorers["VAE d_cal"].scores(jobs.plans, jobs.repetitions).per_joint
    np.testing.assert_array_equal((d_cal == 0).sum(axis=0), 10)
    assert np.all((d_cal > 0.5).sum(axis=0) == 1)


def test_the_variants_differ_in_one_thing_each():
    named = variants(TwinConfig())
    assert named[VAE] == TwinConfig()
    assert replace(named["AE"], kind="vae") == TwinConfig()
    assert replace(named["VAE z=8"], latent=2) == TwinConfig()
    assert replace(named["VAE whole arm"], scope="joint", hidden=32, latent=2) == TwinConfig()


@pytest.fixture(scope="module")
def result(study, tmp_path_factory):
    """Everybody's quality under one seed."""
    return quality([SEED], config=TINY, folder=tmp_path_factory.mktemp("twins"), make=lambda _: study, logs=1)


def test_everybody_takes_part_and_is_measured(result):
    names = {row.scorer for row in result.rows}
    assert set(BASELINES) <= names
    assert {VAE, "VAE d_cal", "VAE torque channel", "VAE one-sided torque", "VAE z=8", "VAE whole arm"} <= names
    for row in result.rows:
        for measure in MEASURES:
            assert -1 <= row.values(measure)[0] <= 1, (row.scorer, measure)


def test_who_is_told_of_heat_knows_best(result):
    """The label follows from the thermal law, so that of a nominal arm and the arm's own find nearly all."""
    assert [name for name in BASELINES if result.knows(name) == HEAT] == list(THERMAL)
    for name in ("rc nominal", "rc identified"):
        for question in ("any joint, total", "joint 2, joint 2"):
            row = result.row(name, question)
            assert row.values("auroc")[0] > 0.97
            assert row.values("spearman")[0] > 0.97
    assert all(
        "with motor data and the thermal law, VAE is beaten by" in said
        for said in verdicts(result, VAE, BASELINES)[1::2]
    )


def test_logs_of_cool_jobs_tell_the_arm(study):
    """Nearer to the truth than a nominal arm, for jobs that overheat too, none of which was logged."""
    jobs = jobs_of(study.test, study.horizon_s)
    start_c = np.full(NODES, study.ambient_c)
    nominal = RcTwin.nominal(ambient_c=study.ambient_c)
    wrong_k = [
        rc.peaks(jobs.plans, jobs.repetitions, start_c=start_c)[:, CARRIER] - jobs.peak_c[:, CARRIER]
        for rc in (nominal, identified_twin(study, SEED, logs=2))
    ]
    assert np.abs(wrong_k[1]).mean() < 0.5 * np.abs(wrong_k[0]).mean()


def test_fewer_networks_may_take_part_but_not_without_the_twin():
    few = chosen_variants(TINY, (VAE, "AE"))
    assert list(few) == [VAE, "AE"]
    assert few[VAE] == TINY
    assert chosen_variants(TINY, None) == variants(TINY)
    for networks in (("AE",), (VAE, "GAN")):
        with pytest.raises(ValueError, match="A benchmark takes 'VAE' and any of"):
            chosen_variants(TINY, networks)
