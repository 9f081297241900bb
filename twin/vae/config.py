"""Input, size and training of a twin's networks, and the cache key of a training."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import msgspec
import numpy as np

from fleet.fields import check, option
from fleet.motion import CHANNELS, RATE_HZ

Scope = Literal["joint", "arm"]
"""One network per joint with 3 channels, or one for the arm with 3 channels per joint.

The second also learns which postures and loads go together, and trains faster."""
Kind = Literal["vae", "ae"]
"""Variational, or a plain autoencoder without KL, latent noise and posterior."""

Loss = Literal["sum", "mean"]
"""Squared error of a window summed over time and channel, as in the ELBO, or its mean, which the KL outweighs."""
Optimizer = Literal["adam", "sgd"]
"""Adam with a one-cycle schedule, or plain stochastic gradient descent at a constant learning rate."""

_BY_SIZE = "by the size"
LOGVAR_RANGE = (-8.0, 4.0)
"""Bounds of the posterior's log variance."""


@dataclass(frozen=True, kw_only=True)
class TwinConfig:
    """Input, size and training of a twin."""

    scope: Scope = option(
        "joint (one network per joint) or arm (one network of 21 channels).", "joint", choices=get_args(Scope)
    )
    kind: Kind = option("vae or ae (a plain autoencoder, as a baseline).", "vae", choices=get_args(Kind))
    latent: int = option("Dimensions of the latent space of each network.", 2, low=1, high=64)
    hidden: int = option("Units of each LSTM.", 16, low=1, high=1024)
    layers: int = option("Layers of each LSTM.", 1, low=1, high=8)
    window: int = option("Samples per window.", 12, low=2, high=10_000)
    """About a second. Longer ones rank jobs worse and take longer (docs/results/paper.md, the
    sweep)."""
    rate_hz: float = option("Samples per second inside a window.", 12.5, low=0, high=1000, above=True, flag="--rate")
    record_hz: float = RATE_HZ
    """Samples per second of the training records; plans always come at fleet.motion.RATE_HZ."""
    stride: int = 10
    """Samples from one training window to the next."""
    score_stride: int = 12
    """Samples from one scored window to the next; the last window ends at the end."""
    max_windows: int = option("Maximum number of training windows.", 1792, low=1, high=1_000_000, shown=_BY_SIZE)
    """Sampled at random; 14 batches."""
    beta: float = option("Weight of the KL term.", 1.0, low=0, high=1000)
    loss: Loss = "sum"
    optimizer: Optimizer = "adam"
    epochs: int = option("Passes over the training windows.", 60, low=1, high=100_000, shown=_BY_SIZE)
    batch: int = 128
    learning_rate: float = 3e-3
    """Peak of the one-cycle schedule; with `sgd` the constant rate."""
    clip: float = 1.0
    """Largest gradient norm."""
    restarts: int = option("Trainings per network; the best ELBO is kept.", 2, low=1, high=100, shown=_BY_SIZE)
    """From different weights: a small latent has local minima."""
    trial: float = 0.6
    """Share of the epochs of every restart; then only the one with the best ELBO continues (`twin.vae.train`)."""
    noise: tuple[float, float, float] = (0.001, 0.005, 0.1)
    """Sensor noise added to the training windows, standard deviation in rad, rad/s, N·m, so that smooth plans and noisy
    measured motion score alike."""
    allow_collapse: bool = option("Keep a twin whose latent space collapsed, as a baseline.", False)
    """Instead of raising CollapsedPosterior."""

    def __post_init__(self) -> None:
        check(self)
        choices = {"loss": Loss, "optimizer": Optimizer}
        for name, allowed in ((name, get_args(literal)) for name, literal in choices.items()):
            if getattr(self, name) not in allowed:
                raise ValueError(f"TwinConfig.{name} must be one of {allowed} (got {getattr(self, name)!r}).")
        for name in ("stride", "score_stride", "batch"):
            if getattr(self, name) < 1:
                raise ValueError(f"TwinConfig.{name} must be >= 1 (got {getattr(self, name)}).")
        for name in ("record_hz", "learning_rate", "clip"):
            if not getattr(self, name) > 0:
                raise ValueError(f"TwinConfig.{name} must be > 0 (got {getattr(self, name)}).")
        if not 0 < self.trial <= 1:
            raise ValueError(f"TwinConfig.trial must be in (0, 1] (got {self.trial}).")
        if max(self.stride, self.score_stride) > self.window:
            raise ValueError(
                f"TwinConfig.stride and score_stride must be <= window = {self.window}, or samples between windows "
                f"are never seen (got {self.stride}, {self.score_stride})."
            )
        if len(self.noise) != len(CHANNELS) or not all(std >= 0 for std in self.noise):
            raise ValueError(f"TwinConfig.noise must be three standard deviations >= 0 (got {self.noise}).")

    @classmethod
    def quick(cls) -> "TwinConfig":
        """A tenth of the training steps of the default."""
        return cls(max_windows=768, epochs=20, learning_rate=5e-3, restarts=1)

    def changed(self, **changes: Any) -> "TwinConfig":  # Any: values of any field
        """The same with other values; with another window, windows to score follow each other without overlap.

        Raises:
            ValueError: a value is not allowed.
        """
        if "window" in changes:
            window = max(1, changes["window"])  # a stride longer than the window would leave gaps
            changes = {"stride": min(self.stride, window), "score_stride": window} | changes
        return replace(self, **changes)

    def networks(self, joints: int) -> int:
        """Number of networks of an arm."""
        return 1 if self.scope == "arm" else joints

    def channels(self, joints: int) -> int:
        """Number of input channels of each network."""
        return len(CHANNELS) * joints // self.networks(joints)


Array = np.ndarray

RECIPE = 3
"""Increase it when the same records, configuration and seed give other weights."""


def hash_records(records: Sequence[Array]) -> str:
    """Hash of the training data."""
    digest = hashlib.sha256()
    for record in records:
        digest.update(f"{record.dtype}{record.shape}".encode())
        digest.update(np.ascontiguousarray(record).tobytes())
    return digest.hexdigest()[:32]


def training_key(records: Sequence[Array], config: TwinConfig, seed: np.random.SeedSequence) -> str:
    """Cache key of a training: equal keys mean equal weights."""
    parts = [str(RECIPE), hash_records(records), msgspec.json.encode(config).decode(), seed_text(seed)]
    return hashlib.sha256("|".join(parts).encode()).hexdigest()[:32]


def seed_text(seed: np.random.SeedSequence) -> str:
    """A seed as text, `entropy/spawn.key`."""
    return f"{seed.entropy}/{'.'.join(map(str, seed.spawn_key))}"
