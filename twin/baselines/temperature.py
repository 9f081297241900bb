"""An LSTM that predicts temperatures from torques: supervised, as in the sibling of the twin's paper.

It needs labelled motion: the temperature that each job leads to. Here a window of torques of all joints gives the
rise of every motor at the end of the job's horizon, and the rise by a job is the mean over its windows.
Source: T. K. La & E. Guiffo Kaigom, arXiv 2509.12739: one LSTM layer and feed-forward layers on sensed joint torques.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from fleet.motion import CHANNELS, Plan
from twin.vae.config import TwinConfig
from twin.vae.model import one_thread
from twin.vae.window import cut_jobs

Array = np.ndarray

TAU = CHANNELS.index("tau")
HIDDEN = 32
LEARNING_RATE = 3e-3
"""Peak of the one-cycle schedule."""
BATCH = 128
_CHUNK = 256
"""Jobs read at a time."""


class _Regressor(nn.Module):
    """Windows of torques [batch, time, joint] to rises [batch, joint], all standardised."""

    def __init__(self, joints: int) -> None:
        super().__init__()
        self.lstm = nn.LSTM(joints, HIDDEN, batch_first=True)
        self.head = nn.Sequential(nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, joints))

    def forward(self, torques: torch.Tensor) -> torch.Tensor:
        return self.head(self.lstm(torques)[1][0][-1])


@dataclass(frozen=True, eq=False)
class TemperatureRegressor:
    """A trained regressor."""

    net: _Regressor
    config: TwinConfig
    """How windows are cut."""
    tau: tuple[Array, Array]
    """Mean and standard deviation of the training torques, N·m, each [joint]."""
    rise: tuple[Array, Array]
    """The same of the rises, K."""

    def predict(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Array:
        """Rise of every motor at the end of each job, K, [job, joint]."""
        parts = []
        for first in range(0, len(plans), _CHUNK):
            some = slice(first, first + _CHUNK)
            reading = cut_jobs(plans[some], repetitions[some], self.config)
            x = torch.from_numpy(_standardised(reading.windows[..., TAU], self.tau))
            with one_thread(), torch.inference_mode():
                z = self.net(x).numpy()
            parts.append(reading.mean(z[:, None]))
        return np.concatenate(parts) * self.rise[1] + self.rise[0]


def train_regressor(
    plans: Sequence[Plan],
    repetitions: Sequence[int],
    rise_k: Array,
    config: TwinConfig,
    seed: int,
    *,
    steps: int,
) -> TemperatureRegressor:
    """A regressor fitted on jobs with known rises, on one thread.

    Args:
        rise_k: Rise of every motor at the end of each job, K, [job, joint].
        config: How windows are cut.
        steps: Steps of Adam, each with 128 random windows.

    Raises:
        ValueError: not one row of rises for each job.
    """
    if len(rise_k) != len(plans):
        raise ValueError(f"Each job needs its rises: {len(plans)} plans, {len(rise_k)} rows.")
    reading = cut_jobs(plans, repetitions, config)
    torques = reading.windows[..., TAU]
    tau = torques.mean(axis=(0, 1)), np.maximum(torques.std(axis=(0, 1)), 1e-3)
    rise = rise_k.mean(axis=0), np.maximum(rise_k.std(axis=0), 1e-3)
    x = torch.from_numpy(_standardised(torques, tau))
    y = torch.from_numpy(_standardised(rise_k[reading.job], rise))
    with one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = _Regressor(torques.shape[-1])
        optimizer = torch.optim.Adam(net.parameters(), lr=LEARNING_RATE, fused=True)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=max(steps, 2))
        for _ in range(steps):
            some = torch.randint(len(x), (BATCH,))
            optimizer.zero_grad()
            nn.functional.mse_loss(net(x[some]), y[some]).backward()
            optimizer.step()
            schedule.step()
    return TemperatureRegressor(net, config, tau, rise)


def _standardised(values: Array, scale: tuple[Array, Array]) -> Array:
    return ((values - scale[0]) / scale[1]).astype(np.float32)
