"""A real arm's log as a body: it moves and warms as it once did, and takes no work."""

from dataclasses import dataclass

import numpy as np

from fleet.events import Event
from fleet.job import Job
from fleet.live.body import Reading
from fleet.motion import Plan

Array = np.ndarray

MOVING_RAD_S = 0.01
"""A joint that is faster is at work."""


@dataclass(frozen=True, eq=False)
class Readings:
    """What the sensors of one arm once said, each [time, joint], SI; None for what was not logged."""

    time_s: Array
    """Strictly increasing, [time]."""
    temp_c: Array
    q: Array
    qd: Array
    tau: Array
    current_a: Array | None = None


class LogBody:
    """Lives through a log once, from its first sample on, at the fleet's pace; then it stands as it ended."""

    def __init__(self, readings: Readings, *, time_s: float = 0.0) -> None:
        """Begin at the first sample.

        Args:
            time_s: The fleet's time at that moment.
        """
        if not len(readings.time_s):
            raise ValueError("A log needs at least one sample.")
        self._log = readings
        self._began_s = self._now_s = time_s

    @property
    def time_s(self) -> float:
        """The fleet's time until which it has lived."""
        return self._now_s

    @property
    def over(self) -> bool:
        """Whether its last sample has passed."""
        return self._row == len(self._log.time_s) - 1

    job, free, cycles = "", False, 0

    def last_in_s(self) -> float:
        """It never begins a cycle."""
        return np.inf

    def free_in_s(self) -> float:
        """It is never free."""
        return np.inf

    def begin(self, job: Job, plan: Plan, cycles: int) -> None:
        """Refuse: what is past cannot be changed."""
        raise ValueError(f"A log cannot begin '{job.name}'.")

    def permit(self, cycles: int) -> None:
        """Nothing is in hand."""

    def let_go(self) -> None:
        """Nothing is in hand."""

    def advance(self, until_s: float) -> list[Event]:
        """Live up to a time; nothing is told, for nobody judged the log."""
        self._now_s = max(self._now_s, until_s)
        return []

    def set_time(self, time_s: float) -> None:
        """From now on the fleet's time is another."""
        self._began_s += time_s - self._now_s
        self._now_s = time_s

    def set_pace(self, dt_s: float) -> None:
        """Whoever looks sees the last sample."""

    def read(self) -> Reading:
        """The last sample that was taken by now."""
        log, row = self._log, self._row
        qd = np.zeros_like(log.qd[row]) if self.over else log.qd[row]
        amps = () if log.current_a is None else tuple(log.current_a[row].tolist())
        mode = "working" if np.abs(qd).max() > MOVING_RAD_S else "idle"
        temp_c, q, tau = (tuple(values[row].tolist()) for values in (log.temp_c, log.q, log.tau))
        return Reading(mode, temp_c, q, tuple(qd.tolist()), tau, amps)

    @property
    def _row(self) -> int:
        into_s = self._log.time_s[0] + self._now_s - self._began_s
        return max(0, int(np.searchsorted(self._log.time_s, into_s + 1e-9, side="right")) - 1)
