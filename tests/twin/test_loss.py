import numpy as np
import torch
from torch.distributions import Independent, Normal, kl_divergence

from twin.vae.model import active_units, collapsed, kl, negative_elbo, reconstruction

DRAW = torch.Generator().manual_seed(0)


def test_kl_is_that_of_torch_distributions():
    mu, logvar = torch.randn(5, 3, generator=DRAW), torch.randn(5, 3, generator=DRAW)
    posterior = Independent(Normal(mu, (0.5 * logvar).exp()), 1)
    prior = Independent(Normal(torch.zeros(5, 3), torch.ones(5, 3)), 1)
    torch.testing.assert_close(kl(mu, logvar), kl_divergence(posterior, prior))


def test_kl_is_the_mean_log_ratio_over_samples():
    mu, logvar = torch.tensor([[0.7, -1.2]]), torch.tensor([[-1.0, 0.5]])
    q = Normal(mu, (0.5 * logvar).exp())
    z = mu + (0.5 * logvar).exp() * torch.randn(200_000, 2, generator=DRAW)
    ratio = (q.log_prob(z) - Normal(0.0, 1.0).log_prob(z)).sum(1)
    np.testing.assert_allclose(kl(mu, logvar).item(), ratio.mean(), rtol=0.02)


def test_kl_of_the_prior_is_zero():
    assert kl(torch.zeros(1, 2), torch.zeros(1, 2)).item() == 0.0


def test_reconstruction_is_the_gaussian_log_likelihood_up_to_its_constant():
    x, x_hat = torch.randn(6, 2, 3, 4, generator=DRAW), torch.randn(6, 2, 3, 4, generator=DRAW)
    log_p = Normal(x_hat, 1.0).log_prob(x).sum((0, 2))
    torch.testing.assert_close(-reconstruction(x, x_hat) - 18 * 0.5 * np.log(2 * np.pi), log_p)


def test_beta_weighs_the_kl():
    x, mu, logvar = torch.zeros(4, 1, 3, 2), torch.ones(1, 2, 2), torch.zeros(1, 2, 2)
    assert negative_elbo(x, x, mu, logvar, 1.0).item() == 1.0
    assert negative_elbo(x, x, mu, logvar, 4.0).item() == 4.0


def test_a_latent_that_never_moves_is_not_active():
    mu = torch.stack([torch.linspace(-1, 1, 50), torch.full((50,), 0.4)])
    assert active_units(mu) == 1


def test_what_counts_as_collapsed():
    assert collapsed(0.4, 1)
    assert collapsed(3.0, 0)
    assert not collapsed(0.6, 1)
