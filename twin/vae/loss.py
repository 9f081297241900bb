"""The evidence lower bound of a window, in nats, and whether the latent is used.

−ELBO = ½ Σ (x − x̂)² + β·KL(q(z|x) ‖ N(0, I)), a Gaussian likelihood of unit variance without its constant.
The sum over the window matters: with a mean the KL outweighs it and the posterior collapses.
Source: Kingma & Welling, arXiv 1312.6114, eq. 10 and appendix B; β: Higgins et al., ICLR 2017.
"""

import torch
from torch import Tensor

LEAST_KL_NATS = 0.5
"""A posterior closer to the prior than this carries no information about the window."""
ACTIVE_VARIANCE = 0.01
"""A latent unit is active if its mean varies more than this over the data (Burda et al., arXiv 1509.00519, 5.2)."""


def reconstruction(x: Tensor, x_hat: Tensor) -> Tensor:
    """Half the squared error summed over time and channel, [batch]."""
    return 0.5 * (x - x_hat).square().flatten(1).sum(1)


def kl(mu: Tensor, logvar: Tensor) -> Tensor:
    """KL(N(mu, e^logvar) ‖ N(0, 1)) summed over the latent, nats, [batch]; infinite for an autoencoder."""
    return 0.5 * (mu.square() + logvar.exp() - 1.0 - logvar).sum(1)


def negative_elbo(x: Tensor, x_hat: Tensor, mu: Tensor, logvar: Tensor, beta: float) -> Tensor:
    """Mean over the batch of reconstruction + β·KL, scalar; β = 0 omits the KL, as for an autoencoder."""
    error = reconstruction(x, x_hat)
    return (error + beta * kl(mu, logvar)).mean() if beta else error.mean()


def active_units(mu: Tensor) -> int:
    """Number of latent units that vary between windows, from posterior means [batch, latent]."""
    return int((torch.var(mu, dim=0, correction=0) > ACTIVE_VARIANCE).sum())


def collapsed(kl_nats: float | None, active: int) -> bool:
    """Whether the decoder ignores the latent; an autoencoder has no KL (None)."""
    return active == 0 or (kl_nats is not None and kl_nats < LEAST_KL_NATS)
