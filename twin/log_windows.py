"""Windows of a log without overlap, or of readings that arrive piece by piece, and their features by a twin."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fleet.errors import FleetError
from twin.logs.recording import GAP_S, READINGS, Recording, Stretch, stretches, unwrap
from twin.vae.measures import Features
from twin.vae.twin import Twin

Array = np.ndarray

LogWindows = list[tuple[Stretch, Array, Features]]
"""Windows of stretches without gaps: the first sample of each, [window], and their features, [window, joint]."""


class TooShort(FleetError):
    """A recording has no stretch of one window."""


def log_windows(twin: Twin, recording: Recording) -> LogWindows:
    """Each stretch without gaps with the first samples of its windows, which do not overlap, and their features.

    Raises:
        FleetError: the recording has another number of joints than the twin.
        TooShort: it has no stretch of one window.
    """
    _check_joints(twin, recording)
    parts = _windows(twin, recording)
    if not parts:
        raise TooShort(
            f"'{recording.name}' has no stretch of {twin.config.window / twin.config.rate_hz:g} s without a gap, which "
            "one window needs."
        )
    return parts


def _windows(twin: Twin, recording: Recording, hop: int = 0, most: int | None = None) -> LogWindows:
    """Windows every `hop` samples (0: without overlap), at most `most` of each stretch."""
    config, parts = twin.config, LogWindows()
    for stretch in stretches(recording, config.rate_hz):
        first = np.arange(0, len(stretch.profile) - config.window + 1, hop or config.window)[:most]
        if len(first):
            inside = first[:, None] + np.arange(config.window)
            windows = stretch.profile[inside].transpose(0, 1, 3, 2)
            parts.append((stretch, first, twin.window_features(windows)))
    return parts


class WindowFeed:
    """Windows of readings that arrive piece by piece: those of the whole recording, up to rounding.

    Args:
        every_s: From the start of a window to that of the next; default: its length. At least a sample of the twin.

    Attributes:
        due_s: Time of the reading with which the next window is complete; −inf before the first reading.
    """

    def __init__(self, twin: Twin, every_s: float | None = None) -> None:
        config = twin.config
        self._twin, self._hop = twin, config.window if every_s is None else max(1, round(every_s * config.rate_hz))
        self._pieces: list[Recording] = []
        """Readings from the start of the next window on."""
        self.due_s = -np.inf

    def add(self, piece: Recording) -> LogWindows:
        """Windows that are complete with these readings, which are later than those before.

        Raises:
            FleetError: another number of joints than the twin's.
            ValueError: readings that are not later, or without a channel that earlier ones have.
        """
        _check_joints(self._twin, piece)
        self._pieces.append(piece)
        if piece.time_s[-1] < self.due_s:
            return []
        config, joined = self._twin.config, join(self._pieces)
        rows = np.split(np.arange(len(joined.time_s)), np.flatnonzero(np.diff(joined.time_s) > GAP_S) + 1)
        *before, last = (joined.part(each) for each in rows)
        parts = [part for each in before for part in _windows(self._twin, each, self._hop)]
        samples = int(last.duration_s * config.rate_hz + 1e-6 * len(last.time_s))
        if samples >= config.window:
            count = (samples - config.window) // self._hop + 1
            parts += _windows(self._twin, last, self._hop, count)
            last = _from(last, float(last.time_s[0]) + count * self._hop / config.rate_hz)
        self._pieces, self.due_s = [last], float(last.time_s[0]) + config.window / config.rate_hz
        return parts


def join(pieces: Sequence[Recording]) -> Recording:
    """One recording of several with the same channels."""
    present = [channel for channel in READINGS if getattr(pieces[0], channel) is not None]
    joined = {name: np.concatenate([getattr(each, name) for each in pieces]) for name in ("time_s", *present)}
    return replace(pieces[0], **joined)


def _from(recording: Recording, time_s: float) -> Recording:
    """The recording from a time within it on, with an interpolated first sample."""
    after = int(np.searchsorted(recording.time_s, time_s + 1e-9))
    if after == len(recording.time_s) or abs(recording.time_s[after - 1] - time_s) < 1e-9:
        return recording.part(slice(after - 1, None))
    pair = recording.part(slice(after - 1, after + 1))
    pair = replace(pair, q=unwrap(pair.q, pair.qd, pair.time_s))
    share = (time_s - pair.time_s[0]) / (pair.time_s[1] - pair.time_s[0])
    present = [channel for channel in READINGS if getattr(pair, channel) is not None]
    ends = {channel: getattr(pair, channel) for channel in present}
    between = {channel: ((1 - share) * value[0] + share * value[1])[None] for channel, value in ends.items()}
    begin = replace(pair, time_s=np.array([time_s]), **between)
    return join([begin, recording.part(slice(after, None))])


def _check_joints(twin: Twin, recording: Recording) -> None:
    if recording.joints != twin.joints:
        raise FleetError(f"'{recording.name}' has {recording.joints} joints, the twin of '{twin.arm}' {twin.joints}.")
