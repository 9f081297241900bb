"""The trained networks of one arm as one module on windows of all joints, and functions of NumPy arrays."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from fleet.motion import CHANNELS
from twin.vae.model import LstmVae, one_thread

Array = np.ndarray

_CHUNK = 512
"""Windows per pass: keeps the activations in cache."""


class Networks(nn.Module):
    """Networks that each read their share of an arm's channels, in z-scores; deterministic."""

    def __init__(self, nets: Sequence[LstmVae]) -> None:
        super().__init__()
        self.nets = tuple(net.eval().requires_grad_(False) for net in nets)

    def encode(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Posterior mean and log variance, [batch, net, latent], of windows [batch, time, joint, channel]."""
        parts = z.flatten(2).chunk(len(self.nets), dim=2)
        posteriors = [net.encode(part) for net, part in zip(self.nets, parts, strict=True)]
        return torch.stack([mu for mu, _ in posteriors], dim=1), torch.stack([var for _, var in posteriors], dim=1)

    def decode(self, latent: Tensor, steps: int) -> Tensor:
        """Windows decoded from latents [batch, net, latent], [batch, time, joint, channel]."""
        parts = [net.decode(latent[:, n], steps) for n, net in enumerate(self.nets)]
        return torch.cat(parts, dim=2).unflatten(2, (-1, len(CHANNELS)))

    def forward(self, z: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Windows decoded from their posterior means, [batch, time, joint, channel], and the means."""
        mu = self.encode(z)[0]
        return self.decode(mu, steps), mu


def posterior(networks: Networks, z: Array) -> tuple[Array, Array]:
    """Mean and standard deviation of the latent of windows [batch, time, joint, channel], [batch, net, latent]."""

    def of(part: Tensor) -> tuple[Tensor, ...]:
        mu, logvar = networks.encode(part)
        return mu, torch.exp(0.5 * logvar)

    mu, sigma = _in_chunks(of, z)
    return mu, sigma


def decode(networks: Networks, latent: Array, steps: int) -> Array:
    """Windows decoded from latents [batch, net, latent], float32 [batch, time, joint, channel]."""
    return _in_chunks(lambda part: (networks.decode(part, steps),), np.asarray(latent, dtype=np.float32))[0]


def reconstruct(networks: Networks, z: Array) -> Array:
    """Windows [batch, time, joint, channel] decoded from the means of their posteriors, float32."""
    return _in_chunks(lambda part: networks(part, z.shape[1]), z)[0]


def _in_chunks(function: Callable[[Tensor], tuple[Tensor, ...]], values: Array) -> list[Array]:
    """The results of a function of a batch, computed chunk by chunk on one thread."""
    with one_thread(), torch.inference_mode():
        parts = [function(part) for part in torch.from_numpy(values).split(_CHUNK)]
        return [torch.cat(result).numpy() for result in zip(*parts, strict=True)]
