"""The network: an LSTM encoder of a window to a Gaussian latent, and an LSTM decoder back to the window; and its loss.

−ELBO = ½ Σ (x − x̂)² + β·KL(q(z|x) ‖ N(0, I)), a Gaussian likelihood of unit variance without its constant.
The sum over the window matters: with a mean the KL outweighs it and the posterior collapses.
Windows of the loss are [time, net, channel, batch], latents [net, latent, batch], as in `twin.vae.train`.

Sources: E. Guiffo Kaigom, arXiv 2509.12740; Kingma & Welling, arXiv 1312.6114, eq. 10 and appendix B; β: Higgins et
al., ICLR 2017.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor, nn

from fleet.motion import CHANNELS
from twin.vae.config import LOGVAR_RANGE, Loss, TwinConfig


class LstmVae(nn.Module):
    """Encoder and decoder of windows [batch, time, channel], in z-scores."""

    def __init__(self, config: TwinConfig, channels: int) -> None:
        super().__init__()
        hidden, layers = config.hidden, config.layers
        self.encoder = nn.LSTM(channels, hidden, layers, batch_first=True)
        self.summary = nn.Linear(hidden, hidden)
        self.mu = nn.Linear(hidden, config.latent)
        self.logvar = nn.Linear(hidden, config.latent) if config.kind == "vae" else None
        self.expand = nn.Linear(config.latent, hidden)
        self.decoder = nn.LSTM(hidden, hidden, layers, batch_first=True)
        self.out = nn.Linear(hidden, channels)

    def encode(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Posterior mean and log variance, each [batch, latent]; the log variance of an autoencoder is -inf."""
        _, (last, _) = self.encoder(x)
        summary = torch.tanh(self.summary(last[-1]))
        mu = self.mu(summary)
        if self.logvar is None:
            return mu, torch.full_like(mu, -torch.inf)
        return mu, self.logvar(summary).clamp(*LOGVAR_RANGE)

    def decode(self, z: Tensor, steps: int) -> Tensor:
        """Windows of latents [batch, latent], [batch, time, channel]."""
        inputs = torch.tanh(self.expand(z))[:, None].expand(-1, steps, -1)
        return self.out(self.decoder(inputs)[0])

    def forward(self, x: Tensor, eps: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Reconstruction from z = mu + eps·sigma with mean and log variance; eps = 0 decodes the mean."""
        mu, logvar = self.encode(x)
        return self.decode(mu + eps * torch.exp(0.5 * logvar), x.shape[1]), mu, logvar


def build(config: TwinConfig, seed: int, *, channels: int = len(CHANNELS)) -> LstmVae:
    """A network with random weights of this seed; torch's global random state is unchanged."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return LstmVae(config, channels)


def weights_of(net: LstmVae) -> dict[str, np.ndarray]:
    """The weights of a network by name, for `twin.vae.inference`."""
    return {name: tensor.detach().numpy().copy() for name, tensor in net.state_dict().items()}


@contextmanager
def one_thread() -> Iterator[None]:
    """Use one torch thread inside: more do not speed up these networks and would change the order of sums."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


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
