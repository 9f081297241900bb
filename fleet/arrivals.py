"""When jobs arrive: a Poisson stream, batches, or a trace."""

from dataclasses import dataclass, replace
from math import inf

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Poisson:
    """Independent arrivals with exponential gaps of mean `every_s`, from `start_s` until `stop_s`."""

    every_s: float
    start_s: float = 0.0
    stop_s: float = inf

    def __post_init__(self) -> None:
        if not 0 < self.every_s < inf:
            raise ValueError(f"Poisson.every_s must be > 0 and finite (got {self.every_s}).")
        if not (0 <= self.start_s <= self.stop_s and self.start_s < inf):
            raise ValueError(f"Poisson needs 0 <= start_s <= stop_s (got {self.start_s}, {self.stop_s}).")


@dataclass(frozen=True, kw_only=True)
class Batch:
    """`count` jobs at `start_s`, and again every `every_s` if that is given."""

    count: int
    start_s: float = 0.0
    every_s: float | None = None

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"Batch.count must be >= 1 (got {self.count}).")
        if not 0 <= self.start_s < inf:
            raise ValueError(f"Batch.start_s must be >= 0 and finite (got {self.start_s}).")
        if self.every_s is not None and not 0 < self.every_s < inf:
            raise ValueError(f"Batch.every_s must be > 0 and finite (got {self.every_s}).")


@dataclass(frozen=True, kw_only=True)
class Trace:
    """Arrivals at the given times, s, in order."""

    times_s: tuple[float, ...]

    def __post_init__(self) -> None:
        if not all(0 <= t < inf for t in self.times_s) or list(self.times_s) != sorted(self.times_s):
            raise ValueError(f"Trace.times_s must be >= 0, finite and in order (got {self.times_s}).")


Arrivals = Poisson | Batch | Trace


def release_times(arrivals: Arrivals, horizon_s: float, rng: np.random.Generator) -> np.ndarray:
    """Arrival times before the horizon, s, [job], in order."""
    match arrivals:
        case Poisson():
            stop = max(min(arrivals.stop_s, horizon_s), arrivals.start_s)
            # Conditioned on their number, the arrivals of a Poisson process are uniform order statistics.
            count = rng.poisson((stop - arrivals.start_s) / arrivals.every_s)
            return np.sort(rng.uniform(arrivals.start_s, stop, size=count))
        case Batch():
            starts = [arrivals.start_s]
            if arrivals.every_s is not None:
                starts = list(np.arange(arrivals.start_s, horizon_s, arrivals.every_s))
            times = np.repeat(np.array(starts, dtype=float), arrivals.count)
        case Trace():
            times = np.array(arrivals.times_s, dtype=float)
    return times[times < horizon_s]


def oftener(arrivals: Arrivals, factor: float) -> Arrivals:
    """The same so many times as often; single batches and traces stay as they are."""
    if isinstance(arrivals, Trace) or arrivals.every_s is None:
        return arrivals
    return replace(arrivals, every_s=arrivals.every_s / factor)
