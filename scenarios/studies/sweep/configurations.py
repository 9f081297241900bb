"""Configurations that a sweep compares: one choice of the twin changed at a time, and the paper's own choices."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal  # Any: values of fields of TwinConfig

from twin.vae.config import TwinConfig

BASE = replace(TwinConfig.quick(), allow_collapse=True)
"""What every row changes in one point: the size that the scenarios of the library use. A collapse is a result too."""
OURS = "ours"


@dataclass(frozen=True)
class Configuration:
    """One row of the sweep."""

    group: str
    """What is varied."""
    label: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Fields of `BASE` with other values."""
    data: Literal["cool", "any"] = "cool"
    """Training motion: cool over the whole horizon, or any motion, as if chosen by the temperature of the moment: all
    work begins cool."""

    @property
    def config(self) -> TwinConfig:
        """The configuration; strides no longer than the window."""
        return BASE.changed(**self.changes)


SGD = {"optimizer": "sgd", "learning_rate": 0.1, "epochs": 60}
"""Three times the steps: SGD needs them."""
PAPER = {**SGD, "loss": "mean", "layers": 2, "noise": (0.0, 0.0, 0.0)}
CONFIGURATIONS: Mapping[str, Configuration] = {
    OURS: Configuration("ours", "quick: β 1, 1 s, latent 2, one layer of 16, Adam 0.005, 20 epochs"),
    "paper": Configuration("paper", "all of the paper's choices below", PAPER, data="any"),
    "paper_cool": Configuration("paper", "the same, trained on motion that is cool by the whole horizon", PAPER),
    "paper_sum": Configuration("paper", "the same with the summed loss", {**PAPER, "loss": "sum"}),
    "mean": Configuration("paper, one at a time", "mean loss", {"loss": "mean"}),
    "sgd": Configuration("paper, one at a time", "SGD 0.1, 60 epochs", SGD),
    "moment": Configuration("paper, one at a time", "cool by the temperature of the moment", data="any"),
    "layers_2": Configuration("paper, one at a time", "two LSTM layers", {"layers": 2}),
    "no_noise": Configuration("paper, one at a time", "no sensor noise", {"noise": (0.0, 0.0, 0.0)}),
    "window_0.5s": Configuration("window", "0.5 s", {"window": 6}),
    "window_2s": Configuration("window", "2 s", {"window": 25}),
    "window_4s": Configuration("window", "4 s", {"window": 50}),
    "window_8s": Configuration("window", "8 s", {"window": 100}),
    "window_4s_32": Configuration("window", "4 s, 32 hidden units", {"window": 50, "hidden": 32}),
    "hidden_8": Configuration("hidden units", "8", {"hidden": 8}),
    "hidden_32": Configuration("hidden units", "32", {"hidden": 32}),
    "hidden_64": Configuration("hidden units", "64", {"hidden": 64}),
    "beta_0.25": Configuration("β", "0.25", {"beta": 0.25}),
    "beta_4": Configuration("β", "4", {"beta": 4.0}),
    "beta_16": Configuration("β", "16", {"beta": 16.0}),
    "latent_1": Configuration("latent", "1", {"latent": 1}),
    "latent_4": Configuration("latent", "4", {"latent": 4}),
    "latent_8": Configuration("latent", "8", {"latent": 8}),
    "rate_0.001": Configuration("learning rate", "0.001", {"learning_rate": 1e-3}),
    "rate_0.01": Configuration("learning rate", "0.01", {"learning_rate": 1e-2}),
    "epochs_60": Configuration("training", "60 epochs, rate 0.003", {"epochs": 60, "learning_rate": 3e-3}),
    "untrained": Configuration("training", "untrained", {"epochs": 1, "learning_rate": 1e-9}),
    "restarts_2": Configuration("training", "two restarts", {"restarts": 2}),
    "epochs_180": Configuration("training", "180 epochs", {"epochs": 180}),
    "beta_4_long": Configuration("together", "β 4, 60 epochs", {"beta": 4.0, "epochs": 60}),
    "beta_4_latent_4": Configuration("together", "β 4, latent 4, 60 epochs", {"beta": 4.0, "latent": 4, "epochs": 60}),
    "beta_2_latent_4": Configuration("together", "β 2, latent 4, 60 epochs", {"beta": 2.0, "latent": 4, "epochs": 60}),
    "latent_4_long": Configuration("together", "latent 4, 60 epochs", {"latent": 4, "epochs": 60}),
    "large": Configuration("together", "32 units, latent 4, 60 epochs", {"hidden": 32, "latent": 4, "epochs": 60}),
    "whole_arm": Configuration("scope", "one network", {"scope": "arm", "hidden": 64, "latent": 8}),
    "ae": Configuration("scope", "autoencoder", {"kind": "ae"}),
}
"""By the key of their rows, the most informative first."""
