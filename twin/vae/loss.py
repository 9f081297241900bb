"""The evidence lower bound of a window, in nats, and whether the latent is used.

−ELBO = ½ Σ (x − x̂)² + β·KL(q(z|x) ‖ N(0, I)), a Gaussian likelihood of unit variance without its constant.
The sum over the window matters: with a mean the KL outweighs it and the posterior collapses.
Windows are [time, net, channel, batch], latents [net, latent, batch], as in `twin.vae.side_by_side`.
Source: Kingma & Welling, arXiv 1312.6114, eq. 10 and appendix B; β: Higgins et al., ICLR 2017.
"""

import torch
from torch import Tensor

from twin.vae.config import Loss

LEAST_KL_NATS = 0.5
"""A posterior closer to the prior than this carries no information about the window."""
ACTIVE_VARIANCE = 0.01
"""A latent unit is active if its mean varies more than this over the data (Burda et al., arXiv 1509.00519, 5.2)."""


def reconstruction(x: Tensor, x_hat: Tensor, loss: Loss = "sum") -> Tensor:
    """Half the squared error, summed or averaged over time and channel, [net, batch]."""
    squares = 0.5 * (x - x_hat).square()
    return squares.sum((0, 2)) if loss == "sum" else squares.mean((0, 2))


def kl(mu: Tensor, logvar: Tensor) -> Tensor:
    """KL(N(mu, e^logvar) ‖ N(0, 1)) summed over the latent, nats, [net, batch]; infinite for an autoencoder."""
    return 0.5 * (mu.square() + logvar.exp() - 1.0 - logvar).sum(1)


def negative_elbo(x: Tensor, x_hat: Tensor, mu: Tensor, logvar: Tensor, beta: float, loss: Loss = "sum") -> Tensor:
    """Mean over the batch of reconstruction + β·KL, [net]; β = 0 omits the KL, as for an autoencoder."""
    error = reconstruction(x, x_hat, loss)
    return (error + beta * kl(mu, logvar)).mean(1) if beta else error.mean(1)


def active_units(mu: Tensor) -> int:
    """Number of latent units of one network that vary between windows, from posterior means [latent, batch]."""
    return int((torch.var(mu, dim=1, correction=0) > ACTIVE_VARIANCE).sum())


def collapsed(kl_nats: float | None, active: int) -> bool:
    """Whether the decoder ignores the latent; an autoencoder has no KL (None)."""
    return active == 0 or (kl_nats is not None and kl_nats < LEAST_KL_NATS)
