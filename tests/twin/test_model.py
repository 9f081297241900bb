import pytest
import torch

from twin.vae.config import LOGVAR_RANGE, TwinConfig
from twin.vae.model import build, one_thread


@pytest.mark.parametrize("latent", [1, 2, 5])
@pytest.mark.parametrize("layers", [1, 2])
def test_shapes(latent, layers):
    net = build(TwinConfig(latent=latent, hidden=8, layers=layers), seed=0)
    x_hat, mu, logvar = net(torch.zeros(4, 50, 3), torch.zeros(4, latent))
    assert x_hat.shape == (4, 50, 3)
    assert mu.shape == logvar.shape == (4, latent)


def test_the_log_variance_stays_in_its_range():
    net = build(TwinConfig(), seed=0)
    with torch.no_grad():
        net.logvar.bias.copy_(torch.tensor([100.0, -100.0]))
        _, logvar = net.encode(torch.randn(3, 50, 3))
    assert logvar.unique().tolist() == sorted(LOGVAR_RANGE)


def test_building_leaves_the_global_random_state_alone():
    before = torch.random.get_rng_state()
    first, second, other = build(TwinConfig(), 5), build(TwinConfig(), 5), build(TwinConfig(), 6)
    assert torch.equal(before, torch.random.get_rng_state())
    assert torch.equal(first.mu.weight, second.mu.weight)
    assert not torch.equal(first.mu.weight, other.mu.weight)


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
        ({"noise": (0.1, 0.1)}, "noise must be three"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        TwinConfig(**change)


def test_quick_trains_less():
    quick, full = TwinConfig.quick(), TwinConfig()
    assert quick.max_windows * quick.epochs * quick.restarts < full.max_windows * full.epochs * full.restarts / 4


def test_an_autoencoder_is_certain_whatever_the_noise():
    net = build(TwinConfig(kind="ae"), seed=0)
    x = torch.randn(4, 50, 3, generator=torch.Generator().manual_seed(1))
    quiet, mu, logvar = net(x, torch.zeros(4, 2))
    loud, _, _ = net(x, torch.full((4, 2), 1e6))
    assert torch.equal(quiet, loud)
    assert torch.equal(logvar.exp(), torch.zeros_like(mu))


@pytest.mark.parametrize(("scope", "networks", "channels"), [("joint", 7, 3), ("arm", 1, 21)])
def test_a_scope_says_how_many_networks_read_how_much(scope, networks, channels):
    config = TwinConfig(scope=scope)
    assert (config.networks(7), config.channels(7)) == (networks, channels)
