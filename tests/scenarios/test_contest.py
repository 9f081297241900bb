"""Scorers of the benchmark, on tiny studies with untrained networks."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.thermal import NODES
from scenarios.prepare.simulated_logs import identify_from_work
from scenarios.prepare.train_twins import train_or_load
from scenarios.studies.benchmark import (
    BASELINES,
    THERMAL,
    VAE,
    TwinScorer,
    chosen_variants,
    jobs_of,
    quality,
    twin_scorers,
    variants,
)
from scenarios.studies.ranking import CARRIER, MEASURES, verdicts
from scenarios.studies.setup import Bench, make_study
from twin.baselines.reconstruction import ModelScorer, untrained_config
from twin.thermal.thermal_twin import RcTwin
from twin.vae.config import TwinConfig

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


def test_the_scorer_of_a_twin_gives_its_own_score(study, twin):
    jobs = jobs_of(study.novel, study.horizon_s)
    read = TwinScorer(VAE, twin).scores(jobs.plans, jobs.repetitions)
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
    assert replace(named["VAE whole arm"], scope="joint", hidden=16, latent=2) == TwinConfig()


@pytest.fixture(scope="module")
def result(study, tmp_path_factory):
    """Quality of every scorer under one seed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scenarios.studies.benchmark.LOGS", 1)
        return quality(Bench([SEED], TINY, tmp_path_factory.mktemp("twins"), lambda _: study))


def test_every_scorer_is_measured(result):
    for scorers in result.values():
        assert set(BASELINES) <= set(scorers)
        assert {VAE, "VAE d_cal", "VAE torque channel", "VAE one-sided torque", "VAE z=8", "VAE whole arm"} <= set(
            scorers
        )
        for name, values in scorers.items():
            assert list(values) == list(MEASURES)
            assert all(-1 <= seeds[0] <= 1 for seeds in values.values()), name


def test_thermal_networks_rank_best(result):
    """The label follows from the thermal law, so the networks of a nominal arm and of the arm rank nearly all."""
    for name in ("rc nominal", "rc identified"):
        for question in ("any joint, total", "joint 2, joint 2"):
            assert result[question][name]["auroc"][0] > 0.97
            assert result[question][name]["spearman"][0] > 0.97
    assert all(
        "with motor data and the thermal law, VAE is beaten by" in sentence
        for sentence in verdicts(result, VAE, BASELINES, thermal=THERMAL)[1::2]
    )


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


def test_fewer_networks_may_take_part_but_not_without_the_twin():
    few = chosen_variants(TINY, (VAE, "AE"))
    assert list(few) == [VAE, "AE"]
    assert few[VAE] == TINY
    assert chosen_variants(TINY, None) == variants(TINY)
    for networks in (("AE",), (VAE, "GAN")):
        with pytest.raises(ValueError, match="A benchmark takes 'VAE' and any of"):
            chosen_variants(TINY, networks)
