"""Input, size and training of a twin's networks."""

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

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

LOGVAR_RANGE = (-8.0, 4.0)
"""Bounds of the posterior's log variance."""


@dataclass(frozen=True, kw_only=True)
class TwinConfig:
    """Input, size and training of a twin."""

    scope: Scope = "joint"
    kind: Kind = "vae"
    latent: int = 2
    """Latent units of each network."""
    hidden: int = 16
    layers: int = 1
    window: int = 12
    """Samples per window: about a second. Longer ones rank jobs worse and take longer (docs/results/paper.md, the
    sweep)."""
    rate_hz: float = 12.5
    """Samples per second inside a window."""
    record_hz: float = RATE_HZ
    """Samples per second of the training records; plans always come at fleet.motion.RATE_HZ."""
    stride: int = 10
    """Samples from one training window to the next."""
    score_stride: int = 12
    """Samples from one scored window to the next; the last window ends at the end."""
    max_windows: int = 1792
    """Maximum number of training windows, sampled at random; 14 batches."""
    beta: float = 1.0
    """Weight of the KL term."""
    loss: Loss = "sum"
    optimizer: Optimizer = "adam"
    epochs: int = 60
    batch: int = 128
    learning_rate: float = 3e-3
    """Peak of the one-cycle schedule; with `sgd` the constant rate."""
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
        choices = {"scope": Scope, "kind": Kind, "loss": Loss, "optimizer": Optimizer}
        for name, allowed in ((name, get_args(literal)) for name, literal in choices.items()):
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
