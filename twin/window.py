"""From planned or recorded motion to what the network reads: one clock, windows of one length, z-scores.

Joints 1, 3, 5 and 7 of a Gen3 turn without end, so the same posture has many angles. Their angles are unwrapped in
time, and each window is moved by whole turns to where its mean lies nearest the training data: a wrap never shows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.motion import CHANNELS

Array = np.ndarray

Q = CHANNELS.index("q")
CONTINUOUS = (0, 2, 4, 6)
"""Joints without end stops (Kinova Gen3 user guide, actuator position limits), index 0..6."""
STD_FLOOR = (0.02, 0.02, 0.2)
"""Least standard deviation per channel, rad, rad/s, N·m. A joint that stood still in training has none of its own;
below this a difference is sensor noise and no news."""


def resample(profile: Array, from_hz: float, to_hz: float) -> Array:
    """The profile on another clock: the mean of each channel over each new sample's time.

    Averaging keeps means (so heat-relevant load is not aliased away) and works for any pair of rates.

    Args:
        profile: [time, channel, joint]; sample i stands for the time from i/from_hz to (i+1)/from_hz.

    Returns:
        float64 [time, channel, joint] with continuous joints unwrapped; the last sample may stand for a shorter time.
    """
    samples = np.array(profile, dtype=float)
    _unwrap(samples[:, Q])
    if len(samples) == 0 or from_hz == to_hz:
        return samples
    length = len(samples)
    count = int(np.ceil(length * to_hz / from_hz - 1e-9))
    edges = np.minimum(np.arange(count + 1) * (from_hz / to_hz), length)
    integral = np.zeros((length + 1, *samples.shape[1:]))
    np.cumsum(samples, axis=0, out=integral[1:])
    whole = np.minimum(edges.astype(int), length - 1)
    part = (edges - whole)[:, None, None]
    at_edges = integral[whole] + part * samples[whole]
    return np.diff(at_edges, axis=0) / np.diff(edges)[:, None, None]


def _unwrap(q: Array) -> None:
    """Take the jumps of whole turns out of the continuous joints' angles [time, joint], in place."""
    continuous = [j for j in CONTINUOUS if j < q.shape[1]]
    turns = np.round(np.diff(q[:, continuous], axis=0) / (2 * np.pi))
    if turns.any():
        q[1:, continuous] -= 2 * np.pi * np.cumsum(turns, axis=0)


def starts(length: int, window: int, stride: int) -> Array:
    """First samples of the windows that cover `length` samples, every `stride`, the last one flush with the end."""
    if length <= window:
        return np.zeros(min(length, 1), dtype=int)
    regular = np.arange(0, length - window, stride)
    return np.append(regular, length - window)


def cut(samples: Array, window: int, stride: int) -> Array:
    """Windows of motion, [batch, time, joint, channel].

    What is shorter than a window is padded by holding its last sample: an arm that has arrived stays there.

    Args:
        samples: [time, channel, joint]; no samples give no windows.
    """
    first = starts(len(samples), window, stride)
    index = np.minimum(first[:, None] + np.arange(window), max(len(samples) - 1, 0))
    return samples[index].transpose(0, 1, 3, 2)


def cover(length: int, window: int, stride: int) -> Array:
    """Weight of each sample of each window in the time mean over the whole stretch, [batch, time].

    Every real sample counts once however many windows overlap on it, padding counts nothing; sums to one.
    """
    index = starts(length, window, stride)[:, None] + np.arange(window)
    inside = index < length
    times = np.bincount(index[inside], minlength=length)
    return np.where(inside, 1.0 / (times[np.minimum(index, max(length - 1, 0))] * max(length, 1)), 0.0)


def windows_of(records: Sequence[Array], *, from_hz: float, rate_hz: float, window: int, stride: int) -> Array:
    """All windows of all records [time, channel, joint], on one clock, [batch, time, joint, channel].

    Raises:
        ValueError: no record, a record of another shape, or one that is not finite.
    """
    checked = [check_profile(record, f"Record {i}") for i, record in enumerate(records)]
    parts = [cut(resample(record, from_hz, rate_hz), window, stride) for record in checked if len(record)]
    if not parts:
        raise ValueError("Training needs at least one record with samples (got none).")
    if len({part.shape[2] for part in parts}) > 1:
        raise ValueError("All records must have the same number of joints.")
    return np.concatenate(parts)


def check_profile(profile: Array, name: str) -> Array:
    """The profile itself, if it is finite [time, 3, joint]; `name` is what the error calls it."""
    if profile.ndim != 3 or profile.shape[1] != len(CHANNELS):
        raise ValueError(f"{name} must be [time, 3, joint] (got shape {profile.shape}).")
    if not np.isfinite(profile).all():
        time, channel, joint = np.argwhere(~np.isfinite(profile))[0]
        raise ValueError(f"{name} is not finite: {CHANNELS[channel]} of joint {joint + 1} at sample {time}.")
    return profile


@dataclass(frozen=True, eq=False)
class Scaler:
    """Z-score per joint and channel, with numbers from training data alone."""

    turn_q: Array
    """Angle whose neighbourhood continuous joints are moved to by whole turns, rad, [joint]."""
    mean: Array
    """[joint, channel]."""
    std: Array
    """[joint, channel], at least `STD_FLOOR`."""
    still: Array
    """Joints of which no channel moved more than the floor in training, bool [joint]."""

    @classmethod
    def fit(cls, windows: Array) -> "Scaler":
        """The scaler of training windows [batch, time, joint, channel]."""
        q = windows[..., Q]
        turn_q = np.angle(np.exp(1j * q).mean(axis=(0, 1)))
        near = _nearest_turn(windows, turn_q)
        std = near.std(axis=(0, 1))
        floor = np.array(STD_FLOOR)
        return cls(turn_q, near.mean(axis=(0, 1)), np.maximum(std, floor), (std < floor).all(axis=-1))

    @property
    def joints(self) -> int:
        """How many joints it knows."""
        return len(self.turn_q)

    def to_z(self, windows: Array) -> Array:
        """Windows [batch, time, joint, channel] in training standard deviations, float32."""
        z = _nearest_turn(windows, self.turn_q)
        z -= self.mean
        z /= self.std
        return z.astype(np.float32)

    def to_si(self, z: Array) -> Array:
        """Back to rad, rad/s, N·m, [batch, time, joint, channel]; angles near the training data."""
        return z.astype(float) * self.std + self.mean


def _nearest_turn(windows: Array, turn_q: Array) -> Array:
    moved = np.array(windows, dtype=float)
    joints = [j for j in CONTINUOUS if j < moved.shape[2]]
    away = moved[:, :, joints, Q].mean(axis=1) - turn_q[joints]
    moved[:, :, joints, Q] -= 2 * np.pi * np.round(away / (2 * np.pi))[:, None]
    return moved
