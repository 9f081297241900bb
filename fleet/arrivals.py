"""Job arrivals: a Poisson stream, batches, or a trace."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Literal, NamedTuple

import numpy as np

from fleet.errors import check_nonnegative, check_positive
from fleet.jit import jit_inline
from fleet.seeding import Bits, random_uniform

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class Arrivals:
    """When jobs of a stream arrive: independently with exponential gaps, in batches, or at given times."""

    kind: Literal["poisson", "batch", "trace"]
    """In a scenario file also weekly, with times of day `at` and, if not every day, `weekdays`: it becomes a trace."""
    every_s: float | None = None
    """poisson: mean gap. batch: gap between batches; None for a single batch."""
    count: int | None = None
    """batch: jobs per batch."""
    start_s: float = 0.0
    """poisson, batch: no arrivals before this. trace: added to every time."""
    stop_s: float | None = None
    """poisson: no arrivals after this."""
    times_s: tuple[float, ...] | None = None
    """trace: the arrival times."""
    file: str | None = None
    """trace: a text file beside the scenario, one arrival time in seconds per line."""

    def __post_init__(self) -> None:
        kinds = {"poisson": ("every_s", "stop_s"), "batch": ("count", "every_s"), "trace": ("file", "times_s")}
        for name in sorted({name for names in kinds.values() for name in names} - {*kinds[self.kind]}):
            if getattr(self, name) is not None:
                allowed = ", ".join(sorted((*kinds[self.kind], "start_s")))
                raise ValueError(f"arrivals of kind '{self.kind}' take no '{name}'; they take {allowed}")
        needed = kinds[self.kind][0]
        if self.kind == "trace":
            if (self.times_s is None) == (self.file is None):
                raise ValueError("arrivals of kind 'trace' need either 'times_s' or 'file'")
            times = tuple(t + self.start_s for t in self.times_s or ())
            if not all(0 <= t < inf for t in times) or list(times) != sorted(times):
                raise ValueError(f"Arrivals.times_s must be >= 0, finite and in order (got {times}).")
            return
        if getattr(self, needed) is None:
            raise ValueError(f"arrivals of kind '{self.kind}' need '{needed}'")
        if self.every_s is not None:
            check_positive(self, "every_s")
        if self.count is not None:
            if self.count < 1:
                raise ValueError(f"Arrivals.count must be >= 1 (got {self.count}).")
            check_nonnegative(self, "start_s")
        stop_s = inf if self.stop_s is None else self.stop_s
        if not (0 <= self.start_s <= stop_s and self.start_s < inf):
            raise ValueError(f"Arrivals needs 0 <= start_s <= stop_s (got {self.start_s}, {stop_s}).")

    def given_s(self, horizon_s: float) -> Array:
        """Arrival times of batches or of a trace before the horizon, s, [arrival]; of a Poisson stream none."""
        times = np.array([t + self.start_s for t in self.times_s or ()], dtype=float)
        if self.count is not None:
            starts = [self.start_s] if self.every_s is None else np.arange(self.start_s, horizon_s, self.every_s)
            times = np.repeat(np.asarray(starts, dtype=float), self.count)
        return times[times < horizon_s]

    def expected(self, horizon_s: float) -> float:
        """Expected number of arrivals before the horizon; 0 for a trace whose file is not read yet."""
        if self.kind == "trace":
            return float(sum(t + self.start_s < horizon_s for t in self.times_s or ()))
        left_s = max(0.0, min(self.stop_s or horizon_s, horizon_s) - self.start_s)
        if self.kind == "poisson":
            assert self.every_s is not None
            return left_s / self.every_s
        assert self.count is not None
        batches = math.ceil(left_s / self.every_s) if self.every_s else float(left_s > 0)
        return self.count * batches


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
    for i, stream in enumerate(streams):
        if stream.kind == "poisson":
            start_s[i], every_s[i] = stream.start_s, stream.every_s
            stop_s[i] = horizon_s if stream.stop_s is None else min(stream.stop_s, horizon_s)
    given = [stream.given_s(horizon_s) for stream in streams]
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
    return arrivals if arrivals.every_s is None else replace(arrivals, every_s=arrivals.every_s / factor)
