"""Networks trained side by side, against torch.nn.LSTM and torch's optimisers."""

import numpy as np
import pytest
import torch

from twin.vae.config import TwinConfig
from twin.vae.inference import tanh
from twin.vae.model import build, negative_elbo
from twin.vae.train import Run, SideBySide


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
