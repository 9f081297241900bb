"""Recordings of any rate as motion on one clock: averaged, unwrapped, and cut where nothing was recorded."""

from dataclasses import dataclass

import numpy as np

from twin.recording import Recording
from twin.window import CONTINUOUS

Array = np.ndarray

GAP_S = 2.0
"""A longer step between samples is a hole: at the joints' top speed, 1.33 rad/s, nobody knows the way across it."""
_SAME_RATE = 1e-6
"""Relative difference of rates that is rounding."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Motion on a regular clock, without a hole."""

    recording: str
    """Name of the recording it is from."""
    time_s: Array
    """Middle of each sample in the recording's own time, [time]."""
    profile: Array
    """q rad (continuous joints unwrapped), qd rad/s, tau N·m, float64 [time, 3, joint]."""
    temp_c: Array | None
    """Motor temperature, [time, joint]."""


def stretches(recording: Recording, rate_hz: float, *, gap_s: float = GAP_S) -> list[Stretch]:
    """A recording on a regular clock, split where a step between samples exceeds `gap_s`.

    Between samples every reading is taken to run straight. Where the new clock is slower, a new sample is the time
    mean of that line over its time, so that means are kept and load is not aliased away; where it is as fast or
    faster, it is the value of the line at that moment. Stretches shorter than one new sample are left out.

    Raises:
        ValueError: a rate or gap that is not positive, or a gap that the usual step of the recording exceeds.
    """
    if not 0 < rate_hz < np.inf:
        raise ValueError(f"rate_hz must be > 0 (got {rate_hz}).")
    steps = np.diff(recording.time_s)
    if not gap_s > 0:
        raise ValueError(f"gap_s must be > 0 (got {gap_s}).")
    if len(steps) and np.median(steps) > gap_s:
        raise ValueError(
            f"Recording '{recording.name}' has a sample every {np.median(steps):.3g} s, so gap_s={gap_s:g} would leave "
            "nothing of it; give a larger gap_s."
        )
    pieces = np.split(np.arange(len(recording.time_s)), np.flatnonzero(steps > gap_s) + 1)
    return [
        stretch for piece in pieces if len(piece) > 1 and (stretch := _stretch(recording, piece, rate_hz)) is not None
    ]


def _stretch(recording: Recording, piece: Array, rate_hz: float) -> Stretch | None:
    time_s = recording.time_s[piece]
    q = unwrapped(recording.q[piece], recording.qd[piece], time_s)
    channels = [q, recording.qd[piece], recording.tau[piece]]
    if recording.temp_c is not None:
        channels.append(recording.temp_c[piece])
    moments, values = on_clock(time_s, np.stack(channels, axis=1), rate_hz)
    if not len(moments):
        return None
    return Stretch(recording.name, moments, values[:, :3], values[:, 3] if recording.temp_c is not None else None)


def unwrapped(q: Array, qd: Array, time_s: Array) -> Array:
    """Angles [time, joint] without the jumps of whole turns that continuous joints show.

    The velocities say how many turns lie between two samples, so a joint may move more than half a turn in one step.
    """
    step = np.diff(q, axis=0)
    expected = (qd[1:] + qd[:-1]) / 2.0 * np.diff(time_s)[:, None]
    turns = np.round((expected - step) / (2 * np.pi))
    turns[:, [j for j in range(q.shape[1]) if j not in CONTINUOUS]] = 0.0
    return q + 2 * np.pi * np.concatenate([np.zeros((1, q.shape[1])), np.cumsum(turns, axis=0)])


def on_clock(time_s: Array, values: Array, rate_hz: float) -> tuple[Array, Array]:
    """Readings on a regular clock that begins at the first of them.

    Args:
        time_s: Strictly increasing, [time], two or more.
        values: [time, ...].

    Returns:
        Moments that the new samples stand for, s, [sample], and their values, [sample, ...]; see `stretches`.
    """
    since_s = time_s - time_s[0]
    samples = since_s[-1] * rate_hz + _SAME_RATE * len(time_s)
    if rate_hz * np.median(np.diff(time_s)) >= 1 - _SAME_RATE:
        at_s = np.minimum(np.arange(int(samples) + 1) / rate_hz, since_s[-1])
        return time_s[0] + at_s, line_at(since_s, values, at_s)
    edges_s = np.minimum(np.arange(int(samples) + 1) / rate_hz, since_s[-1])
    at_edges = integral_at(since_s, values, edges_s)
    means = np.diff(at_edges, axis=0) / _down(np.diff(edges_s), values)
    return time_s[0] + (edges_s[1:] + edges_s[:-1]) / 2.0, means


def line_at(time_s: Array, values: Array, at_s: Array) -> Array:
    """Straight lines between readings, at some moments."""
    before = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    share = _down((at_s - time_s[before]) / (time_s[before + 1] - time_s[before]), values)
    return (1 - share) * values[before] + share * values[before + 1]


def integral_at(time_s: Array, values: Array, at_s: Array) -> Array:
    """Integral of the straight lines between readings, from the first of them to some moments."""
    areas = (values[1:] + values[:-1]) / 2.0 * _down(np.diff(time_s), values)
    to_reading = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(areas, axis=0)])
    before = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    rest = (values[before] + line_at(time_s, values, at_s)) / 2.0 * _down(at_s - time_s[before], values)
    return to_reading[before] + rest


def _down(factor: Array, values: Array) -> Array:
    """[time] as a factor of [time, ...]."""
    return factor.reshape(-1, *(1,) * (values.ndim - 1))
