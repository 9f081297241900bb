"""Sensor readings of the arms over time."""

from dataclasses import dataclass, fields
from typing import Literal, get_args

import numpy as np

from fleet.robot import JOINTS

Array = np.ndarray

Mode = Literal["idle", "working", "faulted"]
MODES: tuple[Mode, ...] = get_args(Mode)
"""Arrays hold the index of a mode in this tuple."""
IDLE, WORKING, FAULTED = range(len(MODES))


@dataclass(frozen=True, eq=False)
class Telemetry:
    """Sensor readings of a fleet; equally long arrays, sample axis first."""

    time_s: Array
    """[sample]."""
    mode: Array
    """Index into `MODES`, int [sample, arm]; -1 of an arm that is absent in a recording."""
    q: Array
    """rad, [sample, arm, joint]."""
    qd: Array
    """rad/s, [sample, arm, joint]."""
    tau: Array
    """N·m at the joint output, [sample, arm, joint]."""
    current_a: Array
    """[sample, arm, joint]."""
    temp_c: Array
    """Motor (winding) temperature with sensor noise, [sample, arm, joint]."""

    @classmethod
    def empty(cls, arms: int) -> "Telemetry":
        """Telemetry without samples."""
        sensors = [np.empty((0, arms, JOINTS), np.float32) for _ in range(5)]
        return cls(np.empty(0), np.empty((0, arms), np.int8), *sensors)


class Readings:
    """Telemetry that is added piece by piece, in the precision of recordings: float32, modes int8.

    Args:
        samples: Most samples of all pieces.
    """

    def __init__(self, samples: int) -> None:
        self._most, self._count = samples, 0
        self._all: dict[str, Array] = {}

    def add(self, part: Telemetry) -> None:
        """Append readings."""
        rows = slice(self._count, self._count + len(part.time_s))
        for f in fields(Telemetry):
            values = getattr(part, f.name)
            if f.name not in self._all:
                kind = {"time_s": np.float64, "mode": np.int8}.get(f.name, np.float32)
                self._all[f.name] = np.empty((self._most, *values.shape[1:]), kind)  # takes memory once written to
            self._all[f.name][rows] = values
        self._count = rows.stop

    def telemetry(self) -> Telemetry | None:
        """All readings so far; None without any."""
        return Telemetry(**{name: values[: self._count] for name, values in self._all.items()}) if self._count else None
