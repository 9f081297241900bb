import numpy as np
import torch
from torch.distributions import Independent, Normal, kl_divergence

from twin.vae.config import TwinConfig
from twin.vae.loss import active_units, collapsed, kl, negative_elbo, reconstruction
from twin.vae.model import build

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
    x, x_hat = torch.randn(4, 6, 3, generator=DRAW), torch.randn(4, 6, 3, generator=DRAW)
    log_p = Normal(x_hat, 1.0).log_prob(x).sum((1, 2))
    torch.testing.assert_close(-reconstruction(x, x_hat) - 18 * 0.5 * np.log(2 * np.pi), log_p)


def test_beta_weighs_the_kl():
    x, mu, logvar = torch.zeros(2, 4, 3), torch.ones(2, 2), torch.zeros(2, 2)
    assert negative_elbo(x, x, mu, logvar, 1.0).item() == 1.0
    assert negative_elbo(x, x, mu, logvar, 4.0).item() == 4.0


def test_the_gradient_of_the_elbo_is_its_finite_difference():
    net = build(TwinConfig(hidden=4, window=6, stride=2, score_stride=6), seed=1).double()
    x = torch.randn(3, 6, 3, generator=DRAW, dtype=torch.float64)
    eps = torch.randn(3, 2, generator=DRAW, dtype=torch.float64)

    def loss() -> torch.Tensor:
        return negative_elbo(x, *net(x, eps), beta=1.5)

    loss().backward()
    for name, weight in net.named_parameters():
        direction = torch.randn(weight.shape, generator=DRAW, dtype=torch.float64)
        assert weight.grad is not None
        slope = float((weight.grad * direction).sum())
        with torch.no_grad():
            weight += 1e-5 * direction
            above = float(loss())
            weight -= 2e-5 * direction
            below = float(loss())
            weight += 1e-5 * direction
        np.testing.assert_allclose(slope, (above - below) / 2e-5, rtol=1e-4, atol=1e-6, err_msg=name)


def test_a_latent_that_never_moves_is_not_active():
    mu = torch.stack([torch.linspace(-1, 1, 50), torch.full((50,), 0.4)], dim=1)
    assert active_units(mu) == 1


def test_what_counts_as_collapsed():
    assert collapsed(0.4, 1)
    assert collapsed(3.0, 0)
    assert not collapsed(0.6, 1)
