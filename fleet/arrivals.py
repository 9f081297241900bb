"""Job arrivals: a Poisson stream, batches, or a trace."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import NamedTuple

import numpy as np

from fleet.errors import check_nonnegative, check_positive
from fleet.jit import jit_inline
from fleet.seeding import Bits, random_uniform

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class Poisson:
    """Independent arrivals with exponential gaps of mean `every_s`, from `start_s` until `stop_s`."""

    every_s: float
    start_s: float = 0.0
    stop_s: float = inf

    def __post_init__(self) -> None:
        check_positive(self, "every_s")
        if not (0 <= self.start_s <= self.stop_s and self.start_s < inf):
            raise ValueError(f"Poisson needs 0 <= start_s <= stop_s (got {self.start_s}, {self.stop_s}).")


@dataclass(frozen=True, kw_only=True)
class Batch:
    """`count` jobs at `start_s`, repeated every `every_s` if given."""

    count: int
    start_s: float = 0.0
    every_s: float | None = None

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"Batch.count must be >= 1 (got {self.count}).")
        check_nonnegative(self, "start_s")
        if self.every_s is not None:
            check_positive(self, "every_s")


@dataclass(frozen=True, kw_only=True)
class Trace:
    """Arrivals at given times, s, in order."""

    times_s: tuple[float, ...]

    def __post_init__(self) -> None:
        if not all(0 <= t < inf for t in self.times_s) or list(self.times_s) != sorted(self.times_s):
            raise ValueError(f"Trace.times_s must be >= 0, finite and in order (got {self.times_s}).")


Arrivals = Poisson | Batch | Trace


class ArrivalTable(NamedTuple):
    """Several streams of arrivals as arrays; a stream is Poisson, or its times are given."""

    start_s: Array
    """Of a Poisson stream, [stream]."""
    stop_s: Array
    """[stream]."""
    every_s: Array
    """Mean gap of a Poisson stream, NaN of the others, [stream]."""
    times_s: Array
    """Given times of all streams, [arrival]."""
    first: Array
    """Where the given times of each stream begin, int [stream + 1]."""


def arrival_table(streams: Sequence[Arrivals], horizon_s: float) -> ArrivalTable:
    """The arrivals before the horizon, s."""
    start_s, stop_s, every_s = (np.full(len(streams), np.nan) for _ in range(3))
    given: list[Array] = []
    for i, arrivals in enumerate(streams):
        times = np.zeros(0)
        match arrivals:
            case Poisson():
                start_s[i], every_s[i] = arrivals.start_s, arrivals.every_s
                stop_s[i] = min(arrivals.stop_s, horizon_s)
            case Batch():
                starts = np.array([arrivals.start_s])
                if arrivals.every_s is not None:
                    starts = np.arange(arrivals.start_s, horizon_s, arrivals.every_s)
                times = np.repeat(starts, arrivals.count)
            case Trace():
                times = np.array(arrivals.times_s, dtype=float)
        given.append(times[times < horizon_s])
    first = np.cumsum([0, *map(len, given)])
    return ArrivalTable(start_s, stop_s, every_s, np.concatenate([np.zeros(0), *given]), first)


@jit_inline
def sample_arrivals(table: ArrivalTable, stream: int, key: Bits, out: Array) -> int:
    """Put the arrival times of a stream into `out`, in order, and return their number; −1 if `out` is too short.

    Gaps of a Poisson stream are exponential, from the uniform values of `fleet.seeding` at counts 0, 1, 2, …

    Args:
        key: Of the stream, uint64.
        out: [room].
    """
    count = 0
    if np.isnan(table.every_s[stream]):
        for n in range(table.first[stream], table.first[stream + 1]):
            if count == len(out):
                return -1
            out[count] = table.times_s[n]
            count += 1
        return count
    time_s = table.start_s[stream]
    while True:
        time_s -= table.every_s[stream] * math.log1p(-random_uniform(key, np.uint64(count)))
        if time_s >= table.stop_s[stream]:
            return count
        if count == len(out):
            return -1
        out[count] = time_s
        count += 1


def scale_rate(arrivals: Arrivals, factor: float) -> Arrivals:
    """The arrivals at `factor` times the rate; single batches and traces are unchanged."""
    if isinstance(arrivals, Trace) or arrivals.every_s is None:
        return arrivals
    return replace(arrivals, every_s=arrivals.every_s / factor)
