"""The networks of a twin as functions of arrays in z-scores: to the latent, back from it, and both."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from fleet.motion import CHANNELS
from twin.grouped import Grouped
from twin.model import LstmVae, one_thread

Array = np.ndarray

_CHUNK = 512
"""Windows per pass: keeps the activations in cache."""
FEW = 24
"""So many windows or fewer go through the networks of several joints all at once (`twin.grouped`). With seven networks
of hidden size 32 that takes half of torch's time for 4 windows and two thirds for 24; two layers break even at 24."""
NARROW = 64
"""Networks of a larger hidden size have enough to sum for torch to be quicker with any number of windows."""


class Networks:
    """Trained networks side by side: each reads its share of an arm's channels; nothing is drawn at random.

    Their weights must not change any more: those for few windows are prepared once, at first use, and never pickled.
    """

    def __init__(self, nets: Sequence[LstmVae]) -> None:
        self.nets = tuple(net.eval().requires_grad_(False) for net in nets)

    def __getstate__(self) -> dict[str, object]:
        return {"nets": self.nets}

    def posterior(self, z: Array) -> tuple[Array, Array]:
        """Mean and standard deviation of the latent of windows [batch, time, joint, channel], [batch, net, latent]."""
        mu, sigma = [], []
        with one_thread(), torch.inference_mode():
            for net, x in zip(self.nets, self._split(z), strict=True):
                parts = [net.encode(part) for part in x.split(_CHUNK)]
                mu.append(torch.cat([mean for mean, _ in parts]).numpy())
                sigma.append(torch.exp(0.5 * torch.cat([logvar for _, logvar in parts])).numpy())
        return np.stack(mu, axis=1), np.stack(sigma, axis=1)

    def decode(self, latent: Array, steps: int) -> Array:
        """Windows that latents [batch, net, latent] stand for, float32 [batch, time, joint, channel]."""
        told = torch.from_numpy(np.array(latent, dtype=np.float32))
        with one_thread(), torch.inference_mode():
            made = [
                torch.cat([net.decode(part, steps) for part in told[:, n].split(_CHUNK)]).numpy()
                for n, net in enumerate(self.nets)
            ]
        return _join(made)

    def reconstruct(self, z: Array) -> Array:
        """Windows [batch, time, joint, channel] decoded from the mean of their posterior, float32.

        The last digits depend on how many windows there are: sums are taken in another order.
        """
        narrow = self.nets[0].encoder.hidden_size <= NARROW
        return self._all_at_once(z) if len(self.nets) > 1 and narrow and len(z) <= FEW else self._one_by_one(z)

    def _all_at_once(self, z: Array) -> Array:
        x = z.reshape(*z.shape[:2], len(self.nets), -1).transpose(2, 1, 0, 3)
        return self._grouped.reconstruct(x).transpose(2, 1, 0, 3).reshape(z.shape)

    @cached_property
    def _grouped(self) -> Grouped:
        return Grouped(self.nets)

    def _one_by_one(self, z: Array) -> Array:
        made = []
        with one_thread(), torch.inference_mode():
            for net, x in zip(self.nets, self._split(z), strict=True):
                parts = [net.decode(net.encode(part)[0], x.shape[1]) for part in x.split(_CHUNK)]
                made.append(parts[0].numpy() if len(parts) == 1 else torch.cat(parts).numpy())
        return _join(made)

    def _split(self, z: Array) -> list[Tensor]:
        """The windows as each network reads them, [batch, time, channel of the network]."""
        return [torch.from_numpy(x) for x in split(z, len(self.nets))]


def split(z: Array, networks: int) -> list[Array]:
    """Windows [batch, time, joint, channel] as each of one or all joints' networks reads them."""
    apart = z.reshape(*z.shape[:2], networks, -1)
    return [np.ascontiguousarray(apart[:, :, n]) for n in range(networks)]


def _join(made: Sequence[Array]) -> Array:
    whole = np.stack(made, axis=2)
    return whole.reshape(*whole.shape[:2], -1, len(CHANNELS))
