from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest
import torch

from fleet.errors import FleetError
from twin.vae.config import TwinConfig, hash_records, seed_text, training_key
from twin.vae.train import CollapsedPosterior, Diverged, Run, train

SEED = np.random.SeedSequence(11)


@pytest.fixture(scope="module")
def tiny() -> TwinConfig:
    return TwinConfig(hidden=8, max_windows=64, epochs=3, batch=32, restarts=2, trial=0.4, allow_collapse=True)


def test_the_objective_rises_on_the_same_windows():
    draw = torch.Generator().manual_seed(0)
    time, phase = torch.arange(50) / 12.5, 6.28 * torch.rand(1, 1, 32, generator=draw)
    x = 2 * torch.sin(time[:, None, None] + phase + torch.tensor([0.0, 1.57, 0.5])[:, None])
    config = TwinConfig(hidden=16, learning_rate=2e-2, epochs=120, batch=32)
    run = Run([x], torch.zeros(1, 3), config, [0])
    run.train(config.epochs)
    assert run.elbo_by_epoch[-1] > 0.6 * run.elbo_by_epoch[0]


def test_the_twin_knows_its_training_better_than_their_mean(twin):
    for fit in twin.fits:
        assert fit.mean_squared_error < 0.75
        assert fit.kl > 0.5
        assert fit.active_units >= 1


def test_the_same_seed_gives_the_same_weights(records, tiny):
    first = train(records, tiny, SEED, arm="a")
    again = train(records, tiny, SEED, arm="a")
    other = train(records, tiny, np.random.SeedSequence(12), arm="a")
    assert first.version == again.version != other.version
    for name, tensor in first.tensors().items():
        np.testing.assert_array_equal(tensor, again.tensors()[name])


def test_training_leaves_global_random_states_and_threads_alone(records, tiny):
    before, threads = torch.random.get_rng_state(), torch.get_num_threads()
    train(records, tiny, SEED, arm="a")
    assert torch.equal(before, torch.random.get_rng_state())
    assert torch.get_num_threads() == threads


@pytest.mark.ci_slow
def test_another_process_trains_the_same_twin(records, tiny):
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        there = pool.submit(train, records[:8], tiny, SEED, arm="a").result(timeout=300)
    assert there.version == train(records[:8], tiny, SEED, arm="a").version


def test_the_restart_that_is_ahead_after_the_trial_is_trained_to_the_end(records, tiny):
    config = replace(tiny, epochs=5, trial=0.4, restarts=3)
    twin = train(records[:8], config, SEED, arm="a")
    assert {len(fit.elbo_by_epoch) for fit in twin.fits} == {5}
    assert any(fit.restart > 0 for fit in twin.fits)
    for fit in twin.fits:
        assert len(fit.restart_elbos) == 3
        assert fit.restart == np.argmax(fit.restart_elbos)
    alone = train(records[:8], replace(config, restarts=1), SEED, arm="a").fits
    for joint, fit in enumerate(twin.fits):
        assert (fit.elbo_by_epoch == pytest.approx(alone[joint].elbo_by_epoch, rel=1e-6)) == (fit.restart == 0)


def test_a_whole_trial_keeps_the_best_of_full_trainings(records, tiny):
    config = replace(tiny, trial=1.0)
    both = train(records[:8], config, SEED, arm="a")
    first = train(records[:8], replace(config, restarts=1), SEED, arm="a")
    assert all(b.elbo >= f.elbo for b, f in zip(both.fits, first.fits, strict=True))
    assert any(b.elbo > f.elbo for b, f in zip(both.fits, first.fits, strict=True))


def test_more_windows_than_wanted_are_drawn_without_bias(records, tiny):
    rising = [record + np.float32(i) for i, record in enumerate(records)]
    means = [
        train(rising, replace(tiny, epochs=1, restarts=1), np.random.SeedSequence(s), arm="a").scaler.mean[1, 0]
        for s in range(6)
    ]
    of_64 = np.std(np.arange(60)) / np.sqrt(64)
    assert np.std(means) > 0.2 * of_64
    np.testing.assert_allclose(np.mean(means), np.mean(rising, axis=(0, 1))[0, 1], atol=4 * of_64 / np.sqrt(6))


def test_progress_rises_to_one(records, tiny):
    told: list[float] = []
    train(records[:4], tiny, SEED, arm="a", progress=told.append)
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)
    assert len(told) == 3  # epochs, each of all joints and restarts together


