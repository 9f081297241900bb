"""Select the parts of an arm's recordings on which its twin is trained.

They are chosen by the temperatures after them, not by those at the time: a heavy job begins cool too.
"""

from collections.abc import Sequence

import numpy as np

from fleet.errors import FleetError
from twin.logs.recording import Recording
from twin.logs.resampling import GAP_S, Stretch, stretches

Array = np.ndarray

TREND_S = 60.0
"""Length of the end of a recording from which its temperatures are extrapolated."""


class NothingCool(FleetError):
    """No part of the recordings stayed cool, so there is no training data.

    Attributes:
        fact: The message without its advice.
    """

    def __init__(self, fact: str, advice: str) -> None:
        super().__init__(f"{fact} {advice}")
        self.fact, self.advice = fact, advice

    def __reduce__(self) -> tuple[type, tuple[str, str]]:
        return type(self), (self.fact, self.advice)


class TooShort(NothingCool):
    """The parts that stayed cool are shorter than a window."""


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
    """The stretches from every moment of which no motor reaches `cool_c` within the horizon.

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
        TooShort: there are such stretches, all shorter than `least_s`.
        NothingCool: there is no such stretch; the message names the warm motors.
        ValueError: no recordings, one without temperatures, or limits of another number of joints.
    """
    if not recordings:
        raise ValueError("There are no recordings to choose from.")
    cool_parts: list[Stretch] = []
    whole = True
    for recording in recordings:
        limit_c = _limits(recording, cool_c, joints)
        cool = cool_moments(recording, limit_c, horizon_s)
        whole &= bool(cool.all())
        for piece in _runs(cool):
            cool_parts += stretches(recording.part(piece), rate_hz, gap_s=gap_s)
    if not cool_parts:
        raise _nothing_cool(recordings, cool_c, joints, horizon_s)
    long = [s for s in cool_parts if len(s.time_s) >= least_s * rate_hz]
    if not long:
        raise _too_short(max(len(s.time_s) for s in cool_parts) / rate_hz, least_s, whole=whole)
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


def _nothing_cool(
    recordings: Sequence[Recording],
    cool_c: float | Sequence[float] | Array,
    joints: Sequence[int] | None,
    horizon_s: float,
) -> NothingCool:
    coolest = np.min([r.temp_c.min(axis=0) for r in recordings if r.temp_c is not None and len(r.time_s)], axis=0)
    limit_c = _limits(recordings[0], cool_c, joints)
    counted = np.flatnonzero(np.isfinite(limit_c))
    names = ", ".join(str(j + 1) for j in counted)
    some = f"motor {names} never" if len(counted) == 1 else f"none of motors {names}"
    who = "no motor" if len(counted) == len(limit_c) else some
    least_c, most_c = limit_c[counted].min(), limit_c[counted].max()
    limit = f"{least_c:g} °C" if least_c == most_c else f"its {least_c:g} to {most_c:g} °C"
    until = f"{horizon_s:g} s" if np.isfinite(horizon_s) else "a rest of the recording"
    always = [f"{j + 1} ({coolest[j]:.1f} °C)" for j in np.flatnonzero(coolest >= limit_c)]
    least = f" Of all samples the coolest of joint {', '.join(always)} is over its limit." if always else ""
    return NothingCool(
        f"No moment of {_counted(len(recordings))} is followed by {until} in which {who} reaches {limit}.{least}",
        "Raise cool_c (idle wrists of a Gen3 sit at 40 to 43 °C: limits may differ by joint), count fewer joints, "
        "shorten horizon_s, or record light work.",
    )


def _too_short(longest_s: float, least_s: float, *, whole: bool) -> TooShort:
    what = "What was recorded" if whole else "What stays cool"
    return TooShort(
        f"{what} is shorter than one window: {least_s:.4g} s are needed, the longest stretch has {longest_s:.4g} s.",
        "Record for longer, or look at less at a time (least_s).",
    )


def _counted(recordings: int) -> str:
    return "one recording" if recordings == 1 else f"{recordings} recordings"
