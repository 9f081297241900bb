"""Live telemetry scored window by window, with the same result as scoring the finished recording.

The clock is that of `twin.stretches`: between samples every reading runs straight; where samples come faster than the
twin's clock, a new sample is the mean of that line over its time, else its value at that moment; a step longer than the
gap begins anew. Only the window in the making is kept.
"""

from dataclasses import dataclass

import numpy as np

from fleet.motion import CHANNELS
from twin.measures import Features, Measures
from twin.score import Twin
from twin.stretches import GAP_S, integral_at, line_at, unwrapped

Array = np.ndarray

_ROUNDING = 1e-6
"""Of a new sample's time: a sample that ends this little after the last reading has ended."""


@dataclass(frozen=True, eq=False, kw_only=True)
class WindowScore:
    """What the twin says of one window of live motion."""

    start_s: float
    """In the time of the samples."""
    end_s: float
    features: Features
    """[joint]."""
    measures: Measures
    """[joint]; the p-value compares with whole jobs, so read it as a hint until a job is over."""


class Stream:
    """Scores one arm's telemetry as it comes in; push samples in chunks of any size."""

    def __init__(self, twin: Twin, sample_hz: float, *, stride: int | None = None, gap_s: float = GAP_S) -> None:
        """
        Args:
            sample_hz: About how many samples come per second; they need not come evenly.
            stride: New samples from one scored window to the next; by default the twin's `score_stride`.
            gap_s: A longer step between samples is a hole: what was gathered before it is dropped.

        Raises:
            ValueError: a stride outside 1..window, a rate that is not positive, or a gap not above the
                usual step between samples.
        """
        if not 0 < sample_hz < np.inf:
            raise ValueError(f"sample_hz must be > 0 (got {sample_hz}).")
        self._twin = twin
        self._means = twin.config.rate_hz < sample_hz * (1 - _ROUNDING)
        self._stride = twin.config.score_stride if stride is None else stride
        if not 1 <= self._stride <= twin.config.window:
            raise ValueError(f"stride must be 1 to window = {twin.config.window} (got {stride}).")
        if not gap_s > 1.0 / sample_hz:
            raise ValueError(f"gap_s must be > 1 / sample_hz = {1.0 / sample_hz:g} s (got {gap_s}).")
        self._gap_s = gap_s
        self._last: tuple[float, Array] | None = None
        self._begin_anew(0.0)

    @property
    def waiting(self) -> int:
        """New samples kept for the window in the making, less than a window."""
        return len(self._made)

    def push(self, time_s: Array, samples: Array) -> list[WindowScore]:
        """The windows that these samples complete, oldest first.

        Args:
            time_s: Strictly increasing, also from one push to the next, [time].
            samples: q rad, qd rad/s, tau N·m, [time, 3, joint]; angles may wrap.

        Raises:
            ValueError: times that do not increase, or samples that are misshapen or not finite; nothing is taken in.
        """
        time_s, samples = np.asarray(time_s, dtype=float), np.asarray(samples, dtype=float)
        self._check(time_s, samples)
        if not len(time_s):
            return []
        if self._last is None:
            self._begin_anew(float(time_s[0]))
        else:
            time_s = np.concatenate([[self._last[0]], time_s])
            samples = np.concatenate([self._last[1][None], samples])
        scores: list[WindowScore] = []
        first = 0
        for stop in [*(np.flatnonzero(np.diff(time_s) > self._gap_s) + 1), len(time_s)]:
            if first:
                self._begin_anew(float(time_s[first]))
            scores += self._advance(time_s[first:stop], samples[first:stop])
            first = stop
        return scores

    def _check(self, time_s: Array, samples: Array) -> None:
        wanted = (*time_s.shape, len(CHANNELS), self._twin.joints)
        if time_s.ndim != 1 or samples.shape != wanted:
            raise ValueError(
                f"push needs time_s [time] and samples [time, {wanted[-2]}, {wanted[-1]}] "
                f"(got {time_s.shape} and {samples.shape})."
            )
        if not (np.isfinite(time_s).all() and np.isfinite(samples).all()):
            raise ValueError("Times and samples must be finite; leave out what a sensor did not say.")
        before = [] if self._last is None else [self._last[0]]
        if (np.diff([*before, *time_s]) <= 0).any():
            raise ValueError("Times must increase, also from one push to the next.")

    def _begin_anew(self, time_s: float) -> None:
        """Forget all but where and when the clock begins."""
        self._origin_s = time_s
        self._ticks = 0
        self._unfinished: Array | float = 0.0  # integral since the last tick, [channel, joint]
        self._made = np.zeros((0, len(CHANNELS), self._twin.joints))

    def _advance(self, time_s: Array, samples: Array) -> list[WindowScore]:
        """Take in samples without a hole; the first has been taken in before, or is the first of all."""
        if len(time_s) > 1:
            samples = samples.copy()
            samples[:, 0] = unwrapped(samples[:, 0], samples[:, 1], time_s)
            since = (time_s - self._origin_s) * self._twin.config.rate_hz  # in ticks of the new clock
            last = int(np.floor(since[-1] + _ROUNDING))
            made = self._mean_until(last, since, samples) if self._means else self._line_until(last, since, samples)
            self._made = np.concatenate([self._made, made])
        self._last = (float(time_s[-1]), samples[-1])
        return self._complete()

    def _mean_until(self, last: int, since: Array, samples: Array) -> Array:
        """New samples that end at the ticks after the last one until `last`: means over their time."""
        ticks = np.minimum(np.arange(self._ticks + 1, last + 1), since[-1])
        at_ends = integral_at(since, samples, np.append(ticks, since[-1]))
        means = np.diff(at_ends, axis=0, prepend=np.zeros((1, *samples.shape[1:])))
        means[0] += self._unfinished
        self._unfinished = means[-1]
        self._ticks += len(ticks)
        return means[:-1]

    def _line_until(self, last: int, since: Array, samples: Array) -> Array:
        """New samples that stand for the moments of the ticks until `last`, the very first included."""
        ticks = np.arange(self._ticks, last + 1)
        self._ticks += len(ticks)
        return line_at(since, samples, np.minimum(ticks, since[-1]))

    def _complete(self) -> list[WindowScore]:
        window = self._twin.config.window
        count = max(0, (len(self._made) - window) // self._stride + 1)
        if not count:
            return []
        first = np.arange(count) * self._stride
        windows = self._made[first[:, None] + np.arange(window)].transpose(0, 1, 3, 2)
        found = self._twin.window_features(windows)
        begin = self._ticks - len(self._made) + first
        self._made = self._made[count * self._stride :]
        rate_hz = self._twin.config.rate_hz
        return [
            WindowScore(
                start_s=self._origin_s + float(tick) / rate_hz,
                end_s=self._origin_s + float(tick + window) / rate_hz,
                features=Features(packed),
                measures=self._twin.measures_of(Features(packed)),
            )
            for tick, packed in zip(begin, found.packed, strict=True)
        ]
