"""Recordings at a regular rate: averaged, unwrapped, and split at gaps."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from twin.logs.recording import CONTINUOUS, Recording

Array = np.ndarray

GAP_S = 2.0
"""A longer step between samples is a gap: at the top speed of 1.33 rad/s the motion across it is unknown."""
_SAME_RATE = 1e-6
"""Relative difference of rates that counts as rounding."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Motion at a regular rate without a gap."""

    recording: str
    """Name of its recording."""
    time_s: Array
    """Middle of each sample in the recording's own time, [time]."""
    profile: Array
    """q rad (continuous joints unwrapped), qd rad/s, tau N·m, float64 [time, 3, joint]."""
    temp_c: Array | None
    """Motor temperature, [time, joint]."""


def stretches(recording: Recording, rate_hz: float, *, gap_s: float = GAP_S) -> list[Stretch]:
    """A recording at a regular rate, split where a step between samples exceeds `gap_s`.

    Readings are interpolated linearly. At a lower rate a new sample is the mean of the line over its time, which keeps
    the mean load; at the same or a higher rate it is the value of the line. Stretches shorter than one new sample are
    dropped.

    Raises:
        ValueError: a rate or gap that is not positive, or a gap below the usual step of the recording.
    """
    if not 0 < rate_hz < np.inf:
        raise ValueError(f"rate_hz must be > 0 (got {rate_hz}).")
    steps = np.diff(recording.time_s)
    if not gap_s > 0:
        raise ValueError(f"gap_s must be > 0 (got {gap_s}).")
    if len(steps) and np.median(steps) > gap_s:
        raise ValueError(
            f"Recording '{recording.name}' has a sample every {np.median(steps):.3g} s, so gap_s={gap_s:g} would drop "
            "all of it; give a larger gap_s."
        )
    pieces = np.split(np.arange(len(recording.time_s)), np.flatnonzero(steps > gap_s) + 1)
    resampled = [_stretch(recording.part(piece), rate_hz) for piece in pieces if len(piece) > 1]
    return [stretch for stretch in resampled if len(stretch.time_s)]


def _stretch(recording: Recording, rate_hz: float) -> Stretch:
    channels = [unwrap(recording.q, recording.qd, recording.time_s), recording.qd, recording.tau]
    if recording.temp_c is not None:
        channels.append(recording.temp_c)
    time_s, values = at_rate(recording.time_s, np.stack(channels, axis=1), rate_hz)
    return Stretch(recording.name, time_s, values[:, :3], None if recording.temp_c is None else values[:, 3])


def unwrap(q: Array, qd: Array, time_s: Array) -> Array:
    """Angles [time, joint] with the whole-turn jumps of continuous joints removed.

    Turns between two samples follow from the velocities, so a joint may move more than half a turn in one step.
    """
    step = np.diff(q, axis=0)
    expected = (qd[1:] + qd[:-1]) / 2.0 * np.diff(time_s)[:, None]
    turns = np.round((expected - step) / (2 * np.pi))
    turns[:, ~np.isin(np.arange(q.shape[1]), CONTINUOUS)] = 0.0
    return q + 2 * np.pi * np.concatenate([np.zeros((1, q.shape[1])), np.cumsum(turns, axis=0)])


def at_rate(time_s: Array, values: Array, rate_hz: float) -> tuple[Array, Array]:
    """Readings at a regular rate that starts at the first of them.

    Args:
        time_s: Strictly increasing, [time], two or more.
        values: [time, ...].

    Returns:
        Times of the new samples, s, [sample], and their values, [sample, ...]; see `stretches`.
    """
    since_s = time_s - time_s[0]
    line = make_interp_spline(since_s, values, k=1)
    samples = int(since_s[-1] * rate_hz + _SAME_RATE * len(time_s))
    at_s = np.minimum(np.arange(samples + 1) / rate_hz, since_s[-1])
    if rate_hz * np.median(np.diff(time_s)) >= 1 - _SAME_RATE:
        return time_s[0] + at_s, line(at_s)
    width_s = np.diff(at_s).reshape(-1, *(1,) * (values.ndim - 1))
    return time_s[0] + (at_s[1:] + at_s[:-1]) / 2.0, np.diff(line.antiderivative()(at_s), axis=0) / width_s
