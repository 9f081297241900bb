"""Select the parts of an arm's recordings on which its twin is trained.

They are chosen by the later temperatures, not by those at the time: a heavy job begins cool too.
"""

from collections.abc import Sequence

import numpy as np

from fleet.errors import FleetError
from twin.logs.recording import GAP_S, Recording, Stretch, stretches

Array = np.ndarray

TREND_S = 60.0
"""Length of the end of a recording from which its temperatures are extrapolated."""


class NothingCool(FleetError):
    """No part of the recordings stayed cool for long enough, so there is no training data."""


def cool_stretches(
    recordings: Sequence[Recording],
    rate_hz: float,
    *,
    cool_c: float | Sequence[float] | Array,
    horizon_s: float,
    joints: Sequence[int] | None = None,
    least_s: float = 0.0,
    gap_s: float = GAP_S,
) -> list[Stretch]:
    """The stretches at every moment of which no motor reaches `cool_c` within the horizon.

    Where a recording ends within the horizon, its temperatures are extrapolated linearly from the last minute. That is
    on the safe side: the warmer a motor, the faster it cools.

    Args:
        cool_c: °C, for all joints or per joint. Idle wrists of a Gen3 are at 40 to 43 °C, so a common limit low enough
            for joint 2 excludes everything; give the wrists their own limits, or name the joints that count.
        horizon_s: Time over which work affects temperatures; inf is the rest of the recording, without
            extrapolation.
        joints: Index 0..6 of the motors that count; None is all.
        least_s: Least length of a stretch, such as a twin's window.

    Raises:
        NothingCool: there is no such stretch, which names the warm motors, or all are shorter than `least_s`.
        ValueError: no recordings, one without temperatures, or limits of another number of joints.
    """
    if not recordings:
        raise ValueError("Training data needs at least one recording (got none).")
    cool_parts: list[Stretch] = []
    whole = True
    for recording in recordings:
        limit_c = _limits(recording, cool_c, joints)
        cool = cool_moments(recording, limit_c, horizon_s)
        whole &= bool(cool.all())
        for piece in _runs(cool):
            cool_parts += stretches(recording.part(piece), rate_hz, gap_s=gap_s)
    if not cool_parts:
        raise NothingCool(_no_cool_moment(recordings, cool_c, joints, horizon_s))
    long = [s for s in cool_parts if len(s.time_s) >= least_s * rate_hz]
    if not long:
        longest_s = max(len(s.time_s) for s in cool_parts) / rate_hz
        what = "The recording" if whole else "The part that stays cool"
        raise NothingCool(
            f"{what} is shorter than one window: {least_s:.4g} s are needed, the longest stretch has {longest_s:.4g} "
            "s. Record for longer, or choose a smaller window (--window)."
        )
    return long


def cool_moments(recording: Recording, limit_c: Array, horizon_s: float) -> Array:
    """Whether no motor reaches its limit from each moment until the horizon, bool [time].

    Args:
        limit_c: °C, [joint]; inf for motors that do not count.

    Raises:
        ValueError: a recording without temperatures, or a horizon below zero.
    """
    if recording.temp_c is None:
        raise ValueError(f"Recording '{recording.name}' has no motor temperatures, so its cool parts are unknown.")
    if not horizon_s >= 0:
        raise ValueError(f"horizon_s must be >= 0 (got {horizon_s}).")
    time_s = recording.time_s
    hot_s = time_s[(recording.temp_c >= limit_c).any(axis=1)]
    next_hot_s = np.append(hot_s, np.inf)[np.searchsorted(hot_s, time_s)]
    if len(time_s) and np.isfinite(horizon_s):
        next_hot_s = np.minimum(next_hot_s, _hot_after_end(recording, limit_c))
    return (next_hot_s > time_s + horizon_s) if np.isfinite(horizon_s) else next_hot_s == np.inf


def _hot_after_end(recording: Recording, limit_c: Array) -> float:
    """Time at which a motor reaches its limit by linear extrapolation of the last minute; inf if never."""
    assert recording.temp_c is not None
    time_s, temp_c = recording.time_s, recording.temp_c
    last = time_s >= time_s[-1] - TREND_S
    if last.sum() < 2:
        return float("inf")
    since_s = time_s[last] - time_s[last].mean()
    slope = since_s @ (temp_c[last] - temp_c[last].mean(axis=0)) / (since_s @ since_s)  # K/s, [joint]
    with np.errstate(divide="ignore"):
        wait_s = np.where(slope > 0, (limit_c - temp_c[-1]) / np.where(slope > 0, slope, 1.0), np.inf)
    return float(time_s[-1] + np.maximum(wait_s, 0.0).min())


def _limits(recording: Recording, cool_c: float | Sequence[float] | Array, joints: Sequence[int] | None) -> Array:
    limit_c = np.asarray(cool_c, dtype=float)
    if limit_c.ndim > 1 or limit_c.size not in (1, recording.joints):
        raise ValueError(f"cool_c must be one limit or {recording.joints}, one per joint (got {limit_c.size}).")
    limit_c = np.broadcast_to(limit_c, (recording.joints,)).copy()
    if joints is not None:
        unknown = [j for j in joints if not 0 <= j < recording.joints]
        if unknown or not joints:
            raise ValueError(f"joints must be some of 0 … {recording.joints - 1} (got {tuple(joints)}).")
        limit_c[[j for j in range(recording.joints) if j not in joints]] = np.inf
    return limit_c


def _runs(mask: Array) -> list[slice]:
    """Contiguous runs of a mask."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _no_cool_moment(
    recordings: Sequence[Recording],
    cool_c: float | Sequence[float] | Array,
    joints: Sequence[int] | None,
    horizon_s: float,
) -> str:
    coolest = np.min([r.temp_c.min(axis=0) for r in recordings if r.temp_c is not None and len(r.time_s)], axis=0)
    limit_c = _limits(recordings[0], cool_c, joints)
    counted = np.flatnonzero(np.isfinite(limit_c))
    least_c, most_c = limit_c[counted].min(), limit_c[counted].max()
    limit = f"{least_c:g} °C" if least_c == most_c else f"its {least_c:g} to {most_c:g} °C"
    until = f"for {horizon_s:g} s" if np.isfinite(horizon_s) else "for the rest of its recording"
    always = [f"{j + 1} ({coolest[j]:.1f} °C)" for j in np.flatnonzero(coolest >= limit_c)]
    return (
        f"At no moment of {len(recordings)} recording(s) do the motors {', '.join(str(j + 1) for j in counted)} stay "
        f"below {limit} {until}."
        + (f" Always above: {', '.join(always)}, the coolest sample." if always else "")
        + " Raise the limit (--cool; it may differ by joint, idle wrists of a Gen3 are at 40 to 43 °C), count fewer "
        "joints, shorten the horizon, or record light work."
    )
