"""Regressors against least squares, aggregation against the mean by hand, few labels against many."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.errors import FleetError
from scenarios.prepare.train_twins import train_or_load
from scenarios.studies.benchmark import jobs_of
from scenarios.studies.setup import Bench, make_study
from scenarios.studies.transfer import INPUTS, REGRESSORS, compare, fit, job_inputs, moments, over_time, transfer
from twin.baselines.reconstruction import untrained_config
from twin.vae.config import TwinConfig
from twin.vae.window import cut_jobs

TINY = replace(untrained_config(TwinConfig()), hidden=4, max_windows=64)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Twins of all tests here; each is trained once."""
    return tmp_path_factory.mktemp("twins")


@pytest.fixture(scope="module")
def tiny():
    """Studies by their seed; each is made once."""
    made = {}

    def make(seed):
        if seed.entropy not in made:
            made[seed.entropy] = make_study(seed, train=6, reference=2, test=44, novel=0)
        return made[seed.entropy]

    return make


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def test_what_depends_linearly_is_learned_exactly(rng):
    x = rng.normal(size=(60, 4))
    y = 30.0 + x @ np.array([1.0, -2.0, 0.5, 0.0])
    said = fit("ridge", x[:40], y[:40], seed=0).predict(x[40:])
    solved, *_ = np.linalg.lstsq(np.c_[np.ones(40), x[:40]], y[:40], rcond=None)
    np.testing.assert_allclose(said, np.c_[np.ones(20), x[40:]] @ solved, atol=0.02)
    np.testing.assert_allclose(said, y[40:], atol=0.02)


def test_the_small_network_learns_what_ridge_cannot(rng):
    x = rng.uniform(-1, 1, (400, 1))
    y = 40.0 + 10.0 * x[:, 0] ** 2
    errors = {name: np.std(fit(name, x[:200], y[:200], seed=1).predict(x[200:]) - y[200:]) for name in REGRESSORS}
    assert errors["MLP"] < 0.3 * errors["ridge"]
    repeated = [fit("MLP", x[:50], y[:50], seed=2).predict(x) for _ in range(2)]
    np.testing.assert_array_equal(*repeated)


def test_more_labels_help_and_an_input_that_knows_beats_noise(rng):
    x = rng.normal(size=(120, 6))
    rise_k = 20.0 + 5.0 * x[:, 0] + rng.normal(0, 0.5, 120)
    by = compare({"knows": x, "noise": rng.normal(size=(120, 6))}, rise_k, rng, labels=(6, 40), draws=2)
    assert len(by) == 2 * len(REGRESSORS) * 2
    assert np.mean(by["knows", "ridge", 40]["rmse_k"]) < np.mean(by["knows", "ridge", 6]["rmse_k"])
    assert np.mean(by["knows", "ridge", 40]["r2"]) > 0.97
    assert np.mean(by["noise", "ridge", 40]["r2"]) < 0.1
    assert all(len(row["r2"]) == len(row["rmse_k"]) == 2 for row in by.values())
    with pytest.raises(FleetError, match="61 labels need 122 jobs"):
        compare({"knows": x}, rise_k, rng, labels=(61,))


def test_aggregation_by_hand(small):
    work = small.work()
    plan = small.arm(0, [work], times=small.Times(approach=4.0, cycle=8.0, retreat=4.0)).plans[work][0]
    reading = cut_jobs([plan, plan], [1, 3], TINY.changed(window=50))  # windows of 4 s: 1 + 2 + 1
    found = over_time(reading, np.array([0.0, 1.0, 3.0, 4.0] * 2)[:, None])
    np.testing.assert_allclose(found[0], [2.0, np.sqrt((4 + 1 + 1 + 4) / 4)])
    np.testing.assert_allclose(found[1], [(0 + 3 * 1 + 3 * 3 + 4) / 8, np.sqrt((4 + 3 * 1 + 3 * 1 + 4) / 8)])


def test_moments_by_hand():
    windows = np.zeros((1, 2, 1, 3))
    windows[0, :, 0, 2] = [1.0, 7.0]
    np.testing.assert_allclose(moments(windows)[0, 0], [0, 0, 4.0, 0, 0, 3.0, 0, 0, 5.0])


def test_transfer_runs_from_study_to_table_and_repeats(tiny, folder):
    seeds = [np.random.SeedSequence(1), np.random.SeedSequence(2)]
    first = transfer(Bench(seeds, TINY, folder, tiny), labels=(8,), draws=1)
    again = transfer(Bench(seeds[:1], TINY, folder, tiny), labels=(8,), draws=1)
    assert [row["rmse_k"][:1] for row in first.values()] == [row["rmse_k"] for row in again.values()]
    assert list(first) == [(i, r, 8) for i in INPUTS for r in REGRESSORS]
    assert all(len(row["r2"]) == 2 for row in first.values())
    with pytest.raises(ValueError, match="at least one seed"):
        transfer(Bench([], TINY, folder, tiny))


def test_inputs_follow_their_jobs(tiny, folder):
    study = tiny(np.random.SeedSequence(1))
    twin = train_or_load(study.train.records(), TINY, np.random.SeedSequence(1), arm="arm", folder=folder)
    jobs = jobs_of(study.test, study.horizon_s)
    order = np.random.default_rng(0).permutation(len(jobs.plans))
    moved = replace(
        jobs,
        plans=tuple(jobs.plans[i] for i in order),
        repetitions=tuple(jobs.repetitions[i] for i in order),
        peak_c=jobs.peak_c[order],
    )
    first, again = job_inputs(twin, jobs), job_inputs(twin, moved)
    assert first["latent"].shape == (44, 7 * 2 * 2)
    assert first["raw"].shape == (44, 7 * 9 * 2)
    assert first["both"].shape == (44, 7 * 22)
    for name, values in first.items():
        np.testing.assert_allclose(values[order], again[name], rtol=1e-4, atol=1e-5)
