"""The network: an LSTM encoder of a window to a Gaussian latent, and an LSTM decoder back to the window.

Source: E. Guiffo Kaigom, arXiv 2509.12740.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from fleet.motion import CHANNELS, RATE_HZ

Scope = Literal["joint", "arm"]
"""One network per joint with 3 channels, or one for the arm with 3 channels per joint.

The second also learns which postures and loads go together, and trains faster."""
Kind = Literal["vae", "ae"]
"""Variational, or a plain autoencoder without KL, latent noise and posterior."""

LOGVAR_RANGE = (-8.0, 4.0)
"""Bounds of the posterior's log variance."""


@dataclass(frozen=True, kw_only=True)
class TwinConfig:
    """Input, size and training of a twin."""

    scope: Scope = "joint"
    kind: Kind = "vae"
    latent: int = 2
    """Latent units of each network."""
    hidden: int = 32
    layers: int = 1
    window: int = 50
    """Samples per window."""
    rate_hz: float = 12.5
    """Samples per second inside a window."""
    record_hz: float = RATE_HZ
    """Samples per second of the training records; plans always come at fleet.motion.RATE_HZ."""
    stride: int = 10
    """Samples from one training window to the next."""
    score_stride: int = 50
    """Samples from one scored window to the next; the last window ends at the end."""
    max_windows: int = 1792
    """Most training windows, drawn at random; 14 batches."""
    beta: float = 1.0
    """Weight of the KL term."""
    epochs: int = 60
    batch: int = 128
    learning_rate: float = 3e-3
    """Peak of the one-cycle schedule."""
    clip: float = 1.0
    """Largest gradient norm."""
    restarts: int = 2
    """Trainings per network from different weights: a small latent has local minima."""
    trial: float = 0.6
    """Share of the epochs of every restart; then only the one with the best ELBO continues (`twin.vae.train`)."""
    noise: tuple[float, float, float] = (0.001, 0.005, 0.1)
    """Sensor noise added to the training windows, standard deviation in rad, rad/s, N·m, so that smooth plans and noisy
    measured motion score alike."""
    allow_collapse: bool = False
    """Keep a twin with a collapsed posterior, as a baseline, instead of raising CollapsedPosterior."""

    def __post_init__(self) -> None:
        for name, allowed in (("scope", get_args(Scope)), ("kind", get_args(Kind))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"TwinConfig.{name} must be one of {allowed} (got {getattr(self, name)!r}).")
        whole = ("latent", "hidden", "layers", "stride", "score_stride", "max_windows", "epochs", "batch", "restarts")
        for name in whole:
            if getattr(self, name) < 1:
                raise ValueError(f"TwinConfig.{name} must be >= 1 (got {getattr(self, name)}).")
        for name in ("rate_hz", "record_hz", "learning_rate", "clip"):
            if not getattr(self, name) > 0:
                raise ValueError(f"TwinConfig.{name} must be > 0 (got {getattr(self, name)}).")
        if not 0 < self.trial <= 1:
            raise ValueError(f"TwinConfig.trial must be in (0, 1] (got {self.trial}).")
        if self.window < 2:
            raise ValueError(f"TwinConfig.window must be >= 2 samples (got {self.window}).")
        if max(self.stride, self.score_stride) > self.window:
            raise ValueError(
                f"TwinConfig.stride and score_stride must be <= window = {self.window}, or samples between windows "
                f"are never seen (got {self.stride}, {self.score_stride})."
            )
        if not self.beta >= 0:
            raise ValueError(f"TwinConfig.beta must be >= 0 (got {self.beta}).")
        if len(self.noise) != len(CHANNELS) or not all(std >= 0 for std in self.noise):
            raise ValueError(f"TwinConfig.noise must be three standard deviations >= 0 (got {self.noise}).")

    @classmethod
    def quick(cls) -> "TwinConfig":
        """A tenth of the training steps of the default."""
        return cls(max_windows=768, epochs=20, learning_rate=5e-3, restarts=1)

    def networks(self, joints: int) -> int:
        """Number of networks of an arm."""
        return 1 if self.scope == "arm" else joints

    def channels(self, joints: int) -> int:
        """Number of input channels of each network."""
        return len(CHANNELS) * joints // self.networks(joints)


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


@contextmanager
def one_thread() -> Iterator[None]:
    """Use one torch thread inside: more do not speed up these networks and would change the order of sums."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
