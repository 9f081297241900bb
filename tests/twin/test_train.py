"""Windows, network, loss and training of a twin, against torch and closed forms."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch.distributions import Independent, Normal, kl_divergence

from fleet.errors import FleetError
from twin.logs.recording import NothingCool, Recording, cool_stretches
from twin.vae.config import LOGVAR_RANGE, TwinConfig, hash_records, seed_text, training_key
from twin.vae.inference import tanh
from twin.vae.model import active_units, build, collapsed, kl, negative_elbo, one_thread
from twin.vae.train import CollapsedPosterior, Diverged, Run, SideBySide, train
from twin.vae.window import STD_FLOOR, Scaler, cover, cut, resample, windows_of

lengths = st.integers(1, 300)
windows = st.integers(2, 60)
rates = st.sampled_from([2.0, 10.0, 12.5, 33.0, 50.0, 120.0])


@given(lengths, windows, st.data())
def test_cover_makes_the_window_mean_the_plain_time_mean(length, window, data):
    stride = data.draw(st.integers(1, window))
    values = data.draw(arrays(float, (length, 3, 2), elements=st.floats(-9, 9)))
    weights = cover(length, window, stride)
    pieces = cut(values, window, stride)
    mean = np.einsum("bt,btjc->cj", weights, pieces)
    np.testing.assert_allclose(mean, values.mean(axis=0), atol=1e-9)


def test_short_motion_is_padded_by_its_last_sample_none_gives_no_window_and_blocks_are_averaged():
    (window,) = cut(np.arange(9.0).reshape(3, 3, 1), 5, 5)
    np.testing.assert_array_equal(window[:, 0, 0], [0, 3, 6, 6, 6])
    np.testing.assert_allclose(cover(3, 5, 5), [[1 / 3, 1 / 3, 1 / 3, 0, 0]])
    assert cut(np.zeros((0, 3, 7)), 50, 10).shape == (0, 50, 7, 3)
    assert cover(0, 50, 10).shape == (0, 50)
    assert resample(np.zeros((0, 3, 7)), 50.0, 12.5).shape == (0, 3, 7)
    profile = np.arange(8.0)[:, None, None] * np.ones((1, 3, 1)) * 0.1
    np.testing.assert_allclose(resample(profile, 50.0, 12.5)[:, 0, 0], [0.15, 0.55])


@given(st.integers(1, 200), rates, rates)
def test_resampling_keeps_the_integral_over_time(length, from_hz, to_hz):
    rng = np.random.default_rng(length)
    profile = rng.uniform(-1, 1, (length, 3, 2))
    new = resample(profile, from_hz, to_hz)
    span = np.full(len(new), 1 / to_hz)
    span[-1] = length / from_hz - (len(new) - 1) / to_hz
    assert span[-1] > 0
    np.testing.assert_allclose((new * span[:, None, None]).sum(0), profile.sum(0) / from_hz, atol=1e-9)


def test_a_wrap_of_a_continuous_joint_never_shows(rng, motion):
    spun = (0, 2, 4, 6)
    profile = motion(rng, 12.0).astype(float)
    profile[:, 0, spun] += 3.0
    wrapped = profile.copy()
    wrapped[:, 0, spun] = np.angle(np.exp(1j * profile[:, 0, spun]))
    assert np.abs(np.diff(wrapped[:, 0, spun], axis=0)).max() > 6
    turned = profile.copy()
    turned[:, 0, spun] += 6 * np.pi
    scaler = Scaler.fit(cut(resample(profile, 50, 12.5), 50, 10))
    want = scaler.to_z(cut(resample(profile, 50, 12.5), 50, 10))
    for other in (wrapped, turned):
        np.testing.assert_allclose(scaler.to_z(cut(resample(other, 50, 12.5), 50, 10)), want, atol=1e-4)


def test_a_limited_joint_is_not_moved_by_turns():
    at = np.zeros((1, 5, 7, 3))
    far = at.copy()
    far[:, :, 1, 0] = 4.0
    z = Scaler.fit(at).to_z(far)
    assert z[0, 0, 1, 0] == pytest.approx(4.0 / STD_FLOOR[0])


def test_z_scores_have_mean_zero_and_deviation_one_go_back_to_si_and_floor_a_still_joint(records):
    cool = windows_of(records, TwinConfig())
    scaler = Scaler.fit(cool)
    z = scaler.to_z(cool)
    np.testing.assert_allclose(z.mean(axis=(0, 1)), 0, atol=1e-4)
    np.testing.assert_allclose(z.std(axis=(0, 1)), 1, atol=1e-3)
    np.testing.assert_allclose(scaler.to_si(z), cool, atol=1e-5)
    heavy = cool.copy()
    heavy[..., 2] *= 3
    assert scaler.to_z(heavy)[..., 2].std() > 2.5
    cool[:, :, 4] = 1.0
    scaler = Scaler.fit(cool)
    np.testing.assert_array_equal(scaler.std[4], STD_FLOOR)
    np.testing.assert_array_equal(scaler.still, np.arange(7) == 4)
    assert np.all(np.isfinite(scaler.to_z(cool)))


def test_records_that_cannot_teach_are_refused(rng, motion, tiny):
    bad, whole = motion(rng, 2.0), np.zeros((100, 3, 7))
    bad[4, 2, 1] = np.nan
    for records, words in (
        ([], "at least one record"),
        ([np.zeros((0, 3, 7))], "at least one record"),
        ([np.zeros((5, 7))], r"Record 0 must be \[time, 3, joint\]"),
        ([np.zeros((5, 2, 7))], r"Record 0 must be \[time, 3, joint\]"),
        ([whole.astype(np.float32), bad], "Record 1 is not finite: tau of joint 2 at sample 4"),
        ([whole, np.zeros((100, 3, 6))], "same number of joints"),
    ):
        with pytest.raises(ValueError, match=words):
            train(records, tiny, SEED, arm="a")


@pytest.mark.parametrize(("latent", "layers"), [(1, 2), (5, 1)])
def test_shapes_and_the_range_of_the_log_variance(latent, layers):
    net = build(TwinConfig(latent=latent, hidden=8, layers=layers), seed=0)
    x_hat, mu, logvar = net(torch.zeros(4, 50, 3), torch.zeros(4, latent))
    assert (x_hat.shape, mu.shape, logvar.shape) == ((4, 50, 3), (4, latent), (4, latent))
    with torch.no_grad():
        net.logvar.bias.copy_(100.0 * (-1.0) ** torch.arange(latent))
        _, logvar = net.encode(torch.randn(3, 50, 3))
    assert logvar.unique().tolist() == sorted(LOGVAR_RANGE)[-min(latent, 2) :]


def test_one_thread_gives_the_threads_back_even_after_an_error():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    seen = []
    try:
        with pytest.raises(ZeroDivisionError), one_thread():
            seen.append(torch.get_num_threads() / (torch.get_num_threads() - 1))
        with one_thread():
            seen.append(torch.get_num_threads())
        seen.append(torch.get_num_threads())
    finally:
        torch.set_num_threads(before)
    assert seen == [1, 2]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scope": "leg"}, "No scope 'leg'"),
        ({"kind": "gan"}, "No kind 'gan'"),
        ({"trial": 0.0}, r"trial must be in \(0, 1\]"),
        ({"latent": 0}, "latent must be 1 to 64"),
        ({"rate_hz": 0.0}, "rate_hz must be > 0 and at most 1000"),
        ({"learning_rate": float("nan")}, "learning_rate must be > 0"),
        ({"window": 1}, "window must be 2 to 10000"),
        ({"window": 20, "stride": 30}, "never seen"),
        ({"beta": -1.0}, "beta must be 0 to 1000"),
        ({"noise": (0.1, -0.1, 0.1)}, "noise must be three"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        TwinConfig(**change)


def test_a_seed_reads_as_entropy_and_spawn_key():
    assert seed_text(np.random.SeedSequence(5, spawn_key=(1, 2))) == "5/1.2"


def test_an_autoencoder_is_certain_whatever_the_noise():
    net = build(TwinConfig(kind="ae"), seed=0)
    x = torch.randn(4, 50, 3, generator=torch.Generator().manual_seed(1))
    quiet, mu, logvar = net(x, torch.zeros(4, 2))
    loud, _, _ = net(x, torch.full((4, 2), 1e6))
    assert torch.equal(quiet, loud)
    assert torch.equal(logvar.exp(), torch.zeros_like(mu))


DRAW = torch.Generator().manual_seed(0)


def test_kl_is_that_of_torch_distributions():
    mu, logvar = torch.randn(5, 3, generator=DRAW), torch.randn(5, 3, generator=DRAW)
    posterior = Independent(Normal(mu, (0.5 * logvar).exp()), 1)
    prior = Independent(Normal(torch.zeros(5, 3), torch.ones(5, 3)), 1)
    torch.testing.assert_close(kl(mu, logvar), kl_divergence(posterior, prior))


def test_a_latent_that_never_moves_is_not_active_and_none_or_little_kl_counts_as_collapsed():
    assert active_units(torch.stack([torch.linspace(-1, 1, 50), torch.full((50,), 0.4)])) == 1
    assert [collapsed(0.4, 1), collapsed(3.0, 0), collapsed(0.6, 1)] == [True, True, False]


SEED = np.random.SeedSequence(11)


@pytest.fixture(scope="module")
def tiny() -> TwinConfig:
    return TwinConfig(hidden=8, max_windows=64, epochs=3, batch=32, restarts=2, trial=0.4, allow_collapse=True)


def test_the_twin_knows_its_training_better_than_their_mean(twin):
    for fit in twin.fits:
        assert fit.mean_squared_error < 0.75
        assert fit.kl > 0.5
        assert fit.active_units >= 1


def test_a_seed_gives_the_same_weights_and_leaves_global_states_alone(records, tiny):
    before, threads, progress = torch.random.get_rng_state(), torch.get_num_threads(), list[float]()
    first = train(records, tiny, SEED, arm="a", progress=progress.append)
    assert torch.equal(before, torch.random.get_rng_state())
    assert torch.get_num_threads() == threads
    assert first.data_hash == hash_records(records)
    assert progress == sorted(progress)
    assert progress[-1] == pytest.approx(1.0)
    assert len(progress) == 3  # epochs, each of all joints and restarts together
    again = train(records, tiny, SEED, arm="a")
    other = train(records, tiny, np.random.SeedSequence(12), arm="a")
    assert first.version == again.version != other.version
    for name, tensor in first.tensors().items():
        np.testing.assert_array_equal(tensor, again.tensors()[name])


@pytest.mark.slow
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


def test_more_windows_than_wanted_are_drawn_without_bias(records, tiny):
    rising = [record + np.float32(i) for i, record in enumerate(records)]
    means = [
        train(rising, replace(tiny, hidden=2, epochs=1, restarts=1), np.random.SeedSequence(s), arm="a").scaler.mean[
            1, 0
        ]
        for s in range(6)
    ]
    of_64 = np.std(np.arange(60)) / np.sqrt(64)
    assert np.std(means) > 0.2 * of_64
    np.testing.assert_allclose(np.mean(means), np.mean(rising, axis=(0, 1))[0, 1], atol=4 * of_64 / np.sqrt(6))


def test_a_collapsed_posterior_is_an_error_with_advice(records, small):
    drowned = replace(small, beta=1000.0, epochs=8, max_windows=128)
    with pytest.raises(CollapsedPosterior, match=r"from .* s of motion.* lower beta") as caught:
        train(records, drowned, SEED, arm="arm_3")
    assert isinstance(caught.value, FleetError)
    assert "arm_3" in str(caught.value)
    kept = train(records, replace(drowned, allow_collapse=True), SEED, arm="arm_3")
    assert max(fit.kl for fit in kept.fits) < 0.5


def test_a_joint_that_stood_still_may_have_nothing_to_say(records, small):
    held = [record.copy() for record in records]
    for record in held:
        record[:, :, 4:] = record[0, :, 4:] = 0.5
    twin = train(held, replace(small, epochs=15, noise=(0.0, 0.0, 0.0)), SEED, arm="a")
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


def test_one_network_can_know_the_whole_arm(records, small):
    config = replace(small, scope="arm", latent=8, hidden=32, epochs=20)
    twin = train(records, config, SEED, arm="a")
    assert len(twin.nets) == len(twin.fits) == 1
    assert {name.split(".")[0] for name in twin.tensors()} == {"arm"}
    assert twin.fits[0].mean_squared_error < 0.9
    assert twin.fits[0].kl > 0.5
    assert len(twin.fits[0].kl_by_epoch) == config.epochs


def test_an_autoencoder_has_no_posterior_and_is_watched_by_its_units(records, small):
    twin = train(records, replace(small, kind="ae", epochs=10), SEED, arm="a")
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


def test_a_record_shorter_than_a_window_teaches_what_it_shows(motion, tiny, rng):
    twin = train([motion(rng, 1.0) for _ in range(40)], tiny, SEED, arm="a")
    assert np.isfinite([fit.elbo for fit in twin.fits]).all()


JOINTS = 7


def warmed(temp_2_c: np.ndarray, others_c: float = 30.0, name: str = "a") -> Recording:
    """A recording at 1 Hz in which only the temperature of joint 2 changes."""
    time_s = np.arange(float(len(temp_2_c)))
    still = np.zeros((len(time_s), JOINTS))
    temp_c = np.full_like(still, others_c)
    temp_c[:, 1] = temp_2_c
    return Recording(name=name, time_s=time_s, q=still, qd=still, tau=still, temp_c=temp_c)


def test_what_comes_later_counts():
    temp_c = np.full(300, 35.0)
    temp_c[150] = 41.0
    recordings = [warmed(temp_c), warmed(temp_c + 10, name="b"), warmed(np.full(100, 39.0), name="c")]
    found = cool_stretches(recordings, 1.0, cool_c=40.0, joints=range(JOINTS))
    assert [s.recording for s in found] == ["a", "c"]
    assert [(s.time_s[0], s.time_s[-1]) for s in found] == [(151.0, 299.0), (0.0, 99.0)]
    long = cool_stretches(recordings, 1.0, cool_c=40.0, joints=range(JOINTS), least_s=140.0)
    assert [s.recording for s in long] == ["a"]


def test_motors_that_do_not_count_may_be_warm():
    idle = warmed(np.full(100, 33.0), others_c=42.0)
    with pytest.raises(NothingCool, match=r"Always above: 1 \(42.0 °C\), 3 .*Raise the limit"):
        cool_stretches([idle], 1.0, cool_c=40.0, joints=range(JOINTS))
    assert [len(s.time_s) for s in cool_stretches([idle], 1.0, cool_c=40.0, joints=[1])] == [100]


LATE_PEAK_C = np.full(100, 35.0)
LATE_PEAK_C[87] = 50.0
NO_HEAT = {name: getattr(warmed(np.full(10, 30.0)), name) for name in ("time_s", "q", "qd", "tau")}
REFUSED = {
    "hot": (
        [warmed(np.full(100, 50.0))] * 2, {"joints": [1, 2]},
        r"^At no moment of 2 recording.*motors 2, 3 stay below 40 °C for the rest.*2 \(50.0 °C\).*Raise the limit",
    ),
    "short": (
        [warmed(np.full(10, 30.0))] * 2, {"least_s": 25.0},
        r"^The recording is shorter .* 25 s are needed, the longest .* has 10 s\.",
    ),
    "short part": (
        [warmed(LATE_PEAK_C)], {"least_s": 25.0},
        r"^The part that stays cool is shorter .* 25 s are needed, the longest .* has 12 s\.",
    ),
    "none": ([], {}, "at least one recording"),
    "no such joint": ([warmed(np.full(10, 30.0))], {"joints": [7]}, "some of 0 … 6"),
    "no temperatures": ([Recording(name="blind", **NO_HEAT)], {}, "'blind' has no motor temperatures"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_recordings_without_a_cool_part_are_refused_with_the_reason(name):
    recordings, options, words = REFUSED[name]
    with pytest.raises((NothingCool, ValueError), match=words):
        cool_stretches(recordings, 1.0, cool_c=40.0, **{"joints": [1], **options})


def drawn(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def loss_of(x, x_hat, mu, logvar, config):
    """As `negative_elbo` of one network in the layout of `LstmVae`, written out."""
    squares = 0.5 * (x - x_hat) ** 2
    error = squares.sum((1, 2)) if config.loss == "sum" else squares.mean((1, 2))
    if config.kind == "ae":
        return error.mean()
    kl = -0.5 * (1 + logvar - mu**2 - logvar.exp()).sum(1)
    return (error + config.beta * kl).mean()


def test_the_tangent_is_that_of_numpy():
    x = np.concatenate([np.linspace(-12, 12, 4001), [0.0, 1e-20, -1e-6, 1e6, -1e30]]).astype(np.float32)
    np.testing.assert_allclose([tanh(value) for value in x], np.tanh(x.astype(float)), atol=4e-7)


@pytest.mark.parametrize(("layers", "kind", "loss"), [(1, "vae", "sum"), (2, "vae", "mean"), (3, "ae", "sum")])
@pytest.mark.parametrize("batch", [1, 17])
def test_values_and_gradients_are_those_of_torch(layers, kind, loss, batch):
    config = TwinConfig(hidden=9, layers=layers, kind=kind, loss=loss, beta=1.5)
    nets = [build(config, seed) for seed in range(3)]
    together = SideBySide.of(nets, config)
    parameters = together.parameters
    x, eps = drawn(0, 20, 3, 3, batch), drawn(1, 3, 2, batch)
    x_hat, mu, logvar = together(x, eps)
    negative_elbo(x, x_hat, mu, logvar, 1.5 if kind == "vae" else 0.0, config.loss).sum().backward()
    assert all(parameter.grad is not None for parameter in parameters)
    for n, net in enumerate(nets):
        alone = x[:, n].permute(2, 0, 1)
        want_x, want_mu, want_logvar = net(alone, eps[n].T)
        torch.testing.assert_close(x_hat[:, n].permute(2, 0, 1), want_x, atol=2e-6, rtol=0)
        torch.testing.assert_close(mu[n].T, want_mu, atol=2e-6, rtol=0)
        torch.testing.assert_close(logvar[n].T, want_logvar, atol=2e-6, rtol=0)
        loss_of(alone, want_x, want_mu, want_logvar, config).backward()
        for name, parameter in net.named_parameters():
            got, want = together.weights[name].grad, parameter.grad
            assert got is not None
            assert want is not None
            torch.testing.assert_close(got[n], want, atol=2e-5 * float(want.abs().max()) + 1e-9, rtol=0)


@pytest.mark.parametrize("optimizer", ["adam", "sgd"])
def test_a_training_is_that_of_torch_with_the_same_draws(optimizer):
    """Three epochs of three batches, the last one smaller, by torch.nn.LSTM, torch's clipping and its optimisers."""
    config = TwinConfig(hidden=6, epochs=3, batch=16, optimizer=optimizer, learning_rate=2e-2, clip=3.0)
    x, noise, seeds = [drawn(n, 12, 3, 40) for n in range(2)], torch.full((2, 3), 0.1), [5, 6]
    run = Run(x, noise, config, seeds)
    run.train(3)
    for n, seed in enumerate(seeds):
        net, draw = build(config, seed), torch.Generator().manual_seed(seed)
        rate = config.learning_rate
        if optimizer == "sgd":
            steps, schedule = torch.optim.SGD(net.parameters(), rate), None
        else:
            steps = torch.optim.Adam(net.parameters(), rate)
            schedule = torch.optim.lr_scheduler.OneCycleLR(steps, rate, total_steps=9)
        for _ in range(3):
            for some in torch.randperm(40, generator=draw).split(16):
                eps = torch.randn(2, len(some), generator=draw)
                batch = x[n][:, :, some] + 0.1 * torch.randn(12, 3, len(some), generator=draw)
                steps.zero_grad()
                batch = batch.permute(2, 0, 1)
                x_hat, mu, logvar = net(batch, eps.T)
                loss_of(batch, x_hat, mu, logvar, config).backward()
                torch.nn.utils.clip_grad_norm_(net.parameters(), 3.0)
                steps.step()
                if schedule:
                    schedule.step()
        for name, weight in net.state_dict().items():
            np.testing.assert_allclose(run.nets.weights_of(n)[name], weight.numpy(), atol=2e-4)


