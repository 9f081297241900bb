"""A network that learned nothing, beside which a twin is judged."""

from dataclasses import replace

from twin.vae.config import TwinConfig


def untrained_config(config: TwinConfig) -> TwinConfig:
    """A VAE with its initial weights: one epoch at a rate below what the weights can resolve."""
    return replace(config, epochs=1, learning_rate=1e-12, restarts=1, allow_collapse=True)
