"""Recordings at a regular rate: averaged, unwrapped, and split at gaps."""

from dataclasses import dataclass

import numpy as np

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
    return [
        stretch for piece in pieces if len(piece) > 1 and (stretch := _stretch(recording, piece, rate_hz)) is not None
    ]


def _stretch(recording: Recording, piece: Array, rate_hz: float) -> Stretch | None:
    time_s = recording.time_s[piece]
    q = unwrap(recording.q[piece], recording.qd[piece], time_s)
    channels = [q, recording.qd[piece], recording.tau[piece]]
    if recording.temp_c is not None:
        channels.append(recording.temp_c[piece])
    moments, values = at_rate(time_s, np.stack(channels, axis=1), rate_hz)
    if not len(moments):
        return None
    return Stretch(recording.name, moments, values[:, :3], values[:, 3] if recording.temp_c is not None else None)


def unwrap(q: Array, qd: Array, time_s: Array) -> Array:
    """Angles [time, joint] with the whole-turn jumps of continuous joints removed.

    Turns between two samples follow from the velocities, so a joint may move more than half a turn in one step.
    """
    step = np.diff(q, axis=0)
    expected = (qd[1:] + qd[:-1]) / 2.0 * np.diff(time_s)[:, None]
    turns = np.round((expected - step) / (2 * np.pi))
    turns[:, [j for j in range(q.shape[1]) if j not in CONTINUOUS]] = 0.0
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
    samples = since_s[-1] * rate_hz + _SAME_RATE * len(time_s)
    if rate_hz * np.median(np.diff(time_s)) >= 1 - _SAME_RATE:
        at_s = np.minimum(np.arange(int(samples) + 1) / rate_hz, since_s[-1])
        return time_s[0] + at_s, line_at(since_s, values, at_s)
    edges_s = np.minimum(np.arange(int(samples) + 1) / rate_hz, since_s[-1])
    at_edges = integral_at(since_s, values, edges_s)
    means = np.diff(at_edges, axis=0) / _column(np.diff(edges_s), values)
    return time_s[0] + (edges_s[1:] + edges_s[:-1]) / 2.0, means


def line_at(time_s: Array, values: Array, at_s: Array) -> Array:
    """Linear interpolation of readings at some times."""
    before = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    share = _column((at_s - time_s[before]) / (time_s[before + 1] - time_s[before]), values)
    return (1 - share) * values[before] + share * values[before + 1]


def integral_at(time_s: Array, values: Array, at_s: Array) -> Array:
    """Integral of the linear interpolation from the first reading to some times."""
    areas = (values[1:] + values[:-1]) / 2.0 * _column(np.diff(time_s), values)
    to_reading = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(areas, axis=0)])
    before = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    rest = (values[before] + line_at(time_s, values, at_s)) / 2.0 * _column(at_s - time_s[before], values)
    return to_reading[before] + rest


def _column(factor: Array, values: Array) -> Array:
    """[time] reshaped to multiply [time, ...]."""
    return factor.reshape(-1, *(1,) * (values.ndim - 1))