def test_a_selection_goes_on_as_if_nothing_had_happened():
    config = TwinConfig(hidden=6, epochs=4, batch=16)
    x, noise = [drawn(n, 12, 3, 40) for n in range(3)], torch.full((3, 3), 0.1)
    whole, half = Run(x, noise, config, [1, 2, 3]), Run(x, noise, config, [1, 2, 3])
    whole.train(4)
    half.train(2)
    first, second = half.select([2, 0]), half.select([2])
    first.train(4)
    second.train(4)
    assert len(half.elbo_by_epoch) == 2
    for run, i, n in ((first, 0, 2), (first, 1, 0), (second, 0, 2)):
        for name, weight in whole.nets.weights_of(n).items():
            np.testing.assert_allclose(run.nets.weights_of(i)[name], weight, atol=1e-5)
    torch.testing.assert_close(torch.stack(first.elbo_by_epoch), torch.stack(whole.elbo_by_epoch)[:, [2, 0]])


def test_a_network_that_diverges_leaves_its_neighbours_alone():
    config = TwinConfig(hidden=6, epochs=2, batch=16)
    x, noise = [drawn(0, 12, 3, 32), drawn(1, 12, 3, 32)], torch.zeros(2, 3)
    spoilt = [x[0], torch.full_like(x[1], torch.nan)]
    alone, beside = Run(x, noise, config, [1, 2]), Run(spoilt, noise, config, [1, 2])
    alone.train(2)
    beside.train(2)
    assert np.isfinite(beside.elbos()).tolist() == [True, False]
    for name, weight in alone.nets.weights_of(0).items():
        np.testing.assert_allclose(beside.nets.weights_of(0)[name], weight, atol=1e-6)
