"""The same data gives the same twin; the prior's own statistics; shares by hand."""

from dataclasses import replace

import numpy as np
import pytest

from scenarios.prepare.train_twins import train_or_load
from scenarios.studies.detection_metrics import Detection
from scenarios.studies.ranking import QUESTIONS, side_by_side
from scenarios.studies.self_training import GENERATED, OWN, PRIOR, autonomy, generated_plans, prior_records, remaining
from scenarios.studies.setup import Bench, make_study
from twin.baselines.reconstruction import untrained_config
from twin.vae.config import TwinConfig

TINY = replace(untrained_config(TwinConfig()), hidden=4, max_windows=64)
SEED = np.random.SeedSequence(1)


@pytest.fixture(scope="module")
def study():
    return make_study(SEED, train=8, reference=20, test=30, novel=4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Twins of all tests here; each is trained once."""
    return tmp_path_factory.mktemp("twins")


def test_a_twin_that_is_given_its_own_data_again_is_the_same_twin(study, folder):
    bench = Bench([SEED], TINY, folder, lambda _: study)
    result = autonomy(bench, propose=lambda study, twin, count, seed: study.train.plans)
    for question in QUESTIONS:
        scorers = result[question]
        np.testing.assert_equal(scorers[GENERATED], scorers[OWN])
        assert any((scorers[PRIOR][m] != scorers[OWN][m]).any() for m in scorers[OWN])
        for share in remaining(scorers).values():
            np.testing.assert_allclose(share, 1.0)


def test_what_is_proposed_is_told_how_much_and_by_which_seed(study, folder):
    told = []

    def propose(study, twin, count, seed):
        told.append((count, seed))
        return study.train.plans[:count]

    bench = Bench([SEED], TINY, folder, lambda _: study)
    for _ in range(2):
        autonomy(bench, propose=propose, count=3)
    assert told[0] == told[1]
    assert told[0][0] == 3
    with pytest.raises(ValueError, match="at least one generated job"):
        autonomy(bench, count=0)


def test_prior_samples_are_windows_of_the_twin_in_si_units(study, folder):
    twin = train_or_load(study.train.records(), TINY, SEED, arm="arm", folder=folder)
    drawn = prior_records(twin, 40, np.random.default_rng(0))
    assert len(drawn) == 40
    assert drawn[0].shape == (TINY.window, 3, 7)
    latent = np.random.default_rng(0).standard_normal((40, 7, 2)).astype(np.float32)
    np.testing.assert_array_equal(drawn[5][:, 2, 1], twin.decode(latent)[5, :, 1, 2])


def some(auroc, auprc, spearman):
    return Detection(auroc=auroc, auprc=auprc, spearman=spearman, caught=0.0, false_novel=0.0)


def test_what_remains_by_hand():
    real, again = some(0.9, 0.8, 0.5), some(0.7, 0.4, 0.5)
    quality = side_by_side([{key: {OWN: real, GENERATED: again} for key in QUESTIONS}])
    shares = remaining(quality["any joint, total"])
    assert {name: share[0] for name, share in shares.items()} == pytest.approx(
        {"auroc": 0.5, "auprc": 0.5, "spearman": 1.0}
    )


@pytest.mark.slow
def test_a_trained_twin_proposes_motion_to_learn_from(tmp_path):
    study = make_study(SEED, train=40, reference=0, test=0, novel=0)
    twin = train_or_load(study.train.records(), TwinConfig.quick(), SEED, arm="arm", folder=tmp_path)
    plans = generated_plans(study, twin, 3, 1)
    assert len(plans) == 3
    assert all(plan.arm == study.robot.name for plan in plans)
