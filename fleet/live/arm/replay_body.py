"""Body that replays the log of a real arm: it moves and warms as recorded, and accepts no work."""

from dataclasses import dataclass

import numpy as np

from fleet.events import Event
from fleet.job import Job
from fleet.live.arm.body import SensorReading
from fleet.motion import Plan

Array = np.ndarray

MOVING_RAD_S = 0.01
"""The arm is working when a joint is faster than this."""


@dataclass(frozen=True, eq=False)
class SensorLog:
    """Sensor readings of one arm, each [time, joint], SI; None for what was not logged."""

    time_s: Array
    """Strictly increasing, [time]."""
    temp_c: Array
    q: Array
    qd: Array
    tau: Array
    current_a: Array | None = None


class ReplayBody:
    """Body that replays a log once, in fleet time; then it keeps the last sample. See `fleet.live.arm.body.Body`.

    Args:
        time_s: Fleet time of the first sample.
    """

    def __init__(self, log: SensorLog, *, time_s: float = 0.0) -> None:
        if not len(log.time_s):
            raise ValueError("A log needs at least one sample.")
        self._log = log
        self._start_s = self._now_s = time_s

    @property
    def time_s(self) -> float:
        return self._now_s

    @property
    def over(self) -> bool:
        """Whether its last sample has passed."""
        return self._row == len(self._log.time_s) - 1

    @property
    def housing_c(self) -> np.ndarray:
        return self._log.temp_c[self._row]  # as warm as the motors: no job is quoted

    # It takes no jobs.

    job, is_free, cycles, away = "", False, 0, None

    def last_cycle_in_s(self) -> float:
        return np.inf

    def free_in_s(self) -> float:
        return np.inf

    def start(self, job: Job, plan: Plan, cycles: int) -> None:
        raise ValueError(f"A replayed log takes no jobs (got '{job.name}').")

    def allow_cycles(self, cycles: int) -> None:
        pass

    def release(self) -> None:
        pass

    # Its log

    def advance(self, until_s: float) -> list[Event]:
        self._now_s = max(self._now_s, until_s)
        return []

    def set_time(self, time_s: float) -> None:
        self._start_s += time_s - self._now_s
        self._now_s = time_s

    def clear_fault(self) -> str:
        return "a recorded arm has no faults"

    def set_step(self, dt_s: float) -> None:
        pass  # samples are read at any time

    def read_sensors(self) -> SensorReading:
        log, row = self._log, self._row
        qd = np.zeros_like(log.qd[row]) if self.over else log.qd[row]
        current_a = () if log.current_a is None else tuple(log.current_a[row].tolist())
        mode = "working" if np.abs(qd).max() > MOVING_RAD_S else "idle"
        temp_c, q, tau = (tuple(values[row].tolist()) for values in (log.temp_c, log.q, log.tau))
        return SensorReading(mode, temp_c, q, tuple(qd.tolist()), tau, current_a)

    @property
    def _row(self) -> int:
        into_s = self._log.time_s[0] + self._now_s - self._start_s
        after = np.searchsorted(self._log.time_s, into_s + 1e-9, side="right")  # pyright: ignore[reportUnknownVariableType]
        return max(0, int(after) - 1)  # pyright: ignore[reportUnknownArgumentType]