def test_a_collapsed_posterior_is_an_error_with_advice(records, small):
    drowned = replace(small, beta=1000.0, epochs=8, max_windows=128)
    with pytest.raises(CollapsedPosterior, match="Lower beta") as caught:
        train(records, drowned, SEED, arm="arm_3")
    assert isinstance(caught.value, FleetError)
    assert "arm_3" in str(caught.value)
    kept = train(records, replace(drowned, allow_collapse=True), SEED, arm="arm_3")
    assert max(fit.kl for fit in kept.fits) < 0.5


def test_a_joint_that_stood_still_may_have_nothing_to_say(records, small):
    held = [record.copy() for record in records]
    for record in held:
        record[:, :, 4:] = record[0, :, 4:] = 0.5
    twin = train(held, replace(small, epochs=25, noise=(0.0, 0.0, 0.0)), SEED, arm="a")
    assert twin.scaler.still.tolist() == [False] * 4 + [True] * 3


def test_diverged_training_is_an_error(records, tiny):
    with pytest.raises(Diverged, match="training of joint 1 of 'a' ended without finite weights"):
        train(records, replace(tiny, learning_rate=1e30, clip=1e30, epochs=5), SEED, arm="a")


def test_the_key_changes_with_data_configuration_and_seed(records, tiny):
    key = training_key(records, tiny, SEED)
    assert key == training_key([record.copy() for record in records], tiny, np.random.SeedSequence(11))
    changed = [records[0] + 1e-6, *records[1:]]
    others = [
        training_key(changed, tiny, SEED),
        training_key(records[1:], tiny, SEED),
        training_key(records, replace(tiny, beta=2.0), SEED),
        training_key(records, tiny, np.random.SeedSequence(12)),
        training_key(records, tiny, np.random.SeedSequence(11, spawn_key=(1,))),
    ]
    assert len({key, *others}) == 6


def test_the_data_is_named_by_its_content_unless_told(records, tiny):
    one = replace(tiny, epochs=1, restarts=1)
    assert train(records[:2], one, SEED, arm="a").data_hash == hash_records(records[:2])
    assert train(records[:2], one, SEED, arm="a", data_hash="lot 7").data_hash == "lot 7"


def test_a_seed_reads_as_entropy_and_spawn_key():
    assert seed_text(np.random.SeedSequence(5, spawn_key=(1, 2))) == "5/1.2"


def test_one_network_can_know_the_whole_arm(records, small):
    config = replace(small, scope="arm", latent=8, hidden=32)
    twin = train(records, config, SEED, arm="a")
    assert len(twin.nets) == len(twin.fits) == 1
    assert {name.split(".")[0] for name in twin.tensors()} == {"arm"}
    assert twin.fits[0].mean_squared_error < 0.9
    assert twin.fits[0].kl > 0.5
    assert len(twin.fits[0].kl_by_epoch) == config.epochs


def test_an_autoencoder_has_no_posterior_and_is_watched_by_its_units(records, small):
    twin = train(records, replace(small, kind="ae"), SEED, arm="a")
    assert not any("logvar" in name for name in twin.tensors())
    for fit in twin.fits:
        assert fit.kl == 0.0
        assert fit.active_units >= 1
        np.testing.assert_allclose(fit.elbo, -0.5 * 3 * small.window * fit.mean_squared_error, rtol=1e-4)


def test_an_autoencoder_that_learned_nothing_is_collapsed(records, small):
    still = replace(small, kind="ae", learning_rate=1e-9, epochs=1)
    with pytest.raises(CollapsedPosterior, match="0 active latent unit"):
        train(
            [record * np.float32(0.0) + record[:1] * np.float32(i % 2) for i, record in enumerate(records[:6])],
            replace(still, noise=(0.0, 0.0, 0.0), latent=1),
            SEED,
            arm="a",
        )


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ([], "at least one record"),
        ([np.full((100, 3, 7), np.nan)], "Record 0 is not finite"),
        ([np.zeros((100, 3, 7)), np.zeros((100, 3, 6))], "same number of joints"),
    ],
)
def test_records_that_cannot_teach_are_refused(tiny, bad, words):
    with pytest.raises(ValueError, match=words):
        train(bad, tiny, SEED, arm="a")


def test_a_record_shorter_than_a_window_teaches_what_it_shows(motion, tiny, rng):
    twin = train([motion(rng, 1.0) for _ in range(40)], tiny, SEED, arm="a")
    assert np.isfinite([fit.elbo for fit in twin.fits]).all()
